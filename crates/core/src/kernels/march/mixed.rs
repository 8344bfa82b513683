//! The march through several channels at once, and through labels. Twin of `shaders/march/mixed.wgsl`.
//!
//! Each channel is sampled and classified by its own table. Between two samples, channel j alone has colour c_j and
//! optical depth τ_j. Media mix: τ = Σ τ_j and c = Σ c_j·τ_j / τ. Light adds up: τ = max τ_j and c = min(Σ c_j·τ_j / τ, 1).
//! Both are laws of densities, so the length of steps does not matter.
//!
//! Where the first of the channels has nothing, no channel is shown.
//!
//! Labels are names, so nothing lies between two of them. A sample is the label of the nearest voxel, and a step has the
//! mean density of the labels at both ends.

use glam::Vec3;

use super::field::{MarchField, Run};
use super::glossy::VoxelRay;
use super::grid::{Grid, GridShape, LANES, Lanes};
use super::skipper::{Skipper, VisibleBins};
use super::{Lattice, Marcher, Scene, Sink, Step, TABLE_BINS, TAU_MIN, Texels, Walk, classify_by};
use crate::channels::{Blend, MAX_CHANNELS};
use crate::kernels::raycast::opacity;
use crate::transfer::TransferTable;
use crate::volume::Voxels;

/// A channel of a mixed march.
pub(super) struct MixedChannel<'a> {
    table: &'a TransferTable,
    visible_bins: VisibleBins,
}

/// Texels of any type.
pub(super) enum AnyGrid<'a> {
    U8(Grid<&'a [u8]>),
    U16(Grid<&'a [u16]>),
    F32(Grid<&'a [f32]>),
}

impl<'a> AnyGrid<'a> {
    pub(super) fn of(voxels: &'a Voxels, shape: GridShape) -> Self {
        match voxels {
            Voxels::U8(v) => Self::U8(Grid::new(v, shape)),
            Voxels::U16(v) => Self::U16(Grid::new(v, shape)),
            Voxels::F32(v) => Self::F32(Grid::new(v, shape)),
        }
    }
}

impl<'a> MixedChannel<'a> {
    /// The visible channels of a scene that mixes them; none of any other scene.
    pub(super) fn all(scene: &'a Scene) -> Vec<Self> {
        if !scene.is_mixed() {
            return Vec::new();
        }
        let others = scene.others.iter().map(|other| &other.table);
        let of = |table| Self { table, visible_bins: VisibleBins::of(table) };
        std::iter::once(&scene.table).chain(others).map(of).collect()
    }

    /// Positions in the domain of points along a ray.
    #[inline(always)]
    fn positions(&self, texels: &AnyGrid<'_>, origin: Vec3, dir: Vec3, s: &Lanes) -> Lanes {
        let mut x = [0.0; LANES];
        if self.table.are_labels {
            for m in 0..LANES {
                let stored = match texels {
                    AnyGrid::U8(grid) => grid.nearest(origin + dir * s[m]),
                    AnyGrid::U16(grid) => grid.nearest(origin + dir * s[m]),
                    AnyGrid::F32(grid) => grid.nearest(origin + dir * s[m]),
                };
                x[m] = self.table.label_node(stored) as f32 * (1.0 / TABLE_BINS as f32);
            }
            return x;
        }
        let stored = match texels {
            AnyGrid::U8(grid) => grid.sample_lanes(origin, dir, s),
            AnyGrid::U16(grid) => grid.sample_lanes(origin, dir, s),
            AnyGrid::F32(grid) => grid.sample_lanes(origin, dir, s),
        };
        for m in 0..LANES {
            let at = stored[m] * self.table.x_scale + self.table.x_offset;
            let at = if at > 0.0 { at } else { 0.0 };
            x[m] = if at < 1.0 { at } else { 1.0 };
        }
        x
    }

    /// One bit per step, set where it may be visible.
    #[inline(always)]
    fn visible_steps(&self, x0: &Lanes, x1: &Lanes) -> u32 {
        if !self.table.are_labels {
            return self.visible_bins.between(x0, x1);
        }
        let mut bits = 0;
        for m in 0..LANES {
            bits |= u32::from(self.density(x0[m])[3] + self.density(x1[m])[3] > 0.0) << m;
        }
        bits
    }

    #[inline(always)]
    fn density(&self, x: f32) -> [f32; 4] {
        self.table.density[((x * TABLE_BINS as f32) as usize).min(TABLE_BINS)]
    }

    /// Colour (not premultiplied) and optical depth of a step of length `h` between two positions.
    #[inline(always)]
    fn classify(&self, x0: f32, x1: f32, h: f32) -> (Vec3, f32) {
        if !self.table.are_labels {
            return classify_by(self.table, x0, x1, h);
        }
        let (a, b) = (self.density(x0), self.density(x1));
        let sigma = a[3] + b[3];
        if sigma <= 0.0 {
            return (Vec3::ZERO, 0.0);
        }
        (Vec3::new(a[0] + b[0], a[1] + b[1], a[2] + b[2]) / sigma, 0.5 * sigma * h)
    }
}

impl<T: Texels> Marcher<'_, T> {
    /// Marches all channels of a field together, [`LANES`] steps at once like the march of one channel.
    #[inline(always)]
    pub(super) fn march_channels(
        &self,
        (field, ray): (&MarchField<'_, T>, &VoxelRay),
        lattice: Lattice,
        run: Run,
        walk: &mut Walk,
        sink: &mut impl Sink,
    ) {
        let Lattice { s0, h, .. } = lattice;
        let Run { end, limit, pace } = run;
        let (origin, dir) = (ray.origin, ray.dir);
        let skipper = Skipper::new(field, (origin, dir), lattice, run);
        let mut positions = [[[0.0; LANES]; 2]; MAX_CHANNELS];
        while walk.i < end {
            let stride = walk.stride * pace;
            let i = skipper.skip(walk.i, stride, -1.0);
            walk.i = i;
            if i >= end {
                return;
            }
            let (mut s_front, mut s_back) = ([0.0; LANES], [0.0; LANES]);
            for m in 0..LANES {
                let front = i + stride * m as u32;
                s_front[m] = s0 + front.min(limit) as f32 * h;
                s_back[m] = s0 + (front + stride).min(limit) as f32 * h;
            }
            let mut steps = 0;
            let channels = self.channels.iter().zip(&field.channels);
            for ((channel, texels), [x0, x1]) in channels.zip(&mut positions) {
                *x1 = channel.positions(texels, origin, dir, &s_back);
                let first = channel.positions(texels, origin, dir, &[s_front[0]; LANES])[0];
                *x0 = super::behind(first, x1);
                steps |= channel.visible_steps(x0, x1);
            }
            if let Some(gaps) = &field.gaps {
                steps &= gaps.steps_without(origin, dir, &s_front, &s_back);
            }
            let num_steps = (end - i).div_ceil(stride).min(LANES as u32);
            steps &= (1 << num_steps) - 1;
            if steps != 0 {
                let light = self.light_lanes(field, ray, &s_front, &s_back);
                while steps != 0 {
                    let m = steps.trailing_zeros() as usize % LANES;
                    steps &= steps - 1;
                    let length = s_back[m] - s_front[m];
                    let parts = self.channels.iter().zip(&positions);
                    let parts = parts.map(|(channel, [x0, x1])| channel.classify(x0[m], x1[m], length));
                    let (color, tau) = blended(parts, self.scene.blend);
                    if tau <= TAU_MIN {
                        continue;
                    }
                    let alpha = opacity(tau);
                    let c = self.sent(color, alpha, self.light_of_lane(&light, ray, m));
                    let next = sink.step(Step { s0: s_front[m], s1: s_back[m], c, tau, alpha });
                    if walk.turns(next, i + stride * (m as u32 + 1), limit) {
                        return;
                    }
                }
            }
            walk.i = (i + stride * num_steps).min(limit);
        }
    }
}

/// Several channels or labels, as a const parameter of the march beside the numbers of modes.
pub(super) const MIXED: u8 = u8::MAX;

/// Colour and optical depth of the channels together.
#[inline(always)]
fn blended(parts: impl Iterator<Item = (Vec3, f32)>, blend: Blend) -> (Vec3, f32) {
    let (mut sum, mut total, mut greatest) = (Vec3::ZERO, 0.0, 0.0f32);
    for (color, tau) in parts {
        sum += color * tau;
        total += tau;
        greatest = greatest.max(tau);
    }
    let tau = if blend == Blend::Over { total } else { greatest };
    if tau > 0.0 { ((sum / tau).min(Vec3::ONE), tau) } else { (Vec3::ZERO, 0.0) }
}
