//! Lists of the projections: the greatest, the least and the mean value along a ray. Twin of
//! `shaders/layering/projection.wgsl`.
//!
//! Nothing hides anything in a projection, so matter counts alike everywhere on a ray. Only a segment's error within
//! its own interval matters. `super::stream` makes segments of steps, with the budget of [`super::budget`]; a few
//! sums over a piece give its error.
//!
//! *Greatest key.* A segment shows one key v wherever a turned ray crosses it. With the keys y(s) along its interval,
//! its error is the integral of (v − y)² over its length. The square of its peak weights it, because low keys are
//! seldom the greatest on any ray. v lies between the mean of y and the peak, by `PEAK_SHARE`. A turned ray crosses
//! many segments and shows the greatest key, so means are too low by a tenth of the error. Peaks are too high after
//! large turns. The segment with the greatest key of its ray keeps that key, and all others get lower ones. So the
//! view from the same pose is exact.
//!
//! *Mean.* A segment spreads what it shows evenly over its length, which displaces it in a view from the side. The
//! error is what the segment shows times the distance between the two distributions: that of their means and of their
//! deviations.

use super::budget::NUM_THRESHOLDS;
use super::stream::{Piece, PieceStream};
use super::{Listing, OpenSegment, SegmentList};
use crate::kernels::march::modes::{Values, shown_of_key};
use crate::kernels::march::{Advance, Lattice, Scene, Sink, Step, Texels};
use crate::kernels::raycast::greater;
use crate::layer::{KEY_LEAST, half_below, slot_from_key};
use crate::mode::{Compositing, Mode};

/// Fills `list` for a ray with at most `longest` segments, whose errors are at most `threshold`.
pub(super) fn list<T: Texels>(of: &Listing<'_, T>, longest: usize, threshold: f32, list: &mut SegmentList) {
    let mut sink = ProjectionLister::new(of, [threshold], longest, list);
    of.marcher.project(&of.ray, of.lattice, &mut sink);
    sink.finish();
}

/// Number of segments of a ray at several thresholds.
pub(super) fn counts<T: Texels>(
    of: &Listing<'_, T>,
    longest: usize,
    thresholds: &[f32; NUM_THRESHOLDS],
) -> [u32; NUM_THRESHOLDS] {
    let mut unused = SegmentList::default();
    let mut sink = ProjectionLister::new(of, *thresholds, longest, &mut unused);
    of.marcher.project(&of.ray, of.lattice, &mut sink);
    sink.count()
}

/// A piece of a ray, by sums over its steps.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct ProjectionPiece {
    pub(super) s0: f32,
    pub(super) s1: f32,
    /// Greatest key.
    pub(super) peak: f32,
    /// Integrals of the key and its square. For a mean: of the brightness, and of the brightness times the distance.
    pub(super) first: f32,
    pub(super) second: f32,
    /// Integral of the brightness times the square of the distance.
    pub(super) third: f32,
    /// Integral of the shown colour.
    pub(super) shown: glam::Vec3,
}

pub(super) struct RayConstants {
    compositing: Compositing,
    lattice: Lattice,
    /// See [`key_limit`](crate::kernels::march::modes::key_limit).
    key_limit: f32,
}

impl RayConstants {
    /// Of a ray whose whole lattice is this.
    pub(super) fn of<T: Texels>(of: &Listing<'_, T>, lattice: Lattice) -> Self {
        let compositing = of.scene.settings.mode.compositing();
        Self { compositing, lattice, key_limit: of.marcher.key_limit }
    }
}

impl ProjectionPiece {
    pub(super) fn of(step: &Step, ray: &RayConstants) -> Self {
        let length = step.s1 - step.s0;
        let ends = Self { s0: step.s0, s1: step.s1, ..Self::default() };
        if ray.compositing == Compositing::Mean {
            let brightness = step.c.max_element();
            let middle = 0.5 * (step.s0 + step.s1) - ray.lattice.s0;
            let around = middle * middle + length * length * (1.0 / 12.0);
            let (first, second, third) = (brightness, brightness * middle, brightness * around);
            return Self { first, second, third, shown: step.c, ..ends };
        }
        let Values { peak, mean, square } = Values::of(step);
        Self { peak, first: mean * length, second: square * length, ..ends }
    }

    /// The key of a segment that does not hold the greatest of its ray.
    fn key(&self) -> f32 {
        let mean = self.first / (self.s1 - self.s0);
        mean + (self.peak - mean) * PEAK_SHARE
    }
}

impl Piece for ProjectionPiece {
    type Ray = RayConstants;

    #[inline(always)]
    fn joined(&self, behind: &Self, _: &RayConstants) -> Self {
        Self {
            s0: self.s0,
            s1: behind.s1,
            peak: greater(self.peak, behind.peak),
            first: self.first + behind.first,
            second: self.second + behind.second,
            third: self.third + behind.third,
            shown: self.shown + behind.shown,
        }
    }

    #[inline(always)]
    fn error(&self, ray: &RayConstants) -> f32 {
        let (length, h) = (self.s1 - self.s0, ray.lattice.unit);
        let error = if ray.compositing == Compositing::Mean {
            let per_brightness = 1.0 / self.first.max(BRIGHTNESS_LEAST);
            let mean = self.second * per_brightness;
            let deviation = (self.third * per_brightness - mean * mean).max(0.0).sqrt();
            let middle = 0.5 * (self.s0 + self.s1) - ray.lattice.s0;
            let apart = (mean - middle).abs() + (deviation - length * EVEN_DEVIATION).abs();
            self.first * apart / (h * h)
        } else {
            let v = self.key();
            let square = v * v * length - 2.0 * v * self.first + self.second;
            self.peak * self.peak * square.max(0.0) / h
        };
        // In huge volumes errors are infinite. Then pieces are simply joined.
        if error.is_nan() { 0.0 } else { error }
    }

    #[inline(always)]
    fn s1(&self) -> f32 {
        self.s1
    }
}

/// Makes a list, or counts at several thresholds.
pub(super) struct ProjectionLister<'a, const N: usize> {
    scene: &'a Scene,
    ray: RayConstants,
    streams: [PieceStream<ProjectionPiece>; N],
    /// The state of each stream.
    kept: [Kept; N],
    written: Written<'a>,
}

/// The number of segments so far, and their greatest peak.
#[derive(Clone, Copy, Debug)]
struct Kept {
    num: u32,
    greatest: f32,
}

impl Kept {
    const NONE: Self = Self { num: 0, greatest: -1.0 };

    /// Whether a piece shows or hides anything, or holds the greatest key so far.
    fn keeps(&self, part: &ProjectionPiece, ray: &RayConstants) -> bool {
        match ray.compositing {
            Compositing::Mean => part.first > 0.0,
            _ => part.peak > self.greatest || part.key() > ray.key_limit,
        }
    }

    fn add(&mut self, part: &ProjectionPiece, ray: &RayConstants) {
        self.num += u32::from(self.keeps(part, ray));
        self.greatest = greater(self.greatest, part.peak);
    }
}

struct Written<'a> {
    list: &'a mut SegmentList,
    kept: Kept,
    /// Index of the first segment with the greatest peak.
    of: usize,
}

impl<'a, const N: usize> ProjectionLister<'a, N> {
    pub(super) fn new<T: Texels>(
        of: &Listing<'a, T>,
        thresholds: [f32; N],
        longest: usize,
        list: &'a mut SegmentList,
    ) -> Self {
        let ray = RayConstants::of(of, of.lattice);
        let streams = thresholds.map(|threshold| PieceStream::new(threshold, longest, &of.lattice));
        let written = Written { list, kept: Kept::NONE, of: 0 };
        Self { scene: of.scene, ray, streams, kept: [Kept::NONE; N], written }
    }

    pub(super) fn count(mut self) -> [u32; N] {
        for (stream, kept) in self.streams.iter_mut().zip(&mut self.kept) {
            stream.finish(&self.ray, |part| kept.add(part, &self.ray));
        }
        self.kept.map(|kept| kept.num)
    }

    pub(super) fn finish(mut self) {
        let Self { scene, ray, streams, written, .. } = &mut self;
        for stream in streams {
            stream.finish(ray, |part| written.push(scene, ray, part));
        }
        written.finish(scene, ray);
    }
}

impl Written<'_> {
    fn push(&mut self, scene: &Scene, ray: &RayConstants, part: &ProjectionPiece) {
        let ends = OpenSegment { s0: part.s0, s1: part.s1, ..OpenSegment::default() };
        let is_kept = self.kept.keeps(part, ray);
        if part.peak > self.kept.greatest {
            self.of = self.list.len;
        }
        self.kept.add(part, ray);
        if !is_kept {
            return;
        }
        if ray.compositing == Compositing::Mean {
            let length = ray.lattice.h * ray.lattice.n as f32;
            self.list.push(OpenSegment { c: part.shown / length, ..ends });
            return;
        }
        let key = part.key();
        let c = shown_of_key(&scene.table, scene.settings.mode == Mode::MinIp, key);
        self.list.push(OpenSegment { c, tau: slot_from_key(key), ..ends });
    }

    /// Gives the ray's greatest key to the segment that holds it, and lower ones to all others.
    fn finish(&mut self, scene: &Scene, ray: &RayConstants) {
        if ray.compositing == Compositing::Mean || self.list.len == 0 {
            return;
        }
        // The greatest key stays at least one codec step above those below it.
        let greatest = self.kept.greatest.max(2.0 * KEY_LEAST);
        let slot = slot_from_key(greatest);
        let below = half_below(slot);
        for segment in &mut self.list.segments[..self.list.len] {
            segment.tau = segment.tau.min(below);
        }
        let holder = &mut self.list.segments[self.of];
        holder.c = shown_of_key(&scene.table, scene.settings.mode == Mode::MinIp, greatest);
        holder.tau = slot;
    }
}

impl<const N: usize> ProjectionLister<'_, N> {
    /// Takes the next piece, or step, of the ray.
    #[inline(always)]
    pub(super) fn take(&mut self, part: ProjectionPiece) {
        let Self { scene, ray, streams, kept, written } = self;
        for (stream, kept) in streams.iter_mut().zip(kept) {
            stream.step(ray, part, part.s0, |part| match N {
                1 => written.push(scene, ray, part),
                _ => kept.add(part, ray),
            });
        }
    }
}

impl<const N: usize> Sink for ProjectionLister<'_, N> {
    #[inline(always)]
    fn step(&mut self, step: Step) -> Advance {
        self.take(ProjectionPiece::of(&step, &self.ray));
        Advance::Step
    }
}

/// Position between the mean key of a piece (0) and its greatest (1): see [`ProjectionPiece::key`].
const PEAK_SHARE: f32 = 0.75;
/// Standard deviation of a uniform distribution, in lengths: 1/√12.
const EVEN_DEVIATION: f32 = 0.288_675_13;
const BRIGHTNESS_LEAST: f32 = 1e-30;
