//! The whole of a volume, of which a process may hold only a part.

use std::sync::Arc;

use super::grid::{Volume, VolumeError, Voxels};
use super::histogram::Histogram;

/// A box of voxels, `first` to `end` without the end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct VoxelBox {
    /// The first voxel along x, y, z.
    pub first: [u32; 3],
    /// The voxel behind the last.
    pub end: [u32; 3],
}

impl VoxelBox {
    /// All voxels of a grid.
    pub fn of(dims: [u32; 3]) -> Self {
        Self { first: [0; 3], end: dims }
    }

    /// Voxels along x, y, z.
    pub fn dims(&self) -> [u32; 3] {
        [0, 1, 2].map(|axis| self.end[axis] - self.first[axis])
    }

    /// Number of voxels.
    pub fn count(&self) -> u64 {
        self.dims().iter().map(|&n| u64::from(n)).product()
    }

    /// The box with `voxels` more on each side, inside a grid of `dims`.
    pub fn grown(&self, voxels: u32, dims: [u32; 3]) -> Self {
        Self {
            first: self.first.map(|first| first.saturating_sub(voxels)),
            end: [0, 1, 2].map(|axis| self.end[axis].saturating_add(voxels).min(dims[axis])),
        }
    }

    /// Whether a voxel lies inside.
    pub fn contains(&self, voxel: [u32; 3]) -> bool {
        (0..3).all(|axis| (self.first[axis]..self.end[axis]).contains(&voxel[axis]))
    }
}

/// The whole that the voxels of a [`Volume`] are a part of, with everything that must be the same in all parts.
#[derive(Clone, Debug)]
pub struct Whole {
    /// Voxels of the whole along x, y, z.
    pub dims: [u32; 3],
    /// The voxel of the whole that is the part's first.
    pub first: [u32; 3],
    /// Least and greatest stored number of the whole.
    pub stored_range: (f32, f32),
    /// Histogram of the whole.
    pub histogram: Histogram,
    /// Stored numbers at [`sample_places`] of the whole, x fastest.
    pub samples: Vec<f32>,
}

impl Volume {
    /// Voxels along x, y, z of the whole volume.
    pub fn whole_dims(&self) -> [u32; 3] {
        self.whole().map_or(self.dims(), |whole| whole.dims)
    }

    /// The voxel of the whole volume that is the first one here.
    pub fn first(&self) -> [u32; 3] {
        self.whole().map_or([0; 3], |whole| whole.first)
    }

    /// The voxels of the whole volume that are here.
    pub fn held(&self) -> VoxelBox {
        let first = self.first();
        VoxelBox { first, end: [0, 1, 2].map(|axis| first[axis] + self.dims()[axis]) }
    }

    /// The stored number at the coordinates of the whole, clamped to the voxels that are here.
    pub fn stored_in_world(&self, voxel: [u32; 3]) -> f32 {
        let [x, y, z] = [0, 1, 2].map(|axis| i64::from(voxel[axis]) - i64::from(self.first()[axis]));
        self.stored_at(x as i32, y as i32, z as i32)
    }
}

impl Whole {
    /// A whole volume as seen from its part from `first` on.
    pub fn of(volume: &Volume, first: [u32; 3]) -> Self {
        let [xs, ys, zs] = volume.dims().map(sample_places);
        let rows = zs.iter().flat_map(|z| ys.iter().map(move |y| (y, z)));
        let samples = rows.flat_map(|(y, z)| xs.iter().map(move |x| volume.stored_in_world([*x, *y, *z])));
        Self {
            dims: volume.dims(),
            first,
            stored_range: volume.stored_range(),
            histogram: Histogram::of(volume),
            samples: samples.collect(),
        }
    }
}

impl Volume {
    /// The part of a whole volume in a box, with all channels.
    ///
    /// # Errors
    /// If the box does not lie inside.
    pub fn part(&self, voxels: &VoxelBox) -> Result<Self, VolumeError> {
        let dims = voxels.dims();
        let cut = |stored: &Voxels| match stored {
            Voxels::U8(v) => Voxels::U8(cut(v, self.dims(), voxels)),
            Voxels::U16(v) => Voxels::U16(cut(v, self.dims(), voxels)),
            Voxels::F32(v) => Voxels::F32(cut(v, self.dims(), voxels)),
        };
        let part = |of: &Self| {
            let part = Self::new(dims, of.spacing(), cut(of.voxels()), of.value_map(), of.info.clone())?;
            let part = match of.gaps() {
                Some(gaps) => part.with_gaps(self::cut(&gaps.bytes, of.dims(), voxels)),
                None => part,
            };
            let part = match of.finest() {
                Some(finest) => part.with_finest((**finest).clone()),
                None => part,
            };
            part.in_whole(Arc::new(Whole::of(of, voxels.first)))
        };
        let others = self.others().iter().map(|other| part(other).map(Arc::new));
        part(self)?.with_others(others.collect::<Result<_, _>>()?)
    }
}

/// The numbers of a box, of a grid of `dims`.
fn cut<T: Copy>(all: &[T], dims: [u32; 3], voxels: &VoxelBox) -> Vec<T> {
    let [nx, ny, _] = dims.map(|n| n as usize);
    let ([x, y, z], [ex, ey, ez]) = (voxels.first.map(|n| n as usize), voxels.end.map(|n| n as usize));
    let rows = (z..ez).flat_map(|z| (y..ey).map(move |y| (z * ny + y) * nx));
    rows.flat_map(|row| &all[row + x..row + ex]).copied().collect()
}

/// The voxels along an axis of a whole that are sampled: in the middle of at most `MOST_SAMPLES` equal parts.
pub fn sample_places(num_voxels: u32) -> Vec<u32> {
    let num = num_voxels.min(MOST_SAMPLES);
    (0..num).map(|i| ((2 * u64::from(i) + 1) * u64::from(num_voxels) / (2 * u64::from(num))) as u32).collect()
}

/// Samples along each axis.
const MOST_SAMPLES: u32 = 64;
