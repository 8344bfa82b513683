//! The levels of means that an index keeps of a file without levels: they are those of the image that `convert` makes.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::fs;
use std::path::{Path, PathBuf};

use glam::Vec3;
use isinglass_core::volume::{Histogram, PageId, PageSource};
use isinglass_formats::{
    Conversion, Dtype, Endian, Flip, Meaning, OpenOptions, PagedFile, RawShape, Reading, Selection, open,
    open_paged,
};
use tempfile::TempDir;

/// A volume file, and how it is opened.
struct Sample {
    name: &'static str,
    file: &'static str,
    bytes: Vec<u8>,
    raw: Option<RawShape>,
    selection: Selection,
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Waves with noise, 0 to 200.
fn wave([x, y, z]: [u32; 3]) -> f64 {
    let noise = x.wrapping_mul(2_654_435_761).wrapping_add(y * 40_503).wrapping_add(z * 977) >> 27;
    let [x, y, z] = [x, y, z].map(f64::from);
    80.0 + 60.0 * (x / 17.0).sin() * (y / 9.0).cos() + z + f64::from(noise % 16)
}

fn numbers(dims: [u32; 3], of: impl Fn([u32; 3]) -> Vec<u8>) -> Vec<u8> {
    let [nx, ny, nz] = dims;
    (0..nx * ny * nz).flat_map(|i| of([i % nx, i / nx % ny, i / nx / ny])).collect()
}

fn raw(
    name: &'static str,
    dims: [u32; 3],
    dtype: Dtype,
    endian: Endian,
    of: impl Fn([u32; 3]) -> Vec<u8>,
) -> Sample {
    let raw = Some(RawShape { dims, dtype, spacing: Vec3::new(1.0, 1.0, 1.2), endian, offset: 7 });
    let bytes = [vec![0; 7], numbers(dims, of)].concat();
    Sample { name, file: "a.raw", bytes, raw, selection: Selection::default() }
}

fn nrrd(name: &'static str, header: &str, data: Vec<u8>) -> Sample {
    let bytes =
        [format!("NRRD0004\nencoding: raw\nendian: little\n{header}\n\n").into_bytes(), data].concat();
    Sample { name, file: "a.nrrd", bytes, raw: None, selection: Selection::default() }
}

/// CT of a NIfTI file, with what a scanner writes outside of its circle.
fn ct(dims: [u32; 3]) -> Sample {
    let mut header = vec![0u8; 352];
    let mut put = |at: usize, bytes: &[u8]| header[at..at + bytes.len()].copy_from_slice(bytes);
    put(0, &348i32.to_le_bytes());
    put(40, &3i16.to_le_bytes());
    for (k, n) in dims.iter().enumerate() {
        put(42 + 2 * k, &(*n as i16).to_le_bytes());
        put(80 + 4 * k, &1.5f32.to_le_bytes());
    }
    for k in 3..7 {
        put(42 + 2 * k, &1i16.to_le_bytes());
    }
    put(70, &4i16.to_le_bytes());
    put(72, &16i16.to_le_bytes());
    put(76, &1f32.to_le_bytes());
    put(108, &352f32.to_le_bytes());
    put(112, &1f32.to_le_bytes());
    put(123, &[2]);
    put(254, &1i16.to_le_bytes());
    for (row, sign) in [-1.5f32, -1.5, 1.5].iter().enumerate() {
        put(280 + 16 * row + 4 * row, &sign.to_le_bytes());
    }
    put(344, b"n+1\0");
    let of = |at: [u32; 3]| {
        let far = (at[0] as f32 - 130.0).hypot(at[1] as f32 * 5.0 - 100.0) > 120.0;
        let number = if far { -2000 } else { wave(at) as i16 * 10 - 900 };
        number.to_le_bytes().to_vec()
    };
    let bytes = [header, numbers(dims, of)].concat();
    Sample { name: "CT", file: "a.nii", bytes, raw: None, selection: Selection::default() }
}

const DIMS: [u32; 3] = [260, 41, 35];

fn samples() -> Vec<Sample> {
    let (little, big) = (Endian::Little, Endian::Big);
    let of_marks = |at: [u32; 3]| match at {
        [x, y, _] if (x / 9 + y) % 7 == 0 => -9999f32,
        [x, 3, _] if x % 5 == 0 => f32::NAN,
        at => wave(at) as f32 / 7.0,
    };
    let float = "type: float\ndimension: 3\nsizes: 260 41 35";
    let turned = "type: ushort\ndimension: 3\nsizes: 41 35 260\nspace: left-posterior-superior\n\
                  space directions: (0,2,0) (0,0,-2) (2,0,0)";
    let block = |[x, y, z]: [u32; 3]| match (x / 41 + y / 17 + z / 13) % 4 {
        0 => 0,
        i => (i * 7) as u8,
    };
    let mut parts = vec![
        raw("uint8", DIMS, Dtype::Uint8, little, |at| vec![wave(at) as u8]),
        raw("int8", DIMS, Dtype::Int8, little, |at| vec![(wave(at) as i32 - 128) as i8 as u8]),
        raw("int16", DIMS, Dtype::Int16, big, |at| (wave(at) as i16 * 90 - 9000).to_be_bytes().to_vec()),
        raw("int32", DIMS, Dtype::Int32, big, |at| ((wave(at) * 7e6) as i32).to_be_bytes().to_vec()),
        raw("uint64", DIMS, Dtype::Uint64, little, |at| ((wave(at) * 1e15) as u64).to_le_bytes().to_vec()),
        raw("float16", DIMS, Dtype::Half, little, |at| {
            half::f16::from_f64(wave(at) / 3.0).to_le_bytes().to_vec()
        }),
        raw("double", DIMS, Dtype::Double, little, |at| (wave(at) / 3.0).to_le_bytes().to_vec()),
        raw("three levels", [530, 70, 9], Dtype::Uint16, little, |at| {
            (wave(at) as u16 * 300).to_le_bytes().to_vec()
        }),
        raw("deep", [30, 40, 300], Dtype::Uint8, little, |at| vec![wave(at) as u8]),
        raw("labels", DIMS, Dtype::Uint8, little, |at| vec![block(at)]),
        nrrd("markers", float, numbers(DIMS, |at| of_marks(at).to_le_bytes().to_vec())),
        nrrd("turned", turned, numbers([41, 35, 260], |at| (wave(at) as u16 * 9).to_le_bytes().to_vec())),
        nrrd(
            "colours",
            "type: uchar\ndimension: 4\nsizes: 3 260 41 35\nkinds: RGB-color domain domain domain",
            numbers(DIMS, |at| vec![wave(at) as u8, at[0] as u8, (at[1] * 6) as u8]),
        ),
        ct(DIMS),
    ];
    let selection = Selection {
        region: Some("3:,:40,1:".parse().unwrap()),
        flip: Flip([true, false, true]),
        ..Selection::default()
    };
    let part = raw("a part", [270, 44, 37], Dtype::Uint8, little, |at| vec![wave(at) as u8]);
    parts.push(Sample { selection, ..part });
    parts
}

/// A file in a folder with room for an index.
struct Opened {
    _folder: TempDir,
    path: PathBuf,
    kept: PathBuf,
    raw: Option<RawShape>,
    selection: Selection,
}

impl Opened {
    fn of(sample: &Sample) -> Self {
        let folder = TempDir::new().unwrap();
        let (path, kept) = (folder.path().join(sample.file), folder.path().join("kept"));
        fs::write(&path, &sample.bytes).unwrap();
        let &Sample { raw, selection, .. } = sample;
        Self { _folder: folder, path, kept, raw, selection }
    }

    fn options(&self) -> OpenOptions<'_> {
        let &Self { raw, selection, .. } = self;
        OpenOptions { raw, selection, index_folder: Some(&self.kept), ..OpenOptions::default() }
    }

    fn paged(&self) -> PagedFile {
        open_paged(text(&self.path), &self.options()).unwrap_or_else(|e| panic!("{e}"))
    }

    fn means(&self) -> Vec<PathBuf> {
        let all = fs::read_dir(&self.kept).unwrap().map(|file| file.unwrap().path());
        all.filter(|path| path.extension().unwrap() == "means").collect()
    }
}

fn places(source: &dyn PageSource, level: usize) -> impl Iterator<Item = [u32; 3]> {
    let [nx, ny, nz] = source.pyramid().pages(level);
    (0..nx * ny * nz).map(move |i| [i % nx, i / nx % ny, i / nx / ny])
}

/// Levels of each that are the same in both files, to the bit.
fn same_levels(a: &PagedFile, b: &PagedFile, name: &str) -> Vec<(usize, usize)> {
    let (of_a, of_b) = (&a.source.pyramid().levels, &b.source.pyramid().levels);
    let mut same = Vec::new();
    for (i, level) in of_a.iter().enumerate() {
        let alike = |j: &usize| (of_b[*j].dims, of_b[*j].factor) == (level.dims, level.factor);
        let Some(j) = (0..of_b.len()).find(alike) else { continue };
        let apart = (0..3).map(|k| (of_b[j].first[k] - level.first[k]).abs()).fold(0.0, f32::max);
        let pages = (0..a.base.channels().count()).flat_map(|c| places(&*a.source, i).map(move |at| (c, at)));
        let is_same = apart < 1e-3
            && pages.into_iter().all(|(channel, at)| {
                let [a, b] = [(a, i), (b, j)].map(|(file, level)| {
                    file.source.read(channel, PageId { level: level as u8, at }).unwrap()
                });
                let bits = |i: usize| a.voxels.get(i).to_bits() == b.voxels.get(i).to_bits();
                a.gaps == b.gaps && a.voxels.len() == b.voxels.len() && (0..a.voxels.len()).all(bits)
            });
        if is_same {
            same.push((i, j));
        } else {
            eprintln!("{name}: level {i} of {of_a:?} differs from level {j} of {of_b:?}");
        }
    }
    same
}

#[test]
fn pages_of_every_level_are_those_of_the_image_that_convert_makes() {
    for sample in samples() {
        let name = sample.name;
        let file = Opened::of(&sample);
        let paged = file.paged();
        let image = file.path.with_extension("ome.zarr");
        let options = OpenOptions { index_folder: None, ..file.options() };
        let made = Conversion::begin(text(&file.path), &image, &options).unwrap().run().unwrap();
        let other = OpenOptions { index_folder: Some(&file.kept), ..OpenOptions::default() };
        let converted = open_paged(text(&image), &other).unwrap();
        let (own, others) = (&paged.source.pyramid().levels, &converted.source.pyramid().levels);
        // All levels are small, so all are kept.
        let expected: Vec<_> = (0..others.len()).map(|level| (level, level)).collect();
        assert_eq!(own.len(), expected.len(), "{name}: {own:?} {others:?}");
        assert_eq!(same_levels(&paged, &converted, name), expected, "{name}");
        // What is seen first and what decides about colours.
        assert_eq!(paged.index, converted.index, "{name}");
        assert_eq!(paged.base.info.are_labels, made.are_labels, "{name}");
        assert_eq!(converted.base.info.are_labels, made.are_labels, "{name}");
        for (a, b) in paged.base.channels().zip(converted.base.channels()) {
            assert!(a.voxels() == b.voxels(), "{name}");
            assert_eq!(a.gaps().map(|g| &g.bytes), b.gaps().map(|g| &g.bytes), "{name}");
            assert_eq!(a.stored_range(), b.stored_range(), "{name}");
            assert_eq!(Histogram::of(a), Histogram::of(b), "{name}");
        }
        let place = |file: &PagedFile| (file.base.bounds().center(), file.base.bounds().radius());
        let ((a, r), (b, s)) = (place(&paged), place(&converted));
        assert!((a - b).length() < 1e-4 && (r - s).abs() < 1e-3 * r, "{name}: {a} {b} {r} {s}");
        // The control: without an index, the second level is of every Nth voxel.
        let without = open_paged(text(&file.path), &options).unwrap();
        assert!(same_levels(&without, &converted, "control").len() < expected.len(), "{name}");
    }
}

#[test]
fn labels_are_labels_in_every_level_and_values_if_the_person_says_so() {
    let sample = samples().into_iter().find(|sample| sample.name == "labels").unwrap();
    let file = Opened::of(&sample);
    let paged = file.paged();
    assert!(paged.base.info.are_labels && paged.is_indexed());
    assert!(paged.base.info.warnings.iter().any(|word| word.contains("taken for labels")));
    let reading = Reading { voxels: Some(Meaning::Values), ..Reading::default() };
    let values = open_paged(text(&file.path), &OpenOptions { reading: &reading, ..file.options() }).unwrap();
    assert!(!values.is_indexed() && !values.base.info.are_labels, "levels of labels are none of values");
    values.keep_index(&values.build_index(None, None).unwrap()).unwrap();
    let values = open_paged(text(&file.path), &OpenOptions { reading: &reading, ..file.options() }).unwrap();
    assert!(values.is_indexed());
    assert!(values.base.voxels() != paged.base.voxels(), "means are no labels");
}

#[test]
fn levels_that_are_cut_altered_or_of_an_older_file_are_refused_and_the_file_is_shown() {
    let file = Opened::of(&samples()[2]);
    let whole = file.paged();
    assert!(whole.is_indexed());
    let [kept] = &file.means()[..] else { panic!("one file") };
    let bytes = fs::read(kept).unwrap();
    let without =
        open_paged(text(&file.path), &OpenOptions { index_folder: None, ..file.options() }).unwrap();
    let is_shown_without = |what: &str| {
        let paged = file.paged();
        assert_eq!(paged.source.pyramid().levels, without.source.pyramid().levels, "{what}");
        assert!(paged.base.voxels() == without.base.voxels() && !paged.is_indexed(), "{what}");
        assert_eq!(paged.index, whole.index, "{what}: the numbers are still known");
    };
    for at in (0..bytes.len()).step_by(bytes.len() / 97) {
        fs::write(kept, &bytes[..at]).unwrap();
        is_shown_without(&format!("cut at {at}"));
        let mut altered = bytes.clone();
        altered[at] ^= 1 << (at % 8);
        fs::write(kept, &altered).unwrap();
        is_shown_without(&format!("altered at {at}"));
    }
    fs::write(kept, [&bytes[..], &[0]].concat()).unwrap();
    is_shown_without("longer");
    // The control: as it was, it is used.
    fs::write(kept, &bytes).unwrap();
    assert_eq!(file.paged().source.pyramid().levels, whole.source.pyramid().levels);
    // Another age of the file has another index, and the old levels are of no use under its name.
    let time = fs::metadata(&file.path).unwrap().modified().unwrap() + std::time::Duration::from_secs(9);
    fs::File::options().write(true).open(&file.path).unwrap().set_modified(time).unwrap();
    assert!(file.paged().is_indexed() && file.means().len() == 2);
    for means in file.means() {
        fs::write(means, &bytes).unwrap();
    }
    assert!(!file.paged().is_indexed(), "levels of an older file");
}

#[test]
fn a_whole_reading_shows_what_it_showed_before() {
    // Levels change nothing where the volume fits into memory.
    for sample in samples() {
        let file = Opened::of(&sample);
        let before = open(text(&file.path), &OpenOptions { index_folder: None, ..file.options() }).unwrap();
        file.paged();
        let after = open(text(&file.path), &file.options()).unwrap();
        assert!(before.voxels() == after.voxels() && before.info == after.info, "{}", sample.name);
    }
}
