//! Cuts at equal distances between the first and the last content (Brady 1997).
//!
//! March 1 finds where the content begins and ends, march 2 cuts it ([`super::cuts`]). Brady composites every segment of
//! a ray on its own, whatever is in front of it, so matter behind opaque matter is kept.

use isinglass_core::kernels::march::{Advance, Sink, Step};

use super::cuts::PlaneCuts;

/// March 1: where the content of a ray begins and ends.
#[derive(Clone, Copy, Debug)]
pub(super) struct Extent {
    s_first: f32,
    s_last: f32,
    transmittance: f32,
}

impl Default for Extent {
    fn default() -> Self {
        Self { s_first: f32::INFINITY, s_last: 0.0, transmittance: 1.0 }
    }
}

impl Extent {
    /// March 2: `k` segments from end to end. `None` if there is no content.
    pub(super) fn cuts(&self, k: usize) -> Option<PlaneCuts> {
        let length = (self.s_last - self.s_first) / k as f32;
        (length > 0.0).then(|| PlaneCuts::new(k, self.s_first, length, true))
    }
}

impl Sink for Extent {
    fn step(&mut self, step: Step) -> Advance {
        self.s_first = self.s_first.min(step.s0);
        self.s_last = step.s1;
        self.transmittance *= 1.0 - step.alpha;
        Advance::behind(self.transmittance)
    }
}
