//! NetCDF files and Zarr groups of climate, weather and ocean models, as netCDF4, h5netcdf and xarray write them
//! (`fixtures/make_netcdf.py`), and variants that are written here.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

#[path = "support/classic.rs"]
mod classic;
mod support;
#[path = "support/zarr.rs"]
mod zarr;

use std::fs;
use std::path::Path;

use classic::{Attribute, ClassicFile, ClassicVariable, Numbers};
use isinglass_core::volume::Volume;
use isinglass_formats::{OpenOptions, Outline, Selection, open, open_paged, outline};
use support::unpack;
use zarr::{ArrayText, Packing, write_image};

fn open_as(path: &Path, selection: Selection) -> Volume {
    let options = OpenOptions { selection, ..Default::default() };
    open(path.to_str().unwrap(), &options).unwrap_or_else(|e| panic!("{e}"))
}

fn outline_as(path: &Path, selection: Selection) -> Outline {
    let options = OpenOptions { selection, ..Default::default() };
    outline(path.to_str().unwrap(), &options).unwrap_or_else(|e| panic!("{e}"))
}

fn error(path: &Path) -> String {
    let options = OpenOptions::default();
    let message = open(path.to_str().unwrap(), &options).map(|v| v.dims()).unwrap_err().to_string();
    assert!(message.lines().count() == 1 && message.len() < 800, "{message}");
    message
}

/// The values, x fastest.
fn values(volume: &Volume) -> Vec<f32> {
    (0..volume.voxels().len()).map(|i| volume.value_from_stored(volume.voxels().get(i))).collect()
}

/// Checks that x points east, y north and z up in a volume of the values x + 10 y + 100 z, and more by `offset`.
fn check(path: &Path, selection: Selection, offset: f32) -> Volume {
    let name = path.file_name().unwrap().to_str().unwrap();
    let volume = open_as(path, selection);
    assert_eq!(volume.dims(), [5, 4, 3], "{name}");
    assert_eq!(volume.info.orientation, None, "{name}: x right, y up");
    for (i, x) in values(&volume).into_iter().enumerate() {
        let is_gap = volume.gaps().is_some_and(|gaps| gaps.bytes[i] != 0);
        let expected = (i % 5) + (i / 5 % 4) * 10 + i / 20 * 100;
        assert!(is_gap || (x - offset - expected as f32).abs() < 1e-3, "{name}: voxel {i} is {x}");
    }
    volume
}

/// The times of every file of a model in the archive, and the seconds between them.
const MODELS: [(&str, u64, Option<f64>); 22] = [
    ("depth", 1, None),
    ("depth-name", 1, None),
    ("depth-below-zero", 1, None),
    ("up-falling", 1, None),
    ("hpa", 1, None),
    ("pa-falling", 1, None),
    ("pressure-level", 1, None),
    ("sigma", 1, None),
    ("hybrid", 1, None),
    ("hybrid-height", 1, None),
    ("ln-pressure", 1, None),
    ("axis", 1, None),
    ("transposed", 1, None),
    ("wrf", 2, Some(3600.0)),
    ("wrf-classic", 2, Some(3600.0)),
    ("nemo", 2, Some(6.0)),
    ("roms", 2, Some(6.0)),
    ("mom", 2, Some(6.0 * 86_400.0)),
    ("cesm", 2, Some(6.0 * 86_400.0)),
    ("hycom", 2, Some(6.0 * 86_400.0)),
    ("curvilinear", 2, Some(6.0 * 3600.0)),
    ("classic-fixed", 1, None),
];

#[test]
fn every_model_has_its_axes_east_north_and_up() {
    let folder = unpack("netcdf");
    for (name, num_times, step) in MODELS {
        let path = folder.path().join(format!("{name}.nc"));
        let found = outline_as(&path, Selection::default());
        assert_eq!((found.num_times, found.num_channels, found.time_step), (num_times, 1, step), "{name}");
        for time in 0..num_times {
            let selection = Selection { time: Some(time as u32), ..Default::default() };
            let volume = check(&path, selection, 1000.0 * time as f32);
            let words = volume.info.warnings.join("\n");
            assert!(!words.contains("does not name its axes"), "{name}: {words}");
        }
    }
    // Only the model's own words turn the axes: the same depths in a file of a microscope stay as they are.
    let axes = |name: &str| outline_as(&folder.path().join(name), Selection::default()).file_axes;
    assert_eq!(axes("depth.nc"), "+x-y-z");
    assert_eq!(axes("hpa.nc"), "+x-y-z");
    assert_eq!(axes("depth-below-zero.nc"), "+x+y+z");
    assert_eq!(axes("pa-falling.nc"), "+x+y+z");
}

#[test]
fn wrf_has_the_distances_of_its_grid() {
    let folder = unpack("netcdf");
    let found = outline_as(&folder.path().join("wrf.nc"), Selection::default());
    let words: Vec<String> = found.warnings.iter().map(|w| w.text.clone()).collect();
    assert!(words.iter().any(|w| w.contains("an axis has no coordinates")), "{words:?}");
    assert_eq!(found.series, ["/W (2×2×4×5 float)", "/v (2×3×4×5 float)"]);
    assert!(found.format.ends_with("/v"), "{}", found.format);
}

#[test]
fn classic_files_of_every_version_have_records() {
    let folder = unpack("netcdf");
    for (name, format) in [
        ("classic-0", "NetCDF, CDF-1, v"),
        ("classic-1", "NetCDF, CDF-2, v"),
        ("classic-2", "NetCDF, CDF-5, v"),
        ("classic-alone", "NetCDF, CDF-1, v"),
    ] {
        let path = folder.path().join(format!("{name}.nc"));
        let found = outline_as(&path, Selection::default());
        assert_eq!((&found.format[..], found.num_times, found.time_step), (format, 2, Some(6.0 * 3600.0)));
        assert_eq!(&found.file_axes, "+x+y-z");
        for time in 0..2 {
            let selection = Selection { time: Some(time), ..Default::default() };
            check(&path, selection, 1000.0 * time as f32);
        }
        // A file that is cut is told.
        let mut bytes = fs::read(&path).unwrap();
        // The library fills up the block at the end; the last number is not zero.
        bytes.truncate(bytes.iter().rposition(|byte| *byte != 0).unwrap() + 1);
        for length in [3, 4, 40, 200, bytes.len() - 40] {
            let cut = folder.path().join("cut.nc");
            fs::write(&cut, &bytes[..length]).unwrap();
            let options = OpenOptions {
                selection: Selection { time: Some(1), ..Default::default() },
                ..Default::default()
            };
            let e = open(cut.to_str().unwrap(), &options).map(|v| v.dims()).unwrap_err().to_string();
            assert!(e.contains("cut.nc"), "{name} of {length} bytes: {e}");
        }
    }
}

#[test]
fn numbers_have_the_sign_and_the_range_that_the_file_tells() {
    let folder = unpack("netcdf");
    for kind in ["new", "classic"] {
        let path = folder.path().join(format!("unsigned-{kind}.nc"));
        let volume = check(&path, Selection::default(), 0.0);
        assert_eq!(volume.gaps().map(|gaps| gaps.num_gaps), Some(1), "{kind}");
        assert_eq!((volume.value_range(), &volume.info.dtype[..]), ((0.0, 233.0), "uint8"));
        for range in ["unpacked", "packed"] {
            let path = folder.path().join(format!("valid-{range}-{kind}.nc"));
            let volume = open_as(&path, Selection::default());
            assert_eq!(volume.gaps().map_or(0, |gaps| gaps.num_gaps), 0, "{range} {kind}");
            let (lo, hi) = volume.value_range();
            assert!((lo - 270.0).abs() + (hi - 293.4).abs() < 1e-3, "{range} {kind}: {lo} to {hi}");
        }
    }
}

#[test]
fn dimensions_of_one_length_are_told_apart() {
    let folder = unpack("netcdf");
    let found = outline_as(&folder.path().join("cube-h5netcdf.nc"), Selection::default());
    assert_eq!((&found.file_axes[..], found.dims), ("+x+y-z", [5; 3]));
    let volume = open_as(&folder.path().join("cube-h5netcdf.nc"), Selection::default());
    assert_eq!(values(&volume)[..3], [0.0, 1.0, 2.0]);
}

#[test]
fn groups_of_xarray_show_their_largest_variable() {
    let folder = unpack("xarray");
    for version in [2, 3] {
        for name in ["one", "many"] {
            let path = folder.path().join(format!("{name}-{version}.zarr"));
            let found = outline_as(&path, Selection::default());
            assert_eq!(found.format, format!("Zarr {version}, thetao"));
            assert_eq!((&found.file_axes[..], found.value_unit.as_deref()), ("+x-y-z", Some("degC")));
            let volume = check(&path, Selection::default(), 0.0);
            assert_eq!(volume.gaps().map(|gaps| gaps.num_gaps), Some(1), "{name}-{version}");
            // An array is opened by its own path, and has its coordinates beside it.
            check(&path.join("thetao"), Selection::default(), 0.0);
        }
        let path = folder.path().join(format!("times-{version}.zarr"));
        let found = outline_as(&path, Selection::default());
        assert_eq!((found.num_times, found.time_step, found.num_channels), (2, Some(6.0 * 3600.0), 1));
        check(&path, Selection { time: Some(1), ..Default::default() }, 1000.0);
    }
}

fn write_array(folder: &Path, shape: &[u64], attributes: &str) {
    let text = ArrayText { shape, chunk: shape, dtype: "<u2", packing: Packing::Raw };
    text.write(folder, |index| (index.iter().fold(0u16, |n, i| 10 * n + *i as u16)).to_le_bytes().to_vec());
    fs::write(folder.join(".zattrs"), attributes).unwrap();
}

#[test]
fn groups_of_other_writers_are_opened_or_named() {
    let folder = tempfile::tempdir().unwrap();
    // Arrays without names of their axes.
    let plain = folder.path().join("plain.zarr");
    write_array(&plain.join("a"), &[3, 4, 5], "{}");
    write_array(&plain.join("inner/b"), &[4, 4, 5], "{}");
    fs::write(plain.join(".zgroup"), r#"{"zarr_format": 2}"#).unwrap();
    fs::write(plain.join("inner/.zgroup"), r#"{"zarr_format": 2}"#).unwrap();
    let found = outline_as(&plain, Selection::default());
    assert_eq!(found.series, ["a (3×4×5 uint16)", "inner/b (4×4×5 uint16)"]);
    assert_eq!((found.dims, &found.format[..]), ([5, 4, 4], "Zarr 2, inner/b"));
    let first = Selection { series: Some(0), ..Default::default() };
    assert_eq!(outline_as(&plain, first).dims, [5, 4, 3]);
    let options =
        OpenOptions { selection: Selection { series: Some(2), ..Default::default() }, ..Default::default() };
    assert!(outline(plain.to_str().unwrap(), &options).is_err());
    // A group without arrays.
    let empty = folder.path().join("empty.zarr");
    fs::create_dir(&empty).unwrap();
    fs::write(empty.join(".zgroup"), r#"{"zarr_format": 2}"#).unwrap();
    assert!(error(&empty).contains("found no image in its attributes"));
    // Only tables.
    write_array(&empty.join("a"), &[3], "{}");
    assert!(error(&empty).contains("it has a (3 uint16)"), "{}", error(&empty));
    // An array that cannot be read is named.
    write_array(&empty.join("b"), &[3, 4, 5], "{}");
    let metadata = fs::read_to_string(empty.join("b/.zarray")).unwrap();
    fs::write(
        empty.join("b/.zarray"),
        metadata.replace(r#""filters": null"#, r#""filters": [{"id": "delta"}]"#),
    )
    .unwrap();
    assert!(error(&empty).contains("cannot be read, \"b\": it has filters"), "{}", error(&empty));
    // References to other files, as a document and as a folder.
    let references = folder.path().join("references.json");
    fs::write(&references, r#"{"version": 1, "refs": {".zgroup": "{\"zarr_format\": 2}"}}"#).unwrap();
    assert!(error(&references).contains("kerchunk"), "{}", error(&references));
    let parquet = folder.path().join("references.parq");
    fs::create_dir(&parquet).unwrap();
    fs::write(parquet.join(".zmetadata"), r#"{"metadata": {}, "record_size": 1000}"#).unwrap();
    assert!(error(&parquet).contains("kerchunk"), "{}", error(&parquet));
    // N5, by its attributes and by its name.
    for (name, text) in
        [("a.n5", None), ("b", Some(r#"{"n5": "2.5.1"}"#)), ("c", Some(r#"{"dataType": "uint8"}"#))]
    {
        let n5 = folder.path().join(name);
        fs::create_dir(&n5).unwrap();
        if let Some(text) = text {
            fs::write(n5.join("attributes.json"), text).unwrap();
        }
        assert!(error(&n5).contains("found an N5 container, expected OME-Zarr"), "{}", error(&n5));
    }
    // The control: another folder with such a document.
    let other = folder.path().join("d");
    fs::create_dir(&other).unwrap();
    fs::write(other.join("attributes.json"), r#"{"name": "x"}"#).unwrap();
    assert!(error(&other).contains("a folder without slices"));
}

#[test]
fn fields_of_a_plate_are_series() {
    let folder = tempfile::tempdir().unwrap();
    let plate = folder.path().join("plate.zarr");
    fs::create_dir(&plate).unwrap();
    fs::write(plate.join(".zgroup"), r#"{"zarr_format": 2}"#).unwrap();
    let wells =
        r#"{"plate": {"wells": [{"path": "A/1"}, {"path": "B/2"}, {"path": "../x"}], "version": "0.4"}}"#;
    fs::write(plate.join(".zattrs"), wells).unwrap();
    assert!(error(&plate).contains("a plate without fields"), "{}", error(&plate));
    for (well, first) in [("A/1", 100u16), ("B/2", 200)] {
        let well = plate.join(well);
        for field in 0..2 {
            let image = well.join(field.to_string());
            write_image(&image, &["z", "y", "x"], &[(vec![1.0; 3], vec![0.0; 3])], "");
            let packing = if field == 0 { Packing::Zstd } else { Packing::Blosc };
            let text = ArrayText { shape: &[2, 3, 4], chunk: &[2, 3, 4], dtype: "<u2", packing };
            text.write(&image.join("0"), |_| (first + field).to_le_bytes().to_vec());
        }
        fs::write(well.join(".zgroup"), r#"{"zarr_format": 2}"#).unwrap();
        fs::write(well.join(".zattrs"), r#"{"well": {"images": [{"path": "0"}, {"path": "1"}]}}"#).unwrap();
    }
    let found = outline_as(&plate, Selection::default());
    assert_eq!(found.series, ["A/1/0", "A/1/1", "B/2/0", "B/2/1"]);
    let words: Vec<String> = found.warnings.iter().map(|w| w.text.clone()).collect();
    assert!(words.iter().any(|w| w.contains("the plate has 4 fields, of which A/1/0")), "{words:?}");
    for (series, expected) in [100.0, 101.0, 200.0, 201.0].into_iter().enumerate() {
        let volume = open_as(&plate, Selection { series: Some(series as u32), ..Default::default() });
        assert_eq!(values(&volume)[0], expected);
    }
    // A well has its own fields, and a field is an image as any other.
    assert_eq!(outline_as(&plate.join("B/2"), Selection::default()).series, ["0", "1"]);
    assert!(outline_as(&plate.join("B/2/1"), Selection::default()).series.is_empty(), "control");
}

#[test]
fn pages_count_absent_chunks_as_whole_reads_do() {
    let folder = tempfile::tempdir().unwrap();
    for (name, separator) in [("nested", "/"), ("flat", ".")] {
        let image = folder.path().join(name);
        write_image(&image, &["z", "y", "x"], &[(vec![1.0; 3], vec![0.0; 3])], "");
        let text = ArrayText { shape: &[40; 3], chunk: &[10; 3], dtype: "<u2", packing: Packing::Raw };
        let array = image.join("0");
        text.write(&array, |_| vec![1, 0]);
        if separator == "." {
            let metadata = fs::read_to_string(array.join(".zarray")).unwrap();
            let metadata = metadata.replace(r#""dimension_separator": "/""#, r#""dimension_separator": ".""#);
            fs::write(array.join(".zarray"), metadata).unwrap();
            for at in zarr::indices(&[4; 3]) {
                let names: Vec<String> = at.iter().map(u64::to_string).collect();
                fs::rename(array.join(names.join("/")), array.join(names.join("."))).unwrap();
            }
        }
        let paged = || {
            let options = OpenOptions { by_pages: true, max_bytes: 256 << 20, ..Default::default() };
            let paged = open_paged(image.to_str().unwrap(), &options).unwrap();
            paged.into_volume(options.max_bytes).info.warnings.join("\n")
        };
        let whole = || open_as(&image, Selection::default()).info.warnings.join("\n");
        assert!(!whole().contains("not found") && !paged().contains("not found"), "control");
        for (num, at) in [[0u64, 0, 0], [3, 2, 1], [1, 1, 3]].into_iter().enumerate() {
            fs::remove_file(array.join(at.map(|i| i.to_string()).join(separator))).unwrap();
            let expected = format!("chunks not found: {} of 64, shown as the fill value", num + 1);
            assert!(whole().contains(&expected), "{}", whole());
            assert!(paged().contains(&expected), "{}", paged());
        }
    }
}

/// Variants that no library above writes: other orders, units and words.
#[test]
fn classic_variants_have_their_axes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.nc");
    let text = |name: &'static str, text: &'static str| (name, Attribute::Text(text));
    let axis = |name: &'static str, dim, list: Vec<f64>, attributes| ClassicVariable {
        name,
        dims: vec![dim],
        attributes,
        numbers: Numbers::Double(list),
    };
    let lat = || axis("lat", 1, vec![1.0, 2.0, 3.0, 4.0], vec![text("units", "degrees_north")]);
    let lon = || axis("lon", 2, vec![358.0, 359.0, 0.0, 1.0, 2.0], vec![text("units", "degrees_east")]);
    let write = |name: &'static str, list: [f64; 3], words: Vec<(&'static str, Attribute)>| {
        let numbers = (0..60).map(f64::from).collect();
        let volume = ClassicVariable {
            name: "v",
            dims: vec![0, 1, 2],
            attributes: vec![],
            numbers: Numbers::Double(numbers),
        };
        let vertical = axis(name, 0, list.to_vec(), words);
        let file = ClassicFile {
            dims: vec![(name, 3), ("lat", 4), ("lon", 5)],
            variables: vec![vertical, lat(), lon(), volume],
        };
        fs::write(&path, file.bytes()).unwrap();
        outline_as(&path, Selection::default()).file_axes
    };
    for (name, list, words, expected) in [
        ("lev", [1.0, 2.0, 3.0], vec![text("units", "sigma_level")], "+x+y+z"),
        ("lev", [1.0, 2.0, 3.0], vec![text("positive", "Down")], "+x+y-z"),
        ("isobaric", [1.0, 2.0, 3.0], vec![text("units", "Pa")], "+x+y-z"),
        ("isobaric", [3.0, 2.0, 1.0], vec![text("units", "hectopascals")], "+x+y+z"),
        ("lev", [1.0, 2.0, 3.0], vec![text("units", "kPa")], "+x+y-z"),
        ("lev", [10.0, 20.0, 30.0], vec![text("units", "dbar")], "+x+y-z"),
        ("isobaricInhPa", [3.0, 2.0, 1.0], vec![], "+x+y+z"),
        ("height", [1.0, 2.0, 3.0], vec![text("units", "m")], "+x+y+z"),
        ("level", [1.0, 2.0, 3.0], vec![text("long_name", "pressure_level")], "+x+y-z"),
        ("z", [1.0, 2.0, 3.0], vec![text("units", "m")], "+x+y+z"),
        ("soil_layers_stag", [1.0, 2.0, 3.0], vec![], "+x+y-z"),
        ("olevel", [1.0, 2.0, 3.0], vec![text("units", "m")], "+x+y-z"),
    ] {
        let shown = format!("{name} {list:?} {words:?}");
        assert_eq!(write(name, list, words), expected, "{shown}");
    }
    // Longitudes that go through zero are even.
    let words = outline_as(&path, Selection::default()).warnings;
    assert!(!words.iter().any(|w| w.text.contains("uneven")), "{words:?}");
}
