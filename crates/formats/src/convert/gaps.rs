//! Which number marks voxels without a value, judged by the numbers of a volume as its reader does.

use half::f16;
use serde::{Deserialize, Serialize};

use super::average::Rule;
use crate::decode::{Extremes, near_zero, single};
use crate::dtype::Dtype;
use crate::padding::{GapNumbers, NEAR, OF_CT, are_padding};
use crate::plan::Plan;
use crate::units::may_be_hounsfield;

/// What is known of the numbers of one channel at one time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(from = "StoredTally", into = "StoredTally")]
pub(crate) struct Tally {
    extremes: Extremes,
    num: u64,
    num_not_finite: u64,
    /// For each value that CT scanners write outside of their circle: voxels with it, and with others near it.
    of_ct: [[u64; 2]; OF_CT.len()],
}

impl Tally {
    /// Of no numbers.
    pub(crate) const NONE: Self =
        Self { extremes: Extremes::NONE, num: 0, num_not_finite: 0, of_ct: [[0; 2]; OF_CT.len()] };

    /// Of little-endian numbers. `map` is the slope and intercept of their values.
    pub(crate) fn of(bytes: &[u8], dtype: Dtype, map: (f64, f64)) -> Self {
        macro_rules! of {
            ($list:ident, $t:ty, $single:expr) => {{
                let numbers = bytes.as_chunks().0.iter().map(|b| <$t>::from_le_bytes(*b));
                Self::$list(numbers, map, $single)
            }};
        }
        match dtype {
            Dtype::Int8 => of!(of_integers, i8, f32::from),
            Dtype::Uint8 => of!(of_integers, u8, f32::from),
            Dtype::Int16 => of!(of_integers, i16, f32::from),
            Dtype::Uint16 => of!(of_integers, u16, f32::from),
            Dtype::Int32 => of!(of_integers, i32, |x| x as f32),
            Dtype::Uint32 => of!(of_integers, u32, |x| x as f32),
            Dtype::Int64 => of!(of_integers, i64, |x| x as f32),
            Dtype::Uint64 => of!(of_integers, u64, |x| x as f32),
            Dtype::Half => of!(of_floats, f16, f16::to_f32),
            Dtype::Float => of!(of_floats, f32, |x| x),
            Dtype::Double => of!(of_floats, f64, single),
        }
    }

    /// Integers have no markers, so their range is enough.
    fn of_integers<T: Copy + Ord>(
        numbers: impl Iterator<Item = T> + Clone,
        map: (f64, f64),
        single: impl Fn(T) -> f32,
    ) -> Self {
        let range = |(least, greatest): (T, T), x: T| (least.min(x), greatest.max(x));
        let Some(first) = numbers.clone().next() else { return Self::NONE };
        let (least, greatest) = numbers.clone().fold((first, first), range);
        let extremes = Extremes::NONE.with(single(least)).with(single(greatest));
        let num = numbers.clone().count() as u64;
        Self { extremes, num, ..Self::NONE }.with_ct(numbers.map(single), map)
    }

    fn of_floats<T>(
        numbers: impl Iterator<Item = T> + Clone,
        map: (f64, f64),
        single: impl Fn(T) -> f32 + Copy,
    ) -> Self {
        let singles = numbers.map(single);
        let mut tally = Self::NONE;
        for x in singles.clone() {
            tally.num += 1;
            if x.is_finite() {
                tally.extremes = tally.extremes.with(x);
            } else {
                tally.num_not_finite += 1;
            }
        }
        tally.with_ct(singles.filter(|x| x.is_finite()), map)
    }

    /// Counts what CT scanners write, if any of the numbers is as low.
    fn with_ct(mut self, numbers: impl Iterator<Item = f32>, (slope, intercept): (f64, f64)) -> Self {
        let value = |x: f32| (f64::from(x) * slope + intercept) as f32;
        let (least, greatest) = self.extremes.range();
        if value(least).min(value(greatest)) > HIGHEST_OF_CT {
            return self;
        }
        for value in numbers.map(value).filter(|value| *value <= HIGHEST_OF_CT) {
            for (outside, [equal, beside]) in OF_CT.iter().zip(&mut self.of_ct) {
                *equal += u64::from(value == *outside);
                *beside += u64::from(value != *outside && (value - outside).abs() <= NEAR);
            }
        }
        self
    }

    /// Of the numbers of both.
    pub(crate) fn and(mut self, other: Self) -> Self {
        self.extremes = self.extremes.and(other.extremes);
        self.num += other.num;
        self.num_not_finite += other.num_not_finite;
        for (own, more) in self.of_ct.iter_mut().flatten().zip(other.of_ct.iter().flatten()) {
            *own += more;
        }
        self
    }

    /// How many numbers are not finite.
    pub(crate) fn num_not_finite(&self) -> u64 {
        self.num_not_finite
    }

    /// The number that marks voxels without a value, in a file that says nothing about that.
    pub(crate) fn gap(&self, plan: &Plan) -> Option<f64> {
        let (least, greatest) = self.extremes.range();
        if plan.dtype.integer_range().is_none() && plan.has_gaps {
            let filled = match self.num_not_finite {
                0 => self.extremes,
                _ => self.extremes.with(near_zero(least, greatest)),
            };
            if let Some((mark, _)) = filled.mark() {
                return Some(mark.into());
            }
            if self.num_not_finite > 0 {
                return None;
            }
        }
        let (slope, intercept) = plan.value_map;
        let value = |x: f32| (f64::from(x) * slope + intercept) as f32;
        let (lo, hi) = (value(least).min(value(greatest)), value(least).max(value(greatest)));
        let outside = OF_CT.iter().position(|outside| *outside == lo)?;
        let [equal, beside] = self.of_ct[outside];
        let is_padding = may_be_hounsfield(lo, hi) && are_padding(equal, beside, self.num);
        is_padding.then(|| number_of(plan, lo.into()))
    }

    /// Whether a number may occur.
    pub(crate) fn may_have(&self, number: f64) -> bool {
        let (least, greatest) = self.extremes.range();
        (f64::from(least)..=f64::from(greatest)).contains(&number)
    }
}

/// The numbers that mark voxels without a value, as the file tells them. Attributes have a list and one range of what is
/// valid. So a short range of whole numbers that are none is listed, and a long one bounds what is valid: from below if
/// it begins at or below zero, or else from above.
pub(crate) fn told_gaps(plan: &Plan) -> GapNumbers {
    let told = plan.missing.values.iter().map(|value| number_of(plan, *value));
    let mut numbers: Vec<f64> = told.filter(|x| x.is_finite()).collect();
    numbers.dedup();
    let both = |&(lo, hi): &(f64, f64)| {
        let (a, b) = (number_of(plan, lo), number_of(plan, hi));
        // JSON has no infinite numbers.
        (a.min(b).max(f64::MIN), a.max(b).min(f64::MAX))
    };
    // The number after another one, or before it.
    let next = |x: f64, step: f64| match plan.dtype.integer_range() {
        Some(_) => x + step,
        None if step > 0.0 => x.next_up(),
        None => x.next_down(),
    };
    let mut valid = plan.missing.valid.as_ref().map(both);
    for (lo, hi) in plan.missing.ranges.iter().map(both) {
        if plan.dtype.integer_range().is_some() && hi - lo < MOST_LISTED {
            numbers.extend((0..=(hi - lo) as u32).map(|i| lo + f64::from(i)));
            continue;
        }
        let (least, greatest) = valid.unwrap_or((f64::MIN, f64::MAX));
        valid = Some(if lo <= 0.0 {
            (least.max(next(hi, 1.0)), greatest)
        } else {
            (least, greatest.min(next(lo, -1.0)))
        });
    }
    GapNumbers { numbers, valid }
}

/// The stored number of a value.
fn number_of(plan: &Plan, value: f64) -> f64 {
    let (slope, intercept) = plan.value_map;
    let number = (value - intercept) / slope;
    if plan.dtype.num_bytes_in_memory() < 4 { number.round() } else { number }
}

/// The gap that all volumes of an image share, if each that may have the number takes it for one.
fn shared_gap(tallies: &[Tally], gaps: &[Option<f64>]) -> Option<f64> {
    let gap = gaps.iter().flatten().next().copied()?;
    let agrees =
        |(tally, own): (&Tally, &Option<f64>)| *own == Some(gap) || (own.is_none() && !tally.may_have(gap));
    tallies.iter().zip(gaps).all(agrees).then_some(gap)
}

/// How the voxels of coarser levels are made, by the tally of each time and channel, and the numbers of voxels without a
/// value that all of these share.
pub(crate) fn level_rules(plan: &Plan, tallies: &[Tally], are_labels: bool) -> (GapNumbers, Vec<Rule>) {
    let told = Some(told_gaps(plan)).filter(|told| !are_labels && *told != GapNumbers::default());
    let gap = |tally: &Tally| tally.gap(plan).filter(|_| !are_labels && told.is_none());
    let gaps: Vec<Option<f64>> = tallies.iter().map(gap).collect();
    let one = |gap: Option<f64>| GapNumbers { numbers: gap.into_iter().collect(), valid: None };
    let all = told.clone().unwrap_or_else(|| one(shared_gap(tallies, &gaps)));
    let rule = |gap: &Option<f64>| match &told {
        _ if are_labels => Rule::Majority,
        Some(told) => Rule::Mean(told.clone()),
        None => Rule::Mean(one(*gap)),
    };
    (all, gaps.iter().map(rule).collect())
}

/// A [`Tally`] in numbers that JSON can hold.
#[derive(Serialize, Deserialize)]
struct StoredTally {
    bits_of_extremes: [u32; 4],
    num: u64,
    num_not_finite: u64,
    of_ct: [[u64; 2]; OF_CT.len()],
}

impl From<StoredTally> for Tally {
    fn from(stored: StoredTally) -> Self {
        let StoredTally { bits_of_extremes, num, num_not_finite, of_ct } = stored;
        Self { extremes: Extremes(bits_of_extremes.map(f32::from_bits)), num, num_not_finite, of_ct }
    }
}

impl From<Tally> for StoredTally {
    fn from(tally: Tally) -> Self {
        let Tally { extremes, num, num_not_finite, of_ct } = tally;
        Self { bits_of_extremes: extremes.0.map(f32::to_bits), num, num_not_finite, of_ct }
    }
}

/// Most numbers of a range that are listed.
const MOST_LISTED: f64 = 32.0;
/// No padding of CT, and nothing near it, has a greater value.
const HIGHEST_OF_CT: f32 = -1020.0;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::axes::Geometry;
    use crate::dtype::Endian;
    use crate::plan::Axis;

    fn plan(dtype: Dtype, intercept: f64) -> Plan {
        let geometry = Geometry::along_axes([1.0; 3], None);
        let mut plan = Plan::new("test", dtype, Endian::Little, Axis::in_space([10; 3]), geometry);
        plan.value_map = (1.0, intercept);
        plan
    }

    #[test]
    fn markers_and_padding_are_found_in_parts_as_in_the_whole() {
        let floats: Vec<u8> = (0..1000)
            .flat_map(|i| if i % 5 == 0 { -9999.0 } else { i as f32 / 10.0 }.to_le_bytes())
            .collect();
        let plan_of_floats = plan(Dtype::Float, 0.0);
        let whole = Tally::of(&floats, Dtype::Float, plan_of_floats.value_map);
        assert_eq!(whole.gap(&plan_of_floats), Some(-9999.0));
        let parts = floats.chunks(444).map(|part| Tally::of(part, Dtype::Float, (1.0, 0.0)));
        assert_eq!(parts.fold(Tally::NONE, Tally::and), whole);
        let text = serde_json::to_string(&Tally::NONE).unwrap();
        assert_eq!(serde_json::from_str::<Tally>(&text).unwrap(), Tally::NONE);
        let ct = |outside: u16| -> Vec<u8> {
            let number = |i: u16| if i < 300 { outside } else { 1000 + i % 100 * 20 };
            (0..1000).flat_map(|i| number(i).to_le_bytes()).collect()
        };
        let plan_of_ct = plan(Dtype::Uint16, -2000.0);
        let gap = |outside| Tally::of(&ct(outside), Dtype::Uint16, (1.0, -2000.0)).gap(&plan_of_ct);
        // The control is a least value that no scanner writes.
        assert_eq!((gap(0), gap(1)), (Some(0.0), None));
    }

    #[test]
    fn a_gap_is_shared_if_nobody_has_it_as_a_value() {
        let tally = |numbers: &[f32]| {
            let bytes: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
            Tally::of(&bytes, Dtype::Float, (1.0, 0.0))
        };
        let tallies = [tally(&[-9999.0, 1.0, 2.0]), tally(&[1.0, 2.0])];
        assert_eq!(shared_gap(&tallies, &[Some(-9999.0), None]), Some(-9999.0));
        let tallies = [tallies[0], tally(&[-10_000.0, -9999.0, 2.0])];
        assert_eq!(shared_gap(&tallies, &[Some(-9999.0), None]), None, "the second has it as a value");
        assert_eq!(shared_gap(&tallies, &[None, None]), None);
    }
}
