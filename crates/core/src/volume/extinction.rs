//! The mean extinction of matter in the cells of a coarse grid, for lighting.

mod surfaces;

use std::iter::StepBy;
use std::ops::Range;

use rayon::prelude::*;

use glam::Vec3;

pub use self::surfaces::{Sheet, are_lesser_bodies, area_above, has_lesser_bodies};

use super::grid::{Volume, Voxels};
use super::world::VoxelBox;
use crate::clip::Region;
use crate::space::Aabb;
use crate::transfer::TransferTable;

/// The detail of lighting.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Detail {
    /// While something is dragged: few cells, few directions, and not every voxel.
    Draft,
    /// For the final picture.
    Final,
}

impl Detail {
    /// Most cells of the grid, of four bytes each and a few more arrays. These resolve creases of two voxels in a
    /// scan of 256³. Twice as many along each axis would cost eight times the work.
    fn max_cells(self) -> f32 {
        match self {
            Self::Draft => (1 << 17) as f32,
            Self::Final => (1 << 21) as f32,
        }
    }
}

/// What attenuates light.
#[derive(Clone, Copy, Debug)]
pub enum Matter<'a> {
    /// All matter, as classified by a transfer function.
    Medium(&'a TransferTable),
    /// Surfaces in any order, and the matter behind opaque ones.
    Surfaces(&'a [Sheet]),
}

/// Mean extinction of each cell, x fastest. A cell is a block of voxels, about a cube in the world. The first begins
/// where the volume does; the last may reach beyond it into empty space.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Extinction {
    /// Cells along x, y, z.
    pub(crate) dims: [usize; 3],
    /// Voxels of a cell along x, y, z.
    pub(crate) voxels: [usize; 3],
    /// Sides of a cell, world units.
    pub(crate) cell: Vec3,
    /// Extinctions, 1/world unit.
    pub(crate) sigma: Vec<f32>,
}

/// What the voxels of a box add to the cells that it touches, x fastest. A border of boxes may run through a cell.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct CellSums {
    /// Means over whole cells of the box's extinctions, 1/world unit.
    sigma: Vec<f32>,
    /// Shares of whole cells that bodies fill; empty where there are no surfaces.
    full: Vec<f32>,
}

/// The cells that a box touches, in the grid of cells.
#[derive(Clone, Copy, Debug, PartialEq)]
struct CellBox {
    first: [usize; 3],
    dims: [usize; 3],
    /// Voxels of a cell along x, y, z.
    side: [usize; 3],
    /// The voxels that count.
    own: VoxelBox,
    /// Every so many voxels of a cell count.
    step: [usize; 3],
}

impl CellBox {
    fn of(own: &VoxelBox, side: [usize; 3], step: [usize; 3]) -> Self {
        let first = [0, 1, 2].map(|axis| own.first[axis] as usize / side[axis]);
        let end = [0, 1, 2].map(|axis| (own.end[axis] as usize).div_ceil(side[axis]));
        let dims = [0, 1, 2].map(|axis| end[axis] - first[axis]);
        Self { first, dims, side, own: *own, step }
    }

    fn count(&self) -> usize {
        self.dims.iter().product()
    }

    /// The voxels of the whole that count in the layer `cell` along an axis.
    fn voxels(&self, axis: usize, cell: usize) -> StepBy<Range<usize>> {
        let (side, step) = (self.side[axis], self.step[axis]);
        let start = (self.first[axis] + cell) * side;
        let end = (start + side).min(self.own.end[axis] as usize);
        let skipped = (self.own.first[axis] as usize).saturating_sub(start).div_ceil(step) * step;
        ((start + skipped).min(end)..end).step_by(step)
    }

    /// The share of a cell that a voxel has. A cell beyond the volume's end is as full as its part inside.
    fn share(&self) -> f32 {
        let taken = |axis: usize| self.side[axis].div_ceil(self.step[axis]) as f32;
        (taken(0) * taken(1) * taken(2)).recip()
    }
}

impl CellSums {
    /// The sums of the voxels of `own`, which `volume` has. `is_lesser` is the side of opaque surfaces that has bodies.
    pub(crate) fn of(
        volume: &Volume,
        own: &VoxelBox,
        (matter, is_lesser): (Matter<'_>, Option<bool>),
        detail: Detail,
    ) -> Self {
        let (_, side) = cells(volume, detail.max_cells());
        let step = match detail {
            Detail::Draft => side.map(|side| (side / 2).max(1)),
            Detail::Final => [1; 3],
        };
        let cells = CellBox::of(own, side, step);
        let mut found = Self { sigma: vec![0.0; cells.count()], full: Vec::new() };
        match (matter, volume.voxels()) {
            (Matter::Surfaces(sheets), _) => found.fill_surfaces(volume, &cells, sheets, is_lesser),
            (Matter::Medium(table), Voxels::U8(v)) => {
                let of = by_number(table, 1 << 8);
                found.fill(v, volume, &cells, |stored| of[usize::from(stored)]);
            }
            (Matter::Medium(table), Voxels::U16(v)) => {
                let of = by_number(table, 1 << 16);
                found.fill(v, volume, &cells, |stored| of[usize::from(stored)]);
            }
            (Matter::Medium(table), Voxels::F32(v)) => {
                found.fill(v, volume, &cells, |stored| table.extinction_of(stored));
            }
        }
        found
    }

    fn fill<T: Copy + Sync>(
        &mut self,
        voxels: &[T],
        volume: &Volume,
        cells: &CellBox,
        sigma: impl Fn(T) -> f32 + Sync,
    ) {
        let [nx, ny, _] = volume.dims().map(|d| d as usize);
        let [fx, fy, fz] = volume.first().map(|d| d as usize);
        let [cx, cy, _] = cells.dims;
        let share = cells.share();
        self.sigma.par_chunks_mut(cx * cy).enumerate().for_each(|(k, slice)| {
            for z in cells.voxels(2, k) {
                for (j, row) in slice.chunks_mut(cx).enumerate() {
                    for y in cells.voxels(1, j) {
                        let line = &voxels[((z - fz) * ny + (y - fy)) * nx..][..nx];
                        for (i, sum) in row.iter_mut().enumerate() {
                            *sum += cells.voxels(0, i).map(|x| sigma(line[x - fx])).sum::<f32>() * share;
                        }
                    }
                }
            }
        });
    }

    /// The sums as words.
    pub(crate) fn to_words(&self) -> Vec<u32> {
        self.sigma.iter().chain(&self.full).map(|sum| sum.to_bits()).collect()
    }

    /// The sums of `num` cells as they were written; `None` if these are not their words.
    fn from_words(words: &[u32], num: usize, has_full: bool) -> Option<Self> {
        let (sigma, full) = words.split_at_checked(num)?;
        let numbers = |words: &[u32]| words.iter().map(|bits| f32::from_bits(*bits)).collect();
        (full.len() == if has_full { num } else { 0 })
            .then(|| Self { sigma: numbers(sigma), full: numbers(full) })
    }
}

impl Extinction {
    /// Computes it from every voxel, or in a draft from some of each cell. There is nothing outside `region`.
    pub(crate) fn of(volume: &Volume, matter: Matter<'_>, region: &Region, detail: Detail) -> Self {
        let is_lesser = match matter {
            Matter::Surfaces(sheets) => has_lesser_bodies(sheets, volume, region),
            Matter::Medium(_) => None,
        };
        let sums = CellSums::of(volume, &VoxelBox::of(volume.dims()), (matter, is_lesser), detail);
        Self::of_sums(volume, sums, region, detail)
    }

    /// The same of a volume in parts, given the box of each and the words of its sums. `None` if one has others.
    pub(crate) fn of_parts(
        volume: &Volume,
        parts: &[(VoxelBox, &[u32])],
        has_surfaces: bool,
        region: &Region,
        detail: Detail,
    ) -> Option<Self> {
        let (dims, side) = cells(volume, detail.max_cells());
        let num: usize = dims.iter().product();
        let mut all = CellSums { sigma: vec![0.0; num], full: vec![0.0; if has_surfaces { num } else { 0 }] };
        for (own, words) in parts {
            let cells = CellBox::of(own, side, [1; 3]);
            let sums = CellSums::from_words(words, cells.count(), has_surfaces)?;
            let [cx, cy, cz] = cells.dims;
            for (row, (z, y)) in (0..cz).flat_map(|z| (0..cy).map(move |y| (z, y))).enumerate() {
                let [x0, y0, z0] = cells.first;
                let to = ((z0 + z) * dims[1] + y0 + y) * dims[0] + x0;
                let add = |all: &mut [f32], sums: &[f32]| {
                    let sums = sums.get(row * cx..(row + 1) * cx).unwrap_or_default();
                    all.iter_mut().zip(sums).for_each(|(all, sum)| *all += sum);
                };
                add(&mut all.sigma[to..to + cx], &sums.sigma);
                if has_surfaces {
                    add(&mut all.full[to..to + cx], &sums.full);
                }
            }
        }
        Some(Self::of_sums(volume, all, region, detail))
    }

    /// The extinctions, given the sums of all cells.
    fn of_sums(volume: &Volume, sums: CellSums, region: &Region, detail: Detail) -> Self {
        let (dims, voxels) = cells(volume, detail.max_cells());
        let mut found = Self { dims, voxels, cell: cell_sides(volume, voxels), sigma: sums.sigma };
        found.hide_behind_bodies(&sums.full);
        let bounds = volume.bounds();
        if region.bounds != bounds || region.normal != Vec3::ZERO || region.offset > 0.0 {
            let end = Vec3::from_array(volume.whole_dims().map(|n| n as f32));
            let grid = Aabb { min: volume.world_from_voxel(Vec3::ZERO), max: volume.world_from_voxel(end) };
            found.cut(&grid, region);
        }
        found
    }

    /// Removes matter outside a region; border cells lose a share.
    fn cut(&mut self, grid: &Aabb, region: &Region) {
        let [cx, cy, _] = self.dims;
        let (cell, first) = (self.cell, grid.min);
        self.sigma.par_iter_mut().enumerate().for_each(|(i, sigma)| {
            let corner = Vec3::new((i % cx) as f32, (i / cx % cy) as f32, (i / cx / cy) as f32);
            let low = first + corner * cell;
            // Only the part of a cell inside the grid holds anything.
            let inside = (low + cell).min(grid.max) - low;
            let overlap = (region.bounds.max.min(low + inside) - region.bounds.min.max(low)).max(Vec3::ZERO);
            let in_box = (overlap / inside).to_array().iter().product::<f32>();
            let distance = region.normal.dot(low + 0.5 * inside) - region.offset;
            // Half of the extent along the normal.
            let reach = 0.5 * (region.normal.abs() * inside).element_sum();
            let on_side = if reach > 0.0 {
                (0.5 + 0.5 * distance / reach).clamp(0.0, 1.0)
            } else {
                f32::from(distance >= 0.0)
            };
            *sigma *= in_box.min(1.0) * on_side;
        });
    }
}

/// Cells along the axes, and voxels of one: at most `max_cells`, of about equal sides.
fn cells(volume: &Volume, max_cells: f32) -> ([usize; 3], [usize; 3]) {
    let whole = volume.whole_dims();
    let size = volume.spacing() * Vec3::from_array(whole.map(|n| n as f32));
    let least = volume.spacing().min_element();
    // A product of three sides could underflow in single precision, but not relative to the least spacing.
    let relative = size / least;
    let mut side = (relative.x * relative.y * relative.z / max_cells).cbrt().max(1.0);
    loop {
        let voxels: [usize; 3] =
            std::array::from_fn(|i| (side * least / volume.spacing()[i]).round().max(1.0) as usize);
        let dims: [usize; 3] = std::array::from_fn(|i| (whole[i] as usize).div_ceil(voxels[i]));
        if dims.iter().product::<usize>() as f32 <= max_cells {
            return (dims, voxels);
        }
        side *= 1.05;
    }
}

fn cell_sides(volume: &Volume, voxels: [usize; 3]) -> Vec3 {
    volume.spacing() * Vec3::from_array(voxels.map(|n| n as f32))
}

/// Extinctions of the numbers from 0 on.
fn by_number(table: &TransferTable, count: usize) -> Vec<f32> {
    (0..count).map(|stored| table.extinction_of(stored as f32)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clip::{Clip, Plane};
    use crate::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
    use crate::volume::Histogram;

    #[test]
    fn a_cut_beside_the_volume_takes_nothing() {
        // Cells of two voxels, the last of one.
        let voxels = Voxels::U8(vec![200; 71 * 71 * 71]);
        let volume = Volume::new([71; 3], Vec3::ONE, voxels, (1.0, 0.0), Default::default()).unwrap();
        let point = |x| ControlPoint { x, color: [1.0; 3], opacity: 0.5 };
        let transfer = TransferFunction {
            name: "even".into(),
            domain: Domain::Values(0.0, 255.0),
            unit_length: UnitLength::Voxel,
            points: vec![point(0.0), point(1.0)],
        };
        let table = transfer.table(&volume, &Histogram::of(&volume));
        let of = |d: f32| {
            let clip = Clip { plane: Plane::new(Vec3::new(0.3, 1.0, 0.2), d), bounds: None };
            Extinction::of(&volume, Matter::Medium(&table), &clip.region(&volume.bounds()), Detail::Draft)
        };
        let whole = Clip::default().region(&volume.bounds());
        let whole = Extinction::of(&volume, Matter::Medium(&table), &whole, Detail::Draft);
        assert_eq!((whole.dims, whole.voxels), ([36; 3], [2; 3]));
        assert_eq!(of(-1000.0), whole);
        // Negative control.
        assert_ne!(of(30.0), whole);
    }
}
