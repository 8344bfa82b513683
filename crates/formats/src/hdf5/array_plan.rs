//! The plan of one array.

use glam::DVec3;

use super::contents::{ArrayFile, FORMAT, Listed};
use super::coordinates::{self, Coordinates, Scales, Unit};

use crate::axes::{Geometry, World};
use crate::error::one_line;
use crate::padding::Missing;
use crate::plan::{Axis, AxisKind, Plan, Role};
use crate::units::{time_step, value_unit};
use crate::warning::WarningKind;

/// Voxels of `array` along its axes in space. The error says why it is no volume.
pub(super) fn sizes(array: &Listed, scales: &Scales) -> Result<Vec<u64>, String> {
    array.kind.as_ref().map_err(|found| format!("{} has {found}, expected numbers", array.description()))?;
    let (kinds, _) = kinds(&array.shape, &coordinates::of_array(None, array, scales));
    let kinds = kinds.ok_or_else(|| other_axes(array))?;
    let is_space = |kind: &Option<AxisKind>| matches!(kind, Some(AxisKind::Space(_)));
    Ok(array.shape.iter().zip(&kinds).filter(|(_, kind)| is_space(kind)).map(|(n, _)| *n).collect())
}

fn other_axes(array: &Listed) -> String {
    format!("{} has other axes, expected two or three in space, and channels and times", array.description())
}

/// The plan of `array`.
pub(super) fn plan(contents: &ArrayFile, array: &Listed, scales: &Scales) -> Result<Plan, String> {
    let (dtype, endian) = array.kind.clone()?;
    let found = coordinates::of_array(Some(contents), array, scales);
    let (kinds, is_guess) = kinds(&array.shape, &found);
    let kinds = kinds.ok_or_else(|| other_axes(array))?;
    let mut axes: Vec<Axis> = Vec::new();
    // The number of each axis in space and which it is, the fastest first.
    let mut in_space = Vec::new();
    for (i, kind) in kinds.iter().enumerate().rev() {
        let role = match kind {
            Some(AxisKind::Space(k)) => {
                in_space.push((i, *k));
                Role::Space(in_space.len() - 1)
            }
            Some(AxisKind::Channel) => Role::Channel,
            Some(AxisKind::Time) => Role::Time,
            None => Role::Single,
        };
        axes.push(Axis { size: array.shape[i], role });
    }
    let (geometry, problem) = geometry(&found, &in_space);
    axes.extend((in_space.len()..3).map(|k| Axis { size: 1, role: Role::Space(k) }));
    let format = if scales.are_of_netcdf() { "NetCDF-4" } else { FORMAT };
    let format = format!("{format}, {}", one_line(&array.path));
    let mut plan = Plan::new(format, dtype, endian, axes, geometry);
    plan.spacing_guess = problem;
    if is_guess {
        plan.warn(WarningKind::Guess, "the array does not name its axes; the fastest was taken as x");
    }
    if in_space.iter().any(|(i, _)| found[*i].is_uneven) {
        plan.warn(
            WarningKind::Guess,
            "the coordinates along an axis are uneven; their mean distance was taken",
        );
    }
    let time = kinds.iter().position(|kind| *kind == Some(AxisKind::Time));
    plan.time_step = time.and_then(|i| time_step(found[i].seconds()?));
    set_values(&mut plan, array);
    Ok(plan)
}

/// Scale and unit of the values, and which of them say that there is none.
fn set_values(plan: &mut Plan, array: &Listed) {
    let attributes = &array.attributes;
    let finite = |name: &str| attributes.number(name).filter(|x| x.is_finite());
    let scale = finite("scale_factor").filter(|x| *x != 0.0).unwrap_or(1.0);
    let offset = finite("add_offset").unwrap_or(0.0);
    plan.value_map = (scale, offset);
    plan.value_unit = attributes.text("units").and_then(|unit| value_unit(&unit));
    let value = |number: f64| number * scale + offset;
    let none = ["_FillValue", "missing_value"].map(|name| attributes.numbers(name));
    let valid = match attributes.numbers("valid_range")[..] {
        [least, most] => (Some(least), Some(most)),
        _ => (finite("valid_min"), finite("valid_max")),
    };
    let valid = match valid {
        (None, None) => None,
        (least, most) => {
            let ends = (value(least.unwrap_or(f64::NEG_INFINITY)), value(most.unwrap_or(f64::INFINITY)));
            Some((ends.0.min(ends.1), ends.0.max(ends.1)))
        }
    };
    let values = none.into_iter().flatten().take(MAX_MISSING).map(value).collect();
    plan.missing = Missing { values, valid, what: "missing, as the file says", ..Missing::default() };
}

/// What each axis is, the slowest first, and whether the order alone tells it. An axis without meaning has one entry.
/// `None` if there are too many.
fn kinds(shape: &[u64], found: &[Coordinates]) -> (Option<Vec<Option<AxisKind>>>, bool) {
    let is_named = found.iter().any(|axis| axis.kind.is_some());
    let mut kinds: Vec<Option<AxisKind>> = Vec::new();
    for axis in found {
        // Of two axes with one name, only the first has it.
        kinds.push(axis.kind.filter(|kind| !kinds.contains(&Some(*kind))));
    }
    let num_long = shape.iter().filter(|n| **n > 1).count();
    let last = shape.len().saturating_sub(1);
    let is_color =
        |shape: &[u64]| matches!(shape[last], 3 | 4) && shape[..last].iter().all(|n| *n == 1 || *n > 4);
    if !is_named && num_long > 3 && is_color(shape) {
        kinds[last] = Some(AxisKind::Channel);
    }
    let usual =
        [AxisKind::Space(0), AxisKind::Space(1), AxisKind::Space(2), AxisKind::Channel, AxisKind::Time];
    let mut num_left = shape.len();
    for i in (0..shape.len()).rev() {
        if kinds[i].is_some() {
            continue;
        }
        // Axes with one entry have no meaning where there are more than three.
        if shape[i] == 1 && num_left > 3 {
            num_left -= 1;
            continue;
        }
        let Some(free) = usual.into_iter().find(|kind| !kinds.contains(&Some(*kind))) else {
            return (None, false);
        };
        kinds[i] = Some(free);
    }
    let num_space = kinds.iter().filter(|kind| matches!(kind, Some(AxisKind::Space(_)))).count();
    ((num_space >= 2).then_some(kinds), !is_named)
}

/// Where the voxels lie, from the axes in space: their numbers and which they are, the fastest first. The text is the
/// warning about an unknown spacing.
fn geometry(found: &[Coordinates], in_space: &[(usize, usize)]) -> (Geometry, Option<String>) {
    let lines = || in_space.iter().map(|(i, _)| found[*i].line);
    let is_along_x = |(_, k): &&(usize, usize)| *k == 0;
    let first = in_space.iter().find(is_along_x).or(in_space.first()).map_or(0, |(i, _)| *i);
    let unit = &found[first].unit;
    let is_like = |other: &Unit| match (unit, other) {
        (Unit::Length(..), Unit::Length(..)) => true,
        (unit, other) => unit == other,
    };
    let problem = match () {
        () if lines().all(|line| line.is_none()) => Some("an array has no spacing; it was taken as 1"),
        () if lines().any(|line| line.is_none()) => {
            Some("an axis has no coordinates; the spacing was taken as 1")
        }
        () if !in_space.iter().all(|(i, _)| is_like(&found[*i].unit)) => {
            Some("the coordinates have different units; the spacing was taken as 1")
        }
        () => None,
    };
    // The unit of an axis in that of the first.
    let in_first = |i: usize| match (&found[i].unit, unit) {
        (Unit::Length(own, _), Unit::Length(first, _)) => own / first,
        _ => 1.0,
    };
    let mut steps = [DVec3::ZERO; 3];
    let mut origin = DVec3::ZERO;
    let mut is_free = [true; 3];
    for (n, (i, k)) in in_space.iter().enumerate() {
        let (at, step) = found[*i].line.unwrap_or((0.0, 1.0));
        let step = if problem.is_some() { step.signum() } else { step * in_first(*i) };
        steps[n] = DVec3::AXES[*k] * step;
        origin[*k] = at * in_first(*i);
        is_free[*k] = false;
    }
    let free = (0..3).filter(|k| is_free[*k]);
    for (n, k) in (in_space.len()..3).zip(free) {
        steps[n] = DVec3::AXES[k] * steps[0].length();
    }
    let is_placed = problem.is_none() && origin != DVec3::ZERO;
    let world = if coordinates::are_of_earth(found) { World::Space } else { World::Image };
    let unit = match unit {
        Unit::Length(_, name) if problem.is_none() => Some((*name).to_owned()),
        _ => None,
    };
    let geometry = Geometry { steps, origin: is_placed.then_some(origin), world, unit };
    (geometry, problem.map(str::to_owned))
}

/// Most values that stand for none.
const MAX_MISSING: usize = 16;
