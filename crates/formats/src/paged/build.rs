//! Makes the index of a file by reading all of its pages.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use isinglass_core::volume::{PageId, PageSource};
use rayon::prelude::*;

use super::index::{PageIndex, PageIndexBuilder};
use super::index_file::IndexPlace;
use crate::error::{FormatError, shown};
use crate::read_volume::MOST_READ_FOR_NUMBERS;
use crate::source::OpenOptions;
use crate::web::is_address;

/// Reads all pages of the finest level once. `progress` is called with the fraction that has been read, 0 to 1.
///
/// # Errors
/// A page cannot be read, there are too many of them, or `cancel` was set.
pub(crate) fn built_index(
    source: &dyn PageSource,
    path: &Path,
    progress: Option<&dyn Fn(f32)>,
    cancel: Option<&AtomicBool>,
) -> Result<PageIndex, FormatError> {
    let data = |problem: String| FormatError::Data { path: shown(path), problem };
    let pyramid = source.pyramid();
    let mut builder = PageIndexBuilder::new(pyramid)
        .ok_or_else(|| data("more pages than an index holds, expected at most 16 777 216".into()))?;
    let [nx, ny, nz] = pyramid.pages(0).map(u64::from);
    let (num_pages, num_channels) = (nx * ny * nz, pyramid.value_maps.len());
    for channel in 0..num_channels {
        // Pages of a layer share its chunks.
        for first in (0..num_pages).step_by(AT_ONCE) {
            if cancel.is_some_and(|cancel| cancel.load(Ordering::Relaxed)) {
                return Err(FormatError::Cancelled { path: shown(path) });
            }
            let some = (first..num_pages.min(first + AT_ONCE as u64)).into_par_iter();
            let read = |i: u64| {
                let at = [i % nx, i / nx % ny, i / nx / ny].map(|n| n as u32);
                let page = PageId { level: 0, at };
                source.read(channel, page).map(|voxels| (page, voxels)).map_err(|e| data(e.to_string()))
            };
            for (page, voxels) in some.map(read).collect::<Result<Vec<_>, _>>()? {
                builder.add(channel, page, &voxels);
            }
            if let Some(progress) = progress {
                let done = channel as u64 * num_pages + first + AT_ONCE as u64;
                progress((done as f64 / (num_pages * num_channels as u64) as f64).min(1.0) as f32);
            }
        }
    }
    builder.finish().ok_or_else(|| data("a channel has no voxel with a value, expected one".into()))
}

/// The index that is kept, or that of a small volume, which is kept then.
///
/// # Errors
/// If reading was cancelled.
pub(super) fn known_index(
    source: &dyn PageSource,
    place: Option<&IndexPlace>,
    path: &Path,
    options: &OpenOptions,
) -> Result<Option<PageIndex>, FormatError> {
    let pyramid = source.pyramid();
    let num_channels = pyramid.value_maps.len();
    let is_alike =
        |index: &PageIndex| (index.pages(), index.num_channels()) == (pyramid.pages(0), num_channels);
    if let Some(index) = place.and_then(IndexPlace::read).filter(is_alike) {
        return Ok(Some(index));
    }
    let bytes = (pyramid.kind.bytes() * num_channels) as u64;
    let bytes = pyramid.dims().iter().fold(bytes, |n, &m| n.saturating_mul(m.into()));
    if bytes > MOST_READ_FOR_NUMBERS || is_address(&path.to_string_lossy()) {
        return Ok(None);
    }
    match built_index(source, path, options.progress, options.cancel) {
        Ok(index) => {
            // A folder that cannot be written to costs only time.
            let _ = place.map(|place| place.write(&index));
            Ok(Some(index))
        }
        Err(e @ FormatError::Cancelled { .. }) => Err(e),
        Err(_) => Ok(None),
    }
}

/// Pages that are in memory at once.
const AT_ONCE: usize = 8;
