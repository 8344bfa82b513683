//! Frames and pictures on order. Threads of process 0 order them, its main thread hands each order on to the other
//! processes, and all of them work on it together.

use std::collections::VecDeque;
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::time::Duration;

use isinglass_core::cancel::Wanted;
use isinglass_core::kernels::layering::budget::Budget;
use isinglass_core::kernels::lens::View;
use isinglass_core::kernels::march::Scene;
use isinglass_core::layer::FrameHeader;
use isinglass_core::look::Look;
use isinglass_core::picture::Picture;
use isinglass_core::volume::{Detail, PartProgress, Volume};

use crate::asides::{Aside, FrameOfAll, Numbers, Shelf};
use crate::cluster::{Cluster, OwnRows};
use crate::exchange::ClusterError;
use crate::jobs::{Job, JobCamera, JobView, SceneOrder};
use crate::pages::{PagesOrder, PartReader};

/// Orders frames, pictures and slices. Clones order from the same processes, which end with the last of them.
#[derive(Clone)]
pub struct Orders(SyncSender<Order>);

/// The orders, for the thread that talks with the other processes.
pub struct OrderQueue(Receiver<Order>);

/// The scene of an order is the own part of process 0, without the shade of others.
pub(crate) enum Order {
    Frame { scene: Scene, header: FrameHeader, is_over: Arc<AtomicBool>, reply: SyncSender<Option<MadeRows>> },
    Rows { scene: Scene, view: View, rows: Range<u32>, reply: SyncSender<Option<Picture>> },
    Aside(Aside),
    End,
}

/// The number of a frame whose rows are made, its header, and how many segments it has.
type MadeRows = (Arc<u64>, FrameHeader, usize);

/// Orders, and where they arrive.
pub fn orders() -> (Orders, OrderQueue) {
    let (sender, receiver) = sync_channel(MOST_WAITING);
    (Orders(sender), OrderQueue(receiver))
}

impl Orders {
    /// A layered frame of the whole volume, of which `scene` is the own part under a look. `None` if it is no longer
    /// wanted, or the processes have ended.
    pub fn generate(&self, scene: &Scene, header: FrameHeader, wanted: Wanted<'_>) -> Option<FrameOfAll> {
        let is_over = Arc::new(AtomicBool::new(false));
        let (reply, answer) = sync_channel(1);
        let order = Order::Frame { scene: scene.clone(), header, is_over: is_over.clone(), reply };
        self.send(order)?;
        loop {
            match answer.recv_timeout(LOOK_AGAIN) {
                Ok(made) => {
                    return made.map(|(number, header, num_segments)| FrameOfAll {
                        orders: self.clone(),
                        number,
                        header,
                        num_segments,
                    });
                }
                Err(RecvTimeoutError::Disconnected) => return None,
                Err(RecvTimeoutError::Timeout) if !wanted() => is_over.store(true, Ordering::Relaxed),
                Err(RecvTimeoutError::Timeout) => {}
            }
        }
    }

    /// Some rows of the picture of a view of the whole volume; `None` if the processes have ended.
    pub fn render_rows(&self, scene: &Scene, view: &View, rows: Range<u32>) -> Option<Picture> {
        let (reply, answer) = sync_channel(1);
        self.send(Order::Rows { scene: scene.clone(), view: *view, rows, reply })?;
        answer.recv().ok()?
    }

    /// Ends the work of all processes. Later orders come to nothing.
    pub fn end(&self) {
        // They may have ended.
        let _ = self.send(Order::End);
    }

    /// `None` if the processes have ended.
    pub(crate) fn send(&self, order: Order) -> Option<()> {
        self.0.send(order).ok()
    }
}

/// The orders that wait.
struct Waiting {
    queue: Receiver<Order>,
    asides: VecDeque<Aside>,
    others: VecDeque<Order>,
    /// Whether the last order that was taken is done beside frames.
    had_aside: bool,
}

impl Waiting {
    fn new(OrderQueue(queue): OrderQueue) -> Self {
        Self { queue, asides: VecDeque::new(), others: VecDeque::new(), had_aside: false }
    }

    /// Those that are done beside frames and wait now.
    fn take_asides(&mut self) -> VecDeque<Aside> {
        self.drain();
        std::mem::take(&mut self.asides)
    }

    fn drain(&mut self) {
        while let Ok(order) = self.queue.try_recv() {
            self.put(order);
        }
    }

    /// The next order if it comes within a time. Those beside frames take turns with the others.
    fn next(&mut self, patience: Option<Duration>) -> Result<Order, RecvTimeoutError> {
        loop {
            self.drain();
            let is_turn = !self.had_aside || self.others.is_empty();
            if let Some(aside) = is_turn.then(|| self.asides.pop_front()).flatten() {
                self.had_aside = true;
                return Ok(Order::Aside(aside));
            }
            self.had_aside = false;
            if let Some(order) = self.others.pop_front() {
                return Ok(order);
            }
            let order = match patience {
                Some(patience) => self.queue.recv_timeout(patience)?,
                None => self.queue.recv().map_err(|_| RecvTimeoutError::Disconnected)?,
            };
            self.put(order);
        }
    }

    fn put(&mut self, order: Order) {
        match order {
            Order::Aside(aside) => self.asides.push_back(aside),
            other => self.others.push_back(other),
        }
    }
}

/// What process 0 has and keeps while it works.
struct Desk<'a> {
    waiting: Waiting,
    volume: &'a Volume,
    kept: KeptScenes,
    budget: Budget,
    numbers: Numbers,
    shelf: Shelf,
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
    /// How far its pages are.
    part: PartProgress,
    shown: u64,
}

/// Where a process takes a scene from.
enum Origin<'a> {
    /// The ordered scene itself.
    Ordered(Box<Scene>),
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

    /// The ordered scene, and how far its pages are. A new one is made from the last one that was shown, and is ready
    /// then.
    fn take(
        &mut self,
        cluster: &Cluster<'_>,
        order: SceneOrder,
        origin: Origin<'_>,
    ) -> Result<(&Scene, PartProgress), ClusterError> {
        self.num_shown += 1;
        if let Some((look, is_draft)) = order.new {
            let detail = if is_draft { Detail::Draft } else { Detail::Final };
            let last = self.newest().map(|place| &self.scenes[place].scene);
            let scene = match &origin {
                Origin::Ordered(scene) => (**scene).clone(),
                Origin::Base(base) => last.unwrap_or(base).under(&look, detail, None),
            };
            let scene = cluster.ready(scene)?;
            let kept = KeptScene { look, detail, scene, part: PartProgress::default(), shown: 0 };
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
            Origin::Ordered(scene) => kept.scene = *scene,
            Origin::Base(_) => {
                (kept.scene, kept.part) = cluster.by_own_pages(&kept.scene, order.pages.as_ref());
            }
        }
        Ok((&kept.scene, kept.part))
    }
}

impl Cluster<'_> {
    /// Works on orders together with the other processes, until they are to end or nobody can order anything. `volume` is
    /// the own part. Only in process 0.
    ///
    /// # Errors
    /// If the processes cannot talk, or one sends something else than expected.
    pub fn work_on(&self, orders: OrderQueue, volume: &Volume) -> Result<(), ClusterError> {
        let mut desk = Desk {
            waiting: Waiting::new(orders),
            volume,
            kept: KeptScenes::default(),
            budget: Budget::default(),
            numbers: Numbers::default(),
            shelf: Shelf::default(),
        };
        isinglass_core::codec::prepare();
        // Whether pages of others are still to come, and whom they are read for.
        let (mut is_loading, mut known) = (false, Vec::new());
        loop {
            let patience = self.reader.map(|_| if is_loading { ASK_AGAIN } else { LOOK_ROUND });
            let order = match desk.waiting.next(patience) {
                Ok(order) => order,
                Err(RecvTimeoutError::Disconnected) => break,
                Err(RecvTimeoutError::Timeout) => {
                    let viewers = self.reader.map(PartReader::viewers).unwrap_or_default();
                    if is_loading || viewers != known {
                        self.tell(&Job::Progress { viewers: viewers.clone() }, false)?;
                        is_loading = self.tell_progress(&viewers)?;
                        known = viewers;
                    }
                    continue;
                }
            };
            match order {
                Order::Frame { scene, header, is_over, reply } => {
                    let wanted = || !is_over.load(Ordering::Relaxed);
                    let made = if wanted() {
                        is_loading |= scene.pages.is_some();
                        self.frame(&mut desk, scene, header, &wanted)?
                    } else {
                        None
                    };
                    // Who ordered it may have left.
                    let _ = reply.send(made);
                }
                Order::Rows { scene, view, rows, reply } => {
                    let order = desk.kept.order(&scene, self.pages_order(&scene));
                    let of = (order.clone(), JobView::from(&view), rows.clone());
                    self.tell(&Job::Rows { scene: of.0, view: of.1, rows: of.2 }, false)?;
                    let (scene, _) = desk.kept.take(self, order, Origin::Ordered(Box::new(scene)))?;
                    let _ = reply.send(self.picture(scene, &view, rows)?);
                }
                Order::Aside(aside) => {
                    self.order_aside(aside, volume, (&mut desk.numbers, &mut desk.shelf), false)?;
                }
                Order::End => break,
            }
        }
        self.tell(&Job::End, false)
    }

    fn frame(
        &self,
        desk: &mut Desk<'_>,
        scene: Scene,
        header: FrameHeader,
        wanted: Wanted<'_>,
    ) -> Result<Option<MadeRows>, ClusterError> {
        let Desk { waiting, volume, kept, budget, numbers, shelf } = desk;
        self.tidy(numbers, shelf, false)?;
        let header = FrameHeader { mode: scene.settings.mode, ..header };
        let order = kept.order(&scene, self.pages_order(&scene));
        let viewer = order.pages.as_ref().map(PagesOrder::key);
        if order.new.is_some() || kept.newest() != Some(order.place) {
            // What another scene has spent says nothing about this one.
            budget.forget();
        }
        let threshold = budget.threshold(&header, scene.volume.bounds().radius());
        let (camera, k, number) = (JobCamera::from(&header.camera), header.k, numbers.next());
        self.tell(&Job::Frame { scene: order.clone(), camera, k, threshold, number }, false)?;
        let (scene, own) = kept.take(self, order, Origin::Ordered(Box::new(scene)))?;
        self.tell_parts(viewer.map(|key| (key, own)).as_slice(), true)?;
        let mut goes_on = || {
            for aside in waiting.take_asides() {
                self.order_aside(aside, volume, (numbers, shelf), true)?;
            }
            let goes_on = wanted();
            self.tell(&Job::GoOn(goes_on), true)?;
            Ok(goes_on)
        };
        let (made, report) = self.rows_while(scene, header, threshold, &mut goes_on)?;
        let Some(rows) = made else { return Ok(None) };
        tracing::debug!(?report, "a frame of all processes");
        let OwnRows { num_segments, num_filled, .. } = rows;
        budget.note_spent(&header, report.threshold, num_segments as usize, num_filled as usize);
        let made = (numbers.note_frame(number), rows.rows.header, num_segments as usize);
        shelf.frames.insert(number, rows);
        Ok(Some(made))
    }

    /// Works on what process 0 asks for, until it ends. `base` is the own part under any look. Only in other processes.
    ///
    /// # Errors
    /// If the processes cannot talk, or one sends something else than expected.
    pub fn help(&self, base: &Scene) -> Result<(), ClusterError> {
        let (mut kept, mut shelf, volume) = (KeptScenes::default(), Shelf::default(), base.whole());
        isinglass_core::codec::prepare();
        loop {
            match self.told(false)? {
                Job::Frame { scene, camera, k, threshold, number } => {
                    let viewer = scene.pages.as_ref().map(PagesOrder::key);
                    let (scene, own) = kept.take(self, scene, Origin::Base(base))?;
                    self.tell_parts(viewer.map(|key| (key, own)).as_slice(), true)?;
                    let header = FrameHeader::alone(camera.camera(), k);
                    let mut goes_on = || self.goes_on(volume, &mut shelf);
                    if let (Some(rows), _) = self.rows_while(scene, header, threshold, &mut goes_on)? {
                        shelf.frames.insert(number, rows);
                    }
                }
                Job::Rows { scene, view, rows } => {
                    let (scene, _) = kept.take(self, scene, Origin::Base(base))?;
                    self.picture(scene, &view.view(), rows)?;
                }
                Job::Progress { viewers } => {
                    self.tell_progress(&viewers)?;
                }
                Job::Aside(job) => self.do_aside(job, volume, &mut shelf)?,
                Job::GoOn(_) => return Err(ClusterError::Job("a frame goes on that nobody makes".into())),
                Job::End => return Ok(()),
            }
        }
    }
}

/// Scenes that are kept, of a byte or two per voxel each: a look and its draft, and another viewer's.
const MOST_SCENES: usize = 3;
/// Whether a frame is still wanted is looked at so often.
const LOOK_AGAIN: Duration = Duration::from_millis(2);
/// How often process 0 asks how far the pages of others are, while some are to come and nothing is ordered.
const ASK_AGAIN: Duration = Duration::from_millis(100);
/// It checks so often whether viewers have left.
const LOOK_ROUND: Duration = Duration::from_secs(1);
/// Most orders that wait; who orders more waits too.
const MOST_WAITING: usize = 16;
