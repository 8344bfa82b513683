//! What is odd about a file, told before and after it is read.

use std::fmt;

/// What a warning is about, so that a viewer can mark the ones that matter to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum WarningKind {
    /// The volume lies in space in another way than it is shown.
    Geometry,
    /// The file does not say something that was assumed.
    Guess,
    /// Numbers were changed.
    Values,
    /// Data was left out, or is not what it should be.
    Data,
    /// The file holds more than what is shown.
    Choice,
}

/// One sentence without its full stop.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Warning {
    /// What it is about.
    pub kind: WarningKind,
    /// The sentence.
    pub text: String,
}

impl Warning {
    /// A warning; text from a file must be quoted.
    pub(crate) fn new(kind: WarningKind, text: impl Into<String>) -> Self {
        Self { kind, text: text.into() }
    }
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&self.text)
    }
}
