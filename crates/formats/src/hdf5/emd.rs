//! Microscopy data of electron microscopes: EMD of Berkeley (NCEM, py4DSTEM), EMD of Velox, and HyperSpy.

use std::ops::Range;

use serde_json::Value;

use super::contents::{ArrayFile, Listed};
use super::dialects::plain_unit;
use super::storage::Storage;
use crate::cf::{Coordinates, Unit, kind_of_name};
use crate::plan::AxisKind;

/// The axes of an array that one of these programs wrote.
pub(super) fn axes(contents: &ArrayFile, array: &Listed) -> Option<Vec<Coordinates>> {
    match array.name() {
        "Data" if is_velox(array) => velox_axes(contents, array),
        "data" => berkeley_axes(contents, array).or_else(|| hyperspy_axes(contents, array)),
        _ => None,
    }
}

/// Whether an array has descriptions of others as bytes.
pub(super) fn is_description(array: &Listed) -> bool {
    array.path.starts_with("/Data/") && array.name() == "Metadata"
}

fn is_velox(array: &Listed) -> bool {
    array.path.starts_with("/Data/Image/") && array.shape.len() == 3
}

/// The axes of Berkeley's format: an array of coordinates for each, numbered from 1, or from 0 since its version 1.
fn berkeley_axes(contents: &ArrayFile, array: &Listed) -> Option<Vec<Coordinates>> {
    let group = array.folder();
    contents.attributes(group).filter(|a| a.has("emd_group_type"))?;
    let first = usize::from(contents.array(&format!("{group}/dim0")).is_err());
    let axis = |(i, length): (usize, &u64)| {
        let path = format!("{group}/dim{}", i + first);
        let attributes = contents.attributes(&path);
        let text = |name: &str| attributes.as_ref().and_then(|a| a.text(name)).unwrap_or_default();
        let mut axis = Coordinates::told(kind_of_name(text("name").trim()), None, plain_unit(&text("units")));
        match contents.numbers(&path).as_deref() {
            // Two of them stand for all.
            Some([at, next]) => axis.set_numbers(&[*at, *next]),
            Some(numbers) if numbers.len() as u64 == *length => axis.set_numbers(numbers),
            _ => {}
        }
        axis
    };
    Some(array.shape.iter().enumerate().map(axis).collect())
}

/// The axes of HyperSpy: a group for each.
fn hyperspy_axes(contents: &ArrayFile, array: &Listed) -> Option<Vec<Coordinates>> {
    let axis = |i: usize| {
        let found = contents.attributes(&format!("{}/axis-{i}", array.folder()))?;
        let step = found.number("scale");
        let line = step.map(|step| (found.number("offset").unwrap_or(0.0), step));
        let unit = found.text("units").map_or(Unit::None, |text| plain_unit(&text));
        let kind = found.text("name").and_then(|name| kind_of_name(name.trim())).or(match unit {
            Unit::Time(_) => Some(AxisKind::Time),
            _ => None,
        });
        Some(Coordinates::told(kind, line, unit))
    };
    (0..array.shape.len()).map(axis).collect()
}

/// The axes of Velox: rows, columns and frames, with a description of each frame as text.
fn velox_axes(contents: &ArrayFile, array: &Listed) -> Option<Vec<Coordinates>> {
    let told = velox_description(contents, array.folder()).unwrap_or(Value::Null);
    let number = |value: &Value| value.as_f64().or_else(|| value.as_str()?.trim().parse().ok());
    let result = &told["BinaryResult"];
    let is_length = result["PixelUnitX"].as_str() == Some("m");
    let axis = |space: usize, name: &str| {
        let step = number(&result["PixelSize"][name]).filter(|step| is_length && *step > 0.0);
        let line = step.map(|step| (0.0, step / NANOMETRE));
        Coordinates::told(Some(AxisKind::Space(space)), line, Unit::Length(NANOMETRE, "nm"))
    };
    let seconds = number(&told["Scan"]["FrameTime"]).map(|step| (0.0, step));
    let frames = Coordinates::told(Some(AxisKind::Time), seconds, Unit::Time(1.0));
    Some(vec![axis(1, "height"), axis(0, "width"), frames])
}

/// The description of the first frame.
fn velox_description(contents: &ArrayFile, group: &str) -> Option<Value> {
    let array = contents.array(&format!("{group}/Metadata")).ok()?;
    let storage = Storage::of(contents, &array, MAX_TEXT_BYTES).ok()?;
    let ranges: Vec<Range<u64>> = match array.shape[..] {
        [length, _] => vec![0..length, 0..1],
        _ => return None,
    };
    let bytes: Vec<u8> = storage.numbers(&ranges).ok()?.into_iter().map(|x| x as u8).collect();
    let end = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
    serde_json::from_slice(&bytes[..end]).ok()
}

const NANOMETRE: f64 = 1e-9;
/// Largest chunk of a description.
const MAX_TEXT_BYTES: u64 = 16 << 20;
