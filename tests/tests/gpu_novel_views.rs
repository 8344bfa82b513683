//! Do novel views on the GPU, of one frame and of several, come out as from their Rust twins? On any adapter, lavapipe
//! too; the tolerance is that of `isinglass_tests::twins`.

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::kernels::combine;
use isinglass_core::kernels::layering;
use isinglass_core::kernels::raycast::{self, CastOptions, Raycaster, Reconstruction};
use isinglass_core::layer::LayeredFrame;
use isinglass_gpu::{GpuError, GpuReprojector};
use isinglass_tests::twins::{Difference, camera, gpu, header, scenes, views};

#[test]
fn novel_views_are_those_of_the_twin() {
    let Some(gpu) = gpu() else { return };
    for (name, scene) in scenes() {
        let bounds = scene.volume.bounds();
        let frame = layering::generate(&scene, header(camera(&scene, 25.0, (90, 77)), 8));
        let mut reprojector = GpuReprojector::new(gpu, &frame, &bounds).unwrap();
        let caster = Raycaster::new(&frame, &bounds);
        for (view, camera) in views(&scene) {
            let twin = raycast::raycast(&frame, &bounds, &camera);
            let found = reprojector.raycast(&camera).unwrap();
            Difference::of(&found, &twin).assert_tolerable(&format!("{name}, {view}"));
            // Jumping over empty cells leaves out nothing. Without it the kernel is another one, which may round otherwise.
            let skips_none = CastOptions { skips_empty_space: false, ..Default::default() };
            let all = reprojector.raycast_with(&camera, &skips_none).unwrap();
            Difference::of(&all, &found).assert_tolerable(&format!("{name}, {view}, all cells"));
            let nearest = CastOptions { reconstruction: Reconstruction::Nearest, ..Default::default() };
            let found = reprojector.raycast_with(&camera, &nearest).unwrap();
            let twin_nearest = caster.picture(&camera, &nearest);
            Difference::of(&found, &twin_nearest).assert_tolerable(&format!("{name}, {view}, nearest"));
            let mut shifted = camera;
            shifted.pose.eye += camera.pose.world_from_view * Vec3::X * (0.02 * bounds.radius());
            let shifted = reprojector.raycast(&shifted).unwrap();
            Difference::of(&shifted, &twin).assert_noticed(&format!("{name}, {view}: a camera shifted"));
        }
    }
}

/// The newest frame sees a part of the volume only, older ones other parts of it, and the pictures look beside, between and
/// beyond them.
#[test]
fn several_frames_are_combined_as_by_the_twin() {
    let Some(gpu) = gpu() else { return };
    // A soft one and an opaque one.
    for (name, scene) in scenes().into_iter().take(2) {
        let bounds = scene.volume.bounds();
        let near = |degrees: f32, aside: f32, (width, height): (u32, u32)| {
            let intrinsics = Intrinsics::perspective(width, height, 0.7);
            let pose = Pose::orbit(bounds.center(), degrees.to_radians(), 0.2, 0.8 * bounds.radius());
            let eye = pose.eye + pose.world_from_view * (Vec3::X * (aside * bounds.radius()));
            Camera::new(Pose { eye, ..pose }, intrinsics, &bounds)
        };
        let frame = |degrees, aside, size| layering::generate(&scene, header(near(degrees, aside, size), 6));
        // Of several sizes: each has its own buffers.
        let frames = [
            frame(0.0, 0.0, (72, 56)),
            frame(35.0, 0.0, (80, 56)),
            frame(-40.0, 0.2, (64, 64)),
            frame(180.0, 0.0, (40, 40)),
        ];
        let frames = frames.each_ref();
        let pictures = [(0.0, 0.0), (12.0, 0.0), (-25.0, 0.15), (60.0, -0.1)];
        let mut reprojector = GpuReprojector::new(gpu, frames[0], &bounds).unwrap();
        for num_frames in [4, 2] {
            reprojector.set_frames(&frames[..num_frames], &bounds).unwrap();
            for (degrees, aside) in pictures {
                let what = format!("{name}, {num_frames} frames, {degrees} degrees");
                let camera = near(degrees, aside, (72, 56));
                let found = reprojector.raycast(&camera).unwrap();
                let twin = combine::combine(&frames[..num_frames], &bounds, &camera);
                Difference::of(&found, &twin).assert_tolerable(&what);
                let newest = raycast::raycast(frames[0], &bounds, &camera);
                if degrees == 0.0 {
                    Difference::of(&found, &newest).assert_tolerable("the own pose");
                } else {
                    Difference::of(&found, &newest).assert_noticed(&format!("{what}: kept frames left out"));
                }
            }
        }
        // One frame is cast as ever, and so are several from the newest one's own pose: by two kernels, and compilers fuse other
        // operations in each, so that their bits differ where nobody sees it.
        let [own, turned] = [0.0, 12.0].map(|degrees| near(degrees, 0.0, (72, 56)));
        let together = [own, turned].map(|camera| reprojector.raycast(&camera).unwrap());
        reprojector.set_frame(frames[0], &bounds).unwrap();
        let alone = [own, turned].map(|camera| reprojector.raycast(&camera).unwrap());
        Difference::of(&together[0], &alone[0]).assert_tolerable(&format!("{name}: several, the own pose"));
        Difference::of(&together[1], &alone[1]).assert_noticed(&format!("{name}: several, turned"));
        let mut never_several = GpuReprojector::new(gpu, frames[0], &bounds).unwrap();
        let again = never_several.raycast(&turned).unwrap();
        Difference::of(&again, &alone[1]).assert_tolerable(&format!("{name}: one after several"));
    }
}

#[test]
fn a_reprojector_takes_frames_of_any_size_and_refuses_bad_ones() {
    let Some(gpu) = gpu() else { return };
    let (_, scene) = scenes().swap_remove(1);
    let bounds = scene.volume.bounds();
    let frame = |size, k| layering::generate(&scene, header(camera(&scene, 25.0, size), k));
    let view = camera(&scene, 31.0, (64, 48));
    let mut reprojector = GpuReprojector::new(gpu, &frame((20, 16), 2), &bounds).unwrap();
    for frame in
        [frame((120, 90), 8), frame((30, 40), 3), LayeredFrame::empty(header(camera(&scene, 0.0, (9, 9)), 4))]
    {
        reprojector.set_frame(&frame, &bounds).unwrap();
        let twin = raycast::raycast(&frame, &bounds, &view);
        Difference::of(&reprojector.raycast(&view).unwrap(), &twin)
            .assert_tolerable("a frame of another size");
    }
    let good = frame((30, 40), 3);
    reprojector.set_frame(&good, &bounds).unwrap();
    let before = reprojector.raycast(&view).unwrap();
    let broken: [fn(&mut LayeredFrame); 5] = [
        |f| f.offsets[5] = u32::MAX,
        |f| f.offsets.truncate(10),
        |f| f.depth.truncate(1),
        |f| f.c_rg.clear(),
        |f| f.header.camera.near = -1.0,
    ];
    for damage in broken {
        let mut bad = good.clone();
        damage(&mut bad);
        assert!(matches!(reprojector.set_frame(&bad, &bounds), Err(GpuError::Frame(_) | GpuError::Camera)));
    }
    assert_eq!(reprojector.raycast(&view).unwrap(), before);
    // A list in disorder, which no decoder gives, ends: nothing of it is shown.
    let mut disordered = good;
    disordered.depth.reverse();
    reprojector.set_frame(&disordered, &bounds).unwrap();
    Difference::of(&reprojector.raycast(&view).unwrap(), &before).assert_noticed("disorder");
}
