//! Codes pictures like the planes of a layer, and smooths the borders of blocks like those of a frame's picture.
//! Transform, contexts and bits are the same, but there is no depth, mask or reference. No frame is sent in this
//! form. It serves to compare the coding of planes with image codecs on the same planes.

use super::super::error::CodecError;
use super::entropy::{BitRecorder, Coder, Decoder, Tables, Tally, encoded};
use super::model::{BLOCK, BLOCK_LISTS};
use super::residual::{Expected, residual};
use super::scales::{FINE, roots_from_ycc, ycc_from_roots};
use super::smooth::{Border, smooth};
use super::syntax::{Contexts, NO_CLASS};
use super::transform::{BlockNumbers, BlockPlane};

/// The shape of a picture, and the steps of its coding.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BlockPicture {
    /// Columns and rows.
    pub size: [usize; 2],
    /// Number of channels: 1, or 3 for red, green and blue.
    pub channels: usize,
    /// Step of the one channel, or of brightness.
    pub step: f32,
    /// Step of colour differences over that of brightness.
    pub chroma: f32,
}

impl BlockPicture {
    /// Encodes samples from 0 to 1, row by row, with the channels of a pixel side by side.
    pub fn encode(&self, samples: &[f32]) -> Vec<u8> {
        let recorder = self.code(BitRecorder::default(), samples, None);
        let (tables, mut bytes) = Tables::changed(&recorder.tally());
        bytes.extend(encoded(&recorder.bits, &tables));
        bytes
    }

    /// Decodes the samples, with their coding error.
    pub fn decode(&self, bytes: &[u8]) -> Result<Vec<f32>, CodecError> {
        let mut whole = Vec::new();
        let mut coded = bytes;
        let tables = Tables::read(&mut coded)?;
        if !self.code(Decoder::new(coded, &tables, Tally::default()), &[], Some(&mut whole)).is_at_end() {
            return Err(CodecError::Payload { plane: "picture", problem: "ends too early".into() });
        }
        self.smooth(&mut whole);
        let mut samples = vec![0.0; self.size[0] * self.size[1] * self.channels];
        for (block, values) in whole.iter().enumerate() {
            for i in 0..BLOCK_LISTS {
                let Some(at) = self.place(block, i) else { continue };
                let pixel = values.each_ref().map(|plane| plane[i]);
                let pixel = if self.channels == 1 { pixel } else { roots_from_ycc(pixel) };
                for (sample, value) in samples[at..at + self.channels].iter_mut().zip(pixel) {
                    *sample = (value as f32 / FINE).clamp(0.0, 1.0);
                }
            }
        }
        Ok(samples)
    }

    /// Codes the blocks. `whole`, if given, gets their decoded components.
    fn code<C: Coder>(
        &self,
        mut coder: C,
        samples: &[f32],
        mut whole: Option<&mut Vec<[BlockNumbers; 3]>>,
    ) -> C {
        let [width, height] = self.size;
        let contexts = Contexts::all();
        let across = width.div_ceil(BLOCK);
        // Means and classes of the components of all blocks so far.
        let mut coded: Vec<[(i32, u8); 3]> = Vec::with_capacity(across * height.div_ceil(BLOCK));
        let steps = self.steps();
        for block in 0..across * height.div_ceil(BLOCK) {
            let mask = self.mask(block);
            let source = C::ENCODES.then(|| self.block(samples, block));
            let left = (block % across > 0).then(|| &coded[block - 1]);
            let above = block.checked_sub(across).map(|b| &coded[b]);
            let mut own = [(0, 0); 3];
            let mut values = [[0; BLOCK_LISTS]; 3];
            for (c, values) in values.iter_mut().enumerate().take(self.channels) {
                let near = [left, above].map(|b| b.map(|b| &b[c]));
                let beside = match near {
                    [Some((_, a)), Some((_, b))] => (a + b) / 2,
                    [Some((_, a)), None] | [None, Some((_, a))] => *a,
                    [None, None] => NO_CLASS,
                };
                let in_front = if c == 0 { NO_CLASS } else { own[c - 1].1 };
                let component = if self.channels == 1 { 0 } else { [1, 2, 2][c] };
                let mean = match near {
                    [Some((a, _)), Some((b, _))] => (a + b) >> 1,
                    [Some((a, _)), None] | [None, Some((a, _))] => *a,
                    [None, None] => 0,
                };
                let (class, _) = residual(
                    &mut coder,
                    contexts,
                    component,
                    [in_front, beside],
                    steps[c],
                    mask,
                    source.as_ref().map(|s| &s[c]),
                    &Expected::Constant(mean),
                    values,
                );
                own[c] = (values.iter().sum::<i32>() >> 6, class);
            }
            coded.push(own);
            if let Some(whole) = &mut whole {
                whole.push(values);
            }
        }
        coder
    }

    /// Steps of the components.
    fn steps(&self) -> [i32; 3] {
        [1.0, self.chroma, self.chroma].map(|by| (self.step * by * FINE).round() as i32)
    }

    /// Smooths the borders between all blocks.
    fn smooth(&self, whole: &mut [[BlockNumbers; 3]]) {
        let across = self.size[0].div_ceil(BLOCK);
        let steps = &self.steps()[..self.channels];
        for (border, back) in [(Border::Beside, 1), (Border::Below, across)] {
            for block in back..whole.len() {
                if border == Border::Beside && block % across == 0 {
                    continue;
                }
                let (before, from) = whole.split_at_mut(block);
                let lines = border.lines(self.mask(block - back), self.mask(block));
                smooth(border, &mut before[block - back], &mut from[0], lines, steps);
            }
        }
    }

    /// Index of the first sample of list `i` of a block, if the list is inside the picture.
    fn place(&self, block: usize, i: usize) -> Option<usize> {
        let [width, height] = self.size;
        let across = width.div_ceil(BLOCK);
        let [x, y] = [block % across * BLOCK + i % BLOCK, block / across * BLOCK + i / BLOCK];
        (x < width && y < height).then_some((y * width + x) * self.channels)
    }

    /// Mask of a block's lists inside the picture.
    fn mask(&self, block: usize) -> u64 {
        let across = self.size[0].div_ceil(BLOCK);
        let [columns, rows] = [(0, block % across), (1, block / across)]
            .map(|(axis, at)| self.size[axis].saturating_sub(at * BLOCK).min(BLOCK));
        (0..rows).fold(0, |mask, y| mask | ((1u64 << columns) - 1) << (y * BLOCK))
    }

    /// The components of a block.
    fn block(&self, samples: &[f32], block: usize) -> [BlockPlane; 3] {
        let mut planes = [[0.0; BLOCK_LISTS]; 3];
        for i in 0..BLOCK_LISTS {
            let Some(at) = self.place(block, i) else { continue };
            let pixel = match samples[at..at + self.channels] {
                [r, g, b] => ycc_from_roots([r, g, b]),
                ref one => [one[0], 0.0, 0.0],
            };
            for (plane, value) in planes.iter_mut().zip(pixel) {
                plane[i] = value * FINE;
            }
        }
        planes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_come_back_within_their_steps_and_finer_ones_are_larger() {
        for (size, channels) in [([37, 22], 1), ([64, 40], 3), ([1, 1], 3)] {
            let samples: Vec<f32> = (0..size[0] * size[1] * channels)
                .map(|i| 0.5 + 0.4 * ((i / channels) as f32 * 0.05 + (i % channels) as f32).sin())
                .collect();
            let mut last = 0;
            for step in [0.2, 0.05, 0.01] {
                let picture = BlockPicture { size, channels, step, chroma: 2.0 };
                let bytes = picture.encode(&samples);
                let found = picture.decode(&bytes).unwrap();
                let squares: f32 = samples.iter().zip(&found).map(|(a, b)| (a - b).powi(2)).sum();
                // Half a step of the coefficients at most, twice that of differences; a colour is the sum of three.
                assert!((squares / samples.len() as f32).sqrt() < 1.5 * step, "{size:?} {step}");
                assert!(bytes.len() >= last);
                last = bytes.len();
            }
            let picture = BlockPicture { size, channels, step: 0.01, chroma: 2.0 };
            let bytes = picture.encode(&samples);
            if size[0] > 1 {
                assert!(picture.decode(&bytes[..bytes.len() / 2]).is_err());
            }
        }
    }
}
