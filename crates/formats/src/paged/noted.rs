//! The pages of a file without an index. What a session reads of them makes the index on the way: it is kept when all of
//! the finest level was read, and used when the file is opened again.

use std::sync::{Arc, Mutex};

use isinglass_core::volume::{PageError, PageId, PageSource, PageVoxels, Pyramid};

use super::index::PageIndexBuilder;
use super::index_file::IndexPlace;
use super::pages::FilePages;

/// Pages that note the numbers of those that are read.
pub(super) struct NotedPages {
    pages: Arc<FilePages>,
    place: IndexPlace,
    /// `None` once all pages have come.
    noted: Mutex<Option<PageIndexBuilder>>,
}

impl NotedPages {
    /// `None` if the notes would take much memory.
    pub(super) fn new(pages: Arc<FilePages>, place: IndexPlace) -> Option<Self> {
        if PageIndexBuilder::most_bytes(pages.pyramid()) > MOST_BYTES {
            return None;
        }
        let noted = PageIndexBuilder::new(pages.pyramid())?;
        Some(Self { noted: Mutex::new(Some(noted)), pages, place })
    }

    fn note(&self, channel: usize, page: PageId, voxels: &PageVoxels) {
        // After a panic, the counts may be wrong: then there is no index.
        let Ok(mut noted) = self.noted.lock() else { return };
        let Some(builder) = noted.as_mut() else { return };
        builder.add(channel, page, voxels);
        if builder.num_missing() > 0 {
            return;
        }
        let whole = noted.take();
        drop(noted);
        // Parts that are absent may still be written, and nobody would notice.
        let whole = whole.filter(|_| self.pages.num_absent() == 0);
        if let Some(index) = whole.and_then(PageIndexBuilder::finish) {
            // A folder that cannot be written to costs only time.
            let _ = self.place.write(&index);
        }
    }
}

impl PageSource for NotedPages {
    fn pyramid(&self) -> &Pyramid {
        self.pages.pyramid()
    }

    fn read(&self, channel: usize, page: PageId) -> Result<PageVoxels, PageError> {
        let voxels = self.pages.read(channel, page)?;
        if page.level == 0 {
            self.note(channel, page, &voxels);
        }
        Ok(voxels)
    }
}

/// Most memory of the notes, bytes.
const MOST_BYTES: u64 = 32 << 20;
