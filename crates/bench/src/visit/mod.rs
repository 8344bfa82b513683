//! Viewers without a window on a server anywhere: they play a camera path at a display's rate, cast what a window
//! would show, and measure it. All times are on the viewer's own clock, so two machines need no common one.

mod painter;
mod pictures;
mod report;

use std::collections::BTreeMap;
use std::path::Path;
use std::time::{Duration, Instant};

use isinglass_client::{CameraPath, Foresight, HeadlessViewer, Standing, WindowOptions};
use isinglass_core::camera::Intrinsics;
use isinglass_core::ids::FrameId;
use isinglass_core::orbit::Orbit;
use isinglass_net::{Client, LinkStats, State};
use isinglass_render::{Backend, BackendChoice};

use crate::demo::course::Course;
use crate::demo::play::{FIRST_FRAME_TIMEOUT, Tick};
use crate::demo::script::{Motion, Script};
use crate::error::BenchError;
use painter::Painter;
use pictures::PictureWriter;
pub use report::{Visit, VisitReport};

/// What the viewers do.
#[derive(Clone, Debug)]
pub struct VisitOptions {
    /// The server, for the report.
    pub server: String,
    /// A path in place of an orbit.
    pub path: Option<CameraPath>,
    /// Where the camera begins.
    pub orbit: Orbit,
    /// Speed of the orbit.
    pub degrees_per_second: f32,
    /// Size and field of view of the picture.
    pub intrinsics: Intrinsics,
    /// Whether rays are parallel.
    pub is_orthographic: bool,
    /// The viewer's measures against latency.
    pub foresight: Foresight,
    /// Refreshes of the display per second.
    pub refresh_hz: f32,
    /// Where pictures are cast.
    pub backend: BackendChoice,
    /// Also write the picture of every so many refreshes.
    pub every: Option<u32>,
}

/// Lets all `clients` play at the same time, and writes their refreshes, pictures and figures to `out`, which is
/// created if necessary. Only the first casts pictures, because the others would slow it down.
///
/// # Errors
/// If a viewer sees no whole picture, or a file cannot be written. The other viewers end first.
pub fn run(clients: Vec<Client>, options: &VisitOptions, out: &Path) -> Result<VisitReport, BenchError> {
    std::fs::create_dir_all(out).map_err(BenchError::io(out))?;
    let backend = Backend::open(options.backend)?;
    let is_alone = clients.len() == 1;
    let visits: Vec<Result<Visit, BenchError>> = std::thread::scope(|scope| {
        let begin = |(number, client): (usize, Client)| {
            let backend = (number == 0).then(|| backend.clone());
            let folder = if is_alone { out.to_owned() } else { out.join(format!("viewer-{}", number + 1)) };
            scope.spawn(move || visit(client, options, backend, &folder))
        };
        let threads: Vec<_> = clients.into_iter().enumerate().map(begin).collect();
        let ended = threads.into_iter().map(|thread| thread.join());
        ended
            .map(|end| end.unwrap_or_else(|_| Err(BenchError::Demo("a viewer's thread panicked".into()))))
            .collect()
    });
    let viewers = visits.into_iter().collect::<Result<Vec<_>, _>>()?;
    let report = VisitReport { viewers };
    report::write_summary(out, &report)?;
    Ok(report)
}

/// One refresh, with everything about it that no tick has.
struct Refreshed {
    tick: Tick,
    /// Time from the refresh to the finished picture.
    paint: Duration,
    /// Side of the cast picture as a share of the shown one.
    scale: f32,
    /// Number of older frames in the picture.
    num_kept: usize,
    stats: LinkStats,
    is_connected: bool,
}

/// All that one viewer saw.
struct Seen {
    script: Script,
    refreshed: Vec<Refreshed>,
    /// From the first request to the first frame, and to the first whole picture.
    first_frame: Duration,
    first_whole: Duration,
    /// Bytes of each frame that came while the path was played, whether or not it was shown.
    frame_bytes: u64,
    num_left_out: usize,
    description: Option<String>,
}

fn visit(
    client: Client,
    options: &VisitOptions,
    backend: Option<Backend>,
    out: &Path,
) -> Result<Visit, BenchError> {
    std::fs::create_dir_all(out).map_err(BenchError::io(out))?;
    let mut viewer = HeadlessViewer::new(client, options.intrinsics, options.foresight);
    viewer.set_orthographic(options.is_orthographic);
    viewer.set_frame_size(WindowOptions::default().frame_size);
    let course = Course {
        motion: match &options.path {
            Some(path) => Motion::Recorded(path.clone()),
            None => Motion::Orbit { start: options.orbit, degrees_per_second: options.degrees_per_second },
        },
        intrinsics: options.intrinsics,
        refresh_hz: options.refresh_hz,
        patience: FIRST_FRAME_TIMEOUT,
        shows_progress: backend.is_some(),
    };
    let description = backend.as_ref().map(Backend::description);
    let mut painter = backend.map(|backend| Painter::new(backend, options.refresh_hz));
    let mut pictures = PictureWriter::start(out)?;
    let asked = Instant::now();
    let mut first_frame = None;
    let script = course.begin(&mut viewer, |record| {
        if record.frame.is_some() && first_frame.is_none() {
            first_frame = Some(asked.elapsed());
            if let Some(painter) = &mut painter {
                painter.paint(&record)?;
                pictures.put("first", painter.picture());
            }
        }
        Ok(())
    })?;
    let first_whole = asked.elapsed();
    let rests = script.rests();
    let mut refreshed = Vec::with_capacity(course.num_periods(&script));
    let mut bytes = BTreeMap::new();
    let (mut rest, mut since_collected, mut num_refreshes) = (None, 0, 0u64);
    course.play(&script, &mut viewer, |moment, viewer, record| {
        let rest_now = rests.iter().position(|rest| rest.contains(&moment.at));
        let mut painted = painter::Painted::default();
        if let Some(painter) = &mut painter {
            if let Some(ended) = rest.filter(|_| rest != rest_now) {
                pictures.put(&format!("rest-{}", ended + 1), painter.picture());
            }
            painted = painter.paint(&record)?;
            if options.every.is_some_and(|n| num_refreshes % u64::from(n) == 0) {
                pictures.put(&format!("t{:07.3}s", moment.at.as_secs_f64()), painter.picture());
            }
        }
        num_refreshes += 1;
        rest = rest_now;
        let (stats, is_connected) = (record.stats, record.state == State::Connected);
        if let Some(mut tick) = Tick::of(moment, record, false) {
            // A frame of the present pose is not old, and no picture is on the screen before it is finished.
            tick.frame_age = tick.frame_age.map(|age| if age.is_zero() { age } else { age + painted.time });
            let painter::Painted { time: paint, scale, num_kept } = painted;
            refreshed.push(Refreshed { tick, paint, scale, num_kept, stats, is_connected });
        }
        // The ledger holds only a few seconds' worth.
        since_collected += 1;
        if since_collected as f32 >= options.refresh_hz {
            since_collected = 0;
            collect(&mut bytes, viewer.source());
        }
        Ok(())
    })?;
    if let Some(painter) = &painter {
        pictures.put(&format!("rest-{}", rests.len()), painter.picture());
    }
    collect(&mut bytes, viewer.source());
    let num_left_out = pictures.finish()?;
    let frame_bytes = bytes.values().sum();
    let first_frame = first_frame.unwrap_or(first_whole);
    let seen = Seen { script, refreshed, first_frame, first_whole, frame_bytes, num_left_out, description };
    report::write_refreshes(out, &seen)?;
    let visit = Visit::of(options, &seen);
    report::write_visit(out, &visit)?;
    Ok(visit)
}

/// Notes the bytes of the ledger's frames. Frames of another connection count from 1 again.
fn collect(bytes: &mut BTreeMap<(u32, FrameId), u64>, client: &Client) {
    bytes.extend(client.ledger().into_iter().map(|life| ((life.connection, life.frame), life.bytes)));
}

impl Seen {
    /// How long there was no connection while the path was played.
    fn disconnected(&self) -> Duration {
        let ends = self.refreshed.windows(2).filter(|pair| !pair[0].is_connected);
        ends.map(|pair| pair[1].tick.at.saturating_sub(pair[0].tick.at)).sum()
    }

    /// Refreshes whose picture waits for a connection.
    fn num_offline(&self) -> usize {
        self.refreshed.iter().filter(|r| r.tick.standing == Standing::Offline).count()
    }
}
