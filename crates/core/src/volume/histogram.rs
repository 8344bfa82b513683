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
                let scale = num_bins as f32 / (stored_hi - stored_lo).max(f32::MIN_POSITIVE);
                for x in v {
                    counts[(((x - stored_lo) * scale) as usize).min(num_bins - 1)] += 1;
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
        let last = (self.counts.len() - 1).max(1) as f32;
        for (i, n) in self.counts.iter().enumerate() {
            seen += n;
            if seen >= wanted {
                return self.lo + (self.hi - self.lo) * (i as f32 / last);
            }
        }
        self.hi
    }
}
