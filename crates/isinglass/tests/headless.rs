//! Does a viewer without a window measure a server that it knows by a link only, alone and with others?

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[expect(dead_code, reason = "each test file uses its own part of the module")]
mod common;

use std::io::{BufRead, BufReader, Write};
use std::process::Stdio;

use serde_json::Value;

use common::{Bench, Running, assert_has, files_in};

/// Still, a turn of half a second, and still again.
const PATH: &str = "0 10 20\n0.2 10 20\n0.7 40 20\n1 40 20\n";

/// A server of a small volume, and a link for each viewer.
fn serve(bench: &Bench, num_viewers: usize) -> (Running, Vec<String>) {
    let line =
        format!("serve builtin:shells@24 --listen 127.0.0.1:0 --viewers {num_viewers} --backend cpu --json");
    let child = bench.command(&line).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    let mut server = Running(child);
    let mut told = String::new();
    BufReader::new(server.0.stdout.take().unwrap()).read_line(&mut told).unwrap();
    let told: Value = serde_json::from_str(&told).unwrap();
    (server, told["links"].as_array().unwrap().iter().map(|l| l.as_str().unwrap().to_owned()).collect())
}

#[test]
fn a_viewer_without_a_window_measures_what_it_would_show() {
    let bench = Bench::new();
    bench.write("a.path", PATH);
    let (_server, links) = serve(&bench, 1);
    // A path that is not there does not use the link up.
    bench.fails(&format!("view {} --headless --path none.path", links[0]), 1, &["none.path"]);
    let line = format!(
        "view {} --headless --path a.path --out out --every 15 --size 96x64 --refresh 30 --backend cpu --json",
        links[0]
    );
    let report = bench.json(&line);
    let visit = &report["viewers"][0];
    assert_has(
        visit,
        "carrier frame_age_ms_p50 frame_age_ms_p99 frames_per_second longest_gap_ms exact_after_ms frame_bytes \
         rtt_ms_p50 refreshes_per_second paint_ms_p50 first_frame_ms first_whole_ms disconnected_ms",
    );
    assert_eq!((visit["plays_path"].as_bool(), visit["size"][0].as_u64()), (Some(true), Some(96)));
    assert!(visit["exact_after_ms"][0].is_f64(), "{visit}");
    assert!(visit["frame_bytes"].as_u64() > Some(0) && visit["frames_per_second"].as_f64() > Some(0.0));
    assert!(visit["frame_age_ms_p50"].as_f64() <= visit["frame_age_ms_p99"].as_f64(), "{visit}");
    let files = files_in(&bench.path("out"));
    for file in ["first.png", "refreshes.csv", "rest-1.png", "summary.json"] {
        assert!(files.contains(&file.into()), "{file}: {files:?}");
    }
    assert!(files.iter().filter(|f| f.starts_with('t') && f.ends_with("s.png")).count() >= 2, "{files:?}");
    let table = std::fs::read_to_string(bench.path("out/refreshes.csv")).unwrap();
    let mut lines = table.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let names = lines.next().unwrap();
    let column = |name: &str| names.iter().position(|n| *n == name).unwrap();
    let rows: Vec<_> = lines.collect();
    assert!(rows.iter().all(|row| row.len() == names.len()), "{table}");
    assert_eq!(rows.len() as u64, visit["refreshes"].as_u64().unwrap());
    assert!(rows.iter().any(|row| row[column("standing")] == "moving"), "{table}");
    assert_eq!(rows.last().unwrap()[column("standing")], "exact");
    // The picture at rest is that of the renderer, which the first one, from elsewhere, is not.
    let render = "render builtin:shells@24 --size 96x64 --backend cpu";
    bench.ok(&format!("{render} --orbit 40,20 -o truth.png"));
    let error = |picture: &str| bench.json(&format!("compare out/{picture} truth.png --json"));
    assert!(error("rest-1.png")["max_abs_255"].as_u64() <= Some(1), "{}", error("rest-1.png"));
    assert!(error("first.png")["max_abs_255"].as_u64() > Some(20));
}

#[test]
fn several_viewers_load_a_server() {
    let bench = Bench::new();
    bench.write("a.path", PATH);
    let (_server, links) = serve(&bench, 3);
    let line =
        "view - --headless --copies 3 --path a.path --out out --size 48x48 --refresh 20 --backend cpu --json";
    let mut command = bench.command(line);
    let mut viewers =
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    // The input stays open, as that of a server does.
    let mut input = viewers.stdin.take().unwrap();
    input.write_all((links.join("\n") + "\n").as_bytes()).unwrap();
    let output = viewers.wait_with_output().unwrap();
    drop(input);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    let visits = report["viewers"].as_array().unwrap();
    assert_eq!(visits.len(), 3);
    assert!(visits.iter().all(|v| v["frames_per_second"].as_f64() > Some(0.0)), "{report}");
    let casts: Vec<bool> = visits.iter().map(|v| v["backend"].is_string()).collect();
    assert_eq!(casts, [true, false, false]);
    assert!(bench.path("out/viewer-3/refreshes.csv").exists() && bench.path("out/summary.json").exists());
}

#[test]
fn what_a_viewer_without_a_window_cannot_do_is_said() {
    let bench = Bench::new();
    let link = format!("isinglass://127.0.0.1:9/#token={}&cert=sha256:{}", "0".repeat(32), "0".repeat(64));
    bench.write("a.path", PATH);
    bench.fails("view --headless", 1, &["link", "demo --headless"]);
    bench.fails("view builtin:shells@8 --headless", 1, &["link", "demo --headless"]);
    bench.fails(&format!("view {link} --headless --copies 2"), 2, &["one viewer", "standard input"]);
    bench.fails(&format!("view {link} --path a.path"), 2, &["--path", "--headless"]);
    bench.fails(&format!("view {link} --out out"), 2, &["--headless"]);
    bench.fails("demo builtin:shells@8 --link fibre", 2, &["fibre", "satellite"]);
}
