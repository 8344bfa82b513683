//! Frames that are off by no more than was asked for: the smallest of the codings that keeps a bound, found by decoding.

use super::blocks::{self, MAX_QUALITY};
use super::{CodecError, Coding, EncodedFrame, Settings, decode};
use crate::layer::LayeredFrame;

/// How far a decoded frame may be off.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bound {
    /// Greatest difference of a channel at the frame's own pose, over black, in 1/255 of sRGB.
    pub picture_255: u8,
    /// Greatest shift of a list's middle, in pixels, when the camera turns by `turn_radians`. The middle of a list is the mean
    /// depth of its segments, by what is seen of each.
    pub shift_pixels: f32,
    /// Turn of the camera about the middle of the volume.
    pub turn_radians: f32,
}

/// How far a decoded frame is off: see [`Bound`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Misfit {
    /// Greatest difference of a channel.
    pub picture_255: u8,
    /// Greatest shift, pixels.
    pub shift_pixels: f32,
}

/// An encoded frame, its coding, and how far it is off.
type Kept = (EncodedFrame, Coding, Misfit);

impl Bound {
    /// How far `decoded` is off `frame`, of the same camera. Lists of a projection keep their depths in every coding that they
    /// have, and what is seen of them has no middle: they do not shift.
    pub fn misfit(&self, frame: &LayeredFrame, decoded: &LayeredFrame) -> Misfit {
        let picture = |f: &LayeredFrame| f.flatten().to_srgb8([0.0; 3]);
        let differences = picture(frame).into_iter().zip(picture(decoded)).map(|(a, b)| a.abs_diff(b));
        let camera = &frame.header.camera;
        let pixels_per_unit = self.turn_radians.sin().abs() / blocks::relayer::units_per_pixel(camera);
        // Lists that are hardly there have no middle, nor one that shows.
        let middles = |n| Some((middle(frame, n)?, middle(decoded, n)?));
        let is_projection = frame.header.mode.is_projection();
        let num_lists = if is_projection { 0 } else { camera.intrinsics.num_pixels() };
        let shifts = (0..num_lists).filter_map(middles).map(|(a, b)| (a - b).abs() * pixels_per_unit);
        Misfit { picture_255: differences.max().unwrap_or(0), shift_pixels: shifts.fold(0.0, f32::max) }
    }

    fn holds(&self, misfit: &Misfit) -> bool {
        misfit.picture_255 <= self.picture_255 && misfit.shift_pixels <= self.shift_pixels
    }

    /// Encodes a frame, which must be valid, in the fewest bytes of those codings that keep the bound: blocks of some quality,
    /// or exact lists with colours of 8 or 10 bits. Returns the coding and how far its frame is off.
    ///
    /// # Errors
    /// Those of the codings; [`CodecError::Bound`] if even the exact coding is off by more.
    pub fn encode(&self, frame: &LayeredFrame) -> Result<Kept, CodecError> {
        let attempt = |coding: Coding| {
            let (encoded, _) = coding.encode(frame, None)?;
            let chunks: Vec<&[u8]> = encoded.chunks.iter().map(|c| &c.bytes[..]).collect();
            let misfit = self.misfit(frame, &decode(&chunks)?);
            Ok((encoded, coding, misfit))
        };
        let in_blocks = |quality| attempt(Coding::Blocks(blocks::Settings::of(quality)));
        if !frame.header.mode.is_projection() {
            let best = in_blocks(MAX_QUALITY)?;
            if self.holds(&best.2) {
                return self.coarsest(best, in_blocks);
            }
        }
        let mut least = u8::MAX;
        for color_bits in [8, 10] {
            let found = attempt(Coding::Exact(Settings { color_bits, num_groups: 1 }))?;
            if self.holds(&found.2) {
                return Ok(found);
            }
            least = found.2.picture_255;
        }
        Err(CodecError::Bound(least))
    }

    /// The least quality of blocks that keeps the bound, where the greatest, `best`, does.
    fn coarsest(
        &self,
        mut best: Kept,
        in_blocks: impl Fn(u8) -> Result<Kept, CodecError>,
    ) -> Result<Kept, CodecError> {
        // Least qualities that may hold, and the least that is known to.
        let (mut least, mut known) = (0, MAX_QUALITY);
        while least < known {
            let quality = (least + known) / 2;
            let found = in_blocks(quality)?;
            if self.holds(&found.2) {
                known = quality;
                best = found;
            } else {
                least = quality + 1;
            }
        }
        Ok(best)
    }
}

/// The mean depth of what is seen of a list; none if all of it is less opaque than [`LEAST_OPACITY`].
fn middle(frame: &LayeredFrame, list: usize) -> Option<f32> {
    let (mut sum, mut transmittance) = (0.0, 1.0);
    for segment in frame.list(list).map(|s| frame.segment(s)) {
        let behind = transmittance * (-segment.tau).exp();
        sum += (transmittance - behind) * 0.5 * (f32::from(segment.front) + f32::from(segment.back));
        transmittance = behind;
    }
    let opacity = 1.0 - transmittance;
    (opacity >= LEAST_OPACITY).then(|| sum / opacity)
}

/// Lists below change no channel by much more than one in 255.
const LEAST_OPACITY: f32 = 1.0 / 128.0;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Camera, Intrinsics, Pose};
    use crate::codec::tests::{soft, soft_scene};
    use crate::kernels::layering::generate;
    use crate::kernels::march::{MarchSettings, Scene};
    use crate::layer::FrameHeader;
    use crate::mode::Mode;
    use crate::volume::procedural::Builtin;

    fn made(builtin: Builtin) -> LayeredFrame {
        frame_of(&soft_scene(builtin))
    }

    fn frame_of(scene: &Scene) -> LayeredFrame {
        let bounds = scene.volume.bounds();
        let intrinsics = Intrinsics::perspective(96, 80, 0.6);
        let distance = bounds.radius() * intrinsics.fit_distance();
        let camera = Camera::new(Pose::orbit(glam::Vec3::ZERO, 0.5, 0.3, distance), intrinsics, &bounds);
        generate(scene, FrameHeader::alone(camera, 12))
    }

    #[test]
    fn a_projection_is_coded_exactly_and_does_not_shift() {
        for mode in [Mode::Mip, Mode::MinIp, Mode::Average] {
            let scene = soft_scene(Builtin::Cloud);
            let settings = MarchSettings { mode, ..scene.settings };
            let frame = frame_of(&scene.with_look(&soft(), settings));
            assert!(frame.header.mode == mode && frame.num_segments() > 0);
            let bound = Bound { picture_255: 2, shift_pixels: 0.0, turn_radians: 0.2 };
            let (encoded, coding, misfit) = bound.encode(&frame).unwrap();
            assert!(matches!(coding, Coding::Exact(_)) && encoded.chunks.iter().all(|c| c.is_base), "{mode}");
            assert!(misfit.picture_255 <= 2 && misfit.shift_pixels == 0.0, "{mode}: {misfit:?}");
        }
    }

    /// What is encoded is decoded anew and measured anew, and what costs fewer bytes would not have kept the bound.
    #[test]
    fn bounds_are_kept() {
        let mut blocks = 0;
        for builtin in [Builtin::Cloud, Builtin::Shells] {
            let frame = made(builtin);
            let mut last = usize::MAX;
            for picture_255 in [1, 2, 16, 64] {
                let shift_pixels = f32::from(picture_255) * 0.5;
                let bound = Bound { picture_255, shift_pixels, turn_radians: 10f32.to_radians() };
                let (encoded, coding, misfit) = bound.encode(&frame).unwrap();
                let chunks: Vec<&[u8]> = encoded.chunks.iter().map(|c| &c.bytes[..]).collect();
                let decoded = decode(&chunks).unwrap();
                assert_eq!(bound.misfit(&frame, &decoded), misfit);
                assert!(misfit.picture_255 <= picture_255 && misfit.shift_pixels <= shift_pixels);
                assert!(encoded.num_bytes() <= last, "a wider bound takes more bytes");
                last = encoded.num_bytes();
                if let Coding::Blocks(settings) = coding {
                    blocks += 1;
                    let coarser = settings.quality.checked_sub(1).map(|quality| {
                        let (encoded, _) =
                            blocks::encode(&frame, &blocks::Settings { quality, ..settings }, None).unwrap();
                        let chunks: Vec<&[u8]> = encoded.chunks.iter().map(|c| &c.bytes[..]).collect();
                        bound.holds(&bound.misfit(&frame, &decode(&chunks).unwrap()))
                    });
                    assert_ne!(coarser, Some(true), "{builtin:?} {picture_255}");
                }
            }
        }
        assert!(blocks >= 2, "{blocks} of 8 bounds are kept by blocks");
        let frame = made(Builtin::Shells);
        let none = Bound { picture_255: 0, shift_pixels: 0.0, turn_radians: 0.1 };
        assert!(matches!(none.encode(&frame), Err(CodecError::Bound(_))));
    }
}
