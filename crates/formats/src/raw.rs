//! Raw voxels: no header, the shape comes with the request.

use std::fs::File;
use std::io::{Seek, SeekFrom};
use std::path::Path;

use glam::Vec3;
use isinglass_core::volume::{Volume, VolumeError, VolumeInfo};

use crate::decode::{VoxelSink, pump_bytes};
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, shown};
use crate::source::{OpenOptions, file_name};

/// What a raw file does not say of itself.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RawShape {
    /// Voxels along x (fastest), y and z.
    pub dims: [u32; 3],
    /// Type of a voxel.
    pub dtype: Dtype,
    /// Distances between voxel centres, world units.
    pub spacing: Vec3,
    /// Byte order, for types of more than one byte.
    pub endian: Endian,
    /// Bytes before the first voxel.
    pub offset: u64,
}

/// Reads the voxels of `file`, the file at `path`. Bytes after the last voxel are ignored with a warning.
pub(crate) fn read(
    mut file: File,
    path: &Path,
    shape: &RawShape,
    options: &OpenOptions,
) -> Result<Volume, FormatError> {
    let volume_error = |cause| FormatError::Volume { path: shown(path), cause };
    let RawShape { dims, dtype, spacing, endian, offset } = *shape;
    if dims.iter().any(|&d| d == 0 || d > Volume::MAX_SIDE) {
        return Err(volume_error(VolumeError::Dims(dims)));
    }
    let num_voxels = dims.iter().map(|&d| u64::from(d)).product::<u64>();
    options.check_memory(path, num_voxels * dtype.num_bytes_in_memory() as u64)?;
    let io = io_error(path);
    let num_bytes = num_voxels * dtype.num_bytes() as u64;
    let found = file.metadata().map_err(&io)?.len().saturating_sub(offset);
    let short = |found| {
        let [x, y, z] = dims;
        let shape = format!("{x}×{y}×{z} {} from byte {offset}", dtype.name());
        FormatError::Short { path: shown(path), shape, expected: num_bytes, found, unit: "bytes" }
    };
    if found < num_bytes {
        return Err(short(found));
    }
    file.seek(SeekFrom::Start(offset)).map_err(&io)?;
    let mut sink = VoxelSink::new(dtype, endian, num_voxels as usize)
        .map_err(|_| io(std::io::ErrorKind::OutOfMemory.into()))?;
    let mut tick = |done: u64| {
        if let Some(progress) = options.progress {
            progress(done as f32 / num_bytes as f32);
        }
    };
    let (done, result) = pump_bytes(&mut file, &mut sink, num_bytes, &mut tick);
    result.map_err(&io)?;
    if done < num_bytes {
        return Err(short(done));
    }
    let decoded = sink.finish();
    let mut warnings = decoded.warnings;
    if found > num_bytes {
        warnings.push(format!("{} bytes after the last voxel are ignored", found - num_bytes));
    }
    let info = VolumeInfo {
        name: file_name(path),
        dtype: dtype.name().to_owned(),
        unit: None,
        orientation: None,
        warnings,
    };
    Volume::new(dims, spacing, decoded.voxels, decoded.value_map, info).map_err(volume_error)
}
