//! Several channels in one march: closed forms of both blends, labels without anything between them, and what is hidden.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::sync::Arc;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::channels::{Blend, ChannelLook, Channels, Visibility};
use isinglass_core::kernels::layering::generate;
use isinglass_core::kernels::march::{Scene, render};
use isinglass_core::kernels::raycast::raycast;
use isinglass_core::layer::FrameHeader;
use isinglass_core::look::Look;
use isinglass_core::mode::Mode;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::{Lighting, Volume, VolumeInfo, VolumeLabel, Voxels};

const SIDE: u32 = 24;

fn volume(value: impl Fn(u32, u32, u32) -> f32, are_labels: bool) -> Volume {
    let n = SIDE;
    let voxels = (0..n * n * n).map(|i| value(i % n, i / n % n, i / n / n)).collect();
    let info = VolumeInfo { are_labels, ..VolumeInfo::default() };
    Volume::new([n; 3], Vec3::splat(0.1), Voxels::F32(voxels), (1.0, 0.0), info).unwrap()
}

/// The same colour and extinction for all values above 0.
fn even(color: [f32; 3], opacity_per_unit: f32) -> TransferFunction {
    let p = |x, opacity| ControlPoint { x, color, opacity };
    TransferFunction {
        name: "even".into(),
        domain: Domain::Values(0.0, 1.0),
        unit_length: UnitLength::World(1.0),
        points: vec![p(0.0, opacity_per_unit), p(1.0, opacity_per_unit)],
    }
}

fn look(first: TransferFunction, others: Vec<TransferFunction>, blend: Blend) -> Look {
    let of = |transfer| ChannelLook { transfer, visibility: Visibility::default() };
    let channels = Channels { blend, others: others.into_iter().map(of).collect(), ..Channels::default() };
    Look { shaded: false, channels, ..Look::new(first) }
}

fn camera(scene: &Scene, side: u32) -> Camera {
    let bounds = scene.volume.bounds();
    let pose = Pose::orbit(Vec3::ZERO, 0.0, 0.0, 3.0 * bounds.radius());
    Camera::new(pose, Intrinsics::orthographic(side, side, 0.5), &bounds)
}

/// The picture's middle pixel.
fn seen(scene: &Scene) -> [f32; 4] {
    let camera = camera(scene, 9);
    render(scene, &camera).pixels[40]
}

fn assert_close(found: [f32; 4], expected: [f32; 4], error: f32) {
    let is_close = found.iter().zip(expected).all(|(a, b)| (a - b).abs() <= error);
    assert!(is_close, "{found:?}, expected {expected:?}");
}

#[test]
fn even_media_have_their_closed_forms() {
    let depth = 0.1 * SIDE as f32;
    let (a, b) = (0.3f32, 0.6f32);
    let sigma = |opacity: f32| -(1.0 - opacity).ln();
    let (red, green) = ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]);
    let whole = volume(|_, _, _| 0.5, false);
    let whole = Arc::new(whole.clone().with_others(vec![Arc::new(whole)]).unwrap());
    let of = |blend| Scene::of_look(whole.clone(), &look(even(red, a), vec![even(green, b)], blend));

    // Media mix: extinctions add up, and each colour has the share of its own.
    let total = sigma(a) + sigma(b);
    let alpha = 1.0 - (-total * depth).exp();
    let expected = [alpha * sigma(a) / total, alpha * sigma(b) / total, 0.0, alpha];
    assert_close(seen(&of(Blend::Over)), expected, 1e-3);

    // Light adds up: the denser one sets the extinction.
    let alpha = 1.0 - (-sigma(b) * depth).exp();
    let expected = [alpha * sigma(a) / sigma(b), alpha, 0.0, alpha];
    assert_close(seen(&of(Blend::Additive)), expected, 1e-3);

    // Of equal strength they are yellow, which no mean of both is.
    let equal = Scene::of_look(whole.clone(), &look(even(red, b), vec![even(green, b)], Blend::Additive));
    assert_close(seen(&equal), [alpha, alpha, 0.0, alpha], 1e-3);
}

#[test]
fn hidden_channels_are_not_there() {
    let (red, green) = ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]);
    let first = volume(|x, _, _| x as f32 / SIDE as f32, false);
    let alone = Arc::new(first.clone());
    let other = Arc::new(volume(|_, y, _| y as f32 / SIDE as f32, false));
    let both = Arc::new(first.with_others(vec![other.clone()]).unwrap());
    let mut look = look(even(red, 0.4), vec![even(green, 0.7)], Blend::Over);
    let mixed = seen(&Scene::of_look(both.clone(), &look));
    look.channels.others[0].visibility.is_hidden = true;
    let only_first = Scene::of_look(both.clone(), &look);
    assert!(!only_first.is_mixed());
    assert_eq!(seen(&only_first), seen(&Scene::new(alone, &look.transfer, look.march_settings())));
    look.channels.others[0].visibility.is_hidden = false;
    look.channels.first.is_hidden = true;
    let only_other = seen(&Scene::of_look(both.clone(), &look));
    let own = &look.channels.others[0].transfer;
    assert_eq!(only_other, seen(&Scene::new(other, own, look.march_settings())));
    // Nothing at all, and the control: both differ from their mixture.
    look.channels.others[0].visibility.is_hidden = true;
    assert_eq!(seen(&Scene::of_look(both, &look)), [0.0; 4]);
    assert!(mixed[0] > 0.1 && mixed[1] > 0.1 && only_other[0] == 0.0, "{mixed:?} {only_other:?}");
}

#[test]
fn projections_show_the_chosen_channel() {
    let first = volume(|_, _, _| 0.2, false);
    let both = Arc::new(first.with_others(vec![Arc::new(volume(|_, _, _| 0.9, false))]).unwrap());
    let ramp = |color: [f32; 3]| {
        let p = |x| ControlPoint { x, color, opacity: x };
        TransferFunction { points: vec![p(0.0), p(1.0)], ..even(color, 0.0) }
    };
    let red_and_green = look(ramp([1.0, 0.0, 0.0]), vec![ramp([0.0, 1.0, 0.0])], Blend::Additive);
    let mut look = Look { mode: Mode::Mip, ..red_and_green };
    let first = seen(&Scene::of_look(both.clone(), &look));
    look.channels.chosen = 1;
    let second = seen(&Scene::of_look(both, &look));
    assert!(first[0] > 0.0 && first[1] == 0.0, "{first:?}");
    assert!(second[1] > first[0] && second[0] == 0.0, "{second:?}");
}

/// A ball of label 10 in label 0.
fn ball() -> Volume {
    let is_inside = |c: [u32; 3]| {
        let square = c.map(|c| (c as f32 + 0.5 - SIDE as f32 / 2.0).powi(2)).iter().sum::<f32>();
        square < (SIDE as f32 / 3.0).powi(2)
    };
    volume(|x, y, z| if is_inside([x, y, z]) { 10.0 } else { 0.0 }, true)
}

fn labels(value: u32, color: [u8; 3]) -> VolumeLabel {
    VolumeLabel { value, name: format!("label {value}"), color: Some(color) }
}

#[test]
fn a_label_has_no_shell_of_a_lesser_one() {
    let mut ball = ball();
    ball.info.labels = vec![labels(5, [0, 255, 0]), labels(10, [255, 0, 0])];
    let look = look(even([1.0; 3], 0.9), vec![], Blend::Over);
    let scene = Scene::of_look(Arc::new(ball.clone()), &look);
    let green = |scene: &Scene| render(scene, &camera(scene, 40)).pixels.iter().map(|p| p[1]).sum::<f32>();
    let red = |scene: &Scene| render(scene, &camera(scene, 40)).pixels.iter().map(|p| p[0]).sum::<f32>();
    assert_eq!(green(&scene), 0.0);
    assert!(red(&scene) > 100.0);
    // The control: as quantities, the values between 0 and 10 make a green shell.
    ball.info.are_labels = false;
    let p = |x, color, opacity| ControlPoint { x, color, opacity };
    let points = vec![
        p(0.0, [0.0; 3], 0.0),
        p(0.4, [0.0, 1.0, 0.0], 0.9),
        p(0.6, [0.0, 1.0, 0.0], 0.9),
        p(1.0, [1.0, 0.0, 0.0], 0.9),
    ];
    let transfer = TransferFunction { points, domain: Domain::Values(0.0, 10.0), ..look.transfer.clone() };
    let quantities = Scene::new(Arc::new(ball), &transfer, look.march_settings());
    assert!(green(&quantities) > 10.0);
}

#[test]
fn labels_are_switched_off_one_by_one() {
    let value = |x: u32, _: u32, _: u32| if x < SIDE / 2 { 3.0 } else { 1026.0 };
    let mut two = volume(value, true);
    two.info.labels = vec![labels(3, [255, 0, 0])];
    let two = Arc::new(two);
    let mut look = look(even([1.0; 3], 0.9), vec![], Blend::Over);
    let sum = |look: &Look| {
        let scene = Scene::of_look(two.clone(), look);
        let picture = render(&scene, &camera(&scene, 20));
        [0, 1, 2, 3].map(|ch| picture.pixels.iter().map(|p| p[ch]).sum::<f32>())
    };
    let all = sum(&look);
    // Labels above the table share its nodes: 1026 is as 3.
    assert!(all[0] > 10.0 && all[1] == 0.0, "{all:?}");
    look.channels.first.set_label(3, false);
    assert_eq!(sum(&look), [0.0; 4]);
    look.channels.first.set_label(3, true);
    look.channels.first.set_label(4, false);
    assert_eq!(sum(&look), all);
}

#[test]
fn labels_over_a_scan_are_lit_and_cut_alike() {
    let scan = volume(|x, y, z| (x + y + z) as f32 / (3 * SIDE) as f32, false);
    let both = Arc::new(scan.with_others(vec![Arc::new(ball())]).unwrap());
    let mut look = look(even([0.8; 3], 0.05), vec![even([1.0; 3], 0.95)], Blend::Over);
    look.shaded = true;
    look.lighting = Lighting { shadows: 0.8, ..Lighting::default() };
    let scene = Scene::of_look(both.clone(), &look);
    let unlit = Look { shaded: false, lighting: Lighting::default(), ..look.clone() };
    let unlit = Scene::of_look(both.clone(), &unlit);
    let light = |scene: &Scene| render(scene, &camera(scene, 20)).pixels.iter().map(|p| p[0]).sum::<f32>();
    assert!(light(&scene) < 0.9 * light(&unlit), "{} {}", light(&scene), light(&unlit));
    // The layered frame at its own pose is the picture.
    let camera = camera(&scene, 40);
    let header = FrameHeader::alone(camera, 16);
    let frame = generate(&scene, header);
    let (cast, picture) = (raycast(&frame, &scene.volume.bounds(), &camera), render(&scene, &camera));
    let worst = cast
        .pixels
        .iter()
        .zip(&picture.pixels)
        .flat_map(|(a, b)| a.iter().zip(b).map(|(a, b)| (a - b).abs()).collect::<Vec<_>>());
    let worst = worst.fold(0.0, f32::max);
    assert!(worst < 0.02, "{worst}");
}
