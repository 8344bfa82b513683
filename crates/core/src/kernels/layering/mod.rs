//! Rules that turn the steps of a march into the segments of a layered frame: one file each.
//!
//! Every rule sees the same steps of the same lattice; only what becomes of them differs. Projections have a rule of their
//! own ([`projection`]), whichever is chosen.

pub mod all_samples;
pub mod budget;
mod close;
pub mod cuts;
pub mod equal_length;
pub mod equal_transmittance;
pub mod homogeneity;
#[cfg(test)]
mod laws;
pub mod projection;
pub mod single_depth;
pub mod slabs;
mod stream;
mod visibility_merge;

pub use single_depth::Representative;

use rayon::prelude::*;

use self::budget::Budget;
use super::march::{Lattice, Marcher, Scene, Step, Texels, with_texels};
use super::raycast::opacity;
use crate::camera::{Basis, Intrinsics};
use crate::cancel::{ALWAYS, Wanted};
use crate::layer::{FrameHeader, LayeredFrame, MAX_K};
use crate::mode::Mode;
use crate::space::Ray;

/// The rules by name.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Layering {
    /// One march, merged up to an error that the whole frame shares; K segments a list on average, more where they matter
    /// (ours).
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
}

impl Layering {
    /// Every rule.
    pub const ALL: [Self; 12] = [
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
    ];

    /// The name on the command line.
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
        }
    }
}

impl Layering {
    /// The longest list that occurs in a frame for `k`.
    pub fn longest_list(self, k: u8) -> u8 {
        let k = usize::from(k).clamp(1, MAX_K);
        let longest = if self == Self::VisibilityMerge { budget::longest_list(k) } else { k };
        longest as u8
    }

    /// The rule that stands for this one in a mode: projections have one.
    pub fn in_mode(self, mode: Mode) -> Self {
        if mode.is_projection() { Self::VisibilityMerge } else { self }
    }
}

impl std::fmt::Display for Layering {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl std::str::FromStr for Layering {
    type Err = String;

    fn from_str(s: &str) -> Result<Self, String> {
        // The default in full, beside the others of its kind.
        let name = if s == "single-depth:mean" { "single-depth" } else { s };
        Self::ALL.into_iter().find(|l| l.name() == name).ok_or_else(|| {
            format!("unknown layering '{s}', expected one of {}", Self::ALL.map(Self::name).join(", "))
        })
    }
}

/// A segment while it is made: a step that may span many.
pub type OpenSegment = Step;

/// Up to [`MAX_K`] finished segments of one ray.
#[derive(Clone, Copy, Debug, Default)]
pub struct SegmentList {
    /// How many of `segments` count.
    pub len: usize,
    /// Front to back.
    pub segments: [OpenSegment; MAX_K],
}

impl SegmentList {
    /// Adds a segment behind the others.
    pub fn push(&mut self, segment: OpenSegment) {
        self.segments[self.len] = segment;
        self.len += 1;
    }
}

/// Adds a piece to the back of an open segment.
fn append(open: &mut OpenSegment, piece: &Step) {
    open.c += piece.c * (1.0 - open.alpha);
    open.alpha += piece.alpha * (1.0 - open.alpha);
    open.tau += piece.tau;
    open.s1 = piece.s1;
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

/// Generates a layered frame by the rule `layering` with `header.k` segments a list: on average for
/// [`Layering::VisibilityMerge`], else at most. The header of the frame has the longest list that can occur.
pub fn generate(scene: &Scene, header: FrameHeader, layering: Layering) -> LayeredFrame {
    let frame = generate_while(scene, header, layering, &mut Budget::default(), ALWAYS);
    frame.unwrap_or_else(|| LayeredFrame::empty(header))
}

/// The same for one frame after another of one scene, whose budget follows from what the last one spent; `None` when the
/// frame is no longer wanted, which is asked for each row.
pub fn generate_while(
    scene: &Scene,
    header: FrameHeader,
    layering: Layering,
    budget: &mut Budget,
    wanted: Wanted<'_>,
) -> Option<LayeredFrame> {
    with_texels!(scene, texels => {
        generate_with(scene, &Marcher::new(scene, texels), header, layering, budget, wanted)
    })
}

fn generate_with<T: Texels>(
    scene: &Scene,
    marcher: &Marcher<'_, T>,
    header: FrameHeader,
    layering: Layering,
    budget: &mut Budget,
    wanted: Wanted<'_>,
) -> Option<LayeredFrame> {
    let camera = header.camera;
    let basis = camera.basis();
    let k = header.k.clamp(1, MAX_K as u8);
    let mode = scene.settings.mode;
    let layering = layering.in_mode(mode);
    let asked = FrameHeader { k, mode, ..header };
    let header = FrameHeader { k: layering.longest_list(k), ..asked };
    let longest = usize::from(header.k);
    let k = usize::from(k);
    let threshold = match layering {
        Layering::VisibilityMerge => {
            budget.threshold(&asked, scene.volume.bounds().radius()).unwrap_or_else(|| {
                budget::count(scene, marcher, &camera, k, |of, thresholds| match mode.is_projection() {
                    true => projection::counts(of, longest, thresholds),
                    false => budget::counts_of_matter(of, longest, thresholds),
                })
            })
        }
        _ => 0.0,
    };
    let frame = gather_rows(header, wanted, |y, row| {
        let mut list = SegmentList::default();
        for x in 0..camera.intrinsics.width {
            if let Some(of) = Listing::new(scene, marcher, &basis, camera.near, (x, y)) {
                of.list(layering, k, threshold, &mut list);
                close::list(&camera, mode.compositing(), &mut list, of.s_per_depth, |list| row.extend(list));
            }
            row.offsets.push(row.depth.len() as u32);
        }
    })?;
    if layering == Layering::VisibilityMerge {
        budget.note(&asked, threshold, &frame);
    }
    Some(frame)
}

/// The frame of the rows that `fill` makes, in parallel: it pushes the segments and the end of each list of row `y`.
/// `None` as soon as it is no longer wanted.
fn gather_rows(
    header: FrameHeader,
    wanted: Wanted<'_>,
    fill: impl Fn(u32, &mut LayeredFrame) + Sync,
) -> Option<LayeredFrame> {
    let Intrinsics { width, height, .. } = header.camera.intrinsics;
    let rows: Vec<LayeredFrame> = (0..height)
        .into_par_iter()
        .map(|y| {
            if !wanted() {
                return None;
            }
            let mut row = LayeredFrame {
                header,
                offsets: Vec::with_capacity(width as usize),
                depth: Vec::new(),
                c_rg: Vec::new(),
                c_b_tau: Vec::new(),
            };
            fill(y, &mut row);
            Some(row)
        })
        .collect::<Option<_>>()?;
    let total = rows.iter().map(LayeredFrame::num_segments).sum();
    let mut frame = LayeredFrame {
        depth: vec![0; total],
        c_rg: vec![0; total],
        c_b_tau: vec![0; total],
        ..LayeredFrame::empty(header)
    };
    // Memory that nobody has written to comes page by page, which takes longer than copying: so that is done in parallel, too.
    let (mut depth, mut c_rg, mut c_b_tau) =
        (&mut frame.depth[..], &mut frame.c_rg[..], &mut frame.c_b_tau[..]);
    let mut first = 0;
    let mut places = Vec::with_capacity(rows.len());
    for (row, offsets) in rows.into_iter().zip(frame.offsets[1..].chunks_mut(width as usize)) {
        let num = row.num_segments();
        let planes = [&mut depth, &mut c_rg, &mut c_b_tau].map(|plane| {
            let (own, rest) = std::mem::take(plane).split_at_mut(num);
            *plane = rest;
            own
        });
        places.push((row, first, offsets, planes));
        first += num as u32;
    }
    places.into_par_iter().for_each(|(row, first, offsets, [depth, c_rg, c_b_tau])| {
        for (offset, in_row) in offsets.iter_mut().zip(&row.offsets) {
            *offset = first + in_row;
        }
        depth.copy_from_slice(&row.depth);
        c_rg.copy_from_slice(&row.c_rg);
        c_b_tau.copy_from_slice(&row.c_b_tau);
    });
    Some(frame)
}

/// A ray that meets the volume, and what a rule knows of its frame.
pub(crate) struct Listing<'a, T> {
    scene: &'a Scene,
    marcher: &'a Marcher<'a, T>,
    basis: &'a Basis,
    /// View depth of the near plane.
    near: f32,
    ray: Ray,
    lattice: Lattice,
    /// World distance per unit of view depth.
    s_per_depth: f32,
}

impl<'a, T: Texels> Listing<'a, T> {
    /// The ray of a pixel; none if it meets nothing.
    fn new(
        scene: &'a Scene,
        marcher: &'a Marcher<'a, T>,
        basis: &'a Basis,
        near: f32,
        (x, y): (u32, u32),
    ) -> Option<Self> {
        let (ray, s_per_depth) = basis.ray(x as f32 + 0.5, y as f32 + 0.5);
        let lattice = scene.lattice(&ray, near * s_per_depth)?;
        Some(Self { scene, marcher, basis, near, ray, lattice, s_per_depth })
    }

    /// Makes of `list` that of the ray.
    fn list(&self, layering: Layering, k: usize, threshold: f32, list: &mut SegmentList) {
        let &Self { scene, marcher, basis, near, ref ray, lattice, s_per_depth } = self;
        list.len = 0;
        *list = match layering {
            Layering::VisibilityMerge => {
                let longest = budget::longest_list(k);
                if scene.settings.mode.is_projection() {
                    return projection::list(self, longest, threshold, list);
                }
                let mut lister = visibility_merge::Lister::new(threshold, longest, &lattice, list);
                marcher.march(ray, lattice, &mut lister);
                return lister.finish();
            }
            Layering::EqualTransmittance => {
                let mut profile = equal_transmittance::Profile::default();
                marcher.march(ray, lattice, &mut profile);
                let mut cuts = equal_transmittance::Cuts::new(k, profile);
                marcher.march(ray, lattice, &mut cuts);
                cuts.finish()
            }
            Layering::EqualLength => {
                let mut extent = equal_length::Extent::default();
                marcher.march(ray, lattice, &mut extent);
                let Some(mut cuts) = extent.cuts(k) else { return };
                marcher.march(ray, lattice, &mut cuts);
                cuts.finish()
            }
            Layering::Homogeneity => {
                homogeneity::list(k, lattice.h, |pass| marcher.march(ray, lattice, pass))
            }
            Layering::SingleDepth(representative) => {
                let mut sink = single_depth::SingleDepth::new(f32::INFINITY);
                marcher.march(ray, lattice, &mut sink);
                if representative == Representative::Threshold {
                    sink = sink.again();
                    marcher.march(ray, lattice, &mut sink);
                }
                sink.finish(representative)
            }
            Layering::Slabs => {
                let mut cuts = slabs::cuts(k, basis, near, &scene.region().bounds, s_per_depth);
                marcher.march(ray, lattice, &mut cuts);
                cuts.finish()
            }
        };
    }
}

/// A part of a step without any opacity is divided by this; no visible one is so small.
const ALPHA_LEAST: f32 = 1e-30;
