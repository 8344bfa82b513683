//! Segments of like colour (Frey 2013; Gupta 2022, section 3): a segment ends where the next sample differs from it by
//! more than a threshold, and where matter ends.
//!
//! What is compared is the premultiplied colour of the segment over the length of the sample, and that of the sample, by
//! their Euclidean distance. The threshold is found ray by ray, by bisection, so that the number of segments is at most
//! K and at least 85 % of K, with one march for every threshold that is tried and one more that writes, as published.
//! Nothing ends at opaque matter.
//!
//! Gaps are not stored. Only on a ray with more than K pieces of matter some gaps must be: there a gap is compared
//! like a sample, transparent ones being black, and ends a segment only if it differs. Whatever threshold is found, the
//! K-th segment takes what is left.

use isinglass_core::kernels::march::{Advance, Sink, Step};
use isinglass_core::kernels::raycast::opacity;

use super::{OpenSegment, SegmentList, append};

/// What is done with one ray: counted with a threshold, or written.
#[derive(Clone, Copy, Debug)]
pub(super) struct Homogeneity {
    k: usize,
    /// Length of a step, world units.
    h: f32,
    threshold: f32,
    /// Whether a gap need not end a segment.
    bridges_gaps: bool,
    /// Whether the segments are kept: at most K of them, the last with what is left.
    writes: bool,
    open: OpenSegment,
    /// Segments so far, the open one among them.
    count: usize,
    /// Pieces of matter without a gap so far.
    pieces: usize,
    transmittance: f32,
    list: SegmentList,
}

impl Homogeneity {
    fn new(k: usize, h: f32, threshold: f32, bridges_gaps: bool, writes: bool) -> Self {
        let (open, list) = (OpenSegment::default(), SegmentList::default());
        Self { k, h, threshold, bridges_gaps, writes, open, count: 0, pieces: 0, transmittance: 1.0, list }
    }

    /// Whether the open segment ends in front of the sample.
    fn ends(&self, step: &Step, has_gap: bool) -> bool {
        if self.writes && self.count == self.k {
            return false;
        }
        if has_gap {
            let transparent = Step { s1: self.h, ..Step::default() };
            if !self.bridges_gaps || difference(&self.open, self.open.s1, &transparent) >= self.threshold {
                return true;
            }
        }
        difference(&self.open, step.s0, step) >= self.threshold
    }

    fn close(&mut self) {
        if self.writes && self.count > 0 {
            self.list.push(self.open);
        }
    }
}

impl Sink for Homogeneity {
    fn step(&mut self, step: Step) -> Advance {
        // Half a step: lattice points are equal up to rounding.
        let has_gap = step.s0 > self.open.s1 + 0.5 * self.h;
        if self.count == 0 || has_gap {
            self.pieces += 1;
        }
        if self.count == 0 || self.ends(&step, has_gap) {
            self.close();
            self.open = step;
            self.count += 1;
        } else {
            append(&mut self.open, &step);
        }
        self.transmittance *= 1.0 - step.alpha;
        Advance::behind(self.transmittance)
    }
}

/// Distance between the premultiplied colours of the segment up to `s_end`, over the length of the sample, and of the
/// sample.
fn difference(open: &OpenSegment, s_end: f32, step: &Step) -> f32 {
    let part = (step.s1 - step.s0) / (s_end - open.s0);
    (open.c * (opacity(open.tau * part) / open.alpha) - step.c).length()
}

/// The list of one ray with at most `k` segments and steps of length `h`; `march` marches it once.
pub(super) fn list(k: usize, h: f32, mut march: impl FnMut(&mut Homogeneity)) -> SegmentList {
    let mut threshold = THRESHOLD_FIRST;
    let (mut low, mut high) = (0.0, THRESHOLD_GREATEST);
    let mut bridges_gaps = false;
    let mut least = 0;
    for _ in 0..MAX_TRIES {
        let mut pass = Homogeneity::new(k, h, threshold, bridges_gaps, false);
        march(&mut pass);
        if pass.count > k {
            low = threshold;
        } else if pass.count < least {
            high = threshold;
        } else {
            break;
        }
        // Known from the first march on.
        bridges_gaps = pass.pieces > k || bridges_gaps;
        least = k - k * ACCEPTED_BELOW_PERCENT / 100;
        if high - low < BRACKET_LEAST {
            threshold = high;
            break;
        }
        threshold = 0.5 * (low + high);
    }
    let mut pass = Homogeneity::new(k, h, threshold, bridges_gaps, true);
    march(&mut pass);
    pass.close();
    pass.list
}

/// Tried first; a ray that has at most K segments with it is accepted at once.
const THRESHOLD_FIRST: f32 = 1e-4;
/// Greatest distance of two colours, √3.
const THRESHOLD_GREATEST: f32 = 1.732_050_8;
/// A bracket of thresholds below this is not halved again; its upper end counts.
const BRACKET_LEAST: f32 = 1e-6;
/// A count is accepted down to so many percent below K.
const ACCEPTED_BELOW_PERCENT: usize = 15;
/// The first and the 21 halvings from √3 to the least bracket, and two for rounding.
const MAX_TRIES: usize = 24;
