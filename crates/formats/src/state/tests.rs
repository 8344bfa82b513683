use isinglass_core::channels::{Blend, ChannelLook, Channels, Visibility};
use isinglass_core::clip::{Clip, Plane};
use isinglass_core::space::Aabb;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use isinglass_core::volume::{Lighting, SlabMode};

use super::*;
use crate::dtype::{Dtype, Endian};
use crate::reading::{Meaning, Reading};

/// Numbers without a short decimal.
fn odd(i: u32) -> f32 {
    f32::from_bits(0x3e00_0000 + i.wrapping_mul(0x9e37_79b9) % 0x0180_0000)
}

/// Clips: none, a box, a plane, and both.
fn clip(seed: u32) -> Clip {
    let min = Vec3::new(-odd(seed), -odd(seed + 1), -1.0);
    let bounds = Aabb { min, max: min + Vec3::splat(1.0 / 3.0) };
    let plane = Plane::new(Vec3::new(odd(seed + 2), 1.0, -odd(seed)), odd(seed + 3));
    Clip { bounds: (seed & 1 == 1).then_some(bounds), plane: plane.filter(|_| seed & 2 == 2) }
}

fn raw(seed: u32) -> RawShape {
    let dtype = Dtype::ALL[seed as usize % Dtype::ALL.len()];
    let endian = [Endian::Little, Endian::Big][seed as usize / 2 % 2];
    RawShape { dims: [9, 6, 7], dtype, spacing: Vec3::ONE, endian, offset: 512 + u64::from(seed) }
}

fn slices(seed: u32) -> SavedSlices {
    let turned = Quat::from_rotation_y(odd(seed)) * Quat::from_rotation_x(odd(seed + 1));
    SavedSlices {
        shown: seed.is_multiple_of(4),
        point: [odd(seed), -odd(seed + 1), 1e-3],
        thickness: odd(seed),
        mode: SlabMode::Max,
        window: seed.is_multiple_of(3).then(|| [-1000.0, odd(seed)]),
        planes: [SavedPlane::Right, SavedPlane::Oblique(turned.to_array()), SavedPlane::Top],
        in_picture: seed.is_multiple_of(3),
        large: (seed % 5 == 1).then_some(2),
    }
}

fn lighting(seed: u32) -> Lighting {
    let (specular, shininess) = (odd(seed), 100.0 * odd(seed + 1) + 1.0);
    Lighting { specular, shininess, azimuth_degrees: -90.0 * odd(seed), ..Lighting::default() }
}

fn state(seed: u32) -> SavedState {
    let point =
        |i: u32| ControlPoint { x: i as f32 / 7.0, color: [odd(i), 0.5, 1.0 / 3.0], opacity: odd(i + seed) };
    let transfer = TransferFunction {
        name: "a \"quoted\" name µ".into(),
        domain: [Domain::Full, Domain::Values(-1e37, odd(seed)), Domain::Percentiles(0.1, 99.9)]
            [seed as usize % 3],
        unit_length: [UnitLength::Voxel, UnitLength::World(1e-12), UnitLength::Radius(0.1)]
            [seed as usize % 3],
        points: (0..=7).map(point).collect(),
    };
    let rotation = Quat::from_rotation_y(odd(seed)) * Quat::from_rotation_x(odd(seed + 1));
    let intrinsics = Intrinsics::perspective(1100, 761, (20.0 + odd(seed) * 90.0).to_radians());
    let eye = Vec3::new(odd(seed + 2), -odd(seed + 3), 1e5 * odd(seed + 4));
    SavedState {
        volume: Some(SavedVolume {
            name: "head.nrrd".into(),
            source: Some("/data/a b/head.nrrd".into()),
            region: Some("1:5,:,7:".into()),
            time: Some(3),
            given_spacing: (seed % 3 == 1).then(|| [0.1, odd(seed), 2.0]),
            flip: (seed % 3 == 1).then(|| "x,z".into()),
            stored_slices: (seed % 3 == 1).then_some(true),
            voxels: (seed % 3 == 1).then_some(Meaning::Labels),
            labels: (seed % 3 == 1).then(|| "/data/l.nii".into()),
            raw: (seed % 2 == 1).then(|| raw(seed)),
            dims: [5, 6, 7],
            spacing: [0.1, odd(seed), 3.0],
            range: [-1000.0, odd(seed + 5)],
            ..SavedVolume::default()
        }),
        camera: Some(SavedCamera::of(Vec3::splat(odd(seed + 6)), (rotation, eye), intrinsics)),
        view: SavedView {
            shows_box: Some(true),
            shows_legend: Some(seed % 3 == 1),
            background: Some(Srgb([1, 2, 254])),
            theme: Some(Theme::Light),
            stereo: Some(StereoPicture::RedCyan),
            orthographic: Some(seed % 2 == 1),
            eye_angle_degrees: Some(odd(seed)),
            slices: seed.is_multiple_of(2).then(|| slices(seed)),
            ..SavedView::default()
        },
        look: Some(Look {
            shaded: seed.is_multiple_of(2),
            lighting: lighting(seed),
            k: 9,
            clip: clip(seed),
            ..Look::new(transfer)
        }),
        ..SavedState::default()
    }
}

fn from_text(text: &str) -> Result<ReadState, String> {
    state_from_bytes(text.as_bytes(), Path::new("a.toml")).map_err(|e| e.to_string())
}

#[test]
fn channels_are_kept_and_defaults_take_no_room() {
    let plain = state(1);
    assert!(!plain.to_toml().contains("channels"));
    let mut state = plain.clone();
    let look = state.look.as_mut().unwrap();
    let transfer = TransferFunction { name: "second".into(), ..look.transfer.clone() };
    let visibility = Visibility { is_hidden: true, hidden_labels: vec![3, 700] };
    let others = vec![ChannelLook { transfer, visibility: visibility.clone() }];
    look.channels = Channels { blend: Blend::Over, first: visibility, others, chosen: 1 };
    let text = state.to_toml();
    assert_eq!(from_text(&text).unwrap(), ReadState { state: state.clone(), note: None }, "{text}");
    assert_eq!(state_from_link(&state_to_link(&state)).unwrap().state, state);
    assert_ne!(state, plain);
}

#[test]
fn what_is_written_is_read_to_the_bit_in_a_file_and_in_a_link() {
    for seed in 0..60 {
        let state = state(seed);
        let text = state.to_toml();
        let read = from_text(&text).unwrap();
        assert_eq!(read, ReadState { state: state.clone(), note: None }, "{text}");
        let (camera, again) = (state.camera.unwrap(), read.state.camera.unwrap());
        assert_eq!(camera.pose(), again.pose());
        // The angle is converted to degrees and back.
        assert_eq!(camera.intrinsics().fov_y().to_bits(), (20.0 + odd(seed) * 90.0).to_radians().to_bits());
        let link = state_to_link(&state);
        assert!(
            link.len() < 1200 && state_from_link(&link).unwrap().state == state,
            "{} characters",
            link.len()
        );
        // Control: another last digit is another state.
        let other =
            SavedState { camera: Some(SavedCamera { center: [odd(seed + 7); 3], ..camera }), ..state };
        assert_ne!(from_text(&other.to_toml()).unwrap().state, read.state);
    }
}

#[test]
fn it_is_text_that_a_person_can_read() {
    let text = state(2).to_toml();
    for line in [
        "isinglass_state = 1",
        "[volume]",
        "name = \"head.nrrd\"",
        "[camera]",
        "background = \"#0102fe\"",
        "stereo = \"red-cyan\"",
        "[look]",
        "k = 9",
        "[look.transfer]",
        "domain = { percentiles = [0.1, 99.9] }",
    ] {
        assert!(text.lines().any(|l| l == line), "{line} in {text}");
    }
    assert!(is_state(text.as_bytes()));
    let preset = crate::transfer_to_toml(&crate::preset("ct").unwrap());
    assert!(!is_state(preset.as_bytes()) && !is_state(b"NRRD0004"));
}

#[test]
fn what_is_missing_is_left_as_it_is_and_what_is_unknown_is_told() {
    assert_eq!(from_text("isinglass_state = 1").unwrap().state, SavedState::default());
    let whole = state(1).to_toml();
    let older: String = whole.lines().filter(|l| !l.starts_with("k = ")).map(|l| format!("{l}\n")).collect();
    let look = from_text(&older).unwrap().state.look.unwrap();
    assert_eq!(look, Look { k: isinglass_core::look::DEFAULT_K, ..state(1).look.unwrap() });
    let newer =
        whole.replace("[look]", "[fog]\nx = 1\n[look]\nsmoke = true").replace("x = 0.0", "x = 0.0, y = 2");
    let read = from_text(&newer).unwrap();
    assert_eq!(read.state, state(1));
    let note = read.note.unwrap();
    assert_eq!(note, "not known here and left out: \"fog\", \"look.smoke\", \"look.transfer.points.0.y\"");
}

#[test]
fn each_mistake_is_named_in_one_line() {
    let good = state(0).to_toml();
    for (from, to, what) in [
        ("isinglass_state = 1", "isinglass_state = 2", "isinglass_state is \"2\", expected 1"),
        ("isinglass_state = 1", "", "found no isinglass_state"),
        ("size = [1100, 761]", "size = [0, 761]", "size is 0×761"),
        ("size = [1100, 761]", "size = [1100]", "invalid length 1"),
        ("fov_degrees = ", "fov_degrees = 1e3 # ", "fov_degrees is 1000, expected 1 to 170"),
        ("rotation = [", "rotation = [9.0, 9.0, 9.0, 9.0] # ", "no place and rotation"),
        ("\"#0102fe\"", "\"blue\"", "found \"blue\", expected a colour"),
        ("\"red-cyan\"", "\"both\"", "unknown variant `both`"),
        ("k = 9", "k = 99", "k is 99, expected 1 to 32"),
        ("k = 9", "k = 999", "look: "),
        ("1:5,:,7:", "all", "region: expected FROM:TO"),
        ("opacity = ", "opacity = 9.0 # ", "a.toml: line"),
        ("opacity = ", "opacity = -", "control point 0: opacity is -"),
        ("domain = \"full\"", "domain = \"some\"", "unknown variant `some`"),
        ("eye_angle_degrees = ", "eye_angle_degrees = -", "expected 0 to 90"),
    ] {
        let bad = good.replacen(from, to, 1);
        assert_ne!(bad, good, "{from} is not in {good}");
        let e = from_text(&bad).unwrap_err();
        assert!(e.starts_with("a.toml: ") && e.contains(what) && !e.contains('\n'), "{to}: {e}");
    }
    assert!(state_from_bytes(&[b' '; 2 << 20], Path::new("a")).is_err());
    for bad in ["", "Z", "****", "AAAA"] {
        let e = state_from_link(bad).unwrap_err().to_string();
        assert!(e.starts_with("the link's state: ") && !e.contains('\n'), "{e}");
    }
}

#[test]
fn another_volume_is_told_from_the_same_under_another_name() {
    let volume = state(0).volume.unwrap();
    let moved = SavedVolume { name: "copy.nrrd".into(), source: None, ..volume.clone() };
    assert_eq!(volume.difference(&moved), None);
    let other = SavedVolume { dims: [5, 6, 8], ..moved };
    assert!(volume.difference(&other).unwrap().contains("5×6×8"));
}

/// Invalid numbers. One cannot be written, and no volume has any.
#[test]
fn a_volume_of_numbers_that_are_none_is_refused() {
    for number in ["nan", "inf", "-inf", "1e999"] {
        for key in ["range = [0.0, N]", "spacing = [N, 1.0, 1.0]"] {
            let text = state(0).to_toml();
            let (name, _) = key.split_once(' ').unwrap();
            let line = text.lines().find(|line| line.starts_with(name)).unwrap();
            let bad = text.replace(line, &key.replace('N', number));
            let problem = from_text(&bad).unwrap_err();
            // Parsers may refuse a number that is too large.
            let is_told = problem.contains("expected finite numbers") || problem.contains("overflow");
            assert!(is_told, "{problem}");
        }
    }
}

#[test]
fn what_it_takes_to_read_a_volume_again_is_kept_but_not_in_links() {
    let volume = state(1).volume.unwrap();
    let (region, flip) = ("1:5,:,7:".parse().ok(), Flip([true, false, true]));
    let selection = Selection { time: Some(3), region, flip, ..Selection::default() };
    let source = VolumeSource {
        source: "/data/a b/head.nrrd".into(),
        raw: Some(raw(1)),
        selection,
        spacing: volume.given_spacing.map(Vec3::from),
        foreign_files: false,
        reading: Reading {
            stored_slices: true,
            voxels: Some(Meaning::Labels),
            thin: None,
            labels: Some("/data/l.nii".into()),
        },
    };
    assert_eq!(volume.volume_source(), Ok(Some(source.clone())));
    assert_eq!(volume.source_to_open(), Ok(Some(source.clone())));
    let opened = SavedVolume { time: None, raw: None, ..volume.clone() }.opened_from(&source);
    assert_eq!(opened, SavedVolume { region: Some("1:5,0:,7:".into()), ..volume.clone() });
    let text = state(1).to_toml();
    for line in
        ["[volume.raw]", "dims = [9, 6, 7]", "dtype = \"uint8\"", "endian = \"little\"", "offset = 513"]
    {
        assert!(text.lines().any(|l| l == line), "{line} in {text}");
    }
    // A person may write less.
    let short = text.replace("endian = \"little\"\n", "").replace("offset = 513\n", "");
    let read = from_text(&short).unwrap();
    let raw = RawShape { offset: 0, ..raw(1) };
    assert_eq!(read.state.volume, Some(SavedVolume { raw: Some(raw), ..volume.clone() }));
    assert_eq!(volume.without_place().volume_source(), Ok(None));
    for (from, to, what) in [
        ("dtype = \"uint8\"", "dtype = \"block\"", "unknown type \"block\""),
        ("offset = 513", "offset = -1", "invalid value"),
        ("given_spacing = [0.1", "given_spacing = [nan", "expected finite numbers"),
    ] {
        let problem = from_text(&text.replace(from, to)).unwrap_err();
        assert!(problem.contains(what), "{problem}");
    }
}

#[test]
fn a_volume_that_was_moved_with_its_state_is_found_beside_it() {
    let folder = tempfile::TempDir::new().unwrap();
    let path = folder.path().join("seen.toml");
    let beside = folder.path().join("head.nrrd");
    let read = |source: &str| {
        let volume = SavedVolume { source: Some(source.into()), ..state(0).volume.unwrap() };
        std::fs::write(&path, SavedState { volume: Some(volume), ..state(0) }.to_toml()).unwrap();
        read_state(&path).unwrap().state.volume.unwrap()
    };
    // The path stays while there is no such file.
    for source in ["/nowhere/at/all/head.nrrd", "head.nrrd", "builtin:cloud", "isinglass://h:1/#token=0"] {
        let volume = read(source);
        assert_eq!(volume.source.as_deref(), Some(source));
        assert_eq!(volume.is_here(), source == "builtin:cloud", "{source}");
    }
    std::fs::write(&beside, "NRRD0004").unwrap();
    for source in ["/nowhere/at/all/head.nrrd", "head.nrrd", "./head.nrrd"] {
        let volume = read(source);
        assert!(volume.is_here() && Path::new(volume.source.as_ref().unwrap()).is_absolute(), "{volume:?}");
        assert_eq!(std::fs::read(volume.source.unwrap()).unwrap(), b"NRRD0004");
    }
    // A file at its own path comes first.
    let elsewhere = tempfile::TempDir::new().unwrap();
    let other = elsewhere.path().join("head.nrrd");
    std::fs::write(&other, "NRRD0005").unwrap();
    assert_eq!(read(other.to_str().unwrap()).source.as_deref(), other.to_str());
    assert_eq!(read("isinglass://h:1/head.nrrd").link(), Some("isinglass://h:1/head.nrrd"));
}

#[test]
fn a_state_alone_asks_no_address() {
    let volume = state(1).volume.unwrap();
    let at = |source: &str, labels: Option<&str>| SavedVolume {
        source: Some(source.into()),
        labels: labels.map(str::to_owned),
        ..volume.clone()
    };
    for address in ["https://example.org/a.zarr?token=7", "HTTP://example.org/a.zarr", "s3://bucket/a.zarr"] {
        for asks in [at(address, None), at("head.nrrd", Some(address))] {
            let problem = asks.source_to_open().unwrap_err();
            assert!(problem.contains("which a state alone does not call"), "{problem}");
            assert!(problem.contains(address.split('?').next().unwrap()) && !problem.contains("token"));
            // A window that shows it already compares the two.
            assert!(asks.volume_source().is_ok_and(|source| source.is_some()));
        }
    }
    assert!(at("head.nrrd", Some("labels.nii")).source_to_open().is_ok());
}
