//! Which pages of a large volume are wanted, which are in memory, and which are read next. It reads nothing itself.
//!
//! Each viewer has a [`PagePlan`]. What is shown at rest depends on the plan only, however the pages arrive.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::grid::Volume;
use super::level_assembly::LevelAssembly;
use super::page_plan::PagePlan;
use super::pages::{Page, PageSet, PlanKey};
use super::pyramid::{PAGE_VOXELS, PageId, Pyramid};

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

/// Pages that are in memory while others replace them: one for each page that is read at once.
const SLACK: usize = 8;
/// Times that a page is read before it is given up.
const TRIES: u8 = 3;
