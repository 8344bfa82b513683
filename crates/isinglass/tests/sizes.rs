//! Is a picture in little memory ever worse than that of the finest level that fits into it whole, whatever the file?

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[expect(dead_code, reason = "each test file uses its own part of the module")]
mod common;

use common::Bench;

/// Bytes of a sheet that is thinner than a voxel of the coarser levels, `SIDE` along each axis.
fn gyroid() -> Vec<u8> {
    let of = |i: usize| i as f32 / (SIDE - 1) as f32 * 2.0 - 1.0;
    let waves: Vec<(f32, f32)> = (0..SIDE).map(|i| (of(i) * 20.0).sin_cos()).collect();
    let mut bytes = Vec::with_capacity(SIDE.pow(3));
    for (z, (sin_z, cos_z)) in waves.iter().enumerate() {
        for (y, (sin_y, cos_y)) in waves.iter().enumerate() {
            for (x, (sin_x, cos_x)) in waves.iter().enumerate() {
                let g = (sin_x * cos_y + sin_y * cos_z + sin_z * cos_x).abs();
                let radius = [x, y, z].map(|i| of(i).powi(2)).iter().sum::<f32>();
                bytes.push(if g < 0.35 && radius < 0.9 { (180.0 * (1.0 - g / 0.35)) as u8 } else { 0 });
            }
        }
    }
    bytes
}

struct Pictures {
    bench: Bench,
}

impl Pictures {
    fn draw(&self, what: &str, name: &str) {
        self.bench.ok(&format!("render {what} -o {name}.png --size 320x240"));
    }

    /// The DSSIM of a picture against that of all voxels.
    fn error(&self, name: &str) -> f64 {
        self.bench.json(&format!("compare whole.png {name}.png --json"))["dssim"].as_f64().unwrap()
    }
}

#[test]
fn a_picture_is_never_worse_than_that_of_a_level_which_fits_whole() {
    let bench = Bench::new();
    bench.write("a.raw", gyroid());
    let flags = format!("--dims {SIDE},{SIDE},{SIDE} --dtype uint8");
    bench.ok(&format!("convert a.raw a.ome.zarr {flags}"));
    bench.ok(&format!("index a.raw {flags}"));
    let header = format!("NRRD0004\ntype: uchar\ndimension: 3\nsizes: {SIDE} {SIDE} {SIDE}\nencoding: raw\n");
    bench.write("a.nhdr", format!("{header}data file: a.raw\n"));
    bench.ok("index a.nhdr");
    let pictures = Pictures { bench };
    pictures.draw("a.ome.zarr", "whole");
    let levels = [1, 2].map(|level| {
        let name = format!("level{level}");
        pictures.draw(&format!("a.ome.zarr --level {level}"), &name);
        pictures.error(&name)
    });
    // What is not allowed is not taken.
    pictures.bench.fails("render a.ome.zarr --level 1 --max-memory 20MB -o none.png", 1, &["needs", "20"]);
    for source in ["a.ome.zarr".to_owned(), format!("a.raw {flags}"), "a.nhdr".to_owned()] {
        // Level 1 fits into the first of them, and all voxels with their brightness into the last.
        for (memory, most) in
            [("100MB", levels[0]), ("128MiB", levels[0]), ("160MB", levels[0]), ("190MB", 0.0)]
        {
            let is_flat = source != "a.ome.zarr";
            if is_flat && memory == "100MB" {
                // Nothing is read by pages in less than 128 MiB, and the file itself has no levels.
                let line = format!("render {source} -o none.png --max-memory {memory}");
                pictures.bench.fails(&line, 1, &["needs"]);
                continue;
            }
            pictures.draw(&format!("{source} --max-memory {memory}"), "some");
            let error = pictures.error("some");
            assert!(error <= most * MOST_MORE + 1e-4, "{source}, {memory}: {error}, expected {most}");
        }
    }
    // The control: the next level is worse.
    assert!(levels[1] > 1.5 * levels[0], "{levels:?}");
}

/// Voxels along each axis. They and their brightness take 180 MB.
const SIDE: usize = 448;
/// Where levels meet, colours step a little.
const MOST_MORE: f64 = 1.02;
