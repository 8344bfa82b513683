//! Pages of a volume that does not fit into memory: threads read what viewers look at, and frames show what is there.

use std::any::Any;
use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, Weak};

use isinglass_core::kernels::march::{Scene, SeenPages};
use isinglass_core::layer::Fineness;
use isinglass_core::session::admission::ViewerId;
use isinglass_core::volume::{
    Page, PageError, PageId, PagePlan, PageRanges, PageSet, PageSource, PageValues, PageView, Paging,
    PartProgress, PlanKey, Pyramid, Residency, Volume, VolumeError, VoxelBox,
};
use tokio::sync::watch;

/// The pages that a frame shows.
#[derive(Clone, Debug)]
pub struct FramePages {
    /// The pages.
    pub set: Arc<PageSet>,
    /// How far they are; a version changes with the pages in memory.
    pub part: PartProgress,
    /// Whether they are those of a resting camera.
    pub rests: bool,
    /// Whether another part of the file is read, for which the pages made room.
    pub is_paused: bool,
}

impl FramePages {
    /// How fine a frame of these pages is.
    pub fn fineness(&self) -> Fineness {
        if !self.rests || self.is_paused || self.part.progress.is_loading() {
            Fineness::Draft
        } else if self.part.progress.is_exact() {
            Fineness::Whole
        } else {
            Fineness::Bounded
        }
    }
}

/// Reads pages on threads of its own, which end with the last clone.
#[derive(Clone)]
pub struct Pager {
    shared: Arc<PagerThreads>,
    /// Ends the threads when the last pager is dropped.
    _ending: Arc<Ending>,
}

struct PagerThreads {
    source: Arc<dyn PageSource>,
    ranges: Option<Arc<dyn PageRanges>>,
    own: Option<VoxelBox>,
    num_channels: usize,
    max_bytes: u64,
    page_bytes: u64,
    max_pages: usize,
    state: Mutex<State>,
    /// Notified when there may be something to read.
    work: Condvar,
    changed: watch::Sender<u64>,
}

struct State {
    residency: Residency,
    views: HashMap<PlanKey, PlannedView>,
    /// What the newest looks leave visible, by known values.
    seen: Vec<(Scene, Arc<SeenPages>)>,
    sets: HashMap<PlanKey, (u64, Arc<PageSet>)>,
    /// How far the parts of other processes are now, and were in the newest frame.
    others: HashMap<PlanKey, [PartProgress; 2]>,
    /// Changes with the pages of other processes.
    version_of_others: u64,
    /// What was shown before, as long as its memory is not free.
    remains: Remains,
    is_paused: bool,
    is_over: bool,
}

/// What a plan was made for.
struct PlannedView {
    view: PageView,
    /// Pages of the viewer's share of the memory, and the level that it holds whole.
    room: (usize, Option<u8>),
    seen: Option<Arc<SeenPages>>,
}

/// Parts of a volume that is no longer shown, with their bytes. Frames on their way may hold them for a while.
#[derive(Default)]
pub(crate) struct Remains(Vec<(Weak<dyn Any + Send + Sync>, u64)>);

impl Remains {
    /// A volume in memory.
    pub(crate) fn of_volume(volume: &Arc<Volume>) -> Self {
        Self(vec![Self::part(volume, volume.bytes_in_memory())])
    }

    fn part<T: Any + Send + Sync>(part: &Arc<T>, bytes: u64) -> (Weak<dyn Any + Send + Sync>, u64) {
        let weak: Weak<T> = Arc::downgrade(part);
        (weak, bytes)
    }

    /// Bytes of what is still there.
    fn bytes(&mut self) -> u64 {
        self.0.retain(|(part, _)| part.strong_count() > 0);
        self.0.iter().map(|(_, bytes)| bytes).sum()
    }
}

impl State {
    /// Changes with the pages of all processes.
    fn version(&self) -> u64 {
        self.residency.version().wrapping_add(self.version_of_others)
    }

    /// How far a viewer's pages are, those of other processes included.
    fn part(&self, key: PlanKey) -> PartProgress {
        let own = self.residency.progress(key);
        self.others.get(&key).map_or(own, |[others, _]| own.and(*others))
    }
}

struct Ending(Arc<PagerThreads>);

impl Drop for Ending {
    fn drop(&mut self) {
        self.0.state().is_over = true;
        self.0.work.notify_all();
    }
}

impl std::fmt::Debug for Pager {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Pager")
            .field("num_pages", &self.shared.state().residency.num_pages())
            .finish_non_exhaustive()
    }
}

impl Pager {
    /// Starts to read the pages of a volume; `None` if it is in memory whole.
    ///
    /// # Errors
    /// If the volume is not the coarsest level of its pages.
    pub fn of(base: &Volume) -> Result<Option<Self>, VolumeError> {
        base.paging().map(|paging| Self::start(paging.clone(), base)).transpose()
    }

    fn start(paging: Paging, base: &Volume) -> Result<Self, VolumeError> {
        let Paging { source, ranges, max_bytes, own } = paging;
        isinglass_formats::return_large_blocks();
        let pyramid = Arc::new(source.pyramid().clone());
        let pages = pyramid.base_pages(base)?;
        let num_channels = base.channels().count();
        let page_bytes = pages.first().map_or(1, |page| page.num_bytes().max(1));
        // The pages of the coarsest level count, too.
        let max_pages = ((max_bytes / page_bytes) as usize).saturating_sub(pages.len());
        let residency = Residency::new(pyramid, pages, max_pages);
        let (views, seen, sets, others) = Default::default();
        let (version_of_others, remains, is_paused, is_over) = (0, Remains::default(), false, false);
        let state =
            State { residency, views, seen, sets, others, version_of_others, remains, is_paused, is_over };
        let shared = Arc::new(PagerThreads {
            source,
            ranges,
            own,
            num_channels,
            max_bytes,
            page_bytes,
            max_pages,
            state: Mutex::new(state),
            work: Condvar::new(),
            changed: watch::channel(0).0,
        });
        let cores = std::thread::available_parallelism().map_or(2, usize::from);
        for i in 0..cores.clamp(2, MAX_READERS) {
            let shared = shared.clone();
            let read = move || shared.read();
            if let Err(e) = std::thread::Builder::new().name(format!("page {i}")).spawn(read) {
                tracing::error!("no thread to read pages: {e}");
            }
        }
        let ending = Arc::new(Ending(shared.clone()));
        Ok(Self { shared, _ending: ending })
    }

    /// Most memory of the pages, bytes.
    pub fn max_bytes(&self) -> u64 {
        self.shared.max_bytes
    }

    /// The renderer has memory for at most so many pages at once. Later views get no more. Returns whether that is less
    /// than was known.
    pub fn limit(&self, most: usize) -> bool {
        let is_less = self.shared.state().residency.limit(most);
        if is_less {
            tracing::warn!("the renderer has memory for {most} pages of the volume at once");
        }
        is_less
    }

    /// The pages for a viewer's next frame of `scene`. What is missing is read from now on.
    pub fn pages(&self, viewer: ViewerId, view: &PageView, scene: &Scene) -> FramePages {
        let key = viewer.0;
        let mut state = self.shared.state();
        // A process that has a part of the volume holds no level of all.
        let level = state.residency.level_that_fits(key).filter(|_| self.shared.own.is_none());
        let room = (state.residency.share(key), level);
        let seen = self.shared.seen(&mut state, scene);
        let is_same = |known: &PlannedView| {
            (&known.view, known.room) == (view, room) && same(known.seen.as_ref(), seen.as_ref())
        };
        if !state.views.get(&key).is_some_and(is_same) {
            let pyramid = state.residency.pyramid();
            let is_visible = |id: PageId| {
                self.shared.own.as_ref().is_none_or(|own| pyramid.meets(id, own))
                    && seen.as_ref().is_none_or(|seen| seen.sees(id))
            };
            let plan = PagePlan::of(pyramid, view, room.0, is_visible);
            let plan = match level {
                Some(level) => plan.or_level(pyramid, level),
                None => plan,
            };
            state.residency.set_plan(key, plan);
            state.views.insert(key, PlannedView { view: view.clone(), room, seen });
            state.sets.remove(&key);
            self.shared.work.notify_all();
        }
        let version = state.residency.version();
        let set = match state.sets.get(&key) {
            Some((known, set)) if *known == version => set.clone(),
            _ => {
                let set = Arc::new(state.residency.set(key).for_viewer(key, view.clone()));
                state.sets.insert(key, (version, set.clone()));
                set
            }
        };
        let (part, is_paused) = (state.residency.progress(key), state.is_paused);
        FramePages { set, part, rests: view.rests, is_paused }
    }

    /// The pages of a frame that several processes have made, with those of the others.
    pub(crate) fn with_others(&self, viewer: ViewerId, pages: FramePages) -> FramePages {
        let others = self.shared.state().others.get(&viewer.0).copied();
        FramePages { part: others.map_or(pages.part, |[_, others]| pages.part.and(others)), ..pages }
    }

    /// Takes note how far the parts of other processes are for a viewer: now, or in the frame that is being made.
    pub fn note_others(&self, key: PlanKey, others: PartProgress, in_frame: bool) {
        let version = {
            let mut state = self.shared.state();
            let known = state.others.entry(key).or_default();
            known[0] = others;
            if in_frame {
                known[1] = others;
            }
            state.version_of_others = others.version;
            state.version()
        };
        self.shared.changed.send_if_modified(|known| std::mem::replace(known, version) != version);
    }

    /// How far the own pages for a viewer are.
    pub fn own_progress(&self, key: PlanKey) -> PartProgress {
        self.shared.state().residency.progress(key)
    }

    /// The viewers that pages are read for.
    pub fn viewers(&self) -> Vec<PlanKey> {
        self.shared.state().views.keys().copied().collect()
    }

    /// Only these viewers are left.
    pub fn forget_others(&self, viewers: &[PlanKey]) {
        let gone = self.viewers().into_iter().filter(|key| !viewers.contains(key));
        gone.for_each(|key| self.forget(key));
    }

    /// The pages of a viewer's newest view, as they are now.
    pub fn shown(&self, viewer: ViewerId) -> Option<FramePages> {
        let key = viewer.0;
        let state = self.shared.state();
        let view = &state.views.get(&key)?.view;
        let (_, set) = state.sets.get(&key)?;
        let (part, is_paused) = (state.part(key), state.is_paused);
        Some(FramePages { set: set.clone(), part, rests: view.rests, is_paused })
    }

    /// Whether pages of a viewer's view are still to come.
    pub fn is_loading(&self, viewer: ViewerId) -> bool {
        self.shared.state().part(viewer.0).progress.is_loading()
    }

    /// A viewer has left.
    pub fn forget(&self, key: PlanKey) {
        let mut state = self.shared.state();
        state.residency.forget(key);
        state.views.remove(&key);
        state.sets.remove(&key);
        state.others.remove(&key);
    }

    /// Gives so many bytes back: until [`Self::resume`], frames have less fine pages.
    pub(crate) fn make_room(&self, bytes: u64) {
        let num_pages = usize::try_from(bytes.div_ceil(self.shared.page_bytes)).unwrap_or(usize::MAX);
        self.set_room(self.shared.max_pages.saturating_sub(num_pages), true);
    }

    /// Takes all of its memory again.
    pub(crate) fn resume(&self) {
        if self.shared.state().is_paused {
            self.set_room(self.shared.max_pages, false);
        }
    }

    /// Another volume is shown: reads no more, and returns the pages that somebody may still hold.
    pub(crate) fn end(&self) -> Remains {
        let page = |page: &Arc<Page>| Remains::part(page, page.num_bytes());
        let remains = self.shared.state().residency.pages().map(page).collect();
        self.set_room(0, true);
        Remains(remains)
    }

    /// Takes only the memory that what was shown before has left.
    pub(crate) fn follow(&self, remains: Remains) {
        self.shared.state().remains = remains;
    }

    fn set_room(&self, max_pages: usize, is_paused: bool) {
        let version = {
            let mut state = self.shared.state();
            state.is_paused = is_paused;
            state.residency.set_room(max_pages);
            state.views.clear();
            state.sets.clear();
            state.version()
        };
        self.shared.changed.send_replace(version);
        self.shared.work.notify_all();
    }

    /// The levels.
    pub(crate) fn pyramid(&self) -> &Pyramid {
        self.shared.source.pyramid()
    }

    /// What `work` makes of the finest values in memory. `base` is the coarsest level. With a level, pages that are coarser
    /// are read there for this alone, while they are `wanted`.
    pub(crate) fn with_values<T>(
        &self,
        base: &Volume,
        level: Option<u8>,
        wanted: &(dyn Fn() -> bool + Sync),
        work: impl FnOnce(&PageValues<'_>) -> T,
    ) -> T {
        let find = |at: [u32; 3]| self.shared.state().residency.finest(at);
        let read = |id: PageId| {
            let may_read = wanted() && !self.shared.state().residency.has_failed(id);
            let read = || self.shared.source.read(0, id).ok();
            let read = || catch_unwind(AssertUnwindSafe(read)).ok().flatten();
            may_read.then(read).flatten().filter(|page| self.pyramid().is_page(page))
        };
        let known = PageValues::known(base, self.pyramid(), &find);
        match level {
            Some(level) => work(&known.reading(level, &read)),
            None => work(&known),
        }
    }

    /// Notified when pages come or go.
    pub fn changes(&self) -> watch::Receiver<u64> {
        self.shared.changed.subscribe()
    }

    /// Waits until all pages of a view are there or given up, and returns them; soon after `is_wanted` turns false those
    /// so far.
    pub fn settled(
        &self,
        viewer: ViewerId,
        view: &PageView,
        scene: &Scene,
        is_wanted: &dyn Fn() -> bool,
    ) -> FramePages {
        loop {
            let pages = self.pages(viewer, view, scene);
            if !pages.part.progress.is_loading() || !is_wanted() {
                return pages;
            }
            std::thread::sleep(POLL);
        }
    }
}

impl PagerThreads {
    fn state(&self) -> MutexGuard<'_, State> {
        // Every change is one call of the residency, so a panic leaves it in order.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What a scene leaves visible, if the values of pages are known.
    fn seen(&self, state: &mut State, scene: &Scene) -> Option<Arc<SeenPages>> {
        let ranges = self.ranges.as_ref()?;
        if let Some((_, known)) = state.seen.iter().find(|(known, _)| known.is_seen_like(scene)) {
            return Some(known.clone());
        }
        let seen = Arc::new(SeenPages::of(state.residency.pyramid(), scene, &**ranges));
        state.seen.truncate(MAX_SEEN - 1);
        state.seen.insert(0, (scene.without_pages(), seen.clone()));
        Some(seen)
    }

    /// Reads pages until the pager ends.
    fn read(&self) {
        let mut state = self.state();
        loop {
            if state.is_over {
                return;
            }
            let has_room = self.has_room(&mut state);
            let Some(id) = (if has_room { state.residency.take_next() } else { None }) else {
                state = match has_room {
                    true => self.work.wait(state).unwrap_or_else(PoisonError::into_inner),
                    // Nobody tells when the last frame of what was shown before is gone.
                    false => self.work.wait_timeout(state, POLL).unwrap_or_else(PoisonError::into_inner).0,
                };
                continue;
            };
            drop(state);
            let page = catch_unwind(AssertUnwindSafe(|| self.page(id)));
            let page = page.unwrap_or_else(|_| Err(PageError::Damaged("reading it failed".into())));
            state = self.state();
            match page {
                Ok(page) => {
                    if let Some(level) = state.residency.insert(Arc::new(page)) {
                        drop(state);
                        let level = level.finish(self.source.pyramid());
                        state = self.state();
                        match level {
                            Ok(level) => state.residency.insert_level(Arc::new(level)),
                            Err(e) => tracing::error!("a level cannot be held whole: {e}"),
                        }
                    }
                }
                Err(e) => {
                    if state.residency.fail(id, matches!(e, PageError::Damaged(_))) {
                        tracing::warn!("page {:?} of level {} stays coarse: {e}", id.at, id.level);
                    }
                }
            }
            let version = state.version();
            self.changed.send_if_modified(|known| std::mem::replace(known, version) != version);
            // Room for another page may be there.
            self.work.notify_one();
        }
    }

    /// Whether there is memory for another page beside what was shown before.
    fn has_room(&self, state: &mut State) -> bool {
        let remains = state.remains.bytes();
        let own = (state.residency.num_pages() as u64 + 1) * self.page_bytes;
        remains == 0 || remains + own <= self.max_bytes
    }

    fn page(&self, id: PageId) -> Result<Page, PageError> {
        let channels = (0..self.num_channels).map(|channel| self.source.read(channel, id));
        let channels = channels.collect::<Result<Vec<_>, _>>()?;
        Page::new(self.source.pyramid(), id, channels).map_err(|e| PageError::Damaged(e.to_string()))
    }
}

fn same(a: Option<&Arc<SeenPages>>, b: Option<&Arc<SeenPages>>) -> bool {
    a.map(Arc::as_ptr) == b.map(Arc::as_ptr)
}

/// Looks whose visible pages are remembered.
const MAX_SEEN: usize = 4;
/// Most threads that read: disks and servers answer several at once.
const MAX_READERS: usize = 8;
/// Time between looks at what is there.
const POLL: std::time::Duration = std::time::Duration::from_millis(5);

#[cfg(test)]
pub(crate) mod in_memory;
