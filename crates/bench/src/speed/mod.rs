//! Measures each stage of a frame's life side by side: full renderings, frames of each K, coding, and novel views at
//! each turn, with and without the empty-space grid.
//!
//! All work on one scene and backend is a list of tasks that take turns. A round runs each once, so that a busy
//! machine affects all alike. The first round does not count. Of the others the least time does, because disturbances
//! only add to it.

mod tasks;

use isinglass_render::{Backend, BackendChoice};
use serde::Serialize;

use crate::error::BenchError;
use crate::progress::Progress;
use crate::subject::{Failures, Subject, SubjectConditions, each_scene};

/// What to measure.
#[derive(Clone, Debug)]
pub struct SpeedOptions {
    /// The subject; its angles turn the novel views.
    pub subject: Subject,
    /// Backends to compare.
    pub backends: Vec<BackendChoice>,
    /// Frame sizes: columns and rows of lists.
    pub frame_sizes: Vec<[u32; 2]>,
    /// Number of rounds of which the least time counts, after one that does not.
    pub repeats: u32,
}

/// The whole result.
#[derive(Clone, Debug, Serialize)]
pub struct SpeedReport {
    /// The conditions of all rows.
    pub conditions: SpeedConditions,
    /// One row for each scene, backend, frame size, K and turn.
    pub(crate) rows: Vec<SpeedRow>,
    /// Times to prepare each volume.
    pub(crate) preparations: Vec<Preparation>,
}

/// Times to prepare a volume on a backend, seconds.
#[derive(Clone, Debug, Serialize)]
pub struct Preparation {
    pub(crate) scene: String,
    pub(crate) dims: [u32; 3],
    pub(crate) backend: String,
    /// Time to read or make the voxels.
    pub(crate) volume_seconds: f64,
    pub(crate) histogram_seconds: f64,
    /// Time for the minima and maxima of bricks.
    pub(crate) bricks_seconds: f64,
    /// Time for transfer function, visible bricks and light.
    pub(crate) look_seconds: f64,
    /// Time for the upload and the device's kernels; almost none on the CPU.
    pub(crate) upload_seconds: f64,
}

/// The conditions of all rows.
#[derive(Clone, Debug, Serialize)]
pub struct SpeedConditions {
    /// The conditions of any table of pictures.
    #[serde(flatten)]
    pub subject: SubjectConditions,
    pub(crate) repeats: u32,
    pub(crate) statistic: &'static str,
}

/// Milliseconds, with readback to the CPU. Fields called `gpu` measure only the passes by the device's timestamps,
/// and are `None` without such a clock. Ratios and rates prefer the device's times.
#[derive(Clone, Debug, Serialize)]
pub struct SpeedRow {
    pub(crate) scene: String,
    pub(crate) dims: [u32; 3],
    pub(crate) backend: String,
    /// Requested mean length of lists.
    pub(crate) k: u8,
    pub(crate) frame_size: [u32; 2],
    pub(crate) angle_deg: f32,
    /// Full rendering from the turned camera.
    pub(crate) render_ms: f64,
    pub(crate) render_gpu_ms: Option<f64>,
    /// Full rendering from the frame's camera that does not stop at opaque matter.
    pub(crate) render_through_ms: f64,
    pub(crate) render_through_gpu_ms: Option<f64>,
    pub(crate) generate_ms: f64,
    pub(crate) generate_gpu_ms: Option<f64>,
    pub(crate) encode_ms: f64,
    pub(crate) decode_ms: f64,
    /// Preparing it for views, once.
    pub(crate) prepare_ms: f64,
    pub(crate) novel_view_ms: f64,
    pub(crate) novel_view_gpu_ms: Option<f64>,
    /// Casting it without the empty-space grid.
    pub(crate) novel_view_no_grid_ms: f64,
    pub(crate) novel_view_no_grid_gpu_ms: Option<f64>,
    pub(crate) fps: f64,
    pub(crate) render_fps: f64,
    /// Novel view relative to the full rendering from the same camera.
    pub(crate) view_over_render: f64,
    /// Generation relative to the full rendering that does not stop.
    pub(crate) generate_over_through: f64,
    /// Full rendering and generation by pages of the finest level, relative to the volume in memory whole; `None` for a
    /// large volume.
    pub(crate) render_pages_over_whole: Option<f64>,
    pub(crate) generate_pages_over_whole: Option<f64>,
    /// Fraction of the time without the grid that it saves.
    pub(crate) grid_gain: f64,
    /// Fraction of the grid's cells that are empty.
    pub(crate) empty_share: f32,
    pub(crate) ssim: f64,
    pub(crate) dssim: f64,
    /// The same over the bounding rectangle of what is not background.
    pub(crate) dssim_object: f64,
    pub(crate) psnr_db: f64,
    pub(crate) bytes: usize,
    pub(crate) segments_mean: f64,
    pub(crate) segments_total: usize,
}

/// Measures.
pub fn run(options: &SpeedOptions) -> Result<SpeedReport, BenchError> {
    let (mut rows, mut preparations) = (Vec::new(), Vec::new());
    let mut failures: Failures<BenchError> = Failures::default();
    let num_runs = options.backends.len() * options.subject.scenes.len();
    for &choice in &options.backends {
        let backend = Backend::open(choice)?;
        failures.append(each_scene(&options.subject.scenes, |source| {
            // One step per round, one for the preparation and one for the pictures.
            let mut progress = Progress::new("speed", u64::from(options.repeats) + 3);
            progress.begin(&format!("{} on {}", source.name, backend.description()));
            let (mut tasks, preparation) = tasks::Tasks::open(&backend, options, source)?;
            preparations.push(preparation);
            for round in 0..=options.repeats {
                progress.advance(1, &format!("{} on {}, round {round}", source.name, choice));
                tasks.run_round(round > 0)?;
            }
            tasks.rows(source, &mut rows)?;
            progress.finish();
            if num_runs > 1 {
                crate::progress::note(&format!("measured {} on {choice}", source.name));
            }
            Ok(())
        }));
    }
    let conditions = SpeedConditions {
        subject: options.subject.conditions(rayon::current_num_threads(), failures.lines(rows.is_empty())?),
        repeats: options.repeats,
        statistic: "least of the rounds; all tasks of a scene and backend take turns",
    };
    Ok(SpeedReport { conditions, rows, preparations })
}

/// Rendering and generation by pages.
fn by_pages(r: &SpeedRow) -> String {
    let both = r.render_pages_over_whole.zip(r.generate_pages_over_whole);
    both.map_or_else(|| "-".into(), |(render, generate)| format!("{render:.2}, {generate:.2}"))
}

/// A table for people. Times on the device where it has a clock.
pub fn table(report: &SpeedReport) -> String {
    let mut text = format!(
        "{:<18} {:>2} {:>9} {:>5} {:>8} {:>8} {:>8} {:>7} {:>7} {:>7} {:>7} {:>8} {:>6} {:>6} {:>11} {:>7} {:>6} {:>9}  {}\n",
        "scene",
        "k",
        "frame",
        "turn",
        "render",
        "through",
        "generate",
        "encode",
        "decode",
        "prepare",
        "view",
        "no grid",
        "of rdr",
        "of thr",
        "by pages",
        "fps",
        "ssim",
        "bytes",
        "ms, on"
    );
    for r in &report.rows {
        text += &format!(
            "{:<18} {:>2} {:>9} {:>4.0}° {:>8.2} {:>8.2} {:>8.2} {:>7.2} {:>7.2} {:>7.2} {:>7.2} {:>8.2} {:>6.3} {:>6.2} {:>11} {:>7.1} {:>6.4} {:>9}  {}\n",
            r.scene,
            r.k,
            format!("{}x{}", r.frame_size[0], r.frame_size[1]),
            r.angle_deg,
            r.render_gpu_ms.unwrap_or(r.render_ms),
            r.render_through_gpu_ms.unwrap_or(r.render_through_ms),
            r.generate_gpu_ms.unwrap_or(r.generate_ms),
            r.encode_ms,
            r.decode_ms,
            r.prepare_ms,
            r.novel_view_gpu_ms.unwrap_or(r.novel_view_ms),
            r.novel_view_no_grid_gpu_ms.unwrap_or(r.novel_view_no_grid_ms),
            r.view_over_render,
            r.generate_over_through,
            by_pages(r),
            r.fps,
            r.ssim,
            r.bytes,
            r.backend
        );
    }
    text += "\nready after, s:\n";
    for p in &report.preparations {
        text += &format!(
            "{:<18} {}x{}x{}: volume {:.2}, histogram {:.2}, bricks {:.2}, look and light {:.2}, upload {:.2}  {}\n",
            p.scene,
            p.dims[0],
            p.dims[1],
            p.dims[2],
            p.volume_seconds,
            p.histogram_seconds,
            p.bricks_seconds,
            p.look_seconds,
            p.upload_seconds,
            p.backend
        );
    }
    text
}
