//! The threshold that spends a frame's budget: K segments per list on average, over lists that have any. Twin of
//! `shaders/layering/budget.wgsl`.
//!
//! *First frame.* One of [`sample_stride`]² pixels is listed at several thresholds at once, and only counted. The
//! first pass covers the whole range, the second the interval that brackets the budget. The threshold follows by
//! interpolation between logarithms.
//!
//! *Later frames.* The number of segments at the last threshold gives the next one ([`Budget`]). After a jump of the
//! camera or a new look, rays are counted again.

use rayon::prelude::*;

use super::visibility_merge::Counter;
use super::{Listing, projection};
use crate::camera::{Camera, Pose};
use crate::kernels::march::{Marcher, Scene, Texels};
use crate::layer::{FrameHeader, LayeredFrame, MAX_K};
use crate::mode::Mode;

/// The longest list of a frame with `k` segments per list on average.
pub const fn longest_list(k: usize) -> usize {
    let longest = 3 * k / 2 + 10;
    if longest < MAX_K { longest } else { MAX_K }
}

/// The distance of counted pixels along each axis: at least [`SAMPLE_RAYS`] rays are counted, and the distance is at
/// least 4.
pub const fn sample_stride(width: u32, height: u32) -> u32 {
    let num_rays = width as u64 * height as u64;
    let mut stride: u32 = 4;
    while (stride as u64 + 1).pow(2) * SAMPLE_RAYS <= num_rays {
        stride += 1;
    }
    stride
}

/// The counted pixels along an axis.
pub(super) fn sampled(side: u32, stride: u32) -> impl Iterator<Item = u32> {
    ((stride / 2).min(side / 2)..side).step_by(stride as usize)
}

/// Segments of the counted rays at each of [`thresholds`], and the number of rays with any.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SegmentCounts {
    /// Number of rays with any matter.
    pub num_lists: u32,
    /// Number of segments at each threshold.
    pub num_segments: [u32; NUM_THRESHOLDS],
}

impl SegmentCounts {
    fn sum(mut self, other: Self) -> Self {
        self.num_lists += other.num_lists;
        for (a, b) in self.num_segments.iter_mut().zip(other.num_segments) {
            *a += b;
        }
        self
    }
}

/// Thresholds at equal ratios from `least` on.
pub fn thresholds(least: f32, ratio: f32) -> [f32; NUM_THRESHOLDS] {
    let mut threshold = least;
    std::array::from_fn(|_| {
        let this = threshold;
        threshold *= ratio;
        this
    })
}

/// The threshold at which `counts`, taken at [`thresholds`], have `k` segments per list; the end of the range if none
/// has.
pub fn threshold_from_counts(counts: &SegmentCounts, least: f32, ratio: f32, k: usize) -> f32 {
    let wanted = (counts.num_lists as f32 * k as f32).max(1.0);
    let within = last_above(counts, k);
    let Some(i) = within.filter(|i| i + 1 < NUM_THRESHOLDS) else {
        return if within.is_none() { least } else { least * ratio.powi(NUM_THRESHOLDS as i32 - 1) };
    };
    let (more, less) = (counts.num_segments[i] as f32, counts.num_segments[i + 1].max(1) as f32);
    let part = (more / wanted).ln() / (more / less).ln().max(LOGARITHM_LEAST);
    least * ratio.powf(i as f32 + part.clamp(0.0, 1.0))
}

/// The last threshold with more than `k` segments per list, if any.
fn last_above(counts: &SegmentCounts, k: usize) -> Option<usize> {
    counts.num_segments.iter().rposition(|&num| num as usize > counts.num_lists as usize * k)
}

/// The least threshold of the second count.
pub fn second_least(counts: &SegmentCounts, k: usize) -> f32 {
    let i = last_above(counts, k).unwrap_or(0).min(NUM_THRESHOLDS - 2);
    FIRST_LEAST * FIRST_RATIO.powi(i as i32)
}

/// Counts rays to find the threshold of a frame. `asked.k` is K.
pub(super) fn count<T: Texels>(scene: &Scene, marcher: &Marcher<'_, T>, asked: &FrameHeader) -> f32 {
    let (basis, longest) = (asked.camera.basis(), longest_list(asked.k.into()));
    count_by(asked, |pixel, thresholds| {
        let of = Listing::new(scene, marcher, &basis, asked.camera.near, pixel)?;
        Some(of.counts(longest, thresholds))
    })
}

/// The pixels whose rays are counted for a frame, by rows.
pub(super) fn counted_pixels(camera: &Camera) -> (Vec<u32>, Vec<u32>) {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let stride = sample_stride(width, height);
    (sampled(width, stride).collect(), sampled(height, stride).collect())
}

/// The same, where `segments` gives the number of segments of a pixel's ray at each threshold.
pub(super) fn count_by(
    asked: &FrameHeader,
    segments: impl Fn((u32, u32), &[f32; NUM_THRESHOLDS]) -> Option<[u32; NUM_THRESHOLDS]> + Sync,
) -> f32 {
    let k = usize::from(asked.k);
    let (columns, rows) = counted_pixels(&asked.camera);
    let count_at = |least, ratio| {
        let thresholds = thresholds(least, ratio);
        let row = |&y: &u32| {
            let mut counts = SegmentCounts::default();
            for &x in &columns {
                if let Some(num_segments) = segments((x, y), &thresholds) {
                    let num_lists = u32::from(num_segments[0] > 0);
                    counts = counts.sum(SegmentCounts { num_lists, num_segments });
                }
            }
            counts
        };
        rows.par_iter().map(row).reduce(SegmentCounts::default, SegmentCounts::sum)
    };
    let least = second_least(&count_at(FIRST_LEAST, FIRST_RATIO), k);
    threshold_from_counts(&count_at(least, SECOND_RATIO), least, SECOND_RATIO, k)
}

impl<T: Texels> Listing<'_, T> {
    /// Number of segments of the ray at each threshold.
    fn counts(&self, longest: usize, thresholds: &[f32; NUM_THRESHOLDS]) -> [u32; NUM_THRESHOLDS] {
        if self.scene.settings.mode.is_projection() {
            return projection::counts(self, longest, thresholds);
        }
        let mut counter = Counter::new(thresholds, longest, &self.lattice);
        self.march(&mut counter);
        counter.finish()
    }
}

/// The state that a renderer keeps from frame to frame.
#[derive(Clone, Copy, Debug, Default)]
pub struct Budget {
    last: Option<PreviousFrame>,
}

#[derive(Clone, Copy, Debug)]
struct PreviousFrame {
    k: u8,
    mode: Mode,
    pose: Pose,
    threshold: f32,
}

impl Budget {
    /// The next frame is of another scene, so its rays must be counted.
    pub fn forget(&mut self) {
        self.last = None;
    }

    /// The threshold for a frame; `None` if its rays must be counted. `header.k` is K, and `reach` the radius of the
    /// volume.
    pub fn threshold(&self, header: &FrameHeader, reach: f32) -> Option<f32> {
        let pose = &header.camera.pose;
        let is_near = |last: &PreviousFrame| {
            let turned = last.pose.forward().dot(pose.forward());
            let moved = last.pose.eye.distance(pose.eye);
            (last.k, last.mode) == (header.k, header.mode)
                && turned > NEAR_COSINE
                && moved < NEAR_SHARE * reach
        };
        self.last.filter(is_near).map(|last| last.threshold)
    }

    /// Notes a frame made at `threshold`. `header.k` is K.
    pub fn note(&mut self, header: &FrameHeader, threshold: f32, frame: &LayeredFrame) {
        self.note_spent(header, threshold, frame.num_segments(), frame.num_filled());
    }

    /// The same for a frame with so many segments, in so many lists that have any.
    pub fn note_spent(&mut self, header: &FrameHeader, threshold: f32, num_segments: usize, num: usize) {
        let k = f32::from(header.k.max(1));
        if num < NOTED_LISTS || !threshold.is_finite() {
            self.last = None;
            return;
        }
        let spent = num_segments as f32 / num as f32;
        let threshold =
            threshold * (spent / k).powf(FOLLOWING_POWER).clamp(1.0 / FOLLOWING_MOST, FOLLOWING_MOST);
        let threshold = threshold.clamp(FIRST_LEAST, THRESHOLD_GREATEST);
        self.last =
            Some(PreviousFrame { k: header.k, mode: header.mode, pose: header.camera.pose, threshold });
    }
}

/// Thresholds counted at once.
pub const NUM_THRESHOLDS: usize = 8;
/// Least threshold of the first count. Its greatest is far above the error of any segment.
pub const FIRST_LEAST: f32 = 1.0 / 4096.0;
/// Ratio of successive thresholds in the first count.
pub const FIRST_RATIO: f32 = 16.0;
/// Ratio in the second count: its seven steps equal one step of the first.
pub const SECOND_RATIO: f32 = 1.485_994_3;
/// The greatest threshold of the first count.
pub const THRESHOLD_GREATEST: f32 = FIRST_LEAST * 268_435_456.0;
/// Number of rays that represent a frame.
pub const SAMPLE_RAYS: u64 = 2048;
/// Least difference of logarithms that is divided by.
const LOGARITHM_LEAST: f32 = 1e-6;
/// Exponent of the correction. The number of segments falls as a power of the threshold between −.25 and −.5, so even
/// the steepest does not overshoot.
const FOLLOWING_POWER: f32 = 2.0;
/// Greatest change of the threshold from one frame to the next, as a factor.
const FOLLOWING_MOST: f32 = 4.0;
/// Fewer lists than this say nothing about the next frame.
const NOTED_LISTS: usize = 64;
/// Cosine of the greatest turn between successive frames, 15°. The eye may move by the same share of the volume's
/// radius.
const NEAR_COSINE: f32 = 0.966;
const NEAR_SHARE: f32 = 0.5;

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::camera::Intrinsics;
    use crate::space::Aabb;

    #[test]
    fn the_threshold_is_where_the_counts_say() {
        // N = lists · 20 · T^−½: 4 at T = 25.
        let counts_at = |least: f32, ratio: f32| {
            let num = |t: f32| (100_000.0 * 20.0 / t.sqrt()) as u32;
            SegmentCounts { num_lists: 100_000, num_segments: thresholds(least, ratio).map(num) }
        };
        let least = second_least(&counts_at(FIRST_LEAST, FIRST_RATIO), 4);
        assert!(least <= 25.0 && 25.0 <= least * FIRST_RATIO * 1.001, "{least}");
        let found = threshold_from_counts(&counts_at(least, SECOND_RATIO), least, SECOND_RATIO, 4);
        assert!((found / 25.0 - 1.0).abs() < 1e-2, "{found}");
        // Another K has another.
        let found = threshold_from_counts(&counts_at(least, SECOND_RATIO), least, SECOND_RATIO, 5);
        assert!((found / 16.0 - 1.0).abs() < 1e-2, "{found}");
    }

    #[test]
    fn counts_out_of_range_give_the_ends_of_it() {
        let of = |num| SegmentCounts { num_lists: 10, num_segments: [num; NUM_THRESHOLDS] };
        assert_eq!(threshold_from_counts(&of(5), 0.5, 2.0, 4), 0.5);
        assert_eq!(threshold_from_counts(&of(50), 0.5, 2.0, 4), 64.0);
        assert_eq!(threshold_from_counts(&SegmentCounts::default(), 0.5, 2.0, 4), 0.5);
        assert!((SECOND_RATIO.powi(NUM_THRESHOLDS as i32 - 1) / FIRST_RATIO - 1.0).abs() < 1e-5);
        assert_eq!(THRESHOLD_GREATEST, FIRST_LEAST * FIRST_RATIO.powi(NUM_THRESHOLDS as i32 - 1));
    }

    fn header(azimuth: f32, k: u8) -> FrameHeader {
        let bounds = Aabb { min: Vec3::splat(-1.0), max: Vec3::splat(1.0) };
        let intrinsics = Intrinsics::perspective(32, 32, 0.7);
        FrameHeader::alone(Camera::new(Pose::orbit(Vec3::ZERO, azimuth, 0.2, 4.0), intrinsics, &bounds), k)
    }

    /// A frame of lists of `mean` segments, as far as a budget looks at it.
    fn frame(mean: f32) -> LayeredFrame {
        let mut frame = LayeredFrame::empty(header(0.0, 8));
        for (i, offset) in frame.offsets.iter_mut().enumerate() {
            *offset = (i as f32 * mean) as u32;
        }
        frame.depth = vec![0; *frame.offsets.last().unwrap() as usize];
        frame
    }

    #[test]
    fn frames_that_follow_come_to_their_budget_and_stay_there() {
        for power in [0.25f32, 0.35, 0.5] {
            let mut budget = Budget::default();
            let (mut threshold, mut means) = (1.0, vec![]);
            for _ in 0..16 {
                let mean = 20.0 * f32::powf(threshold, -power);
                means.push(mean);
                budget.note(&header(0.0, 8), threshold, &frame(mean));
                threshold = budget.threshold(&header(0.02, 8), 1.7).unwrap();
            }
            // A quarter of the way that is left is gone with each frame at least, but for the greatest change.
            assert!(means[12..].iter().all(|mean| (mean / 8.0 - 1.0).abs() < 0.03), "{power}: {means:?}");
            assert!(means.windows(2).all(|w| w[1] > 7.9 && w[1] <= w[0] + 0.1), "{power}: {means:?}");
        }
    }

    #[test]
    fn rays_are_counted_after_a_jump() {
        let mut budget = Budget::default();
        let threshold = |budget: &Budget, azimuth, k| budget.threshold(&header(azimuth, k), 1.7);
        assert_eq!(threshold(&budget, 0.0, 8), None);
        budget.note(&header(0.0, 8), 0.5, &frame(8.0));
        // The control: a camera that moves on has the threshold.
        assert!(threshold(&budget, 0.1, 8).is_some_and(|t| (t / 0.5 - 1.0).abs() < 0.01));
        assert_eq!(threshold(&budget, 0.4, 8), None, "a turn of 23 degrees");
        assert_eq!(threshold(&budget, 0.1, 4), None, "another K");
        let other_mode = FrameHeader { mode: Mode::Average, ..header(0.1, 8) };
        assert_eq!(budget.threshold(&other_mode, 1.7), None);
        assert_eq!(budget.threshold(&header(0.1, 8), 0.1), None, "a small volume, which the eye has passed");
        budget.note(&header(0.0, 8), f32::NAN, &frame(8.0));
        assert_eq!(threshold(&budget, 0.0, 8), None, "what is no threshold is forgotten");
    }

    #[test]
    fn a_sample_is_of_enough_rays_and_of_no_more_than_a_sixteenth() {
        for (width, height) in [(1u32, 1u32), (64, 48), (512, 512), (1920, 1080)] {
            let stride = sample_stride(width, height);
            let num = sampled(width, stride).count() * sampled(height, stride).count();
            assert!(num as u64 >= SAMPLE_RAYS.min(u64::from(width * height) / 25) && stride >= 4);
        }
    }
}
