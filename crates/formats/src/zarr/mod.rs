//! OME-Zarr 0.1 to 0.6 (ngff.openmicroscopy.org) on Zarr 2 and 3: pyramids of chunked arrays, and single arrays. Only
//! the selected level and region are read.

mod array;
mod boxes;
mod chunks;
mod codec;
mod describe;
mod json;
mod multiscale;
mod pyramid;
mod store;
mod values;
mod write;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::RecvTimeoutError;
use std::sync::{Arc, mpsc};
use std::thread;
use std::time::Duration;

use isinglass_core::volume::MAX_CHANNELS;
use rayon::prelude::*;

use self::array::Array;
use self::chunks::read_chunks;
pub(crate) use self::describe::ImageFacts;
use self::multiscale::Multiscale;
pub(crate) use self::pyramid::{PyramidLevel, pyramid_levels};
use self::store::Store;
use self::values::ArrayValues;
pub(crate) use self::write::{ArrayWriter, write_document};
use crate::collector::Collector;
use crate::error::{FormatError, io_error, malformed, not_there};
use crate::plan::{BoxLevel, Plan, VolumeFile};
use crate::pyramid::{level_to_show, warn_of_level};
use crate::source::OpenOptions;
use crate::warning::WarningKind;
use crate::web::WebFolder;

pub(crate) struct ZarrImage {
    plan: Plan,
    pyramid: Arc<ArrayPyramid>,
    level: usize,
    most_bytes: u64,
}

/// The levels of an image.
struct ArrayPyramid {
    multiscale: Multiscale,
    arrays: Vec<Array>,
    /// What the numbers of the arrays mean.
    values: ArrayValues,
    store: Store,
}

/// Whether a folder is an array or a group of arrays.
pub(crate) fn is_group(path: &Path) -> bool {
    METADATA.iter().any(|name| path.join(name).is_file())
}

impl ZarrImage {
    /// Opens the group or array in the folder `path`.
    pub(crate) fn open(path: &Path, options: &OpenOptions) -> Result<Self, FormatError> {
        Self::in_store(Store::of_folder(path, options), path, options)
    }

    /// Opens the group or array at an address of the web. A server may take long for each file, so another thread asks
    /// it, which nobody waits for after cancelling.
    pub(crate) fn open_web(address: &str, options: &OpenOptions) -> Result<Self, FormatError> {
        let folder = WebFolder::new(address);
        let path = PathBuf::from(folder.address());
        let (selection, max_bytes) = (options.selection, options.max_bytes);
        let (sender, receiver) = mpsc::sync_channel(1);
        let is_cancelled = Arc::new(AtomicBool::new(false));
        let (theirs, of_thread) = (Arc::clone(&is_cancelled), path.clone());
        let survey = move || {
            let cancel = Some(&*theirs);
            let options = OpenOptions { selection, max_bytes, cancel, ..OpenOptions::default() };
            let image = Store::of_web(folder).and_then(|store| Self::in_store(store, &of_thread, &options));
            // Nobody listens after cancelling.
            let _ = sender.send(image);
        };
        let thread = thread::Builder::new().name("survey".into()).spawn(survey);
        thread.map_err(io_error(&path))?;
        loop {
            match receiver.recv_timeout(CANCEL_TIME) {
                Ok(image) => return image,
                Err(RecvTimeoutError::Disconnected) => {
                    return Err(malformed(&path, "OME-Zarr")("its metadata cannot be read".into()));
                }
                Err(RecvTimeoutError::Timeout) => {}
            }
            if let Err(e) = options.check_cancelled(&path) {
                is_cancelled.store(true, Ordering::Relaxed);
                return Err(e);
            }
        }
    }

    fn in_store(store: Store, path: &Path, options: &OpenOptions) -> Result<Self, FormatError> {
        let bad = malformed(path, "OME-Zarr");
        let mut image = path.to_owned();
        let mut series = Vec::new();
        let mut found = Multiscale::read(&store, path)?;
        if found.is_none() {
            // bioformats2raw puts each image into its own group.
            while series.len() < store.max_images() {
                options.check_cancelled(path)?;
                let name = series.len().to_string();
                let files = METADATA.iter().map(|file| store.has(&path.join(&name).join(file)));
                // The first file that is there is enough.
                let Some(found) = files.into_iter().find(|found| !matches!(found, Ok(false))) else { break };
                found?;
                series.push(name);
            }
            let index = options.selection.series.unwrap_or(0) as usize;
            if let Some(name) = series.get(index) {
                image = path.join(name);
                found = Multiscale::read(&store, &image)?;
            } else if !series.is_empty() {
                return Err(not_there(path, "series", index as u64, series.len()));
            }
        }
        let Some(multiscale) = found else {
            let place = if matches!(store, Store::Web(..)) { "at this address" } else { "in its attributes" };
            return Err(bad(format!("found no image {place}, expected multiscales")));
        };
        options.check_cancelled(path)?;
        let read = || {
            let levels = multiscale.levels.par_iter();
            levels.map(|level| Array::read(&store, &image.join(&level.path))).collect::<Result<Vec<_>, _>>()
        };
        let arrays = store.on_threads(read)?;
        let dims: Vec<[u64; 3]> = arrays.iter().map(|a| multiscale.space_of(&a.shape)).collect();
        let num_channels = match options.selection.channel {
            Some(_) => 1,
            None => multiscale.num_channels(&arrays[0].shape).min(MAX_CHANNELS as u64),
        };
        let level = level_to_show(path, &dims, num_channels, arrays[0].dtype, options)?;
        let finest = &arrays[0];
        let values = ArrayValues::read(&store, &finest.path, finest.version)?;
        let mut plan = multiscale.plan(&arrays, level, &values).map_err(bad)?;
        warn_of_level(&mut plan, options);
        if series.len() > 1 {
            if options.selection.series.is_none() {
                plan.warn(
                    WarningKind::Choice,
                    format!("the group has {} images, of which 0 is shown", series.len()),
                );
            }
            plan.series = series;
        }
        let pyramid = Arc::new(ArrayPyramid { multiscale, arrays, values, store });
        Ok(Self { plan, pyramid, level, most_bytes: options.max_bytes })
    }
}

impl VolumeFile for ZarrImage {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn is_chunked(&self) -> bool {
        true
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        let pyramid = &*self.pyramid;
        read_chunks(&pyramid.arrays[self.level], &pyramid.store, collector, self.most_bytes)
    }

    fn data_files(&self) -> Vec<PathBuf> {
        // A chunk that changes in its place goes unnoticed.
        let finest = &self.pyramid.arrays[0].path;
        [".zarray", "zarr.json", "0", "c"]
            .iter()
            .map(|name| finest.join(name))
            .chain([finest.clone()])
            .collect()
    }

    fn boxes(&self, path: &Path) -> Result<Vec<BoxLevel>, FormatError> {
        let pyramid = &self.pyramid;
        let plan = |level| pyramid.multiscale.plan(&pyramid.arrays, level, &pyramid.values);
        let plans = (0..pyramid.arrays.len()).map(plan).collect::<Result<Vec<_>, _>>();
        let mut plans = plans.map_err(malformed(path, "OME-Zarr"))?;
        plans.iter_mut().for_each(|plan| plan.series.clone_from(&self.plan.series));
        boxes::levels(pyramid, plans, self.most_bytes, path)
    }

    fn finest_level(&self) -> Option<Box<dyn VolumeFile>> {
        // Nobody asked for a whole level from the web.
        if self.level == 0 || matches!(self.pyramid.store, Store::Web(..)) {
            return None;
        }
        let pyramid = Arc::clone(&self.pyramid);
        let plan = pyramid.multiscale.plan(&pyramid.arrays, 0, &pyramid.values).ok()?;
        Some(Box::new(Self { plan, pyramid, level: 0, most_bytes: self.most_bytes }))
    }
}

/// The files that describe arrays and groups.
const METADATA: [&str; 4] = [".zattrs", ".zgroup", ".zarray", "zarr.json"];
/// How long it takes at most until a survey ends after cancelling.
const CANCEL_TIME: Duration = Duration::from_millis(50);
