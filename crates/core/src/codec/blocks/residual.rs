//! Codes a plane of 8×8 values as its prediction and the quantised coefficients of the difference.

use super::entropy::Coder;
use super::model::BLOCK_LISTS;
use super::scales::whole;
use super::syntax::{Contexts, Levels};
use super::transform::{BlockNumbers, BlockPlane, ZIGZAG, fill_in, forward, inverse};

/// The prediction of a plane.
#[derive(Clone, Copy, Debug)]
pub(super) enum Expected<'a> {
    Constant(i32),
    Plane(&'a BlockNumbers),
}

impl Expected<'_> {
    fn values(&self) -> BlockNumbers {
        match self {
            Self::Constant(value) => [*value; BLOCK_LISTS],
            Self::Plane(plane) => **plane,
        }
    }
}

/// Codes the difference of a plane from its prediction, and writes the decoded values. Returns the class, and the
/// difference of the mean. Numbers are whole, a quarter of a code of u and 1/32768 of Y, Co and Cg.
#[expect(clippy::too_many_arguments, reason = "two directions in one function")]
pub(super) fn residual<C: Coder>(
    coder: &mut C,
    contexts: &Contexts,
    component: usize,
    near: [u8; 2],
    step: i32,
    mask: u64,
    source: Option<&BlockPlane>,
    expected: &Expected<'_>,
    values: &mut BlockNumbers,
) -> (u8, i32) {
    let mut levels = Levels::ZERO;
    if let (true, Some(source)) = (C::ENCODES, source) {
        let expected = expected.values();
        let mut difference: BlockPlane = std::array::from_fn(|i| source[i] - expected[i] as f32);
        fill_in(&mut difference, mask);
        let coefficients = forward(&difference);
        let rounding =
            if component < FIRST_INTER || component == CORRECTION { ROUNDING } else { INTER_ROUNDING };
        quantize(&coefficients, step as f32, rounding, &mut levels);
    }
    let class = contexts.coefficients(coder, component, near, &mut levels);
    let mut coefficients = [0; BLOCK_LISTS];
    for (k, &level) in levels.values[..levels.length].iter().enumerate() {
        if level != 0 {
            let towards_zero = if k > 0 { step.wrapping_mul(TOWARDS_ZERO) >> 8 } else { 0 };
            let size = level.wrapping_abs().wrapping_mul(step).wrapping_sub(towards_zero);
            coefficients[usize::from(ZIGZAG[k])] = if level < 0 { size.wrapping_neg() } else { size };
        }
    }
    let mean = coefficients[0].wrapping_add(4) >> 3;
    *values = expected.values();
    if levels.length == 1 {
        values.iter_mut().for_each(|v| *v = v.wrapping_add(mean));
    } else if levels.length > 1 {
        for (value, difference) in values.iter_mut().zip(inverse(&coefficients)) {
            *value = value.wrapping_add(difference);
        }
    }
    (class, mean)
}

wide! {
    /// Colours as stored numbers, of which four times a range is given: a quarter, rounded.
    pub(super) fn stored_of(values: &BlockNumbers, range: [i32; 2], stored: &mut [i16; BLOCK_LISTS])
        = stored_of_any;
}

wide! {
    /// Levels of coefficients.
    fn quantize(coefficients: &BlockPlane, step: f32, rounding: [f32; 2], levels: &mut Levels) = quantize_any;
}

#[inline(always)]
fn stored_of_any(values: &BlockNumbers, [least, most]: [i32; 2], stored: &mut [i16; BLOCK_LISTS]) {
    for (stored, value) in stored.iter_mut().zip(values) {
        *stored = ((*value.max(&least).min(&most) + 2) >> 2) as i16;
    }
}

#[inline(always)]
fn quantize_any(coefficients: &BlockPlane, step: f32, rounding: [f32; 2], levels: &mut Levels) {
    let size = |c: f32, rounding: f32| {
        let size = c.abs() / step + rounding;
        whole(if size < MAX_SIZE { size } else { MAX_SIZE }) as i32
    };
    let mut all = [0; BLOCK_LISTS];
    let mut any = 0;
    for (level, &c) in all.iter_mut().zip(coefficients) {
        let size = size(c, rounding[1]);
        *level = if c < 0.0 { -size } else { size };
        any |= size;
    }
    let first = size(coefficients[0], rounding[0]);
    all[0] = if coefficients[0] < 0.0 { -first } else { first };
    levels.length = 0;
    if any | first == 0 {
        return;
    }
    for (level, &place) in levels.values.iter_mut().zip(&ZIGZAG) {
        *level = all[usize::from(place) % BLOCK_LISTS];
    }
    let mut length = 0;
    for (k, &level) in levels.values.iter().enumerate() {
        let end = if level != 0 { k as u32 + 1 } else { 0 };
        length = length.max(end);
    }
    levels.length = length as usize;
}

/// Greater than any coefficient in steps.
const MAX_SIZE: f32 = (1 << 20) as f32;
/// Added to the constant and to other coefficients before rounding down. Larger dead zones cost more of the picture
/// than they save.
const ROUNDING: [f32; 2] = [0.5, 0.45];
/// A moved reference has errors of about half a step, so larger dead zones save more than they cost. Along orbits, .4
/// and .3 take 1 % more bytes for the same picture; .3 and .2 take as many.
const INTER_ROUNDING: [f32; 2] = [0.35, 0.25];
/// Components from here on are predicted from a reference, except the last.
const FIRST_INTER: usize = 4;
const CORRECTION: usize = 7;
/// Distance by which a coefficient is closer to zero than its level on average: .05, in 256ths of a step.
const TOWARDS_ZERO: i32 = 13;
