//! The flags that the user gave: they override a state and settings.

use std::collections::HashSet;

use clap::ArgMatches;
use clap::parser::ValueSource;
use isinglass_client::Bindings;

/// The arguments given on a command's command line, and the bindings, which no argument sets.
#[derive(Clone, Debug, Default)]
pub(crate) struct Given {
    fields: HashSet<String>,
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
        Self { fields: ids.map(str::to_owned).collect(), bindings }
    }

    /// Whether the argument with this field name was given.
    pub(crate) fn has(&self, field: &str) -> bool {
        self.fields.contains(field)
    }
}
