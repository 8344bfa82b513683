//! Do several channels, and labels, look the same on the GPU and in their Rust twin? On any adapter, lavapipe too; the
//! tolerance is that of `isinglass_tests::twins`.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use isinglass_core::channels::{Blend, ChannelLook, Channels, Visibility};
use isinglass_core::kernels::layering;
use isinglass_core::kernels::march::{self, Scene};
use isinglass_core::kernels::raycast;
use isinglass_core::look::Look;
use isinglass_core::transfer::TransferFunction;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Volume, VolumeInfo, Voxels};
use isinglass_gpu::GpuRenderer;
use isinglass_tests::twins::{Difference, camera, gpu, header, transfer};

const SIDE: u32 = 36;

/// The built-in volume as numbers of another type.
fn channel(builtin: Builtin, of: impl Fn(Vec<u8>) -> Voxels, are_labels: bool) -> Arc<Volume> {
    let volume = builtin.volume(SIDE);
    let bytes = (0..volume.voxels().len()).map(|i| volume.voxels().get(i) as u8).collect();
    let info = VolumeInfo { are_labels, ..VolumeInfo::default() };
    Arc::new(Volume::new(volume.dims(), volume.spacing(), of(bytes), (1.0, 0.0), info).unwrap())
}

/// Bytes, words, floats and labels, in this order, as often as it takes.
fn channels(num: usize) -> Arc<Volume> {
    let words = |v: Vec<u8>| Voxels::U16(v.iter().map(|&b| u16::from(b) * 200).collect());
    let floats = |v: Vec<u8>| Voxels::F32(v.iter().map(|&b| f32::from(b) - 80.0).collect());
    let labels = |v: Vec<u8>| Voxels::U8(v.iter().map(|&b| if b < 90 { 0 } else { b / 40 }).collect());
    let all = [
        channel(Builtin::Shells, Voxels::U8, false),
        channel(Builtin::Cloud, words, false),
        channel(Builtin::Cubus, floats, false),
        channel(Builtin::Cubus, labels, true),
    ];
    let others = (1..num).map(|i| all[i % 4].clone()).collect();
    Arc::new((*all[0]).clone().with_others(others).unwrap())
}

fn tinted(color: [f32; 3]) -> TransferFunction {
    let mut transfer = transfer(true);
    transfer.points.iter_mut().for_each(|p| p.color = color);
    transfer
}

fn look(num: usize, blend: Blend) -> Look {
    let colors = [[0.1, 1.0, 0.2], [1.0, 0.2, 0.9], [0.2, 0.4, 1.0], [1.0, 0.9, 0.1]];
    let other = |i: usize| ChannelLook { transfer: tinted(colors[i % 4]), visibility: Visibility::default() };
    let others = (1..num).map(other).collect();
    let channels = Channels { blend, others, ..Channels::default() };
    Look { channels, ..Look::new(tinted(colors[0])) }
}

#[test]
fn mixed_channels_are_those_of_the_twin() {
    let Some(gpu) = gpu() else { return };
    for (num, blend) in [(2, Blend::Additive), (4, Blend::Over), (8, Blend::Additive)] {
        let (volume, look) = (channels(num), look(num, blend));
        let scene = Scene::of_look(volume, &look);
        assert!(scene.is_mixed());
        let camera = camera(&scene, 25.0, (64, 48));
        let twin = march::render(&scene, &camera);
        let mut renderer = GpuRenderer::new(gpu, scene.clone()).unwrap();
        let found = renderer.render(&camera).unwrap();
        Difference::of(&found, &twin).assert_alike_but_for_choices(&format!("{num} channels, {blend:?}"));
        // Layered frames too: what both lists show from their own pose.
        let header = header(camera, 12);
        let (bounds, frame) = (scene.volume.bounds(), renderer.generate(header).unwrap());
        let cast = raycast::raycast(&frame, &bounds, &camera);
        let of_twin = raycast::raycast(&layering::generate(&scene, header), &bounds, &camera);
        assert!(Difference::of(&cast, &of_twin).is_another_choice(), "{:?}", Difference::of(&cast, &of_twin));
        // Negative control: one channel is hidden.
        let mut less = look.clone();
        less.channels.others[num - 2].visibility.is_hidden = true;
        let without =
            march::render(&scene.under(&less, isinglass_core::volume::Detail::Final, None), &camera);
        Difference::of(&found, &without).assert_noticed("a hidden channel");
    }
}

#[test]
fn a_look_shows_and_hides_channels_on_the_device() {
    let Some(gpu) = gpu() else { return };
    let (volume, look) = (channels(4), look(4, Blend::Over));
    let scene = Scene::of_look(volume, &look);
    let camera = camera(&scene, 25.0, (48, 36));
    let mut renderer = GpuRenderer::new(gpu, scene.clone()).unwrap();
    // Only the first, only the labels, all but the first, a projection of the third, and all again.
    let hidden: [&[usize]; 5] = [&[1, 2, 3], &[0, 1, 2], &[0], &[], &[]];
    for (step, hidden) in hidden.into_iter().enumerate() {
        let mut wanted = look.clone();
        for &channel in hidden {
            wanted.channels.visibility_mut(channel).unwrap().is_hidden = true;
        }
        if step == 3 {
            wanted.mode = isinglass_core::mode::Mode::Mip;
            wanted.channels.chosen = 2;
        }
        let scene = scene.under(&wanted, isinglass_core::volume::Detail::Final, None);
        renderer.set_scene(scene.clone()).unwrap();
        let found = renderer.render(&camera).unwrap();
        let twin = march::render(&scene, &camera);
        Difference::of(&found, &twin).assert_alike_but_for_choices(&format!("step {step}"));
        assert!(found.pixels.iter().any(|p| p[3] > 0.1), "step {step}: nothing is seen");
    }
}
