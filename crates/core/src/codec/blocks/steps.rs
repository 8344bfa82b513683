//! Turns a quality into the steps that a chunk states, and into the cost of a layer.

use super::model::BLOCK_LISTS;
use super::scales::{FINE, QUARTERS_PER_U};
use crate::camera::Camera;
use crate::layer::DEPTH_UNITS;

/// How to encode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// 0 to [`MAX_QUALITY`].
    pub quality: u8,
    /// The turn that the frame is made for: the angle between its camera and the displaying one, degrees, at most
    /// [`MAX_TURN_DEG`]. With a smaller turn, more bytes go to the picture at the frame's own pose and fewer to
    /// depths. `None` suits all turns.
    pub turn_deg: Option<u8>,
    /// Most bands, each of which a process of several may code. More bands cost bytes for headers, and for probabilities
    /// of a frame alone. Large frames have several in any case.
    pub max_bands: u8,
}

impl Settings {
    /// Settings of a quality, for all turns and in one band.
    pub const fn of(quality: u8) -> Self {
        Self { quality, turn_deg: None, max_bands: 1 }
    }
}

/// The cost of a layer, which decides when two layers become one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct LayerCost {
    /// The mean move of a list's matter that removing a layer may cause, pixels^(5/4).
    pub(super) lambda: f32,
    /// Length of a pixel's width in depth units, in the middle between near and far.
    pub(super) units_per_pixel: f32,
}

impl LayerCost {
    /// The error that removing a layer of a block may add, in the unit of `LayerSearch::error`.
    pub(super) fn error_per_layer(&self) -> f32 {
        self.lambda * self.units_per_pixel * self.units_per_pixel.sqrt().sqrt() * BLOCK_LISTS as f32
    }
}

/// Length of a pixel's width in depth units, in the middle between near and far.
fn units_per_pixel(camera: &Camera) -> f32 {
    let units_per_world = DEPTH_UNITS / (camera.far - camera.near);
    let middle = 0.5 * (camera.far + camera.near);
    let (_, half_height) = camera.intrinsics.half_size_at(middle);
    2.0 * half_height / camera.intrinsics.height as f32 * units_per_world
}

/// The steps of quantised values, as a decoder needs them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct StepSizes {
    /// Step of depths, depth units.
    pub(super) depth: u16,
    /// Step of u, in quarters of a code.
    pub(super) opacity: u16,
    /// Step of Y where it is fully visible, in units of [`FINE`].
    pub(super) color: u16,
    /// Step of Y in the correction of the picture, in units of [`FINE`].
    pub(super) picture: u16,
    /// Step of Co and Cg over that of Y, in sixteenths.
    pub(super) chroma: u16,
}

impl StepSizes {
    /// Steps of Y, Co and Cg in the correction of the picture.
    pub(super) fn of_picture(&self) -> [i32; 3] {
        let of_chroma = self.of_chroma(self.picture.into());
        [self.picture.into(), of_chroma, of_chroma]
    }

    /// Step of Co and Cg, given that of Y.
    pub(super) fn of_chroma(&self, of_brightness: i32) -> i32 {
        of_brightness.wrapping_mul(self.chroma.into()) >> 4
    }

    pub(super) fn to_bytes(self) -> [u8; STEPS_BYTES] {
        let mut bytes = [0; STEPS_BYTES];
        let words = [self.depth, self.opacity, self.color, self.picture, self.chroma];
        for (bytes, word) in bytes.as_chunks_mut::<2>().0.iter_mut().zip(words) {
            *bytes = word.to_le_bytes();
        }
        bytes
    }

    /// `None` if a step is not positive.
    pub(super) fn from_bytes(bytes: [u8; STEPS_BYTES]) -> Option<Self> {
        let mut words = [0; 5];
        for (word, bytes) in words.iter_mut().zip(bytes.as_chunks::<2>().0) {
            *word = u16::from_le_bytes(*bytes);
        }
        let [depth, opacity, color, picture, chroma] = words;
        words.iter().all(|&word| word > 0).then_some(Self { depth, opacity, color, picture, chroma })
    }
}

/// The cost of layers and the steps for these settings, of a frame that `is_predicted` or stands alone.
pub(super) fn from_settings(
    settings: &Settings,
    is_predicted: bool,
    camera: &Camera,
) -> (LayerCost, StepSizes) {
    let [moves, corrections] = match (settings.turn_deg.map(|t| t.min(MAX_TURN_DEG)), is_predicted) {
        (None, false) => [1.0, 1.0],
        (None, true) => PREDICTED_FOR_ALL,
        (Some(turn), false) => alone_for_turn(turn),
        (Some(turn), true) => predicted_for_turn(turn),
    };
    let at =
        f32::from(settings.quality.min(MAX_QUALITY)) * (FAMILY.len() - 1) as f32 / f32::from(MAX_QUALITY);
    let row = (at as usize).min(FAMILY.len() - 2);
    let part = at - row as f32;
    // Between two rows the steps change by equal factors.
    let [lambda, pixels, opacity, color, picture, chroma]: [f32; 6] =
        std::array::from_fn(|i| FAMILY[row][i] * (FAMILY[row + 1][i] / FAMILY[row][i]).powf(part));
    let units_per_pixel = units_per_pixel(camera);
    let number = |step: f32| step.round().clamp(1.0, 65535.0) as u16;
    let steps = StepSizes {
        depth: number((pixels * units_per_pixel).min(16384.0)),
        opacity: number(opacity * QUARTERS_PER_U),
        color: number(color * FINE),
        picture: number(picture * corrections * FINE),
        chroma: number(chroma * 16.0),
    };
    (LayerCost { lambda: lambda * moves, units_per_pixel }, steps)
}

/// Factors of λ and of the step of corrections for frames without a reference that are made for a turn.
///
/// Matter that moves along a ray appears beside its place by the sine of the turn. So the accepted move is in inverse
/// proportion to that sine, down to a turn where other errors hide it. The correction is of the picture at the own
/// pose, and matters less as the turn grows (docs/MATH.md).
fn alone_for_turn(turn_deg: u8) -> [f32; 2] {
    let nearer = 6.0 / f32::from(turn_deg).max(1.5);
    let corrections: ByTurn = [0.5, 0.85, 1.1, 1.15, 1.2, 1.25, 1.28, 1.31, 1.34, 1.37, 1.4];
    [nearer * nearer.sqrt().sqrt(), corrections[usize::from(turn_deg)]]
}

/// The same for predicted frames, by measurement. Layers are kept from frame to frame, so more of them pay off.
/// Corrections are coded anew each time.
fn predicted_for_turn(turn_deg: u8) -> [f32; 2] {
    let nearer = 3.0 / f32::from(turn_deg).max(0.5);
    let corrections: ByTurn = [0.6, 1.0, 1.15, 1.25, 1.35, 1.45, 1.52, 1.58, 1.64, 1.7, 1.75];
    [nearer.sqrt(), corrections[usize::from(turn_deg)]]
}

/// The same for predicted frames for all turns. What is corrected stays corrected while planes are kept.
const PREDICTED_FOR_ALL: [f32; 2] = [1.0, 0.9];
/// A factor for each turn.
type ByTurn = [f32; MAX_TURN_DEG as usize + 1];
/// Greatest turn that a frame is made for, degrees.
pub const MAX_TURN_DEG: u8 = 10;
/// Best quality.
pub const MAX_QUALITY: u8 = 100;
/// Size of [`StepSizes`], bytes.
pub(super) const STEPS_BYTES: usize = 10;
/// λ, step of depth in pixels, steps of u, of Y and of the correction, and step of colour over that of brightness.
/// The coarsest come first. Measurements found each row better than its neighbours at the same bytes.
const FAMILY: [[f32; 6]; 6] = [
    [26.0, 4.0, 0.45, 0.3, 0.08, 3.5],
    [11.0, 3.0, 0.36, 0.2, 0.05, 3.5],
    [4.5, 2.0, 0.26, 0.15, 0.035, 3.0],
    [1.7, 1.2, 0.17, 0.09, 0.022, 3.0],
    [0.8, 1.0, 0.1, 0.04, 0.016, 2.5],
    [0.16, 1.0, 0.055, 0.025, 0.01, 2.5],
];
