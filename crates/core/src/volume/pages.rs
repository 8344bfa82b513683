//! Pages in memory, and which of them shows each part of a volume.

use std::cmp::Reverse;
use std::sync::Arc;

use glam::Vec3;

use super::bricks::{BRICK, Bricks};
use super::grid::{Volume, VolumeError, VolumeInfo, Voxels};
use super::pyramid::{Finest, PAGE_POINTS, PageId, PageVoxels, Pyramid};
use crate::camera::Camera;
use crate::clip::Region;

/// A page in memory, with all channels; or all of a level in place of its pages ([`PageSet::of_level`]).
#[derive(Debug)]
pub struct Page {
    /// Which one it is; of a whole level the first one.
    pub id: PageId,
    /// Its voxels, [`PAGE_POINTS`] along each axis. It lies in the world where it belongs ([`Volume::voxel_origin`]).
    pub volume: Arc<Volume>,
    /// Minima and maxima of each channel.
    pub bricks: Vec<Bricks>,
    /// Whether each channel has nothing anywhere.
    pub are_nothing: Vec<bool>,
}

impl Page {
    /// A page of the voxels of each channel.
    ///
    /// # Errors
    /// If the voxels are not those of a page, or have no finite meaning.
    pub fn new(pyramid: &Pyramid, id: PageId, channels: Vec<PageVoxels>) -> Result<Self, VolumeError> {
        Self::of(pyramid, id, [PAGE_POINTS; 3], channels)
    }

    /// All of a level, of the voxels of each channel.
    ///
    /// # Errors
    /// If the voxels are not those of the level, or have no finite meaning.
    pub fn whole_level(pyramid: &Pyramid, level: u8, channels: Vec<PageVoxels>) -> Result<Self, VolumeError> {
        let dims = pyramid.levels[usize::from(level)].dims;
        Self::of(pyramid, PageId { level, at: [0; 3] }, dims, channels)
    }

    fn of(
        pyramid: &Pyramid,
        id: PageId,
        dims: [u32; 3],
        channels: Vec<PageVoxels>,
    ) -> Result<Self, VolumeError> {
        let is_nothing =
            |channel: &PageVoxels| channel.gaps.as_ref().is_some_and(|g| g.iter().all(|gap| *gap != 0));
        let are_nothing = channels.iter().map(is_nothing).collect();
        let mut volumes = Vec::new();
        for (channel, PageVoxels { voxels, gaps }) in channels.into_iter().enumerate() {
            volumes.push(pyramid.page_volume(id, dims, channel, PageVoxels { voxels, gaps })?);
        }
        let bricks = volumes.iter().map(Bricks::of).collect();
        let mut volumes = volumes.into_iter();
        let first = volumes.next().ok_or(VolumeError::Count { dims: [0; 3], expected: 1, found: 0 })?;
        let volume = Arc::new(first.with_others(volumes.map(Arc::new).collect())?);
        Ok(Self { id, volume, bricks, are_nothing })
    }

    /// A channel, from 0; the first if there is no such.
    pub fn channel(&self, channel: usize) -> &Arc<Volume> {
        channel.checked_sub(1).and_then(|i| self.volume.others().get(i)).map_or(&self.volume, |other| other)
    }

    /// Memory of the voxels of all channels, of their brightness, and of what is known of their bricks, bytes.
    pub fn num_bytes(&self) -> u64 {
        let of_brick = size_of::<(f32, f32)>() * self.bricks.len() + 2;
        let num_bricks = PAGE_POINTS.div_ceil(BRICK).pow(3) as usize;
        // A system hands out whole pages of its own.
        let rounding = SYSTEM_PAGE * (self.bricks.len() + 1);
        self.volume.bytes_in_memory() + (num_bricks * of_brick + rounding) as u64
    }
}

impl Pyramid {
    fn page_volume(
        &self,
        id: PageId,
        dims: [u32; 3],
        channel: usize,
        PageVoxels { voxels, gaps }: PageVoxels,
    ) -> Result<Volume, VolumeError> {
        self.check_kind(&voxels)?;
        let level = self.level(id);
        let (first, factor) = (self.first_point(id), level.factor.map(|f| f as f32));
        let place = |i: usize| level.first[i] + factor[i] * first[i] as f32;
        let spacing = self.spacing * Vec3::from_array(factor);
        let map = self.value_maps.get(channel).or(self.value_maps.first()).copied().unwrap_or((1.0, 0.0));
        let info = VolumeInfo { are_labels: self.info.are_labels, ..VolumeInfo::default() };
        let volume = Volume::new(dims, spacing, voxels, map, info)?;
        let volume = match gaps {
            Some(gaps) => volume.with_filled_gaps(gaps),
            None => volume,
        };
        let first = Vec3::from_array(std::array::from_fn(place));
        let (dims, spacing, stored_range, histogram) = (self.dims(), self.spacing, None, None);
        Ok(volume.with_finest(Finest { dims, spacing, first, stored_range, histogram }))
    }

    /// Writes into a table of the finest level's pages, x fastest, where a page lies.
    fn fill<T: Copy>(&self, page: PageId, table: &mut [T], value: T) {
        let (grid, factor) = (self.pages(0), self.level(page).factor);
        let span = |i: usize| {
            let start = (page.at[i] * factor[i]).min(grid[i]);
            start as usize..((page.at[i] + 1) * factor[i]).min(grid[i]) as usize
        };
        for (z, y) in span(2).flat_map(|z| span(1).map(move |y| (z, y))) {
            let row = (z * grid[1] as usize + y) * grid[0] as usize;
            table[row + span(0).start..row + span(0).end].fill(value);
        }
    }

    fn check_kind(&self, voxels: &Voxels) -> Result<(), VolumeError> {
        let (found, expected) = (voxels.kind(), self.kind);
        if found == expected { Ok(()) } else { Err(VolumeError::Kind { found, expected }) }
    }

    /// All pages of the coarsest level, cut from that level in memory.
    ///
    /// # Errors
    /// If `base` is not that level.
    pub fn base_pages(&self, base: &Volume) -> Result<Vec<Arc<Page>>, VolumeError> {
        let last = self.levels.len().saturating_sub(1);
        let dims = self.levels[last].dims;
        if base.dims() != dims {
            return Err(VolumeError::Channels(base.dims(), dims));
        }
        base.channels().try_for_each(|channel| self.check_kind(channel.voxels()))?;
        let page = |id| {
            let channels = base.channels().map(|channel| page_of(channel, self.first_point(id)));
            Page::new(self, id, channels.collect()).map(Arc::new)
        };
        self.page_ids(last as u8).map(page).collect()
    }
}

/// The page of a volume from a voxel on.
pub fn page_of(volume: &Volume, first: [u32; 3]) -> PageVoxels {
    let (dims, side) = (volume.dims(), PAGE_POINTS as usize);
    let voxels = match volume.voxels() {
        Voxels::U8(v) => Voxels::U8(cut(v, dims, first, side)),
        Voxels::U16(v) => Voxels::U16(cut(v, dims, first, side)),
        Voxels::F32(v) => Voxels::F32(cut(v, dims, first, side)),
    };
    let gaps = volume.gaps().map(|gaps| cut(&gaps.bytes, dims, first, side));
    PageVoxels { voxels, gaps: gaps.filter(|gaps| gaps.iter().any(|gap| *gap != 0)) }
}

/// A cube of `side` texels of a grid from `first` on. Beyond the grid its last texels repeat.
fn cut<T: Copy>(texels: &[T], dims: [u32; 3], first: [u32; 3], side: usize) -> Vec<T> {
    let at = |axis: usize, i: usize| (first[axis] as usize + i).min(dims[axis] as usize - 1);
    let mut out = Vec::with_capacity(side * side * side);
    for (z, y) in (0..side).flat_map(|z| (0..side).map(move |y| (z, y))) {
        let row = (at(2, z) * dims[1] as usize + at(1, y)) * dims[0] as usize;
        out.extend((0..side).map(|x| texels[row + at(0, x)]));
    }
    out
}

/// The unit in which systems hand out large blocks of memory, bytes.
const SYSTEM_PAGE: usize = 4096;

/// A viewer, by any number.
pub type PlanKey = u32;

/// What a viewer looks at.
#[derive(Clone, Debug, PartialEq)]
pub struct PageView {
    /// The camera of its frames.
    pub camera: Camera,
    /// The visible part of the volume.
    pub region: Region,
    /// Whether the camera rests.
    pub rests: bool,
}

/// The pages that stand for the parts of a volume: for each the finest one that is there.
#[derive(Debug)]
pub struct PageSet {
    pyramid: Arc<Pyramid>,
    /// Pages of the finest level along x, y, z.
    grid: [u32; 3],
    /// For each page of the finest level, x fastest, the place in `pages` of the one that stands for it.
    table: Vec<u32>,
    pages: Vec<Arc<Page>>,
    /// For each page of the finest level, whether it is looked at and a coarser one stands for it.
    rough: Vec<bool>,
    is_level: bool,
    seen_by: Option<(PlanKey, PageView)>,
}

impl PageSet {
    /// The set of some pages, of which those stand for their parts that `is_shown`: among them all of the coarsest
    /// level.
    pub fn new(pyramid: Arc<Pyramid>, mut pages: Vec<Arc<Page>>, is_shown: impl Fn(PageId) -> bool) -> Self {
        // Finer pages come last and win.
        pages.sort_by_key(|page| Reverse((page.id.level, page.id.at)));
        let grid = pyramid.pages(0);
        let mut table = vec![0; grid.iter().map(|n| *n as usize).product()];
        for (slot, page) in pages.iter().enumerate().filter(|(_, page)| is_shown(page.id)) {
            pyramid.fill(page.id, &mut table, slot as u32);
        }
        let rough = table.iter().map(|slot| pages[*slot as usize].id.level > 0).collect();
        Self { pyramid, grid, table, pages, rough, is_level: false, seen_by: None }
    }

    /// One level that is held whole, in place of all pages.
    pub fn of_level(pyramid: Arc<Pyramid>, level: Arc<Page>) -> Self {
        let grid = pyramid.pages(0);
        let num = grid.iter().map(|n| *n as usize).product();
        let rough = vec![level.id.level > 0; num];
        Self { pyramid, grid, table: vec![0; num], pages: vec![level], rough, is_level: true, seen_by: None }
    }

    /// The level that is held whole in place of all pages, if it is so.
    pub fn level(&self) -> Option<&Arc<Page>> {
        self.pages.first().filter(|_| self.is_level)
    }

    /// The same set, where only these pages are both looked at and not yet fine.
    pub fn with_rough(mut self, pages: impl Iterator<Item = PageId>) -> Self {
        self.rough.fill(false);
        pages.for_each(|page| self.pyramid.fill(page, &mut self.rough, true));
        self
    }

    /// For each page of the finest level, x fastest, whether it is looked at and a coarser one stands for it.
    pub fn rough(&self) -> &[bool] {
        &self.rough
    }

    /// The same set, which was chosen for a viewer.
    pub fn for_viewer(self, key: PlanKey, view: PageView) -> Self {
        Self { seen_by: Some((key, view)), ..self }
    }

    /// The viewer that the set was chosen for, and its view then.
    pub fn seen_by(&self) -> Option<&(PlanKey, PageView)> {
        self.seen_by.as_ref()
    }

    /// The levels.
    pub fn pyramid(&self) -> &Arc<Pyramid> {
        &self.pyramid
    }

    /// The pages, coarser ones first.
    pub fn pages(&self) -> &[Arc<Page>] {
        &self.pages
    }

    /// Pages of the finest level along x, y, z.
    pub fn grid(&self) -> [u32; 3] {
        self.grid
    }

    /// For each page of the finest level, x fastest, the place in [`Self::pages`] of the one that stands for it.
    pub fn table(&self) -> &[u32] {
        &self.table
    }

    /// The place in [`Self::table`] of a page of the finest level, which must exist.
    #[inline]
    pub fn cell(&self, [x, y, z]: [u32; 3]) -> usize {
        ((z as usize * self.grid[1] as usize) + y as usize) * self.grid[0] as usize + x as usize
    }

    /// The place in [`Self::pages`] of the page that stands for a page of the finest level, which must exist.
    pub fn slot(&self, at: [u32; 3]) -> usize {
        self.table[self.cell(at)] as usize
    }
}
