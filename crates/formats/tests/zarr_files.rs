//! Metadata of OME-Zarr: transformations, units, fill values and names of chunks.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::fs;
use std::path::Path;

use glam::Vec3;
use isinglass_core::volume::Volume;
use isinglass_formats::{FormatError, OpenOptions, Selection, open, outline};
use tempfile::TempDir;

/// An array of uncompressed bytes in version 2, all of them `value`. Its chunks have two numbers along each side.
fn array(folder: &Path, shape: [u64; 3], separator: &str, fill: &str, value: Option<u8>) {
    fs::create_dir_all(folder).unwrap();
    let text = format!(
        r#"{{"zarr_format": 2, "shape": {shape:?}, "chunks": [2, 2, 2], "dtype": "|u1", "compressor": null,
             "filters": null, "order": "C", "fill_value": {fill}, "dimension_separator": "{separator}"}}"#
    );
    fs::write(folder.join(".zarray"), text).unwrap();
    let Some(value) = value else { return };
    let [z, y, x] = shape.map(|n| n.div_ceil(2));
    for (k, j, i) in (0..z * y * x).map(|n| (n / x / y, n / x % y, n % x)) {
        let path = folder.join(format!("{k}{separator}{j}{separator}{i}"));
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, [value + (4 * k + 2 * j + i) as u8; 8]).unwrap();
    }
}

/// Transformations of the whole image and of its two levels, along z, y, x.
fn image(folder: &Path, units: [&str; 3], all: &str, levels: [&str; 2]) {
    let axes: Vec<String> = ["z", "y", "x"]
        .iter()
        .zip(units)
        .map(|(name, unit)| format!(r#"{{"name": "{name}", "type": "space", "unit": "{unit}"}}"#))
        .collect();
    let datasets: Vec<String> = levels
        .iter()
        .enumerate()
        .map(|(i, steps)| format!(r#"{{"path": "{i}"{}}}"#, transformations(steps)))
        .collect();
    let text = format!(
        r#"{{"multiscales": [{{"version": "0.4", "axes": [{}], "datasets": [{}]{}}}]}}"#,
        axes.join(", "),
        datasets.join(", "),
        transformations(all)
    );
    fs::write(folder.join(".zgroup"), r#"{"zarr_format": 2}"#).unwrap();
    fs::write(folder.join(".zattrs"), text).unwrap();
    array(&folder.join("0"), [4, 5, 6], "/", "0", Some(1));
    array(&folder.join("1"), [4, 3, 3], "/", "0", Some(1));
}

fn transformations(steps: &str) -> String {
    if steps.is_empty() { String::new() } else { format!(r#", "coordinateTransformations": [{steps}]"#) }
}

fn opened(folder: &Path, level: u32) -> Result<Volume, FormatError> {
    let selection = Selection { level: Some(level), ..Selection::default() };
    open(folder.to_str().unwrap(), &OpenOptions { selection, ..OpenOptions::default() })
}

/// Spacing and centre of a level.
fn place(folder: &Path, level: u32) -> (Vec3, [f64; 3]) {
    let volume = opened(folder, level).unwrap_or_else(|e| panic!("{e}"));
    (volume.spacing(), volume.info.placement.unwrap().center)
}

fn is_near(found: (Vec3, [f64; 3]), spacing: [f32; 3], center: [f64; 3]) -> bool {
    (found.0 - Vec3::from(spacing)).abs().max_element() < 1e-5
        && found.1.iter().zip(center).all(|(a, b)| (a - b).abs() < 1e-5)
}

const UM: [&str; 3] = ["micrometer"; 3];

#[test]
fn transformations_follow_each_other() {
    let folder = TempDir::new().unwrap();
    let folder = folder.path();
    let all =
        r#"{"type": "scale", "scale": [10, 10, 10]}, {"type": "translation", "translation": [1, 2, 3]}"#;
    let fine = r#"{"type": "scale", "scale": [2, 1, 1]}, {"type": "translation", "translation": [0, 0, 5]}"#;
    let coarse = r#"{"type": "scale", "scale": [1, 1, 1]}, {"type": "scale", "scale": [2, 2, 2]}"#;
    image(folder, UM, all, [fine, coarse]);
    // z: 1 + 1.5 steps of 20; y: 2 + 2 of 10; x: 3 + 50 + 2.5 of 10.
    let found = place(folder, 0);
    assert!(is_near(found, [10.0, 10.0, 20.0], [78.0, 22.0, 31.0]), "{found:?}");
    let found = place(folder, 1);
    assert!(is_near(found, [20.0, 20.0, 20.0], [23.0, 22.0, 31.0]), "{found:?}");
    for (steps, words) in [
        (
            r#"{"type": "affine", "affine": []}"#,
            "a transformation is \"affine\", expected scale or translation",
        ),
        (r#"{"type": "scale", "scale": [1, 1]}"#, "expected 3 numbers"),
    ] {
        image(folder, UM, "", [steps, ""]);
        let message = opened(folder, 0).unwrap_err().to_string();
        assert!(message.contains(words), "{message}");
    }
}

#[test]
fn a_level_that_tells_no_steps_covers_what_the_finest_does() {
    let folder = TempDir::new().unwrap();
    let folder = folder.path();
    let fine = r#"{"type": "scale", "scale": [3, 1, 1]}, {"type": "translation", "translation": [0, 0, 5]}"#;
    image(folder, UM, "", [fine, ""]);
    // 6 and 5 voxels became 3 along x and y, and z kept its 4. The middle is that of the finest level.
    let found = place(folder, 1);
    assert!(is_near(found, [2.0, 2.0, 3.0], [7.5, 2.0, 4.5]), "{found:?}");
    // The first voxel along y is the mean of 0 and 1.
    let volume = opened(folder, 1).unwrap();
    let first = volume.world_from_voxel(Vec3::splat(0.5));
    assert_eq!(volume.info.placement.unwrap().file_from_world(first), [5.5, 0.5, 0.0]);
    let before = outline(folder.to_str().unwrap(), &OpenOptions::default()).unwrap();
    let spacings: Vec<_> = before.levels.iter().map(|l| l.spacing).collect();
    assert_eq!(spacings, [[1.0, 1.0, 3.0], [2.0, 2.0, 3.0]]);
    image(folder, UM, "", ["", ""]);
    assert_eq!(place(folder, 1).0, Vec3::new(2.0, 2.0, 1.0));
    let warnings = opened(folder, 0).unwrap().info.warnings;
    assert_eq!(warnings, ["the image has no spacing; it was taken as 1"]);
}

#[test]
fn units_are_those_of_x() {
    let folder = TempDir::new().unwrap();
    let steps = r#"{"type": "scale", "scale": [0.002, 500, 0.5]}"#;
    image(folder.path(), ["millimeter", "nanometer", "micrometer"], "", [steps, ""]);
    let volume = opened(folder.path(), 0).unwrap();
    assert!((volume.spacing() - Vec3::new(0.5, 0.5, 2.0)).abs().max_element() < 1e-6, "{}", volume.spacing());
    assert_eq!(volume.info.unit.as_deref(), Some("µm"));
}

#[test]
fn chunks_that_are_not_there_have_the_fill_value() {
    let folder = TempDir::new().unwrap();
    for separator in ["/", "."] {
        let path = folder.path().join(if separator == "/" { "nested" } else { "flat" });
        array(&path, [2, 2, 4], separator, "9", Some(1));
        fs::remove_file(path.join(format!("0{separator}0{separator}1"))).unwrap();
        let volume = open(path.to_str().unwrap(), &OpenOptions::default()).unwrap();
        let row: Vec<f32> = (0..4).map(|i| volume.voxels().get(i)).collect();
        assert_eq!(row, [1.0, 1.0, 9.0, 9.0], "{separator}");
    }
    let path = folder.path().join("words");
    array(&path, [2, 2, 4], "/", "\"none\"", None);
    let message = open(path.to_str().unwrap(), &OpenOptions::default()).unwrap_err().to_string();
    assert!(message.contains("its fill_value is") && message.contains("expected a number"), "{message}");
    // In version 3, numbers that were never written are not a number.
    for (separator, name) in [("/", "c/0/0/0"), (".", "c.0.0.0")] {
        let path = folder.path().join(format!("v3{}", name.len()));
        let chunk = path.join(name);
        fs::create_dir_all(chunk.parent().unwrap()).unwrap();
        let text = format!(
            r#"{{"zarr_format": 3, "node_type": "array", "shape": [2, 2, 4], "data_type": "float32",
                 "chunk_grid": {{"name": "regular", "configuration": {{"chunk_shape": [2, 2, 2]}}}},
                 "chunk_key_encoding": {{"name": "default", "configuration": {{"separator": "{separator}"}}}},
                 "fill_value": "NaN", "codecs": [{{"name": "bytes", "configuration": {{"endian": "little"}}}}]}}"#
        );
        fs::write(path.join("zarr.json"), text).unwrap();
        fs::write(&chunk, [3f32.to_le_bytes(); 8].concat()).unwrap();
        let volume = open(path.to_str().unwrap(), &OpenOptions::default()).unwrap();
        let warnings = volume.info.warnings.join("\n");
        assert!(warnings.contains("8 voxels are not a number"), "{warnings}");
        assert_eq!(volume.value_range(), (3.0, 3.0));
    }
}

#[test]
fn absent_chunks_are_counted() {
    let folder = TempDir::new().unwrap();
    let folder = folder.path();
    let said = || open(folder.to_str().unwrap(), &OpenOptions::default()).unwrap().info.warnings;
    array(folder, [4, 5, 6], "/", "7", Some(1));
    let is_told = |warnings: &[String]| warnings.iter().any(|w| w.starts_with("chunks not found"));
    assert!(!is_told(&said()));
    fs::remove_file(folder.join("1/2/0")).unwrap();
    let text = "chunks not found: 1 of 18, shown as the fill value of the array";
    assert!(said().iter().any(|w| w == text), "{:?}", said());
    // The names of all chunks have another separator.
    array(folder, [4, 5, 6], ".", "7", None);
    let text =
        "chunks not found: 18 of 18, shown as the fill value of the array; is the dimension separator right?";
    assert!(said().iter().any(|w| w == text), "{:?}", said());
}

/// The metadata are those that ngff-zarr 0.50 writes, but for the unit and the second system.
#[test]
fn version_0_6_names_its_systems_of_coordinates() {
    let folder = TempDir::new().unwrap();
    let folder = folder.path();
    let axes = r#"[{"name": "z", "type": "space", "unit": "micrometer"}, {"name": "y", "type": "space", "unit": "micrometer"},
        {"name": "x", "type": "space", "unit": "micrometer"}]"#;
    let level = |i: usize, steps: &str| {
        format!(
            r#"{{"path": "{i}", "coordinateTransformations": [{{"input": {{"path": "{i}"}}, "output": {{"name": "own"}},
            "type": "sequence", "transformations": [{steps}]}}]}}"#
        )
    };
    let write = |first: &str, more: &str| {
        let second = r#"{"type": "scale", "scale": [3.0, 4.0, 3.0]}, {"type": "translation", "translation": [5.0, 21.0, -9.25]}"#;
        let text = format!(
            r#"{{"zarr_format": 3, "node_type": "group", "attributes": {{"ome": {{"version": "0.6", "multiscales": [{{
            "coordinateSystems": [{{"name": "other", "axes": [{{"name": "a"}}]}}, {{"name": "own", "axes": {axes}}}],
            "datasets": [{}, {}]{more}}}]}}}}}}"#,
            level(0, first),
            level(1, second)
        );
        fs::write(folder.join("zarr.json"), text).unwrap();
    };
    let first = r#"{"type": "scale", "scale": [3.0, 2.0, 1.5]}, {"type": "translation", "translation": [5.0, 20.0, -10.0]}"#;
    array(&folder.join("0"), [4, 5, 6], "/", "0", Some(1));
    array(&folder.join("1"), [4, 3, 3], "/", "0", Some(1));
    // What leads to another system moves nothing.
    let to_other = r#", "coordinateTransformations": [{"type": "affine", "affine": [[1]], "input": {"name": "own"}, "output": {"name": "other"}}]"#;
    for more in ["", to_other] {
        write(first, more);
        let (fine, coarse) = (place(folder, 0), place(folder, 1));
        assert!(is_near(fine, [1.5, 2.0, 3.0], [-6.25, 24.0, 9.5]), "{fine:?}");
        // The middle is that of the finest level.
        assert!(is_near(coarse, [3.0, 4.0, 3.0], [-6.25, 24.0, 9.5]), "{coarse:?}");
        assert_eq!(opened(folder, 0).unwrap().info.unit.as_deref(), Some("µm"));
        let found = outline(folder.to_str().unwrap(), &OpenOptions::default()).unwrap();
        assert!(found.format.starts_with("OME-Zarr 0.6, Zarr "), "{}", found.format);
    }
    write(r#"{"type": "rotation", "rotation": [[1]]}"#, "");
    let problem = opened(folder, 0).map(|v| v.dims()).unwrap_err().to_string();
    assert!(problem.contains("a transformation is \"rotation\", expected scale or translation"), "{problem}");
}
