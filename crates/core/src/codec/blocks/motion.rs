//! Motion compensation: the pixel and depth of a frame's point in another frame. It follows from the two cameras, so
//! no motion vectors are sent.
//!
//! The arithmetic is sums, products and quotients in double precision, so all machines compute the same bits.

use super::super::portable_math::tan;
use crate::camera::{Camera, Projection};
use crate::layer::DEPTH_UNITS;

/// The motion from a camera to that of a reference.
#[derive(Clone, Copy, Debug)]
pub(super) struct ReferenceMotion {
    /// With p = (x, y, 1) and view depth z, the homogeneous reference pixel and the depth are z·`linear`·p +
    /// `offset`. For parallel rays they are `linear`·p + z·`along` + `offset`.
    linear: [[f64; 3]; 4],
    along: [f64; 4],
    offset: [f64; 4],
    is_parallel: bool,
    near: f64,
    depth_per_unit: f64,
    reference_near: f64,
    reference_units_per_depth: f64,
    /// Whether the cameras are the same.
    pub(super) is_still: bool,
}

/// Motion of a point from the frame to the reference.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Shift {
    /// Pixels rightwards.
    pub(super) x: f32,
    /// Pixels downwards.
    pub(super) y: f32,
    /// Depth units.
    pub(super) z: f32,
}

impl ReferenceMotion {
    pub(super) fn new(camera: &Camera, reference: &Camera) -> Self {
        let (from, to) = (Frustum::new(camera), Frustum::new(reference));
        // Direction with view depth 1 through (x, y): forward + right (2x/w − 1) + up (1 − 2y/h). For parallel rays,
        // all but forward is the place of their origin.
        let [spread, along] = if from.is_parallel { [0.0, 1.0] } else { [1.0, 0.0] };
        let direction: [[f64; 3]; 3] = std::array::from_fn(|axis| {
            [
                2.0 * from.right[axis] / from.width,
                -2.0 * from.up[axis] / from.height,
                from.forward[axis] * spread - from.right[axis] + from.up[axis],
            ]
        });
        let rows = to.pixel_rows();
        let between: [f64; 3] = std::array::from_fn(|axis| from.eye[axis] - to.eye[axis]);
        let column = |j: usize| direction.map(|row| row[j]);
        let range = |c: &Camera| (f64::from(c.far) - f64::from(c.near)) / f64::from(DEPTH_UNITS);
        Self {
            linear: rows.map(|(row, _)| [0, 1, 2].map(|j| dot(&row, &column(j)))),
            along: rows.map(|(row, _)| dot(&row, &from.forward) * along),
            offset: rows.map(|(row, added)| dot(&row, &between) + added),
            is_parallel: from.is_parallel,
            near: camera.near.into(),
            depth_per_unit: range(camera),
            reference_near: reference.near.into(),
            reference_units_per_depth: 1.0 / range(reference),
            is_still: camera == reference,
        }
    }

    /// Motion of the point at pixel (`x`, `y`) and depth `z`, depth units. `None` if the reference does not see it.
    pub(super) fn at(&self, x: f32, y: f32, z: f32) -> Option<Shift> {
        let [x, y, z] = [x, y, z].map(f64::from);
        let depth = self.near + z * self.depth_per_unit;
        let scale = if self.is_parallel { 1.0 } else { depth };
        let at: [f64; 4] = std::array::from_fn(|i| {
            let across = (self.linear[i][0] * x + self.linear[i][1] * y + self.linear[i][2]) * scale;
            across + self.along[i] * depth + self.offset[i]
        });
        let units = (at[3] - self.reference_near) * self.reference_units_per_depth;
        let shift = [at[0] / at[2] - x, at[1] / at[2] - y, units - z];
        let is_sound = at[3] > 0.0 && shift.iter().all(|s| s.abs() < MAX_SHIFT);
        is_sound.then(|| Shift { x: shift[0] as f32, y: shift[1] as f32, z: shift[2] as f32 })
    }
}

/// A camera in double precision, with the vectors of [`crate::camera::Basis`].
struct Frustum {
    eye: [f64; 3],
    forward: [f64; 3],
    right: [f64; 3],
    up: [f64; 3],
    width: f64,
    height: f64,
    is_parallel: bool,
}

impl Frustum {
    fn new(camera: &Camera) -> Self {
        let (width, height) = (f64::from(camera.intrinsics.width), f64::from(camera.intrinsics.height));
        let (half_height, is_parallel) = match camera.intrinsics.projection {
            Projection::Perspective { fov_y } => (tan(f64::from(fov_y) * 0.5), false),
            Projection::Orthographic { height } => (f64::from(height) * 0.5, true),
        };
        let half_width = half_height * width / height;
        let [x, y, z, w] = camera.pose.world_from_view.to_array().map(f64::from);
        let rotate = |v: [f64; 3], length: f64| {
            let t = cross(&[x, y, z], &v).map(|t| 2.0 * t);
            let u = cross(&[x, y, z], &t);
            [0, 1, 2].map(|i| (v[i] + w * t[i] + u[i]) * length)
        };
        Self {
            eye: camera.pose.eye.to_array().map(f64::from),
            forward: rotate([0.0, 0.0, -1.0], 1.0),
            right: rotate([1.0, 0.0, 0.0], half_width),
            up: rotate([0.0, 1.0, 0.0], half_height),
            width,
            height,
            is_parallel,
        }
    }

    /// The rows that map a vector from the eye to its homogeneous pixel and view depth, and the constants to add.
    fn pixel_rows(&self) -> [([f64; 3], f64); 4] {
        let (x_length, y_length) = (dot(&self.right, &self.right), dot(&self.up, &self.up));
        // The weight is the view depth, or 1 for parallel rays.
        let (weight, added) = if self.is_parallel { ([0.0; 3], 1.0) } else { (self.forward, 0.0) };
        let x = [0, 1, 2].map(|i| (weight[i] + self.right[i] / x_length) * 0.5 * self.width);
        let y = [0, 1, 2].map(|i| (weight[i] - self.up[i] / y_length) * 0.5 * self.height);
        [(x, 0.5 * self.width * added), (y, 0.5 * self.height * added), (weight, added), (self.forward, 0.0)]
    }
}

fn dot(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: &[f64; 3], b: &[f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Larger motions are useless: they exceed the largest picture and the depth range.
const MAX_SHIFT: f64 = 1e6;

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::camera::{Intrinsics, Pose};
    use crate::layer::depth_to_units;
    use crate::space::Aabb;

    fn camera(azimuth: f32) -> Camera {
        let bounds = Aabb { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) };
        let intrinsics = Intrinsics::perspective(320, 200, 0.7);
        Camera::new(Pose::orbit(Vec3::ZERO, azimuth, 0.2, 5.0), intrinsics, &bounds)
    }

    #[test]
    fn points_move_as_the_cameras_say() {
        let (from, to) = (camera(0.3), camera(0.36));
        let motion = ReferenceMotion::new(&from, &to);
        let basis = to.basis();
        let mut moved: f32 = 0.0;
        for (x, y, z) in [(12.5, 80.0, 20_000.0), (160.0, 100.0, 40_000.0), (300.0, 10.0, 33_000.0)] {
            let (ray, per_depth) = from.ray(x, y);
            let depth = from.near + z * (from.far - from.near) / DEPTH_UNITS;
            let h = basis.pixel_from_point(ray.at(depth * per_depth));
            let shift = motion.at(x, y, z).unwrap();
            // Single precision over coordinates of some hundred pixels and ten thousands of units.
            assert!((h.x / h.z - x - shift.x).abs() < 1e-2 && (h.y / h.z - y - shift.y).abs() < 1e-2);
            assert!((depth_to_units(&to, h.z) - z - shift.z).abs() < 0.1);
            moved = moved.max(shift.x.abs());
        }
        assert!(moved > 1.0);
        let still = ReferenceMotion::new(&from, &from).at(100.0, 50.0, 30_000.0).unwrap();
        // A rotation of single precision is off by some 1e-7, of coordinates up to 320 and of 65535 units.
        assert!(still.x.abs() < 1e-3 && still.y.abs() < 1e-3 && still.z.abs() < 0.1, "{still:?}");
    }

    #[test]
    fn what_the_reference_cannot_see_does_not_move() {
        let (from, mut to) = (camera(0.0), camera(0.0));
        to.pose = Pose::orbit(Vec3::ZERO, std::f32::consts::PI, 0.0, -20.0);
        assert!(ReferenceMotion::new(&from, &to).at(160.0, 100.0, 30_000.0).is_none());
        assert!(ReferenceMotion::new(&from, &from).at(f32::NAN, 0.0, 0.0).is_none());
    }

    #[test]
    fn the_tangent_is_the_tangent() {
        for x in [0.0, 0.001, 0.3, 0.785, 1.2, 1.549] {
            // The cosine near its zero has lost some digits.
            assert!((tan(x) - x.tan()).abs() <= 1e-11 * x.tan().max(1.0), "{x}");
        }
    }
}
