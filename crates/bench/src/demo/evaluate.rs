//! Makes the pictures that were displayed, and compares them with the truth.

use isinglass_core::image_error::{ImageError, compare};
use isinglass_core::kernels::march::Scene;
use isinglass_core::layer::LayeredFrame;
use isinglass_formats::png::Rgb8;
use isinglass_render::Backend;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::DemoOptions;
use super::play::Played;
use crate::error::BenchError;
use crate::progress::Progress;

/// Results of the comparison.
#[derive(Clone, Debug, Default)]
pub(crate) struct Evaluation {
    /// The pictures in order of time.
    pub(crate) pictures: Vec<Evaluated>,
    /// Times of pictures from one prepared frame, ms.
    pub(crate) view_ms: Vec<f64>,
    /// Pictures to look at.
    pub(crate) samples: Vec<Sample>,
}

/// The errors of one displayed picture.
#[derive(Clone, Debug)]
pub(crate) struct Evaluated {
    pub(crate) at: Duration,
    pub(crate) azimuth_degrees: f32,
    /// Displayed picture against the truth.
    pub(crate) shown: ImageError,
    /// The newest server image, unchanged, against the truth.
    pub(crate) last_image: ImageError,
    pub(crate) frame_age: Option<Duration>,
}

/// Displayed picture, truth and last server image at one time.
#[derive(Clone, Debug)]
pub(crate) struct Sample {
    pub(crate) at: Duration,
    pub(crate) azimuth_degrees: f32,
    pub(crate) pictures: [Rgb8; 3],
}

/// Casts each kept frame from its recorded camera and renders the truth.
pub(crate) fn evaluate(
    backend: &Backend,
    scene: Scene,
    options: &DemoOptions,
    played: &Played,
) -> Result<Evaluation, BenchError> {
    let bounds = scene.volume.bounds();
    let mut renderer = backend.renderer(scene)?;
    let kept: Vec<_> = played.ticks.iter().filter_map(|t| Some((t, t.kept.as_ref()?))).collect();
    let mut progress = Progress::new("comparing", kept.len() as u64);
    let num_counted = kept.iter().filter(|(tick, _)| played.script.is_counted(tick.at)).count();
    let sample_stride = num_counted.div_ceil(NUM_SAMPLES).max(1);
    let mut evaluation = Evaluation::default();
    let (width, height) = (options.intrinsics.width as usize, options.intrinsics.height as usize);
    for (number, (tick, frame)) in kept.into_iter().enumerate() {
        let frame = &frame.frame;
        let rgb = |picture| Rgb8::of(&picture, [0; 3]);
        let shown = rgb(match options.rival.as_ref().and_then(|rival| rival.show.as_ref()) {
            // Only the ray cast can combine frames.
            None if !tick.older.is_empty() => {
                let frames: Vec<&LayeredFrame> =
                    std::iter::once(frame).chain(tick.older.iter().map(|f| &f.frame)).collect();
                backend.combine(&frames, &bounds, &tick.camera)?
            }
            None => {
                let mut caster = backend.reprojector(Arc::new(frame.clone()), &bounds)?;
                let started = Instant::now();
                let picture = caster.raycast(&tick.camera)?;
                evaluation.view_ms.push(started.elapsed().as_secs_f64() * 1e3);
                picture
            }
            Some(show) => {
                let mut views = show(frame, &bounds);
                let started = Instant::now();
                let picture = views(&tick.camera);
                evaluation.view_ms.push(started.elapsed().as_secs_f64() * 1e3);
                picture
            }
        });
        let truth = rgb(renderer.render(&tick.camera)?);
        let last = frame.flatten();
        // A margin around the picture is not shown.
        let margin = frame.header.camera.intrinsics.margin_around(&tick.camera.intrinsics).unwrap_or(0);
        let last = rgb(last.cropped(margin));
        if (last.width, last.height) != (shown.width, shown.height) {
            return Err(BenchError::Demo(format!(
                "the server sent {}x{} pixels, expected {width}x{height}; ask for a smaller size",
                last.width, last.height
            )));
        }
        let errors = |a: &Rgb8, b: &Rgb8| compare(&a.bytes, &b.bytes, width, height, [0; 3]);
        evaluation.pictures.push(Evaluated {
            at: tick.at,
            azimuth_degrees: tick.azimuth_degrees,
            shown: errors(&shown, &truth)?,
            last_image: errors(&last, &truth)?,
            frame_age: tick.frame_age,
        });
        // The sample comes from the middle of each interval, as the first picture is the settled one.
        if number % sample_stride == sample_stride / 2 && played.script.is_counted(tick.at) {
            let pictures = [shown, truth, last];
            evaluation.samples.push(Sample { at: tick.at, azimuth_degrees: tick.azimuth_degrees, pictures });
        }
        progress.advance(1, "");
    }
    progress.finish();
    Ok(evaluation)
}

/// Enough to show movement, stop and reversal.
const NUM_SAMPLES: usize = 8;
