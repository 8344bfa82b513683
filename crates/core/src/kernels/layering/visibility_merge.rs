//! Lists by one march, whose segments err by no more than a threshold that the whole frame shares (ours). Twin of
//! `shaders/layering/visibility_merge.wgsl`; [`super::stream`] makes segments of steps.
//!
//! *Error of a segment.* A new ray reads a segment as a homogeneous medium. On its way through the segment's matter,
//! the old ray collects the opacity α(s) and the colour C(s); through the medium it collects α̂(s) and Ĉ(s). Both
//! agree at the two ends. The error is the displacement of what is collected, in steps of length h, weighted by its
//! visibility:
//!
//! ```text
//! e = max(κ, 0.1) · (L/h)^¼ · max(|α·(μ − μ̂)| + α·|σ − σ̂|, 6·|C·(μ_C − μ̂)|) / h
//! ```
//!
//! κ is the transmittance in front, and L the length. μ and σ are the mean and the standard deviation of the distance
//! at which opacity is collected; μ_C is the mean for colour. They follow from integrals of dα, s·dα, s²·dα and s·dC.
//! These are additive, so the error of a union costs a few operations, and opposite errors cancel. Those of the
//! medium have closed forms (`even_moments`). Hidden matter keeps a tenth of its weight, because a turned camera sees
//! it. The power of the length keeps distant matter apart.

use glam::Vec3;

use super::stream::{Piece, PieceStream};
use super::{OpenSegment, SegmentList, append};
use crate::kernels::march::{Advance, Lattice, Sink, Step};
use crate::kernels::raycast::greater;

/// A piece of a ray, by integrals over its steps.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct MatterPiece {
    pub(super) all: OpenSegment,
    /// Transmittance in front, at least [`VISIBILITY_FLOOR`].
    visibility: f32,
    /// Integrals over opacity of the distance from the front, in steps, and of its square.
    pub(super) first: f32,
    pub(super) second: f32,
    /// Integral over colour of the distance.
    pub(super) color_first: Vec3,
}

/// Number of steps per unit of world distance.
pub(super) struct StepsPerLength(pub(super) f32);

impl MatterPiece {
    #[inline(always)]
    pub(super) fn of(step: &Step, transmittance: f32, ray: &StepsPerLength) -> Self {
        let length = (step.s1 - step.s0) * ray.0;
        let (first, second) = even_moments(step.tau, step.alpha);
        Self {
            all: *step,
            visibility: greater(transmittance, VISIBILITY_FLOOR),
            first: first * length,
            second: second * length * length,
            color_first: step.c * (first * length / greater(step.alpha, ALPHA_LEAST)),
        }
    }
}

impl MatterPiece {
    /// The piece behind matter of this transmittance.
    #[inline(always)]
    pub(super) fn seen_through(self, transmittance: f32) -> Self {
        Self { visibility: greater(transmittance, VISIBILITY_FLOOR), ..self }
    }
}

impl Piece for MatterPiece {
    type Ray = StepsPerLength;

    #[inline(always)]
    fn joined(&self, behind: &Self, ray: &StepsPerLength) -> Self {
        let distance = (behind.all.s0 - self.all.s0) * ray.0;
        let through = 1.0 - self.all.alpha;
        let first = behind.first + distance * behind.all.alpha;
        let second = behind.second + distance * (behind.first + first);
        let color_first = behind.color_first + behind.all.c * distance;
        let mut all = self.all;
        append(&mut all, &behind.all);
        Self {
            all,
            visibility: self.visibility,
            first: self.first + through * first,
            second: self.second + through * second,
            color_first: self.color_first + color_first * through,
        }
    }

    #[inline(always)]
    fn error(&self, ray: &StepsPerLength) -> f32 {
        let OpenSegment { s0, s1, c, tau, alpha } = self.all;
        let length = greater((s1 - s0) * ray.0, LENGTH_LEAST);
        let per_alpha = 1.0 / greater(alpha, ALPHA_LEAST);
        let (even_first, even_second) = even_moments(tau, alpha);
        let (even_first, even_second) = (even_first * length, even_second * length * length);
        let moved = (self.first - even_first).abs();
        let spread = alpha
            * (deviation(self.first, self.second, per_alpha) - deviation(even_first, even_second, per_alpha))
                .abs();
        let color = (self.color_first - c * (even_first * per_alpha)).abs();
        let color = greater(greater(color.x, color.y), color.z);
        greater(moved + spread, COLOR_WEIGHT * color) * length.sqrt().sqrt() * self.visibility
    }

    /// Compares the fourth power of the error without its spread: this takes no root and one division.
    #[inline(always)]
    fn is_within(&self, limit: f32, ray: &StepsPerLength) -> bool {
        let OpenSegment { s0, s1, c, tau, alpha } = self.all;
        let length = (s1 - s0) * ray.0;
        let even_first = even_moments(tau, alpha).0 * length;
        let color = (self.color_first * alpha - c * even_first).abs();
        let color = greater(greater(color.x, color.y), color.z);
        let moved = (self.first - even_first).abs() * alpha;
        let error = greater(moved, COLOR_WEIGHT * color) * self.visibility;
        let (error, limit) = (error * error, (limit * alpha) * (limit * alpha));
        error * error * length <= limit * limit
    }

    #[inline(always)]
    fn s1(&self) -> f32 {
        self.all.s1
    }
}

/// ∫s dα and ∫s² dα on the way through a homogeneous medium of unit length: (1 − (1 + τ)e^−τ)/τ and
/// (2 − (2 + 2τ + τ²)e^−τ)/τ², by their series where the differences would be rounding.
#[inline(always)]
pub(super) fn even_moments(tau: f32, alpha: f32) -> (f32, f32) {
    if tau < SERIES_BELOW {
        let first = 1.0 / 2.0 - tau * (1.0 / 3.0 - tau * (1.0 / 8.0 - tau * (1.0 / 30.0)));
        let second = 1.0 / 3.0 - tau * (1.0 / 4.0 - tau * (1.0 / 10.0 - tau * (1.0 / 36.0)));
        return (tau * first, tau * second);
    }
    let through = 1.0 - alpha;
    let per_tau = 1.0 / tau;
    let first = (alpha - tau * through) * per_tau;
    let second = (2.0 * first - tau * through) * per_tau;
    (first, second)
}

/// Standard deviation of a distance, from its integrals over a total of 1/`per_total`.
#[inline(always)]
fn deviation(first: f32, second: f32, per_total: f32) -> f32 {
    let mean = first * per_total;
    greater(second * per_total - mean * mean, 0.0).sqrt()
}

/// Makes a list of the steps of one ray.
pub(super) struct Lister<'a> {
    ray: StepsPerLength,
    stream: PieceStream<MatterPiece>,
    transmittance: f32,
    list: &'a mut SegmentList,
}

impl<'a> Lister<'a> {
    /// Fills `list` from its start with at most `longest` segments.
    pub(super) fn new(threshold: f32, longest: usize, lattice: &Lattice, list: &'a mut SegmentList) -> Self {
        list.len = 0;
        let ray = StepsPerLength(1.0 / lattice.unit);
        Self { ray, stream: PieceStream::new(threshold, longest, lattice), transmittance: 1.0, list }
    }

    pub(super) fn finish(mut self) {
        let list = self.list;
        self.stream.finish(&self.ray, |matter| list.push(matter.all));
    }

    /// Takes the next piece of the ray, whatever its visibility.
    #[inline(always)]
    pub(super) fn take(&mut self, matter: MatterPiece) {
        let list = &mut *self.list;
        let OpenSegment { s0, alpha, .. } = matter.all;
        let matter = matter.seen_through(self.transmittance);
        self.stream.step(&self.ray, matter, s0, |matter| list.push(matter.all));
        self.transmittance *= 1.0 - alpha;
    }
}

impl Sink for Lister<'_> {
    #[inline(always)]
    fn step(&mut self, step: Step) -> Advance {
        self.take(MatterPiece::of(&step, self.transmittance, &self.ray));
        Advance::behind(self.transmittance)
    }
}

/// Counts the segments of one ray at several thresholds at once.
pub(super) struct Counter<const N: usize> {
    ray: StepsPerLength,
    streams: [PieceStream<MatterPiece>; N],
    transmittance: f32,
}

impl<const N: usize> Counter<N> {
    pub(super) fn new(thresholds: &[f32; N], longest: usize, lattice: &Lattice) -> Self {
        let streams = thresholds.map(|threshold| PieceStream::new(threshold, longest, lattice));
        Self { ray: StepsPerLength(1.0 / lattice.unit), streams, transmittance: 1.0 }
    }

    /// Number of segments at each threshold.
    pub(super) fn finish(mut self) -> [u32; N] {
        self.streams.each_mut().map(|stream| {
            stream.finish(&self.ray, |_| ());
            stream.num_out() as u32
        })
    }
}

impl<const N: usize> Sink for Counter<N> {
    #[inline(always)]
    fn step(&mut self, step: Step) -> Advance {
        let matter = MatterPiece::of(&step, self.transmittance, &self.ray);
        for stream in &mut self.streams {
            stream.step(&self.ray, matter, step.s0, |_| ());
        }
        self.transmittance *= 1.0 - step.alpha;
        Advance::behind(self.transmittance)
    }
}

/// Least visibility of matter. With .2 smooth media are some percent worse. With .05, matter behind leaves is a tenth
/// worse at 30°.
const VISIBILITY_FLOOR: f32 = 0.1;
/// Weight of displaced colour, as sRGB, against displaced opacity. With 3 novel views are 3 % worse, with 12 alike.
const COLOR_WEIGHT: f32 = 6.0;
/// Least opacity that is divided by.
const ALPHA_LEAST: f32 = 1e-30;
/// Least length that is divided by: surfaces may coincide.
const LENGTH_LEAST: f32 = 1e-30;
/// Below this optical depth the series are used. Their first omitted term is below 10⁻⁵, like the rounding of the
/// differences.
const SERIES_BELOW: f32 = 0.1;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::raycast::opacity;

    const RAY: StepsPerLength = StepsPerLength(1.0);

    fn step(s0: f32, s1: f32, tau: f32, color: f32) -> Step {
        let alpha = opacity(tau);
        Step { s0, s1, c: Vec3::splat(color * alpha), tau, alpha }
    }

    fn joined(steps: &[Step]) -> MatterPiece {
        let mut transmittance = 1.0;
        let mut all: Option<MatterPiece> = None;
        for step in steps {
            let matter = MatterPiece::of(step, transmittance, &RAY);
            transmittance *= 1.0 - step.alpha;
            all = Some(all.map_or(matter, |all| all.joined(&matter, &RAY)));
        }
        all.unwrap()
    }

    /// Against ∫s dα and ∫s² dα by small steps in double precision.
    #[test]
    fn moments_of_a_homogeneous_medium_have_their_closed_forms() {
        for tau in [1e-6f32, 0.01, 0.09, 0.11, 1.0, 5.0, 30.0] {
            let n = 20_000;
            let (mut first, mut second) = (0.0, 0.0);
            for i in 0..n {
                let s = (f64::from(i) + 0.5) / f64::from(n);
                let added = f64::from(tau) * (-f64::from(tau) * s).exp() / f64::from(n);
                (first, second) = (first + s * added, second + s * s * added);
            }
            let (a, b) = even_moments(tau, opacity(tau));
            // Rounding of the differences, against their size.
            assert!((f64::from(a) - first).abs() < 2e-5 * first + 1e-9, "τ = {tau}: {a}, {first}");
            assert!((f64::from(b) - second).abs() < 2e-4 * second + 1e-9, "τ = {tau}: {b}, {second}");
        }
    }

    #[test]
    fn parts_of_a_homogeneous_medium_are_one_without_error() {
        for tau in [0.001, 0.3, 2.0, 9.0] {
            let steps: Vec<_> = (0..40).map(|i| step(i as f32, i as f32 + 1.0, tau / 40.0, 0.7)).collect();
            let error = joined(&steps).error(&RAY);
            // A fortieth of a step over forty of them is rounding; a gap of a step is not.
            assert!(error < 0.02 * opacity(tau), "τ = {tau}: {error}");
            let mut apart = steps.clone();
            apart[20..].iter_mut().for_each(|s| (s.s0, s.s1) = (s.s0 + 10.0, s.s1 + 10.0));
            assert!(joined(&apart).error(&RAY) > 5.0 * error.max(0.02 * opacity(tau)), "τ = {tau}");
        }
    }

    /// Matter on one side of a segment is displaced by a quarter of its length; a colour that changes half way, too.
    #[test]
    fn displaced_matter_and_displaced_colour_cost_what_they_are_off() {
        let thin = 1e-3;
        // Evenly over 10 steps, and then nothing but a trace over 10 more.
        let error = joined(&[step(0.0, 10.0, thin, 1.0), step(10.0, 20.0, 1e-6, 1.0)]).error(&RAY);
        let moved = thin * (10.0 - 5.0);
        let spread = thin * (20.0 - 10.0) / 12f32.sqrt();
        let expected = (moved + spread).max(COLOR_WEIGHT * moved) * 20f32.sqrt().sqrt();
        assert!((error / expected - 1.0).abs() < 0.01, "{error}, expected {expected}");
        // Matter without colour weighs by its opacity alone.
        let error = joined(&[step(0.0, 10.0, thin, 0.0), step(10.0, 20.0, 1e-6, 0.0)]).error(&RAY);
        let expected = (moved + spread) * 20f32.sqrt().sqrt();
        assert!((error / expected - 1.0).abs() < 0.01, "{error}, expected {expected}");
        // Of an even medium, half is bright: ∫s dC is off by a quarter of the colour's share.
        let error = joined(&[step(0.0, 10.0, thin, 1.0), step(10.0, 20.0, thin, 0.0)]).error(&RAY);
        let expected = COLOR_WEIGHT * thin * 5.0 * 20f32.sqrt().sqrt();
        assert!((error / expected - 1.0).abs() < 0.01, "{error}, expected {expected}");
    }

    /// Where the spread is none, as where matter is moved as a whole, both are the same.
    #[test]
    fn pieces_grow_to_their_error() {
        for (tau, gap) in [(0.01, 3.0), (0.5, 1.0), (4.0, 10.0)] {
            let all = joined(&[step(0.0, 1.0, tau, 0.8), step(1.0 + gap, 2.0 + gap, 1e-4 * tau, 0.8)]);
            let colored = COLOR_WEIGHT * 0.8 > 2.0;
            assert!(colored, "colour outweighs the spread");
            let error = all.error(&RAY);
            assert!(all.is_within(1.01 * error, &RAY) && !all.is_within(0.99 * error, &RAY), "τ = {tau}");
        }
    }

    #[test]
    fn hidden_matter_weighs_less_but_not_nothing() {
        let halves = |front: f32| {
            let parts = [step(0.0, 1.0, 0.1, 1.0), step(5.0, 6.0, 0.1, 1.0)];
            let of = |s: &Step| MatterPiece::of(s, front, &RAY);
            of(&parts[0]).joined(&of(&parts[1]), &RAY).error(&RAY)
        };
        assert!((halves(0.5) / halves(1.0) - 0.5).abs() < 1e-5);
        assert!((halves(1e-6) / halves(1.0) - VISIBILITY_FLOOR).abs() < 1e-5);
    }
}
