//! A bounded sample of a large file whose boxes can be read in any order.

use std::path::Path;

use isinglass_core::volume::Volume;

use super::levels::page_levels;
use crate::decode::VoxelSink;
use crate::error::{FormatError, io_error};
use crate::plan::{Chosen, VolumeFile};
use crate::read_volume::channel_volumes;
use crate::source::OpenOptions;

/// Voxels of the first selected channel of the finest level, in evenly spread bands of rows: at most [`MOST_VOXELS`]. Only
/// their numbers mean something, and not their places.
///
/// # Errors
/// The file cannot be read, or not in any order.
pub(crate) fn sample_of(
    file: &dyn VolumeFile,
    path: &Path,
    options: &OpenOptions,
) -> Result<Volume, FormatError> {
    let levels = page_levels(file.boxes(path)?, path, options)?;
    let level = &levels[0];
    let (grid, dims) = (&level.chosen.grid, level.shape.dims);
    // The axes of the volume from the file's fastest to its slowest.
    let [fast, next, slow] = [0, 1, 2].map(|i| (0..3).find(|&k| grid.order[k].0 == i).unwrap_or(i));
    let num_bands = dims[slow].min(MOST_BANDS);
    let mut side = [1; 3];
    side[fast] = dims[fast].min(Volume::MAX_SIDE);
    side[next] = (MOST_VOXELS / num_bands / side[fast]).clamp(1, dims[next].min(Volume::MAX_SIDE));
    let channel = level.chosen.channels.start;
    let num_voxels = u64::from(side[fast]) * u64::from(side[next]) * u64::from(num_bands);
    let sink = VoxelSink::new(level.plan.dtype, level.plan.endian, num_voxels as usize);
    let mut all = sink.map_err(|_| io_error(path)(std::io::ErrorKind::OutOfMemory.into()))?;
    for band in 0..num_bands {
        options.check_cancelled(path)?;
        // The middle of the rows, and other columns in each band.
        let share = |k: usize, i: u32, n: u32| {
            let free = u64::from(dims[k] - side[k]);
            (free * u64::from(2 * i + 1) / u64::from(2 * n)) as u32
        };
        let mut min = [0; 3];
        min[fast] = share(fast, 0, 1);
        min[next] = share(next, band * 7 % num_bands, num_bands);
        min[slow] = (u64::from(dims[slow]) * u64::from(2 * band + 1) / u64::from(2 * num_bands)) as u32;
        let max = [0, 1, 2].map(|k| u64::from(min[k] + side[k]));
        let part = grid.part(min.map(u64::from), max);
        all.append(level.reader.read(&level.steps(&part, channel))?);
    }
    let grid = grid.coarser([side[fast], side[next], num_bands], [1; 3]);
    let channels = channel..channel + 1;
    let chosen = Chosen { grid, num_voxels, channels, ..(*level.chosen).clone() };
    let decoded = vec![all.finish(level.plan.has_gaps)];
    let (mut volumes, _) = channel_volumes(&level.plan, &chosen, decoded, path)?;
    Ok(volumes.remove(0))
}

/// Most bands.
const MOST_BANDS: u32 = 64;
/// Most voxels of a sample.
const MOST_VOXELS: u32 = 1 << 22;
