//! What `info` tells of a file of any size in bounded time: its header, and the values of a bounded part.

use std::path::Path;

use isinglass_core::volume::Histogram;

use crate::error::FormatError;
use crate::facts::{ValuesOf, VolumeFacts};
use crate::outline::Outline;
use crate::paged::{IndexPlace, sample_of};
use crate::plan::VolumeFile;
use crate::selection::{Region, Selection};
use crate::source::{OpenOptions, open, open_source, outline};
use crate::web::is_address;

/// The facts about a file by its header, with values from its index, its coarsest level, a sample, or its first voxels.
/// At most 64 MiB of voxels are read, and at an address only the coarsest level. `None` if the volume is so small that
/// all of it may be read at once.
///
/// # Errors
/// As [`crate::outline`], and those of what is read.
pub fn facts_at_once(source: &str, options: &OpenOptions) -> Result<Option<VolumeFacts>, FormatError> {
    if source.starts_with("builtin:") {
        return Ok(None);
    }
    let found = match outline(source, options) {
        // It may be described all the same.
        Err(FormatError::TooLarge { .. }) => {
            outline(source, &OpenOptions { max_bytes: u64::MAX, ..*options })
        }
        found => found,
    }?;
    let is_far = is_address(source);
    let is_plain = found.levels.is_empty() && found.level == 0;
    if is_plain && options.reading.labels.is_some() {
        return Ok(None);
    }
    if found.bytes_needed() <= MOST_BYTES && (!is_far || is_plain) {
        return Ok(None);
    }
    let facts = VolumeFacts::of_header(&found);
    let (path, file) = open_source(source, options)?;
    if let Some(histogram) = of_index(&*file, &path, options) {
        return Ok(Some(facts.with_values(ValuesOf::Index, &histogram)));
    }
    if found.levels.len() > 1 {
        return of_coarsest(source, &found, facts, options).map(Some);
    }
    if is_far {
        return Ok(Some(facts));
    }
    let sample = match sample_of(&*file, &path, options) {
        Err(FormatError::NotPaged { .. }) => None,
        found => Some(found?),
    };
    if let Some(sample) = sample {
        let num_voxels = sample.voxels().len() as u64;
        return Ok(Some(facts.with_values(ValuesOf::Sample(num_voxels), &Histogram::of(&sample))));
    }
    of_first(source, &*file, &path, facts, options).map(Some)
}

/// The histogram of the first selected channel in the index.
fn of_index(file: &dyn VolumeFile, path: &Path, options: &OpenOptions) -> Option<Histogram> {
    let index = IndexPlace::of(file, path, options.selection.region, options)?.read()?;
    Some((**index.histogram(0)).clone())
}

/// With the values of the coarsest level, if it is small.
fn of_coarsest(
    source: &str,
    outline: &Outline,
    facts: VolumeFacts,
    options: &OpenOptions,
) -> Result<VolumeFacts, FormatError> {
    let level = outline.levels.len() as u32 - 1;
    let selection = Selection { level: Some(level), region: None, ..options.selection };
    // The numbers of the finest level are left where they are.
    let options = OpenOptions { selection, max_bytes: MOST_BYTES, index_folder: None, ..*options };
    let needed = crate::outline(source, &options).map(|coarsest| coarsest.bytes_needed());
    match needed {
        Ok(needed) => {
            let volume = open(source, &OpenOptions { max_bytes: needed, ..options })?;
            Ok(facts.with_values(ValuesOf::Level(level), &Histogram::of(&volume)))
        }
        Err(FormatError::TooLarge { .. }) => Ok(facts),
        Err(e) => Err(e),
    }
}

/// With the values of the first slices of the file, or of a part of the first one.
fn of_first(
    source: &str,
    file: &dyn VolumeFile,
    path: &Path,
    facts: VolumeFacts,
    options: &OpenOptions,
) -> Result<VolumeFacts, FormatError> {
    let plan = file.plan();
    let chosen = plan.choose(path, &OpenOptions { max_bytes: u64::MAX, ..*options })?;
    let (order, dims) = (chosen.grid.order, chosen.grid.dims());
    let start = options.selection.region.map_or([0; 3], |region| region.min);
    let size = plan.dtype.num_bytes_in_memory() as u64 + 1;
    let mut region = Region { min: start, max: [0, 1, 2].map(|k| Some(start[k] + dims[k])) };
    let mut side = dims.map(u64::from);
    // From the file's slowest axis to its fastest.
    for i in [2, 1, 0] {
        let Some(k) = (0..3).find(|&k| order[k].0 == i) else { continue };
        let in_slice = side.iter().product::<u64>() / side[k] * size * u64::from(chosen.channels.end);
        let count = (MOST_BYTES / in_slice.max(1)).clamp(1, side[k]);
        let (first, last) = (u64::from(region.min[k]), u64::from(region.min[k]) + side[k]);
        let (first, last) = if order[k].1 { (last - count, last) } else { (first, first + count) };
        (region.min[k], region.max[k], side[k]) = (first as u32, Some(last as u32), count);
        if count > 1 {
            break;
        }
    }
    let selection = Selection { region: Some(region), ..options.selection };
    let volume = open(source, &OpenOptions { selection, ..*options })?;
    let num_voxels = volume.voxels().len() as u64;
    Ok(facts.with_values(ValuesOf::First(num_voxels), &Histogram::of(&volume)))
}

/// Most bytes of voxels that are read: 64 MiB.
const MOST_BYTES: u64 = 64 << 20;
