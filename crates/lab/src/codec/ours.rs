//! The product's coding of planes, on planes of image codecs.

use isinglass_core::codec::blocks::raster::BlockPicture;

use super::raster::{Coded, ImageCodec, Raster, code_through_bytes};
use crate::error::LabError;

/// Planes coded as those of the product's layers.
pub(crate) struct Ours;

/// Steps, of the whole range of a sample.
const STEPS: [f32; 10] = [0.28, 0.175, 0.11, 0.07, 0.044, 0.028, 0.0175, 0.011, 0.0062, 0.0028];
/// Colour differences are coded as much coarser as at the product's better qualities.
const CHROMA: f32 = 2.5;

impl ImageCodec for Ours {
    fn max_bits(&self) -> u8 {
        16
    }

    fn levels(&self) -> Vec<String> {
        STEPS.iter().map(|step| format!("step {step}")).collect()
    }

    fn code(&self, raster: &Raster, level: usize) -> Result<Coded, LabError> {
        let &Raster { width, height, channels, bits, .. } = raster;
        let size = [width as usize, height as usize];
        let picture = BlockPicture { size, channels: channels.into(), step: STEPS[level], chroma: CHROMA };
        let samples: Vec<f32> = (0..raster.samples.len()).map(|i| raster.unit(i)).collect();
        let decode =
            |bytes: &[u8]| Ok(Raster::from_units([width, height], channels, bits, &picture.decode(bytes)?));
        code_through_bytes(|| Ok(picture.encode(&samples)), decode)
    }
}

#[cfg(test)]
mod tests {
    use super::super::raster::tests::raster;
    use super::*;

    #[test]
    fn finer_settings_are_nearer_and_larger() {
        for (channels, bits) in [(1, 16), (3, 8)] {
            let given = raster(96, 80, channels, bits);
            let coded: Vec<_> = (0..STEPS.len()).map(|level| Ours.code(&given, level).unwrap()).collect();
            let off = |c: &Coded| -> f32 {
                (0..given.samples.len()).map(|i| (c.decoded.unit(i) - given.unit(i)).powi(2)).sum()
            };
            assert!(coded.windows(2).all(|pair| pair[0].bytes < pair[1].bytes));
            // Neighbours may fall alike on so small a picture; steps that are four times finer do not.
            assert!(coded.windows(4).all(|c| off(&c[0]) > off(&c[3])));
        }
    }
}
