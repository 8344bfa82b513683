//! Pose and intrinsics of a camera, and the rays through its pixels: all from the eye, or all parallel.

use glam::{Quat, Vec3};

use crate::space::{Aabb, Ray};

/// Position and rotation of a camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Centre of projection, world space. For parallel rays, the middle of the plane on which they start.
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

    /// The pose rotated by `world_from_view` whose eye is `eye_from_center`, in view space, away from the world point
    /// `center`.
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

    /// The pose at fraction `t` from `self` to `to`: the eye moves on a straight line, the rotation is a slerp.
    pub fn interpolate(&self, to: &Self, t: f32) -> Self {
        Self {
            eye: self.eye.lerp(to.eye, t),
            world_from_view: self.world_from_view.slerp(to.world_from_view, t).normalize(),
        }
    }

    /// The pose with the eye moved back along the viewing direction until all of `bounds` is well in front. Parallel
    /// rays stay the same.
    pub fn before(&self, bounds: &Aabb) -> Self {
        let forward = self.forward();
        let depth = (bounds.center() - self.eye).dot(forward);
        Self { eye: self.eye + forward * (depth - 2.0 * bounds.radius()), ..*self }
    }

    /// Unit viewing direction, world space.
    pub fn forward(&self) -> Vec3 {
        self.world_from_view * Vec3::NEG_Z
    }

    /// Whether all numbers are finite and bounded and the rotation is valid.
    pub fn is_valid(&self) -> bool {
        self.eye.is_finite()
            && self.eye.abs().max_element() <= MAX_COORDINATE
            && self.world_from_view.is_finite()
            && (self.world_from_view.length_squared() - 1.0).abs() < 1e-3
    }
}

/// Size of the picture, and its projection.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// The projection of its rays.
    pub projection: Projection,
}

/// Direction and distance of a picture's rays.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Projection {
    /// All rays start at the eye.
    Perspective {
        /// Vertical field of view, radians, in (0, π).
        fov_y: f32,
    },
    /// All rays run along the viewing direction, from the plane of the eye: size does not depend on distance.
    Orthographic {
        /// Height of the visible area, world units.
        height: f32,
    },
}

impl Projection {
    /// One number that stores and transmits a projection: the vertical field of view in radians, or minus the height
    /// of an orthographic picture in world units.
    pub fn to_number(self) -> f32 {
        match self {
            Self::Perspective { fov_y } => fov_y,
            Self::Orthographic { height } => -height,
        }
    }

    /// Inverse of [`Projection::to_number`]; an invalid number gives an invalid projection.
    pub fn from_number(number: f32) -> Self {
        if number < 0.0 {
            Self::Orthographic { height: -number }
        } else {
            Self::Perspective { fov_y: number }
        }
    }

    /// Whether the rays are parallel.
    pub fn is_orthographic(self) -> bool {
        matches!(self, Self::Orthographic { .. })
    }

    /// Whether a peer's projection can be used.
    pub fn is_valid(self) -> bool {
        match self {
            Self::Perspective { fov_y } => fov_y > 1e-3 && fov_y < 3.1,
            Self::Orthographic { height } => HEIGHTS.contains(&height),
        }
    }
}

impl Intrinsics {
    /// A picture with a vertical field of view, radians.
    pub const fn perspective(width: u32, height: u32, fov_y: f32) -> Self {
        Self { width, height, projection: Projection::Perspective { fov_y } }
    }

    /// A picture of parallel rays that shows `world_height` world units from its upper to its lower border.
    pub const fn orthographic(width: u32, height: u32, world_height: f32) -> Self {
        Self { width, height, projection: Projection::Orthographic { height: world_height } }
    }

    /// The same pixels with another vertical field of view, radians.
    pub const fn with_fov_y(&self, fov_y: f32) -> Self {
        Self::perspective(self.width, self.height, fov_y)
    }

    /// Number of pixels.
    pub fn num_pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// Vertical field of view, radians; 0 where rays are parallel.
    pub fn fov_y(&self) -> f32 {
        match self.projection {
            Projection::Perspective { fov_y } => fov_y,
            Projection::Orthographic { .. } => 0.0,
        }
    }

    /// Half the width and half the height of the visible area at a view depth, world units. At depth 1 of a
    /// perspective they are the tangents of half the fields of view.
    pub fn half_size_at(&self, depth: f32) -> (f32, f32) {
        let y = match self.projection {
            Projection::Perspective { fov_y } => (fov_y * 0.5).tan() * depth,
            Projection::Orthographic { height } => height * 0.5,
        };
        (y * self.width as f32 / self.height as f32, y)
    }

    /// The same picture with `margin` more pixels on every side (a guard band). Pixel (x, y) of `self` has the ray of
    /// pixel (x + margin, y + margin) of the result, up to rounding.
    pub fn with_margin(&self, margin: u32) -> Self {
        if margin == 0 {
            return *self;
        }
        let (width, height) = (self.width + 2 * margin, self.height + 2 * margin);
        let growth = f64::from(height) / f64::from(self.height);
        // Double precision, so that the result is rounded once.
        let projection = match self.projection {
            Projection::Perspective { fov_y } => {
                let tan = (f64::from(fov_y) * 0.5).tan() * growth;
                Projection::Perspective { fov_y: (2.0 * tan.atan()) as f32 }
            }
            Projection::Orthographic { height } => {
                Projection::Orthographic { height: (f64::from(height) * growth) as f32 }
            }
        };
        Self { width, height, projection }
    }

    /// The margin that makes `self` of `inner`, if there is one.
    pub fn margin_around(&self, inner: &Self) -> Option<u32> {
        let margin = self.height.checked_sub(inner.height)? / 2;
        (inner.with_margin(margin) == *self).then_some(margin)
    }

    /// The distance at which a sphere just fits the view, in units of its radius. For parallel rays it is 1, which
    /// puts the sphere in front.
    pub fn fit_distance(&self) -> f32 {
        if self.projection.is_orthographic() {
            return 1.0;
        }
        let (x, y) = self.half_size_at(1.0);
        1.0 / x.min(y).atan().sin()
    }
}

/// A camera with the depth interval that quantises its layered frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Position and rotation.
    pub pose: Pose,
    /// Picture size and projection.
    pub intrinsics: Intrinsics,
    /// Least view depth of the volume's bounding sphere, world units, positive.
    pub near: f32,
    /// Greatest view depth of the volume's bounding sphere, world units, above `near`.
    pub far: f32,
}

impl Camera {
    /// A camera whose near and far planes enclose the bounding sphere of `bounds` (Zellmann 2012).
    pub fn new(pose: Pose, intrinsics: Intrinsics, bounds: &Aabb) -> Self {
        let radius = bounds.radius();
        let center_depth = (bounds.center() - pose.eye).dot(pose.forward());
        let least = radius * 1e-3;
        let near = (center_depth - radius).max(least);
        // The planes differ even from so far away that rounding swallows the volume.
        let far = (center_depth + radius).max(near + least).max(near * (1.0 + 1e-6));
        Self { pose, intrinsics, near, far }
    }

    /// The vectors that generate rays, in the form that every kernel uses.
    pub fn basis(&self) -> Basis {
        let (half_width, half_height) = self.intrinsics.half_size_at(1.0);
        let q = self.pose.world_from_view;
        Basis {
            eye: self.pose.eye,
            forward: q * Vec3::NEG_Z,
            right: q * Vec3::X * half_width,
            up: q * Vec3::Y * half_height,
            width: self.intrinsics.width as f32,
            height: self.intrinsics.height as f32,
            perspective: if self.intrinsics.projection.is_orthographic() { 0.0 } else { 1.0 },
        }
    }

    /// A camera of parallel rays that shows matter at view depth `depth` in the same place and size. All of the
    /// volume in `bounds` is in front of it.
    pub fn to_orthographic(&self, depth: f32, bounds: &Aabb) -> Self {
        let Intrinsics { width, height, .. } = self.intrinsics;
        let world_height = 2.0 * self.intrinsics.half_size_at(depth).1;
        let intrinsics = Intrinsics::orthographic(width, height, world_height);
        Self::new(self.pose.before(bounds), intrinsics, bounds)
    }

    /// The ray through the point (`x`, `y`) of pixel space, and world distance per unit of view depth along it.
    pub fn ray(&self, x: f32, y: f32) -> (Ray, f32) {
        self.basis().ray(x, y)
    }

    /// Greatest number of pixels by which a box reaches beyond a side of the picture; 0 if it is inside, infinite if
    /// a part is behind the eye.
    pub fn overhang(&self, bounds: &Aabb) -> f32 {
        let basis = self.basis();
        let beyond = |corner: Vec3| {
            let h = basis.pixel_from_point(corner);
            let (x, y) = (h.x / h.z, h.y / h.z);
            let beyond = (-x).max(x - basis.width).max(-y).max(y - basis.height);
            if basis.depth_of(corner) > 0.0 { beyond } else { f32::INFINITY }
        };
        bounds.corners().into_iter().map(beyond).fold(0.0, f32::max)
    }

    /// Whether a peer's camera can be used: finite, ordered, of a bounded size.
    pub fn is_valid(&self) -> bool {
        let i = &self.intrinsics;
        self.pose.is_valid()
            && (1..=MAX_SIDE).contains(&i.width)
            && (1..=MAX_SIDE).contains(&i.height)
            && i.projection.is_valid()
            && self.near > 0.0
            && self.far > self.near
            && self.far <= MAX_DEPTH
    }
}

/// A camera as an eye and three vectors. For x, y in [−1, 1] over the picture, a pixel's ray runs from the eye along
/// `forward + x·right + y·up`. With parallel rays it runs from `eye + x·right + y·up` along `forward`. Its direction
/// has a view depth of exactly 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Basis {
    /// Centre of projection, world space.
    pub eye: Vec3,
    /// Unit viewing direction.
    pub forward: Vec3,
    /// Points right; its length is half of the picture's width at view depth 1.
    pub right: Vec3,
    /// Points up; its length is half of the picture's height at view depth 1.
    pub up: Vec3,
    /// Columns.
    pub width: f32,
    /// Rows.
    pub height: f32,
    /// 1 for a perspective, 0 for parallel rays.
    pub perspective: f32,
}

/// A ray in the homogeneous pixel coordinates (x·w, y·w, w) of a camera: `o + d·s` at world distance s from its origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PixelLine {
    /// The ray's origin.
    pub o: Vec3,
    /// Its direction.
    pub d: Vec3,
    /// View depth of the origin, and its change per unit of s.
    pub depth: [f32; 2],
}

impl PixelLine {
    /// The homogeneous pixel at world distance `s`.
    #[inline]
    pub fn at(&self, s: f32) -> Vec3 {
        self.o + self.d * s
    }

    /// The view depth at world distance `s`.
    #[inline]
    pub fn depth_at(&self, s: f32) -> f32 {
        self.depth[0] + self.depth[1] * s
    }
}

impl Basis {
    /// The direction of view depth 1 through a point of pixel space.
    pub fn direction(&self, x: f32, y: f32) -> Vec3 {
        let [nx, ny] = self.normalized(x, y).map(|n| n * self.perspective);
        self.forward + self.right * nx + self.up * ny
    }

    /// Start of the ray through a point of pixel space, world space.
    pub fn origin(&self, x: f32, y: f32) -> Vec3 {
        let [nx, ny] = self.normalized(x, y).map(|n| n * (1.0 - self.perspective));
        self.eye + self.right * nx + self.up * ny
    }

    fn normalized(&self, x: f32, y: f32) -> [f32; 2] {
        [2.0 * x / self.width - 1.0, 1.0 - 2.0 * y / self.height]
    }

    /// See [`Camera::ray`].
    pub fn ray(&self, x: f32, y: f32) -> (Ray, f32) {
        let d = self.direction(x, y);
        let length = d.length();
        (Ray { origin: self.origin(x, y), dir: d / length }, length)
    }

    /// Homogeneous pixel coordinates (x·w, y·w, w) of a point in the world. The weight w is the view depth, or 1 for
    /// parallel rays.
    pub fn pixel_from_point(&self, point: Vec3) -> Vec3 {
        self.pixel_from_world(point - self.eye, 1.0 - self.perspective)
    }

    /// The same for a direction: the change of a point's coordinates along it.
    pub fn pixel_from_direction(&self, direction: Vec3) -> Vec3 {
        self.pixel_from_world(direction, 0.0)
    }

    fn pixel_from_world(&self, v: Vec3, weight: f32) -> Vec3 {
        let w = v.dot(self.forward) * self.perspective + weight;
        let x = v.dot(self.right) / self.right.length_squared();
        let y = v.dot(self.up) / self.up.length_squared();
        Vec3::new((w + x) * 0.5 * self.width, (w - y) * 0.5 * self.height, w)
    }

    /// View depth of a point in the world.
    pub fn depth_of(&self, point: Vec3) -> f32 {
        (point - self.eye).dot(self.forward)
    }

    /// A ray in this camera's pixels.
    pub fn line(&self, ray: &Ray) -> PixelLine {
        PixelLine {
            o: self.pixel_from_point(ray.origin),
            d: self.pixel_from_direction(ray.dir),
            depth: [self.depth_of(ray.origin), ray.dir.dot(self.forward)],
        }
    }
}

/// Valid heights of orthographic pictures, world units: their squares times those of pixels stay in single precision.
const HEIGHTS: std::ops::RangeInclusive<f32> = 1e-16..=1e15;
/// Largest distance of an eye from the origin: its square is finite in single precision.
const MAX_COORDINATE: f32 = 1e15;
/// Largest depth that a camera may see.
const MAX_DEPTH: f32 = 1e16;
/// Largest picture side that is accepted from anyone.
pub const MAX_SIDE: u32 = 8192;

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        let bounds = Aabb { min: Vec3::new(-1.0, -2.0, -3.0), max: Vec3::new(1.0, 2.0, 3.0) };
        let intrinsics = Intrinsics::perspective(64, 48, 0.7);
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
            let h = basis.pixel_from_point(ray.at(7.0));
            assert!((h.x / h.z - x).abs() < 1e-3 && (h.y / h.z - y).abs() < 1e-3);
            assert!((h.z * s_per_depth - 7.0).abs() < 1e-4);
        }
    }

    #[test]
    fn a_margin_keeps_the_rays_of_all_pixels() {
        for (width, height, fov_y) in [(64, 48, 0.7), (1920, 1080, 0.7), (31, 255, 2.0), (256, 256, 0.05)] {
            let inner = Intrinsics::perspective(width, height, fov_y);
            for margin in [0, 1, 16, 37, 200] {
                let outer = inner.with_margin(margin);
                assert_eq!((outer.width, outer.height), (width + 2 * margin, height + 2 * margin));
                assert_eq!(outer.margin_around(&inner), Some(margin));
                let camera = |intrinsics| Camera { intrinsics, ..camera() };
                let (a, b) = (camera(inner), camera(outer).basis());
                let m = margin as f32;
                for (x, y) in [(0.5, 0.5), (width as f32 - 0.5, 0.5), (7.5, height as f32 - 0.5)] {
                    let h = b.pixel_from_direction(a.ray(x, y).0.dir);
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
        let intrinsics = Intrinsics::perspective(90, 60, 0.7);
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
        let intrinsics = Intrinsics::perspective(8, 8, 1.0);
        let outside = Camera::new(Pose::orbit(Vec3::ZERO, 0.0, 0.0, 10.0), intrinsics, &bounds);
        assert!((outside.near - (10.0 - 3f32.sqrt())).abs() < 1e-4);
        // The farthest that a pose datagram may name, and everything nearer.
        for distance in [0.0, -0.5, -10.0, 1e6, 1e9, 1e15, -1e15] {
            let c = Camera::new(Pose::orbit(Vec3::ZERO, 0.0, 0.0, distance), intrinsics, &bounds);
            assert!(c.is_valid(), "{c:?}");
        }
    }
}
