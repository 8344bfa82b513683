//! Every rule in every mode: the view of a layered frame from its own pose is the rendering, to 1/255.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::kernels::layering::generate;
use isinglass_core::kernels::march::{MarchSettings, Scene, render};
use isinglass_core::kernels::raycast::raycast;
use isinglass_core::layer::FrameHeader;
use isinglass_core::mode::{Iso, Isos, Mode};
use isinglass_core::picture::Picture;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::{Volume, Voxels};

const SIDE: u32 = 48;

/// Bubbles over a ramp. Matter reaches all faces of the volume, and rays leave some of it just before they leave the box.
fn bubbles() -> Arc<Volume> {
    let voxels = (0..SIDE.pow(3)).map(|i| {
        let [x, y, z] = [i % SIDE, i / SIDE % SIDE, i / SIDE / SIDE].map(|n| n as f32);
        let wave = (x * 0.61).sin() * (y * 0.47).cos() + (z * 0.53).sin() * (x * 0.29).cos();
        ((wave + 2.0) * 50.0 + (x + y + z) * 0.3) as u8
    });
    let voxels = Voxels::U8(voxels.collect());
    let spacing = Vec3::new(0.05, 0.06, 0.045);
    Arc::new(Volume::new([SIDE; 3], spacing, voxels, (1.0, 0.0), Default::default()).unwrap())
}

fn transfer(mode: Mode) -> TransferFunction {
    let p = |x, color, opacity| ControlPoint { x, color, opacity };
    let points = vec![
        p(0.0, [0.1, 0.2, 0.9], 0.0),
        p(0.4, [0.2, 0.8, 0.5], 0.1),
        p(0.7, [0.9, 0.6, 0.2], 0.6),
        p(1.0, [1.0, 1.0, 0.9], 0.98),
    ];
    let turned = points.iter().rev().map(|point| ControlPoint { x: 1.0 - point.x, ..*point }).collect();
    TransferFunction {
        name: "test".into(),
        domain: Domain::Full,
        unit_length: UnitLength::Voxel,
        points: if mode == Mode::MinIp { turned } else { points },
    }
}

/// The surfaces: opaque, and opaque ones within and around a translucent one.
fn isos() -> [Isos; 3] {
    let at = |value, opacity| Iso { value, opacity };
    [
        Isos::one(110.0),
        Isos::new(&[at(90.0, 0.3), at(120.0, 1.0)]).unwrap(),
        Isos::new(&[at(80.0, 0.2), at(100.0, 0.4), at(115.0, 1.0), at(130.0, 0.5)]).unwrap(),
    ]
}

fn max_difference(a: &Picture, b: &Picture) -> u8 {
    a.to_srgb8([0.0; 3]).iter().zip(&b.to_srgb8([0.0; 3])).map(|(x, y)| x.abs_diff(*y)).max().unwrap()
}

#[test]
fn in_every_mode() {
    let volume = bubbles();
    let bounds = volume.bounds();
    let intrinsics = Intrinsics::perspective(110, 90, 0.6);
    let camera_at = |azimuth: f32| {
        let pose = Pose::orbit(Vec3::ZERO, azimuth, 0.35, bounds.radius() * intrinsics.fit_distance());
        Camera::new(pose, intrinsics, &bounds)
    };
    let whole = Scene::new(volume, &transfer(Mode::Composite), MarchSettings::default());
    let mut looks = vec![(Mode::Composite, Isos::default())];
    looks.extend([Mode::Mip, Mode::MinIp, Mode::Average].map(|mode| (mode, Isos::default())));
    looks.extend(isos().map(|isos| (Mode::Iso, isos)));
    // Frames of each look, and those of them in which the control was noticed.
    let mut noticed = Vec::new();
    for (i, (mode, isos)) in looks.into_iter().enumerate() {
        let scene = whole.with_look(&transfer(mode), MarchSettings { mode, isos, ..whole.settings });
        let azimuth = [0.5, 2.4][i % 2];
        let camera = camera_at(azimuth);
        let truth = render(&scene, &camera);
        let (mut num, mut num_noticed) = (0, 0);
        for k in [1, 8, 16] {
            let mut frame = generate(&scene, FrameHeader::alone(camera, k));
            frame.validate().unwrap();
            let at = format!("look {i}, {azimuth}, k = {k}");
            let flat = max_difference(&frame.flatten(), &truth);
            let own = max_difference(&raycast(&frame, &bounds, &camera), &truth);
            // Half floats carry C and τ to 2^−11: less than half a step of 1/255.
            assert!(own.max(flat) <= 1, "{at}: composited {flat}, cast {own}");
            // Negative controls: five degrees to the side is another picture, and so is, if the list has many segments, one
            // of which what lies before the volume's far side is pushed behind it.
            let beside = raycast(&frame, &bounds, &camera_at(azimuth + 0.09));
            assert!(max_difference(&beside, &truth) > 8, "{at}: a turned camera shows the same");
            frame.depth.iter_mut().for_each(|ends| *ends += 64 | 64 << 16);
            num += 1;
            num_noticed += usize::from(max_difference(&raycast(&frame, &bounds, &camera), &truth) > 1);
        }
        noticed.push((mode, num, num_noticed));
    }
    assert!(noticed.iter().all(|(_, num, num_noticed)| num_noticed * 2 > *num), "{noticed:?}");
}
