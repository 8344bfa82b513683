//! What the user reads: results, errors of one line, and the log.

use std::fmt::Write as _;
use std::io::{self, Write};
use std::process::ExitCode;

use anyhow::{Context, Result};
use clap::error::ErrorKind;
use isinglass_bench::BenchError;
use isinglass_bench::progress::note;
use serde::Serialize;
use tracing_subscriber::EnvFilter;

/// Writes text to standard output. A reader that went away is no failure.
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

/// Tells of bad usage in one line, or shows the help that was asked for.
pub(crate) fn usage(error: &clap::Error) -> ExitCode {
    let is_answer = matches!(
        error.kind(),
        ErrorKind::DisplayHelp
            | ErrorKind::DisplayVersion
            | ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand
    );
    if is_answer {
        // Nobody may be listening, which is no reason to fail.
        let _ = error.print();
        return ExitCode::from(error.exit_code() as u8);
    }
    // The first paragraph says what is wrong; behind it stand hints and the usage.
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

/// Tells of a failure in one line.
pub(crate) fn failure(error: &anyhow::Error) -> ExitCode {
    // What only several arguments together show to be bad usage.
    if let Some(error) = error.downcast_ref() {
        return usage(error);
    }
    let is_usage = error.downcast_ref().is_some_and(BenchError::is_usage);
    let mut line = String::new();
    for cause in error.chain() {
        let separator = if line.is_empty() { "isinglass: " } else { ": " };
        let _ = write!(line, "{separator}{cause}");
    }
    note(&without_tokens(&one_line(&line)));
    if is_usage { ExitCode::from(USAGE) } else { ExitCode::FAILURE }
}

/// A line in which links, which may have been given where something else belongs, keep their secret: it may go to a log that
/// others read.
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

/// Sends the log to standard error: what is at least at `level`, or what `RUST_LOG` names.
pub(crate) fn start_log(level: &str) {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(level));
    // A second subscriber cannot be installed, and there is none before this one.
    let _ = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(io::stderr)
        .with_target(false)
        .try_init();
}

/// What stands in front of a link's secret.
const TOKEN: &str = "token=";
/// Exit code for bad usage.
const USAGE: u8 = 2;
