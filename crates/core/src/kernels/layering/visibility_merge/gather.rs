//! Gathering the steps of a ray into at most [`MAX_K`] pieces.

use super::pieces::{Pieces, Way};
use super::{MOVED_WEIGHT, OpenSegment, VISIBILITY_FLOOR};
use crate::kernels::layering::{SegmentList, append};
use crate::kernels::march::{Pace, Sink, Step};
use crate::kernels::raycast::{greater, lesser};
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
    waiting: Waiting,
    len: usize,
    rows: Rows,
    /// What was gathered, and work space.
    pub(super) pieces: Pieces,
    pub(super) way: Way,
}

/// Pieces or steps, front to back, each of their numbers in a row of its own: for work on eight at a time.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rows<const N: usize = ROW> {
    pub(super) s0: [f32; N],
    pub(super) s1: [f32; N],
    pub(super) tau: [f32; N],
    pub(super) alpha: [f32; N],
    pub(super) c: [[f32; N]; 3],
    /// Transmittance in front, at least [`VISIBILITY_FLOOR`].
    pub(super) visibility: [f32; N],
    /// What merging has cost up to now.
    spent: [f32; N],
}

/// Steps that wait.
#[derive(Clone, Copy, Debug)]
struct Waiting {
    steps: Rows<WAITING_ROW>,
    /// What a piece of each and the step behind it costs.
    pair_cost: [f32; MAX_WAITING],
    /// The same with two behind it.
    triple_cost: [f32; MAX_WAITING],
}

impl Waiting {
    /// Finds what pieces cost that begin with each of the first `num` steps, eight at a time.
    #[inline(always)]
    fn find_costs(&mut self, num: usize, steps_per_length: f32) {
        for i in 0..num.next_multiple_of(8).min(MAX_WAITING) {
            let mut piece = self.steps.piece(i);
            let next = self.steps.piece(i + 1);
            let pair_cost = merge_cost(&piece, &next, steps_per_length) * self.steps.visibility[i];
            append(&mut piece, &next);
            let triple_cost =
                merge_cost(&piece, &self.steps.piece(i + 2), steps_per_length) * self.steps.visibility[i];
            self.pair_cost[i] = pair_cost;
            self.triple_cost[i] = triple_cost + pair_cost;
        }
    }

    /// One bit for each step, set where a piece that begins with it takes the step behind it, and where it takes one more
    /// after that.
    #[inline(always)]
    fn merging(&self, num: usize, tolerance: f32) -> (u64, u64) {
        (bits_up_to(&self.pair_cost, num, tolerance), bits_up_to(&self.triple_cost, num, tolerance))
    }
}

/// One bit for each of the first `num` costs, and maybe some behind, set where it is no more than `tolerance`.
#[inline(always)]
fn bits_up_to(costs: &[f32; MAX_WAITING], num: usize, tolerance: f32) -> u64 {
    let mut all = 0;
    for (at, costs) in costs.as_chunks::<8>().0.iter().enumerate().take(num.div_ceil(8)) {
        let mut bits = 0u32;
        for (m, cost) in costs.iter().enumerate() {
            bits |= u32::from(*cost <= tolerance) << m;
        }
        all |= u64::from(bits) << (8 * at);
    }
    all
}

impl<const N: usize> Rows<N> {
    const NOTHING: Self = Self {
        s0: [0.0; N],
        s1: [0.0; N],
        tau: [0.0; N],
        alpha: [0.0; N],
        c: [[0.0; N]; 3],
        visibility: [0.0; N],
        spent: [0.0; N],
    };

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

    /// Puts `num` steps from number `i` on at `at`. What is behind them may be written over.
    #[inline(always)]
    fn put<const M: usize>(&mut self, at: usize, steps: &Rows<M>, i: usize, num: usize) {
        for done in (0..num).step_by(8) {
            let (to, from) = (at + done, i + done);
            let copy = |row: &mut [f32; N], steps: &[f32; M]| {
                row[to..to + 8].copy_from_slice(&steps[from..from + 8]);
            };
            copy(&mut self.s0, &steps.s0);
            copy(&mut self.s1, &steps.s1);
            copy(&mut self.tau, &steps.tau);
            copy(&mut self.alpha, &steps.alpha);
            for (row, steps) in self.c.iter_mut().zip(&steps.c) {
                copy(row, steps);
            }
            copy(&mut self.visibility, &steps.visibility);
            copy(&mut self.spent, &steps.spent);
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
        self.transmittance = 1.0;
        (self.num_waiting, self.len) = (0, 0);
    }

    /// Merges the steps that wait into the last piece, or opens pieces with them.
    ///
    /// What becomes of a step is as good as a coin's toss, and each waits for what became of the one before. So what pieces
    /// of up to three steps cost is found beforehand, for all of them at once.
    #[inline(always)]
    fn take_waiting(&mut self) {
        let num = std::mem::take(&mut self.num_waiting);
        let Self { waiting, rows, tolerance, steps_per_length, .. } = self;
        waiting.find_costs(num, *steps_per_length);
        let (mut pairs, mut triples) = waiting.merging(num, *tolerance);
        let mut len = self.len;
        let last = len.saturating_sub(1);
        let (mut open, mut visibility, mut spent) =
            (rows.piece(last), rows.visibility[last], rows.spent[last]);
        let mut i = 0;
        'piece: loop {
            if len > 0 {
                while i < num {
                    let step = waiting.steps.piece(i);
                    let cost = merge_cost(&open, &step, *steps_per_length) * visibility + spent;
                    if cost <= *tolerance {
                        append(&mut open, &step);
                        spent = cost;
                        i += 1;
                    } else {
                        break;
                    }
                }
                rows.set(len - 1, &open, visibility, spent);
            }
            // Step i opens a piece.
            while i < num {
                // So do those behind it, until one takes the next, or is the last.
                let singles = (pairs >> i | 1 << (num - 1 - i)).trailing_zeros() as usize;
                let singles = singles.min(MAX_K - len);
                rows.put(len, &waiting.steps, i, singles);
                len += singles;
                i += singles;
                (open, visibility, spent) = (waiting.steps.piece(i), waiting.steps.visibility[i], 0.0);
                i += 1;
                if len == MAX_K {
                    rows.set(MAX_K, &open, visibility, spent);
                    (len, *tolerance) = thin_out(rows, *tolerance, *steps_per_length);
                    (pairs, triples) = waiting.merging(num, *tolerance);
                    let last = len - 1;
                    (open, visibility, spent) = (rows.piece(last), rows.visibility[last], rows.spent[last]);
                    continue 'piece;
                }
                len += 1;
                if i < num {
                    append(&mut open, &waiting.steps.piece(i));
                    spent = waiting.pair_cost[i - 1];
                    i += 1;
                    if i < num && triples >> (i - 2) & 1 != 0 {
                        append(&mut open, &waiting.steps.piece(i));
                        spent = waiting.triple_cost[i - 2];
                        i += 1;
                        continue 'piece;
                    }
                }
                rows.set(len - 1, &open, visibility, spent);
            }
            break;
        }
        self.len = len;
    }

    /// How many pieces were gathered.
    pub(super) fn finish(&mut self) -> usize {
        finish(self);
        self.len
    }

    /// Joins what was gathered to one segment; `note` is told the number of segments and the greatest cost so far before
    /// each join.
    pub(super) fn join_all(&mut self, note: &mut dyn FnMut(usize, f32)) {
        join_all(self, note);
    }

    /// Makes of `list` that of at most `most` segments, and of no more than joins below `threshold` leave.
    pub fn reduce(&mut self, most: usize, threshold: f32, list: &mut SegmentList) {
        list.len = 0;
        if self.len + self.num_waiting > 0 {
            reduce(self, most, threshold, list);
        }
    }
}

wide! {
    fn take_waiting(gather: &mut Gather) = Gather::take_waiting;
}
wide! {
    fn finish(gather: &mut Gather) = finish_any;
}
wide! {
    fn join_all(gather: &mut Gather, note: &mut dyn FnMut(usize, f32)) = join_all_any;
}
wide! {
    fn reduce(gather: &mut Gather, most: usize, threshold: f32, list: &mut SegmentList) = reduce_any;
}

#[inline(always)]
fn finish_any(gather: &mut Gather) {
    gather.take_waiting();
    gather.pieces.take(&gather.rows, gather.len, gather.h);
}

#[inline(always)]
fn join_all_any(gather: &mut Gather, note: &mut dyn FnMut(usize, f32)) {
    gather.pieces.join(&mut gather.way, 1, f32::INFINITY, note);
}

#[inline(always)]
fn reduce_any(gather: &mut Gather, most: usize, threshold: f32, list: &mut SegmentList) {
    finish_any(gather);
    gather.pieces.reduce(&mut gather.way, most, threshold, list);
}

impl Default for Gather {
    fn default() -> Self {
        Self {
            h: 1.0,
            steps_per_length: 1.0,
            tolerance: 0.0,
            transmittance: 1.0,
            num_waiting: 0,
            waiting: Waiting {
                steps: Rows::NOTHING,
                pair_cost: [0.0; MAX_WAITING],
                triple_cost: [0.0; MAX_WAITING],
            },
            len: 0,
            rows: Rows::NOTHING,
            pieces: Pieces::default(),
            way: Way::default(),
        }
    }
}

impl Sink for Gather {
    #[inline(always)]
    fn step(&mut self, step: Step) -> Pace {
        self.waiting.steps.set(self.num_waiting, &step, self.transmittance.max(VISIBILITY_FLOOR), 0.0);
        self.num_waiting += 1;
        if self.num_waiting == MAX_WAITING {
            take_waiting(self);
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
    // But for rounding.
    let least = cost[..MAX_K].iter().fold(f32::INFINITY, |least, &cost| lesser(least, cost));
    let tolerance = greater(greater(MAX_K as f32 / sum_of_inverses, 2.0 * tolerance), least);
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
    let length = greater(b.s1 - a.s0, LENGTH_LEAST);
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
/// Room for them, and for eight at a time from each on.
const WAITING_ROW: usize = MAX_WAITING + 8;
/// Room for pieces, and for eight at a time from each on.
const ROW: usize = MAX_K + 8;
/// Costs below this are equal.
const COST_LEAST: f32 = 1e-20;
/// Surfaces can lie at one place. Optical depths over this length are finite.
pub(super) const LENGTH_LEAST: f32 = 1e-30;

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::kernels::raycast::opacity;

    /// Steps of length 1, some of them missing, with colours and depths that change slowly and now and then jump.
    pub(in super::super) fn steps(seed: u32, num: u32) -> Vec<Step> {
        let mut random = seed;
        let mut step = Step { tau: 0.05, c: glam::Vec3::splat(0.5), ..Step::default() };
        let mut steps = vec![];
        for i in 0..num {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let share = (random >> 8) as f32 / (1 << 24) as f32;
            if random >> 28 == 0 {
                step.tau = share * 0.3;
                step.c = glam::Vec3::new(share, 1.0 - share, 0.3);
            }
            step.tau = step.tau * (0.98 + 0.04 * share) + 1e-4;
            if random >> 28 != 1 {
                let alpha = opacity(step.tau);
                steps.push(Step { s0: i as f32, s1: (i + 1) as f32, alpha, c: step.c * alpha, ..step });
            }
        }
        steps
    }

    /// Surfaces of equal values lie at one place, and as many as you like on a ray through noise.
    #[test]
    fn matter_without_length_is_gathered_like_any_other() {
        for (k, tolerance) in [(1, 0.0), (4, 0.0), (MAX_K, 1e-3)] {
            for threshold in [0.0, 1e-3] {
                let mut gather = Gather::default();
                gather.begin(1.0, tolerance);
                for i in 0..200u16 {
                    let s = f32::from(i / 3);
                    let c = glam::Vec3::splat(f32::from(i % 7) / 10.0);
                    let _ = gather.step(Step { s0: s, s1: s, tau: 0.01, alpha: opacity(0.01), c: c * 0.01 });
                }
                let mut list = SegmentList::default();
                gather.reduce(k, threshold, &mut list);
                let segments = &list.segments[..list.len];
                assert!((1..=k).contains(&list.len), "{k}");
                let tau: f32 = segments.iter().map(|s| s.tau).sum();
                assert!((tau - 2.0).abs() < 1e-3, "{k}: {tau}");
                assert!(segments.iter().all(|s| s.c.is_finite() && s.s0 <= s.s1));
            }
        }
    }

    /// What the shader does: step after step.
    fn one_by_one(steps: &[Step], mut tolerance: f32) -> Vec<[u32; 9]> {
        let mut rows = Gather::default().rows;
        let (mut len, mut transmittance) = (0usize, 1.0f32);
        for step in steps {
            let visibility = transmittance.max(VISIBILITY_FLOOR);
            transmittance *= 1.0 - step.alpha;
            if let Some(last) = len.checked_sub(1) {
                let (mut open, visibility) = (rows.piece(last), rows.visibility[last]);
                let cost = merge_cost(&open, step, 1.0) * visibility + rows.spent[last];
                if cost <= tolerance {
                    append(&mut open, step);
                    rows.set(last, &open, visibility, cost);
                    continue;
                }
            }
            rows.set(len, step, visibility, 0.0);
            len += 1;
            if len > MAX_K {
                (len, tolerance) = thin_out(&mut rows, tolerance, 1.0);
            }
        }
        bits(&rows, len)
    }

    fn bits(rows: &Rows, len: usize) -> Vec<[u32; 9]> {
        let bits = |i: usize| {
            let OpenSegment { s0, s1, tau, alpha, c } = rows.piece(i);
            [s0, s1, tau, alpha, c.x, c.y, c.z, rows.visibility[i], rows.spent[i]].map(f32::to_bits)
        };
        (0..len).map(bits).collect()
    }

    #[test]
    fn steps_that_waited_are_gathered_as_those_one_by_one() {
        let (mut num_pieces, mut num_noticed) = (0, 0);
        // One for all, as a row of a frame has; a ray longer than any before leaves what it can in it.
        let (mut gather, long) = (Gather::default(), steps(99, 700));
        for seed in 1..20 {
            for num in [1, 2, 3, 9, 30, 63, 64, 65, 66, 130, 700] {
                for tolerance in [0.0, 0.002, 0.02, 0.3] {
                    let steps = steps(seed, num);
                    for (h, tolerance, steps) in [(0.5, 0.001, &long), (1.0, tolerance, &steps)] {
                        gather.begin(h, tolerance);
                        for &step in steps {
                            let _ = gather.step(step);
                        }
                        gather.finish();
                    }
                    let expected = one_by_one(&steps, tolerance);
                    assert_eq!(bits(&gather.rows, gather.len), expected, "{seed} {num} {tolerance}");
                    num_pieces += expected.len();
                    // Negative control: where more is merged at once, the pieces are others.
                    num_noticed += usize::from(one_by_one(&steps, 1.5 * tolerance + 0.001) != expected);
                }
            }
        }
        assert!(num_pieces > 5000 && num_noticed > 300, "{num_pieces} {num_noticed}");
    }
}
