//! Composites the crossed parts of segments.

use glam::Vec4;

use super::line::{ROUNDER, greater, lesser};
use super::media::{Medium, unpacked};

/// A batch of crossed parts of segments, in the order of the ray.
pub(super) struct Pieces {
    pub(super) num: usize,
    /// Optical depth.
    pub(super) tau: [f32; MAX_PIECES],
    pub(super) rest: [CrossedPiece; MAX_PIECES],
}

#[derive(Clone, Copy, Default)]
pub(super) struct CrossedPiece {
    /// Nearness of the list.
    pub(super) weight: f32,
    /// 1 for the first piece of a column, or else 0.
    pub(super) starts_column: f32,
    /// 1 for a piece behind another one of the same list, or else 0.
    pub(super) continues_list: f32,
    /// See [`super::Medium`].
    pub(super) e: [u16; 4],
}

/// The part of a ray in one list.
pub(super) struct Crossing {
    /// Least and greatest depth, in units.
    pub(super) lo: f32,
    pub(super) hi: f32,
    /// World length of the ray per unit of depth.
    pub(super) length_per_unit: f32,
    /// See [`CrossedPiece`].
    pub(super) weight: f32,
    pub(super) starts_column: f32,
    pub(super) continues_list: f32,
}

impl Pieces {
    pub(super) fn new() -> Self {
        Self { num: 0, tau: [0.0; MAX_PIECES], rest: [CrossedPiece::default(); MAX_PIECES] }
    }

    /// Takes the next piece of a crossing if it has a length and `is_of_list`. A full batch first goes to `sum`.
    #[inline(always)]
    pub(super) fn push(&mut self, sum: &mut Sum, crossing: &mut Crossing, medium: &Medium, is_of_list: bool) {
        if self.num == MAX_PIECES {
            sum.add(self);
        }
        let overlap = lesser(crossing.hi, medium.back()) - greater(crossing.lo, medium.front());
        let is_crossed = (overlap > 0.0) & is_of_list;
        let at = self.num % MAX_PIECES;
        self.tau[at] = medium.sigma * (overlap * crossing.length_per_unit);
        self.rest[at] = CrossedPiece {
            weight: crossing.weight,
            starts_column: crossing.starts_column,
            continues_list: crossing.continues_list,
            e: medium.e,
        };
        self.num += usize::from(is_crossed);
        crossing.starts_column = if is_crossed { 0.0 } else { crossing.starts_column };
        crossing.continues_list = if is_crossed { 1.0 } else { crossing.continues_list };
    }
}

/// What a ray has collected, up to some piece of a column.
pub(super) struct Sum {
    pub(super) color: Vec4,
    /// Sum in front of the column.
    before: f32,
    /// Opacity of the column, mixed over its lists.
    mixed: f32,
    /// Transmittance of the list.
    of_list: f32,
}

impl Default for Sum {
    fn default() -> Self {
        Self { color: Vec4::ZERO, before: 1.0, mixed: 0.0, of_list: 1.0 }
    }
}

impl Sum {
    /// Composites the pieces behind the sum and clears them. Factors of 0 and 1 replace branches, which a processor
    /// would mispredict.
    #[inline(always)]
    pub(super) fn add(&mut self, pieces: &mut Pieces) {
        let num = std::mem::take(&mut pieces.num);
        let padded = num.next_multiple_of(8).min(MAX_PIECES);
        for tau in &mut pieces.tau[..padded] {
            *tau = opacity(*tau);
        }
        for (piece, &alpha) in pieces.rest[..num].iter().zip(&pieces.tau) {
            self.before *= 1.0 - self.mixed * piece.starts_column;
            self.mixed *= 1.0 - piece.starts_column;
            self.of_list = (1.0 - piece.continues_list) + piece.continues_list * self.of_list;
            let share = self.of_list * alpha * piece.weight;
            self.of_list *= 1.0 - alpha;
            self.mixed += share;
            self.color += unpacked(piece.e) * (share * self.before);
        }
    }

    pub(super) fn transmittance(&self) -> f32 {
        self.before * (1.0 - self.mixed)
    }
}

/// Opacity 1 − e^−τ of optical depth τ to single precision, relative for small τ too, without a branch or a call: 2^−y
/// with y = n − f, |f| ≤ ½, is 2^−n·(1 + p(f)).
#[inline(always)]
pub fn opacity(tau: f32) -> f32 {
    let (scale, p) = scale_and_rest(tau);
    (1.0 - scale) - scale * p
}

/// Transmittance e^−τ, relative to itself to single precision; constant beyond τ of 126·ln 2.
#[inline(always)]
pub(crate) fn transmittance(tau: f32) -> f32 {
    let (scale, p) = scale_and_rest(tau);
    scale + scale * p
}

/// 2^−n and p(f) of [`opacity`].
#[inline(always)]
fn scale_and_rest(tau: f32) -> (f32, f32) {
    let y = lesser(tau * std::f32::consts::LOG2_E, 126.0);
    let shifted = y + ROUNDER;
    let f = (shifted - ROUNDER) - y;
    // Taylor's series of 2^f − 1, whose next term is below 2^−25 for |f| ≤ ½.
    let p = f
        * (LN_2_POWERS[0]
            + f * (LN_2_POWERS[1]
                + f * (LN_2_POWERS[2] + f * (LN_2_POWERS[3] + f * (LN_2_POWERS[4] + f * LN_2_POWERS[5])))));
    (f32::from_bits(ONE_BITS.wrapping_sub(shifted.to_bits() << 23)), p)
}

/// Pieces in a batch: more than a tile's columns usually have.
pub(super) const MAX_PIECES: usize = 64;
const ONE_BITS: u32 = 0x3f80_0000;
/// (ln 2)^i/i!.
const LN_2_POWERS: [f32; 6] =
    [std::f32::consts::LN_2, 0.240_226_5, 0.055_504_11, 0.009_618_129, 0.001_333_355_8, 0.000_154_035_3];
