//! NumPy arrays with axes of one entry, and archives of several.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::fs;
use std::path::{Path, PathBuf};

use isinglass_formats::{OpenOptions, Outline, Selection, open, outline};
use tempfile::TempDir;

/// A `.npy` of bytes that count up from `first`.
fn array(shape: &[usize], first: u8) -> Vec<u8> {
    let shape: Vec<String> = shape.iter().map(usize::to_string).collect();
    let text = format!("{{'descr': '|u1', 'fortran_order': False, 'shape': ({},)}}", shape.join(", "));
    let header = format!("{text:<117}\n");
    let count: usize = shape.iter().map(|n| n.parse::<usize>().unwrap()).product();
    let numbers: Vec<u8> = (0..count).map(|i| first.wrapping_add(i as u8)).collect();
    let start = [b"\x93NUMPY\x01\x00".as_slice(), &(header.len() as u16).to_le_bytes(), header.as_bytes()];
    [&start.concat(), &numbers[..]].concat()
}

/// A `.zip` of uncompressed files (APPNOTE 4.3).
fn zip(files: &[(&str, Vec<u8>)]) -> Vec<u8> {
    let (mut bytes, mut directory) = (Vec::new(), Vec::new());
    for (name, data) in files {
        let (at, size) = (bytes.len() as u32, data.len() as u32);
        // Flags, method, time, date, checksum, sizes, lengths of the name and the extra field.
        let mut common = vec![0; 12];
        common.extend([size, size].iter().flat_map(|n| n.to_le_bytes()));
        common.extend([name.len() as u16, 0].iter().flat_map(|n| n.to_le_bytes()));
        bytes.extend(b"PK\x03\x04\x14\0");
        bytes.extend(&common);
        bytes.extend(name.as_bytes());
        bytes.extend(data);
        directory.extend(b"PK\x01\x02\x14\0\x14\0");
        directory.extend(&common);
        directory.extend([0; 10]);
        directory.extend(at.to_le_bytes());
        directory.extend(name.as_bytes());
    }
    let (at, size, count) = (bytes.len() as u32, directory.len() as u32, files.len() as u16);
    bytes.extend(directory);
    bytes.extend(b"PK\x05\x06\0\0\0\0");
    bytes.extend([count, count].iter().flat_map(|n| n.to_le_bytes()));
    bytes.extend([size, at].iter().flat_map(|n| n.to_le_bytes()));
    bytes.extend([0; 2]);
    bytes
}

fn save(folder: &Path, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.join(name);
    fs::write(&path, bytes).unwrap();
    path
}

fn outline_of(path: &Path) -> Outline {
    outline(path.to_str().unwrap(), &OpenOptions::default()).unwrap_or_else(|e| panic!("{e}"))
}

/// Dimensions, the first voxel and the warnings.
fn opened(path: &Path, channel: Option<u32>) -> ([u32; 3], f32, String) {
    let selection = Selection { channel, ..Selection::default() };
    let options = OpenOptions { selection, ..OpenOptions::default() };
    let volume = open(path.to_str().unwrap(), &options).unwrap_or_else(|e| panic!("{e}"));
    (volume.dims(), volume.voxels().get(0), volume.info.warnings.join("\n"))
}

#[test]
fn axes_of_one_entry_say_nothing() {
    let folder = TempDir::new().unwrap();
    for shape in [&[1, 3, 5, 6][..], &[3, 5, 6, 1], &[1, 3, 5, 6, 1], &[1, 1, 3, 5, 6], &[3, 5, 6, 1, 1]] {
        let before = outline_of(&save(folder.path(), "a.npy", &array(shape, 0)));
        assert_eq!((before.dims, before.num_channels, before.num_times), ([6, 5, 3], 1, 1), "{shape:?}");
    }
    // A single slice stays one.
    assert_eq!(outline_of(&save(folder.path(), "a.npy", &array(&[1, 5, 6], 0))).dims, [6, 5, 1]);
}

#[test]
fn the_largest_array_of_an_archive_is_shown() {
    let folder = TempDir::new().unwrap();
    let files = [
        ("affine.npy", array(&[20, 20], 1)),
        ("mask.npy", array(&[2, 3, 4], 2)),
        ("image.npy", array(&[3, 5, 6], 3)),
        ("label.npy", array(&[3, 5, 6], 4)),
    ];
    let path = save(folder.path(), "a.npz", &zip(&files));
    let (dims, first, warnings) = opened(&path, None);
    assert_eq!((dims, first), ([6, 5, 3], 3.0));
    let text = "the file has 4 channels (affine, mask, image, label), of which 2 is shown";
    assert!(warnings.contains(text), "{warnings}");
    assert_eq!(outline_of(&path).shown.channel, Some(2));
    assert_eq!(opened(&path, Some(1)).1, 2.0);
    // The channels are those of the largest array.
    let files = [("table.npy", array(&[7, 7], 1)), ("image.npy", array(&[2, 3, 5, 6], 3))];
    let path = save(folder.path(), "b.npz", &zip(&files));
    let (dims, first, warnings) = opened(&path, Some(1));
    assert_eq!((dims, first), ([6, 5, 3], 93.0));
    assert!(warnings.contains("image is the largest array; others are not shown: table"), "{warnings}");
}

#[test]
fn encrypted_and_damaged_archives_are_refused_in_one_line() {
    let folder = TempDir::new().unwrap();
    let message = |bytes: &[u8]| {
        let path = save(folder.path(), "a.npz", bytes);
        outline(path.to_str().unwrap(), &OpenOptions::default()).map(drop).map_err(|e| e.to_string())
    };
    let good = zip(&[("image.npy", array(&[3, 5, 6], 3))]);
    assert_eq!(message(&good), Ok(()));
    let directory = good.windows(4).position(|w| w == b"PK\x01\x02").unwrap();
    let mut encrypted = good.clone();
    encrypted[directory + 8] |= 1;
    assert!(message(&encrypted).unwrap_err().ends_with("ZIP archive: it is encrypted"));
    let mut moved = good.clone();
    moved[directory + 42] = 9;
    for damaged in [&moved, &good[..directory + 20].to_vec()] {
        let e = message(damaged).unwrap_err();
        assert!(e.contains("a.npz: ZIP archive: ") && !e.contains('\n'), "{e}");
    }
}
