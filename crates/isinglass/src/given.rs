//! Which flags a person gave: those hold, whatever a state or a file of settings says.

use std::collections::HashSet;

use clap::ArgMatches;
use clap::parser::ValueSource;

/// The arguments of a command that stood on its command line.
#[derive(Clone, Debug, Default)]
pub(crate) struct Given(HashSet<String>);

impl Given {
    /// Those of the command that was called.
    pub(crate) fn of(matches: &ArgMatches) -> Self {
        let Some((_, command)) = matches.subcommand() else { return Self::default() };
        let is_given = |id: &str| command.value_source(id) == Some(ValueSource::CommandLine);
        Self(command.ids().map(clap::Id::as_str).filter(|id| is_given(id)).map(str::to_owned).collect())
    }

    /// Whether the argument with this name of a field was given.
    pub(crate) fn has(&self, field: &str) -> bool {
        self.0.contains(field)
    }
}
