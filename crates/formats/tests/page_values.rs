//! Slices, probes and profiles of a file's pages are those of the volume that is opened whole: of any part, channel, time
//! and direction, with gaps and labels.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

#[path = "support/zarr.rs"]
mod zarr;

use std::path::Path;
use std::sync::Arc;

use glam::Vec3;
use isinglass_core::cancel::ALWAYS;
use isinglass_core::ids::ProbeId;
use isinglass_core::volume::{
    Page, PageId, PageValues, SlabMode, Slice, SlicePlane, SliceSpec, ValuesAt, Volume,
};
use isinglass_core::wire::ProfileRequest;
use isinglass_formats::{Flip, Meaning, OpenOptions, Reading, Selection, open, open_paged, outline};
use tempfile::TempDir;
use zarr::{ArrayText, Packing, write_image};

fn slices(whole: &Volume) -> Vec<SliceSpec> {
    let axis = |axis: u8, index, thickness| SliceSpec {
        plane: SlicePlane::Axis { axis, index },
        thickness,
        mode: SlabMode::Max,
    };
    let step = whole.spacing().min_element();
    let oblique = SlicePlane::Oblique {
        origin: (whole.bounds().min * 0.9).to_array(),
        column: [step * 1.3, step * 0.6, 0.1 * step],
        row: [-0.2 * step, 0.7 * step, step],
        size: [110, 90],
    };
    let oblique = SliceSpec { plane: oblique, thickness: 0.0, mode: SlabMode::Mean };
    vec![axis(0, 63, 0.0), axis(1, 64, 3.0 * step), axis(2, 9999, 0.0), oblique]
}

/// Compares what is read at the finest level with the volume. Returns the volume.
fn agree(path: &Path, selection: Selection, reading: &Reading, what: &str) -> Volume {
    let source = path.to_str().unwrap();
    let options = OpenOptions { selection, reading, ..OpenOptions::default() };
    let has_levels = !outline(source, &options).unwrap().levels.is_empty();
    let level = has_levels.then_some(0);
    let whole =
        open(source, &OpenOptions { selection: Selection { level, ..selection }, ..options }).unwrap();
    let paged = open_paged(source, &options).unwrap();
    let (base, pyramid) = (&paged.base, paged.source.pyramid());
    let pages = pyramid.base_pages(base).unwrap();
    let last = pyramid.levels.len() as u8 - 1;
    let known = |at: [u32; 3]| -> Arc<Page> {
        let id = pyramid.page_over(at, last);
        pages.iter().find(|page| page.id == id).unwrap().clone()
    };
    let read = |id: PageId| paged.source.read(0, id).ok();
    let fine = PageValues::known(base, pyramid, &known).reading(0, &read);
    let coarse = PageValues::known(base, pyramid, &known);
    let mut num_coarse = 0;
    for spec in slices(&whole) {
        let flat = Slice::of(&whole, &spec, ALWAYS).unwrap();
        assert_eq!(Slice::of_pages(&fine, &spec, ALWAYS), Some((flat.clone(), 0)), "{what} {spec:?}");
        num_coarse += usize::from(Slice::of_pages(&coarse, &spec, ALWAYS).unwrap().0 != flat);
    }
    assert!(num_coarse > 0, "{what}: the control, a coarser level is another one");
    let bounds = whole.bounds();
    let point = |share: Vec3| bounds.min + (bounds.max - bounds.min) * share;
    let (mut cursor, mut flat) = (fine.cursor(), &whole);
    for i in 0..400u32 {
        let share = Vec3::new((i % 17) as f32 / 16.0, (i % 19) as f32 / 18.0, (i % 23) as f32 / 22.0);
        assert_eq!(cursor.voxel(point(share)), flat.voxel(point(share)), "{what} {share}");
    }
    let ends = [Vec3::splat(0.03), Vec3::new(0.9, 0.97, 0.8)].map(|share| point(share).to_array());
    let question = ProfileRequest { id: ProbeId(1), ends, num_points: 300 };
    assert_eq!(question.answer(&mut cursor), question.answer(&mut flat), "{what}");
    whole
}

/// Numbers without any symmetry.
fn number(x: u64, y: u64, z: u64) -> u64 {
    (x * 7 + y * 31 + z * 101 + (x * y + z) % 13) % 251
}

const PACKINGS: [Packing; 3] = [Packing::Raw, Packing::Zstd, Packing::Blosc];

fn parts() -> Vec<(&'static str, Selection)> {
    let region = |text: &str| Selection { region: Some(text.parse().unwrap()), ..Selection::default() };
    vec![
        ("all", Selection::default()),
        ("a region", region("10:131,7:,4:69")),
        ("mirrored", Selection { flip: Flip([true, false, true]), ..Selection::default() }),
    ]
}

#[test]
fn of_channels_and_times_of_an_image_in_levels() {
    let folder = TempDir::new().unwrap();
    let dims = [150u64, 131, 70];
    let factors = [[1u64, 1, 1], [2, 2, 1], [4, 4, 2]];
    let level = |f: &[u64; 3]| {
        let [x, y, z] = f.map(|f| f as f64);
        (vec![1.0, 1.0, 2.0 * z, y, x], vec![0.0, 0.0, z - 1.0, (y - 1.0) / 2.0, (x - 1.0) / 2.0])
    };
    let levels: Vec<_> = factors.iter().map(level).collect();
    write_image(folder.path(), &["t", "c", "z", "y", "x"], &levels, "");
    for (i, f) in factors.iter().enumerate() {
        let shape = [2, 2, dims[2] / f[2], dims[1] / f[1], dims[0] / f[0]];
        let chunk = [1, 1, 32, 64, 64];
        let array = ArrayText { shape: &shape, chunk: &chunk, dtype: "<u2", packing: PACKINGS[i] };
        array.write(&folder.path().join(i.to_string()), |at| {
            let value = number(at[4] * f[0] + 3 * at[0], at[3] * f[1] + 5 * at[1], at[2] * f[2]);
            (value as u16 * 9 + at[1] as u16).to_le_bytes().to_vec()
        });
    }
    let mut seen = Vec::new();
    for (what, part) in parts() {
        for (channel, time) in [(None, 0), (Some(1), 0), (Some(1), 1)] {
            let selection = Selection { channel, time: Some(time), ..part };
            let what = format!("{what}, channel {channel:?}, time {time}");
            seen.push(agree(folder.path(), selection, Reading::USUAL, &what).stored_at(40, 40, 40));
        }
    }
    // The control: channels, times and parts differ.
    assert!(seen[0] != seen[1] && seen[1] != seen[2] && seen[1] != seen[4], "{seen:?}");
}

#[test]
fn of_volumes_with_gaps_and_of_labels() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("a.nrrd");
    let [nx, ny, nz] = [150u64, 131, 70];
    let write = |kind: &str, data: Vec<u8>| {
        let header = format!(
            "NRRD0004\ntype: {kind}\ndimension: 3\nsizes: {nx} {ny} {nz}\nspacings: 0.5 0.7 2\nencoding: raw\n\
             endian: little\n\n"
        );
        std::fs::write(&path, [header.into_bytes(), data].concat()).unwrap();
    };
    let all = || (0..nx * ny * nz).map(|i| [i % nx, i / nx % ny, i / nx / ny]);
    // Holes of all sizes: at the borders of pages, and a side without values.
    let is_gap = |[x, y, z]: [u64; 3]| {
        x > 120 || (x.abs_diff(64) + y.abs_diff(60) + z.abs_diff(30)) < 14 || (x * 7 + y * 5 + z) % 31 == 0
    };
    let value = |at: [u64; 3]| if is_gap(at) { f32::NAN } else { number(at[0], at[1], at[2]) as f32 - 60.0 };
    write("float", all().flat_map(|at| value(at).to_le_bytes()).collect());
    for (what, part) in parts() {
        let whole = agree(&path, part, Reading::USUAL, &format!("gaps, {what}"));
        assert!(whole.gaps().is_some(), "the control");
    }
    let label = |[x, y, z]: [u64; 3]| [3u8, 200, 90, 17][((x / 9 + 2 * (y / 7) + 3 * (z / 11)) % 4) as usize];
    write("uint8", all().map(label).collect());
    for (what, part) in parts() {
        let reading = Reading { voxels: Some(Meaning::Labels), ..Reading::default() };
        let whole = agree(&path, part, &reading, &format!("labels, {what}"));
        assert!(whole.info.are_labels, "the control");
    }
}
