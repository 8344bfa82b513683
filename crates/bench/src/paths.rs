//! Camera paths recorded from the viewer's window, for measurements with realistic hands.

use isinglass_client::{CameraPath, CameraPathError};

/// A path by its name, if it exists.
pub fn builtin(name: &str) -> Option<Result<CameraPath, CameraPathError>> {
    PATHS.iter().find(|(known, _)| *known == name).map(|(_, text)| CameraPath::parse(text))
}

/// The names that [`builtin`] knows.
pub fn names() -> impl Iterator<Item = &'static str> {
    PATHS.iter().map(|(name, _)| *name)
}

/// A program moved the mouse: bowed strokes of minimum jerk, with a pixel's tremor, at 50 events a second.
const PATHS: [(&str, &str); 3] = [
    // One slow drag with stops in it.
    ("stops", include_str!("../paths/stops.path")),
    // Fast drags of a quarter of a second, released at the end.
    ("flicks", include_str!("../paths/flicks.path")),
    // The wheel in and out, a pan, a drag and a zoom by dragging.
    ("zoom-pan", include_str!("../paths/zoom-pan.path")),
];

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use glam::Vec3;
    use isinglass_core::camera::Intrinsics;
    use isinglass_core::space::Aabb;

    use super::*;

    /// Every path is read, moves in the way that its name says, and rests at its end.
    #[test]
    fn every_path_is_what_its_name_says() {
        let bounds = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };
        let intrinsics = Intrinsics::perspective(8, 8, 0.7);
        for name in names() {
            let path = builtin(name).unwrap().unwrap();
            let seconds = path.duration().as_secs_f32();
            assert!((4.0..15.0).contains(&seconds), "{name}: {seconds} s");
            let at = |s: f32| path.pose_at(Duration::from_secs_f32(s), &intrinsics, &bounds).unwrap();
            let steps =
                || (0..(seconds * 20.0) as u32).map(|i| (at(i as f32 * 0.05), at(i as f32 * 0.05 + 0.05)));
            let fastest =
                steps().map(|(a, b)| a.world_from_view.angle_between(b.world_from_view)).fold(0.0, f32::max);
            let distances = || steps().map(|(a, _)| a.eye.length());
            let zoom = distances().fold(0.0, f32::max) / distances().fold(f32::INFINITY, f32::min);
            // Radians in 50 ms: 2.5 a second is more than a slow hand turns and less than a fast one.
            assert_eq!(fastest > 0.125, name == "flicks", "{name}: {fastest}");
            assert_eq!(zoom > 1.2, name == "zoom-pan", "{name}: {zoom}");
            assert!(steps().filter(|(a, b)| a == b).count() > 5, "{name} rests at times");
        }
        assert!(builtin("nothing").is_none());
    }
}
