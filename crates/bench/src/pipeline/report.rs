//! The figures, and the table for people.

use isinglass_core::session::ledger::{Life, Stage};
use isinglass_render::Backend;
use serde::Serialize;

use super::PipelineOptions;
use super::device::DeviceTimes;
use super::play::Recording;

/// The results.
#[derive(Clone, Debug, Serialize)]
pub struct PipelineReport {
    /// The volume.
    pub source: String,
    /// Columns and rows of the picture.
    pub size: [u32; 2],
    /// Mean length of lists.
    pub k: u8,
    /// Coding of frames.
    pub codec: &'static str,
    /// Where kernels ran.
    pub backend: String,
    /// Number of worker threads.
    pub threads: usize,
    /// The link's own round trip, ms.
    pub rtt_ms: f64,
    /// Its jitter, ms.
    pub jitter_ms: f64,
    /// Its rate, Mbit/s; `None` for no limit.
    pub bandwidth_mbit: Option<f64>,
    /// The round trip measured by the transport, ms.
    pub measured_rtt_ms: f64,
    /// Refreshes of the display a second.
    pub refresh_hz: f32,
    /// Speed of the camera.
    pub degrees_per_second: f32,
    /// Duration of the measurement.
    pub seconds: f64,
    /// Time to the first whole picture: opening, bricks, tables, device, first frame.
    pub first_picture_seconds: f64,
    /// New frames on the screen per second.
    pub new_frames_per_second: f64,
    /// Number of frames that began.
    pub frames_begun: usize,
    /// Number of those that were shown.
    pub frames_shown: usize,
    /// Frames that were skipped for a newer one, by the last stage that they reached.
    pub given_up: Vec<GivenUp>,
    /// Time since the displayed frame's pose was set, at each refresh.
    pub age_ms: Spread,
    /// Bytes of a frame.
    pub bytes: Spread,
    /// Bytes per second.
    pub bytes_per_second: f64,
    /// Stages of the frames that were shown.
    pub stages: Vec<StageRow>,
    /// Times by the device's own clock; `None` where it has none.
    pub device: Option<DeviceTimes>,
}

/// Frames that stopped early.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct GivenUp {
    /// The last stage that they reached.
    pub after: &'static str,
    /// Their number.
    pub frames: usize,
}

/// A stage in the lives of frames.
#[derive(Clone, Debug, Serialize)]
pub struct StageRow {
    /// Its name.
    pub stage: &'static str,
    /// Number of frames with its stamp.
    pub frames: usize,
    /// Time since the previous stage, ms.
    pub step_ms: Spread,
    /// Time since the pose was set, ms.
    pub since_asked_ms: Spread,
}

/// Mean, median and 95th percentile.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Spread {
    /// The mean.
    pub mean: f64,
    /// The median.
    pub p50: f64,
    /// The 95th percentile.
    pub p95: f64,
}

impl Spread {
    /// The spread of some values; zeros without any.
    pub fn of(mut values: Vec<f64>) -> Self {
        values.sort_unstable_by(f64::total_cmp);
        let at = |share: f64| {
            let rank = (values.len() as f64 * share).ceil() as usize;
            values.get(rank.saturating_sub(1)).copied().unwrap_or(0.0)
        };
        let mean = values.iter().sum::<f64>() / values.len().max(1) as f64;
        Self { mean, p50: at(0.5), p95: at(0.95) }
    }
}

pub(super) fn report(
    options: &PipelineOptions,
    backend: &Backend,
    played: &Recording,
    device: Option<DeviceTimes>,
) -> PipelineReport {
    let demo = &options.demo;
    let shown: Vec<&Life> = played.lives.iter().filter(|life| life.at(Stage::Shown).is_some()).collect();
    let seconds = played.measured.as_secs_f64();
    let bytes: Vec<f64> = played.lives.iter().filter(|l| l.bytes > 0).map(|l| l.bytes as f64).collect();
    PipelineReport {
        source: demo.source.clone(),
        size: [demo.intrinsics.width, demo.intrinsics.height],
        k: demo.k,
        codec: demo.plan.mode.name(),
        backend: backend.description(),
        threads: rayon::current_num_threads(),
        rtt_ms: demo.link.rtt.as_secs_f64() * 1e3,
        jitter_ms: demo.link.jitter.as_secs_f64() * 1e3,
        bandwidth_mbit: demo.link.bandwidth_mbit,
        measured_rtt_ms: played.round_trip.as_secs_f64() * 1e3,
        refresh_hz: demo.refresh_hz,
        degrees_per_second: demo.degrees_per_second,
        seconds,
        first_picture_seconds: played.first_picture.as_secs_f64(),
        new_frames_per_second: played.num_new as f64 / seconds,
        frames_begun: played.lives.len(),
        frames_shown: shown.len(),
        given_up: given_up(&played.lives),
        age_ms: Spread::of(played.ages_micros.iter().map(|&micros| micros as f64 / 1e3).collect()),
        bytes_per_second: bytes.iter().sum::<f64>() / seconds,
        bytes: Spread::of(bytes),
        stages: stages(&shown),
        device,
    }
}

/// Frames in flight at the end are not given up: none newer was shown.
fn given_up(lives: &[Life]) -> Vec<GivenUp> {
    let newest = lives.iter().filter(|life| life.at(Stage::Shown).is_some()).map(|life| life.frame).max();
    let is_lost = |life: &&Life| life.is_given_up || newest.is_some_and(|newest| life.frame < newest);
    let lost = lives.iter().filter(|life| life.at(Stage::Shown).is_none()).filter(is_lost);
    let lost: Vec<Option<Stage>> = lost.map(Life::last_stage).collect();
    let count = |stage: Stage| GivenUp {
        after: stage.name(),
        frames: lost.iter().filter(|last| **last == Some(stage)).count(),
    };
    Stage::ALL.into_iter().map(count).filter(|row| row.frames > 0).collect()
}

fn stages(lives: &[&Life]) -> Vec<StageRow> {
    let between = |from: Stage, to: Stage| {
        let time = |life: &&Life| Some(life.at(to)?.saturating_sub(life.at(from)?) as f64 / 1e3);
        Spread::of(lives.iter().filter_map(time).collect())
    };
    let row = |number: usize| {
        let stage = Stage::ALL[number];
        StageRow {
            stage: stage.name(),
            frames: lives.iter().filter(|life| life.at(stage).is_some()).count(),
            step_ms: between(Stage::ALL[number.saturating_sub(1)], stage),
            since_asked_ms: between(Stage::Asked, stage),
        }
    };
    (0..Stage::ALL.len()).map(row).collect()
}

/// A table for people.
pub fn table(r: &PipelineReport) -> String {
    let mut text = format!(
        "{} at {}x{}, k {}, codec {}, {}, {} threads\nround trip {:.0} ms{}{}, display {:.0} Hz, camera {:.0}°/s, {:.1} s; first whole picture after {:.1} s\n\n",
        r.source,
        r.size[0],
        r.size[1],
        r.k,
        r.codec,
        r.backend,
        r.threads,
        r.rtt_ms,
        if r.jitter_ms > 0.0 { format!(", jitter {:.0} ms", r.jitter_ms) } else { String::new() },
        r.bandwidth_mbit.map_or_else(String::new, |mbit| format!(", {mbit} Mbit/s")),
        r.refresh_hz,
        r.degrees_per_second,
        r.seconds,
        r.first_picture_seconds,
    );
    let spread = |s: &Spread| format!("{:>8.1} {:>8.1} {:>8.1}", s.mean, s.p50, s.p95);
    text += &format!("{:<20} {:>26} {:>26}\n", "ms", "since the stage before", "since asked");
    text += &format!(
        "{:<20} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8}\n",
        "", "mean", "p50", "p95", "mean", "p50", "p95"
    );
    for row in &r.stages {
        text += &format!("{:<20} {} {}\n", row.stage, spread(&row.step_ms), spread(&row.since_asked_ms));
    }
    text += &format!("{:<20} {}\n", "age on the screen", spread(&r.age_ms));
    text += &format!(
        "\n{:.1} new frames a second; {} begun, {} shown\n",
        r.new_frames_per_second, r.frames_begun, r.frames_shown
    );
    for lost in &r.given_up {
        text += &format!("{} given up or passed over after: {}\n", lost.frames, lost.after);
    }
    text += &format!(
        "{:.0} bytes a frame (p95 {:.0}), {:.2} MB/s\n",
        r.bytes.mean,
        r.bytes.p95,
        r.bytes_per_second / 1e6
    );
    if let Some(device) = &r.device {
        text += &format!(
            "on the device: layered frame {:.2} ms, rendering through {:.2} ms, novel view {:.2} ms\n",
            device.generate_ms, device.render_through_ms, device.novel_view_ms
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use isinglass_core::ids::{FrameId, PoseId};

    use super::*;

    #[test]
    fn spreads_are_those_of_the_values() {
        let s = Spread::of((1..=100).map(f64::from).collect());
        assert_eq!((s.mean, s.p50, s.p95), (50.5, 50.0, 95.0));
        assert_eq!(Spread::of(vec![7.0]), Spread { mean: 7.0, p50: 7.0, p95: 7.0 });
        assert_eq!(Spread::of(vec![]), Spread::default());
    }

    #[test]
    fn frames_are_lost_where_they_ended_and_those_on_their_way_are_not() {
        let life = |n: u32, upto: usize| {
            let stages = Stage::ALL[..upto].iter().enumerate();
            stages
                .fold(Life::new(FrameId(n), PoseId(n)), |life, (i, stage)| life.with(*stage, 1000 * i as u64))
        };
        let all = Stage::ALL.len();
        let lives = [life(1, all), life(2, 3), life(3, 11), life(4, all), life(5, 5)];
        let lost = given_up(&lives);
        let row = |after: Stage| GivenUp { after: after.name(), frames: 1 };
        assert_eq!(lost, [row(Stage::Generated), row(Stage::Decoded)]);
        let rows = stages(&[&lives[0], &lives[3]]);
        assert_eq!(rows.len(), all);
        assert_eq!(rows[1].step_ms.mean, 1.0);
        assert_eq!((rows[11].since_asked_ms.p95, rows[11].frames), (11.0, 2));
    }
}
