//! Where the time of a frame goes: a real server, a real viewer and a slowed-down link in one process, a camera that orbits, and the
//! ledgers of both sides joined frame by frame.
//!
//! Both sides read one clock here, so the stamps of one can be subtracted from the other's. Pictures are not made while it runs, so
//! that measuring does not slow down what is measured; the device's own times are taken afterwards.

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
    /// Volume, look, link, coding and camera. The path, the method and what is compared do not matter here.
    pub demo: DemoOptions,
    /// How long to measure, after [`WARM_UP`].
    pub duration: Duration,
}

/// Measures, in real time. `trace` is written as Chrome trace events.
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

/// The camera moves for so long before it counts: a congestion window opens, estimates settle.
pub const WARM_UP: Duration = Duration::from_secs(2);
