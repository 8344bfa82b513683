//! Full volume rendering, layered frames and novel views by one interface, on the GPU, on the CPU or in processes.
//!
//! Callers use a [`Backend`] and need not know where it runs. This crate has no kernels: those of the GPU are in
//! `isinglass-gpu`, their twins in `isinglass-core`.

mod devices;
mod made;
mod parts;

use std::ops::Range;
use std::str::FromStr;
use std::sync::Arc;

use isinglass_core::camera::Camera;
use isinglass_core::cancel::{ALWAYS, Wanted};
use isinglass_core::kernels::combine;
use isinglass_core::kernels::layering::budget::Budget;
use isinglass_core::kernels::layering::{self, FrameMaker, Making, UnfinishedFrame};
use isinglass_core::kernels::lens::{self, View};
use isinglass_core::kernels::march::{self, Scene};
use isinglass_core::kernels::raycast::{self, CastOptions, Raycaster};
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;
use isinglass_core::volume::{AskedPoints, FoundPoints, Slice, SliceSpec};

use isinglass_gpu::{Gpu, GpuError, GpuRenderer, GpuReprojector};

pub use devices::{Devices, GpuCount};
pub use made::{FrameElsewhere, MadeFrame, RowsElsewhere};
pub use parts::PartRenderer;

/// The user's choice of a backend.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum BackendChoice {
    /// A hardware GPU if there is one, or else the CPU.
    #[default]
    Auto,
    /// A GPU, even in software; an error without any.
    Gpu,
    /// The CPU.
    Cpu,
}

impl BackendChoice {
    /// Every choice.
    pub const ALL: [Self; 3] = [Self::Auto, Self::Gpu, Self::Cpu];

    /// The name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Gpu => "gpu",
            Self::Cpu => "cpu",
        }
    }
}

impl std::fmt::Display for BackendChoice {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for BackendChoice {
    type Err = String;

    fn from_str(s: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|choice| choice.name() == s).ok_or_else(|| {
            format!("unknown backend '{s}', expected one of {}", Self::ALL.map(Self::name).join(", "))
        })
    }
}

/// Processes that make frames and pictures of a volume together. Each has a part of it, and so has this one: its scene
/// shows the own part under the wanted look.
pub trait Workers: Send + Sync {
    /// A layered frame with `header.k` segments per list on average. `None` when it is no longer wanted, or the processes
    /// have ended.
    fn generate(&self, scene: &Scene, header: FrameHeader, wanted: Wanted<'_>) -> Option<FrameElsewhere>;

    /// Some rows of the picture of a view; `None` if the processes have ended.
    fn render_rows(&self, scene: &Scene, view: &View, rows: Range<u32>) -> Option<Picture>;

    /// A slice of the whole volume; `None` if the processes have ended.
    fn slice(&self, spec: &SliceSpec) -> Option<Slice>;

    /// What the whole volume has at points; `None` if the processes have ended.
    fn values(&self, asked: AskedPoints) -> Option<FoundPoints>;

    /// What they are, such as `cpu of 4 processes`.
    fn description(&self) -> String;
}

/// Where kernels run. Clones share the device.
#[derive(Clone)]
pub enum Backend {
    /// On a GPU.
    Gpu(Gpu),
    /// On the CPU: the twins of core.
    Cpu,
    /// On the CPU, with layered frames by a laboratory's rule.
    Rule(FrameMaker),
    /// In several processes.
    Workers(Arc<dyn Workers>),
}

impl Backend {
    /// Opens the chosen backend. `Auto` and `Cpu` cannot fail.
    pub fn open(choice: BackendChoice) -> Result<Self, GpuError> {
        Self::open_by(choice, Gpu::open)
    }

    /// The same with another way to open a GPU.
    fn open_by(
        choice: BackendChoice,
        open: impl FnOnce() -> Result<Gpu, GpuError>,
    ) -> Result<Self, GpuError> {
        match choice {
            BackendChoice::Cpu => Ok(Self::Cpu),
            BackendChoice::Gpu => open().map(Self::Gpu),
            BackendChoice::Auto => match open() {
                Ok(gpu) if !gpu.info().is_software => Ok(Self::Gpu(gpu)),
                Ok(gpu) => {
                    tracing::info!(
                        "only a software device ({}): the CPU's own kernels are faster",
                        gpu.info()
                    );
                    Ok(Self::Cpu)
                }
                Err(e) => {
                    tracing::info!("{e}");
                    Ok(Self::Cpu)
                }
            },
        }
    }

    /// Whether its device is lost, so that another must be opened.
    pub fn is_lost(&self) -> bool {
        matches!(self, Self::Gpu(gpu) if gpu.is_lost())
    }

    /// This backend, or one that was opened again if its device is lost: the same device, or another of the kind.
    /// `None` if there is none.
    pub fn reopened(&self) -> Option<Self> {
        let Self::Gpu(gone) = self else { return Some(self.clone()) };
        if !gone.is_lost() {
            return Some(self.clone());
        }
        match gone.open_again().or_else(|_| Gpu::open()) {
            Ok(gpu) => (gone.info().is_software || !gpu.info().is_software).then_some(Self::Gpu(gpu)),
            Err(e) => {
                tracing::error!("the GPU cannot be opened again: {e}");
                None
            }
        }
    }

    /// `cpu`, or `gpu` with the device's name and driver.
    pub fn description(&self) -> String {
        match self {
            Self::Gpu(gpu) => format!("gpu: {}", gpu.info()),
            Self::Cpu | Self::Rule(_) => "cpu".into(),
            Self::Workers(workers) => workers.description(),
        }
    }

    /// The processes, if it runs in several.
    pub fn workers(&self) -> Option<&Arc<dyn Workers>> {
        if let Self::Workers(workers) = self { Some(workers) } else { None }
    }

    /// A renderer of one scene.
    pub fn renderer(&self, scene: Scene) -> Result<Renderer, GpuError> {
        Ok(match self {
            Self::Gpu(gpu) => Renderer::Gpu(Box::new(GpuRenderer::new(gpu, scene)?)),
            Self::Cpu => Renderer::on_cpu(scene),
            Self::Rule(maker) => Renderer::Cpu(Box::new(CpuRenderer::new(scene, Some(maker.clone())))),
            Self::Workers(workers) => {
                Renderer::Workers(Box::new(SharedScene { scene, workers: workers.clone() }))
            }
        })
    }

    /// The picture of a layered frame from a camera. `bounds` is the box of the volume. For several views of one
    /// frame use [`Backend::reprojector`].
    pub fn raycast(&self, frame: &LayeredFrame, bounds: &Aabb, camera: &Camera) -> Result<Picture, GpuError> {
        match self {
            Self::Gpu(gpu) => GpuReprojector::new(gpu, frame, bounds)?.raycast(camera),
            _ if !camera.is_valid() => Err(GpuError::Camera),
            _ => Ok(raycast::raycast(frame, bounds, camera)),
        }
    }

    /// The picture of at most [`combine::MAX_FRAMES`] layered frames of one volume and look from a camera, the newest
    /// first. `bounds` is the box of the volume. The CPU steps in if the GPU can bind too few buffers.
    pub fn combine(
        &self,
        frames: &[&LayeredFrame],
        bounds: &Aabb,
        camera: &Camera,
    ) -> Result<Picture, GpuError> {
        match self {
            Self::Gpu(gpu) if frames.len() < 2 || gpu.check_combining().is_ok() => {
                GpuReprojector::of_frames(gpu, frames, bounds)?.raycast(camera)
            }
            _ if !camera.is_valid() => Err(GpuError::Camera),
            _ => Ok(combine::combine(frames, bounds, camera)),
        }
    }

    /// Keeps a frame for any number of views. `bounds` is the box of the volume.
    pub fn reprojector(&self, frame: Arc<LayeredFrame>, bounds: &Aabb) -> Result<Reprojector, GpuError> {
        Ok(match self {
            Self::Gpu(gpu) => Reprojector::Gpu(Box::new(GpuReprojector::new(gpu, &frame, bounds)?)),
            _ => Reprojector::Cpu(Box::new(Raycaster::new(&frame, bounds))),
        })
    }
}

/// Full volume rendering and layered frames of one scene.
pub enum Renderer {
    /// On a GPU.
    Gpu(Box<GpuRenderer>),
    /// On the CPU.
    Cpu(Box<CpuRenderer>),
    /// In several processes.
    Workers(Box<SharedScene>),
}

/// A scene of which each of several processes has a part, and the own part.
pub struct SharedScene {
    scene: Scene,
    workers: Arc<dyn Workers>,
}

impl SharedScene {
    /// Rows of the picture of a view, or empty ones if the processes have ended.
    fn render_rows(&self, view: &View, rows: Range<u32>) -> Picture {
        let made = self.workers.render_rows(&self.scene, view, rows.clone());
        made.unwrap_or_else(|| Picture::new(view.basis.width as u32, rows.len() as u32))
    }

    fn render(&self, view: &View) -> Picture {
        self.render_rows(view, 0..view.basis.height as u32)
    }

    fn generate_while(&self, header: FrameHeader, wanted: Wanted<'_>) -> Option<LayeredFrame> {
        MadeFrame::Elsewhere(self.workers.generate(&self.scene, header, wanted)?).gathered()
    }
}

/// A scene on the CPU, with the budget of its frames.
pub struct CpuRenderer {
    scene: Scene,
    budget: Budget,
    maker: Option<FrameMaker>,
    /// How many scenes came before this one.
    num_scenes: u64,
}

/// A frame that [`Renderer::advance`] makes in pieces. Its scene stays the one it was begun with.
pub struct FrameInPieces {
    header: FrameHeader,
    /// Rows by the CPU's own rule; others make the frame at once.
    rows: Option<Rows>,
}

struct Rows {
    scene: Scene,
    /// The number of the scene at its renderer.
    number: u64,
    frame: UnfinishedFrame,
}

/// What a piece of work has come to.
pub enum Piece {
    /// More pieces follow.
    Unfinished,
    /// The frame is there.
    Whole(MadeFrame),
    /// The frame exceeds its number of segments, and would have about so many.
    TooLarge(usize),
    /// It was given up.
    GivenUp,
}

impl CpuRenderer {
    fn new(scene: Scene, maker: Option<FrameMaker>) -> Self {
        Self { scene, budget: Budget::default(), maker, num_scenes: 0 }
    }

    fn generate_while(&mut self, header: FrameHeader, wanted: Wanted<'_>) -> Option<LayeredFrame> {
        match &self.maker {
            Some(maker) => maker(&self.scene, header, wanted),
            None => layering::generate_while(&self.scene, header, &mut self.budget, wanted),
        }
    }
}

impl Renderer {
    /// A renderer of one scene on the CPU, which cannot fail.
    pub fn on_cpu(scene: Scene) -> Self {
        Self::Cpu(Box::new(CpuRenderer::new(scene, None)))
    }

    /// The scene.
    pub fn scene(&self) -> &Scene {
        match self {
            Self::Gpu(renderer) => renderer.scene(),
            Self::Cpu(renderer) => &renderer.scene,
            Self::Workers(shared) => &shared.scene,
        }
    }

    /// Goes on after it was lost: on the CPU, or with the same processes, as no other has the whole volume.
    pub fn fall_back(&mut self) {
        if !matches!(self, Self::Workers(_)) {
            *self = Self::on_cpu(self.scene().clone());
        }
    }

    /// Replaces the scene.
    pub fn set_scene(&mut self, scene: Scene) -> Result<(), GpuError> {
        match self {
            Self::Gpu(renderer) => renderer.set_scene(scene),
            Self::Cpu(renderer) => {
                let num_scenes = renderer.num_scenes + 1;
                **renderer = CpuRenderer { num_scenes, ..CpuRenderer::new(scene, renderer.maker.take()) };
                Ok(())
            }
            Self::Workers(shared) => {
                shared.scene = scene;
                Ok(())
            }
        }
    }

    /// The picture from a camera by full volume rendering, premultiplied linear.
    pub fn render(&mut self, camera: &Camera) -> Result<Picture, GpuError> {
        match self {
            Self::Gpu(renderer) => renderer.render(camera),
            Self::Cpu(_) | Self::Workers(_) if !camera.is_valid() => Err(GpuError::Camera),
            Self::Cpu(renderer) => Ok(march::render(&renderer.scene, camera)),
            Self::Workers(shared) => Ok(shared.render(&View::from(camera))),
        }
    }

    /// Some rows of [`Self::render`], equal to the bit, so that a large picture can be made in pieces.
    pub fn render_rows(&mut self, camera: &Camera, rows: Range<u32>) -> Result<Picture, GpuError> {
        match self {
            Self::Gpu(renderer) => renderer.render_rows(camera, rows),
            Self::Cpu(_) | Self::Workers(_) if !camera.is_valid() || rows.end > camera.intrinsics.height => {
                Err(GpuError::Camera)
            }
            Self::Cpu(renderer) => Ok(march::render_rows(&renderer.scene, camera, rows)),
            Self::Workers(shared) => Ok(shared.render_rows(&View::from(camera), rows)),
        }
    }

    /// The mean over `views` of full volume renderings, all of one size; there must be at least one.
    pub fn render_mean(&mut self, views: &[View]) -> Result<Picture, GpuError> {
        check_views(views)?;
        match self {
            Self::Gpu(renderer) => mean_of_views(views, |view| renderer.render_view(view)),
            Self::Cpu(renderer) => Ok(lens::render_mean(&renderer.scene, views)),
            Self::Workers(shared) => mean_of_views(views, |view| Ok(shared.render(view))),
        }
    }

    /// The picture of [`Self::render`], by a march that also covers matter behind opaque matter.
    pub fn render_through(&mut self, camera: &Camera) -> Result<Picture, GpuError> {
        match self {
            Self::Gpu(renderer) => renderer.render_through(camera),
            Self::Cpu(_) | Self::Workers(_) if !camera.is_valid() => Err(GpuError::Camera),
            Self::Cpu(renderer) => Ok(march::render_through(&renderer.scene, camera)),
            Self::Workers(shared) => Ok(shared.render(&View::from(camera))),
        }
    }

    /// A layered frame with `header.k` segments per list on average: see [`layering::generate`].
    pub fn generate(&mut self, header: FrameHeader) -> Result<LayeredFrame, GpuError> {
        match self {
            Self::Gpu(renderer) => renderer.generate(header),
            Self::Cpu(_) | Self::Workers(_) if !header.camera.is_valid() => Err(GpuError::Camera),
            Self::Cpu(renderer) => {
                renderer.budget.forget();
                Ok(renderer.generate_while(header, ALWAYS).unwrap_or_else(|| LayeredFrame::empty(header)))
            }
            Self::Workers(shared) => {
                let made = shared.generate_while(header, ALWAYS);
                Ok(made.unwrap_or_else(|| LayeredFrame::empty(header)))
            }
        }
    }

    /// The same for successive frames, whose budget follows from the last one. `None` when the frame is no longer
    /// wanted. The CPU checks that for each row, a slow GPU between some passes.
    pub fn generate_while(
        &mut self,
        header: FrameHeader,
        wanted: Wanted<'_>,
    ) -> Result<Option<LayeredFrame>, GpuError> {
        match self {
            Self::Gpu(renderer) => renderer.generate_while(header, wanted),
            Self::Cpu(_) | Self::Workers(_) if !header.camera.is_valid() => Err(GpuError::Camera),
            Self::Cpu(renderer) => Ok(renderer.generate_while(header, wanted)),
            Self::Workers(shared) => Ok(shared.generate_while(header, wanted)),
        }
    }
}

impl Renderer {
    /// Begins a frame of the present scene, without any of its work.
    pub fn begin(&self, header: FrameHeader) -> Result<FrameInPieces, GpuError> {
        let rows = match self {
            _ if !header.camera.is_valid() => return Err(GpuError::Camera),
            Self::Cpu(renderer) if renderer.maker.is_none() => {
                let frame = UnfinishedFrame::new(&renderer.scene, header);
                Some(Rows { scene: renderer.scene.clone(), number: renderer.num_scenes, frame })
            }
            Self::Cpu(_) | Self::Gpu(_) | Self::Workers(_) => None,
        };
        Ok(FrameInPieces { header, rows })
    }

    /// Works on a frame while `goes_on`, and at least a little. It gets at most `max_segments` segments. A GPU, several
    /// processes and a laboratory's rule make all of it at once, from the present scene, while it is `wanted`.
    pub fn advance(
        &mut self,
        frame: &mut FrameInPieces,
        max_segments: usize,
        goes_on: Wanted<'_>,
        wanted: Wanted<'_>,
    ) -> Result<Piece, GpuError> {
        let (Self::Cpu(renderer), Some(Rows { scene, number, frame: made })) = (&mut *self, &mut frame.rows)
        else {
            let made = match self {
                Self::Workers(shared) => {
                    let made = shared.workers.generate(&shared.scene, frame.header, wanted);
                    made.map(MadeFrame::Elsewhere)
                }
                here => here.generate_while(frame.header, wanted)?.map(MadeFrame::Here),
            };
            return Ok(match made {
                Some(made) if made.num_segments() > max_segments => Piece::TooLarge(made.num_segments()),
                made => made.map_or(Piece::GivenUp, Piece::Whole),
            });
        };
        // What another scene has spent says nothing about this one.
        let mut other = Budget::default();
        let budget = if *number == renderer.num_scenes { &mut renderer.budget } else { &mut other };
        let stays = || wanted() && goes_on();
        Ok(match made.advance(scene, budget, max_segments, &stays) {
            _ if !wanted() => Piece::GivenUp,
            Making::Unfinished => Piece::Unfinished,
            Making::TooLarge => Piece::TooLarge(made.expected_segments()),
            Making::Whole => {
                let empty = UnfinishedFrame::new(scene, frame.header);
                Piece::Whole(MadeFrame::Here(std::mem::replace(made, empty).finish(budget)))
            }
        })
    }
}

impl FrameInPieces {
    /// Whether its next piece needs the scene it was begun with to be the present one.
    pub fn needs_its_scene(&self) -> bool {
        self.rows.is_none()
    }
}

/// One layered frame, kept for any number of novel views.
pub enum Reprojector {
    /// On a GPU.
    Gpu(Box<GpuReprojector>),
    /// On the CPU.
    Cpu(Box<Raycaster>),
}

impl Reprojector {
    /// Replaces the frame. `bounds` is the box of the volume.
    pub fn set_frame(&mut self, frame: Arc<LayeredFrame>, bounds: &Aabb) -> Result<(), GpuError> {
        match self {
            Self::Gpu(reprojector) => reprojector.set_frame(&frame, bounds),
            Self::Cpu(caster) => {
                **caster = Raycaster::new(&frame, bounds);
                Ok(())
            }
        }
    }

    /// The novel view from a camera, premultiplied linear.
    pub fn raycast(&mut self, camera: &Camera) -> Result<Picture, GpuError> {
        self.raycast_with(camera, &CastOptions::default())
    }

    /// The novel view from a camera with `options`.
    pub fn raycast_with(&mut self, camera: &Camera, options: &CastOptions) -> Result<Picture, GpuError> {
        match self {
            Self::Gpu(reprojector) => reprojector.raycast_with(camera, options),
            Self::Cpu(_) if !camera.is_valid() => Err(GpuError::Camera),
            Self::Cpu(caster) => Ok(caster.picture(camera, options)),
        }
    }

    /// The mean over `views` of novel views, all of one size; there must be at least one. Premultiplied linear.
    pub fn raycast_mean(&mut self, views: &[View]) -> Result<Picture, GpuError> {
        self.raycast_mean_with(views, &CastOptions::default())
    }

    /// The same with `options`.
    pub fn raycast_mean_with(&mut self, views: &[View], options: &CastOptions) -> Result<Picture, GpuError> {
        check_views(views)?;
        match self {
            Self::Gpu(reprojector) => mean_of_views(views, |view| reprojector.raycast_view(view, options)),
            Self::Cpu(caster) => Ok(lens::mean_of_casts(caster, views, options)),
        }
    }
}

/// A picture per view; the sum has the same order as on the CPU.
fn mean_of_views(
    views: &[View],
    draw: impl FnMut(&View) -> Result<Picture, GpuError>,
) -> Result<Picture, GpuError> {
    lens::mean_picture(views.iter().map(draw))?.ok_or(GpuError::Camera)
}

fn check_views(views: &[View]) -> Result<(), GpuError> {
    let size = |view: &View| (view.basis.width, view.basis.height);
    let is_usable = |view: &View| view.is_valid() && size(view) == size(&views[0]);
    if views.is_empty() || !views.iter().all(is_usable) { Err(GpuError::Camera) } else { Ok(()) }
}
