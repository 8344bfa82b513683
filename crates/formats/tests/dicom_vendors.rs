//! What single vendors write: places in other fields, preambles of other formats, tables, floats and byte orders.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

#[path = "support/dicom.rs"]
mod dicom;

use std::fs;
use std::path::Path;

use dicom::{PLAIN, decimals, element, file, sequence, text, with_pixels};
use isinglass_core::volume::Volume;
use isinglass_formats::{OpenOptions, open, outline};
use tempfile::TempDir;

const POSITION: (u16, u16) = (0x0020, 0x0032);
const ORIENTATION: (u16, u16) = (0x0020, 0x0037);
const SPACING: (u16, u16) = (0x0028, 0x0030);
const LOCATION: (u16, u16) = (0x0020, 0x1041);

fn folder(files: &[(&str, Vec<u8>)]) -> TempDir {
    let folder = TempDir::new().unwrap();
    for (name, bytes) in files {
        fs::write(folder.path().join(name), bytes).unwrap();
    }
    folder
}

fn opened(path: &Path) -> Volume {
    open(path.to_str().unwrap(), &OpenOptions::default()).unwrap_or_else(|e| panic!("{e}"))
}

fn refused(path: &Path) -> String {
    outline(path.to_str().unwrap(), &OpenOptions::default()).unwrap_err().to_string()
}

/// All values in order.
fn values(volume: &Volume) -> Vec<f32> {
    (0..volume.voxels().len()).map(|i| volume.value_from_stored(volume.voxels().get(i))).collect()
}

fn short(number: u16, value: u16) -> Vec<u8> {
    element((0x0028, number), "US", &value.to_le_bytes())
}

#[test]
fn locations_order_what_has_no_positions() {
    let slice =
        |z: f64, value| file(PLAIN, vec![decimals(LOCATION, &[z]), decimals(SPACING, &[1.0, 1.0])], &[value]);
    let series = folder(&[("a", slice(6.0, 3)), ("b", slice(0.0, 1)), ("c", slice(3.0, 2))]);
    let volume = opened(series.path());
    assert_eq!((volume.dims(), volume.spacing().to_array()), ([2, 2, 3], [1.0, 1.0, 3.0]));
    assert_eq!(values(&volume).iter().step_by(4).copied().collect::<Vec<_>>(), [1.0, 2.0, 3.0]);
    assert!(
        volume.info.warnings[0].contains("in the order of their locations"),
        "{:?}",
        volume.info.warnings
    );
    // Equal locations order nothing.
    let equal = folder(&[("a", slice(1.0, 3)), ("b", slice(1.0, 1))]);
    let said = opened(equal.path()).info.warnings;
    assert!(said.iter().any(|w| w.contains("in the order of their numbers")), "{said:?}");
}

/// An enhanced file of stacks in one direction. Each frame has its stack and its place.
fn stacks(frames: &[(&str, [f64; 3])]) -> TempDir {
    let frame = |(stack, place): &(&str, [f64; 3])| {
        vec![
            sequence((0x0020, 0x9111), &[vec![text((0x0020, 0x9056), "SH", stack)]]),
            sequence((0x0020, 0x9113), &[vec![decimals(POSITION, place)]]),
            sequence((0x0020, 0x9116), &[vec![decimals(ORIENTATION, &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0])]]),
        ]
    };
    let measures = sequence((0x0028, 0x9110), &[vec![decimals(SPACING, &[1.0, 1.0])]]);
    let frames: Vec<_> = frames.iter().map(frame).collect();
    let groups = vec![sequence((0x5200, 0x9229), &[vec![measures]]), sequence((0x5200, 0x9230), &frames)];
    let numbers: Vec<u16> = (0..frames.len() as u16).collect();
    folder(&[("all", file(PLAIN, groups, &numbers))])
}

#[test]
fn stacks_that_make_one_volume_are_joined() {
    let at = |stack, z| (stack, [0.0, 0.0, z]);
    let one = stacks(&[at("3", 8.0), at("3", 10.0), at("1", 0.0), at("1", 2.0), at("2", 4.0), at("2", 6.0)]);
    let volume = opened(one.path());
    assert_eq!((volume.dims(), volume.spacing().z), ([2, 2, 6], 2.0));
    assert_eq!(
        values(&volume).iter().step_by(4).copied().collect::<Vec<_>>(),
        [2.0, 3.0, 4.0, 5.0, 0.0, 1.0]
    );
    // Stacks with a gap between them, or aside of each other, stay apart.
    let apart = stacks(&[at("1", 0.0), at("1", 2.0), at("2", 9.0), at("2", 11.0)]);
    let aside = stacks(&[at("1", 0.0), at("1", 2.0), ("2", [5.0, 0.0, 4.0]), ("2", [5.0, 0.0, 6.0])]);
    for (name, folder) in [("apart", apart), ("aside", aside)] {
        let found = outline(folder.path().to_str().unwrap(), &OpenOptions::default()).unwrap();
        assert_eq!(found.series.len(), 2, "{name}");
    }
}

#[test]
fn a_preamble_decides_nothing() {
    let slice = file(PLAIN, vec![decimals(SPACING, &[1.0, 1.0])], &[7]);
    for start in [&b"II*\0\x08\0\0\0"[..], b"MM\0*\0\0\0\x08", b"NRRD0004\n", b"\x1f\x8b\x08\0"] {
        let mut bytes = slice.clone();
        bytes[..start.len()].copy_from_slice(start);
        let lone = folder(&[("a.dcm", bytes)]);
        assert_eq!(values(&opened(&lone.path().join("a.dcm"))), [7.0; 4], "{start:?}");
        assert_eq!(values(&opened(lone.path())), [7.0; 4], "{start:?}");
    }
    // Without the mark, a TIFF header is one.
    let tiff = folder(&[("a.dcm", b"II*\0\x08\0\0\0".to_vec())]);
    assert!(refused(&tiff.path().join("a.dcm")).contains("TIFF"));
}

#[test]
fn a_modality_lut_gives_the_values() {
    let words = |list: &[u16]| list.iter().flat_map(|n| n.to_le_bytes()).collect::<Vec<u8>>();
    let table = sequence(
        (0x0028, 0x3000),
        &[vec![
            element((0x0028, 0x3002), "US", &words(&[3, 10, 16])),
            text((0x0028, 0x3004), "LO", "HU"),
            element((0x0028, 0x3006), "US", &words(&[500, 700, 65_535])),
        ]],
    );
    // The same elements in a table for windows (VOI LUT) change nothing.
    let other = sequence((0x0028, 0x3010), &[vec![element((0x0028, 0x3002), "US", &words(&[1, 0, 16]))]]);
    let pixels = element((0x7fe0, 0x0010), "OW", &words(&[10, 11, 12, 99]));
    let of = |elements: Vec<Vec<u8>>| {
        let lone = folder(&[("a", with_pixels(PLAIN, elements, &pixels))]);
        opened(&lone.path().join("a"))
    };
    let volume = of(vec![table, other.clone()]);
    // A number beyond the table has its last value.
    assert_eq!(values(&volume), [500.0, 700.0, 65_535.0, 65_535.0]);
    assert_eq!(volume.info.value_unit.as_deref(), Some("HU"));
    assert!(volume.info.warnings.iter().any(|w| w.contains("Modality LUT")));
    assert_eq!(values(&of(vec![other])), [10.0, 11.0, 12.0, 99.0]);
}

#[test]
fn floats_and_swapped_bytes_are_read() {
    let floats: Vec<u8> = [1.5f32, -2.0, 0.25, 1e9].iter().flat_map(|x| x.to_le_bytes()).collect();
    let pixels = element((0x7fe0, 0x0008), "OW", &floats);
    let lone = folder(&[("a", with_pixels(PLAIN, vec![short(0x100, 32)], &pixels))]);
    assert_eq!(values(&opened(&lone.path().join("a"))), [1.5, -2.0, 0.25, 1e9]);

    // Two frames of 3×1 pixels of 8 bits in big-endian words: each pair of bytes is swapped.
    let big = |bytes: Vec<u8>| -> Vec<u8> {
        let word = |i: usize| [bytes[i + 1], bytes[i]];
        let is_text = matches!(&bytes[4..6], b"CS" | b"UI" | b"IS" | b"LO" | b"DS");
        let head = [word(0), word(2)].concat();
        let size = [bytes[7], bytes[6]];
        let value = if is_text {
            bytes[8..].to_vec()
        } else {
            bytes[8..].chunks(2).flat_map(|w| [w[1], w[0]]).collect()
        };
        [&head[..], &bytes[4..6], &size, &value].concat()
    };
    let elements = [
        text((0x0008, 0x0060), "CS", "MR"),
        short(0x02, 1),
        text((0x0028, 0x0004), "CS", "MONOCHROME2"),
        text((0x0028, 0x0008), "IS", "2"),
        short(0x10, 1),
        short(0x11, 3),
        short(0x100, 8),
        short(0x101, 8),
        short(0x102, 7),
        short(0x103, 0),
    ];
    let body: Vec<u8> = elements.into_iter().flat_map(big).collect();
    let of = |vr: &[u8; 2], pixels: [u8; 6]| {
        let meta = text((0x0002, 0x0010), "UI", "1.2.840.10008.1.2.2");
        let head = [&[0x7f, 0xe0, 0x00, 0x10][..], vr, &[0, 0, 0, 0, 0, 6]].concat();
        let bytes = [&[0; 128][..], b"DICM", &meta, &body, &head, &pixels].concat();
        let lone = folder(&[("a", bytes)]);
        values(&opened(&lone.path().join("a")))
    };
    assert_eq!(of(b"OW", [2, 1, 4, 3, 6, 5]), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    assert_eq!(of(b"OB", [1, 2, 3, 4, 5, 6]), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
}

#[test]
fn what_is_no_picture_is_named() {
    let class = |uid: &str| text((0x0008, 0x0016), "UI", uid);
    let no_pixels = |elements: Vec<Vec<u8>>| with_pixels(PLAIN, elements, &[]);
    let lone = folder(&[
        ("DICOMDIR", no_pixels(vec![class("1.2.840.10008.1.3.10")])),
        ("report", no_pixels(vec![text((0x0008, 0x0060), "CS", "SR")])),
        ("palette", with_pixels(PLAIN, vec![text((0x0028, 0x0004), "CS", "PALETTE COLOR")], &[])),
        (
            "colors",
            file("1.2.840.10008.1.2.4.80", vec![text((0x0028, 0x0004), "CS", "RGB"), short(0x02, 3)], &[7]),
        ),
    ]);
    let e = |name: &str| refused(&lone.path().join(name));
    assert!(
        e("DICOMDIR").ends_with("found a list of files (DICOMDIR), expected the folder that it lists"),
        "{}",
        e("DICOMDIR")
    );
    let expected = r#"the file of modality "SR" has no pixels, expected a picture or a segmentation"#;
    assert!(e("report").ends_with(expected), "{}", e("report"));
    assert!(e("palette").contains("no pixels"), "{}", e("palette"));
    assert!(!e("colors").contains("\"RGB\""), "{}", e("colors"));
    // A list beside slices is no slice that was left out.
    fs::remove_file(lone.path().join("report")).unwrap();
    fs::remove_file(lone.path().join("palette")).unwrap();
    fs::remove_file(lone.path().join("colors")).unwrap();
    fs::write(lone.path().join("slice"), file(PLAIN, vec![decimals(SPACING, &[1.0, 1.0])], &[7])).unwrap();
    let said = opened(lone.path()).info.warnings;
    assert!(!said.iter().any(|w| w.contains("left out")), "{said:?}");
}

#[test]
fn empty_files_among_slices_are_told() {
    let place = |z: f64| {
        vec![
            decimals(POSITION, &[0.0, 0.0, z]),
            decimals(ORIENTATION, &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0]),
            decimals(SPACING, &[1.0, 1.0]),
        ]
    };
    let slice = |z: f64| file(PLAIN, place(z), &[z as u16]);
    let series =
        folder(&[("1.dcm", slice(0.0)), ("2.dcm", vec![]), ("3.dcm", slice(2.0)), ("4.dcm", slice(4.0))]);
    let volume = opened(series.path());
    assert_eq!(values(&volume).iter().step_by(4).copied().collect::<Vec<_>>(), [0.0, 2.0, 4.0]);
    let text = "1 files are no slices and were left out, the first: 2.dcm: it is empty (0 bytes)";
    assert!(volume.info.warnings.iter().any(|w| w == text), "{:?}", volume.info.warnings);
    // The same series in an archive.
    let mut archive = rawzip::ZipArchiveWriter::new(Vec::new());
    for (i, z) in [4.0, 0.0, 2.0].into_iter().enumerate() {
        let (mut entry, config) = archive.new_file(format!("series/{i}.dcm")).start().unwrap();
        let mut writer = config.wrap(&mut entry);
        std::io::Write::write_all(&mut writer, &slice(z)).unwrap();
        let (_, descriptor) = writer.finish().unwrap();
        entry.finish(descriptor).unwrap();
    }
    let path = series.path().join("series.zip");
    fs::write(&path, archive.finish().unwrap()).unwrap();
    let zipped = opened(&path);
    assert_eq!((values(&zipped), zipped.spacing()), (values(&volume), volume.spacing()));
}

/// The window is of values, after the rescale. The first of several counts, and that of the middle slice.
#[test]
fn the_window_of_a_series_is_that_of_its_middle_slice() {
    const CENTER: (u16, u16) = (0x0028, 0x1050);
    const WIDTH: (u16, u16) = (0x0028, 0x1051);
    let place = |z: f64| {
        vec![
            decimals(POSITION, &[0.0, 0.0, z]),
            decimals(ORIENTATION, &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0]),
            decimals(SPACING, &[1.0, 1.0]),
            decimals((0x0028, 0x1052), &[-10.0]),
            decimals((0x0028, 0x1053), &[2.0]),
        ]
    };
    let window = |center: &[f64], width: &[f64]| vec![decimals(CENTER, center), decimals(WIDTH, width)];
    let of = |more: [Vec<Vec<u8>>; 3]| {
        let slice = |(k, more): (usize, Vec<Vec<u8>>)| {
            (["a", "b", "c"][k], file(PLAIN, [more, place(k as f64)].concat(), &[100 * k as u16]))
        };
        let files: Vec<_> = more.into_iter().enumerate().map(slice).collect();
        opened(folder(&files).path()).info.window
    };
    let [low, middle, high] =
        [window(&[10.0], &[4.0]), window(&[150.0, 40.0], &[200.0, 80.0]), window(&[900.0], &[2.0])];
    assert_eq!(of([low.clone(), middle.clone(), high.clone()]), Some((50.0, 250.0)));
    assert_eq!(of([vec![], vec![], vec![]]), None);
    // A width of zero, half a window, and values that are inverted are no window.
    assert_eq!(of([low.clone(), window(&[150.0], &[0.0]), high.clone()]), None);
    assert_eq!(of([low.clone(), vec![decimals(CENTER, &[150.0])], high.clone()]), None);
    let white = || vec![text((0x0028, 0x0004), "CS", "MONOCHROME1")];
    let inverted = [low, [middle, white()].concat(), high].map(|more| [more, white()].concat());
    assert_eq!(of(inverted), None);
    // The frames of an enhanced file have it in a sequence.
    let frame = |center: f64| vec![sequence((0x0028, 0x9132), &[window(&[center], &[20.0])])];
    let frames: Vec<_> = [100.0, 200.0, 300.0].map(frame).to_vec();
    let file = file(PLAIN, [place(0.0), vec![sequence((0x5200, 0x9230), &frames)]].concat(), &[1, 2, 3]);
    let one = folder(&[("enhanced", file)]);
    assert_eq!(opened(one.path()).info.window, Some((190.0, 210.0)));
}
