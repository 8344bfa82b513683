//! Files that are written whole or not at all.

use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use tempfile::NamedTempFile;

use crate::error::{FormatError, io_error};

/// Writes `bytes` to `path` through a file beside it that is renamed at the end: a reader sees the old file or the new
/// one. A link is followed, and a device or pipe is written to directly.
///
/// # Errors
/// If the system refuses. The old file then stays, and no other is left.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), FormatError> {
    let write = |path: PathBuf| match file_beside(&path, Readers::OfUmask)? {
        Some(file) => replace(file, &path, bytes),
        None => fs::write(&path, bytes),
    };
    write(resolved(path)).map_err(io_error(path))
}

/// Writes a file of the program itself, as [`write_whole`] does, but only its owner can read it. Its folder is made if it
/// is missing, for the owner alone.
///
/// # Errors
/// If the system refuses, or the path is a folder, a device or a pipe. The old file then stays, and no other is left.
pub fn write_private(path: &Path, bytes: &[u8]) -> Result<(), FormatError> {
    let write = |path: PathBuf| {
        make_private_folder(folder_of(&path))?;
        let file = file_beside(&path, Readers::Owner)?.ok_or(ErrorKind::InvalidInput)?;
        replace(file, &path, bytes)?;
        sync_folder(folder_of(&path))
    };
    write(resolved(path)).map_err(io_error(path))
}

/// Makes a folder and those above it, as far as they are missing, for their owner alone.
///
/// # Errors
/// If the system refuses.
pub fn make_private_folder(folder: &Path) -> io::Result<()> {
    let mut builder = fs::DirBuilder::new();
    builder.recursive(true);
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    builder.create(folder)
}

fn replace(mut file: NamedTempFile<File>, path: &Path, bytes: &[u8]) -> io::Result<()> {
    file.write_all(bytes)?;
    file.as_file().sync_all()?;
    file.persist(path).map(drop).map_err(|e| e.error)
}

/// Writes `bytes` to a file. They are on the disk when this returns, so that a power cut loses none of them.
pub(crate) fn write_synced(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut file = File::create(path)?;
    file.write_all(bytes)?;
    file.sync_all()
}

/// Brings the names in a folder and in those below it to the disk.
pub(crate) fn sync_folders(folder: &Path) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_type()?.is_dir() {
            sync_folders(&entry.path())?;
        }
    }
    sync_folder(folder)
}

/// Brings the names in a folder to the disk.
#[cfg(unix)]
pub(crate) fn sync_folder(folder: &Path) -> io::Result<()> {
    match File::open(folder)?.sync_all() {
        // Some file systems cannot.
        Err(e) if e.kind() == ErrorKind::InvalidInput || e.kind() == ErrorKind::Unsupported => Ok(()),
        done => done,
    }
}

/// Only Unix opens folders.
#[cfg(not(unix))]
pub(crate) fn sync_folder(_: &Path) -> io::Result<()> {
    Ok(())
}

/// Writes `bytes` to a new file, which appears under its name as a whole.
///
/// # Errors
/// [`ErrorKind::AlreadyExists`] if there is such a file, and whatever else the system refuses. No part of it stays.
pub fn write_new(path: &Path, bytes: &[u8]) -> io::Result<()> {
    write_new_for(Readers::OfUmask, path, bytes)
}

/// The same for a file that only its owner can read.
///
/// # Errors
/// As [`write_new`].
pub fn write_new_private(path: &Path, bytes: &[u8]) -> io::Result<()> {
    write_new_for(Readers::Owner, path, bytes)?;
    sync_folder(folder_of(path))
}

fn write_new_for(readers: Readers, path: &Path, bytes: &[u8]) -> io::Result<()> {
    let found = fs::symlink_metadata(path).is_ok();
    let Some(mut file) = (if found { None } else { file_beside(path, readers)? }) else {
        return Err(ErrorKind::AlreadyExists.into());
    };
    file.write_all(bytes)?;
    file.as_file().sync_all()?;
    match file.persist_noclobber(path) {
        Ok(_) => Ok(()),
        Err(e) if e.error.kind() == ErrorKind::AlreadyExists => Err(e.error),
        // Some file systems cannot rename without replacing.
        Err(_) => {
            let mut options = OpenOptions::new();
            options.write(true).create_new(true);
            #[cfg(unix)]
            std::os::unix::fs::OpenOptionsExt::mode(&mut options, readers.mode());
            let mut file = options.open(path)?;
            let written = file.write_all(bytes).and_then(|()| file.sync_all());
            written.inspect_err(|_| drop(fs::remove_file(path)))
        }
    }
}

/// Removes the unfinished files of programs that were killed, as far as the system lets it.
pub fn remove_leftovers(folder: &Path) {
    for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let is_ours = name.to_str().is_some_and(|name| name.starts_with(PREFIX) && name.ends_with(SUFFIX));
        if !is_ours {
            continue;
        }
        let changed = entry.metadata().ok().filter(fs::Metadata::is_file).and_then(|m| m.modified().ok());
        let is_old = changed.and_then(|at| at.elapsed().ok()).is_some_and(|age| age > LOCKED_AFTER);
        // Who writes a file holds its lock, which ends with the process.
        let is_left =
            || OpenOptions::new().write(true).open(entry.path()).is_ok_and(|f| f.try_lock().is_ok());
        if is_old && is_left() {
            let _ = fs::remove_file(entry.path());
        }
    }
}

/// Whether [`write_whole`] can make its file. Call it before long work whose result would be lost.
///
/// # Errors
/// If the path is a folder, or its folder takes no files.
pub fn check_writable(path: &Path) -> Result<(), FormatError> {
    file_beside(&resolved(path), Readers::OfUmask).map(drop).map_err(io_error(path))
}

/// Who can read a new file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Readers {
    /// Those whom the umask allows: the user has named the file.
    OfUmask,
    /// The file belongs to the program.
    Owner,
}

impl Readers {
    #[cfg(unix)]
    fn mode(self) -> u32 {
        match self {
            Self::OfUmask => 0o666,
            Self::Owner => 0o600,
        }
    }
}

/// The file that a link names.
pub(crate) fn resolved(path: &Path) -> PathBuf {
    fs::canonicalize(path).unwrap_or_else(|_| path.to_owned())
}

/// A temporary file in the folder of `path`, deleted unless it is kept; `None` if `path` is a device or pipe. It is
/// locked, so that [`remove_leftovers`] knows it from one whose program was killed.
pub(crate) fn file_beside(path: &Path, readers: Readers) -> io::Result<Option<NamedTempFile<File>>> {
    match fs::metadata(path) {
        Ok(found) if found.is_dir() => return Err(ErrorKind::IsADirectory.into()),
        Ok(found) if !found.is_file() => return Ok(None),
        _ => {}
    }
    let mut builder = tempfile::Builder::new();
    builder.prefix(PREFIX).suffix(SUFFIX);
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(readers.mode()));
    #[cfg(not(unix))]
    let _ = readers;
    let file = builder.tempfile_in(folder_of(path))?;
    // Some file systems have no locks. There, leftovers stay.
    let _ = file.as_file().try_lock();
    Ok(Some(file))
}

/// Where a file is: the present folder if its path names none.
pub(crate) fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

pub(crate) const PREFIX: &str = ".isinglass-";
pub(crate) const SUFFIX: &str = ".part";
/// By this age, the writer has locked its file.
pub(crate) const LOCKED_AFTER: Duration = Duration::from_secs(3);

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

    #[test]
    fn a_new_file_replaces_none() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        write_new(&path, b"first").unwrap();
        assert_eq!(write_new(&path, b"second").unwrap_err().kind(), ErrorKind::AlreadyExists);
        assert_eq!(write_new(folder.path(), b"x").unwrap_err().kind(), ErrorKind::AlreadyExists);
        assert!(write_new(&folder.path().join("none").join("a.png"), b"x").is_err());
        assert_eq!(fs::read_to_string(&path).unwrap(), "first");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn what_a_killed_program_leaves_is_removed_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("movie.gif");
        let new = || file_beside(&path, Readers::OfUmask).unwrap().unwrap();
        let age = |file: &File| file.set_modified(std::time::SystemTime::now() - LOCKED_AFTER * 2).unwrap();
        // A killed program deletes nothing, but its locks end.
        let left = new().keep().unwrap();
        age(&left.0);
        let written = new();
        age(written.as_file());
        let young = new().keep().unwrap();
        let foreign = folder.path().join(".tmpAbCdEf");
        fs::write(&foreign, "").unwrap();
        age(&OpenOptions::new().write(true).open(&foreign).unwrap());
        let left_path = left.1.clone();
        drop((left, young.0));
        remove_leftovers(folder.path());
        assert!(!left_path.exists());
        assert!(written.path().exists() && young.1.exists() && foreign.exists());
        remove_leftovers(&folder.path().join("no such folder"));
        assert_eq!(folder_of(Path::new("movie.gif")), Path::new("."));
        assert_eq!(folder_of(&path), folder.path());
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

    #[cfg(unix)]
    #[test]
    fn files_of_the_program_are_their_owners_alone() {
        use std::os::unix::fs::PermissionsExt;
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("state/isinglass");
        let [private, new, plain] = ["recent.toml", "identity", "a.png"].map(|name| folder.join(name));
        write_private(&private, b"1").unwrap();
        write_new_private(&new, b"key").unwrap();
        write_whole(&plain, b"2").unwrap();
        assert_eq!((mode(&private), mode(&new)), (0o600, 0o600));
        assert_eq!((mode(&folder), mode(folder.parent().unwrap())), (0o700, 0o700));
        // The control: what the user names has the umask's mode.
        fs::write(folder.join("usual"), "").unwrap();
        assert_eq!(mode(&plain), mode(&folder.join("usual")));
        // A file of an older version is closed at the next writing.
        fs::set_permissions(&private, PermissionsExt::from_mode(0o644)).unwrap();
        write_private(&private, b"3").unwrap();
        assert_eq!((mode(&private), fs::read(&private).unwrap()), (0o600, b"3".to_vec()));
        assert!(write_private(Path::new("/dev/null"), b"x").is_err());
        assert_eq!(write_new_private(&new, b"x").unwrap_err().kind(), ErrorKind::AlreadyExists);
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 4, "nothing else is left");
    }
}
