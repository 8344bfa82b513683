//! The march against exact integrals: constant medium, ramp and sphere, and what the march promises about steps and
//! empty space.

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::kernels::march::{MarchSettings, Scene, render, render_through};
use isinglass_core::picture::Picture;
use isinglass_core::space::Ray;
use isinglass_core::transfer::{
    ControlPoint, Domain, TABLE_BINS, TransferFunction, TransferTable, UnitLength,
};
use isinglass_core::volume::fields::Field;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Occupancy, Volume, VolumeInfo, Voxels};

/// A table with σ = value and white matter, for values up to `sigma_max`.
fn identity_table(sigma_max: f32) -> TransferTable {
    let x = |i: usize| i as f32 / TABLE_BINS as f32;
    TransferTable {
        density: (0..=TABLE_BINS).map(|i| [sigma_max * x(i); 4]).collect(),
        integral: (0..=TABLE_BINS).map(|i| [sigma_max * 0.5 * x(i) * x(i); 4]).collect(),
        x_scale: 1.0 / sigma_max,
        x_offset: 0.0,
        are_labels: false,
    }
}

fn field_scene(field: Field, sigma_max: f32, step_in_voxels: f32) -> Scene {
    let transfer = TransferFunction {
        name: "unused".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![ControlPoint { x: 0.0, color: [1.0; 3], opacity: 0.5 }],
    };
    let settings = MarchSettings { step_in_voxels, shading: None, ..Default::default() };
    let mut scene = Scene::new(Arc::new(field.volume(96)), &transfer, settings);
    scene.table = identity_table(sigma_max);
    scene.occupancy = scene.bricks.occupancy(&scene.table);
    scene
}

fn camera(scene: &Scene, azimuth: f32) -> Camera {
    let bounds = scene.volume.bounds();
    let intrinsics = Intrinsics::perspective(24, 20, 0.7);
    let pose = Pose::orbit(Vec3::ZERO, azimuth, 0.3, bounds.radius() * intrinsics.fit_distance());
    Camera::new(pose, intrinsics, &bounds)
}

/// Greatest relative error of the optical depth over all pixels with an optical depth of at least 0.1.
fn worst_error(picture: &Picture, scene: &Scene, camera: &Camera, field: Field) -> f64 {
    let bounds = scene.volume.bounds();
    let mut worst = 0f64;
    let mut seen = 0;
    for y in 0..picture.height {
        for x in 0..picture.width {
            let (ray, _) = camera.ray(x as f32 + 0.5, y as f32 + 0.5);
            let Some((s0, s1)) = bounds.clip(&ray) else { continue };
            let exact = field.optical_depth(&ray, s0, s1);
            if exact < 0.1 {
                continue;
            }
            let [r, g, b, alpha] = picture.pixels[(y * picture.width + x) as usize];
            assert!((r - alpha).abs() < 1e-5 && r == g && g == b, "white matter has C = α");
            let found = -(1.0 - f64::from(alpha)).ln();
            worst = worst.max((found - exact).abs() / exact);
            seen += 1;
        }
    }
    assert!(seen > 20, "only {seen} pixels saw the field");
    worst
}

#[test]
fn optical_depth_is_the_exact_integral() {
    let fields = [
        (Field::Constant(0.8), 2.0),
        (Field::Ramp { at_zero: 2.0, slope: 0.5 }, 4.0),
        (Field::Sphere { peak: 2.0, radius: 0.9 }, 2.0),
    ];
    for (field, sigma_max) in fields {
        for azimuth in [0.0, 0.9, 2.5] {
            let scene = field_scene(field, sigma_max, 0.5);
            let camera = camera(&scene, azimuth);
            let picture = render(&scene, &camera);
            let worst = worst_error(&picture, &scene, &camera, field);
            // On a 96³ grid, trilinear interpolation misses the curvature and the edge of the sphere by
            // 0.3 % where it is thin (it falls with the square of the spacing). Beyond the outermost voxel centres the value is held, which a ramp feels
            // along a face: a quarter of a voxel times the slope, 0.3 %. A constant leaves only rounding.
            let limit = if matches!(field, Field::Constant(_)) { 1e-4 } else { 5e-3 };
            assert!(worst < limit, "{field:?} at {azimuth}: {worst}");
            // Negative control: another field's integral is not met.
            let wrong = Field::Constant(0.5);
            assert!(worst_error(&picture, &scene, &camera, wrong) > 0.02);
        }
    }
}

#[test]
fn transmittance_of_a_constant_medium_is_exponential() {
    for sigma in [0.1f32, 1.0, 5.0] {
        let scene = field_scene(Field::Constant(sigma), 8.0, 0.5);
        let camera = camera(&scene, 0.4);
        let picture = render(&scene, &camera);
        for (i, pixel) in picture.pixels.iter().enumerate() {
            let (x, y) = (i as u32 % picture.width, i as u32 / picture.width);
            let (ray, _) = camera.ray(x as f32 + 0.5, y as f32 + 0.5);
            let Some((s0, s1)) = scene.volume.bounds().clip(&ray) else { continue };
            let exact = (-sigma * (s1 - s0)).exp();
            // The march stops where less than 1e-4 is left to see.
            assert!((1.0 - pixel[3] - exact).abs() < 1.5e-4, "σ {sigma}, pixel {i}");
        }
    }
}

#[test]
fn half_steps_converge() {
    let field = Field::Sphere { peak: 3.0, radius: 0.8 };
    let at = |step| {
        let scene = field_scene(field, 3.0, step);
        render(&scene, &camera(&scene, 0.7))
    };
    let distance = |a: &Picture, b: &Picture| {
        a.pixels.iter().zip(&b.pixels).map(|(p, q)| f64::from((p[3] - q[3]).abs())).sum::<f64>()
    };
    let pictures = [8.0, 4.0, 2.0, 1.0, 0.5].map(at);
    let steps: Vec<f64> = pictures.windows(2).map(|w| distance(&w[0], &w[1])).collect();
    for w in steps.windows(2) {
        // Trapezoidal sums converge with the square of the step until the kinks of the grid show (first order).
        assert!(w[1] < 0.6 * w[0], "{steps:?}");
    }
}

/// Thick slices are marched by half a voxel, too, and errors are counted alike along every axis.
#[test]
fn steps_go_with_the_voxels_along_a_ray() {
    let p = |x| ControlPoint { x, color: [1.0; 3], opacity: x };
    let transfer = TransferFunction {
        name: "ramp".into(),
        domain: Domain::Full,
        unit_length: UnitLength::World(5.0),
        points: vec![p(0.0), p(1.0)],
    };
    let scene = |step_in_voxels, spacing| {
        let voxels = Voxels::U8((0..512u32).map(|i| (i * 37 % 251) as u8).collect());
        let volume = Volume::new([8; 3], spacing, voxels, (1.0, 0.0), VolumeInfo::default()).unwrap();
        let settings = MarchSettings { step_in_voxels, shading: None, ..Default::default() };
        Scene::new(Arc::new(volume), &transfer, settings)
    };
    let thick = scene(0.5, Vec3::new(1.0, 1.0, 10.0));
    for (dir, step) in [(Vec3::X, 0.5), (Vec3::Y, 0.5), (Vec3::Z, 5.0)] {
        let ray = Ray { origin: dir * -100.0, dir };
        let lattice = thick.lattice(&ray, 0.0).unwrap();
        assert_eq!((lattice.n, lattice.h, lattice.unit), (16, step, 0.5), "{dir}");
    }
    // And the picture is the one of many more steps, which single ones of ten voxels would not give.
    let fine = scene(0.05, Vec3::new(1.0, 1.0, 10.0));
    let coarse = scene(10.0, Vec3::new(1.0, 1.0, 10.0));
    let pictures = [&fine, &thick, &coarse].map(|scene| render_through(scene, &camera(scene, 0.4)));
    let apart = |i: usize| {
        let pairs = pictures[0].pixels.iter().flatten().zip(pictures[i].pixels.iter().flatten());
        pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    };
    assert!(apart(1) < 0.02 && apart(2) > 0.04, "{} {}", apart(1), apart(2));
}

fn cubus_scene() -> Scene {
    let p = |x, opacity| ControlPoint { x, color: [0.9, 0.5, 0.2], opacity };
    let transfer = TransferFunction {
        name: "cubus".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: vec![p(0.0, 0.0), p(0.3, 0.0), p(1.0, 0.4)],
    };
    Scene::new(Arc::new(Builtin::Cubus.volume(128)), &transfer, MarchSettings::default())
}

#[test]
fn skipping_empty_bricks_changes_nothing() {
    let mut scene = cubus_scene();
    assert!(scene.occupancy.fraction() < 0.9, "nothing to skip: {}", scene.occupancy.fraction());
    // The longest step is longer than a brick.
    for step_in_voxels in [11.0, 3.0, 0.5] {
        scene.settings.step_in_voxels = step_in_voxels;
        let everything = Scene { occupancy: Occupancy::full(scene.occupancy.dims), ..scene.clone() };
        for azimuth in [0.0, 0.5, 1.57, 3.0] {
            let camera = camera(&scene, azimuth);
            assert!(render(&scene, &camera) == render(&everything, &camera), "azimuth {azimuth}");
        }
    }
    // Negative control: a brick wrongly called empty shows.
    let mut holes = scene.clone();
    Arc::make_mut(&mut holes.occupancy.words).iter_mut().for_each(|w| *w |= 0x0001_0001);
    let camera = camera(&scene, 0.5);
    assert!(render(&scene, &camera) != render(&holes, &camera));
}

#[test]
fn marching_through_opaque_matter_changes_no_more_than_is_left_of_the_light() {
    let scene = cubus_scene();
    let camera = camera(&scene, 0.5);
    let (stopped, through) = (render(&scene, &camera), render_through(&scene, &camera));
    let differences =
        stopped.pixels.iter().flatten().zip(through.pixels.iter().flatten()).map(|(a, b)| b - a);
    let greatest = differences.fold(0.0, f32::max);
    // What is left at a stop is at most 1e-4 of the light, and no matter is brighter than 0.25 + 0.85.
    assert!(greatest <= 1.1e-4 + 1e-6, "{greatest}");
    // Negative control: some ray did stop.
    assert!(greatest > 0.0);
}

#[test]
fn step_length_does_not_change_the_look() {
    let field = Field::Constant(1.0);
    let fine = field_scene(field, 2.0, 0.25);
    let coarse = field_scene(field, 2.0, 3.0);
    let camera = camera(&fine, 0.2);
    for (a, b) in render(&fine, &camera).pixels.iter().zip(&render(&coarse, &camera).pixels) {
        // Rounding of a few hundred products of single precision.
        assert!((a[3] - b[3]).abs() < 1e-4);
    }
}
