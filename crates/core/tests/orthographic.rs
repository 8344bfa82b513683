//! Are pictures of parallel rays right: by the march, from layered frames of either projection, and combined?

#[path = "common/brute_force.rs"]
mod brute_force;
mod common;
#[path = "common/frames.rs"]
mod frames;

use std::sync::Arc;

use glam::{Quat, Vec3};
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::clip::Clip;
use isinglass_core::kernels::combine::combine;
use isinglass_core::kernels::lens::{View, render_mean};
use isinglass_core::kernels::march::{MarchSettings, Scene, render};
use isinglass_core::kernels::raycast::{CastOptions, Raycaster, Reconstruction, raycast};
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;
use isinglass_core::transfer::{
    ControlPoint, Domain, TABLE_BINS, TransferFunction, TransferTable, UnitLength,
};
use isinglass_core::volume::fields::Field;
use isinglass_core::volume::procedural::Builtin;

use self::brute_force::brute_force;
use self::common::scene;
use self::frames::{frame_of, max_difference};

fn perspective(azimuth: f32, distance: f32, side: u32, bounds: &Aabb) -> Camera {
    let intrinsics = Intrinsics::perspective(side, side - 3, 0.8);
    Camera::new(Pose::orbit(Vec3::ZERO, azimuth, 0.2, distance), intrinsics, bounds)
}

fn parallel(azimuth: f32, distance: f32, side: u32, bounds: &Aabb) -> Camera {
    perspective(azimuth, distance, side, bounds).to_orthographic(distance, bounds)
}

/// Their mean.
fn mean_difference(a: &Picture, b: &Picture) -> f64 {
    let (a, b) = (a.to_srgb8([0.0; 3]), b.to_srgb8([0.0; 3]));
    a.iter().zip(&b).map(|(x, y)| f64::from(x.abs_diff(*y))).sum::<f64>() / a.len() as f64
}

#[test]
fn a_constant_medium_is_as_opaque_as_its_chords_are_long() {
    let sigma = 1.3f32;
    let transfer = TransferFunction {
        name: "unused".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![ControlPoint { x: 0.0, color: [1.0; 3], opacity: 0.5 }],
    };
    let settings = MarchSettings { shading: None, ..Default::default() };
    let mut scene = Scene::new(Arc::new(Field::Constant(sigma).volume(24)), &transfer, settings);
    let x = |i: usize| i as f32 / TABLE_BINS as f32;
    scene.table = TransferTable {
        density: (0..=TABLE_BINS).map(|i| [2.0 * x(i); 4]).collect(),
        integral: (0..=TABLE_BINS).map(|i| [x(i) * x(i); 4]).collect(),
        x_scale: 0.5,
        x_offset: 0.0,
        are_labels: false,
    };
    scene.occupancy = scene.bricks.occupancy(&scene.table);
    let bounds = scene.volume.bounds();
    for azimuth in [0.0, 0.4, 2.0] {
        let camera = parallel(azimuth, 4.0, 40, &bounds);
        let picture = render(&scene, &camera);
        let forward = camera.pose.forward();
        let mut num_hit = 0;
        for (i, pixel) in picture.pixels.iter().enumerate() {
            let (ray, s_per_depth) = camera.ray((i % 40) as f32 + 0.5, (i / 40) as f32 + 0.5);
            assert!((ray.dir - forward).length() < 1e-6 && (s_per_depth - 1.0).abs() < 1e-6);
            let chord = bounds.clip(&ray).map_or(0.0, |(s0, s1)| s1 - s0);
            // Single precision over two hundred steps.
            assert!((pixel[3] - (1.0 - (-sigma * chord).exp())).abs() < 1e-4, "{azimuth}, pixel {i}");
            num_hit += usize::from(chord > 0.5);
        }
        assert!(num_hit > 300, "{num_hit}");
    }
    // From straight ahead all chords are two units long: one opacity, where a perspective has many.
    let opacities = |camera: Camera| {
        let inside = render(&scene, &camera).pixels.into_iter().map(|p| p[3]).filter(|a| *a > 0.2);
        inside.fold([1f32, 0.0], |[least, most], a| [least.min(a), most.max(a)])
    };
    let straight = |camera: Camera| Camera { pose: Pose::orbit(Vec3::ZERO, 0.0, 0.0, 4.0), ..camera };
    let [least, most] = opacities(straight(parallel(0.0, 4.0, 40, &bounds)));
    assert!(most - least < 1e-4, "{least} {most}");
    let [least, most] = opacities(straight(perspective(0.0, 4.0, 40, &bounds)));
    assert!(most - least > 0.1, "{least} {most}");
}

#[test]
fn sizes_do_not_depend_on_depth_and_the_middle_is_as_in_the_perspective() {
    let bounds = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };
    let (camera, flat) = (perspective(0.4, 4.0, 60, &bounds), parallel(0.4, 4.0, 60, &bounds));
    let pixel = |camera: &Camera, p: Vec3| {
        let h = camera.basis().pixel_from_point(p);
        h.truncate() / h.z
    };
    let (right, forward) = (camera.pose.world_from_view * Vec3::X, camera.pose.forward());
    for depth in [-1.0, 0.0, 0.7] {
        let at = forward * depth + right * 0.1;
        let length = |camera: &Camera| (pixel(camera, at + right) - pixel(camera, at)).length();
        assert!((length(&flat) - length(&parallel(0.4, 4.0, 60, &bounds))).abs() < 1e-4);
        let of_middle = (pixel(&camera, right) - pixel(&camera, Vec3::ZERO)).length();
        assert!((length(&flat) - of_middle).abs() < 1e-3, "as large as the perspective's at its middle");
        // Negative control: perspective sizes do.
        assert!(depth == 0.0 || (length(&camera) - of_middle).abs() > 1.0);
        assert!((pixel(&flat, at) - pixel(&flat, at + forward * 0.5)).length() < 1e-4);
        let (ray, _) = flat.ray(pixel(&flat, at).x, pixel(&flat, at).y);
        assert!((at - ray.origin).cross(ray.dir).length() < 1e-4, "and its ray goes through the point");
    }
    let scene = scene(Builtin::Cloud);
    let bounds = scene.volume.bounds();
    let flat = parallel(0.4, 4.0, 40, &bounds);
    let mut nearer = flat;
    nearer.pose.eye += flat.pose.forward() * (0.5 * bounds.radius());
    let nearer = Camera::new(nearer.pose, nearer.intrinsics, &bounds);
    assert!(max_difference(&render(&scene, &flat), &render(&scene, &nearer)) <= 1, "no eye to come nearer");
}

/// Switching between the projections shows the old frame under the new camera at once.
#[test]
fn frames_of_one_projection_are_cast_right_into_the_other() {
    for builtin in Builtin::ALL {
        let scene = scene(builtin);
        let bounds = scene.volume.bounds();
        let whole = Clip::default().region(&bounds);
        let turned = |camera: Camera, q: Quat| Camera {
            pose: Pose { world_from_view: camera.pose.world_from_view * q, ..camera.pose },
            ..camera
        };
        let views =
            |azimuth: f32| [perspective(azimuth, 4.0, 15, &bounds), parallel(azimuth, 4.0, 15, &bounds)];
        let mut displays: Vec<Camera> = [0.31, 0.475, 1.9, 3.45].into_iter().flat_map(views).collect();
        // From inside, along the old picture's plane, and askew.
        displays.push(perspective(1.3, 0.3, 15, &bounds));
        displays.push(turned(parallel(0.31, 1.2, 15, &bounds), Quat::from_rotation_z(0.7)));
        for old in [
            parallel(0.3, 4.0, 28, &bounds),
            parallel(0.3, 0.7, 28, &bounds),
            perspective(0.3, 4.0, 28, &bounds),
        ] {
            let frame = frame_of(&scene, old, 8);
            let caster = Raycaster::new(&frame, &bounds);
            let is_old_parallel = old.intrinsics.projection.is_orthographic();
            for new in
                displays.iter().filter(|d| is_old_parallel || d.intrinsics.projection.is_orthographic())
            {
                for reconstruction in [Reconstruction::Nearest, Reconstruction::Mixed] {
                    let options = CastOptions { reconstruction, ..CastOptions::default() };
                    let found = caster.picture(new, &options);
                    let mut truth = Picture::new(found.width, found.height);
                    for (i, pixel) in truth.pixels.iter_mut().enumerate() {
                        let (ray, _) = new.ray((i % 15) as f32 + 0.5, (i / 15) as f32 + 0.5);
                        *pixel = brute_force(&frame, &whole, &ray, reconstruction).map(|v| v as f32);
                    }
                    let difference = max_difference(&found, &truth);
                    assert!(difference <= 1, "{} {old:?} {new:?}: {difference}/255", builtin.name());
                    let all = CastOptions { skips_empty_space: false, ..options };
                    assert_eq!(caster.picture(new, &all), found, "empty space");
                }
            }
            // And it shows the volume: a good deal nearer to the truth than the old picture is.
            let new = if is_old_parallel {
                perspective(0.35, 4.0, 48, &bounds)
            } else {
                parallel(0.35, 4.0, 48, &bounds)
            };
            if old.intrinsics == perspective(0.3, 4.0, 28, &bounds).intrinsics {
                let fine = frame_of(&scene, perspective(0.3, 4.0, 96, &bounds), 8);
                let truth = render(&scene, &new);
                let before = render(&scene, &perspective(0.3, 4.0, 48, &bounds));
                let found = raycast(&fine, &bounds, &new);
                assert!(
                    mean_difference(&found, &truth) < 0.5 * mean_difference(&before, &truth),
                    "{}",
                    builtin.name()
                );
            }
        }
    }
}

#[test]
fn frames_of_both_projections_are_one_picture() {
    let scene = scene(Builtin::Shells);
    let bounds = scene.volume.bounds();
    let (newest, older) = (parallel(0.0, 1.2, 48, &bounds), perspective(0.2, 4.0, 96, &bounds));
    let frames = [newest, older].map(|camera| frame_of(&scene, camera, 8));
    let frames = frames.each_ref();
    let own = combine(&frames, &bounds, &newest);
    assert_eq!(own, raycast(frames[0], &bounds, &newest), "the newest sees all of its own picture");
    for display in [parallel(0.1, 3.0, 48, &bounds), perspective(0.1, 3.0, 48, &bounds)] {
        let truth = render(&scene, &display);
        let (both, alone) = (combine(&frames, &bounds, &display), raycast(frames[0], &bounds, &display));
        assert!(mean_difference(&both, &truth) < 0.5 * mean_difference(&alone, &truth));
    }
}

/// The two eyes of parallel rays look askew: what lies at the focus is at one place for both.
#[test]
fn two_eyes_of_parallel_rays_meet_at_the_focus() {
    let bounds = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };
    let camera = parallel(0.3, 4.0, 40, &bounds);
    let focus = -camera.pose.eye.dot(camera.pose.forward());
    let [left, right] = View::from(&camera).stereo(0.2, focus);
    assert!(left.is_valid() && right.is_valid());
    for (x, y) in [(3.5, 7.5), (20.0, 18.5), (33.0, 30.0)] {
        let at = |view: &View, depth: f32| {
            let (ray, s_per_depth) = view.basis.ray(x, y);
            ray.at(depth * s_per_depth)
        };
        assert!((at(&left, focus) - at(&right, focus)).length() < 1e-5);
        let apart = at(&right, focus - 1.0) - at(&left, focus - 1.0);
        assert!((apart.length() - 0.2 / focus).abs() < 1e-5, "in front of it, by the angle of the eyes");
    }
    let scene = scene(Builtin::Shells);
    let camera = parallel(0.3, 4.0, 40, &scene.volume.bounds());
    let pictures = View::from(&camera).stereo(0.2, focus).map(|view| render_mean(&scene, &[view]));
    assert_ne!(pictures[0], pictures[1]);
    assert_eq!(render_mean(&scene, &[View::from(&camera)]), render(&scene, &camera));
}
