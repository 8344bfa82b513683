//! ImageJ's description of a hyperstack: lines of `name=value`.

use super::{PlaneAxis, Stack};
use crate::plan::unit_of_values;

/// Whether a description is ImageJ's.
pub(super) fn is_imagej(text: &str) -> bool {
    text.starts_with("ImageJ=")
}

/// What it says. `resolution`: pixels per unit along x and y.
pub(super) fn stack(text: &str, resolution: &[Option<f64>; 2]) -> Stack {
    let get =
        |name: &str| text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix('=')).map(str::trim);
    let count = |name: &str| get(name).and_then(|v| v.parse::<u64>().ok()).unwrap_or(1).max(1);
    let [images, channels, slices, frames] = ["images", "channels", "slices", "frames"].map(count);
    let number = |name: &str| get(name).and_then(|v| v.parse::<f64>().ok()).filter(|v| v.is_finite());
    // A stack without hyperstack fields is one of slices.
    let slices = if channels.saturating_mul(slices).saturating_mul(frames) == 1 { images } else { slices };
    let unit = match get("unit").unwrap_or_default() {
        "micron" | "microns" | "um" | "µm" | "μm" | "\\u00B5m" => Some("µm"),
        "" | "pixel" | "pixels" => None,
        "millimeter" | "mm" => Some("mm"),
        "nanometer" | "nm" => Some("nm"),
        "cm" | "centimeter" => Some("cm"),
        _ => Some(""),
    };
    let in_plane = |i: usize| unit.and(resolution[i]).map(|pixels| 1.0 / pixels);
    // A negative spacing marks a stack whose slices were taken downwards.
    let depth = unit.and(get("spacing")).and_then(|v| v.parse::<f64>().ok()).map(f64::abs);
    Stack {
        axes: vec![(PlaneAxis::Channel, channels), (PlaneAxis::Z, slices), (PlaneAxis::Time, frames)],
        spacing: [in_plane(0), in_plane(1), depth],
        unit: unit.filter(|u| !u.is_empty()).map(str::to_owned),
        channel_names: Vec::new(),
        planes: None,
        other_files: Vec::new(),
        series: Vec::new(),
        value_map: value_map(get("cf"), number("c1"), number("c0")),
        value_unit: get("vunit").filter(|_| get("cf") == Some("0")).and_then(unit_of_values),
        name: "ImageJ TIFF",
    }
}

/// Of a calibration by a straight line; others are left out. Signed integers are stored as unsigned ones with one.
fn value_map(function: Option<&str>, slope: Option<f64>, intercept: Option<f64>) -> (f64, f64) {
    match (function, slope, intercept) {
        (Some("0"), Some(slope), Some(intercept)) if slope != 0.0 => (slope, intercept),
        _ => (1.0, 0.0),
    }
}
