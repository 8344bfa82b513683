//! Orders for the rendering threads: layered frames and pictures.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use isinglass_core::camera::Camera;
use isinglass_core::kernels::march::{LitPage, Scene};
use isinglass_core::layer::FrameHeader;
use isinglass_core::look::Look;
use isinglass_core::picture::Picture;
use isinglass_core::session::admission::ViewerId;
use isinglass_core::volume::Occlusion;
use isinglass_gpu::GpuError;
use isinglass_net::AfterWork;
use isinglass_render::{Devices, FrameInPieces, MadeFrame};
use rayon::ThreadPool;
use tokio::sync::{Semaphore, oneshot};

use crate::ServeError;
use crate::counters::Counters;
use crate::dispatch::{Dispatch, ShownScene};
use crate::frame_memory::Held;
use crate::lights::Lights;
use crate::paging::FramePages;
use crate::render_thread::RenderThread;
use crate::selection::SceneNumber;

/// Has layered frames made; viewers share the time. Clones share the threads, which end with the last of them.
#[derive(Clone)]
pub(crate) struct Generator {
    /// Which thread does whose work.
    pub(crate) dispatch: Dispatch,
    pictures: Arc<Semaphore>,
    /// Threads that light pages: half of the machine, so that frames go on.
    lighters: Arc<ThreadPool>,
}

pub(crate) struct Generated {
    pub(crate) frame: MadeFrame,
    /// Its memory, which is free again when this is dropped.
    pub(crate) _held: Held,
    /// Time for marching and layering, without that of others in between, µs.
    pub(crate) generate_micros: u64,
    /// Whether the shade is a draft, so that [`Lights::scene`] can provide a finer one.
    pub(crate) is_draft: bool,
    /// The ambient occlusion of a frame that is no draft.
    pub(crate) occlusion: Option<Occlusion>,
    /// The pages that it shows, of a volume that is read by pages.
    pub(crate) pages: Option<FramePages>,
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
    /// A panic. Another device or the CPU makes all later frames.
    #[error("the renderer failed on this frame")]
    Panicked,
    /// The frame was cancelled.
    #[error("the frame is no longer wanted")]
    GivenUp,
    /// Another volume is shown by now.
    #[error("the frame is of a volume that is no longer shown")]
    OtherVolume,
    /// The device of this viewer is lost. Another makes all later frames.
    #[error("the renderer of this frame is lost")]
    Moved,
}

impl GenerateError {
    /// Whether the renderer is lost; another has replaced it.
    pub(crate) fn is_lost(&self) -> bool {
        match self {
            Self::Gpu(e) => e.is_lost(),
            Self::Panicked | Self::Moved => true,
            Self::GivenUp | Self::OtherVolume => false,
        }
    }
}

/// Whose frame it is, and its limits.
pub(crate) struct FrameOrder {
    pub(crate) viewer: ViewerId,
    pub(crate) scene: SceneNumber,
    /// Must be valid.
    pub(crate) look: Look,
    /// The ambient occlusion of this viewer's last frame that had all of its shade. A draft borrows it.
    pub(crate) near: Option<Occlusion>,
    pub(crate) header: FrameHeader,
    /// Whether the camera rests, so that its pages are as fine as the memory allows.
    pub(crate) rests: bool,
    /// The frame is made while this holds.
    pub(crate) wish: Wish,
    /// The memory that it may take while it is made.
    pub(crate) held: Held,
}

pub(crate) enum Job {
    Frame(Box<FrameJob>),
    Rows(Box<RowsJob>),
    /// Shows pages that are lit.
    Light {
        scene: SceneNumber,
        /// The scene that they are lit for.
        lit: Arc<Scene>,
        pages: Arc<[LitPage]>,
        reply: oneshot::Sender<()>,
    },
    /// Forgets all pages until the next frame.
    ForgetPages {
        scene: SceneNumber,
        reply: oneshot::Sender<()>,
    },
    Replace {
        state: Box<RenderThread>,
        reply: oneshot::Sender<()>,
    },
    /// The thread ends, and answers when its memory is free.
    Stop {
        reply: oneshot::Sender<()>,
    },
}

pub(crate) type Reply<T> = oneshot::Sender<Result<T, GenerateError>>;

pub(crate) struct FrameJob {
    pub(crate) order: FrameOrder,
    pub(crate) reply: Reply<Generated>,
    /// What is made already, and the time that it took, µs.
    pub(crate) begun: Option<Begun>,
    pub(crate) spent_micros: u64,
}

/// A frame in the making.
pub(crate) struct Begun {
    pub(crate) frame: FrameInPieces,
    pub(crate) is_draft: bool,
    /// Its ambient occlusion, unless it is a draft.
    pub(crate) occlusion: Option<Occlusion>,
    pub(crate) pages: Option<FramePages>,
}

/// The next rows of a picture.
pub(crate) struct RowsJob {
    pub(crate) viewer: ViewerId,
    pub(crate) scene: SceneNumber,
    pub(crate) look: Look,
    /// The scene with all of its shade, if it has any.
    pub(crate) lit: Option<Scene>,
    pub(crate) camera: Camera,
    /// The pages of a volume that is read by pages; without them its coarsest level is shown.
    pub(crate) pages: Option<FramePages>,
    pub(crate) first: u32,
    /// Pixels that take about [`ROWS_MICROS`]; `None` if that is not known yet.
    pub(crate) num_pixels: Option<u32>,
    pub(crate) reply: Reply<Rows>,
}

/// Some rows of a picture, and the time that they took, µs.
pub(crate) struct Rows {
    pub(crate) picture: Picture,
    pub(crate) micros: u64,
}

impl Generator {
    /// Puts a scene on the threads of devices.
    ///
    /// # Errors
    /// If the scene does not fit the backend, or no thread is available.
    pub(crate) fn start(
        devices: &Devices,
        shown: ShownScene,
        after_work: AfterWork,
        counters: Counters,
    ) -> Result<Self, ServeError> {
        let dispatch = Dispatch::start(devices, shown, after_work, counters)?;
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let lighters = rayon::ThreadPoolBuilder::new().num_threads(cores.div_ceil(2));
        let lighters = Arc::new(lighters.thread_name(|i| format!("light {i}")).build()?);
        Ok(Self { dispatch, pictures: Arc::new(Semaphore::new(1)), lighters })
    }

    /// The ordered frame, while its wish holds. It may be smaller than its header says, to keep to its memory. `None`
    /// if no thread is left.
    ///
    /// # Errors
    /// If this frame cannot be made.
    pub(crate) async fn generate(&self, order: FrameOrder) -> Option<Result<Generated, GenerateError>> {
        let viewer = order.viewer;
        let (reply, answer) = oneshot::channel();
        let job = Box::new(FrameJob { order, reply, begun: None, spent_micros: 0 });
        let working = self.dispatch.send(viewer, Job::Frame(job)).await?;
        let made = answer.await;
        drop(working);
        Some(made.unwrap_or(Err(GenerateError::Moved)))
    }

    /// Forgets the pages that the threads show, so that their memory is free.
    pub(crate) async fn forget_pages(&self, scene: SceneNumber, lights: &Lights) {
        lights.forget_pages().await;
        self.dispatch.tell_all(|reply| Job::ForgetPages { scene, reply }).await;
        // A thread may have noted its pages meanwhile.
        lights.forget_pages().await;
    }

    /// Lights all pages that were shown last as `lit` does, piece by piece and beside the frames. All threads show each
    /// piece as soon as it is there, so that no page has two lights for long.
    pub(crate) async fn light_pages(&self, scene: SceneNumber, lights: &Lights, lit: &Scene) {
        let mut pages: Arc<[LitPage]> = Arc::new([]);
        let lit = Arc::new(lit.clone());
        for _ in 0..MAX_PIECES {
            let (of, for_scene, new) = (lights.clone(), lit.clone(), pages.clone());
            // A rendering thread may hold what this waits for.
            let dark = tokio::task::spawn_blocking(move || of.pages_to_light(&for_scene, &new)).await;
            let Ok(dark) = dark else { return };
            if !pages.is_empty() {
                let job = |reply| Job::Light { scene, lit: lit.clone(), pages: pages.clone(), reply };
                self.dispatch.tell_all(job).await;
            }
            if dark.is_empty() {
                return;
            }
            let (of, lighters) = (lit.clone(), self.lighters.clone());
            let work = tokio::task::spawn_blocking(move || lighters.install(|| of.light_pages(dark)));
            let Ok(made) = work.await else { return };
            pages = made.into();
        }
    }

    /// The picture from `camera` of a scene under a valid look, by full volume rendering with all shade. It is 8-bit
    /// sRGB over a linear background, three bytes per pixel, or transparent with four. It is made in pieces, with frames in between, and only
    /// one at a time, because pictures are large. `None` if no thread is left. Dropping this cancels the picture.
    ///
    /// # Errors
    /// If it cannot be made.
    pub(crate) async fn picture(
        &self,
        viewer: ViewerId,
        scene: SceneNumber,
        look: &Look,
        (lights, pages): (&Lights, Option<FramePages>),
        camera: Camera,
        background: Option<[f32; 3]>,
    ) -> Option<Result<Vec<u8>, GenerateError>> {
        let _turn = self.pictures.acquire().await.ok()?;
        // Even plain shading takes a while for pages.
        let needs_light = look.lighting.is_on() || pages.is_some();
        let lit = if needs_light { Some(lights.scene(look, Some((self, scene))).await?) } else { None };
        let (mut srgb, mut first, mut has_failed, mut num_pixels) = (Vec::new(), 0, false, None);
        while first < camera.intrinsics.height {
            let (reply, answer) = oneshot::channel();
            let (look, lit, pages) = (look.clone(), lit.clone(), pages.clone());
            let job = RowsJob { viewer, scene, look, lit, camera, pages, first, num_pixels, reply };
            let working = self.dispatch.send(viewer, Job::Rows(Box::new(job))).await?;
            let made = answer.await.unwrap_or(Err(GenerateError::Moved));
            drop(working);
            match made {
                Ok(Rows { picture: rows, micros }) => {
                    first += rows.height;
                    let share = ROWS_MICROS as f64 / micros.max(1) as f64;
                    // Some rows are dear, and others are free.
                    num_pixels = Some((rows.pixels.len() as f64 * share.clamp(0.25, 4.0)) as u32);
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

/// Time for the rows of a picture, µs: no viewer waits longer for its frame.
const ROWS_MICROS: u64 = 50_000;
/// Most pieces in which pages are lit. Other viewers' looks might make them dark again.
const MAX_PIECES: usize = 1024;
