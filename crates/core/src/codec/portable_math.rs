//! Functions made of sums, products and quotients only. The functions of libraries differ in the last bit, and all
//! machines must decode alike.

use crate::layer::TAU_MAX;

/// e^−x for x in [0, [`TAU_MAX`]]: the series of e^(−x/1024), squared ten times.
pub(super) fn exp_neg(x: f32) -> f64 {
    debug_assert!((0.0..=TAU_MAX).contains(&x), "{x}");
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

/// Natural logarithm of a number of at least 1, by the series of the inverse hyperbolic tangent.
pub(super) fn ln(x: f64) -> f64 {
    let bits = x.to_bits();
    let octave = (bits >> 52) as i32 - 1023;
    let mantissa = f64::from_bits(bits & ((1 << 52) - 1) | 1023 << 52);
    let t = (mantissa - 1.0) / (mantissa + 1.0);
    let mut sum = 0.0;
    for n in (0..20).rev() {
        sum = sum * t * t + 1.0 / f64::from(2 * n + 1);
    }
    f64::from(octave) * std::f64::consts::LN_2 + 2.0 * t * sum
}

/// Tangent of an angle in [0, π/2), radians, by the series of sine and cosine.
pub(super) fn tan(x: f64) -> f64 {
    let (mut sine, mut cosine) = (1.0, 1.0);
    for n in (1..=14).rev() {
        let n = f64::from(2 * n);
        cosine = 1.0 - x * x / ((n - 1.0) * n) * cosine;
        sine = 1.0 - x * x / (n * (n + 1.0)) * sine;
    }
    x * sine / cosine
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn they_are_the_functions_of_the_library() {
        for x in [0.0f32, 1e-6, 0.3, 1.0, 8.0, 100.0, TAU_MAX] {
            let exact = f64::from(-x).exp();
            // Ten squarings multiply the rounding of doubles by 1024: 1.1e-13.
            assert!((exp_neg(x) - exact).abs() <= 2e-13 * exact, "{x}");
        }
        assert!((exp_neg(1.0) - (-1.01f64).exp()).abs() > 1e-3);
        for x in [1.0, 1.5, 3.0, 1001.0] {
            assert!((ln(x) - x.ln()).abs() <= 1e-14 * x.ln().max(1.0), "{x}");
        }
        for x in [0.0, 0.3, 0.8, 1.5] {
            assert!((tan(x) - x.tan()).abs() <= 1e-12 * x.tan().max(1.0), "{x}");
        }
    }
}
