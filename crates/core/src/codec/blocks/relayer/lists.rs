//! The lists of a block as curves: what a ray along a list has collected up to a depth.

use super::super::model::{BLOCK, BLOCK_LISTS};
use super::{Column, columns, select};
use crate::kernels::raycast::opacity;
use crate::layer::{LayeredFrame, MAX_K, Over};

/// The segments of a block's lists, front to back; reused from block to block.
#[derive(Clone, Debug)]
pub struct BlockLists {
    /// The pieces of list `i` are `starts[i]..starts[i + 1]`.
    starts: [u32; BLOCK_LISTS + 1],
    pieces: Vec<Piece>,
    /// How much more an error in a list is seen the darker the list is; 1 for a bright one.
    pub(super) slope: Column,
}

/// A segment and what is in front of it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Piece {
    pub(super) front: f32,
    pub(super) back: f32,
    pub(super) tau: f32,
    pub(super) alpha: f32,
    pub(super) c: [f32; 3],
    /// Optical depth in front of it.
    pub(super) tau_before: f32,
    /// Colour and transmittance in front of it.
    pub(super) before: [f32; 4],
}

impl Default for BlockLists {
    fn default() -> Self {
        Self { starts: [0; BLOCK_LISTS + 1], pieces: vec![], slope: [1.0; BLOCK_LISTS] }
    }
}

impl BlockLists {
    /// Reads the lists of a valid frame ([`LayeredFrame::validate`]) from (`x`·[`BLOCK`], `y`·[`BLOCK`]) on; those
    /// outside of the frame are empty.
    pub fn read(&mut self, frame: &LayeredFrame, x: u32, y: u32) {
        let intrinsics = frame.header.camera.intrinsics;
        let (width, height) = (intrinsics.width as usize, intrinsics.height as usize);
        self.pieces.clear();
        for i in 0..BLOCK_LISTS {
            let (x, y) = (x as usize * BLOCK + i % BLOCK, y as usize * BLOCK + i / BLOCK);
            let mut over = Over::default();
            let mut tau_before = 0.0;
            if x < width && y < height {
                for index in frame.list(y * width + x) {
                    let segment = frame.segment(index);
                    let tau = segment.tau.max(TAU_MIN);
                    let alpha = opacity(tau);
                    self.pieces.push(Piece {
                        front: f32::from(segment.front),
                        back: f32::from(segment.back),
                        tau,
                        alpha,
                        c: segment.c.to_array(),
                        tau_before,
                        before: [over.c.x, over.c.y, over.c.z, over.transmittance],
                    });
                    over.c += segment.c * over.transmittance;
                    over.transmittance *= 1.0 - alpha;
                    tau_before += tau;
                }
            }
            self.starts[i + 1] = self.pieces.len() as u32;
            // The picture shows about the root of the colour, so an error in a dark list counts for more.
            self.slope[i] = (0.5 / over.c.max_element().max(0.01).sqrt()).sqrt();
        }
    }

    /// Whether no list has a segment.
    pub fn is_empty(&self) -> bool {
        self.pieces.is_empty()
    }

    /// The segments of list `i`.
    pub(super) fn list(&self, i: usize) -> &[Piece] {
        &self.pieces[self.starts[i] as usize..self.starts[i + 1] as usize]
    }
}

/// What all lists have collected up to a depth of each.
#[derive(Clone, Copy, Debug)]
pub(super) struct Collected {
    /// Optical depth.
    pub(super) tau: Column,
    /// Transmittance.
    pub(super) kappa: Column,
    /// Colour, seen from the front.
    pub(super) c: [Column; 3],
    /// Where matter begins, at this depth or behind it; infinite behind all matter.
    pub(super) next: Column,
    /// Where matter ends, at this depth or before it; −infinite in front of all matter.
    pub(super) last: Column,
}

impl Collected {
    pub(super) const NOTHING: Self = Self {
        tau: [0.0; BLOCK_LISTS],
        kappa: [1.0; BLOCK_LISTS],
        c: [[0.0; BLOCK_LISTS]; 3],
        next: [f32::INFINITY; BLOCK_LISTS],
        last: [f32::NEG_INFINITY; BLOCK_LISTS],
    };
}

/// Walks through all lists at once, front to back.
#[derive(Clone, Debug)]
pub(super) struct Walk {
    /// Index in its list of the piece that the walk is in or in front of.
    index: [u8; BLOCK_LISTS],
    front: Column,
    back: Column,
    /// Optical depth of a depth unit of the piece.
    rate: Column,
    /// Source colour of the piece.
    e: [Column; 3],
    tau_before: Column,
    before: [Column; 4],
    /// Where the piece before ends.
    last: Column,
}

impl Walk {
    pub(super) const START: Self = Self {
        index: [0; BLOCK_LISTS],
        front: [f32::INFINITY; BLOCK_LISTS],
        back: [f32::INFINITY; BLOCK_LISTS],
        rate: [0.0; BLOCK_LISTS],
        e: [[0.0; BLOCK_LISTS]; 3],
        tau_before: [0.0; BLOCK_LISTS],
        before: [[0.0; BLOCK_LISTS]; 4],
        last: [f32::NEG_INFINITY; BLOCK_LISTS],
    };

    /// To the front of the lists.
    #[inline(always)]
    pub(super) fn restart(&mut self, lists: &BlockLists) {
        for i in 0..BLOCK_LISTS {
            self.index[i] = 0;
            self.last[i] = f32::NEG_INFINITY;
            self.enter(lists, i);
        }
    }

    /// The piece `index[i]` of list `i`, or what is behind the last one.
    #[inline(always)]
    fn enter(&mut self, lists: &BlockLists, i: usize) {
        let list = lists.list(i);
        if let Some(piece) = list.get(usize::from(self.index[i])) {
            self.front[i] = piece.front;
            self.back[i] = piece.back;
            self.rate[i] = piece.tau / (piece.back - piece.front);
            let e_from_c = 1.0 / piece.alpha;
            for (e, c) in self.e.iter_mut().zip(piece.c) {
                e[i] = c * e_from_c;
            }
            self.tau_before[i] = piece.tau_before;
            for (before, from) in self.before.iter_mut().zip(piece.before) {
                before[i] = from;
            }
            return;
        }
        self.front[i] = f32::INFINITY;
        self.back[i] = f32::INFINITY;
        self.rate[i] = 0.0;
        self.tau_before[i] = 0.0;
        for (before, nothing) in self.before.iter_mut().zip([0.0, 0.0, 0.0, 1.0]) {
            before[i] = nothing;
        }
        if let Some(piece) = list.last() {
            self.tau_before[i] = piece.tau_before + piece.tau;
            for (before, (from, c)) in self.before.iter_mut().zip(piece.before.into_iter().zip(piece.c)) {
                before[i] = from + c * piece.before[3];
            }
            self.before[3][i] = piece.before[3] * (1.0 - piece.alpha);
        }
    }

    /// Goes on to `depth`, which must not lie before the depth of the call before.
    #[inline(always)]
    pub(super) fn go_to(&mut self, lists: &BlockLists, depth: &Column, out: &mut Collected) {
        loop {
            let mut is_behind = 0u64;
            for (i, depth) in depth.iter().enumerate() {
                is_behind |= u64::from(self.back[i] <= *depth) << i;
            }
            if is_behind == 0 {
                break;
            }
            while is_behind != 0 {
                let i = is_behind.trailing_zeros() as usize;
                is_behind &= is_behind - 1;
                self.last[i] = self.back[i];
                self.index[i] += 1;
                self.enter(lists, i);
            }
        }
        columns(|i| {
            let front = self.front[i];
            let at = select(depth[i] > front, depth[i], front);
            // Nothing is left of infinity less infinity.
            let x = select(at > front, (at - front) * self.rate[i], 0.0);
            let alpha = opacity(x);
            let before = self.before[3][i];
            out.tau[i] = self.tau_before[i] + x;
            out.kappa[i] = before * (1.0 - alpha);
            for channel in 0..3 {
                out.c[channel][i] = self.before[channel][i] + before * self.e[channel][i] * alpha;
            }
            out.next[i] = at;
            out.last[i] = select(at > front, at, self.last[i]);
        });
    }
}
const _: () = assert!(MAX_K <= u8::MAX as usize, "a walk counts pieces in a byte");
/// Least optical depth of a segment: the source colour C/α of a thinner one would not be a number to rely on.
const TAU_MIN: f32 = 1e-4;
