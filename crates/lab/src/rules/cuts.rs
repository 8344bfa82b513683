//! Segments between planes at equal distances along a ray: what `equal-length` and `slabs` share.
//!
//! All matter between two planes is one segment; without matter there is none. A step that a plane falls into is split
//! as a homogeneous medium.

use isinglass_core::kernels::march::{Advance, Sink, Step, TAU_MIN};

use super::{OpenSegment, SegmentList, append, split};

/// Cuts the content of one ray.
#[derive(Clone, Copy, Debug)]
pub(super) struct PlaneCuts {
    k: usize,
    /// World distance of plane 0.
    first: f32,
    /// World distance from one plane to the next.
    length: f32,
    /// Whether a segment spans all of its interval; else it spans its content.
    spans_all: bool,
    /// The open segment lies between the planes `i` and `i` + 1.
    i: usize,
    open: OpenSegment,
    transmittance: f32,
    list: SegmentList,
}

impl PlaneCuts {
    /// `k` intervals of the given length from the distance `first` on; the last takes whatever is behind it too.
    pub(super) fn new(k: usize, first: f32, length: f32, spans_all: bool) -> Self {
        let (open, list) = (OpenSegment::default(), SegmentList::default());
        Self { k, first, length, spans_all, i: 0, open, transmittance: 1.0, list }
    }

    /// World distance of plane `i`.
    fn plane(&self, i: usize) -> f32 {
        self.first + self.length * i as f32
    }

    /// Adds a piece to the open segment.
    fn extend(&mut self, piece: &Step) {
        if piece.tau > 0.0 {
            if self.open.tau == 0.0 {
                self.open.s0 = piece.s0;
            }
            append(&mut self.open, piece);
        }
    }

    /// Ends the open segment.
    fn close(&mut self) {
        if self.open.tau > TAU_MIN {
            if self.spans_all {
                (self.open.s0, self.open.s1) = (self.plane(self.i), self.plane(self.i + 1));
            }
            self.list.push(self.open);
        }
        self.open = OpenSegment::default();
        self.i += 1;
    }

    /// The list.
    pub(super) fn finish(mut self) -> SegmentList {
        self.close();
        self.list
    }
}

impl Sink for PlaneCuts {
    fn step(&mut self, step: Step) -> Advance {
        let mut rest = step;
        while self.i + 1 < self.k && rest.s1 > self.plane(self.i + 1) {
            let part = (self.plane(self.i + 1) - rest.s0) / (rest.s1 - rest.s0);
            let near;
            (near, rest) = split(&rest, part.clamp(0.0, 1.0));
            self.extend(&near);
            self.close();
        }
        self.extend(&rest);
        self.transmittance *= 1.0 - step.alpha;
        Advance::behind(self.transmittance)
    }
}
