//! HDF5 files as BigDataViewer, NeXus, MATLAB, EMD, HyperSpy, openPMD, Chimera, DREAM.3D and Imaris write them
//! (`fixtures/make_hdf5_dialects.py`).

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

#[path = "support/cube.rs"]
mod cube;
mod support;

use std::fs;
use std::path::Path;

use cube::{check, error, open_as, outline_as, values};
use isinglass_core::volume::PageId;
use isinglass_formats::{OpenOptions, Selection, open_paged};
use support::unpack;
use tempfile::TempDir;

fn folder() -> TempDir {
    unpack("hdf5_dialects")
}

/// The spacing of the volume with its unit, and whether the position of its first voxel is known.
fn check_spacing(path: &Path, unit: Option<&str>, is_placed: bool) {
    let found = outline_as(path, Selection::default());
    let near = found.spacing.iter().zip([1.5, 2.0, 3.0]).all(|(a, b)| (a / b - 1.0).abs() < 1e-6);
    assert!(near, "{}: {:?}", path.display(), found.spacing);
    assert_eq!(found.unit.as_deref(), unit, "{}", path.display());
    assert_eq!(found.center.is_some(), is_placed, "{}", path.display());
}

fn warnings(path: &Path) -> String {
    let found = outline_as(path, Selection::default());
    found.warnings.iter().map(|w| w.text.clone() + "\n").collect()
}

/// A channel at a time.
fn part(channel: u32, time: u32) -> Selection {
    Selection { channel: Some(channel), time: Some(time), ..Default::default() }
}

#[test]
fn big_data_viewer_has_levels_channels_and_times() {
    let folder = folder();
    for name in ["bdv.h5", "bdv.xml", "kept.xml"] {
        let path = folder.path().join(name);
        let found = outline_as(&path, Selection::default());
        assert_eq!((&found.format[..], &found.dtype[..]), ("BigDataViewer", "uint16"));
        assert_eq!((&found.channels[..], found.num_times), (&["dye 0".to_owned(), "dye 1".into()][..], 2));
        assert!(found.joins_channels && found.series.is_empty());
        assert_eq!((found.spacing, found.unit.as_deref()), ([0.3, 0.4, 0.9], Some("µm")));
        let levels: Vec<_> = found.levels.iter().map(|level| (level.dims, level.spacing)).collect();
        assert_eq!(levels, [([5, 4, 3], [0.3, 0.4, 0.9]), ([2, 2, 3], [0.6, 0.8, 0.9])]);
        for time in 0..2 {
            let volume = open_as(&path, Selection { time: Some(time), ..Default::default() });
            // Numbers above 32767 are stored as negative ones.
            assert_eq!(check(&volume, name), 60_000.0 * time as f32);
            assert_eq!(check(&volume.others()[0], name), 1000.0 + 60_000.0 * time as f32);
        }
    }
    // Without its description.
    fs::remove_file(folder.path().join("bdv.xml")).unwrap();
    let found = outline_as(&folder.path().join("bdv.h5"), Selection::default());
    assert_eq!((found.num_channels, found.num_times, found.unit), (2, 2, None));
    assert!(warnings(&folder.path().join("bdv.h5")).contains("no .xml beside the file"));
    // Angles are not channels.
    let path = folder.path().join("angles.xml");
    let found = outline_as(&path, Selection::default());
    assert_eq!((found.num_channels, found.series.len()), (1, 2), "{:?}", found.series);
    assert!(found.series[1].starts_with("setups 5 to 5, angle 5"), "{:?}", found.series);
    let second = open_as(&path, Selection { series: Some(1), ..part(0, 1) });
    assert_eq!(check(&second, "angles"), 65_000.0);
}

#[test]
fn a_description_of_big_data_viewer_that_names_no_file_here_is_refused() {
    let folder = folder();
    let text = fs::read_to_string(folder.path().join("bdv.xml")).unwrap();
    let path = folder.path().join("other.xml");
    for (from, to, words) in [
        ("bdv.hdf5", "bdv.n5", "its images are in \"bdv.n5\", expected bdv.hdf5"),
        (">bdv.h5<", ">none.h5<", "its data file \"none.h5\" is missing"),
        (">bdv.h5<", ">../bdv.h5<", "outside its folder"),
        ("<ImageLoader", "<Other", "it names no file with images"),
        (">bdv.h5<", ">map.cmap<", ""),
    ] {
        fs::write(&path, text.replace(from, to)).unwrap();
        if words.is_empty() {
            assert_eq!(outline_as(&path, Selection::default()).whole_dims, [5, 4, 3]);
        } else {
            let e = error(&path);
            assert!(e.contains(words), "{e}");
        }
    }
}

#[test]
fn nexus_files_show_what_they_say() {
    let folder = folder();
    for (name, unit) in [("nexus-list.h5", "mm"), ("nexus-old.h5", "µm")] {
        let path = folder.path().join(name);
        check_spacing(&path, Some(unit), name == "nexus-list.h5");
        check(&open_as(&path, Selection::default()), name);
        let text = warnings(&path);
        assert!(text.contains("of which the file's own choice is shown") && !text.contains("name"), "{text}");
        // The control: the largest can still be chosen.
        let found = outline_as(&path, Selection::default());
        let largest = found.series.iter().position(|text| text.contains("6×6×6")).unwrap();
        assert_eq!(
            open_as(&path, Selection { series: Some(largest as u32), ..Default::default() }).dims(),
            [6; 3]
        );
    }
    let path = folder.path().join("nexus-indices.h5");
    let found = outline_as(&path, Selection::default());
    assert_eq!((found.num_times, found.time_step, found.whole_dims), (2, Some(0.05), [5, 4, 3]));
    assert_eq!(check(&open_as(&path, part(0, 1)), "indices"), 1000.0);
}

#[test]
fn matlab_shows_columns_along_x_and_no_mask() {
    let folder = folder();
    let path = folder.path().join("matlab.mat");
    let found = outline_as(&path, Selection::default());
    assert_eq!(found.format, "HDF5, /vol");
    check(&open_as(&path, Selection::default()), "matlab");
    assert!(!warnings(&path).contains("does not name its axes"));
    // Rows, columns, colours and slices.
    let colors = outline_as(&path.join("s/colors"), Selection::default());
    assert_eq!((colors.num_channels, colors.whole_dims), (3, [5, 4, 2]));
    // Truth values of h5py.
    let path = folder.path().join("mask.h5");
    assert_eq!(outline_as(&path, Selection::default()).format, "HDF5, /v");
    assert_eq!(open_as(&path.join("a mask"), Selection::default()).dims(), [6; 3]);
}

#[test]
fn microscopes_tell_their_axes() {
    let folder = folder();
    for name in ["emd-ncem.emd", "emd-new.h5"] {
        let path = folder.path().join(name);
        check_spacing(&path, Some("nm"), false);
        check(&open_as(&path, Selection::default()), name);
    }
    let path = folder.path().join("hyperspy.hspy");
    check_spacing(&path, Some("nm"), true);
    let found = outline_as(&path, Selection::default());
    assert_eq!((found.num_times, found.time_step), (2, Some(0.5)));
    assert_eq!(check(&open_as(&path, part(0, 1)), "hyperspy"), 1000.0);
    let path = folder.path().join("velox.emd");
    let found = outline_as(&path, Selection::default());
    assert_eq!((found.whole_dims, found.num_times, found.time_step), ([5, 4, 1], 3, Some(0.25)));
    assert!(
        (found.spacing[0] - 1.5).abs() < 1e-6 && (found.spacing[1] - 2.0).abs() < 1e-6,
        "{:?}",
        found.spacing
    );
    let frame = values(&open_as(&path, part(0, 2)));
    assert!(frame.iter().enumerate().all(|(i, x)| *x == (200 + i % 5 + i / 5 * 10) as f32), "{frame:?}");
}

#[test]
fn simulations_of_openpmd_have_metres_components_and_iterations() {
    let folder = folder();
    for order in ["C", "F"] {
        let path = folder.path().join(format!("openpmd-{order}.h5"));
        let found = outline_as(&path, Selection::default());
        assert_eq!((&found.format[..], found.series.len()), ("openPMD, E", 2));
        assert_eq!((&found.channels[..], found.joins_channels), (&["x".to_owned(), "y".into()][..], false));
        assert_eq!((found.num_times, found.time_step), (2, Some(4.5)));
        let spacing = found.spacing.map(|step| (step * 1e6 * 1e3).round());
        assert_eq!((spacing, found.unit.as_deref()), ([1500.0, 2000.0, 3000.0], Some("m")), "{order}");
        for (channel, time) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let first = check(&open_as(&path, part(channel, time)), order);
            assert_eq!(first, 1000.0 * channel as f32 + 2000.0 * time as f32);
        }
        let rho = open_as(&path, Selection { series: Some(1), ..part(0, 0) });
        assert_eq!(rho.dims(), [5, 4, 2]);
    }
}

#[test]
fn maps_of_chimera_have_levels() {
    let folder = folder();
    let path = folder.path().join("map.cmap");
    check_spacing(&path, Some("Å"), true);
    check(&open_as(&path, Selection::default()), "map");
    let found = outline_as(&path, Selection::default());
    assert_eq!((found.levels.len(), found.levels[1].spacing), (2, [3.0, 4.0, 6.0]));
    let coarse = open_as(&path, Selection { level: Some(1), ..Default::default() });
    assert_eq!(values(&coarse), [0.0, 2.0, 20.0, 22.0, 200.0, 202.0, 220.0, 222.0]);
}

#[test]
fn cells_of_dream_3d_have_their_grid() {
    let folder = folder();
    for name in ["dream6.dream3d", "dream7.dream3d"] {
        let path = folder.path().join(name);
        check_spacing(&path, None, true);
        let values = outline_as(&path, Selection::default());
        let center = values.center.unwrap();
        assert_eq!(center, [10.0 + 3.75, 20.0 + 4.0, 30.0 + 4.5], "{name}");
    }
    let path = folder.path().join("dream6.dream3d/DataContainers/Image/CellData");
    check(&open_as(&path.join("Values"), Selection::default()), "cells");
    let angles = outline_as(&path.join("EulerAngles"), Selection::default());
    assert_eq!((angles.num_channels, angles.whole_dims), (3, [5, 4, 3]));
}

#[test]
fn imaris_numbers_channels_times_and_levels_as_it_likes() {
    let folder = folder();
    for name in ["from1.ims", "gaps.ims"] {
        let path = folder.path().join(name);
        check_spacing(&path, Some("µm"), true);
        let found = outline_as(&path, Selection::default());
        assert_eq!(
            (&found.format[..], &found.channels[..]),
            ("Imaris", &["DAPI".to_owned(), "GFP".into()][..])
        );
        assert_eq!((found.num_times, found.levels.len()), (2, 2), "{name}");
        assert_eq!(found.levels[1].dims, [3, 2, 2]);
        for time in 0..2 {
            let volume = open_as(&path, Selection { time: Some(time), ..Default::default() });
            assert_eq!(check(&volume, name), 2000.0 * time as f32);
            assert_eq!(volume.info.channel.color, Some([0, 0, 255]));
            let other = &volume.others()[0];
            assert_eq!(check(other, name), 1000.0 + 2000.0 * time as f32);
            assert_eq!(other.info.channel.color, Some([0, 255, 51]));
        }
    }
    // Exchanged corners turn the columns over.
    let path = folder.path().join("mirrored.ims");
    check_spacing(&path, Some("µm"), true);
    let first = values(&open_as(&path, Selection::default()));
    assert_eq!(first[..5], [4.0, 3.0, 2.0, 1.0, 0.0]);
}

#[test]
fn every_array_has_pages() {
    let folder = folder();
    let others = unpack("hdf5_links");
    let names = ["bdv.h5", "from1.ims", "map.cmap", "openpmd-C.h5", "nexus-list.h5", "dream6.dream3d"];
    let paths = names.map(|name| folder.path().join(name)).into_iter();
    let more = ["bits-lz4-u2.h5", "chunks-tree2packed.h5", "soft-old.h5", "master-new.h5", "block-2048.h5"];
    for path in paths.chain(more.map(|name| others.path().join(name))) {
        let selection = Selection { level: Some(0), ..Default::default() };
        let whole = open_as(&path, selection);
        let text = path.to_str().unwrap();
        let paged = open_paged(text, &OpenOptions::default()).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(paged.source.pyramid().levels[0].dims, whole.dims(), "{text}");
        for (c, channel) in whole.channels().enumerate() {
            let page =
                paged.source.read(c, PageId { level: 0, at: [0; 3] }).unwrap_or_else(|e| panic!("{e}"));
            let side = isinglass_core::volume::PAGE_POINTS as usize;
            for (i, expected) in (0..channel.voxels().len()).map(|i| (i, channel.voxels().get(i))) {
                let [x, y, z] = [i % 5, i / 5 % 4, i / 20];
                let found = page.voxels.get((z * side + y) * side + x);
                assert_eq!(found, expected, "{text} {c} {x} {y} {z}");
            }
        }
        assert_eq!(paged.num_absent(), 0, "{text}");
    }
}
