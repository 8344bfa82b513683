//! Volumes that are read by pages: the coarsest level whole, the others as they are wanted.

mod base;
mod blocks;
mod build;
pub(crate) mod flat;
mod index;
mod index_file;
mod levels;
mod means;
mod means_file;
mod noted;
mod pages;
mod sample;
mod scan_rules;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use isinglass_core::volume::{PAGE_CELLS, PageRanges, PageSource, Paging, Volume};

use self::base::{Base, bytes_to_open};
pub use self::build::BuiltIndex;
use self::build::{IndexRequest, known_index};
pub use self::index::{PageIndex, PageIndexBuilder};
pub(crate) use self::index_file::IndexPlace;
use self::levels::{PageLevel, page_levels};
use self::means::MeanPlan;
use self::noted::NotedPages;
use self::pages::FilePages;
pub(crate) use self::sample::sample_of;
use crate::error::{FormatError, shown};
use crate::outline::PageCount;
use crate::reading::Meaning;
use crate::source::{OpenOptions, open_source};
use crate::web::is_address;

/// A volume whose pages are read as they are wanted.
#[derive(Clone)]
pub struct PagedFile {
    /// The coarsest level, whole in memory. It looks as the finest one does: [`Volume::finest`].
    pub base: Volume,
    /// Reads pages of all levels. Channels are numbered as in [`Volume::channels`] of the base.
    pub source: Arc<dyn PageSource>,
    /// What is known of the finest level, if it was read before.
    pub index: Option<Arc<PageIndex>>,
    pages: Arc<FilePages>,
    path: PathBuf,
    /// Where its index is kept.
    place: Option<IndexPlace>,
    meaning: Option<Meaning>,
    max_bytes: u64,
}

impl PagedFile {
    /// The volume: its base, which brings the pages along. Both take at most about `max_bytes` of memory.
    pub fn into_volume(self, max_bytes: u64) -> Volume {
        let Self { base, source, index, .. } = self;
        let ranges = index.map(|index| index as Arc<dyn PageRanges>);
        // What is kept of the file, three parts of 32 for tables and what is under way, and the base.
        let max_bytes = max_bytes.saturating_sub(max_bytes / 8 + max_bytes / 32 * 3 + base.bytes_in_memory());
        base.with_paging(Paging { source, ranges, max_bytes, own: None })
    }

    /// Parts of the file that are not there and have its fill value, as far as they were met.
    pub fn num_absent(&self) -> u64 {
        self.pages.num_absent()
    }

    /// Whether all is known that an index keeps: that of the finest level, and levels of means if the file has none.
    pub fn is_indexed(&self) -> bool {
        let has_means = self.pages.has_means() || self.pages.mean_plan().is_none();
        self.index.is_some() && has_means
    }

    /// Reads all numbers of the finest level for its index, and for levels of means if the file has no levels. `progress`
    /// is called with the fraction that has been read, 0 to 1.
    ///
    /// # Errors
    /// A part cannot be read, there are too many pages, or `cancel` was set.
    pub fn build_index(
        &self,
        progress: Option<&dyn Fn(f32)>,
        cancel: Option<&AtomicBool>,
    ) -> Result<BuiltIndex, FormatError> {
        let Self { pages, path, meaning, max_bytes, .. } = self;
        let place = self.place.as_ref();
        IndexRequest { pages, path, place, meaning: *meaning, max_bytes: *max_bytes, cancel }.build(progress)
    }

    /// Keeps an index in [`OpenOptions::index_folder`] for the next time. Returns its file; `None` without a folder.
    ///
    /// # Errors
    /// If the system refuses.
    pub fn keep_index(&self, built: &BuiltIndex) -> Result<Option<PathBuf>, FormatError> {
        self.place.as_ref().map(|place| built.keep(place)).transpose()
    }

    /// The file of its index, if there is one.
    pub fn index_file(&self) -> Option<PathBuf> {
        self.index.as_ref().and(self.place.as_ref()).map(IndexPlace::file)
    }
}

/// Opens `source`, as [`crate::open`] does, to be read by pages. A level of a pyramid may have up to 32 768 voxels a
/// side. What is kept of the file beside the base, such as decoded chunks, takes at most an eighth of the memory.
///
/// # Errors
/// The file cannot be read, or not in any order. The message is one line.
pub fn open_paged(source: &str, options: &OpenOptions) -> Result<PagedFile, FormatError> {
    let unsupported = |found, expected| {
        let path = shown(Path::new(source));
        Err(FormatError::Unsupported { path, found, expected })
    };
    if source.starts_with("builtin:") {
        return unsupported("a built-in volume", "a file to read by pages");
    }
    if options.reading.labels.is_some() {
        return unsupported("labels over a volume that is read by pages", "the volume alone");
    }
    if options.reading.thin.is_some_and(|thin| thin > 1) || options.selection.level.is_some() {
        return unsupported("one level or a share of the voxels", "all levels, to read them by pages");
    }
    let (opened, is_new) = opened_once(source, options)?;
    // The levels of an index that was made just now are used at once.
    if is_new && opened.pages.mean_plan().is_some() {
        return Ok(opened_once(source, options)?.0);
    }
    Ok(opened)
}

/// Opens a volume. Returns whether its index was made and kept just now.
fn opened_once(source: &str, options: &OpenOptions) -> Result<(PagedFile, bool), FormatError> {
    let LevelsOfFile { path, place, of_file, of_index } = levels_of(source, options)?;
    let with_index = |of_index: Vec<PageLevel>| -> Result<(Base, Vec<PageLevel>), FormatError> {
        let mut levels = [&of_file[..], &of_index].concat();
        let base = Base::read(&mut levels, &path, options)?;
        Ok((base, levels))
    };
    let has_means = !of_index.is_empty();
    let (base, levels) = match with_index(of_index) {
        // Levels that are damaged count as none.
        Err(FormatError::Data { .. } | FormatError::Io { .. }) if has_means => with_index(Vec::new()),
        found => found,
    }?;
    let mut pages = FilePages::new(levels, &base);
    let (meaning, max_bytes, cancel) = (options.reading.voxels, options.max_bytes, options.cancel);
    let request =
        IndexRequest { pages: &pages, path: &path, place: place.as_ref(), meaning, max_bytes, cancel };
    let (index, is_new) = known_index(&request, options)?;
    let base = base.into_volume(index.as_ref(), &path, options)?;
    pages.complete(&base);
    let pages = Arc::new(pages);
    // Nobody notices when a file of the web changes.
    let noted = place.clone().filter(|_| index.is_none() && !is_address(&path.to_string_lossy()));
    let noted = noted.and_then(|place| NotedPages::new(Arc::clone(&pages), place));
    let source = match noted {
        Some(noted) => Arc::new(noted) as Arc<dyn PageSource>,
        None => Arc::clone(&pages) as Arc<dyn PageSource>,
    };
    let index = index.map(Arc::new);
    Ok((PagedFile { base, source, index, pages, path, place, meaning, max_bytes }, is_new))
}

/// The levels of a file, and those that its index keeps.
struct LevelsOfFile {
    path: PathBuf,
    place: Option<IndexPlace>,
    of_file: Vec<PageLevel>,
    of_index: Vec<PageLevel>,
}

fn levels_of(source: &str, options: &OpenOptions) -> Result<LevelsOfFile, FormatError> {
    let (path, file) = open_source(source, options)?;
    let of_file = page_levels(file.boxes(&path)?, &path, options)?;
    let place = IndexPlace::of(&*file, &path, options.selection.region, options);
    let find = || {
        let [finest] = &of_file[..] else { return None };
        let plan = MeanPlan::of(finest)?;
        let file = place.as_ref()?.read_means(&plan, finest.chosen.channels.len())?;
        // What the person says of the voxels goes first.
        let is_right = options.reading.voxels.is_none_or(|m| file.are_labels() == (m == Meaning::Labels));
        is_right.then(|| file.levels(&plan, finest))
    };
    let of_index = find().unwrap_or_default();
    Ok(LevelsOfFile { path, place, of_file, of_index })
}

/// The pages of `source` by its header and its index; `None` if it cannot be read by pages.
pub fn page_count(source: &str, options: &OpenOptions) -> Option<PageCount> {
    if source.starts_with("builtin:") {
        return None;
    }
    let LevelsOfFile { of_file, of_index, .. } = levels_of(source, options).ok()?;
    let pages = |n: u32| u64::from(n.saturating_sub(1).div_ceil(PAGE_CELLS).max(1));
    let finest = of_file.first()?.shape.dims.into_iter().map(pages).product();
    let mut levels: Vec<PageLevel> = of_file.into_iter().chain(of_index).collect();
    let num_levels = levels.len() as u32;
    let bytes_to_open = bytes_to_open(&mut levels, options.max_bytes);
    Some(PageCount { levels: num_levels, finest, bytes_to_open })
}

/// Most voxels along an axis of a volume that is read by pages.
const MAX_SIDE: u64 = 1 << 15;
