//! Edits of a transfer function: opacity points and colour stops, each by themselves. They have values of the volume
//! here. If one leaves the domain, the domain grows and the others keep their values.
//!
//! A transfer function has control points with a colour and an opacity each. The editor parts them into points for
//! the opacity and stops for the colour, and merges both after each edit. So neither moves the other.

use isinglass_core::transfer::{ControlPoint, Domain, MAX_POINTS, TransferFunction};
use isinglass_core::volume::Volume;

/// A transfer function with its domain as two values of the volume.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Curve {
    /// What the marks amount to.
    pub(crate) transfer: TransferFunction,
    /// Ascending and different.
    pub(crate) domain: (f32, f32),
    pub(crate) marks: Marks,
    /// What the whole function has besides its marks.
    pub(crate) tone: Tone,
}

/// Factors on a whole function: on its extinction, and on the sRGB of its colours.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Tone {
    pub(crate) opacity: f32,
    pub(crate) brightness: f32,
}

impl Default for Tone {
    fn default() -> Self {
        Self { opacity: 1.0, brightness: 1.0 }
    }
}

impl Tone {
    /// The opacity of a mark as the function has it. Matter as thick as `factor` units has it.
    fn of_opacity(self, opacity: f32) -> f32 {
        if self.opacity == 1.0 { opacity } else { 1.0 - (1.0 - opacity).powf(self.opacity) }
    }

    /// The opacity of the mark for one of the function.
    fn mark_opacity(self, opacity: f32) -> f32 {
        let opacity = opacity.clamp(0.0, 1.0);
        if self.opacity == 1.0 { opacity } else { 1.0 - (1.0 - opacity).powf(1.0 / self.opacity) }
    }

    pub(crate) fn of_color(self, color: [f32; 3]) -> [f32; 3] {
        color.map(|c| (c * self.brightness).min(1.0))
    }
}

/// Opacity points and colour stops, each by ascending position in the domain; at least one of each.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Marks {
    pub(crate) points: Vec<Mark<1>>,
    pub(crate) stops: Vec<Mark<3>>,
}

/// An opacity or an sRGB colour at a position.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Mark<const N: usize> {
    pub(crate) x: f32,
    pub(crate) is: [f32; N],
}

impl Marks {
    /// Parts control points. Where neither colour nor opacity bends, a point is kept for the opacity.
    pub(crate) fn of(points: &[ControlPoint]) -> Self {
        let bends = bends(points, |p| [p.opacity], STRAIGHT_OPACITY);
        let turns = self::bends(points, |p| p.color, STRAIGHT_COLOR);
        let with = |needed: &dyn Fn(usize) -> bool| -> Vec<ControlPoint> {
            points.iter().enumerate().filter(|(i, _)| needed(*i)).map(|(_, p)| *p).collect()
        };
        let opacities = with(&|i| bends[i] || !turns[i]);
        let colors = with(&|i| turns[i]);
        Self {
            points: opacities.iter().map(|p| Mark { x: p.x, is: [p.opacity] }).collect(),
            stops: colors.iter().map(|p| Mark { x: p.x, is: p.color }).collect(),
        }
    }

    /// The control points: one at every mark, two where either jumps.
    fn merged(&self, tone: Tone) -> Vec<ControlPoint> {
        let of_points = self.points.iter().map(|p| p.x);
        let mut xs: Vec<f32> = of_points.chain(self.stops.iter().map(|s| s.x)).collect();
        xs.sort_by(f32::total_cmp);
        xs.dedup();
        let mut merged = Vec::with_capacity(xs.len());
        for x in xs {
            let ([opacity], [opacity_behind]) = sides(&self.points, x);
            let (color, color_behind) = sides(&self.stops, x);
            merged.push(ControlPoint { x, color, opacity });
            if (opacity, color) != (opacity_behind, color_behind) {
                merged.push(ControlPoint { x, color: color_behind, opacity: opacity_behind });
            }
        }
        for p in &mut merged {
            (p.color, p.opacity) = (tone.of_color(p.color), tone.of_opacity(p.opacity));
        }
        merged
    }
}

/// For each point, whether something bends there. The ends always count.
fn bends<const N: usize>(
    points: &[ControlPoint],
    of: impl Fn(&ControlPoint) -> [f32; N],
    tolerance: f32,
) -> Vec<bool> {
    let mut kept = 0;
    let is_bend = |(i, p): (usize, &ControlPoint)| {
        let (a, Some(b)) = (&points[kept], points.get(i + 1)) else { return true };
        let is_between = i > 0 && a.x < p.x && p.x < b.x;
        let t = (p.x - a.x) / (b.x - a.x);
        let is_off = |n: usize| (mix(of(a)[n], of(b)[n], t) - of(p)[n]).abs() > tolerance;
        let bends = !is_between || (0..N).any(is_off);
        kept = if bends { i } else { kept };
        bends
    };
    points.iter().enumerate().map(is_bend).collect()
}

/// What holds just before and just behind a position.
fn sides<const N: usize>(marks: &[Mark<N>], x: f32) -> ([f32; N], [f32; N]) {
    let before = marks.partition_point(|m| m.x < x);
    let behind = marks.partition_point(|m| m.x <= x);
    if before < behind {
        return (marks[before].is, marks[behind - 1].is);
    }
    let is = match (before.checked_sub(1).map(|i| marks[i]), marks.get(before)) {
        (Some(a), Some(b)) => {
            let t = (x - a.x) / (b.x - a.x);
            std::array::from_fn(|n| mix(a.is[n], b.is[n], t))
        }
        (Some(end), None) => end.is,
        (None, Some(end)) => end.is,
        (None, None) => [0.0; N],
    };
    (is, is)
}

fn mix(a: f32, b: f32, t: f32) -> f32 {
    a + (b - a) * t
}

impl Curve {
    pub(crate) fn new(transfer: TransferFunction, domain: (f32, f32)) -> Self {
        let marks = Marks::of(&transfer.points);
        Self { transfer, domain, marks, tone: Tone::default() }
    }

    /// The value of an opacity point.
    pub(crate) fn value(&self, index: usize) -> f32 {
        self.value_at(self.marks.points[index].x)
    }

    pub(crate) fn opacity(&self, index: usize) -> f32 {
        self.tone.of_opacity(self.marks.points[index].is[0])
    }

    pub(crate) fn num_points(&self) -> usize {
        self.marks.points.len()
    }

    /// The value of a colour stop.
    pub(crate) fn stop_value(&self, index: usize) -> f32 {
        self.value_at(self.marks.stops[index].x)
    }

    pub(crate) fn value_at(&self, x: f32) -> f32 {
        self.domain.0 + (self.domain.1 - self.domain.0) * x
    }

    /// The position of a value: 0 to 1 inside the domain.
    pub(crate) fn position(&self, value: f32) -> f32 {
        (value - self.domain.0) / (self.domain.1 - self.domain.0)
    }

    /// sRGB and opacity at a value.
    pub(crate) fn at(&self, value: f32) -> ([f32; 3], f32) {
        let x = self.position(value);
        let (color, [opacity]) = (sides(&self.marks.stops, x).1, sides(&self.marks.points, x).1);
        (self.tone.of_color(color), self.tone.of_opacity(opacity))
    }

    /// The curve with opacity point `index` moved, at most to its neighbours. No colour moves.
    pub(crate) fn with_point_at(&self, index: usize, value: f32, opacity: f32) -> Self {
        let mut moved = self.clone();
        moved.marks.points[index].is = [self.tone.mark_opacity(opacity)];
        let xs: Vec<f32> = self.marks.points.iter().map(|p| p.x).collect();
        moved.include(self.moved(&xs, index, value));
        moved.marks.points[index].x = moved.inside(self.moved(&xs, index, value));
        moved.merged().unwrap_or_else(|| self.clone())
    }

    /// The curve with colour stop `index` moved, at most to its neighbours. No opacity moves.
    pub(crate) fn with_stop_at(&self, index: usize, value: f32) -> Self {
        let mut moved = self.clone();
        let xs: Vec<f32> = self.marks.stops.iter().map(|s| s.x).collect();
        moved.include(self.moved(&xs, index, value));
        moved.marks.stops[index].x = moved.inside(self.moved(&xs, index, value));
        moved.merged().unwrap_or_else(|| self.clone())
    }

    /// The curve with another opacity point, and its index; none if there are too many marks.
    pub(crate) fn with_point(&self, value: f32, opacity: f32) -> Option<(Self, usize)> {
        let mut more = self.clone();
        let value = value.is_finite().then_some(value.clamp(-MAX_VALUE, MAX_VALUE))?;
        more.include(value);
        let x = more.inside(value);
        let index = more.marks.points.partition_point(|p| p.x <= x);
        more.marks.points.insert(index, Mark { x, is: [self.tone.mark_opacity(opacity)] });
        Some((more.merged()?, index))
    }

    /// The curve with another colour stop in the colour of its place, and its index; none if there are too many.
    pub(crate) fn with_stop(&self, value: f32) -> Option<(Self, usize)> {
        let color = sides(&self.marks.stops, self.position(value)).1;
        let mut more = self.clone();
        let value = value.is_finite().then_some(value.clamp(-MAX_VALUE, MAX_VALUE))?;
        more.include(value);
        let x = more.inside(value);
        let index = more.marks.stops.partition_point(|s| s.x <= x);
        more.marks.stops.insert(index, Mark { x, is: color });
        Some((more.merged()?, index))
    }

    /// The curve without an opacity point; none if it is the last one.
    pub(crate) fn without_point(&self, index: usize) -> Option<Self> {
        let mut less = self.clone();
        if less.marks.points.len() < 2 || index >= less.marks.points.len() {
            return None;
        }
        less.marks.points.remove(index);
        less.merged()
    }

    /// The curve without a colour stop; none if it is the last one.
    pub(crate) fn without_stop(&self, index: usize) -> Option<Self> {
        let mut less = self.clone();
        if less.marks.stops.len() < 2 || index >= less.marks.stops.len() {
            return None;
        }
        less.marks.stops.remove(index);
        less.merged()
    }

    /// The curve with another sRGB colour of a stop.
    pub(crate) fn with_color(&self, index: usize, color: [f32; 3]) -> Self {
        let mut colored = self.clone();
        // A colour that is chosen is shown as it is, and so are the others.
        colored.marks.stops.iter_mut().for_each(|stop| stop.is = self.tone.of_color(stop.is));
        colored.tone.brightness = 1.0;
        colored.marks.stops[index].is = color.map(|c| c.clamp(0.0, 1.0));
        colored.merged().unwrap_or_else(|| self.clone())
    }

    /// The curve with the colours of control points over its domain in place of its own. No opacity changes. None if
    /// there are too many marks.
    pub(crate) fn with_colors_of(&self, points: &[ControlPoint]) -> Option<Self> {
        let mut colored = self.clone();
        colored.marks.stops = Marks::of(points).stops;
        if colored.marks.stops.is_empty() { None } else { colored.merged() }
    }

    /// The curve with another tone.
    pub(crate) fn with_tone(&self, tone: Tone) -> Self {
        Self { tone, ..self.clone() }.merged().unwrap_or_else(|| self.clone())
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

    /// The value between its neighbours to which a mark may move.
    fn moved(&self, xs: &[f32], index: usize, value: f32) -> f32 {
        let least = index.checked_sub(1).map_or(-MAX_VALUE, |i| self.value_at(xs[i]));
        let most = xs.get(index + 1).map_or(MAX_VALUE, |x| self.value_at(*x));
        if value.is_finite() { value.max(least).min(most) } else { self.value_at(xs[index]) }
    }

    fn inside(&self, value: f32) -> f32 {
        self.position(value).clamp(0.0, 1.0)
    }

    /// Grows the domain to hold a value. All marks keep their values.
    fn include(&mut self, value: f32) {
        let before = self.domain;
        let (lo, hi) = (before.0.min(value), before.1.max(value));
        if (lo, hi) == before {
            return;
        }
        self.domain = (lo, hi);
        self.transfer.domain = Domain::Values(lo, hi);
        let grown = |x: f32| ((before.0 + (before.1 - before.0) * x - lo) / (hi - lo)).clamp(0.0, 1.0);
        self.marks.points.iter_mut().for_each(|p| p.x = grown(p.x));
        self.marks.stops.iter_mut().for_each(|s| s.x = grown(s.x));
    }

    /// The transfer function anew; none if it has too many control points.
    fn merged(mut self) -> Option<Self> {
        self.transfer.points = self.marks.merged(self.tone);
        (self.transfer.points.len() <= MAX_POINTS).then_some(self)
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

/// A point within this of the line between its neighbours does not bend it: opacity, and sRGB.
const STRAIGHT_OPACITY: f32 = 2e-6;
const STRAIGHT_COLOR: f32 = 1e-4;
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
        Curve::new(transfer, (100.0, 200.0))
    }

    fn values(c: &Curve) -> Vec<f32> {
        (0..c.num_points()).map(|i| c.value(i)).collect()
    }

    #[test]
    fn a_point_moves_between_its_neighbours_and_the_others_stay() {
        let c = curve();
        let moved = c.with_point_at(1, 160.0, 0.4);
        assert_eq!((values(&moved), moved.opacity(1)), (vec![120.0, 160.0, 200.0], 0.4));
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
        let (_, opacity) = c.at(175.0);
        let (more, index) = c.with_point(175.0, opacity).unwrap();
        assert_eq!((index, &more.marks.stops), (2, &c.marks.stops));
        for i in 0..=100 {
            let x = i as f32 / 100.0;
            assert!((more.transfer.at(x).1 - c.transfer.at(x).1).abs() < 1e-6);
        }
        assert_eq!(more.without_point(2).map(|less| less.marks), Some(c.marks.clone()));
        let one = c.without_point(0).unwrap().without_point(0).unwrap();
        assert_eq!(one.without_point(0), None, "the last point stays");
        let mut full = c;
        full.marks.points =
            (0..MAX_POINTS).map(|i| Mark { x: i as f32 / 255.0, is: [(i % 2) as f32] }).collect();
        full.marks.stops.truncate(1);
        assert!(full.with_point(150.1, 0.5).is_none() && full.with_stop(150.1).is_none());
    }

    #[test]
    fn colour_and_opacity_are_apart_and_nothing_is_lost() {
        let c = curve();
        // The colours of this curve lie on one line, so two stops hold them.
        assert_eq!((c.num_points(), c.marks.stops.len()), (3, 2));
        assert_eq!(c.clone().merged().unwrap().transfer.points.len(), 3);
        let moved = c.with_point_at(1, 130.0, 0.3);
        assert_eq!(moved.marks.stops, c.marks.stops);
        let (stopped, index) = c.with_stop(140.0).unwrap();
        assert_eq!((index, &stopped.marks.points), (1, &c.marks.points));
        let red = stopped.with_color(1, [1.0, 0.0, 0.0]).with_stop_at(1, 170.0);
        assert_eq!((red.at(170.0).0, &red.marks.points), ([1.0, 0.0, 0.0], &c.marks.points));
        assert!((red.at(135.0).1 - c.at(135.0).1).abs() < 1e-6, "opacity is as before");
        // What is written and read again has the same marks, and the same curve at every value.
        let again = Curve::new(red.transfer.clone(), red.domain);
        assert_eq!(again.marks.stops.len(), 3);
        assert_eq!(again.num_points(), 3);
        for i in 0..=200 {
            let value = 90.0 + i as f32 * 0.6;
            let ((a, of_a), (b, of_b)) = (red.at(value), again.at(value));
            assert!((of_a - of_b).abs() < 1e-5 && (0..3).all(|n| (a[n] - b[n]).abs() < 1e-3), "{value}");
        }
        assert_eq!(red.without_stop(1).map(|less| less.marks.stops), Some(c.marks.stops.clone()));
        // A jump of the opacity leaves the colour whole, and the other way round.
        let jump = |x, color, opacity| ControlPoint { x, color, opacity };
        let points = vec![
            jump(0.0, [0.0; 3], 0.0),
            jump(0.5, [0.5; 3], 0.0),
            jump(0.5, [0.5; 3], 0.8),
            jump(0.7, [0.7; 3], 0.8),
            jump(0.7, [0.0; 3], 0.8),
            jump(1.0, [1.0; 3], 0.8),
        ];
        let transfer = TransferFunction { points: points.clone(), ..c.transfer };
        let jumps = Curve::new(transfer.clone(), (0.0, 1.0)).merged().unwrap();
        for i in 0..=300 {
            let x = i as f32 / 300.0;
            let ((a, of_a), (b, of_b)) = (jumps.transfer.at(x), transfer.at(x));
            assert!((of_a - of_b).abs() < 1e-5 && (a[0] - b[0]).abs() < 1e-3, "{x}: {a:?} {b:?}");
        }
    }

    #[test]
    fn the_tone_goes_there_and_back_and_is_thickness() {
        let c = curve();
        let dense = c.with_tone(Tone { opacity: 2.0, brightness: 1.5 });
        // Twice as thick: what is let through is squared.
        for (a, b) in c.transfer.points.iter().zip(&dense.transfer.points) {
            assert!(((1.0 - a.opacity).powi(2) - (1.0 - b.opacity)).abs() < 1e-6);
            assert!((b.color[0] - (a.color[0] * 1.5).min(1.0)).abs() < 1e-6);
        }
        assert_eq!(dense.transfer.validate(), Ok(()));
        assert_eq!(dense.marks, c.marks);
        assert_eq!(dense.with_tone(Tone::default()).transfer.points, c.transfer.points);
        // A point lies where it is put, and a colour is what was chosen.
        assert!((dense.with_point_at(1, 150.0, 0.3).opacity(1) - 0.3).abs() < 1e-6);
        let red = dense.with_color(1, [0.5, 0.0, 0.0]);
        assert_eq!(red.at(200.0).0, [0.5, 0.0, 0.0]);
        assert!((red.at(120.0).0[1] - dense.at(120.0).0[1]).abs() < 1e-6, "no other changes");
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
