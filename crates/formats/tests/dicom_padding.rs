//! Ranges of padding in DICOM: numbers that stand for no value, before they are rescaled.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

#[allow(dead_code, reason = "other tests use the rest")]
#[path = "support/dicom.rs"]
mod dicom;
#[path = "support/paging.rs"]
mod paging;

use std::fs;
use std::path::Path;

use dicom::{PLAIN, decimals, element, text, with_pixels};
use isinglass_formats::{Conversion, OpenOptions, open};
use paging::check_pages;
use tempfile::TempDir;

/// 8×6 pixels in 5 slices: numbers from 1000 on, and a stripe of these.
fn numbers(stripe: &[i32]) -> Vec<i32> {
    (0..240).map(|i| if i % 8 < 3 { stripe[i as usize % stripe.len()] } else { 1000 + i }).collect()
}

struct Padded {
    is_signed: bool,
    padding: Option<i32>,
    limit: Option<i32>,
    /// For each slice.
    slopes: [f64; 5],
    intercept: f64,
    is_inverted: bool,
}

const SIGNED: Padded = Padded {
    is_signed: true,
    padding: None,
    limit: None,
    slopes: [1.0; 5],
    intercept: 0.0,
    is_inverted: false,
};

fn folder(numbers: &[i32], kind: &Padded) -> TempDir {
    let folder = TempDir::new().unwrap();
    let short = |number, value: i32| {
        element((0x0028, number), if kind.is_signed { "SS" } else { "US" }, &(value as u16).to_le_bytes())
    };
    for (k, slice) in numbers.chunks(48).enumerate() {
        let mut elements = vec![
            decimals((0x0020, 0x0032), &[0.0, 0.0, 2.0 * k as f64]),
            decimals((0x0020, 0x0037), &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0]),
            decimals((0x0028, 0x0030), &[1.0, 1.0]),
            decimals((0x0028, 0x1052), &[kind.intercept]),
            decimals((0x0028, 0x1053), &[kind.slopes[k]]),
            element((0x0028, 0x0010), "US", &6u16.to_le_bytes()),
            element((0x0028, 0x0011), "US", &8u16.to_le_bytes()),
            element((0x0028, 0x0103), "US", &u16::from(kind.is_signed).to_le_bytes()),
        ];
        elements.extend(kind.is_inverted.then(|| text((0x0028, 0x0004), "CS", "MONOCHROME1")));
        elements.extend(kind.padding.map(|value| short(0x0120, value)));
        elements.extend(kind.limit.map(|value| short(0x0121, value)));
        let bytes: Vec<u8> = slice.iter().flat_map(|x| (*x as u16).to_le_bytes()).collect();
        let pixels = element((0x7fe0, 0x0010), "OW", &bytes);
        fs::write(folder.path().join(format!("{k}")), with_pixels(PLAIN, elements, &pixels)).unwrap();
    }
    folder
}

/// The values in the order of the file, and none where there is nothing.
fn values(path: &Path) -> Vec<Option<f32>> {
    let volume = open(path.to_str().unwrap(), &OpenOptions::default()).unwrap_or_else(|e| panic!("{e}"));
    let [nx, ny, _] = volume.dims().map(|n| n as usize);
    let value = |i: usize| {
        // A body's x and y run against those of the file.
        let at = i / (nx * ny) * nx * ny + (ny - 1 - i / nx % ny) * nx + (nx - 1 - i % nx);
        let is_gap = volume.gaps().is_some_and(|gaps| gaps.bytes[at] != 0);
        (!is_gap).then(|| volume.value_from_stored(volume.voxels().get(at)))
    };
    (0..volume.voxels().len()).map(value).collect()
}

#[test]
fn numbers_within_the_range_of_padding_are_nothing() {
    let stripe = [-2000, -1500, -1750, -1499, -2001];
    let list = numbers(&stripe);
    let unsigned = [65_535, 63_000, 64_000, 62_999, 2000];
    let plain = |list: &[i32]| list.iter().map(|x| *x as f32).collect::<Vec<_>>();
    for (name, kind, stripe, range) in [
        ("both ends", Padded { padding: Some(-2000), limit: Some(-1500), ..SIGNED }, stripe, -2000..=-1500),
        (
            "the other order",
            Padded { padding: Some(-1500), limit: Some(-2000), ..SIGNED },
            stripe,
            -2000..=-1500,
        ),
        ("no limit", Padded { padding: Some(-2000), ..SIGNED }, stripe, -2000..=-2000),
        (
            "unsigned",
            Padded { is_signed: false, padding: Some(65_535), limit: Some(63_000), ..SIGNED },
            unsigned,
            63_000..=65_535,
        ),
        (
            "rescaled",
            Padded {
                padding: Some(-2000),
                limit: Some(-1500),
                slopes: [2.0; 5],
                intercept: -1024.0,
                ..SIGNED
            },
            stripe,
            -2000..=-1500,
        ),
        (
            "falling",
            Padded { padding: Some(-2000), limit: Some(-1500), slopes: [-1.0; 5], intercept: 9.0, ..SIGNED },
            stripe,
            -2000..=-1500,
        ),
        (
            "slices of their own",
            Padded { padding: Some(-2000), limit: Some(-1500), slopes: [1.0, 1.5, 2.0, 1.0, 3.0], ..SIGNED },
            stripe,
            -2000..=-1500,
        ),
    ] {
        let list = numbers(&stripe);
        let folder = folder(&list, &kind);
        let expected: Vec<Option<f32>> = list
            .iter()
            .zip(0..)
            .map(|(x, i)| {
                (!range.contains(x)).then(|| *x as f32 * kind.slopes[i / 48] as f32 + kind.intercept as f32)
            })
            .collect();
        assert_eq!(values(folder.path()), expected, "{name}");
        check_pages(folder.path(), &OpenOptions::default());
    }
    // White is the least.
    let kind =
        Padded { is_inverted: true, is_signed: false, padding: Some(65_535), limit: Some(63_000), ..SIGNED };
    let list_white = numbers(&unsigned);
    let expected: Vec<Option<f32>> =
        list_white.iter().map(|x| (!(63_000..=65_535).contains(x)).then_some(65_535.0 - *x as f32)).collect();
    assert_eq!(values(folder(&list_white, &kind).path()), expected);
    // The controls: a limit alone says nothing, and neither does another range.
    for kind in [
        Padded { limit: Some(-1500), ..SIGNED },
        Padded { padding: Some(-3000), limit: Some(-2500), ..SIGNED },
    ] {
        let found: Vec<f32> = values(folder(&list, &kind).path()).into_iter().flatten().collect();
        assert_eq!(found, plain(&list));
    }
}

#[test]
fn a_converted_series_keeps_its_padding() {
    for (padding, limit) in [(-2000, -1500), (-2000, -1990), (-32_000, -1500)] {
        let list = numbers(&[padding, limit, (padding + limit) / 2]);
        let folder = folder(&list, &Padded { padding: Some(padding), limit: Some(limit), ..SIGNED });
        let target = TempDir::new().unwrap();
        let image = target.path().join("a.ome.zarr");
        let source = folder.path().to_str().unwrap();
        Conversion::begin(source, &image, &OpenOptions::default()).unwrap().run().unwrap();
        let (from, to) =
            (open(source, &OpenOptions::default()), open(image.to_str().unwrap(), &OpenOptions::default()));
        let (from, to) = (from.unwrap(), to.unwrap());
        assert_eq!(from.gaps().map(|gaps| gaps.num_gaps), Some(90), "{padding} {limit}");
        assert_eq!(
            from.gaps().map(|gaps| &gaps.bytes),
            to.gaps().map(|gaps| &gaps.bytes),
            "{padding} {limit}"
        );
        assert_eq!(from.value_range(), to.value_range());
    }
}
