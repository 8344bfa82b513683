//! A state as TOML. Numbers have as few digits as read back to the bit. The text is compared with the parsed state,
//! so that unknown keys are noticed.

use std::path::Path;

use isinglass_core::channels::Channels;
use isinglass_core::look::Look;
use isinglass_core::transfer::TransferFunction;
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use super::{
    NamedView, ReadState, SavedCamera, SavedMeasure, SavedState, SavedView, SavedVolume, VERSION, VERSION_KEY,
};
use crate::error::{FormatError, one_line, quoted, shown, syntax_error};
use crate::transfer::{number_literal, text_literal};

/// The whole file. The look is parsed later, because parts of it may be missing.
#[derive(Deserialize, Serialize)]
struct StateFile {
    isinglass_state: i64,
    views: Option<Vec<NamedView>>,
    measures: Option<Vec<SavedMeasure>>,
    volume: Option<SavedVolume>,
    camera: Option<SavedCamera>,
    #[serde(default)]
    view: SavedView,
    look: Option<Table>,
}

impl StateFile {
    fn of(state: &SavedState) -> Self {
        let SavedState { volume, camera, view, look, views, measures } = state.clone();
        let table = |look: Look| {
            let has_channels = look.channels != Channels::default();
            let mut table = Table::try_from(look).expect("a look is a table of numbers and names");
            if !has_channels {
                table.remove("channels");
            }
            table
        };
        let look = look.map(table);
        Self { isinglass_state: VERSION, views, measures, volume, camera, view, look }
    }

    fn table(&self) -> Table {
        Table::try_from(self).expect("a state is a table of numbers and names")
    }
}

pub(super) fn write(state: &SavedState) -> String {
    let mut out = String::new();
    write_table(&mut out, "", &StateFile::of(state).table());
    out
}

/// The state in a text, before its numbers are checked.
pub(super) fn read(text: &str, path: &Path) -> Result<ReadState, FormatError> {
    let problem = |problem: String| FormatError::State { path: shown(path), problem };
    let syntax = syntax_error(path, text);
    let whole: Table = toml::from_str(text).map_err(syntax)?;
    match whole.get(VERSION_KEY) {
        Some(Value::Integer(VERSION)) => {}
        Some(found) => {
            return Err(problem(format!(
                "{VERSION_KEY} is {}, expected {VERSION}; a newer program wrote it",
                quoted(&found.to_string())
            )));
        }
        None => return Err(problem(format!("found no {VERSION_KEY}, expected a saved state"))),
    }
    let mut file: StateFile = toml::from_str(text).map_err(syntax)?;
    let look = file.look.take().map(look_of).transpose().map_err(|e| problem(format!("look: {e}")))?;
    let StateFile { volume, camera, view, views, measures, .. } = file;
    let state = SavedState { volume, camera, view, look, views, measures };
    let mut unknown = Vec::new();
    find_unknown("", &whole, &StateFile::of(&state).table(), &mut unknown);
    let note = (!unknown.is_empty()).then(|| {
        let shown: Vec<_> = unknown.iter().take(MAX_NOTED).map(|key| quoted(key)).collect();
        let more = if unknown.len() > MAX_NOTED { ", …" } else { "" };
        format!("not known here and left out: {}{more}", shown.join(", "))
    });
    Ok(ReadState { state, note })
}

/// The look in a table. Missing fields have the values of [`Look::new`], so that files of older programs remain
/// valid.
fn look_of(table: Table) -> Result<Look, String> {
    let message = |e: toml::de::Error| one_line(e.message());
    let transfer = table.get("transfer").ok_or("found no transfer function, expected look.transfer")?;
    let transfer: TransferFunction = transfer.clone().try_into().map_err(message)?;
    let mut whole = Table::try_from(Look::new(transfer)).map_err(|e| one_line(&e.to_string()))?;
    whole.extend(table);
    Value::Table(whole).try_into().map_err(message)
}

/// Collects the keys of `found` that are not in `known`.
fn find_unknown(at: &str, found: &Table, known: &Table, unknown: &mut Vec<String>) {
    for (key, value) in found {
        let path = if at.is_empty() { key.clone() } else { format!("{at}.{key}") };
        match (value, known.get(key)) {
            (_, None) => unknown.push(path),
            (Value::Table(found), Some(Value::Table(known))) => find_unknown(&path, found, known, unknown),
            (Value::Array(found), Some(Value::Array(known))) => {
                for (i, pair) in found.iter().zip(known).enumerate() {
                    if let (Value::Table(found), Value::Table(known)) = pair {
                        find_unknown(&format!("{path}.{i}"), found, known, unknown);
                    }
                }
            }
            _ => {}
        }
    }
}

/// Writes scalars first, as TOML requires, and then the tables. `at` is the name of the table.
fn write_table(out: &mut String, at: &str, table: &Table) {
    let is_section = |value: &Value| matches!(value, Value::Table(t) if at.is_empty() || t.len() > 1);
    for (key, value) in table.iter().filter(|(_, v)| !is_section(v)) {
        *out += &format!("{} = {}\n", key_literal(key), value_literal(value));
    }
    for (key, value) in table.iter().filter(|(_, v)| is_section(v)) {
        let Value::Table(inner) = value else { continue };
        let name = if at.is_empty() { key_literal(key) } else { format!("{at}.{}", key_literal(key)) };
        *out += &format!("\n[{name}]\n");
        write_table(out, &name, inner);
    }
}

fn value_literal(value: &Value) -> String {
    let list = |items: &[Value]| items.iter().map(value_literal).collect::<Vec<_>>().join(", ");
    match value {
        Value::String(text) => text_literal(text),
        Value::Float(number) if f64::from(*number as f32) == *number => number_literal(*number as f32),
        Value::Float(number) => format!("{number:?}"),
        // Control points have a line each.
        Value::Array(items) if items.iter().any(Value::is_table) => {
            let lines: String = items.iter().map(|item| format!("  {},\n", value_literal(item))).collect();
            format!("[\n{lines}]")
        }
        Value::Array(items) => format!("[{}]", list(items)),
        Value::Table(table) => {
            let pairs =
                table.iter().map(|(key, value)| format!("{} = {}", key_literal(key), value_literal(value)));
            format!("{{ {} }}", pairs.collect::<Vec<_>>().join(", "))
        }
        other => other.to_string(),
    }
}

fn key_literal(key: &str) -> String {
    let is_bare = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    if !key.is_empty() && key.chars().all(is_bare) { key.to_owned() } else { text_literal(key) }
}

/// Most unknown keys in a note.
const MAX_NOTED: usize = 3;
