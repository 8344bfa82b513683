//! Measures the stages of a frame: a real server, a real viewer and a slowed-down link in one process, with an
//! orbiting camera. The ledgers of both sides are joined frame by frame.
//!
//! Both sides use one clock here, so their stamps can be subtracted. No pictures are made meanwhile, so that
//! measuring does not slow the system down; the device's own times are taken afterwards.

mod device;
mod play;
mod report;
mod trace;

use std::path::Path;
use std::time::{Duration, Instant};

use isinglass_formats::{check_writable, write_whole};
use isinglass_render::Backend;

use crate::demo::DemoOptions;
use crate::error::BenchError;

pub use report::{GivenUp, PipelineReport, Spread, StageRow, table};

/// What to measure.
#[derive(Clone, Debug)]
pub struct PipelineOptions {
    /// Volume, look, link, coding and camera. The path, the method and the comparison do not matter here.
    pub demo: DemoOptions,
    /// How long to measure, after [`WARM_UP`].
    pub duration: Duration,
}

/// Measures in real time. Writes `trace` as Chrome trace events.
pub fn run(options: &PipelineOptions, trace: Option<&Path>) -> Result<PipelineReport, BenchError> {
    trace.map_or(Ok(()), check_writable)?;
    let started = Instant::now();
    let (opened, demo) = options.demo.open()?;
    let backend = Backend::open(demo.backend)?;
    let options = PipelineOptions { demo, ..options.clone() };
    let played = play::play(&options, &opened, &backend, started)?;
    let device = device::measure(&options.demo, opened, &backend)?;
    if let Some(path) = trace {
        write_whole(path, trace::chrome(&played.lives)?.as_bytes())?;
    }
    Ok(report::report(&options, &backend, &played, device))
}

/// Time of camera movement before counting, while the congestion window opens and estimates settle.
pub const WARM_UP: Duration = Duration::from_secs(2);
