//! Are several layered frames one picture? What the newest does not see comes from older ones, without a seam, and
//! nothing else changes.

mod common;
#[path = "common/frames.rs"]
#[expect(dead_code, reason = "each test file uses its own part of the module")]
mod frames;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::kernels::combine::{MAX_FRAMES, choose, combine};
use isinglass_core::kernels::march::render;
use isinglass_core::kernels::raycast::raycast;
use isinglass_core::layer::LayeredFrame;
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;
use isinglass_core::volume::procedural::Builtin;

use self::common::scene;
use self::frames::frame_of;

const PICTURE: Intrinsics = Intrinsics::perspective(72, 56, 0.7);

/// Near enough that the volume goes on beyond the picture on all sides.
fn near(azimuth_degrees: f32, pan: Vec3, bounds: &Aabb) -> Camera {
    let pose = Pose::orbit(bounds.center(), azimuth_degrees.to_radians(), 0.2, 0.8 * bounds.radius());
    let pose = Pose { eye: pose.eye + pose.world_from_view * pan, ..pose };
    Camera::new(pose, PICTURE, bounds)
}

/// Mean and greatest difference of colours and opacity over the pixels that are `counted`.
fn difference(a: &Picture, b: &Picture, counted: impl Fn(usize, usize) -> bool) -> (f32, f32) {
    let width = a.width as usize;
    let (mut sum, mut max, mut n) = (0.0, 0f32, 0);
    for (i, (p, q)) in a.pixels.iter().zip(&b.pixels).enumerate() {
        if counted(i % width, i / width) {
            let off = (0..4).map(|c| (p[c] - q[c]).abs()).fold(0.0, f32::max);
            (sum, max, n) = (sum + off, max.max(off), n + 1);
        }
    }
    (sum / n.max(1) as f32, max)
}

#[test]
fn one_frame_alone_is_cast_as_ever_and_the_own_pose_is_the_newest_frame_s_alone() {
    let scene = scene(Builtin::Shells);
    let bounds = scene.volume.bounds();
    let (here, there) = (near(0.0, Vec3::ZERO, &bounds), near(20.0, Vec3::ZERO, &bounds));
    let (newest, older) = (frame_of(&scene, here, 8), frame_of(&scene, there, 8));
    for camera in [here, there, near(150.0, Vec3::X, &bounds)] {
        assert_eq!(combine(&[&newest], &bounds, &camera), raycast(&newest, &bounds, &camera));
    }
    let own = raycast(&newest, &bounds, &here);
    assert_eq!(combine(&[&newest, &older], &bounds, &here), own);
    // Negative control: where it does look beyond the newest frame, the older one is seen.
    assert_ne!(combine(&[&newest, &older], &bounds, &there), raycast(&newest, &bounds, &there));
    assert!(combine(&[], &bounds, &here).pixels.iter().all(|p| *p == [0.0; 4]));
}

#[test]
fn what_the_newest_frame_does_not_see_comes_from_the_kept_ones() {
    let scene = scene(Builtin::Shells);
    let bounds = scene.volume.bounds();
    let width = bounds.radius() * 0.2;
    // The camera was on the left, went to the middle, and looks to the left again: by panning and by turning.
    for (newest, kept, display) in [
        ((0.0, Vec3::ZERO), (0.0, Vec3::NEG_X * width), (0.0, Vec3::NEG_X * (0.8 * width))),
        ((0.0, Vec3::ZERO), (40.0, Vec3::ZERO), (30.0, Vec3::ZERO)),
        (
            (0.0, Vec3::ZERO),
            (10.0, Vec3::new(1.0, 1.0, 0.0) * width),
            (5.0, Vec3::new(0.9, 0.9, 0.1) * width),
        ),
    ] {
        let [newest, kept, display] = [newest, kept, display].map(|(az, pan)| near(az, pan, &bounds));
        assert_eq!(choose(&display, &newest, &[kept], &bounds), [0]);
        let (newest, kept) = (frame_of(&scene, newest, 8), frame_of(&scene, kept, 8));
        let truth = render(&scene, &display);
        let alone = raycast(&newest, &bounds, &display);
        let together = combine(&[&newest, &kept], &bounds, &display);
        // Where the newest frame alone shows too little: the border that moved in.
        let missing = |x: usize, y: usize| {
            let i = y * PICTURE.width as usize + x;
            truth.pixels[i][3] - alone.pixels[i][3] > 0.05
        };
        let (without, _) = difference(&alone, &truth, missing);
        let (with, _) = difference(&together, &truth, missing);
        // The rest is what novel views are off by anywhere.
        assert!(with < without / 5.0, "{with} {without}");
        // Elsewhere nothing is lost.
        let elsewhere = |x, y| !missing(x, y);
        let (without, with) =
            (difference(&alone, &truth, elsewhere).0, difference(&together, &truth, elsewhere).0);
        assert!(with < without * 1.1, "{with} {without}");
    }
}

#[test]
fn no_seam_shows_where_one_frame_ends() {
    // Frames that disagree: the kept one is of twice the brightness. The picture goes over from one to the other
    // gradually, while a hard change would show as a step.
    let scene = scene(Builtin::Shells);
    let bounds = scene.volume.bounds();
    let width = bounds.radius() * 0.2;
    let newest = frame_of(&scene, near(0.0, Vec3::ZERO, &bounds), 8);
    let mut kept = frame_of(&scene, near(0.0, Vec3::NEG_X * width, &bounds), 8);
    for i in 0..kept.num_segments() {
        let mut s = kept.segment(i);
        s.c *= 2.0;
        [kept.depth[i], kept.c_rg[i], kept.c_b_tau[i]] = s.pack();
    }
    let display = near(0.0, Vec3::NEG_X * (0.5 * width), &bounds);
    let together = combine(&[&newest, &kept], &bounds, &display);
    let truth = render(&scene, &display);
    // How much brighter than the truth each column is: 2 on the left, 1 on the right.
    let ratio = |x: usize| {
        let sum = |p: &Picture| -> f32 {
            (0..PICTURE.height as usize).map(|y| p.pixels[y * PICTURE.width as usize + x][1]).sum()
        };
        sum(&together) / sum(&truth)
    };
    let ratios: Vec<f32> = (0..PICTURE.width as usize).map(ratio).collect();
    assert!(ratios[0] > 1.8 && *ratios.last().unwrap() < 1.1, "{ratios:?}");
    let step = ratios.windows(2).map(|r| (r[0] - r[1]).abs()).fold(0.0, f32::max);
    // The whole change of 1 over a band of eight lists is an eighth a pixel; rays that cross the border at some depth
    // spread it further, the noise of the reconstruction adds to it.
    assert!(step < 0.25, "{step}: {ratios:?}");
}

#[test]
fn as_the_camera_leaves_the_newest_frame_nothing_jumps() {
    let scene = scene(Builtin::Shells);
    let bounds = scene.volume.bounds();
    let newest = frame_of(&scene, near(0.0, Vec3::ZERO, &bounds), 8);
    let kept = frame_of(&scene, near(25.0, Vec3::ZERO, &bounds), 8);
    let at = |az: f32| combine(&[&newest, &kept], &bounds, &near(az, Vec3::ZERO, &bounds));
    let everywhere = |_: usize, _: usize| true;
    let mut before = at(0.0);
    for i in 1..=8 {
        let now = at(0.05 * i as f32);
        let alone = raycast(&newest, &bounds, &near(0.05 * i as f32, Vec3::ZERO, &bounds));
        // A twentieth of a degree is a twentieth of a pixel, so pictures differ by about that part of the contrast.
        assert!(difference(&now, &before, everywhere).0 < 5e-3);
        assert!(difference(&now, &alone, everywhere).0 < 5e-3);
        before = now;
    }
}

#[test]
fn frames_are_chosen_that_add_what_is_missing() {
    let bounds = scene(Builtin::Shells).volume.bounds();
    let camera = |az: f32| near(az, Vec3::ZERO, &bounds);
    let newest = camera(0.0);
    // Seen whole, nothing is missing.
    let far = Camera::new(Pose::orbit(Vec3::ZERO, 0.5, 0.0, 5.0 * bounds.radius()), PICTURE, &bounds);
    assert!(choose(&far, &far, &[camera(20.0)], &bounds).is_empty());
    assert!(choose(&newest, &newest, &[camera(20.0), camera(-20.0)], &bounds).is_empty());
    // A frame of the same camera adds nothing; the one towards which the camera turns adds most.
    assert_eq!(choose(&camera(20.0), &newest, &[newest, camera(20.0)], &bounds)[0], 1);
    assert!(!choose(&camera(20.0), &newest, &[newest, camera(20.0)], &bounds).contains(&0));
    // Of two alike the later; and not both.
    assert_eq!(choose(&camera(20.0), &newest, &[camera(20.0), camera(20.0)], &bounds), [1]);
    let many: Vec<Camera> = (0..40).map(|i| camera(9.0 * i as f32)).collect();
    assert!(choose(&camera(90.0), &camera(200.0), &many, &bounds).len() < MAX_FRAMES);
}

#[test]
fn odd_cameras_are_survived() {
    let scene = scene(Builtin::Shells);
    let bounds = scene.volume.bounds();
    // Back to back, inside the volume, beside it, far away.
    let cameras: Vec<Camera> = [(0.0, 1.3), (180.0, 0.2), (90.0, 0.0), (45.0, 30.0)]
        .map(|(az, d): (f32, f32)| {
            let pose = Pose::orbit(bounds.center(), az.to_radians(), 0.0, d * bounds.radius());
            Camera::new(pose, PICTURE, &bounds)
        })
        .to_vec();
    let frames: Vec<LayeredFrame> = cameras.iter().map(|c| frame_of(&scene, *c, 8)).collect();
    for camera in &cameras {
        for first in 0..frames.len() {
            let mut order: Vec<&LayeredFrame> = frames.iter().collect();
            order.rotate_left(first);
            let picture = combine(&order, &bounds, camera);
            assert!(picture.pixels.iter().flatten().all(|x| x.is_finite() && *x >= -1e-6), "{first}");
        }
    }
}
