//! The one definition of a layered frame, used by every generator, the codec and every renderer.
//!
//! A layered frame holds, for each pixel of the generating view, a short list of segments along its ray, front to
//! back. A segment is a homogeneous medium between two planes of constant view depth; gaps between segments are empty
//! space. List `i` covers the pixel area `[i, i+1)` and was marched along its centre.
//!
//! A segment is 12 bytes in three planes of `u32`, the same on the CPU and the GPU. Planes are separate so that each
//! fits a 128 MiB storage binding at 1920×1080 with 15 segments in every list:
//! - `depth`: front in the low and back in the high 16 bits, each the view depth mapped linearly from [near, far] to
//!   [0, 65535] (Zellmann 2012). Front < back always.
//! - `c_rg`, `c_b_tau`: red and green, blue and optical depth τ, as half floats, low bits first. C is the
//!   premultiplied colour of the segment composited on its own; τ = −ln(1 − α) ≤ [`TAU_MAX`].
//!
//! This holds for modes that composite with *over*. In a projection ([`crate::mode::Compositing`]) matter neither
//! hides nor dims, and the fields hold other numbers:
//! - greatest: C is what the segment shows on any crossing ray. Its key replaces τ ([`slot_from_key`]); the greatest
//!   key on a ray is shown.
//! - mean: C is the segment's share of what its list shows, so the list shows the sum of its C. τ is 0.
//!
//! The opacity of what a projection shows is its greatest channel.

use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::camera::Camera;
use crate::ids::{FrameId, LookVersion, PoseId};
use crate::mode::{Compositing, Mode};

/// The header of a layered frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameHeader {
    /// Number of this frame.
    pub frame: FrameId,
    /// The pose that this frame answers.
    pub pose: PoseId,
    /// The version of its look.
    pub look: LookVersion,
    /// The generating camera; its size is the number of lists.
    pub camera: Camera,
    /// Longest possible list, 1 to [`MAX_K`].
    pub k: u8,
    /// The mode, which decides how segments become one colour.
    pub mode: Mode,
    /// Whether it shows the finest level of its volume.
    pub fineness: Fineness,
}

/// Whether a frame shows the finest level of its volume. One that is read by pages has coarser parts at first.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[repr(u8)]
pub enum Fineness {
    /// All that is seen is of the finest level.
    #[default]
    Whole,
    /// Parts are coarser, and stay so: there is no memory for finer ones, or they cannot be read.
    Bounded,
    /// A finer frame of the same pose follows.
    Draft,
}

impl Fineness {
    /// All of them, by their numbers.
    pub const ALL: [Self; 3] = [Self::Whole, Self::Bounded, Self::Draft];
}

impl FrameHeader {
    /// The header of a composite frame that answers no request.
    pub fn alone(camera: Camera, k: u8) -> Self {
        Self {
            frame: FrameId(1),
            pose: PoseId(0),
            look: LookVersion(0),
            camera,
            k,
            mode: Mode::default(),
            fineness: Fineness::default(),
        }
    }
}

/// W×H lists of segments. `offsets[i]..offsets[i + 1]` are the segments of list `i` (row by row from the top).
#[derive(Clone, Debug, PartialEq)]
pub struct LayeredFrame {
    /// Camera, ids and limits.
    pub header: FrameHeader,
    /// Prefix sum of the list lengths, W·H + 1 entries, first 0.
    pub offsets: Vec<u32>,
    /// Depth plane.
    pub depth: Vec<u32>,
    /// Red and green plane.
    pub c_rg: Vec<u32>,
    /// Blue and optical depth plane.
    pub c_b_tau: Vec<u32>,
}

/// One segment, unpacked.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Segment {
    /// Front depth, 0..65535 between near and far.
    pub front: u16,
    /// Back depth, greater than `front`.
    pub back: u16,
    /// Premultiplied linear colour of the whole segment alone.
    pub c: Vec3,
    /// Optical depth of the whole segment.
    pub tau: f32,
}

impl Segment {
    /// Opacity of the whole segment.
    pub fn alpha(&self) -> f32 {
        1.0 - (-self.tau).exp()
    }

    /// The three packed words, in the order depth, c_rg, c_b_tau.
    pub fn pack(&self) -> [u32; 3] {
        [
            u32::from(self.front) | u32::from(self.back) << 16,
            pack_halves(self.c.x, self.c.y),
            pack_halves(self.c.z, self.tau.min(TAU_MAX)),
        ]
    }

    /// Inverse of [`Segment::pack`].
    pub fn unpack([depth, c_rg, c_b_tau]: [u32; 3]) -> Self {
        let (r, g) = unpack_halves(c_rg);
        let (b, tau) = unpack_halves(c_b_tau);
        Self { front: depth as u16, back: (depth >> 16) as u16, c: Vec3::new(r, g, b), tau }
    }
}

impl LayeredFrame {
    /// A frame without any segment.
    pub fn empty(header: FrameHeader) -> Self {
        let n = header.camera.intrinsics.num_pixels();
        Self { header, offsets: vec![0; n + 1], depth: vec![], c_rg: vec![], c_b_tau: vec![] }
    }

    /// A frame with `num` segments in the memory of a `spare` one, unless that is too small or more than twice the
    /// size. The first list begins at 0; the caller must write everything else.
    pub(crate) fn in_memory_of(spare: Option<Self>, header: FrameHeader, num_segments: usize) -> Self {
        let make_room = |mut words: Vec<u32>, num: usize| {
            if !(num..=2 * num).contains(&words.capacity()) {
                // The next frame fits even if it is a little larger.
                words = vec![0; num + num / 8];
            }
            words.resize(num, 0);
            words
        };
        let [offsets, depth, c_rg, c_b_tau] = match spare {
            Some(Self { offsets, depth, c_rg, c_b_tau, .. }) => [offsets, depth, c_rg, c_b_tau],
            None => Default::default(),
        };
        let mut offsets = make_room(offsets, header.camera.intrinsics.num_pixels() + 1);
        offsets[0] = 0;
        let [depth, c_rg, c_b_tau] = [depth, c_rg, c_b_tau].map(|words| make_room(words, num_segments));
        Self { header, offsets, depth, c_rg, c_b_tau }
    }

    /// Number of segments in all lists.
    pub fn num_segments(&self) -> usize {
        self.depth.len()
    }

    /// Number of lists that have any segments.
    pub fn num_filled(&self) -> usize {
        self.offsets.windows(2).filter(|ends| ends[1] > ends[0]).count()
    }

    /// Mean number of segments over lists that have any; 0 if there are none.
    pub fn segments_mean(&self) -> f64 {
        self.num_segments() as f64 / self.num_filled().max(1) as f64
    }

    /// The frame of a greatest or least value without its less visible segments: no list keeps more than half the mean
    /// length of the lists that are not empty. The greatest keys stay, so the picture from the frame's own pose does.
    pub fn thinned(&self) -> Self {
        self.thinned_to(Self::thin_length(self.num_segments(), self.num_filled()))
    }

    /// The longest list of a thinned frame that had so many segments in so many lists.
    pub fn thin_length(num_segments: usize, num_filled: usize) -> usize {
        num_segments.div_ceil(2 * num_filled.max(1)).max(1)
    }

    /// The frame with at most `most` segments in each list, those with the greatest keys.
    pub fn thinned_to(&self, most: usize) -> Self {
        let mut thin = Self::empty(self.header);
        let mut kept: Vec<usize> = Vec::with_capacity(MAX_K);
        for i in 0..self.header.camera.intrinsics.num_pixels() {
            kept.clear();
            kept.extend(self.list(i));
            // The nearer first among equals.
            kept.sort_by(|&a, &b| self.segment(b).tau.total_cmp(&self.segment(a).tau));
            kept.truncate(most);
            kept.sort_unstable();
            for &s in &kept {
                thin.depth.push(self.depth[s]);
                thin.c_rg.push(self.c_rg[s]);
                thin.c_b_tau.push(self.c_b_tau[s]);
            }
            thin.offsets[i + 1] = thin.depth.len() as u32;
        }
        thin
    }

    /// The indices of the segments of list `i`.
    pub fn list(&self, i: usize) -> std::ops::Range<usize> {
        self.offsets[i] as usize..self.offsets[i + 1] as usize
    }

    /// Segment number `i`, unpacked.
    pub fn segment(&self, i: usize) -> Segment {
        Segment::unpack([self.depth[i], self.c_rg[i], self.c_b_tau[i]])
    }

    /// Appends a segment to the planes; the caller maintains `offsets`.
    pub fn push(&mut self, segment: &Segment) {
        let [depth, c_rg, c_b_tau] = segment.pack();
        self.depth.push(depth);
        self.c_rg.push(c_rg);
        self.c_b_tau.push(c_b_tau);
    }

    /// Appends several segments.
    pub fn extend(&mut self, segments: &[Segment]) {
        let packed = segments.iter().map(Segment::pack);
        self.depth.extend(packed.clone().map(|words| words[0]));
        self.c_rg.extend(packed.clone().map(|words| words[1]));
        self.c_b_tau.extend(packed.map(|words| words[2]));
    }

    /// The picture from the frame's own pose, premultiplied linear: every list is composited as its mode requires.
    pub fn flatten(&self) -> crate::picture::Picture {
        let i = self.header.camera.intrinsics;
        let mut picture = crate::picture::Picture::new(i.width, i.height);
        let compositing = self.header.mode.compositing();
        for (n, pixel) in picture.pixels.iter_mut().enumerate() {
            let segments = self.list(n).map(|s| self.segment(s));
            *pixel = match compositing {
                Compositing::Over => {
                    let mut acc = Over::default();
                    segments.for_each(|s| acc.add(s.c, s.tau));
                    acc.rgba()
                }
                Compositing::Greatest | Compositing::Mean => {
                    let mut acc = Projected::default();
                    segments.for_each(|s| acc.add(compositing, s.c, s.tau));
                    acc.rgba()
                }
            };
        }
        picture
    }

    /// Checks every rule of this module; the message names the first one broken.
    pub fn validate(&self) -> Result<(), String> {
        let n = self.header.camera.intrinsics.num_pixels();
        if !self.header.camera.is_valid() {
            return Err("camera is not valid".into());
        }
        if self.header.k == 0 || self.header.k as usize > MAX_K {
            return Err(format!("k is {}, expected 1 to {MAX_K}", self.header.k));
        }
        if self.offsets.len() != n + 1 || self.offsets[0] != 0 {
            return Err(format!("{} offsets for {n} lists", self.offsets.len()));
        }
        let total = self.depth.len();
        if self.c_rg.len() != total || self.c_b_tau.len() != total || self.offsets[n] as usize != total {
            return Err("planes and offsets disagree on the number of segments".into());
        }
        for i in 0..n {
            let (a, b) = (self.offsets[i], self.offsets[i + 1]);
            if b < a || b - a > u32::from(self.header.k) {
                return Err(format!("list {i} has offsets {a}..{b} with k = {}", self.header.k));
            }
            let mut last_back = 0;
            for j in self.list(i) {
                let s = self.segment(j);
                if s.front >= s.back || s.front < last_back {
                    return Err(format!("list {i}: depths {}..{} after {last_back}", s.front, s.back));
                }
                let sane = |x: f32| (0.0..=HALF_MAX).contains(&x);
                if !(sane(s.c.x) && sane(s.c.y) && sane(s.c.z) && (0.0..=TAU_MAX).contains(&s.tau)) {
                    return Err(format!(
                        "list {i}: colour {:?} or optical depth {} out of range",
                        s.c, s.tau
                    ));
                }
                last_back = s.back;
            }
        }
        Ok(())
    }
}

/// Front-to-back compositing with *over*, premultiplied. The identity is the default value.
#[derive(Clone, Copy, Debug)]
pub struct Over {
    /// Colour so far.
    pub c: Vec3,
    /// Transmittance so far (κ).
    pub transmittance: f32,
}

impl Default for Over {
    fn default() -> Self {
        Self { c: Vec3::ZERO, transmittance: 1.0 }
    }
}

impl Over {
    /// Puts a piece with premultiplied colour `c` and optical depth `tau` behind the others.
    pub fn add(&mut self, c: Vec3, tau: f32) {
        self.c += c * self.transmittance;
        self.transmittance *= (-tau).exp();
    }

    /// Premultiplied colour and opacity.
    pub fn rgba(&self) -> [f32; 4] {
        [self.c.x, self.c.y, self.c.z, 1.0 - self.transmittance]
    }
}

/// What a projection has collected, in any order. The identity is the default value.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Projected {
    /// Collected colour.
    pub c: Vec3,
    /// Greatest key, or a number that grows with it; 0 for nothing.
    pub key: f32,
}

impl Projected {
    /// Adds a piece; a mean ignores `key`.
    #[inline(always)]
    pub fn add(&mut self, compositing: Compositing, c: Vec3, key: f32) {
        if compositing == Compositing::Mean {
            self.c += c;
        } else if key > self.key {
            *self = Self { c, key };
        }
    }

    /// The colour, with its greatest channel as opacity.
    pub fn rgba(&self) -> [f32; 4] {
        [self.c.x, self.c.y, self.c.z, self.c.max_element().min(1.0)]
    }
}

/// The number that replaces τ for a key in [0, 1]: 8·key³, for which the codec's scale of τ makes even steps of the
/// key. Every segment has a key above 0, which means nothing.
pub fn slot_from_key(key: f32) -> f32 {
    let key = key.clamp(KEY_LEAST, 1.0);
    SLOT_MAX * (key * key * key)
}

/// Inverse of [`slot_from_key`].
pub fn key_from_slot(slot: f32) -> f32 {
    (slot.clamp(0.0, SLOT_MAX) * (1.0 / SLOT_MAX)).cbrt()
}

/// The greatest half float below a positive one.
pub fn half_below(x: f32) -> f32 {
    f32_from_half(half_from_f32(x).saturating_sub(1))
}

/// Most lists in a server's frame with lists of mean length `k`. With an eighth more segments, the planes still fit
/// what the codec accepts and wgpu's default binding size, 2²⁵ words.
pub fn max_lists(k: u8) -> usize {
    let k = usize::from(k.max(1));
    ((1 << 25) / (k + k.div_ceil(8))).clamp(ALWAYS_LISTS, MAX_LISTS)
}

/// Converts view depth (world units) to a frame's 16-bit scale, unrounded and unclamped.
pub fn depth_to_units(camera: &Camera, depth: f32) -> f32 {
    (depth - camera.near) * (DEPTH_UNITS / (camera.far - camera.near))
}

/// Packs two non-negative finite numbers as half floats, `lo` in the low bits. Rounds to nearest; values above
/// [`HALF_MAX`] and NaN become [`HALF_MAX`] and 0.
#[inline]
pub fn pack_halves(lo: f32, hi: f32) -> u32 {
    u32::from(half_from_f32(lo)) | u32::from(half_from_f32(hi)) << 16
}

/// Inverse of [`pack_halves`]; the sign bit is ignored and infinities read as large finite numbers.
#[inline]
pub fn unpack_halves(word: u32) -> (f32, f32) {
    (f32_from_half(word as u16), f32_from_half((word >> 16) as u16))
}

/// Converts a non-negative half float by moving its bits and scaling the exponent (exact for subnormals too).
#[inline]
fn f32_from_half(h: u16) -> f32 {
    f32::from_bits(u32::from(h & 0x7fff) << 13) * f32::from_bits((254 - 15) << 23)
}

#[inline]
#[expect(clippy::manual_clamp, reason = "max and min turn NaN into 0, clamp would keep it")]
fn half_from_f32(x: f32) -> u16 {
    // The product changes the exponent bias to that of a half float.
    let scaled = (x.max(0.0).min(HALF_MAX) * f32::from_bits(15 << 23)).to_bits();
    ((scaled + 0xfff + (scaled >> 13 & 1)) >> 13) as u16
}

/// Greatest optical depth of a segment: e^−1000 is zero in any picture, and a thousandth of such a segment still has
/// a transmittance of e^−1.
pub const TAU_MAX: f32 = 1000.0;
/// Greatest colour that the wire carries. Shading can lift a colour above one.
pub const COLOR_MAX: f32 = 1.25;
/// Least key of a segment.
pub const KEY_LEAST: f32 = 0.005;
/// The number that replaces τ for a key of 1.
pub const SLOT_MAX: f32 = 8.0;
/// Greatest list length: Gupta 2022 compares lists of 15 and of 30.
pub const MAX_K: usize = 32;
/// Most lists in any server's frame: 1920×1080 with a margin of 160 on each side.
pub const MAX_LISTS: usize = 2240 * 1400;
/// Lists of the largest picture that a viewer requests, 1920×1200: a server allows this many for any K.
pub const ALWAYS_LISTS: usize = 1920 * 1200;
/// Depth units between near and far.
pub const DEPTH_UNITS: f32 = 65535.0;
/// Greatest finite half float.
pub const HALF_MAX: f32 = 65504.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halves_round_to_nearest_and_never_misbehave() {
        for (x, expect) in
            [(0.0, 0.0), (1.0, 1.0), (0.5, 0.5), (65504.0, 65504.0), (1e9, 65504.0), (-3.0, 0.0)]
        {
            assert_eq!(unpack_halves(pack_halves(x, 0.0)).0, expect);
        }
        assert_eq!(unpack_halves(pack_halves(f32::NAN, f32::INFINITY)), (0.0, HALF_MAX));
        let mut x = 1e-7f32;
        while x < 6e4 {
            let (y, z) = unpack_halves(pack_halves(x, x));
            assert_eq!(y, z);
            // Half of the spacing of half floats: 2^−11 relative, 2^−25 absolute for subnormals.
            assert!((x - y).abs() <= (x * 2f32.powi(-11)).max(2f32.powi(-25)) * 1.0001, "{x} {y}");
            x *= 1.003;
        }
        for h in 0..=0x7bffu16 {
            assert_eq!(half_from_f32(f32_from_half(h)), h);
        }
    }

    #[test]
    fn memory_of_a_frame_is_used_again_where_it_is_about_enough() {
        let bounds = crate::space::Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };
        let header = |side: u32| {
            let intrinsics = crate::camera::Intrinsics::perspective(side, side, 0.7);
            FrameHeader::alone(
                Camera::new(crate::camera::Pose::orbit(Vec3::ZERO, 0.3, 0.2, 5.0), intrinsics, &bounds),
                8,
            )
        };
        let sizes = |frame: &LayeredFrame| {
            [&frame.offsets, &frame.depth, &frame.c_rg, &frame.c_b_tau].map(|words| words.len())
        };
        let mut first = LayeredFrame::in_memory_of(None, header(20), 1000);
        assert_eq!(sizes(&first), [401, 1000, 1000, 1000]);
        first.offsets.fill(7);
        let at = first.depth.as_ptr();
        // Some more, and down to half: the same memory.
        let more = LayeredFrame::in_memory_of(Some(first), header(20), 1100);
        assert_eq!((sizes(&more), more.depth.as_ptr(), more.offsets[0]), ([401, 1100, 1100, 1100], at, 0));
        let less = LayeredFrame::in_memory_of(Some(more), header(18), 600);
        assert_eq!((sizes(&less), less.depth.as_ptr()), ([325, 600, 600, 600], at));
        // Far less keeps no memory that it has no use for, and more has its own.
        let far_less = LayeredFrame::in_memory_of(Some(less), header(2), 10);
        assert_eq!(sizes(&far_less), [5, 10, 10, 10]);
        assert!(far_less.depth.capacity() <= 20 && far_less.offsets.capacity() <= 10);
        let far_more = LayeredFrame::in_memory_of(Some(far_less), header(30), 5000);
        assert_eq!(sizes(&far_more), [901, 5000, 5000, 5000]);
        assert!(far_more.depth.iter().all(|word| *word == 0));
    }

    #[test]
    fn the_more_segments_the_fewer_lists() {
        assert_eq!([1, 8].map(max_lists), [MAX_LISTS; 2]);
        assert_eq!([0, 255].map(max_lists), [MAX_LISTS, ALWAYS_LISTS]);
        for k in 1..=MAX_K as u8 {
            let lists = max_lists(k);
            assert!(lists <= max_lists(k - 1) && (ALWAYS_LISTS..=MAX_LISTS).contains(&lists), "{k}");
            // Above the lists of the largest picture, full ones are within what the codec takes from a peer.
            let segments = lists * usize::from(k);
            assert!(lists == ALWAYS_LISTS || segments <= crate::codec::MAX_FRAME_SEGMENTS, "{k}");
        }
    }

    #[test]
    fn over_has_an_identity_and_is_associative_with_segments() {
        let mut acc = Over::default();
        acc.add(Vec3::new(0.2, 0.1, 0.0), 0.5);
        let before = acc;
        acc.add(Vec3::ZERO, 0.0);
        assert_eq!((before.c, before.transmittance), (acc.c, acc.transmittance));
    }
}
