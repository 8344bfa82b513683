//! Files that are written whole or not at all.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

use crate::error::{FormatError, io_error};

/// Writes `bytes` to `path` through a file beside it that is renamed at the end: a reader sees the old file or the new
/// one. A link is followed, and a device or pipe is written to directly.
///
/// # Errors
/// If the system refuses. The old file then stays, and no other is left.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), FormatError> {
    let write = |path: PathBuf| {
        let Some(mut file) = file_beside(&path)? else { return fs::write(&path, bytes) };
        file.write_all(bytes)?;
        file.as_file().sync_all()?;
        file.persist(&path).map(drop).map_err(|e| e.error)
    };
    write(resolved(path)).map_err(io_error(path))
}

/// Whether [`write_whole`] can make its file. Call it before long work whose result would be lost.
///
/// # Errors
/// If the path is a folder, or its folder takes no files.
pub fn check_writable(path: &Path) -> Result<(), FormatError> {
    file_beside(&resolved(path)).map(drop).map_err(io_error(path))
}

/// The file that a link names.
pub(crate) fn resolved(path: &Path) -> PathBuf {
    fs::canonicalize(path).unwrap_or_else(|_| path.to_owned())
}

/// A temporary file in the folder of `path`, deleted unless it is kept; `None` if `path` is a device or pipe.
pub(crate) fn file_beside(path: &Path) -> io::Result<Option<NamedTempFile<File>>> {
    match fs::metadata(path) {
        Ok(found) if found.is_dir() => return Err(io::ErrorKind::IsADirectory.into()),
        Ok(found) if !found.is_file() => return Ok(None),
        _ => {}
    }
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    let mut builder = tempfile::Builder::new();
    // A temporary file is its owner's alone by default; this one becomes a file like any other, by the umask.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(folder.unwrap_or(Path::new("."))).map(Some)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_replaced_as_a_whole_and_nothing_else_is_left() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.txt");
        for text in ["first", "second"] {
            write_whole(&path, text.as_bytes()).unwrap();
            assert_eq!(fs::read_to_string(&path).unwrap(), text);
            check_writable(&path).unwrap();
        }
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_refusal_leaves_everything_as_it_was() {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("taken")).unwrap();
        for path in ["taken", "no such folder/a.txt"] {
            let path = folder.path().join(path);
            assert!(write_whole(&path, b"x").is_err() && check_writable(&path).is_err(), "{path:?}");
        }
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[cfg(unix)]
    #[test]
    fn links_are_followed_and_permissions_are_those_of_any_new_file() {
        let folder = tempfile::tempdir().unwrap();
        let [target, link, plain] = ["target", "link", "plain"].map(|name| folder.path().join(name));
        fs::write(&target, "old").unwrap();
        std::os::unix::fs::symlink(&target, &link).unwrap();
        write_whole(&link, b"new").unwrap();
        assert_eq!(fs::read_to_string(&target).unwrap(), "new");
        assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
        fs::write(&plain, "").unwrap();
        let permissions = |path| fs::metadata(path).unwrap().permissions();
        assert_eq!(permissions(&target), permissions(&plain));
        write_whole(Path::new("/dev/null"), b"x").unwrap();
        assert!(!fs::metadata("/dev/null").unwrap().is_file(), "a device is not replaced");
    }
}
