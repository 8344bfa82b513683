//! The unfinished result of a conversion: a folder beside the target, which a later run may go on with.

use std::fmt::Write as _;
use std::fs::{self, File, TryLockError};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use serde::{Deserialize, Serialize};

use super::gaps::Tally;
use crate::error::{FormatError, io_error, shown};
use crate::output::{PREFIX, SUFFIX, folder_of, sync_folder, sync_folders, write_synced};
use crate::source::read_file;

/// The folder of an unfinished conversion, locked as long as this value lives.
pub(super) struct PartFolder {
    path: PathBuf,
    _lock: File,
}

/// What a run has done. It is written after each step.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Journal {
    /// The input and the options, which must be the same for another run.
    fingerprint: String,
    /// Steps that are done.
    pub(super) num_done: u64,
    /// The numbers of each time and channel so far.
    pub(super) tallies: Vec<Tally>,
    /// Whether the voxels are labels, once that is known.
    pub(super) are_labels: Option<bool>,
}

impl PartFolder {
    /// Opens the folder of the conversion to `target`, or makes it. What another input or other options left is removed.
    /// Returns what an earlier run has done.
    ///
    /// # Errors
    /// The target exists, its folder takes no files, or another program is converting to it.
    pub(super) fn open(target: &Path, fingerprint: String) -> Result<(Self, Journal), FormatError> {
        let io = io_error(target);
        let Some(name) = target.file_name() else { return Err(io(ErrorKind::InvalidInput.into())) };
        if fs::symlink_metadata(target).is_ok() {
            return Err(FormatError::Unsupported {
                path: shown(target),
                found: "a file or folder of this name",
                expected: "a new name",
            });
        }
        let mut own = PREFIX.to_owned();
        own.extend([&name.to_string_lossy(), SUFFIX]);
        let path = folder_of(target).join(own);
        match fs::create_dir(&path) {
            Err(e) if e.kind() == ErrorKind::AlreadyExists => {}
            made => made.map_err(&io)?,
        }
        let lock = File::create(path.join("lock")).map_err(&io)?;
        match lock.try_lock() {
            Err(TryLockError::WouldBlock) => {
                return Err(FormatError::Unsupported {
                    path: shown(target),
                    found: "another program that converts to it",
                    expected: "one",
                });
            }
            // Some file systems have no locks.
            Ok(()) | Err(TryLockError::Error(_)) => {}
        }
        let part = Self { path, _lock: lock };
        let known = read_file(&part.path.join(JOURNAL), MOST_BYTES_OF_JOURNAL).ok().flatten();
        let known: Option<Journal> = known.and_then(|bytes| serde_json::from_slice(&bytes).ok());
        if let Some(journal) = known.filter(|journal| journal.fingerprint == fingerprint) {
            return Ok((part, journal));
        }
        if part.image().exists() {
            fs::remove_dir_all(part.image()).map_err(&io)?;
        }
        fs::create_dir_all(part.image()).map_err(&io)?;
        let journal = Journal { fingerprint, num_done: 0, tallies: Vec::new(), are_labels: None };
        Ok((part, journal))
    }

    /// Where the image is made.
    pub(super) fn image(&self) -> PathBuf {
        self.path.join("image")
    }

    /// The folder itself.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Notes what is done.
    ///
    /// # Errors
    /// The system refuses.
    pub(super) fn note(&self, journal: &Journal) -> Result<(), FormatError> {
        let (path, new) = (self.path.join(JOURNAL), self.path.join("journal.new"));
        let io = io_error(&path);
        let bytes = serde_json::to_vec(journal).map_err(|e| io(e.into()))?;
        write_synced(&new, &bytes).and_then(|()| fs::rename(&new, &path)).map_err(io)
    }

    /// Removes the folder, as far as the system lets it.
    pub(super) fn remove(self) {
        let _ = fs::remove_dir_all(&self.path);
    }

    /// Gives the image its name, and removes the folder.
    ///
    /// # Errors
    /// The system refuses, or the target exists by now.
    pub(super) fn finish(self, target: &Path) -> Result<(), FormatError> {
        let io = io_error(target);
        if fs::symlink_metadata(target).is_ok() {
            return Err(io(ErrorKind::AlreadyExists.into()));
        }
        // A power cut now leaves the unfinished folder, and one later the whole image.
        sync_folders(&self.image()).map_err(&io)?;
        fs::rename(self.image(), target).map_err(&io)?;
        sync_folder(folder_of(target)).map_err(io)?;
        // The image is whole; what remains of the folder does no harm.
        let _ = fs::remove_dir_all(&self.path);
        Ok(())
    }
}

/// What tells the files of a source from changed ones: names, lengths and times. Files beside a header count too if it
/// may name them.
pub(super) fn files_of(path: &Path) -> String {
    let mut text = String::new();
    if path.is_dir() {
        list(path, &mut text, &mut 0);
    } else {
        describe(path, &mut text);
        let end = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
        if MAY_NAME_OTHERS.contains(&&*end) {
            for beside in entries(folder_of(path)).iter().filter(|beside| beside.is_file()) {
                describe(beside, &mut text);
            }
        }
    }
    format!("{:016x} of {} bytes", fnv(text.as_bytes()), text.len())
}

/// The paths in a folder, sorted, without those of unfinished work.
fn entries(folder: &Path) -> Vec<PathBuf> {
    let is_ours = |path: &PathBuf| {
        let name = path.file_name().map(|name| name.to_string_lossy().into_owned());
        name.is_some_and(|name| name.starts_with(PREFIX))
    };
    let mut paths: Vec<PathBuf> =
        fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path()).collect();
    paths.retain(|path| !is_ours(path));
    paths.sort();
    paths
}

fn list(folder: &Path, text: &mut String, num: &mut usize) {
    for path in entries(folder) {
        *num += 1;
        if *num > MOST_FILES {
            return;
        }
        if path.is_dir() && !path.is_symlink() { list(&path, text, num) } else { describe(&path, text) }
    }
}

fn describe(path: &Path, text: &mut String) {
    let Ok(found) = fs::metadata(path) else { return };
    let at = found.modified().ok().and_then(|at| at.duration_since(UNIX_EPOCH).ok()).unwrap_or_default();
    let _ = writeln!(text, "{} {} {}", path.display(), found.len(), at.as_nanos());
}

/// The hash FNV-1a.
fn fnv(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, b| (hash ^ u64::from(*b)).wrapping_mul(0x0100_0000_01b3))
}

const JOURNAL: &str = "journal.json";
const MOST_BYTES_OF_JOURNAL: u64 = 1 << 30;
/// The ends of names of headers whose voxels are in other files.
const MAY_NAME_OTHERS: [&str; 8] = ["nhdr", "mhd", "hdr", "img", "tif", "tiff", "ome", "xml"];
/// Most files of a folder that are looked at.
const MOST_FILES: usize = 1 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_same_conversion_goes_on() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("a.ome.zarr");
        let (part, mut journal) = PartFolder::open(&target, "one".into()).unwrap();
        journal.num_done = 7;
        part.note(&journal).unwrap();
        fs::write(part.image().join("x"), "").unwrap();
        assert!(PartFolder::open(&target, "one".into()).is_err(), "it is locked");
        drop(part);
        let (part, journal) = PartFolder::open(&target, "one".into()).unwrap();
        assert_eq!((journal.num_done, part.image().join("x").exists()), (7, true));
        drop(part);
        let (part, journal) = PartFolder::open(&target, "two".into()).unwrap();
        assert_eq!((journal.num_done, part.image().join("x").exists()), (0, false));
        assert!(!target.exists());
        part.finish(&target).unwrap();
        assert_eq!(entries(folder.path()).len(), 1);
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
        assert!(PartFolder::open(&target, "one".into()).is_err(), "it exists");
    }

    #[test]
    fn a_changed_file_is_another_one() {
        let folder = tempfile::tempdir().unwrap();
        let header = folder.path().join("a.nhdr");
        fs::write(&header, "1").unwrap();
        let before = files_of(&header);
        assert_eq!(files_of(&header), before);
        fs::write(folder.path().join("a.raw"), "22").unwrap();
        let with_data = files_of(&header);
        assert_ne!(with_data, before);
        fs::create_dir(folder.path().join(".isinglass-b.part")).unwrap();
        assert_eq!(files_of(&header), with_data);
        assert_ne!(files_of(folder.path()), with_data);
    }
}
