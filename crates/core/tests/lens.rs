//! Stereo pairs, depth of field and motion blur from one layered frame: against closed forms, and against brute-force
//! averages of full renderings.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use glam::{Vec2, Vec3};
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::image_error::compare;
use isinglass_core::kernels::layering::generate;
use isinglass_core::kernels::lens::{
    Exposure, View, disc_point, mean_picture, pose_between, raycast_mean, render_mean,
};
use isinglass_core::kernels::march::{MarchSettings, Scene};
use isinglass_core::kernels::raycast::raycast;
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Volume, Voxels};

const INTRINSICS: Intrinsics = Intrinsics::perspective(72, 64, 0.7);

fn scene(volume: Volume, most_opaque: f32) -> Scene {
    let p = |x, color, opacity| ControlPoint { x, color, opacity };
    let transfer = TransferFunction {
        name: "test".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Radius(0.02),
        points: vec![
            p(0.0, [0.1, 0.2, 0.9], 0.0),
            p(0.3, [0.2, 0.8, 0.5], 0.1 * most_opaque),
            p(1.0, [1.0, 0.9, 0.7], most_opaque),
        ],
    };
    Scene::new(Arc::new(volume), &transfer, MarchSettings::default())
}

/// A ball of a few voxels in an empty box, at `at` in voxels from the middle; thin enough that light adds up.
fn ball(at: Vec3) -> Scene {
    let n = 41u32;
    let voxel = |i: u32| {
        let p = Vec3::new((i % n) as f32, (i / n % n) as f32, (i / n / n) as f32) - Vec3::splat(20.0);
        (250.0 * (1.0 - (p - at).length() / 2.5).max(0.0)) as u8
    };
    let voxels = Voxels::U8((0..n * n * n).map(voxel).collect());
    let volume = Volume::new([n; 3], Vec3::splat(0.5), voxels, (1.0, 0.0), Default::default()).unwrap();
    scene(volume, 0.05)
}

fn camera_at(azimuth: f32, bounds: &Aabb) -> Camera {
    let distance = bounds.radius() * INTRINSICS.fit_distance();
    Camera::new(Pose::orbit(bounds.center(), azimuth, 0.3, distance), INTRINSICS, bounds)
}

fn frame_of(scene: &Scene, camera: Camera) -> LayeredFrame {
    let header = FrameHeader::alone(camera, 12);
    generate(scene, header)
}

fn pinhole(focus_depth: f32) -> Exposure {
    Exposure { aperture_radius: 0.0, focus_depth, shutter: None, num_samples: 16 }
}

fn dssim(a: &Picture, b: &Picture) -> f64 {
    let [a8, b8] = [a, b].map(|p| p.to_srgb8([0.0; 3]));
    compare(&a8, &b8, a.width as usize, a.height as usize, [0; 3]).unwrap().dssim
}

/// Centroid and variance of the opacity along x and y, pixels.
fn moments(picture: &Picture) -> (Vec2, Vec2) {
    let weighted = || {
        picture.pixels.iter().enumerate().map(|(i, p)| {
            let at = Vec2::new((i as u32 % picture.width) as f32, (i as u32 / picture.width) as f32) + 0.5;
            (at, p[3])
        })
    };
    let total = weighted().map(|(_, w)| w).sum::<f32>();
    let centroid = weighted().map(|(at, w)| at * w).sum::<Vec2>() / total;
    (centroid, weighted().map(|(at, w)| (at - centroid) * (at - centroid) * w).sum::<Vec2>() / total)
}

#[test]
fn without_eye_distance_aperture_and_movement_it_is_the_plain_view_to_the_bit() {
    let scene = scene(Builtin::Cloud.volume(32), 0.5);
    let bounds = scene.volume.bounds();
    let frame = frame_of(&scene, camera_at(0.2, &bounds));
    let camera = camera_at(0.35, &bounds);
    let plain = raycast(&frame, &bounds, &camera);
    let [left, right] = View::from(&camera).stereo(0.0, 7.0);
    assert_eq!((left, right), (View::from(&camera), View::from(&camera)));
    assert_eq!(raycast_mean(&frame, &bounds, &[left]), plain);
    for exposure in [pinhole(5.0), Exposure { shutter: Some(camera.pose), ..pinhole(5.0) }] {
        assert_eq!(raycast_mean(&frame, &bounds, &exposure.views(&camera, &bounds)), plain);
    }
    // Negative control: a little of each is something else.
    let [left, right] = View::from(&camera).stereo(0.2, 7.0);
    assert_ne!(raycast_mean(&frame, &bounds, &[left]), raycast_mean(&frame, &bounds, &[right]));
    let lens = Exposure { aperture_radius: 0.2, ..pinhole(5.0) };
    assert_ne!(raycast_mean(&frame, &bounds, &lens.views(&camera, &bounds)), plain);
}

/// From anywhere on the lens the plane at the focus is where it was; a plane at depth z moves by o·(1 − f/z) as
/// measured on the focus plane; view depths stay.
#[test]
fn a_shifted_eye_keeps_the_focus_plane_and_all_depths() {
    let bounds = Aabb { min: Vec3::splat(-4.0), max: Vec3::splat(4.0) };
    let camera = camera_at(0.7, &bounds);
    let (view, q) = (View::from(&camera), camera.pose.world_from_view);
    let focus = 9.0;
    for offset in [Vec2::new(0.4, 0.0), Vec2::new(-0.3, 0.7)] {
        let shifted = view.shifted(offset, focus);
        for (x, y) in [(0.5, 0.5), (40.0, 22.5), (71.5, 60.0)] {
            let at = |v: &View, depth: f32| {
                let (ray, s_per_depth) = v.basis.ray(x, y);
                let p = ray.at(depth * s_per_depth);
                // Whatever the eye, the ray's parameter is the view depth of the camera.
                assert!(((p - camera.pose.eye).dot(camera.pose.forward()) - depth).abs() < 1e-4);
                p
            };
            // Single precision, a few operations on numbers of the order of 10.
            assert!((at(&view, focus) - at(&shifted, focus)).length() < 1e-4);
            for z in [5.0, 14.0] {
                let moved = at(&shifted, z) - at(&view, z);
                let expected = q * (offset * (1.0 - z / focus)).extend(0.0);
                assert!((moved - expected).length() < 1e-4, "{moved} {expected}");
                assert!(moved.length() > 0.1, "negative control: another plane does move");
            }
        }
    }
}

#[test]
fn lens_points_are_spread_evenly_for_any_number() {
    for n in [5, 16, 33, 64, 256] {
        let points: Vec<Vec2> = (0..n).map(|i| disc_point(i, n)).collect();
        let mean_square = points.iter().map(|p| p.length_squared()).sum::<f32>() / n as f32;
        // Of a uniform disc: the radii are those of rings of equal areas, so the sum is exact.
        assert!((mean_square - 0.5).abs() < 1e-5 && points.iter().all(|p| p.length() < 1.0));
        let centroid = points.iter().sum::<Vec2>() / n as f32;
        assert!(centroid.length() < 0.6 / n as f32, "{n}: {centroid}");
        let nearest = |points: &[Vec2]| {
            let each = points.iter().enumerate();
            each.flat_map(|(i, a)| points[..i].iter().map(move |b| a.distance(*b))).fold(2.0, f32::min)
        };
        // The spacing of a square grid of n points over the disc is √(π/n); random points come as near as 1/n.
        let spacing = (std::f32::consts::PI / n as f32).sqrt();
        assert!(nearest(&points) > 0.6 * spacing, "{n}: {} of {spacing}", nearest(&points));
        // Negative control: turned by a third of a turn each, they lie on three lines.
        let lines: Vec<Vec2> = (0..n)
            .map(|i| Vec2::from_angle(i as f32 * std::f32::consts::TAU / 3.0) * disc_point(i, n).length())
            .collect();
        assert!(n < 16 || nearest(&lines) < 0.6 * spacing);
    }
}

/// Every time once, evenly; and an orbit stays one, where a straight line would come nearer.
#[test]
fn a_shutter_is_open_at_all_times_alike() {
    let bounds = Aabb { min: Vec3::splat(-3.0), max: Vec3::splat(5.0) };
    let (open, close) = (camera_at(0.2, &bounds), camera_at(1.4, &bounds));
    let distance = open.pose.eye.distance(bounds.center());
    for n in [1, 2, 7, 12, 64, 100] {
        let lens = Exposure { aperture_radius: 0.3, focus_depth: distance, ..pinhole(1.0) };
        for exposure in [pinhole(distance), lens] {
            let exposure = Exposure { shutter: Some(close.pose), num_samples: n, ..exposure };
            let views = exposure.views(&open, &bounds);
            let mut azimuths: Vec<f32> = views
                .iter()
                .map(|v| {
                    // The basis knows where its camera was, whatever point of the lens it sees from.
                    let back = v.basis.right.cross(v.basis.up);
                    back.x.atan2(back.z)
                })
                .collect();
            azimuths.sort_by(f32::total_cmp);
            for (i, azimuth) in azimuths.iter().enumerate() {
                // Slerp between two turns about different axes leaves the orbit's own azimuth by so little.
                let expected = 0.2 + 1.2 * (i as f32 + 0.5) / n as f32;
                assert!((azimuth - expected).abs() < 0.02, "{n}: {azimuth} {expected}");
            }
        }
    }
    let halfway = pose_between(&open.pose, &close.pose, bounds.center(), 0.5);
    assert!((halfway.eye.distance(bounds.center()) - distance).abs() < 1e-4 * distance);
    assert!(open.pose.interpolate(&close.pose, 0.5).eye.distance(bounds.center()) < 0.9 * distance);
}

/// A ball at depth z becomes a disc of radius a·|1/f − 1/z|·(h/2)/tan(fov/2) pixels: a convolution adds variances, and
/// that of a disc of radius R is R²/4 along each axis. At the focus it stays as sharp as it is.
#[test]
fn blur_has_the_radius_of_the_circle_of_confusion() {
    let scene = ball(Vec3::new(2.0, 0.0, -4.0));
    let bounds = scene.volume.bounds();
    let camera = camera_at(0.0, &bounds);
    let frame = frame_of(&scene, camera);
    let at = Vec3::new(1.0, 0.0, -2.0);
    let z = (at - camera.pose.eye).dot(camera.pose.forward());
    let pixels = INTRINSICS.height as f32 * 0.5 / (INTRINSICS.fov_y() * 0.5).tan();
    let sharp = moments(&raycast(&frame, &bounds, &camera));
    for (aperture_radius, focus_depth) in [(2.0, z), (2.0, 0.85 * z), (2.0, 1.2 * z), (1.0, 0.8 * z)] {
        let exposure = Exposure { aperture_radius, num_samples: 64, ..pinhole(focus_depth) };
        let blurred = moments(&raycast_mean(&frame, &bounds, &exposure.views(&camera, &bounds)));
        let radius = aperture_radius * (1.0 / focus_depth - 1.0 / z).abs() * pixels;
        let added = blurred.1 - sharp.1;
        let expected = radius * radius / 4.0;
        // Lists are a pixel wide, and a view from the lens's rim smears the ball, three pixels high, by a fraction of one.
        let tolerance = 0.05 * expected + 0.25;
        assert!((added - expected).abs().max_element() < tolerance, "f {focus_depth}: {added} {expected}");
        assert!((blurred.0 - sharp.0).length() < 0.15, "the middle stays: {blurred:?} {sharp:?}");
        // Negative control: with twice the lens, the law of this one fails.
        let wide = Exposure { aperture_radius: 2.0 * aperture_radius, ..exposure };
        let wide = moments(&raycast_mean(&frame, &bounds, &wide.views(&camera, &bounds))).1 - sharp.1;
        assert!(focus_depth == z || (wide - expected).abs().min_element() > tolerance, "{wide} {expected}");
    }
}

/// The left eye sees what is nearer than the focus further to the right, by e·(1/z − 1/f)·(h/2)/tan(fov/2) pixels in all.
#[test]
fn eyes_see_the_parallax_of_their_distance() {
    let pixels = INTRINSICS.height as f32 * 0.5 / (INTRINSICS.fov_y() * 0.5).tan();
    for along in [-8.0, 0.0, 8.0] {
        let scene = ball(Vec3::new(0.0, 2.0, along));
        let bounds = scene.volume.bounds();
        let camera = camera_at(0.0, &bounds);
        let at = Vec3::new(0.0, 1.0, 0.5 * along);
        let z = (at - camera.pose.eye).dot(camera.pose.forward());
        let frame = frame_of(&scene, camera);
        let (eye_distance, focus) = (24.0, camera.pose.eye.length());
        let eyes = View::from(&camera).stereo(eye_distance, focus);
        let [left, right] = eyes.map(|view| moments(&raycast_mean(&frame, &bounds, &[view])).0);
        let parallax = left - right;
        let expected = eye_distance * (1.0 / z - 1.0 / focus) * pixels;
        // Along its own rays a list's matter lies anywhere within a pixel: half a pixel for each eye, both the same way.
        assert!((parallax.x - expected).abs() < 1.0, "{along}: {parallax} {expected}");
        assert!(parallax.y.abs() < 0.1, "no vertical parallax: {parallax}");
        let noticed = (parallax.x + expected).abs() > 2.0;
        assert!(noticed || along == 0.0, "negative control: swapped eyes, {parallax} {expected}");
    }
}

/// The mean of novel views against the mean of full renderings.
#[test]
fn averages_are_those_of_full_renderings() {
    for builtin in Builtin::ALL {
        let scene = scene(builtin.volume(48), 0.6);
        let bounds = scene.volume.bounds();
        let camera = camera_at(0.5, &bounds);
        let frame = frame_of(&scene, camera);
        let (r, focus) = (bounds.radius(), camera.pose.eye.length());
        let close = camera_at(0.8, &bounds).pose;
        let lens = Exposure { aperture_radius: 0.4 * r, ..pinhole(focus) };
        let front = Exposure { focus_depth: focus - 0.8 * r, ..lens };
        let shutter = Exposure { shutter: Some(close), ..pinhole(focus) };
        let both = Exposure { shutter: Some(close), ..front };
        let novel = |e: &Exposure| raycast_mean(&frame, &bounds, &e.views(&camera, &bounds));
        let truth = |e: &Exposure| render_mean(&scene, &e.views(&camera, &bounds));
        for (name, exposure, wrong) in [
            ("lens, no aperture", lens, pinhole(focus)),
            ("lens, wrong focus", lens, front),
            ("in front, wrong focus", front, lens),
            ("shutter, none", shutter, pinhole(focus)),
            ("both, lens only", both, front),
            ("both, shutter only", both, shutter),
        ] {
            let truth = truth(&exposure);
            let (error, control) = (dssim(&novel(&exposure), &truth), dssim(&novel(&wrong), &truth));
            println!("{} {name}: {error:.5}, control {control:.5}", builtin.name());
            // Less than a single novel view at such a turn has at this size, below: an average is not worse than its views.
            assert!(error < 0.015, "{} {name}: {error}", builtin.name());
            // The least difference is that which half of an effect makes beside the other half.
            assert!(control > 1.5 * error, "{} {name}: {error}, control {control}", builtin.name());
        }
        // Root mean squares are a norm: the law holds without a margin but rounding.
        let views = both.views(&camera, &bounds);
        let of_views: Vec<f64> = views
            .iter()
            .map(|v| rms(&raycast_mean(&frame, &bounds, &[*v]), &render_mean(&scene, &[*v])))
            .collect();
        let mean = of_views.iter().sum::<f64>() / of_views.len() as f64;
        assert!(rms(&novel(&both), &truth(&both)) <= mean * (1.0 + 1e-4));

        let eyes = View::from(&camera).stereo(0.8 * r, focus);
        let truth = eyes.map(|eye| render_mean(&scene, &[eye]));
        let seen = eyes.map(|eye| raycast_mean(&frame, &bounds, &[eye]));
        let (left, right) = (dssim(&seen[0], &truth[0]), dssim(&seen[1], &truth[1]));
        let (swapped, mono) = (dssim(&seen[1], &truth[0]), dssim(&novel(&pinhole(focus)), &truth[0]));
        println!("{} eyes: {left:.5} {right:.5}, swapped {swapped:.5}, mono {mono:.5}", builtin.name());
        // Single views of opaque cubes at 64 rows.
        assert!(left.max(right) < 0.015 && swapped.min(mono) > 2.0 * left);
    }
}

#[test]
fn a_mean_of_pictures_is_that_of_views() {
    let scene = scene(Builtin::Shells.volume(24), 0.6);
    let bounds = scene.volume.bounds();
    let camera = camera_at(0.5, &bounds);
    let frame = frame_of(&scene, camera);
    let views = Exposure { aperture_radius: 1.0, num_samples: 5, ..pinhole(9.0) }.views(&camera, &bounds);
    let one_by_one = views.iter().map(|v| Ok::<_, ()>(raycast_mean(&frame, &bounds, &[*v])));
    assert_eq!(mean_picture(one_by_one).unwrap(), Some(raycast_mean(&frame, &bounds, &views)));
    assert_eq!(mean_picture(std::iter::empty::<Result<_, ()>>()), Ok(None));
    assert_eq!(mean_picture([Err::<Picture, _>("lost")].into_iter()), Err("lost"));
    assert_eq!(raycast_mean(&frame, &bounds, &[]).pixels.len(), 0);
}

/// Root mean square of the difference of all channels.
fn rms(a: &Picture, b: &Picture) -> f64 {
    let each = a.pixels.iter().flatten().zip(b.pixels.iter().flatten());
    let sum = each.map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>();
    (sum / a.pixels.len() as f64).sqrt()
}
