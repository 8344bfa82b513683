//! What is left of the picture when a frame rate has to be held (Gupta 2022, table 2): SSIM of the coarser cast against
//! the full cast of the same frame.
//!
//! The cast becomes as coarse as the viewer makes it: by the viewer's own controller, on the times that its choices
//! really take.

use std::time::Duration;

use isinglass_client::{Quality, QualityControl};
use isinglass_core::camera::Camera;
use isinglass_core::kernels::raycast::{CastOptions, Reconstruction};
use isinglass_core::picture::Picture;
use serde::Serialize;

use super::tasks::{Tasks, error_between};
use crate::choices::reconstruction_name;
use crate::error::BenchError;
use crate::rivals::stretch;
use crate::scenes::SceneSource;

/// One frame rate.
#[derive(Clone, Debug, Serialize)]
pub struct TargetRow {
    /// Name of the scene.
    pub scene: String,
    /// Where the kernels ran.
    pub backend: String,
    /// Layering rule.
    pub method: &'static str,
    /// How lists were read.
    pub reconstruction: &'static str,
    /// K of the rule.
    pub k: u8,
    /// Columns and rows of lists.
    pub frame_size: [u32; 2],
    /// Turn of the novel view.
    pub angle_deg: f32,
    /// Frames a second that were asked for.
    pub target_fps: f32,
    /// Side of the picture that is cast, in units of the one that is shown.
    pub scale: f32,
    /// Time of such a cast, on the device where it has a clock.
    pub novel_view_ms: f64,
    /// Frames a second that it makes.
    pub fps: f64,
    /// SSIM against the full cast.
    pub ssim: f64,
    /// SSIM against the full rendering.
    pub ssim_truth: f64,
}

/// All frame rates that are asked for, on all frames that are ray-cast, at all turns.
pub(super) fn measure(
    tasks: &mut Tasks<'_>,
    source: &SceneSource,
    rows: &mut Vec<TargetRow>,
) -> Result<(), BenchError> {
    let (backend, options) = (tasks.backend, tasks.options);
    if options.target_fps.is_empty() {
        return Ok(());
    }
    for (angle, camera) in tasks.turned.clone().into_iter().enumerate() {
        let truth = tasks.truth(angle)?;
        let readings = |frame| options.reconstructions.iter().map(move |&reading| (frame, reading));
        for (frame, reconstruction) in (0..tasks.frames.len()).flat_map(readings) {
            let mut scale = Scale { tasks, frame, reconstruction, camera };
            let Some((full, _)) = scale.cast(Quality::FULL)? else { continue };
            for &target_fps in &options.target_fps {
                let quality = scale.by_control(target_fps)?;
                let Some((shown, ms)) = scale.cast_thrice(quality)? else { continue };
                rows.push(TargetRow {
                    scene: source.name.clone(),
                    backend: backend.description(),
                    method: scale.tasks.frames[frame].rule.name(),
                    reconstruction: reconstruction_name(reconstruction),
                    k: scale.tasks.frames[frame].k(),
                    frame_size: scale.tasks.frames[frame].size(),
                    angle_deg: options.subject.angles_degrees[angle],
                    target_fps,
                    scale: quality.scale,
                    novel_view_ms: ms,
                    fps: 1e3 / ms,
                    ssim: error_between(&shown, &full)?.ssim,
                    ssim_truth: error_between(&shown, &truth)?.ssim,
                });
            }
        }
    }
    Ok(())
}

/// A table for people.
pub(super) fn table(rows: &[TargetRow]) -> String {
    let mut text = format!(
        "{:<18} {:<21} {:<7} {:>2} {:>9} {:>5} {:>6} {:>5} {:>8} {:>7} {:>6} {:>6}  {}\n",
        "scene",
        "method",
        "lists",
        "k",
        "frame",
        "turn",
        "target",
        "scale",
        "view ms",
        "fps",
        "ssim",
        "truth",
        "on"
    );
    for r in rows {
        text += &format!(
            "{:<18} {:<21} {:<7} {:>2} {:>9} {:>4.0}° {:>6.0} {:>5.2} {:>8.2} {:>7.1} {:>6.4} {:>6.4}  {}\n",
            r.scene,
            r.method,
            r.reconstruction,
            r.k,
            format!("{}x{}", r.frame_size[0], r.frame_size[1]),
            r.angle_deg,
            r.target_fps,
            r.scale,
            r.novel_view_ms,
            r.fps,
            r.ssim,
            r.ssim_truth,
            r.backend
        );
    }
    text
}

/// One frame from one camera, cast more or less coarsely.
struct Scale<'a, 'b> {
    tasks: &'a mut Tasks<'b>,
    frame: usize,
    reconstruction: Reconstruction,
    camera: Camera,
}

impl Scale<'_, '_> {
    /// The picture as it would be shown, and the milliseconds of the cast; none if the frame is not ray-cast. Enlarging
    /// is left to the display, as the viewer does it.
    fn cast(&mut self, quality: Quality) -> Result<Option<(Picture, f64)>, BenchError> {
        let smaller = quality.size_of(self.camera.intrinsics);
        let camera = Camera { intrinsics: smaller, ..self.camera };
        let cast = CastOptions { reconstruction: self.reconstruction, ..CastOptions::default() };
        let made = self.tasks.cast(self.frame, &camera, &cast)?;
        Ok(made.map(|(picture, time)| (stretch(&picture, &smaller, &self.camera), time.best())))
    }

    /// The same with the least of three times.
    fn cast_thrice(&mut self, quality: Quality) -> Result<Option<(Picture, f64)>, BenchError> {
        let Some((picture, mut ms)) = self.cast(quality)? else { return Ok(None) };
        for _ in 0..2 {
            ms = self.cast(quality)?.map_or(ms, |(_, again)| ms.min(again));
        }
        Ok(Some((picture, ms)))
    }

    /// Where the viewer's controller comes to rest while the camera moves.
    fn by_control(&mut self, target_fps: f32) -> Result<Quality, BenchError> {
        let mut control = QualityControl::new(target_fps);
        // One frame is measured: there are no kept ones.
        let chosen = |control: &QualityControl| Quality { keeps: false, ..control.quality(true) };
        let mut now = Duration::ZERO;
        let mut num_casts_here = 0;
        for _ in 0..MAX_CASTS {
            let quality = chosen(&control);
            // A cast that something else on the machine held up would count as long as the controller remembers.
            let ms = self.cast_thrice(quality)?.map_or(0.0, |(_, ms)| ms);
            let time = Duration::from_secs_f64(ms * 1e-3);
            now += time.max(REFRESH);
            control.handle_cast(now, quality, time);
            num_casts_here = if chosen(&control) == quality { num_casts_here + 1 } else { 0 };
            if num_casts_here >= CASTS_AT_REST {
                break;
            }
        }
        Ok(chosen(&control))
    }
}

/// What the controller's clock goes on for a cast, at least: it waits 0.4 s before it tries a finer step, and casts that
/// only pass the time would tell nothing.
const REFRESH: Duration = Duration::from_millis(100);
/// Longer than the controller waits, and than it remembers what a finer step took.
const CASTS_AT_REST: u32 = 60;
const MAX_CASTS: u32 = 200;
