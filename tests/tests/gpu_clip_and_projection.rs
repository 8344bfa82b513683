//! Do the kernels on the GPU clip and see along parallel rays as their Rust twins do? On any adapter, lavapipe too; the
//! tolerance is that of `isinglass_tests::twins`.

use glam::Vec3;
use isinglass_core::camera::Camera;
use isinglass_core::clip::{Clip, Plane};
use isinglass_core::kernels::combine::combine_clipped;
use isinglass_core::kernels::layering;
use isinglass_core::kernels::march::{self, MarchSettings, Scene};
use isinglass_core::kernels::raycast::{CastOptions, Raycaster};
use isinglass_core::space::Aabb;
use isinglass_gpu::{GpuRenderer, GpuReprojector};
use isinglass_tests::twins::{Difference, camera, gpu, header, scenes};

/// Of the perspective cameras and those of parallel rays.
fn cameras(scene: &Scene, degrees: f32, size: (u32, u32)) -> [Camera; 2] {
    let camera = camera(scene, degrees, size);
    let bounds = scene.volume.bounds();
    [camera, camera.to_orthographic((bounds.center() - camera.pose.eye).dot(camera.pose.forward()), &bounds)]
}

/// Nothing, a box, a slanted plane, both, and what lies beside the volume.
fn clips(bounds: &Aabb) -> [Clip; 5] {
    let half = (bounds.max - bounds.min) * 0.5;
    let inner = Aabb { min: Vec3::new(-0.6, -0.4, -0.5) * half, max: Vec3::new(0.4, 0.7, 0.2) * half };
    let beside = Aabb { min: bounds.max * 2.0, max: bounds.max * 3.0 };
    let plane = Plane::new(Vec3::new(0.4, 1.0, -0.7), 0.1 * half.y);
    [
        Clip::default(),
        Clip { bounds: Some(inner), plane: None },
        Clip { bounds: None, plane },
        Clip { bounds: Some(inner), plane },
        Clip { bounds: Some(beside), plane: None },
    ]
}

#[test]
fn what_is_left_is_rendered_and_layered_as_by_the_twin() {
    let Some(gpu) = gpu() else { return };
    for (name, scene) in scenes().into_iter().skip(1).step_by(2) {
        let whole = march::render(&scene, &cameras(&scene, 25.0, (56, 48))[1]);
        let mut renderer = GpuRenderer::new(gpu, scene.clone()).unwrap();
        for clip in clips(&scene.volume.bounds()) {
            let cut = Scene { settings: MarchSettings { clip, ..scene.settings }, ..scene.clone() };
            renderer.set_scene(cut.clone()).unwrap();
            for camera in cameras(&scene, 25.0, (56, 48)) {
                let what = format!("{name}, {clip:?}");
                let twin = march::render(&cut, &camera);
                let found = renderer.render(&camera).unwrap();
                Difference::of(&found, &twin).assert_tolerable(&what);
                let frame = renderer.generate(header(camera, 8)).unwrap();
                frame.validate().unwrap();
                let twin = layering::generate(&cut, header(camera, 8));
                Difference::of(&frame.flatten(), &twin.flatten()).assert_tolerable(&what);
                if camera.intrinsics.projection.is_orthographic() && clip != Clip::default() {
                    Difference::of(&found, &whole).assert_noticed(&format!("{what}: what is cut away"));
                }
            }
        }
    }
}

#[test]
fn frames_of_both_projections_are_cast_and_cut_as_by_the_twin() {
    let Some(gpu) = gpu() else { return };
    for (name, scene) in scenes().into_iter().skip(1).take(2) {
        let bounds = scene.volume.bounds();
        for old in cameras(&scene, 25.0, (72, 64)) {
            let frame = layering::generate(&scene, header(old, 8));
            let mut reprojector = GpuReprojector::new(gpu, &frame, &bounds).unwrap();
            let caster = Raycaster::new(&frame, &bounds);
            for new in [26.5, 35.0, 200.0].into_iter().flat_map(|degrees| cameras(&scene, degrees, (52, 44)))
            {
                let [whole, ..] = clips(&bounds).map(|clip| {
                    let what = format!("{name}, {clip:?}, from {:?} into {new:?}", old.intrinsics);
                    let options = CastOptions { clip, ..CastOptions::default() };
                    let found = reprojector.raycast_with(&new, &options).unwrap();
                    Difference::of(&found, &caster.picture(&new, &options)).assert_tolerable(&what);
                    found
                });
                let other = cameras(&scene, 25.0, (52, 44));
                let other =
                    other.iter().find(|c| c.intrinsics.projection != new.intrinsics.projection).unwrap();
                let mixed = Camera { pose: new.pose, ..*other };
                let mixed = reprojector.raycast(&mixed).unwrap();
                Difference::of(&mixed, &whole).assert_noticed(&format!("{name}: the other projection"));
            }
        }
    }
}

#[test]
fn several_frames_of_both_projections_are_combined_and_cut_as_by_the_twin() {
    let Some(gpu) = gpu() else { return };
    let (name, scene) = scenes().swap_remove(0);
    let bounds = scene.volume.bounds();
    let near = |degrees, size, depth: f32| {
        let [camera, _] = cameras(&scene, degrees, size);
        camera.to_orthographic(depth * bounds.radius(), &bounds)
    };
    let frames = [near(0.0, (60, 56), 1.5), cameras(&scene, 20.0, (72, 60))[0], near(-20.0, (56, 40), 2.5)]
        .map(|camera| layering::generate(&scene, header(camera, 6)));
    let frames = frames.each_ref();
    let mut reprojector = GpuReprojector::of_frames(gpu, &frames, &bounds).unwrap();
    for display in [near(8.0, (52, 44), 2.0), cameras(&scene, 10.0, (52, 44))[0]] {
        for clip in clips(&bounds) {
            let options = CastOptions { clip, ..CastOptions::default() };
            let found = reprojector.raycast_with(&display, &options).unwrap();
            let twin = combine_clipped(&frames, &bounds, &display, &clip);
            Difference::of(&found, &twin).assert_tolerable(&format!("{name}, {clip:?}"));
            if clip == Clip::default() {
                let alone = Raycaster::new(frames[0], &bounds).picture(&display, &options);
                Difference::of(&found, &alone).assert_noticed("older frames left out");
            }
        }
    }
}
