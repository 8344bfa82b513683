//! Surfaces with thickness. Twin of the same functions in `shaders/march/surfaces.wgsl`.
//!
//! A surface is infinitely thin, but in a layered frame it needs thickness. A new ray passes from list to list. Where
//! the surface's depth differs between lists by more than its thickness, the ray slips through. Nobody outside sees
//! what an opaque surface encloses, so its crossings are filled with its own matter. The fill has the front's colour
//! from the entry to half way, and the back's colour from there to the exit.
//!
//! Opaque matter is dense: the ray that found it has the same colours but for the e^−τ, at most 1/2980, that came
//! through the surface. A translucent surface is [`THICKNESS_IN_VOXELS`] thick, and no thicker than half the way to
//! the next crossing. Both lie on the side of the bodies: of greater values, or of lesser ones where opaque surfaces
//! enclose those ([`has_lesser_bodies`]). On the other side, a body of lesser values would fill the open space behind
//! it.

use super::modes::Surface;
use super::{Advance, Lattice, Scene, Sink, Step};
use crate::clip::Clip;
use crate::kernels::part_rows::PartsError;
use crate::kernels::raycast::opacity;
use crate::mode::Mode;
use crate::transfer::TransferTable;
use crate::volume::{
    Matter, Sheet, Volume, VoxelBox, are_lesser_bodies, area_above, has_lesser_bodies, opacity_table,
};

pub(super) fn sheets(surfaces: &[Surface]) -> Vec<Sheet> {
    let sheet = |&Surface { stored, tau, .. }: &Surface| Sheet { stored, tau, is_opaque: tau > OPAQUE_TAU };
    surfaces.iter().map(sheet).collect()
}

/// Whether the bodies inside opaque surfaces, in the visible part of a volume, have lesser values.
pub(super) fn has_lesser(surfaces: &[Surface], table: &TransferTable, volume: &Volume, clip: &Clip) -> bool {
    let is_lesser = has_lesser_bodies(&sheets(surfaces), volume, &clip.region(&volume.bounds()));
    is_lesser.is_some_and(|is_lesser| in_positions(is_lesser, table))
}

/// Values and positions may fall where stored numbers rise.
fn in_positions(is_lesser: bool, table: &TransferTable) -> bool {
    is_lesser == (table.x_scale > 0.0)
}

impl Scene {
    /// Of a part of a volume: the areas that decide, summed over all parts, on which side of surfaces bodies lie. The
    /// first is that of the voxels of `own`, and the second is the same everywhere. `None` if nothing depends on it.
    pub fn areas_of_bodies(&self, own: &VoxelBox) -> Option<[f64; 2]> {
        area_above(&sheets(&self.surfaces), &self.volume, &self.region(), own)
    }

    /// The scene of a part, given the sum of the first area over all parts and the second.
    pub fn with_areas_of_bodies(self, areas: [f64; 2]) -> Self {
        Self { has_lesser_bodies: in_positions(are_lesser_bodies(areas), &self.table), ..self }
    }
}

impl Scene {
    /// Of a part of a volume whose shade needs all parts: what the voxels of `own` add to it, as words. The side of the
    /// bodies must be known. `None` if there is no shade, or it is there.
    pub fn own_cells_of_light(&self, own: &VoxelBox) -> Option<Vec<u32>> {
        let sheets = sheets(&self.surfaces);
        let is_lesser = Some(in_positions(self.has_lesser_bodies, &self.table));
        let table;
        let matter = match &self.opacities {
            Some(opacities) => {
                table = opacity_table(opacities);
                Matter::Medium(&table)
            }
            None if self.settings.mode == Mode::Iso => Matter::Surfaces(&sheets),
            None => Matter::Medium(&self.table),
        };
        self.illumination.own_cells((matter, is_lesser), own)
    }

    /// The scene of a part with its shade, given the box of each part and its words.
    ///
    /// # Errors
    /// If a part has sent something else.
    pub fn lit_by_cells(mut self, boxes: &[VoxelBox], words: &[Vec<u32>]) -> Result<Self, PartsError> {
        if boxes.len() != words.len() {
            return Err(PartsError::Processes { found: words.len(), expected: boxes.len() });
        }
        let parts: Vec<_> = boxes.iter().copied().zip(words.iter().map(Vec::as_slice)).collect();
        self.illumination = self.illumination.with_cells(&parts).ok_or(PartsError::Cells)?;
        Ok(self)
    }
}

/// Hands crossings on as segments that do not overlap.
pub(crate) struct Thicken<'a, S> {
    sink: &'a mut S,
    /// The last crossing.
    pending: Option<Pending>,
    lattice: Lattice,
    voxel: f32,
    has_lesser_bodies: bool,
    has_stopped: bool,
}

struct Pending {
    step: Step,
    place: f32,
    /// Whether the matter is behind the crossing.
    enters: bool,
}

impl<'a, S: Sink> Thicken<'a, S> {
    /// `voxel` is the least spacing.
    pub(super) fn new(sink: &'a mut S, lattice: Lattice, voxel: f32, has_lesser_bodies: bool) -> Self {
        Self { sink, pending: None, lattice, voxel, has_lesser_bodies, has_stopped: false }
    }

    /// Hands on the last crossing and ends the ray.
    pub(crate) fn finish(mut self) {
        let end = self.lattice.s0 + self.lattice.h * self.lattice.n as f32;
        if let Some(pending) = self.pending.take().filter(|_| !self.has_stopped) {
            self.hand_on(&pending, end);
        }
    }

    /// The greatest thickness of a crossing's matter.
    fn reach(&self, step: &Step) -> f32 {
        if step.tau > OPAQUE_TAU { f32::INFINITY } else { THICKNESS_IN_VOXELS * self.voxel }
    }

    /// Hands on a crossing; `most` bounds the matter behind it.
    fn hand_on(&mut self, pending: &Pending, most: f32) -> Advance {
        let mut step = pending.step;
        let back = if pending.enters { pending.place + self.reach(&step) } else { pending.place };
        step.s1 = back.min(most).max(step.s0);
        if step.tau > OPAQUE_TAU {
            // This density makes a voxel of it opaque.
            let denser = ((step.s1 - step.s0) / self.voxel).max(1.0);
            let alpha = opacity(step.tau * denser);
            step.c *= alpha / step.alpha;
            (step.tau, step.alpha) = (step.tau * denser, alpha);
        }
        self.sink.step(step)
    }
}

impl<S: Sink> Sink for Thicken<'_, S> {
    fn step(&mut self, step: Step) -> Advance {
        let (place, enters) = (step.s0, (step.s1 > step.s0) != self.has_lesser_bodies);
        let mut pace = Advance::Step;
        // An opaque body around the ray's start would hide its inside.
        let mut before = place - self.reach(&step).min(THICKNESS_IN_VOXELS * self.voxel);
        before = before.max(self.lattice.s0);
        if let Some(pending) = self.pending.take() {
            let both = pending.enters && !enters;
            let border = if both { 0.5 * (pending.place + place) } else { place };
            pace = self.hand_on(&pending, border);
            before = (place - self.reach(&step)).max(if both { border } else { pending.place });
        }
        let s0 = if enters { place } else { before };
        self.pending = Some(Pending { step: Step { s0, ..step }, place, enters });
        self.has_stopped = pace == Advance::Stop;
        // A stride would step over a thin sheet, and lists would lack a wall: no integral reveals it.
        if pace == Advance::Stride { Advance::Step } else { pace }
    }
}

/// Optical depth above which a crossing is opaque, between opacities of 0.999 and 0.9999.
const OPAQUE_TAU: f32 = 8.0;
/// At two voxels, surfaces at 60° to the lists have no gaps.
const THICKNESS_IN_VOXELS: f32 = 2.0;
