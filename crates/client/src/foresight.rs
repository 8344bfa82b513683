//! What is asked for beyond the picture of this moment: where the camera will be, and what lies beside its view.

use isinglass_core::camera::{Camera, Intrinsics, Pose};

use isinglass_core::space::Aabb;

/// What a viewer does against the delay of its frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Foresight {
    /// Frames are asked for from where the camera will be when they are shown.
    pub predicts: bool,
    /// Frames are asked for with a margin around the picture where the volume goes on beyond it.
    pub guards: bool,
    /// What the newest frame does not see is taken from older ones.
    pub keeps: bool,
}

impl Default for Foresight {
    fn default() -> Self {
        Self { predicts: true, guards: true, keeps: true }
    }
}

impl Foresight {
    /// Nothing.
    pub const NONE: Self = Self { predicts: false, guards: false, keeps: false };
}

/// What the server makes at most.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Limits {
    /// Columns and rows.
    pub(crate) max_side: u32,
    /// Columns times rows.
    pub(crate) max_lists: usize,
}

/// The largest margin that a frame gets whose picture alone would be `frame`: as much as there is to see beside it, a
/// seventh of its longer side at most, and within what the server makes.
pub(crate) fn widest(frame: Camera, bounds: &Aabb, limits: Limits) -> Intrinsics {
    guarded(frame, bounds, limits, f32::INFINITY)
}

/// The frame for a camera that moves: with a margin as wide as the picture moves on the way from `now` to `reach`.
pub(crate) fn guard_band(frame: Camera, now: Pose, reach: Pose, bounds: &Aabb, limits: Limits) -> Intrinsics {
    let basis = |pose| Camera { pose, ..frame }.basis();
    let (from, to) = (basis(now), basis(reach));
    let shift = |corner| {
        let (a, b) = (from.pixel_from_world(corner - from.eye), to.pixel_from_world(corner - to.eye));
        let moved = (a.truncate() / a.z - b.truncate() / b.z).abs().max_element();
        // Behind the eye there is no picture that could move.
        if a.z > 0.0 && b.z > 0.0 { moved } else { f32::INFINITY }
    };
    let moved = bounds.corners().into_iter().map(shift).fold(0.0, f32::max);
    guarded(frame, bounds, limits, moved)
}

fn guarded(frame: Camera, bounds: &Aabb, limits: Limits, moved: f32) -> Intrinsics {
    let i = frame.intrinsics;
    let longer = i.width.max(i.height) as f32;
    let wanted = moved.clamp(LEAST_SHARE * longer, GREATEST_SHARE * longer).min(frame.overhang(bounds));
    // Whole tiles, so that frames do not change their size at every refresh.
    let mut margin = (wanted / TILE).ceil() as u32 * TILE as u32;
    let fits = |margin: u32| {
        let wide = i.with_margin(margin);
        let fits = wide.width.max(wide.height) <= limits.max_side && wide.num_pixels() <= limits.max_lists;
        fits && wide.fov_y < MAX_FOV_Y
    };
    while margin > 0 && !fits(margin) {
        margin -= TILE as u32;
    }
    i.with_margin(margin)
}

/// Margins are multiples of this many pixels: the codec's tiles.
const TILE: f32 = 16.0;
/// Least and greatest margin on each side, in units of the longer side. The least is what a hand that starts moves
/// within a short round trip; the greatest makes a frame 1.7 times as large.
const LEAST_SHARE: f32 = 0.04;
const GREATEST_SHARE: f32 = 0.15;
/// Wider views are refused by the server.
const MAX_FOV_Y: f32 = 3.0;

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use isinglass_core::layer::{MAX_LISTS, max_lists};

    use super::*;

    const BOUNDS: Aabb = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };
    const LIMITS: Limits = Limits { max_side: 8192, max_lists: MAX_LISTS };
    const PICTURE: Intrinsics = Intrinsics { width: 320, height: 200, fov_y: 0.7 };

    fn at(azimuth: f32, distance: f32) -> Camera {
        Camera::new(Pose::orbit(Vec3::ZERO, azimuth, 0.2, distance), PICTURE, &BOUNDS)
    }

    #[test]
    fn a_volume_inside_the_picture_needs_no_margin() {
        let camera = at(0.0, 8.0);
        assert_eq!(widest(camera, &BOUNDS, LIMITS), PICTURE);
        assert_eq!(guard_band(camera, at(0.0, 8.0).pose, at(0.5, 8.0).pose, &BOUNDS, LIMITS), PICTURE);
    }

    #[test]
    fn the_margin_grows_with_the_movement_up_to_its_limit() {
        let (near, margin) = (at(0.0, 2.5), |i: Intrinsics| i.margin_around(&PICTURE).unwrap());
        let to = |azimuth| margin(guard_band(near, near.pose, at(azimuth, 2.5).pose, &BOUNDS, LIMITS));
        assert_eq!((to(0.0), to(0.15), to(1.0)), (16, 32, 48));
        assert_eq!(margin(widest(near, &BOUNDS, LIMITS)), 48);
        // A volume that only just sticks out needs no more than that.
        let distances = (0..100).map(|i| 3.0 + 0.05 * i as f32);
        let just =
            distances.map(|d| at(0.0, d)).find(|c| (0.1..16.0).contains(&c.overhang(&BOUNDS))).unwrap();
        assert_eq!(margin(widest(just, &BOUNDS, LIMITS)), 16);
    }

    #[test]
    fn the_server_s_limits_hold() {
        let near = at(0.0, 2.5);
        assert_eq!(widest(near, &BOUNDS, Limits { max_side: 320, ..LIMITS }), PICTURE);
        assert_eq!(widest(near, &BOUNDS, Limits { max_side: 360, ..LIMITS }).width, 352);
        let full_hd = Intrinsics { width: 1920, height: 1080, fov_y: 0.7 };
        let margin = |i: Intrinsics, k| {
            let limits = Limits { max_lists: max_lists(k), ..LIMITS };
            let wide = widest(Camera { intrinsics: i, ..near }, &BOUNDS, limits);
            assert!(wide.num_pixels() <= max_lists(k));
            wide.margin_around(&i).unwrap()
        };
        // The largest pictures have room for a movement, too; longer lists leave less of it.
        assert_eq!([1, 8, 12, 32].map(|k| margin(full_hd, k)), [160, 160, 48, 32]);
        assert_eq!(margin(Intrinsics { height: 1200, ..full_hd }, 8), 112);
        let open = Intrinsics { fov_y: 2.99, ..PICTURE };
        assert_eq!(widest(Camera { intrinsics: open, ..near }, &BOUNDS, LIMITS), open);
    }
}
