//! Do pictures of several views, and views that are off-axis, come out of the GPU as they come out of the CPU?
//!
//! Tolerance as of every kernel against its twin (see `isinglass_tests::twins`): at most 2/255 at any channel and below
//! 0.1/255 in the mean.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::kernels::lens::{Exposure, View};
use isinglass_core::kernels::march::{MarchSettings, Scene};
use isinglass_core::layer::FrameHeader;
use isinglass_core::picture::Picture;
use isinglass_core::volume::procedural::Builtin;
use isinglass_gpu::GpuError;
use isinglass_render::Backend;
use isinglass_tests::twins::gpu;

fn backends() -> Option<[Backend; 2]> {
    gpu().map(|gpu| [Backend::Gpu(gpu.clone()), Backend::Cpu])
}

/// Greatest and mean difference in 1/255.
fn difference([a, b]: &[Picture; 2]) -> (u8, f64) {
    let [a, b] = [a, b].map(|p| p.to_srgb8([0.1, 0.2, 0.3]));
    let each = || a.iter().zip(&b).map(|(a, b)| a.abs_diff(*b));
    (each().max().unwrap(), each().map(f64::from).sum::<f64>() / a.len() as f64)
}

#[test]
fn means_and_shifted_eyes_are_the_same_on_both_backends() {
    let Some(backends) = backends() else { return };
    let transfer = isinglass_formats::preset("cloud").unwrap();
    let scene = Scene::new(Arc::new(Builtin::Cloud.volume(40)), &transfer, MarchSettings::default());
    let bounds = scene.volume.bounds();
    let intrinsics = Intrinsics::perspective(70, 53, 0.7);
    let camera = |azimuth| {
        Camera::new(Pose::orbit(Vec3::ZERO, azimuth, 0.2, 3.0 * bounds.radius()), intrinsics, &bounds)
    };
    let (open, focus_depth, r) = (camera(0.4), 2.6 * bounds.radius(), bounds.radius());
    let exposure =
        Exposure { aperture_radius: 0.3 * r, focus_depth, shutter: Some(camera(0.6).pose), num_samples: 6 };
    let [left, right] = View::from(&open).stereo(0.4 * r, focus_depth);
    let header = FrameHeader::alone(camera(0.3), 8);
    let frame = Arc::new(Backend::Cpu.renderer(scene.clone()).unwrap().generate(header).unwrap());
    let means = [exposure.views(&open, &bounds), vec![left], vec![right]].map(|views| {
        let novel = backends
            .each_ref()
            .map(|b| b.reprojector(frame.clone(), &bounds).unwrap().raycast_mean(&views).unwrap());
        let full =
            backends.each_ref().map(|b| b.renderer(scene.clone()).unwrap().render_mean(&views).unwrap());
        for both in [&novel, &full] {
            let (max, mean) = difference(both);
            assert!(max <= 2 && mean < 0.1, "max {max}, mean {mean}");
        }
        novel[0].clone()
    });
    // Negative control: the means are not those of one another.
    for (a, b) in [(0, 1), (1, 2)] {
        let (max, mean) = difference(&[means[a].clone(), means[b].clone()]);
        assert!(max > 2 && mean > 0.1, "max {max}, mean {mean}");
    }
    for backend in &backends {
        let mut reprojector = backend.reprojector(frame.clone(), &bounds).unwrap();
        let at_infinity = View::from(&open).shifted(glam::Vec2::X, 0.0);
        for bad in [vec![], vec![at_infinity]] {
            assert!(matches!(reprojector.raycast_mean(&bad), Err(GpuError::Camera)));
        }
    }
}
