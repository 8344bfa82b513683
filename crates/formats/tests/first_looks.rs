//! The first look of volumes of every kind: the thing is seen, and what surrounds it is not.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::fs;
use std::path::Path;

use glam::Vec3;
use isinglass_core::camera::Intrinsics;
use isinglass_core::kernels::march::{MarchSettings, Scene, render};
use isinglass_core::mode::Mode;
use isinglass_core::orbit::Orbit;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::{Histogram, Volume, VolumeInfo, Voxels};
use isinglass_formats::{OpenOptions, default_channels, default_preset, default_transfer, open, preset};
use tempfile::TempDir;

const SIDE: usize = 48;
const PIXELS: u32 = 96;

/// The place of a voxel from the middle of the volume.
fn place(i: usize) -> Vec3 {
    let at = [i % SIDE, i / SIDE % SIDE, i / SIDE / SIDE].map(|n| n as f32 - (SIDE as f32 - 1.0) / 2.0);
    Vec3::from_array(at)
}

/// How far a place is outside of the ball that is to be seen.
fn depth(at: Vec3) -> f32 {
    at.length() - 14.0
}

/// One within the ball, zero outside, with an edge of a voxel.
fn ball(at: Vec3) -> f32 {
    (0.5 - depth(at)).clamp(0.0, 1.0)
}

/// Numbers that look random, nearly normal with a deviation of one.
fn noise(i: usize) -> f32 {
    let uniform = |k: usize| {
        let mut x = (i * 12 + k + 1) as u64;
        x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((x ^ (x >> 31)) >> 40) as f32 / (1u64 << 24) as f32
    };
    (0..12).map(uniform).sum::<f32>() - 6.0
}

#[derive(Clone, Copy, Debug)]
enum Type {
    U8,
    U16,
    F32,
}

fn volume_with(of: Type, info: VolumeInfo, value: impl Fn(usize, Vec3) -> f32) -> Volume {
    let values = (0..SIDE.pow(3)).map(|i| value(i, place(i)));
    let voxels = match of {
        Type::U8 => Voxels::U8(values.map(|v| v.round() as u8).collect()),
        Type::U16 => Voxels::U16(values.map(|v| v.round() as u16).collect()),
        Type::F32 => Voxels::F32(values.collect()),
    };
    Volume::new([SIDE as u32; 3], Vec3::ONE, voxels, (1.0, 0.0), info).unwrap()
}

fn volume(of: Type, value: impl Fn(usize, Vec3) -> f32) -> Volume {
    volume_with(of, VolumeInfo::default(), value)
}

/// The sRGB bytes of a picture of this volume.
fn picture(volume: &Volume, transfer: &TransferFunction, mode: Mode) -> Vec<[u8; 3]> {
    let settings = MarchSettings { mode, ..MarchSettings::default() };
    let camera = Orbit::default().camera(Intrinsics::perspective(PIXELS, PIXELS, 0.6), &volume.bounds());
    let scene = Scene::with_channels(volume.clone().into(), transfer, default_channels(volume), settings);
    render(&scene, &camera).to_srgb8([0.0; 3]).chunks(3).map(|c| [c[0], c[1], c[2]]).collect()
}

fn is_lit(pixel: &[u8; 3]) -> bool {
    pixel.iter().any(|c| *c > 24)
}

fn first_transfer(volume: &Volume) -> TransferFunction {
    default_transfer("a file", volume, &Histogram::of(volume))
}

/// The pixels of a shape that is solid where `depth` is below zero.
fn silhouette(depth: impl Fn(Vec3) -> f32) -> Vec<bool> {
    let shape = volume(Type::U8, |_, at| 255.0 * (0.5 - depth(at)).clamp(0.0, 1.0));
    let p = |x, opacity| ControlPoint { x, color: [1.0; 3], opacity };
    let transfer = TransferFunction {
        name: "solid".into(),
        domain: Domain::Values(0.0, 255.0),
        unit_length: UnitLength::Voxel,
        points: vec![p(0.4, 0.0), p(0.6, 0.9)],
    };
    picture(&shape, &transfer, Mode::Composite).iter().map(is_lit).collect()
}

/// The share of the pixels of a thing that are lit, and of those that see nothing of it.
fn lit_shares(picture: &[[u8; 3]], depth: impl Fn(Vec3) -> f32) -> (f32, f32) {
    let (within, around) = (silhouette(|at| depth(at) + 1.5), silhouette(|at| depth(at) - 2.0));
    let share = |of: &dyn Fn(usize) -> bool| {
        let places: Vec<usize> = (0..picture.len()).filter(|i| of(*i)).collect();
        places.iter().filter(|i| is_lit(&picture[**i])).count() as f32 / places.len() as f32
    };
    (share(&|i| within[i]), share(&|i| !around[i]))
}

/// What is wrong with the first look, which must show a thing and nothing around it.
fn problem(volume: &Volume, transfer: &TransferFunction, depth: impl Fn(Vec3) -> f32) -> Option<String> {
    let (thing, around) = lit_shares(&picture(volume, transfer, Mode::Composite), depth);
    let text = format!("{}: {thing} of the thing and {around} around it are lit", transfer.name);
    (thing < 0.95 || around > 0.03).then_some(text)
}

#[test]
fn dark_matter_in_bright_surroundings_is_seen() {
    let two = |at: Vec3| at.x.abs() - 4.0;
    // Electron microscopy with noise in three types, without noise, shaded, a tomogram about zero,
    // and distances to a surface, cut off.
    let kinds: Vec<(&str, Volume)> = vec![
        ("bytes", volume(Type::U8, |i, at| 200.0 - 140.0 * ball(at) + 10.0 * noise(i))),
        ("words", volume(Type::U16, |i, at| 30e3 - 12e3 * ball(at) + 1500.0 * noise(i))),
        ("floats", volume(Type::F32, |i, at| 1.0 - 0.7 * ball(at) + 0.05 * noise(i))),
        ("clean", volume(Type::U8, |_, at| 235.0 - 120.0 * ball(at))),
        ("shaded", volume(Type::U8, |i, at| 180.0 + 0.5 * at.x - 110.0 * ball(at) + 5.0 * noise(i))),
        ("about zero", volume(Type::F32, |i, at| noise(i) - 6.0 * ball(at))),
        ("distances, cut off", volume(Type::F32, |_, at| (depth(at) / 3.0).clamp(-1.0, 1.0))),
    ];
    for (name, volume) in &kinds {
        let transfer = first_transfer(volume);
        assert_eq!(transfer.validate(), Ok(()), "{name}");
        assert_eq!((problem(volume, &transfer, depth), &*transfer.name), (None, "dark"), "{name}");
        // The controls: as a plant, each is a block, and the law says so.
        let plant = TransferFunction { domain: Domain::Full, ..preset("ct").unwrap() };
        assert!(problem(volume, &plant, depth).is_some(), "{name}");
    }
    // Distances to a surface fade out beyond it, and the corners of the box are clear.
    let distances = volume(Type::F32, |_, at| depth(at));
    let transfer = first_transfer(&distances);
    let seen = picture(&distances, &transfer, Mode::Composite);
    let (thing, corners) = (lit_shares(&seen, depth).0, lit_shares(&seen, |at| depth(at) - 9.0).1);
    assert!(thing > 0.95 && corners < 0.03 && transfer.name == "dark", "{thing} {corners} {}", transfer.name);
    // The same turned round is bright, and a slab in no surroundings of its own is not called dark.
    let bright = volume(Type::U8, |i, at| 55.0 + 140.0 * ball(at) + 10.0 * noise(i));
    let transfer = first_transfer(&bright);
    assert_eq!(problem(&bright, &transfer, depth), None);
    assert_ne!(transfer.name, "dark");
    let textured = volume(Type::U8, |i, _| 128.0 + 30.0 * noise(i));
    assert_ne!(first_transfer(&textured).name, "dark");
    let slab = volume(Type::U8, |_, at| if two(at) < 0.0 { 90.0 } else { 0.0 });
    assert_ne!(first_transfer(&slab).name, "dark");
}

#[test]
fn air_around_a_patient_is_no_matter() {
    // A crop of tissue with air in it. Only as a scan of nobody, the air is a thing.
    let crop = |modality: Option<&str>| {
        let info = VolumeInfo { modality: modality.map(Into::into), ..VolumeInfo::default() };
        let volume = volume_with(Type::U8, info, |i, at| 180.0 - 170.0 * ball(at) + 4.0 * noise(i));
        first_transfer(&volume).name
    };
    assert_eq!(crop(None), "dark");
    assert_ne!(crop(Some("CT")), "dark");
    assert_ne!(crop(Some("MR")), "dark");
}

#[test]
fn a_thing_is_seen_whatever_value_its_surroundings_have() {
    let kinds: Vec<(&str, Volume)> = vec![
        ("normalised", volume(Type::F32, |i, at| 2.0 * ball(at) - 1.0 + 0.03 * noise(i))),
        ("normalised, clean", volume(Type::F32, |_, at| 2.0 * ball(at) - 1.0)),
        ("scores", volume(Type::F32, |i, at| -0.4 + 3.5 * ball(at) + 0.02 * noise(i))),
        ("offset", volume(Type::F32, |i, at| 30e3 * ball(at) - 20e3 + 300.0 * noise(i))),
        ("noise below zero", volume(Type::F32, |i, at| ball(at) + 0.1 * noise(i))),
        ("10 to 22 of 255", volume(Type::U8, |i, at| 10.0 + (i * 7919 % 13) as f32 + 190.0 * ball(at))),
        ("a camera's offset", volume(Type::U16, |i, at| 100.0 + 5.0 * noise(i) + 400.0 * ball(at))),
        ("heavy noise", volume(Type::U8, |i, at| (60.0 + 15.0 * noise(i) + 150.0 * ball(at)).min(255.0))),
        ("air of a CT", volume(Type::F32, |i, at| -1000.0 + 40.0 * noise(i) + 1500.0 * ball(at))),
    ];
    for (name, volume) in &kinds {
        let transfer = first_transfer(volume);
        assert_eq!(problem(volume, &transfer, depth), None, "{name}");
        assert!(!["signed", "dark"].contains(&&*transfer.name), "{name}: {}", transfer.name);
    }
    // The control: the same preset over all values shows the surroundings, for a third of the kinds.
    let is_block = |(_, volume): &&(&str, Volume)| {
        let transfer = TransferFunction { domain: Domain::Full, ..preset("ct").unwrap() };
        problem(volume, &transfer, depth).is_some()
    };
    assert!(kinds.iter().filter(is_block).count() * 3 >= kinds.len());
}

#[test]
fn both_signs_are_seen_and_zero_is_clear() {
    let beside = |at: Vec3, x: f32| Vec3::new(at.x - x, at.y, at.z).length() - 7.0;
    let part = |at: Vec3, x: f32| (0.5 - beside(at, x)).clamp(0.0, 1.0);
    let map = |at: Vec3| part(at, 12.0) - part(at, -12.0);
    // Differences with noise, also as an offset in bytes and words; statistics with a zero of their own, also few
    // below it; and phases.
    let kinds: Vec<(&str, Volume)> = vec![
        ("difference", volume(Type::F32, |i, at| 8.0 * map(at) + 0.4 * noise(i))),
        ("bytes about 128", volume(Type::U8, |i, at| 128.0 + 90.0 * map(at) + 3.0 * noise(i))),
        ("words about 32768", volume(Type::U16, |i, at| 32_768.0 + 2e4 * map(at) + 500.0 * noise(i))),
        ("statistics", volume(Type::F32, |_, at| 6.0 * part(at, 12.0) - 4.0 * part(at, -12.0))),
        ("mostly above", volume(Type::F32, |_, at| 6.0 * part(at, 12.0) - 1.2 * part(at, -12.0))),
        ("phase", volume(Type::F32, |_, at| std::f32::consts::PI * map(at))),
    ];
    for (name, volume) in &kinds {
        let transfer = first_transfer(volume);
        assert_eq!((transfer.validate(), &*transfer.name), (Ok(()), "signed"), "{name}");
        let seen = |at: Vec3| beside(at, 12.0).min(beside(at, -12.0));
        assert_eq!(problem(volume, &transfer, seen), None, "{name}");
        let pixels = picture(volume, &transfer, Mode::Composite);
        let num = |is: &dyn Fn(&[u8; 3]) -> bool| pixels.iter().filter(|p| is_lit(p) && is(p)).count();
        let (red, blue) = (num(&|p| p[0] > p[2]), num(&|p| p[2] > p[0]));
        assert!(red > 100 && blue > 100, "{name}: {red} red and {blue} blue pixels");
    }
    // The controls: noise below zero is no sign, and one side alone is none.
    let one = volume(Type::F32, |i, at| 8.0 * part(at, 12.0) + 0.4 * noise(i));
    assert_ne!(first_transfer(&one).name, "signed");
}

#[test]
fn patient_axes_and_millimetres_are_of_a_body() {
    // Few bright voxels as in vessels, which look like those of a microscope.
    let head = |info: VolumeInfo, spacing: f32| {
        let value = |i: usize, at: Vec3| {
            let bright = if i.is_multiple_of(1501) { 1000.0 } else { 0.0 };
            60.0 * ball(at) * (1.0 + 0.3 * (0.7 * at.x).sin() * (0.5 * at.y).sin()) + bright
        };
        let volume = volume_with(Type::U16, info.clone(), value);
        let voxels = volume.voxels().clone();
        let volume = Volume::new([SIDE as u32; 3], Vec3::splat(spacing), voxels, (1.0, 0.0), info).unwrap();
        default_preset("a file", &volume, &Histogram::of(&volume))
    };
    let info = |orientation: Option<&str>, unit: Option<&str>, modality: Option<&str>| VolumeInfo {
        orientation: orientation.map(Into::into),
        unit: unit.map(Into::into),
        modality: modality.map(Into::into),
        ..VolumeInfo::default()
    };
    assert_eq!(head(info(Some("LPS"), Some("mm"), None), 1.0), "mri");
    assert_eq!(head(info(Some("RAS"), None, None), 0.9), "mri");
    assert_eq!(head(info(Some("RAS"), Some("µm"), None), 900.0), "mri");
    // The controls: no axes of a patient, voxels of a microscope, and light that a patient emits.
    assert_eq!(head(info(None, Some("mm"), None), 1.0), "fluorescence");
    assert_eq!(head(info(Some("LPS"), Some("mm"), None), 0.005), "fluorescence");
    assert_eq!(head(info(Some("RAS"), Some("µm"), None), 0.9), "fluorescence");
    assert_eq!(head(info(Some("LPS"), Some("mm"), Some("PT")), 2.0), "fluorescence");
}

#[test]
fn tiny_and_thin_volumes_are_seen() {
    let lit = |dims: [u32; 3], voxels: Vec<u8>| {
        let volume =
            Volume::new(dims, Vec3::ONE, Voxels::U8(voxels), (1.0, 0.0), VolumeInfo::default()).unwrap();
        picture(&volume, &first_transfer(&volume), Mode::Composite).iter().filter(|p| is_lit(p)).count()
    };
    let least = (PIXELS * PIXELS) as usize / 50;
    assert!(lit([3, 3, 3], (0..27).collect()) > least);
    assert!(lit([3, 3, 3], (0..27).map(|i| u8::from(i == 13)).collect()) > least);
    assert!(lit([3, 3, 3], (0..27).map(|i| (i * 101 % 256) as u8).collect()) > least);
    assert!(lit([2, 2, 2], (0..8).collect()) > least);
    assert!(lit([4, 4, 4], (0..64).map(|i| if i % 4 / 2 == 1 { 200 } else { 0 }).collect()) > least);
    let disc = |i: i32| if (i % 40 - 20).pow(2) + (i / 40 - 20).pow(2) < 150 { 180 } else { 20 };
    let slice = |dims| lit(dims, (0..1600).map(|i| disc(i) + (i % 3) as u8).collect());
    assert!(slice([40, 40, 1]) > least);
    // From the edge, a slice is a line.
    assert!(slice([1, 40, 40]) > least / 20 && slice([40, 1, 40]) > least / 20);
    // The control: one value everywhere tells nothing apart.
    assert_eq!(lit([3, 3, 3], vec![0; 27]), 0);
}

/// An NRRD file of numbers of one type.
fn nrrd(folder: &Path, kind: &str, dims: [usize; 3], bytes: &[u8]) -> Volume {
    let path = folder.join("a.nrrd");
    let [x, y, z] = dims;
    let header = format!(
        "NRRD0004\ntype: {kind}\ndimension: 3\nsizes: {x} {y} {z}\nendian: little\nencoding: raw\n\n"
    );
    fs::write(&path, [header.as_bytes(), bytes].concat()).unwrap();
    open(path.to_str().unwrap(), &OpenOptions::default()).unwrap()
}

/// Four bars of different labels in 24³ voxels.
fn bars(i: usize) -> f32 {
    let [x, y, z] = [i % 24, i / 24 % 24, i / 576];
    let is_inside = (4..20).contains(&z) && (3..21).contains(&x) && (3..21).contains(&y);
    let is_gap = x / 6 % 2 == 1 && y / 6 % 2 == 1;
    if is_inside && !is_gap { [1.0, 2.0, 3.0, 5.0][x / 12 + y / 12 * 2] } else { 0.0 }
}

#[test]
fn labels_may_be_floats() {
    let folder = TempDir::new().unwrap();
    let are_labels = |value: &dyn Fn(usize) -> f32| {
        let values: Vec<f32> = (0..24 * 24 * 24).map(value).collect();
        let single: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        let double: Vec<u8> = values.iter().flat_map(|v| f64::from(*v).to_le_bytes()).collect();
        let found = [("float", single), ("double", double)]
            .map(|(kind, bytes)| nrrd(folder.path(), kind, [24; 3], &bytes).info.are_labels);
        assert_eq!(found[0], found[1]);
        found[0]
    };
    assert!(are_labels(&bars));
    assert!(are_labels(&|i| 100.0 * bars(i)));
    assert!(are_labels(&|i| if bars(i) == 5.0 { 7.0 } else { 0.0 }));
    // The controls: a mask of the white of floats or of bytes, one number that is not whole, one below zero, a scan in
    // whole numbers, and counts.
    assert!(!are_labels(&|i| f32::from(bars(i) > 0.0)));
    assert!(!are_labels(&|i| if bars(i) > 0.0 { 255.0 } else { 0.0 }));
    assert!(!are_labels(&|i| if i == 5000 { 2.5 } else { bars(i) }));
    assert!(!are_labels(&|i| if i == 5000 { -1.0 } else { bars(i) }));
    assert!(!are_labels(&|i| (300.0 * bars(i) + 30.0 * noise(i)).round().max(0.0)));
    assert!(!are_labels(&|i| (2.0 + noise(i)).round().max(0.0)));
    // A mask of whole numbers is a label, as in an atlas.
    let bytes: Vec<u8> = (0..24 * 24 * 24).map(|i| u8::from(bars(i) > 0.0)).collect();
    assert!(nrrd(folder.path(), "uchar", [24; 3], &bytes).info.are_labels);
}

#[test]
fn labels_have_their_colours_in_every_mode() {
    let folder = TempDir::new().unwrap();
    let bytes: Vec<u8> = (0..24 * 24 * 24).map(|i| bars(i) as u8).collect();
    let labels = nrrd(folder.path(), "uchar", [24; 3], &bytes);
    assert!(labels.info.are_labels);
    let transfer = first_transfer(&labels);
    let expected = picture(&labels, &transfer, Mode::Composite);
    let share = |pixels: &[[u8; 3]]| pixels.iter().filter(|p| is_lit(p)).count() as f32 / pixels.len() as f32;
    let is_grey = |p: &&[u8; 3]| is_lit(p) && p[0].abs_diff(p[1]) < 3 && p[1].abs_diff(p[2]) < 3;
    assert!((0.05..0.9).contains(&share(&expected)), "{}", share(&expected));
    for mode in Mode::ALL {
        let pixels = picture(&labels, &transfer, mode);
        let num_grey = pixels.iter().filter(is_grey).count();
        assert!(num_grey * 50 < pixels.iter().filter(|p| is_lit(p)).count(), "{mode}: {num_grey} are grey");
        assert!(pixels == expected, "{mode}: names have neither a greatest nor a mean");
    }
    // The control: the same numbers as values differ from mode to mode.
    let mut values = labels.clone();
    values.info.are_labels = false;
    let transfer = first_transfer(&values);
    assert!(picture(&values, &transfer, Mode::Mip) != picture(&values, &transfer, Mode::Composite));
}
