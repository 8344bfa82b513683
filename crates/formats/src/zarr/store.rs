//! Where the files of an image are.

use std::fs::File;
use std::io::{ErrorKind, Read, Seek, SeekFrom};
use std::path::Path;

use crate::error::{FormatError, io_error, shown};
use crate::foreign::HomeFolder;
use crate::source::OpenOptions;

/// A folder with the files of an image.
pub(super) struct Store {
    home: HomeFolder,
}

/// A part of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Part {
    Whole,
    /// So many bytes from an offset.
    At(u64, u64),
    /// So many bytes at the end.
    End(u64),
}

impl Store {
    /// The folder `path`, whose links may not lead outside.
    pub(super) fn of_folder(path: &Path, options: &OpenOptions) -> Self {
        Self { home: HomeFolder::of_folder(path, options) }
    }

    /// Whether there is a file.
    pub(super) fn has(&self, path: &Path) -> bool {
        path.is_file()
    }

    /// Reads a part of the file at `path`, of at most `most` bytes. Returns its bytes and the length of the file, or
    /// `None` if there is no such file.
    ///
    /// # Errors
    /// The file is outside of the folder, the part is not in it, or it cannot be read.
    pub(super) fn read(
        &self,
        path: &Path,
        part: Part,
        most: u64,
    ) -> Result<Option<(Vec<u8>, u64)>, FormatError> {
        self.home.check(path)?;
        let io = io_error(path);
        let bad = |problem: String| FormatError::Data { path: shown(path), problem };
        let mut file = match File::open(path) {
            Ok(file) => file,
            Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => return Ok(None),
            Err(e) => return Err(io(e)),
        };
        let metadata = file.metadata().map_err(io)?;
        if !metadata.is_file() {
            return Err(bad("a folder or device, expected a file".into()));
        }
        let length = metadata.len();
        let (at, size) = match part {
            Part::Whole => (0, length),
            Part::At(at, size) => (at, size),
            Part::End(size) => (length.saturating_sub(size), size),
        };
        if at.checked_add(size).is_none_or(|end| end > length) {
            return Err(bad(format!("a part ends at {at} + {size} of {length} bytes")));
        }
        if size > most {
            return Err(bad(format!("{size} bytes, expected at most {most}")));
        }
        file.seek(SeekFrom::Start(at)).map_err(io)?;
        let mut bytes = Vec::new();
        file.take(size).read_to_end(&mut bytes).map_err(io)?;
        Ok(Some((bytes, length)))
    }

    /// Runs work on the threads that read.
    pub(super) fn on_threads<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        work()
    }
}
