//! Rate control: finds the quality at which a frame has at most a given number of bytes.

use super::super::chunk::EncodedFrame;
use super::super::error::CodecError;
use super::encode::encode;
use super::reference::Reference;
use super::steps::{MAX_QUALITY, Settings};
use crate::layer::LayeredFrame;

/// Finds the quality of consecutive frames, so that each has at most a given number of bytes.
///
/// A picture changes little from frame to frame, so the size of the last frame predicts that of the next one.
/// Predicted frames and others have separate estimates, because their sizes differ by a factor.
#[derive(Clone, Copy, Debug)]
pub struct RateControl {
    target_bytes: f32,
    /// log₂ of the bytes that a frame would have at quality 0: first for frames alone, then for predicted ones.
    floor_octaves: [Option<f32>; 2],
}

impl RateControl {
    /// Starts with this limit of bytes for each frame.
    pub fn new(target_bytes: usize) -> Self {
        Self { target_bytes: target_bytes.max(1) as f32, floor_octaves: [None; 2] }
    }

    /// Changes the limit of bytes for each frame.
    pub fn set_target(&mut self, target_bytes: usize) {
        self.target_bytes = target_bytes.max(1) as f32;
    }

    /// The quality for the next frame. It is medium until a frame was seen.
    pub fn quality(&self, is_predicted: bool) -> u8 {
        let Some(floor) = self.floor(is_predicted) else { return MAX_QUALITY / 2 };
        let octaves = (self.target_bytes * AIM).log2() - floor;
        (octaves / OCTAVES_PER_QUALITY).floor().clamp(0.0, f32::from(MAX_QUALITY)) as u8
    }

    /// The predicted bytes of the next frame at this quality, if a frame was seen.
    pub fn expected_bytes(&self, is_predicted: bool, quality: u8) -> Option<f32> {
        Some((self.floor(is_predicted)? + f32::from(quality) * OCTAVES_PER_QUALITY).exp2())
    }

    /// Learns from the size of a frame.
    pub fn observe(&mut self, is_predicted: bool, quality: u8, bytes: usize) {
        let found = (bytes.max(1) as f32).log2() - f32::from(quality) * OCTAVES_PER_QUALITY;
        let floor = &mut self.floor_octaves[usize::from(is_predicted)];
        // A larger size counts fully, and a smaller one by half, because one easy frame among hard ones says little.
        let gain = if floor.is_none_or(|known| found > known) { 1.0 } else { 0.5 };
        let known = floor.unwrap_or(found);
        *floor = Some(known + gain * (found - known));
    }

    fn floor(&self, is_predicted: bool) -> Option<f32> {
        let [whole, predicted] = self.floor_octaves;
        if is_predicted {
            predicted.or(whole.map(|o| o - PREDICTION_OCTAVES))
        } else {
            whole.or(predicted.map(|o| o + PREDICTION_OCTAVES))
        }
    }
}

/// Encodes a frame at the best quality within `max_bytes`, in at most [`MAX_ENCODES`] trials. Returns the frame, the
/// reference that a receiver will have, and the quality. All trials use the other `settings`.
///
/// # Errors
/// Those of [`encode`], and [`CodecError::TooLarge`] if no trial is small enough.
pub fn encode_within(
    frame: &LayeredFrame,
    max_bytes: usize,
    settings: &Settings,
    reference: Option<&Reference>,
) -> Result<(EncodedFrame, Reference, u8), CodecError> {
    let mut control = RateControl::new(max_bytes);
    let mut best = None;
    // The best quality that fits and the least one that does not, with log₂ of their bytes.
    let mut fits = None::<(u8, f32)>;
    let mut exceeds = None::<(u8, f32)>;
    for trial in 0..MAX_ENCODES {
        let least = fits.map_or(0, |(q, _)| q + 1);
        let most = exceeds.map_or(MAX_QUALITY, |(q, _)| q.saturating_sub(1));
        if least > most || exceeds.is_some_and(|(q, _)| q == 0) {
            break;
        }
        let guess = match (fits, exceeds) {
            (Some((q, octaves)), Some((above, above_octaves))) => {
                let share = ((max_bytes as f32).log2() - octaves) / (above_octaves - octaves).max(1e-3);
                q + (share.clamp(0.0, 1.0) * f32::from(above - q)) as u8
            }
            // The last chance for a frame that fits.
            (None, Some(_)) if trial + 1 == MAX_ENCODES => 0,
            _ => control.quality(reference.is_some()),
        };
        let quality = guess.clamp(least, most);
        let (encoded, decoded) = encode(frame, &Settings { quality, ..*settings }, reference)?;
        let bytes = encoded.num_bytes();
        control = RateControl::new(max_bytes);
        control.observe(reference.is_some(), quality, bytes);
        let found = Some((quality, (bytes as f32).log2()));
        if bytes <= max_bytes {
            fits = found;
            best = Some((encoded, decoded, quality));
        } else {
            exceeds = found;
        }
    }
    let least = exceeds.map_or(0, |(_, octaves)| octaves.exp2() as usize);
    best.ok_or(CodecError::TooLarge { what: "bytes with the least quality", found: least, limit: max_bytes })
}

/// Most trials of [`encode_within`]. The first few come close to the final quality, and more make no visible
/// difference.
pub const MAX_ENCODES: usize = 6;
/// Target size over the limit, so that frames may grow a little from one to the next.
const AIM: f32 = 0.92;
/// log₂ of the growth in bytes for one step of quality: 3.7 from the least to the best quality.
const OCTAVES_PER_QUALITY: f32 = 3.7 / MAX_QUALITY as f32;
/// log₂ of the saving by prediction, before a predicted frame was seen.
const PREDICTION_OCTAVES: f32 = 0.8;
