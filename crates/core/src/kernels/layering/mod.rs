//! Layered frames from a march: the steps of each ray become the segments of its list.
//!
//! `visibility_merge` makes the lists of modes that composite with *over*, [`projection`] those of projections. Both
//! are `stream`s under one [`budget`]. A laboratory may supply a [`Rule`] of its own, which sees the same steps.

pub mod budget;
pub mod close;
pub mod parts;
mod pieces;
pub mod projection;
mod stream;
mod visibility_merge;

#[cfg(test)]
mod tests;

use std::sync::Arc;

use self::budget::Budget;
pub use self::pieces::{Making, UnfinishedFrame, gather_rows};
use super::march::{Lattice, Marcher, Scene, Sink, Step, Texels, with_texels};
use crate::camera::Basis;
use crate::cancel::{ALWAYS, Wanted};
use crate::layer::{FrameHeader, LayeredFrame, MAX_K};
use crate::space::Ray;

/// Another rule that turns the steps of a ray into a list.
pub trait Rule: Sync {
    /// Fills the empty `list` for a ray with at most `k` segments.
    fn list<T: Texels>(&self, ray: &Listing<'_, T>, k: usize, list: &mut SegmentList);
}

/// Makes a frame of a scene, in place of [`generate_while`].
pub type FrameMaker = Arc<dyn Fn(&Scene, FrameHeader, Wanted<'_>) -> Option<LayeredFrame> + Send + Sync>;

/// An unfinished segment: a step that may span many.
pub type OpenSegment = Step;

/// Up to [`MAX_K`] finished segments of one ray.
#[derive(Clone, Copy, Debug, Default)]
pub struct SegmentList {
    /// Number of valid `segments`.
    pub len: usize,
    /// The segments, front to back.
    pub segments: [OpenSegment; MAX_K],
}

impl SegmentList {
    /// Adds a segment at the back.
    pub fn push(&mut self, segment: OpenSegment) {
        self.segments[self.len] = segment;
        self.len += 1;
    }
}

/// Adds a piece to the back of an open segment.
pub fn append(open: &mut OpenSegment, piece: &Step) {
    open.c += piece.c * (1.0 - open.alpha);
    open.alpha += piece.alpha * (1.0 - open.alpha);
    open.tau += piece.tau;
    open.s1 = piece.s1;
}

/// Generates a layered frame with `header.k` segments per list on average. The header of the result has the longest
/// possible list.
pub fn generate(scene: &Scene, header: FrameHeader) -> LayeredFrame {
    let frame = generate_while(scene, header, &mut Budget::default(), ALWAYS);
    frame.unwrap_or_else(|| LayeredFrame::empty(header))
}

/// The same for successive frames of one scene, whose budget follows from the last frame. Returns `None` when the
/// frame is no longer `wanted`, which is checked for each row.
pub fn generate_while(
    scene: &Scene,
    header: FrameHeader,
    budget: &mut Budget,
    wanted: Wanted<'_>,
) -> Option<LayeredFrame> {
    let mut frame = UnfinishedFrame::new(scene, header);
    let is_whole = wanted() && frame.advance(scene, budget, usize::MAX, wanted) == Making::Whole;
    is_whole.then(|| frame.finish(budget))
}

/// Generates a layered frame with a laboratory's rule, at most `header.k` segments per list. The mode must composite
/// with *over*.
pub fn generate_by(
    scene: &Scene,
    header: FrameHeader,
    rule: &impl Rule,
    wanted: Wanted<'_>,
) -> Option<LayeredFrame> {
    let header = FrameHeader { k: clamp_k(header.k), mode: scene.settings.mode, ..header };
    with_texels!(scene, texels => {
        let marcher = Marcher::new(scene, texels);
        let fill = |of: &Listing<'_, _>, list: &mut SegmentList| rule.list(of, header.k.into(), list);
        let limits = (usize::MAX, wanted);
        pieces::whole(header, || pieces::rows_of_lists(scene, &marcher, header, 0, limits, fill), wanted)
    })
}

fn clamp_k(k: u8) -> u8 {
    k.clamp(1, MAX_K as u8)
}

/// A ray that meets the volume, with what is known of its frame.
pub struct Listing<'a, T> {
    /// The scene that is marched.
    pub scene: &'a Scene,
    marcher: &'a Marcher<'a, T>,
    /// Basis of the frame's camera.
    pub basis: &'a Basis,
    /// View depth of the near plane.
    pub near: f32,
    /// The ray.
    pub ray: Ray,
    /// The steps of the ray.
    pub lattice: Lattice,
    /// World distance per unit of view depth.
    pub s_per_depth: f32,
}

impl<'a, T: Texels> Listing<'a, T> {
    /// The ray of a pixel; `None` if it misses the volume.
    pub fn new(
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

    /// Marches the ray, in a mode that composites with *over*.
    pub fn march(&self, sink: &mut impl Sink) {
        self.marcher.march(&self.ray, self.lattice, sink);
    }

    /// Fills the empty `list` with at most `longest` segments, whose errors are at most `threshold`.
    pub fn list(&self, longest: usize, threshold: f32, list: &mut SegmentList) {
        if self.scene.settings.mode.is_projection() {
            return projection::list(self, longest, threshold, list);
        }
        let mut lister = visibility_merge::Lister::new(threshold, longest, &self.lattice, list);
        self.march(&mut lister);
        lister.finish();
    }
}
