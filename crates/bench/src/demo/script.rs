//! The camera path: forward, a stop, back, a stop; or a recorded path and a stop.

use std::ops::Range;
use std::time::Duration;

use isinglass_client::CameraPath;
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::space::Aabb;

use isinglass_core::orbit::Orbit;

/// The camera's motion, without the rests that are added for measuring.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Motion {
    /// An orbit at constant speed, forward and back.
    Orbit { start: Orbit, degrees_per_second: f32 },
    /// A recorded path, unchanged.
    Recorded(CameraPath),
}

impl Motion {
    /// Where the camera begins.
    pub(crate) fn start(&self, intrinsics: &Intrinsics, bounds: &Aabb) -> Pose {
        Script::new(self.clone(), Duration::ZERO).pose_at(Duration::ZERO, intrinsics, bounds)
    }
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Script {
    motion: Motion,
    phases: Vec<Phase>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Phase {
    seconds: f32,
    /// Direction of the orbit: −1, 0 or 1. A recorded path moves while it is not 0.
    direction: f32,
}

impl Script {
    /// After each stop the camera rests for 1.5 s, and then for `settle`, which no mean counts. So the picture can
    /// settle on a slow machine without flattering it. A recorded path has one such stop, at its end.
    pub(crate) fn new(motion: Motion, settle: Duration) -> Self {
        let phase = |seconds, direction| Phase { seconds, direction };
        let rest = phase(REST_SECONDS + settle.as_secs_f32(), 0.0);
        let phases = match &motion {
            Motion::Orbit { .. } => vec![phase(MOVE_SECONDS, 1.0), rest, phase(MOVE_SECONDS, -1.0), rest],
            Motion::Recorded(path) => vec![phase(path.duration().as_secs_f32(), 1.0), rest],
        };
        Self { motion, phases }
    }

    /// The camera's pose at a time.
    pub(crate) fn pose_at(&self, at: Duration, intrinsics: &Intrinsics, bounds: &Aabb) -> Pose {
        match &self.motion {
            Motion::Orbit { start, degrees_per_second } => {
                start.turned(self.turn(at) * degrees_per_second).pose(intrinsics, bounds)
            }
            // A path has a position for every time.
            Motion::Recorded(path) => path
                .pose_at(at, intrinsics, bounds)
                .unwrap_or_else(|| Orbit::default().pose(intrinsics, bounds)),
        }
    }

    /// The azimuth at a time, for people; a pan changes it too.
    pub(crate) fn azimuth_degrees(&self, at: Duration, pose: &Pose, bounds: &Aabb) -> f32 {
        match &self.motion {
            Motion::Orbit { start, degrees_per_second } => {
                start.turned(self.turn(at) * degrees_per_second).azimuth_degrees
            }
            Motion::Recorded(_) => {
                let from_center = pose.eye - bounds.center();
                from_center.x.atan2(from_center.z).to_degrees()
            }
        }
    }

    /// Seconds of forward movement minus those of backward movement.
    fn turn(&self, at: Duration) -> f32 {
        let mut left = at.as_secs_f32();
        let mut turn = 0.0;
        for phase in &self.phases {
            turn += left.clamp(0.0, phase.seconds) * phase.direction;
            left -= phase.seconds;
        }
        turn
    }

    pub(crate) fn duration(&self) -> Duration {
        Duration::from_secs_f32(self.phases.iter().map(|p| p.seconds).sum())
    }

    pub(crate) fn rests(&self) -> Vec<Range<Duration>> {
        let mut rests = Vec::new();
        let mut at = 0.0;
        for phase in &self.phases {
            let end = at + phase.seconds;
            if phase.direction == 0.0 {
                rests.push(Duration::from_secs_f32(at)..Duration::from_secs_f32(end));
            }
            at = end;
        }
        rests
    }

    /// Whether a picture displayed at a time counts in means: during movement and for [`REST_SECONDS`] after each
    /// stop.
    pub(crate) fn is_counted(&self, at: Duration) -> bool {
        let counted_rest = Duration::from_secs_f32(REST_SECONDS);
        self.is_moving(at)
            || self.rests().iter().any(|rest| rest.contains(&at) && at < rest.start + counted_rest)
    }

    /// How long the camera moves in all.
    pub(crate) fn moving(&self) -> Duration {
        let rests: Duration = self.rests().into_iter().map(|rest| rest.end - rest.start).sum();
        self.duration().saturating_sub(rests)
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
        let motion = Motion::Orbit { start: Orbit::default(), degrees_per_second: 30.0 };
        let script = Script::new(motion, Duration::from_millis(500));
        let intrinsics = Intrinsics::perspective(8, 8, 0.7);
        let bounds = Aabb { min: glam::Vec3::NEG_ONE, max: glam::Vec3::ONE };
        let azimuth = |s: f32| {
            let at = Duration::from_secs_f32(s);
            let pose = script.pose_at(at, &intrinsics, &bounds);
            let azimuth = script.azimuth_degrees(at, &pose, &bounds);
            let expect = Orbit { azimuth_degrees: azimuth, ..Orbit::default() }.pose(&intrinsics, &bounds);
            assert!((pose.eye - expect.eye).length() < 1e-3);
            azimuth - 30.0
        };
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

    #[test]
    fn a_recorded_path_is_played_as_it_is_and_then_rests() {
        let path = CameraPath::parse("5 10 20\n6 40 20\n8 40 20\n").unwrap();
        let script = Script::new(Motion::Recorded(path.clone()), Duration::from_secs(1));
        assert_eq!(script.duration(), Duration::from_secs_f32(5.5));
        assert_eq!(script.rests().len(), 1);
        let intrinsics = Intrinsics::perspective(8, 8, 0.7);
        let bounds = Aabb { min: glam::Vec3::NEG_ONE, max: glam::Vec3::ONE };
        for s in [0.0, 0.3, 2.5, 5.0] {
            let at = Duration::from_secs_f32(s);
            let pose = script.pose_at(at, &intrinsics, &bounds);
            assert_eq!(Some(pose), path.pose_at(at, &intrinsics, &bounds));
            assert_eq!((script.is_moving(at), script.is_counted(at)), (s < 3.0, s < 4.5));
        }
        let pose = script.pose_at(Duration::from_secs(9), &intrinsics, &bounds);
        assert!((script.azimuth_degrees(Duration::from_secs(9), &pose, &bounds) - 40.0).abs() < 1e-3);
    }
}
