//! Reads settings from TOML with sections into a flat list. Each setting knows its line, and the caller interprets
//! the keys.

use std::path::Path;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::error::{FormatError, io_error, line_at, one_line, shown, syntax_error};
use crate::source::read_file;
use crate::transfer::text_literal;

/// A setting in a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Setting {
    /// The section; empty at the top.
    pub section: String,
    /// Its name in the section.
    pub key: String,
    /// Its value.
    pub value: SettingValue,
    /// The line, counted from 1.
    pub line: usize,
}

/// The value of a setting, as on a command line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SettingValue {
    /// A string, or the text of a number or truth value.
    Text(String),
    /// A list of these.
    List(Vec<String>),
}

/// The settings in a file; `None` if there is no such file.
///
/// # Errors
/// The file cannot be read, or it is not TOML with sections. The message is one line.
pub fn read_settings(path: &Path) -> Result<Option<Vec<Setting>>, FormatError> {
    if !path.try_exists().map_err(io_error(path))? {
        return Ok(None);
    }
    let unsupported = |found| FormatError::Unsupported { path: shown(path), found, expected: "settings" };
    let bytes = read_file(path, MAX_SETTINGS_BYTES)?.ok_or_else(|| unsupported("more than 1 MiB"))?;
    let text = String::from_utf8(bytes).map_err(|_| unsupported("bytes that are not UTF-8"))?;
    settings_from_toml(&text, path).map(Some)
}

/// The settings in a text, in order. `path` is for messages.
///
/// # Errors
/// As [`read_settings`].
pub fn settings_from_toml(text: &str, path: &Path) -> Result<Vec<Setting>, FormatError> {
    let syntax = |at: usize, problem: String| FormatError::Syntax {
        path: shown(path),
        line: line_at(text, at),
        problem,
    };
    let whole = DeTable::parse(text).map_err(syntax_error(path, text))?;
    let mut settings = Vec::new();
    for (section, value) in whole.get_ref() {
        let at = section.span().start;
        let DeValue::Table(table) = value.get_ref() else {
            let key = one_line(section.get_ref());
            return Err(syntax(
                at,
                format!("found {key:?} outside of a section, expected it under one such as [look]"),
            ));
        };
        for (key, value) in table {
            let line = line_at(text, key.span().start);
            let value = value_of(text, value).ok_or_else(|| {
                let key = one_line(key.get_ref());
                syntax(
                    key_start(value),
                    format!(
                        "{key:?} is a table or a date, expected a text, number, truth value or a list of them"
                    ),
                )
            })?;
            settings.push(Setting {
                section: section.get_ref().to_string(),
                key: key.get_ref().to_string(),
                value,
                line,
            });
        }
    }
    settings.sort_by_key(|s| s.line);
    Ok(settings)
}

fn key_start(value: &Spanned<DeValue<'_>>) -> usize {
    value.span().start
}

fn value_of(text: &str, value: &Spanned<DeValue<'_>>) -> Option<SettingValue> {
    if let DeValue::Array(items) = value.get_ref() {
        return items.iter().map(|item| scalar_of(text, item)).collect::<Option<_>>().map(SettingValue::List);
    }
    scalar_of(text, value).map(SettingValue::Text)
}

fn scalar_of(text: &str, value: &Spanned<DeValue<'_>>) -> Option<String> {
    match value.get_ref() {
        DeValue::String(s) => Some(s.to_string()),
        DeValue::Integer(_) | DeValue::Float(_) | DeValue::Boolean(_) => {
            text.get(value.span()).map(str::to_owned)
        }
        _ => None,
    }
}

impl SettingValue {
    /// The value as TOML that reads back as the same value.
    pub fn literal(&self) -> String {
        match self {
            Self::Text(text) => scalar_literal(text),
            Self::List(items) => {
                format!("[{}]", items.iter().map(|i| text_literal(i)).collect::<Vec<_>>().join(", "))
            }
        }
    }
}

/// Writes numbers and truth values without quotes.
fn scalar_literal(text: &str) -> String {
    let digits = text.strip_prefix('-').unwrap_or(text);
    let (whole, part) = digits.split_once('.').map_or((digits, None), |(w, p)| (w, Some(p)));
    let is_digits = |s: &str| !s.is_empty() && s.len() < 16 && s.bytes().all(|b| b.is_ascii_digit());
    let is_number =
        is_digits(whole) && (whole == "0" || !whole.starts_with('0')) && part.is_none_or(is_digits);
    if is_number || text == "true" || text == "false" { text.to_owned() } else { text_literal(text) }
}

/// Longest file of settings.
const MAX_SETTINGS_BYTES: u64 = 1 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_are_read_with_their_lines_and_written_so_that_they_read_back() {
        let text = "# first\n[look]\nk = 12 # twelve\ntf = \"a b\"\n\n[window]\nfov=35.5\nbox = true\nlist = [\"a\", 2]\n";
        let read = settings_from_toml(text, Path::new("a.toml")).unwrap();
        let shown: Vec<_> = read
            .iter()
            .map(|s| format!("{}:{}.{}={}", s.line, s.section, s.key, s.value.literal()))
            .collect();
        let expected = [
            "3:look.k=12",
            "4:look.tf=\"a b\"",
            "7:window.fov=35.5",
            "8:window.box=true",
            "9:window.list=[\"a\", \"2\"]",
        ];
        assert_eq!(shown, expected);
        for odd in
            ["007", "1e5", "-", "1.", "", "\"q\"\\", "#204060", "-12", "0.5", "1_0", "99999999999999999999"]
        {
            let value = SettingValue::Text(odd.into());
            let again = settings_from_toml(&format!("[a]\nb = {}", value.literal()), Path::new("a")).unwrap();
            assert_eq!(again[0].value, value, "{odd}");
        }
    }

    #[test]
    fn mistakes_are_one_line_with_file_and_line() {
        for (text, words) in [
            ("[a]\nb = ", "a.toml: line 2"),
            ("b = 1", "a.toml: line 1: found \"b\" outside of a section"),
            ("[a]\n[a]", "a.toml: line 2"),
            ("[a]\nb = 1979-05-27", "a.toml: line 2: \"b\" is a table or a date"),
            ("[a]\n[a.b]\nc = 1", "is a table"),
            ("[a]\nb = [[1]]", "list of them"),
        ] {
            let e = settings_from_toml(text, Path::new("a.toml")).unwrap_err().to_string();
            assert!(e.contains(words) && !e.contains('\n'), "{text:?}: {e}");
        }
        assert!(read_settings(Path::new("/no/such/file.toml")).unwrap().is_none());
        assert!(read_settings(Path::new("/")).is_err());
    }
}
