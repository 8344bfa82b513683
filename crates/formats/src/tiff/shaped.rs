//! The description of an array by tifffile: `{"shape": [2, 3, 4, 5, 6], "axes": "TCZYX"}`, or `shape=(4, 5, 6)` in
//! older versions.

use serde_json::Value;

use super::page::{Group, PageShape};
use super::stack::{PlaneAxis, Stack};

/// The shape of an array that begins at a page.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Shaped {
    /// Sizes of the axes, the slowest first. The last two or three are those of a page.
    shape: Vec<u64>,
    /// A letter for each axis.
    axes: Option<String>,
    /// Whether all planes follow the first page without directories of their own.
    pub(super) is_truncated: bool,
}

impl Shaped {
    /// Parses a description; `None` if it has another form.
    pub(super) fn of(text: &str) -> Option<Self> {
        let shaped = if let Some(rest) = text.strip_prefix("shape=(") {
            let words = rest.split_once(')')?.0.split(',').map(str::trim).filter(|w| !w.is_empty());
            let shape = words.map(|w| w.parse().ok()).collect::<Option<_>>()?;
            Self { shape, axes: None, is_truncated: false }
        } else {
            let value: Value = text.starts_with('{').then(|| serde_json::from_str(text).ok())??;
            let shape = value.get("shape")?.as_array()?.iter().map(Value::as_u64).collect::<Option<_>>()?;
            let axes = value["axes"].as_str().map(str::to_owned);
            let is_truncated = value["truncated"].as_bool().unwrap_or(false);
            Self { shape, axes, is_truncated }
        };
        let is_good = (2..=MAX_AXES).contains(&shaped.shape.len()) && !shaped.shape.contains(&0);
        is_good.then_some(shaped)
    }

    /// Number of axes outside of a page, if the others are those of `page`.
    fn num_outer(&self, page: &PageShape) -> Option<usize> {
        let [height, width, samples] =
            [u64::from(page.height), u64::from(page.width), u64::from(page.samples)];
        let ends = match (page.is_planar, samples) {
            (_, 1) => [vec![height, width], vec![height, width, 1]],
            (true, _) => [vec![samples, height, width], Vec::new()],
            (false, _) => [vec![height, width, samples], Vec::new()],
        };
        let end = ends.iter().find(|end| !end.is_empty() && self.shape.ends_with(end))?;
        Some(self.shape.len() - end.len())
    }

    /// Number of planes of the array, if `page` is one of them.
    pub(super) fn num_planes(&self, page: &PageShape) -> Option<u64> {
        self.shape[..self.num_outer(page)?].iter().try_fold(1u64, |n, size| n.checked_mul(*size))
    }

    /// The stack of the pages in `group`; `None` if they do not match.
    pub(super) fn stack(&self, group: &Group) -> Result<Option<Stack>, String> {
        let Some(num_outer) = self.num_outer(&group.shape) else { return Ok(None) };
        let outer = &self.shape[..num_outer];
        // Letters are ignored if they put other axes than x and y into a page.
        let letters: Option<Vec<char>> = self.axes.as_ref().map(|a| a.chars().collect());
        let letters = letters.filter(|l| {
            let inner: String = l.iter().skip(num_outer).filter(|c| **c != 'S').collect();
            l.len() == self.shape.len() && inner == "YX"
        });
        let named = |i: usize| letters.as_ref().map_or('Q', |l| l[i]);
        let mut axes: Vec<(Option<PlaneAxis>, u64)> = (0..num_outer)
            .rev()
            .filter(|&i| outer[i] > 1)
            .map(|i| {
                let axis = match named(i) {
                    'Z' => Some(PlaneAxis::Z),
                    'C' => Some(PlaneAxis::Channel),
                    'T' => Some(PlaneAxis::Time),
                    _ => None,
                };
                (axis, outer[i])
            })
            .collect();
        // Axes with another name or none take the first free meaning, from the fastest on.
        for i in 0..axes.len() {
            let is_twice = axes[..i].iter().any(|a| a.0.is_some() && a.0 == axes[i].0);
            if axes[i].0.is_none() || is_twice {
                let left = [PlaneAxis::Z, PlaneAxis::Channel, PlaneAxis::Time]
                    .into_iter()
                    .find(|a| !axes.iter().any(|x| x.0 == Some(*a)));
                let problem = || {
                    format!(
                        "its description has axes {:?} of {:?}, expected z, channels and times",
                        self.axes, outer
                    )
                };
                axes[i].0 = Some(left.ok_or_else(problem)?);
            }
        }
        let num_guessed = (0..num_outer).filter(|&i| outer[i] > 1 && !"ZCT".contains(named(i))).count();
        let guess = (axes.len() > 1 && num_guessed > 0).then(|| {
            let names: Vec<&str> = axes.iter().rev().filter_map(|a| a.0).map(PlaneAxis::name).collect();
            format!(
                "the axes {outer:?} of the description have no names; they were taken as {}",
                names.join(", ")
            )
        });
        let axes = axes.into_iter().filter_map(|(axis, size)| Some((axis?, size))).collect();
        let has_channels = (0..num_outer).any(|i| outer[i] > 1 && named(i) == 'C');
        Ok(Some(Stack { axes, guess, has_channels, ..Stack::plain(group) }))
    }
}

/// Most axes of an array.
const MAX_AXES: usize = 16;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dtype::Dtype;

    fn group(samples: u16, is_planar: bool) -> Group {
        let shape =
            PageShape { width: 6, height: 5, samples, is_planar, dtype: Dtype::Uint8, is_white: false };
        Group {
            shape,
            pages: vec![0],
            shaped: None,
            resolution: [None; 2],
            unit_mm: None,
            block: None,
            palette: None,
        }
    }

    #[test]
    fn axes_are_those_of_the_description() {
        use PlaneAxis::{Channel, Time, Z};
        let axes = |text: &str, samples: u16, is_planar: bool| {
            let stack = Shaped::of(text)?.stack(&group(samples, is_planar)).ok()??;
            Some((stack.axes, stack.guess.is_some()))
        };
        for (text, expected) in [
            (
                r#"{"shape": [2, 3, 4, 5, 6], "axes": "TCZYX"}"#,
                (vec![(Z, 4), (Channel, 3), (Time, 2)], false),
            ),
            (r#"{"shape": [4, 3, 5, 6], "axes": "ZCYX"}"#, (vec![(Channel, 3), (Z, 4)], false)),
            (r#"{"shape": [4, 5, 6, 1], "axes": "TYXS"}"#, (vec![(Time, 4)], false)),
            (r#"{"shape": [1, 3, 4, 5, 6], "axes": "QICYX"}"#, (vec![(Channel, 4), (Z, 3)], true)),
            (r#"{"shape": [2, 3, 4, 5, 6]}"#, (vec![(Z, 4), (Channel, 3), (Time, 2)], true)),
            (r#"{"shape": [4, 5, 6], "axes": "XYZ"}"#, (vec![(Z, 4)], false)),
            ("shape=(3, 4, 5, 6)", (vec![(Z, 4), (Channel, 3)], true)),
            ("shape=(5, 6)", (vec![], false)),
        ] {
            assert_eq!(axes(text, 1, false), Some(expected), "{text}");
        }
        assert_eq!(axes(r#"{"shape": [4, 5, 6, 3]}"#, 3, false), Some((vec![(Z, 4)], false)));
        assert_eq!(axes(r#"{"shape": [4, 3, 5, 6]}"#, 3, true), Some((vec![(Z, 4)], false)));
        for text in [r#"{"shape": [4, 6, 5]}"#, r#"{"shape": 4}"#, "shape=(4, x)", "{", "shape=(0, 5, 6)"] {
            assert_eq!(axes(text, 1, false), None, "{text}");
        }
        let five = Shaped::of(r#"{"shape": [2, 2, 2, 2, 5, 6]}"#).unwrap();
        assert!(five.stack(&group(1, false)).is_err_and(|e| e.contains("expected z, channels and times")));
    }
}
