//! The coordinates along an axis of a variable.

use super::AttributeList;
use super::names::{AxisWords, is_since};
use crate::plan::AxisKind;
use crate::units::{length_unit, time_unit};

/// An axis of an array.
#[derive(Clone, Debug, Default)]
pub(crate) struct Coordinates {
    /// What it is, if the file tells.
    pub(crate) kind: Option<AxisKind>,
    /// The coordinate of the first number, and the distance of the next, which may be less than zero. They rise upwards
    /// along z.
    pub(crate) line: Option<(f64, f64)>,
    pub(crate) unit: Unit,
    /// Whether the distances differ.
    pub(crate) is_uneven: bool,
    /// Whether the axis is one of the earth, such as latitude, height or depth.
    pub(crate) is_of_earth: bool,
    /// Whether the numbers of an axis without coordinates run downwards.
    pub(crate) is_down: bool,
}

/// The unit of coordinates.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) enum Unit {
    #[default]
    None,
    /// A length in metres, and its short name.
    Length(f64, &'static str),
    /// A time in seconds.
    Time(f64),
    /// Another one, such as degrees.
    Other(String),
}

impl Coordinates {
    /// The axis of the dimension `name`, whose coordinates have these attributes. In a file of `is_geo`, names such as
    /// `depth` are those of the earth.
    pub(super) fn of(name: &str, attributes: Option<&dyn AttributeList>, is_geo: bool) -> Self {
        let words = AxisWords::of(name, attributes);
        let is_of_earth = words.is_of_earth || (is_geo && words.is_down.is_some());
        let units = attributes.and_then(|list| list.text("units")).unwrap_or_default();
        Self {
            kind: words.kind,
            unit: unit_of(&units),
            is_of_earth,
            is_down: is_of_earth && words.is_down == Some(true),
            ..Self::default()
        }
    }

    /// Takes the coordinates of a variable. `is_told` says that the file itself tells whether they rise downwards.
    pub(super) fn set_variable(&mut self, mut numbers: Vec<f64>, is_told: bool) {
        if self.kind == Some(AxisKind::Space(0)) && self.unit == degrees() {
            unwind(&mut numbers);
        }
        // Depths below zero are heights, unless the file says otherwise.
        let is_height = !is_told && is_length(&self.unit) && numbers.iter().all(|x| *x <= 0.0);
        self.is_down &= !(is_height && numbers.len() > 1);
        self.set_numbers(&numbers);
    }

    /// Takes the coordinates of all numbers along the axis.
    pub(crate) fn set_numbers(&mut self, numbers: &[f64]) {
        let [first, .., last] = numbers[..] else { return };
        let step = (last - first) / (numbers.len() - 1) as f64;
        if !step.is_finite() || step == 0.0 {
            return;
        }
        // Coordinates in single precision differ by their last digits.
        let tolerance = (step.abs() * UNEVEN).max(first.abs().max(last.abs()) * SINGLE);
        self.is_uneven = numbers.windows(2).any(|pair| ((pair[1] - pair[0]) - step).abs() > tolerance);
        let sign = if self.is_down { -1.0 } else { 1.0 };
        self.line = Some((sign * first, sign * step));
    }

    /// What a program tells of an axis: what it is, its first coordinate and its step, and their unit.
    pub(crate) fn told(kind: Option<AxisKind>, line: Option<(f64, f64)>, unit: Unit) -> Self {
        let line = line.filter(|(at, step)| at.is_finite() && step.is_finite() && *step != 0.0);
        Self { kind, line, unit, ..Self::default() }
    }

    /// The same where y and z point up, as they do in space.
    pub(crate) fn in_space(self) -> Self {
        Self { is_of_earth: true, ..self }
    }

    /// Seconds from one point in time to the next.
    pub(crate) fn seconds(&self) -> Option<f64> {
        match (&self.unit, self.line) {
            (Unit::Time(unit), Some((_, step))) => Some(step * unit),
            _ => None,
        }
    }
}

fn is_length(unit: &Unit) -> bool {
    matches!(unit, Unit::Length(..))
}

fn degrees() -> Unit {
    Unit::Other("degrees".into())
}

/// Makes longitudes rise or fall beyond ±180° or 360°, where they begin anew.
fn unwind(numbers: &mut [f64]) {
    let mut turns = 0.0;
    for i in 1..numbers.len() {
        let step = numbers[i] + turns - numbers[i - 1];
        if step.abs() > 180.0 && step.is_finite() {
            turns -= (step / 360.0).round() * 360.0;
        }
        numbers[i] += turns;
    }
}

/// The unit that a text names.
pub(crate) fn unit_of(text: &str) -> Unit {
    let text = text.trim();
    let first = text.split_whitespace().next().unwrap_or_default();
    match (length_unit(text), time_unit(first).or_else(|| long_time(first))) {
        (Some((metres, name)), _) => Unit::Length(metres, name),
        // Times have a beginning, such as `hours since 2000-01-01`.
        (None, Some(seconds)) if first == text || is_since(text) => Unit::Time(seconds),
        _ if ["", "1", "pixel", "pixels", "index", "none"].contains(&text) => Unit::None,
        _ if text.starts_with("degree") => degrees(),
        _ => Unit::Other(text.to_owned()),
    }
}

/// Units of time without a fixed length, in seconds, as UDUNITS takes them.
fn long_time(name: &str) -> Option<f64> {
    Some(match name.to_lowercase().as_str() {
        "week" | "weeks" => 7.0 * 86_400.0,
        "month" | "months" => YEAR_S / 12.0,
        "year" | "years" => YEAR_S,
        _ => return None,
    })
}

/// The tropical year of 1900, seconds.
const YEAR_S: f64 = 3.155_692_597_47e7;
/// Distances that differ by less than this part of their mean are even.
const UNEVEN: f64 = 0.01;
/// The last digit of single precision, twice.
const SINGLE: f64 = 2.4e-7;

#[cfg(test)]
mod tests {
    use super::*;

    fn axis(kind: usize, unit: Unit, numbers: &[f64], is_down: bool) -> Coordinates {
        let mut axis =
            Coordinates { kind: Some(AxisKind::Space(kind)), unit, is_down, ..Coordinates::default() };
        axis.set_variable(numbers.to_vec(), false);
        axis
    }

    #[test]
    fn longitudes_go_on_where_they_begin_anew() {
        for (numbers, line) in [
            (&[350.0, 355.0, 0.0, 5.0][..], (350.0, 5.0)),
            (&[170.0, 175.0, -180.0, -175.0], (170.0, 5.0)),
            (&[5.0, 0.0, 355.0], (5.0, -5.0)),
            (&[0.0, 1.0, 2.0], (0.0, 1.0)),
        ] {
            let found = axis(0, degrees(), numbers, false);
            assert_eq!((found.line, found.is_uneven), (Some(line), false), "{numbers:?}");
        }
        // The control: numbers of another unit are as they are.
        assert!(axis(0, Unit::None, &[350.0, 355.0, 0.0, 5.0], false).is_uneven);
    }

    #[test]
    fn depths_point_down_unless_they_are_heights() {
        let metres = Unit::Length(1.0, "m");
        assert_eq!(axis(2, metres.clone(), &[5.0, 15.0], true).line, Some((-5.0, -10.0)));
        assert_eq!(axis(2, metres.clone(), &[15.0, 5.0], true).line, Some((-15.0, 10.0)));
        assert_eq!(axis(2, metres.clone(), &[0.0, -10.0], true).line, Some((0.0, -10.0)));
        assert_eq!(axis(2, metres, &[5.0, 15.0], false).line, Some((5.0, 10.0)), "control");
    }

    #[test]
    fn times_have_units_with_a_beginning() {
        assert_eq!(unit_of("hours since 1900-01-01 00:00:0.0"), Unit::Time(3600.0));
        assert_eq!(unit_of("seconds"), Unit::Time(1.0));
        assert_eq!(unit_of("Days Since 1950-01-01"), Unit::Time(86_400.0));
        assert_eq!(unit_of("months since 1950-01-01"), Unit::Time(YEAR_S / 12.0));
        // The controls: speeds are no times.
        assert_eq!(unit_of("m"), Unit::Length(1.0, "m"));
        assert_eq!(unit_of("s m-1"), Unit::Other("s m-1".into()));
    }
}
