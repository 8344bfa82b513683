//! HDF5, netCDF-4 and Imaris files that h5py and netCDF4 wrote (`fixtures/make_hdf5.py`).

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

#[path = "support/cube.rs"]
mod cube;
mod support;

use std::fs;

use cube::{check, error, open_as, outline_as, values};
use glam::Vec3;
use isinglass_core::volume::{Volume, Voxels};
use isinglass_formats::{OpenOptions, Region, Selection, open, source_exists};
use support::unpack;

#[test]
fn every_type_in_both_orders_of_bytes() {
    let folder = unpack("hdf5");
    let codes = ["f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8"];
    let firsts =
        [0.0, 0.0, 0.0, -120.0, -3000.0, -70_000.0, -1_048_576.0, 0.0, 40_000.0, 1_048_576.0, 1_048_576.0];
    for word in ["little", "big"] {
        let path = folder.path().join(format!("types-{word}.h5"));
        let found = outline_as(&path, Selection::default());
        // In the order of their paths.
        assert_eq!(found.series.len(), codes.len());
        for (i, (code, first)) in codes.iter().zip(firsts).enumerate() {
            assert!(found.series[i].starts_with(&format!("/types/{code} (3×4×5 ")), "{:?}", found.series);
            let volume = open_as(&path, Selection { series: Some(i as u32), ..Default::default() });
            assert_eq!(check(&volume, code), first, "{code}");
            let kept = match volume.voxels() {
                Voxels::U8(_) => matches!(*code, "u1" | "i1"),
                Voxels::U16(_) => matches!(*code, "u2" | "i2"),
                Voxels::F32(_) => code.starts_with('f') || code.ends_with(['4', '8']),
            };
            assert!(kept, "{code}");
        }
        let e = error(&path.join("types/none"));
        assert!(e.contains("none"), "{e}");
    }
}

#[test]
fn every_storage_filter_and_version() {
    let folder = unpack("hdf5");
    let mut num = 0;
    for entry in fs::read_dir(folder.path()).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
        let Some((_, code)) = name.split_once('-').filter(|(start, _)| *start != "types") else { continue };
        num += 1;
        let volume = open_as(&path, Selection::default());
        check(&volume, &name);
        let expected = if code.starts_with('f') { "float" } else { "int" };
        assert!(volume.info.dtype.contains(expected) || code == "f8", "{name}: {}", volume.info.dtype);
        // A part and every second voxel are those of the whole.
        let whole = values(&volume);
        let region = Region { min: [1, 1, 1], max: [Some(4), None, Some(3)] };
        let part = open_as(&path, Selection { region: Some(region), ..Default::default() });
        assert_eq!(part.dims(), [3, 3, 2], "{name}");
        let at = |i: usize| (1 + i % 3) + 5 * (1 + i / 3 % 3) + 20 * (1 + i / 9);
        assert_eq!(values(&part), (0..18).map(|i| whole[at(i)]).collect::<Vec<_>>(), "{name}");
        let reading = isinglass_formats::Reading { thin: Some(2), ..Default::default() };
        let thin =
            open(path.to_str().unwrap(), &OpenOptions { reading: &reading, ..Default::default() }).unwrap();
        let at = |i: usize| 2 * (i % 3) + 10 * (i / 3 % 2) + 40 * (i / 6);
        assert_eq!(values(&thin), (0..12).map(|i| whole[at(i)]).collect::<Vec<_>>(), "{name}");
    }
    assert_eq!(num, 16);
}

#[test]
fn an_array_is_named_by_its_path_after_that_of_the_file() {
    let folder = unpack("hdf5");
    for name in ["groups-u1.h5", "dense-u1.h5"] {
        let path = folder.path().join(name);
        check(&open_as(&path.join("group 7/deep/a"), Selection::default()), name);
        // A group has the arrays below it.
        check(&open_as(&path.join("group 7"), Selection::default()), name);
        let found = outline_as(&path.join("group 7/deep/a"), Selection::default());
        assert_eq!((&found.name[..], &found.format[..]), (name, "HDF5, /group 7/deep/a"));
        for (inside, words) in [
            ("group 3", "other axes"),
            ("group 3/table", "other axes"),
            ("group 99", "group 99"),
            ("group 7/deep/a/b", "deep/a"),
        ] {
            let e = error(&path.join(inside));
            assert!(e.contains(words) && e.contains(name), "{e}");
        }
        assert!(source_exists(path.join("group 7").to_str().unwrap()));
    }
    let other = folder.path().join("text");
    fs::write(&other, "no HDF5").unwrap();
    assert!(!source_exists(other.join("a").to_str().unwrap()));
    assert!(!error(&other.join("a")).contains("HDF5:"));
}

#[test]
fn lengths_and_names_of_axes_are_those_of_fiji_ilastik_and_h5py() {
    let folder = unpack("hdf5_axes");
    let path = folder.path().join("fiji.h5");
    let volume = open_as(&path, Selection::default());
    check(&volume, "fiji");
    assert_eq!((volume.spacing().to_array(), volume.info.unit.as_deref()), ([1.5, 2.0, 3.0], Some("µm")));
    let warnings = volume.info.warnings.join("\n");
    assert!(
        warnings.contains("the file has 2 arrays, of which the largest is shown: /t0/channel0"),
        "{warnings}"
    );
    let small = open_as(&path, Selection { series: Some(0), ..Default::default() });
    assert_eq!(small.dims(), [2; 3]);
    let all = outline_as(&path, Selection::default());
    assert_eq!(all.series, ["/small (2×2×2 uint8)", "/t0/channel0 (3×4×5 uint16)"]);
    assert!(error(&path.join("table")).contains("/table (3×4 structures) has structures, expected numbers"));

    let path = folder.path().join("ilastik.h5");
    let found = outline_as(&path, Selection::default());
    assert_eq!((found.num_channels, found.num_times, found.spacing), (2, 1, [1.5, 2.0, 3.0]));
    for channel in 0..2 {
        let volume = open_as(&path, Selection { channel: Some(channel), ..Default::default() });
        assert_eq!(check(&volume, "ilastik"), 1000.0 * channel as f32);
    }
    // The slowest axis is x.
    check(&open_as(&folder.path().join("labels.h5"), Selection::default()), "labels");
}

#[test]
fn what_is_not_stored_has_the_fill_value() {
    let folder = unpack("hdf5_axes");
    let path = folder.path().join("holes.h5");
    let volume = open_as(&path, Selection::default());
    let expected: Vec<f32> = (0..160).map(|i| if (40..80).contains(&i) { 1.5 } else { -7.0 }).collect();
    assert_eq!(values(&volume), expected);
    assert!(
        volume.info.warnings.join("\n").contains("chunks not found: 3 of 4"),
        "{:?}",
        volume.info.warnings
    );
    assert_eq!(values(&open_as(&path.join("b"), Selection::default())), [9.0; 60]);
}

#[test]
fn coordinates_and_packed_values_of_netcdf() {
    let folder = unpack("hdf5_axes");
    let path = folder.path().join("ocean.nc");
    let found = outline_as(&path, Selection::default());
    assert_eq!(
        (&found.format[..], found.num_times, found.time_step),
        ("NetCDF-4, /t", 2, Some(6.0 * 3600.0))
    );
    assert_eq!(found.value_unit.as_deref(), Some("K"));
    let volume = open_as(&path, Selection::default());
    // Lengths are in the unit of x. North is up, so the rows were turned over, and the numbers are halves.
    let [x, y, z] = volume.spacing().to_array();
    assert!((x - 1.5e-3).abs() + (y - 2e-3).abs() + (z - 3e-3).abs() < 1e-8, "{x} {y} {z}");
    assert_eq!(volume.info.unit.as_deref(), Some("km"));
    let first = values(&volume);
    assert_eq!(first[1] - first[0], 0.5);
    let second = open_as(&path, Selection { time: Some(1), ..Default::default() });
    let gaps = second.gaps().map(|gaps| gaps.num_gaps);
    assert_eq!(gaps, Some(2), "{:?}", second.info.warnings);
    assert!(second.info.warnings.iter().any(|w| w.contains("missing, as the file says")));
    assert_eq!(second.value_range(), (10.5, 10.0 + 0.5 * 235.0));

    let earth = open_as(&folder.path().join("earth.nc"), Selection::default());
    let warnings = earth.info.warnings.join("\n");
    assert!(warnings.contains("different units") && warnings.contains("uneven"), "{warnings}");
    assert_eq!(earth.spacing().to_array(), [1.0; 3]);
}

#[test]
fn an_imaris_file_is_one_image_of_levels_channels_and_times() {
    let folder = unpack("hdf5_axes");
    let path = folder.path().join("cells.ims");
    let found = outline_as(&path, Selection::default());
    assert_eq!(
        (&found.format[..], &found.channels[..]),
        ("Imaris", &["DAPI".to_owned(), "GFP".to_owned()][..])
    );
    assert_eq!((found.num_times, found.time_step, found.levels.len()), (2, Some(12.5), 2));
    assert_eq!(found.levels[1].dims, [3, 2, 2]);
    assert_eq!((found.spacing, found.unit.as_deref()), ([1.5, 2.0, 3.0], Some("µm")));
    for time in 0..2 {
        let volume = open_as(&path, Selection { time: Some(time), ..Default::default() });
        assert_eq!(check(&volume, "DAPI"), 2000.0 * time as f32);
        assert_eq!(volume.info.channel.color, Some([0, 0, 255]));
        assert_eq!(volume.info.window, Some((0.0, 200.0)));
        let other = &volume.others()[0];
        assert_eq!(check(other, "GFP"), 1000.0 + 2000.0 * time as f32);
        assert_eq!((other.info.channel.color, other.info.window), (Some([0, 255, 51]), Some((1.0, 201.0))));
        let alone = open_as(&path, Selection { channel: Some(1), time: Some(time), ..Default::default() });
        assert_eq!(values(&alone), values(other));
    }
    let finest = open_as(&path, Selection::default());
    let coarse = open_as(&path, Selection { level: Some(1), ..Default::default() });
    // It looks as the finest level does: its box, and its values.
    let place = |volume: &Volume| {
        volume.info.placement.unwrap().file_from_world(Vec3::new(3.0, -2.0, 1.0)).map(|x| x as f32)
    };
    for (coarse, finest) in coarse.channels().zip(finest.channels()) {
        assert_eq!((coarse.bounds(), coarse.value_range()), (finest.bounds(), finest.value_range()));
        assert!(Vec3::from(place(coarse)).distance(place(finest).into()) < 1e-5);
    }
    assert!(
        !coarse.info.warnings.iter().any(|text| text.contains("not known")),
        "{:?}",
        coarse.info.warnings
    );
    assert_eq!((coarse.dims(), coarse.spacing().to_array()), ([3, 2, 2], [2.5, 4.0, 4.5]));
    assert_eq!(values(&coarse)[..4], [0.0, 2.0, 4.0, 20.0]);
    let part = Region { min: [1, 0, 1], max: [Some(3), Some(1), Some(2)] };
    let part = open_as(&path, Selection { region: Some(part), ..Default::default() });
    assert_eq!(values(&part), [101.0, 102.0]);
    // An array of it can be named as well.
    let inside = path.join("DataSet/ResolutionLevel 1/TimePoint 0/Channel 1/Data");
    assert_eq!(open_as(&inside, Selection::default()).dims(), [4; 3]);
}

#[test]
fn what_is_not_read_is_told_in_one_line() {
    let folder = unpack("hdf5_refused");
    for (name, words) in [
        ("virtual", "/a (3×4×5 uint8) is virtual: its numbers are in other files or arrays"),
        ("outside", "external files"),
        ("links", "\"/a\" leads to the file \"other.h5\", which is missing"),
        ("scale-offset", "/a (3×4×5 int32) is packed by scale-offset (filter 6), expected deflate"),
        ("zfp", "is packed by ZFP (filter 32013)"),
        ("complex", "it has /a (3×4×5 structures), /names (2 lists or text)"),
        ("nested", "HDF5: "),
    ] {
        let e = error(&folder.path().join(format!("{name}.h5")));
        assert!(e.contains(words), "{name}: {e}");
    }
}
