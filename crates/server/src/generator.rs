//! The thread that owns the renderer.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use isinglass_core::camera::{Camera, Intrinsics};
use isinglass_core::kernels::march::{MarchSettings, Scene};
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::look::Look;
use isinglass_core::picture::Picture;
use isinglass_core::volume::{Detail, Occlusion};
use isinglass_gpu::GpuError;
use isinglass_net::{AfterWork, Work};
use isinglass_render::{Backend, Renderer};
use tokio::sync::{Semaphore, mpsc, oneshot};

use crate::ServeError;
use crate::lights::Lights;
use crate::selection::SceneNumber;

/// Makes layered frames in the order of requests. Clones share the thread, which ends with the last of them.
#[derive(Clone)]
pub(crate) struct Generator {
    jobs: mpsc::Sender<Job>,
    after_work: AfterWork,
    pictures: Arc<Semaphore>,
}

pub(crate) struct Generated {
    pub(crate) frame: LayeredFrame,
    /// Time for marching and layering, µs.
    pub(crate) generate_micros: u64,
    /// Whether the shade is a draft, so that [`Lights::scene`] can provide a finer one.
    pub(crate) is_draft: bool,
    /// The ambient occlusion of a frame that is no draft.
    pub(crate) occlusion: Option<Occlusion>,
}

/// How a viewer wants its frame.
pub(crate) struct Wanted {
    /// A valid look.
    pub(crate) look: Look,
    /// The ambient occlusion of this viewer's last frame that had all of its shade. A draft borrows it.
    pub(crate) near: Option<Occlusion>,
    pub(crate) header: FrameHeader,
    pub(crate) wish: Wish,
}

/// Whether a frame is still wanted. Clones share the answer.
#[derive(Clone, Debug, Default)]
pub(crate) struct Wish {
    is_over: Arc<AtomicBool>,
}

impl Wish {
    /// Cancels the frame; its maker stops at its next check.
    pub(crate) fn give_up(&self) {
        self.is_over.store(true, Ordering::Relaxed);
    }

    /// Whether the frame is still wanted.
    pub(crate) fn holds(&self) -> bool {
        !self.is_over.load(Ordering::Relaxed)
    }
}

/// Why there is no frame. The next one may succeed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum GenerateError {
    /// The GPU has failed.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// A panic. The CPU makes all later frames.
    #[error("the renderer failed on this frame")]
    Panicked,
    /// The frame was cancelled.
    #[error("the frame is no longer wanted")]
    GivenUp,
    /// Another volume is shown by now.
    #[error("the frame is of a volume that is no longer shown")]
    OtherVolume,
}

impl GenerateError {
    /// Whether the renderer is lost; another has replaced it.
    pub(crate) fn is_lost(&self) -> bool {
        match self {
            Self::Gpu(e) => e.is_lost(),
            Self::Panicked => true,
            Self::GivenUp | Self::OtherVolume => false,
        }
    }
}

enum Job {
    Frame(Box<FrameJob>),
    Rows(Box<RowsJob>),
    Replace { state: Box<RenderThread>, reply: oneshot::Sender<()> },
}

type Reply<T> = oneshot::Sender<Result<T, GenerateError>>;

struct FrameJob {
    scene: SceneNumber,
    wanted: Wanted,
    reply: Reply<Generated>,
}

/// The next rows of a picture.
struct RowsJob {
    scene: SceneNumber,
    look: Look,
    /// The scene with all of its shade, if it has any.
    lit: Option<Scene>,
    camera: Camera,
    first: u32,
    reply: Reply<Picture>,
}

struct RenderThread {
    renderer: Renderer,
    look: Look,
    scene: SceneNumber,
    lights: Lights,
    after_work: AfterWork,
}

impl Generator {
    /// Puts a scene with `look` on a thread of its own.
    ///
    /// # Errors
    /// If the scene does not fit the backend, or no thread is available.
    pub(crate) fn start(
        backend: &Backend,
        scene: Scene,
        look: Look,
        lights: Lights,
        after_work: AfterWork,
    ) -> Result<Self, ServeError> {
        let renderer = renderer_of(backend, scene)?;
        let mut state = RenderThread {
            renderer,
            look,
            scene: SceneNumber::default(),
            lights,
            after_work: after_work.clone(),
        };
        // The march has threads of its own: on shared ones, encoding a frame would wait until the next one is
        // generated.
        let threads = rayon::ThreadPoolBuilder::new().thread_name(|i| format!("march {i}")).build()?;
        let (jobs, mut receiver) = mpsc::channel(MAX_JOBS);
        let work = move || state.work(&mut receiver);
        std::thread::Builder::new()
            .name("generator".into())
            .spawn(move || threads.install(work))
            .map_err(ServeError::Thread)?;
        Ok(Self { jobs, after_work, pictures: Arc::new(Semaphore::new(1)) })
    }

    /// A frame of a scene, while the wish holds. `None` if the thread has ended.
    ///
    /// # Errors
    /// If this frame cannot be made.
    pub(crate) async fn generate(
        &self,
        scene: SceneNumber,
        wanted: Wanted,
    ) -> Option<Result<Generated, GenerateError>> {
        let (reply, answer) = oneshot::channel();
        let order = Box::new(FrameJob { scene, wanted, reply });
        self.jobs.send(Job::Frame(order)).await.ok()?;
        answer.await.ok()
    }

    /// Later frames show another scene, which has `look`. Returns false if the thread has ended.
    pub(crate) async fn replace(
        &self,
        renderer: Renderer,
        look: Look,
        number: SceneNumber,
        lights: Lights,
    ) -> bool {
        let (reply, answer) = oneshot::channel();
        let state = Box::new(RenderThread {
            renderer,
            look,
            scene: number,
            lights,
            after_work: self.after_work.clone(),
        });
        self.jobs.send(Job::Replace { state, reply }).await.is_ok() && answer.await.is_ok()
    }

    /// The picture from `camera` of a scene under a valid look, by full volume rendering with all shade. It is 8-bit
    /// sRGB over a linear background, three bytes per pixel, or transparent with four. It is made in pieces, with frames in between, and only
    /// one at a time, because pictures are large. `None` if the thread has ended. Dropping this cancels the picture.
    ///
    /// # Errors
    /// If it cannot be made.
    pub(crate) async fn picture(
        &self,
        scene: SceneNumber,
        look: &Look,
        lights: &Lights,
        camera: Camera,
        background: Option<[f32; 3]>,
    ) -> Option<Result<Vec<u8>, GenerateError>> {
        let _turn = self.pictures.acquire().await.ok()?;
        let lit = if look.lighting.is_on() { Some(lights.scene(look).await?) } else { None };
        let (mut srgb, mut first, mut has_failed) = (Vec::new(), 0, false);
        while first < camera.intrinsics.height {
            let (reply, answer) = oneshot::channel();
            let (look, lit) = (look.clone(), lit.clone());
            let order = Box::new(RowsJob { scene, look, lit, camera, first, reply });
            self.jobs.send(Job::Rows(order)).await.ok()?;
            match answer.await.ok()? {
                Ok(rows) => {
                    first += rows.height;
                    srgb.extend(match background {
                        Some(background) => rows.to_srgb8(background),
                        None => rows.to_srgba8(),
                    });
                }
                // Another renderer has replaced a lost one, so this tries once more.
                Err(e) if e.is_lost() && !std::mem::replace(&mut has_failed, true) => {}
                Err(e) => return Some(Err(e)),
            }
        }
        Some(Ok(srgb))
    }
}

/// A renderer on the backend, or on the CPU if that fails by itself or is too small.
pub(crate) fn renderer_of(backend: &Backend, scene: Scene) -> Result<Renderer, GpuError> {
    match backend.renderer(scene.clone()) {
        Err(e) if e.asks_for_cpu() => {
            tracing::error!("rendering on the CPU: {e}");
            Backend::Cpu.renderer(scene)
        }
        made => made,
    }
}

impl RenderThread {
    fn work(&mut self, jobs: &mut mpsc::Receiver<Job>) {
        while let Some(job) = jobs.blocking_recv() {
            // A closed reply means that the viewer left while its order was in the queue.
            match job {
                Job::Frame(order) if !order.reply.is_closed() => {
                    let made = self.attempt(|state| state.generate(&order));
                    let _ = order.reply.send(made);
                }
                Job::Rows(order) if !order.reply.is_closed() => {
                    let made = self.attempt(|state| state.rows(&order));
                    let _ = order.reply.send(made);
                }
                Job::Frame(_) | Job::Rows(_) => {}
                Job::Replace { state, reply } => {
                    *self = *state;
                    let _ = reply.send(());
                }
            }
        }
    }

    /// A panic in one frame must not end the service for everyone.
    fn attempt<T>(
        &mut self,
        work: impl FnOnce(&mut Self) -> Result<T, GenerateError>,
    ) -> Result<T, GenerateError> {
        let attempt = catch_unwind(AssertUnwindSafe(|| work(self)));
        let result = attempt.unwrap_or(Err(GenerateError::Panicked));
        if result.as_ref().is_err_and(GenerateError::is_lost) {
            tracing::error!("rendering on the CPU from now on: the renderer is lost");
            self.renderer = Renderer::on_cpu(self.renderer.scene().clone());
        }
        result
    }

    fn generate(&mut self, order: &FrameJob) -> Result<Generated, GenerateError> {
        let started = Instant::now();
        let Wanted { look, near, header, wish } = &order.wanted;
        self.prepare(order.scene, look, near.as_ref(), None)?;
        let (renderer, wanted) = (&mut self.renderer, || wish.holds());
        let work = || renderer.generate_while(*header, &wanted);
        let frame = self.after_work.run(Work::Generate, work)?;
        let frame = frame.ok_or(GenerateError::GivenUp)?;
        let is_draft = !self.is_final();
        let occlusion = self.renderer.scene().illumination.occlusion().filter(|_| !is_draft);
        let generate_micros = started.elapsed().as_micros() as u64;
        Ok(Generated { frame, generate_micros, is_draft, occlusion })
    }

    /// Renders as many rows of a picture as take no longer than a frame.
    fn rows(&mut self, order: &RowsJob) -> Result<Picture, GenerateError> {
        self.prepare(order.scene, &order.look, None, order.lit.as_ref())?;
        let Intrinsics { width, height, .. } = order.camera.intrinsics;
        let num_pixels = match self.renderer {
            Renderer::Gpu(_) => GPU_PIXELS,
            Renderer::Cpu(_) => CPU_PIXELS,
        };
        let end = order.first.saturating_add((num_pixels / width.max(1)).max(1)).min(height);
        Ok(self.renderer.render_rows(&order.camera, order.first..end)?)
    }

    /// Sets a look: with all of its shade if that is known or given, else with a draft. The scene may have the look of
    /// any viewer, so its ambient occlusion is not taken.
    fn prepare(
        &mut self,
        scene: SceneNumber,
        look: &Look,
        near: Option<&Occlusion>,
        lit: Option<&Scene>,
    ) -> Result<(), GenerateError> {
        if scene != self.scene {
            return Err(GenerateError::OtherVolume);
        }
        let is_set = self.look.marches_like(look);
        if is_set && self.is_final() {
            // This marks the look as used, so that it is not evicted first.
            self.lights.known(look);
            return Ok(());
        }
        match lit.cloned().or_else(|| self.lights.known(look)) {
            Some(lit) => self.renderer.set_scene(lit)?,
            None if is_set => return Ok(()),
            None => {
                let settings = MarchSettings { detail: Detail::Draft, ..look.march_settings() };
                let draft = self.renderer.scene().with_look_near(&look.transfer, settings, near);
                self.renderer.set_scene(draft)?;
            }
        }
        self.look = look.clone();
        Ok(())
    }

    fn is_final(&self) -> bool {
        self.renderer.scene().illumination.is_final()
    }
}

/// Most waiting jobs. Every viewer waits for at most one frame; further ones wait to ask.
const MAX_JOBS: usize = 16;
/// Pixels of a picture per piece, so that no viewer waits long for its frame: about a tenth of a second on two cores,
/// and much less on a GPU.
const CPU_PIXELS: u32 = 1 << 16;
const GPU_PIXELS: u32 = 1 << 20;

#[cfg(test)]
mod tests;
