//! Cuts at equal shares of the accumulated opacity (Lochmann 2016, section 3.1).
//!
//! March 1 finds the opacity of the whole ray; march 2 cuts where (1 − κ(s))/(1 − κ(∞)) reaches i/k, so the k
//! segments run without a gap from the first to the last content and each adds an equal share. A
//! step that a cut falls into is split as a homogeneous medium. As published, nothing is kept behind opaque matter.

use isinglass_core::kernels::march::{Advance, Sink, Step, TRANSMITTANCE_MIN};

use super::{OpenSegment, SegmentList, append, split};

/// March 1: transmittance of the whole ray and the end of its content.
#[derive(Clone, Copy, Debug)]
pub(super) struct Profile {
    transmittance: f32,
    s_last: f32,
}

impl Default for Profile {
    fn default() -> Self {
        Self { transmittance: 1.0, s_last: 0.0 }
    }
}

impl Sink for Profile {
    fn step(&mut self, step: Step) -> Advance {
        self.transmittance *= 1.0 - step.alpha;
        self.s_last = step.s1;
        if self.transmittance > TRANSMITTANCE_MIN {
            Advance::behind(self.transmittance)
        } else {
            Advance::Stop
        }
    }
}

/// March 2: cuts the content.
#[derive(Clone, Copy, Debug)]
pub(super) struct TransmittanceCuts {
    k: usize,
    profile: Profile,
    /// Optical depth from the start of the content to the next cut.
    tau_cut: f32,
    tau_total: f32,
    open: Option<OpenSegment>,
    list: SegmentList,
}

impl TransmittanceCuts {
    /// At most `k` segments for a ray with the given profile.
    pub(super) fn new(k: usize, profile: Profile) -> Self {
        let mut cuts =
            Self { k, profile, tau_cut: 0.0, tau_total: 0.0, open: None, list: SegmentList::default() };
        cuts.tau_cut = cuts.depth_of_cut(1);
        cuts
    }

    /// Optical depth at which the share `i`/k is reached; infinite for the last.
    fn depth_of_cut(&self, i: usize) -> f32 {
        if i >= self.k {
            return f32::INFINITY;
        }
        let share = i as f32 / self.k as f32;
        -(1.0 - share * (1.0 - self.profile.transmittance)).ln()
    }

    /// Adds a piece to the open segment; opens one at its front if there is none.
    fn extend(&mut self, piece: &Step) {
        let open = self.open.get_or_insert(OpenSegment { s0: piece.s0, ..OpenSegment::default() });
        append(open, piece);
    }

    /// The list.
    pub(super) fn finish(mut self) -> SegmentList {
        if let Some(open) = self.open.take().filter(|o| o.tau > 0.0) {
            self.list.push(open);
        }
        self.list
    }
}

impl Sink for TransmittanceCuts {
    fn step(&mut self, step: Step) -> Advance {
        let mut rest = step;
        while self.tau_total + rest.tau > self.tau_cut && self.list.len + 1 < self.k {
            let part = ((self.tau_cut - self.tau_total) / rest.tau).clamp(0.0, 1.0);
            let near;
            (near, rest) = split(&rest, part);
            self.extend(&near);
            if let Some(open) = self.open.take() {
                self.list.push(open);
            }
            self.tau_total += near.tau;
            // The next one starts at the cut: the list has no gaps.
            self.open = Some(OpenSegment { s0: rest.s0, s1: rest.s0, ..OpenSegment::default() });
            self.tau_cut = self.depth_of_cut(self.list.len + 1);
        }
        self.extend(&rest);
        self.tau_total += rest.tau;
        if step.s1 < self.profile.s_last { Advance::behind((-self.tau_total).exp()) } else { Advance::Stop }
    }
}
