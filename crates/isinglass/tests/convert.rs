//! Does `convert` keep to its memory, survive being killed, and leave a whole pyramid or none?

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[expect(dead_code, reason = "each test file uses its own part of the module")]
mod common;

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::Duration;

use serde_json::Value;

use common::{Bench, Running, assert_has};

/// A file of bytes that look random.
fn noise(num: usize) -> Vec<u8> {
    let mut random = 1u32;
    let next = |_| {
        random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (random >> 24) as u8 / 16
    };
    (0..num).map(next).collect()
}

/// All files below a folder, by their paths.
fn tree(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = BTreeMap::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if path.is_dir() {
            found.extend(tree(&path).into_iter().map(|(below, bytes)| (format!("{name}/{below}"), bytes)));
        } else {
            found.insert(name, fs::read(&path).unwrap());
        }
    }
    found
}

fn start(bench: &Bench, line: &str) -> Running {
    Running(bench.command(line).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap())
}

/// Waits until a run has done so many steps, or ends.
fn wait_for_steps(bench: &Bench, name: &str, child: &mut Child, num: u64) {
    let journal = bench.path(&format!(".isinglass-{name}.part/journal.json"));
    let done = || {
        let value: Value = serde_json::from_slice(&fs::read(&journal).ok()?).ok()?;
        value["num_done"].as_u64()
    };
    while child.try_wait().unwrap().is_none() && done().is_none_or(|done| done < num) {
        sleep(Duration::from_millis(2));
    }
}

#[test]
fn a_killed_run_is_taken_up_and_makes_the_same_bytes() {
    let bench = Bench::new();
    bench.write("a.raw", noise(200 * 190 * 700));
    let flags = "--dims 200,190,700 --dtype uint8 --max-memory 100M";
    bench.ok(&format!("convert a.raw whole.ome.zarr {flags}"));
    let line = format!("convert a.raw a.ome.zarr {flags}");
    let mut num_killed = 0;
    for num_steps in [1, 5, 10, 13] {
        let mut run = start(&bench, &line);
        wait_for_steps(&bench, "a.ome.zarr", &mut run.0, num_steps);
        // SIGKILL on Unix.
        run.0.kill().unwrap();
        num_killed += u32::from(!run.0.wait().unwrap().success());
        assert!(!bench.path("a.ome.zarr").exists() || num_steps == 13);
    }
    assert!(num_killed >= 3, "{num_killed}");
    if !bench.path("a.ome.zarr").exists() {
        let output = bench.run(&line);
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success() && told.contains("this one goes on"), "{told}");
    }
    let (whole, found) = (tree(&bench.path("whole.ome.zarr")), tree(&bench.path("a.ome.zarr")));
    assert!(whole == found && whole.len() > 40, "{}", whole.len());
    // The control: another volume is another pyramid.
    bench.write("b.raw", noise(200 * 190 * 701).split_off(200 * 190));
    bench.ok(&format!("convert b.raw b.ome.zarr {flags}"));
    assert!(tree(&bench.path("b.ome.zarr")) != whole);
    // Indices are in the cache.
    let names = ["a.ome.zarr", "a.raw", "b.ome.zarr", "b.raw", "cache", "whole.ome.zarr"];
    assert_eq!(bench.files(), names);
}

#[cfg(unix)]
#[test]
fn an_interrupt_ends_in_one_line_and_keeps_what_is_done() {
    let bench = Bench::new();
    bench.write("a.raw", noise(200 * 190 * 900));
    let line = "convert a.raw a.ome.zarr --dims 200,190,900 --dtype uint8 --max-memory 100M";
    let mut run = start(&bench, line);
    wait_for_steps(&bench, "a.ome.zarr", &mut run.0, 3);
    let interrupt = Command::new("kill").args(["-INT", &run.0.id().to_string()]).status();
    assert!(interrupt.unwrap().success());
    let mut told = String::new();
    std::io::Read::read_to_string(run.0.stderr.as_mut().unwrap(), &mut told).unwrap();
    assert_eq!(run.0.wait().unwrap().code(), Some(1), "{told}");
    let last = told.lines().last().unwrap();
    assert!(last.starts_with("isinglass: stopped at") && last.ends_with("goes on from there"), "{told}");
    assert!(!bench.path("a.ome.zarr").exists());
    assert!(bench.ok(line).starts_with("a.ome.zarr: 4 levels down to 25×24×113, means"));
}

/// Memory of the program itself in a build for tests: its code and its threads.
#[cfg(target_os = "linux")]
const OF_PROGRAM: u64 = 64 << 20;

/// The most memory that the process has had, as Linux tells while it runs.
fn most_memory(child: &mut Child) -> u64 {
    let mut most = 0;
    while child.try_wait().unwrap().is_none() {
        let status = fs::read_to_string(format!("/proc/{}/status", child.id())).unwrap_or_default();
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap_or_default();
        let kib: u64 = line.trim().trim_end_matches(" kB").parse().unwrap_or(0);
        most = most.max(kib * 1024);
        sleep(Duration::from_millis(5));
    }
    most
}

#[cfg(target_os = "linux")]
#[test]
fn a_volume_of_many_times_the_memory_converts_within_it() {
    let bench = Bench::new();
    let source = bench.path("a.raw");
    // A file without content takes no room.
    File::create(&source).unwrap().set_len(1 << 30).unwrap();
    let mut run =
        start(&bench, "convert a.raw a.ome.zarr --dims 1024,1024,1024 --dtype uint8 --max-memory 128M");
    let most = most_memory(&mut run.0);
    assert!(run.0.wait().unwrap().success());
    assert!(most <= 128_000_000 + OF_PROGRAM, "{most}");
    // The same from chunks.
    let part = "convert a.ome.zarr b.ome.zarr --region 0:512,0:512,:";
    let mut run = start(&bench, &format!("{part} --max-memory 32M"));
    let most = most_memory(&mut run.0);
    assert!(run.0.wait().unwrap().success());
    assert!(most <= 32_000_000 + OF_PROGRAM, "{most}");
    // The control: a layer of chunks is in memory where that is allowed.
    let mut run = start(&bench, "convert a.raw c.ome.zarr --dims 2048,2048,64 --dtype uint8 --max-memory 1G");
    let most = most_memory(&mut run.0);
    assert!(most > 200_000_000, "{most}");
}

#[test]
fn what_cannot_be_converted_is_told_in_one_line() {
    let bench = Bench::new();
    bench.write("a.raw", [7; 1000]);
    fs::create_dir(bench.path("taken")).unwrap();
    let flags = "--dims 10,10,10 --dtype uint8";
    bench.fails(&format!("convert a.raw taken {flags}"), 2, &["found a folder"]);
    bench.fails(&format!("convert a.raw a.raw {flags}"), 2, &["would be read and written"]);
    bench.fails(&format!("convert a.raw none/b {flags}"), 2, &["there is no folder none"]);
    bench.fails(&format!("convert a.raw b {flags} --thin 2"), 2, &["--thin"]);
    bench.fails(
        &format!("convert a.raw b {flags} --max-memory 1k"),
        1,
        &["bytes of memory, expected at most 1000"],
    );
    bench.fails("convert none.nrrd b", 1, &["none.nrrd"]);
    bench.fails("convert builtin:cloud@16", 2, &["OUTPUT"]);
    assert!(bench.ok("convert builtin:cloud@16 b").starts_with("b: 1 level down to 16×16×16, means"));
    let json = bench.json("convert b c --json");
    assert_has(&json, "output levels dtype channels times labels most_bytes");
    assert_eq!(json["levels"], serde_json::json!([[16, 16, 16]]));
}
