//! Lists of the projections: the greatest, the least and the mean value along a ray. Twin of
//! `shaders/layering/projection.wgsl`.
//!
//! Nothing hides anything here, so matter anywhere on a ray counts alike, and only what a segment gets wrong of its own
//! piece of the way does. Steps are gathered to at most [`MAX_K`] pieces and these joined, cheapest first, as
//! [`super::visibility_merge`] does it, with the same budget; but the error of a piece follows from a few sums over it
//! (`Piece::error`), so that joins need not look at its steps again.
//!
//! *Greatest key.* A segment shows one key v wherever a turned ray crosses it. With y(s) the keys on its way, its error
//! is the integral of (v − y)² over its length, weighted by the square of its peak: what is low is seldom the greatest on
//! any ray. v is the mean of y and of the peak, by `PEAK_SHARE`: a turned ray crosses many segments and shows the greatest
//! of their keys, so means are too low, by a tenth of the error, and peaks too high after large turns. The segment that holds the greatest key of its ray
//! has that key, and all others a lower one, so the view from the same pose is exact.
//!
//! *Mean.* A segment spreads what it shows evenly over its length. Seen from aside, what lay elsewhere is displaced: the
//! error is what the segment shows times the distance between the two distributions, taken as that of their means and
//! that of their deviations.

use super::visibility_merge;
use super::{Layering, OpenSegment, SegmentList};
use crate::camera::Camera;
use crate::kernels::march::modes::{Values, key_limit, shown_of_key};
use crate::kernels::march::{Lattice, Marcher, Pace, Scene, Sink, Step, Texels};
use crate::layer::{KEY_LEAST, MAX_K, half_below, slot_from_key};
use crate::mode::{Compositing, Mode};

/// The cost at which rays stop joining, see [`super::visibility_merge`].
pub fn threshold<T: Texels>(scene: &Scene, marcher: &Marcher<'_, T>, camera: &Camera, k: usize) -> f32 {
    visibility_merge::threshold_by(
        scene,
        camera,
        k,
        || Gather::new(scene),
        |gather, ray, lattice, sample| {
            gather.begin(lattice, 0.0);
            marcher.project(ray, lattice, gather);
            sample.add(gather.len, |note| gather.join(1, f32::INFINITY, note));
        },
    )
}

/// The list of a ray by a rule: at equal lengths, or all at the place of the greatest key, for comparison; else by
/// merging, to at most `most` segments and no more than joins below `threshold` leave.
pub fn list<T: Texels>(
    marcher: &Marcher<'_, T>,
    ray: &crate::space::Ray,
    lattice: Lattice,
    layering: Layering,
    (k, most, threshold): (usize, usize, f32),
    gather: &mut Gather,
) -> SegmentList {
    let cuts = match layering {
        Layering::EqualLength => k,
        Layering::SingleDepth(_) => 1,
        _ => 0,
    };
    gather.begin(lattice, visibility_merge::tolerance(threshold, k));
    gather.num_cuts = cuts;
    marcher.project(ray, lattice, gather);
    if cuts == 0 {
        gather.join(most, threshold, |_, _| ());
    }
    gather.finish(layering)
}

/// A piece of a ray, by sums over its steps.
#[derive(Clone, Copy, Debug, Default)]
struct Piece {
    s0: f32,
    s1: f32,
    /// Greatest key, and the ends of the step that has it.
    peak: f32,
    peak_ends: [f32; 2],
    /// Integrals of the key and its square; of a mean, of the brightness and of that times the distance.
    first: f32,
    second: f32,
    /// Integral of the brightness times the square of the distance.
    third: f32,
    /// Integral of what is shown.
    shown: glam::Vec3,
}

impl Piece {
    fn of(step: &Step, compositing: Compositing, origin: f32) -> Self {
        let length = step.s1 - step.s0;
        let ends = Self { s0: step.s0, s1: step.s1, peak_ends: [step.s0, step.s1], ..Self::default() };
        if compositing == Compositing::Mean {
            let brightness = step.c.max_element();
            let middle = 0.5 * (step.s0 + step.s1) - origin;
            let around = middle * middle + length * length * (1.0 / 12.0);
            let (first, second, third) = (brightness, brightness * middle, brightness * around);
            return Self { first, second, third, shown: step.c, ..ends };
        }
        let Values { peak, mean, square } = Values::of(step);
        Self { peak, first: mean * length, second: square * length, ..ends }
    }

    fn with(&self, behind: &Self) -> Self {
        let is_higher = behind.peak > self.peak;
        Self {
            s0: self.s0,
            s1: behind.s1,
            peak: if is_higher { behind.peak } else { self.peak },
            peak_ends: if is_higher { behind.peak_ends } else { self.peak_ends },
            first: self.first + behind.first,
            second: self.second + behind.second,
            third: self.third + behind.third,
            shown: self.shown + behind.shown,
        }
    }

    /// The key that it shows if it does not hold the greatest of its ray.
    fn key(&self) -> f32 {
        let mean = self.first / (self.s1 - self.s0);
        mean + (self.peak - mean) * PEAK_SHARE
    }

    /// See the module; `h` is the length of a step.
    fn error(&self, compositing: Compositing, h: f32, origin: f32) -> f32 {
        let length = self.s1 - self.s0;
        if compositing == Compositing::Mean {
            let per_brightness = 1.0 / self.first.max(BRIGHTNESS_LEAST);
            let mean = self.second * per_brightness;
            let deviation = (self.third * per_brightness - mean * mean).max(0.0).sqrt();
            let middle = 0.5 * (self.s0 + self.s1) - origin;
            let apart = (mean - middle).abs() + (deviation - length * EVEN_DEVIATION).abs();
            return self.first * apart / (h * h);
        }
        let v = self.key();
        let square = v * v * length - 2.0 * v * self.first + self.second;
        self.peak * self.peak * square.max(0.0) / h
    }
}

/// The pieces of one ray.
#[derive(Clone, Debug)]
pub struct Gather<'a> {
    scene: &'a Scene,
    compositing: Compositing,
    lattice: Lattice,
    tolerance: f32,
    /// Cuts at equal lengths instead of merging, if not 0.
    num_cuts: usize,
    len: usize,
    pieces: [Piece; MAX_K + 1],
}

impl<'a> Gather<'a> {
    /// For the rays of a scene whose mode is a projection.
    pub fn new(scene: &'a Scene) -> Self {
        Self {
            scene,
            compositing: scene.settings.mode.compositing(),
            lattice: Lattice { s0: 0.0, h: 1.0, n: 1, unit: 1.0 },
            tolerance: 0.0,
            num_cuts: 0,
            len: 0,
            pieces: [Piece::default(); MAX_K + 1],
        }
    }

    /// Makes ready for the next ray; pieces that cost no more than `tolerance` are merged at once.
    pub fn begin(&mut self, lattice: Lattice, tolerance: f32) {
        (self.lattice, self.tolerance) = (lattice, tolerance);
        (self.num_cuts, self.len) = (0, 0);
    }

    fn error(&self, piece: &Piece) -> f32 {
        piece.error(self.compositing, self.lattice.unit, self.lattice.s0)
    }

    /// What joining piece `i` with `behind` adds to the sum of errors.
    fn growth(&self, i: usize, behind: &Piece) -> f32 {
        let front = &self.pieces[i];
        let growth = self.error(&front.with(behind)) - self.error(front) - self.error(behind);
        // Of volumes so large that errors are infinite, nothing is known but that pieces must be joined.
        if growth.is_nan() { 0.0 } else { growth }
    }

    fn add(&mut self, piece: Piece) {
        if self.num_cuts > 0 {
            self.add_to_cut(piece);
            return;
        }
        if self.len > 0 && self.growth(self.len - 1, &piece) <= self.tolerance {
            self.pieces[self.len - 1] = self.pieces[self.len - 1].with(&piece);
            return;
        }
        self.pieces[self.len] = piece;
        self.len += 1;
        if self.len > MAX_K {
            self.thin_out();
        }
    }

    fn add_to_cut(&mut self, piece: Piece) {
        let middle = 0.5 * (piece.s0 + piece.s1) - self.lattice.s0;
        let share = middle / (self.lattice.h * self.lattice.n as f32);
        let cut = ((share * self.num_cuts as f32) as usize).min(self.num_cuts - 1);
        // Those before are there, if only empty; what follows is where it belongs.
        while self.len <= cut {
            self.pieces[self.len] = Piece { peak: -1.0, ..Piece::default() };
            self.len += 1;
        }
        let open = &mut self.pieces[cut];
        *open = if open.peak < 0.0 { piece } else { open.with(&piece) };
    }

    /// Of MAX_K + 1 pieces merges neighbours, and raises the tolerance to where most of the cheap pairs merge. A pair that
    /// costs more than the one behind it waits for another time, as does one with a piece that was merged just now.
    fn thin_out(&mut self) {
        let mut cost = [f32::INFINITY; MAX_K + 1];
        let (mut sum_of_inverses, mut least) = (0.0, f32::INFINITY);
        for (i, cost) in cost.iter_mut().enumerate().take(MAX_K) {
            *cost = self.growth(i, &self.pieces[i + 1]);
            sum_of_inverses += 1.0 / cost.max(COST_LEAST);
            least = least.min(*cost);
        }
        // The harmonic mean is no less than the least but for rounding.
        self.tolerance = (MAX_K as f32 / sum_of_inverses).max(2.0 * self.tolerance).max(least);
        let (mut kept, mut i) = (0, 0);
        while i <= MAX_K {
            let mut piece = self.pieces[i];
            if i < MAX_K && cost[i] <= self.tolerance && cost[i] <= cost[i + 1] {
                i += 1;
                piece = piece.with(&self.pieces[i]);
            }
            self.pieces[kept] = piece;
            kept += 1;
            i += 1;
        }
        self.len = kept;
    }

    /// Joins pieces, cheapest first, until there are at most `most` and the next join costs more than `threshold`. `note`
    /// is told the number of pieces and the greatest cost so far before each join.
    fn join(&mut self, most: usize, threshold: f32, mut note: impl FnMut(usize, f32)) {
        let mut growth = [f32::INFINITY; MAX_K + 1];
        for (i, growth) in growth.iter_mut().enumerate().take(self.len.saturating_sub(1)) {
            *growth = self.growth(i, &self.pieces[i + 1]);
        }
        let mut greatest: f32 = 0.0;
        while self.len > 1 {
            let mut least = 0;
            for i in 1..self.len - 1 {
                if growth[i] < growth[least] {
                    least = i;
                }
            }
            greatest = greatest.max(growth[least]);
            if self.len <= most && greatest > threshold {
                break;
            }
            note(self.len, greatest);
            self.pieces[least] = self.pieces[least].with(&self.pieces[least + 1]);
            self.len -= 1;
            self.pieces.copy_within(least + 2..self.len + 1, least + 1);
            growth.copy_within(least + 1..self.len, least);
            growth[self.len - 1] = f32::INFINITY;
            if least + 1 < self.len {
                growth[least] = self.growth(least, &self.pieces[least + 1]);
            }
            if least > 0 {
                growth[least - 1] = self.growth(least - 1, &self.pieces[least]);
            }
        }
    }

    /// The segments: their fields as [`crate::layer`] has them.
    fn finish(&self, layering: Layering) -> SegmentList {
        let pieces = &self.pieces[..self.len];
        let length = self.lattice.h * self.lattice.n as f32;
        let mut list = SegmentList::default();
        if self.compositing == Compositing::Mean {
            for piece in pieces.iter().filter(|p| p.first > 0.0) {
                let (mut s0, mut s1) = (piece.s0, piece.s1);
                if matches!(layering, Layering::SingleDepth(_)) {
                    s0 = self.lattice.s0 + piece.second / piece.first;
                    s1 = s0;
                }
                list.push(OpenSegment { s0, s1, c: piece.shown / length, tau: 0.0, alpha: 0.0 });
            }
            return list;
        }
        let Scene { table, settings, .. } = self.scene;
        let is_least = settings.mode == Mode::MinIp;
        let limit = key_limit(settings.mode, table);
        let greatest = pieces.iter().map(|p| p.peak).fold(-1.0, f32::max);
        let below = half_below(slot_from_key(greatest.max(2.0 * KEY_LEAST)));
        let mut has_greatest = false;
        for piece in pieces {
            // The first of equals: one must win.
            let is_greatest = piece.peak == greatest && !has_greatest;
            has_greatest |= is_greatest;
            let is_plain = matches!(layering, Layering::EqualLength | Layering::SingleDepth(_));
            let key = if is_greatest || is_plain { piece.peak } else { piece.key() };
            if piece.peak < 0.0 || key <= limit {
                continue;
            }
            let [s0, s1] = match layering {
                Layering::SingleDepth(_) => piece.peak_ends,
                _ => [piece.s0, piece.s1],
            };
            // Apart from those below it by a code of the codec at least.
            let slot = slot_from_key(if is_greatest { key.max(2.0 * KEY_LEAST) } else { key });
            list.push(OpenSegment {
                s0,
                s1,
                c: shown_of_key(table, is_least, key),
                tau: if is_greatest { slot } else { slot.min(below) },
                alpha: 0.0,
            });
        }
        list
    }
}

impl Sink for Gather<'_> {
    #[inline(always)]
    fn step(&mut self, step: Step) -> Pace {
        self.add(Piece::of(&step, self.compositing, self.lattice.s0));
        Pace::Step
    }
}

/// Of the way from the mean key of a piece to its greatest: see [`Piece::key`].
const PEAK_SHARE: f32 = 0.75;
/// Deviation of an even distribution, in lengths: 1/√12.
const EVEN_DEVIATION: f32 = 0.288_675_13;
/// A piece without any is divided by this.
const BRIGHTNESS_LEAST: f32 = 1e-30;
/// Costs below this are equal.
const COST_LEAST: f32 = 1e-20;
