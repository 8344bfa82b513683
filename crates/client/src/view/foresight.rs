//! What the viewer requests beyond the present picture: a predicted camera, and a margin around its view.

use isinglass_core::camera::{Camera, Intrinsics, Pose, Projection};

use isinglass_core::space::Aabb;

/// A viewer's measures against latency.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Foresight {
    /// Requests frames for the predicted camera.
    pub predicts: bool,
    /// Requests frames with a margin where the volume continues beyond the picture.
    pub guards: bool,
    /// Fills what the newest frame lacks from older ones.
    pub keeps: bool,
}

impl Default for Foresight {
    fn default() -> Self {
        Self { predicts: true, guards: true, keeps: true }
    }
}

impl Foresight {
    /// No measure.
    pub const NONE: Self = Self { predicts: false, guards: false, keeps: false };
}

#[derive(Clone, Copy, Debug)]
pub(crate) struct Limits {
    /// Most columns or rows.
    pub(crate) max_side: u32,
    /// Most columns times rows.
    pub(crate) max_lists: usize,
}

/// The largest margin around the picture `frame`: what is visible beside it, at most a seventh of its longer side,
/// and within the server's limits.
pub(crate) fn widest(frame: Camera, bounds: &Aabb, limits: Limits) -> Intrinsics {
    guarded(frame, bounds, limits, f32::INFINITY)
}

/// The frame for a moving camera, with a margin as wide as the picture moves from `now` to `reach`.
pub(crate) fn guard_band(
    frame: Camera,
    now: &Camera,
    reach: &Camera,
    bounds: &Aabb,
    limits: Limits,
) -> Intrinsics {
    let basis = |camera: &Camera| {
        let projection = camera.intrinsics.projection;
        let intrinsics = Intrinsics { projection, ..frame.intrinsics };
        Camera { pose: camera.pose, intrinsics, ..frame }.basis()
    };
    let (from, to) = (basis(now), basis(reach));
    let shift = |corner| {
        let (a, b) = (from.pixel_from_point(corner), to.pixel_from_point(corner));
        let moved = (a.truncate() / a.z - b.truncate() / b.z).abs().max_element();
        // Behind the eye there is no picture.
        if a.z > 0.0 && b.z > 0.0 { moved } else { f32::INFINITY }
    };
    let moved = bounds.corners().into_iter().map(shift).fold(0.0, f32::max);
    guarded(frame, bounds, limits, moved)
}

/// The pose of an eye whose picture moves like the camera's. Zooming with parallel rays changes the height of the
/// picture and not the eye, so here the distance grows with the height.
pub(crate) fn eye_of(camera: &Camera, bounds: &Aabb) -> Pose {
    let Projection::Orthographic { height } = camera.intrinsics.projection else { return camera.pose };
    let forward = camera.pose.forward();
    let depth = (bounds.center() - camera.pose.eye).dot(forward);
    Pose { eye: camera.pose.eye + forward * (depth - height * DISTANCE_PER_HEIGHT), ..camera.pose }
}

/// The camera like `camera` whose [`eye_of`] is at `eye`.
pub(crate) fn camera_of(eye: Pose, camera: &Camera, bounds: &Aabb) -> Camera {
    if !camera.intrinsics.projection.is_orthographic() {
        return Camera { pose: eye, ..*camera };
    }
    let depth = (bounds.center() - eye.eye).dot(eye.forward());
    let projection = Projection::Orthographic { height: depth / DISTANCE_PER_HEIGHT };
    let projection = if projection.is_valid() { projection } else { camera.intrinsics.projection };
    let intrinsics = Intrinsics { projection, ..camera.intrinsics };
    Camera { pose: eye.before(bounds), intrinsics, ..*camera }
}

fn guarded(frame: Camera, bounds: &Aabb, limits: Limits, moved: f32) -> Intrinsics {
    let i = frame.intrinsics;
    let longer = i.width.max(i.height) as f32;
    let wanted = moved.clamp(LEAST_SHARE * longer, GREATEST_SHARE * longer).min(frame.overhang(bounds));
    // Whole tiles keep the size of frames from changing at every refresh.
    let mut margin = (wanted / TILE).ceil() as u32 * TILE as u32;
    let fits = |margin: u32| {
        let wide = i.with_margin(margin);
        let fits = wide.width.max(wide.height) <= limits.max_side && wide.num_pixels() <= limits.max_lists;
        fits && wide.fov_y() < MAX_FOV_Y
    };
    while margin > 0 && !fits(margin) {
        margin -= TILE as u32;
    }
    i.with_margin(margin)
}

/// Margins are multiples of this many pixels: the codec's tiles.
const TILE: f32 = 16.0;
/// Least and greatest margin on each side, in units of the longer side. The least covers a hand's first movement in a
/// short round trip; the greatest makes a frame 1.7 times as large.
const LEAST_SHARE: f32 = 0.04;
const GREATEST_SHARE: f32 = 0.15;
/// The distance of an eye with a field of view of 0.7 radians.
const DISTANCE_PER_HEIGHT: f32 = 1.37;
/// The server refuses wider views.
const MAX_FOV_Y: f32 = 3.0;

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use isinglass_core::layer::{MAX_LISTS, max_lists};

    use super::*;

    const BOUNDS: Aabb = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };
    const LIMITS: Limits = Limits { max_side: 8192, max_lists: MAX_LISTS };
    const PICTURE: Intrinsics = Intrinsics::perspective(320, 200, 0.7);

    fn at(azimuth: f32, distance: f32) -> Camera {
        Camera::new(Pose::orbit(Vec3::ZERO, azimuth, 0.2, distance), PICTURE, &BOUNDS)
    }

    #[test]
    fn a_volume_inside_the_picture_needs_no_margin() {
        let camera = at(0.0, 8.0);
        assert_eq!(widest(camera, &BOUNDS, LIMITS), PICTURE);
        assert_eq!(guard_band(camera, &at(0.0, 8.0), &at(0.5, 8.0), &BOUNDS, LIMITS), PICTURE);
    }

    #[test]
    fn the_margin_grows_with_the_movement_up_to_its_limit() {
        let (near, margin) = (at(0.0, 2.5), |i: Intrinsics| i.margin_around(&PICTURE).unwrap());
        let to = |azimuth| margin(guard_band(near, &near, &at(azimuth, 2.5), &BOUNDS, LIMITS));
        assert_eq!((to(0.0), to(0.15), to(1.0)), (16, 32, 48));
        assert_eq!(margin(widest(near, &BOUNDS, LIMITS)), 48);
        // A volume that only just sticks out needs no more than that.
        let distances = (0..100).map(|i| 3.0 + 0.05 * i as f32);
        let just =
            distances.map(|d| at(0.0, d)).find(|c| (0.1..16.0).contains(&c.overhang(&BOUNDS))).unwrap();
        assert_eq!(margin(widest(just, &BOUNDS, LIMITS)), 16);
    }

    #[test]
    fn parallel_rays_have_an_eye_to_be_foreseen_by() {
        let parallel = at(0.3, 6.0).to_orthographic(6.0, &BOUNDS);
        let eye = eye_of(&parallel, &BOUNDS);
        let back = camera_of(eye, &parallel, &BOUNDS);
        // A few roundings of numbers of the order of 10.
        assert!((back.pose.eye - parallel.pose.eye).length() < 1e-5);
        assert!((back.basis().up - parallel.basis().up).length() < 1e-5);
        let nearer = camera_of(Pose { eye: eye.eye * 0.5, ..eye }, &parallel, &BOUNDS);
        assert!(
            (nearer.basis().up * 2.0 - parallel.basis().up).length() < 1e-5,
            "half as far shows half as much"
        );
        let behind = Pose { eye: -eye.eye, ..eye };
        assert!(camera_of(behind, &parallel, &BOUNDS).is_valid());
        assert_eq!(eye_of(&at(0.3, 6.0), &BOUNDS), at(0.3, 6.0).pose);
        // A margin is asked for where there is something beside the picture, as wide as it moves.
        let zoomed = at(0.3, 6.0).to_orthographic(1.5, &BOUNDS);
        let turned = at(0.6, 6.0).to_orthographic(1.5, &BOUNDS);
        let margin = |i: Intrinsics| i.margin_around(&zoomed.intrinsics).unwrap();
        assert_eq!(margin(guard_band(zoomed, &zoomed, &turned, &BOUNDS, LIMITS)), 48);
        assert_eq!(margin(guard_band(zoomed, &zoomed, &zoomed, &BOUNDS, LIMITS)), 16);
        assert_eq!(widest(parallel, &BOUNDS, LIMITS), parallel.intrinsics);
    }

    #[test]
    fn the_server_s_limits_hold() {
        let near = at(0.0, 2.5);
        assert_eq!(widest(near, &BOUNDS, Limits { max_side: 320, ..LIMITS }), PICTURE);
        assert_eq!(widest(near, &BOUNDS, Limits { max_side: 360, ..LIMITS }).width, 352);
        let full_hd = Intrinsics::perspective(1920, 1080, 0.7);
        let margin = |i: Intrinsics, k| {
            let limits = Limits { max_lists: max_lists(k), ..LIMITS };
            let wide = widest(Camera { intrinsics: i, ..near }, &BOUNDS, limits);
            assert!(wide.num_pixels() <= max_lists(k));
            wide.margin_around(&i).unwrap()
        };
        // The largest pictures have room for a movement, too; longer lists leave less of it.
        assert_eq!([1, 8, 12, 32].map(|k| margin(full_hd, k)), [160, 160, 48, 32]);
        assert_eq!(margin(Intrinsics { height: 1200, ..full_hd }, 8), 112);
        let open = PICTURE.with_fov_y(2.99);
        assert_eq!(widest(Camera { intrinsics: open, ..near }, &BOUNDS, LIMITS), open);
    }
}
