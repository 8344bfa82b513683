//! Rules that turn the steps of a march into the segments of a layered frame: one file each.
//!
//! Every rule sees the same steps of the same lattice; only what becomes of them differs.

pub mod equal_transmittance;
pub mod visibility_merge;

use rayon::prelude::*;

use super::march::{Marcher, Scene, Step, Texels, with_texels};
use crate::camera::Camera;
use crate::layer::{DEPTH_UNITS, FrameHeader, LayeredFrame, MAX_K, Segment, TAU_MAX, depth_to_units};
use crate::space::Ray;

/// The rules by name.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub enum Layering {
    /// One march; the neighbouring pair that costs least is merged when there are more than K (ours).
    #[default]
    VisibilityMerge,
    /// Cuts at equal shares of the accumulated opacity; two marches (Lochmann 2016).
    EqualTransmittance,
}

impl Layering {
    /// Every rule.
    pub const ALL: [Self; 2] = [Self::VisibilityMerge, Self::EqualTransmittance];

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::VisibilityMerge => "visibility-merge",
            Self::EqualTransmittance => "equal-transmittance",
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
        Self::ALL.into_iter().find(|l| l.name() == s).ok_or_else(|| {
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

/// Generates a layered frame by the rule `layering` with at most `header.k` segments a list.
pub fn generate(scene: &Scene, header: FrameHeader, layering: Layering) -> LayeredFrame {
    with_texels!(scene, texels => generate_with(scene, &Marcher::new(scene, texels), header, layering))
}

fn generate_with<T: Texels>(
    scene: &Scene,
    marcher: &Marcher<'_, T>,
    header: FrameHeader,
    layering: Layering,
) -> LayeredFrame {
    let camera = header.camera;
    let basis = camera.basis();
    let k = usize::from(header.k).clamp(1, MAX_K);
    let rows: Vec<LayeredFrame> = (0..camera.intrinsics.height)
        .into_par_iter()
        .map(|y| {
            let mut row = LayeredFrame {
                header,
                offsets: Vec::with_capacity(camera.intrinsics.width as usize),
                depth: Vec::new(),
                c_rg: Vec::new(),
                c_b_tau: Vec::new(),
            };
            for x in 0..camera.intrinsics.width {
                let (ray, s_per_depth) = basis.ray(x as f32 + 0.5, y as f32 + 0.5);
                let list = generate_list(scene, marcher, &ray, camera.near * s_per_depth, k, layering);
                let mut last_back = 0;
                for segment in &list.segments[..list.len] {
                    let segment = close_segment(&camera, segment, s_per_depth, last_back);
                    last_back = segment.back;
                    row.push(&segment);
                }
                row.offsets.push(row.depth.len() as u32);
            }
            row
        })
        .collect();
    let mut frame = LayeredFrame::empty(header);
    frame.offsets.truncate(1);
    let total = rows.iter().map(LayeredFrame::num_segments).sum();
    frame.depth.reserve_exact(total);
    frame.c_rg.reserve_exact(total);
    frame.c_b_tau.reserve_exact(total);
    for row in rows {
        let base = frame.depth.len() as u32;
        frame.offsets.extend(row.offsets.iter().map(|o| o + base));
        frame.depth.extend_from_slice(&row.depth);
        frame.c_rg.extend_from_slice(&row.c_rg);
        frame.c_b_tau.extend_from_slice(&row.c_b_tau);
    }
    frame
}

/// The list of one ray.
fn generate_list<T: Texels>(
    scene: &Scene,
    marcher: &Marcher<'_, T>,
    ray: &Ray,
    near: f32,
    k: usize,
    layering: Layering,
) -> SegmentList {
    let Some(lattice) = scene.lattice(ray, near) else { return SegmentList::default() };
    match layering {
        Layering::VisibilityMerge => {
            let mut sink = visibility_merge::VisibilityMerge::new(k, lattice.h);
            marcher.march(ray, lattice, &mut sink);
            sink.finish()
        }
        Layering::EqualTransmittance => {
            let mut profile = equal_transmittance::Profile::default();
            marcher.march(ray, lattice, &mut profile);
            let mut cuts = equal_transmittance::Cuts::new(k, profile);
            marcher.march(ray, lattice, &mut cuts);
            cuts.finish()
        }
    }
}

/// Rounds the ends of a segment to depth units, behind `last_back`. A segment thinner than [`MIN_UNITS`] is made so
/// thick; the units kept free at the far end are for those.
fn close_segment(camera: &Camera, segment: &OpenSegment, s_per_depth: f32, last_back: u16) -> Segment {
    let greatest = DEPTH_UNITS - (MAX_K * usize::from(MIN_UNITS)) as f32;
    let units = |s: f32| (depth_to_units(camera, s / s_per_depth) + 0.5).clamp(0.0, greatest) as u16;
    let front = units(segment.s0).max(last_back);
    let back = units(segment.s1).max(front + MIN_UNITS);
    Segment { front, back, c: segment.c, tau: segment.tau.min(TAU_MAX) }
}

/// Least thickness of a segment in depth units. Single precision finds where a ray crosses a depth to about 1/200 of
/// a unit, so the part of such a segment that a ray crosses is known to 1/1000; the units are 1/16384 of the volume's
/// diameter, far below any parallax.
const MIN_UNITS: u16 = 4;
