//! The modes against closed forms, and for each a law that it alone obeys.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::kernels::layering::generate;
use isinglass_core::kernels::march::{MarchSettings, Scene, Shading, render};
use isinglass_core::kernels::raycast::{CastOptions, Raycaster, Reconstruction};
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::mode::{Iso, Isos, Mode};
use isinglass_core::picture::{Picture, linear_from_srgb, srgb_from_linear};
use isinglass_core::space::Ray;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::fields::Field;
use isinglass_core::volume::{Occupancy, Volume, Voxels};

/// White, from transparent at 0 to opaque at `most`: a projection shows a value as an even ramp of sRGB.
fn ramp(most: f32) -> TransferFunction {
    let p = |x, opacity| ControlPoint { x, color: [1.0; 3], opacity };
    TransferFunction {
        name: "ramp".into(),
        domain: Domain::Values(0.0, most),
        unit_length: UnitLength::Voxel,
        points: vec![p(0.0, 0.0), p(1.0, 0.5)],
    }
}

fn settings(mode: Mode) -> MarchSettings {
    MarchSettings { mode, shading: None, ..MarchSettings::default() }
}

fn camera(scene: &Scene, azimuth: f32) -> Camera {
    let bounds = scene.volume.bounds();
    let intrinsics = Intrinsics::perspective(32, 26, 0.7);
    let pose = Pose::orbit(Vec3::ZERO, azimuth, 0.3, bounds.radius() * intrinsics.fit_distance());
    Camera::new(pose, intrinsics, &bounds)
}

/// Each ray that meets the box, its way in it, and what the picture has there, linear.
fn rays<'a>(
    scene: &'a Scene,
    camera: &'a Camera,
    picture: &'a Picture,
) -> impl Iterator<Item = (Ray, [f32; 2], f32)> + 'a {
    picture.pixels.iter().enumerate().filter_map(|(i, pixel)| {
        let (x, y) = (i as u32 % picture.width, i as u32 / picture.width);
        let (ray, _) = camera.ray(x as f32 + 0.5, y as f32 + 0.5);
        let (s0, s1) = scene.volume.bounds().clip(&ray)?;
        assert!((pixel[3] - pixel[0].min(1.0)).abs() < 1e-6, "white has the opacity of its colour");
        Some((ray, [s0, s1], pixel[0]))
    })
}

/// Values of a field along a ray, and the mean of what is shown of them, by a thousand samples.
fn values(field: Field, ray: &Ray, [s0, s1]: [f32; 2], most: f32) -> [f32; 3] {
    let (mut least, mut greatest, mut mean) = (f32::INFINITY, 0f32, 0.0);
    for i in 0..1000 {
        let at = ray.at(s0 + (s1 - s0) * (i as f32 + 0.5) / 1000.0);
        let value = field.sigma(at);
        least = least.min(value);
        greatest = greatest.max(value);
        mean += linear_from_srgb((value / most).clamp(0.0, 1.0)) / 1000.0;
    }
    [greatest / most, least / most, srgb_from_linear(mean)]
}

/// Without its lesser values a frame of greatest or least values has fewer segments and the same picture. A mean, which
/// needs all of them, has not.
#[test]
fn a_thinned_projection_is_the_same_picture_from_its_own_pose() {
    let volume = Arc::new(isinglass_core::volume::procedural::Builtin::Shells.volume(32));
    for (mode, is_same) in [(Mode::Mip, true), (Mode::MinIp, true), (Mode::Average, false)] {
        let scene = Scene::new(volume.clone(), &ramp(255.0), settings(mode));
        let frame = generate(&scene, FrameHeader::alone(camera(&scene, 0.4), 8));
        let thin = frame.thinned();
        thin.validate().unwrap();
        assert!(thin.num_segments() * 3 < frame.num_segments() * 2, "{mode}");
        let [whole, thin] = [&frame, &thin].map(|frame| frame.flatten().to_srgb8([0.0; 3]));
        let most = whole.iter().zip(&thin).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
        assert_eq!(most == 0, is_same, "{mode}: {most}");
    }
}

#[test]
fn projections_of_fields_are_what_their_names_say() {
    let fields = [
        (Field::Constant(0.8), 2.0),
        (Field::Ramp { at_zero: 1.0, slope: 0.5 }, 2.0),
        (Field::Sphere { peak: 2.0, radius: 0.9 }, 2.0),
    ];
    for (field, most) in fields {
        let volume = Arc::new(field.volume(96));
        for (number, mode) in [Mode::Mip, Mode::MinIp, Mode::Average].into_iter().enumerate() {
            let scene = Scene::new(volume.clone(), &ramp(most), settings(mode));
            for azimuth in [0.0, 0.9] {
                let camera = camera(&scene, azimuth);
                let picture = render(&scene, &camera);
                let (mut worst, mut noticed) = (0f32, [0f32; 3]);
                let exposure = exposure(&scene, &ramp(most));
                for (ray, way, found) in rays(&scene, &camera, &picture) {
                    let found = srgb_from_linear(found / exposure);
                    let exact = values(field, &ray, way, most);
                    worst = worst.max((found - exact[number]).abs());
                    for (noticed, exact) in noticed.iter_mut().zip(exact) {
                        *noticed = noticed.max((found - exact).abs());
                    }
                }
                // Half a voxel of 96 beyond the outermost centres, where the value is held, times the slope; and the curvature
                // of the sphere near its edge between voxels.
                assert!(worst < 0.02, "{field:?}, {mode} at {azimuth}: {worst}");
                // Negative control: it is not what the other modes show, but of a constant all are alike.
                let others = (0..3).filter(|n| *n != number);
                let is_constant = matches!(field, Field::Constant(_));
                assert!(
                    others.into_iter().all(|n| is_constant != (noticed[n] > 0.03)),
                    "{field:?}, {mode}: {noticed:?}"
                );
            }
        }
    }
}

/// Two boxes one behind the other along z, of two values, in air.
fn boxes(near: u8, far: u8) -> Arc<Volume> {
    let voxels = (0..32u32 * 32 * 32).map(|i| {
        let (x, y, z) = (i % 32, i / 32 % 32, i / 1024);
        let is_inside = (6..26).contains(&x) && (6..26).contains(&y);
        // The eye is at +z.
        if is_inside && (20..28).contains(&z) {
            near
        } else if is_inside && (4..12).contains(&z) {
            far
        } else {
            0
        }
    });
    Arc::new(
        Volume::new([32; 3], Vec3::ONE, Voxels::U8(voxels.collect()), (1.0, 0.0), Default::default())
            .unwrap(),
    )
}

/// The factor by which a mean is brighter than the plain one.
fn exposure(scene: &Scene, transfer: &TransferFunction) -> f32 {
    let plain = transfer.shown_table(&scene.volume, &scene.histogram);
    if scene.settings.mode == Mode::Average { transfer.exposure(&scene.volume, &plain) } else { 1.0 }
}

/// What is seen in the middle, straight along z.
fn middle(scene: &Scene) -> f32 {
    let bounds = scene.volume.bounds();
    let intrinsics = Intrinsics::perspective(1, 1, 0.01);
    let camera = Camera::new(Pose::orbit(Vec3::ZERO, 0.0, 0.0, 200.0), intrinsics, &bounds);
    srgb_from_linear(render(scene, &camera).pixels[0][0])
}

#[test]
fn two_boxes() {
    let shown = |near, far, mode| middle(&Scene::new(boxes(near, far), &ramp(200.0), settings(mode)));
    // Whichever is in front, the greater one; and no matter how long.
    for (near, far) in [(60, 160), (160, 60)] {
        assert!((shown(near, far, Mode::Mip) - 0.8).abs() < 1e-3);
        assert_eq!(shown(near, far, Mode::MinIp), 0.0, "there is air on the way");
        // Eight voxels of 32 each; a ramp of a voxel at each face has the mean of what is shown between, which the sRGB
        // curve bends: within a hundredth.
        let scene = Scene::new(boxes(near, far), &ramp(200.0), settings(Mode::Average));
        let plain = 0.25 * (linear_from_srgb(0.3) + linear_from_srgb(0.8));
        let exact = srgb_from_linear(plain * exposure(&scene, &ramp(200.0)));
        assert!((middle(&scene) - exact).abs() < 0.04);
        // Across, the way through a box is longer and brighter still.
        assert!(exact > 1.4 * srgb_from_linear(plain) && exact < 1.0, "averages fill the range: {exact}");
    }
    // Order matters with over, and there alone.
    let mut grey = ramp(200.0);
    grey.points[0].color = [0.0; 3];
    let of = |near, far, mode| middle(&Scene::new(boxes(near, far), &grey, settings(mode)));
    let differs = |mode| (of(60, 160, mode) - of(160, 60, mode)).abs() > 1e-3;
    assert_eq!(Mode::ALL.map(differs), [true, false, false, false, false]);
    // What is twice as dense is no brighter in a MIP of its own; with over it is.
    let doubled = |mode| {
        let mut thin = ramp(200.0);
        thin.points[1].opacity = 0.05;
        let shown = |far| middle(&Scene::new(boxes(100, far), &thin, settings(mode)));
        shown(100) - shown(0)
    };
    let [composite, mip, average] = [Mode::Composite, Mode::Mip, Mode::Average].map(doubled);
    assert!(mip.abs() < 1e-3 && average > 0.05 && composite > 0.05, "{composite} {mip} {average}");
}

#[test]
fn a_surface_lies_where_the_field_has_its_value_and_is_lit_by_its_gradient() {
    let (peak, radius) = (2.0, 0.9);
    let field = Field::Sphere { peak, radius };
    let value = 1.0;
    // Where peak·(1 − r²/R²) is the value.
    let surface_radius = radius * (1.0f32 - value / peak).sqrt();
    let volume = Arc::new(field.volume(96));
    let shading = Shading::default();
    let of = |isos| {
        let settings =
            MarchSettings { mode: Mode::Iso, isos, shading: Some(shading), ..MarchSettings::default() };
        Scene::new(volume.clone(), &ramp(peak), settings)
    };
    let scene = of(Isos::one(value));
    let camera = camera(&scene, 0.6);
    let picture = render(&scene, &camera);
    let voxel = scene.volume.spacing().x;
    let mut num_lit = 0;
    for (i, pixel) in picture.pixels.iter().enumerate() {
        let (x, y) = (i as u32 % picture.width, i as u32 / picture.width);
        let (ray, _) = camera.ray(x as f32 + 0.5, y as f32 + 0.5);
        let nearest = ray.at(-ray.origin.dot(ray.dir)).length();
        if nearest > surface_radius + 0.1 * voxel {
            assert_eq!(pixel[3], 0.0, "beside the surface");
        } else if nearest < surface_radius - 0.1 * voxel {
            assert!(pixel[3] > 0.999, "opaque: {}", pixel[3]);
            let half_chord = (surface_radius * surface_radius - nearest * nearest).sqrt();
            let normal = ray.at(-ray.origin.dot(ray.dir) - half_chord).normalize();
            let exact = shading.ambient + shading.diffuse * normal.dot(shading.light).abs();
            // Shares of a byte, interpolated between voxels, with gradients of central differences; and near to where the light
            // grazes |cos| has a corner, which a voxel rounds.
            assert!((pixel[0] - exact).abs() < 0.05, "{} and {exact}", pixel[0]);
            num_lit += 1;
        }
    }
    assert!(num_lit > 40, "{num_lit}");
    // A translucent surface is crossed twice; two of them one in the other four times.
    let in_the_middle = |isos: &[Iso]| {
        let scene = of(Isos::new(isos).unwrap());
        let mut narrow = camera;
        narrow.intrinsics = Intrinsics::perspective(1, 1, 0.01);
        render(&scene, &narrow).pixels[0][3]
    };
    let at = |value, opacity| Iso { value, opacity };
    assert!((in_the_middle(&[at(value, 0.3)]) - (1.0 - 0.7f32.powi(2))).abs() < 1e-4);
    let both = in_the_middle(&[at(value, 0.3), at(1.5, 0.2)]);
    assert!((both - (1.0 - 0.7f32.powi(2) * 0.8f32.powi(2))).abs() < 1e-4, "{both}");
    assert_eq!(in_the_middle(&[at(value, 0.0)]), 0.0);
    // Negative control: a step twice as long finds it in the same place, another value does not.
    let other = render(&of(Isos::one(1.2)), &camera);
    assert_ne!(other.pixels, picture.pixels);
    let coarse = MarchSettings { step_in_voxels: 1.0, ..scene.settings };
    let coarse = render(&scene.with_look(&ramp(peak), coarse), &camera);
    let difference = |a: &Picture| {
        a.pixels.iter().zip(&picture.pixels).map(|(a, b)| (a[0] - b[0]).abs()).fold(0.0, f32::max)
    };
    assert!(difference(&coarse) < 0.02, "{}", difference(&coarse));
    assert!(difference(&other) > 0.1);
}

/// A cubic volume of noise over a ramp: all kinds of values on every ray.
fn noise() -> Arc<Volume> {
    let voxels = (0..40u32 * 40 * 40).map(|i| {
        let (x, y, z) = (i % 40, i / 40 % 40, i / 1600);
        let wave = ((x as f32 * 0.7).sin() * (y as f32 * 0.5).cos() * (z as f32 * 0.6).sin() + 1.0) * 90.0;
        if (x / 8 + y / 8 + z / 8) % 3 == 0 { 0 } else { wave as u8 }
    });
    Arc::new(
        Volume::new(
            [40; 3],
            Vec3::new(0.05, 0.06, 0.05),
            Voxels::U8(voxels.collect()),
            (1.0, 0.0),
            Default::default(),
        )
        .unwrap(),
    )
}

#[test]
fn skipping_empty_bricks_changes_nothing() {
    for mode in Mode::ALL {
        // A domain that leaves much out at both ends.
        for domain in [Domain::Values(60.0, 150.0), Domain::Values(150.0, 240.0)] {
            let transfer = TransferFunction { domain, ..ramp(1.0) };
            let isos =
                Isos::new(&[Iso { value: 50.0, opacity: 0.4 }, Iso { value: 200.0, opacity: 1.0 }]).unwrap();
            let scene = Scene::new(noise(), &transfer, MarchSettings { isos, ..settings(mode) });
            let full = Scene { occupancy: Occupancy::full(scene.bricks.dims()), ..scene.clone() };
            for azimuth in [0.2, 2.0] {
                let camera = camera(&scene, azimuth);
                assert_eq!(render(&scene, &camera).pixels, render(&full, &camera).pixels, "{mode}");
            }
        }
    }
    // Negative control: there is something to skip.
    let scene =
        Scene::new(noise(), &ramp(1.0), MarchSettings { isos: Isos::one(1e6), ..settings(Mode::Iso) });
    assert_eq!(scene.occupancy.fraction(), 0.0);
}

fn frame_of(mode: Mode, k: u8) -> (Scene, Camera, LayeredFrame) {
    let scene = Scene::new(noise(), &ramp(180.0), settings(mode));
    let camera = camera(&scene, 0.4);
    let frame = generate(&scene, FrameHeader::alone(camera, k));
    frame.validate().unwrap();
    assert_eq!(frame.header.mode, mode);
    (scene, camera, frame)
}

#[test]
fn lists_hold_their_budget_and_the_greatest_key_once() {
    for mode in [Mode::Mip, Mode::MinIp, Mode::Average] {
        for k in [1u8, 4, 16] {
            let (.., frame) = frame_of(mode, k);
            let filled = frame.offsets.windows(2).filter(|w| w[1] > w[0]).count();
            let mean = frame.num_segments() as f32 / filled as f32;
            // The sample is a sixteenth of the rays.
            assert!(mean <= f32::from(k) * 1.15, "{mode}, k = {k}: {mean}");
            for list in 0..filled {
                let keys: Vec<f32> = frame.list(list).map(|i| frame.segment(i).tau).collect();
                let greatest = keys.iter().copied().fold(0.0, f32::max);
                let num = keys.iter().filter(|key| **key == greatest).count();
                assert!(mode == Mode::Average || keys.is_empty() || num == 1, "{mode}: {keys:?}");
            }
        }
    }
}

/// A brute-force reference: each ray of `beside` goes through the nearest lists in tiny steps. What it shows, as sRGB, for
/// the rays that meet the box.
fn tiny_steps(scene: &Scene, own: &Camera, frame: &LayeredFrame, beside: &Camera) -> Vec<Option<f32>> {
    let bounds = scene.volume.bounds();
    let basis = own.basis();
    let unit = (own.far - own.near) / 65535.0;
    let way_of = |ray: &Ray| {
        bounds.clip(ray).map_or(0.0, |(s0, s1)| s1 - s0).max((bounds.max - bounds.min).length() / 128.0)
    };
    let shown = |i: u32| {
        let (ray, _) = beside.ray((i % 32) as f32 + 0.5, (i / 32) as f32 + 0.5);
        let (s0, s1) = bounds.clip(&ray)?;
        let (mut greatest, mut shown, mut sum) = (0.0, 0.0, 0.0);
        let num = 4000;
        let ds = (s1 - s0) / num as f32;
        for n in 0..num {
            let h = basis.pixel_from_point(ray.at(s0 + ds * (n as f32 + 0.5)));
            let (x, y) = (h.x / h.z, h.y / h.z);
            if !(0.0..32.0).contains(&x) || !(0.0..26.0).contains(&y) {
                continue;
            }
            let depth = (h.z - own.near) / unit;
            let list = y as usize * 32 + x as usize;
            let segments = frame.list(list).map(|i| frame.segment(i));
            let mut here = segments.filter(|s| f32::from(s.front) <= depth && depth < f32::from(s.back));
            let Some(segment) = here.next() else { continue };
            let (of_list, slant) = basis.ray(x.floor() + 0.5, y.floor() + 0.5);
            let length = f32::from(segment.back - segment.front) * unit * slant;
            sum += segment.c.x * way_of(&of_list) * ds / length;
            if segment.tau > greatest {
                (greatest, shown) = (segment.tau, segment.c.x);
            }
        }
        let linear = if frame.header.mode == Mode::Average { sum / way_of(&ray) } else { shown };
        Some(srgb_from_linear(linear))
    };
    (0..beside.intrinsics.num_pixels() as u32).map(shown).collect()
}

#[test]
fn novel_views_are_those_of_tiny_steps() {
    for mode in [Mode::Mip, Mode::Average] {
        let (scene, own, frame) = frame_of(mode, 6);
        let bounds = scene.volume.bounds();
        // For the control: what each list shows lies an eighth of the depth nearer.
        let mut nearer = frame.clone();
        nearer.depth.iter_mut().for_each(|ends| *ends -= (*ends & 0xffff).min(8192) * 0x1_0001);
        let options = CastOptions { reconstruction: Reconstruction::Nearest, ..CastOptions::default() };
        for azimuth in [0.4, 0.6, 1.4] {
            let beside = camera(&scene, azimuth);
            let exact = tiny_steps(&scene, &own, &frame, &beside);
            let error = |frame: &LayeredFrame| {
                let found = Raycaster::new(frame, &bounds).picture(&beside, &options);
                let pairs = found.pixels.iter().zip(&exact);
                let mut errors: Vec<f32> =
                    pairs.filter_map(|(p, exact)| Some((srgb_from_linear(p[0]) - (*exact)?).abs())).collect();
                errors.sort_by(f32::total_cmp);
                errors[errors.len() * 98 / 100]
            };
            // The steps miss corners of lists that a ray cuts by less than a step: a ray in a hundred.
            assert!(error(&frame) < 0.01, "{mode} at {azimuth}: {}", error(&frame));
            // From its own pose a list shows the same at any depth.
            let control = error(&nearer);
            assert!(azimuth == 0.4 || control > 0.03, "{mode} at {azimuth}, nearer: {control}");
        }
    }
}
