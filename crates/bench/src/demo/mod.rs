//! The demonstration without a window: a real server, a real client and a slowed-down link in one process, a scripted
//! camera, and afterwards the comparison of everything that was shown with the truth.
//!
//! Playing runs in real time and only records cameras and frames; pictures are made and compared when it is over, so
//! that measuring does not slow down what is measured.

mod evaluate;
mod play;
mod plot;
mod report;
mod script;

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
use isinglass_formats::{OpenOptions, RawShape, Selection};
use isinglass_net::{Link, LinkModel};
use isinglass_render::{Backend, BackendChoice};
use isinglass_server::{RunningServer, ServeOptions, Timing, start};

use crate::error::BenchError;
use isinglass_core::orbit::Orbit;
use isinglass_formats::{OpenedScene, open_scene};

pub use report::Report;

/// Another way of frames and pictures, which a laboratory brings.
#[derive(Clone)]
pub struct Rival {
    /// What reports call it.
    pub name: String,
    /// How the server makes frames; none: as the product does.
    pub make: Option<FrameMaker>,
    /// How frames become pictures; none: they are cast.
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
    /// What [`isinglass_formats::open`] opens.
    pub source: String,
    /// The shape of a raw file.
    pub raw: Option<RawShape>,
    /// Which part of a file.
    pub selection: Selection,
    /// Distances between voxels, in place of those of the file.
    pub spacing: Option<Vec3>,
    /// Memory that the volume may take, bytes.
    pub max_bytes: u64,
    /// Preset or file; none: the one that suits the volume.
    pub transfer: Option<String>,
    /// Whether gradients shade.
    pub shaded: bool,
    /// What of the volume is looked at.
    pub clip: Clip,
    /// Light, occlusion and shadows.
    pub lighting: Lighting,
    /// What a pixel tells of its ray.
    pub mode: Mode,
    /// The surfaces of [`Mode::Iso`].
    pub isos: Isos,
    /// Segments a pixel, on average.
    pub k: u8,
    /// What is played in place of the product; none: the product.
    pub rival: Option<Rival>,
    /// Where the camera begins.
    pub orbit: Orbit,
    /// A path to play in place of the orbit.
    pub path: Option<CameraPath>,
    /// What the viewer does against the delay.
    pub foresight: Foresight,
    /// Picture and frame size, field of view.
    pub intrinsics: Intrinsics,
    /// Whether rays are parallel. The picture then shows as much of the volume's middle as it would with the field of view.
    pub is_orthographic: bool,
    /// Where kernels run.
    pub backend: BackendChoice,
    /// The link between server and viewer.
    pub link: LinkModel,
    /// How frames are coded.
    pub plan: CodingPlan,
    /// Speed of the camera while it moves.
    pub degrees_per_second: f32,
    /// Pictures shown in a second.
    pub refresh_hz: f32,
    /// At most about this many of the pictures shown are compared with the truth, evenly spaced.
    pub max_evaluated: usize,
}

impl Default for DemoOptions {
    fn default() -> Self {
        Self {
            source: DEFAULT_SOURCE.into(),
            raw: None,
            selection: Selection::default(),
            spacing: None,
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

/// What came of it.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// The figures.
    pub report: Report,
    /// A few lines for people, with the paths of the files.
    pub text: String,
}

/// Plays, compares, and writes `report.json`, some pictures, a plot and a table of the compared pictures to `out`,
/// which is made if it is not there; without `out` nothing is written.
pub fn run_headless(options: &DemoOptions, out: Option<&Path>) -> Result<Outcome, BenchError> {
    let (opened, options) = options.open()?;
    let options = &options;
    let backend = Backend::open(options.backend)?;
    let Some(out) = out else { return run_opened(options, opened, &backend, None) };
    // Before playing: nobody wants to wait for a report that cannot be written.
    let is_new = !out.exists();
    std::fs::create_dir_all(out).map_err(BenchError::io(out))?;
    run_opened(options, opened, &backend, Some(out)).inspect_err(|_| {
        if is_new {
            // Goes only if it is empty; the first error is the one to tell.
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
    /// For one viewer.
    pub link: Link,
}

impl Host {
    /// Serves what was opened on the loopback interface.
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
            backend: backend.clone(),
            listen: ([127, 0, 0, 1], 0).into(),
            plan: options.plan,
            max_viewers: 1,
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

    /// Tells the viewer, and waits.
    pub fn close(self) {
        self.runtime.block_on(self.server.close());
    }
}

impl DemoOptions {
    /// The look that the server begins with.
    pub fn look(&self, opened: &OpenedScene) -> Look {
        Look {
            shaded: self.shaded,
            clip: self.clip,
            lighting: self.lighting,
            k: self.k,
            mode: self.mode,
            isos: self.isos,
            ..Look::new(opened.transfer.clone())
        }
    }

    /// The volume made ready, and these options with the orbit as the volume wants it.
    pub fn open(&self) -> Result<(OpenedScene, Self), BenchError> {
        let &Self { raw, selection, spacing, max_bytes, clip, mode, isos, .. } = self;
        let open = OpenOptions { raw, selection, spacing, max_bytes, ..OpenOptions::default() };
        let settings = MarchSettings { clip, mode, isos, ..MarchSettings::of(self.shaded, self.lighting) };
        let opened = open_scene(&self.source, self.transfer.as_deref(), settings, &open)?;
        let orbit = self.orbit.upright(opened.scene.volume.info.orientation.as_deref());
        Ok((opened, Self { orbit, ..self.clone() }))
    }
}

/// The volume if none is named: translucent and detailed, small enough for the CPU.
pub const DEFAULT_SOURCE: &str = "builtin:shells";
