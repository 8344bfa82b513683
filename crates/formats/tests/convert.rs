//! Pyramids that `convert` makes: the finest level is the source to the bit, coarser ones are means or majorities, and all
//! lie where the source does.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

mod support;

use std::cell::Cell;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use glam::Vec3;
use isinglass_core::volume::{Volume, Voxels};
use isinglass_formats::{
    Conversion, Converted, Dtype, Endian, FormatError, Meaning, OpenOptions, RawShape, Reading, Selection,
    open, outline,
};
use serde_json::Value;
use support::unpack;
use tempfile::TempDir;

fn converted(source: &Path, target: &Path, options: &OpenOptions) -> Result<Converted, FormatError> {
    Conversion::begin(source.to_str().unwrap(), target, options)?.run()
}

fn part(channel: u32, time: u32, level: u32) -> Selection {
    Selection { channel: Some(channel), time: Some(time), level: Some(level), ..Selection::default() }
}

fn opened(source: &Path, selection: Selection) -> Volume {
    let options = OpenOptions { selection, ..OpenOptions::default() };
    open(source.to_str().unwrap(), &options).unwrap_or_else(|e| panic!("{e}"))
}

fn raw(dims: [u32; 3], dtype: Dtype, endian: Endian, spacing: [f32; 3]) -> Option<RawShape> {
    Some(RawShape { dims, dtype, spacing: Vec3::from(spacing), endian, offset: 0 })
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

/// All files below a folder with their bytes, sorted.
fn tree(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                found.push((path.strip_prefix(folder).unwrap().to_owned(), fs::read(&path).unwrap()));
            }
        }
    }
    found.sort();
    found
}

/// Decodes an array of chunks without the product's reader: Zarr 2, little-endian, blosc of one block of zstd with a byte
/// shuffle, or none. Returns the shape and the bytes of all numbers, the last axis fastest.
fn decoded(array: &Path) -> (Vec<usize>, Vec<u8>) {
    let about = json(&array.join(".zarray"));
    let list = |key: &str| -> Vec<usize> {
        about[key].as_array().unwrap().iter().map(|n| n.as_u64().unwrap() as usize).collect()
    };
    let (shape, chunk) = (list("shape"), list("chunks"));
    assert_eq!((&about["zarr_format"], &about["order"]), (&2.into(), &"C".into()));
    assert_eq!(about["compressor"]["cname"], "zstd");
    let size: usize = about["dtype"].as_str().unwrap()[2..].parse().unwrap();
    let mut all = vec![0u8; shape.iter().product::<usize>() * size];
    let counts: Vec<usize> = shape.iter().zip(&chunk).map(|(n, c)| n.div_ceil(*c)).collect();
    for number in 0..counts.iter().product::<usize>() {
        let mut rest = number;
        let mut at = vec![0; shape.len()];
        for axis in (0..shape.len()).rev() {
            (at[axis], rest) = (rest % counts[axis], rest / counts[axis]);
        }
        let name: Vec<String> = at.iter().map(usize::to_string).collect();
        let numbers = container(&fs::read(array.join(name.join("/"))).unwrap(), size);
        assert_eq!(numbers.len(), chunk.iter().product::<usize>() * size);
        for i in 0..numbers.len() / size {
            let (mut rest, mut place, mut stride, mut is_inside) = (i, 0, 1, true);
            for axis in (0..shape.len()).rev() {
                let index = at[axis] * chunk[axis] + rest % chunk[axis];
                rest /= chunk[axis];
                is_inside &= index < shape[axis];
                place += index * stride;
                stride *= shape[axis];
            }
            if is_inside {
                all[place * size..][..size].copy_from_slice(&numbers[i * size..][..size]);
            }
        }
    }
    (shape, all)
}

/// Decodes a blosc container.
fn container(bytes: &[u8], size: usize) -> Vec<u8> {
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    assert_eq!((bytes[0], usize::from(bytes[3]), word(12)), (2, size, bytes.len()));
    if bytes[2] & 2 != 0 {
        return bytes[16..].to_vec();
    }
    assert_eq!((bytes[2] >> 5, word(4)), (4, word(8)), "zstd in one block");
    let at = word(16);
    let shuffled = zstd::bulk::decompress(&bytes[at + 4..at + 4 + word(at)], word(4)).unwrap();
    let n = shuffled.len() / size;
    (0..shuffled.len()).map(|i| shuffled[i % size * n + i / size]).collect()
}

/// Checks that two volumes are the same in all that a file can tell.
fn check_same(found: &Volume, source: &Volume, name: &str) {
    assert_eq!(found.dims(), source.dims(), "{name}");
    assert!(found.voxels() == source.voxels(), "{name}: voxels differ");
    assert_eq!(found.gaps().map(|g| &g.bytes), source.gaps().map(|g| &g.bytes), "{name}");
    let is_near = |a: f64, b: f64| (a - b).abs() <= 1e-5 * a.abs().max(b.abs()).max(1.0);
    let ((a, b), (c, d)) = (found.value_map(), source.value_map());
    assert!(is_near(a.into(), c.into()) && is_near(b.into(), d.into()), "{name}: {a} {b} {c} {d}");
    assert!(
        (found.spacing() - source.spacing()).abs().max_element() <= 1e-5 * source.spacing().max_element(),
        "{name}"
    );
    let (a, b) = (&found.info, &source.info);
    assert_eq!(a.dtype, b.dtype, "{name}");
    assert_eq!(a.unit, b.unit, "{name}");
    assert_eq!(a.orientation, b.orientation, "{name}");
    assert_eq!((a.are_labels, &a.labels), (b.are_labels, &b.labels), "{name}");
    assert_eq!((&a.value_unit, &a.modality), (&b.value_unit, &b.modality), "{name}");
    assert_eq!(a.channel.color, b.channel.color, "{name}");
    assert_eq!(a.window.is_some(), b.window.is_some(), "{name}");
    match (a.placement, b.placement) {
        (Some(a), Some(b)) => {
            assert!(a.center.iter().zip(b.center).all(|(a, b)| is_near(*a, b)), "{name}: {a:?} {b:?}");
        }
        (a, b) => assert_eq!(a.is_some(), b.is_some(), "{name}: position"),
    }
}

/// Every file that other libraries wrote keeps its voxels, values, place and meaning.
#[test]
fn every_format_becomes_the_same_volume() {
    let mut num = 0;
    for archive in [
        "nrrd",
        "nifti",
        "metaimage",
        "tiff",
        "vti",
        "mrc",
        "numpy",
        "zarr",
        "packed",
        "dicom",
        "calibrated",
        "hdf5",
        "hdf5_axes",
    ] {
        let folder = unpack(archive);
        let out = TempDir::new().unwrap();
        let mut paths: Vec<PathBuf> =
            fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().path()).collect();
        paths.sort();
        for source in paths {
            let text = source.to_str().unwrap();
            let Ok(before) = outline(text, &OpenOptions::default()) else { continue };
            let name = format!("{archive}/{}", before.name);
            let target = out.path().join(format!("{num}.ome.zarr"));
            let done = converted(&source, &target, &OpenOptions::default());
            done.unwrap_or_else(|e| panic!("{name}: {e}"));
            num += 1;
            for channel in 0..before.num_channels as u32 {
                for time in 0..before.num_times as u32 {
                    let selection = part(channel, time, 0);
                    check_same(&opened(&target, selection), &opened(&source, selection), &name);
                }
            }
        }
        let leftovers = fs::read_dir(out.path())
            .unwrap()
            .filter(|e| !e.as_ref().unwrap().file_name().to_string_lossy().ends_with(".ome.zarr"));
        assert_eq!(leftovers.count(), 0, "{archive}");
    }
    assert!(num > 250, "{num}");
}

/// Each type of either byte order is there to the bit, read by an independent decoder, from memory or from a file.
#[test]
fn every_type_is_kept_to_the_bit() {
    let folder = TempDir::new().unwrap();
    let dims = [70u32, 65, 66];
    let num = dims.iter().product::<u32>() as usize;
    for dtype in Dtype::ALL {
        let size = dtype.num_bytes();
        let mut bytes: Vec<u8> = (0..num * size).map(|i| (i * i / 7 + i) as u8).collect();
        if matches!(dtype, Dtype::Half | Dtype::Float | Dtype::Double) {
            // No number may be infinite or NaN in a raw file.
            bytes.iter_mut().skip(size - 1).step_by(size).for_each(|byte| *byte &= 0xbb);
        }
        for (endian, max_bytes) in
            [(Endian::Little, 1 << 30), (Endian::Big, 1 << 30), (Endian::Big, 80 << 20)]
        {
            let source = folder.path().join("a.raw");
            let mut stored = bytes.clone();
            if endian == Endian::Big {
                stored.chunks_exact_mut(size).for_each(<[u8]>::reverse);
            }
            fs::write(&source, &stored).unwrap();
            let target = folder.path().join("a.ome.zarr");
            let options =
                OpenOptions { raw: raw(dims, dtype, endian, [1.0; 3]), max_bytes, ..OpenOptions::default() };
            converted(&source, &target, &options).unwrap();
            let (shape, found) = decoded(&target.join("0"));
            assert_eq!(shape, [66, 65, 70]);
            assert!(found == bytes, "{} {endian:?}", dtype.name());
            // The control: the other byte order is another volume.
            assert!(size == 1 || endian == Endian::Little || found != stored);
            fs::remove_dir_all(&target).unwrap();
        }
    }
}

/// Numbers of a volume that look random, with gaps.
fn noise(dims: [usize; 3], gap: Option<f32>) -> Vec<f32> {
    let mut random = 7u32;
    let mut next = || {
        random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        random >> 16
    };
    let number = |_| match gap {
        Some(gap) if next() % 3 == 0 => gap,
        _ => (next() % 1000) as f32,
    };
    (0..dims.iter().product::<usize>()).map(number).collect()
}

/// Groups of voxels that become one, in the order of the coarser level.
fn groups(fine: &[f32], dims: [usize; 3], factors: [usize; 3]) -> Vec<Vec<f32>> {
    let coarse = [0, 1, 2].map(|k| dims[k].div_ceil(factors[k]));
    let mut groups = vec![Vec::new(); coarse.iter().product()];
    for (i, x) in fine.iter().enumerate() {
        let at = [
            i % dims[0] / factors[0],
            i / dims[0] % dims[1] / factors[1],
            i / dims[0] / dims[1] / factors[2],
        ];
        groups[(at[2] * coarse[1] + at[1]) * coarse[0] + at[0]].push(*x);
    }
    groups
}

#[test]
fn coarser_levels_are_means_of_what_has_a_value() {
    let folder = TempDir::new().unwrap();
    let (dims, side) = ([131usize, 130, 67], [131u32, 130, 67]);
    for (spacing, gap, factors) in [
        ([1.0, 1.0, 1.0], None, [2usize, 2, 2]),
        ([1.0, 1.0, 2.0], None, [2, 2, 1]),
        ([1.0, 1.0, 1.0], Some(f32::NAN), [2, 2, 2]),
        ([1.0, 1.0, 2.0], Some(-99_999.0), [2, 2, 1]),
    ] {
        let fine = noise(dims, gap);
        let source = folder.path().join("a.nrrd");
        let header = format!(
            "NRRD0004\ntype: float\ndimension: 3\nsizes: {} {} {}\nspacings: {} {} {}\nendian: little\nencoding: raw\n\n",
            side[0], side[1], side[2], spacing[0], spacing[1], spacing[2]
        );
        let numbers: Vec<u8> = fine.iter().flat_map(|x| x.to_le_bytes()).collect();
        fs::write(&source, [header.as_bytes(), &numbers].concat()).unwrap();
        let target = folder.path().join("a.ome.zarr");
        converted(&source, &target, &OpenOptions::default()).unwrap();
        let (shape, bytes) = decoded(&target.join("1"));
        let expected = [0, 1, 2].map(|k| dims[2 - k].div_ceil(factors[2 - k]));
        assert_eq!(shape, expected);
        let found = bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b));
        let (mut num_gaps, mut num_plain) = (0, 0);
        for (found, group) in found.zip(groups(&fine, dims, factors)) {
            let is_gap = |x: &f32| gap.is_some_and(|gap| gap.to_bits() == x.to_bits());
            let valid: Vec<f64> = group.iter().filter(|x| !is_gap(x)).map(|x| f64::from(*x)).collect();
            if valid.is_empty() {
                num_gaps += 1;
                assert_eq!(Some(found.to_bits()), gap.map(f32::to_bits));
                continue;
            }
            let mean = |list: &[f64]| (list.iter().sum::<f64>() / list.len() as f64) as f32;
            assert_eq!(found, mean(&valid));
            let plain: Vec<f64> = group.iter().map(|x| f64::from(*x)).collect();
            num_plain += u32::from(mean(&plain).to_bits() != found.to_bits());
        }
        // The controls: there are groups without any value, and a plain mean differs.
        assert_eq!((num_gaps > 0, num_plain > 0), (gap.is_some(), gap.is_some()));
        // The reader finds the same gaps at every level.
        let gaps = |level| opened(&target, part(0, 0, level)).gaps().map_or(0, |gaps| gaps.num_gaps);
        assert_eq!((gaps(0) > 0, gaps(1)), (gap.is_some(), num_gaps));
        fs::remove_dir_all(&target).unwrap();
    }
}

#[test]
fn labels_become_those_that_are_most_frequent() {
    let folder = TempDir::new().unwrap();
    let dims = [140usize, 133, 20];
    // Few numbers in blocks, which nobody calls labels.
    let label = |i: usize| {
        let [x, y, z] = [i % dims[0], i / dims[0] % dims[1], i / dims[0] / dims[1]].map(|n| n as i32);
        let r = (x - 70).pow(2) + (y - 66).pow(2) + (z - 10).pow(2);
        if r < 900 {
            9u16
        } else if r < 2500 {
            300
        } else {
            0
        }
    };
    let fine: Vec<u16> = (0..dims.iter().product()).map(label).collect();
    let source = folder.path().join("a.raw");
    fs::write(&source, fine.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<_>>()).unwrap();
    let shape = raw([140, 133, 20], Dtype::Uint16, Endian::Little, [1.0; 3]);
    let values = Reading { voxels: Some(Meaning::Values), ..Reading::default() };
    for (reading, are_labels) in [(&Reading::default(), true), (&values, false)] {
        let target = folder.path().join("a.ome.zarr");
        let options = OpenOptions { raw: shape, reading, ..OpenOptions::default() };
        assert_eq!(converted(&source, &target, &options).unwrap().are_labels, are_labels);
        let (_, bytes) = decoded(&target.join("1"));
        let found = bytes.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b));
        let fine: Vec<f32> = fine.iter().map(|x| f32::from(*x)).collect();
        let mut num_strange = 0;
        for (found, group) in found.zip(groups(&fine, dims, [2; 3])) {
            let count = |x: f32| group.iter().filter(|y| **y == x).count();
            let most = group.iter().map(|x| count(*x)).max().unwrap();
            num_strange += u32::from(count(f32::from(found)) == 0);
            assert!(!are_labels || count(f32::from(found)) == most);
        }
        // The control: means make labels that are not there.
        assert_eq!(num_strange == 0, are_labels, "{num_strange}");
        assert_eq!(opened(&target, part(0, 0, 1)).info.are_labels, are_labels);
        fs::remove_dir_all(&target).unwrap();
    }
}

/// A ramp in world space is the same ramp at every level, as far as numbers are rounded.
#[test]
fn every_level_lies_where_the_volume_does() {
    let folder = TempDir::new().unwrap();
    let dims = [256u32, 192, 144];
    let source = folder.path().join("a.nrrd");
    let header = "NRRD0004\ntype: double\ndimension: 3\nspace: left-posterior-superior\nsizes: 256 192 144\n\
         space directions: (-0.5,0,0) (0,0.75,0) (0,0,2)\nspace origin: (10,-20,30)\nendian: little\nencoding: raw\n\n";
    // The ramp of the position in RAS.
    let value = |[x, y, z]: [f64; 3]| 3.0 * x - 2.0 * y + 0.5 * z;
    let number = |i: u32| {
        let [i, j, k] = [i % dims[0], i / dims[0] % dims[1], i / dims[0] / dims[1]].map(f64::from);
        value([-(10.0 - 0.5 * i), -(-20.0 + 0.75 * j), 30.0 + 2.0 * k])
    };
    let numbers: Vec<u8> = (0..dims.iter().product()).flat_map(|i| number(i).to_le_bytes()).collect();
    fs::write(&source, [header.as_bytes(), &numbers].concat()).unwrap();
    let target = folder.path().join("a.ome.zarr");
    converted(&source, &target, &OpenOptions::default()).unwrap();
    let about = json(&target.join(".zattrs"));
    let datasets = about["multiscales"][0]["datasets"].as_array().unwrap();
    assert!(datasets.len() > 1);
    for level in 0..datasets.len() as u32 {
        let volume = opened(&target, part(0, 0, level));
        assert_eq!(volume.info.orientation.as_deref(), Some("RAS"));
        let (place, spacing) = (volume.info.placement.unwrap(), volume.spacing());
        let [nx, ny, nz] = volume.dims();
        let shift = &datasets[level as usize]["coordinateTransformations"][1]["translation"];
        let first = &datasets[0]["coordinateTransformations"][1]["translation"];
        let mut worst = 0f64;
        for (x, y, z) in
            [(0, 0, 0), (nx - 1, 0, nz / 2), (nx / 2, ny - 1, 1), (nx - 1, ny - 1, nz - 1), (3, 7, 5)]
        {
            let at = [x, y, z].map(f64::from);
            let middle = [nx, ny, nz].map(|n| (f64::from(n) - 1.0) / 2.0);
            let world: [f64; 3] =
                std::array::from_fn(|k| place.center[k] + (at[k] - middle[k]) * f64::from(spacing[k]));
            let found =
                f64::from(volume.value_from_stored(volume.voxels().get(((z * ny + y) * nx + x) as usize)));
            assert!((found - value(world)).abs() < 1e-3, "level {level}: {found} at {world:?}");
            // The control: without the level's own translation, the ramp is off.
            let moved: [f64; 3] = std::array::from_fn(|k| {
                world[k] - shift[2 - k].as_f64().unwrap() + first[2 - k].as_f64().unwrap()
            });
            worst = worst.max((found - value(moved)).abs());
        }
        assert_eq!(worst > 0.1, level > 0, "level {level}: {worst}");
    }
}

#[test]
fn channels_times_and_their_looks_are_kept_also_on_a_second_way() {
    let folder = TempDir::new().unwrap();
    let (dims, num) = ([66u32, 70, 9], 66 * 70 * 9);
    let source = folder.path().join("a.nrrd");
    let header = "NRRD0005\ntype: unsigned short\ndimension: 5\nsizes: 3 66 70 9 2\n\
         kinds: RGB-color space space space time\nspacings: nan 1 1 1 nan\nendian: little\nencoding: raw\n\n";
    let numbers: Vec<u8> = (0..num * 6u32).flat_map(|i| ((i * 7 + i / 13) as u16).to_le_bytes()).collect();
    fs::write(&source, [header.as_bytes(), &numbers].concat()).unwrap();
    let [first, second, third] = ["a", "b", "c"].map(|name| folder.path().join(format!("{name}.ome.zarr")));
    converted(&source, &first, &OpenOptions::default()).unwrap();
    for (channel, time) in [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1)] {
        let selection = part(channel, time, 0);
        let (found, expected) = (opened(&first, selection), opened(&source, selection));
        assert_eq!(found.dims(), dims);
        assert_eq!(found.info.channel, expected.info.channel);
        check_same(&found, &expected, "channels");
    }
    let omero = &json(&first.join(".zattrs"))["omero"]["channels"];
    assert_eq!((&omero[0]["label"], &omero[2]["color"]), (&"red".into(), &"0000FF".into()));
    // What was converted converts to the same chunks, in one piece or in strips.
    for (target, max_bytes) in [(&second, 1 << 30), (&third, 20 << 20)] {
        converted(&first, target, &OpenOptions { max_bytes, ..OpenOptions::default() }).unwrap();
        let chunks = |folder: &Path| -> Vec<_> {
            tree(folder).into_iter().filter(|(path, _)| !path.to_string_lossy().contains(".z")).collect()
        };
        assert!(chunks(&first) == chunks(target));
    }
    // The control: one channel is fewer.
    let selection = Selection { channel: Some(1), ..Selection::default() };
    let one = folder.path().join("one.ome.zarr");
    converted(&source, &one, &OpenOptions { selection, ..OpenOptions::default() }).unwrap();
    assert_eq!(decoded(&one.join("0")).0, [2, 9, 70, 66]);
    check_same(&opened(&one, part(0, 1, 0)), &opened(&source, part(1, 1, 0)), "one channel");
}

#[test]
fn what_was_stopped_goes_on_and_becomes_the_same() {
    let folder = TempDir::new().unwrap();
    let source = folder.path().join("a.raw");
    let dims = [90usize, 80, 300];
    let numbers: Vec<u8> = noise(dims, None).iter().map(|x| *x as u8).collect();
    fs::write(&source, &numbers).unwrap();
    let shape = raw(dims.map(|n| n as u32), Dtype::Uint8, Endian::Little, [1.0; 3]);
    let whole = folder.path().join("whole.ome.zarr");
    converted(&source, &whole, &OpenOptions { raw: shape, ..OpenOptions::default() }).unwrap();
    let target = folder.path().join("a.ome.zarr");
    let mut starts = Vec::new();
    for stop in [0.1, 0.3, 0.5, 0.8, 0.99, 2.0] {
        let cancel = AtomicBool::new(false);
        let from = Cell::new(f32::NAN);
        let progress = |fraction: f32| {
            if from.get().is_nan() {
                from.set(fraction);
            }
            if fraction >= stop {
                cancel.store(true, Ordering::Relaxed);
            }
        };
        let options = OpenOptions {
            raw: shape,
            progress: Some(&progress),
            cancel: Some(&cancel),
            ..OpenOptions::default()
        };
        let conversion = Conversion::begin(source.to_str().unwrap(), &target, &options).unwrap();
        starts.push(conversion.done());
        let found = conversion.run();
        assert_eq!(target.exists(), stop > 1.0);
        assert!(found.is_ok() || matches!(found, Err(FormatError::Cancelled { .. })));
    }
    assert!(starts.is_sorted() && starts[0] == 0.0 && starts[5] > 0.5, "{starts:?}");
    assert!(tree(&whole) == tree(&target));
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 3);
    // The control: another input begins anew.
    fs::remove_dir_all(&target).unwrap();
    let cancel = AtomicBool::new(false);
    let progress = |fraction: f32| cancel.store(fraction > 0.5, Ordering::Relaxed);
    let options = OpenOptions {
        raw: shape,
        progress: Some(&progress),
        cancel: Some(&cancel),
        ..OpenOptions::default()
    };
    assert!(converted(&source, &target, &options).is_err());
    let done =
        |options: &OpenOptions| Conversion::begin(source.to_str().unwrap(), &target, options).unwrap().done();
    let plain = OpenOptions { raw: shape, ..OpenOptions::default() };
    assert!(done(&plain) > 0.3);
    fs::write(&source, [&numbers[1..], &[7]].concat()).unwrap();
    assert_eq!(done(&plain), 0.0);
}

#[test]
fn layers_too_large_for_the_memory_become_the_same() {
    let folder = TempDir::new().unwrap();
    let source = folder.path().join("a.raw");
    let dims = [300usize, 310, 70];
    fs::write(&source, noise(dims, None).iter().map(|x| *x as u8).collect::<Vec<_>>()).unwrap();
    let shape = raw(dims.map(|n| n as u32), Dtype::Uint8, Endian::Little, [1.0; 3]);
    let made = |max_bytes: u64| {
        let target = folder.path().join(format!("{max_bytes}.ome.zarr"));
        let options = OpenOptions { raw: shape, max_bytes, ..OpenOptions::default() };
        converted(&source, &target, &options).map(|_| tree(&target))
    };
    // A layer of chunks has 6 MB.
    let (large, small) = (made(1 << 30).unwrap(), made(10_000_000).unwrap());
    assert!(large == small);
    assert!(matches!(made(9_000_000), Err(FormatError::TooLarge { .. })), "the control");
}

#[test]
fn refusals_are_one_line_and_leave_nothing() {
    let folder = TempDir::new().unwrap();
    let path = |name: &str| folder.path().join(name);
    let shape = raw([100, 100, 100], Dtype::Float, Endian::Little, [1.0; 3]);
    fs::write(path("nan.raw"), f32::NAN.to_le_bytes().repeat(1_000_000)).unwrap();
    fs::write(path("short.raw"), vec![0; 3_999_999]).unwrap();
    fs::create_dir(path("taken")).unwrap();
    let plain = OpenOptions { raw: shape, ..OpenOptions::default() };
    let small = OpenOptions { max_bytes: 1 << 20, ..plain };
    for (source, target, options, words) in [
        ("nan.raw", "a.ome.zarr", &plain, "NaN or infinite, expected finite"),
        ("short.raw", "a.ome.zarr", &plain, "from byte 0 needs 4000000 bytes, found 3999999"),
        ("short.raw", "taken", &plain, "found a file or folder of this name, expected a new name"),
        ("short.raw", "none/a.ome.zarr", &plain, "a.ome.zarr: "),
        ("short.raw", "a.ome.zarr", &small, "bytes of memory, expected at most 1048576"),
        ("none.raw", "a.ome.zarr", &plain, "none.raw"),
    ] {
        let e = converted(&path(source), &path(target), options).unwrap_err().to_string();
        assert!(e.contains(words) && e.lines().count() == 1, "{e}");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 3, "{source} {target}");
    }
    let target = path("cloud.ome.zarr");
    Conversion::begin("builtin:cloud@70", &target, &OpenOptions::default()).unwrap().run().unwrap();
    let expected = open("builtin:cloud@70", &OpenOptions::default()).unwrap();
    let found = opened(&target, part(0, 0, 0));
    check_same(&found, &expected, "cloud");
    assert!(matches!(found.voxels(), Voxels::U8(_)));
}
