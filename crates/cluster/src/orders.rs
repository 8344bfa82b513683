//! Frames and pictures on order. Threads of process 0 order them, its main thread hands each order on to the other
//! processes, and all of them work on it together.

use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::time::Duration;

use isinglass_core::cancel::{ALWAYS, Wanted};
use isinglass_core::kernels::layering::budget::Budget;
use isinglass_core::kernels::lens::View;
use isinglass_core::kernels::march::Scene;
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::look::Look;
use isinglass_core::picture::Picture;
use isinglass_core::volume::Detail;

use crate::cluster::Cluster;
use crate::exchange::ClusterError;
use crate::jobs::{Job, JobCamera, JobView, SceneOrder, from_words, words_from};
use crate::pages::{PageReader, PagesOrder};

/// Orders frames and pictures. Clones order from the same processes, which end with the last of them.
#[derive(Clone)]
pub struct Orders(SyncSender<Order>);

/// The orders, for the thread that talks with the other processes.
pub struct OrderQueue(Receiver<Order>);

/// The scene of an order is the own part of process 0, without the shade of others.
enum Order {
    Frame {
        scene: Scene,
        header: FrameHeader,
        is_over: Arc<AtomicBool>,
        reply: SyncSender<Option<LayeredFrame>>,
    },
    Rows {
        scene: Scene,
        view: View,
        rows: Range<u32>,
        reply: SyncSender<Option<Picture>>,
    },
    End,
}

/// Orders, and where they arrive.
pub fn orders() -> (Orders, OrderQueue) {
    let (sender, receiver) = sync_channel(MOST_WAITING);
    (Orders(sender), OrderQueue(receiver))
}

impl Orders {
    /// A layered frame of the whole volume, of which `scene` is the own part under a look. `None` if it is no longer
    /// wanted, or the processes have ended.
    pub fn generate(&self, scene: &Scene, header: FrameHeader, wanted: Wanted<'_>) -> Option<LayeredFrame> {
        let is_over = Arc::new(AtomicBool::new(false));
        let (reply, answer) = sync_channel(1);
        let order = Order::Frame { scene: scene.clone(), header, is_over: is_over.clone(), reply };
        self.0.send(order).ok()?;
        loop {
            match answer.recv_timeout(LOOK_AGAIN) {
                Ok(made) => return made,
                Err(RecvTimeoutError::Disconnected) => return None,
                Err(RecvTimeoutError::Timeout) if !wanted() => is_over.store(true, Ordering::Relaxed),
                Err(RecvTimeoutError::Timeout) => {}
            }
        }
    }

    /// Some rows of the picture of a view of the whole volume; `None` if the processes have ended.
    pub fn render_rows(&self, scene: &Scene, view: &View, rows: Range<u32>) -> Option<Picture> {
        let (reply, answer) = sync_channel(1);
        self.0.send(Order::Rows { scene: scene.clone(), view: *view, rows, reply }).ok()?;
        answer.recv().ok()?
    }

    /// Ends the work of all processes. Later orders come to nothing.
    pub fn end(&self) {
        // They may have ended.
        let _ = self.0.send(Order::End);
    }
}

/// Scenes of the own part that are ready, by place, and when each was shown last.
#[derive(Default)]
struct KeptScenes {
    scenes: Vec<KeptScene>,
    num_shown: u64,
}

struct KeptScene {
    look: Look,
    detail: Detail,
    scene: Scene,
    shown: u64,
}

/// Where a process takes a scene from.
enum Origin<'a> {
    /// The ordered scene itself.
    Ordered(Scene),
    /// The own part under any look.
    Base(&'a Scene),
}

impl KeptScenes {
    /// The place of a scene under this look, or the one to put it in and what it is.
    fn order(&self, scene: &Scene, pages: Option<PagesOrder>) -> SceneOrder {
        let (look, detail) = (scene.look(1), scene.settings.detail);
        let is_it = |kept: &KeptScene| kept.detail == detail && kept.look.marches_like(&look);
        if let Some(place) = self.scenes.iter().position(is_it) {
            return SceneOrder { place, new: None, pages };
        }
        let oldest = self.scenes.iter().enumerate().min_by_key(|(_, kept)| kept.shown).map(|(i, _)| i);
        let place = if self.scenes.len() < MOST_SCENES { self.scenes.len() } else { oldest.unwrap_or(0) };
        SceneOrder { place, new: Some((look, detail == Detail::Draft)), pages }
    }

    /// The place of the scene that was shown last.
    fn newest(&self) -> Option<usize> {
        self.scenes.iter().enumerate().max_by_key(|(_, kept)| kept.shown).map(|(place, _)| place)
    }

    /// The ordered scene. A new one is made from the last one that was shown, and is ready then.
    fn take(
        &mut self,
        cluster: &Cluster<'_>,
        order: SceneOrder,
        origin: Origin<'_>,
    ) -> Result<&Scene, ClusterError> {
        self.num_shown += 1;
        if let Some((look, is_draft)) = order.new {
            let detail = if is_draft { Detail::Draft } else { Detail::Final };
            let last = self.newest().map(|place| &self.scenes[place].scene);
            let scene = match &origin {
                Origin::Ordered(scene) => scene.clone(),
                Origin::Base(base) => last.unwrap_or(base).under(&look, detail, None),
            };
            let scene = cluster.ready(scene)?;
            let kept = KeptScene { look, detail, scene, shown: 0 };
            match self.scenes.get_mut(order.place) {
                Some(place) => *place = kept,
                None => self.scenes.push(kept),
            }
        }
        if cluster.reader.is_some() {
            // Pages that nobody shows must not stay in memory.
            let others = self.scenes.iter_mut().enumerate().filter(|(place, _)| *place != order.place);
            others.for_each(|(_, kept)| kept.scene = kept.scene.without_pages());
        }
        let kept = self.scenes.get_mut(order.place);
        let kept = kept.ok_or_else(|| ClusterError::Job(format!("scene {}", order.place)))?;
        kept.shown = self.num_shown;
        match origin {
            _ if cluster.reader.is_none() => {}
            Origin::Ordered(scene) => kept.scene = scene,
            Origin::Base(_) => kept.scene = cluster.by_own_pages(&kept.scene, order.pages.as_ref()),
        }
        Ok(&kept.scene)
    }
}

impl Cluster<'_> {
    /// Works on orders together with the other processes, until they are to end or nobody can order
    /// anything. Only in process 0.
    ///
    /// # Errors
    /// If the processes cannot talk, or one sends something else than expected.
    pub fn work_on(&self, orders: OrderQueue) -> Result<(), ClusterError> {
        let (mut kept, mut budget) = (KeptScenes::default(), Budget::default());
        // Whether pages of others are still to come.
        let mut is_loading = false;
        loop {
            let order = if is_loading {
                orders.0.recv_timeout(ASK_AGAIN)
            } else {
                orders.0.recv().map_err(|_| RecvTimeoutError::Disconnected)
            };
            let order = match order {
                Ok(order) => order,
                Err(RecvTimeoutError::Disconnected) => break,
                Err(RecvTimeoutError::Timeout) => {
                    let viewers = self.reader.map(PageReader::viewers).unwrap_or_default();
                    self.tell(&Job::Progress { viewers: viewers.clone() })?;
                    is_loading = self.tell_progress(&viewers)?;
                    continue;
                }
            };
            match order {
                Order::Frame { scene, header, is_over, reply } => {
                    let wanted = || !is_over.load(Ordering::Relaxed);
                    let made = if wanted() {
                        is_loading |= scene.pages.is_some();
                        self.frame(&mut kept, &mut budget, scene, header, &wanted)?
                    } else {
                        None
                    };
                    // Who ordered it may have left.
                    let _ = reply.send(made);
                }
                Order::Rows { scene, view, rows, reply } => {
                    let order = kept.order(&scene, self.pages_order(&scene));
                    let of = (order.clone(), JobView::from(&view), rows.clone());
                    self.tell(&Job::Rows { scene: of.0, view: of.1, rows: of.2 })?;
                    let scene = kept.take(self, order, Origin::Ordered(scene))?;
                    let _ = reply.send(self.picture(scene, &view, rows)?);
                }
                Order::End => break,
            }
        }
        self.tell(&Job::End)
    }

    fn frame(
        &self,
        kept: &mut KeptScenes,
        budget: &mut Budget,
        scene: Scene,
        header: FrameHeader,
        wanted: Wanted<'_>,
    ) -> Result<Option<LayeredFrame>, ClusterError> {
        let header = FrameHeader { mode: scene.settings.mode, ..header };
        let order = kept.order(&scene, self.pages_order(&scene));
        let viewer = order.pages.as_ref().map(PagesOrder::key);
        if order.new.is_some() || kept.newest() != Some(order.place) {
            // What another scene has spent says nothing about this one.
            budget.forget();
        }
        let threshold = budget.threshold(&header, scene.volume.bounds().radius());
        let (camera, k) = (JobCamera::from(&header.camera), header.k);
        self.tell(&Job::Frame { scene: order.clone(), camera, k, threshold })?;
        let scene = kept.take(self, order, Origin::Ordered(scene))?;
        self.tell_progress(viewer.as_slice())?;
        let (made, report) = self.generate_while(scene, header, threshold, wanted)?;
        if let Some(frame) = &made {
            tracing::debug!(?report, "a frame of all processes");
            budget.note(&header, report.threshold, frame);
        }
        Ok(made)
    }

    fn tell(&self, job: &Job) -> Result<(), ClusterError> {
        self.exchange().broadcast_some_day(words_from(job)?)?;
        Ok(())
    }

    /// Works on what process 0 asks for, until it ends. `base` is the own part under any look. Only in other processes.
    ///
    /// # Errors
    /// If the processes cannot talk, or one sends something else than expected.
    pub fn help(&self, base: &Scene) -> Result<(), ClusterError> {
        let mut kept = KeptScenes::default();
        loop {
            match from_words(&self.exchange().broadcast_some_day(Vec::new())?)? {
                Job::Frame { scene, camera, k, threshold } => {
                    let viewer = scene.pages.as_ref().map(PagesOrder::key);
                    let scene = kept.take(self, scene, Origin::Base(base))?;
                    self.tell_progress(viewer.as_slice())?;
                    let header = FrameHeader::alone(camera.camera(), k);
                    self.generate_while(scene, header, threshold, ALWAYS)?;
                }
                Job::Rows { scene, view, rows } => {
                    let scene = kept.take(self, scene, Origin::Base(base))?;
                    self.picture(scene, &view.view(), rows)?;
                }
                Job::Progress { viewers } => {
                    self.tell_progress(&viewers)?;
                }
                Job::End => return Ok(()),
            }
        }
    }
}

/// Scenes that are kept, of a byte or two per voxel each: a look and its draft, and another viewer's.
const MOST_SCENES: usize = 3;
/// Whether a frame is still wanted is looked at so often.
const LOOK_AGAIN: Duration = Duration::from_millis(2);
/// Process 0 asks so often how far the pages of others are, while any are to come.
const ASK_AGAIN: Duration = Duration::from_millis(100);
/// Most orders that wait; who orders more waits too.
const MOST_WAITING: usize = 16;
