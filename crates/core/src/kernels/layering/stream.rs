//! Lists made while their rays are marched, with few pieces open at once. Twin of `shaders/layering/stream.wgsl`.
//!
//! What pieces are and how far a piece is from what it stands for is the rule's ([`Piece`]): [`super::visibility_merge`] or
//! [`super::projection`]. The way from steps to segments is the same for both:
//!
//! 1. *A piece comes in.* Steps are joined to it while its error, roughly measured, is at most [`COMING_SHARE`] of the limit.
//! 2. *The window.* Then it goes behind the [`WINDOW`] pieces that are open. Of these and the new one, the two neighbours
//!    that have the least error as one are joined, if that is at most the limit. If not, the first is a segment for good.
//! 3. *The end.* Neighbours are joined, cheapest first, while their error is at most the threshold. The rest are segments.
//!
//! The limit is the frame's threshold ([`super::budget`]). It rises where a list fills faster than its ray passes: a list
//! has an end, and what lies behind deserves its share. So no segment has a greater error than the threshold but in such
//! lists, a ray needs no memory beside its open pieces, and nothing is looked at twice.

use crate::kernels::march::Lattice;
use crate::kernels::raycast::greater;

/// A part of a ray that becomes a segment, or a part of one.
pub(super) trait Piece: Copy + Default {
    /// What is the same for all pieces of a ray.
    type Ray;

    /// This piece and the one behind it as one.
    fn joined(&self, behind: &Self, ray: &Self::Ray) -> Self;

    /// How far the piece is from what it stands for, as one segment; never negative.
    fn error(&self, ray: &Self::Ray) -> f32;

    /// A cheap test, asked at each step, for an error of at most `limit`.
    fn is_within(&self, limit: f32, ray: &Self::Ray) -> bool {
        self.error(ray) <= limit
    }

    /// World distance of its back.
    fn s1(&self) -> f32;
}

/// One ray on its way to a list.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stream<P> {
    threshold: f32,
    longest: usize,
    /// World distance where the ray begins, and the inverse of its length.
    s0: f32,
    per_length: f32,
    num_out: usize,
    coming: Option<P>,
    /// How far the piece that comes in may err.
    coming_limit: f32,
    num_open: usize,
    open: [P; WINDOW + 1],
    /// Error of each open piece as one with the piece behind it.
    joint: [f32; WINDOW],
}

impl<P: Piece> Stream<P> {
    /// A ray along `lattice`, of which at most `longest` segments come out: more than [`WINDOW`].
    pub(super) fn new(threshold: f32, longest: usize, lattice: &Lattice) -> Self {
        Self {
            threshold,
            longest,
            s0: lattice.s0,
            per_length: 1.0 / (lattice.h * lattice.n as f32),
            num_out: 0,
            coming: None,
            coming_limit: 0.0,
            num_open: 0,
            open: [P::default(); WINDOW + 1],
            joint: [0.0; WINDOW],
        }
    }

    /// Segments that came out.
    pub(super) fn num_out(&self) -> usize {
        self.num_out
    }

    /// Takes the next step, which begins at the world distance `s0`. Segments come out front to back.
    #[inline(always)]
    pub(super) fn step(&mut self, ray: &P::Ray, step: P, s0: f32, emit: impl FnMut(&P)) {
        if let Some(coming) = &mut self.coming {
            let joined = coming.joined(&step, ray);
            // Across a gap matter is spread as well as moved.
            let limit = self.coming_limit;
            if joined.is_within(limit, ray) && (s0 <= coming.s1() || joined.error(ray) <= limit) {
                *coming = joined;
                return;
            }
            let come = *coming;
            self.push(ray, come, emit);
        }
        self.coming = Some(step);
        self.coming_limit = COMING_SHARE * self.limit(s0);
    }

    /// The ray is over.
    pub(super) fn finish(&mut self, ray: &P::Ray, mut emit: impl FnMut(&P)) {
        if let Some(come) = self.coming.take() {
            self.push(ray, come, &mut emit);
        }
        while self.num_open > 1 {
            let (least, error) = self.least_joint();
            if error > self.threshold {
                break;
            }
            self.join(ray, least);
        }
        for piece in &self.open[..self.num_open] {
            emit(piece);
        }
        self.num_out += std::mem::take(&mut self.num_open);
    }

    fn push(&mut self, ray: &P::Ray, come: P, mut emit: impl FnMut(&P)) {
        self.open[self.num_open] = come;
        self.num_open += 1;
        if self.num_open > 1 {
            self.find_joint(ray, self.num_open - 2);
        }
        if self.num_open <= WINDOW {
            return;
        }
        let (least, error) = self.least_joint();
        let is_over = error > self.limit(self.open[0].s1());
        if is_over && self.num_out + WINDOW < self.longest {
            emit(&self.open[0]);
            self.num_out += 1;
            self.open.copy_within(1.., 0);
            self.joint.copy_within(1.., 0);
            self.num_open -= 1;
        } else {
            self.join(ray, least);
        }
    }

    /// The greatest error that a segment may have behind which the ray is at the world distance `s`.
    #[inline(always)]
    fn limit(&self, s: f32) -> f32 {
        let passed = (s - self.s0) * self.per_length;
        let haste = greater(self.num_out as f32 / self.longest as f32 / (passed + HEAD_START), 1.0);
        self.threshold * ((haste * haste) * (haste * haste))
    }

    /// Makes one of the open piece `first` and the one behind it.
    fn join(&mut self, ray: &P::Ray, first: usize) {
        self.open[first] = self.open[first].joined(&self.open[first + 1], ray);
        self.open.copy_within(first + 2..self.num_open, first + 1);
        self.joint.copy_within(first + 1..self.num_open - 1, first);
        self.num_open -= 1;
        // Its own joint is another now, and that of the piece in front of it.
        for k in first.max(1)..(first + 2).min(self.num_open) {
            self.find_joint(ray, k - 1);
        }
    }

    #[inline(always)]
    fn find_joint(&mut self, ray: &P::Ray, k: usize) {
        self.joint[k] = self.open[k].joined(&self.open[k + 1], ray).error(ray);
    }

    /// The first of the least joints, and how much it is.
    #[inline(always)]
    fn least_joint(&self) -> (usize, f32) {
        let joints = &self.joint[..self.num_open - 1];
        let mut least = 0;
        for (k, joint) in joints.iter().enumerate() {
            if *joint < joints[least] {
                least = k;
            }
        }
        (least, joints[least])
    }
}

/// Pieces that are open at once. With three, novel views of lists that are full were an eighth worse; with six none were better.
pub(super) const WINDOW: usize = 4;
/// Of the limit, for the piece that comes in. Between .35 and .6 novel views are alike, with .2 they were 1 % worse; the more, the
/// fewer pieces are opened.
const COMING_SHARE: f32 = 0.5;
/// A list may be filled by this much more than its ray has passed. With .2, lists of 32 segments lacked what lies behind.
const HEAD_START: f32 = 0.05;

#[cfg(test)]
mod tests {
    use super::*;

    /// Steps of a height, joined to their mean: the error is the spread of what is in them.
    #[derive(Clone, Copy, Debug, Default, PartialEq)]
    struct Heights {
        num: f32,
        low: f32,
        high: f32,
        s1: f32,
    }

    impl Piece for Heights {
        type Ray = ();

        fn joined(&self, behind: &Self, (): &()) -> Self {
            let (low, high) = (self.low.min(behind.low), self.high.max(behind.high));
            Self { num: self.num + behind.num, low, high, s1: behind.s1 }
        }

        fn error(&self, (): &()) -> f32 {
            self.high - self.low
        }

        fn s1(&self) -> f32 {
            self.s1
        }
    }

    fn segments(heights: &[f32], threshold: f32, longest: usize) -> Vec<Heights> {
        let lattice = Lattice { s0: 0.0, h: 1.0, n: heights.len() as u32, unit: 1.0 };
        let mut stream = Stream::new(threshold, longest, &lattice);
        let mut out = vec![];
        for (i, &height) in heights.iter().enumerate() {
            let step = Heights { num: 1.0, low: height, high: height, s1: i as f32 + 1.0 };
            stream.step(&(), step, i as f32, |piece| out.push(*piece));
        }
        stream.finish(&(), |piece| out.push(*piece));
        assert_eq!(stream.num_out(), out.len());
        out
    }

    fn random(num: usize) -> Vec<f32> {
        let mut seed = 7u32;
        let next = |_| {
            seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (seed >> 8) as f32 / (1 << 24) as f32
        };
        (0..num).map(next).collect()
    }

    #[test]
    fn every_step_is_in_one_segment_and_none_errs_by_more_than_the_threshold() {
        for (num, threshold) in [(0, 1.0), (1, 1.0), (3, 0.0), (400, 0.6), (400, 0.9)] {
            let out = segments(&random(num), threshold, 1000);
            assert_eq!(out.iter().map(|s| s.num).sum::<f32>(), num as f32);
            assert!(out.windows(2).all(|w| w[0].s1 < w[1].s1));
            // Full lists alone may err by more; 1000 is none of these.
            assert!(out.iter().all(|s| s.error(&()) <= threshold), "{num} steps");
        }
    }

    #[test]
    fn pieces_part_where_the_steps_do() {
        let plateaus = |heights: &[f32]| heights.iter().flat_map(|h| [*h; 7]).collect::<Vec<_>>();
        let out = segments(&plateaus(&[0.0, 3.0, 3.1, 9.0, 0.0, 4.0, 8.0, 1.0, 5.0]), 0.5, 32);
        let nums: Vec<f32> = out.iter().map(|s| s.num).collect();
        assert_eq!(nums, [7.0, 14.0, 7.0, 7.0, 7.0, 7.0, 7.0, 7.0]);
        // Without a difference there is one segment.
        assert_eq!(segments(&[2.0; 100], 0.0, 32).len(), 1);
    }

    #[test]
    fn a_list_never_exceeds_its_bound_and_keeps_room_for_what_lies_behind() {
        let out = segments(&random(1000), 0.3, 32);
        assert!(out.len() <= 32 && out.len() > 24, "{}", out.len());
        let half = out.iter().position(|s| s.s1 > 500.0).unwrap();
        assert!((8..=25).contains(&half), "{half} of {} segments are in the first half", out.len());
        // At the threshold alone the first steps would take all.
        let free = segments(&random(1000), 0.3, 2000);
        assert!(free.len() > 100 && free[31].s1 < 250.0);
    }
}
