//! A scalar volume on a regular grid.

use std::sync::Arc;

use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::gaps::{self, VoxelGaps};
use super::pyramid::{Finest, Paging, VoxelKind};
use super::world::Whole;
pub use crate::channels::MAX_CHANNELS;
use crate::space::Aabb;

/// The stored voxels, x fastest. Other types are converted on reading: signed integers by an offset, wider ones and
/// doubles to `f32`.
#[derive(Clone, Debug, PartialEq)]
pub enum Voxels {
    /// Eight bits unsigned.
    U8(Vec<u8>),
    /// Sixteen bits unsigned.
    U16(Vec<u16>),
    /// Single-precision floats, all finite.
    F32(Vec<f32>),
}

impl Voxels {
    /// The type of the stored numbers.
    pub fn kind(&self) -> VoxelKind {
        match self {
            Self::U8(_) => VoxelKind::U8,
            Self::U16(_) => VoxelKind::U16,
            Self::F32(_) => VoxelKind::F32,
        }
    }

    /// Number of voxels.
    pub fn len(&self) -> usize {
        match self {
            Self::U8(v) => v.len(),
            Self::U16(v) => v.len(),
            Self::F32(v) => v.len(),
        }
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Bytes of one voxel as stored.
    pub fn bytes_per_voxel(&self) -> usize {
        self.kind().bytes()
    }

    /// The stored number of voxel `i`, as a float.
    pub fn get(&self, i: usize) -> f32 {
        match self {
            Self::U8(v) => f32::from(v[i]),
            Self::U16(v) => f32::from(v[i]),
            Self::F32(v) => v[i],
        }
    }
}

/// Facts about a volume from its file, beside the voxels.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct VolumeInfo {
    /// File name or name of the built-in volume.
    pub name: String,
    /// Type of a voxel in the file, such as `uint8`.
    pub dtype: String,
    /// Unit of the spacing, such as `mm`, if known.
    pub unit: Option<String>,
    /// Directions of the three axes, such as `RAS`, if known.
    pub orientation: Option<String>,
    /// Position of the volume in the world of its file, if known.
    pub placement: Option<Placement>,
    /// Acquisition modality in DICOM's terms (`CT`, `MR`, …), if known.
    pub modality: Option<String>,
    /// Unit of the values, such as `HU`, if known.
    pub value_unit: Option<String>,
    /// The values between which the file's author shows it, ascending, if known.
    pub window: Option<(f32, f32)>,
    /// Whether each value is a label: a name for a kind of matter, not a quantity. The
    /// composite mode interpolates none.
    pub are_labels: bool,
    /// What the labels mean, if the file says so.
    pub labels: Vec<VolumeLabel>,
    /// The channel that these voxels are.
    pub channel: ChannelInfo,
    /// Oddities of the file, one sentence each.
    pub warnings: Vec<String>,
}

/// What a file says about one of its channels.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ChannelInfo {
    /// A name in one line; empty if there is none.
    pub name: String,
    /// The colour in which the file's author shows it, sRGB.
    pub color: Option<[u8; 3]>,
    /// Whether the file's author hides it.
    pub is_hidden: bool,
}

/// What a value of a volume of labels means.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct VolumeLabel {
    /// The value.
    pub value: u32,
    /// A name in one line.
    pub name: String,
    /// The colour in the file, sRGB.
    pub color: Option<[u8; 3]>,
}

/// Position of a volume in the world of its file: right-anterior-superior (RAS+) for a body, or else the file's own
/// axes. Lengths are in the unit of the spacing.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Placement {
    /// The point of the file's world at the origin of world space, which is the centre of the volume's box.
    pub center: [f64; 3],
    /// Unit vectors of the file's world along x, y and z of world space.
    pub axes: [[f64; 3]; 3],
}

impl Placement {
    /// The point of the file's world at `world`, a point of world space.
    pub fn file_from_world(&self, world: Vec3) -> [f64; 3] {
        let w = world.to_array().map(f64::from);
        std::array::from_fn(|i| {
            self.center[i] + self.axes[0][i] * w[0] + self.axes[1][i] * w[1] + self.axes[2][i] * w[2]
        })
    }
}

/// A scalar volume with its physical size. See [`crate::space`] for voxel and world space.
#[derive(Clone, Debug)]
pub struct Volume {
    dims: [u32; 3],
    spacing: Vec3,
    voxels: Voxels,
    value_scale: f32,
    value_offset: f32,
    stored_range: (f32, f32),
    /// See [`Volume::others`].
    others: Vec<Arc<Volume>>,
    gaps: Option<Arc<VoxelGaps>>,
    /// See [`Volume::with_finest`].
    finest: Option<Arc<Finest>>,
    /// See [`Volume::with_paging`].
    paging: Option<Paging>,
    /// See [`Volume::in_whole`].
    whole: Option<Arc<Whole>>,
    /// Name, type and remarks.
    pub info: VolumeInfo,
}

/// Why voxels do not make a volume.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum VolumeError {
    /// A dimension is zero or larger than [`Volume::MAX_SIDE`].
    #[error("dimensions are {0:?}, expected 1 to {max} along each axis", max = Volume::MAX_SIDE)]
    Dims([u32; 3]),
    /// The number of voxels is not the product of the dimensions.
    #[error("dimensions {dims:?} need {expected} voxels, found {found}")]
    Count {
        /// The dimensions.
        dims: [u32; 3],
        /// Their product.
        expected: u64,
        /// Voxels given.
        found: u64,
    },
    /// A spacing is not a positive number, or the three differ beyond reason.
    #[error(
        "spacing is {0}, expected three positive numbers from 1e-12 to 1e12, at most a factor of 1e4 apart"
    )]
    Spacing(Vec3),
    /// A page has voxels of another type than its volume.
    #[error("a page has voxels of {found:?}, expected {expected:?}")]
    Kind {
        /// Type of the page's voxels.
        found: VoxelKind,
        /// Type of the volume's.
        expected: VoxelKind,
    },
    /// There are too many channels, or one has another grid.
    #[error("a channel has {0:?} voxels, expected {1:?}, and at most {MAX_CHANNELS} channels")]
    Channels([u32; 3], [u32; 3]),
    /// A stored number has no finite meaning.
    #[error("stored numbers from {range:?} mean {scale} times that plus {offset}, expected finite values within ±{max:e}", max = Volume::MAX_MAGNITUDE)]
    Values {
        /// Least and greatest stored number.
        range: (f32, f32),
        /// Factor from stored numbers to values.
        scale: f32,
        /// Offset that is added then.
        offset: f32,
    },
    /// A voxel is NaN, infinite or too large for differences.
    #[error(
        "{count} voxels are NaN or infinite or too large, the first at {first:?}; expected finite values within ±{max:e}",
        max = Volume::MAX_MAGNITUDE
    )]
    NotFinite {
        /// Number of such voxels.
        count: u64,
        /// Coordinates of the first.
        first: [u32; 3],
    },
}

impl Volume {
    /// Largest number of voxels along an axis: wgpu's default limit for 3-D textures.
    pub const MAX_SIDE: u32 = 2048;
    /// Largest magnitude of a voxel, so that interpolation and gradients stay finite. Usual marks for missing values
    /// are below it (netCDF: 9.97e36), except the greatest float.
    pub const MAX_MAGNITUDE: f32 = 1e37;

    /// A volume of `dims` voxels, `spacing` apart (world units). Stored numbers mean `value_scale·stored +
    /// value_offset`.
    pub fn new(
        dims: [u32; 3],
        spacing: Vec3,
        voxels: Voxels,
        (value_scale, value_offset): (f32, f32),
        info: VolumeInfo,
    ) -> Result<Self, VolumeError> {
        if dims.iter().any(|&d| d == 0 || d > Self::MAX_SIDE) {
            return Err(VolumeError::Dims(dims));
        }
        let expected = dims.iter().map(|&d| u64::from(d)).product::<u64>();
        if expected != voxels.len() as u64 {
            return Err(VolumeError::Count { dims, expected, found: voxels.len() as u64 });
        }
        let (least, greatest) = (spacing.min_element(), spacing.max_element());
        // Squares of the volume's sides, and of their inverses, are finite single-precision numbers.
        let is_good = least >= 1e-12 && greatest <= 1e12 && greatest <= least * 1e4;
        if !is_good || !spacing.is_finite() {
            return Err(VolumeError::Spacing(spacing));
        }
        if let Voxels::F32(v) = &voxels {
            let is_bad = |x: &f32| x.is_nan() || x.abs() > Self::MAX_MAGNITUDE;
            let count = v.par_iter().filter(|x| is_bad(x)).count() as u64;
            if let Some(i) = v.par_iter().position_first(is_bad) {
                let (nx, ny) = (dims[0] as usize, dims[1] as usize);
                let first = [(i % nx) as u32, (i / nx % ny) as u32, (i / nx / ny) as u32];
                return Err(VolumeError::NotFinite { count, first });
            }
        }
        let stored_range = match &voxels {
            Voxels::U8(v) => min_max(v, u8::min, u8::max),
            Voxels::U16(v) => min_max(v, u16::min, u16::max),
            Voxels::F32(v) => min_max(v, f32::min, f32::max),
        };
        let value = |stored: f32| stored * value_scale + value_offset;
        let is_fit = |value: f32| value.abs() <= Self::MAX_MAGNITUDE;
        if !is_fit(value(stored_range.0)) || !is_fit(value(stored_range.1)) {
            return Err(VolumeError::Values {
                range: stored_range,
                scale: value_scale,
                offset: value_offset,
            });
        }
        let (others, gaps, finest, paging, whole) = (Vec::new(), None, None, None, None);
        Ok(Self {
            dims,
            spacing,
            voxels,
            value_scale,
            value_offset,
            stored_range,
            others,
            gaps,
            finest,
            paging,
            whole,
            info,
        })
    }

    /// The volume with nothing in the voxels whose byte is not 0, one for each voxel, x fastest. They are neither
    /// counted nor shown. A volume without any other voxel, and one with another number of bytes, stay as they are.
    pub fn with_gaps(mut self, bytes: Vec<u8>) -> Self {
        let num_gaps = bytes.par_iter().filter(|byte| **byte != 0).count();
        if bytes.len() != self.voxels.len() || num_gaps == 0 || num_gaps == bytes.len() {
            return self;
        }
        match &mut self.voxels {
            Voxels::U8(v) => self.stored_range = gaps::fill(v, &bytes, self.dims),
            Voxels::U16(v) => self.stored_range = gaps::fill(v, &bytes, self.dims),
            Voxels::F32(v) => self.stored_range = gaps::fill(v, &bytes, self.dims),
        }
        self.gaps = Some(Arc::new(VoxelGaps { bytes, num_gaps: num_gaps as u64 }));
        self
    }

    /// The same of a part of a volume, whose gaps are filled already: from voxels beyond the part, too.
    pub(super) fn with_filled_gaps(mut self, bytes: Vec<u8>) -> Self {
        let num_gaps = bytes.iter().filter(|byte| **byte != 0).count();
        if bytes.len() == self.voxels.len() && num_gaps > 0 && num_gaps < bytes.len() {
            self.gaps = Some(Arc::new(VoxelGaps { bytes, num_gaps: num_gaps as u64 }));
        }
        self
    }

    /// The voxels with nothing in them, if there are any.
    pub fn gaps(&self) -> Option<&Arc<VoxelGaps>> {
        self.gaps.as_ref()
    }

    /// The volume as a level of a pyramid: it lies in the box of the finest level and looks as that does. Each channel
    /// has its own.
    pub fn with_finest(mut self, finest: Finest) -> Self {
        if let Some((lo, hi)) = finest.stored_range.filter(|(lo, hi)| self.is_fit(*lo) && self.is_fit(*hi)) {
            // A writer's mean may lie a rounding beyond.
            self.stored_range = (self.stored_range.0.min(lo), self.stored_range.1.max(hi));
        }
        self.finest = Some(Arc::new(finest));
        self
    }

    /// The finest level of the pyramid that the volume is a level of.
    pub fn finest(&self) -> Option<&Arc<Finest>> {
        self.finest.as_ref()
    }

    /// The volume as the coarsest level of one that is read by pages.
    pub fn with_paging(self, paging: Paging) -> Self {
        Self { paging: Some(paging), ..self }
    }

    /// How the finer levels are read, if this is the coarsest of a volume that is read by pages.
    pub fn paging(&self) -> Option<&Paging> {
        self.paging.as_ref()
    }

    fn is_fit(&self, stored: f32) -> bool {
        self.value_from_stored(stored).abs() <= Self::MAX_MAGNITUDE
    }

    /// This volume as the first channel, shown together with `others` on the same grid.
    ///
    /// # Errors
    /// If there are more than [`MAX_CHANNELS`], or one has other dimensions.
    pub fn with_others(mut self, others: Vec<Arc<Volume>>) -> Result<Self, VolumeError> {
        let is_odd = |other: &&Arc<Volume>| other.dims != self.dims || !other.others.is_empty();
        if let Some(other) = others.iter().find(is_odd).or(others.get(MAX_CHANNELS - 1)) {
            return Err(VolumeError::Channels(other.dims, self.dims));
        }
        self.others = others;
        Ok(self)
    }

    /// The channels beside this one: at most [`MAX_CHANNELS`] − 1, on the same grid, without others of their own.
    pub fn others(&self) -> &[Arc<Volume>] {
        &self.others
    }

    /// The volume as a part of a whole, from which its box, its range and its histogram are taken. Its voxel space is that
    /// of the whole. A part of a level lies in the finest level as the whole level does ([`Volume::with_finest`]).
    ///
    /// # Errors
    /// If the part does not lie inside the whole.
    pub fn in_whole(mut self, whole: Arc<Whole>) -> Result<Self, VolumeError> {
        let is_inside = |axis: usize| {
            whole.first[axis].checked_add(self.dims[axis]).is_some_and(|end| end <= whole.dims[axis])
        };
        if !(0..3).all(is_inside) {
            return Err(VolumeError::Channels(self.dims, whole.dims));
        }
        self.stored_range = whole.stored_range;
        self.whole = Some(whole);
        Ok(self)
    }

    /// The whole that this volume is a part of; `None` if it is one itself.
    pub fn whole(&self) -> Option<&Arc<Whole>> {
        self.whole.as_ref()
    }

    /// All channels, this one first.
    pub fn channels(&self) -> impl Iterator<Item = &Volume> {
        std::iter::once(self).chain(self.others.iter().map(AsRef::as_ref))
    }

    /// Voxels along x, y, z.
    pub fn dims(&self) -> [u32; 3] {
        self.dims
    }

    /// Distance between voxel centres, world units.
    pub fn spacing(&self) -> Vec3 {
        self.spacing
    }

    /// Voxels along x, y, z of the finest level of the whole.
    pub fn finest_dims(&self) -> [u32; 3] {
        self.finest.as_ref().map_or(self.whole_dims(), |finest| finest.dims)
    }

    /// Distance between voxel centres of the finest level, world units.
    pub fn finest_spacing(&self) -> Vec3 {
        self.finest.as_ref().map_or(self.spacing, |finest| finest.spacing)
    }

    /// Voxels of this level for one of the finest level, along x, y, z. Differences of voxels times this are those of
    /// the finest level.
    pub fn steepness(&self) -> Vec3 {
        self.finest.as_ref().map_or(Vec3::ONE, |finest| finest.spacing / self.spacing)
    }

    /// The side of a cube as large as a voxel of the finest level, world units.
    pub fn voxel_side(&self) -> f32 {
        self.finest_spacing().to_array().iter().product::<f32>().cbrt()
    }

    /// The voxels as stored.
    pub fn voxels(&self) -> &Voxels {
        &self.voxels
    }

    /// The box of the volume in world space, faces included (half a voxel beyond the outermost centres). A part
    /// has the box of the whole, and a level of a pyramid that of the finest level.
    pub fn bounds(&self) -> Aabb {
        let (dims, spacing) = match &self.finest {
            Some(finest) => (Vec3::from_array(finest.dims.map(|d| d as f32)), finest.spacing),
            None => (self.whole_dims_f32(), self.spacing),
        };
        let half = dims * spacing * 0.5;
        Aabb { min: -half, max: half }
    }

    /// The world's origin in voxel space: voxel space is world space / spacing + this.
    pub fn voxel_origin(&self) -> Vec3 {
        let Some(finest) = &self.finest else { return self.whole_dims_f32() * 0.5 };
        let middle = Vec3::from_array(finest.dims.map(|d| d as f32)) * 0.5 - 0.5;
        (middle - finest.first) * self.steepness() + 0.5
    }

    /// A point of voxel space in world space.
    pub fn world_from_voxel(&self, point: Vec3) -> Vec3 {
        (point - self.voxel_origin()) * self.spacing
    }

    fn whole_dims_f32(&self) -> Vec3 {
        Vec3::from_array(self.whole_dims().map(|d| d as f32))
    }

    /// The dimensions as floats.
    pub fn dims_f32(&self) -> Vec3 {
        Vec3::new(self.dims[0] as f32, self.dims[1] as f32, self.dims[2] as f32)
    }

    /// The physical value of a stored number.
    pub fn value_from_stored(&self, stored: f32) -> f32 {
        stored * self.value_scale + self.value_offset
    }

    /// Scale and offset from stored numbers to physical values.
    pub fn value_map(&self) -> (f32, f32) {
        (self.value_scale, self.value_offset)
    }

    /// Least and greatest stored number.
    pub fn stored_range(&self) -> (f32, f32) {
        self.stored_range
    }

    /// Least and greatest physical value.
    pub fn value_range(&self) -> (f32, f32) {
        let (a, b) =
            (self.value_from_stored(self.stored_range.0), self.value_from_stored(self.stored_range.1));
        (a.min(b), a.max(b))
    }

    /// Memory of the voxels of all channels and of their brightness, which shaded pictures need ([`super::Lit`]), bytes.
    pub fn bytes_in_memory(&self) -> u64 {
        let bytes = |c: &Self| c.voxels.bytes_per_voxel() + usize::from(c.gaps.is_some());
        let of_voxel = self.channels().map(bytes).sum::<usize>();
        self.voxels.len() as u64 * (of_voxel + BRIGHTNESS_BYTES) as u64
    }

    /// The stored number at integer coordinates, clamped to the grid.
    pub fn stored_at(&self, x: i32, y: i32, z: i32) -> f32 {
        let c = |v: i32, n: u32| v.clamp(0, n as i32 - 1) as usize;
        let (x, y, z) = (c(x, self.dims[0]), c(y, self.dims[1]), c(z, self.dims[2]));
        self.voxels.get((z * self.dims[1] as usize + y) * self.dims[0] as usize + x)
    }
}

/// Bytes per voxel for brightness. Self-shading takes as many again.
const BRIGHTNESS_BYTES: usize = 1;

/// Least and greatest voxel; there must be one.
fn min_max<T: Copy + Send + Sync + Into<f32>>(
    voxels: &[T],
    min: impl Fn(T, T) -> T + Sync,
    max: impl Fn(T, T) -> T + Sync,
) -> (f32, f32) {
    let both = |a: (T, T), b: (T, T)| (min(a.0, b.0), max(a.1, b.1));
    let first = (voxels[0], voxels[0]);
    let of_part = |part: &[T]| part.iter().fold((part[0], part[0]), |found, &v| both(found, (v, v)));
    let (lo, hi) = voxels.par_chunks(PART).map(of_part).reduce(|| first, both);
    (lo.into(), hi.into())
}

/// Voxels in one thread's share.
const PART: usize = 1 << 18;
