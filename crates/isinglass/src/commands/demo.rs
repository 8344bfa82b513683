//! `demo`: server and viewer in one process.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use clap::Args;
use isinglass_bench::demo::{DEFAULT_SOURCE, DemoOptions, run_headless};
use isinglass_bench::progress::note;
use isinglass_client::{InitialOrbit, ViewerError, ViewerOptions, WindowOptions, display_available};
use isinglass_core::orbit::Orbit;
use isinglass_formats::{Remembered, SavedState, VolumeSource};
use isinglass_net::LinkModel;
use isinglass_server::{ServeOptions, Timing};

use crate::args::{
    BackendArgs, ForesightArgs, LinkArgs, ListArgs, LookArgs, PartArgs, PathArgs, PlanArgs, RawArgs,
    VolumeArgs, any_text, parse_duration, parse_fov, parse_rate, parse_size,
};
use crate::given::Given;
use crate::light_args::LightArgs;
use crate::memory::MemoryArgs;
use crate::report::{print, print_json};
use crate::state_args::StateArgs;
use crate::window_args::WindowArgs;

#[derive(Args, Clone)]
pub(crate) struct DemoArgs {
    /// A volume, as for `serve` [default: builtin:shells]
    #[arg(value_name = "VOLUME", value_parser = any_text())]
    volume: Option<String>,
    #[command(flatten)]
    state: StateArgs,
    /// Round-trip time between server and viewer [default: the link's, or 200ms]
    #[arg(long, value_name = "TIME", value_parser = parse_duration)]
    rtt: Option<Duration>,
    /// Play a camera path without a window, compare what was shown with the truth, and write a report [default: only if
    /// there is no display]
    #[arg(long)]
    headless: bool,
    /// Folder for the report and the pictures [default: isinglass-demo]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Columns and rows of the picture [default: 256x256, or a window of 1100x760]
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    size: Option<[u32; 2]>,
    /// The window's size without --size
    #[arg(long, value_name = "WxH", value_parser = parse_size, default_value = "1100x760", hide = true)]
    window_size: [u32; 2],
    /// Vertical field of view, degrees
    #[arg(long, value_name = "DEG", value_parser = parse_fov, default_value_t = isinglass_client::DEFAULT_FOV_Y_DEGREES)]
    fov: f32,
    /// Parallel rays; a window begins with them (key 5)
    #[arg(long)]
    orthographic: bool,
    /// Where the camera begins, see `render`
    #[arg(long, value_name = "AZ,EL[,DIST]", default_value = "30,20", allow_hyphen_values = true)]
    orbit: Orbit,
    /// Speed of the headless camera, degrees a second
    #[arg(long, value_name = "DEG", default_value_t = 30.0, value_parser = parse_speed)]
    speed: f32,
    /// Pictures per second without a window
    #[arg(long, value_name = "HZ", default_value_t = 30.0, value_parser = parse_rate)]
    rate: f32,
    #[command(flatten)]
    lists: ListArgs,
    #[command(flatten)]
    backend: BackendArgs,
    #[command(flatten)]
    memory: MemoryArgs,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    path: PathArgs,
    // Last: what follows would be listed under their headings.
    #[command(flatten)]
    look: LookArgs,
    #[command(flatten)]
    light: LightArgs,
    #[command(flatten)]
    plan: PlanArgs,
    #[command(flatten)]
    link: LinkArgs,
    #[command(flatten)]
    window: WindowArgs,
    #[command(flatten)]
    foresight: ForesightArgs,
    #[command(flatten)]
    raw: RawArgs,
    #[command(flatten)]
    part: PartArgs,
}

pub(crate) fn run(args: DemoArgs, given: Given) -> Result<()> {
    let link = args.link.model(args.rtt, USUAL_RTT)?;
    if args.headless || args.out.is_some() || args.json || args.path.path.is_some() {
        return headless(args, link);
    }
    if !display_available() {
        note("no display: playing without a window (see `isinglass doctor`)");
        return headless(args, link);
    }
    match window(args.clone(), link.clone(), given) {
        // The headless run only replaces a window that never opened; a lost one is an error.
        Err(e) if e.downcast_ref().is_some_and(|e| !matches!(e, ViewerError::DisplayLost)) => {
            note(&format!("no window ({e:#}): playing without one (see `isinglass doctor`)"));
            headless(args, link)
        }
        result => result,
    }
}

fn headless(args: DemoArgs, link: LinkModel) -> Result<()> {
    if args.state.is_some() {
        bail!(
            "--state: found a demonstration without a window, which plays a path; expected `render --state` for a picture"
        );
    }
    let (mode, isos) = args.look.mode()?;
    let mut options = DemoOptions {
        raw: args.raw.shape(),
        selection: args.part.selection(),
        spacing: args.part.spacing,
        foreign_files: args.part.has_foreign_files(),
        reading: args.part.reading(),
        max_bytes: args.memory.bytes(),
        transfer: args.look.tf.clone(),
        shaded: args.look.is_shaded(),
        clip: args.look.clip.clip(),
        lighting: args.light.lighting(),
        mode,
        isos,
        k: args.lists.k,
        is_orthographic: args.orthographic,
        orbit: args.orbit,
        path: args.path.read()?,
        foresight: args.foresight.foresight(),
        backend: args.backend.backend,
        link,
        plan: args.plan.plan(None),
        degrees_per_second: args.speed,
        refresh_hz: args.rate,
        ..DemoOptions::default()
    };
    if let Some(volume) = args.volume {
        options.source = volume;
    }
    if let Some([width, height]) = args.size {
        (options.intrinsics.width, options.intrinsics.height) = (width, height);
    }
    options.intrinsics = options.intrinsics.with_fov_y(args.fov.to_radians());
    let out = args.out.unwrap_or_else(|| PathBuf::from(DEFAULT_OUT));
    if out.exists() && !out.is_dir() {
        bail!("{}: found a file, expected a folder for the report", out.display());
    }
    let outcome = run_headless(&options, Some(&out))?;
    if args.json { print_json(&outcome.report) } else { print(&outcome.text) }
}

fn window(args: DemoArgs, link: LinkModel, given: Given) -> Result<()> {
    let seen = args.state.read(given)?;
    let names_volume = seen.state.volume.as_ref().is_some_and(|v| v.source.is_some());
    let volume = args.volume.or_else(|| (!names_volume).then(|| DEFAULT_SOURCE.into()));
    let volume = seen.volume(&VolumeArgs { volume, raw: args.raw, part: args.part })?;
    // A state never says that files outside the folder are allowed.
    let volume_source = Some(VolumeSource { foreign_files: false, ..volume.volume_source()? });
    let (opened, look) =
        seen.open_to_serve(&volume, &args.look, args.light.lighting(), &args.lists, &args.memory)?;
    let size = args.size.unwrap_or(args.window_size);
    let ((size, state_sets_size), state) = seen.window(size, args.fov, &args.window, &Remembered::default());
    // The server already has the look with its flags.
    let state = Some(SavedState { look: None, ..state });
    let frame_memory = args.memory.frame_bytes(&opened.volume);
    let options = ServeOptions {
        volume: opened.volume,
        look,
        devices: args.backend.open()?.into(),
        listen: ([127, 0, 0, 1], 0).into(),
        plan: args.plan.plan(None),
        max_viewers: 1,
        frame_memory,
        library: Some(opened.library),
        timing: Timing::default(),
    };
    let runtime = tokio::runtime::Runtime::new().context("no threads for the server")?;
    let (server, server_link) = runtime.block_on(async {
        let server = isinglass_server::start(options)?;
        let server_link = server.mint_link(None).await?;
        anyhow::Ok((server, server_link))
    })?;
    let shown = isinglass_client::run(ViewerOptions {
        link: server_link.clone(),
        conditioner: Some(link),
        window: WindowOptions {
            server_name: "this computer".into(),
            size,
            state,
            state_sets_size,
            volume_source,
            bindings: seen.bindings(),
            link: Some(server_link),
            initial_orbit: initial_orbit(&args.orbit),
            fov_y: args.fov.to_radians(),
            is_orthographic: args.orthographic,
            foresight: args.foresight.foresight(),
            refresh_hz: args.window.refresh,
            shows_bars: args.window.shows_bars(),
            shows_panel: size[0] >= WIDTH_WITH_PANEL,
            ..WindowOptions::default()
        },
    });
    runtime.block_on(server.close());
    // Nobody waits for unfinished reading or computing.
    runtime.shutdown_background();
    Ok(shown?)
}

/// The same view as the viewer's type.
pub(crate) fn initial_orbit(orbit: &Orbit) -> InitialOrbit {
    InitialOrbit {
        azimuth_degrees: orbit.azimuth_degrees,
        elevation_degrees: orbit.elevation_degrees,
        distance_in_radii: orbit.distance_in_radii,
    }
}

pub(crate) fn parse_speed(text: &str) -> Result<f32, String> {
    let speed = text.parse::<f32>().ok().filter(|s| s.abs() <= 360.0);
    speed.ok_or_else(|| "expected degrees a second, -360 to 360".into())
}

/// Without a named link.
const USUAL_RTT: Duration = Duration::from_millis(200);
const DEFAULT_OUT: &str = "isinglass-demo";
/// Windows at least this wide begin with the panel of the look, points.
pub(super) const WIDTH_WITH_PANEL: u32 = 1000;
