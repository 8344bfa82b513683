//! `view`: the viewer for a server's link, for a volume of this or another machine, or with a page to choose one.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use anyhow::{Result, bail};
use clap::Args;
use clap::builder::TypedValueParser;
use isinglass_bench::progress::note;
use isinglass_client::{
    CameraPath, First, RemoteServer, Waker, WindowOptions, display_available, run_window_with_start,
};
use isinglass_core::camera::Intrinsics;
use isinglass_core::orbit::Orbit;
use isinglass_formats::{
    Reading, Remembered, SavedState, Selection, VolumeSource, is_address, load_transfer, source_exists,
    state_from_link, write_whole,
};
use isinglass_net::{Client, ClientOptions, Clock, Link, LinkError, Tunnel, state_of_link};

use super::demo::{WIDTH_WITH_PANEL, initial_orbit};
use super::headless::{self, HeadlessArgs, read_links};
use crate::args::{
    BackendArgs, ForesightArgs, ListArgs, LookArgs, PartArgs, RawArgs, VolumeArgs, any_text, parse_fov,
    parse_output, parse_size, usage_error,
};
use crate::given::Given;
use crate::light_args::LightArgs;
use crate::local::{self, FirstLook};
use crate::memory::MemoryArgs;
use crate::remote::{self, RemoteArgs, RemoteVolume};
use crate::state_args::StateArgs;
use crate::window_args::WindowArgs;

#[derive(Args)]
pub(crate) struct ViewerArgs {
    /// The link that `serve` printed, quoted in a shell, or - to read it from standard input, which keeps it off the
    /// list of processes; or a volume of this machine, as for `serve`; or one that ssh reaches, such as host:/path or
    /// ssh://user@host:port/path, for which a server is started there [default: a page to choose one]
    #[arg(value_name = "LINK|VOLUME", value_parser = any_text().try_map(|text: String| parse_target(&text)))]
    target: Option<Target>,
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
    /// Where the camera begins, see `render`
    #[arg(long, value_name = "AZ,EL[,DIST]", default_value = "30,20", allow_hyphen_values = true)]
    orbit: Orbit,
    #[command(flatten)]
    backend: BackendArgs,
    #[command(flatten)]
    memory: MemoryArgs,
    /// Write the camera's path to FILE when the window is closed, for `demo --headless --path`
    #[arg(long, value_name = "FILE", value_parser = parse_output)]
    record: Option<PathBuf>,
    #[command(flatten)]
    lists: ListArgs,
    #[command(flatten)]
    headless: HeadlessArgs,
    // These come last because clap would list later arguments under their headings.
    #[command(flatten)]
    look: LookArgs,
    #[command(flatten)]
    light: LightArgs,
    #[command(flatten)]
    window: WindowArgs,
    #[command(flatten)]
    foresight: ForesightArgs,
    #[command(flatten)]
    raw: RawArgs,
    #[command(flatten)]
    part: PartArgs,
    #[command(flatten)]
    remote: RemoteArgs,
}

/// The first thing to show.
#[derive(Clone, Debug)]
enum Target {
    Server(Link),
    /// A volume on another machine, and the text that named it.
    Remote(RemoteVolume, String),
    Volume(String),
    /// The state in a link that a window has copied, which names a volume of this machine.
    View(String),
    Input,
}

/// An absent or refusing server is an error before any window opens. Later failures, and those of choices in the
/// window, appear there.
pub(crate) fn run(args: ViewerArgs, given: Given) -> Result<()> {
    args.headless.check()?;
    let num_copies = args.headless.num_copies();
    if num_copies > 1 && !matches!(args.target, Some(Target::Input)) {
        return Err(usage_error(
            "each link lets in one viewer, expected - and a link for each on standard input",
        ));
    }
    let mut links = Vec::new();
    let target = match args.target {
        Some(Target::Input) => {
            links = read_links(io::stdin().lock(), num_copies)?;
            links.first().cloned().map(Target::Server)
        }
        target => target,
    };
    let of_link = match &target {
        Some(Target::Server(link)) => link.state.as_deref(),
        Some(Target::View(state)) => Some(state.as_str()),
        _ => None,
    };
    let seen = args.state.read_or(of_link, given)?;
    let target = target.filter(|target| !matches!(target, Target::View(_)));
    // Whoever wrote the state chose the server, and a window would show whom it calls.
    if let (None, Some(server)) = (&target, seen.server()?) {
        bail!(
            "the state's volume is at the server {server}, which a state alone does not call; name its link: view LINK --state FILE"
        );
    }
    let (raw, selection, spacing) = (args.raw.shape(), args.part.selection(), args.part.spacing);
    let is_of_volume =
        raw.is_some() || selection != Selection::default() || spacing.is_some() || seen.has_flags_of_look();
    let is_of_volume = is_of_volume || args.part.reading() != Reading::default();
    let of_state = seen.state.volume.as_ref().is_some_and(|v| v.source.is_some());
    match target {
        Some(Target::Server(_)) if is_of_volume => {
            bail!(
                "--channel, --tf, --dims and the like belong to a volume, found a link; give them to `serve`"
            );
        }
        Some(Target::Remote(..)) => {}
        _ if args.remote.copy => bail!("--copy belongs to a volume on another machine, such as host:/path"),
        None if is_of_volume && !of_state => {
            bail!("--channel, --tf, --dims and the like belong to a volume, found none");
        }
        _ => {}
    }
    if args.headless.is_on() {
        let (link, tunnel) = match target {
            Some(Target::Server(link)) => (link, None),
            Some(Target::Remote(volume, _)) => {
                let order = remote::order(seen.given(), args.look.tf.as_deref())?;
                let RemoteServer { link, tunnel } = args.remote.start(&volume, order)?;
                (link, Some(tunnel))
            }
            _ => bail!(
                "found no server's link, expected one; `demo --headless` plays a volume of this machine"
            ),
        };
        if links.is_empty() {
            links.push(link);
        }
        let [width, height] = args.size;
        let view = headless::View {
            orbit: args.orbit,
            intrinsics: Intrinsics::perspective(width, height, args.fov.to_radians()),
            is_orthographic: args.orthographic,
            foresight: args.foresight.foresight(),
            refresh_hz: args.window.refresh,
            backend: args.backend.backend,
        };
        return args.headless.run(&links, tunnel, view);
    }
    args.look.mode()?;
    if !matches!(target, Some(Target::Remote(..))) {
        args.look.tf.as_deref().map(load_transfer).transpose()?;
    }
    let choices_file = local::choices_file();
    // A file that cannot be read is replaced by the next choice.
    let read = |file: &PathBuf| {
        let left_out = |line| note(&format!("a choice is left out: {line}"));
        Remembered::read(file, left_out).map_err(|e| note(&format!("no choices: {e}"))).ok()
    };
    let choices = choices_file.as_ref().and_then(read).unwrap_or_default();
    let ((size, state_sets_size), state) = seen.window(args.size, args.fov, &args.window, &choices);
    // This comes first, because a link admits one viewer and must not be used up without a display.
    if !display_available() {
        bail!("no display answers, expected one to open a window on; see `isinglass doctor`");
    }
    let recorder = args.record.as_ref().map(|_| Arc::<Mutex<CameraPath>>::default());
    let window = WindowOptions {
        size,
        state: Some(state),
        bindings: seen.bindings(),
        state_sets_size,
        initial_orbit: initial_orbit(&args.orbit),
        fov_y: args.fov.to_radians(),
        is_orthographic: args.orthographic,
        foresight: args.foresight.foresight(),
        refresh_hz: args.window.refresh,
        shows_bars: args.window.shows_bars(),
        shows_panel: choices.panel.unwrap_or(size[0] >= WIDTH_WITH_PANEL),
        choices,
        choices_file,
        has_light: seen.has_flags_of_light(),
        recorder: recorder.clone(),
        ..WindowOptions::default()
    };
    let limit = args.memory.bytes();
    let (foreign_files, reading) = (args.part.has_foreign_files(), args.part.reading());
    let (target, remote, tunnel) = match target {
        Some(Target::Remote(volume, text)) => {
            let order = remote::order(seen.given(), args.look.tf.as_deref())?;
            let RemoteServer { link, tunnel } = args.remote.start(&volume, order)?;
            (Some(Target::Server(link)), Some(text), Some(tunnel))
        }
        target => (target, None, None),
    };
    let request = match target {
        Some(Target::Server(link)) => {
            let (client, waker) = connect_waking(&link, tunnel)?;
            let clock = client.clock().clone();
            let services = local::services(args.backend.backend, limit, foreign_files, None, args.remote);
            run_window_with_start(window, clock, services, move |wake| {
                // There is only one window, so no waker was set before.
                let _ = waker.set(wake);
                Ok(First::Connected { source: Box::new(client), link, remote })
            })?;
            return write_path(args.record.as_deref(), recorder.as_deref());
        }
        Some(Target::Volume(source)) => {
            let volume = VolumeSource { source, raw, selection, spacing, foreign_files, reading };
            Some(volume.request(limit))
        }
        None if of_state => {
            let volume = VolumeArgs { volume: None, raw: args.raw, part: args.part };
            Some(seen.volume(&volume)?.volume_source()?.request(limit))
        }
        Some(Target::Input | Target::View(_) | Target::Remote(..)) | None => None,
    };
    match request {
        Some(request) => {
            let first = FirstLook {
                source: request.source.clone(),
                seen,
                look: args.look,
                lighting: args.light.lighting(),
                lists: args.lists,
            };
            // The volume's server already has the look with its flags.
            let state = window.state.map(|state| SavedState { look: None, ..state });
            let window = WindowOptions { state, ..window };
            let services =
                local::services(args.backend.backend, limit, foreign_files, Some(first), args.remote);
            run_window_with_start(window, Clock::start(), services, |_| Ok(First::Volume(request)))?;
        }
        None => {
            if let Some(server) = seen.state.volume.as_ref().and_then(|v| v.server.as_deref()) {
                note(&format!(
                    "the state was made with the server {server}: connect to that, and it is shown"
                ));
            }
            let services = local::services(args.backend.backend, limit, foreign_files, None, args.remote);
            run_window_with_start(window, Clock::start(), services, |_| Ok(First::StartPage))?;
        }
    }
    write_path(args.record.as_deref(), recorder.as_deref())
}

fn write_path(file: Option<&Path>, recorder: Option<&Mutex<CameraPath>>) -> Result<()> {
    if let (Some(file), Some(recorder)) = (file, recorder) {
        let path = recorder.lock().unwrap_or_else(PoisonError::into_inner);
        write_whole(file, path.to_string().as_bytes())?;
    }
    Ok(())
}

/// An admitted client, and the slot for its window's waker.
fn connect_waking(link: &Link, tunnel: Option<Tunnel>) -> Result<(Client, Arc<OnceLock<Waker>>)> {
    let waker = Arc::new(OnceLock::<Waker>::new());
    let wakes = waker.clone();
    let wake = Arc::new(move || {
        if let Some(wake) = wakes.get() {
            wake();
        }
    });
    Ok((connect(link, ClientOptions { wake, tunnel, ..ClientOptions::default() })?, waker))
}

/// An admitted client.
pub(super) fn connect(link: &Link, options: ClientOptions) -> Result<Client> {
    let client = Client::connect(link, options)?;
    if let Err(problem) = client.wait_connected(CONNECT_TIMEOUT) {
        let details = problem.details().map_or_else(String::new, |details| format!(" ({details})"));
        bail!("{}: {problem}{details}", link.place());
    }
    Ok(client)
}

/// Anything that is no volume is read as a link, with its errors.
fn parse_target(text: &str) -> Result<Target, String> {
    if text == "-" {
        return Ok(Target::Input);
    }
    if is_address(text) {
        return Ok(Target::Volume(text.to_owned()));
    }
    let is_here = source_exists(text);
    if !is_here && let Some(volume) = RemoteVolume::parse(text) {
        return volume.map(|volume| Target::Remote(volume, text.to_owned()));
    }
    if text.contains("://") {
        return match text.parse() {
            Ok(link) => Ok(Target::Server(link)),
            Err(e) => view_of_file(text).map(Target::View).ok_or_else(|| LinkError::to_string(&e)),
        };
    }
    if is_here {
        return Ok(Target::Volume(text.to_owned()));
    }
    Err(format!("there is no file '{text}'; expected a volume, a link as `serve` prints it, or host:/path"))
}

/// The state in a link to a view of a volume of this machine.
fn view_of_file(link: &str) -> Option<String> {
    let state = state_of_link(link).ok()?;
    let volume = state_from_link(&state).ok()?.state.volume?;
    (volume.source.is_some() && volume.link().is_none()).then_some(state)
}

/// Longer than QUIC itself tries on a slow link.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(15);
