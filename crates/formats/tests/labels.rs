//! Volumes of labels: how they are recognised, what the file says about them, and how they lie over another volume.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::fs;
use std::path::{Path, PathBuf};

use isinglass_core::volume::{Volume, VolumeLabel};
use isinglass_formats::{Flip, FormatError, Meaning, OpenOptions, Reading, Selection, open, outline};
use tempfile::TempDir;

/// An NRRD file of bytes with these lines in its header.
fn nrrd(folder: &Path, name: &str, lines: &str, numbers: &[u8]) -> PathBuf {
    let path = folder.join(name);
    let header = format!("NRRD0004\ntype: uchar\nencoding: raw\n{lines}\n\n");
    fs::write(&path, [header.as_bytes(), numbers].concat()).unwrap();
    path
}

fn try_open(path: &Path, reading: &Reading) -> Result<Volume, FormatError> {
    open(path.to_str().unwrap(), &OpenOptions { reading, ..OpenOptions::default() })
}

fn opened(path: &Path, reading: &Reading) -> Volume {
    try_open(path, reading).unwrap_or_else(|e| panic!("{e}"))
}

fn numbers(volume: &Volume) -> Vec<f32> {
    (0..volume.voxels().len()).map(|i| volume.value_from_stored(volume.voxels().get(i))).collect()
}

fn label(value: u32, name: &str, color: Option<[u8; 3]>) -> VolumeLabel {
    VolumeLabel { value, name: name.into(), color }
}

const AS_VALUES: Reading =
    Reading { stored_slices: false, voxels: Some(Meaning::Values), thin: None, labels: None };

#[test]
fn segments_of_slicer_have_their_names_values_and_colours() {
    let folder = TempDir::new().unwrap();
    let keys = "Segment0_Name:=liver: left\nSegment0_LabelValue:=7\nSegment0_Color:=1 0.5 0\nSegment0_Layer:=0\n\
                Segment1_LabelValue:=2\nSegment1_Layer:=0\nSegment2_Name:=vessel\nSegment2_LabelValue:=1\n\
                Segment2_Layer:=1\nSegment3_ID:=x\nSegmentation_MasterRepresentation:=Binary labelmap";
    let two = format!(
        "dimension: 4\nsizes: 2 2 2 1\nkinds: list domain domain domain\nspace: RAS\n\
                       space directions: none (1,0,0) (0,1,0) (0,0,1)\nspace origin: (0,0,0)\n{keys}"
    );
    let path = nrrd(folder.path(), "two.seg.nrrd", &two, &[7, 0, 2, 1, 0, 1, 0, 0]);
    let volume = opened(&path, Reading::USUAL);
    let expected = [label(2, "segment 1", None), label(7, "liver: left", Some([255, 128, 0]))];
    assert_eq!((volume.info.are_labels, &volume.info.labels[..]), (true, &expected[..]));
    assert_eq!(numbers(&volume), [7.0, 2.0, 0.0, 0.0]);
    let selection = Selection { channel: Some(1), ..Selection::default() };
    let options = OpenOptions { selection, ..OpenOptions::default() };
    let volume = open(path.to_str().unwrap(), &options).unwrap();
    assert_eq!(volume.info.labels, [label(1, "vessel", None)]);
    assert_eq!(outline(path.to_str().unwrap(), &options).unwrap().labels, [label(1, "vessel", None)]);
    // Files of older versions have a channel of 0 and 1 for each segment.
    let old = two.replace("_LabelValue", "_Extent").replace("_Layer", "_Tags");
    let path = nrrd(folder.path(), "old.seg.nrrd", &old, &[0; 8]);
    assert_eq!(opened(&path, Reading::USUAL).info.labels, [label(1, "liver: left", Some([255, 128, 0]))]);
    // The controls: the same numbers without a word, and as values.
    let bare = nrrd(folder.path(), "bare.nrrd", two.split("Segment0").next().unwrap().trim_end(), &[7; 8]);
    assert!(!opened(&bare, Reading::USUAL).info.are_labels);
    let volume = opened(&path, &AS_VALUES);
    assert!(!volume.info.are_labels && volume.info.labels.is_empty());
}

#[test]
fn the_intent_of_nifti_is_heard() {
    let folder = TempDir::new().unwrap();
    for (intent, datatype, numbers, are_labels) in [
        (1002i16, 2i16, vec![0u8, 3, 3, 9, 0, 0, 0, 0], true),
        (0, 2, vec![0, 3, 3, 9, 0, 0, 0, 0], false),
        (
            1002,
            16,
            [0.0f32, 3.0, 3.0, 9.0, 0.0, 0.0, 0.0, 1.0].iter().flat_map(|x| x.to_le_bytes()).collect(),
            true,
        ),
        (
            1002,
            16,
            [0.0f32, 3.5, 3.0, 9.0, 0.0, 0.0, 0.0, 1.0].iter().flat_map(|x| x.to_le_bytes()).collect(),
            false,
        ),
        (1002, 256, vec![255, 3, 3, 9, 0, 0, 0, 0], false),
    ] {
        let mut header = vec![0; 352];
        let mut put = |at: usize, bytes: &[u8]| header[at..at + bytes.len()].copy_from_slice(bytes);
        put(0, &348i32.to_le_bytes());
        for (i, dim) in [3i16, 2, 2, 2, 1, 1, 1, 1].iter().enumerate() {
            put(40 + 2 * i, &dim.to_le_bytes());
        }
        put(68, &intent.to_le_bytes());
        put(70, &datatype.to_le_bytes());
        for i in 0..5 {
            put(76 + 4 * i, &1f32.to_le_bytes());
        }
        put(108, &352f32.to_le_bytes());
        put(344, b"n+1\0");
        let path = folder.path().join("a.nii");
        fs::write(&path, [header, numbers].concat()).unwrap();
        let volume = opened(&path, Reading::USUAL);
        assert_eq!(volume.info.are_labels, are_labels, "{intent} {datatype}");
        let is_told = volume.info.warnings.iter().any(|w| w.contains("not all are whole numbers from 0"));
        assert_eq!(is_told, intent == 1002 && !are_labels);
        // Whoever asks for labels gets them or a refusal.
        let wish = Reading { voxels: Some(Meaning::Labels), ..Reading::default() };
        match try_open(&path, &wish) {
            Ok(volume) => assert!(volume.info.are_labels),
            Err(e) => assert!(is_told && e.to_string().contains("expected labels, which are whole numbers")),
        }
    }
}

#[test]
fn labels_of_ome_zarr_have_its_colours_and_properties() {
    let folder = TempDir::new().unwrap();
    let write = |name: &str, text: &str| {
        let path = folder.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    };
    let image = |more: &str| {
        format!(
            r#"{{"multiscales": [{{"version": "0.4", "axes": ["z", "y", "x"], "datasets": [{{"path": "0"}}]}}]{more}}}"#
        )
    };
    let label_part = r#", "image-label": {"colors": [{"label-value": 2, "rgba": [0, 128, 255, 255]},
        {"label-value": 0, "rgba": [0, 0, 0, 0]}], "properties": [{"label-value": 2, "class": "nucleus"},
        {"label-value": 5, "area": 7}, {"label-value": 4, "name": "membrane"}]}"#;
    write("a.zarr/.zattrs", &image(label_part));
    write(
        "a.zarr/0/.zarray",
        r#"{"zarr_format": 2, "shape": [1, 2, 2], "chunks": [1, 2, 2], "dtype": "|u1", "compressor": null,
            "filters": null, "order": "C", "fill_value": 0}"#,
    );
    write("a.zarr/0/0.0.0", "\u{2}\u{4}\0\u{2}");
    let path = folder.path().join("a.zarr");
    let volume = opened(&path, Reading::USUAL);
    let expected = [label(2, "nucleus", Some([0, 128, 255])), label(4, "membrane", None)];
    assert_eq!((volume.info.are_labels, &volume.info.labels[..]), (true, &expected[..]));
    assert_eq!(numbers(&volume), [2.0, 4.0, 0.0, 2.0]);
    write("a.zarr/.zattrs", &image(""));
    assert!(!opened(&path, Reading::USUAL).info.are_labels);
}

/// A ball of 5 in a ball of 10, in 24 voxels along each side.
fn balls() -> Vec<u8> {
    let radius = |i: usize| {
        [i % 24, i / 24 % 24, i / 576].map(|n| (n as f32 - 11.5).powi(2)).iter().sum::<f32>().sqrt()
    };
    (0..24 * 24 * 24).map(|i| if radius(i) < 5.0 { 5 } else { 10 * u8::from(radius(i) < 10.0) }).collect()
}

#[test]
fn few_numbers_in_blocks_are_taken_for_labels_with_a_word() {
    let folder = TempDir::new().unwrap();
    let lines = "dimension: 3\nsizes: 24 24 24";
    let path = nrrd(folder.path(), "balls.nrrd", lines, &balls());
    let volume = opened(&path, Reading::USUAL);
    let is_told =
        |v: &Volume| v.info.warnings.iter().any(|w| w.contains("--voxels values shows them as values"));
    assert!(volume.info.are_labels && is_told(&volume));
    let volume = opened(&path, &AS_VALUES);
    assert!(!volume.info.are_labels && !is_told(&volume));
    // The same with a soft edge.
    let soft: Vec<u8> = balls().iter().enumerate().map(|(i, n)| n * 10 + (i * 7 % 5) as u8).collect();
    let volume = opened(&nrrd(folder.path(), "soft.nrrd", lines, &soft), Reading::USUAL);
    assert!(!volume.info.are_labels && !is_told(&volume));
}

/// The header of a body of this many voxels and spacing along x, y and z. Its first voxel is at `origin`.
fn body(dims: [u32; 3], spacing: f32, origin: [f32; 3]) -> String {
    let [x, y, z] = dims;
    let [a, b, c] = origin;
    format!(
        "dimension: 3\nsizes: {x} {y} {z}\nspace: RAS\nspace directions: ({spacing},0,0) (0,{spacing},0) \
         (0,0,{spacing})\nspace origin: ({a},{b},{c})"
    )
}

fn over(labels: &Path) -> Reading {
    Reading { labels: Some(labels.to_str().unwrap().into()), ..Reading::default() }
}

#[test]
fn labels_lie_over_a_volume_where_their_places_are() {
    let folder = TempDir::new().unwrap();
    let folder = folder.path();
    // Along x, voxels are at 0, 1, 2 and 3 mm.
    let scan = nrrd(folder, "scan.nrrd", &body([4, 1, 1], 1.0, [0.0; 3]), &[50, 60, 70, 80]);
    let same = nrrd(folder, "same.nrrd", &body([4, 1, 1], 1.0, [0.0; 3]), &[1, 2, 3, 0]);
    let volume = opened(&scan, &over(&same));
    let [labels] = volume.others() else { panic!("{:?}", volume.others().len()) };
    assert_eq!((numbers(&volume)[3], numbers(labels)), (80.0, vec![1.0, 2.0, 3.0, 0.0]));
    assert!(labels.info.are_labels && !volume.info.are_labels);
    // Labels are at −0.9, 0.1 and 1.1 mm, and the others have none.
    let shifted = nrrd(folder, "shifted.nrrd", &body([3, 1, 1], 1.0, [-0.9, 0.0, 0.0]), &[9, 4, 6]);
    assert_eq!(numbers(&opened(&scan, &over(&shifted)).others()[0]), [4.0, 6.0, 0.0, 0.0]);
    // Two labels in a voxel, and another order of the axes.
    let fine = body([1, 1, 8], 0.5, [0.0, 0.0, -0.25])
        .replace("(0.5,0,0) (0,0.5,0) (0,0,0.5)", "(0,0,0.5) (0,0.5,0) (0.5,0,0)");
    let fine = fine.replace("(0,0,-0.25)", "(-0.25,0,0)");
    let fine = nrrd(folder, "fine.nrrd", &fine, &[1, 1, 2, 2, 3, 3, 4, 4]);
    let found = numbers(&opened(&scan, &over(&fine)).others()[0]);
    assert_eq!(found, [1.0, 2.0, 3.0, 4.0]);
    // What is mirrored is mirrored with its labels, also if these have another grid.
    for (labels, expected) in
        [(&same, [0.0, 3.0, 2.0, 1.0]), (&fine, [4.0, 3.0, 2.0, 1.0]), (&shifted, [0.0, 0.0, 6.0, 4.0])]
    {
        let selection = Selection { flip: Flip([true, false, false]), ..Selection::default() };
        let options = OpenOptions { selection, reading: &over(labels), ..OpenOptions::default() };
        let mirrored = open(scan.to_str().unwrap(), &options).unwrap();
        assert_eq!(numbers(&mirrored), [80.0, 70.0, 60.0, 50.0]);
        assert_eq!(numbers(&mirrored.others()[0]), expected);
    }
    // What it takes is said before.
    let (reading, source) = (over(&same), scan.to_str().unwrap());
    let bytes = |reading| {
        outline(source, &OpenOptions { reading, ..OpenOptions::default() }).unwrap().bytes_in_memory
    };
    assert_eq!((bytes(Reading::USUAL), bytes(&reading)), (8, 12));
}

#[test]
fn labels_that_do_not_fit_are_refused_in_one_line() {
    let folder = TempDir::new().unwrap();
    let folder = folder.path();
    let scan = nrrd(folder, "scan.nrrd", &body([4, 1, 1], 1.0, [0.0; 3]), &[50, 60, 70, 80]);
    let far = nrrd(folder, "far.nrrd", &body([4, 1, 1], 1.0, [90.0, 0.0, 0.0]), &[1, 2, 3, 4]);
    let plain = nrrd(folder, "plain.nrrd", "dimension: 3\nsizes: 5 1 1", &[1, 2, 3, 4, 5]);
    let fits = nrrd(folder, "fits.nrrd", "dimension: 3\nsizes: 4 1 1", &[1, 2, 3, 4]);
    let missing = folder.join("none.nrrd");
    for (labels, words) in [
        (&far, "no label lies within the volume, expected some"),
        (&plain, "labels of 5×1×1 voxels, expected 4×1×1 as in the volume, or a position in both files"),
        (&missing, "none.nrrd"),
    ] {
        let message = try_open(&scan, &over(labels)).unwrap_err().to_string();
        assert!(message.contains(words) && message.lines().count() == 1, "{message}");
    }
    // Without a position, the same grid will do.
    assert_eq!(numbers(&opened(&scan, &over(&fits)).others()[0]), [1.0, 2.0, 3.0, 4.0]);
}
