//! Voxels without a value: those that the file names, and what CT scanners write outside of what they measure.

use isinglass_core::volume::{Volume, Voxels};
use rayon::prelude::*;

use crate::decode::single;
use crate::units::may_be_hounsfield;

/// The values of which a file says that they stand for none.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Missing {
    pub(crate) values: Vec<f64>,
    /// Least and greatest value of parts in which no value is one.
    pub(crate) ranges: Vec<(f64, f64)>,
    /// The least and the greatest value that is one.
    pub(crate) valid: Option<(f64, f64)>,
    /// What such voxels are, for the warning.
    pub(crate) what: &'static str,
}

impl Default for Missing {
    fn default() -> Self {
        Self { values: Vec::new(), ranges: Vec::new(), valid: None, what: "outside of the scanned part" }
    }
}

/// The numbers of a file that stand for no value, as the file has them.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct GapNumbers {
    pub(crate) numbers: Vec<f64>,
    /// The least and the greatest number that is a value.
    pub(crate) valid: Option<(f64, f64)>,
}

impl GapNumbers {
    pub(crate) fn contains(&self, x: f64) -> bool {
        self.numbers.contains(&x) || self.valid.is_some_and(|(lo, hi)| x < lo || x > hi)
    }

    /// The same in single precision, by which readers compare floats.
    pub(crate) fn in_single(&self) -> Self {
        let valid = self.valid.map(|(lo, hi)| (single(lo).into(), single(hi).into()));
        Self { numbers: self.numbers.iter().map(|x| single(*x).into()).collect(), valid }
    }
}

/// The stored numbers that stand for no value.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct MissingNumbers {
    pub(crate) numbers: Vec<f32>,
    /// Least and greatest number of parts in which no number is a value.
    pub(crate) ranges: Vec<(f32, f32)>,
    /// The least and the greatest number that is a value.
    pub(crate) valid: Option<(f32, f32)>,
}

impl MissingNumbers {
    /// Whether no number is missing.
    pub(crate) fn is_empty(&self) -> bool {
        self.numbers.is_empty() && self.ranges.is_empty() && self.valid.is_none()
    }

    pub(crate) fn contains(&self, number: f32) -> bool {
        self.numbers.contains(&number)
            || self.ranges.iter().any(|(lo, hi)| (*lo..=*hi).contains(&number))
            || self.valid.is_some_and(|(lo, hi)| number < lo || number > hi)
    }
}

/// The volume with nothing in voxels that have no value: those that are `told`, or what is known of CT. Returns the
/// stored numbers of such voxels, too.
pub(crate) fn without_padding(mut volume: Volume, told: &Missing) -> (Volume, MissingNumbers) {
    let (lo, hi) = volume.value_range();
    let (scale, offset) = volume.value_map();
    let is_integer = !matches!(volume.voxels(), Voxels::F32(_));
    let stored_of = |value: f64| {
        let stored = (value - f64::from(offset)) / f64::from(scale);
        (if is_integer { stored.round() } else { stored }) as f32
    };
    let mut numbers: Vec<f32> = told.values.iter().map(|value| stored_of(*value)).collect();
    let both = |ends: (f64, f64)| {
        let (a, b) = (stored_of(ends.0), stored_of(ends.1));
        (a.min(b), a.max(b))
    };
    let (valid, ranges) = (told.valid.map(both), told.ranges.iter().copied().map(both).collect());
    let is_told = !told.values.is_empty() || !told.ranges.is_empty() || told.valid.is_some();
    if !is_told && may_be_hounsfield(lo, hi) && volume.gaps().is_none() {
        let stored = stored_of(f64::from(lo));
        let is_circle = OF_CT.contains(&lo) && is_apart(&volume, stored, f64::from(scale));
        numbers.extend(is_circle.then_some(stored));
    }
    let missing = MissingNumbers { numbers, ranges, valid };
    if missing.is_empty() {
        return (volume, missing);
    }
    let is_gap = |x: f32| u8::from(missing.contains(x));
    let gaps: Vec<u8> = match volume.voxels() {
        Voxels::U8(v) => v.par_iter().map(|x| is_gap(f32::from(*x))).collect(),
        Voxels::U16(v) => v.par_iter().map(|x| is_gap(f32::from(*x))).collect(),
        Voxels::F32(v) => v.par_iter().map(|x| is_gap(*x)).collect(),
    };
    let before = volume.gaps().map(|gaps| gaps.bytes.clone());
    let gaps = match before {
        Some(before) => gaps.into_iter().zip(before).map(|(a, b)| a | b).collect(),
        None => gaps,
    };
    let had = volume.gaps().map_or(0, |gaps| gaps.num_gaps);
    volume = volume.with_gaps(gaps);
    let num = volume.gaps().map_or(0, |gaps| gaps.num_gaps) - had;
    if num > 0 {
        let value = |stored: f32| stored * scale + offset;
        let value = match (&missing.numbers[..], &missing.ranges[..], valid) {
            ([stored], [], None) => format!("{}, ", value(*stored)),
            ([], [(a, b)], None) => {
                let (a, b) = (value(*a), value(*b));
                format!("{} to {}, ", a.min(b), a.max(b))
            }
            _ => String::new(),
        };
        let text = format!("{num} voxels are {value}{}; nothing is shown there", told.what);
        volume.info.warnings.push(text);
    }
    (volume, missing)
}

/// Whether a good share of the voxels has the number, and hardly any one of the numbers next to it.
fn is_apart(volume: &Volume, number: f32, scale: f64) -> bool {
    let near = (f64::from(NEAR) / scale.abs()) as f32;
    let count = |x: f32| {
        let is_equal = x == number;
        (u64::from(is_equal), u64::from(!is_equal && (x - number).abs() <= near))
    };
    let both = |a: (u64, u64), b: (u64, u64)| (a.0 + b.0, a.1 + b.1);
    let (equal, beside) = match volume.voxels() {
        Voxels::U8(v) => v.par_iter().map(|x| count(f32::from(*x))).reduce(|| (0, 0), both),
        Voxels::U16(v) => v.par_iter().map(|x| count(f32::from(*x))).reduce(|| (0, 0), both),
        Voxels::F32(v) => v.par_iter().map(|x| count(*x)).reduce(|| (0, 0), both),
    };
    are_padding(equal, beside, volume.voxels().len() as u64)
}

/// Whether `equal` of so many voxels are padding, if `beside` others have a value within [`NEAR`] of it.
pub(crate) fn are_padding(equal: u64, beside: u64, num_voxels: u64) -> bool {
    equal * FEWEST > num_voxels && beside * MOST_BESIDE < equal
}

/// What scanners write outside of their circle, in Hounsfield units.
pub(crate) const OF_CT: [f32; 5] = [-3024.0, -3000.0, -2048.0, -2000.0, -1024.0];
/// At least one voxel in so many is padding.
const FEWEST: u64 = 100;
/// At most one voxel for so many has a value near the padding's.
const MOST_BESIDE: u64 = 20;
/// Values near the padding's, in its unit.
pub(crate) const NEAR: f32 = 3.0;

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;

    fn ct(outside: f32, inside: impl Fn(u32) -> f32) -> Volume {
        let voxels = (0..1000u32).map(|i| if i < 300 { outside } else { inside(i) } + 4000.0);
        let voxels = Voxels::U16(voxels.map(|x| x as u16).collect());
        Volume::new([10; 3], Vec3::ONE, voxels, (1.0, -4000.0), Default::default()).unwrap()
    }

    #[test]
    fn what_is_outside_of_the_circle_is_nothing() {
        let tissue = |i: u32| -1000.0 + (i % 100) as f32 * 20.0;
        for outside in OF_CT {
            let (found, missing) = without_padding(ct(outside, tissue), &Missing::default());
            assert_eq!(
                missing,
                MissingNumbers { numbers: vec![outside + 4000.0], ..MissingNumbers::default() }
            );
            assert_eq!(found.gaps().map(|g| g.num_gaps), Some(300), "{outside}");
            assert_eq!(found.value_range().0, -1000.0);
            assert!(found.info.warnings[0].contains(&outside.to_string()));
        }
        // The controls: another least value, air that happens to be the least, and a value that the file names.
        assert!(without_padding(ct(-1010.0, tissue), &Missing::default()).0.gaps().is_none());
        let air = |i: u32| -1024.0 + (i % 7) as f32;
        assert!(without_padding(ct(-1024.0, air), &Missing::default()).0.gaps().is_none());
        let (told, _) =
            without_padding(ct(-1010.0, tissue), &Missing { values: vec![-1010.0], ..Missing::default() });
        assert_eq!(told.gaps().map(|g| g.num_gaps), Some(300));
        // Several values, and ends of those that are valid.
        let several = Missing {
            values: vec![-1010.0, -1000.0],
            valid: Some((-2e9, 979.0)),
            what: "missing",
            ..Missing::default()
        };
        let (found, missing) = without_padding(ct(-1010.0, tissue), &several);
        assert_eq!(found.gaps().map(|g| g.num_gaps), Some(300 + 7 + 7));
        assert_eq!(found.value_range(), (-980.0, 960.0));
        assert_eq!(missing.numbers, [2990.0, 3000.0]);
        assert_eq!([2990.0, 2995.0, 4979.0, 4980.0].map(|x| missing.contains(x)), [true, false, false, true]);
        // A range of values, and its end in the warning.
        let range = Missing { ranges: vec![(-1010.0, -981.0)], ..Missing::default() };
        let (found, missing) = without_padding(ct(-1010.0, tissue), &range);
        assert_eq!((found.gaps().map(|g| g.num_gaps), found.value_range().0), (Some(307), -980.0));
        assert_eq!(missing.ranges, [(2990.0, 3019.0)]);
        assert!(found.info.warnings[0].contains("307 voxels are -1010 to -981, "));
    }
}
