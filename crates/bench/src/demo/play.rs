//! Plays the camera path in real time and records what is displayed.

use std::sync::Arc;
use std::time::Duration;

use isinglass_client::{DisplayRecord, HeadlessViewer, Standing};
use isinglass_core::camera::{Camera, Pose};
use isinglass_core::ids::FrameId;
use isinglass_net::{Client, ClientOptions, Link, ReceivedFrame};

use super::DemoOptions;
use super::course::{Course, Moment};
use super::script::Script;
use crate::error::BenchError;

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
    pub(crate) script: Script,
    /// The transport's measurement at the end.
    pub(crate) round_trip: Duration,
}

/// Connects, waits for the first settled picture, and plays.
pub(crate) fn play(link: &Link, options: &DemoOptions) -> Result<Played, BenchError> {
    let client = ClientOptions { conditioner: Some(options.link.clone()), ..ClientOptions::default() };
    let client = Client::connect(link, client).map_err(|e| BenchError::Demo(format!("viewer: {e}")))?;
    let mut viewer = HeadlessViewer::new(client, options.intrinsics, options.foresight);
    viewer.set_orthographic(options.is_orthographic);
    let course = Course {
        motion: options.motion(),
        intrinsics: options.intrinsics,
        refresh_hz: options.refresh_hz,
        patience: FIRST_FRAME_TIMEOUT + options.link.rtt * 10,
        shows_progress: true,
    };
    let script = course.begin(&mut viewer, |_| Ok(()))?;
    let interval = course.interval();
    let num_periods = course.num_periods(&script);
    let is_counted = |number: usize| script.is_counted(interval * number as u32);
    let num_counted = (0..num_periods).filter(|&number| is_counted(number)).count();
    let stride = num_counted.div_ceil(options.max_evaluated.max(1)).max(1);
    let mut num_counted = 0;
    let mut ticks: Vec<Tick> = Vec::with_capacity(num_periods);
    course.play(&script, &mut viewer, |moment, _, record| {
        // Only refreshes that are compared keep their frames: a long path at a large size would not fit.
        let is_chosen = is_counted(moment.number) && num_counted % stride == 0;
        num_counted += usize::from(is_counted(moment.number));
        let kept = is_chosen || ends_rest(&script, moment.at, interval);
        ticks.extend(Tick::of(moment, record, kept));
        Ok(())
    })?;
    let round_trip = Duration::from_micros(viewer.source().stats().rtt_micros);
    if ticks.is_empty() {
        return Err(BenchError::Demo("nothing was shown".into()));
    }
    Ok(Played { ticks, script, round_trip })
}

/// Whether this is one of the last two refreshes of a rest.
fn ends_rest(script: &Script, at: Duration, interval: Duration) -> bool {
    script.rests().iter().any(|rest| rest.contains(&at) && at + interval * 2 >= rest.end)
}

impl Tick {
    /// What a refresh showed; `None` before the first frame. `keeps` the frames for a comparison.
    pub(crate) fn of(moment: &Moment, record: DisplayRecord, keeps: bool) -> Option<Self> {
        let frame = record.frame?;
        Some(Self {
            at: moment.at,
            azimuth_degrees: moment.azimuth_degrees,
            input: moment.input,
            camera: record.camera,
            frame: frame.frame.header.frame,
            frame_bytes: frame.times.bytes,
            kept: keeps.then_some(frame),
            older: if keeps { record.kept } else { Vec::new() },
            standing: record.standing,
            frame_age: record.frame_age,
            turned_degrees: record.turned_degrees,
        })
    }
}

/// The first frame of a large volume on a slow machine, including shader compilation.
pub(crate) const FIRST_FRAME_TIMEOUT: Duration = Duration::from_secs(60);
