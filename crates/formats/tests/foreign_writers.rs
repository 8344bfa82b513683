//! Is what other libraries write read as what they meant? Every file of the archives holds the same volume, in another format,
//! type, compression or orientation.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

mod support;

use std::fs;
use std::path::{Path, PathBuf};

use isinglass_core::volume::{Volume, Voxels};
use isinglass_formats::{OpenOptions, Outline, open, outline};
use support::unpack;

/// The files of a folder with one of these ends, sorted.
fn files(folder: &Path, ends: &[&str]) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
    files.retain(|p| ends.iter().any(|end| p.to_str().unwrap().ends_with(end)));
    files.sort();
    files
}

/// Checks that a volume is the one that `make.py` writes: 5×4×3 voxels, that at i, j, k of value i + 10 j + 100 k above the
/// first. Returns the value of the first.
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

/// Checks spacing and place: 1.5, 2 and 3, and the first voxel at (-10, 20, 5), so the centre at (-7, 23, 8).
fn check_place(volume: &Volume, name: &str) {
    // Headers carry single precision: seven digits of numbers up to 23.
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

/// Opens a file, checks its voxels, and that what was told before agrees with what came.
fn checked(path: &Path) -> (Volume, String, f32) {
    let name = path.file_name().unwrap().to_str().unwrap().to_owned();
    let (before, volume) = (outline_of(path), open_path(path));
    let first = check_values(&volume, &name);
    assert_eq!((before.dims, before.spacing), (volume.dims(), volume.spacing().to_array()), "{name}");
    assert_eq!(before.bytes_in_memory, volume.bytes_in_memory(), "{name}");
    assert_eq!(before.dtype, volume.info.dtype, "{name}");
    (volume, name, first)
}

/// The value of the first voxel of a type, as `make.py` shifts it.
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

/// Types in memory: 8 and 16 bits stay, the others become floats.
fn check_type(volume: &Volume, code: &str, name: &str) {
    let is_kept = match volume.voxels() {
        Voxels::U8(_) => matches!(code, "u1" | "i1"),
        Voxels::U16(_) => matches!(code, "u2" | "i2"),
        Voxels::F32(_) => !matches!(code, "u1" | "i1" | "u2" | "i2"),
    };
    assert!(is_kept, "{name}");
}

/// What a body in this orientation is told to have been: nothing for RAS.
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
            // Half floats have eleven bits: 234 is exact.
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
