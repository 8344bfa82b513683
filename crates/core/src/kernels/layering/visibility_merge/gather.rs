//! Gathering the steps of a ray into at most [`MAX_K`] pieces.

use super::pieces::Pieces;
use super::{MOVED_WEIGHT, OpenSegment, VISIBILITY_FLOOR};
use crate::kernels::layering::{SegmentList, append};
use crate::kernels::march::{Pace, Sink, Step, has_avx2};
use crate::kernels::raycast::greater;
use crate::layer::MAX_K;

/// The pieces of one ray while they are gathered. Filling its memory takes as long as a short ray, so one is used for many.
#[derive(Clone, Debug)]
pub struct Gather {
    /// Length of a step, world units.
    h: f32,
    /// Its inverse.
    steps_per_length: f32,
    /// Pieces that cost no more than this are merged.
    tolerance: f32,
    /// Transmittance in front of the next step that is handed in.
    transmittance: f32,
    /// The shader gathers step by step. Here some wait, as a processor would guess wrong what becomes of each, and then
    /// forget the march that it has begun behind it.
    num_waiting: usize,
    waiting: [Step; MAX_WAITING],
    /// Transmittance in front of the first that waits.
    transmittance_gathered: f32,
    len: usize,
    rows: Rows,
}

/// Pieces, front to back, each of their numbers in a row of its own: for work on eight at a time.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rows {
    pub(super) s0: [f32; MAX_K + 1],
    pub(super) s1: [f32; MAX_K + 1],
    pub(super) tau: [f32; MAX_K + 1],
    pub(super) alpha: [f32; MAX_K + 1],
    pub(super) c: [[f32; MAX_K + 1]; 3],
    /// Transmittance in front, at least [`VISIBILITY_FLOOR`].
    pub(super) visibility: [f32; MAX_K + 1],
    /// What merging has cost up to now.
    spent: [f32; MAX_K + 1],
}

impl Rows {
    #[inline(always)]
    pub(super) fn piece(&self, i: usize) -> OpenSegment {
        OpenSegment {
            s0: self.s0[i],
            s1: self.s1[i],
            c: glam::Vec3::new(self.c[0][i], self.c[1][i], self.c[2][i]),
            tau: self.tau[i],
            alpha: self.alpha[i],
        }
    }

    #[inline(always)]
    fn set(&mut self, i: usize, piece: &OpenSegment, visibility: f32, spent: f32) {
        self.s0[i] = piece.s0;
        self.s1[i] = piece.s1;
        self.tau[i] = piece.tau;
        self.alpha[i] = piece.alpha;
        for (row, c) in self.c.iter_mut().zip(piece.c.to_array()) {
            row[i] = c;
        }
        self.visibility[i] = visibility;
        self.spent[i] = spent;
    }
}

impl Gather {
    /// Makes ready for the next ray: `h` is the length of a step; pieces that cost no more than `tolerance` are merged at
    /// once.
    pub fn begin(&mut self, h: f32, tolerance: f32) {
        (self.h, self.steps_per_length, self.tolerance) = (h, h.recip(), tolerance);
        (self.transmittance, self.transmittance_gathered) = (1.0, 1.0);
        (self.num_waiting, self.len) = (0, 0);
    }

    /// Merges the steps that wait into the last piece, or opens pieces with them.
    #[inline(always)]
    fn take_waiting(&mut self) {
        let num = std::mem::take(&mut self.num_waiting);
        let mut transmittance = self.transmittance_gathered;
        let last = self.len.saturating_sub(1);
        // The last piece; it is in no row meanwhile.
        let (mut open, mut visibility, mut spent) =
            (self.rows.piece(last), self.rows.visibility[last], self.rows.spent[last]);
        for step in &self.waiting[..num] {
            let visibility_of_step = transmittance.max(VISIBILITY_FLOOR);
            transmittance *= 1.0 - step.alpha;
            if self.len > 0 {
                let cost = merge_cost(&open, step, self.steps_per_length) * visibility + spent;
                if cost <= self.tolerance {
                    append(&mut open, step);
                    spent = cost;
                    continue;
                }
                self.rows.set(self.len - 1, &open, visibility, spent);
            }
            (open, visibility, spent) = (*step, visibility_of_step, 0.0);
            self.len += 1;
            if self.len > MAX_K {
                self.rows.set(MAX_K, &open, visibility, spent);
                (self.len, self.tolerance) = thin_out(&mut self.rows, self.tolerance, self.steps_per_length);
                let last = self.len - 1;
                (open, visibility, spent) =
                    (self.rows.piece(last), self.rows.visibility[last], self.rows.spent[last]);
            }
        }
        if self.len > 0 {
            self.rows.set(self.len - 1, &open, visibility, spent);
        }
        self.transmittance_gathered = transmittance;
    }

    /// The list of at most `most` segments, and of no more than joins below `threshold` leave.
    pub fn reduce(&mut self, most: usize, threshold: f32) -> SegmentList {
        if self.len + self.num_waiting == 0 {
            return SegmentList::default();
        }
        #[cfg(target_arch = "x86_64")]
        if has_avx2() {
            #[expect(unsafe_code, reason = "the one way to instructions that not every processor has")]
            // SAFETY: this processor has them.
            return unsafe { self.reduce_avx2(most, threshold) };
        }
        self.finish().reduce(most, threshold)
    }

    /// The same with wider instructions. No multiplication is fused with an addition, so the bits are the same too.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn reduce_avx2(&mut self, most: usize, threshold: f32) -> SegmentList {
        self.finish().reduce(most, threshold)
    }

    /// What was gathered.
    #[inline(always)]
    pub(super) fn finish(&mut self) -> Pieces {
        self.take_waiting();
        Pieces::new(&self.rows, self.len, self.h)
    }
}

impl Default for Gather {
    fn default() -> Self {
        let row = [0.0; MAX_K + 1];
        Self {
            h: 1.0,
            steps_per_length: 1.0,
            tolerance: 0.0,
            transmittance: 1.0,
            num_waiting: 0,
            waiting: [Step::default(); MAX_WAITING],
            transmittance_gathered: 1.0,
            len: 0,
            rows: Rows { s0: row, s1: row, tau: row, alpha: row, c: [row; 3], visibility: row, spent: row },
        }
    }
}

impl Sink for Gather {
    #[inline(always)]
    fn step(&mut self, step: Step) -> Pace {
        self.waiting[self.num_waiting] = step;
        self.num_waiting += 1;
        if self.num_waiting == MAX_WAITING {
            self.take_waiting();
        }
        self.transmittance *= 1.0 - step.alpha;
        Pace::behind(self.transmittance)
    }
}

/// Of MAX_K + 1 pieces merges neighbours; the number of those that are left, and the tolerance, raised to where most of
/// the cheap pairs merge. A pair that costs more than the one behind it waits for another time, as does one with a
/// piece that was merged just now.
#[inline(always)]
fn thin_out(rows: &mut Rows, tolerance: f32, steps_per_length: f32) -> (usize, f32) {
    let mut cost = [f32::INFINITY; MAX_K + 1];
    let (visibility, spent) = (&rows.visibility, &rows.spent);
    for i in 0..MAX_K {
        let merged = merge_cost(&rows.piece(i), &rows.piece(i + 1), steps_per_length) * visibility[i];
        cost[i] = merged + (spent[i] + spent[i + 1]);
    }
    // The harmonic mean is that of the cheap ones; at least one is no dearer.
    let mut sums = [0.0; 8];
    for costs in cost.as_chunks::<8>().0 {
        for m in 0..8 {
            sums[m] += 1.0 / greater(costs[m], COST_LEAST);
        }
    }
    let sum_of_inverses: f32 = sums.iter().sum();
    let tolerance = greater(MAX_K as f32 / sum_of_inverses, 2.0 * tolerance);
    let (mut kept, mut i) = (0, 0);
    while i <= MAX_K {
        let (mut piece, visibility, mut spent) = (rows.piece(i), rows.visibility[i], rows.spent[i]);
        if i < MAX_K && cost[i] <= tolerance && cost[i] <= cost[i + 1] {
            spent = cost[i];
            i += 1;
            append(&mut piece, &rows.piece(i));
        }
        rows.set(kept, &piece, visibility, spent);
        kept += 1;
        i += 1;
    }
    (kept, tolerance)
}

/// While gathering, the error of reading `a`, the gap and `b` as one homogeneous piece.
///
/// Two things go wrong. Optical depth moves: from where it was to where an even spread puts it; what moves is half of
/// the total variation between the two densities, and shows as its opacity (here τ/(1 + τ), which saturates like it
/// and needs no exponential). And the colours of the two pieces mix, which shows where both are opaque enough to be
/// told apart. Seen at an angle, both errors are displaced by at most the length of the piece, so they grow with it.
#[inline(always)]
fn merge_cost(a: &OpenSegment, b: &OpenSegment, steps_per_length: f32) -> f32 {
    let length = b.s1 - a.s0;
    let tau = a.tau + b.tau;
    let gap = greater(b.s0 - a.s1, 0.0);
    // Times the length.
    let moved = 0.5
        * ((a.tau * length - tau * (a.s1 - a.s0)).abs()
            + (b.tau * length - tau * (b.s1 - b.s0)).abs()
            + tau * gap);
    // |Ea − Eb|·αa·αb with E = C/α.
    let mixed = (a.c * b.alpha - b.c * a.alpha).abs();
    let mixed = greater(greater(mixed.x, mixed.y), mixed.z);
    (MOVED_WEIGHT * moved / (length + moved) + mixed) * (length * steps_per_length)
}

/// Steps that wait at most.
const MAX_WAITING: usize = 64;
/// Costs below this are equal.
const COST_LEAST: f32 = 1e-20;
