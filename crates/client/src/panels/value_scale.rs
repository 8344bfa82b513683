//! The values of a volume: their range and histogram.

use isinglass_core::look::Look;
use isinglass_core::mode::{Isos, Mode};
use isinglass_core::transfer::Domain;
use isinglass_core::wire::{ChannelDescription, MAX_BINS, VolumeDescription};

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ValueScale {
    /// Least and greatest value, never equal.
    pub(crate) range: (f32, f32),
    /// The range of the bins; a few voxels may lie far outside.
    bins: (f32, f32),
    counts: Vec<u64>,
}

impl ValueScale {
    /// Chooses a mode.
    pub(crate) fn set_mode(&self, look: &mut Look, mode: Mode) {
        look.mode = mode;
        if mode == Mode::Iso {
            look.isos = self.shown_surfaces(look.isos);
        }
    }

    /// The surfaces that a picture shows: without any, one at the value that separates the histogram best.
    pub(crate) fn shown_surfaces(&self, isos: Isos) -> Isos {
        if isos.as_slice().is_empty() { Isos::one(self.parting_value()) } else { isos }
    }

    pub(crate) fn of(volume: &VolumeDescription) -> Self {
        let (range, bins) = (apart(volume.value_range), apart(volume.histogram_range));
        Self { range, bins, counts: volume.histogram.clone() }
    }

    pub(crate) fn of_channel(channel: &ChannelDescription) -> Self {
        let (range, bins) = (apart(channel.value_range), apart(channel.histogram_range));
        Self { range, bins, counts: channel.histogram.clone() }
    }

    /// The width of the bins' range.
    pub(crate) fn span(&self) -> f32 {
        self.bins.1 - self.bins.0
    }

    /// The value below which `percent` % of the voxels lie, interpolated within a bin.
    pub(crate) fn percentile(&self, percent: f32) -> f32 {
        if percent <= 0.0 || percent >= 100.0 {
            return if percent <= 0.0 { self.range.0 } else { self.range.1 };
        }
        let total: u64 = self.counts.iter().sum();
        let wanted = f64::from(percent) / 100.0 * total as f64;
        let mut seen = 0.0;
        for (i, &n) in self.counts.iter().enumerate() {
            let n = n as f64;
            if n > 0.0 && seen + n >= wanted {
                let within = (wanted - seen) / n;
                return self.value_at((i as f64 + within) as f32 / self.counts.len() as f32);
            }
            seen += n;
        }
        self.range.1
    }

    /// The value that separates the histogram best.
    pub(crate) fn parting_value(&self) -> f32 {
        isinglass_core::volume::parting_value(&self.counts, self.bins)
    }

    /// The two values of a domain, ascending and different.
    pub(crate) fn domain(&self, domain: &Domain) -> (f32, f32) {
        match *domain {
            Domain::Full => self.range,
            Domain::Values(a, b) => apart((a, b)),
            Domain::Percentiles(a, b) => {
                let [lo, hi] = [a, b].map(|percent| self.percentile(percent).clamp(self.bins.0, self.bins.1));
                let bin =
                    |value: f32| ((value - self.bins.0) / self.span() * self.counts.len() as f32).floor();
                // Nearly all voxels have one value, and a bin holds one number: the kernels read it in the same way.
                let is_one = self.counts.len() < MAX_BINS && bin(lo) == bin(hi);
                if is_one { self.bins } else { apart((lo, hi)) }
            }
            Domain::AboutZero(percent) => {
                let ends =
                    [100.0 - percent, percent].map(|p| self.percentile(p).clamp(self.bins.0, self.bins.1));
                let most = ends[0].abs().max(ends[1].abs());
                let all = self.bins.0.abs().max(self.bins.1.abs());
                let most = if most > 0.0 { most } else { all };
                apart((-most, most))
            }
        }
    }

    /// Share of the voxels in the bin of a value, 0 to 1.
    pub(crate) fn share(&self, value: f32) -> f32 {
        let total: u64 = self.counts.iter().sum();
        let (lo, hi) = self.bins;
        let bin = ((value - lo) / self.span() * self.counts.len() as f32).floor();
        let last = self.counts.len() as f32 - 1.0;
        // The last bin includes the greatest value.
        let bin = if value == hi { last } else { bin };
        if !(0.0..=last).contains(&bin) || total == 0 {
            return 0.0;
        }
        self.counts[bin as usize] as f32 / total as f32
    }

    /// Heights, 0 to 1, of `num` columns over the values of `view`: the largest bin in each.
    pub(crate) fn columns(&self, view: (f32, f32), num: usize, is_log: bool) -> Vec<f32> {
        let bins = self.counts.len() as f32;
        let bin_at = |x: f32| (view.0 + (view.1 - view.0) * x - self.bins.0) / self.span() * bins;
        let most_in = |column: usize| {
            let (a, b) = (bin_at(column as f32 / num as f32), bin_at((column + 1) as f32 / num as f32));
            let (a, b) = (a.floor().max(0.0), b.ceil().min(bins));
            let bins = if a < b { a as usize..b as usize } else { 0..0 };
            self.counts[bins].iter().copied().max().unwrap_or(0) as f32
        };
        let counts: Vec<f32> = (0..num).map(most_in).collect();
        let height = |n: f32| if is_log { n.ln_1p() } else { n };
        let most = counts.iter().map(|&n| height(n)).fold(f32::MIN_POSITIVE, f32::max);
        counts.iter().map(|&n| height(n) / most).collect()
    }

    fn value_at(&self, fraction: f32) -> f32 {
        self.bins.0 + self.span() * fraction
    }
}

/// Two different values, as the kernels read a domain without a length.
fn apart((lo, hi): (f32, f32)) -> (f32, f32) {
    if hi > lo { (lo, hi) } else { (lo, lo + (lo.abs() * 1e-3).max(1.0)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(crate) fn scale() -> ValueScale {
        ValueScale { range: (-100.0, 300.0), bins: (-100.0, 300.0), counts: vec![70, 0, 20, 10] }
    }

    #[test]
    fn percentiles_lie_in_their_bins() {
        let s = scale();
        for (percent, value) in
            [(0.0, -100.0), (35.0, -50.0), (70.0, 0.0), (80.0, 150.0), (90.0, 200.0), (100.0, 300.0)]
        {
            assert!((s.percentile(percent) - value).abs() < 1e-3, "{percent} %: {}", s.percentile(percent));
        }
        assert_eq!(s.domain(&Domain::Full), (-100.0, 300.0));
        assert_eq!(s.domain(&Domain::Percentiles(70.0, 90.0)), (0.0, 200.0));
        assert_eq!(s.domain(&Domain::Values(5.0, 6.0)), (5.0, 6.0));
        let far = ValueScale { range: (-100.0, 1e8), ..scale() };
        assert_eq!(far.domain(&Domain::Percentiles(70.0, 90.0)), (0.0, 200.0));
        assert_eq!(far.domain(&Domain::Percentiles(0.0, 100.0)), (-100.0, 300.0));
        assert_eq!(far.domain(&Domain::Percentiles(10.0, 60.0)), (-100.0, 300.0), "one number");
        let constant = ValueScale { range: apart((7.0, 7.0)), bins: apart((7.0, 7.0)), counts: vec![5] };
        let (lo, hi) = constant.domain(&Domain::Percentiles(50.0, 50.0));
        assert!(lo < hi && lo.is_finite() && hi.is_finite());
        let empty = ValueScale { range: (0.0, 1.0), bins: (0.0, 1.0), counts: vec![] };
        assert_eq!((empty.percentile(50.0), empty.share(0.5)), (1.0, 0.0));
        assert_eq!(empty.columns((0.0, 1.0), 3, true), [0.0; 3]);
    }

    #[test]
    fn columns_are_the_bins_at_any_zoom() {
        let s = scale();
        assert_eq!(s.columns(s.range, 4, false), [1.0, 0.0, 2.0 / 7.0, 1.0 / 7.0]);
        let log = s.columns(s.range, 4, true);
        assert!((log[2] - 21f32.ln() / 71f32.ln()).abs() < 1e-6 && log[1] == 0.0);
        assert_eq!(s.columns((100.0, 300.0), 2, false), [1.0, 0.5], "a part is scaled by itself");
        assert_eq!(s.columns((100.0, 200.0), 3, false), [1.0; 3]);
        assert_eq!(s.columns((-900.0, 700.0), 4, false), [0.0, 0.0, 1.0, 0.0], "of several bins the largest");
        assert_eq!([s.share(-50.0), s.share(150.0), s.share(300.0), s.share(301.0)], [0.7, 0.2, 0.1, 0.0]);
    }
}
