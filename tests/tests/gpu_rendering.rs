//! Do rendering and the making of layered frames on the GPU do what their Rust twins do? On any adapter, lavapipe too;
//! the tolerance is that of `isinglass_tests::twins`.

use glam::Vec3;
use isinglass_core::camera::{Camera, Pose};
use isinglass_core::cancel::ALWAYS;
use isinglass_core::kernels::layering;
use isinglass_core::kernels::layering::budget::Budget;
use isinglass_core::kernels::march::{self, MarchSettings, Shading};
use isinglass_core::kernels::raycast;
use isinglass_core::layer::LayeredFrame;
use isinglass_core::mode::Mode;
use isinglass_core::picture::Picture;
use isinglass_core::volume::Lighting;
use isinglass_core::volume::procedural::Builtin;
use isinglass_gpu::{GpuError, GpuRenderer};
use isinglass_tests::twins::{Difference, camera, gpu, header, scene, scenes, transfer};

#[test]
fn render_is_that_of_the_twin() {
    let Some(gpu) = gpu() else { return };
    for (name, scene) in scenes() {
        let camera = camera(&scene, 25.0, (96, 72));
        let twin = march::render(&scene, &camera);
        let mut renderer = GpuRenderer::new(gpu, scene.clone()).unwrap();
        let found = renderer.render(&camera).unwrap();
        Difference::of(&found, &twin).assert_tolerable(name);
        assert!(found.pixels.iter().any(|p| p[3] > 0.5), "{name}: nothing to be seen");

        let mut turned = camera;
        turned.pose = Pose::orbit(Vec3::ZERO, 26f32.to_radians(), 0.35, camera.pose.eye.length());
        let turned = renderer.render(&turned).unwrap();
        Difference::of(&turned, &twin).assert_noticed("a camera turned by one degree");
    }
}

/// A rendering to the far side sees what one that stops at opaque matter does, so the twin is not enough: with a wall that
/// a rendering stops at for good, what is seen through it must be as faint as the twin's.
#[test]
fn render_through_is_that_of_the_twin() {
    let Some(gpu) = gpu() else { return };
    for (name, scene) in scenes() {
        let camera = camera(&scene, 25.0, (64, 48));
        let twin = march::render_through(&scene, &camera);
        let mut renderer = GpuRenderer::new(gpu, scene.clone()).unwrap();
        let found = renderer.render_through(&camera).unwrap();
        Difference::of(&found, &twin).assert_tolerable(name);
        // Opacity in units that only a march that goes on can reach: a stop leaves 10⁻⁴.
        let least = |p: &Picture| p.pixels.iter().map(|p| 1.0 - p[3]).fold(1.0, f32::min);
        let (stopped, found, twin) = (renderer.render(&camera).unwrap(), least(&found), least(&twin));
        if twin < 1e-6 {
            assert!(found < 1e-6, "{name}: {found} is left, the twin leaves {twin}");
            assert!(least(&stopped) > found, "{name}: negative control: a rendering that stops");
        }
        let turned = Pose::orbit(Vec3::ZERO, 26f32.to_radians(), 0.35, camera.pose.eye.length());
        let turned = renderer.render_through(&Camera { pose: turned, ..camera }).unwrap();
        let twin = march::render_through(&scene, &camera);
        Difference::of(&turned, &twin).assert_noticed("a camera turned by one degree");
    }
}

/// 36 MiB of voxels: more than one slab of the upload, the last one not full.
#[test]
fn volumes_are_uploaded_to_the_last_slice() {
    let Some(gpu) = gpu() else { return };
    let scene = scene(Builtin::Cubus.volume(336), false, None);
    let mut renderer = GpuRenderer::new(gpu, scene.clone()).unwrap();
    // Azimuth 0 sees the last slices in front, 180 the first.
    for azimuth in [0.0, 180.0] {
        let camera = camera(&scene, azimuth, (48, 48));
        let found = renderer.render(&camera).unwrap();
        Difference::of(&found, &march::render(&scene, &camera)).assert_tolerable("several slabs");
    }
}

#[test]
fn the_look_can_change_without_another_upload() {
    let Some(gpu) = gpu() else { return };
    let light = Vec3::new(0.9, -0.3, 0.2).normalize();
    let (_, scene) = scenes().swap_remove(1);
    let camera = camera(&scene, 25.0, (64, 64));
    let mut renderer = GpuRenderer::new(gpu, scene.clone()).unwrap();
    let before = renderer.render(&camera).unwrap();
    let settings =
        MarchSettings { shading: Some(Shading { light, ..Default::default() }), ..Default::default() };
    let relit = scene.with_look(&transfer(false), settings);
    renderer.set_scene(relit.clone()).unwrap();
    let after = renderer.render(&camera).unwrap();
    Difference::of(&after, &march::render(&relit, &camera)).assert_tolerable("another light");
    Difference::of(&after, &before).assert_noticed("another light");
    let softer = scene.with_look(&transfer(true), settings);
    renderer.set_scene(softer.clone()).unwrap();
    let found = renderer.render(&camera).unwrap();
    Difference::of(&found, &march::render(&softer, &camera)).assert_tolerable("another transfer function");
    // Shade comes with the brightness, shaded by gradients or not.
    let lighting = Lighting { ambient_occlusion: 0.9, shadows: 0.8, ..Lighting::default() };
    for is_shaded in [true, false] {
        let shady = scene.with_look(&transfer(true), MarchSettings::of(is_shaded, lighting));
        renderer.set_scene(shady.clone()).unwrap();
        let found = renderer.render(&camera).unwrap();
        Difference::of(&found, &march::render(&shady, &camera)).assert_tolerable("shade");
        let bare = scene.with_look(&transfer(true), MarchSettings::of(is_shaded, Lighting::default()));
        Difference::of(&found, &march::render(&bare, &camera)).assert_noticed("no shade");
        // Some rows are those of the whole picture, to the bit.
        let rows = renderer.render_rows(&camera, 17..31).unwrap();
        assert!(rows.pixels[..] == found.pixels[17 * 64..31 * 64]);
    }
    // And another volume, of another size and type.
    let (_, other) = scenes().swap_remove(4);
    renderer.set_scene(other.clone()).unwrap();
    let found = renderer.render(&camera).unwrap();
    Difference::of(&found, &march::render(&other, &camera)).assert_tolerable("another volume");
}

/// Lists cannot be equal word by word: a rounding decides to which depth unit an end goes, and where one of two pieces ends
/// whose errors are equal (there are many: equal cubes, equal shells, everything hidden). Composited along their own rays
/// they must agree within the tolerance of all pictures. From aside, pieces that end elsewhere show: they are as good, so
/// visibility-merge is allowed 0.5 % of the pixels beyond 2/255, and its error against the true picture must be the same to
/// 2 % of itself. Segments are not counted: rounding decides whether an error is above the threshold.
#[test]
fn layered_frames_are_those_of_the_twin() {
    let Some(gpu) = gpu() else { return };
    for (name, scene) in scenes() {
        let bounds = scene.volume.bounds();
        let camera_0 = camera(&scene, 25.0, (80, 64));
        let camera_1 = camera(&scene, 37.0, (80, 64));
        let view = |frame: &LayeredFrame| raycast::raycast(frame, &bounds, &camera_1);
        let truth = march::render(&scene, &camera_1);
        let mut renderer = GpuRenderer::new(gpu, scene.clone()).unwrap();
        // One scene tries the ends of the range.
        let ks: &[u8] = if name.starts_with("cubus") { &[8, 1, 32] } else { &[8] };
        for &k in ks {
            let what = format!("{name}, k = {k}");
            let twin = layering::generate(&scene, header(camera_0, k));
            let found = renderer.generate(header(camera_0, k)).unwrap();
            found.validate().unwrap_or_else(|e| panic!("{what}: {e}"));
            assert_eq!(found.header, twin.header);
            Difference::of(&found.flatten(), &twin.flatten()).assert_tolerable(&what);
            let (view_found, view_twin) = (view(&found), view(&twin));
            let turned = Difference::of(&view_found, &view_twin);
            assert!(
                turned.is_tolerable() || k > 1 && turned.is_another_choice(),
                "{what}, turned: {turned:?}"
            );
            let error = |view| Difference::of(view, &truth).mean;
            let (a, b) = (error(&view_found), error(&view_twin));
            assert!((a - b).abs() <= 0.02 * b, "{what}: error {a} of the view, the twin's is {b}");
            let tau =
                |f: &LayeredFrame| (0..f.num_segments()).map(|i| f64::from(f.segment(i).tau)).sum::<f64>();
            assert!((tau(&found) - tau(&twin)).abs() <= 1e-3 * tau(&twin), "{what}: optical depth in all");
            let again = renderer.generate(header(camera_0, k)).unwrap();
            assert!(again == found, "{what}: another result of the same input");
        }
        let twin = layering::generate(&scene, header(camera_0, 8));
        // Negative control: lists of half the length.
        let other = view(&renderer.generate(header(camera_0, 4)).unwrap());
        let turned = Difference::of(&other, &view(&twin));
        assert!(!turned.is_tolerable() && !turned.is_another_choice(), "{name}: {turned:?}");
    }
}

/// Their thresholds follow from the frame before, on the GPU as on the CPU.
#[test]
fn frames_that_follow_each_other_keep_their_budget() {
    let Some(gpu) = gpu() else { return };
    let (name, scene) = scenes().swap_remove(0);
    let mut on_gpu = GpuRenderer::new(gpu, scene.clone()).unwrap();
    let mut budget = Budget::default();
    let k = 4;
    for n in 0..8 {
        let header = header(camera(&scene, 25.0 + 3.0 * n as f32, (80, 64)), k);
        let found = on_gpu.generate_while(header, ALWAYS).unwrap().unwrap();
        let twin = layering::generate_while(&scene, header, &mut budget, ALWAYS).unwrap();
        Difference::of(&found.flatten(), &twin.flatten()).assert_tolerable(name);
        for (which, frame) in [("gpu", found), ("cpu", twin)] {
            let mean = frame.segments_mean();
            // The first frame is counted on a sixteenth of its rays.
            assert!((mean / f64::from(k) - 1.0).abs() < 0.15, "{name}, {which}, frame {n}: {mean}");
        }
    }
    // Another K is counted, not followed.
    let header = header(camera(&scene, 46.0, (80, 64)), 12);
    let mean = on_gpu.generate_while(header, ALWAYS).unwrap().unwrap().segments_mean();
    assert!((mean / 12.0 - 1.0).abs() < 0.2, "{mean}");
}

#[test]
fn pictures_of_several_dispatches_have_no_seams() {
    let Some(gpu) = gpu() else { return };
    let (_, scene) = scenes().swap_remove(0);
    // More pixels than a software device takes in a dispatch, and no multiple of any workgroup or block.
    let camera = camera(&scene, 200.0, (333, 211));
    let mut renderer = GpuRenderer::new(gpu, scene.clone()).unwrap();
    let found = renderer.render(&camera).unwrap();
    Difference::of(&found, &march::render(&scene, &camera)).assert_tolerable("render");
    let frame = renderer.generate(header(camera, 3)).unwrap();
    frame.validate().unwrap();
    let twin = layering::generate(&scene, header(camera, 3));
    Difference::of(&frame.flatten(), &twin.flatten()).assert_tolerable("generate");
    let moved =
        Picture { pixels: found.pixels.iter().cycle().skip(333).take(333 * 211).copied().collect(), ..found };
    Difference::of(&moved, &march::render(&scene, &camera)).assert_noticed("a row too many");
}

/// In every voxel type, for parallel rays too, with and without shade, in a medium and on surfaces.
#[test]
fn highlights_are_those_of_the_twin() {
    let Some(gpu) = gpu() else { return };
    for (i, (name, scene)) in scenes().into_iter().enumerate() {
        let mode = if i % 2 == 1 { Mode::Iso } else { Mode::Composite };
        let ambient_occlusion = if i > 2 { 0.7 } else { 0.0 };
        let lighting = Lighting { specular: 0.9, shininess: 25.0, ambient_occlusion, ..Lighting::default() };
        let with = |lighting| {
            let settings = MarchSettings { mode, ..MarchSettings::of(true, lighting) };
            scene.with_look(&transfer(false), settings)
        };
        let glossy = with(lighting);
        let perspective = camera(&scene, 25.0, (64, 48));
        let distance = perspective.pose.eye.length();
        let mut renderer = GpuRenderer::new(gpu, with(Lighting { specular: 0.0, ..lighting })).unwrap();
        let matte = renderer.render(&perspective).unwrap();
        renderer.set_scene(glossy.clone()).unwrap();
        for camera in [perspective, perspective.to_orthographic(distance, &scene.volume.bounds())] {
            let twin = march::render(&glossy, &camera);
            Difference::of(&renderer.render(&camera).unwrap(), &twin).assert_tolerable(name);
            let frame = renderer.generate(header(camera, 8)).unwrap();
            frame.validate().unwrap();
            let twin = layering::generate(&glossy, header(camera, 8));
            Difference::of(&frame.flatten(), &twin.flatten()).assert_tolerable(name);
        }
        let shown = march::render(&glossy, &perspective);
        Difference::of(&matte, &shown).assert_noticed("no highlights");
        let duller = march::render(&with(Lighting { shininess: 20.0, ..lighting }), &perspective);
        Difference::of(&duller, &shown).assert_noticed("another exponent");
    }
}

#[test]
fn what_does_not_fit_is_refused_by_name() {
    let Some(gpu) = gpu() else { return };
    let (_, scene) = scenes().swap_remove(0);
    let mut renderer = GpuRenderer::new(gpu, scene.clone()).unwrap();
    let huge = camera(&scene, 0.0, (8192, 8192));
    let error = renderer.generate(header(huge, 16)).unwrap_err();
    assert!(matches!(error, GpuError::TooLarge { .. }), "{error}");
    // The longest lists of the sources at full size: a quarter of a gigabyte a plane, which not every device can bind.
    match renderer.generate(header(camera(&scene, 0.0, (1920, 1080)), 30)) {
        Ok(frame) => frame.validate().unwrap(),
        Err(e) => {
            assert!(matches!(e, GpuError::TooLarge { needed: 248_832_000.., .. }), "{e}");
            assert!(!e.to_string().contains('\n'));
        }
    }
    let mut bad = camera(&scene, 0.0, (64, 64));
    bad.intrinsics.width = 0;
    assert_eq!(renderer.render(&bad), Err(GpuError::Camera));
    assert_eq!(renderer.generate(header(bad, 4)), Err(GpuError::Camera));
    // And the renderer still works.
    let good = camera(&scene, 0.0, (40, 40));
    let found = renderer.render(&good).unwrap();
    Difference::of(&found, &march::render(&scene, &good)).assert_tolerable("after errors");
}
