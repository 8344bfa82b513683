//! Are images seen as on a page, bodies from their front, and does `--flip` mirror both?

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[expect(dead_code, reason = "each test file uses its own part of the module")]
mod common;

use common::Bench;

const ROWS: [&str; 7] = ["#####", "#....", "#....", "####.", "#....", "#....", "#...."];

/// The letter in three equal slices, row by row.
fn voxels() -> Vec<u8> {
    let slice = || ROWS.iter().flat_map(|row| row.bytes().map(|b| if b == b'#' { 255 } else { 0 }));
    (0..3).flat_map(|_| slice()).collect()
}

fn numpy() -> Vec<u8> {
    let header = format!("{:<117}\n", "{'descr': '|u1', 'fortran_order': False, 'shape': (3, 7, 5)}");
    let start = [b"\x93NUMPY\x01\x00".as_slice(), &(header.len() as u16).to_le_bytes(), header.as_bytes()];
    [&start.concat(), &voxels()[..]].concat()
}

fn nrrd(space: &str) -> Vec<u8> {
    let header = format!(
        "NRRD0004\ntype: uint8\ndimension: 3\n{space}\nsizes: 5 7 3\nspace directions: (1,0,0) (0,1,0) (0,0,1)\n\
         encoding: raw\n\n"
    );
    [header.as_bytes(), &voxels()].concat()
}

/// The rows of the letter as the picture shows them: its bright pixels in 5 by 7 fields.
fn seen(bench: &Bench, arguments: &str) -> Vec<String> {
    let line = "--tf smooth --mode mip --orthographic --backend cpu --size 120x120 -o a.png";
    bench.ok(&format!("render {arguments} {line}"));
    let bytes = std::fs::read(bench.path("a.png")).unwrap();
    let picture = isinglass_formats::png::decode(&bytes, 120 * 120).unwrap();
    let is_bright = |x: usize, y: usize| picture.bytes[3 * (120 * y + x)] > 90;
    let bright: Vec<[usize; 2]> =
        (0..120 * 120).map(|i| [i % 120, i / 120]).filter(|[x, y]| is_bright(*x, *y)).collect();
    let ends = |k: usize| {
        let along = bright.iter().map(|at| at[k]);
        (along.clone().min().unwrap(), along.max().unwrap() + 1)
    };
    let ((x0, x1), (y0, y1)) = (ends(0), ends(1));
    let middle = |from: usize, to: usize, i: usize, n: usize| from + (to - from) * (2 * i + 1) / (2 * n);
    (0..7)
        .map(|row| {
            let y = middle(y0, y1, row, 7);
            (0..5).map(|column| if is_bright(middle(x0, x1, column, 5), y) { '#' } else { '.' }).collect()
        })
        .collect()
}

fn reversed_rows() -> Vec<String> {
    ROWS.iter().map(|row| row.chars().rev().collect()).collect()
}

fn upside_down() -> Vec<String> {
    ROWS.iter().rev().map(|row| (*row).to_owned()).collect()
}

#[test]
fn a_letter_in_an_image_reads_as_it_is_and_can_be_mirrored() {
    let bench = Bench::new();
    bench.write("f.npy", numpy());
    assert_eq!(seen(&bench, "f.npy --orbit 0,0"), ROWS);
    assert_eq!(seen(&bench, "f.npy --orbit 180,0"), reversed_rows(), "from behind");
    assert_eq!(seen(&bench, "f.npy --orbit 0,0 --flip x"), reversed_rows());
    assert_eq!(seen(&bench, "f.npy --orbit 0,0 --flip y"), upside_down());
    assert_eq!(seen(&bench, "f.npy --orbit 0,0 --flip z"), ROWS);
    // Voxels keep their numbers: the region of the first rows has the bar of the letter.
    let bar = bench.json("info f.npy --region :,:1,: --json");
    assert_eq!(bar["range"], serde_json::json!([255.0, 255.0]), "{bar}");
    let bar = bench.json("info f.npy --region :,6:,: --flip y --json");
    assert_eq!(bar["range"], serde_json::json!([255.0, 255.0]), "{bar}");
    assert_eq!(bar["orientation"], "RDB");
    bench.fails("info f.npy --flip w", 2, &["--flip", "such as y or x,z"]);
}

#[test]
fn other_volumes_are_seen_as_before() {
    let bench = Bench::new();
    bench.write("plain.nrrd", nrrd("space dimension: 3"));
    assert_eq!(seen(&bench, "plain.nrrd --orbit 0,0"), upside_down(), "y is up, from +z");
    bench.write("body.nrrd", nrrd("space: right-anterior-superior"));
    // From the top, the anterior side is below, and the right side at the left.
    assert_eq!(seen(&bench, "body.nrrd --orbit 0,90"), reversed_rows());
}
