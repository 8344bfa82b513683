//! The figures of visits, their files and their text.

use std::path::Path;
use std::time::Duration;

use isinglass_formats::write_whole;
use serde::Serialize;

use super::{Refreshed, Seen, VisitOptions};
use crate::demo::play::Tick;
use crate::demo::shown::{ShownFrames, millis, percentile};
use crate::error::BenchError;

/// The figures in `summary.json`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct VisitReport {
    /// One for each viewer.
    pub viewers: Vec<Visit>,
}

/// The figures of one viewer. Ages are from the moment in which a frame's pose was sent to that in which its picture
/// was finished, on the viewer's clock.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Visit {
    pub(crate) server: String,
    /// What carried the packets at the end.
    pub(crate) carrier: String,
    /// Where pictures were cast; `None` for a viewer that only loads the server.
    pub(crate) backend: Option<String>,
    pub(crate) size: [u32; 2],
    pub(crate) refresh_hz: f32,
    /// Whether a recorded path replaced the orbit, whose speed then does not matter.
    pub(crate) plays_path: bool,
    pub(crate) degrees_per_second: f32,
    /// From the admission to the first frame, and to the first whole picture.
    pub(crate) first_frame_ms: f64,
    pub(crate) first_whole_ms: f64,
    /// Length of the path with its rests.
    pub(crate) seconds: f64,
    /// Refreshes of the display; one that takes too long costs others.
    pub(crate) refreshes: usize,
    pub(crate) refreshes_per_second: f64,
    /// Time of casting a picture.
    pub(crate) paint_ms_p50: f64,
    pub(crate) paint_ms_p99: f64,
    #[serde(flatten)]
    pub(crate) shown: ShownFrames,
    /// The transport's measurement.
    pub(crate) rtt_ms_p50: f64,
    pub(crate) rtt_ms_p99: f64,
    /// Bytes of all frames that came, and their mean rate.
    pub(crate) frame_bytes: u64,
    pub(crate) frames_mbit: f64,
    /// Packets of the viewer that were lost.
    pub(crate) lost_packets: u64,
    pub(crate) broken_chunks: u64,
    /// Time without a connection.
    pub(crate) disconnected_ms: f64,
    /// Refreshes at rest that showed an older frame, for want of a connection.
    pub(crate) refreshes_offline: usize,
    /// Pictures that came too fast to be written.
    pub(crate) pictures_left_out: usize,
}

impl Visit {
    pub(super) fn of(options: &VisitOptions, seen: &Seen) -> Self {
        let Seen { script, refreshed, .. } = seen;
        let of_each = |of: &dyn Fn(&Refreshed) -> f64| refreshed.iter().map(of).collect::<Vec<_>>();
        let rtts = of_each(&|r| r.stats.rtt_micros as f64 / 1e3);
        let rtt_ms_p50 = percentile(rtts.clone(), 0.5);
        let paints: Vec<f64> =
            refreshed.iter().filter(|r| !r.paint.is_zero()).map(|r| millis(r.paint)).collect();
        let ticks: Vec<Tick> = refreshed.iter().map(|r| r.tick.clone()).collect();
        let last = refreshed.last();
        let seconds = last.map_or(0.0, |r| r.tick.at.as_secs_f64());
        Self {
            server: options.server.clone(),
            carrier: last.map_or_else(String::new, |r| r.stats.carrier.to_string()),
            backend: seen.description.clone(),
            size: [options.intrinsics.width, options.intrinsics.height],
            refresh_hz: options.refresh_hz,
            plays_path: options.path.is_some(),
            degrees_per_second: options.degrees_per_second,
            first_frame_ms: millis(seen.first_frame),
            first_whole_ms: millis(seen.first_whole),
            seconds,
            refreshes: refreshed.len(),
            refreshes_per_second: refreshed.len() as f64 / seconds.max(1e-3),
            paint_ms_p50: percentile(paints.clone(), 0.5),
            paint_ms_p99: percentile(paints, 0.99),
            shown: ShownFrames::of(script, &ticks, Duration::from_secs_f64(rtt_ms_p50 / 1e3)),
            rtt_ms_p50,
            rtt_ms_p99: percentile(rtts, 0.99),
            frame_bytes: seen.frame_bytes,
            frames_mbit: seen.frame_bytes as f64 * 8e-6 / seconds.max(1e-3),
            lost_packets: last.map_or(0, |r| r.stats.lost_packets),
            broken_chunks: last.map_or(0, |r| r.stats.broken_chunks),
            disconnected_ms: millis(seen.disconnected()),
            refreshes_offline: seen.num_offline(),
            pictures_left_out: seen.num_left_out,
        }
    }
}

impl VisitReport {
    /// A few lines for people.
    pub fn text(&self, out: &Path) -> String {
        let mut text = String::new();
        for (i, visit) in self.viewers.iter().enumerate() {
            let Visit { shown, .. } = visit;
            let [width, height] = visit.size;
            let on = visit.backend.as_deref().unwrap_or("no pictures");
            text += &format!(
                "viewer {} of {} at {width}x{height}, {} Hz, {on}\n",
                i + 1,
                visit.server,
                visit.refresh_hz
            );
            let mut line = |name: &str, value: String| text += &format!("  {name:<22} {value}\n");
            line(
                "connection",
                format!(
                    "{}, round trip {:.0} ms, {:.0} ms at worst but 1 %",
                    visit.carrier, visit.rtt_ms_p50, visit.rtt_ms_p99
                ),
            );
            line(
                "first picture",
                format!("after {:.0} ms, whole after {:.0} ms", visit.first_frame_ms, visit.first_whole_ms),
            );
            line(
                "frame on the screen",
                format!(
                    "{:.0} ms old (median), {:.0} ms at worst but 1 %",
                    shown.frame_age_ms_p50, shown.frame_age_ms_p99
                ),
            );
            line(
                "new frames",
                format!(
                    "{:.0} a second, at most {:.0} ms apart, {} freezes",
                    shown.frames_per_second, shown.longest_gap_ms, shown.freezes
                ),
            );
            line(
                "refreshes",
                format!(
                    "{:.0} a second; a picture takes {:.1} ms (median)",
                    visit.refreshes_per_second, visit.paint_ms_p50
                ),
            );
            line("at rest", format!("exact {} after the stop", shown.exact_in_words()));
            line(
                "received",
                format!(
                    "{:.1} MB of frames, {:.1} Mbit/s",
                    visit.frame_bytes as f64 / 1e6,
                    visit.frames_mbit
                ),
            );
        }
        text + &format!("In {}: refreshes.csv, summary.json, pictures\n", out.display())
    }
}

pub(super) fn write_summary(out: &Path, report: &VisitReport) -> Result<(), BenchError> {
    write_json(&out.join("summary.json"), report)
}

/// The figures of one viewer among several.
pub(super) fn write_visit(out: &Path, visit: &Visit) -> Result<(), BenchError> {
    write_json(&out.join("summary.json"), visit)
}

fn write_json(path: &Path, value: &impl Serialize) -> Result<(), BenchError> {
    let json = serde_json::to_string_pretty(value)
        .map_err(|e| BenchError::Demo(format!("the report cannot be written: {e}")))?;
    Ok(write_whole(path, (json + "\n").as_bytes())?)
}

/// One line a refresh.
pub(super) fn write_refreshes(out: &Path, seen: &Seen) -> Result<(), BenchError> {
    let mut text = String::with_capacity(160 * (seen.refreshed.len() + 1));
    text += COLUMNS;
    for Refreshed { tick, paint, scale, num_kept, stats, is_connected } in &seen.refreshed {
        let age = tick.frame_age.map_or(String::new(), |age| format!("{:.1}", millis(age)));
        let [eye, turn] =
            [tick.input.eye.to_array().to_vec(), tick.input.world_from_view.to_array().to_vec()];
        let numbers: Vec<String> = eye.iter().chain(&turn).map(|x| format!("{x:.6}")).collect();
        text += &format!(
            "{:.4},{},{},{age},{:.1},{scale},{num_kept},{},{},{},{is_connected},{:.1},{:.2},{}\n",
            tick.at.as_secs_f64(),
            tick.standing.word(),
            tick.frame.0,
            millis(*paint),
            numbers.join(","),
            tick.frame_bytes,
            stats.carrier,
            stats.rtt_micros as f64 / 1e3,
            stats.bytes_per_second * 8e-6,
            stats.lost_packets,
        );
    }
    Ok(write_whole(&out.join("refreshes.csv"), text.as_bytes())?)
}

const COLUMNS: &str = "time_s,standing,frame,frame_age_ms,paint_ms,picture_scale,kept_frames,eye_x,eye_y,eye_z,turn_x,\
                       turn_y,turn_z,turn_w,frame_bytes,carrier,is_connected,rtt_ms,received_mbit,lost_packets\n";
