//! Does no scan open on an opaque block, and none on an empty picture? All volumes of the data folder are opened.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::path::{Path, PathBuf};

use isinglass_core::camera::Intrinsics;
use isinglass_core::kernels::march::{MarchSettings, Scene, render};
use isinglass_core::orbit::Orbit;
use isinglass_core::transfer::{Domain, TransferFunction};
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Histogram, Volume};
use isinglass_formats::{OpenOptions, default_transfer, load_transfer, open};
use isinglass_tests::data_dir;

/// What fills a picture at the first look.
struct FirstLook {
    /// The share of the outermost voxels that hide what is behind them.
    filled: f32,
    /// Whether there is brighter matter within, which the outermost voxels could hide.
    has_more_within: bool,
    /// The share of the picture that is not black.
    picture: f32,
}

impl FirstLook {
    fn of(volume: Volume, transfer: &TransferFunction) -> Self {
        let histogram = Histogram::of(&volume);
        let domain = transfer.at_values(&volume, &histogram).domain;
        let Domain::Values(lo, hi) = domain else { panic!("{domain:?}") };
        let (mut sides, num_sides) = outermost(&volume);
        sides.sort_unstable_by(f32::total_cmp);
        // Of labels, all but zero are opaque, whatever the transfer function says.
        let is_filled = |value: &&f32| match volume.info.are_labels {
            true => **value != 0.0,
            false => transfer.at((**value - lo) / (hi - lo)).1 > 0.1,
        };
        let filled = sides.iter().filter(is_filled).count() as f32 / num_sides as f32;
        let brightest = sides.get(sides.len().saturating_sub(1) * 98 / 100);
        let has_more_within = brightest.is_none_or(|brightest| *brightest < histogram.percentile(99.8));
        let bounds = volume.bounds();
        let orbit = Orbit::default().upright(volume.info.orientation.as_deref());
        let scene = Scene::new(volume.into(), transfer, MarchSettings::default());
        let seen = render(&scene, &orbit.camera(Intrinsics::perspective(64, 64, 0.6), &bounds));
        let bytes = seen.to_srgb8([0.0; 3]);
        let lit = bytes.chunks(3).filter(|rgb| rgb.iter().any(|c| *c > 24)).count();
        Self { filled, has_more_within, picture: lit as f32 / (64.0 * 64.0) }
    }

    /// What is wrong with it.
    fn problem(&self) -> Option<String> {
        let &Self { filled, has_more_within, picture } = self;
        match (has_more_within && filled > 0.5, picture < 0.002) {
            (true, _) => Some(format!("{:.0} % of the outermost voxels are opaque", 100.0 * filled)),
            (_, true) => Some(format!("{:.2} % of the picture show anything", 100.0 * picture)),
            _ => None,
        }
    }
}

/// The values of the outermost voxels without those with nothing in them, and the number of all.
fn outermost(volume: &Volume) -> (Vec<f32>, usize) {
    let dims = volume.dims().map(|n| n as i32);
    let (mut values, mut num_all) = (Vec::new(), 0);
    for axis in 0..3 {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        for side in [0, dims[axis] - 1] {
            for (a, b) in (0..dims[u]).step_by(3).flat_map(|a| (0..dims[v]).step_by(3).map(move |b| (a, b))) {
                let mut at = [0; 3];
                (at[axis], at[u], at[v]) = (side, a, b);
                num_all += 1;
                let index = (at[2] * dims[1] + at[1]) * dims[0] + at[0];
                if volume.gaps().is_none_or(|gaps| gaps.bytes[index as usize] == 0) {
                    values.push(volume.value_from_stored(volume.stored_at(at[0], at[1], at[2])));
                }
            }
        }
    }
    (values, num_all)
}

/// Folders in the data folder, of volumes.
const FOLDERS: [&str; 2] = ["foreign", "failing"];

/// The files and folders in a folder that may be volumes.
fn sources(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).unwrap();
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    // Folders of volumes.
    paths.retain(|path| !FOLDERS.iter().any(|folder| path.ends_with(folder)));
    paths.sort();
    paths
}

#[test]
fn no_scan_opens_on_a_block_or_on_nothing() {
    let Some(data) = data_dir() else { return };
    let (mut num_looks, mut problems) = (0, Vec::new());
    for folder in [data.clone()].into_iter().chain(FOLDERS.map(|folder| data.join(folder))) {
        for path in sources(&folder) {
            let source = path.to_str().unwrap();
            // What is no volume, or a broken one, has tests of its own.
            let Ok(volume) = open(source, &OpenOptions::default()) else { continue };
            let (lo, hi) = volume.value_range();
            if lo == hi {
                continue;
            }
            let transfer = default_transfer(source, &volume, &Histogram::of(&volume));
            let look = FirstLook::of(volume, &transfer);
            println!("{source}: {}, {:.2} filled, {:.2} lit", transfer.name, look.filled, look.picture);
            num_looks += 1;
            problems.extend(look.problem().map(|problem| format!("{source}: {problem}")));
        }
    }
    assert!(num_looks >= 10, "{num_looks} scans in {}", data.display());
    assert!(problems.is_empty(), "{problems:#?}");
}

/// The check itself finds a block, and a picture of nothing.
#[test]
fn a_block_and_an_empty_picture_are_found() {
    let volume = || Builtin::Shells.volume(32);
    let good = load_transfer("shells").unwrap();
    assert_eq!(FirstLook::of(volume(), &good).problem(), None);
    let mut block = good.clone();
    for point in &mut block.points {
        point.opacity = 1.0;
    }
    assert!(FirstLook::of(volume(), &block).problem().unwrap().contains("opaque"));
    let mut nothing = good;
    for point in &mut nothing.points {
        point.opacity = 0.0;
    }
    assert!(FirstLook::of(volume(), &nothing).problem().unwrap().contains("show anything"));
}
