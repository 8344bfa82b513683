//! OME-Zarr 0.1 to 0.6 (ngff.openmicroscopy.org) on Zarr 2 and 3: pyramids of chunked arrays, and single arrays. So are
//! groups of arrays, as xarray writes them. Only the selected level and region are read.

mod array;
mod boxes;
mod chunks;
mod codec;
mod describe;
mod group;
mod images;
mod json;
mod multiscale;
mod pyramid;
mod store;
mod write;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::RecvTimeoutError;
use std::sync::{Arc, mpsc};
use std::thread;
use std::time::Duration;

use isinglass_core::volume::MAX_CHANNELS;
use rayon::prelude::*;
use serde_json::Value;

use self::array::Array;
use self::chunks::read_chunks;
pub(crate) use self::describe::ImageFacts;
use self::group::ArrayGroup;
use self::images::ImageList;
use self::multiscale::Multiscale;
pub(crate) use self::pyramid::{PyramidLevel, pyramid_levels};
use self::store::Store;
pub(crate) use self::write::{ArrayWriter, write_document};
use crate::cf::{NumberMeaning, signed_as_told};
use crate::collector::Collector;
use crate::error::{FormatError, io_error, malformed, not_there, quoted};
use crate::plan::{BoxLevel, Plan, VolumeFile};
use crate::pyramid::{level_to_show, warn_of_level};
use crate::sniff;
use crate::source::{OpenOptions, read_file};
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
    layout: ImageLayout,
    arrays: Vec<Array>,
    store: Store,
}

/// What tells of the axes of an image.
enum ImageLayout {
    /// The metadata of its levels, and what the numbers of their arrays mean.
    Levels(Box<Multiscale>, NumberMeaning),
    /// The coordinates of its one array.
    Array(Box<Plan>),
}

impl ArrayPyramid {
    fn plan(&self, level: usize) -> Result<Plan, String> {
        match &self.layout {
            ImageLayout::Levels(multiscale, values) => multiscale.plan(&self.arrays, level, values),
            ImageLayout::Array(plan) => Ok(Plan::clone(plan)),
        }
    }
}

/// Whether a folder is an array or a group of arrays.
pub(crate) fn is_group(path: &Path) -> bool {
    METADATA.iter().any(|name| path.join(name).is_file())
}

/// What a folder is that is like a group, and what can be opened instead.
pub(crate) fn other_group(path: &Path) -> Option<(&'static str, &'static str)> {
    if path.join(".zmetadata").is_file() {
        return Some((sniff::REFERENCES, sniff::expected_for(sniff::REFERENCES)));
    }
    let text = read_file(&path.join("attributes.json"), MAX_N5_BYTES).ok().flatten();
    let attributes: Value = text.and_then(|text| serde_json::from_slice(&text).ok()).unwrap_or_default();
    let is_n5 = ["n5", "blockSize", "dataType"].iter().any(|key| attributes.get(*key).is_some());
    let is_called_n5 = path.extension().is_some_and(|end| end.eq_ignore_ascii_case("n5"));
    (is_n5 || is_called_n5).then_some((N5, FROM_N5))
}

/// The group that has the array in the folder `path`, and the array's name.
fn group_around(path: &Path) -> Option<(&Path, &str)> {
    let name = path.file_name()?.to_str()?;
    let folder =
        path.parent().map(|folder| if folder.as_os_str().is_empty() { Path::new(".") } else { folder })?;
    [".zgroup", "zarr.json"].iter().any(|file| folder.join(file).is_file()).then_some((folder, name))
}

impl ZarrImage {
    /// Opens the group or array in the folder `path`.
    pub(crate) fn open(path: &Path, options: &OpenOptions) -> Result<Self, FormatError> {
        let store = Store::of_folder(path, options);
        // The coordinates of an array are beside it.
        if let (Some(_), Some((folder, name))) = (ArrayGroup::alone(&store, path)?, group_around(path)) {
            let store = Store::of_folder(folder, options);
            if let Some(group) = ArrayGroup::read(&store, folder, options)? {
                return Self::of_group(store, folder, &group, Some(name), options);
            }
        }
        Self::in_store(store, path, options)
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
        if let Some(found) = Multiscale::read(&store, path)? {
            let named = if found.is_image { None } else { ArrayGroup::alone(&store, path)? };
            return match named {
                Some(group) => Self::of_group(store, path, &group, None, options),
                None => Self::of_image(store, path, path, found, options),
            };
        }
        let list = ImageList::read(&store, path, options)?;
        let index = options.selection.series.unwrap_or(0) as usize;
        if let Some(name) = list.paths.get(index) {
            let inner = path.join(name);
            if let Some(found) = Multiscale::read(&store, &inner)? {
                let mut image = Self::of_image(store, path, &inner, found, options)?;
                image.plan.set_images(&list, options);
                return Ok(image);
            }
        } else if !list.paths.is_empty() {
            return Err(not_there(path, "series", index as u64, list.paths.len()));
        }
        match ArrayGroup::read(&store, path, options)?.filter(|group| !group.is_empty()) {
            Some(group) => Self::of_group(store, path, &group, None, options),
            None => Err(no_image(&store, path, &list)),
        }
    }

    /// The array of a group that is called `name`, or the one that the options choose.
    fn of_group(
        store: Store,
        path: &Path,
        group: &ArrayGroup,
        name: Option<&str>,
        options: &OpenOptions,
    ) -> Result<Self, FormatError> {
        options.check_cancelled(path)?;
        let mut found = group.volume(&store, path, name, options)?;
        let layout = ImageLayout::Array(Box::new(found.plan.clone()));
        warn_of_level(&mut found.plan, options);
        let pyramid = Arc::new(ArrayPyramid { layout, arrays: vec![found.array], store });
        Ok(Self { plan: found.plan, pyramid, level: 0, most_bytes: options.max_bytes })
    }

    /// The image in the folder `image`. `path` is that of what was opened.
    fn of_image(
        store: Store,
        path: &Path,
        image: &Path,
        multiscale: Multiscale,
        options: &OpenOptions,
    ) -> Result<Self, FormatError> {
        options.check_cancelled(path)?;
        let read = || {
            let levels = multiscale.levels.par_iter();
            levels.map(|level| Array::read(&store, &image.join(&level.path))).collect::<Result<Vec<_>, _>>()
        };
        let mut arrays = store.on_threads(read)?;
        let finest = &arrays[0];
        let attributes = json::attributes_of_array(&store, &finest.path, finest.version)?;
        arrays.iter_mut().for_each(|array| array.dtype = signed_as_told(array.dtype, &attributes));
        let dims: Vec<[u64; 3]> = arrays.iter().map(|a| multiscale.space_of(&a.shape)).collect();
        let num_channels = match options.selection.channel {
            Some(_) => 1,
            None => multiscale.num_channels(&arrays[0].shape).min(MAX_CHANNELS as u64),
        };
        let level = level_to_show(path, &dims, num_channels, arrays[0].dtype, options)?;
        let layout =
            ImageLayout::Levels(Box::new(multiscale), NumberMeaning::of(&attributes, arrays[0].dtype));
        let pyramid = Arc::new(ArrayPyramid { layout, arrays, store });
        let mut plan = pyramid.plan(level).map_err(malformed(path, "OME-Zarr"))?;
        warn_of_level(&mut plan, options);
        Ok(Self { plan, pyramid, level, most_bytes: options.max_bytes })
    }
}

impl Plan {
    /// Notes the images of a group, of which one is shown.
    fn set_images(&mut self, list: &ImageList, options: &OpenOptions) {
        if list.paths.len() > 1 {
            if options.selection.series.is_none() {
                self.warn(WarningKind::Choice, list.choice());
            }
            self.series.clone_from(&list.paths);
        }
    }
}

/// The error that a group has neither an image nor an array.
fn no_image(store: &Store, path: &Path, list: &ImageList) -> FormatError {
    let problem = match (store, &list.paths[..], list.group) {
        (_, [first, ..], _) => format!("found no image at {}, expected multiscales", quoted(first)),
        (_, [], "plate") => "found a plate without fields, expected wells with images".into(),
        (Store::Web(..), ..) => {
            "found no image at this address, expected multiscales, or arrays with consolidated metadata"
                .into()
        }
        _ => "found no image in its attributes, expected multiscales, or arrays".to_owned(),
    };
    malformed(path, "OME-Zarr")(problem)
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
        let plans = (0..pyramid.arrays.len()).map(|level| pyramid.plan(level)).collect::<Result<Vec<_>, _>>();
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
        let plan = pyramid.plan(0).ok()?;
        Some(Box::new(Self { plan, pyramid, level: 0, most_bytes: self.most_bytes }))
    }
}

/// The files that describe arrays and groups.
const METADATA: [&str; 4] = [".zattrs", ".zgroup", ".zarray", "zarr.json"];
const N5: &str = "an N5 container";
const FROM_N5: &str = "OME-Zarr or Zarr, which Fiji (N5 export) or `zarr.copy_all` of zarr-python 2 with its `N5FSStore` makes of it";
/// Longest attributes of an N5 container that are looked at.
const MAX_N5_BYTES: u64 = 16 << 20;
/// How long it takes at most until a survey ends after cancelling.
const CANCEL_TIME: Duration = Duration::from_millis(50);
