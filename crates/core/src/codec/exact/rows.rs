//! The two rows of lists that predictions use: the coded one and the one above it.
//!
//! Segments of both rows share one array. Two empty segments follow each list, so a walk along a list ends there
//! without another test. The first two entries of the array are empty, too, and stand for an empty list. So neither
//! walks nor choices between neighbours need branches.

use super::quantize::Code;
use super::scale::{LEAST_LOG_EXTINCTION, Scale};

/// Quantised matter of a segment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(align(16))]
pub(super) struct SegmentCodes {
    pub(super) c: [u16; 3],
    pub(super) tau: u8,
    /// log₂ of the extinction: that of τ minus that of the thickness.
    pub(super) log_extinction: i16,
    /// 1/√α ([`Scale::inverse_sqrt_alpha`]).
    pub(super) inverse_sqrt_alpha: u32,
}

/// Place of a segment, and the like segments that predict it.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Neighbors {
    pub(super) slot: u32,
    pub(super) like: [u32; 2],
    pub(super) thickness: u16,
    /// 0 for two like neighbours, 9 for one that counts twice, 10 for the previous segment twice, 11 for none.
    pub(super) kind: u8,
    pub(super) is_first: bool,
}

/// What the green channel of a segment says about red and blue.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct ColorRatio {
    /// Its brightness over that of each like segment, in 2⁻¹⁶.
    pub(super) times: [u32; 2],
    /// Green over its prediction, in 2⁻¹².
    pub(super) turned_out: u32,
    /// The coded number of green.
    pub(super) coded: u16,
    /// 0 with two like neighbours, otherwise 8.
    pub(super) alone: u16,
}

/// Two rows of lists.
pub(super) struct ListRows {
    /// Front in the low, back in the high 16 bits; [`NOTHING`] for none.
    pub(super) depths: Vec<u32>,
    pub(super) matters: Vec<SegmentCodes>,
    /// Neighbours of the segments in the coded row, in order.
    pub(super) links: Vec<Neighbors>,
    /// Colour ratios of the same segments.
    pub(super) tints: Vec<ColorRatio>,
    /// Index of the first segment of each list in the row above and in the coded row; 0 for an empty list.
    pub(super) above: Vec<u32>,
    pub(super) own: Vec<u32>,
    /// Number of entries for a row.
    capacity: usize,
    /// Index of the first entry of the coded row.
    first: usize,
}

impl ListRows {
    /// Makes rows for lists with these lengths, `width` in a row. It starts above the first row.
    pub(super) fn new(scale: &Scale, counts: &[u8], width: usize) -> Self {
        let of_list = |&count: &u8| if count > 0 { usize::from(count) + SPACE } else { 0 };
        let of_row = |row: &[u8]| row.iter().map(of_list).sum();
        let capacity = counts.chunks_exact(width).map(of_row).max().unwrap_or(0);
        let nothing = SegmentCodes {
            c: [0; 3],
            tau: 0,
            log_extinction: LEAST_LOG_EXTINCTION,
            inverse_sqrt_alpha: scale.inverse_sqrt_alpha(0),
        };
        Self {
            depths: vec![NOTHING; SPACE + 2 * capacity],
            matters: vec![nothing; SPACE + 2 * capacity],
            links: vec![],
            tints: vec![],
            above: vec![0; width],
            own: vec![0; width],
            capacity,
            first: SPACE + capacity,
        }
    }

    /// Moves on to the next row, with lists of these lengths.
    pub(super) fn advance(&mut self, counts: &[u8]) {
        std::mem::swap(&mut self.above, &mut self.own);
        self.first = 2 * SPACE + self.capacity - self.first;
        let mut next = self.first;
        let mut num_segments = 0;
        for (start, &count) in self.own.iter_mut().zip(counts) {
            let count = usize::from(count);
            *start = if count > 0 { next as u32 } else { 0 };
            num_segments += count;
            if count > 0 {
                next += count + SPACE;
                self.depths[next - SPACE..next].fill(NOTHING);
            }
        }
        self.links.resize(num_segments, Neighbors::default());
        self.tints.resize(num_segments, ColorRatio::default());
    }

    /// Puts the segments of all lists into the row.
    pub(super) fn fill(&mut self, counts: &[u8], mut codes: &[Code]) {
        for (&start, &count) in self.own.iter().zip(counts) {
            let (list, rest) = codes.split_at(count.into());
            codes = rest;
            let slots = start as usize..start as usize + list.len();
            let (depths, matters) = (&mut self.depths[slots.clone()], &mut self.matters[slots]);
            for ((code, depth), matter) in list.iter().zip(depths).zip(matters) {
                *depth = u32::from(code.front) | u32::from(code.back) << 16;
                (matter.c, matter.tau) = (code.c, code.tau);
            }
        }
    }
}

/// Depths of an empty segment: farther than any.
pub(super) const NOTHING: u32 = u32::MAX;
/// Number of empty segments behind each list.
const SPACE: usize = 2;
