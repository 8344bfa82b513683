//! Writes files as a whole or not at all, and pictures as PNG.

use std::fs;
use std::path::Path;
use std::sync::{Mutex, PoisonError};

use image::ImageReader;

use crate::error::BenchError;
use crate::progress::note;

/// Writes `bytes` to `path` like [`isinglass_formats::write_whole`], but never while the process ends.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), BenchError> {
    let _writing = WRITING.lock().unwrap_or_else(PoisonError::into_inner);
    isinglass_formats::write_whole(path, bytes).map_err(BenchError::io(path))
}

/// Checks that [`write_whole`] can write the file. Call it before long work whose result would be lost.
pub fn check_writable(path: &Path) -> Result<(), BenchError> {
    let _writing = WRITING.lock().unwrap_or_else(PoisonError::into_inner);
    isinglass_formats::check_writable(path).map_err(BenchError::io(path))
}

/// Ends the process when no file is being written, so that none is left half-written.
pub fn exit_between_writes(code: i32) -> ! {
    let _none_is_written = WRITING.lock().unwrap_or_else(PoisonError::into_inner);
    std::process::exit(code)
}

/// An 8-bit RGB picture, row by row from the top.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rgb8 {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Three bytes per pixel.
    pub bytes: Vec<u8>,
}

impl Rgb8 {
    /// The picture over a background of 8-bit sRGB.
    pub fn of(picture: &isinglass_core::picture::Picture, background: [u8; 3]) -> Self {
        let linear = background.map(|c| isinglass_core::picture::linear_from_srgb(f32::from(c) / 255.0));
        Self { width: picture.width, height: picture.height, bytes: picture.to_srgb8(linear) }
    }

    /// Reads a PNG file. Transparent pixels are composited over `background`.
    pub fn read(path: &Path, background: [u8; 3]) -> Result<Self, BenchError> {
        let broken = |cause: image::ImageError| BenchError::Picture {
            path: path.display().to_string(),
            cause: one_line(&cause.to_string()),
        };
        let found = fs::metadata(path).map_err(BenchError::io(path))?;
        if !found.is_file() {
            let cause = "not a regular file, expected a PNG picture".into();
            return Err(BenchError::Picture { path: path.display().to_string(), cause });
        }
        let reader = ImageReader::open(path).and_then(ImageReader::with_guessed_format);
        let reader = reader.map_err(BenchError::io(path))?;
        if reader.format() != Some(image::ImageFormat::Png) {
            let cause = "not a PNG picture, by its first bytes".into();
            return Err(BenchError::Picture { path: path.display().to_string(), cause });
        }
        let decoded = reader.decode().map_err(broken)?;
        let color = decoded.color();
        if color.bytes_per_pixel() > color.channel_count() {
            note(&format!("note: {} has 16 bits a channel, of which the upper 8 are taken", path.display()));
        }
        let has_alpha = color.has_alpha();
        let (width, height) = (decoded.width(), decoded.height());
        if !has_alpha {
            return Ok(Self { width, height, bytes: decoded.into_rgb8().into_raw() });
        }
        let mut bytes = Vec::with_capacity(width as usize * height as usize * 3);
        for pixel in decoded.into_rgba8().pixels() {
            let [r, g, b, a] = pixel.0;
            bytes.extend([r, g, b].iter().zip(background).map(|(&c, behind)| {
                let blend = u32::from(c) * u32::from(a) + u32::from(behind) * (255 - u32::from(a));
                ((blend + 127) / 255) as u8
            }));
        }
        Ok(Self { width, height, bytes })
    }

    /// Writes a PNG file, whole or not at all.
    pub fn write(&self, path: &Path) -> Result<(), BenchError> {
        let failed = |e: isinglass_formats::png::PngError| BenchError::Picture {
            path: path.display().to_string(),
            cause: one_line(&e.to_string()),
        };
        write_whole(
            path,
            &isinglass_formats::png::encode(self.width, self.height, &self.bytes).map_err(failed)?,
        )
    }

    /// Pictures of the same height, from left to right with a thin grey line between them.
    pub fn beside(pictures: &[&Self]) -> Self {
        let height = pictures.iter().map(|p| p.height).min().unwrap_or(0);
        let gap = if pictures.is_empty() { 0 } else { pictures.len() as u32 - 1 };
        let width = pictures.iter().map(|p| p.width).sum::<u32>() + gap * GAP_PIXELS;
        let mut bytes = Vec::with_capacity(width as usize * height as usize * 3);
        for y in 0..height as usize {
            for (i, p) in pictures.iter().enumerate() {
                if i > 0 {
                    bytes.extend([GAP_GREY; 3 * GAP_PIXELS as usize]);
                }
                let row = p.width as usize * 3;
                bytes.extend_from_slice(&p.bytes[y * row..(y + 1) * row]);
            }
        }
        Self { width, height, bytes }
    }
}

impl Rgb8 {
    /// This picture for the left eye beside that of the right eye. There is no gap: a stereo display splits the
    /// picture in the middle.
    pub fn stereo_pair(&self, right: &Self) -> Self {
        let row_bytes = self.width as usize * 3;
        let rows = self.bytes.chunks_exact(row_bytes).zip(right.bytes.chunks_exact(row_bytes));
        let bytes = rows.flat_map(|(left, right)| [left, right]).flatten().copied().collect();
        Self { width: self.width * 2, height: self.height, bytes }
    }

    /// This picture for the left eye in red, and that of the right eye in green and blue.
    pub fn anaglyph(&self, right: &Self) -> Self {
        let pixels = self.bytes.chunks_exact(3).zip(right.bytes.chunks_exact(3));
        let bytes = pixels.flat_map(|(left, right)| [left[0], right[1], right[2]]).collect();
        Self { bytes, ..*self }
    }
}

/// Joins a text of several lines.
pub fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

static WRITING: Mutex<()> = Mutex::new(());
const GAP_PIXELS: u32 = 4;
const GAP_GREY: u8 = 96;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_survive_their_file_and_nothing_else_is_left() {
        let folder = std::env::temp_dir().join(format!("isinglass-output-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        let picture = Rgb8 { width: 3, height: 2, bytes: (0..18).collect() };
        let path = folder.join("a.png");
        for _ in 0..2 {
            picture.write(&path).unwrap();
        }
        assert_eq!(Rgb8::read(&path, [0; 3]).unwrap(), picture);
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 1);
        assert!(picture.write(&folder.join("none/a.png")).is_err());
        assert!(write_whole(&folder, b"x").is_err());
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 1);
        fs::write(&path, b"no picture").unwrap();
        assert!(matches!(Rgb8::read(&path, [0; 3]), Err(BenchError::Picture { .. })));
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn eyes_stay_on_their_side_and_in_their_channels() {
        let left = Rgb8 { width: 1, height: 2, bytes: vec![1, 2, 3, 4, 5, 6] };
        let right = Rgb8 { bytes: left.bytes.iter().map(|b| b + 10).collect(), ..left };
        let pair = left.stereo_pair(&right);
        assert_eq!((pair.width, pair.height), (2, 2));
        assert_eq!(pair.bytes, [1, 2, 3, 11, 12, 13, 4, 5, 6, 14, 15, 16]);
        assert_eq!(left.anaglyph(&right).bytes, [1, 12, 13, 4, 15, 16]);
        assert_ne!(left.anaglyph(&right), right.anaglyph(&left));
    }

    #[test]
    fn beside_keeps_both_pictures_apart() {
        let a = Rgb8 { width: 1, height: 1, bytes: vec![1, 2, 3] };
        let b = Rgb8 { width: 1, height: 1, bytes: vec![4, 5, 6] };
        let both = Rgb8::beside(&[&a, &b]);
        assert_eq!((both.width, both.height, both.bytes.len()), (6, 1, 18));
        assert_eq!((&both.bytes[..3], &both.bytes[15..]), (&a.bytes[..], &b.bytes[..]));
    }
}
