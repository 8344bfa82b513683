//! Reads metadata files.

use std::path::Path;

use serde_json::Value;

use super::store::{Part, Store};
use crate::error::{FormatError, io_error, malformed, quoted};

/// Reads the document at `path`; `None` if there is no such file.
pub(super) fn read(store: &Store, path: &Path) -> Result<Option<Value>, FormatError> {
    let bad = malformed(path, "Zarr metadata");
    let Some((bytes, _)) = store.read(path, Part::Whole, MAX_BYTES)? else { return Ok(None) };
    serde_json::from_slice(&bytes).map(Some).map_err(|e| bad(quoted(&e.to_string())))
}

/// The same for a file that must exist.
pub(super) fn require(store: &Store, path: &Path) -> Result<Value, FormatError> {
    let missing = || io_error(path)(std::io::ErrorKind::NotFound.into());
    read(store, path)?.ok_or_else(missing)
}

/// A list of positive integers.
pub(super) fn numbers(value: Option<&Value>, name: &str) -> Result<Vec<u64>, String> {
    let list = value.and_then(Value::as_array).filter(|l| l.len() <= 32);
    let numbers: Option<Vec<u64>> =
        list.and_then(|l| l.iter().map(|v| v.as_u64().filter(|n| *n > 0)).collect());
    numbers.ok_or_else(|| {
        format!(
            "{name} is {}, expected numbers above zero",
            quoted(&value.unwrap_or(&Value::Null).to_string())
        )
    })
}

/// Longest document. Attributes of thousands of channels or wells are shorter.
const MAX_BYTES: u64 = 16 << 20;
