//! Volumes that are read by pages: the coarsest level whole, the others as they are wanted.

mod base;
pub(crate) mod flat;
mod levels;
mod pages;

use std::sync::Arc;

use isinglass_core::volume::{PageSource, Volume};

use self::base::Base;
use self::levels::page_levels;
use self::pages::FilePages;
use crate::error::{FormatError, shown};
use crate::source::{OpenOptions, open_source};

/// A volume whose pages are read as they are wanted.
#[derive(Clone)]
pub struct PagedFile {
    /// The coarsest level, whole in memory. It looks as the finest one does: [`Volume::finest`].
    pub base: Volume,
    /// Reads pages of all levels. Channels are numbered as in [`Volume::channels`] of the base.
    pub source: Arc<dyn PageSource>,
    pages: Arc<FilePages>,
}

impl PagedFile {
    /// Parts of the file that are not there and have its fill value, as far as they were met.
    pub fn num_absent(&self) -> u64 {
        self.pages.num_absent()
    }
}

/// Opens `source`, as [`crate::open`] does, to be read by pages. A level of a pyramid may have up to 32 768 voxels a
/// side. What is kept of the file beside the base, such as decoded chunks, takes at most an eighth of the memory.
///
/// # Errors
/// The file cannot be read, or not in any order. The message is one line.
pub fn open_paged(source: &str, options: &OpenOptions) -> Result<PagedFile, FormatError> {
    let unsupported = |found, expected| {
        let path = shown(std::path::Path::new(source));
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
    let pages = Arc::new(FilePages::new(levels, &base));
    Ok(PagedFile { base: base.volume, source: Arc::clone(&pages) as Arc<dyn PageSource>, pages })
}

/// Most voxels along an axis of a volume that is read by pages.
const MAX_SIDE: u64 = 1 << 15;
