//! The layering rules of the papers, one file each, beside ours. They run on the CPU.
//!
//! Every rule sees the same steps of the same lattice. Only what becomes of them differs.

pub mod all_samples;
mod cuts;
mod equal_length;
mod equal_transmittance;
mod homogeneity;
mod single_depth;
mod slabs;

#[cfg(test)]
mod laws;
#[cfg(test)]
mod tests;

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use isinglass_core::cancel::{ALWAYS, Wanted};
use isinglass_core::kernels::layering::{self, FrameMaker, Listing, OpenSegment, SegmentList, append};
use isinglass_core::kernels::march::{Scene, Step, Texels};
use isinglass_core::kernels::raycast::opacity;
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::mode::Mode;
use isinglass_render::Renderer;

pub use single_depth::Representative;

use crate::error::LabError;

/// How the frame of a table is made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Rule {
    /// As the product makes it: merged up to an error that the whole frame shares (ours).
    #[default]
    VisibilityMerge,
    /// Cuts at equal shares of the accumulated opacity; two marches (Lochmann 2016).
    EqualTransmittance,
    /// Cuts at equal distances from the first to the last content; two marches (Brady 1997).
    EqualLength,
    /// Segments of like colour, by a threshold that is found ray by ray; many marches (Frey 2013, Gupta 2022).
    Homogeneity,
    /// The whole ray at one depth (Zellmann 2012).
    SingleDepth(Representative),
    /// Slabs of equal view depth, the same for every ray (Mueller 1999).
    Slabs,
    /// Every sample is a segment: the floor that the way of reading lists sets. No codec takes such a frame.
    AllSamples,
}

impl Rule {
    /// Every rule.
    pub const ALL: [Self; 13] = [
        Self::VisibilityMerge,
        Self::EqualTransmittance,
        Self::EqualLength,
        Self::Homogeneity,
        Self::Slabs,
        Self::SingleDepth(Representative::Mean),
        Self::SingleDepth(Representative::Entry),
        Self::SingleDepth(Representative::Exit),
        Self::SingleDepth(Representative::Midpoint),
        Self::SingleDepth(Representative::Peak),
        Self::SingleDepth(Representative::Gradient),
        Self::SingleDepth(Representative::Threshold),
        Self::AllSamples,
    ];

    /// The name on the command line and in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::VisibilityMerge => "visibility-merge",
            Self::EqualTransmittance => "equal-transmittance",
            Self::EqualLength => "equal-length",
            Self::Homogeneity => "homogeneity",
            Self::Slabs => "slabs",
            Self::SingleDepth(Representative::Mean) => "single-depth",
            Self::SingleDepth(Representative::Entry) => "single-depth:entry",
            Self::SingleDepth(Representative::Exit) => "single-depth:exit",
            Self::SingleDepth(Representative::Midpoint) => "single-depth:midpoint",
            Self::SingleDepth(Representative::Peak) => "single-depth:peak",
            Self::SingleDepth(Representative::Gradient) => "single-depth:gradient",
            Self::SingleDepth(Representative::Threshold) => "single-depth:threshold",
            Self::AllSamples => "all-samples",
        }
    }

    /// Those of `ks` that make different frames. One depth for a whole ray makes lists of one segment; all samples are
    /// lists without an end, which a header calls 255.
    pub fn ks(self, ks: &[u8]) -> Vec<u8> {
        match self {
            Self::SingleDepth(_) => vec![1],
            Self::AllSamples => vec![u8::MAX],
            _ => ks.to_vec(),
        }
    }

    /// The rule that stands for this one in a mode: projections have one.
    pub fn in_mode(self, mode: Mode) -> Self {
        if mode.is_projection() && self != Self::AllSamples { Self::VisibilityMerge } else { self }
    }

    /// Makes the frame of what `renderer` draws, with `header.k` segments a list: on average for ours, else at most. Ours is
    /// made by the renderer itself.
    pub fn generate(self, renderer: &mut Renderer, header: FrameHeader) -> Result<LayeredFrame, LabError> {
        match self.in_mode(renderer.scene().settings.mode) {
            Self::VisibilityMerge => Ok(renderer.generate(header)?),
            Self::AllSamples => Ok(all_samples::generate(renderer.scene(), header)?),
            rule => Ok(rule.frame_of(renderer.scene(), header)),
        }
    }

    /// The same on the CPU. [`Self::AllSamples`] is made by [`all_samples::generate`] alone, and stands for ours here.
    pub fn frame_of(self, scene: &Scene, header: FrameHeader) -> LayeredFrame {
        self.generate_while(scene, header, ALWAYS).unwrap_or_else(|| LayeredFrame::empty(header))
    }

    fn generate_while(self, scene: &Scene, header: FrameHeader, wanted: Wanted<'_>) -> Option<LayeredFrame> {
        match self.in_mode(scene.settings.mode) {
            Self::VisibilityMerge | Self::AllSamples => {
                layering::generate_while(scene, header, &mut Default::default(), wanted)
            }
            rule => layering::generate_by(scene, header, &rule, wanted),
        }
    }

    /// For a server that makes its frames so; none for ours.
    pub fn frame_maker(self) -> Option<FrameMaker> {
        (self != Self::VisibilityMerge).then(|| {
            Arc::new(move |scene: &_, header, wanted: Wanted<'_>| self.generate_while(scene, header, wanted))
                as _
        })
    }
}

impl layering::Rule for Rule {
    fn list<T: Texels>(&self, of: &Listing<'_, T>, k: usize, list: &mut SegmentList) {
        *list = match *self {
            Self::VisibilityMerge | Self::AllSamples => return,
            Self::EqualTransmittance => {
                let mut profile = equal_transmittance::Profile::default();
                of.march(&mut profile);
                let mut cuts = equal_transmittance::TransmittanceCuts::new(k, profile);
                of.march(&mut cuts);
                cuts.finish()
            }
            Self::EqualLength => {
                let mut extent = equal_length::Extent::default();
                of.march(&mut extent);
                let Some(mut cuts) = extent.cuts(k) else { return };
                of.march(&mut cuts);
                cuts.finish()
            }
            Self::Homogeneity => homogeneity::list(k, of.lattice.h, |pass| of.march(pass)),
            Self::SingleDepth(representative) => {
                let mut sink = single_depth::SingleDepth::new(f32::INFINITY);
                of.march(&mut sink);
                if representative == Representative::Threshold {
                    sink = sink.again();
                    of.march(&mut sink);
                }
                sink.finish(representative)
            }
            Self::Slabs => {
                let bounds = &of.scene.region().bounds;
                let mut cuts = slabs::cuts(k, of.basis, of.near, bounds, of.s_per_depth);
                of.march(&mut cuts);
                cuts.finish()
            }
        };
    }
}

impl fmt::Display for Rule {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Rule {
    type Err = String;

    fn from_str(s: &str) -> Result<Self, String> {
        // The default in full, beside the others of its kind.
        let name = if s == "single-depth:mean" { "single-depth" } else { s };
        Self::ALL.into_iter().find(|l| l.name() == name).ok_or_else(|| {
            format!("unknown rule '{s}', expected one of {}", Self::ALL.map(Self::name).join(", "))
        })
    }
}

/// The two parts of a step that is cut, as a homogeneous medium, behind the share `part` of its length.
fn split(step: &Step, part: f32) -> (Step, Step) {
    let s_cut = step.s0 + (step.s1 - step.s0) * part;
    let piece = |s0, s1, tau| {
        let alpha = opacity(tau);
        Step { s0, s1, c: step.c * (alpha / step.alpha.max(ALPHA_LEAST)), tau, alpha }
    };
    (piece(step.s0, s_cut, step.tau * part), piece(s_cut, step.s1, step.tau * (1.0 - part)))
}

/// A part of a step without any opacity is divided by this; no visible one is so small.
const ALPHA_LEAST: f32 = 1e-30;
