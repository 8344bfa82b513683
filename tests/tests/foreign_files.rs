//! Do files as others published them open as independent readers read them, and are twins in two formats one picture?
//!
//! The expected figures were read with nibabel 5.4 (`as_closest_canonical`, unscaled), SimpleITK 2.5 (`DICOMOrient(…, "RAS")`),
//! VTK 9.7 and tifffile 2026.3, as arrays indexed x, y, z; centres are in RAS.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::path::Path;

use glam::Vec3;
use isinglass_core::camera::{Camera, Intrinsics, Pose};
use isinglass_core::kernels::march::{MarchSettings, Scene, render};
use isinglass_core::volume::Volume;
use isinglass_formats::{OpenOptions, Region, Selection, load_transfer, open, outline};
use isinglass_tests::data_dir;

struct Expected {
    file: &'static str,
    format: &'static str,
    dims: [u32; 3],
    spacing: [f32; 3],
    dtype: &'static str,
    unit: Option<&'static str>,
    orientation: Option<&'static str>,
    center: Option<[f64; 3]>,
    /// Sum, least and greatest of the stored numbers.
    sum: f64,
    range: (f32, f32),
    /// From stored numbers to values.
    slope: f32,
    voxels: &'static [([i32; 3], f32)],
    /// Words of each warning.
    warnings: &'static [&'static str],
}

const FILES: [Expected; 6] = [
    Expected {
        file: "AVM.nii.gz",
        format: "NIfTI-1, gzip",
        dims: [337, 319, 154],
        spacing: [0.5469, 0.5469, 1.0],
        dtype: "uint8",
        unit: Some("mm"),
        orientation: Some("RAS"),
        center: Some([18.481_505_87, 17.262_897_31, 12.389_999_39]),
        sum: 37_963_473.0,
        range: (0.0, 255.0),
        slope: 2.208_627_5,
        voxels: &[([168, 159, 77], 0.0), ([83, 146, 9], 255.0)],
        warnings: &[],
    },
    Expected {
        file: "LIDC2.mha",
        format: "MetaImage, zlib",
        dims: [256, 256, 133],
        spacing: [1.406_25, 1.406_25, 2.5],
        dtype: "uint8",
        unit: Some("mm"),
        orientation: Some("RAS"),
        center: Some([-179.296_875, -180.703_125, 167.5]),
        sum: 61_489_178.0,
        range: (0.0, 255.0),
        slope: 1.0,
        voxels: &[([128, 128, 66], 128.0), ([85, 64, 26], 13.0), ([32, 132, 20], 255.0)],
        warnings: &["the axes of the file point to LAI; the voxels were reordered to RAS"],
    },
    Expected {
        file: "dicom_mr_head",
        format: "DICOM, plain",
        dims: [256, 256, 20],
        spacing: [0.859_375, 0.859_375, 7.000_524],
        dtype: "int16",
        unit: Some("mm"),
        orientation: Some("RAS"),
        center: Some([0.929_687_5, -21.351_317, 7.846_006]),
        sum: 219_593_921.0,
        range: (1.0, 1059.0),
        slope: 1.0,
        voxels: &[
            ([128, 128, 10], 494.0),
            ([85, 64, 4], 497.0),
            ([153, 102, 16], 472.0),
            ([93, 188, 7], 1059.0),
        ],
        warnings: &[
            "slices are 6.9",
            "the file says that slices are 2 mm apart",
            "the axes of the file point to LPS",
            "the axes are rotated by up to 7.7°",
            "340357 voxels are 0, outside of the scanned part",
        ],
    },
    Expected {
        file: "aneurism.vti",
        format: "VTK image, appended raw, zlib",
        dims: [256; 3],
        spacing: [1.0; 3],
        dtype: "uint8",
        unit: None,
        orientation: None,
        center: Some([127.5; 3]),
        sum: 17_938_365.0,
        range: (0.0, 255.0),
        slope: 1.0,
        voxels: &[([128, 128, 128], 0.0), ([58, 218, 166], 255.0)],
        warnings: &[],
    },
    Expected {
        file: "mouse_brain_downsampled.tiff",
        format: "TIFF",
        dims: [108, 77, 135],
        spacing: [1.0; 3],
        dtype: "uint16",
        unit: None,
        orientation: Some("RDB"),
        center: None,
        sum: 579_550_878.0,
        range: (0.0, 65_535.0),
        slope: 1.0,
        voxels: &[
            ([54, 38, 67], 664.0),
            ([36, 19, 27], 1847.0),
            ([64, 30, 108], 510.0),
            ([68, 41, 7], 65_535.0),
        ],
        warnings: &["no spacing"],
    },
    Expected {
        file: "mouse_brain_slices",
        format: "TIFF, a file for each slice",
        dims: [271, 193, 16],
        spacing: [1.0; 3],
        dtype: "uint16",
        unit: None,
        orientation: Some("RDB"),
        center: None,
        sum: 92_323_995.0,
        range: (2.0, 5401.0),
        slope: 1.0,
        voxels: &[([135, 96, 8], 85.0), ([90, 48, 3], 188.0), ([162, 77, 12], 90.0), ([91, 178, 0], 5401.0)],
        warnings: &["no spacing"],
    },
];

fn open_file(path: &Path, options: &OpenOptions) -> Volume {
    open(path.to_str().unwrap(), options).unwrap_or_else(|e| panic!("{e}"))
}

/// The number in the file, of which types with a sign are shifted in memory.
fn number_at(volume: &Volume, at: [i32; 3], slope: f32) -> f32 {
    (volume.value_from_stored(volume.stored_at(at[0], at[1], at[2])) / slope).round()
}

#[test]
fn every_file_opens_as_independent_readers_read_it() {
    let Some(folder) = data_dir() else { return };
    for expected in &FILES {
        let file = expected.file;
        let path = folder.join("foreign").join(file);
        let before = outline(path.to_str().unwrap(), &OpenOptions::default()).unwrap();
        let volume = open_file(&path, &OpenOptions::default());
        assert_eq!(before.format, expected.format, "{file}");
        // Whether a voxel has no value is known when all are read.
        let of_gaps = volume.gaps().map_or(0, |_| volume.voxels().len() as u64);
        assert_eq!(
            (before.dims, before.bytes_in_memory + of_gaps),
            (volume.dims(), volume.bytes_in_memory()),
            "{file}"
        );
        assert_eq!(volume.dims(), expected.dims, "{file}");
        let info = &volume.info;
        assert_eq!(info.dtype, expected.dtype, "{file}");
        assert_eq!(
            (info.unit.as_deref(), info.orientation.as_deref()),
            (expected.unit, expected.orientation)
        );
        // Headers carry six digits or single precision.
        let spacing_error = (volume.spacing() - Vec3::from(expected.spacing)).abs().max_element();
        assert!(spacing_error < 1e-5, "{file}: {}", volume.spacing());
        let center = info.placement.map(|p| p.center);
        assert_eq!(center.is_some(), expected.center.is_some(), "{file}");
        for (found, expected) in center.iter().flatten().zip(expected.center.iter().flatten()) {
            assert!((found - expected).abs() < 1e-4, "{file}: {center:?}");
        }
        let [nx, ny, nz] = volume.dims().map(|d| d as i32);
        let slope = expected.slope;
        let mut sum = 0.0;
        // Padding has the number 0.
        let is_known = |i: &usize| volume.gaps().is_none_or(|gaps| gaps.bytes[*i] == 0);
        for i in (0..volume.voxels().len()).filter(is_known) {
            sum += f64::from(volume.value_from_stored(volume.voxels().get(i)));
        }
        // Values are single-precision products: seven digits of each.
        let sum_error = (sum / f64::from(slope) - expected.sum).abs() / expected.sum;
        assert!(sum_error < 1e-6, "{file}: {sum}");
        let (lo, hi) = volume.value_range();
        assert_eq!(((lo / slope).round(), (hi / slope).round()), expected.range, "{file}");
        for &(at, value) in expected.voxels {
            assert_eq!(number_at(&volume, at, slope), value, "{file} at {at:?}");
        }
        // Negative control: a mirrored volume would not pass.
        let mirrored = expected.voxels.iter().filter(|(at, value)| {
            number_at(&volume, [nx - 1 - at[0], ny - 1 - at[1], nz - 1 - at[2]], slope) != *value
        });
        assert!(mirrored.count() > 0, "{file}");
        assert_eq!(info.warnings.len(), expected.warnings.len(), "{file}: {:?}", info.warnings);
        for (found, words) in info.warnings.iter().zip(expected.warnings) {
            assert!(found.contains(words), "{file}: {found}");
        }
    }
}

/// A small picture of a volume.
fn picture(volume: Volume, transfer: &str) -> Vec<u8> {
    let transfer = load_transfer(transfer).unwrap();
    let bounds = volume.bounds();
    let scene = Scene::new(volume.into(), &transfer, MarchSettings::default());
    let intrinsics = Intrinsics::perspective(96, 80, 0.6);
    let pose = Pose::orbit(bounds.center(), 0.6, 0.35, bounds.radius() * intrinsics.fit_distance());
    render(&scene, &Camera::new(pose, intrinsics, &bounds)).to_srgb8([0.0; 3])
}

/// The vessels in NIfTI and NRRD, and slices of the brain in TIFF files and in the NRRD file of the whole.
#[test]
fn twins_in_two_formats_are_one_picture() {
    let Some(folder) = data_dir() else { return };
    let whole = OpenOptions::default();
    let nifti = open_file(&folder.join("foreign/AVM.nii.gz"), &whole);
    let nrrd = open_file(&folder.join("avm.nrrd"), &whole);
    assert!(nifti.voxels() == nrrd.voxels());
    let nrrd = picture(nrrd, "angio");
    assert!(nrrd.iter().any(|&b| b > 100), "there is something to see");
    assert_eq!(picture(nifti, "angio"), nrrd);

    let spacing = Some(Vec3::new(0.04, 0.04, 0.05));
    let slices = folder.join("foreign/mouse_brain_slices");
    let part = |from: u32| {
        let region = Some(Region { min: [0, 0, from], max: [None, None, Some(from + 16)] });
        let options = OpenOptions { selection: Selection { region, ..Selection::default() }, ..whole };
        open_file(&folder.join("mouse_brain.nrrd"), &options)
    };
    let tiff = open_file(&slices, &OpenOptions { spacing, ..whole });
    assert!(tiff.voxels() == part(128).voxels());
    let expected = picture(part(128), "fluorescence");
    assert_eq!(picture(tiff, "fluorescence"), expected);
    // Negative control: other slices are another picture.
    assert_ne!(picture(part(100), "fluorescence"), expected);
}

/// Scans have many values, or noise, or soft edges. None of them is taken for labels.
#[test]
fn no_scan_is_taken_for_labels() {
    let Some(folder) = data_dir() else { return };
    let scans =
        ["avm", "bonsai", "engine", "heptane", "mouse_brain", "t1_head"].map(|name| format!("{name}.nrrd"));
    let foreign = ["tooth.nhdr", "LIDC2.mha", "aneurism.vti", "mouse_brain_downsampled.tiff"];
    let foreign = foreign.map(|name| format!("foreign/{name}"));
    for name in scans.iter().chain(&foreign) {
        let volume = open_file(&folder.join(name), &OpenOptions::default());
        assert!(!volume.info.are_labels, "{name}");
    }
    // The control: the same blocks of bone in a thresholded scan are labels.
    let scan = open_file(&folder.join("bonsai.nrrd"), &OpenOptions::default());
    let voxels = (0..scan.voxels().len()).map(|i| (scan.voxels().get(i) / 64.0).floor().min(2.0) as u8);
    let header = "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 256 256 256\nencoding: raw\n\n";
    let file = tempfile::TempDir::new().unwrap();
    let path = file.path().join("parts.nrrd");
    std::fs::write(&path, [header.as_bytes(), &voxels.collect::<Vec<u8>>()].concat()).unwrap();
    assert!(open_file(&path, &OpenOptions::default()).info.are_labels);
}
