//! Folders of DICOM slices: each page holds the voxels of the whole series.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

#[allow(dead_code, reason = "other tests use the rest")]
#[path = "support/dicom.rs"]
mod dicom;
#[path = "support/paging.rs"]
mod paging;

use std::fs;

use dicom::{PLAIN, decimals, element, text as words, with_pixels};
use isinglass_core::volume::{PageError, PageId};
use isinglass_formats::{OpenOptions, Selection, open_paged};
use paging::{check_pages, text};
use tempfile::TempDir;

const RUN_LENGTHS: &str = "1.2.840.10008.1.2.5";
const COLUMNS: usize = 75;
const ROWS: usize = 67;

/// How a series differs from a plain one.
#[derive(Clone, Copy)]
struct Kind {
    syntax: &'static str,
    /// Bits that are stored of 16, at the top.
    bits: u16,
    samples: usize,
    num_times: usize,
    /// The place of slice k, in mm.
    place: fn(usize) -> f64,
    slope: fn(usize) -> f64,
    padding: Option<[i16; 2]>,
}

const KIND: Kind = Kind {
    syntax: PLAIN,
    bits: 16,
    samples: 1,
    num_times: 1,
    place: |k| 2.0 * k as f64,
    slope: |_| 1.0,
    padding: None,
};
const DEPTH: usize = 70;

fn number(x: usize, y: usize, z: usize) -> i16 {
    let far = x.abs_diff(37).pow(2) + y.abs_diff(33).pow(2);
    if far > 900 {
        -2000 + (x % 40) as i16
    } else {
        ((x * 7 + y * 31 + z * 101 + (x * y + z) % 13) % 251) as i16
    }
}

/// Pixels after their element, plain or in run lengths (PS3.5, annex G) of literal bytes.
fn pixels(bytes: &[u8], kind: &Kind) -> Vec<u8> {
    if kind.syntax == PLAIN {
        return element((0x7fe0, 0x0010), "OW", bytes);
    }
    let size = bytes.len() / (COLUMNS * ROWS) / kind.samples;
    let mut head = vec![(size * kind.samples) as u32];
    let mut data: Vec<u8> = Vec::new();
    for (sample, byte) in (0..kind.samples).flat_map(|s| (0..size).rev().map(move |b| (s, b))) {
        head.push(64 + data.len() as u32);
        let plane: Vec<u8> =
            bytes.chunks(size * kind.samples).map(|pixel| pixel[sample * size + byte]).collect();
        data.extend(plane.chunks(128).flat_map(|run| [&[run.len() as u8 - 1][..], run].concat()));
        data.resize(data.len().next_multiple_of(2), 0);
    }
    head.resize(16, 0);
    let frame = [head.iter().flat_map(|n| n.to_le_bytes()).collect(), data].concat();
    let item =
        |bytes: &[u8]| [&[0xfe, 0xff, 0x00, 0xe0][..], &(bytes.len() as u32).to_le_bytes(), bytes].concat();
    let start = [&[0xe0, 0x7f, 0x10, 0x00][..], b"OB\0\0", &[0xff; 4]].concat();
    [start, item(&[]), item(&frame), vec![0xfe, 0xff, 0xdd, 0xe0, 0, 0, 0, 0]].concat()
}

fn series(kind: Kind) -> TempDir {
    let folder = TempDir::new().unwrap();
    let short = |number, value: u16| element((0x0028, number), "US", &value.to_le_bytes());
    for (t, z) in (0..kind.num_times).flat_map(|t| (0..DEPTH).map(move |z| (t, z))) {
        let bytes_each = if kind.samples == 3 { 1 } else { 2 };
        let mut elements = vec![
            decimals((0x0020, 0x0032), &[0.0, 0.0, (kind.place)(z)]),
            decimals((0x0020, 0x0037), &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0]),
            words((0x0020, 0x0100), "IS", &(t + 1).to_string()),
            decimals((0x0028, 0x0030), &[1.0, 1.0]),
            decimals((0x0028, 0x1052), &[-10.0]),
            decimals((0x0028, 0x1053), &[(kind.slope)(z)]),
            short(0x02, kind.samples as u16),
            short(0x10, ROWS as u16),
            short(0x11, COLUMNS as u16),
            short(0x100, 8 * bytes_each),
            short(0x101, if bytes_each == 1 { 8 } else { kind.bits }),
            short(0x102, 8 * bytes_each - 1),
            short(0x103, u16::from(bytes_each == 2)),
        ];
        if kind.samples == 3 {
            elements.extend([words((0x0028, 0x0004), "CS", "RGB"), short(0x06, 0)]);
        }
        for (number, value) in
            kind.padding.into_iter().flat_map(|ends| [0x0120, 0x0121].into_iter().zip(ends))
        {
            elements.push(element((0x0028, number), "SS", &value.to_le_bytes()));
        }
        let mut bytes = Vec::new();
        for i in 0..COLUMNS * ROWS {
            for s in 0..kind.samples {
                let number = number(i % COLUMNS, i / COLUMNS, z + 3 * t + 5 * s);
                match bytes_each {
                    1 => bytes.push(number as u8),
                    _ => bytes.extend((number << (16 - kind.bits)).to_le_bytes()),
                }
            }
        }
        let file = with_pixels(kind.syntax, elements, &pixels(&bytes, &kind));
        fs::write(folder.path().join(format!("{:03}_{t}", z * 37 % 101)), file).unwrap();
    }
    folder
}

#[test]
fn pages_of_every_kind_of_series_are_those_of_the_volume() {
    for (name, kind) in [
        ("plain", KIND),
        ("12 bits", Kind { bits: 12, ..KIND }),
        ("run lengths", Kind { syntax: RUN_LENGTHS, ..KIND }),
        ("padding", Kind { padding: Some([-1900, -2000]), ..KIND }),
        ("slopes", Kind { slope: |z| 1.0 + (z % 3) as f64, ..KIND }),
        (
            "slopes and padding",
            Kind { slope: |z| 1.0 + (z % 3) as f64, padding: Some([-2000, -1900]), ..KIND },
        ),
        ("missing slices", Kind { place: |z| 2.0 * (z + z / 30) as f64, ..KIND }),
        ("blocks", Kind { place: |z| 2.0 * (z + z / 30 * 9) as f64, padding: Some([-2000, -1900]), ..KIND }),
        ("blocks without padding", Kind { place: |z| 2.0 * (z + z / 30 * 9) as f64, ..KIND }),
        ("colours", Kind { samples: 3, ..KIND }),
        ("colours in run lengths", Kind { samples: 3, syntax: RUN_LENGTHS, ..KIND }),
    ] {
        let folder = series(kind);
        let paged = check_pages(folder.path(), &OpenOptions::default());
        assert_eq!(paged.source.pyramid().levels.len(), 2, "{name}");
    }
}

#[test]
fn times_and_parts_of_a_series_are_read_by_pages() {
    let folder = series(Kind { num_times: 2, syntax: RUN_LENGTHS, ..KIND });
    for time in [0, 1] {
        let region = Some("3:,:60,1:69".parse().unwrap());
        for region in [None, region] {
            let selection = Selection { time: Some(time), region, ..Selection::default() };
            check_pages(folder.path(), &OpenOptions { selection, ..OpenOptions::default() });
        }
    }
}

#[test]
fn a_damaged_slice_is_an_error_of_its_pages() {
    let folder = series(Kind { syntax: RUN_LENGTHS, ..KIND });
    // Slice 69 is in the last page only, and not in the base. Its run lengths have too many parts.
    let path = folder.path().join(format!("{:03}_0", 69 * 37 % 101));
    let whole = fs::read(&path).unwrap();
    let mut bad = whole.clone();
    let item = bad.windows(4).rposition(|bytes| bytes == [0xfe, 0xff, 0x00, 0xe0]).unwrap();
    bad[item + 8] = 99;
    fs::write(&path, &bad).unwrap();
    let paged = open_paged(text(folder.path()), &OpenOptions::default()).unwrap();
    let read = |z| paged.source.read(0, PageId { level: 0, at: [0, 0, z] });
    let found = read(1).unwrap_err();
    assert!(matches!(&found, PageError::Damaged(text) if text.lines().count() == 1), "{found}");
    fs::write(&path, &whole).unwrap();
    read(1).unwrap();
}
