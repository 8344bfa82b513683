//! Remote volume rendering with layered frames: the command line.
//!
//! Reads arguments, starts and stops; everything else is done by the crates below. Results go to standard output,
//! progress and errors to standard error. The exit code is 0 on success, 2 on bad usage and 1 on failure, and an error
//! is one line.

mod args;
mod clip_args;
mod commands;
mod given;
mod lens_args;
mod library;
mod memory;
mod report;
mod state_args;

use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser};

use commands::Command;
use given::Given;

/// Remote volume rendering that follows the hand at any latency.
#[derive(Parser)]
#[command(name = "isinglass", version, arg_required_else_help = true, disable_help_subcommand = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

fn main() -> ExitCode {
    let (cli, given) = match parse() {
        Ok(parsed) => parsed,
        Err(e) => return report::usage(&e),
    };
    report::start_log(cli.command.log_level());
    match cli.command.run(given) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => report::failure(&e),
    }
}

fn parse() -> Result<(Cli, Given), clap::Error> {
    let mut command = Cli::command();
    for name in commands::WITH_STATE {
        // A state may say where its volume is.
        command = command.mut_subcommand(name, |c| {
            c.mut_arg("volume", |volume| volume.required(false).required_unless_present("state"))
        });
    }
    let mut matches = command.clone().try_get_matches()?;
    let given = Given::of(&matches);
    let cli = Cli::from_arg_matches_mut(&mut matches).map_err(|e| e.format(&mut command))?;
    Ok((cli, given))
}
