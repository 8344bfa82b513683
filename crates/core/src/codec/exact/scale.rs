//! Scales of quantised colour and optical depth. Decoding uses exact arithmetic only, so every machine decodes the
//! same half floats.
//!
//! Colour: C = [`COLOR_MAX`]·(q/M)², M = 1023. The square is close to sRGB's curve but finer in the dark, where the
//! many thin segments are. A code has 10 bits, so a step is at most 0.45 of a step of an 8-bit sRGB picture. With 8
//! bits it would be more than a whole one.
//!
//! Optical depth has 8 bits. Up to q = 200, τ = 8·(q/200)³, which is fine where the opacity depends on τ. Above,
//! there are 8 steps an octave: τ = 2^(3 + e)·(1 + m/8), with 8e + m = q − 200. A relative error suffices there: e^−8
//! is invisible, but a part of such a segment is not. q = 255 is [`TAU_MAX`]. Only τ = 0 has code 0, so a segment
//! with colour keeps an extinction.

use std::sync::LazyLock;

use super::super::portable_math::exp_neg;
use crate::layer::{COLOR_MAX, TAU_MAX, pack_halves, unpack_halves};

/// The tables. `color` and `tau` are decoded values, rounded to half floats.
pub(super) struct Scale {
    pub(super) color: Vec<f32>,
    pub(super) color_half: Vec<u16>,
    pub(super) tau: [f32; 256],
    pub(super) tau_half: [u16; 256],
    /// e^−τ of the codes.
    pub(super) transmittance: [f32; 256],
    /// √(1 − e^−τ) of the codes, in 2⁻¹⁶.
    sqrt_alpha: [u32; 256],
    /// 1/√(1 − e^−τ) of the codes, in 2⁻¹²; that of 0 is guarded.
    inverse_sqrt_alpha: [u32; 256],
    /// log₂ of the codes' optical depths in steps of 1/[`LOG_STEPS`]; that of code 0 is an octave below that of code
    /// 1.
    log_tau: [i16; 256],
    /// The code with the nearest logarithm, from [`LEAST_LOG_EXTINCTION`] on.
    code_from_log: Box<[u8; NUM_LOGS]>,
    /// Half-way between a code and the next; infinite for the last.
    tau_limits: [f32; 256],
    /// For each value of a float's upper bits, a code that is not above the nearest one.
    tau_seeds: Vec<u8>,
}

/// The only instance.
pub(super) fn scale() -> &'static Scale {
    static SCALE: LazyLock<Scale> = LazyLock::new(Scale::new);
    &SCALE
}

impl Scale {
    fn new() -> Self {
        let max_code = u32::from(MAX_COLOR_CODE);
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
        let mut log_tau = tau.map(|t| if t > 0.0 { log2_steps(t) } else { 0 });
        log_tau[0] = log_tau[1] - LOG_STEPS;
        let mut code_from_log = Box::new([0; NUM_LOGS]);
        for (log, code) in (LEAST_LOG_EXTINCTION..).zip(&mut *code_from_log) {
            *code = log_tau.windows(2).filter(|w| w[0] + w[1] < 2 * log).count() as u8;
        }
        let sqrt_alpha = tau.map(|t| (1.0 - exp_neg(t)).sqrt());
        Self {
            color: color_half.iter().map(|&h| value(h)).collect(),
            color_half,
            tau,
            tau_half,
            transmittance: tau.map(|t| exp_neg(t) as f32),
            sqrt_alpha: sqrt_alpha.map(|a| (a * 65536.0 + 0.5) as u32),
            inverse_sqrt_alpha: sqrt_alpha.map(|a| (4096.0 / a.max(LEAST_SQRT_ALPHA) + 0.5) as u32),
            log_tau,
            code_from_log,
            tau_limits,
            tau_seeds,
        }
    }

    /// √(α'/α), the ratio of the colour codes of one matter at two optical depths, in 2⁻¹⁶ and at most 16. Takes 1/√α
    /// and the code of the optical depth with opacity α'.
    pub(super) fn times(&self, inverse_sqrt_alpha: u32, to: u8) -> u32 {
        let times = u64::from(inverse_sqrt_alpha) * u64::from(self.sqrt_alpha[usize::from(to)]);
        (times >> 12).min(16 << 16) as u32
    }

    /// 1/√α of a code of optical depth, in 2⁻¹².
    pub(super) fn inverse_sqrt_alpha(&self, tau: u8) -> u32 {
        self.inverse_sqrt_alpha[usize::from(tau)]
    }

    /// log₂ of a code's optical depth in steps of 1/128. Minus that of a thickness, it is that of the extinction.
    pub(super) fn log_tau(&self, tau: u8) -> i16 {
        self.log_tau[usize::from(tau)]
    }

    /// The code of the optical depth with this logarithm.
    pub(super) fn tau_from_log(&self, log: i16) -> u8 {
        self.code_from_log[usize::from((log - LEAST_LOG_EXTINCTION) as u16) % NUM_LOGS]
    }

    /// Nearest code of a colour channel. Colours above [`COLOR_MAX`] are clamped.
    pub(super) fn color_code(&self, c: f32) -> u16 {
        ((c * (1.0 / COLOR_MAX)).clamp(0.0, 1.0).sqrt() * f32::from(MAX_COLOR_CODE) + 0.5) as u16
    }

    /// Nearest code of an optical depth; at least 1 for a positive one.
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

/// log₂ of a positive number in steps of 1/[`LOG_STEPS`], rounded down. It squares, because libraries differ in the
/// last bit.
const fn log2_steps(x: f32) -> i16 {
    let mut exponent = 0;
    let mut mantissa = x as f64;
    while mantissa >= 2.0 {
        mantissa *= 0.5;
        exponent += 1;
    }
    while mantissa < 1.0 {
        mantissa *= 2.0;
        exponent -= 1;
    }
    let mut step = LOG_STEPS;
    let mut log = exponent * LOG_STEPS;
    while step > 1 {
        step /= 2;
        mantissa *= mantissa;
        if mantissa >= 2.0 {
            mantissa *= 0.5;
            log += step;
        }
    }
    log
}

/// [`log2_steps`] of a thickness, which is rounded to 8 bits; 0 counts as 1.
pub(super) fn log_thickness(thickness: u16) -> i16 {
    let exponent = 15 - thickness.max(1).leading_zeros() as i16;
    let mantissa = (thickness << (15 - exponent)) >> 7;
    exponent * LOG_STEPS + i16::from(LOG_MANTISSA[usize::from(mantissa & 0xff)])
}

static LOG_MANTISSA: [u8; 256] = {
    let mut table = [0; 256];
    let mut i = 0;
    while i < 256 {
        table[i] = log2_steps(1.0 + i as f32 / 256.0) as u8;
        i += 1;
    }
    table
};

fn half(x: f64) -> u16 {
    pack_halves(x as f32, 0.0) as u16
}

fn value(half: u16) -> f32 {
    unpack_halves(u32::from(half)).0
}

/// Greatest code of a colour channel.
pub(super) const MAX_COLOR_CODE: u16 = 1023;
/// Guards the division by the opacity of an empty segment.
const LEAST_SQRT_ALPHA: f64 = 1e-4;
/// Number of low bits of a float that the first guess at a code of τ ignores: 32 guesses an octave.
const SEED_SHIFT: u32 = 18;

/// Steps of a logarithm in an octave. A step of τ is at least two of them.
const LOG_STEPS: i16 = 128;
/// Logarithm of the least extinction, rounded down: the least τ over the greatest thickness, an octave lower for τ =
/// 0.
pub(super) const LEAST_LOG_EXTINCTION: i16 = (-20 - 1 - 16) * LOG_STEPS;
/// Number of logarithms from there on: 10 octaves of τ and 16 octaves of thickness. It is a power of two, so a masked
/// index is never outside.
const NUM_LOGS: usize = 64 * LOG_STEPS as usize;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::picture::srgb_from_linear;

    #[test]
    fn every_code_is_its_own_nearest() {
        let scale = scale();
        for q in 0..scale.color.len() {
            assert_eq!(scale.color_code(scale.color[q]), q as u16);
        }
        for q in 0..256 {
            assert_eq!(scale.tau_code(scale.tau[q]), q as u8, "{}", scale.tau[q]);
        }
    }

    #[test]
    fn the_nearest_code_is_found_from_any_guess() {
        let scale = scale();
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
    fn logarithms_are_those_of_the_library() {
        for z in 1..=u16::MAX {
            // Rounded down twice: to 8 bits (at most 0.72 steps) and to a step.
            let exact = 128.0 * f64::from(z).log2();
            assert!((exact - 1.73..=exact).contains(&f64::from(log_thickness(z))), "{z}");
        }
        let scale = scale();
        let extinction = |q: u8, z: u16| scale.log_tau(q) - log_thickness(z);
        let code = |log: i16, z: u16| scale.tau_from_log(log + log_thickness(z));
        for q in 1..=255u8 {
            for z in [1, 2, 77, 4096, 65_535] {
                assert_eq!(code(extinction(q, z), z), q, "{q} {z}");
            }
            // Twice the thickness is twice the optical depth, up to half a step, an eighth at most, and two roundings.
            let twice = scale.tau[usize::from(code(extinction(q, 50), 100))];
            let expected = (2.0 * scale.tau[usize::from(q)]).min(TAU_MAX);
            assert!((twice / expected - 1.0).abs() < 0.08 || q < 60, "{q} {twice} {expected}");
        }
        assert_eq!(code(LEAST_LOG_EXTINCTION, u16::MAX), 0);
        assert!(extinction(0, u16::MAX) >= LEAST_LOG_EXTINCTION);
        let most = extinction(255, 0) + log_thickness(u16::MAX);
        assert!(most < LEAST_LOG_EXTINCTION + NUM_LOGS as i16);
        assert_eq!(code(extinction(255, 0), u16::MAX), 255);
    }

    #[test]
    fn a_step_is_less_than_half_a_step_of_the_picture() {
        let largest = |codes: &mut dyn Iterator<Item = &f32>| {
            let shown: Vec<_> = codes.map(|&c| 255.0 * srgb_from_linear(c)).collect();
            shown.windows(2).map(|w| w[1] - w[0]).fold(0.0, f32::max)
        };
        // The curve alone gives 0.40; a half float near one is coarse enough to lengthen a step by a quarter.
        let color = &scale().color;
        let found = largest(&mut color.iter());
        assert!(found < 0.5, "{found}");
        assert!(largest(&mut color.iter().step_by(4)) > 1.0);
    }

    #[test]
    fn scales_end_where_they_say_and_rise() {
        let scale = scale();
        assert_eq!((scale.color[0], scale.color[1023]), (0.0, COLOR_MAX));
        assert_eq!((scale.tau[0], scale.tau[200], scale.tau[255]), (0.0, 8.0, TAU_MAX));
        assert!(scale.tau.is_sorted_by(|a, b| a < b) && scale.color.is_sorted_by(|a, b| a < b));
        assert_eq!((scale.color_code(7.0), scale.tau_code(1e-9), scale.tau_code(2e3)), (1023, 1, 255));
    }
}
