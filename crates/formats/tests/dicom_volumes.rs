//! DICOM series with several or incomplete volumes. The tests check that each volume is complete, and that warnings
//! report the rest.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

#[path = "support/dicom.rs"]
mod dicom;

use std::fs;
use std::path::Path;

use dicom::{PLAIN, decimals, element, file, sequence, text};
use isinglass_core::volume::Volume;
use isinglass_formats::{OpenOptions, Outline, Selection, open, outline};
use tempfile::TempDir;

const IMAGE_TYPE: (u16, u16) = (0x0008, 0x0008);
const ACQUISITION_TIME: (u16, u16) = (0x0008, 0x0032);
const CONTENT_TIME: (u16, u16) = (0x0008, 0x0033);
const ECHO_TIME: (u16, u16) = (0x0018, 0x0081);
const ECHO_NUMBERS: (u16, u16) = (0x0018, 0x0086);
const TRIGGER_TIME: (u16, u16) = (0x0018, 0x1060);
const B_VALUE: (u16, u16) = (0x0018, 0x9087);
const ACQUISITION_NUMBER: (u16, u16) = (0x0020, 0x0012);
const INSTANCE_NUMBER: (u16, u16) = (0x0020, 0x0013);
const POSITION: (u16, u16) = (0x0020, 0x0032);
const ORIENTATION: (u16, u16) = (0x0020, 0x0037);
const TEMPORAL_POSITION: (u16, u16) = (0x0020, 0x0100);

const AXIAL: [f64; 6] = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0];
const CORONAL: [f64; 6] = [1.0, 0.0, 0.0, 0.0, 0.0, -1.0];

fn integer(tag: (u16, u16), value: usize) -> Vec<u8> {
    text(tag, "IS", &value.to_string())
}

fn double(tag: (u16, u16), value: f64) -> Vec<u8> {
    element(tag, "FD", &value.to_le_bytes())
}

fn long(tag: (u16, u16), value: u32) -> Vec<u8> {
    element(tag, "UL", &value.to_le_bytes())
}

/// An axial slice of one value at this height.
fn slice(z: f64, value: u16, more: &[Vec<u8>]) -> Vec<u8> {
    let place = [
        decimals(POSITION, &[0.0, 0.0, z]),
        decimals(ORIENTATION, &AXIAL),
        decimals((0x0028, 0x0030), &[1.0, 1.0]),
    ];
    file(PLAIN, [more, &place].concat(), &[value])
}

/// Writes files under names without an order.
fn folder(files: &[Vec<u8>]) -> TempDir {
    let folder = TempDir::new().unwrap();
    for (i, bytes) in files.iter().enumerate() {
        fs::write(folder.path().join(format!("{:03}", (i * 37 + 11) % 101)), bytes).unwrap();
    }
    folder
}

fn options(series: Option<u32>, time: Option<u32>) -> OpenOptions<'static> {
    OpenOptions { selection: Selection { series, time, ..Selection::default() }, ..OpenOptions::default() }
}

fn outline_of(path: &Path) -> Outline {
    outline(path.to_str().unwrap(), &options(None, None)).unwrap_or_else(|e| panic!("{e}"))
}

/// The values of the slices of a part from below, and the warnings.
fn part(path: &Path, series: Option<u32>, time: Option<u32>) -> (Vec<f32>, Vec<String>) {
    let volume: Volume =
        open(path.to_str().unwrap(), &options(series, time)).unwrap_or_else(|e| panic!("{e}"));
    let dims = volume.dims();
    assert_eq!(dims.iter().product::<u32>() as usize, volume.voxels().len());
    let slices = (0..dims[2]).map(|k| volume.voxels().get((k * dims[0] * dims[1]) as usize));
    let kept = |w: &String| !w.starts_with("the axes of the file point to");
    (slices.collect(), volume.info.warnings.iter().filter(|w| kept(w)).cloned().collect())
}

/// Checks that a folder has this number of times with three slices of the values 10 t + k. Returns the warnings of
/// time 0.
fn check_times(path: &Path, num_times: u32) -> Vec<String> {
    let before = outline_of(path);
    assert_eq!((before.num_times, before.series.len()), (u64::from(num_times), 0), "{before:?}");
    for t in 0..num_times {
        let expected: Vec<f32> = (0..3).map(|k| (10 * t + k) as f32).collect();
        assert_eq!(part(path, None, Some(t)).0, expected, "time {t}");
    }
    part(path, None, Some(0)).1
}

/// Three slices at each of several times. `more` adds elements to slice k of time t.
fn times(num_times: usize, more: impl Fn(usize, usize) -> Vec<Vec<u8>>) -> Vec<Vec<u8>> {
    let one = |t: usize, k: usize| slice(3.0 * k as f64, (10 * t + k) as u16, &more(t, k));
    (0..num_times).flat_map(|t| (0..3).map(move |k| (t, k))).map(|(t, k)| one(t, k)).collect()
}

#[test]
fn what_differs_in_a_place_divides_it_into_times() {
    // The numbers count backwards, so that only the key gives the right order.
    let number = |t: usize, k: usize| integer(INSTANCE_NUMBER, 100 - 3 * t - k);
    let time = |t: usize| text(ACQUISITION_TIME, "TM", &format!("1359{:02}.5", 10 + t));
    type More<'a> = &'a dyn Fn(usize, usize) -> Vec<Vec<u8>>;
    let cases: [(&str, More); 7] = [
        ("temporal position", &|t, k| vec![integer(TEMPORAL_POSITION, t + 1), number(t, k)]),
        ("trigger time", &|t, k| vec![decimals(TRIGGER_TIME, &[9.5 * t as f64]), number(t, k)]),
        ("acquisition number", &|t, k| vec![integer(ACQUISITION_NUMBER, t + 3), number(t, k)]),
        ("acquisition time", &|t, k| vec![time(t), number(t, k)]),
        // Every slice has its own time, as scanners write it that take slices one by one.
        ("times of slices", &|t, k| {
            vec![text(CONTENT_TIME, "TM", &format!("10{:02}{:02}", t, 10 * k)), number(t, k)]
        }),
        ("heartbeats", &|t, k| vec![decimals(TRIGGER_TIME, &[30.0 * t as f64 + k as f64]), number(t, k)]),
        // Neither of the two keys is enough alone.
        ("two keys", &|t, k| {
            vec![integer(TEMPORAL_POSITION, t / 2), double(B_VALUE, (t % 2) as f64), number(t, k)]
        }),
    ];
    for (name, more) in cases {
        let folder = folder(&times(4, more));
        let said = check_times(folder.path(), 4);
        assert_eq!(said, [""; 0], "{name}");
    }
    let b_values = folder(&times(3, |t, k| vec![double(B_VALUE, 500.0 * t as f64), number(t, k)]));
    let said = check_times(b_values.path(), 3);
    assert_eq!(said, ["the points in time are b-values: 0, 500, 1000 s/mm²"]);
}

#[test]
fn kinds_of_pictures_and_echoes_are_series() {
    let number = |i: usize| integer(INSTANCE_NUMBER, i + 1);
    // Magnitude and phase, each at two times.
    let kinds = ["ORIGINAL\\PRIMARY\\M\\ND", "ORIGINAL\\PRIMARY\\P\\ND"];
    let mut files = Vec::new();
    for (kind, words) in kinds.iter().enumerate() {
        files.extend((0..6).map(|i| {
            let (t, k) = (i / 3, i % 3);
            let value = (100 * kind + 10 * t + k) as u16;
            let more = [text(IMAGE_TYPE, "CS", words), integer(TEMPORAL_POSITION, t), number(6 * kind + i)];
            slice(3.0 * k as f64, value, &more)
        }));
    }
    let both = folder(&files);
    let before = outline_of(both.path());
    let expected = [r#"7 "made", "M": MR, 6 slices of 2×2"#, r#"7 "made", "P": MR, 6 slices of 2×2"#];
    assert_eq!((&before.series[..], before.num_times), (&expected.map(str::to_owned)[..], 2));
    assert_eq!(part(both.path(), Some(0), Some(1)).0, [10.0, 11.0, 12.0]);
    assert_eq!(part(both.path(), Some(1), Some(1)).0, [110.0, 111.0, 112.0]);

    // Echoes have only a number or only a time. The last lacks a slice.
    for tag in [ECHO_NUMBERS, ECHO_TIME] {
        let echo = |i: usize| {
            let value = (10 * (i / 3) + i % 3) as u16;
            slice(3.0 * (i % 3) as f64, value, &[decimals(tag, &[2.5 * (1 + i / 3) as f64]), number(i)])
        };
        let echoes = folder(&(0..8).map(echo).collect::<Vec<_>>());
        let before = outline_of(echoes.path());
        let unit = if tag == ECHO_TIME { " ms" } else { "" };
        assert!(before.series[2].starts_with(&format!(r#"7 "made", echo 7.5{unit}: MR, 2"#)), "{before:?}");
        assert_eq!(part(echoes.path(), Some(1), None).0, [10.0, 11.0, 12.0]);
        assert_eq!(part(echoes.path(), Some(2), None).0, [20.0, 21.0]);
    }

    // Types and echoes that change along the stack do not divide it.
    let along = |k: usize| {
        let kind = text(IMAGE_TYPE, "CS", kinds[usize::from(k > 3)]);
        slice(3.0 * k as f64, k as u16, &[kind, decimals(ECHO_TIME, &[k as f64])])
    };
    let one = folder(&(0..8).map(along).collect::<Vec<_>>());
    assert_eq!(outline_of(one.path()).series, [""; 0]);
    assert_eq!(part(one.path(), None, None).0, (0..8).map(|k| k as f32).collect::<Vec<_>>());
}

#[test]
fn what_nothing_divides_is_told() {
    let number = |t: usize, k: usize| integer(INSTANCE_NUMBER, 3 * t + k);
    let by_number = folder(&times(2, |t, k| vec![number(t, k)]));
    let said = check_times(by_number.path(), 2);
    let expected = "nothing but their numbers tells which of the 2 slices in each place belong together; they are taken as points in time in that order";
    assert_eq!(said, [expected]);

    // A scan was stopped early, and the last time lacks a slice.
    let mut files = times(3, |t, k| vec![integer(TEMPORAL_POSITION, t), number(t, k)]);
    files.pop();
    let said = check_times(folder(&files).path(), 2);
    assert_eq!(said, ["1 points in time lack slices and were left out"]);

    let mut files = times(2, |t, k| vec![number(t, k)]);
    files.pop();
    let said = check_times(folder(&files).path(), 1);
    let expected = "nothing divides the slices into whole volumes, there are 1 to 2 in a place; 2 that lie where others do were left out";
    assert_eq!(said, [expected]);
}

/// The groups of a frame in an enhanced file: position, orientation and content.
fn frame(position: [f64; 3], orientation: [f64; 6], content: Vec<Vec<u8>>) -> Vec<Vec<u8>> {
    vec![
        sequence((0x0020, 0x9111), &[content]),
        sequence((0x0020, 0x9113), &[vec![decimals(POSITION, &position)]]),
        sequence((0x0020, 0x9116), &[vec![decimals(ORIENTATION, &orientation)]]),
    ]
}

/// An enhanced file of these frames. Their values count from 0.
fn enhanced(frames: &[Vec<Vec<u8>>]) -> TempDir {
    let measures = sequence((0x0028, 0x9110), &[vec![decimals((0x0028, 0x0030), &[1.0, 1.0])]]);
    let groups = [sequence((0x5200, 0x9229), &[vec![measures]]), sequence((0x5200, 0x9230), frames)];
    let values: Vec<u16> = (0..frames.len() as u16).collect();
    folder(&[file(PLAIN, groups.to_vec(), &values)])
}

#[test]
fn frames_of_several_directions_are_series() {
    let axial = (0..3).map(|k| frame([0.0, 0.0, 3.0 * f64::from(k)], AXIAL, vec![]));
    let coronal = (0..2).map(|k| frame([0.0, 4.0 * f64::from(k), 0.0], CORONAL, vec![]));
    let both = enhanced(&axial.chain(coronal).collect::<Vec<_>>());
    let before = outline_of(both.path());
    let expected = [r#"7 "made", axial: MR, 3 slices of 2×2"#, r#"7 "made", coronal: MR, 2 slices of 2×2"#];
    assert_eq!(before.series, expected);
    assert_eq!((before.dims, before.spacing), ([2, 2, 3], [1.0, 1.0, 3.0]));
    assert_eq!(part(both.path(), Some(0), None).0, [0.0, 1.0, 2.0]);
    let second = outline(both.path().to_str().unwrap(), &options(Some(1), None)).unwrap();
    assert_eq!((second.dims, second.spacing), ([2, 2, 2], [1.0, 4.0, 1.0]));

    // Three slices cross each other. The path is that of the file.
    let planes = [AXIAL, CORONAL, [0.0, 1.0, 0.0, 0.0, 0.0, -1.0]];
    let scout = enhanced(&planes.map(|plane| frame([0.0; 3], plane, vec![])));
    let (values, said) =
        part(&fs::read_dir(scout.path()).unwrap().next().unwrap().unwrap().path(), None, None);
    assert_eq!(values, [0.0]);
    let choice =
        r#"the file has 3 series, of which the largest is shown: 7 "made", axial: MR, 1 slices of 2×2"#;
    assert!(said.iter().any(|w| w == choice), "{said:?}");
    assert!(!said.iter().any(|w| w.contains("its folder is a series")), "{said:?}");
}

#[test]
fn stacks_are_series_and_their_times_are_times() {
    // Two stacks in one direction overlap. Each has three slices at two times.
    let frames: Vec<_> = (0..12)
        .map(|i: u32| {
            let (stack, t, k) = (i / 6, i / 3 % 2, i % 3);
            let content = vec![
                text((0x0020, 0x9056), "SH", if stack == 0 { "1" } else { "2" }),
                long((0x0020, 0x9128), 2 - t),
            ];
            frame([0.0, 0.0, f64::from(3 * k + 4 * stack)], AXIAL, content)
        })
        .collect();
    let folder = enhanced(&frames);
    let before = outline_of(folder.path());
    let expected = [
        r#"7 "made", axial, stack "1": MR, 6 slices of 2×2"#,
        r#"7 "made", axial, stack "2": MR, 6 slices of 2×2"#,
    ];
    assert_eq!((&before.series[..], before.num_times), (&expected.map(str::to_owned)[..], 2));
    // The times count down.
    assert_eq!(part(folder.path(), Some(0), Some(0)).0, [3.0, 4.0, 5.0]);
    assert_eq!(part(folder.path(), Some(0), Some(1)).0, [0.0, 1.0, 2.0]);
    assert_eq!(part(folder.path(), Some(1), Some(0)).0, [9.0, 10.0, 11.0]);
}

#[test]
fn frames_are_divided_by_their_own_dimensions_echoes_and_types() {
    let at = |i: u32| [0.0, 0.0, 3.0 * f64::from(i % 3)];
    let index = |list: [u32; 2]| {
        let bytes: Vec<u8> = list.iter().flat_map(|n| n.to_le_bytes()).collect();
        element((0x0020, 0x9157), "UL", &bytes)
    };
    // Every frame has its own stack, which has no meaning. The second number counts down.
    let own = |i: u32| vec![text((0x0020, 0x9056), "SH", &format!("s{i}")), index([1 + i % 3, 3 - i / 3])];
    let times = enhanced(&(0..9).map(|i| frame(at(i), AXIAL, own(i))).collect::<Vec<_>>());
    let before = outline_of(times.path());
    assert_eq!((before.num_times, before.series.len()), (3, 0));
    assert_eq!(part(times.path(), None, Some(0)).0, [6.0, 7.0, 8.0]);

    let echo = |i: u32| sequence((0x0018, 0x9114), &[vec![double((0x0018, 0x9082), f64::from(i / 3 + 1))]]);
    let kind = |i: u32| {
        let words = [text((0x0008, 0x9007), "CS", "ORIGINAL\\PRIMARY"), {
            text((0x0008, 0x9208), "CS", if i < 3 { "MAGNITUDE" } else { "PHASE" })
        }];
        sequence((0x0018, 0x9226), &[words.to_vec()])
    };
    type Group<'a> = &'a dyn Fn(u32) -> Vec<u8>;
    for (group, word) in [(&echo as Group, "echo 2 ms"), (&kind, r#""PHASE""#)] {
        let frames = (0..6).map(|i| [vec![group(i)], frame(at(i), AXIAL, vec![])].concat());
        let folder = enhanced(&frames.collect::<Vec<_>>());
        let before = outline_of(folder.path());
        assert_eq!((before.series.len(), before.num_times), (2, 1));
        assert!(before.series[1].contains(word), "{:?}", before.series);
        assert_eq!(part(folder.path(), Some(1), None).0, [3.0, 4.0, 5.0]);
    }
}

#[test]
fn what_lies_beside_slices_changes_nothing() {
    let series = folder(&(0..3).map(|k| slice(3.0 * f64::from(k), k as u16, &[])).collect::<Vec<_>>());
    let put = |name: &str, bytes: &[u8]| {
        let path = series.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
    };
    put("shot.tif", b"II*\0\x08\0\0\0");
    put("shot.png", b"\x89PNG\r\n\x1a\n");
    put("facts.json", b"{\"Modality\": \"MR\"}");
    put(".DS_Store", b"\0\0\0\x01Bud1");
    // A hidden file may look like a slice.
    put("._IM0001", &slice(9.0, 9, &[]));
    put(".trash/IM0001", &slice(9.0, 9, &[]));
    assert_eq!(outline_of(series.path()).format, "DICOM, plain");
    assert_eq!(part(series.path(), None, None), (vec![0.0, 1.0, 2.0], vec![]));

    // A single DICOM slice beside TIFF files is ignored.
    let pages = TempDir::new().unwrap();
    for name in ["a.tif", "b.tif"] {
        let page = fs::File::create(pages.path().join(name)).unwrap();
        let mut encoder = tiff::encoder::TiffEncoder::new(page).unwrap();
        encoder.write_image::<tiff::encoder::colortype::Gray8>(2, 2, &[7; 4]).unwrap();
    }
    fs::write(pages.path().join("IM0001"), slice(0.0, 0, &[])).unwrap();
    assert_eq!(outline_of(pages.path()).dims, [2, 2, 2]);
}

#[test]
fn gaps_are_filled_and_blocks_stay_apart() {
    let at = |places: &[f64]| {
        let slices: Vec<_> = places.iter().enumerate().map(|(i, z)| slice(*z, 10 + i as u16, &[])).collect();
        let folder = folder(&slices);
        let (values, said) = part(folder.path(), None, None);
        (outline_of(folder.path()).spacing[2], values, said)
    };
    // The positions are rounded to a fiftieth of a millimetre.
    assert_eq!(at(&[0.0, 3.0, 6.02, 9.0, 12.0]), (3.0, vec![10.0, 11.0, 12.0, 13.0, 14.0], vec![]));
    let (distance, values, said) = at(&[0.0, 3.0, 6.0, 12.0, 15.0]);
    // The blended slice lies between 12 and 13, and is rounded.
    assert_eq!((distance, values.len(), values[4]), (3.0, 6, 13.0));
    assert!(
        said[0].starts_with("1 slice is missing, after slice 3; its neighbours were blended"),
        "{said:?}"
    );
    let (distance, values, said) = at(&[0.0, 3.0, 6.0, 81.0, 84.0, 87.0]);
    assert_eq!((distance, values.len()), (3.0, 30));
    assert_eq!((&values[..3], &values[27..]), (&[10.0, 11.0, 12.0][..], &[13.0, 14.0, 15.0][..]));
    // Nothing is in the gap: it has the least number of a slice beside it.
    assert!(values[3..27].iter().all(|x| *x <= 13.0), "{values:?}");
    let words =
        "the slices lie in 2 separate blocks of 3 and 3 slices, up to 75.0 mm apart; the gap is left empty";
    assert_eq!(said[0], words);
}

#[test]
fn mosaics_without_a_number_are_told() {
    let kind = text(IMAGE_TYPE, "CS", "ORIGINAL\\PRIMARY\\M\\ND\\MOSAIC");
    let mosaics = folder(&times(1, |_, _| vec![kind.clone()]));
    let expected =
        "the pictures are mosaics of slices (MOSAIC) without their number, and are shown as they are";
    assert_eq!(part(mosaics.path(), None, None).1, [expected]);
}
