//! Warnings about a file, before and after it is read.

use std::fmt;

/// The subject of a warning, so that a viewer can mark the relevant ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum WarningKind {
    /// The position or orientation of the volume differs from what is shown.
    Geometry,
    /// Something that the file does not state was assumed.
    Guess,
    /// Numbers were changed.
    Values,
    /// Data were ignored, or are not as expected.
    Data,
    /// The file contains more than is shown.
    Choice,
}

/// A warning: one sentence without its full stop.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Warning {
    /// Its subject.
    pub kind: WarningKind,
    /// The sentence.
    pub text: String,
}

impl Warning {
    /// A warning with this text. Text from a file must be quoted.
    pub(crate) fn new(kind: WarningKind, text: impl Into<String>) -> Self {
        Self { kind, text: text.into() }
    }
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&self.text)
    }
}
