//! The processes of a server and a viewer, and the log of the viewer's refreshes.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::process::Stdio;
use std::time::{Duration, Instant};

use glam::{Quat, Vec3};
use isinglass_core::camera::Pose;
use isinglass_net::Link;

use crate::common::{Bench, Running, has_display};

/// A refresh as the viewer's log tells of it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Refresh {
    /// The pose of the picture.
    pub(crate) camera: Pose,
    /// The pose of the newest frame; none has come at first.
    pub(crate) frame: Option<Pose>,
    /// Whether the picture is said to be the server's own.
    pub(crate) is_exact: bool,
    /// Whether no server answers.
    pub(crate) is_offline: bool,
}

/// See the module.
pub(crate) struct Viewer {
    process: Running,
    log: File,
    rest: String,
    refreshes: Vec<Refresh>,
}

impl Viewer {
    /// Runs `line` and follows its log.
    pub(crate) fn start(bench: &Bench, line: &str) -> Self {
        let mut command = bench.command(line);
        command.env("DISPLAY", std::env::var_os("DISPLAY").unwrap());
        command.env("XDG_STATE_HOME", bench.path("remembered")).env("HOME", bench.path(""));
        command.env("RUST_LOG", "warn,isinglass_client::app::refresh=trace");
        command.stdout(Stdio::null()).stderr(File::create(bench.path("log")).unwrap());
        let process = Running(command.spawn().unwrap());
        let log = File::open(bench.path("log")).unwrap();
        Self { process, log, rest: String::new(), refreshes: Vec::new() }
    }

    /// All refreshes so far.
    pub(crate) fn refreshes(&mut self) -> &[Refresh] {
        self.log.read_to_string(&mut self.rest).unwrap();
        while let Some((line, rest)) = self.rest.split_once('\n') {
            match line.contains(" refresh camera=") {
                true => self.refreshes.push(refresh(line)),
                // The test's output is shown where it fails.
                false => eprintln!("the viewer: {line}"),
            }
            self.rest = rest.to_owned();
        }
        &self.refreshes
    }

    /// Waits until `find` finds something in the refreshes so far.
    pub(crate) fn wait<T>(&mut self, what: &str, mut find: impl FnMut(&[Refresh]) -> Option<T>) -> T {
        let patience = Instant::now() + Duration::from_secs(120);
        loop {
            if let Some(found) = find(self.refreshes()) {
                return found;
            }
            let ended = self.process.0.try_wait().unwrap();
            assert!(ended.is_none(), "the viewer ended: {ended:?}");
            assert!(Instant::now() < patience, "no {what}; {:?}", self.refreshes.last());
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

fn refresh(line: &str) -> Refresh {
    let (_, fields) = line.split_once("camera=").unwrap();
    let (camera, fields) = fields.split_once("frame=").unwrap();
    let (frame, standing) = fields.split_once("standing=").unwrap();
    let standing = standing.trim();
    Refresh {
        camera: pose(camera).unwrap(),
        frame: pose(frame),
        is_exact: standing == "Exact",
        is_offline: standing == "Offline",
    }
}

/// The pose whose numbers stand in a text.
fn pose(text: &str) -> Option<Pose> {
    let words = text.split(|c: char| !c.is_alphanumeric() && !".-".contains(c));
    let numbers: Vec<f32> = words.filter_map(|word| word.parse().ok()).collect();
    let [x, y, z, turn @ ..] = &numbers[..] else { return None };
    let turn = Quat::from_array(turn.try_into().unwrap());
    Some(Pose { eye: Vec3::new(*x, *y, *z), world_from_view: turn })
}

/// A server's process and the link that it prints.
pub(crate) fn serve(bench: &Bench, volume: &str) -> (Running, Link) {
    let mut command = bench.command(&format!("serve {volume} --listen 127.0.0.1:0 --backend cpu"));
    let mut server = Running(command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap());
    let mut link = String::new();
    BufReader::new(server.0.stdout.take().unwrap()).read_line(&mut link).unwrap();
    (server, link.trim().parse().unwrap())
}

/// Whether there is a display, and an adapter for the window to draw with. Strict mode fails without.
pub(crate) fn has_window() -> bool {
    if !has_display() {
        return false;
    }
    let Err(e) = isinglass_gpu::Gpu::open() else { return true };
    assert!(std::env::var("ISINGLASS_STRICT").as_deref() != Ok("1"), "{e}");
    eprintln!("skipped: {e}");
    false
}
