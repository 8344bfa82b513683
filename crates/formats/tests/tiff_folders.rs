//! Folders of TIFF files whose names count slices, channels and times, as microscopes write them.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

#[path = "support/tiff.rs"]
mod tiff;

use std::fs;
use std::path::Path;

use isinglass_core::volume::Volume;
use isinglass_formats::{OpenOptions, Outline, Selection, open, outline};
use tempfile::TempDir;
use tiff::{Layout, TiffPage, tiff_file};

/// Slice, channel, time and place of a file, or of a page.
type Place = [usize; 4];

/// What the pixels of a slice have.
fn value([z, c, t, s]: Place) -> u16 {
    (10_000 * s + 1000 * t + 100 * c + z) as u16
}

fn page(value: u16) -> TiffPage {
    TiffPage::new([3, 2], 2, 1, [value.to_le_bytes(); 6].concat())
}

fn write(folder: &Path, name: &str, pages: &[TiffPage]) {
    fs::write(folder.join(name), tiff_file(pages, Layout::default())).unwrap();
}

/// A folder with a file for each place, of so many pages, which are slices then.
fn folder([nz, nc, nt, ns]: Place, num_pages: usize, name: &dyn Fn(Place) -> String) -> TempDir {
    let folder = TempDir::new().unwrap();
    for i in 0..nz * nc * nt * ns {
        let [z, c, t, s] = [i % nz, i / nz % nc, i / nz / nc % nt, i / nz / nc / nt];
        let pages: Vec<_> = (0..num_pages).map(|k| page(value([z + k, c, t, s]))).collect();
        write(folder.path(), &name([z, c, t, s]), &pages);
    }
    folder
}

fn outline_of(path: &Path) -> Outline {
    outline(path.to_str().unwrap(), &OpenOptions::default()).unwrap_or_else(|e| panic!("{e}"))
}

fn part(path: &Path, [channel, time, series]: [Option<usize>; 3]) -> Volume {
    let number = |n: Option<usize>| n.map(|n| n as u32);
    let selection = Selection {
        channel: number(channel),
        time: number(time),
        series: number(series),
        ..Selection::default()
    };
    open(path.to_str().unwrap(), &OpenOptions { selection, ..OpenOptions::default() })
        .unwrap_or_else(|e| panic!("{e}"))
}

/// The value of each slice.
fn slices(volume: &Volume) -> Vec<f32> {
    (0..volume.voxels().len()).step_by(6).map(|i| volume.voxels().get(i)).collect()
}

/// Checks the slices of all channels, times and series.
fn check(what: &str, path: &Path, [nz, nc, nt, ns]: Place) -> Outline {
    let found = outline_of(path);
    let sizes = (found.dims, found.num_channels, found.num_times, found.series.len());
    let num_series = if ns > 1 { ns } else { 0 };
    assert_eq!(sizes, ([3, 2, nz as u32], nc as u64, nt as u64, num_series), "{what}: {:?}", found.warnings);
    for i in 0..nc * nt * ns {
        let [c, t, s] = [i % nc, i / nc % nt, i / nc / nt];
        let volume = part(path, [Some(c), Some(t), (ns > 1).then_some(s)]);
        let expected: Vec<f32> = (0..nz).map(|z| value([z, c, t, s]).into()).collect();
        assert_eq!(slices(&volume), expected, "{what}: channel {c}, time {t}, series {s}");
    }
    found
}

fn is_guess(found: &Outline) -> bool {
    found.warnings.iter().any(|w| w.text.contains("in the names were taken as"))
}

#[test]
fn letters_before_numbers_tell_slices_channels_and_times() {
    type Name = Box<dyn Fn(Place) -> String>;
    let cases: Vec<(&str, Place, Name)> = vec![
        ("Leica", [12, 2, 3, 1], Box::new(|[z, c, t, _]| format!("Series001_t{t:02}_z{z:03}_ch{c:02}.tif"))),
        ("Leica, places", [12, 2, 1, 2], Box::new(|[z, c, _, s]| format!("Series{s:03}_z{z}_ch{c:02}.tif"))),
        (
            "Micro-Manager",
            [11, 3, 2, 2],
            Box::new(|[z, c, t, s]| format!("img_channel{c:03}_position{s:03}_time{t:09}_z{z:03}.tif")),
        ),
        ("Nikon", [12, 2, 3, 1], Box::new(|[z, c, t, _]| format!("exp001xy1c{}z{z:02}t{t:03}.tif", c + 1))),
        (
            "Zeiss",
            [12, 2, 3, 1],
            Box::new(|[z, c, t, _]| format!("Exp-01_b0t{t}z{z:02}c{c}x0-512y0-512.tif")),
        ),
        ("letters only", [12, 2, 1, 1], Box::new(|[z, c, ..]| format!("c{}z{z:02}.tif", c + 1))),
        ("equal signs", [12, 2, 2, 1], Box::new(|[z, c, t, _]| format!("C={c}_Z={z}_T={t}.tif"))),
        ("another order", [12, 2, 2, 1], Box::new(|[z, c, t, _]| format!("T={t} Z={z} C={c}.TIFF"))),
        ("Imaris", [12, 2, 2, 1], Box::new(|[z, c, t, _]| format!("cell_T{t:04}_C{c:02}_Z{z:04}.tif"))),
        ("words", [12, 2, 2, 1], Box::new(|[z, c, t, _]| format!("a_time_{t}_channel_{c}_slice_{z}.tif"))),
        ("capitals", [12, 2, 1, 1], Box::new(|[z, c, ..]| format!("myImageZ{z:03}_runC{c}.tif"))),
        (
            "Yokogawa",
            [12, 2, 2, 1],
            Box::new(|[z, c, t, _]| {
                format!("Plate_B02_T{:04}F001L01A{:02}Z{z:02}C{:02}.tif", t + 1, c + 1, c + 1)
            }),
        ),
        (
            "Operetta",
            [12, 2, 2, 2],
            Box::new(|[z, c, t, s]| format!("r02c03f{s:02}p{z:02}-ch{}sk{}fk1fl1.tiff", c + 1, t + 1)),
        ),
        ("slices alone", [12, 1, 1, 1], Box::new(|[z, ..]| format!("brain_z{z}.tif"))),
        (
            "the time of day",
            [12, 2, 1, 1],
            Box::new(|[z, c, ..]| format!("20240101_{}_z{z:02}_ch{c}.tif", 120_000 + 7 * z + 1000 * c)),
        ),
    ];
    for (what, sizes, name) in cases {
        let folder = folder(sizes, 1, &*name);
        let found = check(what, folder.path(), sizes);
        assert!(!is_guess(&found), "{what}: {:?}", found.warnings);
        assert_eq!(found.joins_channels, sizes[1] > 1, "{what}");
    }
}

#[test]
fn pages_of_files_are_slices_of_channels_and_times() {
    let dyes = ["1DAPI", "2FITC", "3Cy5"];
    let stacks = folder([1, 3, 12, 1], 9, &|[_, c, t, _]| format!("exp_w{}_s1_t{}.TIF", dyes[c], t + 1));
    let found = check("MetaMorph", stacks.path(), [9, 3, 12, 1]);
    assert_eq!(found.channels, ["DAPI", "FITC", "Cy5"]);
    let places =
        folder([1, 2, 3, 2], 9, &|[_, c, t, s]| format!("exp_w{}_s{}_t{}.TIF", dyes[c], s + 1, t + 1));
    check("MetaMorph, places", places.path(), [9, 2, 3, 2]);
    let camera =
        folder([1, 2, 3, 1], 6, &|[_, c, t, _]| format!("SPC00_TM{t:05}_ANG000_CM0_CHN{c:02}_PH0.tif"));
    check("light sheet", camera.path(), [6, 2, 3, 1]);
    check("channels", folder([1, 3, 1, 1], 8, &|[_, c, ..]| format!("stack_ch{c}.tif")).path(), [8, 3, 1, 1]);
    check("times", folder([1, 1, 12, 1], 8, &|[_, _, t, _]| format!("stack_t{t}.tif")).path(), [8, 1, 12, 1]);
    // Files of hyperstacks, one for each time.
    let hyper = TempDir::new().unwrap();
    for t in 0..3 {
        let mut pages: Vec<_> = (0..8).map(|i| page(value([i / 2, i % 2, t, 0]))).collect();
        let text =
            "ImageJ=1.54f\nimages=8\nchannels=2\nslices=4\nhyperstack=true\nunit=micron\nspacing=2.5\n";
        pages[0].description = Some(text.into());
        write(hyper.path(), &format!("movie_t{t:02}.tif"), &pages);
    }
    check("hyperstacks", hyper.path(), [4, 2, 3, 1]);
    // The control: parts of one stack without a word are slices.
    let parts = folder([3, 1, 1, 1], 4, &|[z, ..]| format!("stack@{z:04}.tif"));
    assert_eq!(outline_of(parts.path()).dims, [3, 2, 12]);
}

#[test]
fn words_and_dyes_are_channels() {
    let words = ["Cy5", "DAPI", "FITC"];
    let old = folder([11, 3, 2, 1], 1, &|[z, c, t, _]| format!("img_{t:09}_{}_{z:03}.tif", words[c]));
    let found = check("Micro-Manager, old", old.path(), [11, 3, 2, 1]);
    assert_eq!(found.channels, words);
    assert!(is_guess(&found));
    let lasers =
        folder([12, 3, 1, 1], 1, &|[z, c, ..]| format!("tissue_{}nm_{z:03}.tif", [405, 488, 561][c]));
    assert_eq!(check("lasers", lasers.path(), [12, 3, 1, 1]).channels, ["405nm", "488nm", "561nm"]);
    let dyes = folder([12, 3, 1, 1], 1, &|[z, c, ..]| format!("tissue_z{z:03}_Cy{}.tif", [3, 5, 7][c]));
    assert_eq!(check("dyes", dyes.path(), [12, 3, 1, 1]).channels, ["Cy3", "Cy5", "Cy7"]);
    let both = folder([12, 2, 1, 1], 1, &|[z, c, ..]| format!("a_ch{c}_{}_z{z}.tif", ["GFP", "DAPI"][c]));
    assert_eq!(check("both", both.path(), [12, 2, 1, 1]).channels, ["GFP", "DAPI"]);
    let number = folder([12, 2, 1, 1], 1, &|[z, c, ..]| format!("image{z:04}_ch{c:02}.tif"));
    let found = check("a number alone", number.path(), [12, 2, 1, 1]);
    assert!(is_guess(&found) && found.channels == ["ch00", "ch01"], "{found:?}");
}

#[test]
fn what_does_not_belong_to_the_grid_is_told() {
    let name = |[z, c, ..]: Place| format!("Series001_z{z:02}_ch{c:02}.tif");
    let folder = folder([12, 2, 1, 1], 1, &name);
    write(folder.path(), "Series001_overview_all.tif", &[page(7)]);
    fs::write(folder.path().join("Series001_Properties.xml"), "<Data/>").unwrap();
    let found = check("others", folder.path(), [12, 2, 1, 1]);
    assert!(found.warnings.iter().any(|w| w.text.contains("1 files of the folder have other names")));
    // A file that is missing, and one of another size.
    fs::remove_file(folder.path().join(name([3, 1, 0, 0]))).unwrap();
    write(folder.path(), &name([4, 0, 0, 0]), &[TiffPage::new([2, 2], 2, 1, vec![0; 8])]);
    let volume = part(folder.path(), [Some(1), None, None]);
    assert_eq!(slices(&volume)[2..5], [102.0, 0.0, 104.0]);
    assert_eq!(slices(&part(folder.path(), [Some(0), None, None]))[3..6], [3.0, 0.0, 5.0]);
    let says = |words: &str| volume.info.warnings.iter().any(|w| w.contains(words));
    assert!(
        says("2 planes are in no file") && says("_z04_ch00.tif is not like"),
        "{:?}",
        volume.info.warnings
    );
    // Previews with a word of their own.
    let previews = folder_with_previews();
    check("previews", previews.path(), [9, 2, 3, 1]);
}

/// Stacks of MetaMorph, each with a preview.
fn folder_with_previews() -> TempDir {
    let name = |c: usize, t: usize| format!("exp_w{}_t{t}", ["1DAPI", "2GFP"][c]);
    let folder = folder([1, 2, 3, 1], 9, &|[_, c, t, _]| format!("{}.TIF", name(c, t)));
    for i in 0..6 {
        write(folder.path(), &format!("{}_thumb.TIF", name(i % 2, i / 2)), &[page(9999)]);
    }
    folder
}

#[test]
fn names_that_tell_nothing_are_slices_in_their_order() {
    // One number, a letter that is the end of a word, numbers of no meaning, and colours that are channels already.
    for (name, is_told) in
        [("slice{}.tif", false), ("IMG_{}.tif", false), ("s{}.tif", false), ("scan1_part2_{}.tif", false)]
    {
        let folder = folder([12, 1, 1, 1], 1, &|[z, ..]| name.replace("{}", &z.to_string()));
        let found = check(name, folder.path(), [12, 1, 1, 1]);
        assert_eq!(is_guess(&found), is_told, "{name}: {:?}", found.warnings);
    }
    let two = folder([12, 1, 1, 1], 1, &|[z, ..]| format!("{}_{}.tif", z / 4, z % 4));
    let found = check("two numbers", two.path(), [12, 1, 1, 1]);
    assert!(
        found.warnings.iter().any(|w| w.text.contains("no letters tell which count slices")),
        "{found:?}"
    );
    let colors = TempDir::new().unwrap();
    for (z, c) in (0..8).map(|i| (i / 2, i % 2)) {
        let pixel = [z as u8, 10 * c as u8, 7];
        write(
            colors.path(),
            &format!("a_z{z}_ch{c}.tif"),
            &[TiffPage::new([3, 2], 1, 1, [pixel; 6].concat())],
        );
    }
    let found = outline_of(colors.path());
    assert_eq!((found.dims, found.num_channels, found.series.len()), ([3, 2, 4], 3, 2), "{found:?}");
}
