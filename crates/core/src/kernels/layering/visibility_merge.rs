//! One march with at most K + 1 open segments; each step opens one, and when there are too many the neighbouring
//! pair that costs least is merged (ours). Twin of `shaders/layering/visibility_merge.wgsl`.

use super::{OpenSegment, SegmentList};
use crate::kernels::march::{Pace, Sink, Step};
use crate::layer::MAX_K;

/// The open segments of one ray.
#[derive(Clone, Copy, Debug)]
pub struct VisibilityMerge {
    k: usize,
    /// Length of a step, world units.
    h: f32,
    len: usize,
    open: [OpenSegment; MAX_K + 1],
    /// Cost of merging segment i with i + 1.
    cost: [f32; MAX_K + 1],
    /// Transmittance in front of segment i, at least [`VISIBILITY_FLOOR`].
    visibility: [f32; MAX_K + 1],
    transmittance: f32,
}

impl VisibilityMerge {
    /// At most `k` segments; `h` is the length of a step.
    pub fn new(k: usize, h: f32) -> Self {
        Self {
            k,
            h,
            len: 0,
            open: [OpenSegment::default(); MAX_K + 1],
            cost: [f32::INFINITY; MAX_K + 1],
            visibility: [0.0; MAX_K + 1],
            transmittance: 1.0,
        }
    }

    /// Cost of merging segment `i` with its neighbour behind.
    fn pair_cost(&self, i: usize) -> f32 {
        merge_cost(&self.open[i], &self.open[i + 1], self.h) * self.visibility[i]
    }

    /// Merges segment `i` with its neighbour behind and closes the ranks.
    fn merge(&mut self, i: usize) {
        self.open[i] = merged(&self.open[i], &self.open[i + 1]);
        for j in i + 1..self.len - 1 {
            self.open[j] = self.open[j + 1];
            self.cost[j] = self.cost[j + 1];
            self.visibility[j] = self.visibility[j + 1];
        }
        self.len -= 1;
        if i + 1 < self.len {
            self.cost[i] = self.pair_cost(i);
        }
        if i > 0 {
            self.cost[i - 1] = self.pair_cost(i - 1);
        }
    }

    /// The list.
    pub fn finish(self) -> SegmentList {
        let mut list = SegmentList::default();
        for s in &self.open[..self.len] {
            list.push(*s);
        }
        list
    }
}

impl Sink for VisibilityMerge {
    fn step(&mut self, step: Step) -> Pace {
        let n = self.len;
        self.open[n] = step;
        self.visibility[n] = self.transmittance.max(VISIBILITY_FLOOR);
        self.transmittance *= 1.0 - step.alpha;
        self.len = n + 1;
        if n > 0 {
            self.cost[n - 1] = self.pair_cost(n - 1);
        }
        if self.len > self.k {
            let mut least = 0;
            for i in 1..self.len - 1 {
                if self.cost[i] < self.cost[least] {
                    least = i;
                }
            }
            self.merge(least);
        }
        Pace::behind(self.transmittance)
    }
}

/// The homogeneous segment with the composite of `a` over `b`, from the front of `a` to the back of `b`.
fn merged(a: &OpenSegment, b: &OpenSegment) -> OpenSegment {
    OpenSegment {
        s0: a.s0,
        s1: b.s1,
        c: a.c + b.c * (1.0 - a.alpha),
        tau: a.tau + b.tau,
        alpha: a.alpha + b.alpha * (1.0 - a.alpha),
    }
}

/// The image error, seen from nearby views, of reading `a`, the gap and `b` as one homogeneous piece.
///
/// Two things go wrong. Optical depth moves: from where it was to where an even spread puts it; what moves is half of
/// the total variation between the two densities, and shows as its opacity (here τ/(1 + τ), which saturates like it
/// and needs no exponential). And the colours of the two pieces mix, which shows where both are opaque enough to be
/// told apart. Seen at an angle, both errors are displaced by at most the length of the piece, so they grow with it.
fn merge_cost(a: &OpenSegment, b: &OpenSegment, h: f32) -> f32 {
    let length = b.s1 - a.s0;
    let per_length = (a.tau + b.tau) / length;
    let gap = (b.s0 - a.s1).max(0.0);
    let moved = 0.5
        * ((a.tau - per_length * (a.s1 - a.s0)).abs()
            + (b.tau - per_length * (b.s1 - b.s0)).abs()
            + per_length * gap);
    // |Ea − Eb|·αa·αb with E = C/α.
    let mixed = (a.c * b.alpha - b.c * a.alpha).abs().max_element();
    (MOVED_WEIGHT * moved / (1.0 + moved) + mixed) * (length / h)
}

/// Least visibility that matter hidden behind opaque matter is counted with: a turned camera will see it. Between
/// 0.1 and 0.3 the geometric mean of DSSIM over seven scenes changed by 1 % at 10° and 3 % at 30°.
const VISIBILITY_FLOOR: f32 = 0.2;
/// Weight of moved opacity against mixed colour: between 1 and 2 likewise flat.
const MOVED_WEIGHT: f32 = 2.0;
