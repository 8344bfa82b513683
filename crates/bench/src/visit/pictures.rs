//! Writes pictures on a thread of its own, so that no refresh waits for a file.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread::JoinHandle;

use isinglass_core::picture::Picture;
use isinglass_formats::FormatError;
use isinglass_formats::png::Rgb8;

use crate::error::BenchError;

/// A picture, the size at which it was shown, and its file.
type Waiting = (PathBuf, Arc<Picture>, [u32; 2]);

pub(super) struct PictureWriter {
    folder: PathBuf,
    queue: SyncSender<Waiting>,
    thread: JoinHandle<Result<(), FormatError>>,
    num_left_out: usize,
}

impl PictureWriter {
    pub(super) fn start(folder: &Path) -> Result<Self, BenchError> {
        let (queue, pictures) = sync_channel::<Waiting>(MAX_WAITING);
        let thread = std::thread::Builder::new().name("pictures".into()).spawn(move || {
            let mut written = Ok(());
            for (path, picture, size) in pictures {
                if written.is_ok() {
                    written = Rgb8::of(&enlarged(&picture, size), [0; 3]).write(&path);
                }
            }
            written
        });
        let thread = thread.map_err(BenchError::io(folder))?;
        Ok(Self { folder: folder.to_owned(), queue, thread, num_left_out: 0 })
    }

    /// Writes a picture when there is time. While too many wait, it is left out.
    pub(super) fn put(&mut self, name: &str, picture: Option<(Arc<Picture>, [u32; 2])>) {
        let Some((picture, size)) = picture else { return };
        let path = self.folder.join(format!("{name}.png"));
        self.num_left_out += usize::from(self.queue.try_send((path, picture, size)).is_err());
    }

    /// Waits for the last one. Returns how many were left out.
    pub(super) fn finish(self) -> Result<usize, BenchError> {
        let Self { queue, thread, num_left_out, .. } = self;
        drop(queue);
        let written = thread.join().map_err(|_| BenchError::Demo("a picture could not be written".into()))?;
        written?;
        Ok(num_left_out)
    }
}

/// The picture as a window shows one that was cast in a smaller size: interpolated linearly.
fn enlarged(picture: &Picture, [width, height]: [u32; 2]) -> Picture {
    if (picture.width, picture.height) == (width, height) || picture.pixels.is_empty() {
        return picture.clone();
    }
    let mut out = Picture::new(width, height);
    // The pixel before a place, the one behind it, and the share of the second.
    let places = |to: u32, from: u32| -> Vec<(usize, usize, f32)> {
        let place = |i: u32| {
            let at = ((i as f32 + 0.5) * from as f32 / to as f32 - 0.5).clamp(0.0, (from - 1) as f32);
            (at as usize, (at as usize + 1).min(from as usize - 1), at.fract())
        };
        (0..to).map(place).collect()
    };
    let columns = places(width, picture.width);
    let rows = places(height, picture.height);
    let from = |x: usize, y: usize| picture.pixels[y * picture.width as usize + x];
    for (row, &(y0, y1, v)) in out.pixels.chunks_exact_mut(width as usize).zip(&rows) {
        for (pixel, &(x0, x1, u)) in row.iter_mut().zip(&columns) {
            let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
            *pixel = std::array::from_fn(|c| {
                let [upper, lower] = [y0, y1].map(|y| mix(from(x0, y)[c], from(x1, y)[c], u));
                mix(upper, lower, v)
            });
        }
    }
    out
}

/// Most pictures that wait for the disk.
const MAX_WAITING: usize = 8;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_smaller_picture_is_enlarged_between_its_pixels() {
        let mut small = Picture::new(2, 1);
        small.pixels[1] = [1.0; 4];
        let large = enlarged(&small, [4, 2]);
        assert_eq!((large.width, large.height), (4, 2));
        for row in large.pixels.chunks(4) {
            assert_eq!(row.iter().map(|p| p[0]).collect::<Vec<_>>(), [0.0, 0.25, 0.75, 1.0]);
        }
        assert_eq!(enlarged(&small, [2, 1]), small);
    }

    #[test]
    fn pictures_are_written_and_a_folder_that_is_gone_is_an_error() {
        let folder = std::env::temp_dir().join(format!("isinglass-pictures-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let picture = Some((Arc::new(Picture::new(3, 2)), [6, 4]));
        let mut writer = PictureWriter::start(&folder).unwrap();
        writer.put("first", picture.clone());
        writer.put("none", None);
        assert_eq!(writer.finish().unwrap(), 0);
        assert!(folder.join("first.png").exists() && !folder.join("none.png").exists());
        std::fs::remove_dir_all(&folder).unwrap();
        let mut writer = PictureWriter::start(&folder).unwrap();
        writer.put("first", picture);
        assert!(writer.finish().is_err());
    }
}
