//! Does every kind of bad volume and transfer function end in one line that names the file, the cause, what was expected
//! and what was found?

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::fs;
use std::path::{Path, PathBuf};

use glam::Vec3;
use isinglass_formats::{Dtype, Endian, OpenOptions, RawShape, load_transfer, open};
use tempfile::TempDir;

const HEADER: &str = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 4 3 2\nencoding: raw\n";

fn write(folder: &TempDir, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.path().join(name);
    fs::write(&path, bytes).unwrap();
    path
}

/// The error of opening a file, checked to be one line that names the file.
fn refusal(path: &Path, options: &OpenOptions) -> String {
    let message = open(path.to_str().unwrap(), options).unwrap_err().to_string();
    assert!(message.contains(path.to_str().unwrap()), "{message}");
    assert!(!message.contains(char::is_control) && message.len() < 400, "{message:?}");
    message
}

#[test]
fn headers_that_are_wrong() {
    let folder = TempDir::new().unwrap();
    let with_voxels = |header: &str| [header.as_bytes(), b"\n", &[7; 24]].concat();
    // Negative control: without a change the file opens.
    let good = write(&folder, "good.nrrd", &with_voxels(HEADER));
    open(good.to_str().unwrap(), &OpenOptions::default()).unwrap();
    for (from, to, what) in [
        ("NRRD0004", "NRRD0009", "the first line is \"NRRD0009\", expected NRRD0001 to NRRD0005"),
        ("type: uint8\n", "", "field \"type\" is missing"),
        ("dimension: 3\n", "", "field \"dimension\" is missing"),
        ("sizes: 4 3 2\n", "", "field \"sizes\" is missing"),
        ("encoding: raw\n", "", "field \"encoding\" is missing"),
        ("uint8", "uint16", "field \"endian\" is missing"),
        ("uint8", "block", "field \"type\" is \"block\", expected int8, uint8"),
        ("uint8", "uint8\u{1b}[31m", "expected int8, uint8"),
        ("raw", "bzip2", "field \"encoding\" is \"bzip2\", expected raw, gzip or ascii"),
        ("dimension: 3", "dimension: three", "field \"dimension\" is \"three\", expected a number"),
        ("dimension: 3", "dimension: 0", "expected a number from 1 to 16"),
        ("dimension: 3", "dimension: 4", "field \"sizes\" has 3 entries, expected 4"),
        ("dimension: 3", "dimension: 3\ndimension: 3", "field \"dimension\" is given twice"),
        ("4 3 2", "4 3", "field \"sizes\" has 2 entries, expected 3"),
        ("4 3 2", "0 3 2", "field \"sizes\" is \"0 3 2\", expected positive whole numbers"),
        ("4 3 2", "4 -3 2", "expected positive whole numbers"),
        ("4 3 2", "4 3.5 2", "expected positive whole numbers"),
        ("4 3 2", "4 3 99999999999999999999", "expected positive whole numbers"),
        ("4 3 2", "4 3 4294967298", "axis 2 has 4294967298 voxels, expected 1 to 131072"),
        ("4 3 2", "2048 2048 2048", "needs 17179869184 bytes"),
        ("4 3 2", "4 3 3", "4×3×3 uint8 needs 36 bytes, found 24"),
        ("encoding: raw", "encoding: gzip\nspacings: 1 2", "field \"spacings\" has 2 entries, expected 3"),
        ("encoding: raw", "encoding: raw\nspacings: 1 0 1", "expected finite numbers above zero"),
        ("encoding: raw", "encoding: raw\nspacings: 1 1 1e9", "spacing is"),
        (
            "encoding: raw",
            "encoding: raw\nspace: above",
            "field \"space\" is \"above\", expected right-anterior",
        ),
        (
            "encoding: raw",
            "encoding: raw\nspace directions: (1,0,0) (0,1,0) (0,0,1)",
            "neither \"space\" nor",
        ),
        ("encoding: raw", "encoding: raw\nspace: RAS\nspace dimension: 3", "expected one of them"),
        ("encoding: raw", "encoding: raw\nbyte skip: -2", "field \"byte skip\" is \"-2\""),
        ("encoding: raw", "encoding: raw\nbyte skip: 1", "needs 24 bytes, found 23"),
        ("encoding: raw", "encoding: raw\nbyte skip: 18446744073709551615", "needs 24 bytes, found 0"),
        ("encoding: raw", "encoding: raw\nline skip: 9", "the file ends within the 9 lines to skip"),
        ("encoding: raw", "encoding: gzip", "gzip"),
        ("encoding: raw", "encoding: ascii", "needs 24 numbers, found 12"),
        (
            "encoding: raw",
            "encoding: ascii\n\n1 2 300 4 5 6 7 8 9 0 1 2 3 4 5 6 7",
            "number 2 is 300, expected one of type uint8",
        ),
        (
            "encoding: raw",
            "encoding: ascii\n\n1 2 3x 4 5 6 7 8 9 0 1 2 3 4 5 6 7",
            "number 2 is \"3x\", expected one of type",
        ),
        ("encoding: raw", "encoding: raw\ndata file: nowhere.raw", "nowhere.raw"),
        ("encoding: raw", "encoding: raw\ndata file: .", "found a folder, expected a regular file"),
        ("encoding: raw", "no colon here", "line 5 is \"no colon here\", expected \"field: value\""),
    ] {
        let header = HEADER.replacen(from, to, 1);
        assert_ne!(header, HEADER);
        let path = write(&folder, "bad.nrrd", &with_voxels(&header));
        let options = OpenOptions { max_bytes: 1 << 30, ..OpenOptions::default() };
        let message = open(path.to_str().unwrap(), &options).unwrap_err().to_string();
        assert!(message.contains(what), "{to:?}: {message}");
        assert!(message.contains(folder.path().to_str().unwrap()), "{message}");
        assert!(!message.contains(char::is_control) && message.len() < 400, "{message:?}");
    }
    let endless = write(&folder, "endless.nrrd", &[HEADER.as_bytes(), &b"#\n".repeat(1 << 20)].concat());
    assert!(
        refusal(&endless, &OpenOptions::default()).contains("no blank line ends it within 1048576 bytes")
    );
    let one_line = write(&folder, "line.nrrd", &[b"NRRD0004\ntype: ".as_slice(), &[b'x'; 2 << 20]].concat());
    assert!(refusal(&one_line, &OpenOptions::default()).contains("no blank line"));
    let cut = write(&folder, "cut.nrrd", HEADER.as_bytes());
    assert!(refusal(&cut, &OpenOptions::default()).contains("no blank line"));
}

#[test]
fn files_that_are_no_volume() {
    let folder = TempDir::new().unwrap();
    let options = OpenOptions::default();
    assert!(refusal(&folder.path().join("missing.nrrd"), &options).contains("missing.nrrd: "));
    assert!(refusal(folder.path(), &options).contains("found a folder"));
    assert!(refusal(&write(&folder, "empty", b""), &options).contains("found an empty file"));
    assert!(refusal(&write(&folder, "noise", b"\x01\x02\x03"), &options).contains("no header that is known"));
    for (name, what) in
        [("sphere", "\"sphere\""), ("cubus@7", "@N for N = 8 to 2048"), ("cubus@x", "8 to 2048")]
    {
        let message = open(&format!("builtin:{name}"), &options).unwrap_err().to_string();
        assert!(
            message.contains(what) && message.contains("builtin:cloud, builtin:cubus, builtin:shells"),
            "{message}"
        );
    }
    let small = OpenOptions { max_bytes: 1000, ..options };
    let message = open("builtin:cubus@16", &small).unwrap_err().to_string();
    assert_eq!(message, "builtin:cubus@16: needs 8192 bytes of memory, expected at most 1000");
}

#[test]
fn raw_files_that_do_not_fit_their_shape() {
    let folder = TempDir::new().unwrap();
    let path = write(&folder, "a.raw", &[5; 50]);
    let good = RawShape {
        dims: [4, 3, 2],
        dtype: Dtype::Int16,
        spacing: Vec3::ONE,
        endian: Endian::Little,
        offset: 2,
    };
    let with = |shape| OpenOptions { raw: Some(shape), ..OpenOptions::default() };
    let volume = open(path.to_str().unwrap(), &with(good)).unwrap();
    assert_eq!((volume.value_range(), volume.info.warnings.len()), ((1285.0, 1285.0), 0));
    let longer = open(path.to_str().unwrap(), &with(RawShape { offset: 1, ..good })).unwrap();
    assert_eq!(longer.info.warnings, ["1 bytes after the last voxel are ignored"]);
    for (shape, what) in [
        (RawShape { offset: 3, ..good }, "4×3×2 int16 from byte 3 needs 48 bytes, found 47"),
        (RawShape { offset: u64::MAX, ..good }, "needs 48 bytes, found 0"),
        (RawShape { dims: [4, 3, 3], ..good }, "needs 72 bytes, found 48"),
        (RawShape { dims: [4, 0, 2], ..good }, "dimensions are [4, 0, 2], expected 1 to 2048"),
        (RawShape { dims: [u32::MAX; 3], ..good }, "expected 1 to 2048"),
        (RawShape { dims: [2048; 3], ..good }, "needs 25769803776 bytes of memory, expected at most"),
        (RawShape { spacing: Vec3::new(1.0, -1.0, 1.0), ..good }, "expected three positive numbers"),
        (RawShape { spacing: Vec3::splat(f32::NAN), ..good }, "expected three positive numbers"),
    ] {
        let message = refusal(&path, &with(shape));
        assert!(message.contains(what), "{shape:?}: {message}");
    }
    let nrrd = write(&folder, "a.nrrd", HEADER.as_bytes());
    assert!(refusal(&nrrd, &with(good)).contains("found an NRRD file, expected raw voxels"));
}

#[test]
fn voxels_that_are_not_finite() {
    let folder = TempDir::new().unwrap();
    let file = |voxel: f32| {
        let mut voxels = [1.0f32; 24];
        voxels[17] = voxel;
        let header = HEADER.replace("uint8", "float") + "endian: little\n\n";
        let bytes: Vec<u8> = voxels.iter().flat_map(|v| v.to_le_bytes()).collect();
        write(&folder, "a.nrrd", &[header.as_bytes(), &bytes].concat())
    };
    for voxel in [2.0, -1e37] {
        open(file(voxel).to_str().unwrap(), &OpenOptions::default()).unwrap();
    }
    // What was not measured is nothing, and takes the number beside it.
    let volume = open(file(f32::NAN).to_str().unwrap(), &OpenOptions::default()).unwrap();
    assert_eq!((volume.value_range(), volume.voxels().get(17)), ((1.0, 1.0), 1.0));
    assert_eq!(volume.info.warnings[1..], ["1 voxels are not a number; nothing is shown there"]);
    for voxel in [f32::INFINITY, f32::NEG_INFINITY] {
        let volume = open(file(voxel).to_str().unwrap(), &OpenOptions::default()).unwrap();
        assert_eq!((volume.value_range(), volume.voxels().get(17)), ((1.0, 1.0), 1.0));
        assert_eq!(volume.info.warnings[1..], ["1 voxels are infinite; nothing is shown there"]);
    }
    for voxel in [f32::MAX, -1.1e37] {
        let message = refusal(&file(voxel), &OpenOptions::default());
        assert!(
            message.contains("1 voxels are NaN or infinite or too large, the first at [1, 1, 1]"),
            "{message}"
        );
    }
}

#[test]
fn transfer_functions_that_are_wrong() {
    let folder = TempDir::new().unwrap();
    let point = |x: &str| format!("[[point]]\nx = {x}\ncolor = \"#ffffff\"\nopacity = 0.5\n");
    let file = |text: &str| write(&folder, "tf.toml", text.as_bytes()).to_str().unwrap().to_owned();
    assert_eq!(load_transfer(&file(&(point("0.2") + &point("0.4")))).unwrap().points.len(), 2);
    for (text, what) in [
        (
            point("0.4") + &point("0.2"),
            "control point 1 is at 0.2, before the point at 0.4; expected ascending",
        ),
        (point("nan"), "position is NaN, expected 0 to 1"),
        (String::new(), "0 control points, expected 1 to 256"),
        (point("0.5").repeat(257), "257 control points, expected 1 to 256"),
        (point("0.5") + "colour = 3\n", "line 5: unknown field `colour`"),
        ("not toml at all".into(), "line 1"),
        ("#".repeat(8 << 20) + "\n", "found more than 8 MiB, expected control points in TOML"),
    ] {
        let path = file(&text);
        let message = load_transfer(&path).unwrap_err().to_string();
        assert!(message.starts_with(&path) && message.contains(what) && !message.contains('\n'), "{message}");
    }
    let binary = write(&folder, "binary", &[0xff, 0xfe]);
    assert!(load_transfer(binary.to_str().unwrap()).unwrap_err().to_string().contains("not UTF-8"));
    assert!(
        load_transfer(folder.path().to_str().unwrap()).unwrap_err().to_string().contains("found a folder")
    );
    let message = load_transfer("ctt").unwrap_err().to_string();
    assert!(
        message.starts_with("unknown preset \"ctt\"") && message.contains("ct, industrial, mri"),
        "{message}"
    );
}
