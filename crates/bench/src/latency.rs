//! The headless demonstration over a table of round-trip times.

use std::path::PathBuf;
use std::time::Duration;

use isinglass_net::LinkModel;
use serde::Serialize;

use crate::demo::{DemoOptions, Report, run_headless};
use crate::error::BenchError;
use crate::progress::note;
use crate::scenes::SceneSource;

/// What to measure.
#[derive(Clone, Debug)]
pub struct LatencyOptions {
    /// The scenes, see [`crate::scenes::select`].
    pub scenes: Vec<SceneSource>,
    /// Round-trip times.
    pub rtts: Vec<Duration>,
    /// A folder for what each run writes; none: nothing is written.
    pub out: Option<PathBuf>,
    /// Everything else. Its source and round-trip time are replaced.
    pub demo: DemoOptions,
}

/// The whole result.
#[derive(Clone, Debug, Serialize)]
pub struct LatencyReport {
    /// What holds for all rows.
    pub conditions: LatencyConditions,
    /// One for each scene and round-trip time.
    pub rows: Vec<LatencyRow>,
}

/// What holds for all rows.
#[derive(Clone, Debug, Serialize)]
pub struct LatencyConditions {
    /// Version of this program.
    pub version: &'static str,
    /// Columns and rows.
    pub size: [u32; 2],
    /// Vertical field of view, degrees.
    pub fov_deg: f32,
    /// Layering rule, or the rival method that made the pictures.
    pub method: &'static str,
    /// Longest list.
    pub k: u8,
    /// Speed of the camera.
    pub degrees_per_second: f32,
    /// Pictures shown in a second.
    pub refresh_hz: f32,
    /// Threads of the CPU.
    pub threads: usize,
}

/// One run.
#[derive(Clone, Debug, Serialize)]
pub struct LatencyRow {
    /// Name of the scene.
    pub scene: String,
    /// The figures of the run.
    #[serde(flatten)]
    pub report: Report,
}

/// Measures, in real time.
pub fn run(options: &LatencyOptions) -> Result<LatencyReport, BenchError> {
    let mut rows = Vec::new();
    for scene in &options.scenes {
        for &rtt in &options.rtts {
            note(&format!("{} at {} ms", scene.name, rtt.as_millis()));
            let link = LinkModel { rtt, ..options.demo.link.clone() };
            let demo = DemoOptions { source: scene.source.clone(), link, ..options.demo.clone() };
            let name = format!("{}-{}ms", scene.name.replace([':', '/', '@'], "-"), rtt.as_millis());
            let out = options.out.as_ref().map(|out| out.join(name));
            let report = run_headless(&demo, out.as_deref())?.report;
            rows.push(LatencyRow { scene: scene.name.clone(), report });
        }
    }
    let demo = &options.demo;
    let conditions = LatencyConditions {
        version: env!("CARGO_PKG_VERSION"),
        size: [demo.intrinsics.width, demo.intrinsics.height],
        fov_deg: demo.intrinsics.fov_y.to_degrees(),
        method: demo.method.name_with(demo.layering),
        k: demo.k,
        degrees_per_second: demo.degrees_per_second,
        refresh_hz: demo.refresh_hz,
        threads: rayon::current_num_threads(),
    };
    Ok(LatencyReport { conditions, rows })
}

/// A table for people.
pub fn table(report: &LatencyReport) -> String {
    let mut text = format!(
        "{:<12} {:>7} {:>8} {:>8} {:>8} {:>6} {:>4} {:>8} {:>9} {:>7} {:>5}\n",
        "scene", "rtt ms", "shown", "p95", "last", "ratio", "lag", "age ms", "bytes", "freezes", "rest"
    );
    for row in &report.rows {
        let r = &row.report;
        text += &format!(
            "{:<12} {:>7.0} {:>8.4} {:>8.4} {:>8.4} {:>6.1} {:>4} {:>8.0} {:>9.0} {:>7} {:>5}\n",
            row.scene,
            r.rtt_ms,
            r.dssim_shown_mean,
            r.dssim_shown_p95,
            r.dssim_last_image_mean,
            r.dssim_last_image_mean / r.dssim_shown_mean.max(1e-9),
            r.pose_lag_frames_max,
            r.frame_age_ms_mean,
            r.bytes_per_frame_mean,
            r.freezes,
            r.rest_max_abs_255,
        );
    }
    text
}
