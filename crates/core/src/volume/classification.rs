//! Prepares transfer functions for one volume, which gives their domain and unit length a meaning.

use super::{Histogram, Volume, label_color, sample_places};
use crate::picture::linear_from_srgb;
use crate::transfer::{
    Domain, TABLE_BINS, TransferFunction, TransferTable, UnitLength, integrated, label_table,
};

impl TransferFunction {
    /// The table for one volume. `histogram` must be the volume's own.
    pub fn table(&self, volume: &Volume, histogram: &Histogram) -> TransferTable {
        self.tabulate(self.unit_length_in(volume), self.x_map(volume, histogram))
    }

    /// The table for a volume of labels: their own colours, with the function's greatest opacity. Labels in `hidden`,
    /// ascending, and label 0 are not shown.
    pub fn label_table(&self, volume: &Volume, hidden: &[u16]) -> TransferTable {
        let opacity = self.points.iter().map(|p| p.opacity).fold(0.0, f32::max);
        let color = |label: u16| {
            let is_shown = hidden.binary_search(&label).is_err();
            is_shown.then(|| label_color(u32::from(label), &volume.info.labels))
        };
        let linear = |c: [u8; 3]| c.map(|c| linear_from_srgb(f32::from(c) / 255.0));
        let color = |label: u16| color(label).map(linear);
        label_table(color, opacity, self.unit_length_in(volume), volume.value_map())
    }

    /// The unit length in a volume, world units.
    pub fn unit_length_in(&self, volume: &Volume) -> f32 {
        match self.unit_length {
            UnitLength::Voxel => volume.voxel_side(),
            UnitLength::World(l) => l,
            UnitLength::Radius(r) => r * volume.bounds().radius(),
        }
    }

    /// The table of [`Self::shown`] for one volume, with the greatest channel in place of extinction.
    pub fn shown_table(&self, volume: &Volume, histogram: &Histogram) -> TransferTable {
        let shown = |x: f32| {
            let c = self.shown(x);
            [c[0], c[1], c[2], c[0].max(c[1]).max(c[2])].map(f64::from)
        };
        integrated(shown, self.x_map(volume, histogram))
    }

    /// The brightness of averages: a factor on [`Self::shown_table`] with which the brightest averages along the
    /// volume's axes fill the range. Most of a ray's way is empty, so the plain mean of a scan is nearly black. The
    /// factor is at least 1, and rests on a sample of the voxels.
    pub fn exposure(&self, volume: &Volume, table: &TransferTable) -> f32 {
        let places = volume.whole_dims().map(sample_places);
        let [nx, ny, nz] = [0, 1, 2].map(|axis: usize| places[axis].len());
        // Of a part, the samples of the whole are known.
        let sample = |x: usize, y: usize, z: usize| match volume.whole() {
            Some(whole) => whole.samples.get((z * ny + y) * nx + x).copied().unwrap_or_default(),
            None => volume.stored_in_world([places[0][x], places[1][y], places[2][z]]),
        };
        let mut sums = [vec![0f32; ny * nz], vec![0f32; nx * nz], vec![0f32; nx * ny]];
        for (z, y, x) in (0..nz).flat_map(|z| (0..ny).flat_map(move |y| (0..nx).map(move |x| (z, y, x)))) {
            let at = sample(x, y, z) * table.x_scale + table.x_offset;
            let node = (at.clamp(0.0, 1.0) * TABLE_BINS as f32) as usize;
            let shown = table.density.get(node).map_or(0.0, |node| node[3]);
            for (sum, at) in sums.iter_mut().zip([z * ny + y, z * nx + x, y * nx + x]) {
                sum[at] += shown;
            }
        }
        let lengths = [nx, ny, nz];
        let means = sums.iter().zip(lengths).flat_map(|(sums, n)| sums.iter().map(move |sum| sum / n as f32));
        let mut means: Vec<f32> = means.filter(|mean| *mean > 0.0).collect();
        means.sort_by(f32::total_cmp);
        let bright = means.get(means.len() * 99 / 100).copied().unwrap_or(1.0);
        (1.0 / bright).clamp(1.0, MOST_EXPOSURE)
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
            Domain::AboutZero(percent) => {
                let ends = [100.0 - percent, percent].map(|p| histogram.bulk_percentile(p).abs());
                // Nearly all voxels are zero, so the few others matter.
                let (most, all) = (ends[0].max(ends[1]), histogram.lo.abs().max(histogram.hi.abs()));
                if most > 0.0 { (-most, most) } else { (-all, all) }
            }
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

/// Greatest exposure: a few voxels in an empty volume stay dim.
const MOST_EXPOSURE: f32 = 64.0;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transfer::ControlPoint;
    use crate::volume::{VolumeInfo, Voxels};
    use glam::Vec3;

    #[test]
    fn averages_of_sparse_matter_fill_the_range() {
        let p = |x, opacity| ControlPoint { x, color: [1.0; 3], opacity };
        let transfer = TransferFunction {
            name: "ramp".into(),
            domain: Domain::Values(0.0, 200.0),
            unit_length: UnitLength::Voxel,
            points: vec![p(0.0, 0.0), p(1.0, 0.5)],
        };
        // A box of full brightness that takes a quarter of the way along each axis, in a volume of any size.
        for side in [8u32, 100, 160] {
            let is_inside = |i: u32| (side / 2..side / 2 + side / 4).contains(&i);
            let voxels = (0..side * side * side).map(|i| {
                let all = [i % side, i / side % side, i / side / side].into_iter().all(is_inside);
                if all { 200u8 } else { 0 }
            });
            let voxels = Voxels::U8(voxels.collect());
            let volume =
                Volume::new([side; 3], Vec3::ONE, voxels, (1.0, 0.0), VolumeInfo::default()).unwrap();
            let histogram = Histogram::of(&volume);
            let exposure = transfer.exposure(&volume, &transfer.shown_table(&volume, &histogram));
            assert!((exposure - 4.0).abs() < 0.3, "{side}: {exposure}");
            // Negative control: nothing is seen at all, and nothing is multiplied.
            let clear = TransferFunction { points: vec![p(0.0, 0.0)], ..transfer.clone() };
            assert_eq!(clear.exposure(&volume, &clear.shown_table(&volume, &histogram)), 1.0);
        }
    }
}
