//! Prints the effective settings as a file.

use anyhow::Result;
use clap::ArgMatches;
use isinglass_client::Bindings;
use isinglass_formats::SettingValue;

use super::known::{BINDINGS, COMMANDS, SETTINGS};
use super::{Settings, origin_of};
use crate::report;

/// Prints the effective settings of the command behind `matches`, with the origin of each. The output is a valid
/// file.
pub(crate) fn print(matches: &ArgMatches, settings: &Settings) -> Result<()> {
    let Some((name, matches)) = matches.subcommand().filter(|(name, _)| COMMANDS.contains(name)) else {
        return Ok(());
    };
    let mut out = format!("# What holds for `isinglass {name}`, and where it comes from.\n");
    let mut section = "";
    for known in SETTINGS.iter().filter(|k| k.commands.contains(&name)) {
        if known.section != section {
            section = known.section;
            out += &format!("\n[{section}]\n");
        }
        let given = matches.value_source(known.arg).is_some();
        let id = if given { known.arg } else { known.arg_in(name) };
        let value = matches.get_raw(id).and_then(|mut values| values.next()).map(|v| v.to_string_lossy());
        let origin = origin_of(matches, settings, known, id);
        out += &match value {
            Some(value) => {
                let value = SettingValue::Text(value.into_owned()).literal();
                format!("{} = {value}  # {origin}\n", known.key)
            }
            None => format!("# {} = …  # not set\n", known.key),
        };
    }
    if name != "serve" {
        out += &format!("\n[{BINDINGS}]\n");
        for action in Bindings::names() {
            let value = match settings.bindings.chords(action) {
                chords if action == isinglass_client::REVERSE_WHEEL => SettingValue::Text(chords.concat()),
                chords => SettingValue::List(chords),
            };
            let bound = settings.bound.iter().find(|(key, _)| key == action);
            let origin = bound.map_or("default".into(), |(_, origin)| origin.to_string());
            out += &format!("{action} = {}  # {origin}\n", value.literal());
        }
    }
    report::print(&out)
}
