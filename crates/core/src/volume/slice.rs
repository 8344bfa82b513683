//! Slices: the values of a volume on a plane, or what a slab about the plane holds.
//!
//! A slice across an axis has the voxels themselves. An oblique one has trilinear values between voxel centres, or the
//! nearest labels. A slab has the mean, the greatest or the least of several such slices.

use glam::Vec3;
use serde::{Deserialize, Serialize};

use super::grid::{Volume, Voxels};
use crate::space::MAX_COORDINATE;

/// What a slab shows of the values across it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SlabMode {
    /// The mean value.
    #[default]
    Mean,
    /// The greatest value.
    Max,
    /// The least value.
    Min,
}

/// Where a slice lies.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum SlicePlane {
    /// All voxels with one index along an axis. Columns and rows run along the other two axes, in their order.
    Axis {
        /// The axis: 0, 1 or 2.
        axis: u8,
        /// The index along it. A larger index than the last means the last.
        index: u32,
    },
    /// A grid of points.
    Oblique {
        /// The point of the first column and row, world space.
        origin: [f32; 3],
        /// The step to the next column, world space.
        column: [f32; 3],
        /// The step to the next row, world space.
        row: [f32; 3],
        /// Columns and rows, 1 to [`MAX_SLICE_SIDE`].
        size: [u16; 2],
    },
}

/// A slice of a volume.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SliceSpec {
    /// Where it lies.
    pub plane: SlicePlane,
    /// Thickness of the slab, world units. 0 is the plane alone.
    pub thickness: f32,
    /// What the slab shows.
    pub mode: SlabMode,
}

/// The points of a slice, world space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SliceGrid {
    /// The point of the first column and row.
    pub origin: Vec3,
    /// The step to the next column.
    pub column: Vec3,
    /// The step to the next row.
    pub row: Vec3,
    /// Columns and rows.
    pub size: [u32; 2],
}

impl SliceGrid {
    /// The point at a column and row, which may lie between those of the grid.
    pub fn point(&self, column: f32, row: f32) -> Vec3 {
        self.origin + self.column * column + self.row * row
    }

    /// The column and row of a point of the plane.
    pub fn place(&self, point: Vec3) -> [f32; 2] {
        let from = point - self.origin;
        [self.column, self.row].map(|step| from.dot(step) / step.length_squared())
    }
}

impl SliceSpec {
    /// Whether the numbers describe a slice that can be made of any volume.
    pub fn is_valid(&self) -> bool {
        let is_plane = match self.plane {
            SlicePlane::Axis { axis, .. } => axis < 3,
            SlicePlane::Oblique { origin, column, row, size } => {
                let side = |s: u16| (1..=MAX_SLICE_SIDE).contains(&u32::from(s));
                let is_step = |v: [f32; 3]| {
                    let length = Vec3::from_array(v).length_squared();
                    length.is_finite() && length > 0.0
                };
                let is_near = origin.iter().all(|x| x.abs() <= MAX_COORDINATE);
                size.into_iter().all(side) && is_step(column) && is_step(row) && is_near
            }
        };
        is_plane && (0.0..=MAX_COORDINATE).contains(&self.thickness)
    }

    /// The points of the slice in a volume of this size.
    pub fn grid(&self, dims: [u32; 3], spacing: Vec3) -> SliceGrid {
        match self.plane {
            SlicePlane::Axis { axis, index } => {
                let axis = usize::from(axis.min(2));
                let index = index.min(dims[axis] - 1);
                let center = |i: usize, at: u32| (at as f32 + 0.5 - dims[i] as f32 * 0.5) * spacing[i];
                let mut origin = Vec3::from_array(std::array::from_fn(|i| center(i, 0)));
                origin[axis] = center(axis, index);
                // Of longer sides, every second or third voxel has a point.
                let every = |i: usize| dims[i].div_ceil(MAX_SLICE_SIDE);
                let step = |i: usize| Vec3::AXES[i] * (spacing[i] * every(i) as f32);
                let [a, b] = across(axis);
                let size = [a, b].map(|i| dims[i].div_ceil(every(i)));
                SliceGrid { origin, column: step(a), row: step(b), size }
            }
            SlicePlane::Oblique { origin, column, row, size } => SliceGrid {
                origin: origin.into(),
                column: column.into(),
                row: row.into(),
                size: size.map(u32::from),
            },
        }
    }

    /// The indices of the voxels across an axis that a slab holds.
    pub(super) fn slab(&self, index: u32, num: u32, spacing: f32) -> std::ops::Range<usize> {
        let index = i64::from(index.min(num - 1));
        let voxels = ((self.thickness / spacing).round() as i64).clamp(1, i64::from(num));
        let first = index - (voxels - 1) / 2;
        first.max(0) as usize..(first + voxels).min(i64::from(num)) as usize
    }
}

/// The values of a slice, as codes of 8 or 16 bits. A code means the value `lo + code·step`.
#[derive(Clone, Debug, PartialEq)]
pub struct Slice {
    /// Columns and rows, 1 to [`MAX_SLICE_SIDE`].
    pub size: [u32; 2],
    /// The value of code 0.
    pub lo: f32,
    /// The difference of two neighbouring codes.
    pub step: f32,
    /// The codes, row by row.
    pub codes: SliceCodes,
}

/// The codes of a slice.
#[derive(Clone, Debug, PartialEq)]
pub enum SliceCodes {
    /// Eight bits.
    U8(Vec<u8>),
    /// Sixteen bits.
    U16(Vec<u16>),
}

impl Slice {
    /// The value at a column and row inside the slice.
    pub fn value(&self, column: u32, row: u32) -> f32 {
        let at = row as usize * self.size[0] as usize + column as usize;
        let code = match &self.codes {
            SliceCodes::U8(codes) => f32::from(codes[at]),
            SliceCodes::U16(codes) => f32::from(codes[at]),
        };
        self.value_from_code(code)
    }

    /// The value of a code.
    pub fn value_from_code(&self, code: f32) -> f32 {
        code * self.step + self.lo
    }

    /// Memory of the codes, bytes.
    pub fn num_bytes(&self) -> usize {
        match &self.codes {
            SliceCodes::U8(codes) => codes.len(),
            SliceCodes::U16(codes) => 2 * codes.len(),
        }
    }
}

/// How stored numbers become codes.
pub(super) struct SliceCoding {
    /// The number of code 0, and codes of a step of 1.
    lo: f32,
    scale: f32,
    is_byte: bool,
}

impl SliceCoding {
    /// The codes of a slice of `volume` with numbers of a range.
    pub(super) fn of(volume: &Volume, spec: &SliceSpec, (lo, hi): (f32, f32)) -> Self {
        let (dims, spacing) = (volume.finest_dims(), volume.finest_spacing());
        let is_whole = matches!(spec.plane, SlicePlane::Axis { .. }) && spec.mode != SlabMode::Mean;
        let is_thin = matches!(&spec.plane, SlicePlane::Axis { axis, index } if {
            let axis = usize::from((*axis).min(2));
            spec.slab(*index, dims[axis], spacing[axis]).len() == 1
        });
        let (lo, scale, is_byte) = match volume.voxels() {
            Voxels::U8(_) if is_whole || is_thin => (0.0, 1.0, true),
            Voxels::U8(_) => (0.0, 257.0, false),
            Voxels::U16(_) => (0.0, 1.0, false),
            Voxels::F32(_) => (lo, if hi > lo { 65535.0 / (hi - lo) } else { 1.0 }, false),
        };
        Self { lo, scale, is_byte }
    }

    pub(super) fn slice(&self, volume: &Volume, size: [u32; 2], stored: &[f64]) -> Slice {
        let Self { lo, scale, is_byte } = *self;
        let code = |stored: f64| ((stored - f64::from(lo)) * f64::from(scale)).round();
        let codes = match is_byte {
            true => SliceCodes::U8(stored.iter().map(|v| code(*v) as u8).collect()),
            false => SliceCodes::U16(stored.iter().map(|v| code(*v) as u16).collect()),
        };
        let (value_scale, _) = volume.value_map();
        Slice { size, lo: volume.value_from_stored(lo), step: value_scale / scale, codes }
    }
}

/// The axes of columns and rows of a slice across an axis.
pub(super) fn across(axis: usize) -> [usize; 2] {
    [[1, 2], [0, 2], [0, 1]][axis]
}

/// Most columns or rows of a slice: those of the largest volume.
pub const MAX_SLICE_SIDE: u32 = Volume::MAX_SIDE;
/// Most layers that an oblique slab is made of.
pub(super) const MAX_LAYERS: f32 = 1024.0;
#[cfg(test)]
mod tests {
    use super::*;
    use crate::cancel::ALWAYS;
    use crate::volume::VolumeInfo;

    fn volume(voxels: Voxels, map: (f32, f32)) -> Volume {
        Volume::new([5, 4, 3], Vec3::new(1.0, 0.5, 2.0), voxels, map, VolumeInfo::default()).unwrap()
    }

    fn axis(axis: u8, index: u32, thickness: f32, mode: SlabMode) -> SliceSpec {
        SliceSpec { plane: SlicePlane::Axis { axis, index }, thickness, mode }
    }

    /// Voxels with every stored number once, in no order.
    fn bytes() -> Vec<u8> {
        (0..60u32).map(|i| (i * 37 % 251) as u8).collect()
    }

    #[test]
    fn a_slice_across_an_axis_has_the_voxels_themselves() {
        let shorts = bytes().iter().map(|v| u16::from(*v) * 200).collect();
        let floats = bytes().iter().map(|v| f32::from(*v) * 0.3 - 7.0).collect();
        for (voxels, least) in [
            (Voxels::U8(bytes()), 0.0),
            (Voxels::U16(shorts), 0.0),
            // Half a step of 65535 in a range of 75.
            (Voxels::F32(floats), 7e-4),
        ] {
            let v = volume(voxels, (2.5, -1000.0));
            for a in 0..3u8 {
                for index in 0..v.dims()[usize::from(a)] {
                    let spec = axis(a, index, 0.0, SlabMode::Mean);
                    let slice = Slice::of(&v, &spec, ALWAYS).unwrap();
                    let [c, r] = across(usize::from(a));
                    assert_eq!(slice.size, [v.dims()[c], v.dims()[r]]);
                    let grid = spec.grid(v.dims(), v.spacing());
                    for (x, y) in (0..slice.size[0]).flat_map(|x| (0..slice.size[1]).map(move |y| (x, y))) {
                        let mut at = [0; 3];
                        (at[usize::from(a)], at[c], at[r]) = (index as i32, x as i32, y as i32);
                        let value = v.value_from_stored(v.stored_at(at[0], at[1], at[2]));
                        assert!((slice.value(x, y) - value).abs() <= least * 2.5, "{a} {index} {x} {y}");
                        // The point of the grid is the middle of that voxel.
                        let voxel = (grid.point(x as f32, y as f32) - v.bounds().min) / v.spacing() - 0.5;
                        let expected = Vec3::from_array(at.map(|i| i as f32));
                        assert!((voxel - expected).length() < 1e-4, "{voxel} {expected}");
                        let [column, row] = grid.place(grid.point(x as f32, y as f32));
                        assert!((column - x as f32).abs() < 1e-4 && (row - y as f32).abs() < 1e-4);
                    }
                    // The control: another slice has other voxels.
                    let other = Slice::of(&v, &axis(a, index + 1, 0.0, SlabMode::Mean), ALWAYS).unwrap();
                    assert_eq!(other == slice, index + 1 == v.dims()[usize::from(a)]);
                }
            }
        }
    }

    #[test]
    fn a_slab_has_the_mean_the_greatest_and_the_least_of_its_voxels() {
        let v = volume(Voxels::U8(bytes()), (1.0, 0.0));
        // y: three voxels of half a unit about the second.
        let made = |mode| Slice::of(&v, &axis(1, 1, 1.5, mode), ALWAYS).unwrap();
        let [mean, most, least] = [SlabMode::Mean, SlabMode::Max, SlabMode::Min].map(made);
        for (x, z) in (0..5u32).flat_map(|x| (0..3u32).map(move |z| (x, z))) {
            let all = [0, 1, 2].map(|y| v.stored_at(x as i32, y, z as i32));
            assert!((mean.value(x, z) - all.iter().sum::<f32>() / 3.0).abs() < 0.5 / 257.0 + 1e-4);
            assert_eq!(most.value(x, z), all.into_iter().fold(0.0, f32::max));
            assert_eq!(least.value(x, z), all.into_iter().fold(255.0, f32::min));
        }
        assert!(matches!(most.codes, SliceCodes::U8(_)) && matches!(mean.codes, SliceCodes::U16(_)));
        // At the end of the volume the slab ends with it, and a slab may hold everything.
        assert_eq!(axis(2, 0, 4.0, SlabMode::Max).slab(0, 3, 2.0), 0..2);
        assert_eq!(axis(2, 9, 4.0, SlabMode::Max).slab(9, 3, 2.0), 2..3);
        assert_eq!(axis(2, 1, 1e9, SlabMode::Max).slab(1, 3, 2.0), 0..3);
    }

    #[test]
    fn oblique_slices_of_a_ramp_are_the_ramp() {
        // Stored numbers grow linearly in all three directions.
        let spacing = Vec3::new(1.0, 0.5, 2.0);
        let dims = [24, 40, 12];
        let slope = Vec3::new(100.0, -40.0, 130.0);
        let value = |p: Vec3| 5000.0 + slope.dot(p);
        let center = |i: u32, axis: usize| (i as f32 + 0.5 - dims[axis] as f32 * 0.5) * spacing[axis];
        let voxels = (0..dims[0] * dims[1] * dims[2]).map(|i| {
            let at = [i % dims[0], i / dims[0] % dims[1], i / dims[0] / dims[1]];
            value(Vec3::new(center(at[0], 0), center(at[1], 1), center(at[2], 2)))
        });
        let voxels = Voxels::F32(voxels.collect());
        let v = Volume::new(dims, spacing, voxels, (1.0, 0.0), VolumeInfo::default()).unwrap();
        let column = Vec3::new(0.4, 0.2, 0.1);
        let row = column.cross(Vec3::new(0.3, -1.0, 0.4)).normalize() * 0.3;
        let (origin, size) = (-column * 15.0 - row * 15.0 + 0.2, [31u16, 31]);
        let plane =
            SlicePlane::Oblique { origin: origin.into(), column: column.into(), row: row.into(), size };
        let normal = column.cross(row).normalize();
        let (lo, hi) = v.stored_range();
        let tolerance = (hi - lo) / 65535.0 + 0.05;
        for (thickness, mode, shift) in [
            (0.0, SlabMode::Mean, 0.0),
            (3.0, SlabMode::Mean, 0.0),
            // Six layers of half a unit: the outermost lie 1.25 from the middle.
            (3.0, SlabMode::Max, 1.25 * slope.dot(normal).abs()),
            (3.0, SlabMode::Min, -1.25 * slope.dot(normal).abs()),
        ] {
            let spec = SliceSpec { plane, thickness, mode };
            assert!(spec.is_valid());
            let (slice, grid) = (Slice::of(&v, &spec, ALWAYS).unwrap(), spec.grid(dims, spacing));
            for (x, y) in (0..31).flat_map(|x| (0..31).map(move |y| (x, y))) {
                let wanted = value(grid.point(x as f32, y as f32)) + shift;
                let found = slice.value(x, y);
                assert!((found - wanted).abs() < tolerance, "{mode:?} {x} {y}: {found} {wanted}");
            }
        }
        // The control: a slab's greatest is not its middle.
        assert!(slope.dot(normal).abs() > 10.0);
    }

    #[test]
    fn outside_there_is_the_least_number_and_given_up_work_ends() {
        let v = volume(Voxels::U16((100..160).collect()), (1.0, 0.0));
        let far = SlicePlane::Oblique {
            origin: [50.0; 3],
            column: [1.0, 0.0, 0.0],
            row: [0.0, 1.0, 0.0],
            size: [3, 2],
        };
        let spec = SliceSpec { plane: far, thickness: 4.0, mode: SlabMode::Mean };
        let slice = Slice::of(&v, &spec, ALWAYS).unwrap();
        assert_eq!(slice.codes, SliceCodes::U16(vec![100; 6]), "the least stored number");
        assert_eq!(Slice::of(&v, &spec, &|| false), None);
    }

    #[test]
    fn absurd_planes_are_refused() {
        let good = axis(2, u32::MAX, 0.0, SlabMode::Mean);
        assert!(good.is_valid());
        assert!(!axis(3, 0, 0.0, SlabMode::Mean).is_valid());
        for thickness in [-1.0, f32::NAN, f32::INFINITY] {
            assert!(!SliceSpec { thickness, ..good }.is_valid());
        }
        let oblique = |origin: f32, step: f32, side: u16| {
            let plane = SlicePlane::Oblique {
                origin: [origin; 3],
                column: [step, 0.0, 0.0],
                row: [0.0, step, 0.0],
                size: [side, 1],
            };
            SliceSpec { plane, ..good }.is_valid()
        };
        assert!(oblique(0.0, 1.0, 2048));
        for bad in [
            oblique(0.0, 1.0, 2049),
            oblique(0.0, 1.0, 0),
            oblique(f32::NAN, 1.0, 1),
            oblique(f32::INFINITY, 1.0, 1),
            oblique(0.0, 0.0, 1),
            oblique(0.0, 1e30, 1),
        ] {
            assert!(!bad);
        }
    }
}
