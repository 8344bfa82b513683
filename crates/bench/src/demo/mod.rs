//! The demonstration without a window: a real server, a real client and a slowed-down link in one process, with a
//! scripted camera.
//!
//! Playing runs in real time and only records cameras and frames. Pictures are made and compared with the truth
//! afterwards, so that this does not slow down the measured system.

pub(crate) mod course;
mod evaluate;
pub(crate) mod play;
mod plot;
mod report;
pub(crate) mod script;
pub(crate) mod shown;

use std::path::Path;
use std::sync::Arc;

use glam::Vec3;
use isinglass_client::{CameraPath, Foresight};
use isinglass_core::camera::{Camera, Intrinsics};
use isinglass_core::clip::Clip;
use isinglass_core::kernels::layering::FrameMaker;
use isinglass_core::kernels::march::MarchSettings;
use isinglass_core::layer::LayeredFrame;
use isinglass_core::look::Look;
use isinglass_core::mode::{Isos, Mode};
use isinglass_core::picture::Picture;
use isinglass_core::session::rate::CodingPlan;
use isinglass_core::space::Aabb;
use isinglass_core::volume::Lighting;
use isinglass_formats::{OpenOptions, RawShape, Reading, Selection};
use isinglass_net::{Link, LinkModel};
use isinglass_render::{Backend, BackendChoice};
use isinglass_server::{RunningServer, ServeOptions, Timing, start};

use crate::error::BenchError;
use isinglass_core::orbit::Orbit;
use isinglass_formats::{OpenedScene, open_scene};

pub use report::Report;
use script::Motion;

/// A laboratory's way of making frames and pictures.
#[derive(Clone)]
pub struct Rival {
    /// Its name in reports.
    pub name: String,
    /// How the server makes frames; `None` for the product's way.
    pub make: Option<FrameMaker>,
    /// How frames become pictures; `None` casts them.
    pub show: Option<PictureMaker>,
}

/// Makes pictures of a frame, of a volume in a box, from any camera.
pub type PictureMaker = Arc<dyn Fn(&LayeredFrame, &Aabb) -> Box<dyn FnMut(&Camera) -> Picture> + Send + Sync>;

impl std::fmt::Debug for Rival {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.name)
    }
}

/// What to play.
#[derive(Clone, Debug)]
pub struct DemoOptions {
    /// The volume, as [`isinglass_formats::open`] takes it.
    pub source: String,
    /// The shape of a raw file.
    pub raw: Option<RawShape>,
    /// The part of the file.
    pub selection: Selection,
    /// Distances between voxels that replace those of the file.
    pub spacing: Option<Vec3>,
    /// Whether a header may name files outside its own folder.
    pub foreign_files: bool,
    /// How numbers become voxels.
    pub reading: Reading,
    /// Most memory for the volume, bytes.
    pub max_bytes: u64,
    /// Preset or file; `None` for the one that suits the volume.
    pub transfer: Option<String>,
    /// Whether gradients shade.
    pub shaded: bool,
    /// The visible part of the volume.
    pub clip: Clip,
    /// Light, occlusion and shadows.
    pub lighting: Lighting,
    /// What a pixel shows of its ray.
    pub mode: Mode,
    /// The surfaces of [`Mode::Iso`].
    pub isos: Isos,
    /// Mean number of segments per pixel.
    pub k: u8,
    /// A method in place of the product's.
    pub rival: Option<Rival>,
    /// Where the camera begins.
    pub orbit: Orbit,
    /// A path in place of the orbit.
    pub path: Option<CameraPath>,
    /// The viewer's measures against latency.
    pub foresight: Foresight,
    /// Picture and frame size, field of view.
    pub intrinsics: Intrinsics,
    /// Whether rays are parallel. The picture then shows as much of the volume's middle as with the field of view.
    pub is_orthographic: bool,
    /// Where kernels run.
    pub backend: BackendChoice,
    /// The link between server and viewer.
    pub link: LinkModel,
    /// How frames are coded.
    pub plan: CodingPlan,
    /// Speed of the moving camera.
    pub degrees_per_second: f32,
    /// Displayed pictures per second.
    pub refresh_hz: f32,
    /// About this many displayed pictures, evenly spaced, are compared with the truth.
    pub max_evaluated: usize,
}

impl Default for DemoOptions {
    fn default() -> Self {
        Self {
            source: DEFAULT_SOURCE.into(),
            raw: None,
            selection: Selection::default(),
            spacing: None,
            foreign_files: false,
            reading: Reading::default(),
            max_bytes: OpenOptions::default().max_bytes,
            transfer: None,
            shaded: true,
            clip: Clip::default(),
            lighting: Lighting::default(),
            mode: Mode::default(),
            isos: Isos::default(),
            k: 8,
            rival: None,
            orbit: Orbit::default(),
            path: None,
            foresight: Foresight::default(),
            intrinsics: Intrinsics::perspective(256, 256, 40f32.to_radians()),
            is_orthographic: false,
            backend: BackendChoice::default(),
            link: LinkModel::default(),
            plan: CodingPlan::default(),
            degrees_per_second: 30.0,
            refresh_hz: 30.0,
            max_evaluated: 64,
        }
    }
}

/// The results.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// The figures.
    pub report: Report,
    /// A few lines for people, with the paths of the files.
    pub text: String,
}

/// Plays, compares, and writes `report.json`, some pictures, a plot and a table to `out`, which is created if
/// necessary. Without `out` nothing is written.
pub fn run_headless(options: &DemoOptions, out: Option<&Path>) -> Result<Outcome, BenchError> {
    let (opened, options) = options.open()?;
    let options = &options;
    let backend = Backend::open(options.backend)?;
    let Some(out) = out else { return run_opened(options, opened, &backend, None) };
    // An unwritable report must fail before playing.
    let is_new = !out.exists();
    std::fs::create_dir_all(out).map_err(BenchError::io(out))?;
    run_opened(options, opened, &backend, Some(out)).inspect_err(|_| {
        if is_new {
            // This removes only an empty folder; the first error is the one to report.
            let _ = std::fs::remove_dir(out);
        }
    })
}

fn run_opened(
    options: &DemoOptions,
    opened: OpenedScene,
    backend: &Backend,
    out: Option<&Path>,
) -> Result<Outcome, BenchError> {
    let maker = options.rival.as_ref().and_then(|rival| rival.make.clone());
    let server_backend = maker.map_or_else(|| backend.clone(), Backend::Rule);
    let played = serve_and_play(options, &opened, &server_backend)?;
    let evaluation = evaluate::evaluate(backend, opened.scene, options, &played)?;
    let report = Report::of(options, backend, &played, &evaluation);
    let files = match out {
        Some(out) => report::write(out, &report, &played.script, &evaluation)?,
        None => Vec::new(),
    };
    let text = report::text(options, &report, &played, &evaluation, &files);
    Ok(Outcome { report, text })
}

fn serve_and_play(
    options: &DemoOptions,
    opened: &OpenedScene,
    backend: &Backend,
) -> Result<play::Played, BenchError> {
    let host = Host::start(options, opened, backend, Timing::default())?;
    let played = play::play(&host.link, options);
    host.close();
    played
}

/// A server of this process, and the link of its one viewer.
pub struct Host {
    runtime: tokio::runtime::Runtime,
    pub(crate) server: RunningServer,
    /// The link for the viewer.
    pub link: Link,
}

impl Host {
    /// Serves the opened scene on the loopback interface.
    pub fn start(
        options: &DemoOptions,
        opened: &OpenedScene,
        backend: &Backend,
        timing: Timing,
    ) -> Result<Self, BenchError> {
        let failed = |what: &str, e: &dyn std::fmt::Display| BenchError::Demo(format!("{what}: {e}"));
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .enable_all()
            .build()
            .map_err(|e| failed("no threads for the server", &e))?;
        let serve = ServeOptions {
            volume: opened.scene.volume.clone(),
            look: options.look(opened),
            devices: backend.clone().into(),
            listen: ([127, 0, 0, 1], 0).into(),
            plan: options.plan,
            max_viewers: 1,
            frame_memory: 1 << 30,
            library: None,
            timing,
        };
        let (server, link) = runtime.block_on(async {
            let server = start(serve).map_err(|e| failed("server", &e))?;
            let link = server.mint_link(None).await.map_err(|e| failed("server", &e))?;
            Ok::<_, BenchError>((server, link))
        })?;
        Ok(Self { runtime, server, link })
    }

    /// Tells the viewer and waits.
    pub fn close(self) {
        self.runtime.block_on(self.server.close());
    }
}

impl DemoOptions {
    /// The server's first look.
    pub fn look(&self, opened: &OpenedScene) -> Look {
        Look {
            shaded: self.shaded,
            clip: self.clip,
            lighting: self.lighting,
            k: self.k,
            mode: self.mode,
            isos: self.isos,
            channels: opened.channels.clone(),
            ..Look::new(opened.transfer.clone())
        }
    }

    /// Where the camera goes.
    fn motion(&self) -> Motion {
        match &self.path {
            Some(path) => Motion::Recorded(path.clone()),
            None => Motion::Orbit { start: self.orbit, degrees_per_second: self.degrees_per_second },
        }
    }

    /// The prepared volume, and these options with the orbit made upright.
    pub fn open(&self) -> Result<(OpenedScene, Self), BenchError> {
        let &Self { raw, selection, spacing, max_bytes, clip, mode, isos, .. } = self;
        let open = OpenOptions {
            raw,
            selection,
            spacing,
            max_bytes,
            foreign_files: self.foreign_files,
            reading: &self.reading,
            ..OpenOptions::default()
        };
        let settings = MarchSettings { clip, mode, isos, ..MarchSettings::of(self.shaded, self.lighting) };
        let opened = open_scene(&self.source, self.transfer.as_deref(), settings, &open)?;
        let orbit = self.orbit.upright(opened.scene.volume.info.orientation.as_deref());
        Ok((opened, Self { orbit, ..self.clone() }))
    }
}

/// The default volume: translucent and detailed, small enough for the CPU.
pub const DEFAULT_SOURCE: &str = "builtin:shells";
