//! Histogram of the physical values, and the percentiles read from it.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::grid::{Volume, Voxels};
use super::world::VoxelBox;

/// Counts of voxels in equal bins, usually between the least and the greatest value.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Histogram {
    /// Value at the left edge of the first bin, which also counts lesser values.
    pub lo: f32,
    /// Value at the right edge of the last bin, which also counts greater values.
    pub hi: f32,
    /// Voxels in each bin.
    pub counts: Vec<u64>,
    /// Least and greatest value.
    range: (f32, f32),
}

impl Histogram {
    /// The histogram of a volume in at most 65 536 bins: exact for 8- and 16-bit volumes. If a few distant floats
    /// would squeeze the others into a few bins, the bins cover only the others. A level of a pyramid has the finest
    /// level's, if that is known.
    pub fn of(volume: &Volume) -> Self {
        if let Some(whole) = volume.whole() {
            return whole.histogram.clone();
        }
        if let Some(known) = volume.finest().and_then(|finest| finest.histogram.as_ref()) {
            return (**known).clone();
        }
        let all = VoxelBox::of(volume.dims());
        Self::by(volume, volume.stored_range(), all.count(), &mut |range, with_gaps| {
            Self::counts_in(volume, &all, range, with_gaps)
        })
    }

    /// The same of `num_voxels` voxels with these least and greatest stored numbers. `count` gives the number of voxels
    /// in each bin between two stored numbers, with or without the gaps. Type and values are those of `volume`.
    pub fn by(
        volume: &Volume,
        stored_range: (f32, f32),
        num_voxels: u64,
        count: &mut dyn FnMut((f32, f32), bool) -> Vec<u64>,
    ) -> Self {
        let mut range = stored_range;
        let mut counts = count(range, true);
        if matches!(volume.voxels(), Voxels::F32(_))
            && let Some((bulk, of_bulk)) = bulk(num_voxels, range, &counts, &mut |range| count(range, true))
        {
            (range, counts) = (bulk, of_bulk);
        }
        if volume.gaps().is_some() {
            counts = count(range, false);
        }
        Self::of_bins(counts, range, stored_range, volume.value_map())
    }

    /// The histogram of numbers that were counted in many small bins: each has a least and a greatest number, and how
    /// many there are. Whole numbers below 65 536 in bins of their own give the histogram of their volume. `range` has
    /// the least and the greatest number, and `value_map` is that of the volume.
    pub fn of_counts(bins: &[(f32, f32, u64)], range: (f32, f32), value_map: (f32, f32)) -> Self {
        let are_whole =
            bins.iter().all(|(lo, hi, _)| lo == hi && lo.fract() == 0.0 && (0.0..65_536.0).contains(lo));
        let (lo, hi) = range;
        if are_whole && lo <= hi && lo >= 0.0 && hi < 65_536.0 {
            let mut counts = vec![0; (hi - lo) as usize + 1];
            let last = counts.len() - 1;
            for (at, _, n) in bins {
                counts[((at - lo).max(0.0) as usize).min(last)] += n;
            }
            return Self::of_bins(counts, range, range, value_map);
        }
        let (total, counts) = (bins.iter().map(|bin| bin.2).sum(), spread(bins, range));
        let bulk = bulk(total, range, &counts, &mut |part| spread(bins, part));
        let (of_bins, counts) = bulk.unwrap_or((range, counts));
        Self::of_bins(counts, of_bins, range, value_map)
    }

    /// A histogram as it was stored; `None` if its numbers contradict each other.
    pub fn from_parts(lo: f32, hi: f32, counts: Vec<u64>, range: (f32, f32)) -> Option<Self> {
        let is_good = [lo, hi, range.0, range.1].iter().all(|x| x.is_finite())
            && lo <= hi
            && range.0 <= range.1
            && (1..=NUM_BINS).contains(&counts.len())
            && counts.iter().try_fold(0u64, |sum, n| sum.checked_add(*n)).is_some();
        is_good.then_some(Self { lo, hi, counts, range })
    }

    /// The histogram of stored numbers in equal bins over `bins`.
    fn of_bins(
        mut counts: Vec<u64>,
        bins: (f32, f32),
        stored: (f32, f32),
        (scale, offset): (f32, f32),
    ) -> Self {
        let value = |stored: (f32, f32)| {
            let (a, b) = (stored.0 * scale + offset, stored.1 * scale + offset);
            (a.min(b), a.max(b), b < a)
        };
        let (lo, hi, falls) = value(bins);
        if falls {
            counts.reverse();
        }
        let (least, greatest, _) = value(stored);
        Self { lo, hi, counts, range: (least, greatest) }
    }

    /// Counts the voxels of a box of `volume` in bins between two stored numbers, with or without the gaps.
    pub fn counts_in(volume: &Volume, voxels: &VoxelBox, range: (f32, f32), with_gaps: bool) -> Vec<u64> {
        let gaps = volume.gaps().filter(|_| !with_gaps).map(|gaps| &gaps.bytes[..]);
        let places = Places { dims: volume.dims(), voxels, gaps };
        match volume.voxels() {
            Voxels::U8(v) => places.counts(v, &|part| counted(part, range.0, range.1)),
            Voxels::U16(v) => places.counts(v, &|part| counted(part, range.0, range.1)),
            Voxels::F32(v) => places.counts(v, &|part| in_bins(part, range)),
        }
    }

    /// The least value with at least `percent` % of the voxels at or below it, to the precision of the bins.
    pub fn percentile(&self, percent: f32) -> f32 {
        if percent <= 0.0 {
            return self.range.0;
        }
        let total: u64 = self.counts.iter().sum();
        let wanted = (f64::from(percent.min(100.0)) / 100.0 * total as f64).ceil().max(1.0) as u64;
        let mut seen = 0;
        let last = (self.counts.len() - 1).max(1) as f64;
        let (lo, hi) = (f64::from(self.lo), f64::from(self.hi));
        for (i, n) in self.counts.iter().enumerate() {
            seen += n;
            if seen >= wanted && wanted < total {
                return (lo + (hi - lo) * (i as f64 / last)) as f32;
            }
        }
        self.range.1
    }

    /// The same within the bins, without a few voxels far away from all others.
    pub fn bulk_percentile(&self, percent: f32) -> f32 {
        self.percentile(percent).clamp(self.lo, self.hi)
    }

    /// The share of the voxels above `value`, 0 to 1, to the precision of the bins.
    pub fn share_above(&self, value: f32) -> f32 {
        let total: u64 = self.counts.iter().sum();
        let last = (self.counts.len() - 1).max(1) as f32;
        let bin = ((value - self.lo) / (self.hi - self.lo) * last).floor();
        let first = if bin >= 0.0 { (bin as usize).saturating_add(1) } else { 0 };
        let above: u64 = self.counts.iter().skip(first).sum();
        above as f32 / total.max(1) as f32
    }

    /// The value that best separates lower and higher voxels: the greatest variance between the classes (Otsu 1979).
    pub fn parting_value(&self) -> f32 {
        parting_value(&self.counts, (self.lo, self.hi))
    }
}

/// The voxels of a box that are no gaps.
struct Places<'a> {
    dims: [u32; 3],
    voxels: &'a VoxelBox,
    gaps: Option<&'a [u8]>,
}

impl Places<'_> {
    /// Counts in one pass, or in copies of some rows at a time.
    fn counts<T: Copy>(&self, all: &[T], count: &dyn Fn(&[T]) -> Vec<u64>) -> Vec<u64> {
        if self.gaps.is_none() && *self.voxels == VoxelBox::of(self.dims) {
            return count(all);
        }
        let [nx, ny, _] = self.dims.map(|n| n as usize);
        let ([x, y, z], [ex, ey, ez]) =
            (self.voxels.first.map(|n| n as usize), self.voxels.end.map(|n| n as usize));
        let (mut sums, mut some) = (count(&[]), Vec::with_capacity(MOST_COPIED));
        let mut flush = |some: &mut Vec<T>| {
            sums.iter_mut().zip(count(some)).for_each(|(sum, n)| *sum += n);
            some.clear();
        };
        for row in (z..ez).flat_map(|z| (y..ey).map(move |y| (z * ny + y) * nx)) {
            let row = row + x..row + ex;
            match self.gaps {
                Some(gaps) => {
                    let known = all[row.clone()].iter().zip(&gaps[row]).filter(|(_, gap)| **gap == 0);
                    some.extend(known.map(|(v, _)| *v));
                }
                None => some.extend_from_slice(&all[row]),
            }
            if some.len() + (ex - x) > MOST_COPIED {
                flush(&mut some);
            }
        }
        flush(&mut some);
        sums
    }
}

fn counted<T: Copy + Sync + Into<u32>>(voxels: &[T], lo: f32, hi: f32) -> Vec<u64> {
    let lo = lo as usize;
    let bin = |x: T| (x.into() as usize).saturating_sub(lo);
    in_parts(voxels, (hi - lo as f32) as usize + 1, bin)
}

/// Counts the voxels of each of `num_bins` bins; the last takes what is beyond.
fn in_parts<T: Copy + Sync>(voxels: &[T], num_bins: usize, bin: impl Fn(T) -> usize + Sync) -> Vec<u64> {
    let last = num_bins - 1;
    let add = |mut sum: Vec<u64>, part: &[T]| {
        // Neighbours are often equal, and in one table each would wait for the previous count.
        let mut tables = [(); 4].map(|()| vec![0u32; num_bins]);
        let (fours, rest) = part.as_chunks::<4>();
        for four in fours {
            for (table, &x) in tables.iter_mut().zip(four) {
                table[bin(x).min(last)] += 1;
            }
        }
        rest.iter().for_each(|&x| tables[0][bin(x).min(last)] += 1);
        for table in tables {
            sum.iter_mut().zip(table).for_each(|(sum, n)| *sum += u64::from(n));
        }
        sum
    };
    let both = |mut a: Vec<u64>, b: Vec<u64>| {
        a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
        a
    };
    let none = || vec![0; num_bins];
    voxels.par_chunks(PART).fold(none, add).reduce(none, both)
}

/// Counts voxels in [`NUM_BINS`] equal bins; the first and the last take those outside.
fn in_bins(voxels: &[f32], (lo, hi): (f32, f32)) -> Vec<u64> {
    // Double precision: the range may be shorter than the inverse of the greatest float.
    let lo = f64::from(lo);
    let scale = NUM_BINS as f64 / (f64::from(hi) - lo).max(f64::MIN_POSITIVE);
    in_parts(voxels, NUM_BINS, |x| ((f64::from(x) - lo) * scale) as usize)
}

/// Spreads what was counted in small bins over [`NUM_BINS`] equal ones; the first and the last take those outside.
fn spread(bins: &[(f32, f32, u64)], (lo, hi): (f32, f32)) -> Vec<u64> {
    let lo = f64::from(lo);
    let scale = NUM_BINS as f64 / (f64::from(hi) - lo).max(f64::MIN_POSITIVE);
    let bin = |x: f32| (((f64::from(x) - lo) * scale) as usize).min(NUM_BINS - 1);
    let mut counts = vec![0; NUM_BINS];
    for &(from, to, n) in bins {
        let (first, last) = (bin(from), bin(to));
        let width = (last - first + 1) as u64;
        for (i, at) in (first..=last).enumerate() {
            counts[at] += n / width + u64::from((i as u64) < n % width);
        }
    }
    counts
}

/// The range of all `num_voxels` but [`TAIL`] at each end with its counts, if it is [`FAR`] times shorter than `range`,
/// which `counts` cover. `count` counts them in other ranges.
fn bulk(
    num_voxels: u64,
    mut range: (f32, f32),
    counts: &[u64],
    count: &mut dyn FnMut((f32, f32)) -> Vec<u64>,
) -> Option<((f32, f32), Vec<u64>)> {
    let tail = (num_voxels as f64 * TAIL) as u64;
    let from_below = |counts: &mut dyn Iterator<Item = &u64>| {
        let mut seen = 0;
        counts
            .take_while(|n| {
                seen += **n;
                seen <= tail
            })
            .count()
    };
    let (whole, mut counts) = (range, counts.to_vec());
    loop {
        let first = from_below(&mut counts.iter());
        let after = NUM_BINS - from_below(&mut counts.iter().rev());
        if (after - first) * FAR >= NUM_BINS {
            return (range != whole).then_some((range, counts));
        }
        let at = |bin: usize| {
            let (lo, hi) = (f64::from(range.0), f64::from(range.1));
            (lo + (hi - lo) * (bin as f64 / NUM_BINS as f64)) as f32
        };
        // The ends are stored, because beside distant values the others may be below the rounding.
        let inner = (
            if first == 0 { range.0 } else { at(first) },
            if after == NUM_BINS { range.1 } else { at(after) },
        );
        // There is one value and a few others, and the others matter.
        if inner.0 >= inner.1 || inner == range {
            return None;
        }
        range = inner;
        counts = count(range);
    }
}

/// See [`Histogram::parting_value`]; `counts` belong to equal bins over `range`.
pub fn parting_value(counts: &[u64], (lo, hi): (f32, f32)) -> f32 {
    let total: f64 = counts.iter().map(|&n| n as f64).sum();
    let moment: f64 = counts.iter().enumerate().map(|(i, &n)| i as f64 * n as f64).sum();
    let (mut below, mut moment_below) = (0.0, 0.0);
    let (mut greatest, mut first, mut last) = (0.0, 0, 0);
    for (i, &n) in counts.iter().enumerate() {
        below += n as f64;
        moment_below += i as f64 * n as f64;
        let above = total - below;
        if below <= 0.0 || above <= 0.0 {
            continue;
        }
        let apart = moment_below / below - (moment - moment_below) / above;
        let between = below * above * apart * apart;
        if between > greatest {
            (greatest, first) = (between, i);
        }
        // The variance stays equal across an empty gap; its middle is as far from both sides.
        if between >= greatest {
            last = i;
        }
    }
    let at = (0.5 * (first + last) as f64 + 1.0) / counts.len().max(1) as f64;
    (f64::from(lo) + (f64::from(hi) - f64::from(lo)) * at) as f32
}

const NUM_BINS: usize = 65_536;
/// Voxels in one thread's share: many times the bins.
const PART: usize = 1 << 21;
/// Fraction of voxels at either end that bins may skip.
const TAIL: f64 = 1e-4;
/// Gain in resolution that justifies skipping them.
const FAR: usize = 16;

/// Most voxels that are copied at a time to be counted.
const MOST_COPIED: usize = 1 << 24;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::volume::VolumeInfo;
    use glam::Vec3;

    const MAX: f32 = Volume::MAX_MAGNITUDE;

    fn percentiles(voxels: [f32; 4]) -> [f32; 3] {
        let dims = [4, 1, 1];
        let volume =
            Volume::new(dims, Vec3::ONE, Voxels::F32(voxels.into()), (1.0, 0.0), VolumeInfo::default());
        let histogram = Histogram::of(&volume.unwrap());
        assert_eq!(histogram.counts.iter().sum::<u64>(), 4);
        [0.0, 50.0, 100.0].map(|p| histogram.percentile(p))
    }

    #[test]
    fn counts_of_many_threads_are_those_of_one() {
        // More than one part, and one that is no multiple of four.
        let number = |i: u64| (i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 56) as u16;
        let voxels: Vec<u16> = (0..PART as u64 + 77).map(|i| 300 + number(i)).collect();
        let mut expected = vec![0u64; 256];
        voxels.iter().for_each(|&x| expected[usize::from(x) - 300] += 1);
        assert_eq!(counted(&voxels, 300.0, 555.0), expected);
        expected[0] += 1;
        assert_ne!(counted(&voxels, 300.0, 555.0), expected);
    }

    #[test]
    fn the_parting_value_lies_between_two_heaps() {
        let heaps = |x: usize| u64::from(x % 60 < 5) * 100;
        let counts: Vec<u64> = (0..100).map(heaps).collect();
        // Bins 0 to 4 and 60 to 64 of a hundred over 0 to 1: the gap is .05 to .60.
        let at = parting_value(&counts, (0.0, 1.0));
        assert!((at - 0.325).abs() < 0.011, "{at}");
        assert_eq!(parting_value(&[7], (2.0, 2.0)), 2.0);
        assert!(parting_value(&[], (0.0, 1.0)).is_finite());
        assert!((-MAX..=MAX).contains(&parting_value(&[3, 1, 4], (-MAX, MAX))));
    }

    #[test]
    fn what_lies_far_away_leaves_the_others_their_bins() {
        let of = |voxels: Vec<f32>, map: (f32, f32)| {
            let dims = [voxels.len() as u32, 1, 1];
            let dims = if dims[0] > 2048 { [dims[0] / 64, 8, 8] } else { dims };
            let info = VolumeInfo::default();
            Histogram::of(&Volume::new(dims, Vec3::ONE, Voxels::F32(voxels), map, info).unwrap())
        };
        let ramp = |outlier: Option<f32>| -> Vec<f32> {
            (0..64_000).map(|i| outlier.filter(|_| i == 40).unwrap_or((i % 1000) as f32)).collect()
        };
        for outlier in [None, Some(1e8), Some(-1e30), Some(MAX), Some(-MAX)] {
            let h = of(ramp(outlier), (1.0, 0.0));
            for percent in [1.0, 25.0, 50.0, 99.0] {
                let (found, expected) = (h.percentile(percent), 10.0 * percent - 1.0);
                assert!((found - expected).abs() < 1.1, "{outlier:?} {percent} %: {found}");
            }
            let ends = [h.percentile(0.0), h.percentile(100.0)];
            let all = outlier.unwrap_or(500.0);
            assert_eq!(ends, [all.min(0.0), all.max(999.0)]);
            let [lo, hi] = [0.0, 100.0].map(|percent| h.bulk_percentile(percent));
            assert!(lo > -16_000.0 && hi < 16_000.0, "{outlier:?}: {lo} to {hi}");
            assert!((h.parting_value() - 500.0).abs() < 10.0, "{}", h.parting_value());
            assert_eq!(h.counts.iter().sum::<u64>(), 64_000);
            // Numbers that fall where values rise.
            let falling = of(ramp(outlier), (-0.5, 1.0));
            assert!((falling.percentile(25.0) + 373.5).abs() < 1.0, "{}", falling.percentile(25.0));
        }
        // Nothing but a few voxels in nothing: they are what there is to see.
        let mut sparse = vec![0.0; 64_000];
        sparse[7] = 5.0;
        let h = of(sparse, (1.0, 0.0));
        assert_eq!((h.lo, h.hi, h.percentile(99.0)), (0.0, 5.0, 0.0));
    }

    #[test]
    fn percentiles_of_any_finite_range_are_in_it() {
        let [lo, half, hi] = percentiles([0.0, 1.0, 2.0, 3.0]);
        // A bin is 3/65536 wide.
        assert!(lo == 0.0 && (half - 1.0).abs() < 1e-4 && hi == 3.0, "{lo} {half} {hi}");
        assert_eq!(percentiles([5.0; 4]), [5.0; 3]);
        let [lo, half, hi] = percentiles([-MAX, 0.0, 1.0, MAX]);
        assert!(lo == -MAX && half.abs() < 1e33 && hi == MAX, "{lo} {half} {hi}");
        let [lo, half, hi] = percentiles([0.0, 1e-40, 2e-40, 3e-40]);
        assert!(lo == 0.0 && (half / 1e-40 - 1.0).abs() < 1e-2 && hi == 3e-40, "{lo} {half} {hi}");
    }
}
