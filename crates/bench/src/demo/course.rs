//! Leads a viewer's camera along a path in real time.

use std::time::{Duration, Instant};

use isinglass_client::{DisplayRecord, HeadlessViewer, Standing};
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_net::{Client, State};

use super::script::{Motion, Script};
use crate::error::BenchError;
use crate::progress::Progress;

/// Where the camera goes, and how often the display refreshes.
pub(crate) struct Course {
    pub(crate) motion: Motion,
    pub(crate) intrinsics: Intrinsics,
    pub(crate) refresh_hz: f32,
    /// Longest wait for the first whole picture.
    pub(crate) patience: Duration,
    pub(crate) shows_progress: bool,
}

/// A refresh of the display.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Moment {
    /// Counts the periods of the display.
    pub(crate) number: usize,
    /// Time since the camera began to move.
    pub(crate) at: Duration,
    /// Azimuth according to the script.
    pub(crate) azimuth_degrees: f32,
    pub(crate) input: Pose,
}

impl Course {
    /// Holds the camera where it begins until a whole picture is there. `see` gets what each refresh shows.
    pub(crate) fn begin(
        &self,
        viewer: &mut HeadlessViewer<Client>,
        mut see: impl FnMut(DisplayRecord) -> Result<(), BenchError>,
    ) -> Result<Script, BenchError> {
        let asked = Instant::now();
        loop {
            let mut is_settled = false;
            if let Some(bounds) = viewer.bounds() {
                viewer.tick(now(viewer), self.motion.start(&self.intrinsics, &bounds));
                for record in viewer.take_records() {
                    is_settled |= matches!(record.standing, Standing::Exact | Standing::Settled);
                    see(record)?;
                }
            }
            if is_settled {
                break;
            }
            check_server(viewer, LONGEST_LOSS)?;
            if asked.elapsed() > self.patience {
                check_server(viewer, Duration::ZERO)?;
                let seconds = self.patience.as_secs();
                return Err(BenchError::Demo(format!(
                    "no whole picture came within {seconds} s, expected one; the machine may be too slow"
                )));
            }
            std::thread::sleep(self.interval());
        }
        // At a stop, the frame for the rest may have to wait for one of an older pose.
        let settle = asked.elapsed().min(MAX_SETTLE).mul_f32(1.5);
        Ok(Script::new(self.motion.clone(), settle))
    }

    /// Plays the script. A refresh that takes longer than its period costs the next ones, as on a display.
    ///
    /// # Errors
    /// Those of `see`, and if the server is lost for long or at the end, or cannot read its volume any more.
    pub(crate) fn play(
        &self,
        script: &Script,
        viewer: &mut HeadlessViewer<Client>,
        mut see: impl FnMut(&Moment, &mut HeadlessViewer<Client>, DisplayRecord) -> Result<(), BenchError>,
    ) -> Result<(), BenchError> {
        let bounds = viewer.bounds().ok_or_else(|| BenchError::Demo("the volume is gone".into()))?;
        let num_periods = self.num_periods(script);
        let mut progress = self.shows_progress.then(|| Progress::new("playing", num_periods as u64));
        let interval = self.interval();
        let start = Instant::now();
        let mut number = 0;
        while number < num_periods {
            std::thread::sleep((interval * number as u32).saturating_sub(start.elapsed()));
            let at = start.elapsed();
            let input = script.pose_at(at, &self.intrinsics, &bounds);
            let azimuth_degrees = script.azimuth_degrees(at, &input, &bounds);
            viewer.tick(now(viewer), input);
            check_server(viewer, LONGEST_LOSS)?;
            for record in viewer.take_records() {
                see(&Moment { number, at, azimuth_degrees, input }, viewer, record)?;
            }
            let next = next_period(number, interval, start.elapsed());
            if let Some(progress) = &mut progress {
                progress.advance((next - number) as u64, "");
            }
            number = next;
        }
        if let Some(progress) = progress {
            progress.finish();
        }
        // A server that has just died is silent at first.
        let end = Instant::now();
        while viewer.source().stats().is_silent() && end.elapsed() < LONGEST_LOSS {
            std::thread::sleep(interval);
        }
        check_server(viewer, Duration::ZERO)
    }

    pub(crate) fn num_periods(&self, script: &Script) -> usize {
        (script.duration().as_secs_f32() * self.refresh_hz).ceil() as usize
    }

    pub(crate) fn interval(&self) -> Duration {
        Duration::from_secs_f32(1.0 / self.refresh_hz)
    }
}

/// Whether the server still shows its volume: it has not been away for longer than `longest`, and reads all that is seen.
fn check_server(viewer: &HeadlessViewer<Client>, longest: Duration) -> Result<(), BenchError> {
    let client = viewer.source();
    let lost = |problem: String| Err(BenchError::Demo(format!("the server is lost: {problem}")));
    match client.state() {
        State::Refused(problem) => return lost(problem.to_string()),
        State::Reconnecting { since_micros, problem, .. }
            if Duration::from_micros(client.clock().now_micros().saturating_sub(since_micros)) >= longest =>
        {
            return lost(problem.to_string());
        }
        State::Connecting { problem: Some(problem), .. } if longest.is_zero() => {
            return lost(problem.to_string());
        }
        State::Connected if longest.is_zero() && client.stats().is_silent() => {
            return lost("it does not answer".into());
        }
        State::Connected | State::Connecting { .. } | State::Reconnecting { .. } => {}
    }
    match client.talk().pages.progress().filter(|pages| pages.num_damaged > 0) {
        None => Ok(()),
        Some(pages) => Err(BenchError::Demo(format!(
            "the server cannot read {} of {} parts of its volume that are seen, expected all",
            pages.num_damaged, pages.num_wanted
        ))),
    }
}

/// The period after `number` that has not begun when `elapsed` has passed.
fn next_period(number: usize, interval: Duration, elapsed: Duration) -> usize {
    let begun = (elapsed.as_secs_f64() / interval.as_secs_f64()) as usize;
    begun.max(number) + 1
}

fn now(viewer: &HeadlessViewer<Client>) -> Duration {
    Duration::from_micros(viewer.source().clock().now_micros())
}

/// Longest time without a server while a path is played.
const LONGEST_LOSS: Duration = Duration::from_secs(10);
/// Longest time for a picture to settle.
const MAX_SETTLE: Duration = Duration::from_secs(5);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slow_refresh_costs_the_next_ones() {
        let (ms, period) = (Duration::from_millis, Duration::from_millis(10));
        assert_eq!([0, 3, 9].map(|elapsed| next_period(0, period, ms(elapsed))), [1, 1, 1]);
        assert_eq!(next_period(4, period, ms(45)), 5);
        // It took 2.7 periods: the display was refreshed with the older picture twice.
        assert_eq!(next_period(4, period, ms(67)), 7);
    }
}
