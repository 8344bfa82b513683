//! Pictures of 8 bits a channel, and PNG files of them.

use std::io::Cursor;
use std::path::Path;

use image::codecs::png::{PngDecoder, PngEncoder};
use image::{DynamicImage, ExtendedColorType, ImageDecoder, ImageEncoder};
use isinglass_core::picture::{Picture, linear_from_srgb};

use crate::error::FormatError;
use crate::output::write_whole;

/// A picture in 8-bit sRGB, row by row from the top.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rgb8 {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Three bytes for each pixel.
    pub bytes: Vec<u8>,
}

impl Rgb8 {
    /// The picture on a background of 8-bit sRGB.
    pub fn of(picture: &Picture, background: [u8; 3]) -> Self {
        let linear = background.map(|c| linear_from_srgb(f32::from(c) / 255.0));
        Self { width: picture.width, height: picture.height, bytes: picture.to_srgb8(linear) }
    }

    /// Writes a PNG file with [`write_whole`].
    ///
    /// # Errors
    /// The number of bytes does not match the size, or the system refuses.
    pub fn write(&self, path: &Path) -> Result<(), FormatError> {
        let png = encode(self.width, self.height, &self.bytes).map_err(|e| FormatError::Malformed {
            path: path.display().to_string(),
            format: "PNG".into(),
            problem: e.to_string(),
        })?;
        write_whole(path, &png)
    }
}

/// Why a picture cannot be written or read.
#[derive(Debug, thiserror::Error)]
#[error("a PNG picture of {width}×{height}: {cause}")]
pub struct PngError {
    width: u32,
    height: u32,
    cause: String,
}

/// Reads a PNG file of at most `most_pixels` pixels. Its transparency is dropped.
///
/// # Errors
/// The bytes are no PNG file, or one of a larger picture.
pub fn decode(png: &[u8], most_pixels: u64) -> Result<Rgb8, PngError> {
    let picture = decode_any(png, most_pixels)?;
    let (width, height) = (picture.width(), picture.height());
    Ok(Rgb8 { width, height, bytes: picture.into_rgb8().into_raw() })
}

fn decode_any(png: &[u8], most_pixels: u64) -> Result<DynamicImage, PngError> {
    let failed = |width, height, cause: String| PngError { width, height, cause };
    let mut limits = image::Limits::default();
    limits.max_alloc = Some(most_pixels * 16);
    let decoder =
        PngDecoder::with_limits(Cursor::new(png), limits).map_err(|e| failed(0, 0, e.to_string()))?;
    let (width, height) = decoder.dimensions();
    if u64::from(width) * u64::from(height) > most_pixels {
        return Err(failed(width, height, format!("expected at most {most_pixels} pixels")));
    }
    DynamicImage::from_decoder(decoder).map_err(|e| failed(width, height, e.to_string()))
}

/// Reads a PNG file of at most `most_pixels` pixels: its columns and rows, and four bytes a pixel, with straight opacity.
///
/// # Errors
/// The bytes are no PNG file, or one of a larger picture.
pub fn decode_rgba(png: &[u8], most_pixels: u64) -> Result<([u32; 2], Vec<u8>), PngError> {
    let picture = decode_any(png, most_pixels)?;
    Ok(([picture.width(), picture.height()], picture.into_rgba8().into_raw()))
}

/// The PNG file of a picture in 8-bit sRGB, row by row from the top. A pixel has three bytes, or four with its straight
/// opacity.
///
/// # Errors
/// The number of bytes does not match the size.
pub fn encode(width: u32, height: u32, pixels: &[u8]) -> Result<Vec<u8>, PngError> {
    let failed = |cause: String| PngError { width, height, cause };
    let num_pixels = width as usize * height as usize;
    let color = match pixels.len() {
        length if length == 3 * num_pixels => ExtendedColorType::Rgb8,
        length if length == 4 * num_pixels => ExtendedColorType::Rgba8,
        length => return Err(failed(format!("found {length} bytes, expected {}", 3 * num_pixels))),
    };
    let mut png = Vec::new();
    let encoder = PngEncoder::new(Cursor::new(&mut png));
    encoder.write_image(pixels, width, height, color).map_err(|e| failed(e.to_string()))?;
    Ok(png)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read_back() {
        let rgb: Vec<u8> = (0..5 * 3 * 3).map(|i| (i * 37 % 256) as u8).collect();
        let png = encode(5, 3, &rgb).unwrap();
        assert_eq!(decode(&png, 15).unwrap(), Rgb8 { width: 5, height: 3, bytes: rgb.clone() });
        assert!(decode(&png, 14).is_err() && decode(&png[..40], 15).is_err() && decode(b"no", 15).is_err());
        assert!(encode(5, 4, &rgb).is_err());
        let rgba: Vec<u8> = rgb.chunks(3).flat_map(|p| [p[0], p[1], p[2], 77]).collect();
        let png = encode(5, 3, &rgba).unwrap();
        assert!(decode(&png, 15).unwrap().bytes == rgb && png[25] == 6, "its colour type has opacity");
        assert_eq!(decode_rgba(&png, 15).unwrap(), ([5, 3], rgba));
    }
}
