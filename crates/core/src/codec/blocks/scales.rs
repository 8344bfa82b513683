//! The scales of a cell's opacity and colour. A cell is the part of a list in a layer.
//!
//! Opacity: u = g(τ) = ½√(1 − e^−τ) + ln(1 + τ)/10. It is fine for little opacity, and still separates what is nearly
//! opaque, because a turned camera sees parts of a cell. A decoded u is one of [`CODES`] codes, and tables give all
//! that depends on τ. Colour: the square roots of C/α, transformed to a brightness Y and two differences Co, Cg.
//!
//! The tables are made of sums, products, quotients and square roots in double precision, so they are the same on
//! every machine. What a decoder computes with them are integers.

use std::sync::LazyLock;

use super::super::portable_math::{exp_neg, ln};
use crate::layer::{TAU_MAX, pack_halves, unpack_halves};

/// Tables by the code of u, and others.
pub(super) struct Scales {
    /// The bits of τ as a half float, positive from code 1 on.
    pub(super) tau_half: Box<[u16]>,
    /// α = 1 − e^−τ.
    pub(super) alpha: Box<[f32]>,
    /// α in units of [`UNIT`], positive from code 1 on; and, in the upper half, log₂ τ.
    pub(super) by_code: Box<[u32; CODES as usize]>,
    /// The code for log₂ τ, for each [`LOG_STEP`] from [`LEAST_LOG`] on.
    pub(super) code_of_log: Box<[u16; LOGS]>,
    /// log₂ of mantissas from 1 to 2.
    pub(super) log_of_mantissa: Box<[i16; MANTISSAS]>,
    /// How much log₂ of a sum is above that of the greater number, for each [`BELOW_STEP`] by which that of the other
    /// is below.
    pub(super) log_of_sum: Box<[i16; BELOWS]>,
    /// 2¹² over the root of a number from 0 to 1.
    pub(super) per_root: Box<[u16; ROOTS]>,
    /// u of optical depths, [`PER_OCTAVE`] an octave from 2^[`LEAST_OCTAVE`] on, and the difference to the next. The
    /// length is a power of two, so a masked index is never outside. In quarters of a code, for an encoder.
    u_at: Box<[FloatPair; PLACES]>,
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
        let quarters = f64::from(QUARTERS_PER_U);
        let u_of_place = |i: usize| {
            let mantissa = 1.0 + (i % PER_OCTAVE) as f64 / PER_OCTAVE as f64;
            let octave = (i / PER_OCTAVE) as i32 + LEAST_OCTAVE;
            (quarters * u_from_tau((mantissa * power_of_two(octave)).min(f64::from(TAU_MAX)))) as f32
        };
        let mut u_at = Box::new([FloatPair(0); PLACES]);
        let mut next = u_of_place(0);
        for (i, at) in u_at.iter_mut().enumerate().take(OCTAVES * PER_OCTAVE + 1) {
            let u = std::mem::replace(&mut next, u_of_place(i + 1));
            *at = FloatPair::new(u, next - u);
        }
        let u_max = u_from_tau(f64::from(TAU_MAX));
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
        let mut by_code = Box::new([0; CODES as usize]);
        for ((word, tau), alpha) in by_code.iter_mut().zip(&tau).zip(&alpha).skip(1) {
            let of_unit = nearest(f64::from(*alpha) * f64::from(UNIT)).clamp(1, UNIT - 1);
            // The argument is at least 1.
            let log = log2(f64::from(*tau) * power_of_two(-LEAST_OCTAVE)) + LEAST_LOG;
            *word = of_unit as u32 | (log as u32) << 16;
        }
        let mut made = Self {
            tau_half,
            alpha,
            by_code,
            code_of_log: Box::new([0; LOGS]),
            log_of_mantissa: Box::new(std::array::from_fn(|i| {
                log2(1.0 + i as f64 / MANTISSAS as f64) as i16
            })),
            log_of_sum: Box::new(std::array::from_fn(|i| {
                let octaves = (i as f64 + 0.5) * f64::from(BELOW_STEP) / f64::from(LOG_ONE);
                log2(1.0 + exp_neg((octaves * std::f64::consts::LN_2) as f32)) as i16
            })),
            per_root: Box::new(std::array::from_fn(|i| {
                nearest(4096.0 / ((i as f64 + 0.5) / ROOTS as f64).sqrt()) as u16
            })),
            u_at,
        };
        let mut code = 1;
        for i in 0..LOGS {
            let log = LEAST_LOG + i as i32 * LOG_STEP + LOG_STEP / 2;
            let from = |code: u16| (made.log_of_tau(code) - log).abs();
            while code < CODES - 1 && from(code + 1) <= from(code) {
                code += 1;
            }
            made.code_of_log[i] = code;
        }
        made
    }

    /// u of an optical depth, in quarters of a code.
    #[inline(always)]
    pub(super) fn u_from_tau(&self, tau: f32) -> f32 {
        let bits = tau.clamp(LEAST_TAU, TAU_MAX).to_bits();
        let place = (bits - LEAST_TAU.to_bits()) >> REST_BITS;
        let part = (bits & ((1 << REST_BITS) - 1)) as f32 * (1.0 / (1 << REST_BITS) as f32);
        let [u, growth] = self.u_at[place as usize % PLACES].get();
        u + growth * part
    }

    /// α of a code, in units of [`UNIT`].
    #[inline(always)]
    pub(super) fn opacity(&self, code: u16) -> i32 {
        (self.by_code[usize::from(code % CODES)] & 0xffff) as i32
    }

    /// log₂ τ of a code from 1 on, in units of [`LOG_ONE`].
    #[inline(always)]
    pub(super) fn log_of_tau(&self, code: u16) -> i32 {
        self.by_code[usize::from(code % CODES)] as i32 >> 16
    }

    /// The code of an optical depth, of which log₂ τ is given.
    #[inline(always)]
    pub(super) fn code_of_log(&self, log: i32) -> u16 {
        let place = (log - LEAST_LOG) / LOG_STEP;
        self.code_of_log[place.clamp(0, LOGS as i32 - 1) as usize]
    }

    /// log₂ of a number from 1 to 2²⁴, in units of [`LOG_ONE`].
    #[inline(always)]
    pub(super) fn log_of(&self, number: i32) -> i32 {
        let bits = (number as f32).to_bits();
        let octave = (bits >> 23) as i32 - 127;
        octave * LOG_ONE + i32::from(self.log_of_mantissa[(bits >> 13) as usize % MANTISSAS])
    }

    /// log₂ (a + b), given log₂ a and log₂ b.
    #[inline(always)]
    pub(super) fn log_of_sum(&self, a: i32, b: i32) -> i32 {
        let (most, least) = if a > b { (a, b) } else { (b, a) };
        let below = ((most - least) / BELOW_STEP) as usize;
        most + self.log_of_sum.get(below).map_or(0, |more| i32::from(*more))
    }

    /// A step over the root of a number in units of [`UNIT`].
    pub(super) fn per_root(&self, step: u16, of: i32) -> i32 {
        let place = (of / (UNIT / ROOTS as i32)).clamp(0, ROOTS as i32 - 1);
        ((u32::from(step) * u32::from(self.per_root[place as usize])) >> 12).max(1) as i32
    }
}

/// The code of a cell with matter, given quarters of a code: at least 1.
#[inline(always)]
pub(super) fn code_from_quarters(quarters: i32) -> u16 {
    ((quarters.clamp(4, 4 * i32::from(CODES - 1)) + 2) >> 2) as u16
}

/// What is left of a transmittance in units of [`UNIT`] behind an opacity.
#[inline(always)]
pub(super) fn behind(kappa: i32, opacity: i32) -> i32 {
    ((kappa as u32 * (UNIT - opacity) as u32 + UNIT as u32 / 2) >> 16) as i32
}

/// The visible part of an opacity, in units of [`UNIT`].
#[inline(always)]
pub(super) fn seen(kappa: i32, opacity: i32) -> i32 {
    ((kappa as u32 * opacity as u32) >> 16) as i32
}

/// Y, Co, Cg of the roots of red, green and blue.
#[inline(always)]
pub(super) fn ycc_from_roots([r, g, b]: [f32; 3]) -> [f32; 3] {
    [(r + 2.0 * g + b) * 0.25, (r - b) * 0.5, (2.0 * g - r - b) * 0.25]
}

/// Inverse of [`ycc_from_roots`], in whole numbers.
#[inline(always)]
pub(super) fn roots_from_ycc([y, co, cg]: [i32; 3]) -> [i32; 3] {
    let rest = y - cg;
    [rest + co, y + cg, rest - co]
}

/// The roots of red, green and blue of a cell, clamped to possible colours.
#[inline(always)]
pub(super) fn roots(ycc: [i16; 3]) -> [i32; 3] {
    roots_from_ycc(ycc.map(i32::from)).map(|root| root.clamp(0, MAX_ROOT))
}

/// ⌊√x⌋ of a number up to 2·10⁹.
#[inline(always)]
pub(super) fn root_of(number: i32) -> i32 {
    let about = (number as f32).sqrt() as i32;
    let less = about - i32::from(about * about > number);
    let more = less + 1;
    less + i32::from(more * more <= number)
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

/// The number nearest to one that is not negative.
fn nearest(x: f64) -> i32 {
    (x + 0.5) as i32
}

/// log₂ of a number of at least 1, in units of [`LOG_ONE`].
fn log2(x: f64) -> i32 {
    nearest(ln(x) / std::f64::consts::LN_2 * f64::from(LOG_ONE))
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

/// Greatest root of a colour, in units of 1/8192. Shading can lift one above 1.
pub(super) const MAX_ROOT: i32 = 9830;
/// 2²³: a sum with it has no fraction.
const ROUNDER: f32 = ROUNDER_ONE as f32;
const ROUNDER_ONE: u32 = 1 << 23;
/// Number of codes of u.
pub(super) const CODES: u16 = 4096;
/// Quarters of a code to a unit of u: 4·4095 over u of [`TAU_MAX`].
pub(super) const QUARTERS_PER_U: f32 = 13_754.586;
/// A colour or root of 1 in the numbers that are coded. Cells have a quarter of these.
pub(super) const FINE: f32 = 32_768.0;
/// An opacity or transmittance of 1. No number reaches it.
pub(super) const UNIT: i32 = 1 << 16;
/// An octave.
const LOG_ONE: i32 = 1024;
const LEAST_LOG: i32 = -24_576;
const LOG_STEP: i32 = 4;
const LOGS: usize = OCTAVES * (LOG_ONE / LOG_STEP) as usize;
const MANTISSAS: usize = 1024;
const BELOW_STEP: i32 = 16;
const BELOWS: usize = 11 * (LOG_ONE / BELOW_STEP) as usize;
const ROOTS: usize = 1024;
const PER_OCTAVE: usize = 1 << (23 - REST_BITS);
const REST_BITS: u32 = 17;
const LEAST_OCTAVE: i32 = -24;
const OCTAVES: usize = 34;
const PLACES: usize = 4096;
const _: () =
    assert!(LEAST_LOG == LEAST_OCTAVE * LOG_ONE && OCTAVES * PER_OCTAVE < PLACES && CODES.is_power_of_two());
/// 2^[`LEAST_OCTAVE`], the least half float.
const LEAST_TAU: f32 = 5.960_464_5e-8;

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    fn tau_of(code: u16) -> f32 {
        unpack_halves(scales().tau_half[usize::from(code)].into()).0
    }

    #[test]
    fn codes_rise_and_have_the_opacity_of_their_depth() {
        let s = scales();
        assert!((1..CODES).all(|code| tau_of(code - 1) < tau_of(code) || code < 30));
        assert_eq!((tau_of(0), tau_of(CODES - 1), s.opacity(0)), (0.0, TAU_MAX, 0));
        let per_u = 4.0 * f64::from(CODES - 1) / u_from_tau(f64::from(TAU_MAX));
        assert!((per_u - f64::from(QUARTERS_PER_U)).abs() < 1e-2, "{per_u}");
        for code in 1..CODES {
            let exact = 65536.0 * (1.0 - (-tau_of(code)).exp());
            // Half a unit, and the ends that no number may reach.
            assert!((s.opacity(code) as f32 - exact).abs() <= 1.01 && (1..UNIT).contains(&s.opacity(code)));
            let log = 1024.0 * tau_of(code).log2();
            assert!((s.log_of_tau(code) as f32 - log).abs() < 0.51, "{code}");
        }
    }

    #[test]
    fn u_is_the_function_of_depth_and_logarithms_lead_back() {
        let s = scales();
        let mut tau = 1e-6f32;
        while tau < 1000.0 {
            let exact = 0.5 * (1.0 - (-f64::from(tau)).exp()).sqrt() + 0.1 * f64::from(tau).ln_1p();
            let found = f64::from(s.u_from_tau(tau) / QUARTERS_PER_U);
            // Straight lines between 64 places an octave: (1/64)²/8 of the curvature, and the rounding of floats.
            assert!((found - exact).abs() < 2e-5, "{tau} {found} {exact}");
            tau *= 1.07;
        }
        // Codes below some tens have the same half float as others.
        for code in 60..CODES {
            let log = s.log_of_tau(code);
            let back = s.code_of_log(log);
            // An octave has at most 520 codes, so four units of 1/1024 have two.
            assert!(back.abs_diff(code) <= 2, "{code} {back}");
            let half = s.code_of_log(log - LOG_ONE);
            assert!(
                (tau_of(half) / tau_of(code) - 0.5).abs() < 0.01 + 0.5 / f32::from(half),
                "{code} {half}"
            );
        }
        assert_eq!((s.code_of_log(i32::MIN / 2), s.code_of_log(1 << 20)), (1, CODES - 1));
        for (a, b) in [(1, 1), (7, 3), (1 << 20, 3), (12_345, 67_890), ((1 << 24) - 1, 1)] {
            let exact = |x: i32| 1024.0 * f64::from(x).log2();
            assert!((f64::from(s.log_of(a)) - exact(a)).abs() < 2.0, "{a}");
            let sum = s.log_of_sum(s.log_of(a), s.log_of(b));
            // Steps of a 64th of an octave: half of one, times a half where both are alike.
            assert!((f64::from(sum) - exact(a + b)).abs() < 7.0, "{a} {b}");
        }
    }

    #[test]
    fn roots_are_whole_and_steps_are_over_them() {
        for number in (0..60_000).chain((0..970_000).map(|i| i * 2047)) {
            let root = i64::from(root_of(number));
            assert!(root * root <= number.into() && (root + 1) * (root + 1) > number.into(), "{number}");
        }
        for of in [1311, 13107, 30_000, 65_535] {
            let exact = 1000.0 / (of as f32 / 65_536.0).sqrt();
            assert!((scales().per_root(1000, of) as f32 / exact - 1.0).abs() < 0.03, "{of}");
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
    }

    #[test]
    fn colours_come_back() {
        let c = Vec3::new(0.3, 0.02, 0.7) * 0.4;
        let kept = ycc_from_roots((c / 0.4).to_array().map(f32::sqrt)).map(|v| (v * 8192.0).round() as i16);
        let back = Vec3::from(roots(kept).map(|root| (root as f32 / 8192.0).powi(2))) * 0.4;
        // Half a unit of 1/8192 on each of three roots.
        assert!((back - c).abs().max_element() < 2e-4, "{back}");
    }
}
