//! The index of the pages of a file: what it says is what a walk over all voxels finds.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::fs;
use std::io::{Seek, SeekFrom, Write};
use std::path::Path;
use std::sync::atomic::AtomicBool;

use glam::Vec3;
use isinglass_core::volume::{Histogram, PAGE_POINTS, PageId, Volume};
use isinglass_formats::{
    Dtype, Endian, FormatError, OpenOptions, PageIndex, PageIndexBuilder, RawShape, Selection, open,
    open_paged,
};
use tempfile::TempDir;

const DIMS: [u32; 3] = [129, 70, 66];

/// The bytes of a number in a file.
type ToBytes = fn(f32) -> Vec<u8>;

/// Numbers with waves, noise and a rare outlier.
fn number(i: u32) -> f32 {
    let [x, y, z] = [i % DIMS[0], i / DIMS[0] % DIMS[1], i / DIMS[0] / DIMS[1]].map(|n| n as f32);
    let noise = (i.wrapping_mul(2_654_435_761) >> 24) as f32 / 32.0;
    if i == 300_000 { 250.0 } else { 60.0 + 40.0 * (x / 20.0).sin() * (y / 30.0).cos() + z / 2.0 + noise }
}

fn raw(path: &Path, dtype: Dtype, of: impl Fn(f32) -> Vec<u8>) -> RawShape {
    let num_voxels = DIMS.iter().product();
    fs::write(path, (0..num_voxels).flat_map(|i| of(number(i))).collect::<Vec<u8>>()).unwrap();
    RawShape { dims: DIMS, dtype, spacing: Vec3::ONE, endian: Endian::Little, offset: 0 }
}

/// Least and greatest stored number of the points of a page, by the whole volume.
fn walked(volume: &Volume, at: [u32; 3]) -> (f32, f32) {
    // Its points begin two before its cells.
    let from = at.map(|n| (n * 64).saturating_sub(2));
    let ranges = from.into_iter().zip(DIMS).map(|(from, n)| from..(from + PAGE_POINTS).min(n));
    let [x, y, z]: [std::ops::Range<u32>; 3] = ranges.collect::<Vec<_>>().try_into().unwrap();
    let all =
        z.flat_map(|z| y.clone().map(move |y| (z, y))).flat_map(|(z, y)| x.clone().map(move |x| (x, y, z)));
    all.fold((f32::INFINITY, f32::NEG_INFINITY), |(lo, hi), (x, y, z)| {
        let v = volume.voxels().get(((z * DIMS[1] + y) * DIMS[0] + x) as usize);
        (lo.min(v), hi.max(v))
    })
}

fn check(index: &PageIndex, volume: &Volume) {
    assert_eq!(index.pages(), [2, 2, 2]);
    for i in 0..8 {
        let at = [i % 2, i / 2 % 2, i / 4];
        assert_eq!(index.range(0, at), Some(walked(volume, at)), "{at:?}");
    }
    assert_eq!(index.stored_range(0), volume.stored_range());
    assert_eq!(index.histogram(0).counts.iter().sum::<u64>(), volume.voxels().len() as u64);
}

#[test]
fn an_index_has_what_a_walk_over_the_voxels_finds() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("a.raw");
    let text = path.to_str().unwrap();
    let types: [(Dtype, ToBytes); 4] = [
        (Dtype::Uint8, |x| vec![x as u8]),
        (Dtype::Int16, |x| ((x * 90.0) as i16 - 9000).to_le_bytes().to_vec()),
        (Dtype::Float, |x| (x / 7.0 - 9.0).to_le_bytes().to_vec()),
        // Beside one number far away, the others keep their bins.
        (Dtype::Double, |x| f64::from(if x == 250.0 { 1e9 } else { x }).to_le_bytes().to_vec()),
    ];
    for (dtype, of) in types {
        let options = OpenOptions { raw: Some(raw(&path, dtype, of)), ..OpenOptions::default() };
        let volume = open(text, &options).unwrap();
        let paged = open_paged(text, &options).unwrap();
        // A small file is indexed at once.
        let index = paged.index.clone().unwrap();
        check(&index, &volume);
        let (found, expected) = (index.histogram(0), Histogram::of(&volume));
        if dtype.num_bytes() <= 2 {
            assert_eq!(**found, expected, "{dtype:?}");
        }
        for percent in [0.0, 1.0, 5.0, 50.0, 95.0, 99.0, 100.0] {
            let (found, expected) = (found.percentile(percent), expected.percentile(percent));
            let bin = expected.abs() / 1000.0 + 1e-3;
            assert!((found - expected).abs() <= bin, "{dtype:?} {percent} %: {found}, expected {expected}");
        }
        // The base looks as the volume does.
        assert_eq!(paged.base.stored_range(), volume.stored_range());
        assert_eq!(Histogram::of(&paged.base), **found);
        let mut builder = PageIndexBuilder::new(paged.source.pyramid()).unwrap();
        let places = (0..8u32).map(|i| [i % 2, i / 2 % 2, i / 4]);
        for at in places {
            assert!(builder.range(0, at).is_none() && builder.clone().finish().is_none());
            let page = PageId { level: 0, at };
            let voxels = paged.source.read(0, page).unwrap();
            // A page counts once, and pages of other levels and places not at all.
            builder.add(0, page, &voxels);
            builder.add(0, page, &voxels);
            builder.add(0, PageId { level: 1, at }, &voxels);
            builder.add(0, PageId { level: 0, at: [9; 3] }, &voxels);
            builder.add(7, page, &voxels);
            assert_eq!(builder.range(0, at), index.range(0, at));
        }
        assert_eq!((builder.num_missing(), builder.finish()), (0, Some((*index).clone())));
        // The control: another page's numbers are others.
        assert_ne!(index.range(0, [0, 0, 0]), index.range(0, [1, 1, 1]));
    }
}

#[test]
fn an_index_is_kept_for_the_same_file_and_made_anew_for_another() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("a.raw");
    let text = path.to_str().unwrap();
    let kept = folder.path().join("cache/pages");
    let shape = raw(&path, Dtype::Uint8, |x| vec![x as u8]);
    let options = OpenOptions { raw: Some(shape), index_folder: Some(&kept), ..OpenOptions::default() };
    // Those of numbers; a file of levels may lie beside each.
    let files = || -> Vec<_> {
        let all = fs::read_dir(&kept).unwrap().map(|file| file.unwrap().path());
        all.filter(|path| path.extension().is_some_and(|extension| extension == "pages")).collect()
    };
    let first = open_paged(text, &options).unwrap().index.unwrap();
    assert_eq!(files().len(), 1);
    // A file of other numbers shows that the kept one is read.
    let other = OpenOptions { index_folder: None, ..options };
    raw(&path, Dtype::Uint8, |x| vec![(x / 2.0) as u8]);
    let time = fs::metadata(&path).unwrap().modified().unwrap();
    let halved = open_paged(text, &OpenOptions { index_folder: Some(&kept), ..options }).unwrap();
    assert_ne!(halved.index.as_ref().unwrap().stored_range(0), first.stored_range(0));
    assert_eq!(files().len(), 2, "another age has another file");
    raw(&path, Dtype::Uint8, |x| vec![(x / 3.0) as u8]);
    fs::File::options().write(true).open(&path).unwrap().set_modified(time).unwrap();
    let again = open_paged(text, &options).unwrap();
    assert_eq!(again.index, halved.index, "the kept one is used");
    assert_ne!(open_paged(text, &other).unwrap().index, halved.index, "control: nothing is kept");
    // Another part of the file has its own.
    let selection = Selection { region: Some("0:100,:,:".parse().unwrap()), ..Selection::default() };
    open_paged(text, &OpenOptions { selection, ..options }).unwrap();
    assert_eq!(files().len(), 3);
    // What is damaged or cut counts as none, and is written anew.
    for file in files() {
        let mut bytes = fs::read(&file).unwrap();
        let at = bytes.len() / 2;
        bytes[at] ^= 8;
        fs::write(&file, &bytes[..bytes.len() - at % 2]).unwrap();
    }
    let anew = open_paged(text, &options).unwrap();
    check(&anew.index.unwrap(), &open(text, &options).unwrap());
    assert_eq!(open_paged(text, &options).unwrap().index, open_paged(text, &other).unwrap().index);
}

#[test]
fn making_an_index_can_be_stopped_and_tells_how_far_it_is() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("a.raw");
    let text = path.to_str().unwrap();
    let shape = raw(&path, Dtype::Uint8, |x| vec![x as u8]);
    let options = OpenOptions { raw: Some(shape), ..OpenOptions::default() };
    let paged = open_paged(text, &options).unwrap();
    let most = std::cell::Cell::new(0.0f32);
    let built = paged.build_index(Some(&|done| most.set(most.get().max(done))), None).unwrap();
    assert_eq!((most.get(), Some(&built.index)), (1.0, paged.index.as_deref()));
    assert_eq!(paged.keep_index(&built).unwrap(), None, "there is no folder");
    let stopped = paged.build_index(None, Some(&AtomicBool::new(true)));
    assert!(matches!(stopped, Err(FormatError::Cancelled { .. })));
    // A file that became shorter is a line.
    fs::File::options().write(true).open(&path).unwrap().set_len(1000).unwrap();
    let message = paged.build_index(None, None).unwrap_err().to_string();
    assert!(message.contains("it ends before byte") && message.lines().count() == 1, "{message}");
}

/// A file that is too large to be indexed when it is opened: zeros, with a number here and there.
fn large(path: &Path) -> RawShape {
    let dims = [430, 430, 366];
    let num_voxels = dims.iter().map(|&n| u64::from(n)).product::<u64>();
    let mut file = fs::File::create(path).unwrap();
    file.set_len(num_voxels * 4).unwrap();
    for i in (0..num_voxels).step_by(100_003) {
        file.seek(SeekFrom::Start(i * 4)).unwrap();
        file.write_all(&((i % 977) as f32 / 7.0 - 20.0).to_le_bytes()).unwrap();
    }
    RawShape { dims, dtype: Dtype::Float, spacing: Vec3::ONE, endian: Endian::Little, offset: 0 }
}

#[test]
fn reading_every_page_leaves_the_index_and_reading_all_but_one_leaves_none() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("a.raw");
    let shape = large(&path);
    let [by_reading, by_command] = ["reading", "command"].map(|name| folder.path().join(name));
    let opened = |kept: &Path| {
        let options = OpenOptions { raw: Some(shape), index_folder: Some(kept), ..OpenOptions::default() };
        open_paged(path.to_str().unwrap(), &options).unwrap()
    };
    let num_pages = 7 * 7 * 6;
    // Three threads, in no order, and some pages twice.
    let read = |num: u32| {
        let paged = opened(&by_reading);
        assert!(paged.index.is_none());
        let source = &paged.source;
        let page = |i: u32| PageId { level: 0, at: [i % 7, i / 7 % 7, i / 49] };
        std::thread::scope(|scope| {
            for thread in 0..3 {
                scope.spawn(move || {
                    for i in (0..num).filter(|i| i % 3 == thread || i % 50 == 0) {
                        source.read(0, page(num - 1 - i * 5 % num)).unwrap();
                        source.read(0, PageId { level: 1, at: [0; 3] }).unwrap();
                    }
                });
            }
        });
    };
    assert!(num_pages % 5 != 0 && (num_pages - 1) % 5 != 0, "each page is met");
    read(num_pages - 1);
    assert!(!by_reading.exists(), "the control");
    read(num_pages);
    let paged = opened(&by_command);
    let kept = paged.keep_index(&paged.build_index(None, None).unwrap()).unwrap().unwrap();
    let same = by_reading.join(kept.file_name().unwrap());
    assert!(fs::read(&same).unwrap() == fs::read(&kept).unwrap(), "to the byte");
    // It is used from the next opening on.
    assert_eq!(opened(&by_reading).index, opened(&by_command).index);
    assert!(opened(&by_reading).index.is_some());
}
