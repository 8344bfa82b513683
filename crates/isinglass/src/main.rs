//! Remote volume rendering with layered frames: the command line.
//!
//! Reads arguments, starts and stops; everything else is done by the crates below. Results go to standard output,
//! progress and errors to standard error. The exit code is 0 on success, 2 on bad usage and 1 on failure, and an error
//! is one line.

mod args;
mod commands;
mod lens_args;
mod library;
mod memory;
mod report;

use std::process::ExitCode;

use clap::Parser;

use commands::Command;

/// Remote volume rendering that follows the hand at any latency.
#[derive(Parser)]
#[command(name = "isinglass", version, arg_required_else_help = true, disable_help_subcommand = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(e) => return report::usage(&e),
    };
    report::start_log(cli.command.log_level());
    match cli.command.run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => report::failure(&e),
    }
}
