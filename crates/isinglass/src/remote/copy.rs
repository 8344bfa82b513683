//! `--copy`: puts this program on another machine that is alike.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read};
use std::process::{Command, Stdio};

use anyhow::{Context, Result, bail};
use isinglass_bench::progress::note;
use isinglass_client::format_bytes;

use super::Told;
use super::ssh::Ssh;
use super::start::Complaints;

/// Copies this program to `~/.local/bin` of `machine`, which is of the kind `system`.
///
/// # Errors
/// If the machines differ, or the copy does not run there. What was there before then stays.
pub(super) fn copy(ssh: &Ssh, machine: &str, system: &str) -> Result<()> {
    if let Some(difference) = difference(machine, system) {
        bail!("{difference}");
    }
    let own = std::env::current_exe().context("the program of this machine")?;
    let mut file = File::open(&own).with_context(|| format!("{}", own.display()))?;
    let bytes = file.metadata().with_context(|| format!("{}", own.display()))?.len();
    note(&format!("copying isinglass ({}) to {machine}:~/.local/bin …", format_bytes(bytes)));
    let mut command = ssh.command(&line(bytes));
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().context("cannot run ssh")?;
    let complaints = Complaints::listen(&mut child, &Told::Terminal);
    let sent = match child.stdin.take() {
        Some(mut stdin) => io::copy(&mut file, &mut stdin),
        None => Ok(0),
    };
    let mut said = String::new();
    if let Some(stdout) = child.stdout.take() {
        let lines = BufReader::new(stdout.take(MOST_BYTES)).lines().map_while(Result::ok);
        said = lines.filter(|line| line.starts_with(DONE)).last().unwrap_or_default();
    }
    let status = child.wait().context("ssh")?;
    let _ = complaints.end();
    if said.is_empty() {
        let sent = sent.map_or_else(|e| format!(" ({e})"), |_| String::new());
        bail!(
            "isinglass could not be copied to {machine}, or does not run there ({status}){sent}; its message is above"
        );
    }
    Ok(())
}

/// Why a program of this machine does not run on one of the kind `system`, and what to do.
pub(super) fn difference(machine: &str, system: &str) -> Option<String> {
    let own = Command::new("uname").arg("-sm").stderr(Stdio::null()).output().ok();
    let own = own.map_or_else(
        || std::env::consts::OS.into(),
        |own| String::from_utf8_lossy(&own.stdout).trim().to_owned(),
    );
    (own != system).then(|| {
        let system = if system.is_empty() { "of an unknown kind" } else { system };
        format!("{machine} is {system} and this machine {own}: build isinglass there")
    })
}

/// A line for any login shell that takes the program from standard input, tries it, and only then puts it in place.
fn line(bytes: u64) -> String {
    // No quote, backslash or ! is inside, which shells read differently.
    format!(
        "exec /bin/sh -c 'd=\"$HOME/.local/bin\"; n=\"$d/.isinglass.$$\"; mkdir -p \"$d\" && trap \"rm -f $n\" EXIT && cat > \"$n\" && \
         test \"$(wc -c < \"$n\")\" -eq {bytes} && chmod 755 \"$n\" && v=$(\"$n\" --version) && test -n \"$v\" && mv -f \"$n\" \"$d/isinglass\" && \
         echo \"{DONE} $v\"'"
    )
}

/// The first word of the line that says the copy is in place.
const DONE: &str = "isinglass-copied";
/// Most bytes that are read up to it; what a login shell prints comes before.
const MOST_BYTES: u64 = 1 << 20;

#[cfg(unix)]
#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    fn run(home: &std::path::Path, line: &str, program: &[u8]) -> String {
        let mut command = Command::new("/bin/sh");
        command.args(["-c", line]).env("HOME", home).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command.stderr(Stdio::null()).spawn().unwrap();
        // A shell that fails early reads nothing.
        let _ = child.stdin.take().unwrap().write_all(program);
        String::from_utf8(child.wait_with_output().unwrap().stdout).unwrap()
    }

    #[test]
    fn a_copy_is_put_in_place_only_if_it_is_whole_and_runs() {
        let home = tempfile::tempdir().unwrap();
        let at = home.path().join(".local/bin/isinglass");
        let good = b"#!/bin/sh\necho isinglass 1\n";
        let line_of = |program: &[u8]| line(program.len() as u64);
        assert_eq!(run(home.path(), &line_of(good), good), "isinglass-copied isinglass 1\n");
        assert_eq!(std::fs::read(&at).unwrap(), good);
        let bad = b"#!/bin/sh\nexit 1\n";
        for (line, program) in [(line_of(bad), &bad[..]), (line_of(good), &good[..9]), (line_of(b""), b"")] {
            assert_eq!(run(home.path(), &line, program), "", "{line}");
            assert_eq!(std::fs::read(&at).unwrap(), good, "what was there stays");
        }
        let files = std::fs::read_dir(at.parent().unwrap()).unwrap().count();
        assert_eq!(files, 1, "nothing else is left behind");
    }

    #[test]
    fn another_kind_of_machine_is_named() {
        let line = difference("gpu", "Darwin arm64").unwrap();
        assert!(line.contains("gpu is Darwin arm64") && line.contains("build isinglass there"), "{line}");
        assert!(difference("gpu", "").unwrap().contains("unknown kind"));
        let own = Command::new("uname").arg("-sm").output().unwrap().stdout;
        assert_eq!(difference("gpu", String::from_utf8(own).unwrap().trim()), None);
    }
}
