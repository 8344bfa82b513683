//! Persistent settings from files and the environment, below the flags of a command.
//!
//! The last of these wins: the program's default; the system's file; the user's file; the file after `--config`; a
//! variable `ISINGLASS_SECTION_KEY`; a flag. Each setting *is* a flag: its text becomes that flag's default. So one
//! parser reads both, and no setting can say what a flag cannot. Commands that only compute (`render`, `bench`, …)
//! have no settings: their results depend on the command line alone.

mod known;
mod print;
mod sources;

use std::ffi::OsString;
use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::parser::ValueSource;
use clap::{Arg, ArgAction, ArgMatches, Command, value_parser};
use isinglass_client::{BindingError, Bindings};

use known::{BINDINGS, Known, SETTINGS};
use sources::{Origin, Sourced};

pub(crate) use print::print;

/// Adds the flags of all commands with settings.
pub(crate) fn with_flags(command: Command) -> Command {
    known::COMMANDS.iter().fold(command, |command, name| {
        command.mut_subcommand(name, |c| {
            let config =
                Arg::new(CONFIG).long("config").value_name("FILE").value_parser(value_parser!(PathBuf));
            let print = Arg::new(PRINT).long("print-config").action(ArgAction::SetTrue);
            c.next_help_heading("Settings")
                .arg(
                    config
                        .help("Read settings from FILE too; they hold over those of the system and the user"),
                )
                .arg(
                    print
                        .help("Print the settings that hold, and where each comes from, and do nothing else"),
                )
        })
    })
}

/// The settings for the called command.
#[derive(Default)]
pub(crate) struct Settings {
    /// The command; `None` if it has no settings.
    command: Option<&'static str>,
    /// The effective texts, with their settings.
    held: Vec<(&'static Known, Sourced)>,
    /// Keys and mouse.
    pub(crate) bindings: Bindings,
    /// The origins of bindings that differ from the defaults.
    bound: Vec<(String, Origin)>,
    /// Whether to print them.
    pub(crate) is_printed: bool,
}

impl Settings {
    /// Reads the settings for the command in `arguments`, which `command` will parse.
    pub(crate) fn read(command: &Command, arguments: &[OsString]) -> Result<Self> {
        // This only finds the command and its file; the real parse reports all mistakes.
        let Ok(called) = command.clone().ignore_errors(true).try_get_matches_from(arguments) else {
            return Ok(Self::default());
        };
        let Some((name, matches)) = called.subcommand() else { return Ok(Self::default()) };
        let Some(name) = known::COMMANDS.into_iter().find(|known| *known == name) else {
            return Ok(Self::default());
        };
        let file = matches.try_get_one::<PathBuf>(CONFIG).ok().flatten();
        let is_printed = matches!(matches.try_get_one::<bool>(PRINT), Ok(Some(true)));
        let mut settings = Self { command: Some(name), is_printed, ..Self::default() };
        for sourced in sources::all(name, file.map(PathBuf::as_path))? {
            settings.take(command, name, sourced)?;
        }
        if let Err(problem) = settings.bindings.check() {
            let BindingError::Conflict(_, a, b) = &problem else { bail!(problem) };
            let mut bound = settings.bound.iter().rev();
            // One of the two was set, because defaults do not collide.
            let origin = bound.find(|(key, _)| key == a || key == b).map(|(_, origin)| origin.to_string());
            bail!("{}: {problem}", origin.unwrap_or_default());
        }
        Ok(settings)
    }

    /// Checks a setting, effective or not, and keeps it until another one overrides it.
    fn take(&mut self, command: &Command, name: &str, sourced: Sourced) -> Result<()> {
        let Sourced { section, key, origin, .. } = &sourced;
        if section == BINDINGS {
            let chords = sourced.list();
            if let Err(problem) = self.bindings.set(key, &chords) {
                bail!("{origin}: {section}.{key}: {problem}");
            }
            self.bound.retain(|(k, _)| k != key);
            self.bound.push((key.clone(), origin.clone()));
            return Ok(());
        }
        let known = SETTINGS.iter().find(|k| k.section == section && k.key == key);
        let Some(known) = known else {
            bail!("{origin}: found {section}.{key}, expected {}", known::expected(section));
        };
        let Some(text) = sourced.text() else {
            bail!("{origin}: {section}.{key}: found a list, expected one value");
        };
        let home = command.find_subcommand(known.commands[0]).expect("the table names commands");
        let text = match known.argument(home).get_possible_values() {
            values if values.iter().any(|v| v.matches("on", false)) => switch(text),
            _ => text.to_owned(),
        };
        if let Some(problem) = problem_of(home, known, &text) {
            bail!("{origin}: {section}.{key}: found {:?}, {problem}", shortened(&text));
        }
        if known.commands.contains(&name) {
            let value = isinglass_formats::SettingValue::Text(text);
            self.held.retain(|(k, _)| k.arg != known.arg);
            self.held.push((known, Sourced { value, ..sourced.clone() }));
        }
        Ok(())
    }

    /// The command line with these settings as defaults.
    pub(crate) fn apply(&self, command: Command) -> Command {
        let Some(name) = self.command else { return command };
        command.mut_subcommand(name, |mut command| {
            for (known, sourced) in &self.held {
                let text: &'static str = sourced.text().unwrap_or_default().to_owned().leak();
                command = command.mut_arg(known.arg_in(name), |arg| arg.default_value(text));
            }
            if self.is_printed {
                // Printing serves and shows nothing, so no volume is required.
                let required: Vec<_> = command.get_positionals().map(|a| a.get_id().clone()).collect();
                for id in required {
                    command = command.mut_arg(id, |arg| arg.required(false));
                }
            }
            command
        })
    }
}

/// `true` and `false` in the words of a flag.
fn switch(text: &str) -> String {
    match text {
        "true" => "on".into(),
        "false" => "off".into(),
        text => text.into(),
    }
}

/// The complaint of a flag's own parser about a text.
fn problem_of(command: &Command, known: &Known, text: &str) -> Option<String> {
    let long = known.argument(command).get_long().expect("settings are long flags");
    let line = [OsString::from(command.get_name()), format!("--{long}={text}").into()];
    let error = command.clone().try_get_matches_from(line).err()?;
    match error.kind() {
        ErrorKind::InvalidValue | ErrorKind::ValueValidation => {}
        // The command line may supply what is missing.
        _ => return None,
    }
    if let Some(ContextValue::Strings(values)) = error.get(ContextKind::ValidValue)
        && !values.is_empty()
    {
        return Some(format!("expected one of {}", values.join(", ")));
    }
    let cause = std::error::Error::source(&error).map(ToString::to_string);
    Some(cause.unwrap_or_else(|| "which is no such value".into()))
}

fn shortened(text: &str) -> String {
    text.chars().take(60).collect()
}

/// The origin of an argument's value in words.
fn origin_of(matches: &ArgMatches, settings: &Settings, known: &Known, id: &str) -> String {
    if matches.value_source(id) == Some(ValueSource::CommandLine) {
        return "flag".into();
    }
    let held = settings.held.iter().find(|(k, _)| k.arg == known.arg);
    held.map_or_else(|| "default".into(), |(_, sourced)| sourced.origin.to_string())
}

const CONFIG: &str = "config";
/// The name of the flag that prints them.
pub(crate) const PRINT: &str = "print_config";
