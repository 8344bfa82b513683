//! Edits of a transfer function. Points have values of the volume here. If one leaves the domain, the domain grows
//! and the others keep their values.

use isinglass_core::transfer::{ControlPoint, Domain, MAX_POINTS, TransferFunction};
use isinglass_core::volume::Volume;

/// A transfer function with its domain as two values of the volume.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Curve {
    pub(crate) transfer: TransferFunction,
    /// Ascending and different.
    pub(crate) domain: (f32, f32),
}

impl Curve {
    pub(crate) fn value(&self, index: usize) -> f32 {
        self.value_at(self.transfer.points[index].x)
    }

    pub(crate) fn value_at(&self, x: f32) -> f32 {
        self.domain.0 + (self.domain.1 - self.domain.0) * x
    }

    /// The position of a value: 0 to 1 inside the domain.
    pub(crate) fn position(&self, value: f32) -> f32 {
        (value - self.domain.0) / (self.domain.1 - self.domain.0)
    }

    /// sRGB and opacity at a value, interpolated between the points.
    pub(crate) fn at(&self, value: f32) -> ([f32; 3], f32) {
        let (points, x) = (&self.transfer.points, self.position(value));
        let after = points.partition_point(|p| p.x <= x);
        match (after.checked_sub(1).map(|i| points[i]), points.get(after)) {
            (Some(a), Some(b)) => {
                let t = (x - a.x) / (b.x - a.x);
                let mix = |a: f32, b: f32| a + (b - a) * t;
                (std::array::from_fn(|i| mix(a.color[i], b.color[i])), mix(a.opacity, b.opacity))
            }
            (Some(a), None) => (a.color, a.opacity),
            (None, Some(b)) => (b.color, b.opacity),
            (None, None) => ([0.0; 3], 0.0),
        }
    }

    /// The curve with point `index` moved, at most to its neighbours.
    pub(crate) fn with_point_at(&self, index: usize, value: f32, opacity: f32) -> Self {
        let mut values: Vec<f32> = (0..self.transfer.points.len()).map(|i| self.value(i)).collect();
        let least = index.checked_sub(1).map_or(-MAX_VALUE, |i| values[i]);
        let most = values.get(index + 1).copied().unwrap_or(MAX_VALUE);
        values[index] = if value.is_finite() { value.max(least).min(most) } else { values[index] };
        let mut moved = self.clone();
        moved.transfer.points[index].opacity = opacity.clamp(0.0, 1.0);
        moved.transfer.points[index].x = self.position(values[index]);
        moved.include(&values);
        moved
    }

    /// The curve with another point in the colour of its place, and its index; none if there are too many points.
    pub(crate) fn with_point(&self, value: f32, opacity: f32) -> Option<(Self, usize)> {
        if self.transfer.points.len() >= MAX_POINTS || !value.is_finite() {
            return None;
        }
        let value = value.clamp(-MAX_VALUE, MAX_VALUE);
        let x = self.position(value);
        let index = self.transfer.points.partition_point(|p| p.x <= x);
        let mut values: Vec<f32> = (0..self.transfer.points.len()).map(|i| self.value(i)).collect();
        values.insert(index, value);
        let mut more = self.clone();
        let point = ControlPoint { x, color: self.at(value).0, opacity: opacity.clamp(0.0, 1.0) };
        more.transfer.points.insert(index, point);
        more.include(&values);
        Some((more, index))
    }

    /// The curve without a point; none if it is the last one.
    pub(crate) fn without_point(&self, index: usize) -> Option<Self> {
        let mut less = self.clone();
        if less.transfer.points.len() < 2 || index >= less.transfer.points.len() {
            return None;
        }
        less.transfer.points.remove(index);
        Some(less)
    }

    /// The curve with another sRGB colour of a point.
    pub(crate) fn with_color(&self, index: usize, color: [f32; 3]) -> Self {
        let mut colored = self.clone();
        colored.transfer.points[index].color = color.map(|c| c.clamp(0.0, 1.0));
        colored
    }

    /// The curve stretched to the values from `lo` to `hi`. Invalid ones leave it as it is.
    pub(crate) fn with_domain(&self, lo: f32, hi: f32) -> Self {
        let mut stretched = self.clone();
        if lo.abs() <= MAX_VALUE && hi.abs() <= MAX_VALUE && lo < hi {
            stretched.domain = (lo, hi);
            stretched.transfer.domain = Domain::Values(lo, hi);
        }
        stretched
    }

    /// Level and window: middle and width of the domain.
    pub(crate) fn level_and_window(&self) -> (f32, f32) {
        let (lo, hi) = self.domain;
        (lo + (hi - lo) * 0.5, hi - lo)
    }

    /// The curve with another level and window, the window at least `least` wide.
    pub(crate) fn with_level_and_window(&self, level: f32, window: f32, least: f32) -> Self {
        let half = window.max(least) * 0.5;
        self.with_domain(level - half, level + half)
    }

    /// Grows the domain to hold the values of the points.
    fn include(&mut self, values: &[f32]) {
        let (Some(&first), Some(&last)) = (values.first(), values.last()) else { return };
        let (lo, hi) = (self.domain.0.min(first), self.domain.1.max(last));
        if (lo, hi) != self.domain {
            self.domain = (lo, hi);
            self.transfer.domain = Domain::Values(lo, hi);
            for (p, &value) in self.transfer.points.iter_mut().zip(values) {
                p.x = (value - lo) / (hi - lo);
            }
        }
        for p in &mut self.transfer.points {
            p.x = p.x.clamp(0.0, 1.0);
        }
    }
}

/// The height of an opacity on its axis, 0 to 1. Useful opacities of matter one voxel thick range from a few
/// thousandths to one half: the cube root gives each of them room.
pub(crate) fn height_of(opacity: f32) -> f32 {
    opacity.clamp(0.0, 1.0).cbrt()
}

/// The inverse of [`height_of`].
pub(crate) fn opacity_at(height: f32) -> f32 {
    height.clamp(0.0, 1.0).powi(3)
}

/// No voxel has a larger value, and differences of such values are finite.
const MAX_VALUE: f32 = Volume::MAX_MAGNITUDE;

#[cfg(test)]
mod tests {
    use isinglass_core::transfer::UnitLength;

    use super::*;

    fn curve() -> Curve {
        let p = |x, opacity| ControlPoint { x, color: [x, 0.5, 0.0], opacity };
        let transfer = TransferFunction {
            name: "test".into(),
            domain: Domain::Percentiles(1.0, 99.0),
            unit_length: UnitLength::Voxel,
            points: vec![p(0.2, 0.0), p(0.5, 0.1), p(1.0, 0.9)],
        };
        Curve { transfer, domain: (100.0, 200.0) }
    }

    fn values(c: &Curve) -> Vec<f32> {
        (0..c.transfer.points.len()).map(|i| c.value(i)).collect()
    }

    #[test]
    fn a_point_moves_between_its_neighbours_and_the_others_stay() {
        let c = curve();
        let moved = c.with_point_at(1, 160.0, 0.4);
        assert_eq!((values(&moved), moved.transfer.points[1].opacity), (vec![120.0, 160.0, 200.0], 0.4));
        assert_eq!(moved.transfer.domain, c.transfer.domain, "percentiles stay what they are");
        assert_eq!(values(&c.with_point_at(1, 0.0, 0.4))[1], 120.0);
        assert_eq!(values(&c.with_point_at(1, 1e30, 7.0))[1], 200.0);
        assert_eq!(c.with_point_at(1, f32::NAN, -1.0).transfer.points[1].opacity, 0.0);
        for (index, value) in [(0, -1e38), (1, 0.0), (2, f32::INFINITY), (2, 1e38)] {
            assert_eq!(c.with_point_at(index, value, 0.5).transfer.validate(), Ok(()), "{index} {value}");
        }
    }

    #[test]
    fn the_domain_grows_with_the_points_and_no_other_value_changes() {
        let c = curve();
        let moved = c.with_point_at(2, 300.0, 0.9);
        assert_eq!(moved.transfer.domain, Domain::Values(100.0, 300.0));
        for (a, b) in values(&moved).iter().zip([120.0, 150.0, 300.0]) {
            assert!((a - b).abs() < 1e-4, "{a} {b}");
        }
        let (more, index) = c.with_point(50.0, 0.3).unwrap();
        assert_eq!((index, more.transfer.domain), (0, Domain::Values(50.0, 200.0)));
        for (a, b) in values(&more).iter().zip([50.0, 120.0, 150.0, 200.0]) {
            assert!((a - b).abs() < 1e-4, "{a} {b}");
        }
        assert_eq!(more.transfer.validate(), Ok(()));
    }

    #[test]
    fn a_new_point_on_the_curve_changes_nothing_and_without_it_all_is_as_before() {
        let c = curve();
        let (color, opacity) = c.at(175.0);
        let (more, index) = c.with_point(175.0, opacity).unwrap();
        assert_eq!((index, more.transfer.points[2].color), (2, color));
        for i in 0..=100 {
            let x = i as f32 / 100.0;
            assert!((more.transfer.at(x).1 - c.transfer.at(x).1).abs() < 1e-6);
        }
        assert_eq!(more.without_point(2), Some(c.clone()));
        let one = c.without_point(0).unwrap().without_point(0).unwrap();
        assert_eq!(one.without_point(0), None, "the last point stays");
        let mut full = c;
        full.transfer.points = vec![full.transfer.points[0]; MAX_POINTS];
        assert!(full.with_point(150.0, 0.5).is_none());
    }

    #[test]
    fn level_and_window_move_and_stretch_all_points() {
        let c = curve();
        assert_eq!(c.level_and_window(), (150.0, 100.0));
        let wide = c.with_level_and_window(250.0, 200.0, 1.0);
        assert_eq!(
            (values(&wide), wide.transfer.domain),
            (vec![190.0, 250.0, 350.0], Domain::Values(150.0, 350.0))
        );
        assert_eq!(wide.transfer.points, c.transfer.points);
        assert_eq!(c.with_level_and_window(0.0, -5.0, 2.0).domain, (-1.0, 1.0));
        for (lo, hi) in [(1.0, 1.0), (f32::NAN, 1.0), (0.0, f32::INFINITY), (-3e38, 3e38)] {
            assert_eq!(c.with_domain(lo, hi), c, "{lo} {hi}");
        }
    }

    #[test]
    fn the_axis_of_opacity_goes_there_and_back() {
        for opacity in [0.0, 0.004, 0.1, 0.5, 1.0] {
            assert!((opacity_at(height_of(opacity)) - opacity).abs() < 1e-6);
        }
        assert!(height_of(0.004) > 0.15, "thin matter is far enough from nothing to be taken hold of");
    }
}
