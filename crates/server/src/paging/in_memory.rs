//! A volume in memory that is read by pages, for tests.

use std::sync::Arc;

use isinglass_core::volume::{PageError, PageId, PageSource, PageVoxels, Paging, Pyramid, Volume, page_of};

struct InMemory {
    volume: Volume,
    pyramid: Pyramid,
}

impl PageSource for InMemory {
    fn pyramid(&self) -> &Pyramid {
        &self.pyramid
    }

    fn read(&self, _: usize, page: PageId) -> Result<PageVoxels, PageError> {
        Ok(page_of(&self.volume, self.pyramid.first_point(page)))
    }
}

/// The volume as the only level of its pages.
pub(crate) fn paged(volume: Volume) -> Volume {
    let source = Arc::new(InMemory { pyramid: Pyramid::of(&volume), volume: volume.clone() });
    volume.with_paging(Paging { source, ranges: None, max_bytes: 1 << 30, own: None })
}
