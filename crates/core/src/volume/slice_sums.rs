//! What the voxels of a volume, or of a part of one, add to each point of a slice. The sums of all parts are those of the
//! whole, to the bit: each value belongs to the part whose box has its first voxel, and means are sums without rounding.

use glam::Vec3;
use rayon::prelude::*;

use super::grid::{Volume, Voxels};
use super::slice::{
    MAX_LAYERS, MAX_SLICE_SIDE, SlabMode, Slice, SliceCoding, SliceGrid, SlicePlane, SliceSpec, across,
};
use super::world::VoxelBox;
use crate::cancel::Wanted;

impl Slice {
    /// Makes a slice of a volume; `None` if nobody waits for it any more. Points outside the volume have the least
    /// stored number.
    ///
    /// A level of a pyramid is cut as the finest level would be, by values between its voxels. Of a part of a volume,
    /// the voxels that are not there have the least stored number.
    ///
    /// Codes of 8-bit and 16-bit voxels are the stored numbers. Means and oblique values of 8-bit voxels have 16 bits.
    /// Floats are rounded to 65535 steps of their range.
    pub fn of(volume: &Volume, spec: &SliceSpec, wanted: Wanted<'_>) -> Option<Self> {
        let sums = SliceSums::of(volume, &volume.held(), spec, wanted)?;
        Some(sums.slice(volume, spec))
    }
}

/// What is known of each point of a slice, row by row.
#[derive(Clone, Debug, PartialEq)]
pub struct SliceSums {
    size: [u32; 2],
    /// The sum, or the greatest or least of the stored numbers.
    values: Vec<f64>,
    /// Of how many.
    nums: Vec<u32>,
}

impl SliceSums {
    /// Sums of nothing, for the slice of a volume.
    pub fn nothing(volume: &Volume, spec: &SliceSpec) -> Self {
        let size = spec.grid(volume.finest_dims(), volume.finest_spacing()).size;
        let num = size[0] as usize * size[1] as usize;
        Self { size, values: vec![0.0; num], nums: vec![0; num] }
    }

    /// The sums of the values whose first voxel lies in the box `own` of the whole volume. `None` if nobody waits for
    /// them any more.
    pub fn of(volume: &Volume, own: &VoxelBox, spec: &SliceSpec, wanted: Wanted<'_>) -> Option<Self> {
        let mut sums = Self::nothing(volume, spec);
        match volume.voxels() {
            Voxels::U8(v) => sums.fill(volume, v, own, spec, wanted),
            Voxels::U16(v) => sums.fill(volume, v, own, spec, wanted),
            Voxels::F32(v) => sums.fill(volume, v, own, spec, wanted),
        }
        wanted().then_some(sums)
    }

    /// Columns and rows.
    pub fn size(&self) -> [u32; 2] {
        self.size
    }

    /// The sum at a point, and the number of its values.
    pub fn at(&self, column: u32, row: u32) -> (f64, u32) {
        let at = self.place(column, row);
        (self.values[at], self.nums[at])
    }

    /// Adds the sum of another part at a point.
    pub fn add(&mut self, (column, row): (u32, u32), (value, num): (f64, u32), mode: SlabMode) {
        let at = self.place(column, row);
        if num > 0 {
            let sum = &mut self.values[at];
            *sum = mode.together(*sum, value, self.nums[at]);
            self.nums[at] = self.nums[at].saturating_add(num);
        }
    }

    /// The slice that the sums of all parts are of.
    pub fn slice(mut self, volume: &Volume, spec: &SliceSpec) -> Slice {
        let least = f64::from(volume.stored_range().0);
        for (value, num) in self.values.iter_mut().zip(&self.nums) {
            *value = spec.mode.ended(*value, *num).unwrap_or(least);
        }
        SliceCoding::of(volume, spec, volume.stored_range()).slice(volume, self.size, &self.values)
    }

    fn place(&self, column: u32, row: u32) -> usize {
        row as usize * self.size[0] as usize + column as usize
    }

    fn fill<T: Copy + Into<f64> + Sync>(
        &mut self,
        volume: &Volume,
        voxels: &[T],
        own: &VoxelBox,
        spec: &SliceSpec,
        wanted: Wanted<'_>,
    ) {
        let (dims, spacing) = (volume.finest_dims(), volume.finest_spacing());
        let grid = spec.grid(dims, spacing);
        let width = grid.size[0] as usize;
        let adder = SlabAdder::of(volume, spec.mode);
        let rows = self.values.par_chunks_mut(width).zip(self.nums.par_chunks_mut(width)).enumerate();
        match spec.plane {
            SlicePlane::Axis { axis, index } if volume.finest().is_some() => {
                let along = usize::from(axis.min(2));
                let layer = |k: usize| {
                    let plane = SlicePlane::Axis { axis, index: k as u32 };
                    SliceSpec { plane, ..*spec }.grid(dims, spacing)
                };
                let layers: Vec<SliceGrid> =
                    spec.slab(index, dims[along], spacing[along]).map(layer).collect();
                rows.for_each(|(y, (sums, nums))| {
                    if !wanted() {
                        return;
                    }
                    for (x, (sum, num)) in sums.iter_mut().zip(nums).enumerate() {
                        for layer in &layers {
                            let point = layer.point(x as f32, y as f32);
                            if let Some(stored) = trilinear(volume, voxels, own, point) {
                                adder.add(sum, num, stored);
                            }
                        }
                    }
                });
            }
            SlicePlane::Axis { axis, index } => {
                let axis = usize::from(axis.min(2));
                let slab = spec.slab(index, dims[axis], spacing[axis]);
                let slab = slab.start.max(own.first[axis] as usize)..slab.end.min(own.end[axis] as usize);
                let (here, first) = (volume.dims(), volume.first().map(|n| n as usize));
                let pitch = [1, here[0] as usize, here[0] as usize * here[1] as usize];
                let [a, b] = across(axis);
                let every = [a, b].map(|i| dims[i].div_ceil(MAX_SLICE_SIDE));
                let inside = |i: usize, every: u32| {
                    own.first[i].div_ceil(every) as usize..own.end[i].div_ceil(every) as usize
                };
                let (columns, own_rows) = (inside(a, every[0]), inside(b, every[1]));
                let every = every.map(|n| n as usize);
                rows.filter(|(y, _)| own_rows.contains(y)).for_each(|(y, (sums, nums))| {
                    for k in slab.clone() {
                        if !wanted() {
                            return;
                        }
                        let start = (k - first[axis]) * pitch[axis] + (y * every[1] - first[b]) * pitch[b];
                        for x in columns.clone() {
                            let voxel = voxels[start + (x * every[0] - first[a]) * pitch[a]];
                            adder.add(&mut sums[x], &mut nums[x], voxel.into());
                        }
                    }
                });
            }
            SlicePlane::Oblique { .. } => {
                // A thicker slab has no more of the volume.
                let thickness = spec.thickness.min(2.0 * volume.bounds().radius());
                let finest = volume.spacing().min_element();
                let layers = (thickness / finest).round().clamp(1.0, MAX_LAYERS) as usize;
                let normal = grid.column.cross(grid.row).normalize_or_zero();
                let aside = |n: usize| ((n as f32 + 0.5) / layers as f32 - 0.5) * thickness;
                rows.for_each(|(y, (sums, nums))| {
                    if !wanted() {
                        return;
                    }
                    for (x, (sum, num)) in sums.iter_mut().zip(nums).enumerate() {
                        let middle = grid.point(x as f32, y as f32);
                        for n in 0..layers {
                            let point = middle + normal * aside(n);
                            if let Some(stored) = trilinear(volume, voxels, own, point) {
                                adder.add(sum, num, stored);
                            }
                        }
                    }
                });
            }
        }
    }
}

impl SlabMode {
    /// Two sums as one, where `num` values are in the first.
    fn together(self, sum: f64, value: f64, num: u32) -> f64 {
        match self {
            _ if num == 0 => value,
            Self::Mean => sum + value,
            Self::Max => sum.max(value),
            Self::Min => sum.min(value),
        }
    }

    /// What a slab shows of the sum of `num` values; `None` of none.
    pub(super) fn ended(self, sum: f64, num: u32) -> Option<f64> {
        match self {
            _ if num == 0 => None,
            Self::Mean => Some(sum / f64::from(num)),
            Self::Max | Self::Min => Some(sum),
        }
    }
}

/// Adds values of a slab in any order, with the same result to the bit.
#[derive(Clone, Copy, Debug)]
pub(super) struct SlabAdder {
    mode: SlabMode,
    /// Adding this to a value and taking it off again rounds it, so that sums of many such values are not rounded.
    round: f64,
}

impl SlabAdder {
    /// Adds stored numbers of a volume.
    pub(super) fn of(volume: &Volume, mode: SlabMode) -> Self {
        let (lo, hi) = match volume.voxels() {
            Voxels::U8(_) => (0.0, 255.0),
            Voxels::U16(_) => (0.0, 65535.0),
            Voxels::F32(_) => volume.stored_range(),
        };
        // The power of two below the greatest number has no mantissa.
        let power = f64::from_bits(f64::from(lo.abs().max(hi.abs())).to_bits() >> 52 << 52);
        Self { mode, round: 1.5 * ROUND * power }
    }

    /// Adds a value to the sum of `num`.
    #[inline]
    pub(super) fn add(&self, sum: &mut f64, num: &mut u32, value: f64) {
        let value = if self.mode == SlabMode::Mean { value + self.round - self.round } else { value };
        *sum = self.mode.together(*sum, value, *num);
        *num += 1;
    }
}

/// The stored number between voxel centres, or that of the nearest if it is a label; beyond the outermost centres that of
/// the nearest. None outside the volume, and where the first voxel is not in the box `own` or a part of a volume has no
/// voxels.
fn trilinear<T: Copy + Into<f64>>(volume: &Volume, voxels: &[T], own: &VoxelBox, point: Vec3) -> Option<f64> {
    let (dims, spacing, bounds) = (volume.dims(), volume.spacing(), volume.bounds());
    // A point on a face may be rounded to the outside.
    let slack = spacing * 1e-3;
    if !(point.cmpge(bounds.min - slack).all() && point.cmple(bounds.max + slack).all()) {
        return None;
    }
    let at = point / spacing + volume.voxel_origin() - 0.5;
    let mut low = [0usize; 3];
    let mut high = [0usize; 3];
    let mut share = [0f64; 3];
    let (first, whole) = (volume.first(), volume.whole_dims());
    for i in 0..3 {
        let last = dims[i] - 1;
        // A whole number less is no rounding: parts have the same shares as the whole.
        let x = at[i].clamp(0.0, (whole[i] - 1) as f32) - first[i] as f32;
        if !(0.0..=last as f32).contains(&x) {
            return None;
        }
        low[i] = x as usize;
        high[i] = (low[i] + 1).min(last as usize);
        share[i] = f64::from(x) - low[i] as f64;
        // Between two labels there is no third one.
        share[i] = if volume.info.are_labels { share[i].round() } else { share[i] };
    }
    if !own.contains([0, 1, 2].map(|i| first[i] + low[i] as u32)) {
        return None;
    }
    let [nx, ny, _] = dims.map(|n| n as usize);
    let voxel = |x: usize, y: usize, z: usize| -> f64 { voxels[(z * ny + y) * nx + x].into() };
    let mix = |a: f64, b: f64, t: f64| a + (b - a) * t;
    let along = |y: usize, z: usize| mix(voxel(low[0], y, z), voxel(high[0], y, z), share[0]);
    let face = |z: usize| mix(along(low[1], z), along(high[1], z), share[1]);
    Some(mix(face(low[2]), face(high[2]), share[2]))
}

impl Volume {
    /// The value at a point of world space, mixed from the eight voxels around it; none outside the volume.
    pub fn value_between(&self, point: Vec3) -> Option<f32> {
        self.value_between_in(&self.held(), point)
    }

    /// The same, but none where the first of these voxels is not in the box `own`.
    pub(super) fn value_between_in(&self, own: &VoxelBox, point: Vec3) -> Option<f32> {
        let stored = match self.voxels() {
            Voxels::U8(v) => trilinear(self, v, own, point),
            Voxels::U16(v) => trilinear(self, v, own, point),
            Voxels::F32(v) => trilinear(self, v, own, point),
        }?;
        Some(self.value_from_stored(stored as f32))
    }
}

/// With 2^17 times the power of two of the greatest number, values keep 2^-36 of it. 2048 of them take eleven bits more.
const ROUND: f64 = 131_072.0;
