//! Everything that the user reads: results, errors of one line, and the log.

use std::io::{self, Write};
use std::process::ExitCode;

use anyhow::{Context, Result};
use clap::error::ErrorKind;
use isinglass_bench::BenchError;
use isinglass_bench::progress::note;
use serde::Serialize;
use tracing_subscriber::EnvFilter;

/// Writes text to standard output. A closed pipe is no failure.
pub(crate) fn print(text: &str) -> Result<()> {
    let mut out = io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if e.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        result => result.context("standard output"),
    }
}

/// Writes one JSON object and a line feed to standard output.
pub(crate) fn print_json(object: &impl Serialize) -> Result<()> {
    print(&(serde_json::to_string_pretty(object)? + "\n"))
}

/// Reports bad usage in one line, or shows the requested help.
pub(crate) fn usage(error: &clap::Error) -> ExitCode {
    let is_answer = matches!(
        error.kind(),
        ErrorKind::DisplayHelp
            | ErrorKind::DisplayVersion
            | ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand
    );
    if is_answer {
        // A closed stream is no reason to fail.
        let _ = error.print();
        return ExitCode::from(error.exit_code() as u8);
    }
    // The first paragraph states the problem; hints and usage follow.
    let text = error.to_string();
    let cause = text.split("\n\n").next().unwrap_or_default();
    let cause = cause.strip_prefix("error: ").unwrap_or(cause);
    note(&format!("isinglass: {}; see --help", without_tokens(&one_line(cause))));
    ExitCode::from(USAGE)
}

/// Text of several lines as one.
fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// An error that another process has printed, or this one.
#[derive(Debug)]
pub(crate) struct AlreadyTold;

impl std::fmt::Display for AlreadyTold {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("a process has failed")
    }
}

impl std::error::Error for AlreadyTold {}

/// An error with its causes in one line.
pub(crate) fn in_one_line(error: &anyhow::Error) -> String {
    let causes: Vec<String> = error.chain().map(ToString::to_string).collect();
    without_tokens(&one_line(&causes.join(": ")))
}

pub(crate) fn failure(error: &anyhow::Error) -> ExitCode {
    if error.is::<AlreadyTold>() {
        return ExitCode::FAILURE;
    }
    // Some bad usage only appears when several arguments are combined.
    if let Some(error) = error.downcast_ref() {
        return usage(error);
    }
    let is_usage = error.downcast_ref().is_some_and(BenchError::is_usage);
    note(&format!("isinglass: {}", in_one_line(error)));
    if is_usage { ExitCode::from(USAGE) } else { ExitCode::FAILURE }
}

/// A line without the secrets of its links, which may stand where something else belongs: others may read the log.
fn without_tokens(line: &str) -> String {
    let mut parts = line.split(TOKEN);
    let mut shown = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let rest = part.trim_start_matches(|c: char| c.is_ascii_hexdigit());
        let hidden = if rest.len() < part.len() { "…" } else { "" };
        shown.extend([TOKEN, hidden, rest]);
    }
    shown
}

/// Sends the log to standard error, from `level` up or as `RUST_LOG` says.
pub(crate) fn start_log(level: &str) {
    // QUIC's endpoint calls the end of every byte stream an error. The connection over it tells what it means.
    let usual = || EnvFilter::new(format!("{level},quinn::endpoint=off"));
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| usual());
    // Installing fails only with an earlier subscriber, and there is none.
    let _ = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(io::stderr)
        .with_target(false)
        .try_init();
}

/// The text before a link's secret.
const TOKEN: &str = "token=";
/// Exit code for bad usage.
const USAGE: u8 = 2;
