//! Motion compensation: where a frame's point lies in another frame. It follows from the two cameras, so no motion
//! vectors are sent.
//!
//! The cameras become whole numbers by sums, products and quotients in double precision, so all machines have the same
//! ones. Points are moved in integers.

use super::super::portable_math::tan;
use super::model::SIXTEENTHS;
use crate::camera::{Camera, Projection};
use crate::layer::DEPTH_UNITS;

/// The motion from a camera to that of a reference.
///
/// A point at pixel p = (x, y) and depth z has four coordinates in the reference: x, y and weight, which are
/// homogeneous, and depth. Each is (`along`·p)·z + `here`·p, where a row times p is ((rx·x + ry·y) >> `shift`) + rc.
#[derive(Clone, Copy, Debug)]
pub(super) struct ReferenceMotion {
    pub(super) along: [Row; 4],
    pub(super) here: [Row; 4],
    /// Bits after the point of what a row multiplies a pixel with. A pixel of the reference is 2^`shift` times the
    /// quotient of a coordinate and the weight.
    pub(super) shift: u32,
    /// Whether the cameras are the same.
    pub(super) is_still: bool,
}

/// Factors of x and y, and a constant.
type Row = [i32; 3];

/// Motion of a point from the frame to the reference.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Shift {
    /// Rightwards, in 64ths of a pixel.
    pub(super) x: i32,
    /// Downwards, in 64ths of a pixel.
    pub(super) y: i32,
    /// In sixteenths of a depth unit.
    pub(super) z: i32,
}

impl ReferenceMotion {
    pub(super) fn new(camera: &Camera, reference: &Camera) -> Self {
        let (from, to) = (Frustum::new(camera), Frustum::new(reference));
        // Direction with view depth 1 through (x, y): forward + right (2x/w − 1) + up (1 − 2y/h). For parallel rays,
        // all but forward is the place of their origin.
        let spread = if from.is_parallel { 0.0 } else { 1.0 };
        let direction: [[f64; 3]; 3] = std::array::from_fn(|axis| {
            [
                2.0 * from.right[axis] / from.width,
                -2.0 * from.up[axis] / from.height,
                from.forward[axis] * spread - from.right[axis] + from.up[axis],
            ]
        });
        let between: [f64; 3] = std::array::from_fn(|axis| from.eye[axis] - to.eye[axis]);
        let column = |j: usize| direction.map(|row| row[j]);
        let range = |c: &Camera| (f64::from(c.far) - f64::from(c.near)) / f64::from(DEPTH_UNITS);
        let (near, depth_per_unit) = (f64::from(camera.near), range(camera));
        // What a depth unit adds, and what is there at depth 0: factors of x, y and 1.
        let rows = to.pixel_rows().map(|(row, added)| {
            let linear = [0, 1, 2].map(|j| dot(&row, &column(j)));
            let constant = dot(&row, &between) + added;
            if from.is_parallel {
                let along = dot(&row, &from.forward);
                ([0.0, 0.0, along * depth_per_unit], plus(linear, along * near + constant))
            } else {
                (linear.map(|v| v * depth_per_unit), plus(linear.map(|v| v * near), constant))
            }
        });
        let (reference_near, units_per_depth) = (f64::from(reference.near), 1.0 / range(reference));
        let [x, y, weight, (along, here)] = rows;
        let units =
            (along.map(|v| v * units_per_depth), plus(here, -reference_near).map(|v| v * units_per_depth));
        Self::in_numbers(
            [x, y, weight, units],
            from.width.max(from.height),
            to.width.max(to.height),
            camera == reference,
        )
    }

    /// Rounds all rows, of frames with sides of at most so many pixels.
    fn in_numbers(rows: [([f64; 3], [f64; 3]); 4], side: f64, reference_side: f64, is_still: bool) -> Self {
        let mut shift = 0;
        let mut power = 1.0;
        while power < side.max(reference_side) {
            (shift, power) = (shift + 1, power * 2.0);
        }
        let per_reference = [1.0 / power, 1.0 / power, 1.0];
        // The most that x, y and weight can be.
        let most_of = |[x, y, c]: [f64; 3]| (x.abs() + y.abs()) * side + c.abs();
        let mut most = 0.0;
        for ((along, here), per) in rows.iter().zip(per_reference) {
            let of_row = (most_of(*along) * f64::from(DEPTH_UNITS) + most_of(*here)) * per;
            most = if of_row > most { of_row } else { most };
        }
        let scale = MOST / most;
        let scales = [scale * per_reference[0], scale * per_reference[1], scale, UNITS_SCALE];
        // Only depths are not within their bound already. Behind it are points that no frame shows.
        let bounds = [f64::from(i32::MAX), f64::from(i32::MAX), f64::from(i32::MAX), MOST_UNITS];
        let row = |[x, y, c]: [f64; 3], scale: f64, bound: f64| {
            [x * scale * power, y * scale * power, c * scale].map(|v| number_within(v, bound))
        };
        let per_sixteenth = ALONG / f64::from(SIXTEENTHS);
        let along = std::array::from_fn(|i| row(rows[i].0, scales[i] * per_sixteenth, bounds[i]));
        let here = std::array::from_fn(|i| row(rows[i].1, scales[i], bounds[i]));
        Self { along, here, shift, is_still }
    }

    /// Motion of the point at pixel (`x`, `y`) and depth `z`, sixteenths of a depth unit. `None` if the reference does
    /// not see it.
    pub(super) fn at(&self, [x, y]: [i32; 2], z: i32) -> Option<Shift> {
        if self.is_still {
            return Some(Shift::default());
        }
        let times = |[rx, ry, constant]: Row| {
            let sum = i64::from(rx) * i64::from(x) + i64::from(ry) * i64::from(y);
            (sum >> self.shift) + i64::from(constant)
        };
        let near = i64::from(z.clamp(-MAX_Z, MAX_Z));
        let coordinate = |i: usize| ((times(self.along[i]) * near) >> ALONG_BITS) + times(self.here[i]);
        let weight = coordinate(2);
        if weight <= 0 {
            return None;
        }
        // To the nearest 64th of a pixel.
        let moved = |i: usize, from: i32| {
            let nearest = ((coordinate(i) << (self.shift + 7)) + weight).div_euclid(2 * weight);
            nearest - i64::from(64 * from)
        };
        let units = (coordinate(3) + (1 << (UNITS_BITS - 1))) >> UNITS_BITS;
        let shift = [moved(0, x), moved(1, y), units - i64::from(z)];
        let [x, y, z] = shift.map(|s| i32::try_from(s).ok().filter(|s| s.abs() < MAX_SHIFT));
        Some(Shift { x: x?, y: y?, z: z? })
    }
}

/// The nearest number, between −`bound` and `bound`.
fn number_within(x: f64, bound: f64) -> i32 {
    let x = if x < bound { x } else { bound };
    let x = if x > -bound { x } else { -bound };
    (x + 0.5).floor() as i32
}

fn plus([x, y, c]: [f64; 3], constant: f64) -> [f64; 3] {
    [x, y, c + constant]
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

/// The most that x, y and weight become.
const MOST: f64 = (1u64 << 29) as f64;
/// Bits after the point of what depth is multiplied with.
const ALONG_BITS: u32 = 20;
const ALONG: f64 = (1u64 << ALONG_BITS) as f64;
/// Bits after the point of a depth in the reference, sixteenths of a unit.
const UNITS_BITS: u32 = 5;
const UNITS_SCALE: f64 = ((1 << UNITS_BITS) * SIXTEENTHS) as f64;
/// Greatest factor of a depth in the reference, so that sums of three, twice, have 32 bits.
const MOST_UNITS: f64 = (1 << 27) as f64;
/// Greatest depth that is moved, sixteenths of a unit: twice the range.
const MAX_Z: i32 = 1 << 21;
/// Larger motions are useless: they exceed the largest picture and the depth range.
const MAX_SHIFT: i32 = 1 << 22;

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
        for (x, y, z) in [(12.0, 80.0, 20_000.0), (160.0, 100.0, 40_000.0), (300.0, 10.0, 33_000.0)] {
            let (ray, per_depth) = from.ray(x, y);
            let depth = from.near + z * (from.far - from.near) / DEPTH_UNITS;
            let h = basis.pixel_from_point(ray.at(depth * per_depth));
            let shift = motion.at([x as i32, y as i32], 16 * z as i32).unwrap();
            let [dx, dy] = [shift.x, shift.y].map(|s| s as f32 / 64.0);
            // Half of a 64th, and single precision over coordinates of some hundred pixels.
            assert!((h.x / h.z - x - dx).abs() < 1.2e-2 && (h.y / h.z - y - dy).abs() < 1.2e-2);
            assert!((depth_to_units(&to, h.z) - z - shift.z as f32 / 16.0).abs() < 0.2);
            moved = moved.max(dx.abs());
        }
        assert!(moved > 1.0);
        // What does not move stays to the number, and what hardly moves nearly so.
        assert_eq!(ReferenceMotion::new(&from, &from).at([100, 50], 480_000), Some(Shift::default()));
        let still = ReferenceMotion { is_still: false, ..ReferenceMotion::new(&from, &from) };
        let shift = still.at([100, 50], 480_000).unwrap();
        assert!([shift.x, shift.y, shift.z].iter().all(|s| s.abs() <= 1), "{shift:?}");
    }

    #[test]
    fn what_the_reference_cannot_see_does_not_move() {
        let (from, mut to) = (camera(0.0), camera(0.0));
        to.pose = Pose::orbit(Vec3::ZERO, std::f32::consts::PI, 0.0, -20.0);
        assert!(ReferenceMotion::new(&from, &to).at([160, 100], 480_000).is_none());
        let all = ReferenceMotion::new(&from, &camera(0.1));
        assert!(all.at([160, 100], 480_000).is_some());
        // Numbers of damaged bytes have a result too.
        for z in [i32::MIN, i32::MAX] {
            let _ = all.at([i32::from(u16::MAX), 0], z);
        }
    }

    #[test]
    fn the_tangent_is_the_tangent() {
        for x in [0.0, 0.001, 0.3, 0.785, 1.2, 1.549] {
            // The cosine near its zero has lost some digits.
            assert!((tan(x) - x.tan()).abs() <= 1e-11 * x.tan().max(1.0), "{x}");
        }
    }
}
