//! What `info` tells of large files without reading all of them.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::fs;
use std::io::{Seek, SeekFrom, Write};
use std::path::Path;

use glam::Vec3;
use isinglass_core::volume::{Histogram, Volume};
use isinglass_formats::{
    Conversion, Dtype, Endian, OpenOptions, RawShape, Reading, Selection, ValuesOf, VolumeFacts,
    facts_at_once, open, open_paged,
};
use tempfile::TempDir;

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn facts(volume: &Volume) -> VolumeFacts {
    VolumeFacts::of(volume, &Histogram::of(volume))
}

/// A file of zeros with a slab of a number, which most voxels have.
fn large(path: &Path, dims: [u32; 3], of: u8) -> RawShape {
    let num_voxels = dims.iter().map(|&n| u64::from(n)).product::<u64>();
    let mut file = fs::File::create(path).unwrap();
    file.set_len(num_voxels).unwrap();
    file.seek(SeekFrom::Start(num_voxels / 5)).unwrap();
    let slab = vec![of; 1 << 20];
    for _ in 0..(num_voxels / 5 * 3) >> 20 {
        file.write_all(&slab).unwrap();
    }
    RawShape { dims, dtype: Dtype::Uint8, spacing: Vec3::ONE, endian: Endian::Little, offset: 0 }
}

#[test]
fn values_of_a_large_file_come_from_a_sample_or_from_its_index() {
    let folder = TempDir::new().unwrap();
    let (path, kept) = (folder.path().join("a.raw"), folder.path().join("kept"));
    let raw = Some(large(&path, [500, 400, 410], 90));
    let options = OpenOptions { raw, index_folder: Some(&kept), ..OpenOptions::default() };
    let whole = facts(&open(text(&path), &options).unwrap());
    let sampled = facts_at_once(text(&path), &options).unwrap().unwrap();
    let ValuesOf::Sample(n) = sampled.values_of else { panic!("{}", sampled.values_of) };
    assert!((1 << 20..=1 << 22).contains(&n), "{n}");
    assert_eq!((sampled.dims, sampled.range), (whole.dims, whole.range));
    assert_eq!(sampled.percentiles.unwrap()[4], whole.percentiles.unwrap()[4], "the median");
    let shown = sampled.to_string();
    assert!(shown.contains("a sample of") && shown.contains("--values reads all"), "{shown}");
    // It may be larger than memory.
    let little = OpenOptions { max_bytes: 1 << 20, ..options };
    assert!(open(text(&path), &little).is_err(), "the control");
    assert_eq!(facts_at_once(text(&path), &little).unwrap().unwrap().range, whole.range);
    // An index knows all voxels.
    open_paged(text(&path), &options).unwrap();
    let known = facts_at_once(text(&path), &options).unwrap().unwrap();
    assert_eq!(known.values_of, ValuesOf::Index);
    assert_eq!((known.range, known.percentiles), (whole.range, whole.percentiles));
    // One number of many is not in the sample, and no other file has this index.
    let mut file = fs::File::options().write(true).open(&path).unwrap();
    file.seek(SeekFrom::Start(777_777)).unwrap();
    file.write_all(&[255]).unwrap();
    drop(file);
    let odd = facts_at_once(text(&path), &options).unwrap().unwrap();
    assert!(matches!(odd.values_of, ValuesOf::Sample(_)));
    assert_eq!(odd.range, Some([0.0, 90.0]));
}

#[test]
fn a_small_file_is_read_whole_and_says_so() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("a.raw");
    let raw = Some(large(&path, [200, 150, 300], 7));
    let options = OpenOptions { raw, ..OpenOptions::default() };
    assert_eq!(facts_at_once(text(&path), &options).unwrap(), None);
    assert_eq!(facts_at_once("builtin:shells@64", &OpenOptions::default()).unwrap(), None);
    let read = facts(&open(text(&path), &options).unwrap());
    assert!(read.values_of == ValuesOf::All && !read.to_string().contains("--values"));
    assert!(facts_at_once("nowhere.nii", &OpenOptions::default()).is_err());
}

#[test]
fn a_pyramid_tells_the_values_of_its_coarsest_level() {
    let folder = TempDir::new().unwrap();
    let (path, image) = (folder.path().join("a.raw"), folder.path().join("a.ome.zarr"));
    let raw = Some(large(&path, [500, 400, 410], 90));
    let options = OpenOptions { raw, ..OpenOptions::default() };
    Conversion::begin(text(&path), &image, &options).unwrap().run().unwrap();
    let found = facts_at_once(text(&image), &OpenOptions::default()).unwrap().unwrap();
    assert_eq!((found.values_of, found.dims), (ValuesOf::Level(2), [500, 400, 410]));
    assert_eq!(found.range, Some([0.0, 90.0]));
    let one = OpenOptions {
        selection: Selection { level: Some(2), ..Selection::default() },
        reading: &Reading::default(),
        ..OpenOptions::default()
    };
    assert_eq!(facts_at_once(text(&image), &one).unwrap(), None, "a small level that was asked for is read");
    assert_eq!(found.file.unwrap().levels.len(), 3);
}

#[test]
fn a_packed_file_tells_the_values_of_its_first_slices() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("a.nrrd");
    let header = "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 500 400 410\nencoding: gzip\n\n";
    let mut file = fs::File::create(&path).unwrap();
    file.write_all(header.as_bytes()).unwrap();
    let mut packed = flate2::write::GzEncoder::new(file, flate2::Compression::fast());
    for z in 0..410u32 {
        packed.write_all(&vec![(z / 2) as u8; 500 * 400]).unwrap();
    }
    packed.finish().unwrap();
    let found = facts_at_once(text(&path), &OpenOptions::default()).unwrap().unwrap();
    let ValuesOf::First(n) = found.values_of else { panic!("{}", found.values_of) };
    // A voxel takes two bytes with its brightness.
    let slices = (64 << 20) / (500 * 400 * 2);
    assert_eq!(n, slices * 500 * 400);
    assert_eq!(found.range, Some([0.0, ((slices - 1) / 2) as f32]));
    let json = serde_json::to_value(&found).unwrap();
    assert_eq!(json["values_of"], format!("the first {n} voxels"));
}
