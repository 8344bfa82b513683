//! Is a volume on another machine shown by one command?
//!
//! The other machine is a real sshd on loopback, reached by a real ssh: directly, through a jump host, and where nothing
//! but ssh reaches it. The viewer is the binary's window.
#![cfg(target_os = "linux")]
#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[expect(dead_code, reason = "each test file uses its own part of the module")]
#[path = "../common/mod.rs"]
mod common;
mod sshd;
#[expect(dead_code, reason = "each test file uses its own part of the module")]
#[path = "../common/viewer.rs"]
mod viewer;

use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use common::{Bench, assert_failed};
use isinglass_net::{Client, ClientOptions, Link, State};
use sshd::{Sshd, has_sshd};
use viewer::{Viewer, has_window};

/// Runs `view` with the machine's sshd, which must end before any window.
fn view(bench: &Bench, sshd: &Sshd, place: &str, more: &str) -> Output {
    let mut command = bench.command("view --backend cpu");
    command.arg(place).args(more.split_whitespace()).args(["--ssh", &sshd.ssh()]);
    command.env("DISPLAY", std::env::var_os("DISPLAY").unwrap()).output().unwrap()
}

/// The only line of `view` itself among those of ssh.
fn own_line(output: &Output) -> String {
    let error = String::from_utf8_lossy(&output.stderr);
    let own: Vec<_> = error.lines().filter(|line| line.starts_with("isinglass: ")).collect();
    assert_eq!((output.status.code(), own.len()), (Some(1), 1), "{error}");
    assert!(error.ends_with(&format!("{}\n", own[0])), "it comes last: {error}");
    own[0].to_owned()
}

#[test]
fn one_command_shows_a_volume_of_another_machine() {
    if !has_sshd() || !has_window() {
        return;
    }
    let bench = Bench::new();
    let mut sshd = Sshd::start(&bench, true);
    std::fs::create_dir_all(bench.path("home/isinglass")).unwrap();
    bench.write("home/isinglass/viewer.toml", format!("[remote]\nssh = '{}'\n", sshd.ssh()));
    for (place, way) in [
        ("there:builtin:shells@32", "directly"),
        ("behind:builtin:shells@32", "through ssh alone"),
        ("ssh://jumped/builtin:shells@32", "started through a jump host"),
    ] {
        let begin = Instant::now();
        let mut viewer = Viewer::start(&bench, &format!("view {place} --backend cpu --shading off"));
        viewer.wait("picture", |seen| seen.iter().any(|refresh| refresh.frame.is_some()).then_some(()));
        println!("{place} is shown {way} after {:?}", begin.elapsed());
        if place.starts_with("ssh://") {
            // The server does not need the connection by which it was started.
            sshd.end();
            let num = viewer.refreshes().len();
            viewer.wait("exact picture", |seen| {
                seen[num.min(seen.len())..].iter().any(|r| r.is_exact).then_some(())
            });
            assert!(viewer.refreshes().iter().all(|refresh| !refresh.is_offline));
        }
    }
}

#[test]
fn what_goes_wrong_is_one_line_after_those_of_ssh() {
    if !has_sshd() || !has_window() {
        return;
    }
    let bench = Bench::new();
    let sshd = Sshd::start(&bench, true);
    let secret = sshd.home().join("secret.nrrd");
    std::fs::write(&secret, "NRRD0004\n").unwrap();
    for (place, words) in [
        ("nowhere:/a.nrrd", &["ssh does not reach nowhere", "above"][..]),
        ("closed:/a.nrrd", &["ssh does not reach closed"]),
        ("keyless:/a.nrrd", &["ssh does not reach keyless"]),
        ("stranger:/a.nrrd", &["ssh does not reach stranger"]),
        ("there:/no/a b.nrrd", &["there: /no/a b.nrrd", "No such file"]),
        ("ssh://there/no/a%20b.nrrd", &["there: /no/a b.nrrd", "No such file"]),
        ("there:~/secret.nrrd", &["there: ", "secret.nrrd"]),
        ("there:secret.nrrd", &["there: secret.nrrd"]),
        ("there:-x", &["there: -x", "No such file"]),
    ] {
        let line = own_line(&view(&bench, &sshd, place, ""));
        for word in words {
            assert!(line.contains(word), "{place}: {line}");
        }
    }
    // What ssh says is shown.
    let output = view(&bench, &sshd, "keyless:/a.nrrd", "");
    assert!(String::from_utf8_lossy(&output.stderr).contains("Permission denied"));
    // A flag of the look reaches the server there, and its complaint comes back.
    let line = own_line(&view(&bench, &sshd, "there:builtin:shells@16", "--tf no-such-preset"));
    assert!(line.starts_with("isinglass: there: ") && line.contains("no-such-preset"), "{line}");
    // A file of this machine with that very name is meant.
    bench.write("there:scan.nrrd", "nonsense");
    let mut command = bench.command("view there:scan.nrrd --copy");
    let output = command.env("DISPLAY", std::env::var_os("DISPLAY").unwrap()).output().unwrap();
    assert_failed("a file", &output, 1, &["--copy", "another machine"]);
    // Bad usage.
    for (line, words) in [
        ("view ssh://there", &["ssh://there", "host:/data"][..]),
        ("view ssh://-x/a", &["host"]),
        ("view there:a --ssh ''", &["--ssh", "program"]),
        ("view there:a --remote-program $(x)", &["--remote-program"]),
    ] {
        assert_failed(line, &bench.run(line), 2, words);
    }
    let mut command = bench.command("view there:/a --ssh no-such-program");
    let output = command.env("DISPLAY", std::env::var_os("DISPLAY").unwrap()).output().unwrap();
    assert_failed("no ssh", &output, 1, &["no-such-program", "OpenSSH"]);
}

#[test]
fn a_machine_without_isinglass_gets_a_copy_on_request() {
    if !has_sshd() || !has_window() {
        return;
    }
    let bench = Bench::new();
    let sshd = Sshd::start(&bench, false);
    let line = own_line(&view(&bench, &sshd, "there:/a.nrrd", ""));
    assert!(line.contains("there has no isinglass") && line.contains("--copy"), "{line}");
    let program = sshd.home().join(".local/bin/isinglass");
    // Another version.
    for (said, words) in [
        ("isinglass 0.0.1 (protocol 1)", ["protocol version 1,", "update isinglass there"]),
        ("isinglass 99.0.0 (protocol 9999)", ["protocol version 9999,", "update this viewer"]),
    ] {
        std::fs::write(&program, format!("#!/bin/sh\necho '{said}'\n")).unwrap();
        Command::new("chmod").arg("755").arg(&program).status().unwrap();
        let line = own_line(&view(&bench, &sshd, "there:/a.nrrd", ""));
        assert!(words.iter().all(|word| line.contains(word)), "{line}");
    }
    // The copy takes its place, and runs: only the volume is missing.
    let line = own_line(&view(&bench, &sshd, "there:/a.nrrd", "--copy"));
    assert!(line.contains("there: /a.nrrd"), "{line}");
    let own = std::fs::metadata(env!("CARGO_BIN_EXE_isinglass")).unwrap().len();
    assert_eq!(std::fs::metadata(&program).unwrap().len(), own);
    assert_eq!(std::fs::read_dir(program.parent().unwrap()).unwrap().count(), 1);
}

#[test]
fn a_server_in_the_background_outlives_its_terminal_and_ends_after_its_last_viewer() {
    let bench = Bench::new();
    let serve = "serve builtin:shells@16 --listen 127.0.0.1:0 --backend cpu --detach --end-after-last";
    // It lets go of standard error too, or this would wait for ever.
    let output = bench.command(&format!("{serve} 8s")).stdin(Stdio::null()).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{said}");
    let link: Link = String::from_utf8(output.stdout).unwrap().trim().parse().unwrap();
    let pid = said.split("`kill ").nth(1).unwrap().split('`').next().unwrap().to_owned();
    let is_there = || std::path::Path::new(&format!("/proc/{pid}")).exists();
    let session = |pid: &str| {
        let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap();
        stat.rsplit(") ").next().unwrap().split(' ').nth(3).unwrap().to_owned()
    };
    assert_eq!(session(&pid), pid, "it leads a session of its own");
    assert_ne!(session("self"), pid);
    let client = Client::connect(&link, ClientOptions::default()).unwrap();
    client.wait_connected(Duration::from_secs(60)).unwrap();
    // While a viewer is there, it stays.
    std::thread::sleep(Duration::from_secs(10));
    assert!(is_there() && client.state() == State::Connected);
    drop(client);
    wait_until("the end of the server", || !is_there());
    // Nobody has come.
    let output = bench.command(&format!("{serve} 1s")).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    let pid = said.split("`kill ").nth(1).unwrap().split('`').next().unwrap().to_owned();
    wait_until("the end of the other", || !std::path::Path::new(&format!("/proc/{pid}")).exists());
    // What goes wrong is told, with the exit code.
    bench.fails("serve no.nrrd --detach", 1, &["no.nrrd"]);
    bench.fails("serve builtin:shells@16 --detach --end-after-last 0", 2, &["--end-after-last", "60s"]);
}

#[test]
fn a_relay_joins_its_streams_with_the_server() {
    let bench = Bench::new();
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let mut relay = bench.command(&format!("relay {port}"));
    let mut relay = relay.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let (server, _) = listener.accept().unwrap();
    let (mut input, mut output) = (relay.stdin.take().unwrap(), relay.stdout.take().unwrap());
    let sent: Vec<u8> = (0..3_000_000u32).map(|i| (i * 7 + i / 1000) as u8).collect();
    // Both ways at once.
    let echo = std::thread::spawn(move || std::io::copy(&mut &server, &mut &server));
    let sending = sent.clone();
    let sender =
        std::thread::spawn(move || std::io::Write::write_all(&mut input, &sending).map(|()| drop(input)));
    let mut received = Vec::new();
    std::io::Read::read_to_end(&mut output, &mut received).unwrap();
    sender.join().unwrap().unwrap();
    assert_eq!(echo.join().unwrap().unwrap(), sent.len() as u64);
    assert!(received == sent && relay.wait().unwrap().success());
    // The server ends first, and the relay with it, though its input stays open.
    let mut relay = bench.command(&format!("relay 127.0.0.1:{port}"));
    let mut relay = relay.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    drop(listener.accept().unwrap());
    assert!(relay.wait().unwrap().success());
    drop(listener);
    bench.fails(&format!("relay {port}"), 1, &["no server", "127.0.0.1"]);
    bench.fails("relay far:1", 2, &["far:1", "port"]);
}

fn wait_until(what: &str, is_so: impl Fn() -> bool) {
    let patience = Instant::now() + Duration::from_secs(60);
    while !is_so() {
        assert!(Instant::now() < patience, "waited in vain for {what}");
        std::thread::sleep(Duration::from_millis(50));
    }
}
