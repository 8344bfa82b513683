//! A damaged file can only cause an error.
//!
//! A seeded fuzzer damages the small volumes of `fixtures/`. It takes a valid file and flips bits, or sets numbers to
//! their limits. It also cuts, repeats and mixes parts of other files of the format. Then it opens the outline and
//! the volume. Panics, excess memory and long times are findings.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

#[path = "../../core/tests/common/fuzzing.rs"]
mod fuzzing;
mod support;

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};

use fuzzing::{ALLOCATED, MOST, Random};
use isinglass_core::volume::{PAGE_VOXELS, PageId};
use isinglass_formats::{OpenOptions, Selection, open, open_paged, outline};
use support::unpack;

/// Runs one format at a time, so that its memory can be measured.
static ONE: Mutex<()> = Mutex::new(());

/// An input: a file, or a folder with all of its files.
struct Seed {
    /// Files, relative to the folder of the archive.
    files: Vec<(PathBuf, Vec<u8>)>,
    /// The path to open.
    target: PathBuf,
}

/// All inputs of an archive. Each file at its top is one, with the files that belong to it. Each folder is one as a
/// whole.
fn seeds(archive: &str) -> Vec<Seed> {
    let folder = unpack(archive);
    let mut top: Vec<PathBuf> = fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().path()).collect();
    top.sort();
    let relative = |p: &Path| p.strip_prefix(folder.path()).unwrap().to_owned();
    let is_side = |p: &Path| p.extension().is_some_and(|e| e == "raw" || e == "zraw" || e == "img");
    let sides: Vec<_> =
        top.iter().filter(|p| is_side(p)).map(|p| (relative(p), fs::read(p).unwrap())).collect();
    let mut seeds = Vec::new();
    for path in top.iter().filter(|p| !is_side(p)) {
        let target = relative(path);
        let mut files = Vec::new();
        if path.is_dir() {
            collect(path, &mut files);
            files.iter_mut().for_each(|(p, _)| *p = relative(p));
        } else {
            files.push((target.clone(), fs::read(path).unwrap()));
            let needs = |side: &Path| side.file_stem() == path.file_stem();
            files.extend(sides.iter().filter(|(p, _)| needs(p)).cloned());
        }
        seeds.push(Seed { files, target });
    }
    seeds
}

fn collect(folder: &Path, files: &mut Vec<(PathBuf, Vec<u8>)>) {
    let mut paths: Vec<PathBuf> = fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
    paths.sort();
    for path in paths {
        if path.is_dir() {
            collect(&path, files);
        } else {
            files.push((path.clone(), fs::read(&path).unwrap()));
        }
    }
}

/// Damages `bytes`. `other` is another file of the format.
fn mutate(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) {
    for _ in 0..1 + random.below(4) {
        let len = bytes.len();
        // Most damage goes to headers, where readers decide.
        let reach = random.of(&[len, len, 400, 1200]).min(len);
        let at = random.below(reach);
        match random.below(11) {
            0..=1 if len > 0 => bytes[at] ^= 1 << random.below(8),
            2 if len > 0 => {
                bytes[at] = random.of(&[0, 1, 0x7f, 0x80, 0xff, b'0', b'9', b'-', b' ', b'\n', b'"', b'<']);
            }
            3..=4 => {
                let value = random.of(&[
                    0u64,
                    1,
                    2,
                    3,
                    4,
                    255,
                    0x7fff,
                    0xffff,
                    1 << 31,
                    (1 << 31) - 1,
                    1 << 40,
                    u64::MAX,
                    len as u64,
                ]);
                let width = random.of(&[1, 2, 4, 8]);
                let number = if random.below(2) == 0 {
                    value.to_le_bytes()
                } else {
                    (value << (64 - 8 * width)).to_be_bytes()
                };
                if at + width <= len {
                    bytes[at..at + width].copy_from_slice(&number[..width]);
                }
            }
            // A number in text becomes another number.
            5..=6 => {
                let digits: Vec<usize> = (0..reach).filter(|&i| bytes[i].is_ascii_digit()).collect();
                if !digits.is_empty() {
                    let start = digits[random.below(digits.len())];
                    let end = (start..len).find(|&i| !bytes[i].is_ascii_digit()).unwrap_or(len);
                    let number = random.of(&[
                        "0",
                        "1",
                        "3",
                        "7",
                        "64",
                        "255",
                        "-1",
                        "65536",
                        "99999999999",
                        "18446744073709551615",
                        "1e308",
                        "nan",
                        "",
                    ]);
                    bytes.splice(start..end, number.bytes());
                }
            }
            7 => bytes.truncate(random.below(len + 1)),
            8 => {
                let from = random.below(other.len());
                let to = from + random.below(64).min(other.len() - from);
                let end = (at + to - from).min(len);
                bytes.splice(at..end, other[from..to].iter().copied());
            }
            9 => {
                let to = at + random.below(64).min(len - at);
                let run = bytes[at..to].to_vec();
                bytes.splice(at..at, run);
            }
            _ => {
                let to = at + random.below(32).min(len - at);
                bytes.drain(at..to);
            }
        }
    }
}

/// Runs for `duration` or `most` inputs from a seed. Returns the number of inputs, and of those that opened.
fn fuzz(archive: &str, duration: Duration, most: u64, seed: u64) -> (u64, u64) {
    let _one = ONE.lock().unwrap_or_else(|e| e.into_inner());
    let seeds = seeds(archive);
    let folder = tempfile::TempDir::new().unwrap();
    let mut random = Random(seed);
    let start = Instant::now();
    let (mut inputs, mut opened, mut slowest, mut largest) = (0, 0, Duration::ZERO, 0);
    while inputs < most && start.elapsed() < duration {
        let state = random.0;
        let seed = &seeds[random.below(seeds.len())];
        let other = &seeds[random.below(seeds.len())].files;
        let damaged = random.below(seed.files.len());
        for (i, (path, bytes)) in seed.files.iter().enumerate() {
            let mut bytes = bytes.clone();
            if i == damaged {
                mutate(&mut bytes, &other[random.below(other.len())].1, &mut random);
            }
            let path = folder.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, bytes).unwrap();
        }
        let target = folder.path().join(&seed.target);
        let mut part = |n: usize| (random.below(4) == 0).then(|| random.below(n) as u32);
        let selection = Selection {
            channel: part(3),
            time: part(3),
            level: part(3),
            series: part(2),
            ..Selection::default()
        };
        let options = OpenOptions { selection, max_bytes: MEMORY_LIMIT, ..OpenOptions::default() };
        let source = target.to_str().unwrap();
        let before = ALLOCATED.load(Relaxed);
        MOST.store(before, Relaxed);
        let begin = Instant::now();
        let outline = outline(source, &options);
        let volume = open(source, &options);
        let took = begin.elapsed();
        let used = MOST.load(Relaxed) - before;
        inputs += 1;
        assert!(used <= MOST_BYTES, "{used} bytes allocated, {source}, state {state:#x}");
        // Small files take milliseconds; a machine under load may take many times as long.
        assert!(took < Duration::from_secs(30), "{took:?}, {source}, state {state:#x}");
        check_pages(source, OpenOptions { selection: Selection { level: None, ..selection }, ..options });
        let used = MOST.load(Relaxed) - before;
        assert!(used <= MOST_PAGED_BYTES, "{used} bytes allocated, {source}, state {state:#x}");
        slowest = slowest.max(took);
        largest = largest.max(used);
        match volume {
            Ok(volume) => {
                opened += 1;
                let outline = outline.unwrap_or_else(|e| panic!("it opens, but {e}, state {state:#x}"));
                assert_eq!(outline.dims, volume.dims(), "{source}, state {state:#x}");
                let voxels = volume.voxels();
                assert!((voxels.len() * voxels.bytes_per_voxel()) as u64 <= MEMORY_LIMIT, "state {state:#x}");
            }
            Err(e) => {
                let message = e.to_string();
                let is_line = !message.contains(char::is_control) && message.len() < 800;
                assert!(is_line, "{message:?}, state {state:#x}");
            }
        }
        if seed.target.components().count() > 0 && folder.path().join(&seed.target).is_dir() {
            fs::remove_dir_all(folder.path().join(&seed.target)).unwrap();
        }
    }
    eprintln!("{archive}: {inputs} inputs, {opened} opened, slowest {slowest:?}, largest {largest} bytes");
    (inputs, opened)
}

/// Reads some pages of what opens by pages. What fails is one line.
fn check_pages(source: &str, options: OpenOptions) {
    let is_line = |message: String| {
        assert!(!message.contains(char::is_control) && message.len() < 800, "{message:?}");
    };
    match open_paged(source, &options) {
        Ok(paged) => {
            let pyramid = paged.source.pyramid();
            for level in 0..pyramid.levels.len() {
                let last = pyramid.pages(level).map(|n| n - 1);
                for at in [[0; 3], last] {
                    let page = PageId { level: level as u8, at };
                    match paged.source.read(0, page) {
                        Ok(page) => assert_eq!(page.voxels.len(), PAGE_VOXELS),
                        Err(e) => is_line(e.to_string()),
                    }
                }
            }
        }
        Err(e) => is_line(e.to_string()),
    }
}

fn some(archive: &str) {
    let (inputs, opened) = fuzz(archive, Duration::MAX, 400, 2);
    // Some inputs must fail, and some must open.
    assert!(opened > 0 && opened < inputs, "{opened} of {inputs}");
}

/// Runs for `ISINGLASS_FUZZ_SECONDS`, by default 300, from `ISINGLASS_FUZZ_SEED`.
fn many(archive: &str) {
    let number = |name: &str, otherwise| std::env::var(name).map_or(otherwise, |v| v.parse().unwrap());
    let duration = Duration::from_secs(number("ISINGLASS_FUZZ_SECONDS", 300));
    fuzz(archive, duration, u64::MAX, number("ISINGLASS_FUZZ_SEED", 3));
}

macro_rules! targets {
    ($($archive:ident)*) => {$(
        mod $archive {
            #[test]
            fn some_damage_finds_nothing() {
                super::some(stringify!($archive));
            }

            #[test]
            #[ignore = "runs for five minutes"]
            fn five_minutes_of_damage_find_nothing() {
                super::many(stringify!($archive));
            }
        }
    )*};
}

targets! { nifti metaimage numpy mrc nrrd tiff dicom dicom_odd dicom_coded dicom_vendors calibrated vti zarr packed hdf5 hdf5_axes hdf5_links hdf5_dialects netcdf xarray }

/// Memory limit for the voxels.
const MEMORY_LIMIT: u64 = 1 << 20;
/// Memory limit of reading by pages: some pages, and the chunks that are kept.
const MOST_PAGED_BYTES: usize = 96 << 20;
/// Memory limit in all: voxels and their second copy, the decompressed file, and a few megabytes of headers, tables
/// and buffers.
const MOST_BYTES: usize = 24 << 20;
