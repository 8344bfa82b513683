//! Writes pictures on a thread of its own, so that no refresh waits for a file.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::thread::JoinHandle;

use isinglass_core::picture::Picture;
use isinglass_formats::FormatError;
use isinglass_formats::png::Rgb8;

use crate::error::BenchError;

pub(super) struct PictureWriter {
    folder: PathBuf,
    queue: SyncSender<(PathBuf, Arc<Picture>)>,
    thread: JoinHandle<Result<(), FormatError>>,
    num_left_out: usize,
}

impl PictureWriter {
    pub(super) fn start(folder: &Path) -> Result<Self, BenchError> {
        let (queue, pictures) = sync_channel::<(PathBuf, Arc<Picture>)>(MAX_WAITING);
        let thread = std::thread::Builder::new().name("pictures".into()).spawn(move || {
            let mut written = Ok(());
            for (path, picture) in pictures {
                if written.is_ok() {
                    written = Rgb8::of(&picture, [0; 3]).write(&path);
                }
            }
            written
        });
        let thread = thread.map_err(BenchError::io(folder))?;
        Ok(Self { folder: folder.to_owned(), queue, thread, num_left_out: 0 })
    }

    /// Writes a picture when there is time. While too many wait, it is left out.
    pub(super) fn put(&mut self, name: &str, picture: Option<Arc<Picture>>) {
        let Some(picture) = picture else { return };
        let path = self.folder.join(format!("{name}.png"));
        self.num_left_out += usize::from(self.queue.try_send((path, picture)).is_err());
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

/// Most pictures that wait for the disk.
const MAX_WAITING: usize = 8;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_are_written_and_a_folder_that_is_gone_is_an_error() {
        let folder = std::env::temp_dir().join(format!("isinglass-pictures-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let picture = Some(Arc::new(Picture::new(3, 2)));
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
