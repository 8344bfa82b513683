//! The camera path: forward, a stop, back, a stop.

use std::ops::Range;
use std::time::Duration;

use crate::view::Orbit;

/// An orbit at constant speed with a stop and a reversal.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Script {
    start: Orbit,
    degrees_per_second: f32,
    phases: [Phase; 4],
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Phase {
    seconds: f32,
    /// −1, 0 or 1.
    direction: f32,
}

impl Script {
    /// Begins at `start`. After each stop the camera rests for 1.5 s, and then for `settle`, which no mean
    /// counts: so that the picture can settle on a slow machine without flattering it.
    pub(crate) fn new(start: Orbit, degrees_per_second: f32, settle: Duration) -> Self {
        let rest = REST_SECONDS + settle.as_secs_f32();
        let phase = |seconds, direction| Phase { seconds, direction };
        let phases =
            [phase(MOVE_SECONDS, 1.0), phase(rest, 0.0), phase(MOVE_SECONDS, -1.0), phase(rest, 0.0)];
        Self { start, degrees_per_second, phases }
    }

    /// Where the camera is at a time.
    pub(crate) fn orbit_at(&self, at: Duration) -> Orbit {
        let mut left = at.as_secs_f32();
        let mut turn = 0.0;
        for phase in self.phases {
            turn += left.clamp(0.0, phase.seconds) * phase.direction * self.degrees_per_second;
            left -= phase.seconds;
        }
        self.start.turned(turn)
    }

    /// Length of the whole.
    pub(crate) fn duration(&self) -> Duration {
        Duration::from_secs_f32(self.phases.iter().map(|p| p.seconds).sum())
    }

    /// When the camera stands still.
    pub(crate) fn rests(&self) -> Vec<Range<Duration>> {
        let mut rests = Vec::new();
        let mut at = 0.0;
        for phase in self.phases {
            let end = at + phase.seconds;
            if phase.direction == 0.0 {
                rests.push(Duration::from_secs_f32(at)..Duration::from_secs_f32(end));
            }
            at = end;
        }
        rests
    }

    /// Whether a picture shown at a time counts in means: while the camera moves and for [`REST_SECONDS`] after each
    /// stop.
    pub(crate) fn is_counted(&self, at: Duration) -> bool {
        let counted_rest = Duration::from_secs_f32(REST_SECONDS);
        self.is_moving(at)
            || self.rests().iter().any(|rest| rest.contains(&at) && at < rest.start + counted_rest)
    }

    /// Whether the camera moves at a time.
    pub(crate) fn is_moving(&self, at: Duration) -> bool {
        at < self.duration() && !self.rests().iter().any(|rest| rest.contains(&at))
    }
}

const MOVE_SECONDS: f32 = 2.0;
/// Counted part of a rest.
const REST_SECONDS: f32 = 1.5;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_path_turns_stops_returns_and_stops() {
        let script = Script::new(Orbit::default(), 30.0, Duration::from_millis(500));
        let azimuth = |s: f32| script.orbit_at(Duration::from_secs_f32(s)).azimuth_degrees - 30.0;
        // Sums of a few single-precision products of the order of 60.
        let near = |a: f32, b: f32| assert!((a - b).abs() < 1e-3, "{a} {b}");
        near(azimuth(1.0), 30.0);
        near(azimuth(2.0), 60.0);
        near(azimuth(3.9), 60.0);
        near(azimuth(5.0), 30.0);
        near(azimuth(100.0), 0.0);
        near(script.duration().as_secs_f32(), 8.0);
        let moving = |s: f32| script.is_moving(Duration::from_secs_f32(s));
        assert!(moving(0.0) && moving(1.9) && !moving(2.1) && !moving(3.9) && moving(4.1) && !moving(7.0));
        assert!(!moving(9.0));
        let counted = |s: f32| script.is_counted(Duration::from_secs_f32(s));
        assert!(
            counted(1.0) && counted(3.4) && !counted(3.6) && counted(4.1) && counted(7.4) && !counted(7.6)
        );
    }
}
