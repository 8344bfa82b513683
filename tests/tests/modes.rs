//! Do the modes do on the GPU what their Rust twins do? The tolerance is that of `isinglass_tests::twins`.

use isinglass_core::camera::Intrinsics;
use isinglass_core::codec::{Coding, decode};
use isinglass_core::kernels::combine;
use isinglass_core::kernels::layering;
use isinglass_core::kernels::march::{self, MarchSettings, Scene};
use isinglass_core::kernels::raycast::{CastOptions, Raycaster, Reconstruction};
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::mode::{Iso, Isos, Mode};
use isinglass_core::transfer::TransferFunction;
use isinglass_gpu::{GpuRenderer, GpuReprojector};
use isinglass_tests::twins::{Difference, camera, gpu, header, scenes, transfer, views};

/// The scenes of all twins in a mode; surfaces of two values, the outer one translucent.
fn scenes_in(mode: Mode) -> Vec<(String, Scene)> {
    let each = scenes().into_iter().map(|(name, scene)| {
        let (lo, hi) = scene.volume.value_range();
        let at = |x: f32, opacity| Iso { value: lo + (hi - lo) * x, opacity };
        let isos = Isos::new(&[at(0.35, 0.3), at(0.6, 1.0)]).expect("two surfaces in the range");
        let settings = MarchSettings { mode, isos, ..scene.settings };
        (format!("{name}, {mode}"), scene.with_look(&transfer_in(mode, name.contains("cloud")), settings))
    });
    each.collect()
}

/// Air is the least on every ray: what shows it in a MinIP is another function.
fn transfer_in(mode: Mode, soft: bool) -> TransferFunction {
    let mut transfer = transfer(soft);
    if mode == Mode::MinIp {
        transfer.points.reverse();
        transfer.points.iter_mut().for_each(|point| point.x = 1.0 - point.x);
    }
    transfer
}

fn others() -> impl Iterator<Item = Mode> {
    Mode::ALL.into_iter().filter(|mode| *mode != Mode::Composite)
}

#[test]
fn renderings_and_frames_are_those_of_the_twin() {
    let Some(gpu) = gpu() else { return };
    for mode in others() {
        // Bytes, shaded, and floats; each is a kernel of its own.
        for (name, scene) in scenes_in(mode).into_iter().step_by(2) {
            let bounds = scene.volume.bounds();
            let (own, beside) = (camera(&scene, 25.0, (80, 64)), camera(&scene, 37.0, (80, 64)));
            let twin = march::render(&scene, &own);
            let mut renderer = GpuRenderer::new(gpu, scene.clone()).unwrap();
            Difference::of(&renderer.render(&own).unwrap(), &twin).assert_tolerable(&name);
            assert!(twin.pixels.iter().any(|p| p[3] > 0.1), "{name}: nothing to be seen");
            let composite = MarchSettings { mode: Mode::Composite, ..scene.settings };
            let composite = scene.with_look(&transfer(name.contains("cloud")), composite);
            Difference::of(&twin, &march::render(&composite, &own)).assert_noticed(&name);

            let what = &name;
            let found = renderer.generate(header(own, 8)).unwrap();
            found.validate().unwrap_or_else(|e| panic!("{what}: {e}"));
            let expected = layering::generate(&scene, header(own, 8));
            assert_eq!(found.header, expected.header);
            assert_eq!(found.header.mode, mode);
            Difference::of(&found.flatten(), &expected.flatten()).assert_tolerable(what);
            let view = |frame: &LayeredFrame| {
                Raycaster::new(frame, &bounds).picture(&beside, &CastOptions::default())
            };
            let turned = Difference::of(&view(&found), &view(&expected));
            assert!(turned.is_tolerable() || turned.is_another_choice(), "{what}, turned: {turned:?}");
            // As many pixels hold lists, but for rays that graze.
            let (a, b) = (found.num_filled() as f64, expected.num_filled() as f64);
            assert!((a - b).abs() <= 0.01 * b, "{what}: {a} lists, the twin has {b}");
        }
    }
}

/// Seen from aside, as the filling is seen from nowhere else.
#[test]
fn surfaces_are_filled_on_the_side_that_the_scene_says() {
    let Some(gpu) = gpu() else { return };
    let (name, scene) = scenes_in(Mode::Iso).swap_remove(0);
    let bounds = scene.volume.bounds();
    let (own, beside) = (camera(&scene, 25.0, (80, 64)), camera(&scene, 50.0, (80, 64)));
    let view =
        |frame: &LayeredFrame| Raycaster::new(frame, &bounds).picture(&beside, &CastOptions::default());
    let of = |has_lesser_bodies| {
        let scene = Scene { has_lesser_bodies, ..scene.clone() };
        let expected = layering::generate(&scene, header(own, 8));
        let mut renderer = GpuRenderer::new(gpu, scene).unwrap();
        (view(&renderer.generate(header(own, 8)).unwrap()), view(&expected))
    };
    let both = [false, true].map(of);
    for (found, expected) in &both {
        let turned = Difference::of(found, expected);
        assert!(turned.is_tolerable() || turned.is_another_choice(), "{name}: {turned:?}");
    }
    Difference::of(&both[1].0, &both[0].1).assert_noticed(&name);
}

#[test]
fn novel_views_are_those_of_the_twin() {
    let Some(gpu) = gpu() else { return };
    for mode in others() {
        let (name, scene) = scenes_in(mode).swap_remove(2);
        let bounds = scene.volume.bounds();
        let frame = layering::generate(&scene, header(camera(&scene, 25.0, (72, 60)), 6));
        let caster = Raycaster::new(&frame, &bounds);
        let mut reprojector = GpuReprojector::new(gpu, &frame, &bounds).unwrap();
        for (view, camera) in views(&scene) {
            for reconstruction in [Reconstruction::Mixed, Reconstruction::Nearest] {
                let options = CastOptions { reconstruction, ..CastOptions::default() };
                let found = reprojector.raycast_with(&camera, &options).unwrap();
                let what = format!("{name}, {view}, {reconstruction:?}");
                let expected = caster.picture(&camera, &options);
                let difference = Difference::of(&found, &expected);
                // Which of two keys is greater decides a rounding; and a step of 1/255 is no fault.
                assert!(
                    difference.max <= 1 || difference.is_tolerable() || difference.is_another_choice(),
                    "{what}: {difference:?}"
                );
            }
        }
        // The frames of two cameras at once.
        let aside = camera(&scene, 60.0, (40, 34));
        let kept = layering::generate(&scene, header(aside, 6));
        let mut narrow = camera(&scene, 25.0, (40, 34));
        narrow.intrinsics = Intrinsics::perspective(40, 34, 0.5 * narrow.intrinsics.fov_y());
        let newest = layering::generate(&scene, header(narrow, 6));
        let display = camera(&scene, 30.0, (72, 60));
        let expected = combine::combine(&[&newest, &kept], &bounds, &display);
        let mut both = GpuReprojector::of_frames(gpu, &[&newest, &kept], &bounds).unwrap();
        let difference = Difference::of(&both.raycast(&display).unwrap(), &expected);
        assert!(
            difference.max <= 1 || difference.is_tolerable() || difference.is_another_choice(),
            "{name}, combined: {difference:?}"
        );
        let alone = combine::combine(&[&newest], &bounds, &display);
        Difference::of(&alone, &expected).assert_noticed("the kept frame");
    }
}

#[test]
fn frames_of_projections_in_blocks_are_refused_and_coded_exactly_instead() {
    let (_, scene) = scenes_in(Mode::Mip).swap_remove(0);
    let frame = layering::generate(&scene, header(camera(&scene, 25.0, (64, 52)), 8));
    let blocks = Coding::Blocks(isinglass_core::codec::blocks::Settings::of(60));
    let error = blocks.encode(&frame, None).unwrap_err().to_string();
    assert!(error.contains("mip") && !error.contains('\n'), "{error}");
    assert!(matches!(blocks.for_mode(Mode::Mip), Coding::Exact));
    assert_eq!(blocks.for_mode(Mode::Iso), blocks);
    // Surfaces are composited with over, so blocks carry them.
    let (_, scene) = scenes_in(Mode::Iso).swap_remove(0);
    let frame = layering::generate(&scene, header(camera(&scene, 25.0, (64, 52)), 8));
    let (encoded, _) = blocks.encode(&frame, None).unwrap();
    let chunks: Vec<&[u8]> = encoded.chunks.iter().map(|c| &c.bytes[..]).collect();
    assert_eq!(decode(&chunks).unwrap().header, FrameHeader { k: 24, ..frame.header });
}
