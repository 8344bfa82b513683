//! The variables of a file, and which of them are coordinates of others.

use std::collections::{HashMap, HashSet};

use super::names::AxisWords;
use super::{AttributeList, Coordinates, Unit};
use crate::plan::AxisKind;

/// An array whose dimensions have names.
pub(crate) struct Variable<'a> {
    /// Its path in the file. A dimension with this path has it as its coordinates.
    pub(crate) path: String,
    /// The paths of its dimensions, the slowest first; `None` if one has no name.
    pub(crate) dims: Vec<Option<String>>,
    pub(crate) shape: Vec<u64>,
    pub(crate) attributes: &'a dyn AttributeList,
}

/// The variables of a file.
pub(crate) struct Variables<'a> {
    list: Vec<Variable<'a>>,
    by_path: HashMap<String, usize>,
    /// Variables along one dimension only, and those along two.
    along: HashMap<String, Vec<usize>>,
    planes: Vec<usize>,
    /// The names of variables that describe others.
    auxiliary: HashSet<String>,
    /// Whether names such as `depth` are those of the earth.
    is_geo: bool,
}

/// What reads all numbers of a short variable, by its place in the list, the last axis fastest.
pub(crate) type ReadNumbers<'a> = &'a dyn Fn(usize) -> Option<Vec<f64>>;

impl<'a> Variables<'a> {
    pub(crate) fn new(list: Vec<Variable<'a>>, is_geo: bool) -> Self {
        let by_path = list.iter().enumerate().map(|(i, variable)| (variable.path.clone(), i)).collect();
        let mut along: HashMap<String, Vec<usize>> = HashMap::new();
        let (mut planes, mut auxiliary) = (Vec::new(), HashSet::new());
        for (i, variable) in list.iter().enumerate() {
            match &variable.dims[..] {
                [Some(dim)] if *dim != variable.path => along.entry(dim.clone()).or_default().push(i),
                [Some(_), Some(_)] if planes.len() < MAX_PLANES => planes.push(i),
                _ => {}
            }
            for (key, has_terms) in DESCRIBING {
                let text = variable.attributes.text(key).unwrap_or_default();
                // A term has a name of its own before that of the variable.
                let words = text.split_whitespace().filter(|word| !has_terms || !word.ends_with(':'));
                auxiliary.extend(words.map(str::to_owned));
            }
        }
        Self { list, by_path, along, planes, auxiliary, is_geo }
    }

    /// The place of the variable at `path`.
    pub(crate) fn index_of(&self, path: &str) -> Option<usize> {
        self.by_path.get(path).copied()
    }

    /// Whether a variable describes others: its own dimension, or their coordinates, bounds or areas.
    pub(crate) fn is_auxiliary(&self, index: usize) -> bool {
        let variable = &self.list[index];
        self.auxiliary.contains(last_part(&variable.path)) && variable.dims.iter().any(Option::is_some)
    }

    /// The axes of a variable, the slowest first. Without `numbers`, they have no coordinates. `all` are the attributes
    /// of the file.
    pub(crate) fn axes_of(
        &self,
        index: usize,
        numbers: Option<ReadNumbers>,
        all: Option<&dyn AttributeList>,
    ) -> Vec<Coordinates> {
        let variable = &self.list[index];
        let named = variable.attributes.text("coordinates").unwrap_or_default();
        let named: Vec<&str> = named.split_whitespace().take(MAX_NAMED).collect();
        let axis = |dim: &Option<String>| match dim {
            Some(dim) => self.axis(dim, &named, numbers, all),
            None => Coordinates::default(),
        };
        let mut axes: Vec<Coordinates> = variable.dims.iter().map(axis).collect();
        self.set_planes(variable, &mut axes, numbers);
        axes
    }

    /// The axis of a dimension. `named` are the coordinates that its variable names.
    fn axis(
        &self,
        dim: &str,
        named: &[&str],
        numbers: Option<ReadNumbers>,
        all: Option<&dyn AttributeList>,
    ) -> Coordinates {
        let name = last_part(dim);
        let own = self.index_of(dim).filter(|i| self.list[*i].shape.len() == 1);
        let Some(source) = own.or_else(|| self.other_along(dim, named)) else {
            let mut axis = Coordinates::of(name, None, self.is_geo);
            if let Some(step) = step_of_wrf(name, all) {
                (axis.line, axis.unit) = (Some((0.0, step)), Unit::Length(1.0, "m"));
            }
            return axis;
        };
        let attributes = self.list[source].attributes;
        let mut axis = Coordinates::of(name, Some(attributes), self.is_geo);
        if let Some(found) = numbers.and_then(|read| read(source)) {
            axis.set_variable(found, attributes.text("positive").is_some());
        }
        axis
    }

    /// A variable with the coordinates of a dimension that has none of its name. Either a variable names it, or it has
    /// the letter of an axis, or it is of the kind that the dimension's name tells.
    fn other_along(&self, dim: &str, named: &[&str]) -> Option<usize> {
        let by_name = AxisWords::of(last_part(dim), None).kind;
        let others = self.along.get(dim)?;
        let is_it = |i: &&usize| {
            let variable = &self.list[**i];
            let kind = AxisWords::of("", Some(variable.attributes)).kind;
            let is_told =
                named.contains(&last_part(&variable.path)) || variable.attributes.text("axis").is_some();
            kind.is_some() && (kind == by_name || (is_told && by_name.is_none()))
        };
        others.iter().find(is_it).copied()
    }

    /// Takes longitudes and latitudes that have two dimensions: the row and the column in the middle tell the axes.
    fn set_planes(&self, variable: &Variable, axes: &mut [Coordinates], numbers: Option<ReadNumbers>) {
        for &plane in &self.planes {
            let found = &self.list[plane];
            let place = |dim: &Option<String>| variable.dims.iter().position(|own| own == dim);
            let (Some(rows), Some(columns)) = (place(&found.dims[0]), place(&found.dims[1])) else {
                continue;
            };
            let words = AxisWords::of(last_part(&found.path), Some(found.attributes));
            let (at, kind, has_row) = match words.kind.filter(|_| words.is_of_earth && rows != columns) {
                Some(AxisKind::Space(0)) => (columns, AxisKind::Space(0), true),
                Some(AxisKind::Space(1)) => (rows, AxisKind::Space(1), false),
                _ => continue,
            };
            let is_other = axes.iter().enumerate().any(|(i, axis)| i != at && axis.kind == Some(kind));
            let axis = &mut axes[at];
            if axis.line.is_some() || axis.kind.is_some_and(|own| own != kind) || is_other {
                continue;
            }
            axis.kind = Some(kind);
            axis.is_of_earth = true;
            let (num_rows, num_columns) = (found.shape[0] as usize, found.shape[1] as usize);
            let Some(all) = numbers.and_then(|read| read(plane)) else { continue };
            if all.len() != num_rows * num_columns || all.is_empty() {
                continue;
            }
            let line: Vec<f64> = match has_row {
                true => all[num_rows / 2 * num_columns..][..num_columns].to_vec(),
                false => all.iter().skip(num_columns / 2).step_by(num_columns).copied().collect(),
            };
            axis.unit = super::unit_of("degrees");
            axis.set_variable(line, false);
        }
    }
}

/// The last part of a path in a file.
fn last_part(path: &str) -> &str {
    path.rsplit('/').next().unwrap_or_default()
}

/// The distance of points that WRF writes for all of a file, metres.
fn step_of_wrf(name: &str, all: Option<&dyn AttributeList>) -> Option<f64> {
    let key = match name {
        "west_east" | "west_east_stag" => "DX",
        "south_north" | "south_north_stag" => "DY",
        _ => return None,
    };
    all?.numbers(key).first().copied().filter(|step| step.is_finite() && *step > 0.0)
}

/// Attributes that name variables which describe others, and whether a term is before each name.
const DESCRIBING: [(&str, bool); 7] = [
    ("coordinates", false),
    ("bounds", false),
    ("climatology", false),
    ("ancillary_variables", false),
    ("grid_mapping", true),
    ("cell_measures", true),
    ("formula_terms", true),
];
/// Most variables with two dimensions that are looked at, and most names of coordinates.
const MAX_PLANES: usize = 256;
const MAX_NAMED: usize = 64;
