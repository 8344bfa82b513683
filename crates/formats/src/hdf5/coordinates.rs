//! What the axes of an array are, and where its numbers lie: names and lengths that ilastik, Fiji, h5py and netCDF write.

use serde_json::Value;

use super::contents::{ArrayFile, Attributes, Listed};
use super::storage::Storage;
use crate::plan::AxisKind;
use crate::units::{length_unit, time_unit};

/// An axis of an array.
#[derive(Clone, Debug, Default)]
pub(super) struct Coordinates {
    /// What it is, if the file tells.
    pub(super) kind: Option<AxisKind>,
    /// The coordinate of the first number, and the distance of the next, which may be less than zero.
    pub(super) line: Option<(f64, f64)>,
    pub(super) unit: Unit,
    /// Whether the distances differ.
    pub(super) is_uneven: bool,
    /// Whether the axis is one of the earth, such as latitude, height or depth.
    is_of_earth: bool,
}

/// The unit of coordinates.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) enum Unit {
    #[default]
    None,
    /// A length in metres, and its short name.
    Length(f64, &'static str),
    /// A time in seconds.
    Time(f64),
    /// Another one, such as degrees.
    Other(String),
}

/// The arrays of a file that are coordinates of others.
pub(super) struct Scales<'a>(Vec<&'a Listed>);

impl<'a> Scales<'a> {
    pub(super) fn of(all: &'a [Listed]) -> Self {
        let is_scale = |a: &&Listed| {
            a.shape.len() == 1 && a.attributes.text("CLASS").as_deref() == Some("DIMENSION_SCALE")
        };
        Self(all.iter().filter(is_scale).take(MAX_SCALES).collect())
    }

    /// Whether netCDF wrote them.
    pub(super) fn are_of_netcdf(&self) -> bool {
        self.0.iter().any(|a| a.attributes.number("_Netcdf4Dimid").is_some())
    }
}

/// The axes of `array`, the slowest first. Coordinates are read only from `contents`.
pub(super) fn of_array(contents: Option<&ArrayFile>, array: &Listed, scales: &Scales) -> Vec<Coordinates> {
    if let Some(told) = &array.told {
        return told.clone();
    }
    let mut axes = vec![Coordinates::default(); array.shape.len()];
    set_names(&mut axes, &array.attributes);
    set_tags(&mut axes, &array.attributes);
    for (axis, scale) in scales.of_axes(array).into_iter().enumerate() {
        let Some(scale) = scale else { continue };
        axes[axis].set_scale(contents, scale);
    }
    set_element_size(&mut axes, &array.attributes);
    axes
}

/// Whether the axes in space are of the earth, where y and z point up.
pub(super) fn are_of_earth(axes: &[Coordinates]) -> bool {
    axes.iter().any(|axis| axis.is_of_earth)
}

/// The names of h5py: `DIMENSION_LABELS`.
fn set_names(axes: &mut [Coordinates], attributes: &Attributes) {
    let names = attributes.texts("DIMENSION_LABELS");
    if names.len() == axes.len() {
        axes.iter_mut().zip(names).for_each(|(axis, name)| axis.kind = kind_of_name(name));
    }
}

/// The names of ilastik and vigra: `axistags`, with steps that are zero if they are not known.
fn set_tags(axes: &mut [Coordinates], attributes: &Attributes) {
    let tags: Option<Value> = attributes.text("axistags").and_then(|text| serde_json::from_str(&text).ok());
    let Some(list) = tags.as_ref().and_then(|tags| tags["axes"].as_array()) else { return };
    if list.len() != axes.len() {
        return;
    }
    for (axis, tag) in axes.iter_mut().zip(list) {
        axis.kind = tag["key"].as_str().and_then(kind_of_name);
        let step = tag["resolution"].as_f64().filter(|step| *step > 0.0 && step.is_finite());
        axis.line = step.filter(|_| matches!(axis.kind, Some(AxisKind::Space(_)))).map(|step| (0.0, step));
    }
}

/// The steps of ilastik and Fiji: `element_size_um`, in micrometres along the last three axes in space.
fn set_element_size(axes: &mut [Coordinates], attributes: &Attributes) {
    let steps = attributes.numbers("element_size_um");
    let is_good = |steps: &[f64]| steps.iter().all(|step| *step > 0.0 && step.is_finite());
    if !matches!(steps.len(), 2 | 3) || !is_good(&steps) {
        return;
    }
    let is_named = axes.iter().any(|axis| axis.kind.is_some());
    let in_space =
        axes.iter_mut().rev().filter(|axis| !is_named || matches!(axis.kind, Some(AxisKind::Space(_))));
    for (axis, step) in in_space.zip(steps.iter().rev()) {
        (axis.line, axis.unit) = (Some((0.0, *step)), Unit::Length(1e-6, "µm"));
    }
}

impl Scales<'_> {
    /// The array of coordinates of each axis, as far as there are such. NetCDF numbers its dimensions. Otherwise, a
    /// scale of the same group belongs to the axis of its length, if no other has this length.
    fn of_axes(&self, array: &Listed) -> Vec<Option<&Listed>> {
        let numbers = array.attributes.numbers("_Netcdf4Coordinates");
        if numbers.len() == array.shape.len() {
            let numbered = |id: &f64, length: &u64| {
                let is_it =
                    |a: &&&Listed| a.attributes.number("_Netcdf4Dimid") == Some(*id) && a.shape[0] == *length;
                self.0.iter().find(is_it).copied()
            };
            return numbers.iter().zip(&array.shape).map(|(id, length)| numbered(id, length)).collect();
        }
        let folder = |a: &Listed| a.path.rsplit_once('/').map(|(folder, _)| folder.to_owned());
        let own = folder(array);
        let alone = |length: &u64| {
            let mut with_length = self.0.iter().filter(|a| a.shape[0] == *length && folder(a) == own);
            let is_alone = array.shape.iter().filter(|n| *n == length).count() == 1;
            with_length.next().filter(|_| is_alone && with_length.next().is_none()).copied()
        };
        array.shape.iter().map(alone).collect()
    }
}

impl Coordinates {
    fn set_scale(&mut self, contents: Option<&ArrayFile>, scale: &Listed) {
        let name = scale.path.rsplit('/').next().unwrap_or_default();
        let words =
            ["standard_name", "axis", "long_name"].map(|key| scale.attributes.text(key).unwrap_or_default());
        let kind = [name].into_iter().chain(words.iter().map(String::as_str)).find_map(kind_of_name);
        self.kind = self.kind.or(kind);
        let unit = scale.attributes.text("units").unwrap_or_default();
        self.unit = unit_of(&unit);
        // A dimension without coordinates says so in its name, and its numbers are not stored.
        let is_empty = scale.attributes.text("NAME").is_some_and(|name| name.starts_with(NO_VARIABLE));
        let Some(contents) = contents else { return };
        let storage = Storage::of(contents, scale, MAX_SCALE_BYTES);
        let Some(numbers) = storage.and_then(|s| s.all_numbers()).ok().filter(|_| !is_empty) else { return };
        self.is_of_earth = EARTH.contains(&name.to_lowercase().as_str()) || unit.starts_with("degrees_");
        self.set_numbers(&numbers);
    }

    /// Takes the coordinates of all numbers along the axis.
    pub(super) fn set_numbers(&mut self, numbers: &[f64]) {
        let [first, .., last] = numbers[..] else { return };
        let step = (last - first) / (numbers.len() - 1) as f64;
        if !step.is_finite() || step == 0.0 {
            return;
        }
        self.line = Some((first, step));
        // Coordinates in single precision differ by their last digits.
        let tolerance = (step.abs() * UNEVEN).max(first.abs().max(last.abs()) * SINGLE);
        self.is_uneven = numbers.windows(2).any(|pair| ((pair[1] - pair[0]) - step).abs() > tolerance);
    }

    /// What a program tells of an axis: what it is, its first coordinate and its step, and their unit.
    pub(super) fn told(kind: Option<AxisKind>, line: Option<(f64, f64)>, unit: Unit) -> Self {
        let line = line.filter(|(at, step)| at.is_finite() && step.is_finite() && *step != 0.0);
        Self { kind, line, unit, ..Self::default() }
    }

    /// The same where y and z point up, as they do in space.
    pub(super) fn in_space(self) -> Self {
        Self { is_of_earth: true, ..self }
    }

    /// Seconds from one point in time to the next.
    pub(super) fn seconds(&self) -> Option<f64> {
        match (&self.unit, self.line) {
            (Unit::Time(unit), Some((_, step))) => Some(step * unit),
            _ => None,
        }
    }
}

pub(super) fn kind_of_name(name: &str) -> Option<AxisKind> {
    Some(match name.to_lowercase().as_str() {
        "x" | "lon" | "longitude" | "projection_x_coordinate" | "nx" => AxisKind::Space(0),
        "y" | "lat" | "latitude" | "projection_y_coordinate" | "ny" => AxisKind::Space(1),
        "z" | "lev" | "level" | "depth" | "height" | "altitude" | "plev" | "pressure" | "nz" => {
            AxisKind::Space(2)
        }
        "t" | "time" => AxisKind::Time,
        "c" | "channel" | "channels" | "band" => AxisKind::Channel,
        _ => return None,
    })
}

pub(super) fn unit_of(text: &str) -> Unit {
    let text = text.trim();
    // Times have a beginning, such as `hours since 2000-01-01`.
    let first = text.split_whitespace().next().unwrap_or_default();
    match (length_unit(text), time_unit(first)) {
        (Some((metres, name)), _) => Unit::Length(metres, name),
        (None, Some(seconds)) => Unit::Time(seconds),
        _ if ["", "1", "pixel", "pixels", "index", "none"].contains(&text) => Unit::None,
        _ if text.starts_with("degree") => Unit::Other("degrees".into()),
        _ => Unit::Other(text.to_owned()),
    }
}

/// Most arrays of coordinates.
const MAX_SCALES: usize = 1024;
/// How netCDF names a dimension without coordinates.
const NO_VARIABLE: &str = "This is a netCDF dimension but not a netCDF variable";
/// Names of axes that point north and up.
const EARTH: [&str; 8] = ["lat", "latitude", "lon", "longitude", "lev", "level", "height", "altitude"];
/// Largest chunk of coordinates.
const MAX_SCALE_BYTES: u64 = 16 << 20;
/// Distances that differ by less than this part of their mean are even.
const UNEVEN: f64 = 0.01;
/// The last digit of single precision, twice.
const SINGLE: f64 = 2.4e-7;
