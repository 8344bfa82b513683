//! Files that other libraries write are read correctly. Every file in the archives has the same volume in another
//! format, type, compression or orientation.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

mod support;

use std::fs;
use std::path::{Path, PathBuf};

use glam::Vec3;
use isinglass_core::volume::{Volume, Voxels};
use isinglass_formats::{OpenOptions, Outline, Reading, Selection, open, outline};
use support::unpack;

/// The files of a folder with one of these suffixes, sorted.
fn files(folder: &Path, ends: &[&str]) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
    files.retain(|p| ends.iter().any(|end| p.to_str().unwrap().ends_with(end)));
    files.sort();
    files
}

/// Checks that a volume is the one of `make.py`. It has 5×4×3 voxels, and the voxel at i, j, k is i + 10 j + 100 k
/// above the first. Returns the value of the first.
fn check_values(volume: &Volume, name: &str) -> f32 {
    assert_eq!(volume.dims(), [5, 4, 3], "{name}");
    let value = |i: usize| volume.value_from_stored(volume.voxels().get(i));
    let first = value(0);
    for i in 0..60 {
        let expected = (i % 5) + (i / 5 % 4) * 10 + i / 20 * 100;
        assert_eq!(value(i) - first, expected as f32, "{name}: voxel {i}");
    }
    first
}

/// Checks the spacing, 1.5, 2 and 3, and the position. The first voxel is at (-10, 20, 5), and the centre at (-7, 23,
/// 8).
fn check_place(volume: &Volume, name: &str) {
    // Headers have single precision: seven digits of numbers up to 23.
    let is_near = |a: &[f64; 3], b: [f64; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5);
    assert!(
        is_near(&volume.spacing().to_array().map(f64::from), [1.5, 2.0, 3.0]),
        "{name}: {}",
        volume.spacing()
    );
    let placement = volume.info.placement.unwrap_or_else(|| panic!("{name} has no place"));
    assert!(is_near(&placement.center, [-7.0, 23.0, 8.0]), "{name}: {:?}", placement.center);
    for (k, axis) in placement.axes.iter().enumerate() {
        let expected = [0, 1, 2].map(|i| if i == k { 1.0 } else { 0.0 });
        assert!(is_near(axis, expected), "{name}: {:?}", placement.axes);
    }
}

fn open_path(path: &Path) -> Volume {
    open(path.to_str().unwrap(), &OpenOptions::default()).unwrap_or_else(|e| panic!("{e}"))
}

fn outline_of(path: &Path) -> Outline {
    outline(path.to_str().unwrap(), &OpenOptions::default()).unwrap()
}

/// Opens a file, and checks its voxels and that its outline agrees with the volume.
fn checked(path: &Path) -> (Volume, String, f32) {
    let name = path.file_name().unwrap().to_str().unwrap().to_owned();
    let (before, volume) = (outline_of(path), open_path(path));
    let first = check_values(&volume, &name);
    assert_eq!((before.dims, before.spacing), (volume.dims(), volume.spacing().to_array()), "{name}");
    assert_eq!(before.bytes_in_memory, volume.bytes_in_memory(), "{name}");
    assert_eq!(before.dtype, volume.info.dtype, "{name}");
    (volume, name, first)
}

/// The value of the first voxel of a type. `make.py` shifts it.
fn first_of(code: &str) -> f32 {
    match code {
        "i1" => -120.0,
        "i2" => -3000.0,
        "i4" => -70_000.0,
        "i8" => -1_048_576.0,
        "u2" => 40_000.0,
        "u4" | "u8" => 1_048_576.0,
        _ => 0.0,
    }
}

/// The type in memory: types of 8 and 16 bits stay, and others become floats.
fn check_type(volume: &Volume, code: &str, name: &str) {
    let is_kept = match volume.voxels() {
        Voxels::U8(_) => matches!(code, "u1" | "i1"),
        Voxels::U16(_) => matches!(code, "u2" | "i2"),
        Voxels::F32(_) => !matches!(code, "u1" | "i1" | "u2" | "i2"),
    };
    assert!(is_kept, "{name}");
}

/// The warning for a body in this orientation; none for RAS.
fn check_body(volume: &Volume, letters: &str, name: &str) {
    assert_eq!(volume.info.orientation.as_deref(), Some("RAS"), "{name}");
    let expected = format!("the axes of the file point to {letters}; the voxels were reordered to RAS");
    let expected = if letters == "RAS" { vec![] } else { vec![expected] };
    assert_eq!(volume.info.warnings, expected, "{name}");
}

#[test]
fn nifti_by_nibabel() {
    let folder = unpack("nifti");
    let files = files(folder.path(), &[".nii", ".nii.gz", ".hdr"]);
    assert_eq!(files.len(), 40 + 2 + 1 + 96 + 2);
    for path in files {
        let (volume, name, first) = checked(&path);
        check_place(&volume, &name);
        assert_eq!(volume.info.unit.as_deref(), Some("mm"), "{name}");
        match name.split_once('-') {
            Some((code, rest)) if code.len() == 2 => {
                assert_eq!(first, first_of(code), "{name}");
                check_type(&volume, code, &name);
                assert_eq!(outline_of(&path).format, format!("NIfTI-{}", &rest[..1]), "{name}");
                check_body(&volume, "RAS", &name);
            }
            Some(("sform" | "qform", rest)) => check_body(&volume, &rest[..3], &name),
            _ => check_body(&volume, "RAS", &name),
        }
    }
}

#[test]
fn meta_image_by_simple_itk() {
    let folder = unpack("metaimage");
    let files = files(folder.path(), &[".mha", ".mhd"]);
    assert_eq!(files.len(), 20 + 2 + 48);
    for path in files {
        let (volume, name, first) = checked(&path);
        check_place(&volume, &name);
        let stem = name.split(['.', '-']).next().unwrap();
        match stem.len() {
            2 => {
                assert_eq!(first, first_of(stem), "{name}");
                check_type(&volume, stem, &name);
                check_body(&volume, "RAS", &name);
            }
            3 => check_body(&volume, stem, &name),
            _ => check_body(&volume, "RAS", &name),
        }
    }
}

#[test]
fn arrays_by_numpy() {
    let folder = unpack("numpy");
    let files = files(folder.path(), &[".npy", ".npz"]);
    assert_eq!(files.len(), 22 + 2 + 2);
    for path in files {
        let (volume, name, first) = checked(&path);
        assert_eq!(volume.spacing().to_array(), [1.0; 3]);
        assert_eq!(volume.info.warnings.len(), 2, "{name}: {:?}", volume.info.warnings);
        if name.len() == 7 {
            let code = &name[..2];
            // Half floats have eleven bits, so 234 is exact.
            assert_eq!(first, if code == "f2" { 0.0 } else { first_of(code) }, "{name}");
            check_type(&volume, code, &name);
        }
    }
}

#[test]
fn maps_by_mrcfile() {
    let folder = unpack("mrc");
    let files = files(folder.path(), &[".mrc"]);
    assert_eq!(files.len(), 5 + 1 + 6 + 1);
    for path in files {
        let (volume, name, first) = checked(&path);
        check_place(&volume, &name);
        assert_eq!(
            (volume.info.unit.as_deref(), volume.info.orientation.as_deref()),
            (Some("Å"), None),
            "{name}"
        );
        let code = match name.as_str() {
            "mode0.mrc" => "i1",
            "mode6.mrc" => "u2",
            "mode2.mrc" | "mode12.mrc" | "big.mrc" => "f4",
            _ => "i2",
        };
        assert_eq!(first, first_of(code), "{name}");
        check_type(&volume, code, &name);
    }
}

#[test]
fn nrrd_by_simple_itk() {
    let folder = unpack("nrrd");
    let files = files(folder.path(), &[".nrrd"]);
    assert_eq!(files.len(), 20);
    for path in files {
        let (volume, name, first) = checked(&path);
        check_place(&volume, &name);
        check_body(&volume, "RAS", &name);
        let code = name.split(['.', '-']).next().unwrap();
        assert_eq!(first, first_of(code), "{name}");
        check_type(&volume, code, &name);
    }
}

/// Opens a channel of a file at a time.
fn open_part(path: &Path, channel: u32, time: u32) -> Volume {
    let selection = Selection { channel: Some(channel), time: Some(time), ..Selection::default() };
    open(path.to_str().unwrap(), &OpenOptions { selection, ..OpenOptions::default() })
        .unwrap_or_else(|e| panic!("{e}"))
}

/// Checks distances and unit of a file that has them.
fn check_spacing(volume: &Volume, unit: &str, name: &str) {
    // Fractions of two 32-bit numbers.
    assert!(
        (volume.spacing() - Vec3::new(1.5, 2.0, 3.0)).abs().max_element() < 1e-6,
        "{name}: {}",
        volume.spacing()
    );
    assert_eq!(volume.info.unit.as_deref(), Some(unit), "{name}");
    assert_eq!(volume.info.warnings, [""; 0], "{name}");
}

#[test]
fn tiff_by_tifffile() {
    let folder = unpack("tiff");
    let mut num_files = 0;
    for path in files(folder.path(), &[".tif"]).into_iter().chain([folder.path().join("stack")]) {
        num_files += 1;
        let name = path.file_name().unwrap().to_str().unwrap().to_owned();
        if name.starts_with("hyper") {
            let before = outline_of(&path);
            assert_eq!((before.num_channels, before.num_times), (2, 3), "{name}");
            if name.contains("ome") {
                assert_eq!(before.channels, ["DAPI", "GFP"], "{name}");
            }
            for (channel, time) in [(0, 0), (1, 0), (0, 2), (1, 1)] {
                let volume = open_part(&path, channel, time);
                assert_eq!(check_values(&volume, &name), (1000 * channel + 3000 * time) as f32, "{name}");
            }
            continue;
        }
        if name.starts_with("rgb") {
            assert_eq!(outline_of(&path).channels, ["red", "green", "blue"], "{name}");
            for channel in 0..3 {
                assert_eq!(check_values(&open_part(&path, channel, 0), &name), channel as f32, "{name}");
            }
            continue;
        }
        let (volume, name, first) = checked(&path);
        match name.as_str() {
            "imagej.tif" | "sizes.ome.tif" => check_spacing(&volume, "µm", &name),
            _ => {
                let expected = ["the file has no spacing; it was taken as 1"];
                assert_eq!(volume.info.warnings, expected, "{name}");
            }
        }
        let code = &name[..2];
        if code.as_bytes()[1].is_ascii_digit() {
            assert_eq!(first, if code == "f2" { 0.0 } else { first_of(code) }, "{name}");
            check_type(&volume, code, &name);
        }
    }
    assert_eq!(num_files, 22 + 8 + 2 + 7 + 2 + 1);
}

#[test]
fn dicom_by_pydicom() {
    let folder = unpack("dicom");
    let folders = files(folder.path(), &[""]);
    assert_eq!(folders.len(), 5 + 5 + 2 + 1 + 24);
    for path in folders {
        let (volume, name, first) = checked(&path);
        check_place(&volume, &name);
        assert_eq!(volume.info.modality.as_deref(), Some("CT"), "{name}");
        assert_eq!(volume.info.unit.as_deref(), Some("mm"), "{name}");
        let rest = name.split_once('-').map_or("i2", |(_, rest)| rest);
        if rest.len() == 2 {
            assert_eq!(first, first_of(rest), "{name}");
            check_type(&volume, rest, &name);
            check_body(&volume, "RAS", &name);
        } else {
            check_body(&volume, rest, &name);
        }
    }
}

/// Files with a slope, an intercept or a unit of values.
#[test]
fn calibrated_by_pydicom_and_tifffile() {
    let folder = unpack("calibrated");
    let values = |volume: &Volume| -> Vec<f32> {
        (0..volume.voxels().len()).map(|i| volume.value_from_stored(volume.voxels().get(i))).collect()
    };
    let plain = |i: usize| ((i % 5) + (i / 5 % 4) * 10 + i / 20 * 100) as f32;
    let dose = open_path(&folder.path().join("dose"));
    assert_eq!(values(&dose), (0..60).map(|i| 0.25 * plain(i)).collect::<Vec<_>>());
    check_place(&dose, "dose");
    check_body(&dose, "RAS", "dose");
    assert_eq!((dose.info.modality.as_deref(), dose.info.warnings.len()), (Some("RTDOSE"), 0));
    assert_eq!(dose.info.value_unit.as_deref(), Some("Gy"));
    for (name, slope, intercept) in [("signed", 1.0, -3000.0), ("line", 0.5, -1000.0)] {
        let volume = open_path(&folder.path().join(format!("{name}.tif")));
        let expected: Vec<_> = (0..60).map(|i| slope * plain(i) + intercept).collect();
        assert_eq!(values(&volume), expected, "{name}");
        check_spacing(&volume, "µm", name);
    }
    let volume = open_path(&folder.path().join("page.tif"));
    assert_eq!(check_values(&volume, "page.tif"), 0.0);
    let expected =
        ["the file has no spacing; it was taken as 1", "1 pages of another size or type were left out"];
    assert_eq!(volume.info.warnings, expected);
}

#[test]
fn images_by_vtk() {
    let folder = unpack("vti");
    let files = files(folder.path(), &[".vti"]);
    assert_eq!(files.len(), 20 + 12 + 24);
    for path in files {
        let (volume, name, first) = checked(&path);
        check_place(&volume, &name);
        assert_eq!(outline_of(&path).channels, ["density"], "{name}");
        let code = Some(&name[..2]).filter(|c| c.as_bytes()[1].is_ascii_digit()).unwrap_or("i2");
        assert_eq!(first, first_of(code), "{name}");
        check_type(&volume, code, &name);
    }
}

#[test]
fn pyramids_by_zarr() {
    let folder = unpack("zarr");
    let folders = files(folder.path(), &[""]);
    assert_eq!(folders.len(), 9 + 10 + 8);
    for path in folders {
        let (volume, name, first) = checked(&path);
        check_place(&volume, &name);
        check_spacing(&volume, "µm", &name);
        let code = match &name[3..] {
            "gzip" if name.starts_with("v2") => "i2",
            "zstd" => "f4",
            "big" => "i4",
            code if code.len() == 2 => code,
            _ => "u2",
        };
        assert_eq!(first, first_of(code), "{name}");
        check_type(&volume, code, &name);
    }
    let path = folder.path().join("v3-levels");
    let before = outline_of(&path);
    assert_eq!(before.levels.iter().map(|l| l.dims).collect::<Vec<_>>(), [[5, 4, 3], [3, 2, 2]]);
    let coarse = |options: OpenOptions| open(path.to_str().unwrap(), &options).unwrap();
    let level = Selection { level: Some(1), ..Selection::default() };
    let asked = coarse(OpenOptions { selection: level, ..OpenOptions::default() });
    assert_eq!((asked.dims(), asked.spacing()), ([3, 2, 2], Vec3::new(3.0, 4.0, 6.0)));
    let values: Vec<f32> = (0..12).map(|i| asked.voxels().get(i) - 40_000.0).collect();
    assert_eq!(values[..7], [0.0, 2.0, 4.0, 20.0, 22.0, 24.0, 200.0]);
    // 60 voxels of two bytes and their brightness do not fit into 100 bytes, but the coarser level does.
    let small = coarse(OpenOptions { max_bytes: 100, ..OpenOptions::default() });
    assert_eq!(small.dims(), [3, 2, 2]);
    let warnings = &small.info.warnings;
    assert_eq!(warnings[0], "level 1 of 2 is shown, the finest that fits into memory and a texture");
    // Nor are there bytes to read its values.
    assert!(warnings.len() == 2 && warnings[1].starts_with("the finest level's values are not known"));
    // A region is read from its chunks, in every coding.
    for name in ["v2-blosc", "v2-none", "v3-shards", "v3-transpose", "v3-u2"] {
        let region = Some("1:4,2:,1:2".parse().unwrap());
        let selection = Selection { region, ..Selection::default() };
        let source = folder.path().join(name);
        let options = OpenOptions { selection, ..OpenOptions::default() };
        let part = open(source.to_str().unwrap(), &options).unwrap();
        let values: Vec<f32> = (0..6).map(|i| part.voxels().get(i) - 40_000.0).collect();
        assert_eq!(
            (part.dims(), &values[..]),
            ([3, 2, 1], &[121.0, 122.0, 123.0, 131.0, 132.0, 133.0][..]),
            "{name}"
        );
    }
}

/// DICOM series other than a plain stack of slices.
#[test]
fn odd_series_by_pydicom() {
    let folder = unpack("dicom_odd");
    let at = |name: &str| folder.path().join(name);
    let values = |volume: &Volume| -> Vec<f32> {
        (0..volume.voxels().len()).map(|i| volume.value_from_stored(volume.voxels().get(i))).collect()
    };
    let plain = |i: usize| ((i % 5) + (i / 5 % 4) * 10 + i / 20 * 100) as f32;
    let has = |volume: &Volume, words: &str| {
        let warnings = &volume.info.warnings;
        assert!(warnings.iter().any(|w| w.contains(words)), "{words}: {warnings:?}");
    };

    let inverted = open_path(&at("monochrome1"));
    assert_eq!(values(&inverted), (0..60).map(|i| 255.0 - plain(i)).collect::<Vec<_>>());
    has(&inverted, "MONOCHROME1");
    let scaled = open_path(&at("rescale"));
    assert_eq!(values(&scaled), (0..60).map(|i| 2.0 * (plain(i) - 3000.0) - 1024.0).collect::<Vec<_>>());
    assert_eq!(scaled.info.warnings, [""; 0]);
    let each = open_path(&at("slopes"));
    assert_eq!(values(&each), (0..60).map(|i| plain(i) * (i / 20 + 1) as f32).collect::<Vec<_>>());
    has(&each, "different rescale slopes");

    // Every third value is 100 more than three before it, and missing slices lie between their neighbours.
    let stored = |name: &str| {
        let reading = Reading { stored_slices: true, ..Reading::default() };
        let options = OpenOptions { reading: &reading, ..OpenOptions::default() };
        open(at(name).to_str().unwrap(), &options).unwrap()
    };
    let (gap, gap_stored) = (open_path(&at("gap")), stored("gap"));
    assert_eq!((gap.dims(), gap.spacing().z), ([5, 4, 9], 3.0));
    assert_eq!(values(&gap), (0..180).map(|i| plain(i) - 3000.0).collect::<Vec<_>>());
    has(&gap, "2 slices are missing, after slice 4; their neighbours were blended there");
    has(&gap, "resampled to even distances; --stored-slices shows them as they are");
    assert_eq!((gap_stored.dims(), gap_stored.spacing().z), ([5, 4, 7], 3.0));
    has(&gap_stored, "2 slices are missing, after slice 4; the gap is not shown");
    let (uneven, uneven_stored) = (open_path(&at("uneven")), stored("uneven"));
    // The least distance is 2.3 mm, and 24 mm are ten of 2.4 mm.
    assert_eq!((uneven.dims(), uneven.spacing().z), ([5, 4, 11], 2.4));
    has(&uneven, "slices are 2.300 to 3.700 mm apart; they were resampled to 2.400 mm");
    // At 4.8 mm, between slices at 3.4 and 6 mm.
    assert!((values(&uneven)[40] - (100.0 + 100.0 * 1.4 / 2.6 - 3000.0)).abs() <= 0.5);
    assert_eq!((uneven_stored.dims(), uneven_stored.spacing().z), ([5, 4, 9], 3.0));
    has(&uneven_stored, "slices are 2.300 to 3.700 mm apart; they are shown 3.000 mm apart");
    let (tilt, tilt_stored) = (open_path(&at("tilt")), stored("tilt"));
    // The arc tangent of 0.8 by 3. The slices shift by 6.4 mm in all, or 3.2 rows.
    has(&tilt, "a tilt of 14.9°; they were resampled to right angles");
    assert_eq!((tilt.dims(), tilt.spacing().to_array()), ([5, 8, 9], [1.5, 2.0, 3.0]));
    has(&tilt_stored, "a tilt of 14.9°, which is not shown");
    assert_eq!((tilt_stored.dims(), tilt_stored.spacing().z), ([5, 4, 9], 3.0));

    let two = outline_of(&at("two"));
    assert_eq!(two.series.len(), 2);
    assert!(
        two.series[0].contains("9 slices of 5×4") && two.series[1].contains("3 slices"),
        "{:?}",
        two.series
    );
    let largest = open_path(&at("two"));
    assert_eq!(largest.dims(), [5, 4, 9]);
    has(&largest, "2 series, of which the largest is shown: 7 \"made\": CT, 9 slices");
    let selection = Selection { series: Some(1), ..Selection::default() };
    let options = OpenOptions { selection, ..OpenOptions::default() };
    let second = open(at("two").to_str().unwrap(), &options).unwrap();
    assert_eq!(check_values(&second, "the second series"), 0.0);

    assert_eq!(outline_of(&at("times")).num_times, 2);
    for time in 0..2 {
        let volume = open_part(&at("times"), 0, time);
        assert_eq!(check_values(&volume, "times"), -3000.0 + 1000.0 * time as f32);
    }
    let slice = open_path(&files(&at("rescale"), &[".dcm"])[0]);
    assert_eq!(slice.dims(), [5, 4, 1]);
    has(&slice, "one slice; its folder is a series");
}

#[test]
fn codings_by_imagecodecs() {
    let folder = unpack("dicom_coded");
    let folders = files(folder.path(), &[""]);
    assert_eq!(folders.len(), 6 + 3 + 3);
    for path in folders {
        let name = path.file_name().unwrap().to_str().unwrap().to_owned();
        if name.starts_with("color") {
            let channel = |channel: u32| {
                let selection = Selection { channel: Some(channel), ..Selection::default() };
                let volume =
                    open(path.to_str().unwrap(), &OpenOptions { selection, ..OpenOptions::default() });
                let volume = volume.unwrap_or_else(|e| panic!("{name}: {e}"));
                assert_eq!(volume.dims(), [16, 16, 3], "{name}");
                volume.voxels().get(400)
            };
            for (i, expected) in [200.0, 100.0, 50.0].into_iter().enumerate() {
                assert!((channel(i as u32) - expected).abs() <= 2.0, "{name}: {}", channel(i as u32));
            }
            continue;
        }
        let (form, code) = name.split_once('-').unwrap();
        if ["near", "jpeg12", "lossy"].contains(&form) {
            let volume = open_path(&path);
            assert_eq!(volume.dims(), [5, 4, 3], "{name}");
            for i in 0..60 {
                let expected = (i % 5) + (i / 5 % 4) * 10 + i / 20 * 100;
                let found = volume.value_from_stored(volume.voxels().get(i));
                assert!((found - expected as f32).abs() <= 3.0, "{name}: voxel {i}: {found}, {expected}");
            }
        } else {
            let (volume, _, first) = checked(&path);
            check_place(&volume, &name);
            assert_eq!(first, first_of(code), "{name}");
            check_type(&volume, code, &name);
        }
    }
}

#[test]
fn mosaics_and_nuclear_medicine_by_pydicom() {
    let folder = unpack("dicom_vendors");
    let names = ["mosaic_siemens", "mosaic_header", "mosaic_uih", "nm_up", "nm_down"];
    for name in names {
        let (volume, name, first) = checked(&folder.path().join(name));
        check_place(&volume, &name);
        assert_eq!(first, first_of("u2"), "{name}");
        check_body(&volume, "RAS", &name);
    }
}

#[test]
fn segmentations_by_highdicom() {
    let folder = unpack("dicom_vendors");
    let expected = |i: usize| {
        let (x, y, z) = (i % 5, i / 5 % 4, i / 20);
        let (is_liver, is_lesion) = (z < 2 && y < 2, z > 0 && (1..3).contains(&y) && (1..3).contains(&x));
        if is_lesion { 2.0 } else { f32::from(u8::from(is_liver)) }
    };
    for (name, word) in [
        ("seg_binary.dcm", "2 voxels are in several segments; the one with the highest number is shown"),
        ("seg_fractional.dcm", "the label of the segment that fills most of it"),
        ("seg_labels.dcm", ""),
    ] {
        let path = folder.path().join(name);
        let volume = open_path(&path);
        assert_eq!((volume.dims(), volume.spacing().to_array()), ([5, 4, 3], [1.5, 2.0, 3.0]), "{name}");
        for i in 0..60 {
            assert_eq!(volume.voxels().get(i), expected(i), "{name}: voxel {i}");
        }
        check_place(&volume, name);
        let labels = &volume.info.labels;
        let told: Vec<(u32, &str)> = labels.iter().map(|l| (l.value, l.name.as_str())).collect();
        assert_eq!(told, [(1, "liver"), (2, "lesion")], "{name}");
        for (label, expected) in labels.iter().zip([[255, 0, 0], [0, 255, 0]]) {
            let found = label.color.unwrap();
            assert!(found.iter().zip(expected).all(|(a, b)| a.abs_diff(b) <= 8), "{name}: {found:?}");
        }
        assert!(
            volume.info.warnings.iter().any(|w| w.contains(word)) || word.is_empty(),
            "{:?}",
            volume.info
        );
        assert_eq!(&outline_of(&path).labels, labels);
    }
}

#[test]
fn packed_and_other_files_by_nibabel_and_simpleitk() {
    let folder = unpack("packed");
    let paths = files(folder.path(), &[""]);
    assert_eq!(paths.len(), 4 + 3 + 1 + 2 + 2);
    for path in paths {
        let (volume, name, first) = checked(&path);
        let (form, rest) = name.split_once('-').unwrap();
        let code = &rest[..2];
        assert_eq!(first, first_of(code), "{name}");
        check_type(&volume, code, &name);
        if form != "png" {
            check_place(&volume, &name);
        }
        if matches!(form, "mgh" | "mgz" | "zip" | "deflated") {
            check_body(&volume, "RAS", &name);
        }
    }
}
