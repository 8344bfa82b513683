//! Pages of a volume that does not fit into memory: threads read what viewers look at, and frames show what is there.

use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use isinglass_core::session::admission::ViewerId;
use isinglass_core::volume::{
    Page, PageError, PageId, PagePlan, PageProgress, PageSet, PageSource, PageView, PlanKey, Residency,
    Volume, VolumeError,
};
use tokio::sync::watch;

/// A volume that is read by pages.
#[derive(Clone)]
pub struct PagedVolume {
    /// Reads the pages. Its coarsest level is the volume that is served.
    pub source: Arc<dyn PageSource>,
    /// Most memory of the pages, bytes.
    pub max_bytes: u64,
}

impl std::fmt::Debug for PagedVolume {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("PagedVolume").field("max_bytes", &self.max_bytes).finish_non_exhaustive()
    }
}

/// The pages that a frame shows.
#[derive(Clone, Debug)]
pub struct FramePages {
    /// The pages.
    pub set: Arc<PageSet>,
    /// How far they are.
    pub progress: PageProgress,
    /// Whether they are those of a resting camera.
    pub rests: bool,
    /// Changes with the pages in memory.
    pub version: u64,
}

impl FramePages {
    /// Whether a resting camera will get better ones.
    pub fn is_draft(&self) -> bool {
        !self.rests || self.progress.is_loading()
    }
}

/// Reads pages on threads of its own, which end with the last clone.
#[derive(Clone)]
pub struct Pager {
    shared: Arc<Shared>,
    /// Ends the threads when the last pager is dropped.
    _ending: Arc<Ending>,
}

struct Shared {
    source: Arc<dyn PageSource>,
    num_channels: usize,
    max_bytes: u64,
    state: Mutex<State>,
    /// Notified when there may be something to read.
    work: Condvar,
    changed: watch::Sender<u64>,
}

struct State {
    residency: Residency,
    views: HashMap<PlanKey, (PageView, usize)>,
    sets: HashMap<PlanKey, (u64, Arc<PageSet>)>,
    is_over: bool,
}

struct Ending(Arc<Shared>);

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
    /// Starts to read pages of a volume whose coarsest level is `base`.
    ///
    /// # Errors
    /// If `base` is not that level.
    pub fn start(volume: PagedVolume, base: &Volume) -> Result<Self, VolumeError> {
        let PagedVolume { source, max_bytes } = volume;
        let pyramid = Arc::new(source.pyramid().clone());
        let pages = pyramid.base_pages(base)?;
        let num_channels = base.channels().count();
        let page_bytes = pages.first().map_or(1, |page| page.num_bytes().max(1));
        // The pages of the coarsest level count, too.
        let max_pages = (max_bytes / page_bytes) as usize;
        let residency = Residency::new(pyramid, pages.clone(), max_pages.saturating_sub(pages.len()));
        let (views, sets, is_over) = (HashMap::new(), HashMap::new(), false);
        let shared = Arc::new(Shared {
            source,
            num_channels,
            max_bytes,
            state: Mutex::new(State { residency, views, sets, is_over }),
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

    /// The pages for a viewer's next frame. What is missing is read from now on.
    pub fn pages(&self, viewer: ViewerId, view: &PageView) -> FramePages {
        let key = PlanKey::from(viewer.0);
        let mut state = self.shared.state();
        let room = state.residency.share(key);
        if state.views.get(&key).is_none_or(|known| (&known.0, known.1) != (view, room)) {
            let plan = PagePlan::of(state.residency.pyramid(), view, room, |_| true);
            state.residency.set_plan(key, plan);
            state.views.insert(key, (view.clone(), room));
            state.sets.remove(&key);
            self.shared.work.notify_all();
        }
        let version = state.residency.version();
        let set = match state.sets.get(&key) {
            Some((known, set)) if *known == version => set.clone(),
            _ => {
                let set = Arc::new(state.residency.set(key));
                state.sets.insert(key, (version, set.clone()));
                set
            }
        };
        FramePages { set, progress: state.residency.progress(key), rests: view.rests, version }
    }

    /// The pages of a viewer's newest view, as they are now.
    pub fn shown(&self, viewer: ViewerId) -> Option<FramePages> {
        let view = self.shared.state().views.get(&PlanKey::from(viewer.0)).map(|(view, _)| view.clone());
        view.map(|view| self.pages(viewer, &view))
    }

    /// Whether pages of a viewer's view are still to come.
    pub fn is_loading(&self, viewer: ViewerId) -> bool {
        self.shared.state().residency.progress(PlanKey::from(viewer.0)).is_loading()
    }

    /// A viewer has left.
    pub fn forget(&self, viewer: ViewerId) {
        let key = PlanKey::from(viewer.0);
        let mut state = self.shared.state();
        state.residency.forget(key);
        state.views.remove(&key);
        state.sets.remove(&key);
    }

    /// Notified when pages come or go.
    pub fn changes(&self) -> watch::Receiver<u64> {
        self.shared.changed.subscribe()
    }

    /// Waits until all pages of a view are there or given up, and returns them; soon after `is_wanted` turns false those
    /// so far.
    pub fn settled(&self, viewer: ViewerId, view: &PageView, is_wanted: &dyn Fn() -> bool) -> FramePages {
        loop {
            let pages = self.pages(viewer, view);
            if !pages.progress.is_loading() || !is_wanted() {
                return pages;
            }
            std::thread::sleep(POLL);
        }
    }
}

impl Shared {
    fn state(&self) -> MutexGuard<'_, State> {
        // Every change is one call of the residency, so a panic leaves it in order.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Reads pages until the pager ends.
    fn read(&self) {
        let mut state = self.state();
        loop {
            if state.is_over {
                return;
            }
            let Some(id) = state.residency.next() else {
                state = self.work.wait(state).unwrap_or_else(PoisonError::into_inner);
                continue;
            };
            drop(state);
            let page = catch_unwind(AssertUnwindSafe(|| self.page(id)));
            let page = page.unwrap_or_else(|_| Err(PageError::Damaged("reading it failed".into())));
            state = self.state();
            match page {
                Ok(page) => state.residency.insert(Arc::new(page)),
                Err(e) => {
                    if state.residency.fail(id, matches!(e, PageError::Damaged(_))) {
                        tracing::warn!("page {:?} of level {} stays coarse: {e}", id.at, id.level);
                    }
                }
            }
            let version = state.residency.version();
            self.changed.send_if_modified(|known| std::mem::replace(known, version) != version);
            // Room for another page may be there.
            self.work.notify_one();
        }
    }

    fn page(&self, id: PageId) -> Result<Page, PageError> {
        let channels = (0..self.num_channels).map(|channel| self.source.read(channel, id));
        let channels = channels.collect::<Result<Vec<_>, _>>()?;
        Page::new(self.source.pyramid(), id, channels).map_err(|e| PageError::Damaged(e.to_string()))
    }
}

/// Most threads that read: disks and servers answer several at once.
const MAX_READERS: usize = 8;
/// Time between looks at what is there.
const POLL: std::time::Duration = std::time::Duration::from_millis(5);
