//! Small NRRD files. Every way to write the same voxels gives the same volume, and damage only causes errors.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::fs;
use std::io::Write;
use std::path::Path;

use flate2::Compression;
use flate2::write::GzEncoder;
use isinglass_core::volume::{Volume, Voxels};
use isinglass_formats::{FormatError, OpenOptions, open};
use tempfile::TempDir;

/// 5×4×3 voxels with values from −30 to 29.
const VALUES: std::ops::Range<i16> = -30..30;

fn header(fields: &str) -> Vec<u8> {
    format!("NRRD0005\n# made by a test\ndimension: 3\nsizes: 5 4 3\nspacings: 1 1 2\n{fields}\n")
        .into_bytes()
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::fast());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

fn int16(big: bool) -> Vec<u8> {
    VALUES.flat_map(|v| if big { v.to_be_bytes() } else { v.to_le_bytes() }).collect()
}

fn open_path(path: &Path) -> Result<Volume, FormatError> {
    open(path.to_str().unwrap(), &OpenOptions { max_bytes: MEMORY_LIMIT, ..OpenOptions::default() })
}

fn open_bytes(folder: &TempDir, parts: &[&[u8]]) -> Result<Volume, FormatError> {
    let path = folder.path().join("a.nrrd");
    fs::write(&path, parts.concat()).unwrap();
    open_path(&path)
}

fn values(volume: &Volume) -> Vec<f32> {
    (0..volume.voxels().len()).map(|i| volume.value_from_stored(volume.voxels().get(i))).collect()
}

/// A limit far above any file here, and far below the sizes in damaged headers.
const MEMORY_LIMIT: u64 = 1 << 20;

#[test]
fn every_way_of_writing_gives_the_same_voxels() {
    let folder = TempDir::new().unwrap();
    let expected: Vec<f32> = VALUES.map(f32::from).collect();
    let little = int16(false);
    let text: String = VALUES.map(|v| format!("{v} ")).collect();
    let (front, back) = little.split_at(50);
    let files: &[(&str, &str, Vec<u8>)] = &[
        ("raw little", "type: short\nencoding: raw\nendian: little\n", little.clone()),
        ("raw big", "type: int16\nencoding: raw\nendian: big\n", int16(true)),
        ("gzip", "type: int16_t\nencoding: gz\nendian: little\n", gzip(&little)),
        (
            "gzip in two members",
            "type: short\nencoding: gzip\nendian: little\n",
            [gzip(front), gzip(back)].concat(),
        ),
        (
            "gzip with garbage after it",
            "type: short\nencoding: gzip\nendian: little\n",
            [gzip(&little), vec![1, 2, 3]].concat(),
        ),
        ("ascii", "type: signed short\nencoding: ascii\n", text.clone().into_bytes()),
        ("ascii floats", "type: float\nencoding: text\n", text.into_bytes()),
        (
            "skips in raw data",
            "type: short\nencoding: raw\nendian: little\nline skip: 2\nbyte skip: 3\n",
            [b"one\r\ntwo\nabc".as_slice(), &little].concat(),
        ),
        (
            "skip from the end",
            "type: short\nencoding: raw\nendian: little\nbyteskip: -1\n",
            [b"anything".as_slice(), &little].concat(),
        ),
        (
            "skip inside gzip, line before it",
            "type: short\nencoding: gzip\nendian: little\nline skip: 1\nbyte skip: 4\n",
            [b"line\n".as_slice(), &gzip(&[b"four".as_slice(), &little].concat())].concat(),
        ),
        (
            "doubles",
            "type: double\nencoding: raw\nendian: big\n",
            VALUES.flat_map(|v| f64::from(v).to_be_bytes()).collect(),
        ),
        ("signed bytes", "type: signed char\nencoding: raw\n", VALUES.map(|v| v as u8).collect()),
        (
            "long integers",
            "type: long long\nencoding: raw\nendian: little\n",
            VALUES.flat_map(|v| i64::from(v).to_le_bytes()).collect(),
        ),
    ];
    for (name, fields, data) in files {
        let volume = open_bytes(&folder, &[&header(fields), data]).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(values(&volume), expected, "{name}");
        assert_eq!((volume.dims(), volume.spacing().to_array()), ([5, 4, 3], [1.0, 1.0, 2.0]), "{name}");
        assert_eq!(volume.info.warnings, [""; 0], "{name}");
    }
    for (written, unit) in
        [("\"HU\"", Some("HU")), (" Bq/ml ", Some("Bq/ml")), ("\"\"", None), ("none", None)]
    {
        let fields = format!("{}sample units: {written}\n", files[0].1);
        let volume = open_bytes(&folder, &[&header(&fields), &files[0].2]).unwrap();
        assert_eq!((volume.info.value_unit.as_deref(), volume.info.warnings.len()), (unit, 0), "{written}");
    }
    let same = |v: &Volume| matches!(v.voxels(), Voxels::U16(_));
    assert!(same(&open_bytes(&folder, &[&header(files[0].1), &files[0].2]).unwrap()), "16 bits stay 16 bits");
    // Negative control: the comparison notices a wrong byte order.
    let swapped = open_bytes(&folder, &[&header(files[0].1), &int16(true)]).unwrap();
    assert_ne!(values(&swapped), expected);
}

#[test]
fn detached_voxels_are_found_beside_their_header() {
    let folder = TempDir::new().unwrap();
    let expected: Vec<f32> = VALUES.map(f32::from).collect();
    let fields = "type: short\nencoding: raw\nendian: little\n";
    let little = int16(false);
    fs::create_dir(folder.path().join("my data")).unwrap();
    fs::write(folder.path().join("my data/all.raw"), &little).unwrap();
    for (i, slice) in little.chunks(40).enumerate() {
        fs::write(folder.path().join(format!("slice{:02}.raw", i + 1)), slice).unwrap();
    }
    let path = folder.path().join("a.nhdr");
    for data in [
        "data file: my data/all.raw\n",
        "datafile: ./my data/all.raw",
        "data file: slice%02d.raw 1 3 1 2\n",
        "data file: LIST 2\nslice01.raw\nslice02.raw\nslice03.raw\n",
        "byte skip: -1\ndata file: slice%02d.raw 1 3 1\n\nafter the header",
    ] {
        fs::write(&path, [header(fields).trim_ascii_end(), b"\n", data.as_bytes()].concat()).unwrap();
        let volume = open_path(&path).unwrap_or_else(|e| panic!("{data}: {e}"));
        assert_eq!(values(&volume), expected, "{data}");
    }
    let seven = format!("data file: LIST\n{}", "slice01.raw\n".repeat(7));
    for (data, what) in [
        ("data file: slice%02d.raw 1 4 1\n", r#"a.nhdr: its data file "slice04.raw" is missing"#),
        (&seven, "7 data files cannot share 60 voxels"),
        ("data file: LIST\nslice01.raw\nslice02.raw\n", "slice01.raw: 5×4×3 int16 needs 60 bytes, found 40"),
    ] {
        fs::write(&path, [header(fields).trim_ascii_end(), b"\n", data.as_bytes()].concat()).unwrap();
        let message = open_path(&path).unwrap_err().to_string();
        assert!(message.contains(what), "{data}: {message}");
    }
}

#[test]
fn more_data_than_the_shape_needs_is_a_warning() {
    let folder = TempDir::new().unwrap();
    let longer = [int16(false), vec![0; 2]].concat();
    let fields = |encoding: &str| header(&format!("type: short\nendian: little\nencoding: {encoding}\n"));
    for (encoding, data) in [("raw", longer.clone()), ("gzip", gzip(&longer)), ("ascii", b"1 ".repeat(61))] {
        let volume = open_bytes(&folder, &[&fields(encoding), &data]).unwrap();
        assert_eq!(volume.info.warnings, ["a.nrrd has more data than its shape needs; the rest is ignored"]);
    }
}

#[test]
fn compressed_data_cannot_lie_about_its_size() {
    let folder = TempDir::new().unwrap();
    let open_gzip = |sizes: &str, data: &[u8]| {
        let header = format!(
            "NRRD0004\ntype: uint8\ndimension: 3\nsizes: {sizes}\nspacings: 1 1 1\nencoding: gzip\n\n"
        );
        open_bytes(&folder, &[header.as_bytes(), data])
    };
    // The file has 64 MiB of zeros in 64 KiB. Only 60 voxels are decompressed, so the memory limit holds.
    let bomb = gzip(&vec![0; 64 << 20]);
    assert_eq!(open_gzip("5 4 3", &bomb).unwrap().info.warnings.len(), 1);
    let message = open_gzip("2048 2048 16", &bomb).unwrap_err().to_string();
    assert!(message.contains("needs 134217728 bytes of memory, expected at most 1048576"), "{message}");
    // A file that is too short is refused before memory is allocated.
    let message = open_gzip("50 100 100", &gzip(&[0; 60])).unwrap_err().to_string();
    assert!(message.contains("50×100×100 uint8 needs 500000 bytes, found"), "{message}");
    // Negative control: the undamaged file opens.
    let noise: Vec<u8> = (0..60u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let packed = gzip(&noise);
    assert!(open_gzip("5 4 3", &packed).unwrap().info.warnings.is_empty());
    for cut in [packed.len() - 1, packed.len() - 8, packed.len() / 2, 12, 3, 0] {
        let message = open_gzip("5 4 3", &packed[..cut]).unwrap_err().to_string();
        assert!(message.contains("damaged") || message.contains("needs 60 bytes"), "{cut}: {message}");
    }
    let mut flipped = packed.clone();
    let crc = flipped.len() - 6;
    flipped[crc] ^= 1;
    assert!(
        open_gzip("5 4 3", &flipped).unwrap_err().to_string().contains("damaged"),
        "the checksum is verified"
    );
}

/// A step of xorshift64, which is the same on every machine.
fn next_random(state: &mut u64) -> u64 {
    *state ^= *state << 13;
    *state ^= *state >> 7;
    *state ^= *state << 17;
    *state
}

#[test]
fn damaged_files_are_errors_or_volumes_but_never_panics() {
    let folder = TempDir::new().unwrap();
    let little = int16(false);
    let oriented = "type: short\nencoding: raw\nendian: little\nspace: LPS\nspace units: \"mm\" \"mm\" \"mm\"\n\
                    space directions: (0,-1,0) (1,0,0) (0,0,2)\nspace origin: (0,0,0)\nkinds: domain domain domain\n";
    let text: String = VALUES.map(|v| format!("{v}\n")).collect();
    let seeds: [Vec<u8>; 4] = [
        [header("type: short\nencoding: raw\nendian: big\nline skip: 0\nbyte skip: 0\n"), little.clone()]
            .concat(),
        [header("type: short\nencoding: gzip\nendian: little\n"), gzip(&little)].concat(),
        [header("type: short\nencoding: ascii\n"), text.into_bytes()].concat(),
        [header(oriented), little].concat(),
    ];
    let mut random = 0x9e37_79b9_7f4a_7c15;
    let (mut num_errors, mut num_volumes) = (0, 0);
    for seed in &seeds {
        for round in 0..400 {
            let mut bytes = seed.clone();
            if round % 3 == 0 {
                bytes.truncate(next_random(&mut random) as usize % bytes.len());
            }
            for _ in 0..next_random(&mut random) % 4 {
                let at = next_random(&mut random) as usize % bytes.len().max(1);
                // Digits damage numbers, and other bytes damage words.
                let value = next_random(&mut random);
                let byte = if value & 1 == 0 { b'0' + (value >> 8) as u8 % 10 } else { (value >> 8) as u8 };
                if let Some(b) = bytes.get_mut(at) {
                    *b = byte;
                }
            }
            match open_bytes(&folder, &[&bytes]) {
                Ok(volume) => {
                    num_volumes += 1;
                    let voxels = volume.voxels();
                    assert!((voxels.len() * voxels.bytes_per_voxel()) as u64 <= MEMORY_LIMIT);
                    assert_eq!(volume.dims().iter().product::<u32>() as usize, volume.voxels().len());
                }
                Err(e) => {
                    num_errors += 1;
                    let message = e.to_string();
                    assert!(!message.contains(char::is_control) && message.len() < 600, "{message:?}");
                }
            }
        }
    }
    // Some inputs must fail, and some must open.
    assert!(num_errors > 200 && num_volumes > 200, "{num_errors} errors, {num_volumes} volumes");
}
