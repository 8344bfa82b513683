//! Errors about files. Text from a file is quoted, escaped and cut, so that every message stays one short line.

use std::io;
use std::path::Path;

use isinglass_core::text::is_control;
use isinglass_core::transfer::TransferError;
use isinglass_core::volume::VolumeError;

/// Why a file or a name could not be turned into a volume or a transfer function.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FormatError {
    /// The system refused to open or read the file.
    #[error("{path}: {cause}")]
    Io {
        /// The file.
        path: String,
        /// What the system said.
        cause: io::Error,
    },
    /// The file has no supported format, or it is not a regular file.
    #[error("{path}: found {found}, expected {expected}")]
    Unsupported {
        /// The file.
        path: String,
        /// What it looks like.
        found: &'static str,
        /// What is supported.
        expected: &'static str,
    },
    /// The header of an NRRD file is wrong.
    #[error("{path}: NRRD header: {cause}")]
    Header {
        /// The file.
        path: String,
        /// What is wrong.
        cause: HeaderError,
    },
    /// The header of another file is wrong, or it describes something unsupported.
    #[error("{path}: {format}: {problem}")]
    Malformed {
        /// The file.
        path: String,
        /// The format of the header.
        format: String,
        /// What is wrong, what was found and what was expected.
        problem: String,
    },
    /// The volume cannot be read by pages.
    #[error("{path}: {found} cannot be read by pages; `isinglass convert` makes an OME-Zarr image that can")]
    NotPaged {
        /// The file.
        path: String,
        /// What it is.
        found: String,
    },
    /// The requested part is not in the file.
    #[error("{path}: {what} {asked} was asked for, expected 0 to {last}", last = found.saturating_sub(1))]
    Selection {
        /// The file.
        path: String,
        /// Channel, time, level or series.
        what: &'static str,
        /// The requested number, from 0.
        asked: u64,
        /// How many there are.
        found: u64,
    },
    /// Reading was cancelled.
    #[error("{path}: cancelled")]
    Cancelled {
        /// The file.
        path: String,
    },
    /// The file has fewer bytes or numbers than its shape needs.
    #[error("{path}: {shape} needs {expected} {unit}, found {found}")]
    Short {
        /// The file with the voxels.
        path: String,
        /// The shape, such as `256×256×128 uint8`.
        shape: String,
        /// How many there should be.
        expected: u64,
        /// How many there are; for compressed data, how many there can be at most.
        found: u64,
        /// The unit that is counted, such as bytes or numbers.
        unit: &'static str,
    },
    /// A file that a header names, or a link in a folder, is outside the folder.
    #[error("{path}: its file {name} is outside its folder; --foreign-files allows that")]
    Foreign {
        /// The header or folder.
        path: String,
        /// The name of the file, quoted.
        name: String,
    },
    /// A file that a header names is missing.
    #[error("{path}: its data file {name} is missing; expected it beside the header")]
    MissingData {
        /// The header.
        path: String,
        /// The name of the file, quoted.
        name: String,
    },
    /// The voxels cannot be decoded.
    #[error("{path}: voxels: {problem}")]
    Data {
        /// The file with the voxels.
        path: String,
        /// What is wrong.
        problem: String,
    },
    /// The volume would take more memory than allowed.
    #[error("{path}: needs {needed} bytes of memory, expected at most {limit}{advice}")]
    TooLarge {
        /// The file or built-in volume.
        path: String,
        /// Bytes needed while reading.
        needed: u64,
        /// The limit it was opened with.
        limit: u64,
        /// What else may be done, after a semicolon; empty if nothing is known.
        advice: &'static str,
    },
    /// The voxels do not make a volume.
    #[error("{path}: {cause}")]
    Volume {
        /// The file.
        path: String,
        /// What is wrong.
        cause: VolumeError,
    },
    /// The name after `builtin:` is unknown.
    #[error("unknown built-in volume {found}; expected {expected}")]
    Builtin {
        /// The unknown name.
        found: String,
        /// The known names.
        expected: String,
    },
    /// The name is neither a preset nor a file.
    #[error("unknown preset {found}, and no file of that name; expected one of {expected}, or a TOML file")]
    UnknownPreset {
        /// The unknown name.
        found: String,
        /// The names of all presets.
        expected: String,
    },
    /// The file is not valid TOML, or its fields are wrong.
    #[error("{path}: line {line}: {problem}")]
    Syntax {
        /// The file.
        path: String,
        /// The line, counted from 1.
        line: usize,
        /// What is wrong.
        problem: String,
    },
    /// A saved state that cannot be used.
    #[error("{path}: {problem}")]
    State {
        /// The file.
        path: String,
        /// What is wrong.
        problem: String,
    },
    /// The control points do not form a transfer function.
    #[error("{path}: {cause}")]
    Transfer {
        /// The file.
        path: String,
        /// What is wrong.
        cause: TransferError,
    },
}

impl FormatError {
    /// The same error, which tells what makes a file of any size smaller in memory.
    pub(crate) fn with_advice(mut self) -> Self {
        if let Self::TooLarge { advice, .. } = &mut self {
            *advice = "; `isinglass convert` makes an OME-Zarr image of it that is read by pages";
        }
        self
    }

    /// The same error about what was unpacked from `owner` into `folder`. A file inside is named behind its owner.
    pub(crate) fn named_within(mut self, folder: &Path, owner: &Path) -> Self {
        let (Self::Io { path, .. }
        | Self::Unsupported { path, .. }
        | Self::Header { path, .. }
        | Self::Malformed { path, .. }
        | Self::NotPaged { path, .. }
        | Self::Selection { path, .. }
        | Self::Cancelled { path }
        | Self::Short { path, .. }
        | Self::Foreign { path, .. }
        | Self::MissingData { path, .. }
        | Self::Data { path, .. }
        | Self::TooLarge { path, .. }
        | Self::Volume { path, .. }
        | Self::Syntax { path, .. }
        | Self::State { path, .. }
        | Self::Transfer { path, .. }) = &mut self
        else {
            return self;
        };
        if let Some(inner) = path.strip_prefix(&shown(folder)) {
            *path = format!("{}{}", shown(owner), inner.replace('\\', "/"));
        }
        self
    }
}

/// What is wrong with an NRRD header.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum HeaderError {
    /// The first line does not name a known version of NRRD.
    #[error("the first line is {0}, expected NRRD0001 to NRRD0005")]
    Magic(String),
    /// A required field is missing.
    #[error("field \"{0}\" is missing")]
    Missing(&'static str),
    /// A field has a value that cannot be read.
    #[error("field \"{field}\" is {found}, expected {expected}")]
    Value {
        /// The field.
        field: &'static str,
        /// Its text, quoted.
        found: String,
        /// The accepted values.
        expected: &'static str,
    },
    /// A field occurs more than once.
    #[error("field \"{0}\" is given twice")]
    Twice(&'static str),
    /// A field has the wrong number of entries.
    #[error("field \"{field}\" has {found} entries, expected {expected} as \"dimension\" says")]
    Entries {
        /// The field.
        field: &'static str,
        /// Entries found.
        found: usize,
        /// Entries expected.
        expected: usize,
    },
    /// A line that is neither field, key, comment nor blank.
    #[error("line {line} is {found}, expected \"field: value\", \"key:=value\", a comment or a blank line")]
    Line {
        /// The number of the line, counted from 1.
        line: usize,
        /// Its text, quoted.
        found: String,
    },
    /// The header does not end within this many bytes.
    #[error("no blank line ends it within {0} bytes")]
    End(u64),
    /// The fields contradict each other, or they do not describe a volume.
    #[error("{0}")]
    Contradiction(String),
}

/// Quotes text from outside. Control characters are escaped, and long text is cut.
pub(crate) fn quoted(text: &str) -> String {
    let mut cut: String = text.chars().take(MAX_QUOTED).collect();
    if cut.len() < text.len() {
        cut.push('…');
    }
    format!("{cut:?}")
}

/// A path for a message, on one line.
pub(crate) fn shown(path: &Path) -> String {
    path.display().to_string().chars().map(|c| if is_control(c) { '?' } else { c }).collect()
}

/// Returns a function for `map_err` on anything that reads `path`.
pub(crate) fn io_error(path: &Path) -> impl Fn(io::Error) -> FormatError + Copy + '_ {
    move |cause| FormatError::Io { path: shown(path), cause }
}

/// Returns a function for `map_err` on what parses `text`, the TOML file at `path`.
pub(crate) fn syntax_error<'a>(
    path: &'a Path,
    text: &'a str,
) -> impl Fn(toml::de::Error) -> FormatError + Copy + 'a {
    move |e| FormatError::Syntax {
        path: shown(path),
        line: line_at(text, e.span().map_or(0, |span| span.start)),
        problem: one_line(e.message()),
    }
}

/// The number, from 1, of the line with the byte `at`.
pub(crate) fn line_at(text: &str, at: usize) -> usize {
    1 + text.bytes().take(at).filter(|&b| b == b'\n').count()
}

/// The message of a parser on one line. It is cut, because parsers quote whole lines of a file.
pub(crate) fn one_line(message: &str) -> String {
    let line: String = message.chars().map(|c| if is_control(c) { ' ' } else { c }).collect();
    match line.char_indices().nth(MAX_MESSAGE_CHARS) {
        Some((end, _)) => format!("{}…", &line[..end]),
        None => line,
    }
}

/// The error that `asked`, a channel, time, level or series, is not one of the `found` in the file.
pub(crate) fn not_there(path: &Path, what: &'static str, asked: u64, found: usize) -> FormatError {
    FormatError::Selection { path: shown(path), what, asked, found: found as u64 }
}

/// Returns a function for `map_err` on what reads a header of `format` at `path`.
pub(crate) fn malformed<'a>(path: &'a Path, format: &'a str) -> impl Fn(String) -> FormatError + Copy + 'a {
    move |problem| FormatError::Malformed { path: shown(path), format: format.to_owned(), problem }
}

/// Longest quotation from a file, in characters.
const MAX_QUOTED: usize = 60;
const MAX_MESSAGE_CHARS: usize = 300;
