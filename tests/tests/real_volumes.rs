//! Are real scanned and simulated volumes read as they are? The expected figures are those of the data folder's README;
//! sums and single voxels were read with pynrrd and numpy (`nrrd.read(f)[0][x, y, z]`), which index x first as here.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::path::Path;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::codec::{
    blocks::{self, References},
    decode_with,
};
use isinglass_core::ids::{FrameId, LookVersion, PoseId};
use isinglass_core::image_error::compare;
use isinglass_core::kernels::layering::generate;
use isinglass_core::kernels::march::{MarchSettings, Scene};
use isinglass_core::layer::{FrameHeader, LayeredFrame};
use isinglass_core::transfer::Domain;
use isinglass_core::volume::{Histogram, Volume, Voxels};
use isinglass_formats::{
    Dtype, Endian, OpenOptions, RawShape, VolumeFacts, default_preset, default_transfer, load_transfer, open,
    preset,
};
use isinglass_tests::data_dir;

struct Expected {
    file: &'static str,
    dims: [u32; 3],
    spacing: [f32; 3],
    dtype: &'static str,
    range: (f32, f32),
    unit: Option<&'static str>,
    orientation: Option<&'static str>,
    /// Sum of all voxels.
    sum: u64,
    /// Median and 99th percentile.
    percentiles: (f32, f32),
    voxels: &'static [([i32; 3], f32)],
    preset: &'static str,
}

const VOLUMES: [Expected; 7] = [
    Expected {
        file: "engine.nrrd",
        dims: [256, 256, 128],
        spacing: [1.0; 3],
        dtype: "uint8",
        range: (0.0, 255.0),
        unit: None,
        orientation: None,
        sum: 187_475_057,
        percentiles: (2.0, 186.0),
        voxels: &[
            ([128, 128, 64], 133.0),
            ([100, 90, 64], 6.0),
            ([85, 64, 25], 97.0),
            ([64, 79, 106], 255.0),
        ],
        preset: "industrial",
    },
    Expected {
        file: "bonsai.nrrd",
        dims: [256; 3],
        spacing: [1.0; 3],
        dtype: "uint8",
        range: (0.0, 255.0),
        unit: None,
        orientation: None,
        sum: 225_901_147,
        percentiles: (0.0, 204.0),
        voxels: &[
            ([128, 128, 128], 69.0),
            ([100, 90, 128], 0.0),
            ([85, 64, 51], 49.0),
            ([63, 69, 48], 255.0),
        ],
        preset: "ct",
    },
    Expected {
        file: "avm.nrrd",
        dims: [337, 319, 154],
        spacing: [0.5469, 0.5469, 1.0],
        dtype: "uint8",
        range: (0.0, 255.0),
        unit: Some("mm"),
        orientation: Some("RAS"),
        sum: 37_963_473,
        percentiles: (0.0, 92.0),
        voxels: &[([168, 159, 77], 0.0), ([83, 146, 9], 255.0)],
        preset: "angio",
    },
    Expected {
        file: "t1_head.nrrd",
        dims: [188, 256, 190],
        spacing: [0.88; 3],
        dtype: "uint8",
        range: (0.0, 255.0),
        unit: Some("mm"),
        orientation: Some("RAS"),
        sum: 411_030_734,
        percentiles: (12.0, 144.0),
        voxels: &[
            ([94, 128, 95], 83.0),
            ([100, 90, 95], 127.0),
            ([62, 64, 38], 106.0),
            ([6, 114, 57], 255.0),
        ],
        preset: "mri",
    },
    Expected {
        file: "heptane.nrrd",
        dims: [302; 3],
        spacing: [1.0; 3],
        dtype: "uint8",
        range: (0.0, 255.0),
        unit: None,
        orientation: None,
        sum: 213_899_765,
        percentiles: (0.0, 152.0),
        voxels: &[
            ([151, 151, 151], 39.0),
            ([100, 90, 151], 200.0),
            ([100, 75, 60], 0.0),
            ([292, 143, 183], 255.0),
        ],
        preset: "smooth",
    },
    Expected {
        file: "mouse_brain.nrrd",
        dims: [271, 193, 270],
        spacing: [0.04, 0.04, 0.05],
        dtype: "uint16",
        range: (0.0, 14_580.0),
        unit: Some("mm"),
        orientation: None,
        sum: 1_051_232_170,
        percentiles: (9.0, 391.0),
        voxels: &[
            ([135, 96, 135], 87.0),
            ([100, 90, 135], 122.0),
            ([90, 48, 54], 218.0),
            ([97, 99, 257], 14_580.0),
        ],
        preset: "fluorescence",
    },
    Expected {
        file: "foreign/tooth.nhdr",
        dims: [103, 94, 161],
        spacing: [1.0; 3],
        dtype: "uint16",
        range: (0.0, 1300.0),
        unit: None,
        orientation: None,
        sum: 821_287_590,
        percentiles: (405.0, 1218.0),
        voxels: &[
            ([51, 47, 80], 783.0),
            ([100, 90, 80], 382.0),
            ([34, 23, 32], 393.0),
            ([38, 69, 131], 1300.0),
        ],
        preset: "ct",
    },
];

fn open_file(path: &Path, options: &OpenOptions) -> Volume {
    open(path.to_str().unwrap(), options).unwrap()
}

fn sum(volume: &Volume) -> u64 {
    match volume.voxels() {
        Voxels::U8(v) => v.iter().map(|&x| u64::from(x)).sum(),
        Voxels::U16(v) => v.iter().map(|&x| u64::from(x)).sum(),
        Voxels::F32(_) => panic!("none of these volumes is floating point"),
    }
}

#[test]
fn every_volume_of_the_folder_opens_as_its_readme_says() {
    let Some(folder) = data_dir() else { return };
    for expected in &VOLUMES {
        let file = expected.file;
        let last_progress = std::cell::Cell::new(0.0);
        let progress = |fraction: f32| {
            assert!(fraction >= last_progress.get() && fraction <= 1.0, "{file}: progress only grows");
            last_progress.set(fraction);
        };
        let options = OpenOptions { progress: Some(&progress), ..OpenOptions::default() };
        let volume = open_file(&folder.join(file), &options);
        assert_eq!(last_progress.get(), 1.0, "{file}");
        let histogram = Histogram::of(&volume);
        let facts = VolumeFacts::of(&volume, &histogram);
        assert_eq!(facts.dims, expected.dims, "{file}");
        // The headers carry nine digits; 1e-6 is the rounding of a length to single precision.
        let spacing_error = (volume.spacing() - Vec3::from(expected.spacing)).abs().max_element();
        assert!(spacing_error < 1e-6, "{file}: {spacing_error}");
        assert_eq!((facts.dtype.as_str(), volume.value_range()), (expected.dtype, expected.range), "{file}");
        assert_eq!(
            (facts.unit.as_deref(), facts.orientation.as_deref()),
            (expected.unit, expected.orientation)
        );
        assert_eq!(facts.warnings, [""; 0], "{file}");
        assert_eq!(sum(&volume), expected.sum, "{file}");
        assert_eq!((histogram.percentile(50.0), histogram.percentile(99.0)), expected.percentiles, "{file}");
        for &([x, y, z], value) in expected.voxels {
            assert_eq!(volume.stored_at(x, y, z), value, "{file} at {x} {y} {z}");
        }
        let path = folder.join(file);
        assert_eq!(default_preset(path.to_str().unwrap(), &volume, &histogram), expected.preset, "{file}");
        // Only the tooth stands in something, of 360 to 430; the others' backgrounds are clear as they are.
        let domain = default_transfer(path.to_str().unwrap(), &volume, &histogram).domain;
        match domain {
            Domain::Values(from, _) => {
                assert!(file.ends_with("tooth.nhdr") && (350.0..450.0).contains(&from), "{file} {from}");
            }
            domain => assert_eq!(domain, preset(expected.preset).unwrap().domain, "{file}"),
        }
    }
}

/// The engine, one degree further in each frame of lists, in blocks: what decodes is what the encoder worked with, the picture stays,
/// and every frame after the first takes far fewer bytes.
#[test]
fn a_real_volume_goes_through_blocks() {
    let Some(folder) = data_dir() else { return };
    let volume = open_file(&folder.join("engine.nrrd"), &OpenOptions::default());
    let transfer = load_transfer("industrial").unwrap();
    let bounds = volume.bounds();
    let scene = Scene::new(volume.into(), &transfer, MarchSettings::default());
    let intrinsics = Intrinsics::perspective(192, 160, 0.7);
    let (width, height) = (intrinsics.width as usize, intrinsics.height as usize);
    let mut references = References::default();
    let mut bytes = vec![];
    for id in 1..=3u8 {
        let azimuth = (30.0 + f32::from(id)).to_radians();
        let pose = Pose::orbit(bounds.center(), azimuth, 0.35, bounds.radius() * intrinsics.fit_distance());
        let camera = Camera::new(pose, intrinsics, &bounds);
        let header = FrameHeader {
            frame: FrameId(id.into()),
            pose: PoseId(1),
            look: LookVersion(1),
            camera,
            k: 12,
            mode: Default::default(),
            fineness: Default::default(),
        };
        let frame = generate(&scene, header);
        let settings = blocks::Settings::of(60);
        let reference = references.newest().cloned();
        let (encoded, decoded) = blocks::encode(&frame, &settings, reference.as_deref()).unwrap();
        let chunks: Vec<_> = encoded.chunks.iter().map(|c| &c.bytes[..]).collect();
        let (found, reference) = decode_with(&chunks, &references, None).unwrap();
        found.validate().unwrap();
        let reference = reference.unwrap();
        assert!(*reference == decoded && found == decoded.to_frame(), "frame {id}");
        let picture = |f: &LayeredFrame| f.flatten().to_srgb8([0.0; 3]);
        let e = compare(&picture(&found), &picture(&frame), width, height, [0; 3]).unwrap();
        // At 512² the engine is off by .001.
        assert!(e.dssim < 3e-3, "frame {id}: {e:?}");
        references.insert(reference);
        bytes.push(encoded.num_bytes());
    }
    assert!(bytes[1] * 10 < bytes[0] * 7 && bytes[2] * 10 < bytes[0] * 7, "{bytes:?}");
}

#[test]
fn a_raw_file_reads_as_its_detached_header_says() {
    let Some(folder) = data_dir() else { return };
    let through_header = open_file(&folder.join("foreign/tooth.nhdr"), &OpenOptions::default());
    let shape = RawShape {
        dims: [103, 94, 161],
        dtype: Dtype::Uint16,
        spacing: Vec3::ONE,
        endian: Endian::Big,
        offset: 0,
    };
    let raw = |shape| {
        open_file(
            &folder.join("foreign/tooth.raw"),
            &OpenOptions { raw: Some(shape), ..OpenOptions::default() },
        )
    };
    assert!(raw(shape).voxels() == through_header.voxels());
    // Negative control: the same bytes in the wrong order are another volume.
    assert!(raw(RawShape { endian: Endian::Little, ..shape }).voxels() != through_header.voxels());
}

#[test]
fn other_files_of_the_folder_are_named_when_refused() {
    let Some(folder) = data_dir() else { return };
    let others = [
        ("README.md", "no header that is known"),
        ("licences", "a folder without slices"),
        // Slices lie below, in folders of their own.
        ("", "a folder of volumes"),
    ];
    for (file, kind) in others {
        let path = folder.join(file);
        let message = open(path.to_str().unwrap(), &OpenOptions::default()).unwrap_err().to_string();
        assert!(message.contains(file) && message.contains(&format!("found {kind}, expected")), "{message}");
    }
}
