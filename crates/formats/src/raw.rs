//! Raw voxels without a header. The request contains the shape.

use std::fs::File;
use std::io::{BufReader, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use glam::Vec3;
use isinglass_core::volume::VolumeError;
use serde::{Deserialize, Serialize, Serializer};

use crate::axes::Geometry;
use crate::collector::Collector;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, shown};
use crate::paged::flat::{FlatFile, flat_level};
use crate::plan::{Axis, BoxLevel, Plan, VolumeFile};
use crate::warning::WarningKind;

/// The shape of a raw file.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RawShape {
    /// Voxels along x (fastest), y and z.
    pub dims: [u32; 3],
    /// Type of a voxel.
    pub dtype: Dtype,
    /// Distances between voxel centres, world units.
    #[serde(default = "unit_spacing", with = "in_numbers")]
    pub spacing: Vec3,
    /// Byte order, for types of more than one byte.
    #[serde(default)]
    pub endian: Endian,
    /// Bytes before the first voxel.
    #[serde(default, serialize_with = "offset_in_toml")]
    pub offset: u64,
}

impl RawShape {
    /// Most voxels along an axis. Sides beyond those of a volume are thinned, or read by pages.
    pub const MAX_SIDE: u32 = 1 << 15;
}

fn unit_spacing() -> Vec3 {
    Vec3::ONE
}

mod in_numbers {
    use glam::Vec3;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    pub(super) fn serialize<S: Serializer>(vector: &Vec3, serializer: S) -> Result<S::Ok, S::Error> {
        vector.to_array().serialize(serializer)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec3, D::Error> {
        <[f32; 3]>::deserialize(deserializer).map(Vec3::from)
    }
}

/// Integers in TOML are at most 2⁶³ − 1, like the sizes of files.
fn offset_in_toml<S: Serializer>(offset: &u64, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_i64(i64::try_from(*offset).unwrap_or(i64::MAX))
}

pub(crate) struct RawFile {
    file: File,
    path: PathBuf,
    plan: Plan,
    offset: u64,
}

impl RawFile {
    /// `file` is the file at `path`. Bytes after the last voxel cause a warning.
    pub(crate) fn open(file: File, path: &Path, shape: &RawShape) -> Result<Self, FormatError> {
        let volume_error = |cause| FormatError::Volume { path: shown(path), cause };
        let RawShape { dims, dtype, spacing, endian, offset } = *shape;
        if dims.iter().any(|&d| d == 0 || d > RawShape::MAX_SIDE) {
            return Err(volume_error(VolumeError::Dims(dims)));
        }
        if !(spacing.is_finite() && spacing.min_element() > 0.0) {
            return Err(volume_error(VolumeError::Spacing(spacing)));
        }
        let geometry = Geometry::along_axes(spacing.to_array().map(f64::from), None);
        let mut plan = Plan::new("raw", dtype, endian, Axis::in_space(dims.map(u64::from)), geometry);
        plan.has_gaps = false;
        let found = file.metadata().map_err(io_error(path))?.len().saturating_sub(offset);
        // The product is below 2⁵⁵ bytes.
        let num_bytes = dims.iter().map(|&d| u64::from(d)).product::<u64>() * dtype.num_bytes() as u64;
        if found > num_bytes {
            plan.warn(
                WarningKind::Data,
                format!("{} bytes after the last voxel are ignored", found - num_bytes),
            );
        }
        Ok(Self { file, path: path.to_owned(), plan, offset })
    }
}

impl VolumeFile for RawFile {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        let io = io_error(&self.path);
        let found = self.file.metadata().map_err(&io)?.len().saturating_sub(self.offset);
        let num_bytes = collector.num_bytes();
        if found < num_bytes {
            let mut short = collector.short(&self.path, num_bytes, found, "bytes");
            if let FormatError::Short { shape, .. } = &mut short {
                *shape += &format!(" from byte {}", self.offset);
            }
            return Err(short);
        }
        let mut reader = BufReader::new(&mut self.file);
        reader.seek(SeekFrom::Start(self.offset)).map_err(&io)?;
        collector.pump(&mut reader, &self.path, num_bytes)
    }

    fn boxes(&self, path: &Path) -> Result<Vec<BoxLevel>, FormatError> {
        flat_level(&self.plan, vec![FlatFile { path: self.path.clone(), offset: self.offset }], path)
    }
}
