//! Which flags a person gave: those hold, whatever a state or a file of settings says.

use std::collections::HashSet;

use clap::ArgMatches;
use clap::parser::ValueSource;
use isinglass_client::Bindings;

/// The arguments of a command that stood on its command line, and what no argument says.
#[derive(Clone, Debug, Default)]
pub(crate) struct Given {
    fields: HashSet<String>,
    /// What keys and mouse do in a window.
    pub(crate) bindings: Bindings,
}

impl Given {
    /// Those of the command that was called.
    pub(crate) fn of(matches: &ArgMatches, bindings: Bindings) -> Self {
        let Some((_, command)) = matches.subcommand() else {
            return Self { bindings, ..Self::default() };
        };
        let is_given = |id: &str| command.value_source(id) == Some(ValueSource::CommandLine);
        let ids = command.ids().map(clap::Id::as_str).filter(|id| is_given(id));
        Self { fields: ids.map(str::to_owned).collect(), bindings }
    }

    /// Whether the argument with this name of a field was given.
    pub(crate) fn has(&self, field: &str) -> bool {
        self.fields.contains(field)
    }
}
