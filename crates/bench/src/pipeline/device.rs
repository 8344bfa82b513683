//! The pipeline's work by the device's own clock.

use std::sync::Arc;
use std::time::Duration;

use isinglass_core::layer::FrameHeader;
use isinglass_gpu::GpuError;
use isinglass_render::Backend;
use serde::Serialize;

use crate::demo::DemoOptions;
use crate::error::BenchError;
use isinglass_formats::OpenedScene;

/// Medians over a few turns of the camera, by timestamps, ms.
#[derive(Clone, Debug, Serialize)]
pub struct DeviceTimes {
    /// A layered frame.
    pub generate_ms: f64,
    /// A rendering that does not stop at opaque matter, for comparison.
    pub render_through_ms: f64,
    /// A novel view, turned by some degrees.
    pub novel_view_ms: f64,
}

/// `None` without a device or its clock.
pub(super) fn measure(
    demo: &DemoOptions,
    opened: OpenedScene,
    backend: &Backend,
) -> Result<Option<DeviceTimes>, BenchError> {
    let Backend::Gpu(gpu) = backend else { return Ok(None) };
    let bounds = opened.scene.volume.bounds();
    let mut renderer = backend.renderer(opened.scene)?;
    let (mut generate, mut through, mut view) = (Vec::new(), Vec::new(), Vec::new());
    for turn in 0..TURNS {
        let camera = |degrees: f32| demo.orbit.turned(degrees).camera(demo.intrinsics, &bounds);
        let at = camera(turn as f32 * STEP_DEGREES);
        let header = FrameHeader { mode: demo.mode, ..FrameHeader::alone(at, demo.k) };
        let (frame, time) = gpu.timed::<_, GpuError>(|| renderer.generate(header))?;
        let Some(time) = time else { return Ok(None) };
        generate.push(time);
        through.extend(gpu.timed::<_, GpuError>(|| renderer.render_through(&at))?.1);
        let mut caster = backend.reprojector(Arc::new(frame), &bounds)?;
        let aside = camera((turn as f32 + 1.0) * STEP_DEGREES);
        view.extend(gpu.timed::<_, GpuError>(|| caster.raycast(&aside))?.1);
    }
    let median = |mut times: Vec<Duration>| {
        times.sort_unstable();
        times.get(times.len() / 2).map_or(0.0, |time| time.as_secs_f64() * 1e3)
    };
    Ok(Some(DeviceTimes {
        generate_ms: median(generate),
        render_through_ms: median(through),
        novel_view_ms: median(view),
    }))
}

/// Number of frames, and degrees between them.
const TURNS: usize = 9;
const STEP_DEGREES: f32 = 5.0;
