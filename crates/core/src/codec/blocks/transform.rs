//! The 8×8 cosine transform of a block's plane, and the values of a plane where there is no matter.
//!
//! An encoder transforms in single precision. What a decoder inverts are integers.

use super::model::{BLOCK, BLOCK_LISTS};

/// Values of a block's lists, row by row, of an encoder.
pub(super) type BlockPlane = [f32; BLOCK_LISTS];

/// Values of a block's lists, row by row, that a decoder has. Products and sums wrap around, so that damaged bytes have
/// a result too.
pub(super) type BlockNumbers = [i32; BLOCK_LISTS];

wide! {
    /// The orthonormal transform. Frequencies are row by row, with horizontal ones along a row.
    pub(super) fn forward(values: &BlockPlane) -> BlockPlane = forward_any;
}

wide! {
    /// Inverse of [`forward`]. Each of two passes rounds to whole numbers.
    pub(super) fn inverse(coefficients: &BlockNumbers) -> BlockNumbers = inverse_any;
}

wide! {
    /// Gives the lists outside of `mask` smooth values, which take few coefficients. They start from the mean and
    /// relax towards their neighbours' values.
    pub(super) fn fill_in(values: &mut BlockPlane, mask: u64) = fill_in_any;
}

#[inline(always)]
fn forward_any(values: &BlockPlane) -> BlockPlane {
    let mut rows = [[0.0; BLOCK]; BLOCK];
    for (row, values) in rows.iter_mut().zip(values.as_chunks::<BLOCK>().0) {
        for (x, &value) in values.iter().enumerate() {
            add_scaled(row, &TRANSPOSED[x], value);
        }
    }
    let mut out = [0.0; BLOCK_LISTS];
    for (frequency, out) in out.as_chunks_mut::<BLOCK>().0.iter_mut().enumerate() {
        for (y, row) in rows.iter().enumerate() {
            add_scaled(out, row, BASIS[frequency][y]);
        }
    }
    out
}

#[inline(always)]
fn inverse_any(coefficients: &BlockNumbers) -> BlockNumbers {
    let mut rows = [[HALF; BLOCK]; BLOCK];
    for (frequency, coefficients) in coefficients.as_chunks::<BLOCK>().0.iter().enumerate() {
        if coefficients.iter().any(|&c| c != 0) {
            for (y, row) in rows.iter_mut().enumerate() {
                add_product(row, coefficients, WAVES[frequency][y]);
            }
        }
    }
    let mut out = [HALF; BLOCK_LISTS];
    for (out, row) in out.as_chunks_mut::<BLOCK>().0.iter_mut().zip(&rows) {
        for (frequency, &coefficient) in row.iter().enumerate() {
            add_product(out, &WAVES[frequency], coefficient >> WAVE_BITS);
        }
    }
    out.map(|value| value >> WAVE_BITS)
}

#[inline(always)]
fn fill_in_any(values: &mut BlockPlane, mask: u64) {
    if mask == 0 || mask == u64::MAX {
        return;
    }
    let is_known: [bool; BLOCK_LISTS] = std::array::from_fn(|i| mask >> i & 1 == 1);
    let mut sums = [0.0; BLOCK];
    for (row, is_known) in values.as_chunks::<BLOCK>().0.iter().zip(is_known.as_chunks::<BLOCK>().0) {
        for ((sum, value), is_known) in sums.iter_mut().zip(row).zip(is_known) {
            *sum += if *is_known { *value } else { 0.0 };
        }
    }
    let mean = sums.iter().sum::<f32>() / mask.count_ones() as f32;
    for (value, is_known) in values.iter_mut().zip(is_known) {
        *value = if is_known { *value } else { mean };
    }
    let (rows, _) = values.as_chunks_mut::<BLOCK>();
    for _ in 0..SWEEPS {
        for y in 0..BLOCK {
            if mask >> (y * BLOCK) & 0xff == 0xff {
                continue;
            }
            let (above, row, below) = (rows[y.saturating_sub(1)], rows[y], rows[(y + 1).min(BLOCK - 1)]);
            let left: [f32; BLOCK] = std::array::from_fn(|x| row[x.saturating_sub(1)]);
            let right: [f32; BLOCK] = std::array::from_fn(|x| row[(x + 1).min(BLOCK - 1)]);
            for x in 0..BLOCK {
                let mean = 0.25 * ((above[x] + below[x]) + (left[x] + right[x]));
                rows[y][x] = if is_known[y * BLOCK + x] { row[x] } else { mean };
            }
        }
    }
}

#[inline(always)]
fn add_scaled(to: &mut [f32; BLOCK], what: &[f32; BLOCK], by: f32) {
    for (to, what) in to.iter_mut().zip(what) {
        *to += what * by;
    }
}

#[inline(always)]
fn add_product(to: &mut [i32; BLOCK], what: &[i32; BLOCK], by: i32) {
    for (to, what) in to.iter_mut().zip(what) {
        *to = to.wrapping_add(what.wrapping_mul(by));
    }
}

/// Places of coefficients in coding order: along the diagonals from the constant one.
pub(super) const ZIGZAG: [u8; BLOCK_LISTS] = {
    let mut order = [0; BLOCK_LISTS];
    let mut n = 0;
    let mut diagonal = 0;
    while diagonal < 2 * BLOCK - 1 {
        let mut i = 0;
        while i <= diagonal {
            let (x, y) = if diagonal % 2 == 0 { (i, diagonal - i) } else { (diagonal - i, i) };
            if x < BLOCK && y < BLOCK {
                order[n] = (y * BLOCK + x) as u8;
                n += 1;
            }
            i += 1;
        }
        diagonal += 1;
    }
    order
};

/// `BASIS[k][n]` is wave k at place n.
const BASIS: [[f32; BLOCK]; BLOCK] = {
    let mut basis = [[0.0; BLOCK]; BLOCK];
    let mut k = 0;
    while k < BLOCK {
        let mut n = 0;
        while n < BLOCK {
            basis[k][n] = if k == 0 { HALF_COSINES[4] } else { half_cosine((2 * n + 1) * k) };
            n += 1;
        }
        k += 1;
    }
    basis
};

/// [`BASIS`] in units of 2⁻¹².
pub(super) const WAVES: [[i32; BLOCK]; BLOCK] = {
    let mut waves = [[0; BLOCK]; BLOCK];
    let mut i = 0;
    while i < BLOCK_LISTS {
        let wave = BASIS[i / BLOCK][i % BLOCK] * (1 << WAVE_BITS) as f32;
        waves[i / BLOCK][i % BLOCK] = (wave + if wave < 0.0 { -0.5 } else { 0.5 }) as i32;
        i += 1;
    }
    waves
};
const WAVE_BITS: u32 = 12;
const HALF: i32 = 1 << (WAVE_BITS - 1);

const TRANSPOSED: [[f32; BLOCK]; BLOCK] = {
    let mut transposed = [[0.0; BLOCK]; BLOCK];
    let mut i = 0;
    while i < BLOCK_LISTS {
        transposed[i % BLOCK][i / BLOCK] = BASIS[i / BLOCK][i % BLOCK];
        i += 1;
    }
    transposed
};

/// ½·cos(jπ/16), by symmetry from the first quarter.
const fn half_cosine(j: usize) -> f32 {
    match j % 32 {
        j @ 0..=8 => HALF_COSINES[j],
        j @ 9..=16 => -HALF_COSINES[16 - j],
        j @ 17..=24 => -HALF_COSINES[j - 16],
        j => HALF_COSINES[32 - j],
    }
}

/// ½·cos(jπ/16) for j = 0 to 8. The fifth is also 1/√8.
const HALF_COSINES: [f32; 9] = [
    0.5,
    0.490_392_64,
    0.461_939_77,
    0.415_734_8,
    0.353_553_39,
    0.277_785_12,
    0.191_341_72,
    0.097_545_16,
    0.0,
];

/// Number of relaxations, enough for a value to reach across a block.
const SWEEPS: usize = 12;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::tests::with_each;

    fn noise() -> BlockPlane {
        std::array::from_fn(|i| ((i * 37 + 11) % 64) as f32 / 64.0 - (i % 7) as f32 / 10.0)
    }

    #[test]
    fn the_transform_is_orthonormal_and_inverts() {
        let values = noise();
        let coefficients = forward(&values);
        let energy = |p: &BlockPlane| p.iter().map(|v| v * v).sum::<f32>();
        // 64 terms, each rounded at 2⁻²⁴ some sixteen times.
        assert!((energy(&values) - energy(&coefficients)).abs() < 1e-4 * energy(&values));
        let numbers = |scale: f32| coefficients.map(|c| (c * scale).round() as i32);
        for (a, b) in values.iter().zip(inverse(&numbers(4096.0))) {
            // Waves are off by up to 2⁻¹³, coefficients and both passes by half a number.
            assert!((a - b as f32 / 4096.0).abs() < 1e-3, "{a} {b}");
        }
        assert!((coefficients[0] / 8.0 - values.iter().sum::<f32>() / 64.0).abs() < 1e-5);
        let mut other = coefficients;
        other[9] += 0.1;
        let other = inverse(&other.map(|c| (c * 4096.0).round() as i32));
        assert!(other.iter().zip(&values).any(|(a, b)| (*a as f32 / 4096.0 - b).abs() > 1e-2));
    }

    #[test]
    fn wider_instructions_invert_alike_and_any_number_has_a_result() {
        for scale in [1.0, 3000.0, 1e9] {
            let coefficients: BlockNumbers = noise().map(|c| (c * scale) as i32);
            let [portable, avx2, avx512] = with_each(|| inverse(&coefficients));
            assert_eq!([avx2, avx512], [portable; 2]);
        }
        assert_ne!(inverse(&[i32::MAX; BLOCK_LISTS]), [0; BLOCK_LISTS]);
    }

    #[test]
    fn waves_are_cosines() {
        for (k, row) in BASIS.iter().enumerate().skip(1) {
            for (n, v) in row.iter().enumerate() {
                let exact = 0.5 * (std::f64::consts::PI * (n as f64 + 0.5) * k as f64 / 8.0).cos();
                assert!((f64::from(*v) - exact).abs() < 1e-7, "{k} {n}");
            }
        }
    }

    #[test]
    fn the_order_visits_every_place_once_and_rises() {
        let mut seen = 0u64;
        let mut last = 0;
        for &i in &ZIGZAG {
            seen |= 1 << i;
            let diagonal = i % 8 + i / 8;
            assert!(diagonal >= last);
            last = diagonal;
        }
        assert_eq!(seen, u64::MAX);
    }

    #[test]
    fn filling_in_keeps_what_is_known_and_saves_coefficients() {
        // A ramp that is known on the left: its continuation needs less energy than zeros do.
        let ramp: BlockPlane = std::array::from_fn(|i| 1.0 + (i % BLOCK) as f32 * 0.1);
        let mask = 0x0f0f_0f0f_0f0f_0f0f;
        let mut filled = ramp;
        fill_in(&mut filled, mask);
        let with_zeros: BlockPlane = std::array::from_fn(|i| if mask >> i & 1 == 1 { ramp[i] } else { 0.0 });
        let high = |p: &BlockPlane| forward(p)[1..].iter().map(|c| c * c).sum::<f32>();
        assert!((0..BLOCK_LISTS).all(|i| mask >> i & 1 == 0 || filled[i] == ramp[i]));
        assert!(high(&filled) < 0.05 * high(&with_zeros));
    }
}
