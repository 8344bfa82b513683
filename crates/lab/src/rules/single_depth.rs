//! The whole ray as one colour at one representative depth (Zellmann 2012).
//!
//! As in the renderings that the source sends, the ray ends where nothing behind is seen. The segment is as thin as
//! depths are stored.

use isinglass_core::kernels::march::{Advance, Sink, Step, TRANSMITTANCE_MIN};

use super::{OpenSegment, SegmentList, append};

/// Where on its ray the colour is put.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Representative {
    /// Mean of the distance, weighted by what each step adds to the picture.
    #[default]
    Mean,
    /// First content.
    Entry,
    /// Last content that is seen: the front of its step, so that the segment lies inside the volume.
    Exit,
    /// Half-way between entry and exit.
    Midpoint,
    /// Step of the greatest opacity.
    Peak,
    /// Step that the accumulated opacity grows by most.
    Gradient,
    /// Where the accumulated opacity reaches `THRESHOLD_SHARE` of that of the whole ray; two marches.
    Threshold,
}

impl Representative {
    /// Every one, in the order of their numbers.
    pub const ALL: [Self; 7] =
        [Self::Mean, Self::Entry, Self::Exit, Self::Midpoint, Self::Peak, Self::Gradient, Self::Threshold];
}

/// What is known of one ray.
#[derive(Clone, Copy, Debug)]
pub(super) struct SingleDepth {
    /// Opacity whose place is looked for.
    alpha_sought: f32,
    /// The whole ray, from entry to exit.
    all: OpenSegment,
    /// Front of the last step.
    s_exit: f32,
    /// Sums over the steps: what each adds to the picture, and that times its distance behind the entry.
    weight: f32,
    weighted_s: f32,
    transmittance: f32,
    peak: Greatest,
    gradient: Greatest,
    s_sought: Option<f32>,
}

/// The greatest value so far, and where it is.
#[derive(Clone, Copy, Debug, Default)]
struct Greatest {
    value: f32,
    s: f32,
}

impl Greatest {
    /// Of equal values the first counts, also if rounding tells them apart.
    fn add(&mut self, value: f32, s: f32) {
        if value > self.value * GREATER {
            *self = Self { value, s };
        }
    }
}

impl SingleDepth {
    /// Looks for the place where the accumulated opacity reaches `alpha_sought`, among others.
    pub(super) fn new(alpha_sought: f32) -> Self {
        Self {
            alpha_sought,
            all: OpenSegment::default(),
            s_exit: 0.0,
            weight: 0.0,
            weighted_s: 0.0,
            transmittance: 1.0,
            peak: Greatest::default(),
            gradient: Greatest::default(),
            s_sought: None,
        }
    }

    /// After march 1: march 2, for [`Representative::Threshold`] alone.
    pub(super) fn again(&self) -> Self {
        Self::new(THRESHOLD_SHARE * self.all.alpha)
    }

    /// The list: one segment, or none.
    pub(super) fn finish(self, representative: Representative) -> SegmentList {
        let mut list = SegmentList::default();
        if self.weight > 0.0 {
            let OpenSegment { s0, s1, .. } = self.all;
            let s = match representative {
                Representative::Mean => s0 + self.weighted_s / self.weight,
                Representative::Entry => s0,
                Representative::Exit => self.s_exit,
                Representative::Midpoint => 0.5 * (s0 + s1),
                Representative::Peak => self.peak.s,
                Representative::Gradient => self.gradient.s,
                Representative::Threshold => self.s_sought.unwrap_or(self.s_exit),
            };
            list.push(OpenSegment { s0: s, s1: s, ..self.all });
        }
        list
    }
}

impl Sink for SingleDepth {
    fn step(&mut self, step: Step) -> Advance {
        if self.weight == 0.0 {
            self.all.s0 = step.s0;
        }
        let middle = 0.5 * (step.s0 + step.s1);
        let added = self.transmittance * step.alpha;
        self.weight += added;
        self.weighted_s += added * (middle - self.all.s0);
        self.peak.add(step.alpha, middle);
        self.gradient.add(added, middle);
        append(&mut self.all, &step);
        self.s_exit = step.s0;
        self.transmittance *= 1.0 - step.alpha;
        if self.all.alpha >= self.alpha_sought && self.s_sought.is_none() {
            self.s_sought = Some(middle);
        }
        if self.transmittance > TRANSMITTANCE_MIN { Advance::Step } else { Advance::Stop }
    }
}

/// Share of the ray's opacity that [`Representative::Threshold`] looks for: that of the source's own program.
pub(super) const THRESHOLD_SHARE: f32 = 0.8;
/// A value counts as greater if it is by this factor: a thousandth, above any rounding and below anything seen.
const GREATER: f32 = 1.001;
