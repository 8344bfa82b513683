//! What can be wrong with a file. Text that comes from a file is quoted, escaped and cut, so that every message stays
//! one short line.

use std::io;
use std::path::Path;

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
    /// Not a kind of file that is read here, or not a file at all.
    #[error("{path}: found {found}, expected {expected}")]
    Unsupported {
        /// The file.
        path: String,
        /// What it looks like.
        found: &'static str,
        /// What could be read.
        expected: &'static str,
    },
    /// The header of an NRRD file makes no sense.
    #[error("{path}: NRRD header: {cause}")]
    Header {
        /// The file.
        path: String,
        /// What is wrong.
        cause: HeaderError,
    },
    /// The header of another file makes no sense, or asks for what is not read here.
    #[error("{path}: {format}: {problem}")]
    Malformed {
        /// The file.
        path: String,
        /// The format it was read as.
        format: String,
        /// What is wrong, what was found and what was expected.
        problem: String,
    },
    /// What was asked for is not in the file.
    #[error("{path}: {what} {asked} was asked for, expected 0 to {last}", last = found.saturating_sub(1))]
    Selection {
        /// The file.
        path: String,
        /// Channel, time, level or series.
        what: &'static str,
        /// The one asked for.
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
    /// There are fewer bytes or numbers than the shape needs.
    #[error("{path}: {shape} needs {expected} {unit}, found {found}")]
    Short {
        /// The file with the voxels.
        path: String,
        /// What was asked for, such as `256×256×128 uint8`.
        shape: String,
        /// How many there should be.
        expected: u64,
        /// How many there are (for compressed data: at most).
        found: u64,
        /// Of what: bytes or numbers.
        unit: &'static str,
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
    #[error("{path}: needs {needed} bytes of memory, expected at most {limit}")]
    TooLarge {
        /// The file or built-in volume.
        path: String,
        /// Bytes needed while reading.
        needed: u64,
        /// The limit it was opened with.
        limit: u64,
    },
    /// The voxels do not make a volume.
    #[error("{path}: {cause}")]
    Volume {
        /// The file.
        path: String,
        /// What is wrong.
        cause: VolumeError,
    },
    /// A name after `builtin:` that is none.
    #[error("unknown built-in volume {found}; expected {expected}")]
    Builtin {
        /// What was asked for.
        found: String,
        /// What there is.
        expected: String,
    },
    /// Neither a preset nor a file.
    #[error("unknown preset {found}, and no file of that name; expected one of {expected}, or a TOML file")]
    UnknownPreset {
        /// What was asked for.
        found: String,
        /// The presets there are.
        expected: String,
    },
    /// A file that is not TOML of the right form.
    #[error("{path}: line {line}: {problem}")]
    Syntax {
        /// The file.
        path: String,
        /// Where, from 1.
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
    /// Control points that make no transfer function.
    #[error("{path}: {cause}")]
    Transfer {
        /// The file.
        path: String,
        /// What is wrong.
        cause: TransferError,
    },
}

/// What is wrong with an NRRD header.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum HeaderError {
    /// The first line is no NRRD magic of a known version.
    #[error("the first line is {0}, expected NRRD0001 to NRRD0005")]
    Magic(String),
    /// A required field is not there.
    #[error("field \"{0}\" is missing")]
    Missing(&'static str),
    /// A field says something that cannot be read.
    #[error("field \"{field}\" is {found}, expected {expected}")]
    Value {
        /// The field.
        field: &'static str,
        /// Its text, quoted.
        found: String,
        /// What it could be.
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
        /// Its number, from 1.
        line: usize,
        /// Its text, quoted.
        found: String,
    },
    /// There is no end of the header where one must be.
    #[error("no blank line ends it within {0} bytes")]
    End(u64),
    /// The fields are clear but do not describe one scalar volume.
    #[error("{0}")]
    Contradiction(String),
}

/// Text from outside, quoted, without line breaks or control characters, cut to a length that fits a line.
pub(crate) fn quoted(text: &str) -> String {
    let mut cut: String = text.chars().take(MAX_QUOTED).collect();
    if cut.len() < text.len() {
        cut.push('…');
    }
    format!("{cut:?}")
}

/// A path for a message: as it is, but on one line.
pub(crate) fn shown(path: &Path) -> String {
    path.display().to_string().chars().map(|c| if c.is_control() { '?' } else { c }).collect()
}

/// For `map_err` on anything that reads `path`.
pub(crate) fn io_error(path: &Path) -> impl Fn(io::Error) -> FormatError + Copy + '_ {
    move |cause| FormatError::Io { path: shown(path), cause }
}

/// For `map_err` on what parses `text`, the TOML file at `path`.
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

/// The message of a parser on one line, cut: it quotes what it does not understand.
pub(crate) fn one_line(message: &str) -> String {
    let line: String = message.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    match line.char_indices().nth(MAX_MESSAGE_CHARS) {
        Some((end, _)) => format!("{}…", &line[..end]),
        None => line,
    }
}

/// The error of a channel, time, level or series that is not there. `found` is how many there are.
pub(crate) fn not_there(path: &Path, what: &'static str, asked: u64, found: usize) -> FormatError {
    FormatError::Selection { path: shown(path), what, asked, found: found as u64 }
}

/// For `map_err` on what reads a header of `format` at `path`.
pub(crate) fn malformed<'a>(path: &'a Path, format: &'a str) -> impl Fn(String) -> FormatError + Copy + 'a {
    move |problem| FormatError::Malformed { path: shown(path), format: format.to_owned(), problem }
}

/// Longest quotation from a file, in characters.
const MAX_QUOTED: usize = 60;
const MAX_MESSAGE_CHARS: usize = 300;
