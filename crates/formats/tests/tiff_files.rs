//! Descriptions and tags of TIFF files: images in several files, series, white as the least value, arrays of tifffile
//! and stacks of ImageJ. The tests write the files byte by byte.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::fs;
use std::path::{Path, PathBuf};

use glam::Vec3;
use isinglass_core::volume::Volume;
use isinglass_formats::{FormatError, OpenOptions, Outline, Selection, open, outline};
use tempfile::TempDir;

/// A page of 16-bit numbers.
#[derive(Clone)]
struct Page {
    sides: [u32; 2],
    description: Option<String>,
    /// 0 if the least value is white, 1 if it is black.
    photometric: u32,
    /// 1: unsigned, 2: signed, 3: floats.
    format: u32,
    resolution: Option<[u32; 2]>,
    /// More tags with one number.
    more: Vec<(u16, u32)>,
    /// More tags with their type, the number of their values and the bytes.
    blocks: Vec<(u16, u32, u32, Vec<u8>)>,
    pixels: Vec<u16>,
}

impl Page {
    fn new(sides: [u32; 2], pixels: Vec<u16>) -> Self {
        let (description, resolution, more, blocks) = (None, None, Vec::new(), Vec::new());
        Self { sides, description, photometric: 1, format: 1, resolution, more, blocks, pixels }
    }

    fn described(self, text: &str) -> Self {
        Self { description: Some(text.to_owned()), ..self }
    }
}

/// Pages of one size, numbered from `first`.
fn pages(sides: [u32; 2], count: u16, first: u16) -> Vec<Page> {
    let n = (sides[0] * sides[1]) as u16;
    (0..count).map(|k| Page::new(sides, (first + k * n..first + (k + 1) * n).collect())).collect()
}

/// A little-endian file with one strip for each page (TIFF 6.0).
fn tiff(pages: &[Page]) -> Vec<u8> {
    let mut bytes = b"II*\0\0\0\0\0".to_vec();
    let mut link = 4;
    for page in pages {
        let mut put = |data: &[u8]| {
            let at = bytes.len() as u32;
            bytes.extend_from_slice(data);
            bytes.resize(bytes.len().next_multiple_of(8), 0);
            at
        };
        let pixels: Vec<u8> = page.pixels.iter().flat_map(|x| x.to_le_bytes()).collect();
        let data = put(&pixels);
        let mut entries: Vec<[u32; 4]> = [
            (256, page.sides[0]),
            (257, page.sides[1]),
            (258, 16),
            (259, 1),
            (262, page.photometric),
            (273, data),
            (277, 1),
            (278, page.sides[1]),
            (279, pixels.len() as u32),
            (339, page.format),
        ]
        .map(|(tag, value)| [tag, 4, 1, value])
        .into();
        entries.extend(page.more.iter().map(|&(tag, value)| [tag.into(), 4, 1, value]));
        if let Some(text) = &page.description {
            let text = [text.as_bytes(), b"\0\0\0\0"].concat();
            entries.push([270, 2, text.len() as u32, put(&text)]);
        }
        for (tag, kind, count, block) in &page.blocks {
            entries.push([u32::from(*tag), *kind, *count, put(block)]);
        }
        if let Some(resolution) = page.resolution {
            for (tag, pixels) in [282, 283].into_iter().zip(resolution) {
                let ratio: Vec<u8> = [pixels, 1000].iter().flat_map(|x| x.to_le_bytes()).collect();
                entries.push([tag, 5, 1, put(&ratio)]);
            }
        }
        entries.sort_by_key(|e| e[0]);
        let at = bytes.len() as u32;
        bytes[link..link + 4].copy_from_slice(&at.to_le_bytes());
        bytes.extend((entries.len() as u16).to_le_bytes());
        for [tag, kind, count, value] in entries {
            bytes.extend([tag as u16, kind as u16].iter().flat_map(|x| x.to_le_bytes()));
            bytes.extend([count, value].iter().flat_map(|x| x.to_le_bytes()));
        }
        link = bytes.len();
        bytes.extend([0; 8]);
    }
    bytes
}

fn write(folder: &Path, name: &str, pages: &[Page]) -> PathBuf {
    let path = folder.join(name);
    fs::write(&path, tiff(pages)).unwrap();
    path
}

fn try_open(path: &Path, selection: Selection) -> Result<Volume, FormatError> {
    open(path.to_str().unwrap(), &OpenOptions { selection, ..OpenOptions::default() })
}

fn outline_of(path: &Path) -> Outline {
    outline(path.to_str().unwrap(), &OpenOptions::default()).unwrap_or_else(|e| panic!("{e}"))
}

/// The part of a file at a channel and time.
fn part(path: &Path, channel: u32, time: u32) -> Volume {
    let selection = Selection { channel: Some(channel), time: Some(time), ..Selection::default() };
    try_open(path, selection).unwrap_or_else(|e| panic!("{e}"))
}

fn whole(path: &Path) -> Volume {
    try_open(path, Selection::default()).unwrap_or_else(|e| panic!("{e}"))
}

fn values(volume: &Volume) -> Vec<f32> {
    (0..volume.voxels().len()).map(|i| volume.value_from_stored(volume.voxels().get(i))).collect()
}

fn message(path: &Path, selection: Selection) -> String {
    try_open(path, selection).unwrap_err().to_string()
}

fn numbers(range: std::ops::Range<u16>) -> Vec<f32> {
    range.map(f32::from).collect()
}

fn has_warning(volume: &Volume, words: &str) {
    let warnings = &volume.info.warnings;
    assert!(warnings.iter().any(|w| w.contains(words)), "{words}: {warnings:?}");
}

/// OME-XML of 3×2×2 voxels in three channels, one in each of these files.
fn ome(names: [&str; 3]) -> String {
    let data: String = names
        .iter()
        .enumerate()
        .map(|(c, name)| {
            format!(
                "<TiffData FirstZ=\"0\" FirstC=\"{c}\" FirstT=\"0\" IFD=\"0\" PlaneCount=\"2\">\
                 <UUID FileName=\"{name}\">urn:uuid:{c}</UUID></TiffData>"
            )
        })
        .collect();
    format!(
        "<?xml version=\"1.0\"?><OME><Image Name=\"a\"><Pixels DimensionOrder=\"XYZCT\" SizeX=\"3\" SizeY=\"2\" \
         SizeZ=\"2\" SizeC=\"3\" SizeT=\"1\" Type=\"uint16\" PhysicalSizeX=\"0.5\" PhysicalSizeY=\"0.5\" \
         PhysicalSizeZ=\"2\">{data}</Pixels></Image></OME>"
    )
}

const NAMES: [&str; 3] = ["a_c0.ome.tif", "a_c1.ome.tif", "a_c2.ome.tif"];

/// An image in three files, each with this description.
fn three_files(folder: &Path, text: impl Fn(usize) -> String) {
    for (c, name) in NAMES.iter().enumerate() {
        let mut pages = pages([3, 2], 2, 100 * c as u16);
        pages[0].description = Some(text(c));
        write(folder, name, &pages);
    }
}

#[test]
fn an_image_in_several_files_is_read_from_all_of_them() {
    let binary_only = |file: &str| {
        format!("<?xml version=\"1.0\"?><OME><BinaryOnly MetadataFile=\"{file}\" UUID=\"urn:uuid:9\"/></OME>")
    };
    type Text = Box<dyn Fn(usize) -> String>;
    let of_each: [(&str, Text); 3] = [
        ("each", Box::new(|_| ome(NAMES))),
        ("companion", Box::new(move |_| binary_only("a.companion.ome"))),
        ("first", Box::new(move |c| if c == 1 { ome(NAMES) } else { binary_only("a_c1.ome.tif") })),
    ];
    for (name, text) in of_each {
        let folder = TempDir::new().unwrap();
        three_files(folder.path(), text);
        fs::write(folder.path().join("a.companion.ome"), ome(NAMES)).unwrap();
        for path in [folder.path().to_owned(), folder.path().join(NAMES[0]), folder.path().join(NAMES[2])] {
            assert_eq!(outline_of(&path).num_channels, 3, "{name} {path:?}");
            for channel in 0..3 {
                let volume = part(&path, channel, 0);
                let first = 100 * channel as u16;
                assert_eq!(values(&volume), numbers(first..first + 12), "{name} {path:?} {channel}");
                assert_eq!(volume.spacing(), Vec3::new(0.5, 0.5, 2.0));
                assert_eq!(volume.info.warnings, [""; 0]);
            }
        }
    }
}

#[test]
fn an_ome_image_tells_the_time_between_its_times() {
    let folder = TempDir::new().unwrap();
    for (times, attributes, seconds) in [
        (2, "TimeIncrement=\"0.5\"", Some(0.5)),
        (2, "TimeIncrement=\"2\" TimeIncrementUnit=\"min\"", Some(120.0)),
        (2, "TimeIncrement=\"2\" TimeIncrementUnit=\"lightyear\"", None),
        (2, "TimeIncrement=\"-1\"", None),
        (2, "", None),
        (1, "TimeIncrement=\"0.5\"", None),
    ] {
        let text = format!(
            "<?xml version=\"1.0\"?><OME><Image Name=\"a\"><Pixels DimensionOrder=\"XYZCT\" SizeX=\"3\" SizeY=\"2\" \
             SizeZ=\"1\" SizeC=\"1\" SizeT=\"{times}\" {attributes}/></Image></OME>"
        );
        let mut all = pages([3, 2], times, 0);
        all[0].description = Some(text);
        let found = outline_of(&write(folder.path(), "a.ome.tif", &all)).time_step;
        assert_eq!(found, seconds, "{attributes}");
    }
}

#[test]
fn files_that_are_missing_are_told_of() {
    let folder = TempDir::new().unwrap();
    three_files(folder.path(), |_| ome(NAMES));
    fs::remove_file(folder.path().join(NAMES[1])).unwrap();
    let path = folder.path().join(NAMES[2]);
    // Existing planes can be shown, and a missing one is an error.
    let volume = part(&path, 2, 0);
    assert_eq!(values(&volume), numbers(200..212));
    has_warning(&volume, "1 of 3 files are missing: \"a_c1.ome.tif\"");
    let channel = Selection { channel: Some(1), ..Selection::default() };
    let text = message(&path, channel);
    assert!(text.contains("a_c1.ome.tif") && text.contains("the file is missing"), "{text}");

    let text = "<?xml version=\"1.0\"?><OME><BinaryOnly MetadataFile=\"b.companion.ome\"/></OME>";
    let path = write(folder.path(), "b.tif", &[pages([3, 2], 1, 0)[0].clone().described(text)]);
    let text = message(&path, Selection::default());
    assert!(text.contains("its description is in \"b.companion.ome\", which is missing"), "{text}");
    fs::write(folder.path().join("b.companion.ome"), "<OME></OME>").unwrap();
    let text = message(&path, Selection::default());
    assert!(text.contains("b.companion.ome: OME-TIFF: OME-XML has no Pixels"), "{text}");
    let text = "<?xml version=\"1.0\"?><OME><BinaryOnly MetadataFile=\"../b.ome\"/></OME>";
    let path = write(folder.path(), "c.tif", &[pages([3, 2], 1, 0)[0].clone().described(text)]);
    assert!(message(&path, Selection::default()).contains("a name without folders"));
}

#[test]
fn a_folder_of_several_images_is_no_volume_but_slices_are() {
    let image = |z: u32| {
        format!(
            "<?xml version=\"1.0\"?><OME><Image><Pixels DimensionOrder=\"XYZCT\" SizeX=\"3\" SizeY=\"2\" SizeZ=\"{z}\" \
             SizeC=\"1\" SizeT=\"1\" PhysicalSizeX=\"0.5\" PhysicalSizeY=\"0.5\"/></Image></OME>"
        )
    };
    let folder = TempDir::new().unwrap();
    for k in 0..3 {
        let mut pages = pages([3, 2], 1, 6 * k);
        pages[0].description = Some(image(1));
        write(folder.path(), &format!("{k}.ome.tif"), &pages);
    }
    let volume = whole(folder.path());
    assert_eq!((volume.dims(), values(&volume)), ([3, 2, 3], numbers(0..18)));
    assert_eq!((volume.spacing().x, volume.info.unit.as_deref()), (0.5, Some("µm")));

    let folder = TempDir::new().unwrap();
    for name in ["a.ome.tif", "b.ome.tif"] {
        let mut pages = pages([3, 2], 2, 0);
        pages[0].description = Some(image(2));
        write(folder.path(), name, &pages);
    }
    let text = message(folder.path(), Selection::default());
    assert!(text.contains("a folder of several OME-TIFF images, expected one of its files"), "{text}");

    // A file that does not belong to the image.
    let folder = TempDir::new().unwrap();
    three_files(folder.path(), |_| ome(NAMES));
    write(folder.path(), "z.tif", &pages([3, 2], 1, 0));
    has_warning(&whole(folder.path()), "1 TIFF files of the folder are not of this image");
}

#[test]
fn series_have_shapes_of_their_own() {
    let folder = TempDir::new().unwrap();
    let both = [pages([3, 2], 2, 0), pages([2, 2], 3, 100)].concat();
    let plain = write(folder.path(), "plain.tif", &both);
    assert_eq!(outline_of(&plain).series, ["3×2 uint16, 2 pages", "2×2 uint16, 3 pages"]);
    let volume = whole(&plain);
    assert_eq!(values(&volume), numbers(0..12));
    has_warning(&volume, "2 series (3×2 uint16, 2 pages; 2×2 uint16, 3 pages), of which 0 is shown");

    let image = |name: &str, [x, y, z]: [u32; 3], first: u32| {
        let data: String =
            (0..z).map(|k| format!("<TiffData FirstZ=\"{k}\" IFD=\"{}\"/>", first + k)).collect();
        format!(
            "<Image Name=\"{name}\"><Pixels DimensionOrder=\"XYZCT\" SizeX=\"{x}\" SizeY=\"{y}\" SizeZ=\"{z}\" \
             SizeC=\"1\" SizeT=\"1\">{data}</Pixels></Image>"
        )
    };
    let text =
        format!("<?xml version=\"1.0\"?><OME>{}{}</OME>", image("a", [3, 2, 2], 0), image("b", [2, 2, 3], 2));
    let mut described = both.clone();
    described[0].description = Some(text);
    let ome = write(folder.path(), "a.ome.tif", &described);
    assert_eq!(outline_of(&ome).series, ["\"a\" 3×2×2", "\"b\" 2×2×3"]);
    for path in [plain, ome] {
        let series = |n| Selection { series: Some(n), ..Selection::default() };
        let volume = try_open(&path, series(1)).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!((volume.dims(), values(&volume)), ([2, 2, 3], numbers(100..112)));
        assert!(message(&path, series(2)).contains("series 2 was asked for, expected 0 to 1"));
    }
}

#[test]
fn white_as_the_least_is_turned_over() {
    let folder = TempDir::new().unwrap();
    let mut white = pages([3, 2], 2, 0);
    white.iter_mut().for_each(|p| p.photometric = 0);
    let expected: Vec<f32> = (0..12).map(|x| 65535.0 - x as f32).collect();
    let path = write(folder.path(), "a.tif", &white);
    assert_eq!(values(&whole(&path)), expected);
    has_warning(&whole(&path), "the least value is white (MinIsWhite); values were inverted");
    // Slices in several files, and planes after one page, are not decoded.
    let slices = folder.path().join("slices");
    fs::create_dir(&slices).unwrap();
    white
        .iter()
        .enumerate()
        .for_each(|(k, p)| drop(write(&slices, &format!("{k}.tif"), std::slice::from_ref(p))));
    assert_eq!(values(&whole(&slices)), expected);
    has_warning(&whole(&slices), "MinIsWhite");
    let mut one = Page::new([3, 2], (0..12).collect()).described("ImageJ=1.54f\nimages=2\nslices=2\n");
    one.photometric = 0;
    assert_eq!(values(&whole(&write(folder.path(), "b.tif", &[one]))), expected);
    // White is undefined for signed numbers.
    white[0].format = 2;
    let text = message(&write(folder.path(), "c.tif", &white), Selection::default());
    assert!(text.contains("MinIsWhite") && text.contains("type int16"), "{text}");
}

#[test]
fn arrays_of_tifffile_have_their_axes() {
    let folder = TempDir::new().unwrap();
    // Two times, three channels, two slices.
    let mut all = pages([3, 2], 12, 0);
    for (name, text) in [
        ("named.tif", r#"{"shape": [2, 3, 2, 2, 3], "axes": "TCZYX"}"#),
        ("old.tif", "shape=(2, 3, 2, 2, 3)"),
    ] {
        all[0].description = Some(text.into());
        let path = write(folder.path(), name, &all);
        let before = outline_of(&path);
        assert_eq!((before.num_channels, before.num_times, before.dims), (3, 2, [3, 2, 2]), "{name}");
        assert_eq!(values(&part(&path, 2, 1)), numbers(60..72), "{name}");
        let is_guess = part(&path, 2, 1).info.warnings.iter().any(|w| w.contains("have no names"));
        assert_eq!(is_guess, name == "old.tif", "{name}");
    }
    // Each series has a description, although their pages are alike. A series of one page is an ordinary page.
    let mut two = [pages([3, 2], 2, 0), pages([3, 2], 2, 100)].concat();
    two[0].description = Some(r#"{"shape": [2, 2, 3]}"#.into());
    two[2].description = two[0].description.clone();
    let path = write(folder.path(), "two.tif", &two);
    assert_eq!(outline_of(&path).series.len(), 2);
    let series = Selection { series: Some(1), ..Selection::default() };
    assert_eq!(values(&try_open(&path, series).unwrap()), numbers(100..112));
    two.iter_mut().for_each(|p| p.description = Some(r#"{"shape": [2, 3]}"#.into()));
    assert_eq!(whole(&write(folder.path(), "loop.tif", &two)).dims(), [3, 2, 4]);
    // The description has more planes than there are pages.
    all[0].description = Some(r#"{"shape": [5, 3, 2, 2, 3], "axes": "TCZYX"}"#.into());
    has_warning(&whole(&write(folder.path(), "few.tif", &all)), "the description has 30 planes, the file 12");
}

#[test]
fn planes_behind_one_page_are_read_or_refused() {
    let folder = TempDir::new().unwrap();
    let text = r#"{"shape": [2, 3, 2, 2, 3], "axes": "TCZYX", "truncated": true}"#;
    let mut page = Page::new([3, 2], (0..72).collect()).described(text);
    let path = write(folder.path(), "a.tif", &[page.clone()]);
    assert_eq!(values(&part(&path, 2, 1)), numbers(60..72));
    // The file is too short, or compressed (32773 is PackBits).
    let long = text.replace("[2,", "[200,");
    let short = page.clone().described(&long);
    let text = message(&write(folder.path(), "b.tif", &[short]), Selection::default());
    assert!(text.contains("uint16 needs 14400 bytes"), "{text}");
    page.more = vec![(259, 32_773)];
    let text = message(&write(folder.path(), "c.tif", &[page]), Selection::default());
    assert!(text.contains("its description has 12 planes, but there is one page, packed"), "{text}");
    // A page contains a whole volume (32997 is ImageDepth).
    let mut deep = Page::new([3, 2], (0..12).collect());
    deep.more = vec![(32_997, 2)];
    let text = message(&write(folder.path(), "d.tif", &[deep]), Selection::default());
    assert!(text.contains("ImageDepth is 2, expected 1"), "{text}");
}

#[test]
fn stacks_of_imagej_have_their_order_and_steps() {
    let folder = TempDir::new().unwrap();
    let text = "ImageJ=1.54f\nimages=12\nchannels=3\nslices=2\nframes=2\nhyperstack=true\nunit=\\u00B5m\nspacing=1.5\n";
    let mut all = pages([3, 2], 12, 0);
    // There are 4 pixels per micrometre along x and 2 along y.
    all[0].resolution = Some([4000, 2000]);
    all[0].description = Some(text.into());
    let mut one = Page { pixels: (0..72).collect(), ..all[0].clone() };
    for path in [write(folder.path(), "a.tif", &all), write(folder.path(), "b.tif", &[one.clone()])] {
        // Channels come first, then slices, then frames.
        let volume = part(&path, 1, 1);
        assert_eq!(values(&volume), [numbers(42..48), numbers(60..66)].concat());
        assert_eq!((volume.spacing(), volume.info.unit.as_deref()), (Vec3::new(0.25, 0.5, 1.5), Some("µm")));
    }
    for (lines, seconds) in [
        ("finterval=90.0\ntunit=sec\nfps=7.0\n", Some(90.0)),
        ("finterval=250\ntunit=ms\n", Some(0.25)),
        ("finterval=0\nfps=5.0\n", Some(0.2)),
        ("finterval=1.5\ntunit=frame\n", None),
        ("", None),
    ] {
        all[0].description = Some(format!("{text}{lines}"));
        assert_eq!(outline_of(&write(folder.path(), "t.tif", &all)).time_step, seconds, "{lines}");
    }
    one.more = vec![(259, 32_773)];
    let text = message(&write(folder.path(), "c.tif", &[one]), Selection::default());
    assert!(text.contains("its description has 12 planes, but there is one page, packed"), "{text}");
}

#[test]
fn channels_of_imagej_have_its_colours_and_ranges() {
    let folder = TempDir::new().unwrap();
    let text = "ImageJ=1.54f\nimages=4\nchannels=2\nslices=2\nhyperstack=true\nmode=composite\n";
    let mut all = pages([3, 2], 4, 0);
    all[0].description = Some(text.into());
    // Two tables of colours and a list of ranges (ij.io.TiffEncoder).
    let table = |color: [u16; 3]| -> Vec<u8> {
        color.iter().flat_map(|c| (0..256).map(move |i| (i * c / 255) as u8)).collect()
    };
    let kind = |name: &[u8; 4], count: u32| {
        let mut name = *name;
        name.reverse();
        [&name[..], &count.to_le_bytes()].concat()
    };
    let ranges: Vec<u8> = [5.0f64, 90.0, 1.0, 9.0].iter().flat_map(|x| x.to_le_bytes()).collect();
    let list = [b"JIJI".to_vec(), kind(b"luts", 2), kind(b"rang", 1)].concat();
    let blocks = [list, table([255, 0, 255]), table([0, 255, 0]), ranges];
    let lengths: Vec<u8> = blocks.iter().flat_map(|b| (b.len() as u32).to_le_bytes()).collect();
    let bytes = blocks.concat();
    all[0].blocks = vec![(50_838, 4, 4, lengths), (50_839, 1, bytes.len() as u32, bytes)];
    let volume = whole(&write(folder.path(), "a.tif", &all));
    let looks: Vec<_> = volume.channels().map(|v| (v.info.channel.color, v.info.window)).collect();
    let expected = [(Some([255, 0, 255]), Some((5.0, 90.0))), (Some([0, 255, 0]), Some((1.0, 9.0)))];
    assert_eq!(looks, expected);
    let found: Vec<Vec<f32>> = volume.channels().map(values).collect();
    assert_eq!(
        found,
        [[numbers(0..6), numbers(12..18)].concat(), [numbers(6..12), numbers(18..24)].concat()]
    );
    // A block that is cut says nothing.
    all[0].blocks[1].3.truncate(100);
    all[0].blocks[1].2 = 100;
    let volume = whole(&write(folder.path(), "b.tif", &all));
    assert_eq!((volume.others().len(), volume.info.channel.color), (1, None));
}

#[test]
fn channels_of_ome_have_names_and_colours() {
    let folder = TempDir::new().unwrap();
    // Magenta and opaque, and green with a sign left out.
    let text = r#"<?xml version="1.0"?><OME><Image><Pixels DimensionOrder="XYZCT" SizeX="3" SizeY="2" SizeZ="2"
        SizeC="2" SizeT="1" Type="uint16"><Channel Name="DAPI" Color="-16711681"/><Channel Name="GFP"
        Color="16711935"/><TiffData/></Pixels></Image></OME>"#;
    let mut all = pages([3, 2], 4, 0);
    all[0].description = Some(text.into());
    let volume = whole(&write(folder.path(), "a.ome.tif", &all));
    let looks: Vec<_> =
        volume.channels().map(|v| (&v.info.channel.name[..], v.info.channel.color, values(v))).collect();
    assert_eq!(looks[0], ("DAPI", Some([255, 0, 255]), numbers(0..12)));
    assert_eq!(looks[1], ("GFP", Some([0, 255, 0]), numbers(12..24)));
    assert_eq!(looks.len(), 2);
}

/// Slides are only named, because most are in a JPEG 2000 variant (33003).
#[test]
fn slides_are_no_volumes() {
    let folder = TempDir::new().unwrap();
    let mut page = Page::new([3, 2], vec![0; 6]).described("Aperio Image Library v12.0.15\r\n3x2 J2K");
    (page.photometric, page.more) = (2, vec![(259, 33_003)]);
    let text = message(&write(folder.path(), "a.svs", &[page]), Selection::default());
    assert!(
        text.contains("found a slide of a microscope (Aperio SVS), expected a volume; `bfconvert"),
        "{text}"
    );
}

/// ImageJ has one page for stacks beyond 4 GB.
#[test]
fn planes_beyond_four_gigabytes_are_found() {
    let folder = TempDir::new().unwrap();
    let mut page = Page::new([2048, 1024], vec![0; 2048 * 1024]);
    page = page.described("ImageJ=1.54f\nimages=1100\nframes=1100\nhyperstack=true\n");
    let path = write(folder.path(), "a.tif", &[page]);
    let bytes = fs::read(&path).unwrap();
    // The description follows the first plane. The rest is a hole, except for the last plane.
    let (plane, start) = (4 << 20, 8u64);
    let file = fs::File::options().write(true).open(&path).unwrap();
    file.set_len(start + 1100 * plane).unwrap();
    drop(file);
    assert!(bytes.len() as u64 > start + plane);
    use std::io::{Seek, SeekFrom, Write};
    let mut file = fs::File::options().write(true).open(&path).unwrap();
    file.seek(SeekFrom::Start(start + 1099 * plane)).unwrap();
    file.write_all(&[7, 1, 9, 0]).unwrap();
    drop(file);
    let region = Some("0:3,0:1,:".parse().unwrap());
    let selection = Selection { time: Some(1099), region, ..Selection::default() };
    assert_eq!(values(&try_open(&path, selection).unwrap_or_else(|e| panic!("{e}"))), [263.0, 9.0, 0.0]);
}
