//! Scratch folders, which hold what was unpacked. They are their owner's alone, and nothing of them stays: not after a
//! signal, and where the system can keep files without a name, not even after the program was killed.

use std::fs::{self, File};
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

use tempfile::TempDir;

use crate::output::{LOCKED_AFTER, make_private_folder, write_new_private};
use crate::source::open_file;

/// A folder that is removed when this is dropped.
pub(crate) struct ScratchFolder {
    folder: TempDir,
    /// Locked as long as the program lives.
    _lock: Option<File>,
    /// Files without a name, to which links in the folder lead.
    nameless: Vec<File>,
}

impl ScratchFolder {
    /// Makes a folder, and removes what killed programs have left.
    ///
    /// # Errors
    /// If the system refuses, or the program is ending.
    pub(crate) fn new() -> io::Result<Self> {
        let place = std::env::temp_dir();
        remove_left(&place);
        if let Some(at_first) = AT_FIRST.get() {
            at_first();
        }
        let mut folders = folders();
        folders.check_open()?;
        let mut builder = tempfile::Builder::new();
        builder.prefix(PREFIX).suffix(SUFFIX);
        #[cfg(unix)]
        builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o700));
        let folder = builder.tempdir_in(place)?;
        folders.paths.push(folder.path().to_owned());
        drop(folders);
        let mut scratch = Self { folder, _lock: None, nameless: Vec::new() };
        let lock = scratch.folder.path().join(LOCK);
        write_new_private(&lock, b"")?;
        let lock = File::open(lock)?;
        // Some file systems have no locks. There, what a killed program leaves stays.
        let _ = lock.try_lock();
        scratch._lock = Some(lock);
        make_private_folder(&scratch.path())?;
        Ok(scratch)
    }

    /// The folder of the files.
    pub(crate) fn path(&self) -> PathBuf {
        self.folder.path().join(FILES)
    }

    /// Makes the file `name` of the folder, to write to it. With `is_one_of_few`, it has no name of its own where the
    /// system can: the name is a link to it, which works as long as this value lives.
    ///
    /// # Errors
    /// If the system refuses, or the program is ending.
    pub(crate) fn file(&mut self, name: &Path, is_one_of_few: bool) -> io::Result<File> {
        let path = self.path().join(name);
        let folders = folders();
        folders.check_open()?;
        if let Some(parent) = path.parent() {
            make_private_folder(parent)?;
        }
        // An archive may name a file twice; the last one counts.
        let _ = fs::remove_file(&path);
        if is_one_of_few && let Some(file) = nameless_file(&path) {
            // The link names the number of this very descriptor.
            let writer = file.try_clone()?;
            self.nameless.push(file);
            return Ok(writer);
        }
        let mut options = File::options();
        options.write(true).create_new(true);
        #[cfg(unix)]
        std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
        options.open(path)
    }
}

impl Drop for ScratchFolder {
    fn drop(&mut self) {
        let mut folders = folders();
        let _ = fs::remove_dir_all(self.folder.path());
        folders.paths.retain(|path| path != self.folder.path());
    }
}

/// A file without a name, and a link to it at `path`; `None` if the system cannot.
#[cfg(target_os = "linux")]
fn nameless_file(path: &Path) -> Option<File> {
    use std::os::fd::AsRawFd;
    let file = tempfile::tempfile().ok()?;
    // The system lets others read it where its folder has files without names.
    file.set_permissions(std::os::unix::fs::PermissionsExt::from_mode(0o600)).ok()?;
    std::os::unix::fs::symlink(format!("/proc/self/fd/{}", file.as_raw_fd()), path).ok()?;
    if open_file(path).is_ok() {
        return Some(file);
    }
    let _ = fs::remove_file(path);
    None
}

/// Only Linux gives a nameless file a path.
#[cfg(not(target_os = "linux"))]
fn nameless_file(_: &Path) -> Option<File> {
    None
}

/// Removes all scratch folders of this program, for its end. From then on no other is made.
pub fn remove_scratch() {
    let mut folders = folders();
    folders.is_closed = true;
    for path in folders.paths.drain(..) {
        let _ = fs::remove_dir_all(path);
    }
}

/// Sets what is called before the first scratch folder is made, and before each later one. The first call counts.
pub fn before_scratch(call: fn()) {
    let _ = AT_FIRST.set(call);
}

/// The scratch folders of this program.
#[derive(Default)]
struct Folders {
    paths: Vec<PathBuf>,
    is_closed: bool,
}

impl Folders {
    fn check_open(&self) -> io::Result<()> {
        if self.is_closed { Err(io::Error::new(ErrorKind::Interrupted, "the program ends")) } else { Ok(()) }
    }
}

static FOLDERS: Mutex<Folders> = Mutex::new(Folders { paths: Vec::new(), is_closed: false });
static AT_FIRST: OnceLock<fn()> = OnceLock::new();

fn folders() -> MutexGuard<'static, Folders> {
    // Every change is one step, so a panic leaves the list in order.
    FOLDERS.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Removes the scratch folders of programs that were killed, as far as they are this user's.
fn remove_left(place: &Path) {
    for entry in fs::read_dir(place).into_iter().flatten().flatten() {
        let name = entry.file_name();
        let is_ours = name.to_str().is_some_and(|name| name.starts_with(PREFIX) && name.ends_with(SUFFIX));
        let Some(found) = entry.metadata().ok().filter(|found| is_ours && found.is_dir()) else { continue };
        let age = found.modified().ok().and_then(|at| at.elapsed().ok());
        let is_left = || open_file(&entry.path().join(LOCK)).is_ok_and(|lock| lock.try_lock().is_ok());
        if age.is_some_and(|age| age > LOCKED_AFTER) && is_left() {
            let _ = fs::remove_dir_all(entry.path());
        }
    }
}

const PREFIX: &str = ".isinglass-";
const SUFFIX: &str = ".scratch";
/// The file whose lock ends with the program.
const LOCK: &str = "lock";
/// The folder of the files.
const FILES: &str = "files";

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    #[cfg(unix)]
    #[test]
    fn what_is_unpacked_is_its_owners_alone_and_goes() {
        use std::os::unix::fs::PermissionsExt;
        let mut scratch = ScratchFolder::new().unwrap();
        let root = scratch.folder.path().to_owned();
        for (name, is_one_of_few) in [("a.nrrd", true), ("in/b.nrrd", false)] {
            scratch.file(Path::new(name), is_one_of_few).unwrap().write_all(b"voxels").unwrap();
            let path = scratch.path().join(name);
            assert_eq!(fs::read(&path).unwrap(), b"voxels");
            let has_name = !fs::symlink_metadata(&path).unwrap().is_symlink();
            assert_eq!(has_name, !(is_one_of_few && cfg!(target_os = "linux")), "{name}");
            assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
            let mut folder = path.parent().unwrap();
            while folder.starts_with(&root) {
                assert_eq!(fs::metadata(folder).unwrap().permissions().mode() & 0o777, 0o700);
                folder = folder.parent().unwrap();
            }
        }
        // The control: a folder of the standard library's defaults is open to others.
        let usual = tempfile::tempdir().unwrap();
        fs::create_dir(usual.path().join("usual")).unwrap();
        let mode = fs::metadata(usual.path().join("usual")).unwrap().permissions().mode();
        assert_ne!(mode & 0o077, 0, "this machine's umask closes all folders");
        drop(scratch);
        assert!(!root.exists() && !folders().paths.contains(&root));
    }

    #[test]
    fn what_a_killed_program_left_is_removed_and_nothing_else() {
        let place = tempfile::tempdir().unwrap();
        let folder = |name: &str, lock: Option<&str>| {
            let path = place.path().join(format!("{PREFIX}{name}"));
            fs::create_dir(&path).unwrap();
            if let Some(lock) = lock {
                fs::write(path.join(lock), "").unwrap();
            }
            let old = std::time::SystemTime::now() - LOCKED_AFTER * 2;
            File::open(&path).unwrap().set_modified(old).unwrap();
            path
        };
        let left = folder(&format!("left{SUFFIX}"), Some(LOCK));
        let used = folder(&format!("used{SUFFIX}"), Some(LOCK));
        let others = [folder("foreign", Some(LOCK)), folder(&format!("bare{SUFFIX}"), None)];
        let lock = File::open(used.join(LOCK)).unwrap();
        lock.try_lock().unwrap();
        remove_left(place.path());
        assert!(!left.exists() && used.exists() && others.iter().all(|path| path.exists()));
        drop(lock);
        remove_left(place.path());
        assert!(!used.exists() && others.iter().all(|path| path.exists()));
    }
}
