//! Does a script learn that its server is gone, on this machine and behind ssh? Here ssh is a shell script that runs what
//! it is given.

#![cfg(unix)]
#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[expect(dead_code, reason = "each test file uses its own part of the module")]
mod common;

use std::io::{BufRead, BufReader};
use std::os::unix::fs::PermissionsExt;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use common::{Bench, Running};
use isinglass_core::wire::PROTOCOL_VERSION;

/// A camera that turns for longer than any test lasts, and one that is soon done.
const LONG: &str = "0 10 20\n120 400 20\n";
const SHORT: &str = "0 10 20\n0.5 40 20\n";

/// A server with the flags `more`, and its link.
fn serve(bench: &Bench, more: &str) -> (Running, String) {
    let line = format!("serve builtin:shells@24 --backend cpu --identity id.pem {more}");
    let child = bench.command(&line).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    let mut server = Running(child);
    let mut link = String::new();
    BufReader::new(server.0.stdout.take().unwrap()).read_line(&mut link).unwrap();
    (server, link.trim().to_owned())
}

/// The last line of what failed with code 1.
fn own_line(output: &Output) -> String {
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{error}");
    let line = error.lines().last().unwrap();
    assert!(line.starts_with("isinglass: ") && output.stdout.is_empty(), "{error}");
    line.to_owned()
}

fn view(what: &str) -> String {
    format!("view {what} --headless --path a.path --out out --size 48x48 --refresh 20 --backend cpu")
}

#[test]
fn a_server_that_dies_or_starts_again_is_told() {
    for (signal, restarts) in [("-KILL", false), ("-TERM", false), ("-KILL", true)] {
        let bench = Bench::new();
        bench.write("a.path", LONG);
        let (mut server, link) = serve(&bench, "--listen 127.0.0.1:0");
        let mut command = bench.command(&view(&link));
        let viewer = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let patience = Instant::now() + Duration::from_secs(60);
        while !bench.path("out/first.png").exists() {
            assert!(Instant::now() < patience, "no picture");
            std::thread::sleep(Duration::from_millis(20));
        }
        let id = server.0.id().to_string();
        assert!(Command::new("kill").args([signal, &id]).status().unwrap().success());
        server.0.wait().unwrap();
        let place = link.split("//").nth(1).unwrap().split('/').next().unwrap();
        let _again = restarts.then(|| serve(&bench, &format!("--listen {place}")));
        let line = own_line(&viewer.wait_with_output().unwrap());
        assert!(line.contains("the server is lost: "), "{signal}: {line}");
        assert!(!line.contains("too slow"), "{line}");
        assert_eq!(line.contains("token"), restarts, "{line}");
    }
    // The control: with its server there, the same command ends well.
    let bench = Bench::new();
    bench.write("a.path", SHORT);
    let (_server, link) = serve(&bench, "--listen 127.0.0.1:0");
    bench.ok(&view(&link));
}

/// A program in place of ssh. It knows no `-G`, and does `work` with the line for the other machine in `$l`.
fn fake_ssh(bench: &Bench, work: &str) {
    let script = format!("#!/bin/sh\ncase \" $* \" in *' -G '*) exit 1;; esac\nfor l; do :; done\n{work}\n");
    let path = bench.write("ssh.sh", script);
    std::fs::set_permissions(path, PermissionsExt::from_mode(0o755)).unwrap();
}

#[test]
fn a_machine_without_a_link_is_not_told_to_update() {
    let bench = Bench::new();
    bench.write("a.path", SHORT);
    let greeting = |version: u32| {
        format!(
            "cat >/dev/null; echo isinglass-begun; echo 'isinglass-there|Linux x|::1|isinglass 1 (protocol {version})'"
        )
    };
    let line = view("there:/a.nrrd --ssh ./ssh.sh");
    fake_ssh(&bench, &greeting(PROTOCOL_VERSION));
    let told = own_line(&bench.run(&line));
    assert!(told.contains("there") && told.contains("before it printed its link"), "{told}");
    assert!(!told.contains("update"), "{told}");
    // The control: another version.
    fake_ssh(&bench, &greeting(PROTOCOL_VERSION + 1));
    assert!(own_line(&bench.run(&line)).contains("update this viewer"));
}

#[test]
fn a_session_through_ssh_ends_without_an_error() {
    let bench = Bench::new();
    bench.write("a.path", SHORT);
    let folder = bench.path("there/.local/bin");
    std::fs::create_dir_all(&folder).unwrap();
    std::os::unix::fs::symlink(env!("CARGO_BIN_EXE_isinglass"), folder.join("isinglass")).unwrap();
    let home = bench.path("there");
    fake_ssh(&bench, &format!("HOME={} exec /bin/sh -c \"$l\"", home.display()));
    // No name server knows the machine, so every packet goes through the tunnel.
    let output = bench.run(&view("there.invalid:builtin:shells@24 --ssh ./ssh.sh"));
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{told}");
    assert!(!told.contains("ERROR") && !told.contains("I/O error"), "{told}");
    // The control: the log is asked for all, and has the line of the library.
    let mut command = bench.command(&view("there.invalid:builtin:shells@24 --ssh ./ssh.sh"));
    let output = command.env("RUST_LOG", "error").output().unwrap();
    assert!(output.status.success() && String::from_utf8_lossy(&output.stderr).contains("I/O error"));
}
