//! The picture for two eyes: side by side or for red-cyan glasses, cast twice from one frame.
//!
//! The eyes look off-axis and converge at the volume's centre, which therefore lies on the screen ([`View::stereo`]).
//! Their distance is stored as the angle between them at the centre, so that depth stays comfortable while zooming.

use isinglass_core::camera::{Camera, Intrinsics, Projection};
use isinglass_core::kernels::lens::View;
use isinglass_core::space::Aabb;
pub use isinglass_formats::StereoPicture as StereoMode;

pub(crate) const MODES: [(StereoMode, &str); 3] =
    [(StereoMode::Off, "off"), (StereoMode::SideBySide, "side by side"), (StereoMode::RedCyan, "red-cyan")];

/// The mode after this one; the first follows the last.
pub(crate) fn next(mode: StereoMode) -> StereoMode {
    MODES[(mode as usize + 1) % MODES.len()].0
}

/// The picture for two eyes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stereo {
    /// How each eye gets its picture.
    pub mode: StereoMode,
    /// The angle between the eyes, seen from the volume's centre, degrees.
    pub eye_angle_degrees: f32,
}

impl Default for Stereo {
    fn default() -> Self {
        Self { mode: StereoMode::Off, eye_angle_degrees: DEFAULT_EYE_ANGLE_DEGREES }
    }
}

impl Stereo {
    /// Whether the picture is the camera's own.
    pub(crate) fn is_mono(&self) -> bool {
        self.mode == StereoMode::Off
    }

    /// The intrinsics of one eye's picture in a window with the intrinsics `window`. Half a window shows as much as
    /// the whole one across its narrower side, so that no visible volume is cut off.
    pub(crate) fn eye_intrinsics(&self, window: Intrinsics) -> Intrinsics {
        if self.mode != StereoMode::SideBySide {
            return window;
        }
        // Both eyes draw an odd column.
        let half = Intrinsics { width: window.width.div_ceil(2), ..window };
        let least = |i: &Intrinsics| {
            let (x, y) = i.half_size_at(1.0);
            x.min(y)
        };
        let wider = least(&window) / least(&half);
        let projection = match window.projection {
            Projection::Perspective { fov_y } => {
                let fov_y = 2.0 * ((fov_y * 0.5).tan() * wider).atan();
                Projection::Perspective { fov_y: fov_y.min(MAX_FOV_Y) }
            }
            Projection::Orthographic { height } => Projection::Orthographic { height: height * wider },
        };
        Intrinsics { projection, ..half }
    }

    /// What the left and the right eye see around `camera`. `bounds` is the box of the volume.
    pub fn eyes(&self, camera: &Camera, bounds: &Aabb) -> [View; 2] {
        let depth = (bounds.center() - camera.pose.eye).dot(camera.pose.forward());
        // The controls keep the centre in front of the camera; any other camera has it on the near plane.
        let focus_depth = depth.max(camera.near);
        let eye_distance = 2.0 * focus_depth * (self.eye_angle_degrees.to_radians() * 0.5).tan();
        View::from(camera).stereo(eye_distance, focus_depth)
    }

    /// The part of `rect` that belongs to the eye under the pointer; the whole unless the eyes are side by side.
    pub(crate) fn rect_at(&self, rect: egui::Rect, pointer: Option<egui::Pos2>) -> egui::Rect {
        if self.mode != StereoMode::SideBySide {
            return rect;
        }
        let (left, right) = rect.split_left_right_at_fraction(0.5);
        if pointer.is_some_and(|p| right.contains(p)) { right } else { left }
    }
}

/// The value of VTK and ParaView: about the distance of the eyes at two metres.
pub const DEFAULT_EYE_ANGLE_DEGREES: f32 = 2.0;
/// Largest angle of the panel; people cannot fuse more.
pub(crate) const MAX_EYE_ANGLE_DEGREES: f32 = 8.0;
/// Widest view, for a window that is much higher than wide, radians.
const MAX_FOV_Y: f32 = 2.8;

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use isinglass_core::camera::Pose;

    use super::*;

    const WINDOW: Intrinsics = Intrinsics::perspective(1101, 760, 0.7);

    #[test]
    fn half_a_window_shows_as_much_as_the_whole() {
        let with = |mode| Stereo { mode, ..Stereo::default() };
        for mode in [StereoMode::Off, StereoMode::RedCyan] {
            assert_eq!(with(mode).eye_intrinsics(WINDOW), WINDOW);
        }
        let side_by_side = with(StereoMode::SideBySide);
        for window in [WINDOW, Intrinsics { width: 4000, ..WINDOW }, Intrinsics { width: 600, ..WINDOW }] {
            let eye = side_by_side.eye_intrinsics(window);
            assert_eq!((eye.width, eye.height), (window.width.div_ceil(2), window.height));
            // Single precision of two tangents.
            assert!((eye.fit_distance() - window.fit_distance()).abs() < 1e-3, "{window:?} {eye:?}");
        }
        // Negative control: with the window's own angle, the volume would be cut off.
        let cut = Intrinsics { width: 551, ..WINDOW };
        assert!(cut.fit_distance() > 1.2 * WINDOW.fit_distance());
        let sliver = side_by_side.eye_intrinsics(Intrinsics::perspective(1, 8192, 2.9));
        assert!(sliver.fov_y() <= MAX_FOV_Y);
    }

    #[test]
    fn eyes_meet_at_the_centre_under_their_angle_at_any_distance() {
        let bounds = Aabb { min: Vec3::splat(-1.0), max: Vec3::splat(3.0) };
        for distance in [0.5, 5.0, 50.0] {
            let camera = Camera::new(Pose::orbit(bounds.center(), 0.4, 0.2, distance), WINDOW, &bounds);
            let stereo = Stereo { mode: StereoMode::RedCyan, eye_angle_degrees: 3.0 };
            let [left, right] = stereo.eyes(&camera, &bounds);
            let [to_left, to_right] = [left, right].map(|v| v.basis.eye - bounds.center());
            assert!((to_left.angle_between(to_right).to_degrees() - 3.0).abs() < 0.02);
            let to_the_right = (right.basis.eye - left.basis.eye).dot(camera.basis().right);
            assert!(to_the_right > 0.0, "the left eye is on the left");
            for view in [left, right] {
                let (ray, _) = view.basis.ray(550.5, 380.0);
                let nearest = ray.at((bounds.center() - ray.origin).dot(ray.dir));
                assert!((nearest - bounds.center()).length() < 1e-4 * distance.max(1.0));
            }
            let none = Stereo { eye_angle_degrees: 0.0, ..stereo };
            assert_eq!(none.eyes(&camera, &bounds), [View::from(&camera); 2]);
        }
        let away = Camera::new(Pose::orbit(bounds.center(), 0.0, 0.0, -5.0), WINDOW, &bounds);
        assert!(Stereo::default().eyes(&away, &bounds).iter().all(View::is_valid));
    }

    #[test]
    fn modes_go_around() {
        let mut mode = StereoMode::Off;
        for expected in [StereoMode::SideBySide, StereoMode::RedCyan, StereoMode::Off] {
            mode = next(mode);
            assert_eq!(mode, expected);
        }
    }
}
