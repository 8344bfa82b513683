//! Which pages of a large volume are wanted, which are in memory, and which are read next. It reads nothing itself.
//!
//! A viewer's *plan* refines the volume page by page, where a voxel is largest on the screen first, until its share of
//! the memory is full. A plan depends on the pose, the look and the memory only. So what is shown at rest depends on
//! nothing else, however the pages arrive. While the camera moves, a plan ends where a voxel is a pixel.

use std::collections::{BinaryHeap, HashMap, HashSet};
use std::sync::Arc;

use glam::Vec3;
use serde::{Deserialize, Serialize};

use super::grid::Volume;
use super::level_assembly::LevelAssembly;
use super::pages::{Page, PageSet, PageView, PlanKey};
use super::pyramid::{PAGE_CELLS, PAGE_VOXELS, PageId, Pyramid};
use crate::clip::Region;
use crate::space::Aabb;

/// The pages for a view.
#[derive(Clone, Debug, Default)]
pub struct PagePlan {
    /// The pages in the order in which they are read. Each follows a coarser one that it replaces.
    steps: Vec<PageId>,
    /// Those that nothing finer replaces.
    leaves: HashSet<PageId>,
    /// For each step that finer pages replace, these.
    parts: HashMap<PageId, Vec<PageId>>,
    /// Pages of the coarsest level that nothing finer replaces.
    coarsest: Vec<PageId>,
    /// The level that is held whole in place of pages.
    level: Option<u8>,
    /// Share of the view that the finest level does not fill for lack of memory, 0 to 1.
    coarse_share: f32,
    /// About the part of the picture that all of the view fills, in no unit.
    size: f32,
    /// Whether the camera rests.
    rests: bool,
}

/// How far a view is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PageProgress {
    /// Pages that the view wants.
    pub num_wanted: u32,
    /// Those that are in memory.
    pub num_resident: u32,
    /// Those that cannot be read.
    pub num_damaged: u32,
    /// Share of the view that is coarser than the finest level because there is no memory, 0 to 1.
    pub coarse_share: f32,
}

/// Progress of the part of a view that one of several processes reads.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PartProgress {
    /// How far it is.
    pub progress: PageProgress,
    /// About the part of the picture that it fills, in no unit.
    pub size: f32,
    /// Changes whenever a page comes, goes or is given up.
    pub version: u64,
}

impl PartProgress {
    /// Both parts together.
    pub fn and(self, other: Self) -> Self {
        let (a, b, size) = (self.progress, other.progress, self.size + other.size);
        let coarse = a.coarse_share * self.size + b.coarse_share * other.size;
        let progress = PageProgress {
            num_wanted: a.num_wanted.saturating_add(b.num_wanted),
            num_resident: a.num_resident.saturating_add(b.num_resident),
            num_damaged: a.num_damaged.saturating_add(b.num_damaged),
            coarse_share: if size > 0.0 { coarse / size } else { 0.0 },
        };
        Self { progress, size, version: self.version.wrapping_add(other.version) }
    }
}

impl PageProgress {
    /// Whether pages are still to come.
    pub fn is_loading(&self) -> bool {
        self.num_resident + self.num_damaged < self.num_wanted
    }

    /// The share of the wanted pages that are there or given up, 0 to 1.
    pub fn share(&self) -> f32 {
        (self.num_resident + self.num_damaged) as f32 / self.num_wanted.max(1) as f32
    }

    /// Whether the picture is that of the finest level.
    pub fn is_exact(&self) -> bool {
        !self.is_loading() && self.num_damaged == 0 && self.coarse_share == 0.0
    }
}

/// A page in the making of a plan, by the size of its voxels on the screen.
struct Candidate {
    pixels: f32,
    id: PageId,
}

impl PartialEq for Candidate {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Candidate {}

impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Candidate {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        let by_level = self.id.level.cmp(&other.id.level);
        self.pixels.total_cmp(&other.pixels).then(by_level).then_with(|| other.id.cmp(&self.id))
    }
}

impl PagePlan {
    /// The plan for a view with memory for so many pages beside those of the coarsest level. `is_visible` says whether
    /// anything of a page may be seen; it errs on the side of yes.
    pub fn of(
        pyramid: &Pyramid,
        view: &PageView,
        max_pages: usize,
        is_visible: impl Fn(PageId) -> bool,
    ) -> Self {
        let screen = Screen::of(pyramid, view);
        let last = pyramid.levels.len().saturating_sub(1) as u8;
        let mut plan = Self { rests: view.rests, ..Self::default() };
        let mut heap = BinaryHeap::new();
        let offer = |heap: &mut BinaryHeap<Candidate>, id: PageId| {
            let pixels = screen.pixels(id);
            heap.push(Candidate { pixels, id });
        };
        for id in places([0; 3], pyramid.pages(usize::from(last))).map(|at| PageId { level: last, at }) {
            if screen.sees(id) && is_visible(id) {
                offer(&mut heap, id);
            }
        }
        // Finer leaves are in the plan.
        let stays = |coarsest: &mut Vec<PageId>, id: PageId| {
            if id.level == last && last > 0 {
                coarsest.push(id);
            }
        };
        let enough = if view.rests { 0.0 } else { PIXELS_IN_MOTION };
        let (mut num_pages, mut coarse, mut all) = (0, 0.0, 0.0);
        // The coarsest level of which a page has no room for its parts. Pages of finer levels get none, either: nowhere is a
        // picture much coarser than beside.
        let mut least_level = 0;
        while let Some(Candidate { pixels, id }) = heap.pop() {
            let finer_level = id.level.checked_sub(1).filter(|_| pixels > enough);
            let Some(level) = finer_level else {
                all += screen.share(id);
                if id.level > 0 {
                    stays(&mut plan.coarsest, id);
                }
                continue;
            };
            let finer = parts(pyramid, id, level).filter(|id| screen.sees(*id) && is_visible(*id));
            let finer: Vec<PageId> = finer.collect();
            // The page that they replace is free once they are there.
            let freed = usize::from(id.level != last);
            if id.level < least_level || num_pages + finer.len() > max_pages + freed {
                least_level = least_level.max(id.level);
                coarse += screen.share(id);
                all += screen.share(id);
                stays(&mut plan.coarsest, id);
                continue;
            }
            num_pages = num_pages + finer.len() - freed;
            plan.leaves.remove(&id);
            for finer in &finer {
                plan.steps.push(*finer);
                plan.leaves.insert(*finer);
                offer(&mut heap, *finer);
            }
            plan.parts.insert(id, finer);
        }
        plan.coarse_share = if all > 0.0 { coarse / all } else { 0.0 };
        plan.size = all;
        plan
    }

    /// The same view by a level that is held whole, if pages would show a part of it coarser than that.
    pub fn or_level(self, pyramid: &Pyramid, level: u8) -> Self {
        let last = pyramid.levels.len().saturating_sub(1) as u8;
        let of_leaves = self.leaves.iter().map(|id| id.level).max().unwrap_or(0);
        let coarsest = if self.coarsest.is_empty() { of_leaves } else { last };
        if coarsest <= level {
            return self;
        }
        Self {
            steps: pyramid.page_ids(level).collect(),
            coarsest: pyramid.page_ids(last).collect(),
            level: Some(level),
            coarse_share: if level > 0 { 1.0 } else { 0.0 },
            size: self.size,
            rests: self.rests,
            ..Self::default()
        }
    }

    /// The pages that the view wants in the end.
    pub fn leaves(&self) -> &HashSet<PageId> {
        &self.leaves
    }
}

/// The camera over the finest level's indices.
struct Screen<'a> {
    pyramid: &'a Pyramid,
    view: &'a PageView,
    /// Inward normals and offsets of the sides of the picture.
    sides: Vec<(Vec3, f32)>,
    /// Pixels of a world unit at distance 1, or at any distance.
    pixels_per_unit: f32,
}

impl<'a> Screen<'a> {
    fn of(pyramid: &'a Pyramid, view: &'a PageView) -> Self {
        let camera = &view.camera;
        let size = camera.intrinsics;
        let (width, height) = (size.width as f32, size.height as f32);
        let corners = [[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]];
        let rays = corners.map(|[x, y]| camera.ray(x, y).0);
        let (middle, _) = camera.ray(0.5 * width, 0.5 * height);
        let inside = middle.origin + middle.dir * camera.far.max(1.0);
        let mut sides = Vec::new();
        for i in 0..4 {
            let (a, b) = (rays[i], rays[(i + 1) % 4]);
            let far = b.origin + b.dir * camera.far;
            let normal = a.dir.cross(far - a.origin).normalize_or_zero();
            let offset = normal.dot(a.origin);
            let turn = if normal.dot(inside) < offset { -1.0 } else { 1.0 };
            sides.push((normal * turn, offset * turn));
        }
        let forward = middle.dir;
        sides.push((forward, forward.dot(middle.origin) - size_of(pyramid) * BEHIND));
        let apart = {
            let (a, b) =
                (camera.ray(0.5 * width, 0.5 * height).0, camera.ray(0.5 * width + 1.0, 0.5 * height).0);
            if size.projection.is_orthographic() {
                a.origin.distance(b.origin)
            } else {
                a.dir.distance(b.dir)
            }
        };
        Self { pyramid, view, sides, pixels_per_unit: 1.0 / apart.max(f32::MIN_POSITIVE) }
    }

    /// The box of a page, world space.
    fn bounds(&self, id: PageId) -> Aabb {
        let factor = self.pyramid.level(id).factor;
        let dims = self.pyramid.dims();
        let edge = |i: usize, at: u32| {
            let index = (u64::from(at) * u64::from(factor[i] * PAGE_CELLS)) as f32;
            (index.min(dims[i] as f32 - 1.0) + 0.5 - 0.5 * dims[i] as f32) * self.pyramid.spacing[i]
        };
        // Half a voxel more: the outermost pages go on to the faces, and steps begin before their page.
        let more = self.pyramid.spacing;
        Aabb {
            min: Vec3::from_array(std::array::from_fn(|i| edge(i, id.at[i]))) - more,
            max: Vec3::from_array(std::array::from_fn(|i| edge(i, id.at[i] + 1))) + more,
        }
    }

    /// Whether anything of a page's box may be in the picture.
    fn sees(&self, id: PageId) -> bool {
        let bounds = self.bounds(id);
        let Region { bounds: region, normal, offset } = &self.view.region;
        let meets = bounds.min.cmple(region.max).all() && region.min.cmple(bounds.max).all();
        let half = (bounds.max - bounds.min) * 0.5;
        let center = bounds.center();
        let is_inside = |normal: Vec3, offset: f32| normal.dot(center) + normal.abs().dot(half) >= offset;
        meets
            && is_inside(*normal, *offset)
            && self.sides.iter().all(|(normal, offset)| is_inside(*normal, *offset))
    }

    fn distance(&self, bounds: &Aabb) -> f32 {
        let eye = self.view.camera.pose.eye;
        eye.clamp(bounds.min, bounds.max).distance(eye)
    }

    /// Pixels of a voxel of a page on the screen, at its nearest point.
    fn pixels(&self, id: PageId) -> f32 {
        let factor = Vec3::from_array(self.pyramid.level(id).factor.map(|f| f as f32));
        let voxel = (self.pyramid.spacing * factor).max_element();
        if self.view.camera.intrinsics.projection.is_orthographic() {
            return voxel * self.pixels_per_unit;
        }
        let near = self.pyramid.spacing.min_element();
        voxel * self.pixels_per_unit / self.distance(&self.bounds(id)).max(near)
    }

    /// About the part of the picture that a page fills, in no unit.
    fn share(&self, id: PageId) -> f32 {
        let bounds = self.bounds(id);
        let side = (bounds.max - bounds.min).length();
        if self.view.camera.intrinsics.projection.is_orthographic() {
            return side * side;
        }
        let relative = side / self.distance(&bounds).max(side);
        relative * relative
    }
}

fn size_of(pyramid: &Pyramid) -> f32 {
    let dims = pyramid.dims().map(|d| d as f32);
    (Vec3::from_array(dims) * pyramid.spacing).length()
}

/// The pages of a finer level within a page.
fn parts(pyramid: &Pyramid, id: PageId, level: u8) -> impl Iterator<Item = PageId> {
    let (coarse, fine) = (pyramid.level(id).factor, pyramid.levels[usize::from(level)].factor);
    let most = pyramid.pages(usize::from(level));
    let first = std::array::from_fn(|i| id.at[i] * (coarse[i] / fine[i]));
    let end = std::array::from_fn(|i| ((id.at[i] + 1) * (coarse[i] / fine[i])).min(most[i]));
    places(first, end).map(move |at| PageId { level, at })
}

/// All places of a box of the grid.
fn places(first: [u32; 3], end: [u32; 3]) -> impl Iterator<Item = [u32; 3]> {
    let [xs, ys, zs] = [0, 1, 2].map(|i| first[i]..end[i]);
    zs.flat_map(move |z| {
        let xs = xs.clone();
        ys.clone().flat_map(move |y| xs.clone().map(move |x| [x, y, z]))
    })
}

/// A level that is held whole.
#[derive(Debug)]
enum WholeLevel {
    /// Its pages come.
    Assembly(LevelAssembly),
    /// All of them have come, and somebody makes it one page.
    Complete,
    /// It is there.
    Page(Arc<Page>),
}

/// The pages in memory and the plans of all viewers.
#[derive(Debug)]
pub struct Residency {
    pyramid: Arc<Pyramid>,
    base: Vec<Arc<Page>>,
    resident: HashMap<PageId, Arc<Page>>,
    /// Levels that are held whole, or will be.
    levels: HashMap<u8, WholeLevel>,
    reading: HashSet<PageId>,
    /// Failures of each page so far; those that make no sense have [`TRIES`].
    failed: HashMap<PageId, u8>,
    /// Pages that had to go although parts of them were given up. They are not read again for these plans.
    dropped: HashSet<PageId>,
    plans: Vec<(PlanKey, PagePlan)>,
    max_pages: usize,
    /// What the renderer has memory for, beside the coarsest level.
    limit: usize,
    /// Which viewer's page is read next.
    turn: usize,
    /// See [`Self::version`].
    version: u64,
}

impl Residency {
    /// Begins with the pages of the coarsest level, and memory for so many others.
    pub fn new(pyramid: Arc<Pyramid>, base: Vec<Arc<Page>>, max_pages: usize) -> Self {
        let (resident, levels, reading, failed, dropped) = Default::default();
        Self {
            pyramid,
            base,
            resident,
            levels,
            reading,
            failed,
            dropped,
            plans: Vec::new(),
            max_pages,
            limit: usize::MAX,
            turn: 0,
            version: 0,
        }
    }

    /// The levels.
    pub fn pyramid(&self) -> &Arc<Pyramid> {
        &self.pyramid
    }

    /// There is memory for at most so many pages in all, those of the coarsest level among them. Returns whether that is
    /// less than was known.
    pub fn limit(&mut self, most: usize) -> bool {
        let before = self.limit;
        self.limit = before.min(most.saturating_sub(self.base.len()));
        self.max_pages = self.max_pages.min(self.limit);
        self.evict();
        self.limit < before
    }

    /// Pages that one more viewer's plan may take.
    pub fn share(&self, key: PlanKey) -> usize {
        // While a page is replaced, it and some of its parts are in memory.
        self.fair_share(key).saturating_sub(SLACK)
    }

    fn fair_share(&self, key: PlanKey) -> usize {
        let others = self.plans.iter().filter(|(known, _)| *known != key).count();
        self.max_pages / (others + 1)
    }

    /// The finest level that one more viewer's share of the memory holds whole; none if that is the coarsest.
    pub fn level_that_fits(&self, key: PlanKey) -> Option<u8> {
        // One page is beside it while it is read.
        let (share, last) = (self.fair_share(key).checked_sub(1)?, self.base.first()?.id.level);
        let can_be_read = |level: &u8| {
            let has_failed = |id: &PageId| id.level == *level && self.has_failed(*id);
            let dims = self.pyramid.levels[usize::from(*level)].dims;
            dims.iter().all(|n| *n <= Volume::MAX_SIDE) && !self.failed.keys().any(has_failed)
        };
        (0..last).find(|level| self.pages_of_level(*level) <= share).filter(can_be_read)
    }

    /// As many pages as take the memory of a level that is held whole.
    fn pages_of_level(&self, level: u8) -> usize {
        let Some(page) = self.base.first() else { return usize::MAX };
        let num_voxels: u64 =
            self.pyramid.levels[usize::from(level)].dims.iter().map(|&n| u64::from(n)).product();
        let bytes_of_voxel = page.volume.bytes_in_memory().div_ceil(PAGE_VOXELS as u64);
        (num_voxels * bytes_of_voxel).div_ceil(page.num_bytes()) as usize
    }

    /// There is memory for so many pages from now on. All plans are forgotten, and the finest pages go as far as there is
    /// no room.
    pub fn set_room(&mut self, max_pages: usize) {
        self.max_pages = max_pages.min(self.limit);
        self.version += 1;
        self.plans.clear();
        self.evict();
    }

    /// The pages in memory beside those of the coarsest level, and the levels that are held whole.
    pub fn pages(&self) -> impl Iterator<Item = &Arc<Page>> {
        let levels = self.levels.values().filter_map(|level| match level {
            WholeLevel::Page(level) => Some(level),
            WholeLevel::Assembly(_) | WholeLevel::Complete => None,
        });
        self.resident.values().chain(levels)
    }

    /// A viewer has another plan.
    pub fn set_plan(&mut self, key: PlanKey, plan: PagePlan) {
        self.dropped.clear();
        match self.plans.iter_mut().find(|(known, _)| *known == key) {
            Some((_, before)) => *before = plan,
            None => self.plans.push((key, plan)),
        }
        self.evict();
    }

    /// A viewer has left.
    pub fn forget(&mut self, key: PlanKey) {
        self.plans.retain(|(known, _)| *known != key);
        self.evict();
    }

    /// The page to read next. It counts as being read until `insert` or `fail`.
    pub fn take_next(&mut self) -> Option<PageId> {
        if self.num_pages() >= self.max_pages {
            return None;
        }
        let num = self.plans.len();
        for i in 0..num {
            let place = (self.turn + i) % num;
            let found =
                self.plans[place].1.steps.iter().find(|id| self.is_missing(&self.plans[place].1, **id));
            if let Some(id) = found.copied() {
                self.turn = (place + 1) % num;
                self.reading.insert(id);
                return Some(id);
            }
        }
        None
    }

    /// Whether a step of a plan is still to be read: finer pages do not stand for it.
    fn is_missing(&self, plan: &PagePlan, id: PageId) -> bool {
        let is_known = self.resident.contains_key(&id) || self.reading.contains(&id);
        let is_open = !is_known && !self.has_failed(id) && !self.dropped.contains(&id);
        if let Some(level) = plan.level {
            return is_open
                && matches!(self.levels.get(&level), Some(WholeLevel::Assembly(a)) if a.missing().contains(&id));
        }
        is_open && (plan.leaves.contains(&id) || !self.has_parts(plan, id))
    }

    /// Whether a page was given up.
    pub fn has_failed(&self, id: PageId) -> bool {
        self.failed.get(&id).is_some_and(|tries| *tries >= TRIES)
    }

    /// Whether finer pages fill all that a plan wants of a page.
    fn has_parts(&self, plan: &PagePlan, id: PageId) -> bool {
        let filled = |id: &PageId| self.resident.contains_key(id) || self.has_parts(plan, *id);
        plan.parts.get(&id).is_some_and(|parts| parts.iter().all(filled))
    }

    /// A page was read. Returns the level that it completes, to be made one page and inserted by `insert_level`.
    pub fn insert(&mut self, page: Arc<Page>) -> Option<LevelAssembly> {
        self.reading.remove(&page.id);
        self.failed.remove(&page.id);
        self.version += 1;
        let level = page.id.level;
        if let Some(WholeLevel::Assembly(assembly)) = self.levels.get_mut(&level) {
            assembly.add(&self.pyramid, &page);
            let is_complete = assembly.missing().is_empty();
            let complete = is_complete.then(|| self.levels.insert(level, WholeLevel::Complete)).flatten();
            return match complete {
                Some(WholeLevel::Assembly(assembly)) => Some(assembly),
                _ => None,
            };
        }
        self.resident.insert(page.id, page);
        self.evict();
        None
    }

    /// A level is there whole.
    pub fn insert_level(&mut self, level: Arc<Page>) {
        if let Some(known @ WholeLevel::Complete) = self.levels.get_mut(&level.id.level) {
            *known = WholeLevel::Page(level);
            self.version += 1;
        }
    }

    /// A page could not be read. Whether it is given up: at once if trying again is of no use.
    pub fn fail(&mut self, id: PageId, is_final: bool) -> bool {
        self.reading.remove(&id);
        let tries = self.failed.entry(id).or_default();
        *tries = if is_final { TRIES } else { tries.saturating_add(1) };
        let is_over = *tries >= TRIES;
        self.version += u64::from(is_over);
        is_over
    }

    /// Forgets pages that no viewer wants, and those that finer ones replace, as far as there is no room.
    fn evict(&mut self) {
        let wanted: HashSet<u8> = self.plans.iter().filter_map(|(_, plan)| plan.level).collect();
        self.levels.retain(|level, _| wanted.contains(level));
        for level in wanted {
            let num_channels = self.base.first().map_or(1, |page| page.bricks.len());
            let assembly = || WholeLevel::Assembly(LevelAssembly::new(&self.pyramid, level, num_channels));
            self.levels.entry(level).or_insert_with(assembly);
        }
        let num = self.num_pages();
        if num + SLACK <= self.max_pages {
            return;
        }
        let is_wanted = |id: &PageId| {
            self.plans.iter().any(|(_, plan)| {
                plan.leaves.contains(id) || (plan.parts.contains_key(id) && !self.has_parts(plan, *id))
            })
        };
        let mut unwanted: Vec<PageId> = self.resident.keys().copied().filter(|id| !is_wanted(id)).collect();
        if unwanted.is_empty() && num >= self.max_pages {
            // Pages that stand for parts that were given up would stay for good, and others could never be read.
            unwanted = self.resident.keys().copied().filter(|id| self.has_failed_parts(*id)).collect();
            self.dropped.extend(&unwanted);
        }
        // The finest ones go first, as coarser ones serve more. A few more go, so that not every page asks again.
        unwanted.sort_unstable();
        for id in unwanted.iter().take((num + 2 * SLACK).saturating_sub(self.max_pages)) {
            self.resident.remove(id);
            self.version += 1;
        }
    }

    /// Whether a page is in memory only for parts that were given up.
    fn has_failed_parts(&self, id: PageId) -> bool {
        let is_there = |id: &PageId| self.resident.contains_key(id) || self.has_failed(*id);
        self.plans.iter().all(|(_, plan)| {
            !plan.leaves.contains(&id) && plan.parts.get(&id).is_none_or(|parts| parts.iter().all(is_there))
        })
    }

    /// The pages to show to a viewer. At rest they are those of its plan alone, whatever else is in memory.
    pub fn set(&self, key: PlanKey) -> PageSet {
        let plan = self.plans.iter().find(|(known, _)| *known == key).map(|(_, plan)| plan);
        let level = plan.and_then(|plan| self.levels.get(&plan.level?));
        if let Some(WholeLevel::Page(level)) = level {
            return PageSet::of_level(self.pyramid.clone(), level.clone());
        }
        let is_shown = |id: PageId| {
            let is_base = usize::from(id.level) + 1 == self.pyramid.levels.len();
            is_base
                || plan.is_none_or(|plan| {
                    !plan.rests || plan.leaves.contains(&id) || plan.parts.contains_key(&id)
                })
        };
        // A set keeps its pages in memory.
        let resident = self.resident.values().filter(|page| is_shown(page.id));
        let pages = self.base.iter().chain(resident).cloned().collect();
        let set = PageSet::new(self.pyramid.clone(), pages, is_shown);
        let Some(plan) = plan else { return set };
        let is_rough = |id: &&PageId| id.level > 0 || !self.resident.contains_key(id);
        let rough = plan.leaves.iter().filter(is_rough).chain(&plan.coarsest).copied();
        set.with_rough(rough)
    }

    /// The finest page in memory that stands for a page of the finest level, which must exist.
    pub fn finest(&self, at: [u32; 3]) -> Arc<Page> {
        let last = self.pyramid.levels.len().saturating_sub(1) as u8;
        let resident = (0..last).find_map(|level| self.resident.get(&self.pyramid.page_over(at, level)));
        let base = || {
            let id = self.pyramid.page_over(at, last);
            self.base.iter().find(|page| page.id == id)
        };
        resident.or_else(base).unwrap_or(&self.base[0]).clone()
    }

    /// Changes whenever a page comes, goes or is given up.
    pub fn version(&self) -> u64 {
        self.version
    }

    /// How far a viewer's plan is.
    pub fn progress(&self, key: PlanKey) -> PartProgress {
        let Some((_, plan)) = self.plans.iter().find(|(known, _)| *known == key) else {
            return PartProgress { version: self.version, ..PartProgress::default() };
        };
        if let Some(level) = plan.level {
            return self.progress_of_level(plan, level);
        }
        let count =
            |is_so: &dyn Fn(&PageId) -> bool| plan.leaves.iter().filter(|id| is_so(id)).count() as u32;
        let progress = PageProgress {
            num_wanted: plan.leaves.len() as u32,
            num_resident: count(&|id| self.resident.contains_key(id)),
            num_damaged: count(&|id| !self.resident.contains_key(id) && self.has_failed(*id)),
            coarse_share: plan.coarse_share,
        };
        PartProgress { progress, size: plan.size, version: self.version }
    }

    fn progress_of_level(&self, plan: &PagePlan, level: u8) -> PartProgress {
        let num_wanted = plan.steps.len() as u32;
        let num_missing = match self.levels.get(&level) {
            Some(WholeLevel::Assembly(assembly)) => assembly.missing().len() as u32,
            Some(WholeLevel::Page(_)) => 0,
            Some(WholeLevel::Complete) | None => 1,
        };
        let progress = PageProgress {
            num_wanted,
            num_resident: num_wanted.saturating_sub(num_missing),
            num_damaged: 0,
            coarse_share: plan.coarse_share,
        };
        PartProgress { progress, size: plan.size, version: self.version }
    }

    /// Pages in memory, those that are being read, and as many as whole levels take.
    pub fn num_pages(&self) -> usize {
        let of_levels: usize = self.levels.keys().map(|level| self.pages_of_level(*level)).sum();
        self.resident.len() + self.reading.len() + of_levels
    }
}

/// While the camera moves, voxels need not be smaller on the screen.
const PIXELS_IN_MOTION: f32 = 1.0;
/// How far behind the eye a page may lie, in sizes of the volume: boxes are tested by their nearest corners.
const BEHIND: f32 = 1e-3;
/// Pages that are in memory while others replace them: one for each page that is read at once.
const SLACK: usize = 8;
/// Times that a page is read before it is given up.
const TRIES: u8 = 3;
