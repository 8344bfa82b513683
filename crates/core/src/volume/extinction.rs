//! The mean extinction of matter in the cells of a coarse grid, for lighting.

mod surfaces;

use rayon::prelude::*;

use glam::Vec3;

pub use self::surfaces::{Sheet, are_lesser_bodies, area_above, has_lesser_bodies};

use super::grid::{Volume, Voxels};
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

impl Extinction {
    /// Computes it from every voxel, or in a draft from some of each cell. There is nothing outside `region`.
    pub(crate) fn of(volume: &Volume, matter: Matter<'_>, region: &Region, detail: Detail) -> Self {
        let (dims, voxels) = cells(volume, detail.max_cells());
        let step = match detail {
            Detail::Draft => voxels.map(|side| (side / 2).max(1)),
            Detail::Final => [1; 3],
        };
        let mut found =
            Self { dims, voxels, cell: cell_sides(volume, voxels), sigma: vec![0.0; dims.iter().product()] };
        match (matter, volume.voxels()) {
            (Matter::Surfaces(sheets), _) => found.fill_surfaces(volume, step, sheets, region),
            (Matter::Medium(table), Voxels::U8(v)) => {
                let of = by_number(table, 1 << 8);
                found.fill(v, volume, step, |stored| of[usize::from(stored)]);
            }
            (Matter::Medium(table), Voxels::U16(v)) => {
                let of = by_number(table, 1 << 16);
                found.fill(v, volume, step, |stored| of[usize::from(stored)]);
            }
            (Matter::Medium(table), Voxels::F32(v)) => {
                found.fill(v, volume, step, |stored| table.extinction_of(stored));
            }
        }
        let bounds = volume.bounds();
        if region.bounds != bounds || region.normal != Vec3::ZERO || region.offset > 0.0 {
            let grid = Aabb {
                min: volume.world_from_voxel(Vec3::ZERO),
                max: volume.world_from_voxel(volume.dims_f32()),
            };
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

    fn fill<T: Copy + Sync>(
        &mut self,
        voxels: &[T],
        volume: &Volume,
        step: [usize; 3],
        sigma: impl Fn(T) -> f32 + Sync,
    ) {
        let [nx, ny, nz] = volume.dims().map(|d| d as usize);
        let [cx, cy, _] = self.dims;
        let side = self.voxels;
        // A cell beyond the volume's end is as full as its part inside.
        let taken = |axis: usize| side[axis].div_ceil(step[axis]) as f32;
        let share = (taken(0) * taken(1) * taken(2)).recip();
        self.sigma.par_chunks_mut(cx * cy).enumerate().for_each(|(k, slice)| {
            for z in (k * side[2]..((k + 1) * side[2]).min(nz)).step_by(step[2]) {
                for (j, row) in slice.chunks_mut(cx).enumerate() {
                    for y in (j * side[1]..((j + 1) * side[1]).min(ny)).step_by(step[1]) {
                        let line = &voxels[(z * ny + y) * nx..][..nx];
                        for (sum, block) in row.iter_mut().zip(line.chunks(side[0])) {
                            *sum += block.iter().step_by(step[0]).map(|&v| sigma(v)).sum::<f32>() * share;
                        }
                    }
                }
            }
        });
    }
}

/// Cells along the axes, and voxels of one: at most `max_cells`, of about equal sides.
fn cells(volume: &Volume, max_cells: f32) -> ([usize; 3], [usize; 3]) {
    let size = volume.spacing() * volume.dims_f32();
    let least = volume.spacing().min_element();
    // A product of three sides could underflow in single precision, but not relative to the least spacing.
    let relative = size / least;
    let mut side = (relative.x * relative.y * relative.z / max_cells).cbrt().max(1.0);
    loop {
        let voxels: [usize; 3] =
            std::array::from_fn(|i| (side * least / volume.spacing()[i]).round().max(1.0) as usize);
        let dims: [usize; 3] = std::array::from_fn(|i| (volume.dims()[i] as usize).div_ceil(voxels[i]));
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
