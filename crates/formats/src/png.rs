//! Encodes pictures as PNG files in memory.

use std::io::Cursor;

use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder};

/// Why a picture cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("a picture of {width}×{height} cannot be written as PNG: {cause}")]
pub struct PngError {
    width: u32,
    height: u32,
    cause: String,
}

/// The PNG file of a picture in 8-bit sRGB, with three bytes for each pixel, row by row from the top.
///
/// # Errors
/// The number of bytes does not match the size.
pub fn encode(width: u32, height: u32, rgb: &[u8]) -> Result<Vec<u8>, PngError> {
    let failed = |cause: String| PngError { width, height, cause };
    let expected = width as usize * height as usize * 3;
    if rgb.len() != expected {
        return Err(failed(format!("found {} bytes, expected {expected}", rgb.len())));
    }
    let mut png = Vec::new();
    let encoder = PngEncoder::new(Cursor::new(&mut png));
    encoder.write_image(rgb, width, height, ExtendedColorType::Rgb8).map_err(|e| failed(e.to_string()))?;
    Ok(png)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read_back() {
        let rgb: Vec<u8> = (0..5 * 3 * 3).map(|i| (i * 37 % 256) as u8).collect();
        let png = encode(5, 3, &rgb).unwrap();
        let read = image::load_from_memory(&png).unwrap().into_rgb8();
        assert_eq!((read.width(), read.height(), read.into_raw()), (5, 3, rgb.clone()));
        assert!(encode(5, 4, &rgb).is_err());
    }
}
