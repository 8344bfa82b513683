//! Planes of samples, as image codecs take them, and the one codec of them that is always there: PNG.

use std::io::Cursor;

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ColorType, ExtendedColorType, ImageEncoder, ImageFormat, ImageReader};

use super::clock::timed;
use crate::error::LabError;
use isinglass_core::wire::control::one_line;

/// Samples of one channel or of three, side by side.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Raster {
    /// Columns.
    pub(crate) width: u32,
    /// Rows.
    pub(crate) height: u32,
    /// 1, or 3: red, green and blue.
    pub(crate) channels: u8,
    /// Bits of a sample, 1 to 16.
    pub(crate) bits: u8,
    /// Row by row, all channels of a pixel together.
    pub(crate) samples: Vec<u16>,
}

impl Raster {
    /// Samples from numbers of 0 to 1; others are clamped, NaN is 0.
    pub(crate) fn from_units(size: [u32; 2], channels: u8, bits: u8, values: &[f32]) -> Self {
        let max = max_sample(bits);
        let samples = values.iter().map(|x| (x.clamp(0.0, 1.0) * max + 0.5) as u16).collect();
        Self { width: size[0], height: size[1], channels, bits, samples }
    }

    /// Sample `i` as a number of 0 to 1.
    pub(crate) fn unit(&self, i: usize) -> f32 {
        f32::from(self.samples[i]) / max_sample(self.bits)
    }
}

fn max_sample(bits: u8) -> f32 {
    ((1u32 << bits) - 1) as f32
}

/// What became of a raster.
#[derive(Clone, Debug)]
pub(crate) struct Coded {
    /// Bytes of the coded raster.
    pub(crate) bytes: usize,
    /// As it is decoded.
    pub(crate) decoded: Raster,
    /// Time to encode.
    pub(crate) encode_ms: f64,
    /// Time to decode; none where the encoder itself tells what a decoder gets.
    pub(crate) decode_ms: Option<f64>,
}

/// A codec of rasters.
pub(crate) trait ImageCodec {
    /// Most bits of a sample.
    fn max_bits(&self) -> u8;

    /// Its settings from coarse to fine, by name; one where nothing is lost.
    fn levels(&self) -> Vec<String>;

    /// Encodes and decodes with setting `level`.
    fn code(&self, raster: &Raster, level: usize) -> Result<Coded, LabError>;
}

/// For codecs with an encoder and a decoder of bytes.
pub(crate) fn code_through_bytes(
    encode: impl Fn() -> Result<Vec<u8>, LabError>,
    decode: impl Fn(&[u8]) -> Result<Raster, LabError>,
) -> Result<Coded, LabError> {
    let (bytes, encode_ms) = timed(encode)?;
    let (decoded, decode_ms) = timed(|| decode(&bytes))?;
    Ok(Coded { bytes: bytes.len(), decoded, encode_ms, decode_ms: Some(decode_ms) })
}

/// PNG of 8 or 16 bits at its best compression.
pub(crate) struct Png;

impl ImageCodec for Png {
    fn max_bits(&self) -> u8 {
        16
    }

    fn levels(&self) -> Vec<String> {
        vec!["best".into()]
    }

    fn code(&self, raster: &Raster, _level: usize) -> Result<Coded, LabError> {
        code_through_bytes(|| png_from_raster(raster), |bytes| raster_from_png(bytes, raster.bits))
    }
}

fn failed(cause: &dyn std::fmt::Display) -> LabError {
    LabError::Rival { codec: "png", cause: one_line(&cause.to_string()) }
}

pub(super) fn png_from_raster(raster: &Raster) -> Result<Vec<u8>, LabError> {
    let mut png = Vec::new();
    let encoder =
        PngEncoder::new_with_quality(Cursor::new(&mut png), CompressionType::Best, FilterType::Adaptive);
    let (bytes, color): (Vec<u8>, _) = match (raster.bits, raster.channels) {
        (..=8, 1) => (raster.samples.iter().map(|s| *s as u8).collect(), ExtendedColorType::L8),
        (..=8, _) => (raster.samples.iter().map(|s| *s as u8).collect(), ExtendedColorType::Rgb8),
        // The encoder takes samples in the order of this machine.
        (_, 1) => (raster.samples.iter().flat_map(|s| s.to_ne_bytes()).collect(), ExtendedColorType::L16),
        _ => (raster.samples.iter().flat_map(|s| s.to_ne_bytes()).collect(), ExtendedColorType::Rgb16),
    };
    encoder.write_image(&bytes, raster.width, raster.height, color).map_err(|e| failed(&e))?;
    Ok(png)
}

pub(super) fn raster_from_png(png: &[u8], bits: u8) -> Result<Raster, LabError> {
    let decoded = ImageReader::with_format(Cursor::new(png), ImageFormat::Png).decode();
    let decoded = decoded.map_err(|e| failed(&e))?;
    let (width, height) = (decoded.width(), decoded.height());
    let channels = if decoded.color().has_color() { 3 } else { 1 };
    let samples = match decoded.color() {
        ColorType::L8 => decoded.into_luma8().into_raw().into_iter().map(u16::from).collect(),
        ColorType::Rgb8 => decoded.into_rgb8().into_raw().into_iter().map(u16::from).collect(),
        ColorType::L16 => decoded.into_luma16().into_raw(),
        ColorType::Rgb16 => decoded.into_rgb16().into_raw(),
        other => return Err(failed(&format!("decoded to {other:?}"))),
    };
    Ok(Raster { width, height, channels, bits, samples })
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// A seeded raster: a smooth ramp with an edge and a little noise.
    pub(crate) fn raster(width: u32, height: u32, channels: u8, bits: u8) -> Raster {
        let mut state = 7u32;
        let values: Vec<f32> = (0..width * height * u32::from(channels))
            .map(|i| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let (pixel, channel) = (i / u32::from(channels), i % u32::from(channels));
                let (x, y) = (pixel % width, pixel / width);
                let ramp = (x + 2 * y + 5 * channel) as f32 / (width + 2 * height) as f32;
                let edge = if x > y { 0.25 } else { 0.0 };
                0.6 * ramp + edge + (state >> 24) as f32 / 255.0 * 0.02
            })
            .collect();
        Raster::from_units([width, height], channels, bits, &values)
    }

    /// Root of the mean squared error, of 1.
    #[cfg(feature = "rivals")]
    pub(crate) fn rms(a: &Raster, b: &Raster) -> f64 {
        let sum: f64 = (0..a.samples.len()).map(|i| f64::from(a.unit(i) - b.unit(i)).powi(2)).sum();
        (sum / a.samples.len() as f64).sqrt()
    }

    #[test]
    fn png_gives_back_what_it_was_given() {
        for (channels, bits) in [(1, 8), (3, 8), (1, 16), (1, 12), (3, 10)] {
            let given = raster(37, 22, channels, bits);
            let coded = Png.code(&given, 0).unwrap();
            assert_eq!(coded.decoded, given);
            let raw = given.samples.len() * if bits > 8 { 2 } else { 1 };
            assert!(coded.bytes < raw, "{} of {raw}", coded.bytes);
            let mut other = given.clone();
            other.samples[11] ^= 1;
            assert_ne!(Png.code(&other, 0).unwrap().decoded, given);
        }
    }

    #[test]
    fn units_are_clamped_and_rounded() {
        let r = Raster::from_units([4, 1], 1, 8, &[-1.0, f32::NAN, 0.5, 2.0]);
        assert_eq!(r.samples, [0, 0, 128, 255]);
        assert_eq!((r.unit(0), r.unit(3)), (0.0, 1.0));
    }
}
