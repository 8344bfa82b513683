//! A level of a pyramid that is put together from its pages, to be held whole.
//!
//! Pages have voxels beside their cells and fill the memory only in part, so a level may fit whole where its pages do not.

use std::collections::HashSet;

use super::grid::{VolumeError, Voxels};
use super::pages::Page;
use super::pyramid::{PAGE_POINTS, PageId, PageVoxels, Pyramid, VoxelKind};

/// A level in the making. Its pages come in any order.
#[derive(Debug)]
pub struct LevelAssembly {
    level: u8,
    dims: [u32; 3],
    /// The voxels of each channel, x fastest.
    channels: Vec<PageVoxels>,
    /// The pages that are still to come.
    missing: HashSet<PageId>,
}

impl LevelAssembly {
    /// A level with nothing in it yet.
    pub fn new(pyramid: &Pyramid, level: u8, num_channels: usize) -> Self {
        let dims = pyramid.levels[usize::from(level)].dims;
        let num_voxels = dims.iter().map(|&n| n as usize).product();
        let voxels = || match pyramid.kind {
            VoxelKind::U8 => Voxels::U8(vec![0; num_voxels]),
            VoxelKind::U16 => Voxels::U16(vec![0; num_voxels]),
            VoxelKind::F32 => Voxels::F32(vec![0.0; num_voxels]),
        };
        let channels = (0..num_channels).map(|_| PageVoxels { voxels: voxels(), gaps: None }).collect();
        Self { level, dims, channels, missing: pyramid.page_ids(level).collect() }
    }

    /// The level.
    pub fn level(&self) -> u8 {
        self.level
    }

    /// The pages that are still to come.
    pub fn missing(&self) -> &HashSet<PageId> {
        &self.missing
    }

    /// Adds a page of the level. What pages share is the same in each.
    pub fn add(&mut self, pyramid: &Pyramid, page: &Page) {
        if !self.missing.remove(&page.id) {
            return;
        }
        let first = pyramid.first_point(page.id);
        let place = PlaceInLevel { dims: self.dims, first };
        for (i, PageVoxels { voxels, gaps }) in self.channels.iter_mut().enumerate() {
            let channel = page.channel(i);
            match (voxels, channel.voxels()) {
                (Voxels::U8(all), Voxels::U8(part)) => place.paste(part, all),
                (Voxels::U16(all), Voxels::U16(part)) => place.paste(part, all),
                (Voxels::F32(all), Voxels::F32(part)) => place.paste(part, all),
                // A page has the numbers of its pyramid.
                _ => {}
            }
            if let Some(of_page) = channel.gaps() {
                let num_voxels = self.dims.iter().map(|&n| n as usize).product();
                place.paste(&of_page.bytes, gaps.get_or_insert_with(|| vec![0; num_voxels]));
            }
        }
    }

    /// The level as one page.
    ///
    /// # Errors
    /// If the voxels have no finite meaning.
    pub fn finish(self, pyramid: &Pyramid) -> Result<Page, VolumeError> {
        Page::whole_level(pyramid, self.level, self.channels)
    }
}

/// Where the voxels of a page lie in its level.
struct PlaceInLevel {
    dims: [u32; 3],
    first: [u32; 3],
}

impl PlaceInLevel {
    fn paste<T: Copy>(&self, page: &[T], level: &mut [T]) {
        let side = PAGE_POINTS as usize;
        let [nx, ny, _] = self.dims.map(|n| n as usize);
        let [x, y, z] = self.first.map(|n| n as usize);
        let num = |i: usize| (self.dims[i] - self.first[i]).min(PAGE_POINTS) as usize;
        for (dz, dy) in (0..num(2)).flat_map(|dz| (0..num(1)).map(move |dy| (dz, dy))) {
            let (from, to) = ((dz * side + dy) * side, ((z + dz) * ny + y + dy) * nx + x);
            level[to..to + num(0)].copy_from_slice(&page[from..from + num(0)]);
        }
    }
}
