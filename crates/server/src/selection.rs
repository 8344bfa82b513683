//! Other parts of the file: it reads the newest request beside the shown part, and then replaces that. While a viewer
//! plays times, the next ones are read before it requests them.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU16, AtomicU64, Ordering};

use isinglass_core::channels::Channels;
use isinglass_core::ids::{LoadId, LookVersion};
use isinglass_core::kernels::march::Scene;
use isinglass_core::look::Look;
use isinglass_core::session::admission::ViewerId;
use isinglass_core::session::selection::Load;
use isinglass_core::space::Aabb;
use isinglass_core::transfer::TransferFunction;
use isinglass_core::volume::Volume;
use isinglass_core::wire::control::one_line;
use isinglass_core::wire::{Choices, LoadState, Part, VolumeDescription};
use isinglass_net::Greeting;
use tokio::sync::{mpsc, watch};
use tokio::task::{JoinError, JoinHandle};

use crate::ahead::{Read, ReadAhead};
use crate::dispatch::ShownScene;
use crate::generator::Generator;
use crate::lights::Lights;
use crate::paging::{Pager, Remains};

/// Opens parts of the volume's file. This crate opens no files itself: the server's owner supplies a loader.
///
/// Both functions run on threads that may block.
pub trait Loader: Send + Sync {
    /// The choices in the file and the part that would be shown, from the header alone.
    ///
    /// # Errors
    /// One line for the user: the part does not exist, or does not fit into memory beside the `held` bytes. What is read by
    /// pages needs memory for its coarsest level only, as the shown part then makes room.
    fn survey(&self, part: &Part, held: u64) -> Result<Survey, String>;

    /// Reads the part, beside as many bytes as were held when it was surveyed. `progress` gets the fraction that was read;
    /// reading ends soon after `cancel` becomes true.
    ///
    /// # Errors
    /// One line for the user.
    fn load(
        &self,
        part: &Part,
        held: u64,
        progress: &dyn Fn(f32),
        cancel: &AtomicBool,
    ) -> Result<Loaded, String>;
}

/// Facts about a part before it is read.
#[derive(Clone, Debug)]
pub struct Survey {
    /// The choices in the file, and this part.
    pub parts: Choices,
    /// Memory for the part, including what reading takes, bytes.
    pub bytes_needed: u64,
}

/// A part that was read.
#[derive(Debug)]
pub struct Loaded {
    /// The voxels.
    pub volume: Volume,
    /// The transfer function that suits the voxels; must be valid.
    pub transfer: TransferFunction,
    /// The looks of its channels; must be valid.
    pub channels: Channels,
}

#[derive(Debug)]
pub(crate) struct Present {
    pub(crate) greeting: Arc<Greeting>,
    /// The volume's box.
    pub(crate) bounds: Aabb,
    pub(crate) lights: Lights,
    /// Reads the pages, if the volume is read by pages.
    pub(crate) pager: Option<Pager>,
    pub(crate) scene: SceneNumber,
    pub(crate) parts: Option<Choices>,
    /// Memory of the volume, bytes.
    bytes: u64,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct SceneNumber(pub(crate) u32);

/// A viewer's request for a part of the file; `None` cancels the one that is being read.
pub(crate) type Order = (ViewerId, Option<Part>);

impl Present {
    pub(crate) fn new(
        scene: &Scene,
        number: SceneNumber,
        look: Look,
        parts: Option<Choices>,
        pager: Option<Pager>,
    ) -> Self {
        let lights = Lights::new(scene, &look, pager.is_some());
        let max_bytes = pager.as_ref().map_or(0, Pager::max_bytes);
        let greeting = Greeting {
            volume: VolumeDescription::of_channels(scene.whole(), scene.histograms()),
            look_version: LookVersion(1),
            look,
        };
        Self {
            greeting: Arc::new(greeting),
            bounds: scene.volume.bounds(),
            lights,
            pager,
            scene: number,
            parts: parts.map(Choices::bounded),
            bytes: scene.whole().bytes_in_memory() + max_bytes,
        }
    }

    /// Bytes that it takes beside another part that is read. Its pages may make room, but not for what is read ahead.
    fn bytes_held(&self, is_ahead: bool) -> u64 {
        if self.pager.is_none() || is_ahead { self.bytes } else { self.lights.volume().bytes_in_memory() }
    }

    /// The part as it can be shown again, if viewers can choose parts. One that is read by pages has no memory to wait in.
    fn again(&self) -> Option<Read> {
        if self.pager.is_some() {
            return None;
        }
        let (scene, look) = (self.lights.first_scene().clone(), self.greeting.look.clone());
        Some(Read { scene, look, parts: self.parts.clone()?, pager: None })
    }

    /// Whether values mean the same in both, as they do across times, levels and regions.
    pub(crate) fn has_values_like(&self, other: &Self) -> bool {
        let kind = |present: &Self| present.parts.as_ref().map(|p| (p.shown.channel, p.shown.series));
        kind(self).is_some() && kind(self) == kind(other)
    }
}

/// Reads requested parts, the newest first, until nobody can request any. Meanwhile it reads ahead.
pub(crate) struct SelectionReader {
    pub(crate) loader: Option<Arc<dyn Loader>>,
    pub(crate) generator: Generator,
    pub(crate) orders: mpsc::Receiver<Order>,
    pub(crate) present: watch::Sender<Arc<Present>>,
    pub(crate) load: watch::Sender<Option<Load>>,
    pub(crate) ahead: ReadAhead,
    /// What is being read ahead.
    pub(crate) reading: Option<Reading>,
}

/// How a load ended.
enum Ended {
    Done,
    Failed(String),
    /// This order has arrived meanwhile; `None` means that nobody is left.
    Interrupted(Option<Order>),
}

/// Why a part was not read.
enum NotRead {
    /// There is no room beside what is known.
    NoRoom(String),
    Failed(String),
}

impl NotRead {
    /// Reading has panicked.
    fn by_defect(error: JoinError) -> Self {
        tracing::error!("reading ended early: {error}");
        Self::Failed("the server failed on reading this part".into())
    }
}

/// A part that is being read on another thread.
pub(crate) struct Reading {
    part: Part,
    work: JoinHandle<Result<Read, NotRead>>,
    cancel: CancelOnDrop,
    progress: Arc<Progress>,
}

/// How far a reading is. Viewers are told of it once one of them waits for the part.
#[derive(Default)]
struct Progress {
    is_told: AtomicBool,
    bytes_needed: AtomicU64,
    permille: AtomicU16,
}

impl Progress {
    fn tell(&self, load: &mut Load) {
        load.bytes_needed = self.bytes_needed.load(Ordering::Relaxed);
        load.state = LoadState::Reading { permille: self.permille.load(Ordering::Relaxed) };
    }
}

impl SelectionReader {
    pub(crate) async fn run(mut self) {
        let mut next = None;
        let mut id = LoadId(0);
        loop {
            let order = match next.take() {
                Some(order) => Some(order),
                None => self.read_ahead().await,
            };
            let Some(mut order) = order else { return };
            while let Ok(newer) = self.orders.try_recv() {
                order = newer;
            }
            let (viewer, Some(part)) = order else { continue };
            id = id.next();
            let state = LoadState::Reading { permille: 0 };
            self.load.send_replace(Some(Load { id, viewer, part, bytes_needed: 0, state }));
            let ended = self.open(part).await;
            let state = match ended {
                Ended::Done => LoadState::Done,
                Ended::Failed(problem) => LoadState::Failed(one_line(&problem)),
                Ended::Interrupted(None) => return,
                Ended::Interrupted(order) => {
                    next = order;
                    LoadState::Cancelled
                }
            };
            tracing::info!(load = id.0, ?state, "another part");
            self.tell(|load| load.state = state);
        }
    }

    fn tell(&self, change: impl FnOnce(&mut Load)) {
        self.load.send_modify(|load| {
            if let Some(load) = load {
                change(load);
            }
        });
    }

    /// The next order. Until it arrives, what a viewer that plays will request is read. `None` if nobody is left.
    async fn read_ahead(&mut self) -> Option<Order> {
        loop {
            let present = self.present.borrow().clone();
            let now = present.parts.clone().unwrap_or_default();
            let next = self.ahead.next(&now);
            let reading = self.reading.take();
            let mut reading = match (reading, next) {
                (Some(reading), Some(part)) if reading.part == part => reading,
                (Some(reading), _) => {
                    if let Some(order) = self.stop(reading).await {
                        return order;
                    }
                    continue;
                }
                (None, Some(part)) => match self.begin(part, Some(self.ahead.limit(present.bytes))) {
                    Some(reading) => reading,
                    None => return self.orders.recv().await,
                },
                (None, None) => return self.orders.recv().await,
            };
            tokio::select! {
                biased;
                order = self.orders.recv() => {
                    self.reading = Some(reading);
                    return order;
                }
                read = &mut reading.work => match read {
                    Ok(Ok(read)) => self.ahead.add(read, &now, present.bytes),
                    Ok(Err(NotRead::NoRoom(_))) => self.ahead.make_room(&reading.part, &now, present.bytes),
                    // Who requests the part is told why.
                    Ok(Err(NotRead::Failed(_))) | Err(_) => self.ahead.rest(),
                },
            }
        }
    }

    /// Reads a part and shows it, unless another order arrives first.
    async fn open(&mut self, part: Part) -> Ended {
        if self.loader.is_none() {
            return Ended::Failed("this server shows this part of its file only".into());
        }
        match self.ahead.take(&part) {
            Some(read) => self.show(read).await,
            None => self.open_beside(part).await,
        }
    }

    /// Reads a part and shows it. The pages of the present one make room, and come back if it stays.
    async fn open_beside(&mut self, part: Part) -> Ended {
        let present = self.present.borrow().clone();
        let ended = match self.read(part).await {
            Ok(read) => self.show(read).await,
            Err(ended) => ended,
        };
        if let Some(pager) = present.pager.as_ref().filter(|_| !matches!(ended, Ended::Done)) {
            pager.resume();
        }
        ended
    }

    /// Reads a part, unless another order arrives first.
    async fn read(&mut self, part: Part) -> Result<Read, Ended> {
        let mut reading = match self.reading.take() {
            Some(reading) if reading.part == part => {
                // From now on somebody waits for it.
                reading.progress.is_told.store(true, Ordering::Relaxed);
                self.tell(|load| reading.progress.tell(load));
                Some(reading)
            }
            Some(reading) => {
                if let Some(order) = self.stop(reading).await {
                    return Err(Ended::Interrupted(order));
                }
                None
            }
            None => None,
        };
        let failed = |problem: &str| Ended::Failed(problem.into());
        let mut is_ahead = reading.is_some();
        loop {
            let begun = reading.take().or_else(|| self.begin(part, None));
            let Some(mut reading) = begun else { return Err(failed("there is no file to read")) };
            let read = tokio::select! {
                read = &mut reading.work => read,
                order = self.orders.recv() => {
                    let later = self.stop(reading).await;
                    return Err(Ended::Interrupted(later.unwrap_or(order)));
                }
            };
            match read.unwrap_or_else(|e| Err(NotRead::by_defect(e))) {
                Ok(read) => return Ok(read),
                // What was read ahead goes first, and the limit of reading ahead holds no longer.
                Err(NotRead::NoRoom(_)) if self.ahead.bytes() > 0 || is_ahead => {
                    is_ahead = false;
                    self.ahead.clear();
                }
                Err(NotRead::NoRoom(problem) | NotRead::Failed(problem)) => return Err(failed(&problem)),
            }
        }
    }

    /// Begins to read a part. With a limit it is read ahead, within so many bytes of all that is known; nobody is told
    /// of it. Otherwise the pages of the present part make room for it.
    fn begin(&self, part: Part, limit: Option<u64>) -> Option<Reading> {
        let loader = self.loader.clone()?;
        let (present, known) = (self.present.borrow().clone(), self.ahead.bytes());
        let held = present.bytes_held(limit.is_some()).saturating_add(known);
        let cancel = CancelOnDrop::default();
        let progress =
            Arc::new(Progress { is_told: AtomicBool::new(limit.is_none()), ..Progress::default() });
        let (tellers, generator) = (Tellers::of(self, &cancel, &progress), self.generator.clone());
        let work = tokio::spawn(async move {
            let surveyor = loader.clone();
            let survey = tokio::task::spawn_blocking(move || surveyor.survey(&part, held));
            let survey = survey.await.map_err(NotRead::by_defect)?.map_err(NotRead::NoRoom)?;
            let bytes = survey.bytes_needed.max(survey.parts.bytes_in_memory);
            if limit.is_some_and(|limit| known.saturating_add(bytes) > limit) {
                return Err(NotRead::NoRoom("more than is read ahead".into()));
            }
            if let (None, Some(pager)) = (limit, &present.pager) {
                pager.make_room(survey.bytes_needed);
                generator.forget_pages(present.scene, &present.lights).await;
            }
            let look = present.greeting.look.clone();
            // A volume that was shown meanwhile is not kept for this.
            drop(present);
            let read = tokio::task::spawn_blocking(move || tellers.read(&*loader, survey, held, look));
            read.await.map_err(NotRead::by_defect)?
        });
        Some(Reading { part, work, cancel, progress })
    }

    /// Cancels a reading and waits for its end: two at a time would need memory for both. Returns the newest order
    /// that has arrived meanwhile, if any.
    async fn stop(&mut self, reading: Reading) -> Option<Option<Order>> {
        let Reading { mut work, cancel, .. } = reading;
        drop(cancel);
        let mut newest = None;
        loop {
            tokio::select! {
                _ = &mut work => return newest,
                order = self.orders.recv(), if newest != Some(None) => newest = Some(order),
            }
        }
    }

    /// Shows a part that was read. Its pages come as those of the part before go.
    async fn show(&mut self, read: Read) -> Ended {
        let Read { scene, look, parts, pager } = read;
        let before = self.present.borrow().clone();
        let number = SceneNumber(before.scene.0.wrapping_add(1));
        let present = Present::new(&scene, number, look.clone(), Some(parts.clone()), pager.clone());
        let (lights, bytes) = (present.lights.clone(), present.bytes);
        let shown = ShownScene { scene, look, number, lights, pager };
        if let Err(problem) = self.generator.dispatch.show(shown).await {
            return Ended::Failed(problem.to_string());
        }
        let remains = match &before.pager {
            Some(pager) => pager.end(),
            None => Remains::of_volume(before.lights.first_scene().whole()),
        };
        before.lights.forget_pages().await;
        if let Some(pager) = &present.pager {
            pager.follow(remains);
        }
        self.present.send_replace(Arc::new(present));
        self.ahead.follow(before.again(), &parts, bytes);
        Ended::Done
    }
}

/// What a reading needs beside its part.
struct Tellers {
    load: watch::Sender<Option<Load>>,
    cancelled: Arc<AtomicBool>,
    progress: Arc<Progress>,
}

impl Tellers {
    fn of(reader: &SelectionReader, cancel: &CancelOnDrop, progress: &Arc<Progress>) -> Self {
        Self { load: reader.load.clone(), cancelled: cancel.0.clone(), progress: progress.clone() }
    }

    fn tell(&self) {
        self.load.send_if_modified(|load| {
            // A newer load has replaced this one, or nobody waits for it.
            let is_wanted =
                self.progress.is_told.load(Ordering::Relaxed) && !self.cancelled.load(Ordering::Relaxed);
            let Some(load) = load.as_mut().filter(|_| is_wanted) else { return false };
            let before = (load.bytes_needed, load.state.clone());
            self.progress.tell(load);
            before != (load.bytes_needed, load.state.clone())
        });
    }

    /// Reads a part beside `held` bytes. This may block.
    fn read(&self, loader: &dyn Loader, survey: Survey, held: u64, look: Look) -> Result<Read, NotRead> {
        self.progress.bytes_needed.store(survey.bytes_needed, Ordering::Relaxed);
        self.tell();
        let progress = |fraction: f32| {
            // Steps of a hundredth are fine enough for the eye.
            let permille = (fraction.clamp(0.0, 1.0) * 100.0) as u16 * 10;
            self.progress.permille.store(permille, Ordering::Relaxed);
            self.tell();
        };
        let loaded = loader.load(&survey.parts.shown, held, &progress, &self.cancelled);
        let Loaded { volume, transfer, channels } = loaded.map_err(NotRead::Failed)?;
        if self.cancelled.load(Ordering::Relaxed) {
            return Err(NotRead::Failed("cancelled".into()));
        }
        let pager = Pager::of(&volume).map_err(|e| NotRead::Failed(e.to_string()))?;
        let look = Look { transfer, channels, ..look };
        let scene = Scene::of_look(Arc::new(volume), &look);
        Ok(Read { scene, look, parts: survey.parts, pager })
    }
}

/// Cancels the reader when nobody waits any more.
#[derive(Default)]
struct CancelOnDrop(Arc<AtomicBool>);

impl Drop for CancelOnDrop {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}
