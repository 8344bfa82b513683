//! Histogram of the physical values, and the percentiles read from it.

use super::grid::{Volume, Voxels};

/// Counts of voxels over equal bins between the least and the greatest value.
#[derive(Clone, Debug)]
pub struct Histogram {
    /// Value at the left edge of the first bin.
    pub lo: f32,
    /// Value at the right edge of the last bin.
    pub hi: f32,
    /// Voxels in each bin.
    pub counts: Vec<u64>,
}

impl Histogram {
    /// The histogram of a volume in at most 65 536 bins: exact for 8- and 16-bit volumes.
    pub fn of(volume: &Volume) -> Self {
        let (stored_lo, stored_hi) = volume.stored_range();
        let num_bins = match volume.voxels() {
            Voxels::F32(_) => 65_536,
            _ => (stored_hi - stored_lo) as usize + 1,
        };
        let mut counts = vec![0u64; num_bins];
        match volume.voxels() {
            Voxels::U8(v) => v.iter().for_each(|&x| counts[x as usize - stored_lo as usize] += 1),
            Voxels::U16(v) => v.iter().for_each(|&x| counts[x as usize - stored_lo as usize] += 1),
            Voxels::F32(v) => {
                // In double precision: the range may be shorter than the inverse of the greatest float.
                let lo = f64::from(stored_lo);
                let scale = num_bins as f64 / (f64::from(stored_hi) - lo).max(f64::MIN_POSITIVE);
                for &x in v {
                    counts[(((f64::from(x) - lo) * scale) as usize).min(num_bins - 1)] += 1;
                }
            }
        }
        let (a, b) = (volume.value_from_stored(stored_lo), volume.value_from_stored(stored_hi));
        if b < a {
            counts.reverse();
        }
        Self { lo: a.min(b), hi: a.max(b), counts }
    }

    /// The least value with at least `percent` % of the voxels at or below it.
    pub fn percentile(&self, percent: f32) -> f32 {
        let total: u64 = self.counts.iter().sum();
        let wanted = (f64::from(percent.clamp(0.0, 100.0)) / 100.0 * total as f64).ceil().max(1.0) as u64;
        let mut seen = 0;
        let last = (self.counts.len() - 1).max(1) as f64;
        let (lo, hi) = (f64::from(self.lo), f64::from(self.hi));
        for (i, n) in self.counts.iter().enumerate() {
            seen += n;
            if seen >= wanted {
                return (lo + (hi - lo) * (i as f64 / last)) as f32;
            }
        }
        self.hi
    }

    /// The value that parts the voxels best into lower and higher ones: the greatest variance between the two (Otsu 1979).
    pub fn parting_value(&self) -> f32 {
        parting_value(&self.counts, (self.lo, self.hi))
    }
}

/// See [`Histogram::parting_value`]; `counts` are those of equal bins over `range`.
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
        // Over a gap without voxels it stays: the middle of that is as far from both.
        if between >= greatest {
            last = i;
        }
    }
    let at = (0.5 * (first + last) as f64 + 1.0) / counts.len().max(1) as f64;
    (f64::from(lo) + (f64::from(hi) - f64::from(lo)) * at) as f32
}

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
