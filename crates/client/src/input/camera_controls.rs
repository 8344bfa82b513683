//! From pointer movements to a camera: orbit, roll, pan and zoom around a centre, at first the volume's.
//!
//! The camera is a rotation and the eye's position *relative to the centre, in view space*: (x, y, d), where d is the
//! view depth of the centre. Orbiting changes only the rotation, panning only x and y, and zooming keeps d within
//! bounds. So the eye never passes the centre, and orbiting never moves the centre on the screen.
//!
//! Orbiting turns about the camera's own right and up axes, like the trackball camera of VTK and ParaView. No pole
//! flips or stops the view, but a pointer that circles rolls the picture (`r` sets it upright again).

use glam::{Quat, Vec3};
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::space::Aabb;

/// What the pointer did since the last refresh. Pixels of the picture, x to the right, y down.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ControlInput {
    /// Movement that orbits.
    pub orbit: [f32; 2],
    /// Movement that pans.
    pub pan: [f32; 2],
    /// Turn in the plane of the picture, radians, clockwise.
    pub roll: f32,
    /// Natural logarithm of the magnification: positive brings the volume closer.
    pub zoom: f32,
    /// The point that zooming keeps in place, from the middle of the picture.
    pub zoom_at: [f32; 2],
}

impl ControlInput {
    /// Adds what keys did. Zooming keeps the pointer's point in place.
    pub fn add(&mut self, keys: &Self) {
        let sum = |a: [f32; 2], b: [f32; 2]| [a[0] + b[0], a[1] + b[1]];
        self.orbit = sum(self.orbit, keys.orbit);
        self.pan = sum(self.pan, keys.pan);
        self.roll += keys.roll;
        self.zoom += keys.zoom;
    }

    /// Whether it leaves the camera as it is.
    pub fn is_idle(&self) -> bool {
        self.orbit == [0.0; 2] && self.pan == [0.0; 2] && self.roll == 0.0 && self.zoom == 0.0
    }
}

/// The first view, to which `r` returns, in upright space (`isinglass_core::space`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InitialOrbit {
    /// Degrees; a positive angle moves the eye to the right.
    pub azimuth_degrees: f32,
    /// Degrees; a positive angle moves the eye up.
    pub elevation_degrees: f32,
    /// Distance of the eye from the centre in radii of the bounding sphere; none: the volume's box just fits the view.
    pub distance_in_radii: Option<f32>,
}

impl Default for InitialOrbit {
    fn default() -> Self {
        Self { azimuth_degrees: 30.0, elevation_degrees: 20.0, distance_in_radii: None }
    }
}

/// The camera in the user's hand.
#[derive(Clone, Debug)]
pub struct CameraControls {
    initial: InitialOrbit,
    world_from_upright: Quat,
    middle: Vec3,
    half_size: Vec3,
    /// What the camera turns about.
    center: Vec3,
    radius: f32,
    world_from_view: Quat,
    /// Eye minus centre, view space. z is the view depth of the centre and positive.
    eye_from_center: Vec3,
}

impl CameraControls {
    /// The first view of a volume in the box `bounds`, set upright by `world_from_upright`.
    pub fn new(
        initial: InitialOrbit,
        world_from_upright: Quat,
        bounds: &Aabb,
        intrinsics: &Intrinsics,
    ) -> Self {
        let mut controls = Self {
            initial,
            world_from_upright,
            middle: bounds.center(),
            half_size: half_size(bounds),
            center: bounds.center(),
            radius: bounds.radius(),
            world_from_view: Quat::IDENTITY,
            eye_from_center: Vec3::Z,
        };
        controls.reset(intrinsics);
        controls
    }

    /// Returns to the first view.
    pub fn reset(&mut self, intrinsics: &Intrinsics) {
        self.center = self.middle;
        let upright_from_view = Pose::orbit(
            Vec3::ZERO,
            self.initial.azimuth_degrees.to_radians(),
            self.initial.elevation_degrees.to_radians(),
            1.0,
        )
        .world_from_view;
        self.world_from_view = (self.world_from_upright * upright_from_view).normalize();
        match self.initial.distance_in_radii {
            Some(distance) => self.eye_from_center = Vec3::Z * self.bounded_depth(distance * self.radius),
            None => {
                let (min, max) = (self.middle - self.half_size, self.middle + self.half_size);
                self.fit(&Aabb { min, max }, intrinsics, false);
            }
        }
    }

    /// The same view of another volume, in units of its size. [`CameraControls::reset`] leads to its first view.
    pub fn turn_to(&mut self, bounds: &Aabb) {
        let scale = bounds.radius() / self.radius;
        self.center = bounds.center() + (self.center - self.middle) * scale;
        (self.middle, self.radius, self.half_size) = (bounds.center(), bounds.radius(), half_size(bounds));
        self.eye_from_center =
            (self.eye_from_center * scale).with_z(self.bounded_depth(self.eye_from_center.z * scale));
    }

    /// Applies what the pointer did. Returns whether the camera changed.
    pub fn apply(&mut self, input: &ControlInput, intrinsics: &Intrinsics) -> bool {
        let before = (self.world_from_view, self.eye_from_center);
        self.orbit(input.orbit, intrinsics);
        self.roll(input.roll);
        self.pan(input.pan, intrinsics);
        self.zoom(input.zoom, input.zoom_at, intrinsics);
        before != (self.world_from_view, self.eye_from_center)
    }

    /// Turns about the centre so that the near side of the volume follows the pointer. A drag over the shorter side
    /// of the picture is half a turn.
    pub fn orbit(&mut self, [dx, dy]: [f32; 2], intrinsics: &Intrinsics) {
        let angle_per_pixel = std::f32::consts::PI / intrinsics.width.min(intrinsics.height).max(1) as f32;
        let turn = Quat::from_scaled_axis(Vec3::new(-dy, -dx, 0.0) * angle_per_pixel);
        let turned = (self.world_from_view * turn).normalize();
        if (dx, dy) != (0.0, 0.0) && turned.is_finite() {
            self.world_from_view = turned;
        }
    }

    /// Turns the picture clockwise about the centre, by an angle in radians.
    pub fn roll(&mut self, angle: f32) {
        let turned = (self.world_from_view * Quat::from_rotation_z(angle)).normalize();
        if angle != 0.0 && turned.is_finite() {
            self.world_from_view = turned;
        }
    }

    /// Looks at the volume's middle from the direction `from`, with `up` upwards, at the same distance as before.
    pub fn look_from(&mut self, from: Vec3, up: Vec3) {
        self.world_from_view = Pose::look_at(from, Vec3::ZERO, up).world_from_view;
        self.center = self.middle;
        self.eye_from_center = Vec3::Z * self.bounded_depth(self.eye_from_center.z);
    }

    /// Turns the picture so that `up` points up in it as far as the direction of view allows.
    pub fn roll_upright(&mut self, up: Vec3) {
        let from = self.world_from_view * Vec3::Z;
        self.world_from_view = Pose::look_at(from, Vec3::ZERO, up).world_from_view;
    }

    /// Sets the upright space, in which [`CameraControls::reset`] looks at the volume.
    pub fn set_upright(&mut self, world_from_upright: Quat) {
        self.world_from_upright = world_from_upright;
    }

    /// Keeps the direction of view, and brings all of `bounds` into the picture with a small margin.
    pub fn fit(&mut self, bounds: &Aabb, intrinsics: &Intrinsics, is_parallel: bool) {
        let (x, y) = intrinsics.half_size_at(1.0);
        let view_from_world = self.world_from_view.inverse();
        let depth_of = |corner: Vec3| {
            let p = view_from_world * (corner - bounds.center());
            let across = (p.x.abs() / x).max(p.y.abs() / y) * FIT_MARGIN;
            if is_parallel { across } else { across + p.z }
        };
        let depth = bounds.corners().into_iter().map(depth_of).fold(0.0, f32::max);
        self.center = bounds.center();
        self.eye_from_center = Vec3::Z * self.bounded_depth(depth);
    }

    /// What the camera turns about, world space.
    pub fn center(&self) -> Vec3 {
        self.center
    }

    /// Makes `center` the centre of rotation and keeps the view. A point that is not in front of the eye is refused.
    pub fn set_center(&mut self, center: Vec3) -> bool {
        self.set_center_at(center, None)
    }

    /// The same for parallel rays: no point is near the eye, and the picture keeps its magnification.
    pub fn set_center_of_parallel(&mut self, center: Vec3) -> bool {
        self.set_center_at(center, Some(self.eye_from_center.z))
    }

    fn set_center_at(&mut self, center: Vec3, depth: Option<f32>) -> bool {
        let from_center = self.world_from_view.inverse() * (self.pose().eye - center);
        let eye_from_center = from_center.with_z(depth.unwrap_or(from_center.z));
        let depth = eye_from_center.z;
        let is_usable = eye_from_center.is_finite() && depth == self.bounded_depth(depth);
        if is_usable {
            (self.center, self.eye_from_center) = (center, eye_from_center);
        }
        is_usable
    }

    /// Shifts the camera so that everything at the centre's depth follows the pointer.
    pub fn pan(&mut self, [dx, dy]: [f32; 2], intrinsics: &Intrinsics) {
        let shift = Vec3::new(-dx, dy, 0.0) * self.world_per_pixel(intrinsics);
        self.move_eye(shift);
    }

    /// Magnifies by e^`zoom` around the point `at` (pixels from the middle of the picture) at the centre's depth.
    pub fn zoom(&mut self, zoom: f32, [x, y]: [f32; 2], intrinsics: &Intrinsics) {
        let depth = self.eye_from_center.z;
        let wanted = depth * (-zoom.clamp(-MAX_ZOOM_STEP, MAX_ZOOM_STEP)).exp();
        let nearer_by = 1.0 - self.bounded_depth(wanted) / depth;
        let at = Vec3::new(x, -y, 0.0) * self.world_per_pixel(intrinsics) - Vec3::Z * depth;
        if zoom != 0.0 {
            self.move_eye(at * nearer_by);
        }
    }

    /// The present pose.
    pub fn pose(&self) -> Pose {
        Pose::around(self.center, self.world_from_view, self.eye_from_center)
    }

    /// The rotation from view to world space, and the eye relative to the centre in view space.
    /// [`CameraControls::center`] completes the pose.
    pub fn placement(&self) -> (Quat, Vec3) {
        (self.world_from_view, self.eye_from_center)
    }

    /// Takes over another camera's [`CameraControls::center`] and [`CameraControls::placement`]. A position that
    /// these controls cannot reach is refused.
    pub fn place(&mut self, center: Vec3, (world_from_view, eye_from_center): (Quat, Vec3)) -> bool {
        let reach = MAX_DEPTH_IN_RADII * self.radius;
        let is_usable = Pose::around(center, world_from_view, eye_from_center).is_valid()
            && eye_from_center.z == self.bounded_depth(eye_from_center.z)
            && eye_from_center.truncate().length() <= reach
            && (center - self.middle).length() <= reach;
        if is_usable {
            (self.center, self.world_from_view, self.eye_from_center) =
                (center, world_from_view, eye_from_center);
        }
        is_usable
    }

    /// The camera, for a picture of the given size over a volume in `bounds`.
    pub fn camera(&self, intrinsics: Intrinsics, bounds: &Aabb) -> Camera {
        Camera::new(self.pose(), intrinsics, bounds)
    }

    /// The camera of parallel rays. It shows what lies at the centre's depth as large as [`Self::camera`] does in a
    /// perspective picture of the given size. Zooming changes the height of what is seen.
    pub fn parallel_camera(&self, intrinsics: Intrinsics, bounds: &Aabb) -> Camera {
        self.camera(intrinsics, bounds).to_orthographic(self.eye_from_center.z, bounds)
    }

    /// World length of one pixel at the depth of the centre.
    fn world_per_pixel(&self, intrinsics: &Intrinsics) -> f32 {
        2.0 * intrinsics.half_size_at(1.0).1 * self.eye_from_center.z / intrinsics.height.max(1) as f32
    }

    fn move_eye(&mut self, shift: Vec3) {
        let moved = self.eye_from_center + shift;
        // A pointer event with NaN in it, or a pan beyond sight, must not lose the volume.
        if moved.is_finite() && moved.truncate().length() <= MAX_DEPTH_IN_RADII * self.radius {
            self.eye_from_center = moved.with_z(self.bounded_depth(moved.z));
        }
    }

    fn bounded_depth(&self, depth: f32) -> f32 {
        let (least, most) = (MIN_DEPTH_IN_RADII * self.radius, MAX_DEPTH_IN_RADII * self.radius);
        if depth.is_finite() { depth.clamp(least, most) } else { most }
    }
}

fn half_size(bounds: &Aabb) -> Vec3 {
    (bounds.max - bounds.min) * 0.5
}

/// The angle between two viewing poses as seen from the volume's centre, degrees: how far a frame of one must turn to
/// serve the other.
pub fn angle_between_degrees(a: &Pose, b: &Pose, center: Vec3) -> f32 {
    (a.eye - center).angle_between(b.eye - center).to_degrees()
}

/// Magnification (natural logarithm) of one notch of the wheel: 1.15, between ParaView's 1.21 and most editors' 1.1.
pub const ZOOM_PER_NOTCH: f32 = 0.14;
/// Magnification (natural logarithm) of a right drag over the whole height of the picture: about twenty times.
pub const ZOOM_PER_HEIGHT: f32 = 3.0;
/// Nearest distance from the eye to the centre's plane: inside the volume, but never through the centre.
pub const MIN_DEPTH_IN_RADII: f32 = 0.02;
/// Farthest distance of the eye; the volume then covers a few dozen pixels.
pub const MAX_DEPTH_IN_RADII: f32 = 50.0;
/// How much larger than the volume a picture is that it just fits.
const FIT_MARGIN: f32 = 1.05;
/// Largest magnification of one event, so that no event overflows.
const MAX_ZOOM_STEP: f32 = 20.0;

#[cfg(test)]
mod tests {
    use super::*;

    const INTRINSICS: Intrinsics = Intrinsics::perspective(640, 400, 0.7);

    fn bounds() -> Aabb {
        Aabb { min: Vec3::new(-4.0, -2.0, 1.0), max: Vec3::new(4.0, 6.0, 8.0) }
    }

    /// Turned, shifted and zoomed, so that no law holds by symmetry.
    fn controls() -> CameraControls {
        let mut c = CameraControls::new(InitialOrbit::default(), Quat::IDENTITY, &bounds(), &INTRINSICS);
        c.orbit([37.0, -81.0], &INTRINSICS);
        c.pan([20.0, 11.0], &INTRINSICS);
        c.zoom(0.3, [-50.0, 20.0], &INTRINSICS);
        c
    }

    fn pixel_of(c: &CameraControls, p: Vec3) -> [f32; 2] {
        let basis = c.camera(INTRINSICS, &bounds()).basis();
        let h = basis.pixel_from_point(p);
        [h.x / h.z, h.y / h.z]
    }

    fn assert_close(a: [f32; 2], b: [f32; 2], tolerance: f32) {
        assert!((a[0] - b[0]).abs() < tolerance && (a[1] - b[1]).abs() < tolerance, "{a:?} {b:?}");
    }

    fn distance(a: &Pose, b: &Pose) -> f32 {
        let rotation = (1.0 - a.world_from_view.dot(b.world_from_view).abs()).max(0.0);
        (a.eye - b.eye).length() + rotation
    }

    /// A few rounding errors of coordinates up to 640 pixels (2^-24 relative each).
    const PIXEL_TOLERANCE: f32 = 2e-3;
    /// A few rounding errors of world coordinates up to 50 units.
    const WORLD_TOLERANCE: f32 = 1e-4;

    #[test]
    fn the_first_view_is_the_orbit_that_was_asked_for() {
        let initial =
            InitialOrbit { azimuth_degrees: 50.0, elevation_degrees: -10.0, distance_in_radii: Some(3.0) };
        let c = CameraControls::new(initial, Quat::IDENTITY, &bounds(), &INTRINSICS);
        let expect = Pose::orbit(
            bounds().center(),
            50f32.to_radians(),
            (-10f32).to_radians(),
            3.0 * bounds().radius(),
        );
        assert!(distance(&c.pose(), &expect) < WORLD_TOLERANCE);
        let fit = CameraControls::new(InitialOrbit::default(), Quat::IDENTITY, &bounds(), &INTRINSICS);
        let mut again = fit.clone();
        again.fit(&bounds(), &INTRINSICS, false);
        assert_eq!(again.pose(), fit.pose());
        // Control: an orbit of three radii is another view.
        let mut again = c.clone();
        again.fit(&bounds(), &INTRINSICS, false);
        assert!(distance(&again.pose(), &c.pose()) > 0.1);
    }

    #[test]
    fn fit_shows_every_corner_and_leaves_no_more_than_the_margin() {
        let half = Aabb { min: bounds().min, max: bounds().center() };
        for (of, is_parallel) in [(bounds(), false), (bounds(), true), (half, false), (half, true)] {
            let mut c = controls();
            let turned = c.placement().0;
            c.fit(&of, &INTRINSICS, is_parallel);
            assert_eq!(c.placement().0, turned, "the direction stays");
            let camera = match is_parallel {
                true => c.parallel_camera(INTRINSICS, &bounds()),
                false => c.camera(INTRINSICS, &bounds()),
            };
            let basis = camera.basis();
            let edge = |p: Vec3| {
                let h = basis.pixel_from_point(p);
                ((h.x / h.z / 320.0 - 1.0).abs()).max((h.y / h.z / 200.0 - 1.0).abs())
            };
            let most = of.corners().into_iter().map(edge).fold(0.0, f32::max);
            assert!((most - 1.0 / 1.05).abs() < 1e-3, "{is_parallel}: {most} of the way to the edge");
            // Control: half as far away, corners are outside.
            let (turn, eye) = c.placement();
            assert!(c.place(c.center(), (turn, eye * 0.5)));
            let h = c.camera(INTRINSICS, &bounds()).basis();
            let out = of.corners().into_iter().any(|p| {
                let h = h.pixel_from_point(p);
                h.z <= 0.0 || !(0.0..640.0).contains(&(h.x / h.z)) || !(0.0..400.0).contains(&(h.y / h.z))
            });
            assert!(out);
        }
    }

    #[test]
    fn pan_moves_the_projected_centre_by_exactly_these_pixels() {
        for d in [[10.0, 0.0], [0.0, -25.0], [-130.5, 77.25]] {
            let mut c = controls();
            let before = pixel_of(&c, bounds().center());
            c.pan(d, &INTRINSICS);
            let after = pixel_of(&c, bounds().center());
            assert_close(after, [before[0] + d[0], before[1] + d[1]], PIXEL_TOLERANCE);
        }
    }

    #[test]
    fn zoom_keeps_the_point_under_the_pointer_and_its_inverse_undoes_it() {
        let mut c = controls();
        let before = c.pose();
        let at = [120.0, -60.0];
        // The point of the centre's plane under the pointer.
        let camera = c.camera(INTRINSICS, &bounds());
        let (ray, s_per_depth) = camera.ray(320.0 + at[0], 200.0 + at[1]);
        let depth = (bounds().center() - before.eye).dot(before.forward());
        let p = ray.at(depth * s_per_depth);
        c.zoom(0.8, at, &INTRINSICS);
        assert_close(pixel_of(&c, p), [440.0, 140.0], PIXEL_TOLERANCE);
        assert!(distance(&c.pose(), &before) > 1.0);
        c.zoom(-0.8, at, &INTRINSICS);
        assert!(distance(&c.pose(), &before) < WORLD_TOLERANCE);
    }

    #[test]
    fn zoom_magnifies_by_its_exponential() {
        let mut c = CameraControls::new(InitialOrbit::default(), Quat::IDENTITY, &bounds(), &INTRINSICS);
        let tip = bounds().center() + c.world_from_view * Vec3::X;
        let before = pixel_of(&c, tip)[0] - 320.0;
        c.zoom(2f32.ln(), [0.0; 2], &INTRINSICS);
        assert!(((pixel_of(&c, tip)[0] - 320.0) / before - 2.0).abs() < 1e-4);
    }

    #[test]
    fn a_full_turn_returns_and_half_of_it_does_not() {
        for d in [[1.0, 0.0], [0.0, 1.0], [0.6, -0.8]] {
            let mut c = controls();
            let before = c.pose();
            let steps = 800; // twice the shorter side: a whole turn
            for step in 0..steps {
                c.orbit(d, &INTRINSICS);
                if step == steps / 2 {
                    assert!(distance(&c.pose(), &before) > 1.0);
                }
            }
            // 800 products of quaternions, 2^-24 each, at a distance of 20 units.
            assert!(distance(&c.pose(), &before) < 2e-2, "{d:?} {}", distance(&c.pose(), &before));
        }
    }

    #[test]
    fn orbit_keeps_the_centre_on_its_pixel_and_the_near_side_follows_the_pointer() {
        let mut c = controls();
        let before = pixel_of(&c, bounds().center());
        c.orbit([123.0, -45.0], &INTRINSICS);
        assert_close(pixel_of(&c, bounds().center()), before, PIXEL_TOLERANCE);

        let mut c = CameraControls::new(InitialOrbit::default(), Quat::IDENTITY, &bounds(), &INTRINSICS);
        let near_side = bounds().center() - c.pose().forward() * bounds().radius();
        c.orbit([5.0, 3.0], &INTRINSICS);
        let p = pixel_of(&c, near_side);
        assert!(p[0] > 321.0 && p[1] > 200.5, "{p:?}");
    }

    #[test]
    fn roll_turns_the_picture_clockwise_about_the_centre() {
        let mut c = controls();
        let before = pixel_of(&c, bounds().center());
        c.roll(0.7);
        assert_close(pixel_of(&c, bounds().center()), before, PIXEL_TOLERANCE);
        let mut c = CameraControls::new(InitialOrbit::default(), Quat::IDENTITY, &bounds(), &INTRINSICS);
        let right = bounds().center() + c.world_from_view * Vec3::X;
        let at = pixel_of(&c, right)[0] - 320.0;
        c.roll(std::f32::consts::FRAC_PI_2);
        assert_close(pixel_of(&c, right), [320.0, 200.0 + at], PIXEL_TOLERANCE);
        c.roll(f32::NAN);
        assert_close(pixel_of(&c, right), [320.0, 200.0 + at], PIXEL_TOLERANCE);
    }

    #[test]
    fn another_centre_leaves_the_view_and_is_what_turning_turns_about() {
        let mut c = controls();
        let before = c.pose();
        let point = bounds().center() + Vec3::new(1.5, -1.0, 0.5);
        assert!(c.set_center(point));
        assert!(distance(&c.pose(), &before) < WORLD_TOLERANCE);
        let pixel = pixel_of(&c, point);
        c.orbit([70.0, 33.0], &INTRINSICS);
        assert_close(pixel_of(&c, point), pixel, PIXEL_TOLERANCE);
        // Control: the volume's own centre has moved.
        let middle = pixel_of(&c, bounds().center());
        assert!((middle[0] - 320.0).abs() + (middle[1] - 200.0).abs() > 5.0);
        assert!(!c.set_center(c.pose().eye - c.pose().forward()) && !c.set_center(Vec3::NAN));
        assert_eq!(c.center(), point);
        c.reset(&INTRINSICS);
        assert_eq!(c.center(), bounds().center());
    }

    #[test]
    fn standard_views_look_from_their_side_and_keep_the_distance() {
        let mut c = controls();
        let depth = c.eye_from_center.z;
        for (from, up) in [(Vec3::Y, Vec3::Z), (Vec3::NEG_X, Vec3::Z), (Vec3::Z, Vec3::Y)] {
            c.set_center(bounds().center() + Vec3::splat(0.3));
            c.look_from(from, up);
            let pose = c.pose();
            assert!(
                (pose.forward() + from).length() < 1e-6
                    && (pose.world_from_view * Vec3::Y - up).length() < 1e-6
            );
            assert!((pose.eye - bounds().center() - from * c.eye_from_center.z).length() < WORLD_TOLERANCE);
        }
        assert!((c.eye_from_center.z - depth).abs() < 1.0, "no farther than the centres are apart");
    }

    #[test]
    fn reset_returns_to_the_first_view_exactly() {
        let first =
            CameraControls::new(InitialOrbit::default(), Quat::IDENTITY, &bounds(), &INTRINSICS).pose();
        let mut c = controls();
        assert_ne!(c.pose(), first);
        c.reset(&INTRINSICS);
        assert_eq!(c.pose(), first);
        assert!(!c.apply(&ControlInput::default(), &INTRINSICS));
    }

    #[test]
    fn any_input_leaves_a_valid_camera_in_front_of_the_centre() {
        let wild = [0.0, 1.0, -3.5, 1e6, -1e6, 1e30, f32::MAX, f32::INFINITY, f32::NEG_INFINITY, f32::NAN];
        let mut c = controls();
        for (i, &a) in wild.iter().enumerate() {
            for &b in &wild {
                let input = match i % 3 {
                    0 => ControlInput { zoom: a, zoom_at: [b, a], ..Default::default() },
                    1 => ControlInput { orbit: [a, b], pan: [b, a], ..Default::default() },
                    _ => ControlInput { pan: [a, b], zoom: b, orbit: [b, a], ..Default::default() },
                };
                c.apply(&input, &INTRINSICS);
                let camera = c.camera(INTRINSICS, &bounds());
                assert!(camera.is_valid(), "{input:?} {camera:?}");
                let depth = (bounds().center() - camera.pose.eye).dot(camera.pose.forward());
                assert!(depth > 0.0, "{input:?} {depth}");
            }
        }
        for _ in 0..1000 {
            c.zoom(1.0, [0.0; 2], &INTRINSICS);
        }
        assert_eq!(c.eye_from_center.z, MIN_DEPTH_IN_RADII * bounds().radius());
    }

    #[test]
    fn angle_between_two_orbits() {
        let at = |azimuth: f32| Pose::orbit(Vec3::ONE, azimuth.to_radians(), 0.0, 4.0);
        assert!((angle_between_degrees(&at(10.0), &at(35.0), Vec3::ONE) - 25.0).abs() < 1e-2);
    }

    #[test]
    fn another_volume_is_seen_as_the_one_before_but_for_its_size() {
        let mut c = controls();
        assert!(c.set_center(bounds().center() + Vec3::new(0.5, 0.0, 0.25)));
        let other = Aabb { min: bounds().min * 3.0 + 1.0, max: bounds().max * 3.0 + 1.0 };
        let corners = |c: &CameraControls, b: &Aabb| {
            let basis = c.camera(INTRINSICS, b).basis();
            b.corners().map(|p| basis.pixel_from_point(p)).map(|h| [h.x / h.z, h.y / h.z])
        };
        let before = corners(&c, &bounds());
        c.turn_to(&other);
        for (a, b) in before.into_iter().zip(corners(&c, &other)) {
            assert_close(a, b, 10.0 * PIXEL_TOLERANCE);
        }
        c.reset(&INTRINSICS);
        let first = CameraControls::new(InitialOrbit::default(), Quat::IDENTITY, &other, &INTRINSICS);
        assert!(distance(&c.pose(), &first.pose()) < WORLD_TOLERANCE);
    }
}
