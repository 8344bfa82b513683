//! Every page of every level holds the voxels that the level has when it is opened whole.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

#[path = "support/paging.rs"]
mod paging;
mod support;
#[path = "support/zarr.rs"]
mod zarr;

use std::fs;
use std::path::{Path, PathBuf};

use glam::Vec3;
use isinglass_core::volume::{PAGE_POINTS, PageError, PageId};
use isinglass_formats::{
    Dtype, Endian, Flip, FormatError, OpenOptions, RawShape, Selection, open, open_paged,
};
use paging::{check_pages, is_part, places, text};
use tempfile::TempDir;
use zarr::{ArrayText, Packing, write_image};

/// Different numbers at all places near each other.
fn number(x: u64, y: u64, z: u64) -> u64 {
    (x * 7 + y * 31 + z * 101 + (x * y + z) % 13) % 251
}

const DIMS: [u32; 3] = [70, 67, 131];

fn bytes_of(dtype: Dtype, endian: Endian, value: u64) -> Vec<u8> {
    let signed = value as i64 - 100;
    let mut bytes = match dtype {
        Dtype::Uint8 => vec![value as u8],
        Dtype::Int8 => vec![(signed / 2) as i8 as u8],
        Dtype::Uint16 => (value as u16 * 200).to_le_bytes().to_vec(),
        Dtype::Int16 => (signed as i16 * 100).to_le_bytes().to_vec(),
        Dtype::Uint32 => (value as u32 * 70_001).to_le_bytes().to_vec(),
        Dtype::Int32 => (signed as i32 * 70_001).to_le_bytes().to_vec(),
        Dtype::Uint64 => (value * 70_000_001).to_le_bytes().to_vec(),
        Dtype::Int64 => (signed * 70_000_001).to_le_bytes().to_vec(),
        Dtype::Half => half::f16::from_f32(signed as f32 / 4.0).to_le_bytes().to_vec(),
        Dtype::Float => (signed as f32 / 3.0).to_le_bytes().to_vec(),
        Dtype::Double => (signed as f64 / 3.0).to_le_bytes().to_vec(),
    };
    if endian == Endian::Big {
        bytes.reverse();
    }
    bytes
}

/// All numbers of a volume of `dims`, x fastest.
fn numbers(dims: [u32; 3], dtype: Dtype, endian: Endian) -> Vec<u8> {
    let [nx, ny, nz] = dims.map(u64::from);
    (0..nx * ny * nz)
        .flat_map(|i| bytes_of(dtype, endian, number(i % nx, i / nx % ny, i / nx / ny)))
        .collect()
}

fn raw(dims: [u32; 3], dtype: Dtype, endian: Endian) -> RawShape {
    RawShape { dims, dtype, spacing: Vec3::new(1.0, 2.0, 3.0), endian, offset: 0 }
}

#[test]
fn pages_of_raw_files_of_every_type_are_those_of_the_volume() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("a.raw");
    for dtype in Dtype::ALL {
        for endian in [Endian::Little, Endian::Big] {
            fs::write(&path, numbers(DIMS, dtype, endian)).unwrap();
            let options = OpenOptions { raw: Some(raw(DIMS, dtype, endian)), ..OpenOptions::default() };
            check_pages(&path, &options);
        }
    }
    // The last file again, mirrored and in part.
    let shape = raw(DIMS, Dtype::Double, Endian::Big);
    for flip in (0..8).map(|signs| Flip([0, 1, 2].map(|k| signs >> k & 1 == 1))) {
        for region in [None, Some("3:,1:67,2:130".parse().unwrap())] {
            let selection = Selection { flip, region, ..Selection::default() };
            check_pages(&path, &OpenOptions { raw: Some(shape), selection, ..OpenOptions::default() });
        }
    }
    // The control: the next page has other voxels.
    let options = OpenOptions { raw: Some(shape), ..OpenOptions::default() };
    let paged = open_paged(text(&path), &options).unwrap();
    let whole = open(text(&path), &options).unwrap();
    let page = paged.source.read(0, PageId { level: 0, at: [0, 0, 1] }).unwrap();
    assert!(is_part(&page, &whole, [0, 0, 62]) && !is_part(&page, &whole, [0, 0, 0]));
    let none = paged.source.read(0, PageId { level: 0, at: [0, 0, 3] }).unwrap_err();
    assert!(matches!(none, PageError::Damaged(text) if text.contains("no page")));
}

fn nrrd(path: &Path, dims: [u32; 3], kind: &str, more: &str, data: &[u8]) {
    let [x, y, z] = dims;
    let header = format!(
        "NRRD0004\ntype: {kind}\ndimension: 3\nsizes: {x} {y} {z}\nencoding: raw\nendian: little\n\
         space: left-posterior-superior\nspace directions: (0,0,1.5) (1,0,0) (0,-2,0)\nspace origin: (1,2,3)\n{more}\n"
    );
    fs::write(path, [header.as_bytes(), data].concat()).unwrap();
}

#[test]
fn axes_in_another_order_and_gaps_are_as_in_the_volume() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("a.nrrd");
    let options = OpenOptions::default();
    let [nx, ny, nz] = DIMS.map(|n| n as usize);
    let plain: Vec<f32> = (0..nx * ny * nz)
        .map(|i| number((i % nx) as u64, (i / nx % ny) as u64, (i / nx / ny) as u64) as f32)
        .collect();
    let bytes = |v: &[f32]| -> Vec<u8> { v.iter().flat_map(|x| x.to_le_bytes()).collect() };
    nrrd(&path, DIMS, "float", "", &bytes(&plain));
    let paged = check_pages(&path, &options);
    assert_eq!(paged.base.finest().unwrap().dims, [67, 131, 70], "the axes are in another order");
    // Balls of what is not known, on both sides of a border of pages.
    let in_ball = |i: usize| {
        let at = [i % nx, i / nx % ny, i / nx / ny];
        let far = |center: [usize; 3]| (0..3).map(|k| at[k].abs_diff(center[k]).pow(2)).sum::<usize>();
        far([64, 40, 64]) < 150 || at[2] < 3
    };
    for mark in [f32::NAN, -9999.0, 1e30] {
        let marked: Vec<f32> =
            plain.iter().enumerate().map(|(i, x)| if in_ball(i) { mark } else { *x }).collect();
        nrrd(&path, DIMS, "float", "", &bytes(&marked));
        let paged = check_pages(&path, &options);
        let num_gaps: usize = places(&*paged.source, 0)
            .map(|at| paged.source.read(0, PageId { level: 0, at }).unwrap())
            .map(|page| page.gaps.map_or(0, |gaps| gaps.iter().filter(|gap| **gap != 0).count()))
            .sum();
        assert!(num_gaps > 1000, "{mark}: {num_gaps}");
    }
    // A circle of CT: whole numbers of an integer type.
    let ct: Vec<u8> = (0..nx * ny * nz)
        .flat_map(|i| (if in_ball(i) { -3024i16 } else { plain[i] as i16 * 12 - 1000 }).to_le_bytes())
        .collect();
    nrrd(&path, DIMS, "short", "", &ct);
    let paged = check_pages(&path, &options);
    assert!(paged.base.gaps().is_some());
    // In a raw file, what is no number is a damage.
    let raw_path = folder.path().join("b.raw");
    let mut odd = bytes(&plain);
    odd[..4].copy_from_slice(&f32::NAN.to_le_bytes());
    odd[400..404].copy_from_slice(&f32::NAN.to_le_bytes());
    odd[..4].copy_from_slice(&1f32.to_le_bytes());
    fs::write(&raw_path, odd).unwrap();
    let options = OpenOptions { raw: Some(raw(DIMS, Dtype::Float, Endian::Little)), ..options };
    // Of the base, number 100 is no part: it is x 30 of row 1.
    let paged = open_paged(text(&raw_path), &options).unwrap();
    let found = paged.source.read(0, PageId { level: 0, at: [0; 3] }).unwrap_err();
    assert!(matches!(&found, PageError::Damaged(text) if text.contains("1 voxels are NaN")), "{found}");
}

/// An image of two channels at two times, in three levels of means.
fn image(folder: &Path, packing: Packing, chunk: [u64; 5], dtype: &str) {
    let dims = [150u64, 131, 70];
    let factors = [[1u64, 1, 1], [2, 2, 1], [4, 4, 2]];
    let levels: Vec<(Vec<f64>, Vec<f64>)> = factors
        .iter()
        .map(|f| {
            let [x, y, z] = f.map(|f| f as f64);
            let scale = vec![1.0, 1.0, 2.0 * z, y, x];
            (scale, vec![0.0, 0.0, z - 1.0, (y - 1.0) / 2.0, (x - 1.0) / 2.0])
        })
        .collect();
    write_image(folder, &["t", "c", "z", "y", "x"], &levels, "");
    for (i, f) in factors.iter().enumerate() {
        let shape = [2, 2, dims[2] / f[2], dims[1] / f[1], dims[0] / f[0]];
        let array = ArrayText { shape: &shape, chunk: &chunk, dtype, packing };
        array.write(&folder.join(i.to_string()), |at| {
            let value = number(at[4] * f[0] + 3 * at[0], at[3] * f[1] + 5 * at[1], at[2] * f[2]);
            match dtype {
                "|u1" => vec![value as u8],
                ">u2" => (value as u16 * 9).to_be_bytes().to_vec(),
                _ => (value as f32 / 7.0).to_le_bytes().to_vec(),
            }
        });
    }
}

#[test]
fn pages_of_every_level_channel_and_time_of_an_image_are_those_of_the_level() {
    for (packing, chunk, dtype) in [
        (Packing::Raw, [1, 1, 32, 32, 32], "|u1"),
        (Packing::Zstd, [1, 2, 40, 64, 50], ">u2"),
        (Packing::Blosc, [1, 1, 1, 200, 200], "<f4"),
    ] {
        let folder = TempDir::new().unwrap();
        image(folder.path(), packing, chunk, dtype);
        for selection in [
            Selection::default(),
            Selection { channel: Some(1), time: Some(1), ..Selection::default() },
            Selection { flip: Flip([true, true, false]), channel: Some(0), ..Selection::default() },
        ] {
            let paged = check_pages(folder.path(), &OpenOptions { selection, ..OpenOptions::default() });
            let levels = &paged.source.pyramid().levels;
            assert_eq!(levels.iter().map(|l| l.factor).collect::<Vec<_>>(), [[1; 3], [2, 2, 1], [4, 4, 2]]);
            // Of 131 voxels along y, the last one is in no mean.
            let first = if selection.flip.0[1] { [0.5, 1.5, 0.0] } else { [0.5, 0.5, 0.0] };
            assert_eq!(levels[1].first, first);
            assert_eq!(paged.num_absent(), 0);
        }
        // A part of the finest level, in whose box the others lie.
        let region = "10:131,7:,4:69".parse().unwrap();
        let selection = Selection { region: Some(region), channel: Some(0), ..Selection::default() };
        let options = OpenOptions { selection, ..OpenOptions::default() };
        let paged = open_paged(text(folder.path()), &options).unwrap();
        let levels = paged.source.pyramid().levels.clone();
        assert_eq!(
            (levels[0].dims, levels[1].dims, levels[1].first),
            ([121, 124, 65], [60, 61, 65], [0.5, 1.5, 0.0])
        );
        for (level, part) in [(0, "10:131,7:,4:69"), (1, "5:65,4:,4:69")] {
            let region = Some(part.parse().unwrap());
            let selection = Selection { level: Some(level), region, ..selection };
            let whole = open(text(folder.path()), &OpenOptions { selection, ..options }).unwrap();
            for at in places(&*paged.source, level as usize) {
                let page = paged.source.read(0, PageId { level: level as u8, at }).unwrap();
                let first = levels[level as usize].first_point(at);
                assert!(is_part(&page, &whole, first), "{level} {at:?}");
            }
        }
    }
}

#[test]
fn a_channel_without_any_value_has_empty_pages_and_hides_no_other() {
    let folder = TempDir::new().unwrap();
    let dims = [70u64, 67, 66];
    let scale = |f: f64| (vec![1.0, f, f, f], vec![0.0, (f - 1.0) / 2.0, (f - 1.0) / 2.0, (f - 1.0) / 2.0]);
    write_image(folder.path(), &["c", "z", "y", "x"], &[scale(1.0), scale(2.0)], "");
    let write = |is_empty: &dyn Fn(&[u64]) -> bool| {
        for (level, f) in [(0, 1), (1, 2)] {
            let shape = [2, dims[2] / f, dims[1] / f, dims[0] / f];
            let array =
                ArrayText { shape: &shape, chunk: &[1, 32, 32, 32], dtype: "<f4", packing: Packing::Raw };
            array.write(&folder.path().join(level.to_string()), |at| {
                let value = number(at[3] * f, at[2] * f, at[1] * f) as f32;
                (if is_empty(at) { f32::NAN } else { value }).to_le_bytes().to_vec()
            });
        }
    };
    write(&|at| at[0] == 1);
    let paged = check_pages(folder.path(), &OpenOptions::default());
    let are_hidden: Vec<bool> = paged.base.channels().map(|channel| channel.info.channel.is_hidden).collect();
    assert_eq!(are_hidden, [false, true]);
    let index = paged.build_index(None, None).unwrap().index;
    assert_eq!((index.stored_range(0), index.stored_range(1)), ((0.0, 250.0), (0.0, 0.0)));
    // The control: a channel that has some values has gaps.
    write(&|at| at[0] == 1 && at[3] > 20);
    let paged = check_pages(folder.path(), &OpenOptions::default());
    assert!(paged.base.channels().all(|channel| !channel.info.channel.is_hidden));
    let page = paged.source.read(1, PageId { level: 0, at: [0; 3] }).unwrap();
    assert!(page.gaps.is_some());
}

#[test]
fn what_is_absent_has_its_fill_value_and_what_is_damaged_is_told() {
    let folder = TempDir::new().unwrap();
    image(folder.path(), Packing::Zstd, [1, 1, 32, 32, 32], "|u1");
    let selection = Selection { channel: Some(0), ..Selection::default() };
    let options = OpenOptions { selection, ..OpenOptions::default() };
    let chunk = |level: u32, z: u32, y: u32, x: u32| -> PathBuf {
        folder.path().join(format!("{level}/0/0/{z}/{y}/{x}"))
    };
    fs::remove_file(chunk(0, 0, 0, 0)).unwrap();
    fs::remove_file(chunk(0, 1, 0, 0)).unwrap();
    fs::write(chunk(0, 0, 0, 4), b"nonsense").unwrap();
    let paged = open_paged(text(folder.path()), &options).unwrap();
    let read = |x: u32| paged.source.read(0, PageId { level: 0, at: [x, 0, 0] });
    assert!(paged.index.is_none(), "not all of its pages can be read");
    let page = read(0).unwrap();
    assert_eq!((page.voxels.get(0), page.voxels.get(40)), (0.0, number(40, 0, 0) as f32));
    assert_eq!(paged.num_absent(), 2);
    read(0).unwrap();
    assert_eq!(paged.num_absent(), 2, "each counts once");
    // The page in the middle ends before the damaged chunk; the last one has it.
    let damaged = read(2).unwrap_err();
    let PageError::Damaged(message) = &damaged else { panic!("{damaged}") };
    assert!(message.contains("chunk") && message.lines().count() == 1, "{message}");
    // It is asked for again, and may be whole then.
    fs::copy(chunk(0, 0, 0, 3), chunk(0, 0, 0, 4)).unwrap();
    read(2).unwrap();
}

#[test]
fn neighbouring_pages_share_their_chunks() {
    let folder = TempDir::new().unwrap();
    image(folder.path(), Packing::Raw, [1, 1, 1, 200, 200], "|u1");
    let selection = Selection { channel: Some(0), ..Selection::default() };
    let options = OpenOptions { selection, ..OpenOptions::default() };
    let paged = open_paged(text(folder.path()), &options).unwrap();
    let read = |at: [u32; 3]| paged.source.read(0, PageId { level: 0, at }).unwrap();
    let first = read([0; 3]);
    // The planes are kept, so the files may go.
    let whole = open(text(folder.path()), &options).unwrap();
    fs::remove_dir_all(folder.path().join("0/0/0")).unwrap();
    assert_eq!(read([0; 3]), first);
    assert!(is_part(&read([1, 1, 0]), &whole, [62, 62, 0]));
    assert_eq!(paged.num_absent(), 0);
    // The control: who opens it now finds nothing.
    let anew = open_paged(text(folder.path()), &options).unwrap();
    assert!(!is_part(&anew.source.read(0, PageId { level: 0, at: [0; 3] }).unwrap(), &whole, [0; 3]));
    assert_eq!(anew.num_absent(), 70);
}

#[test]
fn sides_and_offsets_beyond_a_volume_are_read() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("long.raw");
    let dims = [3000, 40, 41];
    fs::write(&path, numbers(dims, Dtype::Uint8, Endian::Little)).unwrap();
    let options =
        OpenOptions { raw: Some(raw(dims, Dtype::Uint8, Endian::Little)), ..OpenOptions::default() };
    let whole = open(text(&path), &options).unwrap();
    assert_eq!(whole.dims(), [1500, 40, 41], "a volume is thinned");
    let paged = open_paged(text(&path), &options).unwrap();
    assert_eq!(paged.source.pyramid().dims(), dims);
    let page = paged.source.read(0, PageId { level: 0, at: [46, 0, 0] }).unwrap();
    assert_eq!(page.voxels.get(55), number(2942 + 55, 0, 0) as f32);
    // Holes in files take no room. One byte far behind 4 GiB is not 0.
    let path = folder.path().join("large.raw");
    let dims = [2500u32, 1000, 2500];
    let length = dims.iter().map(|&n| u64::from(n)).product();
    let file = fs::File::create(&path).unwrap();
    file.set_len(length).unwrap();
    let at = [2400u64, 900, 2300];
    let offset = at[0] + 2500 * (at[1] + 1000 * at[2]);
    std::io::Seek::seek(&mut &file, std::io::SeekFrom::Start(offset)).unwrap();
    std::io::Write::write_all(&mut &file, &[9]).unwrap();
    let options = OpenOptions {
        raw: Some(raw(dims, Dtype::Uint8, Endian::Little)),
        max_bytes: 64 << 20,
        ..OpenOptions::default()
    };
    assert!(matches!(open(text(&path), &options), Err(FormatError::TooLarge { .. })));
    let paged = open_paged(text(&path), &options).unwrap();
    let place = at.map(|n| (n / 64) as u32);
    let page = paged.source.read(0, PageId { level: 0, at: place }).unwrap();
    // The points of a page begin two before its cells.
    let inner = at.map(|n| (n % 64) as u32 + 2);
    let index = (inner[2] * PAGE_POINTS + inner[1]) * PAGE_POINTS + inner[0];
    let sum: f32 = (0..page.voxels.len()).map(|i| page.voxels.get(i)).sum();
    assert_eq!((page.voxels.get(index as usize), sum), (9.0, 9.0));
    let longest = RawShape { dims: [1 << 15, 2, 2], ..raw(dims, Dtype::Uint8, Endian::Little) };
    assert!(open_paged(text(&path), &OpenOptions { raw: Some(longest), ..options }).is_ok());
    let longer = RawShape { dims: [(1 << 15) + 1, 2, 2], ..longest };
    let e = open_paged(text(&path), &OpenOptions { raw: Some(longer), ..options }).err().unwrap();
    assert!(e.to_string().contains("dimensions are"), "{e}");
}

#[test]
fn files_of_other_writers_have_the_same_pages_or_say_why_not() {
    let mut num_paged = std::collections::BTreeMap::new();
    for name in ["zarr", "nrrd", "nifti", "metaimage", "tiff", "numpy", "mrc"] {
        let archive = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/fixtures/{name}.tar.gz"));
        if !archive.exists() {
            continue;
        }
        let folder = support::unpack(name);
        for entry in fs::read_dir(folder.path()).unwrap() {
            let path = entry.unwrap().path();
            let options = OpenOptions::default();
            if open(text(&path), &options).is_err() {
                continue;
            }
            match open_paged(text(&path), &options) {
                Ok(_) => {
                    check_pages(&path, &options);
                    *num_paged.entry(name).or_insert(0) += 1;
                }
                Err(e) => {
                    let is_told = e.to_string().contains("`isinglass convert`");
                    assert!(is_told && e.to_string().lines().count() == 1, "{e}");
                    *num_paged.entry("refused").or_insert(0) += 1;
                }
            }
        }
    }
    println!("{num_paged:?}");
    assert!(num_paged.get("zarr").is_some_and(|n| *n >= 20), "{num_paged:?}");
    assert!(num_paged.len() > 4 && num_paged.contains_key("refused"), "{num_paged:?}");
}

#[test]
fn what_cannot_be_read_by_pages_is_refused_in_a_line() {
    let refused = |source: &str, options: &OpenOptions| {
        let message = open_paged(source, options).err().unwrap().to_string();
        assert_eq!(message.lines().count(), 1, "{message}");
        message
    };
    assert!(refused("builtin:cloud", &OpenOptions::default()).contains("a built-in volume"));
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("a.raw");
    fs::write(&path, [0; 100]).unwrap();
    let options =
        OpenOptions { raw: Some(raw([10, 10, 2], Dtype::Uint8, Endian::Little)), ..OpenOptions::default() };
    assert!(refused(text(&path), &options).contains("needs 200 bytes, found 100"));
    let selection = Selection { level: Some(0), ..Selection::default() };
    assert!(refused(text(&path), &OpenOptions { selection, ..options }).contains("all levels"));
    // A chunk that takes more than its share of the memory.
    let array = folder.path().join("array");
    let one = ArrayText { shape: &[350, 350, 350], chunk: &[350; 3], dtype: "|u1", packing: Packing::Raw };
    fs::create_dir_all(&array).unwrap();
    one.write(&array, |_| vec![0]);
    let options = OpenOptions { max_bytes: 64 << 20, ..OpenOptions::default() };
    assert!(refused(text(&array), &options).contains("chunks of 42875000 bytes"));
}
