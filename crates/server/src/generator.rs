//! The thread that owns the renderer.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use isinglass_core::kernels::march::Scene;
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::look::Look;
use isinglass_gpu::{Backend, GpuError, Renderer};
use tokio::sync::{mpsc, oneshot};

use crate::parts::SceneNumber;
use crate::{ServeError, march_settings};

/// Makes layered frames one after the other, in the order they are asked for. Clones share the thread, which ends
/// with the last of them.
#[derive(Clone)]
pub(crate) struct Generator {
    jobs: mpsc::Sender<Job>,
}

/// A frame and what it cost.
pub(crate) struct Generated {
    /// The frame.
    pub(crate) frame: LayeredFrame,
    /// Marching and layering, µs.
    pub(crate) generate_micros: u64,
}

/// Whether a frame is still wanted. Clones are the same wish.
#[derive(Clone, Debug, Default)]
pub(crate) struct Wish {
    is_over: Arc<AtomicBool>,
}

impl Wish {
    /// Whoever makes the frame stops as soon as it asks.
    pub(crate) fn give_up(&self) {
        self.is_over.store(true, Ordering::Relaxed);
    }

    /// Whether the frame is wanted.
    pub(crate) fn holds(&self) -> bool {
        !self.is_over.load(Ordering::Relaxed)
    }
}

/// Why there is no frame. The next one may succeed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum GenerateError {
    /// What the GPU could not do.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// A defect. Frames are made on the CPU from then on.
    #[error("the renderer failed on this frame")]
    Panicked,
    /// The wish was given up.
    #[error("the frame is no longer wanted")]
    GivenUp,
    /// Another volume is shown meanwhile.
    #[error("the frame is of a volume that is no longer shown")]
    OtherVolume,
}

enum Job {
    Frame(Order),
    Replace { renderer: Box<Renderer>, look: Look, number: SceneNumber, reply: oneshot::Sender<()> },
}

struct Order {
    scene: SceneNumber,
    look: Look,
    header: FrameHeader,
    wish: Wish,
    reply: oneshot::Sender<Result<Generated, GenerateError>>,
}

/// What the thread has.
struct Studio {
    renderer: Renderer,
    look: Look,
    scene: SceneNumber,
}

impl Generator {
    /// Puts a scene, which has `look`, on a thread of its own.
    ///
    /// # Errors
    /// If the scene does not fit the backend, or there is no thread to be had.
    pub(crate) fn start(backend: &Backend, scene: Scene, look: Look) -> Result<Self, ServeError> {
        let renderer = backend.renderer(scene)?;
        let mut studio = Studio { renderer, look, scene: SceneNumber::default() };
        // Its own threads: on the common ones, encoding a frame would wait until the next one is generated.
        let threads = rayon::ThreadPoolBuilder::new().thread_name(|i| format!("march {i}")).build()?;
        let (jobs, mut receiver) = mpsc::channel(MAX_JOBS);
        let work = move || studio.work(&mut receiver);
        std::thread::Builder::new()
            .name("generator".into())
            .spawn(move || threads.install(work))
            .map_err(ServeError::Thread)?;
        Ok(Self { jobs })
    }

    /// The frame for `header` of a scene under a valid look, as long as the wish holds. `None` if the thread has ended.
    ///
    /// # Errors
    /// If this frame cannot be made.
    pub(crate) async fn generate(
        &self,
        scene: SceneNumber,
        look: Look,
        header: FrameHeader,
        wish: Wish,
    ) -> Option<Result<Generated, GenerateError>> {
        let (reply, answer) = oneshot::channel();
        self.jobs.send(Job::Frame(Order { scene, look, header, wish, reply })).await.ok()?;
        answer.await.ok()
    }

    /// Frames that are begun from now on are of another scene, which has `look`. False if the thread has ended.
    pub(crate) async fn replace(&self, renderer: Renderer, look: Look, number: SceneNumber) -> bool {
        let (reply, answer) = oneshot::channel();
        let job = Job::Replace { renderer: Box::new(renderer), look, number, reply };
        self.jobs.send(job).await.is_ok() && answer.await.is_ok()
    }
}

impl Studio {
    fn work(&mut self, jobs: &mut mpsc::Receiver<Job>) {
        while let Some(job) = jobs.blocking_recv() {
            match job {
                Job::Frame(order) => self.answer(order),
                Job::Replace { renderer, look, number, reply } => {
                    *self = Self { renderer: *renderer, look, scene: number };
                    let _ = reply.send(());
                }
            }
        }
    }

    fn answer(&mut self, order: Order) {
        // Nobody waits any more: the viewer has left while its frame was in the queue.
        if order.reply.is_closed() {
            return;
        }
        // A defect in one frame must not end the service of everyone.
        let attempt = catch_unwind(AssertUnwindSafe(|| self.generate(&order)));
        let result = attempt.unwrap_or(Err(GenerateError::Panicked));
        if matches!(result, Err(GenerateError::Panicked | GenerateError::Gpu(GpuError::Lost { .. }))) {
            tracing::error!("rendering on the CPU from now on: the renderer is lost");
            self.renderer = Renderer::Cpu(Box::new(self.renderer.scene().clone()));
        }
        let _ = order.reply.send(result);
    }

    fn generate(&mut self, order: &Order) -> Result<Generated, GenerateError> {
        let Self { renderer, look, scene } = self;
        if order.scene != *scene {
            return Err(GenerateError::OtherVolume);
        }
        let started = Instant::now();
        if order.look.transfer != look.transfer || order.look.shaded != look.shaded {
            renderer.set_look(&order.look.transfer, march_settings(&order.look))?;
            *look = order.look.clone();
        }
        let frame = renderer.generate_while(order.header, order.look.layering, &|| order.wish.holds())?;
        let frame = frame.ok_or(GenerateError::GivenUp)?;
        Ok(Generated { frame, generate_micros: started.elapsed().as_micros() as u64 })
    }
}

/// Every viewer waits for at most one frame; those beyond this wait to ask.
const MAX_JOBS: usize = 16;
