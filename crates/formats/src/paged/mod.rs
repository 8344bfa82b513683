//! Volumes that are read by pages: the coarsest level whole, the others as they are wanted.

mod base;
mod build;
pub(crate) mod flat;
mod index;
mod index_file;
mod levels;
mod noted;
mod pages;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use isinglass_core::volume::{PAGE_CELLS, PageRanges, PageSource, Paging, Volume};

use self::base::{Base, bytes_to_open};
use self::build::{built_index, known_index};
pub use self::index::{PageIndex, PageIndexBuilder};
pub(crate) use self::index_file::IndexPlace;
use self::levels::page_levels;
use self::noted::NotedPages;
use self::pages::FilePages;
use crate::error::{FormatError, shown};
use crate::outline::PageCount;
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

    /// Reads all pages of the finest level once for its index. `progress` is called with the fraction that has been
    /// read, 0 to 1.
    ///
    /// # Errors
    /// A page cannot be read, there are too many of them, or `cancel` was set.
    pub fn build_index(
        &self,
        progress: Option<&dyn Fn(f32)>,
        cancel: Option<&AtomicBool>,
    ) -> Result<PageIndex, FormatError> {
        built_index(&*self.pages, &self.path, progress, cancel)
    }

    /// Keeps an index in [`OpenOptions::index_folder`] for the next time. Returns its file; `None` without a folder.
    ///
    /// # Errors
    /// If the system refuses.
    pub fn keep_index(&self, index: &PageIndex) -> Result<Option<PathBuf>, FormatError> {
        self.place.as_ref().map(|place| place.write(index)).transpose()
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
    let (path, file) = open_source(source, options)?;
    let mut levels = page_levels(file.boxes(&path)?, &path, options)?;
    let base = Base::read(&mut levels, &path, options)?;
    let place = IndexPlace::of(&*file, &path, options.selection.region, options);
    let mut pages = FilePages::new(levels, &base);
    let index = known_index(&pages, place.as_ref(), &path, options)?;
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
    Ok(PagedFile { base, source, index: index.map(Arc::new), pages, path, place })
}

/// The pages of `source` by its header; `None` if it cannot be read by pages.
pub fn page_count(source: &str, options: &OpenOptions) -> Option<PageCount> {
    let is_file = !source.starts_with("builtin:");
    let (path, file) = open_source(source, options).ok().filter(|_| is_file)?;
    let mut levels = page_levels(file.boxes(&path).ok()?, &path, options).ok()?;
    let pages = |n: u32| u64::from(n.saturating_sub(1).div_ceil(PAGE_CELLS).max(1));
    let finest = levels.first()?.shape.dims.into_iter().map(pages).product();
    let num_levels = levels.len() as u32;
    let bytes_to_open = bytes_to_open(&mut levels, options.max_bytes);
    Some(PageCount { levels: num_levels, finest, bytes_to_open })
}

/// Most voxels along an axis of a volume that is read by pages.
const MAX_SIDE: u64 = 1 << 15;
