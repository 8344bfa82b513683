//! Does each command do what it says, and do its JSON objects have the fields that other programs read?

#[expect(dead_code, reason = "each test file uses its own part of the module")]
mod common;

#[cfg(unix)]
use std::io::{BufRead, BufReader};
#[cfg(unix)]
use std::process::Stdio;

use serde_json::Value;

use common::{Bench, assert_has, files_in, keys};

const RENDER: &str = "--backend cpu --size 64x64";

#[test]
fn a_picture_equals_itself_and_no_other() {
    let bench = Bench::new();
    bench.ok(&format!("render builtin:shells@32 --orbit -30,20 -o a.png {RENDER}"));
    bench.ok(&format!("render builtin:shells@32 --orbit -30,20 -o again.png {RENDER}"));
    bench.ok(&format!("render builtin:shells@32 --orbit 30,20,3 -o other.png {RENDER}"));
    let same = bench.json("compare a.png again.png --json");
    assert_eq!(keys(&same), ["dssim", "dssim_object", "max_abs_255", "psnr_db", "ssim"]);
    assert_eq!((same["dssim"].as_f64(), same["max_abs_255"].as_u64()), (Some(0.0), Some(0)));
    let other = bench.json("compare a.png other.png --json");
    assert!(other["dssim"].as_f64() > Some(0.01) && other["max_abs_255"].as_u64() > Some(20), "{other}");
    assert!(bench.ok("compare a.png other.png").contains("PSNR"));
    assert_eq!(bench.files(), ["a.png", "again.png", "other.png"]);
}

/// Through the file, hence through the wire payload. The bound is the one that the work is for; a frame seen from
/// another side does not pass for the same.
#[test]
fn a_stored_frame_gives_back_the_picture_it_was_made_for() {
    let bench = Bench::new();
    for volume in ["cloud", "cubus", "shells"] {
        let from = "--orbit 25,-15";
        bench.ok(&format!("render builtin:{volume}@48 {from} -o a.png {RENDER}"));
        let facts = bench.json(&format!("layers builtin:{volume}@48 {from} -o a.iglf --k 6 --json {RENDER}"));
        assert_has(&facts, "output size backend tf k segments bytes generate_ms");
        for view in ["", from] {
            bench.ok(&format!("reproject a.iglf {view} -o b.png --backend cpu"));
            let error = bench.json("compare a.png b.png --json");
            assert!(error["dssim"].as_f64() <= Some(0.001), "{volume}: {error}");
        }
        bench.ok("reproject a.iglf --orbit 55,-15 -o b.png --backend cpu");
        let error = bench.json("compare a.png b.png --json");
        assert!(error["dssim"].as_f64() > Some(0.001), "{volume}: {error}");
    }
    let facts = bench.json("info a.iglf --json");
    assert_has(&facts, "size fov_deg eye near far k lists segments segments_mean bytes bytes_per_segment");
    assert_eq!(facts["size"], serde_json::json!([64, 64]));
    let of_chunks = facts["bytes_of_chunks"].as_array().unwrap().iter().filter_map(Value::as_u64);
    assert!(facts["bytes"] == of_chunks.sum::<u64>() && facts["bytes"] != 0, "{facts}");
    let text = bench.ok("info a.iglf");
    assert!(text.contains(&format!("{} in 1 chunks", facts["bytes"])), "{text}");
    // A frame in blocks takes fewer.
    bench.ok(&format!("layers builtin:shells@48 -o a.iglf --codec blocks {RENDER}"));
    let in_blocks = bench.json("info a.iglf --json");
    assert!(in_blocks["bytes"].as_u64() < facts["bytes"].as_u64(), "{in_blocks}");
    let facts = in_blocks;
    // Made for the own pose, as many bytes hold a better picture of it.
    let bytes = facts["bytes"].as_u64().unwrap();
    bench.ok(&format!(
        "layers builtin:shells@48 -o near.iglf --codec blocks --bytes {bytes} --turn 0 {RENDER}"
    ));
    assert!(bench.json("info near.iglf --json")["bytes"].as_u64().unwrap() <= bytes);
    bench.ok(&format!("render builtin:shells@48 -o a.png {RENDER}"));
    let dssim = |frame: &str| {
        bench.ok(&format!("reproject {frame} -o b.png --backend cpu"));
        bench.json("compare a.png b.png --json")["dssim"].as_f64().unwrap()
    };
    assert!(dssim("near.iglf") < 0.9 * dssim("a.iglf"), "{} {}", dssim("near.iglf"), dssim("a.iglf"));
}

/// What is cut away is gone from the rendering and from the stored frame alike, and so with parallel rays.
#[test]
fn clips_and_parallel_rays_are_the_same_in_a_picture_and_in_a_frame() {
    let bench = Bench::new();
    let worst = |a: &str, b: &str| bench.json(&format!("compare {a} {b} --json"))["max_abs_255"].as_u64();
    bench.ok(&format!("render builtin:shells@48 -o whole.png {RENDER}"));
    for flags in [
        "--clip-box=-1,0.2,-9,9,-9,9",
        "--clip-plane=-1,0,-2,0.1",
        "--orthographic",
        "--orthographic --clip-plane=0,1,0,0",
    ] {
        bench.ok(&format!("render builtin:shells@48 {flags} -o a.png {RENDER}"));
        bench.ok(&format!("layers builtin:shells@48 {flags} -o a.iglf {RENDER}"));
        bench.ok("reproject a.iglf -o b.png --backend cpu");
        assert!(worst("a.png", "b.png") <= Some(2), "{flags}");
        assert!(worst("a.png", "whole.png") > Some(20), "{flags}");
    }
    // A frame of all of the volume is cut as a viewer cuts it: what is left is that of the rendering, nearly.
    let cut = "--clip-plane=-1,0,-2,0.1";
    bench.ok(&format!("render builtin:shells@48 {cut} -o a.png {RENDER}"));
    bench.ok(&format!("layers builtin:shells@48 -o a.iglf --k 16 {RENDER}"));
    bench.ok(&format!("reproject a.iglf {cut} -o b.png --backend cpu"));
    let apart = |b: &str| bench.json(&format!("compare a.png {b} --json"))["dssim"].as_f64().unwrap();
    assert!(apart("b.png") < 0.1 * apart("whole.png"), "{} {}", apart("b.png"), apart("whole.png"));
    // From one projection into the other: nearer to its rendering than what it was made of.
    bench.ok(&format!("render builtin:shells@48 --orthographic -o flat.png {RENDER}"));
    bench.ok(&format!("layers builtin:shells@48 -o a.iglf {RENDER}"));
    bench.ok("reproject a.iglf --orthographic -o b.png --backend cpu");
    let dssim = |a: &str| bench.json(&format!("compare {a} flat.png --json"))["dssim"].as_f64().unwrap();
    assert!(dssim("b.png") < 0.6 * dssim("whole.png"), "{} {}", dssim("b.png"), dssim("whole.png"));
}

/// Each mode is its own picture, and a stored frame knows its mode.
#[test]
fn a_stored_frame_of_any_mode_gives_back_its_picture() {
    let bench = Bench::new();
    let volume = "builtin:cloud@40 --orbit 25,-15";
    bench.ok(&format!("render {volume} -o composite.png {RENDER}"));
    for mode in ["mip", "minip", "average", "iso --iso 60:0.4,120"] {
        let name = mode.split(' ').next().unwrap();
        let facts = bench.json(&format!("render {volume} -o a.png --mode {mode} --json {RENDER}"));
        assert_eq!(facts["mode"], name);
        let error = bench.json("compare a.png composite.png --json");
        assert!(error["max_abs_255"].as_u64() > Some(8), "{mode}: {error}");
        let facts = bench.json(&format!("layers {volume} -o a.iglf --mode {mode} --json {RENDER}"));
        assert_eq!(facts["mode"], name);
        assert_eq!(bench.json("info a.iglf --json")["mode"], name);
        assert!(bench.ok("info a.iglf").contains(&format!("mode         {name}")));
        bench.ok("reproject a.iglf -o b.png --backend cpu");
        let error = bench.json("compare a.png b.png --json");
        assert!(error["max_abs_255"].as_u64() <= Some(1), "{mode}: {error}");
    }
    bench.fails(
        &format!("layers {volume} -o c.iglf --mode mip --codec blocks {RENDER}"),
        2,
        &["blocks", "mip", "exact"],
    );
    bench.fails(&format!("render {volume} -o c.png --mode mip --iso 3 {RENDER}"), 2, &["--iso", "mip"]);
    bench.fails(&format!("render {volume} -o c.png --mode xray {RENDER}"), 2, &["xray", "average"]);
    bench.fails(&format!("render {volume} -o c.png --iso 1:2 {RENDER}"), 2, &["--iso", "opacity"]);
}

/// A frame seen from 90 and 180 degrees aside, from within the volume and in another size is a picture too.
#[test]
fn a_stored_frame_can_be_seen_from_anywhere() {
    let bench = Bench::new();
    bench.ok(&format!("layers builtin:cloud@32 --orbit 0,0 -o a.iglf {RENDER}"));
    for view in ["90,0", "180,0", "0,90", "10,10,0.2", "0,0,0", "-5,0,9"] {
        bench.ok(&format!("reproject a.iglf --orbit {view} -o b.png --size 40x30 --fov 70 --backend cpu"));
        assert!(bench.path("b.png").metadata().unwrap().len() > 0);
    }
}

/// Two eyes at one place, a lens that is a point and a shutter that sees no movement give the plain picture to the byte;
/// what they give otherwise is that of the averages of full renderings.
#[test]
fn a_stored_frame_gives_stereo_pairs_and_averages() {
    let bench = Bench::new();
    let from = "--orbit 25,-15,3";
    bench.ok(&format!("layers builtin:cubus@32 {from} -o a.iglf {RENDER}"));
    bench.ok("reproject a.iglf -o plain.png --backend cpu");
    for lens in ["--aperture 0", "--shutter 25,-15", "--stereo 0 --anaglyph"] {
        bench.ok(&format!("reproject a.iglf {from} {lens} -o b.png --backend cpu"));
        let error = bench.json("compare plain.png b.png --json");
        // The orbit is computed again from the header's numbers, so an eye may differ in its last digits.
        assert!(error["max_abs_255"].as_u64() <= Some(1), "{lens}: {error}");
    }
    for (lens, size) in [
        ("--stereo 0.2", [128, 64]),
        ("--stereo 0.2 --focus 2 --anaglyph", [64, 64]),
        ("--aperture 0.3 --samples 8", [64, 64]),
        ("--shutter 35,-10 --samples 8", [64, 64]),
        ("--aperture 0.2 --focus 2.2 --shutter 35,-10,2.8 --stereo 0.1 --samples 5", [128, 64]),
    ] {
        bench.ok(&format!("render builtin:cubus@32 {from} {lens} -o truth.png {RENDER}"));
        let facts = bench.json(&format!("reproject a.iglf {lens} -o b.png --backend cpu --json"));
        assert_has(&facts, "output size backend lens novel_view_ms");
        assert_has(&facts["lens"], "stereo aperture_world focus_world shutter_deg samples");
        assert_eq!(facts["size"], serde_json::json!(size), "{lens}");
        let error = bench.json("compare truth.png b.png --json");
        assert!(error["dssim"].as_f64() < Some(0.02), "{lens}: {error}");
        if size == [64, 64] {
            let control = bench.json("compare truth.png plain.png --json");
            let [error, control] = [error, control].map(|e| e["dssim"].as_f64().unwrap());
            assert!(control > 1.5 * error, "{lens}: {error}, plain {control}");
        }
    }
    let facts = bench.json("reproject a.iglf --stereo 0.1 -o b.png --backend cpu --json");
    // Two arc tangents of half a tenth over three.
    let angle = facts["lens"]["stereo"]["eye_angle_deg"].as_f64().unwrap();
    assert!((angle - 1.9095).abs() < 1e-3 && facts["lens"]["samples"] == 1, "{facts}");
}

#[test]
fn info_has_the_promised_fields() {
    let bench = Bench::new();
    let facts = bench.json("info builtin:shells@16 --json");
    let promised = [
        "bytes_in_memory",
        "dims",
        "dtype",
        "orientation",
        "percentiles",
        "range",
        "spacing",
        "values_of",
        "warnings",
    ];
    assert_eq!(keys(&facts), promised);
    bench.write("a.raw", [0u8; 10 + 2 * 24]);
    let raw = "a.raw --dims 2,3,4 --dtype uint16 --endian big --offset 10 --spacing 1,1,2.5";
    let facts = bench.json(&format!("info {raw} --json"));
    assert_eq!(facts["dims"], serde_json::json!([2, 3, 4]));
    assert_eq!(facts["spacing"], serde_json::json!([1.0, 1.0, 2.5]));
    assert_has(
        &facts["file"],
        "format unit file_axes whole_dims channels num_times levels series bytes_while_reading",
    );
    let text = bench.ok(&format!("info {raw}"));
    assert!(text.contains("2 × 3 × 4") && text.contains("format       raw"), "{text}");
    let part = bench.json(&format!("info {raw} --region 1:,:2,1:3 --json"));
    assert_eq!((&part["dims"], &part["file"]["whole_dims"]), (&[1, 2, 2].into(), &[2, 3, 4].into()));
}

#[test]
fn background_and_shading_can_be_chosen() {
    let bench = Bench::new();
    bench.ok(&format!("render builtin:cloud@16 -o a.png {RENDER}"));
    bench.ok(&format!("render builtin:cloud@16 --background #204060 -o b.png {RENDER}"));
    bench.ok(&format!("render builtin:cloud@16 --shading off -o c.png {RENDER}"));
    bench.ok(&format!("render builtin:cloud@16 --tf ct -o d.png {RENDER}"));
    for other in ["b.png", "c.png", "d.png"] {
        let error = bench.json(&format!("compare a.png {other} --json"));
        assert!(error["max_abs_255"].as_u64() > Some(2), "{other}: {error}");
    }
}

#[test]
fn speed_has_a_row_for_each_choice() {
    let bench = Bench::new();
    let report = bench.json(
        "bench speed builtin:cloud@16 builtin:shells@16 --size 32x32 --frame-size 32x32,48x48 --repeats 1 --backend cpu \
         --k 2,4 --angles 5,30 --json",
    );
    assert_eq!(keys(&report), ["conditions", "preparations", "rows"]);
    let rows = report["rows"].as_array().unwrap();
    // Two scenes, sizes, list lengths and turns.
    assert_eq!(rows.len(), 2 * 2 * 2 * 2);
    for row in rows {
        assert_has(
            row,
            "scene dims backend k frame_size angle_deg render_ms render_through_ms generate_ms encode_ms \
             decode_ms prepare_ms novel_view_ms novel_view_no_grid_ms grid_gain fps render_fps view_over_render generate_over_through empty_share ssim \
             dssim dssim_object psnr_db bytes segments_mean segments_total",
        );
        for ratio in ["view_over_render", "generate_over_through", "fps", "ssim"] {
            assert!(row[ratio].as_f64().is_some_and(|r| r > 0.0), "{ratio}: {row}");
        }
        assert!(
            row["render_gpu_ms"].is_null() && row["novel_view_gpu_ms"].is_null(),
            "the CPU has no such clock"
        );
    }
}

/// A volume whose header is as it should be and whose values are not all there.
#[test]
fn a_scene_that_fails_leaves_the_rows_of_others() {
    let bench = Bench::new();
    let header = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 8 8 8\nencoding: gzip\n\n";
    std::fs::write(bench.path("torn.nrrd"), [header.as_bytes(), b"\x1f\x8b no more"].concat()).unwrap();
    for table in ["speed --repeats 1 --k 2", "latency --rtt 20ms --speed 90 --compared 2"] {
        let common = "--size 24x24 --backend cpu --json -o table.json";
        let output = bench.run(&format!("bench {table} torn.nrrd builtin:cloud@16 {common}"));
        assert_eq!(output.status.code(), Some(1), "{table}");
        let told = String::from_utf8(output.stderr).unwrap();
        assert_eq!(told.lines().last().unwrap().matches("torn.nrrd").count(), 1, "{told}");
        let report: Value = serde_json::from_slice(&output.stdout).unwrap();
        let rows = report["rows"].as_array().unwrap();
        assert!(!rows.is_empty() && rows.iter().all(|r| r["scene"] == "builtin:cloud@16"), "{report}");
        assert!(report["conditions"]["failed"][0].as_str().unwrap().contains("torn.nrrd"), "{report}");
        let written = std::fs::read(bench.path("table.json")).unwrap();
        assert_eq!(serde_json::from_slice::<Value>(&written).unwrap(), report);
        // Alone it leaves nothing.
        std::fs::remove_file(bench.path("table.json")).unwrap();
        let alone = bench.run(&format!("bench {table} torn.nrrd {common}"));
        assert!(alone.status.code() == Some(1) && alone.stdout.is_empty(), "{table}");
        assert!(!bench.path("table.json").exists(), "{table}");
    }
}

/// With prediction and without, at every speed and delay.
#[test]
fn latency_has_a_row_for_each_choice() {
    let bench = Bench::new();
    let report = bench.json(
        "bench latency builtin:cloud@16 --size 32x32 --backend cpu --rtt 20ms --speed 90 --compared 4 --json \
         --prediction on,off",
    );
    let rows = report["rows"].as_array().unwrap();
    let of = |row: &Value| (row["predict"].as_bool().unwrap(), row["degrees_per_second"].as_f64());
    assert_eq!(rows.iter().map(of).collect::<Vec<_>>(), [(true, Some(90.0)), (false, Some(90.0))]);
    assert!(rows.iter().all(|row| row["method"] == "layers"));
    assert_has(&rows[0], "scene k rtt_ms dssim_shown_mean dssim_last_image_mean frames_shown");
}

/// Ctrl-C ends a table at once, with nothing on standard output and no file.
#[cfg(unix)]
#[test]
fn an_interrupted_table_leaves_nothing() {
    let bench = Bench::new();
    for table in ["speed --repeats 1000", "latency --rtt 20ms"] {
        let line =
            format!("bench {table} builtin:shells@64 --size 256x256 --backend cpu --json -o table.json");
        let mut command = bench.command(&line);
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut told = BufReader::new(child.stderr.take().unwrap());
        let mut first = String::new();
        told.read_line(&mut first).unwrap();
        assert!(first.contains("builtin:shells@64"), "{first}");
        let kill = std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status();
        assert!(kill.unwrap().success());
        let output = child.wait_with_output().unwrap();
        assert_eq!(output.status.code(), None, "{table}: ended by the signal");
        assert!(output.stdout.is_empty() && bench.files().is_empty(), "{table}");
    }
}

#[test]
fn doctor_looks_at_everything() {
    let report = Bench::new().json("doctor --json");
    let names: Vec<_> =
        report["checks"].as_array().unwrap().iter().map(|c| c["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["processors", "GPU", "Vulkan loader", "display", "UDP loopback"]);
}

/// The whole path: server, link, viewer, comparison. What was shown beats the last image, which a demonstration
/// without movement could not; nor one with prediction, whose frames are made for nearly the camera that shows them.
#[test]
fn the_headless_demo_reports_what_was_shown() {
    let bench = Bench::new();
    let line = "demo builtin:cloud@32 --headless --out out --backend cpu --size 64x64 --rtt 60ms --jitter 2ms --predict off --json";
    let report = bench.json(line);
    let promised = [
        "backend",
        "bandwidth_mbit",
        "bytes_per_frame_mean",
        "codec",
        "degrees_per_second",
        "dssim_last_image_mean",
        "dssim_shown_mean",
        "dssim_shown_p95",
        "exact_after_ms",
        "frame_age_ms_mean",
        "frame_age_ms_p50",
        "frame_age_ms_p99",
        "frame_turned_deg_mean",
        "frames_per_second",
        "frames_shown",
        "freezes",
        "guard_band",
        "jitter_ms",
        "k",
        "kept_frames",
        "longest_gap_ms",
        "loss",
        "method",
        "novel_view_ms",
        "part",
        "plays_path",
        "pose_lag_frames_max",
        "predict",
        "quality",
        "rest_max_abs_255",
        "rtt_ms",
        "seed",
        "size",
        "source",
    ];
    assert_eq!(keys(&report), promised);
    assert_eq!(
        (report["source"].as_str(), report["codec"].as_str()),
        (Some("builtin:cloud@32"), Some("auto"))
    );
    assert_eq!((report["rtt_ms"].as_f64(), report["jitter_ms"].as_f64()), (Some(60.0), Some(2.0)));
    assert!(report["pose_lag_frames_max"].as_u64() <= Some(1), "{report}");
    assert!(report["rest_max_abs_255"].as_u64() <= Some(1), "{report}");
    assert!(report["dssim_shown_mean"].as_f64() < report["dssim_last_image_mean"].as_f64(), "{report}");
    // No frame can be younger than the way there and back.
    assert!(report["frame_age_ms_mean"].as_f64() >= Some(60.0), "{report}");
    let files = files_in(&bench.path("out"));
    assert!(files.contains(&"report.json".into()) && files.contains(&"dssim.svg".into()), "{files:?}");
    assert!(files.iter().filter(|f| f.ends_with(".png")).count() >= 4, "{files:?}");
    assert!(files.iter().all(|f| !f.starts_with('.')), "{files:?}");
    let written = std::fs::read(bench.path("out/report.json")).unwrap();
    assert_eq!(serde_json::from_slice::<Value>(&written).unwrap(), report);
}

/// Who sees nothing is told why.
#[test]
fn what_is_odd_is_said_beside_the_result() {
    let bench = Bench::new();
    let told = |line: &str| {
        let output = bench.run(&format!("render {line} -o a.png {RENDER}"));
        assert!(output.status.success() && bench.path("a.png").exists(), "{line}");
        String::from_utf8(output.stderr).unwrap()
    };
    assert!(
        told("builtin:cubus@16 --iso 300").contains("no surface is there: the values lie between 0 and 255")
    );
    assert_eq!(told("builtin:cubus@16 --iso 300,200"), "");
    bench.write(
        "a.raw",
        7.5f32.to_le_bytes().repeat(63).into_iter().chain((-9999f32).to_le_bytes()).collect::<Vec<_>>(),
    );
    let header = "NRRD0004\ntype: float\ndimension: 3\nsizes: 4 4 4\nspacings: 1 1 1\nencoding: raw\nendian: little\ndata file: a.raw\n";
    bench.write("a.nhdr", header);
    assert_eq!(told("a.nhdr"), "", "one value beside a mark says nothing of how far that is");
    bench.write(
        "b.raw",
        (0..64u8).flat_map(|i| if i < 9 { -9999f32 } else { f32::from(i) }.to_le_bytes()).collect::<Vec<_>>(),
    );
    bench.write("b.nhdr", header.replace("a.raw", "b.raw"));
    assert!(told("b.nhdr").contains("note: 9 voxels are -9999.0"), "{}", told("b.nhdr"));
}

#[test]
fn an_index_is_kept_in_the_users_cache_and_info_tells_of_pages() {
    let bench = Bench::new();
    bench.write("a.raw", (0..100 * 70 * 66).map(|i| (i % 251) as u8).collect::<Vec<_>>());
    let volume = "a.raw --dims 100,70,66 --dtype uint8";
    let text = bench.ok(&format!("info {volume}"));
    assert!(text.contains("  by pages     8 of 64 × 64 × 64 in the finest of 1 level\n"), "{text}");
    assert!(!bench.ok("info builtin:cloud@8").contains("by pages"), "control");
    let text = bench.ok(&format!("index {volume}"));
    assert!(text.starts_with("8 pages in ") && text.contains("channel 0    0 to 250"), "{text}");
    assert_eq!(files_in(&bench.path("cache/isinglass/pages")).len(), 1);
    bench.fails("index builtin:cloud", 1, &["a built-in volume", "a file to read by pages"]);
}
