//! The flags that the user gave: they override a state and settings.

use std::collections::HashMap;

use clap::ArgMatches;
use clap::parser::ValueSource;
use isinglass_client::Bindings;

/// The arguments given on a command's command line, and the bindings, which no argument sets.
#[derive(Clone, Debug, Default)]
pub(crate) struct Given {
    /// The texts of the arguments that appeared, by the names of their fields.
    fields: HashMap<String, String>,
    /// Keys and mouse of a window.
    pub(crate) bindings: Bindings,
}

impl Given {
    /// The arguments of the called command.
    pub(crate) fn of(matches: &ArgMatches, bindings: Bindings) -> Self {
        let Some((_, command)) = matches.subcommand() else {
            return Self { bindings, ..Self::default() };
        };
        let is_given = |id: &str| command.value_source(id) == Some(ValueSource::CommandLine);
        let ids = command.ids().map(clap::Id::as_str).filter(|id| is_given(id));
        let text = |id: &str| {
            let values = command.get_raw(id).into_iter().flatten().map(|value| value.to_string_lossy());
            values.collect::<Vec<_>>().join(",")
        };
        Self { fields: ids.map(|id| (id.to_owned(), text(id))).collect(), bindings }
    }

    /// Whether the argument with this field name was given.
    pub(crate) fn has(&self, field: &str) -> bool {
        self.fields.contains_key(field)
    }

    /// The text of an argument that was given.
    pub(crate) fn text(&self, field: &str) -> Option<&str> {
        self.fields.get(field).map(String::as_str)
    }
}
