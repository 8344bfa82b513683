//! The scales of a cell's opacity and colour. A cell is the part of a list in a layer.
//!
//! Opacity: u = g(τ) = ½√(1 − e^−τ) + ln(1 + τ)/10. It is fine for little opacity, and still separates what is nearly
//! opaque, because a turned camera sees parts of a cell. A decoded u is one of [`CODES`] codes, and tables give all
//! that depends on τ. Colour: the square roots of C/α, transformed to a brightness Y and two differences Co, Cg.
//!
//! The tables are made of sums, products, quotients and square roots in double precision, so they are the same on
//! every machine.

use std::sync::LazyLock;

use super::super::portable_math::{exp_neg, ln};
use crate::layer::{TAU_MAX, pack_halves, unpack_halves};

/// Tables by the code of u.
pub(super) struct Scales {
    /// The bits of τ as a half float.
    pub(super) tau_half: Box<[u16]>,
    /// α = 1 − e^−τ.
    pub(super) alpha: Box<[f32]>,
    /// Optical depth τ, a half float, positive from code 1 on, and α.
    tau_and_alpha: Box<[FloatPair; CODES as usize]>,
    /// u of optical depths, [`PER_OCTAVE`] an octave from 2^[`LEAST_OCTAVE`] on, and the difference to the next. The
    /// length is a power of two, so a masked index is never outside.
    u_at: Box<[FloatPair; PLACES]>,
    /// Codes for a unit of u, and the inverse.
    codes_per_u: f32,
    u_per_code: f32,
}

/// Two numbers in one word, so that one lookup gives both.
#[derive(Clone, Copy)]
struct FloatPair(u64);

impl FloatPair {
    fn new(a: f32, b: f32) -> Self {
        Self(u64::from(a.to_bits()) | u64::from(b.to_bits()) << 32)
    }

    #[inline(always)]
    fn get(self) -> [f32; 2] {
        [f32::from_bits(self.0 as u32), f32::from_bits((self.0 >> 32) as u32)]
    }
}

/// The only instance.
pub(super) fn scales() -> &'static Scales {
    static SCALES: LazyLock<Scales> = LazyLock::new(Scales::new);
    &SCALES
}

impl Scales {
    fn new() -> Self {
        let u_max = u_from_tau(f64::from(TAU_MAX));
        let u_of_place = |i: usize| {
            let mantissa = 1.0 + (i % PER_OCTAVE) as f64 / PER_OCTAVE as f64;
            let octave = (i / PER_OCTAVE) as i32 + LEAST_OCTAVE;
            u_from_tau((mantissa * power_of_two(octave)).min(f64::from(TAU_MAX))) as f32
        };
        let mut u_at = Box::new([FloatPair(0); PLACES]);
        let mut next = u_of_place(0);
        for (i, at) in u_at.iter_mut().enumerate().take(OCTAVES * PER_OCTAVE + 1) {
            let u = std::mem::replace(&mut next, u_of_place(i + 1));
            *at = FloatPair::new(u, next - u);
        }
        let tau_half: Box<[u16]> = (0..CODES)
            .map(|code| {
                let u = u_max * f64::from(code) / f64::from(CODES - 1);
                let tau = if code == 0 { 0.0 } else { tau_from_u(u) };
                // The lowest codes would stand for less than the least half float.
                let half = pack_halves(tau as f32, 0.0) as u16;
                if code == 0 { 0 } else { half.max(1) }
            })
            .collect();
        let tau: Box<[f32]> = tau_half.iter().map(|&half| unpack_halves(half.into()).0).collect();
        let alpha: Box<[f32]> = tau.iter().map(|&t| (1.0 - exp_neg(t)) as f32).collect();
        let mut tau_and_alpha = Box::new([FloatPair(0); CODES as usize]);
        for ((both, tau), alpha) in tau_and_alpha.iter_mut().zip(&tau).zip(&alpha) {
            *both = FloatPair::new(*tau, *alpha);
        }
        Self {
            alpha,
            tau_and_alpha,
            tau_half,
            u_at,
            codes_per_u: (f64::from(CODES - 1) / u_max) as f32,
            u_per_code: (u_max / f64::from(CODES - 1)) as f32,
        }
    }

    /// u of an optical depth.
    #[inline(always)]
    pub(super) fn u_from_tau(&self, tau: f32) -> f32 {
        let bits = tau.clamp(LEAST_TAU, TAU_MAX).to_bits();
        let place = (bits - LEAST_TAU.to_bits()) >> REST_BITS;
        let part = (bits & ((1 << REST_BITS) - 1)) as f32 * (1.0 / (1 << REST_BITS) as f32);
        let [u, growth] = self.u_at[place as usize % PLACES].get();
        u + growth * part
    }

    /// τ and α of a code.
    #[inline(always)]
    pub(super) fn tau_and_alpha(&self, code: u16) -> [f32; 2] {
        self.tau_and_alpha[usize::from(code % CODES)].get()
    }

    /// The code of a cell with matter: at least 1.
    #[inline(always)]
    pub(super) fn code(&self, u: f32) -> u16 {
        let code = u * self.codes_per_u + 0.5;
        let most = f32::from(CODES - 1);
        (whole(if code < most { code } else { most }) as u16).max(1)
    }

    /// u of a code.
    #[inline(always)]
    pub(super) fn u(&self, code: u16) -> f32 {
        f32::from(code) * self.u_per_code
    }
}

/// Y, Co, Cg of the roots of red, green and blue.
#[inline(always)]
pub(super) fn ycc_from_roots([r, g, b]: [f32; 3]) -> [f32; 3] {
    [(r + 2.0 * g + b) * 0.25, (r - b) * 0.5, (2.0 * g - r - b) * 0.25]
}

/// Inverse of [`ycc_from_roots`].
#[inline(always)]
pub(super) fn roots_from_ycc([y, co, cg]: [f32; 3]) -> [f32; 3] {
    let rest = y - cg;
    [rest + co, y + cg, rest - co]
}

/// The roots of red, green and blue of a cell, clamped to possible colours.
#[inline(always)]
pub(super) fn roots(ycc: [i16; 3]) -> [f32; 3] {
    roots_from_ycc(ycc.map(f32_from_fixed)).map(|r| r.clamp(0.0, MAX_ROOT))
}

/// A colour difference or brightness as a stored number.
#[inline(always)]
pub(super) fn fixed_from_f32(x: f32) -> i16 {
    let size = whole((x * FIXED_ONE).abs() + 0.5) as i16;
    if x < 0.0 { -size } else { size }
}

/// The integer part of a number below 2²², and 0 for a negative one. Vector instructions of every machine can do
/// this.
#[inline(always)]
pub(super) fn whole(x: f32) -> u32 {
    let x = if x > 0.0 { x } else { 0.0 };
    let nearest = (x + ROUNDER) - ROUNDER;
    let whole = if nearest > x { nearest - 1.0 } else { nearest };
    (whole + ROUNDER).to_bits() & (ROUNDER_ONE - 1)
}

/// Inverse of [`fixed_from_f32`].
#[inline(always)]
pub(super) fn f32_from_fixed(x: i16) -> f32 {
    f32::from(x) * (1.0 / FIXED_ONE)
}

fn u_from_tau(tau: f64) -> f64 {
    0.5 * (1.0 - exp_neg(tau as f32)).max(0.0).sqrt() + 0.1 * ln(1.0 + tau)
}

/// Finds it by bisection, to less than half of a half float's last bit.
fn tau_from_u(u: f64) -> f64 {
    let (mut low, mut high) = (0.0, f64::from(TAU_MAX));
    for _ in 0..48 {
        let middle = 0.5 * (low + high);
        if u_from_tau(middle) < u {
            low = middle;
        } else {
            high = middle;
        }
    }
    high
}

/// 2^n, made from its bits.
fn power_of_two(n: i32) -> f64 {
    f64::from_bits(((n + 1023) as u64) << 52)
}

/// Greatest root of a colour. Shading can lift one above 1.
pub(super) const MAX_ROOT: f32 = 1.2;
/// 2²³: a sum with it has no fraction.
const ROUNDER: f32 = ROUNDER_ONE as f32;
const ROUNDER_ONE: u32 = 1 << 23;
/// Number of codes of u.
pub(super) const CODES: u16 = 4096;
/// Colours are stored in units of 1/8192.
const FIXED_ONE: f32 = 8192.0;
const PER_OCTAVE: usize = 1 << (23 - REST_BITS);
const REST_BITS: u32 = 17;
const LEAST_OCTAVE: i32 = -24;
const OCTAVES: usize = 34;
const PLACES: usize = 4096;
const _: () = assert!(OCTAVES * PER_OCTAVE < PLACES && CODES.is_power_of_two());
/// 2^[`LEAST_OCTAVE`], the least half float.
const LEAST_TAU: f32 = 5.960_464_5e-8;

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    #[test]
    fn codes_are_their_own_nearest_and_rise() {
        let s = scales();
        let tau = s.tau_and_alpha.map(|pair| pair.get()[0]);
        assert!(tau.is_sorted() && tau[0] == 0.0 && tau[1] > 0.0 && tau[4095] == TAU_MAX);
        assert!(s.alpha.is_sorted() && s.alpha[0] == 0.0 && s.alpha[4095] == 1.0);
        for code in 1..CODES {
            assert_eq!(s.code(s.u(code)), code);
            let of_half = unpack_halves(s.tau_half[usize::from(code)].into()).0;
            assert_eq!(s.tau_and_alpha(code), [of_half, s.alpha[usize::from(code)]]);
        }
        assert_eq!((s.code(-1.0), s.code(9.0)), (1, 4095));
    }

    #[test]
    fn u_is_what_it_says() {
        let s = scales();
        let mut tau = 1e-6f32;
        while tau < 1000.0 {
            let exact = 0.5 * (1.0 - (-f64::from(tau)).exp()).sqrt() + 0.1 * f64::from(tau).ln_1p();
            let found = f64::from(s.u_from_tau(tau));
            // Straight lines between 64 places an octave: (1/64)²/8 of the curvature, and the rounding of floats.
            assert!((found - exact).abs() < 2e-5, "{tau} {found} {exact}");
            let [back, _] = s.tau_and_alpha(s.code(found as f32));
            // Half a code is 1.5e-4 of u; the least slope of u over ln(τ) is near τ = 1/2 and at the ends.
            let slope = f64::from(s.u_from_tau(tau * 1.01)) - found;
            assert!(f64::from((back / tau).ln().abs()) < 0.01 * (1.6e-4 / slope) + 2e-3, "{tau} {back}");
            tau *= 1.07;
        }
    }

    #[test]
    fn whole_parts_are_those_of_a_cast() {
        for i in 0..200_000 {
            let x = i as f32 * 0.37 - 40.0;
            for x in [x, x.round(), x.round() + 0.5, (x.round() + 0.5).next_down(), x.round().next_down()] {
                assert_eq!(whole(x), x as u32, "{x}");
            }
        }
        assert_eq!(whole(f32::NAN), 0);
        assert_eq!((fixed_from_f32(-0.3), fixed_from_f32(0.3)), (-2458, 2458));
    }

    #[test]
    fn colours_come_back() {
        let c = Vec3::new(0.3, 0.02, 0.7) * 0.4;
        let roots = (c / 0.4).to_array().map(f32::sqrt);
        let kept = ycc_from_roots(roots).map(|v| f32_from_fixed(fixed_from_f32(v)));
        let back = Vec3::from(roots_from_ycc(kept).map(|s| s * s)) * 0.4;
        // Half a unit of 1/8192 on each of three roots.
        assert!((back - c).abs().max_element() < 2e-4, "{back}");
    }
}
