//! The figures of a demonstration, its files and its text.

use std::path::{Path, PathBuf};

use isinglass_core::camera::{Camera, Pose};
use isinglass_formats::png::Rgb8;
use isinglass_formats::{Selection, write_whole};
use isinglass_render::Backend;
use serde::Serialize;

use super::evaluate::{Evaluated, Evaluation};
use super::play::{Played, Tick};
use super::script::Script;
use super::shown::{ShownFrames, moving, percentile};
use super::{DemoOptions, plot};
use crate::error::BenchError;

/// The figures in `report.json`. Means of DSSIM are over the pictures compared while the camera moved and for 1.5 s
/// after each stop. The first frame was on the screen before the camera moved.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    pub(crate) source: String,
    pub(crate) part: Selection,
    pub(crate) size: [u32; 2],
    /// Method of the pictures: `layers`, or a rival.
    pub(crate) method: String,
    /// Requested mean length of lists.
    pub(crate) k: u8,
    pub(crate) codec: &'static str,
    pub(crate) quality: u8,
    pub(crate) degrees_per_second: f32,
    /// Whether a recorded path replaced the orbit, whose speed then does not matter.
    pub(crate) plays_path: bool,
    pub(crate) seed: u64,
    /// Round-trip delay of the link.
    pub(crate) rtt_ms: f64,
    /// Greatest additional delay, each way.
    pub(crate) jitter_ms: f64,
    /// Fraction of packets lost, each way.
    pub(crate) loss: f64,
    /// Rate of the link each way; `None` for unlimited.
    pub(crate) bandwidth_mbit: Option<f64>,
    pub(crate) backend: String,
    /// Displayed pictures, one per refresh.
    pub(crate) frames_shown: usize,
    pub(crate) dssim_shown_mean: f64,
    pub(crate) dssim_shown_p95: f64,
    /// Mean DSSIM of the newest server image at the same moments, displayed unchanged.
    pub(crate) dssim_last_image_mean: f64,
    /// Most refreshes from an input to the first picture with that camera. It counts late choices of the camera, and
    /// refreshes that pass while a picture is made, by its median time.
    pub(crate) pose_lag_frames_max: usize,
    /// Median time for a picture of one prepared frame, measured after playing.
    pub(crate) novel_view_ms: f64,
    /// Ages, rate and freezes of frames.
    #[serde(flatten)]
    pub(crate) shown: ShownFrames,
    /// Mean angle between the displayed frame's pose and that of the picture, while the camera moved.
    pub(crate) frame_turned_deg_mean: f64,
    /// Whether frames were requested for the predicted pose.
    pub(crate) predict: bool,
    pub(crate) guard_band: bool,
    /// Whether older frames filled what the newest lacked.
    pub(crate) kept_frames: bool,
    /// Mean size of the displayed server frames, as far as they had arrived when the next one replaced them.
    pub(crate) bytes_per_frame_mean: f64,
    /// Greatest difference between the picture at the end of a rest and a full rendering by the server's renderer.
    pub(crate) rest_max_abs_255: u8,
}

impl Report {
    pub(super) fn of(
        options: &DemoOptions,
        backend: &Backend,
        played: &Played,
        evaluation: &Evaluation,
    ) -> Self {
        let script = &played.script;
        let counted: Vec<&Evaluated> =
            evaluation.pictures.iter().filter(|p| script.is_counted(p.at)).collect();
        let mean = |of: &dyn Fn(&Evaluated) -> f64| {
            counted.iter().map(|p| of(p)).sum::<f64>() / counted.len().max(1) as f64
        };
        let turns: Vec<f64> =
            moving(script, &played.ticks).filter_map(|t| Some(t.turned_degrees?.into())).collect();
        let link = &options.link;
        let novel_view_ms = percentile(evaluation.view_ms.clone(), 0.5);
        let refreshes_a_view = (novel_view_ms * 1e-3 * f64::from(options.refresh_hz)) as usize;
        Self {
            source: options.source.clone(),
            part: options.selection,
            size: [options.intrinsics.width, options.intrinsics.height],
            method: options.rival.as_ref().map_or_else(|| "layers".to_owned(), |rival| rival.name.clone()),
            k: options.k,
            codec: options.plan.mode.name(),
            quality: options.plan.quality,
            degrees_per_second: options.degrees_per_second,
            plays_path: options.path.is_some(),
            seed: link.seed,
            rtt_ms: link.rtt.as_secs_f64() * 1e3,
            jitter_ms: link.jitter.as_secs_f64() * 1e3,
            loss: link.loss,
            bandwidth_mbit: link.bandwidth_mbit,
            backend: backend.description(),
            frames_shown: played.ticks.len(),
            dssim_shown_mean: mean(&|p| p.shown.dssim),
            dssim_shown_p95: percentile(counted.iter().map(|p| p.shown.dssim).collect(), 0.95),
            dssim_last_image_mean: mean(&|p| p.last_image.dssim),
            pose_lag_frames_max: pose_lag(&played.ticks) + refreshes_a_view,
            novel_view_ms,
            shown: ShownFrames::of(script, &played.ticks, link.rtt),
            frame_turned_deg_mean: turns.iter().sum::<f64>() / turns.len().max(1) as f64,
            predict: options.foresight.predicts,
            guard_band: options.foresight.guards,
            kept_frames: options.foresight.keeps,
            bytes_per_frame_mean: bytes_per_frame(&played.ticks),
            rest_max_abs_255: rest_pictures(script, &evaluation.pictures)
                .map(|p| p.shown.max_abs_255)
                .max()
                .unwrap_or(u8::MAX),
        }
    }
}

/// Writes all files, each whole or not at all. The report comes last, so that its existence proves the others.
pub(super) fn write(
    out: &Path,
    report: &Report,
    script: &Script,
    evaluation: &Evaluation,
) -> Result<Vec<PathBuf>, BenchError> {
    let mut files = Vec::new();
    for sample in &evaluation.samples {
        let name = format!("t{:04.1}s-az{:+06.1}.png", sample.at.as_secs_f32(), sample.azimuth_degrees);
        let [shown, truth, last] = &sample.pictures;
        files.push(out.join(name));
        beside(&[shown, truth, last]).write(&files[files.len() - 1])?;
    }
    let text_file = |name: &str, text: String| {
        let path = out.join(name);
        write_whole(&path, text.as_bytes()).map(|()| path)
    };
    files.push(text_file("dssim.svg", plot::svg(script, evaluation)?)?);
    files.push(text_file("pictures.csv", csv(evaluation))?);
    let json = serde_json::to_string_pretty(report)
        .map_err(|e| BenchError::Demo(format!("the report cannot be written: {e}")))?;
    files.push(text_file("report.json", json + "\n")?);
    Ok(files)
}

/// Pictures of the same height, from left to right with a thin grey line between them.
fn beside(pictures: &[&Rgb8]) -> Rgb8 {
    let height = pictures.iter().map(|p| p.height).min().unwrap_or(0);
    let gap = if pictures.is_empty() { 0 } else { pictures.len() as u32 - 1 };
    let width = pictures.iter().map(|p| p.width).sum::<u32>() + gap * GAP_PIXELS;
    let mut bytes = Vec::with_capacity(width as usize * height as usize * 3);
    for y in 0..height as usize {
        for (i, p) in pictures.iter().enumerate() {
            if i > 0 {
                bytes.extend([GAP_GREY; 3 * GAP_PIXELS as usize]);
            }
            let row = p.width as usize * 3;
            bytes.extend_from_slice(&p.bytes[y * row..(y + 1) * row]);
        }
    }
    Rgb8 { width, height, bytes }
}

/// A few lines for people.
pub(super) fn text(
    options: &DemoOptions,
    report: &Report,
    played: &Played,
    evaluation: &Evaluation,
    files: &[PathBuf],
) -> String {
    let ratio = report.dssim_last_image_mean / report.dssim_shown_mean.max(1e-9);
    let measured = played.round_trip.as_secs_f64() * 1e3;
    let shown = &report.shown;
    let mut text = format!(
        "{} at {}x{}, K = {}, {}, on {}\n",
        options.source,
        options.intrinsics.width,
        options.intrinsics.height,
        options.k,
        match &options.path {
            Some(_) => "a recorded path".to_owned(),
            None => format!("{:.0} degrees/s", options.degrees_per_second),
        },
        report.backend
    );
    let mut line = |name: &str, value: String| text += &format!("  {name:<22} {value}\n");
    line(
        "round trip",
        format!(
            "{:.0} ms ({measured:.0} ms measured), jitter {:.0} ms, loss {:.1} %",
            report.rtt_ms,
            report.jitter_ms,
            report.loss * 100.0
        ),
    );
    line(
        "pictures shown",
        format!(
            "{} at {:.0} Hz; the camera is at most {} behind the hand, a picture takes {:.1} ms",
            report.frames_shown, options.refresh_hz, report.pose_lag_frames_max, report.novel_view_ms
        ),
    );
    line(
        "difference shown",
        format!(
            "DSSIM {:.4} mean, {:.4} at worst but 5 % ({} pictures compared)",
            report.dssim_shown_mean,
            report.dssim_shown_p95,
            evaluation.pictures.len()
        ),
    );
    line(
        "last image unchanged",
        format!("DSSIM {:.4} mean: {ratio:.1} times as much", report.dssim_last_image_mean),
    );
    line(
        "frame on the screen",
        format!(
            "{:.0} ms old, {:.0} ms at worst but 1 %, {:.1}° away, {:.0} kB",
            shown.frame_age_ms_mean,
            shown.frame_age_ms_p99,
            report.frame_turned_deg_mean,
            report.bytes_per_frame_mean / 1e3,
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
        "at rest",
        format!(
            "the full rendering to {}/255; exact {} after the stop",
            report.rest_max_abs_255,
            shown.exact_in_words()
        ),
    );
    if let Some(folder) = files.first().and_then(|f| f.parent()) {
        text += &format!("In {}:\n", folder.display());
        for file in files {
            let name = file.file_name().unwrap_or_default().to_string_lossy();
            let what = match file.extension().and_then(|e| e.to_str()) {
                Some("png") => "shown | full rendering | last server image",
                Some("svg") => "difference over time",
                Some("csv") => "every picture compared",
                _ => "all figures",
            };
            text += &format!("  {name:<24} {what}\n");
        }
    }
    text
}

fn csv(evaluation: &Evaluation) -> String {
    let mut text =
        "time_s,azimuth_deg,dssim_shown,dssim_object_shown,psnr_db_shown,dssim_last_image,frame_age_ms\n"
            .to_owned();
    for p in &evaluation.pictures {
        let age = p.frame_age.map_or(String::new(), |a| format!("{:.1}", a.as_secs_f64() * 1e3));
        text += &format!(
            "{:.3},{:.2},{:.6},{:.6},{:.2},{:.6},{age}\n",
            p.at.as_secs_f64(),
            p.azimuth_degrees,
            p.shown.dssim,
            p.shown.dssim_object,
            p.shown.psnr_db,
            p.last_image.dssim,
        );
    }
    text
}

/// Most refreshes, over all refreshes, since the displayed camera was the input.
fn pose_lag(ticks: &[Tick]) -> usize {
    // The eye of a parallel camera is moved in front of the volume.
    let is_shown = |input: &Pose, camera: &Camera| match camera.intrinsics.projection.is_orthographic() {
        true => input.world_from_view == camera.pose.world_from_view,
        false => *input == camera.pose,
    };
    let lag =
        |i: usize| (0..=i).rev().position(|j| is_shown(&ticks[j].input, &ticks[i].camera)).unwrap_or(i + 1);
    (0..ticks.len()).map(lag).max().unwrap_or(0)
}

fn bytes_per_frame(ticks: &[Tick]) -> f64 {
    let runs = ticks.chunk_by(|a, b| a.frame == b.frame);
    let bytes: Vec<u64> = runs.filter_map(|run| Some(run.last()?.frame_bytes)).collect();
    bytes.iter().sum::<u64>() as f64 / bytes.len().max(1) as f64
}

/// The last compared picture of each rest.
fn rest_pictures<'a>(script: &Script, pictures: &'a [Evaluated]) -> impl Iterator<Item = &'a Evaluated> {
    script.rests().into_iter().filter_map(|rest| pictures.iter().rev().find(|p| rest.contains(&p.at)))
}

const GAP_PIXELS: u32 = 4;
const GAP_GREY: u8 = 96;

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use isinglass_core::camera::Intrinsics;

    use super::*;
    use crate::demo::shown::tests::ticks;

    #[test]
    fn lag_is_measured_and_not_assumed() {
        assert_eq!(pose_lag(&ticks(&[1, 2, 3, 4], 0)), 0);
        assert_eq!(pose_lag(&ticks(&[1, 2, 3, 4], 2)), 2);
        // What a parallel camera sees does not depend on how far back its eye stands.
        let parallel = |late| {
            let mut ticks = ticks(&[1, 2, 3, 4], late);
            for Tick { camera, .. } in &mut ticks {
                camera.intrinsics = Intrinsics::orthographic(8, 8, 2.0);
                camera.pose.eye += camera.pose.world_from_view * Vec3::Z;
            }
            ticks
        };
        assert_eq!([0, 2].map(|late| pose_lag(&parallel(late))), [0, 2]);
    }

    #[test]
    fn each_frame_counts_once() {
        // Frames of 100, 200 and 400 bytes.
        assert!((bytes_per_frame(&ticks(&[1, 1, 1, 2, 4, 4], 0)) - 700.0 / 3.0).abs() < 1e-9);
        assert_eq!(bytes_per_frame(&[]), 0.0);
    }
}
