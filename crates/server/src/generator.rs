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

use crate::{ServeError, march_settings};

/// Makes layered frames one after the other, in the order they are asked for. Clones share the thread, which ends
/// with the last of them.
#[derive(Clone)]
pub struct Generator {
    jobs: mpsc::Sender<Job>,
}

/// A frame and what it cost.
pub struct Generated {
    /// The frame.
    pub frame: LayeredFrame,
    /// Marching and layering, µs.
    pub generate_micros: u64,
}

/// Whether a frame is still wanted. Clones are the same wish.
#[derive(Clone, Debug, Default)]
pub struct Wish {
    is_over: Arc<AtomicBool>,
}

impl Wish {
    /// Whoever makes the frame stops as soon as it asks.
    pub fn give_up(&self) {
        self.is_over.store(true, Ordering::Relaxed);
    }

    /// Whether the frame is wanted.
    pub fn holds(&self) -> bool {
        !self.is_over.load(Ordering::Relaxed)
    }
}

/// Why there is no frame. The next one may succeed.
#[derive(Debug, thiserror::Error)]
pub enum GenerateError {
    /// What the GPU could not do.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// A defect. Frames are made on the CPU from then on.
    #[error("the renderer failed on this frame")]
    Panicked,
    /// The wish was given up.
    #[error("the frame is no longer wanted")]
    GivenUp,
}

struct Job {
    look: Look,
    header: FrameHeader,
    wish: Wish,
    reply: oneshot::Sender<Result<Generated, GenerateError>>,
}

impl Generator {
    /// Puts a scene, which has `look`, on a thread of its own.
    ///
    /// # Errors
    /// If the scene does not fit the backend, or there is no thread to be had.
    pub fn start(backend: &Backend, scene: Scene, look: Look) -> Result<Self, ServeError> {
        let mut renderer = backend.renderer(scene)?;
        // Its own threads: on the common ones, encoding a frame would wait until the next one is generated.
        let threads = rayon::ThreadPoolBuilder::new().thread_name(|i| format!("march {i}")).build()?;
        let (jobs, mut receiver) = mpsc::channel(MAX_JOBS);
        let work = move || work(&mut renderer, look, &mut receiver);
        std::thread::Builder::new()
            .name("generator".into())
            .spawn(move || threads.install(work))
            .map_err(ServeError::Thread)?;
        Ok(Self { jobs })
    }

    /// The frame for `header` under a valid look, as long as the wish holds. `None` if the thread has ended.
    ///
    /// # Errors
    /// If this frame cannot be made.
    pub async fn generate(
        &self,
        look: Look,
        header: FrameHeader,
        wish: Wish,
    ) -> Option<Result<Generated, GenerateError>> {
        let (reply, answer) = oneshot::channel();
        self.jobs.send(Job { look, header, wish, reply }).await.ok()?;
        answer.await.ok()
    }
}

fn work(renderer: &mut Renderer, mut look: Look, jobs: &mut mpsc::Receiver<Job>) {
    while let Some(job) = jobs.blocking_recv() {
        // Nobody waits any more: the viewer has left while its frame was in the queue.
        if job.reply.is_closed() {
            continue;
        }
        // A defect in one frame must not end the service of everyone.
        let attempt = catch_unwind(AssertUnwindSafe(|| generate(renderer, &mut look, &job)));
        let result = attempt.unwrap_or(Err(GenerateError::Panicked));
        if matches!(result, Err(GenerateError::Panicked | GenerateError::Gpu(GpuError::Lost { .. }))) {
            tracing::error!("rendering on the CPU from now on: the renderer is lost");
            *renderer = Renderer::Cpu(Box::new(renderer.scene().clone()));
        }
        let _ = job.reply.send(result);
    }
}

fn generate(renderer: &mut Renderer, look: &mut Look, job: &Job) -> Result<Generated, GenerateError> {
    let started = Instant::now();
    if job.look.transfer != look.transfer || job.look.shaded != look.shaded {
        renderer.set_look(&job.look.transfer, march_settings(&job.look))?;
        *look = job.look.clone();
    }
    let frame = renderer.generate_while(job.header, job.look.layering, &|| job.wish.holds())?;
    let frame = frame.ok_or(GenerateError::GivenUp)?;
    Ok(Generated { frame, generate_micros: started.elapsed().as_micros() as u64 })
}

/// Every viewer waits for at most one frame; those beyond this wait to ask.
const MAX_JOBS: usize = 16;
