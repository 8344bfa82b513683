//! Where the files of an image are.

use std::fs;
use std::io::{ErrorKind, Read, Seek, SeekFrom};
use std::path::Path;

use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::error::{FormatError, io_error, shown};
use crate::foreign::HomeFolder;
use crate::source::{OpenOptions, open_file};
use crate::web::WebFolder;

/// The files of an image.
pub(super) enum Store {
    Folder(HomeFolder),
    /// Several requests are on their way at once, each on a thread of its own.
    Web(WebFolder, ThreadPool),
}

pub(super) use crate::web::FilePart as Part;

impl Store {
    /// The folder `path`, whose links may not lead outside.
    pub(super) fn of_folder(path: &Path, options: &OpenOptions) -> Self {
        Self::Folder(HomeFolder::of_folder(path, options))
    }

    /// An address of the web.
    ///
    /// # Errors
    /// The system has no more threads.
    pub(super) fn of_web(folder: WebFolder) -> Result<Self, FormatError> {
        let threads = ThreadPoolBuilder::new().num_threads(NUM_REQUESTS).thread_name(|_| "web".into());
        let path = folder.address().to_owned();
        let threads = threads.build().map_err(|e| io_error(Path::new(&path))(std::io::Error::other(e)))?;
        Ok(Self::Web(folder, threads))
    }

    /// Whether there is a file.
    ///
    /// # Errors
    /// A server does not tell.
    pub(super) fn has(&self, path: &Path) -> Result<bool, FormatError> {
        match self {
            Self::Folder(_) => Ok(path.is_file()),
            Self::Web(folder, _) => Ok(folder.read(path, Part::Whole, MAX_PROBED_BYTES)?.is_some()),
        }
    }

    /// The names of the folders in the folder `path`, sorted, at most so many; empty at an address.
    ///
    /// # Errors
    /// The folder is outside, or cannot be read.
    pub(super) fn folders_in(&self, path: &Path, most: usize) -> Result<Vec<String>, FormatError> {
        let Self::Folder(home) = self else { return Ok(Vec::new()) };
        home.check(path)?;
        let mut names = Vec::new();
        for entry in fs::read_dir(path).map_err(io_error(path))?.take(MAX_ENTRIES) {
            let entry = entry.map_err(io_error(path))?;
            let name = entry.file_name().to_str().map(str::to_owned);
            if names.len() < most && entry.path().is_dir() {
                names.extend(name.filter(|name| !name.starts_with('.')));
            }
        }
        names.sort();
        Ok(names)
    }

    /// The names in the folder `path`, at most so many; `None` if there are more, or if it is an address.
    pub(super) fn names_in(&self, path: &Path, most: usize) -> Option<Vec<String>> {
        let Self::Folder(home) = self else { return None };
        home.check(path).ok()?;
        let mut names = Vec::new();
        for entry in fs::read_dir(path).ok()? {
            if names.len() >= most {
                return None;
            }
            names.extend(entry.ok()?.file_name().into_string().ok());
        }
        Some(names)
    }

    /// Most images that are looked for in a group.
    pub(super) fn max_images(&self) -> usize {
        match self {
            Self::Folder(_) => 4096,
            Self::Web(..) => 64,
        }
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
        let home = match self {
            Self::Folder(home) => home,
            Self::Web(folder, _) => return folder.read(path, part, most),
        };
        home.check(path)?;
        let io = io_error(path);
        let bad = |problem: String| FormatError::Data { path: shown(path), problem };
        let mut file = match open_file(path) {
            Ok(file) => file,
            Err(FormatError::Io { cause, .. })
                if matches!(cause.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) =>
            {
                return Ok(None);
            }
            Err(e) => return Err(e),
        };
        let length = file.metadata().map_err(io)?.len();
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
        match self {
            Self::Folder(_) => work(),
            Self::Web(_, threads) => threads.install(work),
        }
    }
}

/// Most entries of a folder that are looked at.
const MAX_ENTRIES: usize = 1 << 20;
/// Requests at once.
const NUM_REQUESTS: usize = 16;
/// Longest file whose presence is asked for.
const MAX_PROBED_BYTES: u64 = 16 << 20;
