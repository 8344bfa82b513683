//! The two rows of lists that predictions use: the one that is coded and the one above it.
//!
//! Segments of both rows have numbers in one space. Behind each list are two segments of nothing, and so are
//! the first two of the space, which stand for an empty list: a walk along a list needs no other end, and neither walks
//! nor choices between neighbours need branches.

use super::quantize::Code;
use super::scale::{LEAST_LOG_EXTINCTION, Scale};

/// What a segment holds, quantised.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(align(16))]
pub(super) struct SegmentCodes {
    pub(super) c: [u16; 3],
    pub(super) tau: u8,
    /// log₂ of the extinction, which follows from τ and the depths: that of τ less that of the thickness.
    pub(super) log_extinction: i16,
    /// 1/√α ([`Scale::inverse_sqrt_alpha`]), which follows from τ.
    pub(super) inverse_sqrt_alpha: u32,
}

/// Where a segment is, and the segments that it is expected to be like.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Neighbors {
    pub(super) slot: u32,
    pub(super) like: [u32; 2],
    pub(super) thickness: u16,
    /// 0 if two neighbours are like it, else 9 for one twice, 10 for the one before it twice, 11 for none.
    pub(super) kind: u8,
    pub(super) is_first: bool,
}

/// What a segment's green tells of red and blue.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct ColorRatio {
    /// How many times brighter it is than the two that it is expected to be like, in 2⁻¹⁶.
    pub(super) times: [u32; 2],
    /// Green as it is by green as it was expected, in 2⁻¹².
    pub(super) turned_out: u32,
    /// The number that green was coded as.
    pub(super) coded: u16,
    /// 8 if there are not two neighbours, else 0.
    pub(super) alone: u16,
}

/// Two rows of lists.
pub(super) struct ListRows {
    /// Front in the low, back in the high 16 bits; [`NOTHING`] for none.
    pub(super) depths: Vec<u32>,
    pub(super) matters: Vec<SegmentCodes>,
    /// Those of the row that is coded, in order.
    pub(super) links: Vec<Neighbors>,
    /// The same.
    pub(super) tints: Vec<ColorRatio>,
    /// Number of the first segment of each list, above and of the row that is coded; 0 for an empty list.
    pub(super) above: Vec<u32>,
    pub(super) own: Vec<u32>,
    /// Numbers of a row.
    capacity: usize,
    /// First number of the row that is coded.
    first: usize,
}

impl ListRows {
    /// For rows of such lists, `width` to a row, beginning above the first one.
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

    /// Goes on to the next row, with lists of such lengths.
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

    /// Puts segments, one list after the other, in the row.
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

/// Depths of no segment: farther than any.
pub(super) const NOTHING: u32 = u32::MAX;
/// Segments of nothing behind each list.
const SPACE: usize = 2;
