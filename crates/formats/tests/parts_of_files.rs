//! Files with several volumes. Every format returns the requested part, and refuses a missing one.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::fs;
use std::path::{Path, PathBuf};

use glam::Vec3;
use isinglass_core::volume::Volume;
use isinglass_formats::{FormatError, OpenOptions, Reading, Region, Selection, WarningKind, open, outline};
use tempfile::TempDir;

/// Sizes along x, y, z, channels and times.
const SIZES: [usize; 5] = [5, 4, 3, 3, 2];

/// The value of a voxel. Each voxel has a different one.
fn value(at: [usize; 5]) -> u16 {
    (at[0] + 5 * at[1] + 20 * at[2] + 100 * at[3] + 1000 * at[4]) as u16
}

/// All numbers in little-endian order, with these axes from fast to slow.
fn numbers(order: [usize; 5]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut at = [0; 5];
    for i in 0..SIZES.iter().product() {
        let mut rest = i;
        for axis in order {
            at[axis] = rest % SIZES[axis];
            rest /= SIZES[axis];
        }
        bytes.extend(value(at).to_le_bytes());
    }
    bytes
}

fn nifti(folder: &Path) -> PathBuf {
    let mut header = vec![0; 352];
    let mut put = |at: usize, bytes: &[u8]| header[at..at + bytes.len()].copy_from_slice(bytes);
    put(0, &348i32.to_le_bytes());
    for (i, dim) in [5i16, 5, 4, 3, 2, 3, 1, 1].iter().enumerate() {
        put(40 + 2 * i, &dim.to_le_bytes());
    }
    put(70, &512i16.to_le_bytes());
    for i in 0..5 {
        put(76 + 4 * i, &1f32.to_le_bytes());
    }
    put(108, &352f32.to_le_bytes());
    put(344, b"n+1\0");
    let path = folder.join("a.nii");
    fs::write(&path, [header, numbers([0, 1, 2, 4, 3])].concat()).unwrap();
    path
}

fn numpy(folder: &Path) -> PathBuf {
    let header = format!("{:<117}\n", "{'descr': '<u2', 'fortran_order': False, 'shape': (2, 3, 3, 4, 5)}");
    let path = folder.join("a.npy");
    let start = [b"\x93NUMPY\x01\x00".as_slice(), &(header.len() as u16).to_le_bytes(), header.as_bytes()];
    fs::write(&path, [&start.concat(), &numbers([0, 1, 2, 3, 4])[..]].concat()).unwrap();
    path
}

fn nrrd(folder: &Path) -> PathBuf {
    let header = "NRRD0004\ntype: ushort\ndimension: 5\nsizes: 3 5 4 3 2\nspacings: nan 1 1 1 nan\nendian: little\n\
                  kinds: RGB-color domain domain domain time\nencoding: raw\n\n";
    let path = folder.join("a.nrrd");
    fs::write(&path, [header.as_bytes(), &numbers([3, 0, 1, 2, 4])].concat()).unwrap();
    path
}

fn meta_image(folder: &Path) -> PathBuf {
    let header = "ObjectType = Image\nNDims = 4\nDimSize = 5 4 3 2\nElementSpacing = 1 1 1 1\n\
                  ElementNumberOfChannels = 3\nElementType = MET_USHORT\nElementDataFile = LOCAL\n";
    let path = folder.join("a.mha");
    fs::write(&path, [header.as_bytes(), &numbers([3, 0, 1, 2, 4])].concat()).unwrap();
    path
}

fn open_part(path: &Path, selection: Selection) -> Result<Volume, FormatError> {
    open(path.to_str().unwrap(), &OpenOptions { selection, ..OpenOptions::default() })
}

#[test]
fn channel_time_and_region_choose_the_voxels() {
    let folder = TempDir::new().unwrap();
    for path in [nifti, numpy, nrrd, meta_image].map(|write| write(folder.path())) {
        let before = outline(path.to_str().unwrap(), &OpenOptions::default()).unwrap();
        assert_eq!((before.num_channels, before.num_times), (3, 2), "{path:?}");
        let choices = before.warnings.iter().filter(|w| w.kind == WarningKind::Choice).count();
        // Only the colours of the NRRD file are shown together.
        assert_eq!(before.joins_channels, path.ends_with("a.nrrd"), "{path:?}");
        assert_eq!(choices, if before.joins_channels { 1 } else { 2 }, "{path:?}: {:?}", before.warnings);
        for (channel, time, region) in [
            (None, None, None),
            (Some(2), Some(1), None),
            (Some(1), Some(0), Some("1:4,2:,:2")),
            (Some(0), Some(1), Some(":,:,1:2")),
        ] {
            let region: Option<Region> = region.map(|r| r.parse().unwrap());
            let selection = Selection { channel, time, region, ..Selection::default() };
            let volume = open_part(&path, selection).unwrap_or_else(|e| panic!("{e}"));
            let from = region.map_or([0; 3], |r| r.min.map(|n| n as usize));
            let to =
                region.map_or([5, 4, 3], |r| [0, 1, 2].map(|k| r.max[k].map_or(SIZES[k], |n| n as usize)));
            let dims = [0, 1, 2].map(|k| to[k] - from[k]);
            assert_eq!(volume.dims(), dims.map(|n| n as u32), "{path:?} {selection:?}");
            for i in 0..dims.iter().product() {
                let at = [i % dims[0], i / dims[0] % dims[1], i / dims[0] / dims[1]];
                let expected = value([
                    from[0] + at[0],
                    from[1] + at[1],
                    from[2] + at[2],
                    channel.unwrap_or(0) as usize,
                    time.unwrap_or(0) as usize,
                ]);
                assert_eq!(volume.voxels().get(i), f32::from(expected), "{path:?} {selection:?} {at:?}");
            }
        }
    }
}

/// An OME-Zarr image of chunks of 2×2×2 voxels, in all channels and times.
fn zarr(folder: &Path) -> PathBuf {
    let path = folder.join("a.zarr");
    fs::create_dir_all(path.join("0")).unwrap();
    let image = r#"{"multiscales": [{"version": "0.4", "axes": ["t", "c", "z", "y", "x"], "datasets": [{"path": "0"}]}]}"#;
    fs::write(path.join(".zattrs"), image).unwrap();
    let array = r#"{"zarr_format": 2, "shape": [2, 3, 3, 4, 5], "chunks": [1, 1, 2, 2, 2], "dtype": "<u2",
        "compressor": null, "filters": null, "order": "C", "fill_value": 0}"#;
    fs::write(path.join("0/.zarray"), array).unwrap();
    let parts = [3, 2, 2, 3, 2];
    for n in 0..parts.iter().product() {
        let mut rest = n;
        let at = parts.map(|side| (rest % side, rest /= side).0);
        let mut bytes = Vec::new();
        for i in 0..8 {
            let inner = [2 * at[0] + i % 2, 2 * at[1] + i / 2 % 2, 2 * at[2] + i / 4, at[3], at[4]];
            bytes.extend(value(inner).to_le_bytes());
        }
        let name = at.iter().rev().map(ToString::to_string).collect::<Vec<_>>().join(".");
        fs::write(path.join("0").join(name), bytes).unwrap();
    }
    path
}

#[test]
fn thinned_volumes_have_one_voxel_in_so_many() {
    let folder = TempDir::new().unwrap();
    for path in [nifti, numpy, nrrd, meta_image, zarr].map(|write| write(folder.path())) {
        for (thin, channel, region) in [(2, Some(2), None), (3, None, None), (2, Some(1), Some("1:,:,1:"))] {
            let reading = Reading { thin: Some(thin), ..Reading::default() };
            let region: Option<Region> = region.map(|r| r.parse().unwrap());
            let selection = Selection { channel, time: Some(1), region, ..Selection::default() };
            let options = OpenOptions { selection, reading: &reading, ..OpenOptions::default() };
            let volume = open(path.to_str().unwrap(), &options).unwrap_or_else(|e| panic!("{e}"));
            let from = region.map_or([0; 3], |r| r.min.map(|n| n as usize));
            let (thin, dims) = (thin as usize, volume.dims().map(|n| n as usize));
            assert_eq!(dims, [0, 1, 2].map(|k| (SIZES[k] - from[k]).div_ceil(thin)), "{path:?}");
            assert_eq!(volume.spacing(), Vec3::splat(thin as f32));
            assert_eq!(outline(path.to_str().unwrap(), &options).unwrap().dims, volume.dims());
            for (i, one) in volume.channels().enumerate() {
                let channel = channel.map_or(i, |channel| channel as usize);
                for n in 0..dims.iter().product() {
                    let at = [n % dims[0], n / dims[0] % dims[1], n / dims[0] / dims[1]];
                    let [x, y, z] = [0, 1, 2].map(|k| from[k] + thin * at[k]);
                    let expected = f32::from(value([x, y, z, channel, 1]));
                    assert_eq!(one.voxels().get(n), expected, "{path:?} {thin} {at:?}");
                }
            }
            assert!(volume.info.warnings.iter().any(|w| w.starts_with("one voxel in ")));
        }
    }
}

#[test]
fn what_is_not_there_is_refused() {
    let folder = TempDir::new().unwrap();
    let path = numpy(folder.path());
    let part = Selection::default();
    for (selection, what) in [
        (Selection { channel: Some(3), ..part }, "channel 3 was asked for, expected 0 to 2"),
        (Selection { time: Some(2), ..part }, "time 2 was asked for, expected 0 to 1"),
        (Selection { level: Some(1), ..part }, "level 1 was asked for, expected 0 to 0"),
        (Selection { series: Some(1), ..part }, "series 1 was asked for, expected 0 to 0"),
        (
            Selection { region: Some(":,:,2:4".parse().unwrap()), ..part },
            "region 2:4 along z, expected a part of 0:3",
        ),
    ] {
        let message = open_part(&path, selection).unwrap_err().to_string();
        assert!(message.contains(what) && message.contains("a.npy"), "{message}");
    }
}

#[test]
fn spacing_can_be_told_where_the_file_is_silent() {
    let folder = TempDir::new().unwrap();
    let path = numpy(folder.path());
    let options = OpenOptions { spacing: Some(Vec3::new(0.5, 1.0, 2.0)), ..OpenOptions::default() };
    let volume = open(path.to_str().unwrap(), &options).unwrap();
    assert_eq!(volume.spacing(), Vec3::new(0.5, 1.0, 2.0));
    assert!(volume.info.warnings.iter().all(|w| !w.contains("spacing")), "{:?}", volume.info.warnings);
    let control = open(path.to_str().unwrap(), &OpenOptions::default()).unwrap();
    assert!(control.info.warnings.iter().any(|w| w.contains("spacing")));
    let nonsense = OpenOptions { spacing: Some(Vec3::new(0.5, -1.0, f32::NAN)), ..OpenOptions::default() };
    let e = open(path.to_str().unwrap(), &nonsense).unwrap_err().to_string();
    let expected =
        "the distances of voxels along its axes are 0.5, 1 and NaN, expected finite numbers above zero";
    assert!(e.contains(expected), "{e}");
}

/// A part of a large file only needs memory for the part.
#[test]
fn the_estimate_is_of_the_part_and_comes_before_the_voxels() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("a.npy");
    let header =
        format!("{:<117}\n", "{'descr': '<u2', 'fortran_order': False, 'shape': (4000, 3000, 2000)}");
    let start =
        [b"\x93NUMPY\x01\x00".as_slice(), &(header.len() as u16).to_le_bytes(), header.as_bytes()].concat();
    fs::write(&path, &start).unwrap();
    let region = Some("0:100,2900:3000,:50".parse().unwrap());
    let options =
        OpenOptions { selection: Selection { region, ..Selection::default() }, ..OpenOptions::default() };
    let before = outline(path.to_str().unwrap(), &options).unwrap();
    assert_eq!((before.dims, before.whole_dims), ([100, 100, 50], [2000, 3000, 4000]));
    assert_eq!((before.bytes_in_memory, before.bytes_while_reading), (1_500_000, 1_000_000));
    // The whole is thinned to fit into a texture.
    let whole =
        outline(path.to_str().unwrap(), &OpenOptions { max_bytes: u64::MAX, ..OpenOptions::default() });
    assert_eq!(whole.unwrap().dims, [2000, 1500, 2000]);
    let message = outline(path.to_str().unwrap(), &OpenOptions::default()).unwrap_err().to_string();
    assert!(message.contains("needs 18000000000 bytes of memory"), "{message}");
    // The file has no voxels at all.
    let message = open(path.to_str().unwrap(), &options).unwrap_err().to_string();
    assert!(message.contains("needs 48000000000 bytes, found 0"), "{message}");
    // If the file is long enough (it has a hole), the part is read and the rest skipped.
    fs::File::options().write(true).open(&path).unwrap().set_len(48_000_000_128).unwrap();
    assert_eq!(open(path.to_str().unwrap(), &options).unwrap().value_range(), (0.0, 0.0));
}

/// The time from one volume to the next, in the units of each format. Without a unit of time there is none.
#[test]
fn the_time_between_times_is_told() {
    let folder = TempDir::new().unwrap();
    let step_of = |path: &Path| outline(path.to_str().unwrap(), &OpenOptions::default()).unwrap().time_step;
    let path = nifti(folder.path());
    let bytes = fs::read(&path).unwrap();
    for (units, interval, expected) in [
        (0, 2.5f32, Some(2.5)),
        (2 + 8, 2.5, Some(2.5)),
        (2 + 16, 250.0, Some(0.25)),
        (24, 500_000.0, Some(0.5)),
        // Hertz is no time, and zero no step.
        (32, 2.5, None),
        (8, 0.0, None),
        (8, -1.0, None),
        (8, f32::NAN, None),
        (8, f32::INFINITY, None),
    ] {
        let mut bytes = bytes.clone();
        bytes[123] = units;
        bytes[92..96].copy_from_slice(&interval.to_le_bytes());
        fs::write(&path, bytes).unwrap();
        let near = |found: f64| expected.is_some_and(|e: f64| (found - e).abs() < 1e-9);
        assert_eq!(step_of(&path).map(near), expected.map(|_| true), "{units} {interval}");
    }
    assert_eq!(step_of(&numpy(folder.path())), None);
    let zarr = folder.path().join("a.zarr");
    fs::create_dir_all(zarr.join("0")).unwrap();
    fs::write(zarr.join(".zgroup"), r#"{"zarr_format": 2}"#).unwrap();
    for (number, unit, expected) in [
        (3, r#", "unit": "minute""#, Some(30.0)),
        (3, r#", "unit": "second""#, Some(0.5)),
        (3, "", None),
        (3, r#", "unit": "fortnight""#, None),
        // One time has no next one.
        (1, r#", "unit": "second""#, None),
    ] {
        let array = format!(
            r#"{{"zarr_format": 2, "shape": [{number}, 2, 2], "chunks": [1, 2, 2], "dtype": "|u1", "order": "C",
                 "compressor": null, "filters": null, "fill_value": 0}}"#
        );
        fs::write(zarr.join("0/.zarray"), array).unwrap();
        let image = format!(
            r#"{{"multiscales": [{{"version": "0.4",
                 "axes": [{{"name": "t", "type": "time"{unit}}}, {{"name": "y"}}, {{"name": "x"}}],
                 "datasets": [{{"path": "0", "coordinateTransformations":
                    [{{"type": "scale", "scale": [0.5, 1, 1]}}]}}]}}]}}"#
        );
        fs::write(zarr.join(".zattrs"), image).unwrap();
        assert_eq!(step_of(&zarr), expected, "{number} {unit}");
    }
}
