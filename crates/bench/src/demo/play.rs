//! Plays the camera path in real time and records what is displayed.

use std::sync::Arc;
use std::time::{Duration, Instant};

use isinglass_client::{DisplayRecord, HeadlessViewer, Standing};
use isinglass_core::camera::{Camera, Pose};
use isinglass_core::ids::FrameId;
use isinglass_net::{Client, ClientOptions, Link, ReceivedFrame, State};

use super::DemoOptions;
use super::script::{Motion, Script};
use crate::error::BenchError;
use crate::progress::Progress;

/// One refresh of the display.
#[derive(Clone, Debug)]
pub(crate) struct Tick {
    /// Time since the camera began to move.
    pub(crate) at: Duration,
    /// Azimuth according to the script.
    pub(crate) azimuth_degrees: f32,
    /// The input of this refresh.
    pub(crate) input: Pose,
    /// The camera of the displayed picture.
    pub(crate) camera: Camera,
    /// The frame that it was cast from.
    pub(crate) frame: FrameId,
    /// The frame itself, for refreshes that are compared.
    pub(crate) kept: Option<Arc<ReceivedFrame>>,
    /// Older frames that were combined with it.
    pub(crate) older: Vec<Arc<ReceivedFrame>>,
    /// State of the picture and the server.
    pub(crate) standing: Standing,
    /// Time since the frame's pose was set.
    pub(crate) frame_age: Option<Duration>,
    /// Angle between the frame's pose and the camera of the picture.
    pub(crate) turned_degrees: Option<f32>,
    /// Received bytes of the frame.
    pub(crate) frame_bytes: u64,
}

/// All refreshes since the camera began to move, with at least one frame on the screen.
#[derive(Clone, Debug)]
pub(crate) struct Played {
    pub(crate) ticks: Vec<Tick>,
    /// The camera path.
    pub(crate) script: Script,
    /// The transport's measurement at the end.
    pub(crate) round_trip: Duration,
}

/// Connects, waits for the first settled picture, and plays.
pub(crate) fn play(link: &Link, options: &DemoOptions) -> Result<Played, BenchError> {
    let failed = |what: String| BenchError::Demo(what);
    let client = ClientOptions { conditioner: Some(options.link.clone()), ..ClientOptions::default() };
    let client = Client::connect(link, client).map_err(|e| failed(format!("viewer: {e}")))?;
    let clock = client.clock().clone();
    let now = || Duration::from_micros(clock.now_micros());
    let mut viewer = HeadlessViewer::new(client, options.intrinsics, options.foresight);
    viewer.set_orthographic(options.is_orthographic);
    let interval = Duration::from_secs_f32(1.0 / options.refresh_hz);
    let motion = match &options.path {
        Some(path) => Motion::Recorded(path.clone()),
        None => Motion::Orbit { start: options.orbit, degrees_per_second: options.degrees_per_second },
    };

    let asked = Instant::now();
    let patience = FIRST_FRAME_TIMEOUT + options.link.rtt * 10;
    loop {
        let settled = viewer.bounds().is_some_and(|bounds| {
            let pose = motion.start(&options.intrinsics, &bounds);
            let record = viewer.tick(now(), pose);
            record.is_some_and(|r| matches!(r.standing, Standing::Exact | Standing::Settled))
        });
        if settled {
            break;
        }
        if let State::Refused(problem) = viewer.source().state() {
            return Err(failed(format!("viewer: {problem}")));
        }
        if asked.elapsed() > patience {
            let seconds = patience.as_secs();
            return Err(failed(format!(
                "no frame came within {seconds} s, expected one; the machine may be too slow"
            )));
        }
        std::thread::sleep(interval);
    }
    viewer.take_records();
    // At a stop, the frame for the rest may have to wait for one of an older pose.
    let settle = asked.elapsed().min(MAX_SETTLE).mul_f32(1.5);
    let script = Script::new(motion, settle);

    let num_ticks = (script.duration().as_secs_f32() * options.refresh_hz).ceil() as usize;
    let is_counted = |number: usize| script.is_counted(interval * number as u32);
    let num_counted = (0..num_ticks).filter(|&number| is_counted(number)).count();
    let stride = num_counted.div_ceil(options.max_evaluated.max(1)).max(1);
    let mut num_counted = 0;
    let mut progress = Progress::new("playing", num_ticks as u64);
    let mut ticks: Vec<Tick> = Vec::with_capacity(num_ticks);
    let bounds = viewer.bounds().ok_or_else(|| failed("the volume is gone".into()))?;
    let start = Instant::now();
    for number in 0..num_ticks {
        let due = interval * number as u32;
        std::thread::sleep(due.saturating_sub(start.elapsed()));
        let at = start.elapsed();
        let input = script.pose_at(at, &options.intrinsics, &bounds);
        let azimuth_degrees = script.azimuth_degrees(at, &input, &bounds);
        viewer.tick(now(), input);
        // Only refreshes that are compared keep their frames: a long path at a large size would not fit.
        let is_chosen = is_counted(number) && num_counted % stride == 0;
        num_counted += usize::from(is_counted(number));
        for record in viewer.take_records() {
            let kept = is_chosen || ends_rest(&script, at, interval);
            ticks.extend(tick(record, at, azimuth_degrees, input, kept));
        }
        progress.advance(1, "");
    }
    progress.finish();
    let round_trip = Duration::from_micros(viewer.source().stats().rtt_micros);
    if ticks.is_empty() {
        return Err(failed("nothing was shown".into()));
    }
    Ok(Played { ticks, script, round_trip })
}

/// Whether this is one of the last two refreshes of a rest.
fn ends_rest(script: &Script, at: Duration, interval: Duration) -> bool {
    script.rests().iter().any(|rest| rest.contains(&at) && at + interval * 2 >= rest.end)
}

fn tick(record: DisplayRecord, at: Duration, azimuth_degrees: f32, input: Pose, kept: bool) -> Option<Tick> {
    let frame = record.frame?;
    Some(Tick {
        at,
        azimuth_degrees,
        input,
        camera: record.camera,
        frame: frame.frame.header.frame,
        frame_bytes: frame.times.bytes,
        kept: kept.then_some(frame),
        older: if kept { record.kept } else { Vec::new() },
        standing: record.standing,
        frame_age: record.frame_age,
        turned_degrees: record.turned_degrees,
    })
}

/// The first frame of a large volume on a slow machine, including shader compilation.
const FIRST_FRAME_TIMEOUT: Duration = Duration::from_secs(60);
/// Longest time for a picture to settle.
const MAX_SETTLE: Duration = Duration::from_secs(5);
