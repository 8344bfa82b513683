//! TIFF pages whose numbers are places in a table of colours.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

#[path = "support/paging.rs"]
mod paging;
#[path = "support/tiff.rs"]
mod tiff;

use std::fs;

use isinglass_core::volume::Volume;
use isinglass_formats::{OpenOptions, open};
use paging::{check_pages, text};
use tempfile::TempDir;
use tiff::{Layout, TiffPage, tiff_file};

/// A volume of 12×10×8 numbers with this table of 16-bit colours, opened, and its numbers as they were.
fn opened(
    color: impl Fn(usize) -> [u16; 3],
    description: Option<&str>,
    layout: Layout,
) -> (Volume, Vec<f32>) {
    let table: Vec<u16> = (0..3).flat_map(|k| (0..256).map(|i| color(i)[k]).collect::<Vec<_>>()).collect();
    let numbers: Vec<u8> = (0..960).map(|i| (i % 12 / 4 + i / 480) as u8).collect();
    let mut pages: Vec<TiffPage> =
        numbers.chunks(120).map(|slice| TiffPage::new([12, 10], 1, 1, slice.to_vec())).collect();
    for page in &mut pages {
        page.photometric = 3;
        page.shorts = vec![(320, table.clone())];
    }
    pages[0].description = description.map(str::to_owned);
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("a.tif");
    fs::write(&path, tiff_file(&pages, layout)).unwrap();
    check_pages(&path, &OpenOptions::default());
    let volume = open(text(&path), &OpenOptions::default()).unwrap_or_else(|e| panic!("{e}"));
    (volume, numbers.into_iter().map(f32::from).collect())
}

fn values(volume: &Volume) -> Vec<f32> {
    (0..volume.voxels().len()).map(|i| volume.value_from_stored(volume.voxels().get(i))).collect()
}

const FEW: [[u16; 3]; 4] = [[0; 3], [65_535, 0, 0], [0, 65_535, 0], [0, 0, 65_535]];

#[test]
fn a_table_that_jumps_has_the_colours_of_labels() {
    for layout in [Layout::default(), Layout { packing: 8, tile: Some([16, 16]), ..Layout::default() }] {
        let (volume, expected) = opened(|i| FEW.get(i).copied().unwrap_or_default(), None, layout);
        assert_eq!(values(&volume), expected);
        assert!(volume.info.are_labels, "{:?}", volume.info.warnings);
        let colors: Vec<_> = volume.info.labels.iter().map(|label| (label.value, label.color)).collect();
        assert_eq!(colors, [(1, Some([255, 0, 0])), (2, Some([0, 255, 0])), (3, Some([0, 0, 255]))]);
        assert!(volume.info.warnings.iter().any(|w| w.contains("--voxels values")));
    }
}

#[test]
fn a_smooth_table_is_a_look_of_values() {
    let imagej = Some("ImageJ=1.54f\nimages=8\nslices=8\n");
    let (green, expected) = opened(|i| [0, 257 * i as u16, 0], imagej, Layout::default());
    assert_eq!((values(&green), green.info.are_labels), (expected.clone(), false));
    assert_eq!(green.info.channel.color, Some([0, 255, 0]));
    // Of many colours there is no one, and grey needs none.
    let fire = |i: usize| [0, 85, 170].map(|from| 257 * (3 * i.saturating_sub(from)).min(255) as u16);
    let (fire, _) = opened(fire, imagej, Layout::default());
    assert_eq!((fire.info.channel.color, fire.info.are_labels), (None, false));
    assert!(fire.info.warnings.iter().any(|w| w.contains("the table of colours is left out")));
    let (gray, _) = opened(|i| [257 * i as u16; 3], None, Layout::default());
    assert_eq!((values(&gray), gray.info.channel.color), (expected, None));
    assert!(!gray.info.warnings.iter().any(|w| w.contains("table of colours")));
    // Colours in bands are no labels of each number.
    let (bands, _) = opened(|i| FEW[i / 64], None, Layout::default());
    assert!(!bands.info.are_labels);
}
