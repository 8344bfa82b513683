//! What the axes of an array are, and where its numbers lie: names and lengths that ilastik, Fiji, h5py and netCDF write.

use serde_json::Value;

use super::contents::{ArrayFile, Attributes, Listed};
use super::storage::Storage;
use crate::cf::{AttributeList, Coordinates, Unit, Variable, Variables, kind_of_name};
use crate::plan::AxisKind;

/// The arrays of a file, and which of them are coordinates of others.
pub(super) struct Scales<'a> {
    /// The arrays that are variables.
    arrays: Vec<&'a Listed>,
    variables: Variables<'a>,
    is_of_netcdf: bool,
}

impl<'a> Scales<'a> {
    pub(super) fn of(all: &[&'a Listed]) -> Self {
        let is_scale = |a: &&Listed| {
            a.shape.len() == 1 && a.attributes.text("CLASS").as_deref() == Some("DIMENSION_SCALE")
        };
        let mut scales: Vec<DimensionScale> =
            all.iter().copied().filter(is_scale).take(MAX_SCALES).map(DimensionScale::of).collect();
        scales.sort_by_key(|scale| scale.number);
        let is_of_netcdf = scales.iter().any(|scale| scale.number.is_some());
        let arrays: Vec<&Listed> = all.iter().copied().filter(|a| !is_placeholder(a)).collect();
        let variable = |array: &&'a Listed| Variable {
            path: array.path.clone(),
            dims: dims(array, &scales),
            shape: array.shape.clone(),
            attributes: &array.attributes,
        };
        let variables = Variables::new(arrays.iter().map(variable).collect(), is_of_netcdf);
        Self { arrays, variables, is_of_netcdf }
    }

    /// Whether netCDF wrote them.
    pub(super) fn are_of_netcdf(&self) -> bool {
        self.is_of_netcdf
    }

    /// Whether an array describes others, as bounds of coordinates do.
    pub(super) fn is_auxiliary(&self, array: &Listed) -> bool {
        self.variables.index_of(&array.path).is_some_and(|i| self.variables.is_auxiliary(i))
    }
}

/// An array of coordinates.
struct DimensionScale<'a> {
    array: &'a Listed,
    folder: &'a str,
    /// The number of its dimension in netCDF.
    number: Option<i64>,
}

impl<'a> DimensionScale<'a> {
    fn of(array: &'a Listed) -> Self {
        let number = array.attributes.number("_Netcdf4Dimid").map(|number| number as i64);
        Self { array, folder: array.folder(), number }
    }
}

/// Whether an array stands for a dimension without coordinates. It says so in its name, and its numbers are not stored.
fn is_placeholder(array: &Listed) -> bool {
    array.shape.len() == 1 && array.attributes.text("NAME").is_some_and(|name| name.starts_with(NO_VARIABLE))
}

/// The paths of the scales of each axis, as far as there are such. NetCDF numbers its dimensions. Otherwise, a scale of
/// the same group, or of netCDF one above it, belongs to the axis of its length.
fn dims(array: &Listed, scales: &[DimensionScale]) -> Vec<Option<String>> {
    let path = |scale: &DimensionScale| scale.array.path.clone();
    let numbers = array.attributes.numbers("_Netcdf4Coordinates");
    if numbers.len() == array.shape.len() {
        let numbered = |(number, length): (&f64, &u64)| {
            // A dimension that may grow has no numbers of its own, and the length that it had at first.
            let fits = |s: &DimensionScale| s.array.shape[0] == *length || is_placeholder(s.array);
            let is_it = |s: &&DimensionScale| s.number == Some(*number as i64) && fits(s);
            scales.iter().find(is_it).map(path)
        };
        return numbers.iter().zip(&array.shape).map(numbered).collect();
    }
    let own = array.folder();
    if scales.iter().any(|scale| scale.array.path == array.path) {
        return vec![Some(array.path.clone())];
    }
    let is_near = |s: &&DimensionScale| {
        s.folder == own
            || (s.number.is_some() && own.starts_with(s.folder) && !s.folder.is_empty())
            || (s.number.is_some() && s.folder.is_empty())
    };
    let near: Vec<&DimensionScale> = scales.iter().filter(is_near).collect();
    let with_length = |length: u64| near.iter().filter(move |s| s.array.shape[0] == length);
    let is_alone = |length: &u64| {
        array.shape.iter().filter(|n| *n == length).count() == 1 && with_length(*length).count() == 1
    };
    if !array.shape.iter().all(is_alone)
        && let Some(found) = in_order(&array.shape, &near)
    {
        return found;
    }
    let alone = |length: &u64| with_length(*length).next().filter(|_| is_alone(length)).map(|s| path(s));
    array.shape.iter().map(alone).collect()
}

/// The scales of netCDF for axes of these lengths, if only one choice has them in the order of their numbers.
fn in_order(shape: &[u64], scales: &[&DimensionScale]) -> Option<Vec<Option<String>>> {
    let numbered: Vec<&&DimensionScale> = scales.iter().filter(|s| s.number.is_some()).collect();
    if shape.len() > 8 || numbered.is_empty() {
        return None;
    }
    // One choice takes each scale as early as it can, and the other one as late as it can. They are the same if there
    // is only one.
    let early = taken(shape.iter(), numbered.iter());
    let mut late = taken(shape.iter().rev(), numbered.iter().rev());
    late.reverse();
    (early == late && early.iter().all(Option::is_some)).then_some(early)
}

/// For each length the next scale that has it.
fn taken<'a>(
    lengths: impl Iterator<Item = &'a u64>,
    mut scales: impl Iterator<Item = &'a &'a &'a DimensionScale<'a>>,
) -> Vec<Option<String>> {
    let next = |length: &u64| scales.find(|s| s.array.shape[0] == *length).map(|s| s.array.path.clone());
    lengths.map(next).collect()
}

/// The axes of `array`, the slowest first. Coordinates are read only from `contents`.
pub(super) fn of_array(contents: Option<&ArrayFile>, array: &Listed, scales: &Scales) -> Vec<Coordinates> {
    if let Some(told) = &array.told {
        return told.clone();
    }
    let mut axes = vec![Coordinates::default(); array.shape.len()];
    set_names(&mut axes, &array.attributes);
    set_tags(&mut axes, &array.attributes);
    let all = contents.and_then(|contents| contents.attributes("/"));
    let numbers = |i: usize| {
        let storage = Storage::of(contents?, scales.arrays[i], MAX_SCALE_BYTES);
        storage.and_then(|s| s.all_numbers()).ok()
    };
    if let Some(index) = scales.variables.index_of(&array.path) {
        let all = all.as_ref().map(|all| &**all as &dyn AttributeList);
        let numbers: Option<&dyn Fn(usize) -> Option<Vec<f64>>> = contents.is_some().then_some(&numbers);
        for (axis, found) in axes.iter_mut().zip(scales.variables.axes_of(index, numbers, all)) {
            let (kind, line) = (axis.kind.or(found.kind), found.line.or(axis.line));
            *axis = Coordinates { kind, line, ..found };
        }
    }
    set_element_size(&mut axes, &array.attributes);
    axes
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

/// Most arrays of coordinates.
const MAX_SCALES: usize = 1024;
/// How netCDF names a dimension without coordinates.
const NO_VARIABLE: &str = "This is a netCDF dimension but not a netCDF variable";
/// Largest chunk of coordinates.
const MAX_SCALE_BYTES: u64 = 16 << 20;
