//! Plays the orbit and collects lives and ages.

use std::collections::BTreeMap;
use std::ops::Range;
use std::time::{Duration, Instant};

use isinglass_client::{HeadlessViewer, Standing};
use isinglass_core::ids::FrameId;
use isinglass_core::session::ledger::{Life, Stage};
use isinglass_net::{Client, ClientOptions, Clock, Journal, State};
use isinglass_render::Backend;
use isinglass_server::Timing;

use super::{PipelineOptions, WARM_UP};
use crate::demo::Host;
use crate::error::BenchError;
use crate::progress::Progress;
use isinglass_formats::OpenedScene;

/// What happened during the measurement.
pub(super) struct Recording {
    /// Lives of the frames that began then, joined from both sides, in order.
    pub(super) lives: Vec<Life>,
    /// At each refresh, the time since the displayed frame's pose was set, µs.
    pub(super) ages_micros: Vec<u64>,
    /// Number of refreshes that showed a new frame.
    pub(super) num_new: usize,
    /// Duration of the measurement.
    pub(super) measured: Duration,
    /// The transport's measurement at the end.
    pub(super) round_trip: Duration,
    /// Time from the start of work to the first whole picture.
    pub(super) first_picture: Duration,
}

pub(super) fn play(
    options: &PipelineOptions,
    opened: &OpenedScene,
    backend: &Backend,
    started: Instant,
) -> Result<Recording, BenchError> {
    let demo = &options.demo;
    let clock = Clock::start();
    let timing = Timing { clock: clock.clone(), ..Timing::default() };
    let host = Host::start(demo, opened, backend, timing)?;
    let failed = |what: String| BenchError::Demo(what);
    let client = ClientOptions {
        conditioner: Some(demo.link.clone()),
        clock: clock.clone(),
        ..ClientOptions::default()
    };
    let client = Client::connect(&host.link, client).map_err(|e| failed(format!("viewer: {e}")))?;
    let mut viewer = HeadlessViewer::new(client, demo.intrinsics, demo.foresight);
    viewer.set_orthographic(demo.is_orthographic);
    let now = || Duration::from_micros(clock.now_micros());
    let interval = Duration::from_secs_f32(1.0 / demo.refresh_hz);
    loop {
        let settled = viewer.bounds().is_some_and(|bounds| {
            let record = viewer.tick(now(), demo.orbit.pose(&demo.intrinsics, &bounds));
            record.is_some_and(|r| matches!(r.standing, Standing::Exact | Standing::Settled))
        });
        if settled {
            break;
        }
        if let State::Refused(problem) = viewer.source().state() {
            return Err(failed(format!("viewer: {problem}")));
        }
        if started.elapsed() > FIRST_FRAME_TIMEOUT + demo.link.rtt * 10 {
            return Err(failed(format!(
                "no whole picture within {} s, expected one",
                FIRST_FRAME_TIMEOUT.as_secs()
            )));
        }
        std::thread::sleep(interval);
    }
    let first_picture = started.elapsed();
    let journal = host.server.newest_journal().ok_or_else(|| failed("the server has no viewer".into()))?;
    let bounds = viewer.bounds().ok_or_else(|| failed("the volume is gone".into()))?;
    let (mut lives, mut ages_micros) = (BTreeMap::new(), Vec::new());
    let (mut shown, mut num_new) = (None, 0);
    let num_ticks = ((WARM_UP + options.duration).as_secs_f32() * demo.refresh_hz).ceil() as u32;
    let begin = Instant::now();
    let (begin_micros, warm_micros) = (clock.now_micros(), WARM_UP.as_micros() as u64);
    let counts = begin_micros + warm_micros..u64::MAX;
    viewer.take_records();
    let mut progress = Progress::new("playing", u64::from(num_ticks));
    for number in 0..num_ticks {
        std::thread::sleep((interval * number).saturating_sub(begin.elapsed()));
        let turn = begin.elapsed().as_secs_f32() * demo.degrees_per_second;
        viewer.tick(now(), demo.orbit.turned(turn).pose(&demo.intrinsics, &bounds));
        for record in viewer.take_records() {
            let Some(frame) = record.frame else { continue };
            let is_new = shown.replace(frame.times.frame) != Some(frame.times.frame);
            let at = record.at.as_micros() as u64;
            if counts.contains(&at) {
                num_new += usize::from(is_new);
                ages_micros.extend(frame.times.at(Stage::Asked).map(|asked| at.saturating_sub(asked)));
            }
        }
        // Ledgers hold only four seconds' worth.
        if number % (demo.refresh_hz as u32).max(1) == 0 {
            collect(&mut lives, viewer.source(), &journal, &counts);
        }
        progress.advance(1, "");
    }
    progress.finish();
    let measured = begin.elapsed().saturating_sub(WARM_UP);
    collect(&mut lives, viewer.source(), &journal, &counts);
    let round_trip = Duration::from_micros(viewer.source().stats().rtt_micros);
    drop(viewer);
    host.close();
    Ok(Recording {
        lives: lives.into_values().collect(),
        ages_micros,
        num_new,
        measured,
        round_trip,
        first_picture,
    })
}

/// Joins both sides' lives of the frames that began during the measurement. A frame that is sent again is generated
/// once.
fn collect(lives: &mut BTreeMap<FrameId, Life>, client: &Client, journal: &Journal, counts: &Range<u64>) {
    let of_client: BTreeMap<FrameId, Life> =
        client.ledger().into_iter().map(|life| (life.frame, life)).collect();
    for life in journal.lives() {
        if life.at(Stage::Begun).is_some_and(|begun| counts.contains(&begun)) {
            let whole = of_client.get(&life.frame).map_or(life, |other| life.joined(other));
            lives.insert(life.frame, whole);
        }
    }
}

/// The first frame of a large volume on a slow machine, including shader compilation.
const FIRST_FRAME_TIMEOUT: Duration = Duration::from_secs(60);
