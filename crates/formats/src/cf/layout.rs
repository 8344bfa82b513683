//! The plan of an array whose axes have coordinates.

use glam::DVec3;

use super::{AttributeList, Coordinates, NumberMeaning, Unit};
use crate::axes::{Geometry, World};
use crate::dtype::{Dtype, Endian};
use crate::plan::{Axis, AxisKind, Plan, Role};
use crate::units::time_step;
use crate::warning::WarningKind;

/// The plan of an array of this shape, the slowest axis first; `None` if it has too few or too many axes.
pub(crate) fn plan(
    format: String,
    (dtype, endian): (Dtype, Endian),
    shape: &[u64],
    found: &[Coordinates],
    attributes: &dyn AttributeList,
) -> Option<Plan> {
    let (kinds, is_guess) = kinds(shape, found);
    let kinds = kinds?;
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
        axes.push(Axis { size: shape[i], role });
    }
    let (geometry, problem) = geometry(shape, found, &in_space);
    axes.extend((in_space.len()..3).map(|k| Axis { size: 1, role: Role::Space(k) }));
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
    NumberMeaning::of(attributes, dtype).set(&mut plan);
    Some(plan)
}

/// Sizes along the axes in space of an array of this shape; `None` if it is no volume.
pub(crate) fn num_in_space(shape: &[u64], found: &[Coordinates]) -> Option<Vec<u64>> {
    let kinds = kinds(shape, found).0?;
    let is_space = |kind: &Option<AxisKind>| matches!(kind, Some(AxisKind::Space(_)));
    Some(shape.iter().zip(&kinds).filter(|(_, kind)| is_space(kind)).map(|(n, _)| *n).collect())
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
fn geometry(shape: &[u64], found: &[Coordinates], in_space: &[(usize, usize)]) -> (Geometry, Option<String>) {
    // An axis with one entry has no distances.
    let long = || in_space.iter().filter(|(i, _)| shape[*i] > 1 || found[*i].line.is_some());
    let lines = || long().map(|(i, _)| found[*i].line);
    let is_along_x = |(_, k): &&(usize, usize)| *k == 0;
    let first = long().find(is_along_x).or(long().next()).or(in_space.first()).map_or(0, |(i, _)| *i);
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
        () if !long().all(|(i, _)| is_like(&found[*i].unit)) => {
            Some("the coordinates have different units; the spacing was taken as 1")
        }
        () => None,
    };
    // The unit of an axis in that of the first.
    let in_first = |i: usize| match (&found[i].unit, unit) {
        (Unit::Length(own, _), Unit::Length(first, _)) => own / first,
        _ => 1.0,
    };
    let usual = found.get(first).and_then(|axis| axis.line).map_or(1.0, |(_, step)| step.abs());
    let mut steps = [DVec3::ZERO; 3];
    let mut origin = DVec3::ZERO;
    let mut is_free = [true; 3];
    for (n, (i, k)) in in_space.iter().enumerate() {
        let sign = if found[*i].is_down { -1.0 } else { 1.0 };
        let (at, step) = found[*i].line.unwrap_or((0.0, sign * usual));
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
    let is_of_earth = in_space.iter().any(|(i, _)| found[*i].is_of_earth);
    let world = if is_of_earth { World::Space } else { World::Image };
    let unit = match unit {
        Unit::Length(_, name) if problem.is_none() => Some((*name).to_owned()),
        _ => None,
    };
    let geometry = Geometry { steps, origin: is_placed.then_some(origin), world, unit };
    (geometry, problem.map(str::to_owned))
}
