//! Prepares transfer functions for one volume, which gives their domain and unit length a meaning.

use super::{Histogram, Volume};
use crate::transfer::{Domain, TransferFunction, TransferTable, UnitLength, integrated};

impl TransferFunction {
    /// The table for one volume. `histogram` must be the volume's own.
    pub fn table(&self, volume: &Volume, histogram: &Histogram) -> TransferTable {
        let unit_length = match self.unit_length {
            UnitLength::Voxel => volume.spacing().to_array().iter().product::<f32>().cbrt(),
            UnitLength::World(l) => l,
            UnitLength::Radius(r) => r * volume.bounds().radius(),
        };
        self.tabulate(unit_length, self.x_map(volume, histogram))
    }

    /// The table of [`Self::shown`] for one volume, with the greatest channel in place of extinction.
    pub fn shown_table(&self, volume: &Volume, histogram: &Histogram) -> TransferTable {
        let shown = |x: f32| {
            let c = self.shown(x);
            [c[0], c[1], c[2], c[0].max(c[1]).max(c[2])].map(f64::from)
        };
        integrated(shown, self.x_map(volume, histogram))
    }

    /// The same function over this volume's values, so that other volumes look alike.
    pub fn at_values(&self, volume: &Volume, histogram: &Histogram) -> Self {
        let (lo, hi) = self.domain_in(volume, histogram);
        let domain = if hi > lo { Domain::Values(lo, hi) } else { self.domain };
        Self { domain, ..self.clone() }
    }

    /// The values that the domain stands for in a volume.
    fn domain_in(&self, volume: &Volume, histogram: &Histogram) -> (f32, f32) {
        match self.domain {
            Domain::Full => volume.value_range(),
            Domain::Values(a, b) => (a, b),
            // A few voxels far away from all others do not end a domain.
            Domain::Percentiles(a, b) => match (histogram.bulk_percentile(a), histogram.bulk_percentile(b)) {
                // Nearly all voxels are equal, so the few others matter.
                (lo, hi) if lo >= hi => (histogram.lo, histogram.hi),
                between => between,
            },
        }
    }

    /// From stored numbers s to positions: s·`.0` + `.1`.
    fn x_map(&self, volume: &Volume, histogram: &Histogram) -> (f32, f32) {
        let (lo, hi) = self.domain_in(volume, histogram);
        let (scale, offset) = volume.value_map();
        // Double precision: the span may be shorter than the inverse of the greatest float.
        let (lo, span) = (f64::from(lo), if hi > lo { f64::from(hi) - f64::from(lo) } else { 1.0 });
        let finite = |x: f64| (x as f32).clamp(f32::MIN, f32::MAX);
        (finite(f64::from(scale) / span), finite((f64::from(offset) - lo) / span))
    }
}
