//! Several channels at once: which are read together, in one pass, and what the file says about each.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use flate2::Compression;
use flate2::write::GzEncoder;
use isinglass_core::volume::{MAX_CHANNELS, Volume};
use isinglass_formats::{OpenOptions, Outline, Selection, open, outline};
use tempfile::TempDir;

const DIMS: [usize; 3] = [5, 4, 3];
const NUM_VOXELS: usize = 60;

/// The number of voxel `i` in a channel.
fn value(i: usize, channel: usize) -> u8 {
    (i + 64 * channel) as u8
}

/// An NRRD file whose `kind` axis comes first, in gzip.
fn nrrd(folder: &Path, kind: &str, num_channels: usize) -> PathBuf {
    let header = format!(
        "NRRD0004\ntype: uchar\ndimension: 4\nsizes: {num_channels} 5 4 3\nspacings: nan 1 1 1\n\
         kinds: {kind} domain domain domain\nencoding: gzip\n\n"
    );
    let numbers: Vec<u8> =
        (0..NUM_VOXELS).flat_map(|i| (0..num_channels).map(move |channel| value(i, channel))).collect();
    let mut packed = GzEncoder::new(Vec::new(), Compression::fast());
    packed.write_all(&numbers).unwrap();
    let path = folder.join(format!("{kind}{num_channels}.nrrd"));
    fs::write(&path, [header.as_bytes(), &packed.finish().unwrap()].concat()).unwrap();
    path
}

/// An OME-Zarr image of plain bytes, with its axes c, z, y and x. Chunks are 2 channels, 2 slices and 3×3 voxels.
fn zarr(folder: &Path, num_channels: usize, omero: &str) -> PathBuf {
    let path = folder.join(format!("{num_channels}.zarr"));
    let axes = r#"{"name": "c", "type": "channel"}, {"name": "z", "type": "space"},
                  {"name": "y", "type": "space"}, {"name": "x", "type": "space"}"#;
    let text = format!(
        r#"{{"multiscales": [{{"version": "0.4", "axes": [{axes}], "datasets": [{{"path": "0"}}]}}]{omero}}}"#
    );
    fs::create_dir_all(path.join("0")).unwrap();
    fs::write(path.join(".zgroup"), r#"{"zarr_format": 2}"#).unwrap();
    fs::write(path.join(".zattrs"), text).unwrap();
    let [x, y, z] = DIMS;
    let array = format!(
        r#"{{"zarr_format": 2, "shape": [{num_channels}, {z}, {y}, {x}], "chunks": [2, 2, 3, 3], "dtype": "|u1",
             "compressor": null, "filters": null, "order": "C", "fill_value": 0, "dimension_separator": "."}}"#
    );
    fs::write(path.join("0/.zarray"), array).unwrap();
    let chunks = [num_channels.div_ceil(2), 2, 2, 2];
    for n in 0..chunks.iter().product() {
        let at = [n / 8, n / 4 % 2, n / 2 % 2, n % 2];
        let mut bytes = Vec::new();
        for i in 0..36 {
            let inner = [i / 18, i / 9 % 2, i / 3 % 3, i % 3];
            let [c, k, j, i] = [0, 1, 2, 3].map(|axis| at[axis] * [2, 2, 3, 3][axis] + inner[axis]);
            let is_in = c < num_channels && k < z && j < y && i < x;
            bytes.push(if is_in { value(i + x * (j + y * k), c) } else { 255 });
        }
        let name = at.map(|n| n.to_string()).join(".");
        fs::write(path.join("0").join(name), bytes).unwrap();
    }
    path
}

fn options(channel: Option<u32>) -> OpenOptions<'static> {
    let selection = Selection { channel, ..Selection::default() };
    OpenOptions { selection, ..OpenOptions::default() }
}

fn opened(path: &Path, options: &OpenOptions) -> (Volume, Outline) {
    let source = path.to_str().unwrap();
    (open(source, options).unwrap_or_else(|e| panic!("{e}")), outline(source, options).unwrap())
}

/// The channels of a volume must be the first ones of the file.
fn check_values(volume: &Volume, num_channels: usize) {
    let found: Vec<Vec<f32>> =
        volume.channels().map(|v| (0..v.voxels().len()).map(|i| v.voxels().get(i)).collect()).collect();
    let expected: Vec<Vec<f32>> = (0..num_channels)
        .map(|channel| (0..NUM_VOXELS).map(|i| f32::from(value(i, channel))).collect())
        .collect();
    assert_eq!(found, expected);
}

#[test]
fn colours_are_channels_of_their_own_colour() {
    let folder = TempDir::new().unwrap();
    for (kind, num_channels) in [("RGB-color", 3), ("RGBA-color", 4)] {
        let path = nrrd(folder.path(), kind, num_channels);
        let (volume, before) = opened(&path, &options(None));
        check_values(&volume, 3);
        let looks: Vec<_> = volume
            .channels()
            .map(|v| (&v.info.channel.name[..], v.info.channel.color, v.info.window))
            .collect();
        let window = Some((0.0, 255.0));
        assert_eq!(looks[0], ("red", Some([255, 0, 0]), window));
        assert_eq!(looks[1], ("green", Some([0, 255, 0]), window));
        assert_eq!(looks[2], ("blue", Some([0, 0, 255]), window));
        assert_eq!((before.shown.channel, before.joins_channels), (None, true));
        assert_eq!(before.bytes_in_memory, 4 * NUM_VOXELS as u64);
        assert_eq!(volume.bytes_in_memory(), before.bytes_in_memory);
        assert_eq!(before.bytes_while_reading, 3 * NUM_VOXELS as u64);
        assert!(before.to_string().contains(", blue") && before.to_string().contains("(shown together)"));
        let text = "the file has 4 channels (red, green, blue, alpha), of which the first 3 are shown";
        assert_eq!(volume.info.warnings.iter().any(|w| w == text), num_channels == 4, "{:?}", volume.info);
        // A channel alone.
        let (one, before) = opened(&path, &options(Some(2)));
        assert_eq!((one.others().len(), one.voxels().get(1)), (0, 129.0));
        assert_eq!((one.info.channel.name.as_str(), before.shown.channel), ("blue", Some(2)));
        assert_eq!(before.bytes_in_memory, 2 * NUM_VOXELS as u64);
    }
}

#[test]
fn components_that_are_no_colours_are_not_shown_together() {
    let folder = TempDir::new().unwrap();
    for kind in ["vector", "3-vector", "3-gradient", "list", "3-normal"] {
        let (volume, before) = opened(&nrrd(folder.path(), kind, 3), &options(None));
        check_values(&volume, 1);
        assert_eq!((before.shown.channel, before.joins_channels), (Some(0), false), "{kind}");
        assert!(volume.info.warnings.iter().any(|w| w == "the file has 3 channels, of which 0 is shown"));
    }
}

#[test]
fn omero_names_and_colours_channels_in_chunks_of_several() {
    let folder = TempDir::new().unwrap();
    let omero = r#", "omero": {"channels": [
        {"label": "DAPI", "color": "0000FF", "active": true, "window": {"start": 5, "end": 50}},
        {"label": "GFP", "color": "00ff7F", "active": false},
        {"color": "no colour"}]}"#;
    let (volume, before) = opened(&zarr(folder.path(), 3, omero), &options(None));
    check_values(&volume, 3);
    let looks: Vec<_> = volume.channels().map(|v| (v.info.channel.clone(), v.info.window)).collect();
    let look = |i: usize| (&looks[i].0.name[..], looks[i].0.color, looks[i].0.is_hidden, looks[i].1);
    assert_eq!(look(0), ("DAPI", Some([0, 0, 255]), false, Some((5.0, 50.0))));
    assert_eq!(look(1), ("GFP", Some([0, 255, 127]), true, None));
    assert_eq!(look(2), ("2", None, false, None));
    assert_eq!((before.shown.channel, before.joins_channels), (None, true));
    // A colour that all channels have says nothing.
    let same = r#", "omero": {"channels": [{"color": "FFFFFF"}, {"color": "FFFFFF"}]}"#;
    let (volume, _) = opened(&zarr(folder.path(), 2, same), &options(None));
    check_values(&volume, 2);
    assert!(volume.channels().all(|v| v.info.channel.color.is_none()));
    // An array without an image may have any axes.
    let (volume, before) = opened(&folder.path().join("3.zarr/0"), &options(None));
    check_values(&volume, 1);
    assert!(!before.joins_channels);
}

#[test]
fn eight_channels_are_shown_at_most() {
    let folder = TempDir::new().unwrap();
    let (volume, before) = opened(&zarr(folder.path(), 11, ""), &options(None));
    check_values(&volume, MAX_CHANNELS);
    assert_eq!((before.num_channels, before.shown.channel), (11, None));
    let text = "the file has 11 channels, of which the first 8 are shown";
    assert!(volume.info.warnings.iter().any(|w| w == text), "{:?}", volume.info.warnings);
    let (volume, _) = opened(&folder.path().join("11.zarr"), &options(Some(10)));
    assert_eq!(volume.voxels().get(0), f32::from(value(0, 10)));
}

#[test]
fn one_channel_is_shown_where_all_do_not_fit() {
    let folder = TempDir::new().unwrap();
    let n = NUM_VOXELS as u64;
    for path in [zarr(folder.path(), 3, ""), nrrd(folder.path(), "RGB-color", 3)] {
        // Three channels, and the brightness of each voxel.
        let (volume, _) = opened(&path, &OpenOptions { max_bytes: 4 * n, ..options(None) });
        check_values(&volume, 3);
        let (volume, before) = opened(&path, &OpenOptions { max_bytes: 4 * n - 1, ..options(None) });
        check_values(&volume, 1);
        assert_eq!((before.shown.channel, before.joins_channels), (Some(0), true));
        let text = "of which 0 is shown; all together need 240 of 239 bytes of memory";
        assert!(volume.info.warnings.iter().any(|w| w.contains(text)), "{:?}", volume.info.warnings);
    }
}

#[test]
fn a_channel_without_any_value_is_empty_and_hides_no_other() {
    let folder = TempDir::new().unwrap();
    let path = zarr(folder.path(), 3, "");
    let array = r#"{"zarr_format": 2, "shape": [3, 3, 4, 5], "chunks": [1, 3, 4, 5], "dtype": "<f4",
        "compressor": null, "filters": null, "order": "C", "fill_value": 0, "dimension_separator": "/"}"#;
    fs::write(path.join("0/.zarray"), array).unwrap();
    let write = |channel: usize, number: &dyn Fn(usize) -> f32| {
        let bytes: Vec<u8> = (0..NUM_VOXELS).flat_map(|i| number(i).to_le_bytes()).collect();
        fs::create_dir_all(path.join(format!("0/{channel}/0/0"))).unwrap();
        fs::write(path.join(format!("0/{channel}/0/0/0")), bytes).unwrap();
    };
    for empty in 0..3 {
        for channel in 0..3 {
            write(channel, &|i| if channel == empty { f32::NAN } else { (i + 10 * channel) as f32 });
        }
        let (volume, _) = opened(&path, &options(None));
        for (channel, found) in volume.channels().enumerate() {
            assert_eq!(found.info.channel.is_hidden, channel == empty);
            let expected = if channel == empty {
                (0.0, 0.0)
            } else {
                (10.0 * channel as f32, 59.0 + 10.0 * channel as f32)
            };
            assert_eq!(found.value_range(), expected);
        }
        let warnings = volume.info.warnings.join("\n");
        assert_eq!(
            warnings.matches("no voxel has a value; the channel is empty and hidden").count(),
            1,
            "{warnings}"
        );
        // Alone it is no volume.
        let alone = open(path.to_str().unwrap(), &options(Some(empty as u32)));
        assert!(alone.is_err());
    }
    (0..3).for_each(|channel| write(channel, &|_| f32::NAN));
    assert!(open(path.to_str().unwrap(), &options(None)).is_err());
}
