//! Pose and intrinsics of a pinhole camera, and the rays through its pixels.

use glam::{Quat, Vec3};

use crate::space::{Aabb, Ray};

/// Where a camera is and how it is turned.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Centre of projection, world space.
    pub eye: Vec3,
    /// Rotation from view space (looking along −z, +y up) to world space; unit length.
    pub world_from_view: Quat,
}

impl Pose {
    /// The pose on a sphere around `center`: azimuth 0 and elevation 0 look along −z with +y up; a positive
    /// azimuth moves the eye towards +x, a positive elevation towards +y. Angles in radians, distance in world units.
    pub fn orbit(center: Vec3, azimuth: f32, elevation: f32, distance: f32) -> Self {
        let world_from_view = Quat::from_rotation_y(azimuth) * Quat::from_rotation_x(-elevation);
        Self { eye: center + world_from_view * (Vec3::Z * distance), world_from_view }
    }

    /// The pose turned by `world_from_view` whose eye lies at `eye_from_center`, in view space, from the point `center` of
    /// world space.
    pub fn around(center: Vec3, world_from_view: Quat, eye_from_center: Vec3) -> Self {
        Self { eye: center + world_from_view * eye_from_center, world_from_view }
    }

    /// Looks from `eye` to `target` with `up` upwards.
    pub fn look_at(eye: Vec3, target: Vec3, up: Vec3) -> Self {
        let back = (eye - target).normalize_or(Vec3::Z);
        let right = up.cross(back).try_normalize().unwrap_or_else(|| back.any_orthonormal_vector());
        let basis = glam::Mat3::from_cols(right, back.cross(right), back);
        Self { eye, world_from_view: Quat::from_mat3(&basis).normalize() }
    }

    /// The pose a part `t` of the way from `self` to `to`: eye on the straight line, rotation by slerp.
    pub fn interpolate(&self, to: &Self, t: f32) -> Self {
        Self {
            eye: self.eye.lerp(to.eye, t),
            world_from_view: self.world_from_view.slerp(to.world_from_view, t).normalize(),
        }
    }

    /// Unit viewing direction, world space.
    pub fn forward(&self) -> Vec3 {
        self.world_from_view * Vec3::NEG_Z
    }

    /// Whether all numbers are finite and the rotation is a rotation.
    pub fn is_valid(&self) -> bool {
        self.eye.is_finite()
            && self.world_from_view.is_finite()
            && (self.world_from_view.length_squared() - 1.0).abs() < 1e-3
    }
}

/// Size of the picture and its vertical field of view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Vertical field of view, radians, in (0, π).
    pub fov_y: f32,
}

impl Intrinsics {
    /// Number of pixels.
    pub fn num_pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// Tangents of half the horizontal and half the vertical field of view.
    pub fn tan_half(&self) -> (f32, f32) {
        let y = (self.fov_y * 0.5).tan();
        (y * self.width as f32 / self.height as f32, y)
    }

    /// The same pixels with `margin` more of them on every side (a guard band): pixel (x, y) of `self` has the ray of
    /// pixel (x + margin, y + margin) of the result, up to the rounding of the angle.
    pub fn with_margin(&self, margin: u32) -> Self {
        if margin == 0 {
            return *self;
        }
        let (width, height) = (self.width + 2 * margin, self.height + 2 * margin);
        // In double precision, so that the angle is rounded once.
        let tan = (f64::from(self.fov_y) * 0.5).tan() * f64::from(height) / f64::from(self.height);
        Self { width, height, fov_y: (2.0 * tan.atan()) as f32 }
    }

    /// The margin with which `inner` becomes `self`, if there is one.
    pub fn margin_around(&self, inner: &Self) -> Option<u32> {
        let margin = self.height.checked_sub(inner.height)? / 2;
        (inner.with_margin(margin) == *self).then_some(margin)
    }

    /// The distance, in units of a sphere's radius, at which the sphere just fits the view.
    pub fn fit_distance(&self) -> f32 {
        let (x, y) = self.tan_half();
        1.0 / x.min(y).atan().sin()
    }
}

/// A pinhole camera with the depth interval that its layered frame is quantised in.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Position and rotation.
    pub pose: Pose,
    /// Picture size and field of view.
    pub intrinsics: Intrinsics,
    /// Least view depth of the volume's bounding sphere, world units, positive.
    pub near: f32,
    /// Greatest view depth of the volume's bounding sphere, world units, above `near`.
    pub far: f32,
}

impl Camera {
    /// A camera whose near and far planes enclose the bounding sphere of `bounds` (design, trap 8; Zellmann 2012).
    pub fn new(pose: Pose, intrinsics: Intrinsics, bounds: &Aabb) -> Self {
        let radius = bounds.radius();
        let center_depth = (bounds.center() - pose.eye).dot(pose.forward());
        let least = radius * 1e-3;
        let near = (center_depth - radius).max(least);
        // Seen from so far away that rounding swallows the volume, the planes still differ.
        let far = (center_depth + radius).max(near + least).max(near * (1.0 + 1e-6));
        Self { pose, intrinsics, near, far }
    }

    /// The vectors that make rays, in the form every kernel uses.
    pub fn basis(&self) -> Basis {
        let (tan_x, tan_y) = self.intrinsics.tan_half();
        let q = self.pose.world_from_view;
        Basis {
            eye: self.pose.eye,
            forward: q * Vec3::NEG_Z,
            right: q * Vec3::X * tan_x,
            up: q * Vec3::Y * tan_y,
            width: self.intrinsics.width as f32,
            height: self.intrinsics.height as f32,
        }
    }

    /// The ray through the point (`x`, `y`) of pixel space, and world distance per unit of view depth along it.
    pub fn ray(&self, x: f32, y: f32) -> (Ray, f32) {
        self.basis().ray(x, y)
    }

    /// By how many pixels the picture of a box exceeds the camera's own on the side where it does most; 0 if all of it
    /// is inside, infinite if a part of it is behind the eye.
    pub fn overhang(&self, bounds: &Aabb) -> f32 {
        let basis = self.basis();
        let beyond = |corner: Vec3| {
            let h = basis.pixel_from_world(corner - basis.eye);
            let (x, y) = (h.x / h.z, h.y / h.z);
            let beyond = (-x).max(x - basis.width).max(-y).max(y - basis.height);
            if h.z > 0.0 { beyond } else { f32::INFINITY }
        };
        bounds.corners().into_iter().map(beyond).fold(0.0, f32::max)
    }

    /// Whether a peer's camera can be used: finite, ordered, of a bounded size.
    pub fn is_valid(&self) -> bool {
        let i = &self.intrinsics;
        self.pose.is_valid()
            && (1..=MAX_SIDE).contains(&i.width)
            && (1..=MAX_SIDE).contains(&i.height)
            && i.fov_y > 1e-3
            && i.fov_y < 3.1
            && self.near > 0.0
            && self.far > self.near
            && self.far.is_finite()
    }
}

/// A camera as an eye and three vectors: a pixel's direction is `forward + x·right + y·up` with x, y in [−1, 1]; its
/// view depth is exactly 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Basis {
    /// Centre of projection, world space.
    pub eye: Vec3,
    /// Unit viewing direction.
    pub forward: Vec3,
    /// Right, scaled by the tangent of half the horizontal field of view.
    pub right: Vec3,
    /// Up, scaled by the tangent of half the vertical field of view.
    pub up: Vec3,
    /// Columns.
    pub width: f32,
    /// Rows.
    pub height: f32,
}

impl Basis {
    /// The direction of view depth 1 through a point of pixel space.
    pub fn direction(&self, x: f32, y: f32) -> Vec3 {
        let nx = 2.0 * x / self.width - 1.0;
        let ny = 1.0 - 2.0 * y / self.height;
        self.forward + self.right * nx + self.up * ny
    }

    /// See [`Camera::ray`].
    pub fn ray(&self, x: f32, y: f32) -> (Ray, f32) {
        let d = self.direction(x, y);
        let length = d.length();
        (Ray { origin: self.eye, dir: d / length }, length)
    }

    /// Homogeneous pixel coordinates (x·w, y·w, w) of a world-space vector; w is the view depth. For points pass
    /// `p − eye`, for directions the direction: the map is linear, so both work.
    pub fn pixel_from_world(&self, v: Vec3) -> Vec3 {
        let w = v.dot(self.forward);
        let x = v.dot(self.right) / self.right.length_squared();
        let y = v.dot(self.up) / self.up.length_squared();
        Vec3::new((w + x) * 0.5 * self.width, (w - y) * 0.5 * self.height, w)
    }
}

/// Largest picture side that is accepted from anyone.
pub const MAX_SIDE: u32 = 8192;

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        let bounds = Aabb { min: Vec3::new(-1.0, -2.0, -3.0), max: Vec3::new(1.0, 2.0, 3.0) };
        let intrinsics = Intrinsics { width: 64, height: 48, fov_y: 0.7 };
        let pose = Pose::orbit(Vec3::ZERO, 0.4, 0.2, bounds.radius() * intrinsics.fit_distance());
        Camera::new(pose, intrinsics, &bounds)
    }

    #[test]
    fn orbit_follows_the_stated_convention() {
        let p = Pose::orbit(Vec3::ZERO, 0.0, 0.0, 2.0);
        assert!((p.eye - Vec3::Z * 2.0).length() < 1e-6);
        assert!((p.forward() - Vec3::NEG_Z).length() < 1e-6);
        assert!(Pose::orbit(Vec3::ZERO, 0.1, 0.0, 2.0).eye.x > 0.0);
        assert!(Pose::orbit(Vec3::ZERO, 0.0, 0.1, 2.0).eye.y > 0.0);
        for (az, el) in [(0.3, -0.4), (2.0, 1.0), (-3.0, 0.0)] {
            let p = Pose::orbit(Vec3::ONE, az, el, 5.0);
            assert!(((p.eye + p.forward() * 5.0) - Vec3::ONE).length() < 1e-5);
            let q = Pose::look_at(p.eye, Vec3::ONE, p.world_from_view * Vec3::Y);
            assert!(q.world_from_view.dot(p.world_from_view).abs() > 0.9999);
        }
    }

    #[test]
    fn pixel_from_world_inverts_ray() {
        let camera = camera();
        let basis = camera.basis();
        for (x, y) in [(0.5, 0.5), (10.0, 40.25), (63.5, 47.5)] {
            let (ray, s_per_depth) = camera.ray(x, y);
            let h = basis.pixel_from_world(ray.at(7.0) - basis.eye);
            assert!((h.x / h.z - x).abs() < 1e-3 && (h.y / h.z - y).abs() < 1e-3);
            assert!((h.z * s_per_depth - 7.0).abs() < 1e-4);
        }
    }

    #[test]
    fn a_margin_keeps_the_rays_of_all_pixels() {
        for (width, height, fov_y) in [(64, 48, 0.7), (1920, 1080, 0.7), (31, 255, 2.0), (256, 256, 0.05)] {
            let inner = Intrinsics { width, height, fov_y };
            for margin in [0, 1, 16, 37, 200] {
                let outer = inner.with_margin(margin);
                assert_eq!((outer.width, outer.height), (width + 2 * margin, height + 2 * margin));
                assert_eq!(outer.margin_around(&inner), Some(margin));
                let camera = |intrinsics| Camera { intrinsics, ..camera() };
                let (a, b) = (camera(inner), camera(outer).basis());
                let m = margin as f32;
                for (x, y) in [(0.5, 0.5), (width as f32 - 0.5, 0.5), (7.5, height as f32 - 0.5)] {
                    let h = b.pixel_from_world(a.ray(x, y).0.dir);
                    let off = (h.x / h.z - m - x).abs().max((h.y / h.z - m - y).abs());
                    // A dozen roundings of 2^-24 of the coordinate, and of the angle times 1 + tan²; a list has any
                    // weight only from a thousandth of a pixel on.
                    assert!(off < 7e-4, "{inner:?} {margin}: {off}");
                }
            }
            assert_eq!(inner.with_margin(3).margin_around(&inner.with_margin(4)), None);
            assert_eq!(Intrinsics { width: width + 2, ..inner }.margin_around(&inner), None);
        }
    }

    #[test]
    fn overhang_is_what_a_margin_must_cover() {
        let bounds = Aabb { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) };
        let intrinsics = Intrinsics { width: 90, height: 60, fov_y: 0.7 };
        let at = |distance| Camera::new(Pose::orbit(Vec3::ZERO, 0.3, 0.2, distance), intrinsics, &bounds);
        assert_eq!(at(8.0).overhang(&bounds), 0.0);
        assert_eq!(at(1.0).overhang(&bounds), f32::INFINITY);
        let near = at(4.0);
        let margin = near.overhang(&bounds).ceil() as u32;
        assert!(margin > 0);
        let wider = |m| Camera { intrinsics: intrinsics.with_margin(m), ..near };
        assert_eq!(wider(margin).overhang(&bounds), 0.0);
        assert!(wider(margin - 1).overhang(&bounds) > 0.0);
    }

    #[test]
    fn near_and_far_enclose_the_sphere_also_from_inside() {
        let bounds = Aabb { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) };
        let intrinsics = Intrinsics { width: 8, height: 8, fov_y: 1.0 };
        let outside = Camera::new(Pose::orbit(Vec3::ZERO, 0.0, 0.0, 10.0), intrinsics, &bounds);
        assert!((outside.near - (10.0 - 3f32.sqrt())).abs() < 1e-4);
        // The farthest that a pose datagram may name, and everything nearer.
        for distance in [0.0, -0.5, -10.0, 1e6, 1e9, 1e15, -1e15] {
            let c = Camera::new(Pose::orbit(Vec3::ZERO, 0.0, 0.0, distance), intrinsics, &bounds);
            assert!(c.is_valid(), "{c:?}");
        }
    }
}
