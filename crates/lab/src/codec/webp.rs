//! Lossless WebP. It has 8 bits per sample, so wider planes are sent as two, high and low bytes.

use std::io::Cursor;

use image_webp::{ColorType, WebPDecoder, WebPEncoder};

use super::raster::{Coded, ImageCodec, Raster, code_through_bytes};
use crate::error::LabError;

pub(crate) struct WebP;

impl ImageCodec for WebP {
    fn max_bits(&self) -> u8 {
        16
    }

    fn levels(&self) -> Vec<String> {
        vec!["lossless".into()]
    }

    fn code(&self, raster: &Raster, _level: usize) -> Result<Coded, LabError> {
        let &Raster { width, height, channels, bits, .. } = raster;
        if bits <= 8 {
            return code_through_bytes(|| encode(raster), |bytes| decode(bytes, channels));
        }
        let half = |shift: u32| {
            let samples = raster.samples.iter().map(|s| s >> shift & 0xff).collect();
            let half = Raster { width, height, channels, bits: 8, samples };
            code_through_bytes(|| encode(&half), |bytes| decode(bytes, channels))
        };
        let (high, low) = (half(8)?, half(0)?);
        let samples = high.decoded.samples.iter().zip(&low.decoded.samples).map(|(h, l)| h << 8 | l);
        Ok(Coded {
            bytes: high.bytes + low.bytes,
            decoded: Raster { width, height, channels, bits, samples: samples.collect() },
            encode_ms: high.encode_ms + low.encode_ms,
            decode_ms: high.decode_ms.zip(low.decode_ms).map(|(h, l)| h + l),
        })
    }
}

fn encode(raster: &Raster) -> Result<Vec<u8>, LabError> {
    let bytes: Vec<u8> = raster.samples.iter().map(|s| *s as u8).collect();
    let color = if raster.channels == 1 { ColorType::L8 } else { ColorType::Rgb8 };
    let mut out = Vec::new();
    WebPEncoder::new(&mut out).encode(&bytes, raster.width, raster.height, color).map_err(|e| failed(&e))?;
    Ok(out)
}

fn decode(bytes: &[u8], channels: u8) -> Result<Raster, LabError> {
    let mut decoder = WebPDecoder::new(Cursor::new(bytes)).map_err(|e| failed(&e))?;
    let (width, height) = decoder.dimensions();
    let size = decoder.output_buffer_size().ok_or_else(|| failed(&"too large"))?;
    let mut rgb = vec![0; size];
    decoder.read_image(&mut rgb).map_err(|e| failed(&e))?;
    let pixel = if decoder.has_alpha() { 4 } else { 3 };
    let kept = usize::from(channels);
    let samples = rgb.chunks_exact(pixel).flat_map(|p| p[..kept].iter().map(|s| u16::from(*s))).collect();
    Ok(Raster { width, height, channels, bits: 8, samples })
}

fn failed(cause: &dyn std::fmt::Display) -> LabError {
    LabError::Rival { codec: "webp", cause: cause.to_string() }
}

#[cfg(test)]
mod tests {
    use super::super::raster::tests::raster;
    use super::*;

    #[test]
    fn webp_gives_back_what_it_was_given() {
        for (channels, bits) in [(1, 8), (3, 8), (1, 16), (3, 10)] {
            let given = raster(37, 22, channels, bits);
            let coded = WebP.code(&given, 0).unwrap();
            assert_eq!(coded.decoded, given);
            let mut other = given.clone();
            other.samples[3] ^= 1;
            assert_ne!(WebP.code(&other, 0).unwrap().decoded, given);
        }
    }
}
