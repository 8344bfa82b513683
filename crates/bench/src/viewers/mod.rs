//! Measures what viewers of one server cost it: memory and time a frame, for numbers of viewers with the same look or
//! each with its own.
//!
//! The server is a process of its own, and a fresh one for each row, so that its memory is that of this row alone. The
//! viewers are in this process, over real connections on loopback. Each requests frames as a window does: of a slow
//! server, smaller ones while its camera moves. Their cameras orbit and then rest.

mod process;

use std::time::{Duration, Instant};

use isinglass_client::{Foresight, HeadlessViewer, WindowOptions};
use isinglass_core::camera::Intrinsics;
use isinglass_core::ids::FrameId;
use isinglass_core::look::Look;
use isinglass_core::orbit::Orbit;
use isinglass_core::space::Aabb;
use isinglass_net::{Client, ClientOptions};
use serde::Serialize;

use crate::error::BenchError;
use crate::progress::Progress;
pub use process::ServerProcess;

/// What to measure.
#[derive(Clone, Debug)]
pub struct ViewersOptions {
    /// Numbers of viewers.
    pub counts: Vec<u32>,
    /// Whether viewers share one look or each has its own.
    pub looks: Vec<Looks>,
    /// How long cameras move in each row.
    pub duration: Duration,
    /// How often each row is measured; medians count.
    pub repeats: u32,
    /// Where cameras begin; those of several viewers are spread around the volume.
    pub orbit: Orbit,
    /// Speed of the cameras.
    pub degrees_per_second: f32,
    /// Size and field of view of pictures.
    pub intrinsics: Intrinsics,
}

/// The looks of the viewers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Looks {
    /// All have the server's.
    Same,
    /// Each has an opacity of its own.
    Different,
}

/// The whole result.
#[derive(Clone, Debug, Serialize)]
pub struct ViewersReport {
    /// The volume's source.
    pub(crate) source: String,
    pub(crate) size: [u32; 2],
    pub(crate) seconds: f64,
    /// One row for each number of viewers and choice of looks.
    pub(crate) rows: Vec<ViewersRow>,
}

/// What so many viewers cost; medians over the repeats. Memory is `None` on systems that do not tell it.
#[derive(Clone, Debug, Serialize)]
pub struct ViewersRow {
    pub(crate) viewers: u32,
    pub(crate) looks: Looks,
    /// Memory of the server before the first viewer, MB.
    pub(crate) idle_mb: Option<f64>,
    /// Most memory of the server with all viewers, MB.
    pub(crate) peak_mb: Option<f64>,
    /// The difference for each viewer, MB.
    pub(crate) mb_per_viewer: Option<f64>,
    /// New frames of all viewers together while they move.
    pub(crate) frames_per_second: f64,
    /// Those of the viewer that got the fewest.
    pub(crate) least_frames_per_second: f64,
    /// Rendering time of a frame, without that of others in between.
    pub(crate) generate_ms: f64,
    /// The same for each of its lists.
    pub(crate) generate_nanos_per_list: f64,
    /// Processor time of the server for a frame, with coding and sending.
    pub(crate) processor_ms: Option<f64>,
}

/// Measures each row with a server that `serve` starts for so many viewers.
///
/// # Errors
/// If a server does not start, or a viewer sees nothing.
pub fn run(
    source: &str,
    options: &ViewersOptions,
    mut serve: impl FnMut(u32) -> Result<ServerProcess, BenchError>,
) -> Result<ViewersReport, BenchError> {
    let cases: Vec<(Looks, u32)> =
        options.looks.iter().flat_map(|looks| options.counts.iter().map(|count| (*looks, *count))).collect();
    let mut progress = Progress::new("serving", u64::from(options.repeats) * cases.len() as u64);
    let mut measured: Vec<Vec<ViewersRow>> = vec![Vec::new(); cases.len()];
    // Rounds, so that a busy machine affects all rows alike.
    for _ in 0..options.repeats {
        for (rows, &(looks, count)) in measured.iter_mut().zip(&cases) {
            progress.begin(&format!("{count} viewers"));
            let server = serve(count)?;
            rows.push(row(options, looks, count, &server)?);
            progress.advance(1, "");
        }
    }
    progress.finish();
    let Intrinsics { width, height, .. } = options.intrinsics;
    let rows = measured.iter().filter_map(|rows| median_row(rows)).collect();
    Ok(ViewersReport {
        source: source.into(),
        size: [width, height],
        seconds: options.duration.as_secs_f64(),
        rows,
    })
}

/// A viewer whose camera turns, and the frames it has seen.
struct Hand {
    viewer: HeadlessViewer<Client>,
    intrinsics: Intrinsics,
    /// The volume's box.
    bounds: Aabb,
    orbit: Orbit,
    newest: Option<FrameId>,
    num_frames: u32,
    /// Sums over the frames whose cost the server has told.
    costs: Costs,
}

#[derive(Clone, Copy, Debug, Default)]
struct Costs {
    newest: Option<FrameId>,
    num: u32,
    generate_micros: u64,
    num_lists: u64,
}

impl Hand {
    /// Requests a pose and takes what has come.
    fn turn(&mut self, degrees: f32) -> Result<(), BenchError> {
        let Some(frame) = self.pose(degrees)? else { return Ok(()) };
        if self.newest.replace(frame.0) != Some(frame.0) {
            self.num_frames += 1;
        }
        let server = self.viewer.source().stats().server;
        if server.frame == frame.0 && self.costs.newest.replace(frame.0) != Some(frame.0) {
            self.costs.num += 1;
            self.costs.generate_micros += server.generate_micros;
            self.costs.num_lists += frame.1 as u64;
        }
        Ok(())
    }

    /// Requests a pose. Returns the newest frame and its number of lists.
    fn pose(&mut self, degrees: f32) -> Result<Option<(FrameId, usize)>, BenchError> {
        if let isinglass_net::State::Refused(problem) = self.viewer.source().state() {
            return Err(BenchError::Demo(format!("viewer: {problem}")));
        }
        let pose = self.orbit.turned(degrees).pose(&self.intrinsics, &self.bounds);
        let now = Duration::from_micros(self.viewer.source().clock().now_micros());
        self.viewer.tick(now, pose);
        // A frame lives as long as a record names it.
        self.viewer.take_records();
        let newest = self.viewer.source().latest_frame().map(|received| received.frame.header);
        Ok(newest.map(|header| (header.frame, header.camera.intrinsics.num_pixels())))
    }
}

fn row(
    options: &ViewersOptions,
    looks: Looks,
    count: u32,
    server: &ServerProcess,
) -> Result<ViewersRow, BenchError> {
    let intrinsics = options.intrinsics;
    let idle = server.memory();
    server.forget_peak();
    let mut hands = Vec::new();
    for (i, link) in (0..).zip(server.links()) {
        let failed = |e: &dyn std::fmt::Display| BenchError::Demo(format!("viewer: {e}"));
        let client = Client::connect(link, ClientOptions::default()).map_err(|e| failed(&e))?;
        let welcome = client.wait_connected(PATIENCE).map_err(|e| failed(&e))?;
        if looks == Looks::Different {
            client.set_look(own_look(&welcome.look, i, count)).map_err(|e| failed(&e))?;
        }
        let orbit = options.orbit.turned(i as f32 * 360.0 / count as f32);
        let (bounds, costs) = (welcome.volume.bounds(), Costs::default());
        let mut viewer = HeadlessViewer::new(client, intrinsics, Foresight::default());
        viewer.set_frame_size(WindowOptions::default().frame_size);
        hands.push(Hand { viewer, intrinsics, bounds, orbit, newest: None, num_frames: 0, costs });
    }
    let asked = Instant::now();
    while hands.iter().any(|hand| hand.newest.is_none()) {
        hands.iter_mut().try_for_each(|hand| hand.turn(0.0))?;
        if asked.elapsed() > PATIENCE {
            return Err(BenchError::Demo("no frame came, expected one; the machine may be too slow".into()));
        }
        std::thread::sleep(TICK);
    }
    play(&mut hands, options, WARM_UP, Duration::ZERO)?;
    hands.iter_mut().for_each(|hand| (hand.num_frames, hand.costs) = (0, Costs::default()));
    let busy = server.processor_time();
    let seconds = play(&mut hands, options, options.duration, WARM_UP)?.as_secs_f64();
    let busy = server.processor_time().zip(busy).map(|(after, before)| after.saturating_sub(before));
    let frames: Vec<u32> = hands.iter().map(|hand| hand.num_frames).collect();
    // At rest, each viewer gets its whole picture exactly, which takes most memory.
    let stop = options.degrees_per_second * (WARM_UP.as_secs_f32() + seconds as f32);
    let rest = Instant::now();
    while rest.elapsed() < REST {
        hands.iter_mut().try_for_each(|hand| hand.turn(stop))?;
        std::thread::sleep(TICK);
    }
    let peak = server.peak_memory();
    let mb = |bytes: Option<u64>| bytes.map(|bytes| bytes as f64 / 1e6);
    let num_frames: u32 = frames.iter().sum();
    let costs = hands.iter().map(|hand| hand.costs);
    let (num, micros, lists) = costs.fold((0, 0, 0), |(num, micros, lists), costs| {
        (num + costs.num, micros + costs.generate_micros, lists + costs.num_lists)
    });
    let more = mb(peak).zip(mb(idle)).map(|(peak, idle)| (peak - idle) / f64::from(count));
    Ok(ViewersRow {
        viewers: count,
        looks,
        idle_mb: mb(idle),
        peak_mb: mb(peak),
        mb_per_viewer: more,
        frames_per_second: f64::from(num_frames) / seconds,
        least_frames_per_second: f64::from(frames.iter().copied().min().unwrap_or(0)) / seconds,
        generate_ms: micros as f64 / 1e3 / f64::from(num.max(1)),
        generate_nanos_per_list: micros as f64 * 1e3 / lists.max(1) as f64,
        processor_ms: busy.map(|busy| busy.as_secs_f64() * 1e3 / f64::from(num_frames.max(1))),
    })
}

/// Moves all cameras for a while, on from where they are after `since`.
fn play(
    hands: &mut [Hand],
    options: &ViewersOptions,
    duration: Duration,
    since: Duration,
) -> Result<Duration, BenchError> {
    let begin = Instant::now();
    while begin.elapsed() < duration {
        let degrees = options.degrees_per_second * (since + begin.elapsed()).as_secs_f32();
        hands.iter_mut().try_for_each(|hand| hand.turn(degrees))?;
        std::thread::sleep(TICK);
    }
    Ok(begin.elapsed())
}

/// The look of one of several viewers: less opaque than that of the one before.
fn own_look(look: &Look, number: u32, count: u32) -> Look {
    let mut own = look.clone();
    let share = 1.0 - 0.5 * number as f32 / count as f32;
    own.transfer.points.iter_mut().for_each(|point| point.opacity *= share);
    own
}

/// The median of each number of the repeats of a row; `None` without any.
fn median_row(rows: &[ViewersRow]) -> Option<ViewersRow> {
    let first = rows.first()?;
    let median = |of: &dyn Fn(&ViewersRow) -> f64| {
        let mut all: Vec<f64> = rows.iter().map(of).collect();
        all.sort_by(f64::total_cmp);
        all[all.len() / 2]
    };
    let known = |of: &dyn Fn(&ViewersRow) -> Option<f64>| {
        rows.iter().all(|row| of(row).is_some()).then(|| median(&|row| of(row).unwrap_or_default()))
    };
    Some(ViewersRow {
        viewers: first.viewers,
        looks: first.looks,
        idle_mb: known(&|row| row.idle_mb),
        peak_mb: known(&|row| row.peak_mb),
        mb_per_viewer: known(&|row| row.mb_per_viewer),
        frames_per_second: median(&|row| row.frames_per_second),
        least_frames_per_second: median(&|row| row.least_frames_per_second),
        generate_ms: median(&|row| row.generate_ms),
        generate_nanos_per_list: median(&|row| row.generate_nanos_per_list),
        processor_ms: known(&|row| row.processor_ms),
    })
}

/// A table for people.
pub fn table(report: &ViewersReport) -> String {
    let [width, height] = report.size;
    let mut text = format!("{} at {width}x{height}, {:.0} s a row\n", report.source, report.seconds);
    text += "looks      viewers  idle MB  peak MB  MB each  frames/s  least/s  render ms  ns/list  processor ms/frame\n";
    let number = |number: Option<f64>| number.map_or_else(|| "-".into(), |number| format!("{number:.0}"));
    for row in &report.rows {
        let looks = match row.looks {
            Looks::Same => "same",
            Looks::Different => "different",
        };
        text += &format!(
            "{looks:<10} {:>7} {:>8} {:>8} {:>8} {:>9.1} {:>8.1} {:>10.1} {:>8.0} {:>19}\n",
            row.viewers,
            number(row.idle_mb),
            number(row.peak_mb),
            number(row.mb_per_viewer),
            row.frames_per_second,
            row.least_frames_per_second,
            row.generate_ms,
            row.generate_nanos_per_list,
            number(row.processor_ms),
        );
    }
    text
}

/// Longest wait for a connection and for the first frame.
const PATIENCE: Duration = Duration::from_secs(120);
/// Time of movement before counting.
const WARM_UP: Duration = Duration::from_secs(2);
/// Time at rest after the movement.
const REST: Duration = Duration::from_secs(3);
/// Time between two poses.
const TICK: Duration = Duration::from_millis(8);

#[cfg(test)]
mod tests {
    use isinglass_formats::load_transfer;

    use super::*;

    fn sample(viewers: u32, peak_mb: Option<f64>, generate_ms: f64) -> ViewersRow {
        ViewersRow {
            viewers,
            looks: Looks::Same,
            idle_mb: Some(10.0),
            peak_mb,
            mb_per_viewer: peak_mb.map(|peak| peak - 10.0),
            frames_per_second: 1.0,
            least_frames_per_second: 1.0,
            generate_ms,
            generate_nanos_per_list: 1.0,
            processor_ms: None,
        }
    }

    #[test]
    fn the_median_of_the_repeats_counts_and_unknown_stays_unknown() {
        let rows = [sample(2, Some(30.0), 9.0), sample(2, Some(20.0), 1.0), sample(2, Some(90.0), 4.0)];
        let row = median_row(&rows).unwrap();
        assert_eq!((row.peak_mb, row.generate_ms, row.processor_ms), (Some(30.0), 4.0, None));
        assert_eq!(median_row(&[sample(2, None, 1.0), rows[0].clone()]).unwrap().peak_mb, None);
        assert!(median_row(&[]).is_none());
    }

    #[test]
    fn each_viewer_has_a_look_of_its_own_that_is_valid() {
        let look = Look::new(load_transfer("shells").unwrap());
        let looks: Vec<Look> = (0..16).map(|i| own_look(&look, i, 16)).collect();
        assert!(looks[0] == look, "the control: the first has the server's");
        for (i, own) in looks.iter().enumerate() {
            own.validate().unwrap();
            assert!(looks[..i].iter().all(|other| !other.marches_like(own)));
        }
    }
}
