//! Do the kernels stay whole on all that a file or a peer may name: voxels from one end of the floats to the other, eyes
//! from inside the volume to where rounding swallows it?

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::codec;
use isinglass_core::kernels::layering::generate;
use isinglass_core::kernels::march::{MarchSettings, Scene, render};
use isinglass_core::kernels::raycast::raycast;
use isinglass_core::layer::FrameHeader;
use isinglass_core::mode::Mode;
use isinglass_core::picture::Picture;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Lighting, Volume, VolumeError, VolumeInfo, Voxels};

fn scene(voxels: [f32; 8], domain: Domain, spacing: f32) -> Scene {
    let p = |x| ControlPoint { x, color: [1.0, 0.5, 0.2], opacity: x };
    let (name, unit_length) = ("ramp".into(), UnitLength::Voxel);
    let transfer = TransferFunction { name, domain, unit_length, points: vec![p(0.0), p(1.0)] };
    let voxels = Voxels::F32(voxels.into());
    let volume =
        Volume::new([2; 3], Vec3::splat(spacing), voxels, (1.0, 0.0), VolumeInfo::default()).unwrap();
    let lighting = Lighting { specular: 1.0, shininess: 128.0, ..Lighting::default() };
    Scene::new(Arc::new(volume), &transfer, MarchSettings::of(true, lighting))
}

fn is_finite(picture: &Picture) -> bool {
    picture.pixels.iter().flatten().all(|x| x.is_finite())
}

/// All kernels, the codec between them. Returns the rendered picture.
fn through_everything(scene: &Scene, pose: Pose) -> Picture {
    let bounds = scene.volume.bounds();
    let camera = Camera::new(pose, Intrinsics::perspective(64, 64, 0.7), &bounds);
    assert!(camera.is_valid(), "{camera:?}");
    let picture = render(scene, &camera);
    assert!(is_finite(&picture), "{pose:?}");
    for k in [1, 3] {
        let made = generate(scene, FrameHeader::alone(camera, k));
        made.validate().unwrap();
        let encoded = codec::encode(&made).unwrap();
        let chunks: Vec<_> = encoded.chunks.iter().map(|c| &c.bytes).collect();
        let decoded = codec::decode(&chunks).unwrap();
        assert!(is_finite(&raycast(&decoded, &bounds, &camera)), "{k} {pose:?}");
    }
    picture
}

const MAX: f32 = Volume::MAX_MAGNITUDE;

#[test]
fn voxels_of_any_size_are_pictures() {
    for (lo, hi) in [(-MAX, MAX), (0.0, MAX), (0.0, 1e-37), (1.0, 1.0), (0.0, 1.0)] {
        let half = lo * 0.5 + hi * 0.5;
        let voxels = [lo, hi, half, half, hi, lo, half, hi];
        for domain in [Domain::Full, Domain::Percentiles(1.0, 99.0), Domain::Values(0.0, 1e-40)] {
            for spacing in [1e-12, 1.0, 1e12] {
                let pose = Pose::orbit(Vec3::ZERO, 0.4, 0.3, 6.0 * spacing);
                let picture = through_everything(&scene(voxels, domain, spacing), pose);
                // What has a range is seen through its own domain, however large or small the numbers.
                let is_seen = picture.pixels.iter().any(|p| p[3] > 0.1);
                assert!(is_seen || lo == hi || domain != Domain::Full, "{lo} to {hi}, {spacing}");
            }
        }
    }
}

/// The moments of a mean are sums of squares of distances, which overflow first.
#[test]
fn projections_of_any_size_are_pictures() {
    let p = |x| ControlPoint { x, color: [1.0, 0.5, 0.2], opacity: x };
    let (name, unit_length) = ("ramp".into(), UnitLength::Voxel);
    let transfer = TransferFunction { name, domain: Domain::Full, unit_length, points: vec![p(0.0), p(1.0)] };
    for spacing in [1e-12, 1.0, 1e12] {
        for mode in [Mode::Average, Mode::Mip, Mode::MinIp] {
            let voxels = Voxels::U8((0..48 * 48 * 48u32).map(|i| (i * 37 % 251) as u8).collect());
            let info = VolumeInfo::default();
            let volume = Volume::new([48; 3], Vec3::splat(spacing), voxels, (1.0, 0.0), info).unwrap();
            let settings = MarchSettings { mode, ..MarchSettings::default() };
            let scene = Scene::new(Arc::new(volume), &transfer, settings);
            let bounds = scene.volume.bounds();
            let pose = Pose::orbit(Vec3::ZERO, 0.4, 0.3, 80.0 * spacing);
            let camera = Camera::new(pose, Intrinsics::perspective(24, 24, 0.9), &bounds);
            for k in [1, 8, 32] {
                let made = generate(&scene, FrameHeader::alone(camera, k));
                made.validate().unwrap();
                let shown = raycast(&made, &bounds, &camera);
                assert!(is_finite(&shown), "{mode} {spacing} {k}");
                assert!(shown.pixels.iter().any(|p| p[0] > 0.1), "{mode} {spacing} {k}");
            }
        }
    }
}

/// A file of a transfer function may name any thickness.
#[test]
fn matter_of_any_extinction_is_a_picture() {
    let of = |world| {
        let p = |x| ControlPoint { x, color: [1.0, 0.5, 0.2], opacity: x };
        let (name, unit_length) = ("ramp".into(), UnitLength::World(world));
        let transfer =
            TransferFunction { name, domain: Domain::Full, unit_length, points: vec![p(0.0), p(1.0)] };
        let volume = Arc::new(Builtin::Cubus.volume(16));
        let distance = volume.bounds().radius() * 4.0;
        let scene = Scene::new(volume, &transfer, MarchSettings::default());
        through_everything(&scene, Pose::orbit(Vec3::ZERO, 0.4, 0.3, distance))
    };
    let opaque = of(1e-10);
    for world in [1e-44, 1e-38, 1e-30, 1e-20] {
        let pixels = of(world).pixels;
        let pairs = pixels.iter().flatten().zip(opaque.pixels.iter().flatten());
        let greatest = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(greatest < 1e-3, "{world}: {greatest}");
    }
    // The control: what is thin is seen through.
    assert!(of(1e3).pixels.iter().all(|p| p[3] < 0.5));
}

#[test]
fn eyes_from_any_distance_see_pictures() {
    let scene = scene([0.0, 1.0, 0.5, 0.2, 0.9, 0.1, 0.7, 1.0], Domain::Full, 1.0);
    // 1e15 is the farthest that a pose datagram may name.
    for distance in [0.0, 1e-6, 1.0, 1e3, 1e6, 1e8, 1e11, 1e15] {
        for sign in [1.0, -1.0] {
            through_everything(&scene, Pose::orbit(Vec3::ZERO, 0.4, 0.3, sign * distance));
        }
    }
}

#[test]
fn voxels_and_values_that_are_no_numbers_make_no_volume() {
    let volume = |stored: f32, map| {
        let voxels = Voxels::F32(vec![0.0, stored]);
        Volume::new([2, 1, 1], Vec3::ONE, voxels, map, VolumeInfo::default()).map(|v| v.value_range())
    };
    assert_eq!(volume(2.0, (10.0, 1.0)), Ok((1.0, 21.0)));
    for stored in [f32::NAN, f32::INFINITY, 2e37] {
        assert!(
            matches!(volume(stored, (1.0, 0.0)), Err(VolumeError::NotFinite { count: 1, .. })),
            "{stored}"
        );
    }
    for map in [(f32::NAN, 0.0), (1.0, f32::INFINITY), (1e37, 0.0), (1.0, 2e37)] {
        assert!(matches!(volume(2.0, map), Err(VolumeError::Values { .. })), "{map:?}");
    }
}
