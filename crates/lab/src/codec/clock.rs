//! Measures coding by the thread's CPU time, where the system reports it, so that other programs do not count.

use std::fs;
use std::time::Instant;

use crate::error::LabError;

/// Runs `body` and returns its result and milliseconds; a short run is repeated and the lesser time counts. `body`
/// must do all of its work on the calling thread.
pub(crate) fn timed<T>(body: impl Fn() -> Result<T, LabError>) -> Result<(T, f64), LabError> {
    let run = || {
        let (wall, cpu) = (Instant::now(), thread_nanos());
        let result = body()?;
        let nanos = match (cpu, thread_nanos()) {
            (Some(start), Some(end)) => end.saturating_sub(start) as f64,
            _ => wall.elapsed().as_nanos() as f64,
        };
        Ok::<_, LabError>((result, nanos * 1e-6))
    };
    let (result, ms) = run()?;
    if ms >= SHORT_MS {
        return Ok((result, ms));
    }
    let (result, again) = run()?;
    Ok((result, ms.min(again)))
}

/// CPU time of the calling thread, ns; `None` if the system does not report it.
fn thread_nanos() -> Option<u64> {
    // The system updates it when the thread yields, or else at the next tick.
    std::thread::yield_now();
    let account = fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    account.split_whitespace().next()?.parse().ok()
}

/// The clock of the first core, MHz; `None` if the system does not report it.
pub(crate) fn clock_mhz() -> Option<f64> {
    let text = fs::read_to_string("/proc/cpuinfo").ok()?;
    let line = text.lines().find(|line| line.starts_with("cpu MHz"))?;
    line.split(':').nth(1)?.trim().parse().ok().filter(|mhz| *mhz > 0.0)
}

/// Shorter runs are repeated.
const SHORT_MS: f64 = 400.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_and_errors_come_through_and_no_time_is_negative() {
        let (sum, ms) = timed(|| Ok((0..1000u64).map(std::hint::black_box).sum::<u64>())).unwrap();
        assert!(sum == 499_500 && ms >= 0.0, "{sum} {ms}");
        assert!(timed(|| Err::<(), _>(isinglass_bench::BenchError::Demo("no".into()).into())).is_err());
        assert!(clock_mhz().is_none_or(|mhz| mhz > 0.0));
    }
}
