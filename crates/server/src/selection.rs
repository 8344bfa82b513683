//! Other parts of the file: it reads the newest request beside the shown part, and then replaces that.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

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
use isinglass_render::{Backend, Renderer};
use tokio::sync::{mpsc, watch};

use crate::generator::{Generator, renderer_of};
use crate::lights::Lights;

/// Opens parts of the volume's file. This crate opens no files itself: the server's owner supplies a loader.
///
/// Both functions run on threads that may block.
pub trait Loader: Send + Sync {
    /// The choices in the file and the part that would be shown, from the header alone.
    ///
    /// # Errors
    /// One line for the user: the part does not exist, or does not fit into memory beside the `held` bytes.
    fn survey(&self, part: &Part, held: u64) -> Result<Survey, String>;

    /// Reads the part. `progress` gets the fraction that was read; reading ends soon after `cancel` becomes true.
    ///
    /// # Errors
    /// One line for the user.
    fn load(&self, part: &Part, progress: &dyn Fn(f32), cancel: &AtomicBool) -> Result<Loaded, String>;
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
    pub(crate) fn new(scene: &Scene, number: SceneNumber, look: Look, parts: Option<Choices>) -> Self {
        let lights = Lights::new(scene, &look);
        let greeting = Greeting {
            volume: VolumeDescription::of_channels(scene.whole(), scene.histograms()),
            look_version: LookVersion(1),
            look,
        };
        Self {
            greeting: Arc::new(greeting),
            bounds: scene.volume.bounds(),
            lights,
            scene: number,
            parts: parts.map(Choices::bounded),
            bytes: scene.whole().bytes_in_memory(),
        }
    }

    /// Whether values mean the same in both, as they do across times, levels and regions.
    pub(crate) fn has_values_like(&self, other: &Self) -> bool {
        let kind = |present: &Self| present.parts.as_ref().map(|p| (p.shown.channel, p.shown.series));
        kind(self).is_some() && kind(self) == kind(other)
    }
}

/// Reads requested parts, the newest first, until nobody can request any.
pub(crate) struct SelectionReader {
    pub(crate) loader: Option<Arc<dyn Loader>>,
    pub(crate) backend: Backend,
    pub(crate) generator: Generator,
    pub(crate) orders: mpsc::Receiver<Order>,
    pub(crate) present: watch::Sender<Arc<Present>>,
    pub(crate) load: watch::Sender<Option<Load>>,
}

/// How a load ended.
enum Ended {
    Done,
    Failed(String),
    /// This order has arrived meanwhile; `None` means that nobody is left.
    Interrupted(Option<Order>),
}

impl SelectionReader {
    pub(crate) async fn run(mut self) {
        let mut next = self.orders.recv().await;
        let mut id = LoadId(0);
        while let Some(mut order) = next {
            while let Ok(newer) = self.orders.try_recv() {
                order = newer;
            }
            let (viewer, Some(part)) = order else {
                next = self.orders.recv().await;
                continue;
            };
            id = id.next();
            let state = LoadState::Reading { permille: 0 };
            self.load.send_replace(Some(Load { id, viewer, part, bytes_needed: 0, state }));
            let ended = self.open(part).await;
            let (state, order) = match ended {
                Ended::Done => (LoadState::Done, None),
                Ended::Failed(problem) => (LoadState::Failed(one_line(&problem)), None),
                Ended::Interrupted(None) => return,
                Ended::Interrupted(order) => (LoadState::Cancelled, order),
            };
            tracing::info!(load = id.0, ?state, "another part");
            self.tell(|load| load.state = state);
            next = match order {
                Some(order) => Some(order),
                None => self.orders.recv().await,
            };
        }
    }

    fn tell(&self, change: impl FnOnce(&mut Load)) {
        self.load.send_modify(|load| {
            if let Some(load) = load {
                change(load);
            }
        });
    }

    /// Reads a part and shows it, unless another order arrives first.
    async fn open(&mut self, part: Part) -> Ended {
        let Some(loader) = self.loader.clone() else {
            return Ended::Failed("this server shows this part of its file only".into());
        };
        if self.backend.is_lost() {
            let lost = self.backend.clone();
            if let Ok(backend) = tokio::task::spawn_blocking(move || lost.reopened()).await {
                self.backend = backend;
            }
        }
        let held = self.present.borrow().bytes;
        let look = self.present.borrow().greeting.look.clone();
        let cancel = CancelOnDrop::default();
        let (backend, load, cancelled) = (self.backend.clone(), self.load.clone(), cancel.0.clone());
        let mut reading = tokio::task::spawn_blocking(move || {
            let survey = loader.survey(&part, held)?;
            let tell = |change: &dyn Fn(&mut Load)| {
                load.send_if_modified(|load| {
                    // A newer load has replaced this one.
                    let Some(load) = load.as_mut().filter(|_| !cancelled.load(Ordering::Relaxed)) else {
                        return false;
                    };
                    let before = (load.bytes_needed, load.state.clone());
                    change(load);
                    before != (load.bytes_needed, load.state.clone())
                });
            };
            tell(&|load| load.bytes_needed = survey.bytes_needed);
            let progress = |fraction: f32| {
                // Steps of a hundredth are fine enough for the eye.
                let permille = (fraction.clamp(0.0, 1.0) * 100.0) as u16 * 10;
                tell(&|load| load.state = LoadState::Reading { permille });
            };
            let loaded = loader.load(&part, &progress, &cancelled)?;
            if cancelled.load(Ordering::Relaxed) {
                return Err("cancelled".into());
            }
            let Loaded { volume, transfer, channels } = loaded;
            let look = Look { transfer, channels, ..look };
            let scene = Scene::of_look(Arc::new(volume), &look);
            let renderer = renderer_of(&backend, scene.clone()).map_err(|e| e.to_string())?;
            Ok::<_, String>((scene, renderer, look, survey.parts))
        });
        let read = tokio::select! {
            read = &mut reading => read,
            order = self.orders.recv() => {
                drop(cancel);
                // Reading two at a time would need memory for both. Of later orders only the newest counts.
                let mut newest = order;
                loop {
                    tokio::select! {
                        _ = &mut reading => return Ended::Interrupted(newest),
                        order = self.orders.recv(), if newest.is_some() => newest = order,
                    }
                }
            }
        };
        let (scene, renderer, look, parts) = match read {
            Ok(Ok(read)) => read,
            Ok(Err(problem)) => return Ended::Failed(problem),
            Err(e) => {
                tracing::error!("reading ended early: {e}");
                return Ended::Failed("the server failed on reading this part".into());
            }
        };
        let number = SceneNumber(self.present.borrow().scene.0.wrapping_add(1));
        let present = Present::new(&scene, number, look.clone(), Some(parts));
        let lights = present.lights.clone();
        let has_failed = matches!((&self.backend, &renderer), (Backend::Gpu(_), Renderer::Cpu(_)));
        if !self.generator.replace(renderer, look.clone(), number, lights.clone()).await {
            return Ended::Failed("the renderer has ended".into());
        }
        self.present.send_replace(Arc::new(present));
        if has_failed {
            // The previous part's memory is free now.
            let backend = self.backend.clone();
            let again = tokio::task::spawn_blocking(move || backend.renderer(scene)).await;
            if let Ok(Ok(renderer)) = again {
                tracing::info!("the GPU has room for this part now");
                self.generator.replace(renderer, look, number, lights).await;
            }
        }
        Ended::Done
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
