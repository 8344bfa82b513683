//! Is what a clip leaves of a volume shown exactly, by the march and by the cast, and nothing else?

#[path = "common/brute_force.rs"]
mod brute_force;
mod common;
#[path = "common/frames.rs"]
mod frames;

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::clip::{Clip, Plane};
use isinglass_core::kernels::combine::{combine, combine_clipped};
use isinglass_core::kernels::march::{MarchSettings, Scene, render, render_through};
use isinglass_core::kernels::raycast::{CastOptions, Raycaster, Reconstruction};
use isinglass_core::layer::LayeredFrame;
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

fn clipped(scene: &Scene, clip: Clip) -> Scene {
    Scene { settings: MarchSettings { clip, ..scene.settings }, ..scene.clone() }
}

/// From a perspective and from an orthographic camera.
fn cameras(azimuth: f32, side: u32, bounds: &Aabb) -> [Camera; 2] {
    let intrinsics = Intrinsics::perspective(side, side - 3, 0.8);
    let camera = Camera::new(Pose::orbit(Vec3::ZERO, azimuth, 0.2, 4.0), intrinsics, bounds);
    [camera, camera.to_orthographic(4.0, bounds)]
}

/// A box, a slanted plane, and both: through the middle of the volume, where there is matter.
fn clips(bounds: &Aabb) -> [Clip; 3] {
    let r = bounds.radius();
    let inner = Aabb { min: Vec3::new(-0.3, -0.2, -0.25) * r, max: Vec3::new(0.21, 0.33, 0.1) * r };
    let plane = Plane::new(Vec3::new(0.4, 1.0, -0.7), 0.05 * r);
    [
        Clip { bounds: Some(inner), plane: None },
        Clip { bounds: None, plane },
        Clip { bounds: Some(inner), plane },
    ]
}

fn cast(frame: &LayeredFrame, bounds: &Aabb, camera: &Camera, clip: Clip) -> Picture {
    Raycaster::new(frame, bounds).picture(camera, &CastOptions { clip, ..CastOptions::default() })
}

/// Their mean.
fn mean_difference(a: &Picture, b: &Picture) -> f64 {
    let (a, b) = (a.to_srgb8([0.0; 3]), b.to_srgb8([0.0; 3]));
    a.iter().zip(&b).map(|(x, y)| f64::from(x.abs_diff(*y))).sum::<f64>() / a.len() as f64
}

#[test]
fn a_clip_at_the_whole_box_changes_no_bit() {
    let scene = scene(Builtin::Shells);
    let bounds = scene.volume.bounds();
    let whole = Clip { bounds: Some(bounds), plane: Plane::new(Vec3::X, -9.0 * bounds.radius()) };
    let boxed = Clip { bounds: Some(bounds), plane: None };
    for camera in cameras(0.4, 40, &bounds) {
        let truth = render(&scene, &camera);
        let frame = frame_of(&scene, camera, 8);
        let turned = cameras(0.9, 40, &bounds)[0];
        for clip in [boxed, whole] {
            assert_eq!(render(&clipped(&scene, clip), &camera), truth);
            assert_eq!(frame_of(&clipped(&scene, clip), camera, 8), frame);
            for seen in [camera, turned] {
                assert_eq!(cast(&frame, &bounds, &seen, clip), cast(&frame, &bounds, &seen, Clip::default()));
            }
        }
        // Negative control.
        assert_ne!(render(&clipped(&scene, clips(&bounds)[0]), &camera), truth);
    }
}

/// Matter that only absorbs: what passes through the one side and then through the other passes through the whole.
#[test]
fn a_plane_and_its_opposite_are_the_whole() {
    let whole = scene(Builtin::Cloud);
    let bounds = whole.volume.bounds();
    let plane = clips(&bounds)[1].plane.unwrap();
    for camera in cameras(0.7, 72, &bounds) {
        let opacities = |plane| {
            let clip = Clip { bounds: None, plane };
            render_through(&clipped(&whole, clip), &camera)
                .pixels
                .into_iter()
                .map(|p| p[3])
                .collect::<Vec<_>>()
        };
        let [all, one, other] = [None, Some(plane), Some(plane.flipped())].map(opacities);
        let mut num_cut = 0;
        for ((all, one), other) in all.iter().zip(&one).zip(&other) {
            // The steps of the three rays lie otherwise: what classification by integrals leaves of that.
            assert!((1.0 - all - (1.0 - one) * (1.0 - other)).abs() < 4e-3, "{all} {one} {other}");
            num_cut += usize::from(*one > 0.01 && *other > 0.01);
        }
        assert!(num_cut > 50, "{num_cut}");
    }
}

#[test]
fn half_a_sphere_is_the_closed_form() {
    let field = Field::Sphere { peak: 2.0, radius: 0.8 };
    let transfer = TransferFunction {
        name: "unused".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![ControlPoint { x: 0.0, color: [1.0; 3], opacity: 0.5 }],
    };
    let clip = Clip { bounds: None, plane: Plane::new(Vec3::new(0.5, 1.0, 0.3), 0.1) };
    let settings = MarchSettings { shading: None, clip, ..Default::default() };
    let mut scene = Scene::new(Arc::new(field.volume(96)), &transfer, settings);
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
    for camera in cameras(0.3, 40, &bounds) {
        let (picture, half, whole) =
            (render(&scene, &camera), clip.region(&bounds), Clip::default().region(&bounds));
        let (mut num_halved, mut worst) = (0, 0f64);
        for (i, pixel) in picture.pixels.iter().enumerate() {
            let (ray, _) = camera.ray((i % 40) as f32 + 0.5, (i / 40) as f32 + 0.5);
            let opacity = |interval: Option<(f32, f32)>| {
                1.0 - (-interval.map_or(0.0, |(s0, s1)| field.optical_depth(&ray, s0, s1))).exp()
            };
            let (exact, of_whole) = (opacity(half.clip(&ray)), opacity(whole.clip(&ray)));
            worst = worst.max((f64::from(pixel[3]) - exact).abs());
            num_halved += usize::from(exact > 0.1 && of_whole > exact + 0.1);
        }
        // The field between voxel centres is not quadratic, and has a bend at the sphere's border: some squares of the
        // distance of voxels, a fortieth of the radius.
        assert!(worst < 4e-3, "{worst}");
        assert!(num_halved > 50, "{num_halved}: the whole sphere would be noticed");
    }
}

/// Before the server's frame is there: nothing outside is drawn, and what is inside looks as it will.
#[test]
fn a_whole_frame_is_cut_at_once() {
    for builtin in [Builtin::Cloud, Builtin::Shells] {
        let scene = scene(builtin);
        let bounds = scene.volume.bounds();
        for clip in clips(&bounds) {
            let (cut, region) = (clipped(&scene, clip), clip.region(&bounds));
            for (old, new) in [(0.5, 0.5), (0.5, 0.7)] {
                for (old, new) in cameras(old, 64, &bounds).iter().zip(&cameras(new, 48, &bounds)) {
                    let frame = frame_of(&scene, *old, 8);
                    let (found, truth) = (cast(&frame, &bounds, new, clip), render(&cut, new));
                    // The margin of a few depth units, and what rounding adds.
                    let least = region.grown(1e-3 * bounds.radius());
                    for (i, pixel) in found.pixels.iter().enumerate() {
                        let (ray, _) = new.ray((i % 48) as f32 + 0.5, (i / 48) as f32 + 0.5);
                        assert!(least.clip(&ray).is_some() || *pixel == [0.0; 4]);
                    }
                    let (off, uncut) = (
                        mean_difference(&found, &truth),
                        mean_difference(&cast(&frame, &bounds, new, Clip::default()), &truth),
                    );
                    assert!(
                        off < 0.35 * uncut,
                        "{} {clip:?}: {off}, without cutting {uncut}",
                        builtin.name()
                    );
                    // Growing again shows what the frame has.
                    let again = cast(&frame, &bounds, new, Clip::default());
                    assert_eq!(again, Raycaster::new(&frame, &bounds).picture(new, &CastOptions::default()));
                }
            }
        }
    }
}

#[test]
fn cut_rays_match_brute_force_and_empty_space_changes_nothing() {
    let scene = scene(Builtin::Shells);
    let bounds = scene.volume.bounds();
    for old in cameras(0.3, 28, &bounds) {
        let frame = frame_of(&scene, old, 8);
        let caster = Raycaster::new(&frame, &bounds);
        for clip in clips(&bounds) {
            for new in [0.475, 2.0].into_iter().flat_map(|azimuth| cameras(azimuth, 17, &bounds)) {
                for reconstruction in [Reconstruction::Nearest, Reconstruction::Mixed] {
                    let options = CastOptions { reconstruction, clip, ..CastOptions::default() };
                    let found = caster.picture(&new, &options);
                    let mut truth = Picture::new(found.width, found.height);
                    for (i, pixel) in truth.pixels.iter_mut().enumerate() {
                        let (ray, _) = new.ray((i % 17) as f32 + 0.5, (i / 17) as f32 + 0.5);
                        *pixel = brute_force(&frame, &clip.region(&bounds), &ray, reconstruction)
                            .map(|v| v as f32);
                    }
                    assert!(max_difference(&found, &truth) <= 1, "{reconstruction:?} {clip:?}");
                    let whole = CastOptions { skips_empty_space: false, ..options };
                    assert_eq!(caster.picture(&new, &whole), found);
                }
            }
        }
    }
}

#[test]
fn several_frames_are_cut_as_one() {
    let scene = scene(Builtin::Shells);
    let bounds = scene.volume.bounds();
    let near = |azimuth: f32| {
        let pose = Pose::orbit(Vec3::ZERO, azimuth, 0.2, 0.9 * bounds.radius());
        Camera::new(pose, Intrinsics::perspective(48, 40, 0.7), &bounds)
    };
    let frames = [near(0.0), near(0.6)].map(|camera| frame_of(&scene, camera, 8));
    let frames = frames.each_ref();
    let display = near(0.4);
    for clip in clips(&bounds) {
        let found = combine_clipped(&frames, &bounds, &display, &clip);
        assert_ne!(found, cast(frames[0], &bounds, &display, clip), "the older frame is seen");
        for (i, pixel) in found.pixels.iter().enumerate() {
            let (ray, _) = display.ray((i % 48) as f32 + 0.5, (i / 48) as f32 + 0.5);
            assert!(
                clip.region(&bounds).grown(1e-3 * bounds.radius()).clip(&ray).is_some() || *pixel == [0.0; 4]
            );
        }
        let truth = render(&clipped(&scene, clip), &display);
        let uncut = combine(&frames, &bounds, &display);
        assert!(mean_difference(&found, &truth) < 0.5 * mean_difference(&uncut, &truth), "{clip:?}");
    }
    let whole = Clip { bounds: Some(bounds), plane: None };
    assert_eq!(combine_clipped(&frames, &bounds, &display, &whole), combine(&frames, &bounds, &display));
}
