//! Does the program keep what it unpacks and what it remembers to itself, and leave nothing of it behind?

#![cfg(unix)]
#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[expect(dead_code, reason = "each test file uses its own part of the module")]
mod common;

use std::io::{Read, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use common::{Bench, assert_failed, files_in};

/// A ZIP archive of plain files (APPNOTE 6.3.10). The check sums are 0, which no reader of ours looks at.
fn zip(files: &[(String, &[u8])]) -> Vec<u8> {
    let (mut bytes, mut list) = (Vec::new(), Vec::new());
    for (name, content) in files {
        let size = (content.len() as u32).to_le_bytes();
        let offset = (bytes.len() as u32).to_le_bytes();
        let common = [&[20, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0][..], &size, &size].concat();
        let length = (name.len() as u16).to_le_bytes();
        bytes.extend([b"PK\x03\x04", &common[..], &length, &[0; 2], name.as_bytes(), content].concat());
        list.extend([b"PK\x01\x02\x14\0", &common[..], &length, &[0; 12], &offset, name.as_bytes()].concat());
    }
    let num = (files.len() as u16).to_le_bytes();
    let end = [(list.len() as u32).to_le_bytes(), (bytes.len() as u32).to_le_bytes()].concat();
    [bytes, list, [b"PK\x05\x06\0\0\0\0", &num[..], &num, &end, &[0; 2]].concat()].concat()
}

/// An archive of many slices, too large to be read in a moment, and a pipe that keeps a file of it busy.
fn archive(bench: &Bench, num: usize) {
    let header = "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 64 64 16\nencoding: raw\n\n";
    let volume = [header.as_bytes(), &vec![7; 1 << 16]].concat();
    let files: Vec<_> = (0..num).map(|i| (format!("{i}.nrrd"), &volume[..])).collect();
    bench.write("many.zip", zip(&files));
}

fn scratch_of(folder: &Path) -> Vec<String> {
    files_in(folder).into_iter().filter(|name| name.starts_with(".isinglass-")).collect()
}

/// Starts a server of `source` whose scratch is in `tmp`.
fn serve(bench: &Bench, source: &str) -> Child {
    std::fs::create_dir_all(bench.path("tmp")).unwrap();
    let mut command = bench.command(&format!("serve {source} --listen 127.0.0.1:0 --backend cpu"));
    command.env("TMPDIR", bench.path("tmp")).stdout(Stdio::piped()).stderr(Stdio::piped());
    command.spawn().unwrap()
}

/// The same, and waits until the scratch folder is there.
fn start(bench: &Bench, source: &str) -> Child {
    let mut child = serve(bench, source);
    let patience = Instant::now() + Duration::from_secs(60);
    let is_there = || {
        scratch_of(&bench.path("tmp")).iter().any(|name| bench.path("tmp").join(name).join("lock").exists())
    };
    while !is_there() && child.try_wait().unwrap().is_none() {
        assert!(Instant::now() < patience, "no scratch folder");
        std::thread::sleep(Duration::from_millis(1));
    }
    child
}

fn kill(child: &Child, signal: &str) {
    assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap().success());
}

#[test]
fn nothing_that_was_unpacked_stays_after_a_signal() {
    let bench = Bench::new();
    archive(&bench, 3000);
    for (signal, number) in [("-TERM", 15), ("-INT", 2), ("-HUP", 1)] {
        let mut child = start(&bench, "many.zip");
        let folder = bench.path("tmp").join(&scratch_of(&bench.path("tmp"))[0]);
        assert_eq!(std::fs::metadata(&folder).unwrap().permissions().mode() & 0o777, 0o700);
        kill(&child, signal);
        assert_eq!(child.wait().unwrap().code(), Some(128 + number), "{signal}");
        assert_eq!(scratch_of(&bench.path("tmp")), [""; 0], "{signal}");
    }
    // The control: no program hears this signal. What stays is the owner's alone, and goes with the next one.
    let mut child = start(&bench, "many.zip");
    kill(&child, "-KILL");
    child.wait().unwrap();
    assert_eq!(scratch_of(&bench.path("tmp")).len(), 1);
    std::thread::sleep(Duration::from_secs(4));
    let output = bench.command("info many.zip").env("TMPDIR", bench.path("tmp")).output().unwrap();
    assert_failed("info", &output, 1, &["many.zip"]);
    assert_eq!(scratch_of(&bench.path("tmp")), [""; 0]);
}

#[cfg(target_os = "linux")]
#[test]
fn one_packed_volume_has_no_name_on_the_disk() {
    let bench = Bench::new();
    let header = "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 64 64 16\nencoding: raw\n\n";
    let volume = [header.as_bytes(), &vec![7; 1 << 16]].concat();
    bench.write("one.zip", zip(&[("a.nrrd".into(), &volume)]));
    std::fs::set_permissions(bench.path("one.zip"), PermissionsExt::from_mode(0o600)).unwrap();
    let facts = bench.json("info one.zip --json");
    assert_eq!(facts["dims"], serde_json::json!([64, 64, 16]), "{facts}");
    let mut child = serve(&bench, "one.zip");
    // Whatever is there at any moment takes no room: a link, and a lock.
    let mut largest = 0;
    let mut look = |folder: &Path| {
        let mut folders = vec![folder.to_owned()];
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
                let Ok(found) = entry.path().symlink_metadata() else { continue };
                if found.is_dir() {
                    folders.push(entry.path());
                } else {
                    largest = largest.max(found.len());
                }
            }
        }
    };
    let mut out = child.stdout.take().unwrap();
    let reading = std::thread::spawn(move || out.read(&mut [0; 1]).unwrap());
    while !reading.is_finished() {
        look(&bench.path("tmp"));
    }
    assert!(largest < 100, "{largest} bytes");
    kill(&child, "-TERM");
    assert!(child.wait().unwrap().success());
    assert_eq!(scratch_of(&bench.path("tmp")), [""; 0]);
}

/// The limit on the size of files stands for a full disk: a write to any file fails.
#[test]
fn a_full_disk_leaves_no_empty_identity() {
    let bench = Bench::new();
    let serve = "serve builtin:shells@16 --listen 127.0.0.1:0 --backend cpu --identity id.pem";
    let full = format!("trap '' XFSZ; ulimit -f 0; exec {} {serve}", env!("CARGO_BIN_EXE_isinglass"));
    let mut command = bench.command("");
    let environment: Vec<_> =
        command.get_envs().map(|(k, v)| (k.to_owned(), v.map(ToOwned::to_owned))).collect();
    command = Command::new("bash");
    command.args(["-c", &full]).current_dir(bench.path(""));
    for (key, value) in environment {
        match value {
            Some(value) => command.env(key, value),
            None => command.env_remove(key),
        };
    }
    let output = command.output().unwrap();
    assert_failed("a full disk", &output, 1, &["id.pem", "too large"]);
    assert_eq!(bench.files(), [""; 0]);
    // The next start makes it, for its owner alone.
    let mut child = bench.command(serve).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    child.stdout.take().unwrap().read_exact(&mut [0; 10]).unwrap();
    kill(&child, "-TERM");
    assert!(child.wait().unwrap().success());
    let mode =
        |mode| std::fs::set_permissions(bench.path("id.pem"), PermissionsExt::from_mode(mode)).unwrap();
    assert_eq!(std::fs::metadata(bench.path("id.pem")).unwrap().permissions().mode() & 0o777, 0o600);
    mode(0o644);
    bench.fails(serve, 1, &["id.pem", "0644", "chmod 600"]);
}

/// A command in a shell that limits its address space to so many kB.
fn limited(bench: &Bench, kilobytes: u32, line: &str) -> std::process::Output {
    let program = env!("CARGO_BIN_EXE_isinglass");
    let line = format!("ulimit -v {kilobytes}; exec {program} {line}");
    let mut command = Command::new("bash");
    command.args(["-c", &line]).current_dir(bench.path("")).env("RUST_BACKTRACE", "0").output().unwrap()
}

#[cfg(target_os = "linux")]
#[test]
fn too_little_memory_is_one_line() {
    let bench = Bench::new();
    for line in ["info builtin:shells@16", "serve builtin:shells@16 --listen 127.0.0.1:0 --backend cpu"] {
        assert_failed(line, &limited(&bench, 400_000, line), 1, &["ulimit -v"]);
    }
    // The control.
    assert!(limited(&bench, 4_000_000, "info builtin:shells@16").status.success());
    assert!(limited(&bench, 400_000, "--version").status.success());
}

/// A pipe without a writer in the place of each file that a command reads.
#[test]
fn a_pipe_keeps_no_command_waiting() {
    let bench = Bench::new();
    assert!(Command::new("mkfifo").arg(bench.path("pipe")).status().unwrap().success());
    let link = format!("isinglass://127.0.0.1:9/#token={}&cert=sha256:{}", "0".repeat(32), "0".repeat(64));
    for line in [
        "info pipe".to_owned(),
        "info pipe --dims 2,2,2 --dtype uint8".into(),
        "render pipe -o a.png".into(),
        "render builtin:shells@16 --tf pipe -o a.png".into(),
        "render builtin:shells@16 --state pipe -o a.png".into(),
        "serve pipe --listen 127.0.0.1:0".into(),
        "serve builtin:shells@16 --listen 127.0.0.1:0 --backend cpu --identity pipe".into(),
        "convert pipe a.ome.zarr".into(),
        "compare pipe pipe".into(),
        "reproject pipe -o a.png".into(),
        format!("view {link} --headless --path pipe"),
    ] {
        assert_failed(&line, &bench.run(&line), 1, &["pipe", "regular file"]);
    }
    // The control: standard input, which is a pipe here, still gives a link.
    let mut command = bench.command("view - --headless");
    let mut child = command.stdin(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    child.stdin.take().unwrap().write_all(link.as_bytes()).unwrap();
    let output = child.wait_with_output().unwrap();
    assert!(String::from_utf8_lossy(&output.stderr).contains("127.0.0.1:9"), "{output:?}");
}
