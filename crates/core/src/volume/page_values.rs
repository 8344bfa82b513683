//! The values of a volume that is read by pages: of the finest page that is known, or that can be read.

use std::collections::HashMap;
use std::sync::Arc;

use glam::Vec3;

use super::grid::{Volume, Voxels};
use super::pages::Page;
use super::pyramid::{PAGE_CELLS, PAGE_POINTS, PageId, PageVoxels, Pyramid, PyramidLevel};

/// A voxel that holds a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FoundVoxel {
    /// Indices of the finest level's voxel there.
    pub index: [u32; 3],
    /// The value.
    pub value: f32,
    /// The level that the value is of, 0 for the finest.
    pub level: u8,
}

/// Values at points of world space.
pub trait ValuesAt {
    /// The voxel that holds a point; none outside the volume, and where a part of one has no voxels.
    fn voxel(&mut self, point: Vec3) -> Option<FoundVoxel>;

    /// The value mixed from the eight voxels around a point; none outside the volume.
    fn between(&mut self, point: Vec3) -> Option<f32>;
}

/// Viewers know the finest level's voxels.
pub(super) fn finest_voxel(volume: &Volume, point: Vec3) -> [u32; 3] {
    let dims = volume.finest_dims();
    // A point on a border belongs to the same voxel as in a whole volume.
    let at = point / volume.finest_spacing() + Vec3::from_array(dims.map(|d| d as f32)) * 0.5;
    std::array::from_fn(|i| (at[i].max(0.0) as u32).min(dims[i] - 1))
}

/// The values of the first channel of a volume that is read by pages.
pub struct PageValues<'a> {
    base: &'a Volume,
    pyramid: &'a Pyramid,
    known: &'a PageFinder<'a>,
    /// Pages of coarser levels are read at this one.
    level: u8,
    read: Option<&'a PageReader<'a>>,
}

/// The finest page in memory that stands for a page of the finest level.
pub type PageFinder<'a> = dyn Fn([u32; 3]) -> Arc<Page> + Sync + 'a;
/// Reads a page of the first channel; `None` if it cannot.
pub type PageReader<'a> = dyn Fn(PageId) -> Option<PageVoxels> + Sync + 'a;

impl<'a> PageValues<'a> {
    /// The values of pages in memory. `base` is the coarsest level.
    pub fn known(base: &'a Volume, pyramid: &'a Pyramid, known: &'a PageFinder<'a>) -> Self {
        Self { base, pyramid, known, level: u8::MAX, read: None }
    }

    /// The same, but what is coarser than `level` is read there.
    pub fn reading(self, level: u8, read: &'a PageReader<'a>) -> Self {
        Self { level, read: Some(read), ..self }
    }

    /// The coarsest level.
    pub fn base(&self) -> &'a Volume {
        self.base
    }

    /// Reads values one after the other.
    pub fn cursor(&self) -> PageCursor<'_> {
        PageCursor { values: self, read: HashMap::new(), here: None, coarsest: 0 }
    }
}

/// Reads values. Few pages are kept between two of them.
pub struct PageCursor<'a> {
    values: &'a PageValues<'a>,
    read: HashMap<PageId, Option<Arc<PageVoxels>>>,
    /// The page of the finest level in which the last value lay, and what stood for it.
    here: Option<([u32; 3], Held)>,
    coarsest: u8,
}

#[derive(Clone)]
struct Held {
    id: PageId,
    level: PyramidLevel,
    first: [u32; 3],
    voxels: HeldVoxels,
    /// Labels are not mixed.
    are_labels: bool,
}

#[derive(Clone)]
enum HeldVoxels {
    Known(Arc<Page>),
    Read(Arc<PageVoxels>),
}

impl Held {
    fn voxels(&self) -> &Voxels {
        match &self.voxels {
            HeldVoxels::Known(page) => page.volume.voxels(),
            HeldVoxels::Read(page) => &page.voxels,
        }
    }

    /// Where an index of the finest level lies between voxels of this one.
    fn place(&self, index: Vec3) -> [f32; 3] {
        std::array::from_fn(|i| {
            let at = (index[i] - self.level.first[i]) / self.level.factor[i] as f32;
            at.clamp(0.0, (self.level.dims[i] - 1) as f32)
        })
    }

    /// The page's voxel of an index of the level.
    fn local(&self, axis: usize, at: u32) -> usize {
        at.min(self.level.dims[axis] - 1).saturating_sub(self.first[axis]).min(PAGE_POINTS - 1) as usize
    }

    fn stored(&self, index: Vec3) -> f64 {
        let (mut low, mut high, mut share) = ([0; 3], [0; 3], [0.0; 3]);
        let are_labels = self.are_labels;
        for (i, at) in self.place(index).into_iter().enumerate() {
            (low[i], high[i]) = (self.local(i, at as u32), self.local(i, at as u32 + 1));
            share[i] = f64::from(at) - f64::from(at as u32);
            share[i] = if are_labels { share[i].round() } else { share[i] };
        }
        match self.voxels() {
            Voxels::U8(v) => mixed(v, low, high, share),
            Voxels::U16(v) => mixed(v, low, high, share),
            Voxels::F32(v) => mixed(v, low, high, share),
        }
    }

    /// The number of the voxel whose centre is nearest.
    fn nearest(&self, index: Vec3) -> f32 {
        let at = self.place(index);
        let [x, y, z] = std::array::from_fn(|i| self.local(i, at[i].round() as u32));
        let side = PAGE_POINTS as usize;
        self.voxels().get((z * side + y) * side + x)
    }
}

/// The number between the voxels of a page.
fn mixed<T: Copy + Into<f64>>(voxels: &[T], low: [usize; 3], high: [usize; 3], share: [f64; 3]) -> f64 {
    let side = PAGE_POINTS as usize;
    let voxel = |x: usize, y: usize, z: usize| -> f64 { voxels[(z * side + y) * side + x].into() };
    let mix = |a: f64, b: f64, t: f64| a + (b - a) * t;
    let along = |y: usize, z: usize| mix(voxel(low[0], y, z), voxel(high[0], y, z), share[0]);
    let face = |z: usize| mix(along(low[1], z), along(high[1], z), share[1]);
    mix(face(low[2]), face(high[2]), share[2])
}

impl PageCursor<'_> {
    /// The stored number at an index of the finest level, mixed from the eight voxels around it.
    pub fn stored(&mut self, index: Vec3) -> f64 {
        self.held(index).stored(index)
    }

    /// The coarsest level of all values so far.
    pub fn coarsest(&self) -> u8 {
        self.coarsest
    }

    fn held(&mut self, index: Vec3) -> &Held {
        let grid = self.values.pyramid.pages(0);
        let at = std::array::from_fn(|i| (index[i].max(0.0) as u32 / PAGE_CELLS).min(grid[i] - 1));
        let held = match self.here.take() {
            Some((here, held)) if here == at => held,
            _ => self.find(at),
        };
        self.coarsest = self.coarsest.max(held.id.level);
        &self.here.insert((at, held)).1
    }

    fn find(&mut self, at: [u32; 3]) -> Held {
        let PageValues { base, pyramid, known, level, read } = *self.values;
        let known = known(at);
        let place = |id: PageId, voxels| {
            let level = *pyramid.level(id);
            Held { id, level, first: level.first_point(id.at), voxels, are_labels: base.info.are_labels }
        };
        if let Some(read) = read.filter(|_| known.id.level > level) {
            let id = pyramid.page_over(at, level);
            if self.read.len() >= MAX_READ && !self.read.contains_key(&id) {
                self.read.clear();
            }
            let found = self.read.entry(id).or_insert_with(|| read(id).map(Arc::new));
            if let Some(voxels) = found {
                return place(id, HeldVoxels::Read(voxels.clone()));
            }
        }
        place(known.id, HeldVoxels::Known(known))
    }

    /// The index of the finest level at a point; none outside the volume, where there may be `slack`.
    pub(super) fn index_of(&self, point: Vec3, slack: Vec3) -> Option<Vec3> {
        let base = self.values.base;
        let bounds = base.bounds();
        let is_inside = point.cmpge(bounds.min - slack).all() && point.cmple(bounds.max + slack).all();
        let dims = Vec3::from_array(base.finest_dims().map(|d| d as f32));
        let index = point / base.finest_spacing() + dims * 0.5 - 0.5;
        is_inside.then(|| index.clamp(Vec3::ZERO, dims - 1.0))
    }
}

impl ValuesAt for PageCursor<'_> {
    fn voxel(&mut self, point: Vec3) -> Option<FoundVoxel> {
        let base = self.values.base;
        self.index_of(point, Vec3::ZERO)?;
        let index = finest_voxel(base, point);
        let held = self.held(Vec3::from_array(index.map(|i| i as f32)));
        let stored = held.nearest(Vec3::from_array(index.map(|i| i as f32)));
        Some(FoundVoxel { index, value: base.value_from_stored(stored), level: held.id.level })
    }

    fn between(&mut self, point: Vec3) -> Option<f32> {
        let index = self.index_of(point, self.values.base.finest_spacing() * SLACK)?;
        Some(self.values.base.value_from_stored(self.stored(index) as f32))
    }
}

/// A point on a face may be rounded to the outside by this part of a voxel.
pub(super) const SLACK: f32 = 1e-3;
/// Pages that are kept between two values.
const MAX_READ: usize = 32;
