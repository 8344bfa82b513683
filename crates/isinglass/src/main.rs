//! Remote volume rendering with layered frames: the command line.
//!
//! This crate parses arguments, starts and stops; the crates below do everything else. Results go to standard output,
//! progress and errors to standard error. The exit code is 0 on success, 2 on bad usage and 1 on failure. An error is
//! one line.

mod args;
mod clip_args;
mod commands;
mod config;
mod detach;
mod distributed;
mod ending;
mod environment;
mod given;
mod identity_file;
mod lens_args;
mod library;
mod light_args;
mod local;
mod memory;
mod metrics;
mod paged;
mod remote;
mod report;
mod state_args;
mod window_args;

use std::ffi::OsString;
use std::process::ExitCode;
use std::sync::LazyLock;

use clap::{CommandFactory, FromArgMatches, Parser};

use commands::Command;
use config::Settings;
use given::Given;

/// Remote volume rendering that follows the hand at any latency.
#[derive(Parser)]
#[command(name = "isinglass", version = VERSION.as_str(), arg_required_else_help = true, disable_help_subcommand = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

fn main() -> ExitCode {
    environment::silence_wayland();
    let arguments: Vec<OsString> = std::env::args_os().collect();
    let command = command();
    let settings = match Settings::read(&command, &arguments) {
        Ok(settings) => settings,
        Err(e) => return report::failure(&e),
    };
    let mut command = settings.apply(command);
    let parsed = command.try_get_matches_from_mut(arguments).and_then(|matches| {
        if settings.is_printed {
            return Ok((matches, None));
        }
        let cli = Cli::from_arg_matches(&matches).map_err(|e| e.format(&mut command))?;
        Ok((matches, Some(cli)))
    });
    let done = match parsed {
        Ok((matches, None)) => config::print(&matches, &settings),
        Ok((matches, Some(cli))) => {
            report::start_log(cli.command.log_level());
            ending::prepare();
            let done = memory::check_room();
            let done = done.and_then(|()| cli.command.run(Given::of(&matches, settings.bindings)));
            ending::clean_up();
            done
        }
        Err(e) => return report::usage(&e),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => report::failure(&e),
    }
}

/// The version of the program and of its protocol, which must be the same on both sides of a connection.
static VERSION: LazyLock<String> = LazyLock::new(|| {
    format!("{} (protocol {})", env!("CARGO_PKG_VERSION"), isinglass_core::wire::PROTOCOL_VERSION)
});

/// The command line without settings.
fn command() -> clap::Command {
    let has = |command: &clap::Command, id: &str| command.get_arguments().any(|a| a.get_id() == id);
    let command = config::with_flags(Cli::command());
    commands::WITH_STATE.iter().fold(command, |command, name| {
        // A state may name the volume, and printing settings opens none.
        command.mut_subcommand(name, |c| {
            let others: Vec<_> = ["state", config::PRINT].into_iter().filter(|id| has(&c, id)).collect();
            c.mut_arg("volume", |volume| volume.required(false).required_unless_present_any(others))
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flags_are_listed_under_their_own_headings_only() {
        let mut num_flags = 0;
        let mut commands = vec![command()];
        while let Some(command) = commands.pop() {
            commands.extend(command.get_subcommands().cloned());
            for of_all in ["volume", "scenes", "state", "output", "size", "json", "backend", "tf", "k"] {
                let Some(arg) = command.get_arguments().find(|a| a.get_id() == of_all) else { continue };
                assert_eq!(arg.get_help_heading(), None, "{} {of_all}", command.get_name());
                num_flags += 1;
            }
            let bandwidth = command.get_arguments().find(|a| a.get_id() == "bandwidth");
            assert!(bandwidth.is_none_or(|a| a.get_help_heading() == Some("Link")));
        }
        assert!(num_flags > 40, "{num_flags}");
    }
}
