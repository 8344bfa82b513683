//! Reads metadata files.

use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::Value;

use super::store::{Part, Store};
use crate::cf::AttributeList;
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

/// The attributes of the group in the folder `path`, in which those of OME-Zarr 0.5 and up lie deeper; `None` if there
/// are none.
pub(super) fn attributes(store: &Store, path: &Path) -> Result<Option<Value>, FormatError> {
    match read(store, &path.join("zarr.json"))? {
        Some(value) => Ok(attributes_in(&value)),
        None => read(store, &path.join(".zattrs")),
    }
}

/// The same in the document of a group of version 3.
pub(super) fn attributes_in(group: &Value) -> Option<Value> {
    group.get("attributes").and_then(|all| all.get("ome").or(Some(all))).cloned()
}

/// The attributes of the array in the folder `path`, of this version of Zarr; null if there are none.
pub(super) fn attributes_of_array(store: &Store, path: &Path, version: u8) -> Result<Value, FormatError> {
    let found = match version {
        3 => read(store, &path.join("zarr.json"))?.and_then(|all| all.get("attributes").cloned()),
        _ => read(store, &path.join(".zattrs"))?,
    };
    Ok(found.unwrap_or_default())
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

impl AttributeList for Value {
    fn numbers(&self, name: &str) -> Vec<f64> {
        // xarray writes the eight bytes of a float in base64, because some have no digits.
        let of_text = |text: &str| {
            let bytes = STANDARD.decode(text).ok()?;
            Some(f64::from_le_bytes(bytes.try_into().ok()?))
        };
        let number = |value: &Value| value.as_f64().or_else(|| of_text(value.as_str()?));
        match self.get(name) {
            Some(Value::Array(list)) => list.iter().filter_map(number).collect(),
            Some(value) => number(value).into_iter().collect(),
            None => Vec::new(),
        }
    }

    fn text(&self, name: &str) -> Option<String> {
        match self.get(name)? {
            Value::Bool(is_true) => Some(is_true.to_string()),
            value => value.as_str().map(str::to_owned),
        }
    }

    fn has_floats(&self, name: &str) -> bool {
        let is_float = |value: &Value| value.is_f64() || value.is_string();
        self.get(name)
            .is_some_and(|value| value.as_array().map_or(is_float(value), |list| list.iter().any(is_float)))
    }
}

/// Longest document. Attributes of thousands of channels or wells are shorter.
const MAX_BYTES: u64 = 16 << 20;
