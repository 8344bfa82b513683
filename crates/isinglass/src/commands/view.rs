//! `view`: the viewer on a server's link.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use anyhow::{Result, bail};
use clap::Args;
use isinglass_bench::output::write_whole;
use isinglass_bench::rivals;
use isinglass_bench::view::Orbit;
use isinglass_client::{CameraPath, Waker, WindowOptions, display_available, run_window};
use isinglass_net::{Client, ClientOptions, Link};

use super::demo::initial_orbit;
use crate::args::{ForesightArgs, MethodArgs, parse_fov, parse_output, parse_size};
use crate::given::Given;
use crate::state_args::StateArgs;
use crate::window_args::WindowArgs;

#[derive(Args)]
pub(crate) struct ViewerArgs {
    /// The link that `serve` printed; quote it in a shell
    #[arg(value_name = "LINK")]
    link: Link,
    #[command(flatten)]
    state: StateArgs,
    /// Columns and rows of the window
    #[arg(long, value_name = "WxH", value_parser = parse_size, default_value = "1100x760")]
    size: [u32; 2],
    /// Vertical field of view, degrees
    #[arg(long, value_name = "DEG", value_parser = parse_fov, default_value_t = isinglass_client::DEFAULT_FOV_Y_DEGREES)]
    fov: f32,
    /// Begin with parallel rays (key 5)
    #[arg(long)]
    orthographic: bool,
    /// Where the camera begins
    #[arg(long, value_name = "AZ,EL[,DIST]", default_value = "30,20", allow_hyphen_values = true)]
    orbit: Orbit,
    #[command(flatten)]
    method: MethodArgs,
    #[command(flatten)]
    window: WindowArgs,
    #[command(flatten)]
    foresight: ForesightArgs,
    /// Write the camera's path to FILE when the window is closed, for `demo --headless --path`
    #[arg(long, value_name = "FILE", value_parser = parse_output)]
    record: Option<PathBuf>,
}

/// A server that is not there or does not let this viewer in is an error before any window opens; one that goes away
/// later is shown in the window.
pub(crate) fn run(args: ViewerArgs, given: Given) -> Result<()> {
    let seen = args.state.read_or(args.link.state.as_deref(), given)?;
    let ((size, state_sets_size), state) = seen.window(args.size, args.fov, &args.window);
    // First: a link lets in one viewer, and shall not be used up where nothing can be shown.
    if !display_available() {
        bail!("no display answers, expected one to open a window on; see `isinglass doctor`");
    }
    let server_name = format!("{}:{}", args.link.host, args.link.port);
    let waker = Arc::new(OnceLock::<Waker>::new());
    let wakes = waker.clone();
    let wake = Arc::new(move || {
        if let Some(wake) = wakes.get() {
            wake();
        }
    });
    let options = ClientOptions { wake, ..ClientOptions::default() };
    let clock = options.clock.clone();
    let client = Client::connect(&args.link, options)?;
    if let Err(problem) = client.wait_connected(CONNECT_TIMEOUT) {
        bail!("{server_name}: {problem}");
    }
    let recorder = args.record.as_ref().map(|_| Arc::<Mutex<CameraPath>>::default());
    let window = WindowOptions {
        server_name,
        size,
        state: Some(state),
        bindings: seen.bindings(),
        state_sets_size,
        link: Some(args.link),
        initial_orbit: initial_orbit(&args.orbit),
        fov_y: args.fov.to_radians(),
        is_orthographic: args.orthographic,
        novel_views: rivals::for_viewer(),
        novel_view: args.method.method.name(),
        foresight: args.foresight.foresight(),
        recorder: recorder.clone(),
        ..WindowOptions::default()
    };
    run_window(window, clock, move |wake| {
        // There is one window, so nothing was set before.
        let _ = waker.set(wake);
        Ok(client)
    })?;
    if let (Some(file), Some(recorder)) = (args.record, recorder) {
        let path = recorder.lock().unwrap_or_else(PoisonError::into_inner);
        write_whole(&file, path.to_string().as_bytes())?;
    }
    Ok(())
}

/// Longer than QUIC tries by itself on a slow link.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(15);
