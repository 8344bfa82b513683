//! Are voxels with nothing in them transparent in every mode, on the CPU and on the GPU? On any adapter, lavapipe too;
//! the tolerance is that of `isinglass_tests::twins`.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::kernels::march::{self, Scene};
use isinglass_core::look::Look;
use isinglass_core::mode::{Iso, Isos, Mode};
use isinglass_core::transfer::Domain;
use isinglass_core::volume::{Volume, Voxels};
use isinglass_gpu::GpuRenderer;
use isinglass_tests::twins::{Difference, camera, gpu, transfer};

const SIDE: u32 = 32;

/// A ball of numbers that grow from its middle on, and a mark outside of it.
fn ball(mark: f32) -> (Volume, Vec<u8>) {
    let radius = |i: u32| {
        let at = [i % SIDE, i / SIDE % SIDE, i / SIDE / SIDE].map(|c| c as f32 + 0.5 - SIDE as f32 / 2.0);
        Vec3::from_array(at).length() / (SIDE as f32 / 2.0)
    };
    let numbers = 0..SIDE * SIDE * SIDE;
    let voxels = numbers.clone().map(|i| if radius(i) < 0.6 { 100.0 + radius(i) * 100.0 } else { mark });
    let gaps = numbers.map(|i| u8::from(radius(i) >= 0.6)).collect();
    let voxels = Voxels::F32(voxels.collect());
    (Volume::new([SIDE; 3], Vec3::ONE, voxels, (1.0, 0.0), Default::default()).unwrap(), gaps)
}

fn look(mode: Mode) -> Look {
    let mut transfer = transfer(true);
    transfer.domain = Domain::Values(90.0, 170.0);
    // Everything is seen, lesser numbers too.
    transfer.points.iter_mut().for_each(|p| p.opacity = p.opacity.max(0.2));
    let isos = Isos::new(&[Iso { value: 95.0, opacity: 1.0 }, Iso { value: 150.0, opacity: 0.5 }]).unwrap();
    Look { mode, isos, ..Look::new(transfer) }
}

/// The greatest opacity at the corners, which rays beside the ball reach, and at the middle.
fn opacities(pixels: &[[f32; 4]], width: usize) -> (f32, f32) {
    let height = pixels.len() / width;
    let corner = pixels[height / 10 * width + width / 2][3].max(pixels[height / 2 * width + width / 8][3]);
    (corner, pixels[height / 2 * width + width / 2][3])
}

#[test]
fn nothing_is_transparent_in_every_mode() {
    for mode in Mode::ALL {
        let (volume, gaps) = ball(0.0);
        let look = look(mode);
        let with = Scene::of_look(Arc::new(volume.clone().with_gaps(gaps)), &look);
        let camera = camera(&with, 25.0, (60, 60));
        let twin = march::render(&with, &camera);
        let (outside, inside) = opacities(&twin.pixels, 60);
        assert_eq!(outside, 0.0, "{mode:?}");
        assert!(inside > 0.05, "{mode:?}: {inside}");
        // No false surface around it: the value 95 is below all others.
        if mode == Mode::Iso {
            let first = Isos::new(&[Iso { value: 95.0, opacity: 1.0 }]).unwrap();
            let only = Scene::of_look(with.volume.clone(), &Look { isos: first, ..look.clone() });
            assert!(march::render(&only, &camera).pixels.iter().all(|p| p[3] == 0.0));
        }
        // The control: as numbers, they are seen.
        let number = if mode == Mode::Mip { ball(250.0).0 } else { volume };
        let without = march::render(&Scene::of_look(Arc::new(number), &look), &camera);
        let is_seen = match mode {
            Mode::Iso => without.pixels.iter().zip(&twin.pixels).any(|(a, b)| a[3] > b[3] + 0.1),
            _ => opacities(&without.pixels, 60).0 > 0.05,
        };
        assert!(is_seen, "{mode:?}: {:?}", opacities(&without.pixels, 60));
        let Some(gpu) = gpu() else { continue };
        let found = GpuRenderer::new(gpu, with).unwrap().render(&camera).unwrap();
        Difference::of(&found, &twin).assert_alike_but_for_choices(&format!("{mode:?}"));
        Difference::of(&found, &without).assert_noticed("numbers in place of nothing");
    }
}
