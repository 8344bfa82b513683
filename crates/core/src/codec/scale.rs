//! The scales that colour and optical depth are quantised on. Decoding uses exact arithmetic only, so every machine
//! decodes the same half floats.
//!
//! Colour: C = [`COLOR_MAX`]·(q/M)², M = 2^bits − 1. The square is close to sRGB's curve but finer in the dark, where
//! the many thin segments are; at 10 bits a step is at most 0.4 of a step of an 8-bit sRGB picture.
//!
//! Optical depth, 8 bits: τ = 8·(q/200)³ up to q = 200: fine where the opacity depends on it. Above, 8 steps
//! an octave (τ = 2^(3 + e)·(1 + m/8), 8e + m = q − 200): a relative error, as e^−8 is nothing in the picture but a part of
//! such a segment is not. q = 255 is [`TAU_MAX`]. Only τ = 0 is coded as 0: a segment with colour keeps an extinction.

use std::sync::LazyLock;

use super::CodecError;
use crate::layer::{TAU_MAX, pack_halves, unpack_halves};

/// The tables for one number of colour bits. `color` and `tau` are what a decoder gives: rounded to half floats.
pub(super) struct Scale {
    pub(super) color_bits: u8,
    pub(super) color: Vec<f32>,
    pub(super) color_half: Vec<u16>,
    pub(super) tau: [f32; 256],
    pub(super) tau_half: [u16; 256],
    /// e^−τ of the codes.
    pub(super) transmittance: [f32; 256],
    /// √(1 − e^−τ) of the codes.
    pub(super) sqrt_alpha: [f32; 256],
    /// 1/√(1 − e^−τ) of the codes; that of 0 is guarded.
    pub(super) inverse_sqrt_alpha: [f32; 256],
    /// Half-way between a code and the next; nothing is beyond the last.
    tau_limits: [f32; 256],
    /// A code not above the nearest one, for each value of a float's upper bits.
    tau_seeds: Vec<u8>,
}

/// The scale, or an error if there is none with so many bits.
pub(super) fn of(color_bits: u8) -> Result<&'static Scale, CodecError> {
    match color_bits {
        8 => Ok(&SCALE_8),
        10 => Ok(&SCALE_10),
        _ => Err(CodecError::Header {
            what: "bits of colour",
            found: color_bits.to_string(),
            expected: "8 or 10".into(),
        }),
    }
}

impl Scale {
    fn new(color_bits: u8) -> Self {
        let max_code = (1u32 << color_bits) - 1;
        let color_half = (0..=max_code)
            .map(|q| half(f64::from(COLOR_MAX) * f64::from(q * q) / f64::from(max_code * max_code)))
            .collect::<Vec<_>>();
        let tau_half: [u16; 256] = std::array::from_fn(|q| half(tau_from_code(q as u32)));
        let tau = tau_half.map(value);
        let tau_limits = std::array::from_fn(|q| match tau.get(q + 1) {
            Some(next) => 0.5 * (tau[q] + next),
            None => f32::INFINITY,
        });
        let tau_seeds = (0..=f32::INFINITY.to_bits() >> SEED_SHIFT)
            .map(|upper| {
                let least = f32::from_bits(upper << SEED_SHIFT);
                tau_limits[..255].partition_point(|&limit| limit < least) as u8
            })
            .collect();
        let sqrt_alpha = tau.map(|t| (1.0 - exp_neg(t)).sqrt() as f32);
        Self {
            color_bits,
            color: color_half.iter().map(|&h| value(h)).collect(),
            color_half,
            tau,
            tau_half,
            transmittance: tau.map(|t| exp_neg(t) as f32),
            sqrt_alpha,
            inverse_sqrt_alpha: sqrt_alpha.map(|a| 1.0 / a.max(LEAST_SQRT_ALPHA)),
            tau_limits,
            tau_seeds,
        }
    }

    /// Greatest code of a colour channel.
    pub(super) fn max_code(&self) -> u16 {
        (self.color.len() - 1) as u16
    }

    /// The code, or the greatest one.
    pub(super) fn clamp_code(&self, q: u32) -> u16 {
        q.min(self.max_code().into()) as u16
    }

    /// Nearest code of a colour channel on the square-root scale; colours above [`COLOR_MAX`] are clamped.
    pub(super) fn color_code(&self, c: f32) -> u16 {
        ((c * (1.0 / COLOR_MAX)).clamp(0.0, 1.0).sqrt() * f32::from(self.max_code()) + 0.5) as u16
    }

    /// Nearest code of an optical depth, but never 0 for one that is not.
    pub(super) fn tau_code(&self, tau: f32) -> u8 {
        let mut q = self.tau_seeds[(tau.max(0.0).to_bits() >> SEED_SHIFT) as usize];
        while self.tau_limits[usize::from(q)] < tau {
            q += 1;
        }
        if tau > 0.0 { q.max(1) } else { 0 }
    }
}

fn tau_from_code(q: u32) -> f64 {
    match q {
        0..=200 => f64::from(8 * q * q * q) / 8e6,
        255 => f64::from(TAU_MAX),
        _ => f64::from((8 + (q - 200) % 8) << ((q - 200) / 8)),
    }
}

/// e^−x for x in [0, [`TAU_MAX`]] by sums and products alone: libraries differ in the last bit of theirs, and predictions
/// must not. The series of e^(−x/1024) is squared ten times.
pub(super) fn exp_neg(x: f32) -> f64 {
    let y = f64::from(x) / 1024.0;
    let mut sum = 1.0;
    for n in (1..=18).rev() {
        sum = 1.0 - sum * y / f64::from(n);
    }
    for _ in 0..10 {
        sum *= sum;
    }
    sum
}

fn half(x: f64) -> u16 {
    pack_halves(x as f32, 0.0) as u16
}

fn value(half: u16) -> f32 {
    unpack_halves(u32::from(half)).0
}

/// Greatest colour that is kept. Shading can lift a colour a little above one.
pub(super) const COLOR_MAX: f32 = 1.25;
/// Guards the division by the opacity of an empty segment.
const LEAST_SQRT_ALPHA: f32 = 1e-4;
/// Lower bits of a float that the first guess at a code of τ leaves out: 32 guesses an octave.
const SEED_SHIFT: u32 = 18;

static SCALE_8: LazyLock<Scale> = LazyLock::new(|| Scale::new(8));
static SCALE_10: LazyLock<Scale> = LazyLock::new(|| Scale::new(10));

#[cfg(test)]
mod tests {
    use super::*;
    use crate::picture::srgb_from_linear;

    #[test]
    fn every_code_is_its_own_nearest() {
        for bits in [8, 10] {
            let scale = of(bits).unwrap();
            for q in 0..scale.color.len() {
                assert_eq!(scale.color_code(scale.color[q]), q as u16);
            }
            for q in 0..256 {
                assert_eq!(scale.tau_code(scale.tau[q]), q as u8, "{}", scale.tau[q]);
            }
        }
        assert!(of(9).is_err());
    }

    #[test]
    fn the_nearest_code_is_found_from_any_guess() {
        let scale = of(10).unwrap();
        let mut tau = 1e-9f32;
        while tau < 2e3 {
            let distance = |q: u8| (scale.tau[usize::from(q)] - tau).abs();
            let q = scale.tau_code(tau);
            assert!((1..=255).all(|other| distance(q) <= distance(other)), "{tau}");
            tau *= 1.01;
        }
        for tau in [0.0, -0.0, -1.0, f32::NAN] {
            assert_eq!(scale.tau_code(tau), 0);
        }
        assert_eq!((scale.tau_code(f32::MIN_POSITIVE), scale.tau_code(f32::INFINITY)), (1, 255));
    }

    #[test]
    fn exponential_by_products_is_the_exponential() {
        for t in SCALE_10.tau {
            let exact = f64::from(-t).exp();
            // Ten squarings multiply the rounding of doubles by 1024: 1.1e-13.
            assert!((exp_neg(t) - exact).abs() <= 2e-13 * exact, "{t}");
        }
        assert!((exp_neg(1.0) - (-1.01f64).exp()).abs() > 1e-3);
    }

    #[test]
    fn a_step_of_ten_bits_is_less_than_half_a_step_of_the_picture() {
        let largest = |bits| {
            let color = &of(bits).unwrap().color;
            let steps = color.windows(2).map(|w| srgb_from_linear(w[1]) - srgb_from_linear(w[0]));
            255.0 * steps.fold(0.0, f32::max)
        };
        // The curve alone gives 0.40; a half float near one is coarse enough to lengthen a step by a quarter.
        assert!(largest(10) < 0.5, "{}", largest(10));
        assert!(largest(8) > 1.0);
    }

    #[test]
    fn scales_end_where_they_say_and_rise() {
        let scale = of(10).unwrap();
        assert_eq!((scale.color[0], scale.color[1023]), (0.0, COLOR_MAX));
        assert_eq!((scale.tau[0], scale.tau[200], scale.tau[255]), (0.0, 8.0, TAU_MAX));
        assert!(scale.tau.is_sorted_by(|a, b| a < b) && scale.color.is_sorted_by(|a, b| a < b));
        assert_eq!((scale.color_code(7.0), scale.tau_code(1e-9), scale.tau_code(2e3)), (1023, 1, 255));
    }
}
