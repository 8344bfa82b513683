//! By how much a viewer's camera turns from frame to frame.

use std::time::Duration;

use glam::Vec3;
use isinglass_core::camera::Pose;
use tokio::time::Instant;

/// By how much a camera has turned about the middle of the volume, degrees; none where it may have rested.
pub(crate) fn turned_deg(
    (before, then): (Pose, Instant),
    (pose, now): (Pose, Instant),
    center: Vec3,
) -> Option<f32> {
    let is_moving = before != pose && now - then < LONG_PAUSE;
    let degrees = (before.eye - center).angle_between(pose.eye - center).to_degrees();
    (is_moving && degrees.is_finite()).then_some(degrees)
}

/// Between two frames so far apart the camera may have rested.
const LONG_PAUSE: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_that_moves_has_turned_and_one_that_rested_has_not() {
        let begin = Instant::now();
        let center = Vec3::new(1.0, 0.0, 2.0);
        let at = |azimuth: f32, distance, micros| {
            (Pose::orbit(center, azimuth, 0.0, distance), begin + Duration::from_micros(micros))
        };
        let turned = turned_deg(at(0.1, 3.0, 0), at(0.2, 4.0, 50_000), center).unwrap();
        assert!((turned - 0.1f32.to_degrees()).abs() < 0.01, "{turned}");
        assert_eq!(turned_deg(at(0.1, 3.0, 0), at(0.1, 3.0, 50_000), center), None);
        assert_eq!(turned_deg(at(0.1, 3.0, 0), at(0.2, 3.0, 5_000_000), center), None);
        // An eye in the middle has no direction.
        assert_eq!(turned_deg(at(0.1, 3.0, 0), at(0.1, 0.0, 50_000), center), None);
    }
}
