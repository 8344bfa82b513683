//! The rendering threads, one for each device, and which of them does a viewer's work.
//!
//! A device gets the volume when the first viewer comes to it. Until then, and when it is lost, the others do the work
//! of its viewers. When the last one is lost, its thread goes on with the CPU. What the CPU computes for a look is shared.

use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use isinglass_core::kernels::march::Scene;
use isinglass_core::look::Look;
use isinglass_core::session::admission::ViewerId;
use isinglass_gpu::GpuError;
use isinglass_net::AfterWork;
use isinglass_render::{Backend, Devices, Renderer};
use tokio::sync::{mpsc, oneshot, watch};

use crate::ServeError;
use crate::company::Company;
use crate::counters::Counters;
use crate::generator::Job;
use crate::lights::Lights;
use crate::paging::Pager;
use crate::placement::{Device, Place, Placement};
use crate::render_thread::RenderThread;
use crate::selection::SceneNumber;

/// What all devices show.
#[derive(Clone, Debug)]
pub(crate) struct ShownScene {
    pub(crate) scene: Scene,
    /// The look of the scene.
    pub(crate) look: Look,
    pub(crate) number: SceneNumber,
    pub(crate) lights: Lights,
    /// Reads the pages, if the volume is read by pages.
    pub(crate) pager: Option<Pager>,
}

/// A device of a server, and what it does.
#[derive(Clone, Debug)]
pub struct DeviceUse {
    /// Where its kernels run.
    pub description: String,
    /// Whether it has the volume: it gets it with its first viewer.
    pub is_ready: bool,
    /// Viewers whose frames it makes.
    pub viewers: usize,
    /// Time in which it has worked.
    pub rendering: Duration,
}

/// Clones share the threads, which end with the last of them.
#[derive(Clone)]
pub(crate) struct Dispatch(Arc<RenderThreads>);

struct RenderThreads {
    state: Mutex<DispatchState>,
    /// Notified when a device is ready or no longer there.
    changed: watch::Sender<()>,
    after_work: AfterWork,
    counters: Counters,
}

struct DispatchState {
    placement: Placement,
    slots: Vec<Slot>,
    shown: ShownScene,
    /// The sessions of each viewer that is there.
    present: HashMap<ViewerId, usize>,
    /// Whether no thread starts any more.
    is_over: bool,
}

struct Slot {
    backend: Backend,
    /// Orders for its thread, if that runs.
    jobs: Option<mpsc::Sender<Job>>,
    /// Who has had work there lately.
    company: Company,
    /// Time in which it has worked, µs.
    micros: Arc<AtomicU64>,
}

/// A device as its rendering thread sees it.
#[derive(Clone, Default)]
pub(crate) struct Site {
    device: usize,
    shared: Weak<RenderThreads>,
    micros: Arc<AtomicU64>,
}

impl Site {
    /// The device has worked for so long.
    pub(crate) fn note_rendering(&self, micros: u64) {
        self.micros.fetch_add(micros, Ordering::Relaxed);
    }

    /// Whether a viewer is still there.
    pub(crate) fn is_here(&self, viewer: ViewerId) -> bool {
        let shared = self.shared.upgrade();
        shared.is_none_or(|shared| shared.state().present.contains_key(&viewer))
    }

    /// The device makes no more frames. Returns whether others do; if not, the thread goes on with the CPU.
    pub(crate) fn lose(&self) -> bool {
        let Some(shared) = self.shared.upgrade() else { return false };
        let has_others = {
            let mut state = shared.state();
            let has_others = state.placement.lose(self.device);
            if has_others {
                state.slots[self.device].jobs = None;
            }
            has_others
        };
        shared.changed.send_replace(());
        has_others
    }
}

/// An order that has no answer yet.
pub(crate) struct Working {
    shared: Arc<RenderThreads>,
    viewer: ViewerId,
}

impl Drop for Working {
    fn drop(&mut self) {
        self.shared.state().placement.end(self.viewer, Instant::now());
    }
}

impl Dispatch {
    /// Starts the first device that can show the scene, or the CPU if none can.
    ///
    /// # Errors
    /// If the scene does not fit any device nor the CPU, or no thread is available.
    pub(crate) fn start(
        devices: &Devices,
        shown: ShownScene,
        after_work: AfterWork,
        counters: Counters,
    ) -> Result<Self, ServeError> {
        let num = devices.each().len();
        let slot = |backend: &Backend| Slot {
            backend: backend.clone(),
            jobs: None,
            company: Company::default(),
            micros: Arc::default(),
        };
        let slots = devices.each().iter().map(slot).collect();
        let shared = Arc::new(RenderThreads {
            state: Mutex::new(DispatchState {
                placement: Placement::new(num),
                slots,
                shown: shown.clone(),
                present: HashMap::new(),
                is_over: false,
            }),
            changed: watch::channel(()).0,
            after_work,
            counters,
        });
        let mut state = shared.state();
        for (device, backend) in devices.each().iter().enumerate() {
            let renderer = match backend.renderer(shown.scene.clone()) {
                Err(e) if e.asks_for_cpu() && state.placement.lose(device) => {
                    tracing::error!("{}: {e}", backend.description());
                    continue;
                }
                Err(e) if e.asks_for_cpu() => {
                    tracing::error!("rendering on the CPU: {e}");
                    Renderer::on_cpu(shown.scene.clone())
                }
                made => made?,
            };
            shared.run(&mut state, device, renderer)?;
            break;
        }
        drop(state);
        Ok(Self(shared))
    }

    /// Hands a viewer's work to the thread of its device, and counts it until what this returns is dropped. `None` if
    /// no thread is left.
    pub(crate) async fn send(&self, viewer: ViewerId, mut job: Job) -> Option<Working> {
        loop {
            let mut changed = self.0.changed.subscribe();
            changed.borrow_and_update();
            let (place, jobs) = self.place(viewer);
            let starting = place.start.map(|device| {
                let shared = self.0.clone();
                tokio::task::spawn_blocking(move || shared.make_ready(device, Backend::renderer))
            });
            match (place.device, jobs) {
                (Some(device), Some(jobs)) => match jobs.send(job).await {
                    Ok(()) => return Some(self.begin(viewer)),
                    Err(mpsc::error::SendError(back)) => {
                        job = back;
                        self.0.note_ended(device, &jobs)?;
                    }
                },
                _ => {
                    let has_failed = match starting {
                        Some(starting) => !starting.await.ok()?,
                        None => false,
                    };
                    if has_failed {
                        return None;
                    }
                    changed.changed().await.ok()?;
                }
            }
        }
    }

    fn begin(&self, viewer: ViewerId) -> Working {
        self.0.state().placement.begin(viewer, Instant::now());
        Working { shared: self.0.clone(), viewer }
    }

    fn place(&self, viewer: ViewerId) -> (Place, Option<mpsc::Sender<Job>>) {
        let mut state = self.0.state();
        let place = state.placement.place(viewer, Instant::now());
        if !state.present.contains_key(&viewer) {
            // It has left, and this is its last order.
            state.placement.forget(viewer);
        }
        let jobs = place.device.and_then(|device| state.slots[device].jobs.clone());
        (place, jobs)
    }

    /// Ends all threads: a driver may crash when a process ends while a thread uses it. Work that takes long is left
    /// behind.
    pub(crate) async fn stop(&self) {
        self.0.state().is_over = true;
        let stopped = self.tell_all(|reply| Job::Stop { reply });
        let _ = tokio::time::timeout(MOST_FOR_STOPPING, stopped).await;
    }

    /// Gives a job to each thread that runs, and waits until all are done.
    pub(crate) async fn tell_all(&self, job: impl Fn(oneshot::Sender<()>) -> Job) {
        let running: Vec<_> = self.0.state().slots.iter().filter_map(|slot| slot.jobs.clone()).collect();
        let mut answers = Vec::new();
        for jobs in running {
            let (reply, answer) = oneshot::channel();
            if jobs.send(job(reply)).await.is_ok() {
                answers.push(answer);
            }
        }
        for answer in answers {
            let _ = answer.await;
        }
    }

    /// Whether anybody else has had work lately at the device of a viewer.
    pub(crate) fn has_others(&self, viewer: ViewerId, now: Instant) -> bool {
        let company = {
            let state = self.0.state();
            state.placement.device_of(viewer).map(|device| state.slots[device].company.clone())
        };
        company.is_some_and(|company| company.has_others(viewer, now))
    }

    /// What each device does.
    pub(crate) fn uses(&self) -> Vec<DeviceUse> {
        let state = self.0.state();
        let of_slot = |(device, slot): (usize, &Slot)| DeviceUse {
            description: slot.backend.description(),
            is_ready: state.placement.state(device) == Device::Ready,
            viewers: state.placement.num_viewers(device),
            rendering: Duration::from_micros(slot.micros.load(Ordering::Relaxed)),
        };
        state.slots.iter().enumerate().map(of_slot).collect()
    }

    /// A viewer has come.
    pub(crate) fn enter(&self, viewer: ViewerId) {
        *self.0.state().present.entry(viewer).or_default() += 1;
    }

    /// A session of a viewer has ended. Returns whether it was the last one.
    pub(crate) fn forget(&self, viewer: ViewerId) -> bool {
        let mut state = self.0.state();
        let others = state.present.get(&viewer).map_or(0, |sessions| sessions.saturating_sub(1));
        if others > 0 {
            state.present.insert(viewer, others);
        } else {
            state.present.remove(&viewer);
            state.placement.forget(viewer);
        }
        others == 0
    }

    /// Shows another scene. Devices that are in use get it before this returns, the others when somebody needs them.
    ///
    /// # Errors
    /// If it cannot be shown anywhere. Then nothing changes.
    pub(crate) async fn show(&self, shown: ShownScene) -> Result<(), GpuError> {
        self.reopen().await;
        let used: Vec<(usize, Backend)> = {
            let state = self.0.state();
            let used = state.slots.iter().enumerate().filter(|(_, slot)| slot.jobs.is_some());
            used.map(|(device, slot)| (device, slot.backend.clone())).collect()
        };
        let make = |(device, backend): (usize, Backend)| {
            let scene = shown.scene.clone();
            (device, tokio::task::spawn_blocking(move || backend.renderer(scene)))
        };
        let making: Vec<_> = used.into_iter().map(make).collect();
        let mut made = Vec::new();
        for (device, making) in making {
            match making.await {
                Ok(Ok(renderer)) => made.push((device, renderer)),
                Ok(Err(e)) if e.asks_for_cpu() => {
                    tracing::info!("there is no room for both parts: {e}");
                }
                Ok(Err(e)) => return Err(e),
                Err(e) => {
                    tracing::error!("no renderer: {e}");
                }
            }
        }
        self.0.replace(shown, made).await;
        Ok(())
    }

    /// Opens lost devices again.
    async fn reopen(&self) {
        let lost: Vec<(usize, Backend)> = {
            let state = self.0.state();
            let lost = state.slots.iter().enumerate().filter(|(_, slot)| slot.backend.is_lost());
            lost.map(|(device, slot)| (device, slot.backend.clone())).collect()
        };
        for (device, backend) in lost {
            let Ok(found) = tokio::task::spawn_blocking(move || backend.reopened()).await else { continue };
            let mut state = self.0.state();
            let is_in_use = state.slots[device].jobs.is_some();
            // Without a device, who has only the CPU keeps it.
            if let Some(backend) = found.or_else(|| is_in_use.then_some(Backend::Cpu)) {
                state.slots[device].backend = backend;
            }
        }
    }
}

impl RenderThreads {
    fn state(&self) -> MutexGuard<'_, DispatchState> {
        // Every change is one step, so a panic leaves the state in order.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn thread_state(
        self: &Arc<Self>,
        device: usize,
        renderer: Renderer,
        state: &DispatchState,
    ) -> RenderThread {
        let ShownScene { look, number, lights, pager, .. } = state.shown.clone();
        let slot = &state.slots[device];
        RenderThread {
            renderer,
            look,
            scene: number,
            lights,
            awaits_light: false,
            pager,
            after_work: self.after_work.clone(),
            company: slot.company.clone(),
            counters: self.counters.clone(),
            site: Site { device, shared: Arc::downgrade(self), micros: slot.micros.clone() },
        }
    }

    /// Starts the thread of a device.
    fn run(
        self: &Arc<Self>,
        state: &mut DispatchState,
        device: usize,
        renderer: Renderer,
    ) -> Result<(), ServeError> {
        // The march has threads of its own: on shared ones, encoding a frame would wait until the next one is
        // generated. A worker that waits takes any work, so devices share none either.
        let threads = rayon::ThreadPoolBuilder::new().thread_name(|i| format!("march {i}")).build()?;
        let (jobs, mut receiver) = mpsc::channel(MAX_JOBS);
        let thread = self.thread_state(device, renderer, state);
        let work = move || {
            let stopped = threads.install(move || thread.work(&mut receiver));
            // By now its memory is free.
            stopped.map(|stopped| stopped.send(()))
        };
        let started = std::thread::Builder::new().name(format!("generator {device}")).spawn(work);
        started.map_err(ServeError::Thread)?;
        state.slots[device].jobs = Some(jobs);
        state.placement.set(device, Device::Ready);
        Ok(())
    }

    /// Brings the shown scene to a device. If that fails, others do its work; the last one gets the CPU. Returns false
    /// if even that has no thread: then the next order tries again.
    fn make_ready(
        self: &Arc<Self>,
        device: usize,
        make: fn(&Backend, Scene) -> Result<Renderer, GpuError>,
    ) -> bool {
        let is_there = loop {
            let (backend, shown) = {
                let state = self.state();
                (state.slots[device].backend.clone(), state.shown.clone())
            };
            // A driver may panic, and viewers wait.
            let made = catch_unwind(AssertUnwindSafe(|| make(&backend, shown.scene.clone())));
            let made = made.unwrap_or_else(|_| Err(panicked()));
            let mut state = self.state();
            if state.shown.number != shown.number {
                continue;
            }
            let renderer = match made {
                Ok(renderer) => {
                    tracing::info!("viewers have come to device {} of {}", device + 1, state.slots.len());
                    Some(renderer)
                }
                Err(e) if state.placement.lose(device) => {
                    tracing::error!("{}: {e}", backend.description());
                    None
                }
                Err(e) => {
                    tracing::error!("rendering on the CPU: {e}");
                    Some(Renderer::on_cpu(shown.scene))
                }
            };
            let started = renderer.map(|renderer| self.run(&mut state, device, renderer));
            let Some(Err(e)) = started else { break true };
            tracing::error!("{e}");
            break state.placement.lose_or_rest(device);
        };
        self.changed.send_replace(());
        is_there
    }

    /// The thread of a device has ended by itself. Others do its work, or it starts again. `None` if the server ends.
    fn note_ended(&self, device: usize, jobs: &mpsc::Sender<Job>) -> Option<()> {
        {
            let mut state = self.state();
            if state.is_over {
                return None;
            }
            let slot = &mut state.slots[device];
            // Somebody may know already.
            if slot.jobs.take_if(|present| present.same_channel(jobs)).is_some() {
                state.placement.lose_or_rest(device);
            }
        }
        self.changed.send_replace(());
        Some(())
    }

    /// Puts a scene in the place of the one before: on the devices of `made` at once. Others make room first, and get it
    /// when somebody needs them.
    async fn replace(self: &Arc<Self>, shown: ShownScene, made: Vec<(usize, Renderer)>) {
        let mut answers = Vec::new();
        let has_new: Vec<usize> = made.iter().map(|(device, _)| *device).collect();
        let full: Vec<usize>;
        {
            let mut state = self.state();
            state.shown = shown;
            for (device, renderer) in made {
                let thread = Box::new(self.thread_state(device, renderer, &state));
                let (reply, answer) = oneshot::channel();
                let job = Job::Replace { state: thread, reply };
                answers.push((state.slots[device].jobs.clone(), job, answer));
            }
            // Some got ready meanwhile, with the scene before.
            let is_full = |device: &usize| !has_new.contains(device) && state.slots[*device].jobs.is_some();
            full = (0..state.slots.len()).filter(is_full).collect();
            for &device in &full {
                state.placement.set(device, Device::Busy);
                let (reply, answer) = oneshot::channel();
                answers.push((state.slots[device].jobs.take(), Job::Stop { reply }, answer));
            }
        }
        for (jobs, job, answer) in answers {
            if let Some(jobs) = jobs
                && jobs.send(job).await.is_ok()
            {
                let _ = answer.await;
            }
        }
        {
            let mut state = self.state();
            for device in 0..state.slots.len() {
                let is_known = !state.slots[device].backend.is_lost();
                // What had no room for the part before may have room for this one.
                if full.contains(&device) || (state.placement.state(device) == Device::Lost && is_known) {
                    state.placement.set(device, Device::Idle);
                }
            }
        }
        self.changed.send_replace(());
    }
}

fn panicked() -> GpuError {
    GpuError::Failed { what: "getting ready", reason: "it panicked".into() }
}

/// Most jobs on their way to a thread. Every viewer waits for one frame and one piece of a picture at most.
const MAX_JOBS: usize = 16;
/// Time in which threads end.
const MOST_FOR_STOPPING: Duration = Duration::from_secs(5);

#[cfg(test)]
mod tests;
