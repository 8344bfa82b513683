//! Rules that turn the steps of a march into the segments of a layered frame: one file each.
//!
//! Every rule sees the same steps of the same lattice; only what becomes of them differs. Projections have a rule of their
//! own ([`projection`]), whichever is chosen; but `equal-length` and `single-depth` make simpler lists of them, too, to be
//! compared with.

pub mod all_samples;
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
pub mod visibility_merge;

pub use single_depth::Representative;

use rayon::prelude::*;

use super::march::{Marcher, Scene, Step, Texels, with_texels};
use super::raycast::opacity;
use crate::camera::{Basis, Intrinsics};
use crate::layer::{FrameHeader, LayeredFrame, MAX_K};
use crate::mode::Mode;
use crate::space::Ray;
use crate::wanted::{ALWAYS, Wanted};

/// The rules by name.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Layering {
    /// One march, merged where it costs least; K segments a list on average, more where they matter (ours).
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
    /// [`Layering::VisibilityMerge`] with at most K segments in every list.
    VisibilityMergeFixed,
}

impl Layering {
    /// Every rule.
    pub const ALL: [Self; 13] = [
        Self::VisibilityMerge,
        Self::VisibilityMergeFixed,
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
            Self::VisibilityMergeFixed => "visibility-merge:fixed",
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
        let longest = if self == Self::VisibilityMerge { visibility_merge::longest_list(k) } else { k };
        longest as u8
    }

    /// The rule that stands for this one in a mode: projections have but some.
    pub fn in_mode(self, mode: Mode) -> Self {
        match self {
            Self::EqualLength | Self::SingleDepth(_) | Self::VisibilityMergeFixed => self,
            _ if mode.is_projection() => Self::VisibilityMerge,
            _ => self,
        }
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
    generate_while(scene, header, layering, ALWAYS).unwrap_or_else(|| LayeredFrame::empty(header))
}

/// The same; `None` when the frame is no longer wanted, which is asked for each row.
pub fn generate_while(
    scene: &Scene,
    header: FrameHeader,
    layering: Layering,
    wanted: Wanted<'_>,
) -> Option<LayeredFrame> {
    with_texels!(scene, texels => generate_with(scene, &Marcher::new(scene, texels), header, layering, wanted))
}

fn generate_with<T: Texels>(
    scene: &Scene,
    marcher: &Marcher<'_, T>,
    header: FrameHeader,
    layering: Layering,
    wanted: Wanted<'_>,
) -> Option<LayeredFrame> {
    let camera = header.camera;
    let basis = camera.basis();
    let k = usize::from(header.k).clamp(1, MAX_K);
    let mode = scene.settings.mode;
    let layering = layering.in_mode(mode);
    let header = FrameHeader { k: layering.longest_list(header.k), mode, ..header };
    let longest = usize::from(header.k);
    let threshold = match layering {
        Layering::VisibilityMerge if mode.is_projection() => {
            projection::threshold(scene, marcher, &camera, k)
        }
        Layering::VisibilityMerge => visibility_merge::threshold(scene, marcher, &camera, k),
        _ => 0.0,
    };
    gather_rows(header, wanted, |y, row| {
        let mut gather = visibility_merge::Gather::default();
        let mut projected = projection::Gather::new(scene);
        let mut list = SegmentList::default();
        for x in 0..camera.intrinsics.width {
            let (ray, s_per_depth) = basis.ray(x as f32 + 0.5, y as f32 + 0.5);
            let of = RayOfFrame { basis: &basis, near: camera.near, threshold, ray, s_per_depth };
            if mode.is_projection() {
                list = match scene.lattice(&of.ray, of.near * s_per_depth) {
                    Some(lattice) => {
                        let lengths = (k, longest, threshold);
                        projection::list(marcher, &of.ray, lattice, layering, lengths, &mut projected)
                    }
                    None => SegmentList::default(),
                };
            } else {
                generate_list(scene, marcher, &of, k, layering, &mut gather, &mut list);
            }
            close::list(&camera, mode.compositing(), &mut list, s_per_depth, |segments| row.extend(segments));
            row.offsets.push(row.depth.len() as u32);
        }
    })
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

/// What a rule knows of the frame, and the ray.
struct RayOfFrame<'a> {
    basis: &'a Basis,
    /// View depth of the near plane.
    near: f32,
    /// See [`visibility_merge`].
    threshold: f32,
    ray: Ray,
    /// World distance per unit of view depth.
    s_per_depth: f32,
}

/// Makes of `list` that of one ray; `gather` is for the rule that needs it.
fn generate_list<T: Texels>(
    scene: &Scene,
    marcher: &Marcher<'_, T>,
    of: &RayOfFrame<'_>,
    k: usize,
    layering: Layering,
    gather: &mut visibility_merge::Gather,
    list: &mut SegmentList,
) {
    let &RayOfFrame { basis, near, threshold, ref ray, s_per_depth } = of;
    list.len = 0;
    let Some(lattice) = scene.lattice(ray, near * s_per_depth) else { return };
    *list = match layering {
        Layering::VisibilityMerge | Layering::VisibilityMergeFixed => {
            let most =
                if layering == Layering::VisibilityMerge { visibility_merge::longest_list(k) } else { k };
            let tolerance = visibility_merge::tolerance(threshold, k);
            gather.begin(lattice.unit, tolerance);
            marcher.march(ray, lattice, gather);
            gather.reduce(most, threshold, list);
            return;
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
        Layering::Homogeneity => homogeneity::list(k, lattice.h, |pass| marcher.march(ray, lattice, pass)),
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

/// A part of a step without any opacity is divided by this; no visible one is so small.
const ALPHA_LEAST: f32 = 1e-30;
