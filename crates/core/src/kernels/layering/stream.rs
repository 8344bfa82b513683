//! Lists made while rays are marched, with few open pieces. Twin of `shaders/layering/stream.wgsl`.
//!
//! The rule defines pieces and their errors ([`Piece`]): [`super::visibility_merge`] or [`super::projection`]. The
//! way from steps to segments is the same for both:
//! 1. *Coming piece.* Steps join it while its error, roughly measured, is at most [`COMING_SHARE`] of the limit.
//! 2. *Window.* Then it goes behind the [`WINDOW`] open pieces. The two neighbours with the least joint error are
//!    joined, if that is at most the limit. Otherwise the first piece becomes a segment.
//! 3. *End.* Neighbours are joined, cheapest first, while their error is at most the threshold. The rest become
//!    segments.
//!
//! The limit is the frame's threshold ([`super::budget`]). It rises where a list fills faster than its ray advances:
//! lists are bounded, and matter at the back deserves its share. Only segments in such lists have errors above the
//! threshold. A ray needs no memory but its open pieces, and each step is looked at once.

use crate::kernels::march::Lattice;
use crate::kernels::raycast::greater;

/// A part of a ray that becomes a segment, or a part of one.
pub(super) trait Piece: Copy + Default {
    /// What is constant for all pieces of a ray.
    type Ray;

    /// Joins this piece and the one behind it.
    fn joined(&self, behind: &Self, ray: &Self::Ray) -> Self;

    /// The error of the piece as one segment; never negative.
    fn error(&self, ray: &Self::Ray) -> f32;

    /// Cheaply tests at each step whether the error is at most `limit`.
    fn is_within(&self, limit: f32, ray: &Self::Ray) -> bool {
        self.error(ray) <= limit
    }

    /// World distance of its back.
    fn s1(&self) -> f32;
}

/// Turns the steps of one ray into a list.
#[derive(Clone, Copy, Debug)]
pub(super) struct PieceStream<P> {
    threshold: f32,
    longest: usize,
    /// World distance of the ray's start, and the inverse of its length.
    s0: f32,
    per_length: f32,
    num_out: usize,
    coming: Option<P>,
    /// The error limit of the coming piece.
    coming_limit: f32,
    num_open: usize,
    open: [P; WINDOW + 1],
    /// Joint error of each open piece and the one behind it.
    joint: [f32; WINDOW],
}

impl<P: Piece> PieceStream<P> {
    /// Starts a ray along `lattice` that gives at most `longest` segments, which must exceed [`WINDOW`].
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

    /// Number of segments so far.
    pub(super) fn num_out(&self) -> usize {
        self.num_out
    }

    /// Takes the next step, which begins at the world distance `s0`. Emits segments front to back.
    #[inline(always)]
    pub(super) fn step(&mut self, ray: &P::Ray, step: P, s0: f32, emit: impl FnMut(&P)) {
        if let Some(coming) = &mut self.coming {
            let joined = coming.joined(&step, ray);
            // Joining across a gap spreads matter as well as moving it.
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

    /// The greatest error of a segment when the ray has reached the world distance `s`.
    #[inline(always)]
    fn limit(&self, s: f32) -> f32 {
        let passed = (s - self.s0) * self.per_length;
        let haste = greater(self.num_out as f32 / self.longest as f32 / (passed + HEAD_START), 1.0);
        self.threshold * ((haste * haste) * (haste * haste))
    }

    /// Joins the open piece `first` with the one behind it.
    fn join(&mut self, ray: &P::Ray, first: usize) {
        self.open[first] = self.open[first].joined(&self.open[first + 1], ray);
        self.open.copy_within(first + 2..self.num_open, first + 1);
        self.joint.copy_within(first + 1..self.num_open - 1, first);
        self.num_open -= 1;
        // Its joint error changes, and so does that of the piece in front.
        for k in first.max(1)..(first + 2).min(self.num_open) {
            self.find_joint(ray, k - 1);
        }
    }

    #[inline(always)]
    fn find_joint(&mut self, ray: &P::Ray, k: usize) {
        self.joint[k] = self.open[k].joined(&self.open[k + 1], ray).error(ray);
    }

    /// The first of the least joint errors, and its value.
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

/// Number of open pieces. With three, novel views of full lists are an eighth worse; with six none are better.
pub(super) const WINDOW: usize = 4;
/// Share of the limit for the coming piece. Between .35 and .6 novel views are alike; with .2 they are 1 % worse. A
/// larger share opens fewer pieces.
const COMING_SHARE: f32 = 0.5;
/// How far a list's fill may run ahead of its ray. With .2, lists of 32 segments lack matter at the back.
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
        let lattice = Lattice { s0: 0.0, h: 1.0, first: 0, n: heights.len() as u32, unit: 1.0 };
        let mut stream = PieceStream::new(threshold, longest, &lattice);
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
