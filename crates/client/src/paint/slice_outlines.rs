//! The outlines of slices in the picture of the volume.

use egui::{Color32, Rect};
use glam::Vec3;
use isinglass_core::camera::Camera;
use isinglass_core::space::Aabb;

use super::view_aids::{Pen, faces_eye, projected};

/// Draws the outline of a slice on the faces of the volume's box. Lines on faces that look away are faint.
pub(crate) fn paint(
    pen: &Pen<'_>,
    rect: Rect,
    camera: &Camera,
    bounds: &Aabb,
    corners: &[Vec3],
    color: Color32,
) {
    let basis = camera.basis();
    for (a, b) in corners.iter().zip(corners.iter().cycle().skip(1)) {
        let strength = if is_in_front(camera, bounds, (*a + *b) * 0.5) { 0.95 } else { 0.35 };
        if let Some(ends) = projected(&basis, rect, *a, *b) {
            pen.line(ends, 1.5, color.gamma_multiply(strength));
        }
    }
}

/// Whether a point of the box lies on a face that looks at the eye.
fn is_in_front(camera: &Camera, bounds: &Aabb, point: Vec3) -> bool {
    let slack = (bounds.max - bounds.min) * 1e-3;
    (0..3).any(|axis| {
        let is_at = |side: f32| (point[axis] - side).abs() <= slack[axis];
        (is_at(bounds.min[axis]) && faces_eye(camera, bounds, axis, false))
            || (is_at(bounds.max[axis]) && faces_eye(camera, bounds, axis, true))
    })
}

#[cfg(test)]
mod tests {
    use isinglass_core::camera::{Intrinsics, Pose};

    use super::*;

    #[test]
    fn lines_on_the_near_faces_are_told_from_those_behind() {
        let bounds = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };
        let intrinsics = Intrinsics::perspective(200, 100, 0.7);
        // The eye is in front, above and to the right.
        let camera = Camera::new(Pose::orbit(Vec3::ZERO, 0.5, 0.4, 6.0), intrinsics, &bounds);
        for (point, is_near) in
            [(Vec3::Z, true), (Vec3::Y, true), (Vec3::NEG_Z, false), (Vec3::NEG_Y, false), (Vec3::ZERO, false)]
        {
            assert_eq!(is_in_front(&camera, &bounds, point), is_near, "{point}");
        }
    }
}
