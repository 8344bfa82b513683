//! TIFF of every layout: each page holds the voxels of the whole volume, and these are the numbers of the file.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

#[path = "support/paging.rs"]
mod paging;
#[path = "support/tiff.rs"]
mod tiff;

use std::fs;
use std::path::{Path, PathBuf};

use isinglass_core::volume::{PageError, PageId, Volume};
use isinglass_formats::{Flip, OpenOptions, Selection, open, open_paged};
use paging::{check_pages, text};
use tempfile::TempDir;
use tiff::{Layout, TiffPage, tiff_file};

const SIDES: [usize; 2] = [75, 67];
const DEPTH: usize = 70;

fn number(x: usize, y: usize, z: usize) -> u64 {
    ((x * 7 + y * 31 + z * 101 + (x * y + z) % 13) % 251) as u64
}

/// A number of so many bytes and this format, and its value.
fn encoded(number: u64, bytes_each: usize, format: u32) -> (Vec<u8>, f32) {
    let signed = number as i64 - 100;
    match (bytes_each, format) {
        (2, 3) => (half::f16::from_f32(signed as f32 / 4.0).to_le_bytes().to_vec(), signed as f32 / 4.0),
        (4, 3) => ((signed as f32 / 3.0).to_le_bytes().to_vec(), signed as f32 / 3.0),
        (8, 3) => ((signed as f64 / 4.0).to_le_bytes().to_vec(), signed as f32 / 4.0),
        (size, 2) => ((signed / 2).to_le_bytes()[..size].to_vec(), (signed / 2) as f32),
        (size, _) => (number.to_le_bytes()[..size].to_vec(), number as f32),
    }
}

/// Pages of these slices, and the values of their numbers. Samples differ by 50.
fn pages(
    slices: impl Iterator<Item = usize>,
    samples: usize,
    bytes_each: usize,
    format: u32,
) -> (Vec<TiffPage>, Vec<f32>) {
    let (mut pages, mut values) = (Vec::new(), Vec::new());
    for z in slices {
        let mut bytes = Vec::new();
        for i in 0..SIDES[0] * SIDES[1] {
            for s in 0..samples as u64 {
                let number = (number(i % SIDES[0], i / SIDES[0], z) + 50 * s) % 256;
                let (word, value) = encoded(number, bytes_each, format);
                bytes.extend(word);
                values.push(value);
            }
        }
        pages.push(TiffPage::new(SIDES, bytes_each, format, bytes));
    }
    (pages, values)
}

fn values(volume: &Volume) -> Vec<f32> {
    (0..volume.voxels().len()).map(|i| volume.value_from_stored(volume.voxels().get(i))).collect()
}

fn write(folder: &Path, pages: &[TiffPage], layout: Layout) -> PathBuf {
    let path = folder.join("a.tif");
    fs::write(&path, tiff_file(pages, layout)).unwrap();
    path
}

const PLAIN: Layout = Layout {
    tile: None,
    rows: 16,
    packing: 0,
    predictor: 0,
    is_planar: false,
    is_big_endian: false,
    is_big: false,
    absent: None,
};

#[test]
fn pages_of_every_packing_and_layout_are_those_of_the_volume() {
    let folder = TempDir::new().unwrap();
    let types = [(1, 1), (1, 2), (2, 1), (2, 2), (2, 3), (4, 1), (4, 2), (4, 3), (8, 1), (8, 3)];
    let mut turn = 0;
    for packing in [0, 5, 8, 32_946, 32_773, 50_000] {
        for predictor in [1, 2, 3] {
            // PackBits and plain numbers have no predictor.
            if predictor > 1 && ![5, 8, 50_000].contains(&packing) {
                continue;
            }
            for is_tiled in [true, false] {
                turn += 1;
                let of_type = types[turn * 3 % types.len()];
                let (bytes_each, format) = if predictor == 3 { ([2, 4, 8][turn % 3], 3) } else { of_type };
                let layout = Layout {
                    tile: is_tiled.then_some([[32, 48], [80, 80], [16, 16]][turn % 3]),
                    rows: [16, 67, 1][turn % 3],
                    packing,
                    predictor,
                    is_big_endian: turn.is_multiple_of(2),
                    is_big: turn % 4 > 1,
                    ..PLAIN
                };
                let (pages, expected) = pages(0..DEPTH, 1, bytes_each, format);
                let path = write(folder.path(), &pages, layout);
                let options = OpenOptions::default();
                let whole = open(text(&path), &options).unwrap_or_else(|e| panic!("{layout:?}: {e}"));
                assert_eq!(values(&whole), expected, "{layout:?} {bytes_each} {format}");
                check_pages(&path, &options);
            }
        }
    }
}

#[test]
fn colours_parts_and_mirrored_axes_are_those_of_the_volume() {
    let folder = TempDir::new().unwrap();
    let (pages, expected) = pages(0..DEPTH, 3, 1, 1);
    for is_planar in [false, true] {
        for (packing, tile) in [(8, Some([32, 32])), (5, None), (0, Some([48, 16])), (0, None)] {
            let layout =
                Layout { packing, tile, is_planar, predictor: if packing > 0 { 2 } else { 1 }, ..PLAIN };
            let path = write(folder.path(), &pages, layout);
            let whole = open(text(&path), &OpenOptions::default()).unwrap();
            for (c, channel) in whole.channels().enumerate() {
                let own: Vec<f32> = expected.iter().skip(c).step_by(3).copied().collect();
                assert_eq!(values(channel), own, "{layout:?} {c}");
            }
            check_pages(&path, &OpenOptions::default());
            let region = Some("3:70,:66,2:".parse().unwrap());
            let selection = Selection {
                channel: Some(1),
                region,
                flip: Flip([true, false, true]),
                ..Selection::default()
            };
            check_pages(&path, &OpenOptions { selection, ..OpenOptions::default() });
        }
    }
}

#[test]
fn channels_and_times_of_packed_hyperstacks_are_read_by_pages() {
    let folder = TempDir::new().unwrap();
    let (mut pages, expected) = pages(0..4 * 35, 1, 2, 1);
    pages[0].description = Some(
        "ImageJ=1.54f\nimages=140\nchannels=2\nslices=35\nframes=2\nhyperstack=true\norder=zct\n".into(),
    );
    let path =
        write(folder.path(), &pages, Layout { packing: 8, predictor: 2, tile: Some([32, 32]), ..PLAIN });
    let in_stack = SIDES[0] * SIDES[1] * 35;
    for (channel, time) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
        let selection = Selection { channel: Some(channel), time: Some(time), ..Selection::default() };
        let options = OpenOptions { selection, ..OpenOptions::default() };
        let first = (2 * time + channel) as usize * in_stack;
        assert_eq!(values(&open(text(&path), &options).unwrap()), expected[first..first + in_stack]);
        check_pages(&path, &options);
    }
    let selection = Selection { time: Some(1), ..Selection::default() };
    check_pages(&path, &OpenOptions { selection, ..OpenOptions::default() });
}

#[test]
fn slices_in_files_are_read_by_pages() {
    let folder = TempDir::new().unwrap();
    let (pages, expected) = pages(0..DEPTH, 1, 2, 1);
    for (z, page) in pages.iter().enumerate() {
        // The files have different writers.
        let (packing, is_big_endian) = ([0, 8, 5][z % 3], z % 2 == 1);
        let layout = Layout { packing, is_big_endian, tile: (z % 5 == 0).then_some([16, 32]), ..PLAIN };
        fs::write(folder.path().join(format!("s{z}.tif")), tiff_file(std::slice::from_ref(page), layout))
            .unwrap();
    }
    let whole = open(text(folder.path()), &OpenOptions::default()).unwrap();
    assert_eq!(values(&whole), expected);
    check_pages(folder.path(), &OpenOptions::default());
}

#[test]
fn white_as_the_least_and_absent_parts_are_as_in_the_volume() {
    let folder = TempDir::new().unwrap();
    let (mut pages, expected) = pages(0..DEPTH, 1, 1, 1);
    pages.iter_mut().for_each(|page| page.photometric = 0);
    for layout in [PLAIN, Layout { packing: 5, ..PLAIN }] {
        let path = write(folder.path(), &pages, layout);
        let inverted: Vec<f32> = expected.iter().map(|x| 255.0 - x).collect();
        assert_eq!(values(&open(text(&path), &OpenOptions::default()).unwrap()), inverted);
        check_pages(&path, &OpenOptions::default());
    }
    pages.iter_mut().for_each(|page| page.photometric = 1);
    let layout = Layout { packing: 8, absent: Some(1), ..PLAIN };
    let path = write(folder.path(), &pages, layout);
    let at = |i: usize| (16..32).contains(&(i / SIDES[0] % SIDES[1]));
    let sparse: Vec<f32> = expected.iter().enumerate().map(|(i, x)| if at(i) { 0.0 } else { *x }).collect();
    assert_eq!(values(&open(text(&path), &OpenOptions::default()).unwrap()), sparse);
    check_pages(&path, &OpenOptions::default());
}

#[test]
fn what_is_damaged_or_too_large_is_told() {
    let folder = TempDir::new().unwrap();
    let (pages, _) = pages(0..DEPTH, 1, 1, 1);
    let layout = Layout { packing: 8, tile: Some([80, 80]), ..PLAIN };
    let path = write(folder.path(), &pages, layout);
    let good = fs::read(&path).unwrap();
    let mut bad = good.clone();
    // The header of zlib in the tile of slice 1, which the base has not read. It follows all of slice 0.
    let first = tiff_file(&pages[..1], layout).len();
    let at = first + first % 2 + 2;
    bad[at..at + 4].fill(0xff);
    fs::write(&path, &bad).unwrap();
    let paged = open_paged(text(&path), &OpenOptions::default()).unwrap();
    let read = |at| paged.source.read(0, PageId { level: 0, at });
    let found = read([0; 3]).unwrap_err();
    let place = format!("strip or tile at byte {at}");
    assert!(matches!(&found, PageError::Damaged(text) if text.contains(&place)), "{found}");
    assert!(open(text(&path), &OpenOptions::default()).is_err());
    // The control: pages without it are whole.
    read([0, 0, 1]).unwrap();
    fs::write(&path, &good).unwrap();
    read([0; 3]).unwrap();
    // Cut at any place, a file is an error and nothing more.
    for cut in (0..good.len()).step_by(good.len() / 97) {
        fs::write(&path, &good[..cut]).unwrap();
        let _ = open_paged(text(&path), &OpenOptions::default());
        assert!(open(text(&path), &OpenOptions::default()).is_err(), "{cut}");
    }
    // Another packing is named, in the header already.
    let mut jpeg = pages;
    jpeg.truncate(1);
    let mut file = tiff_file(&jpeg, PLAIN);
    let entry = [259u16.to_le_bytes(), 3u16.to_le_bytes(), [1, 0], [0, 0], [1, 0]].concat();
    let at = file.windows(entry.len()).position(|w| w == entry).unwrap();
    file[at + 8] = 7;
    fs::write(&path, &file).unwrap();
    let message = open(text(&path), &OpenOptions::default()).unwrap_err().to_string();
    assert!(message.contains("packed as JPEG (compression 7), expected none, LZW"), "{message}");
}

#[test]
fn a_volume_beyond_the_memory_opens_by_pages() {
    let folder = TempDir::new().unwrap();
    let side = 1024;
    let slice: Vec<u8> = (0..side * side).map(|i| number(i % side, i / side, 0) as u8).collect();
    let page = TiffPage::new([side; 2], 1, 1, slice.clone());
    let layout = Layout { packing: 8, tile: Some([128, 128]), ..PLAIN };
    let file = tiff_file(&[page], layout);
    for z in 0..160 {
        fs::write(folder.path().join(format!("z{z}.tif")), &file).unwrap();
    }
    let options = OpenOptions { max_bytes: 128 << 20, by_pages: true, ..OpenOptions::default() };
    let volume = open(text(folder.path()), &options).unwrap();
    let paging = volume.paging().expect("it does not fit");
    let page = paging.source.read(0, PageId { level: 0, at: [3, 2, 1] }).unwrap();
    // The points of a page begin two before its cells.
    let expected: Vec<f32> = (190..250).map(|x| slice[126 * side + x].into()).collect();
    assert_eq!((0..60).map(|i| page.voxels.get(i)).collect::<Vec<_>>(), expected);
    // The control: whole, it is too large.
    let whole = OpenOptions { by_pages: false, ..options };
    assert!(open(text(folder.path()), &whole).is_err());
}
