//! Do the tables and pictures of the laboratory have what they promise?

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::process::Command;

use serde_json::Value;

/// Runs the program in a folder; its standard output.
fn ok(folder: &std::path::Path, line: &str) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_isinglass-lab"));
    command.args(line.split_whitespace()).current_dir(folder).env_remove("ISINGLASS_DATA");
    let output = command.output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{line}: {error}");
    String::from_utf8(output.stdout).unwrap()
}

fn json(line: &str) -> Value {
    serde_json::from_str(&ok(tempfile::tempdir().unwrap().path(), line)).unwrap()
}

fn assert_has(row: &Value, fields: &str) {
    for field in fields.split_whitespace() {
        assert!(row.get(field).is_some(), "{field} is missing in {row}");
    }
}

#[test]
fn quality_tells_rules_and_turns_apart() {
    let report = json(
        "quality builtin:cubus@48 --size 64x64 --backend cpu --k 8 --angles 0,10 --json \
         --layering visibility-merge,equal-transmittance --method layers,point-warp",
    );
    assert_has(&report["conditions"], "version size fov_deg orbit_deg backend shading");
    let rows = report["rows"].as_array().unwrap();
    // Two rules by two methods at two turns, and the last image at one.
    assert_eq!(rows.len(), 9);
    let dssim = |method: &str, angle: f64| {
        let row = rows.iter().find(|r| r["method"] == method && r["angle_deg"] == angle).unwrap();
        assert_has(
            row,
            "scene method k angle_deg dssim dssim_object psnr_db generate_ms novel_view_ms bytes segments_mean",
        );
        row["dssim"].as_f64().unwrap()
    };
    assert!(dssim("visibility-merge", 0.0) <= 1e-3 && dssim("equal-transmittance", 0.0) <= 1e-3);
    assert!(dssim("visibility-merge", 10.0) > dssim("visibility-merge", 0.0));
    assert!(dssim("visibility-merge", 10.0) < dssim("last-image", 10.0));
    assert!(dssim("point-warp", 0.0) <= 1e-3);
    assert!(dssim("visibility-merge", 10.0) < dssim("point-warp", 10.0));
}

/// Each list in the order of its names; rules of one list length once; all samples without a codec.
#[test]
fn quality_has_a_row_for_each_choice() {
    let report = json(
        "quality builtin:cubus@24 --size 32x32 --frame-size 48x48 --backend cpu --k 2,4 --angles 10 --json --wire off \
         --layering visibility-merge,all-samples --method layers,point-warp@single-depth --reconstruction mixed,nearest",
    );
    let rows = report["rows"].as_array().unwrap();
    let text = |row: &Value, field: &str| row[field].as_str().unwrap_or("-").to_owned();
    let of = |row: &Value| {
        (text(row, "method"), text(row, "layering"), text(row, "reconstruction"), row["k"].as_u64().unwrap())
    };
    let expected = [
        ("last-image", "-", "-", 0),
        ("visibility-merge", "visibility-merge", "mixed", 2),
        ("visibility-merge", "visibility-merge", "nearest", 2),
        ("visibility-merge", "visibility-merge", "mixed", 4),
        ("visibility-merge", "visibility-merge", "nearest", 4),
        ("all-samples", "all-samples", "mixed", 255),
        ("all-samples", "all-samples", "nearest", 255),
        ("point-warp", "single-depth", "-", 1),
    ];
    let expected = expected.map(|(m, l, r, k)| (m.to_owned(), l.to_owned(), r.to_owned(), k));
    assert_eq!(rows.iter().map(of).collect::<Vec<_>>(), expected);
    assert_eq!(report["conditions"]["frame_size"], serde_json::json!([48, 48]));
    let segments = |i: usize| rows[i]["segments_total"].as_u64().unwrap();
    assert!(segments(1) < segments(3) && segments(3) < segments(5));
    assert_ne!(rows[1]["dssim"], rows[2]["dssim"], "lists are read in two ways");
    for row in &rows[1..] {
        assert!(row["dssim_wire"].is_null() && row["ssim"].as_f64().unwrap() > 0.0);
        assert_eq!(row["bytes"].is_null(), row["method"] == "all-samples");
    }
}

/// A row for each setting and turn, with the fields of the other tables.
#[test]
fn codec_has_a_row_for_each_setting_and_turn() {
    let report = json(
        "codec builtin:shells@24 --size 48x48 --backend cpu --k 4 --angles 0,10 --codec exact,raw-zstd --json",
    );
    let rows = report["rows"].as_array().unwrap();
    for row in rows {
        assert_has(
            row,
            "scene method k angle_deg dssim dssim_object psnr_db generate_ms novel_view_ms bytes segments_mean lists \
             settings encode_ms is_on_front",
        );
    }
    let of = |method: &str, angle: f64| {
        let of = rows.iter().filter(|r| r["method"] == method && r["angle_deg"] == angle);
        of.collect::<Vec<_>>()
    };
    assert_eq!([of("exact", 0.0).len(), of("exact", 10.0).len()], [1, 1]);
    let (still, turned) = (of("raw-zstd", 0.0)[0], of("raw-zstd", 10.0)[0]);
    assert_eq!(still["bytes"], turned["bytes"]);
    assert!(still["dssim"].as_f64() < turned["dssim"].as_f64());
}

/// Every method at every speed and delay, as it is named.
#[test]
fn latency_has_a_row_for_each_choice() {
    let report = json(
        "latency builtin:cloud@16 --size 32x32 --backend cpu --rtt 20 --speed 90 --compared 4 --json \
         --method layers,point-warp@single-depth:no-prediction",
    );
    let rows = report["rows"].as_array().unwrap();
    let of = |row: &Value| (row["method"].as_str().unwrap().to_owned(), row["predict"].as_bool().unwrap());
    let expected = [("layers".to_owned(), true), ("point-warp@single-depth".to_owned(), false)];
    assert_eq!(rows.iter().map(of).collect::<Vec<_>>(), expected);
    assert!(rows[0]["dssim_shown_mean"].as_f64() < rows[1]["dssim_shown_mean"].as_f64(), "{report}");
}

/// The file of each choice differs from that of every other.
#[test]
fn pictures_are_by_the_method_and_rule_that_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let choices = ["layers", "layers@homogeneity", "layers@all-samples", "slabs-mesh@slabs", "last-image"];
    let pictures: Vec<Vec<u8>> = choices
        .iter()
        .map(|method| {
            ok(
                folder.path(),
                &format!("picture builtin:shells@32 --size 64x64 --k 4 --angle 20 --method {method}"),
            );
            std::fs::read(folder.path().join("picture.png")).unwrap()
        })
        .collect();
    for (i, picture) in pictures.iter().enumerate() {
        assert!(pictures[..i].iter().all(|other| other != picture), "{}", choices[i]);
    }
}
