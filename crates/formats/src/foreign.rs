//! The files that a header names, or that lie in a folder. They must be inside that folder, unless the options allow
//! others: whoever writes a header could otherwise have any file of the computer read and shown.

use std::fs;
use std::path::{Component, Path, PathBuf};

use crate::error::{FormatError, quoted, shown};
use crate::sniff;
use crate::source::{OpenOptions, file_name, read_start};

/// The folder that data files must be in.
pub(crate) struct HomeFolder {
    /// The header or folder that was opened, for messages.
    owner: PathBuf,
    folder: PathBuf,
    /// The folder without links in its path; `None` if files elsewhere are allowed.
    real: Option<PathBuf>,
}

impl HomeFolder {
    /// The folder of the header at `header`.
    pub(crate) fn of_header(header: &Path, options: &OpenOptions) -> Self {
        let folder = header.parent().filter(|folder| !folder.as_os_str().is_empty());
        Self::new(header, folder.unwrap_or(Path::new(".")), options)
    }

    /// A folder that is opened as a whole.
    pub(crate) fn of_folder(folder: &Path, options: &OpenOptions) -> Self {
        Self::new(folder, folder, options)
    }

    fn new(owner: &Path, folder: &Path, options: &OpenOptions) -> Self {
        let real = || fs::canonicalize(folder).unwrap_or_else(|_| folder.to_owned());
        let real = (!options.foreign_files).then(real);
        Self { owner: owner.to_owned(), folder: folder.to_owned(), real }
    }

    /// The path of a file that the header calls `name`.
    ///
    /// # Errors
    /// It is outside the folder, by its name or by a link.
    pub(crate) fn file(&self, name: &str) -> Result<PathBuf, FormatError> {
        let path = self.folder.join(name);
        if self.holds(&path) { Ok(path) } else { Err(self.refusal(name)) }
    }

    /// The same for a file that has voxels and must be there.
    ///
    /// # Errors
    /// It is outside the folder, missing, or a pointer of Git LFS.
    pub(crate) fn data_file(&self, name: &str) -> Result<PathBuf, FormatError> {
        let path = self.file(name)?;
        if !path.exists() {
            return Err(FormatError::MissingData { path: shown(&self.owner), name: quoted(name) });
        }
        // A short file may have enough bytes for a small volume.
        if read_start(&path).is_some_and(|start| sniff::is_lfs_pointer(&start)) {
            let (found, expected) = (sniff::LFS_NAME, sniff::expected_for(sniff::LFS_NAME));
            return Err(FormatError::Unsupported { path: shown(&path), found, expected });
        }
        Ok(path)
    }

    /// Refuses a file of the folder if its path leads outside.
    pub(crate) fn check(&self, path: &Path) -> Result<(), FormatError> {
        let name = || path.strip_prefix(&self.folder).unwrap_or(path).to_string_lossy().into_owned();
        if self.holds(path) { Ok(()) } else { Err(self.refusal(&name())) }
    }

    /// The same for files that a list of the folder has found: only the last part of a path can be a link.
    pub(crate) fn check_all<'a>(
        &self,
        files: impl IntoIterator<Item = &'a PathBuf>,
    ) -> Result<(), FormatError> {
        let is_link = |path: &&PathBuf| fs::symlink_metadata(path).is_ok_and(|found| found.is_symlink());
        files.into_iter().filter(is_link).try_for_each(|path| self.check(path))
    }

    fn holds(&self, path: &Path) -> bool {
        let Some(real) = &self.real else { return true };
        match fs::canonicalize(path) {
            Ok(found) => found.starts_with(real),
            // A file that is not there is judged by its name, and opening it says what is wrong.
            Err(_) => path.strip_prefix(&self.folder).is_ok_and(stays_inside),
        }
    }

    fn refusal(&self, name: &str) -> FormatError {
        FormatError::Foreign { path: shown(&self.owner), name: quoted(name) }
    }
}

/// Whether no step of a relative path leaves its start.
fn stays_inside(path: &Path) -> bool {
    let mut depth = 0;
    path.components().all(|part| {
        depth += match part {
            Component::Normal(_) => 1,
            Component::ParentDir => -1,
            Component::CurDir | Component::RootDir | Component::Prefix(_) => 0,
        };
        depth >= 0
    })
}

/// A note on where the voxels of a header are, unless it is one file of the header's own name beside it.
pub(crate) fn note_on_data_files(header: &Path, names: &[impl AsRef<str>]) -> Option<String> {
    let (first, last) = (names.first()?.as_ref(), names.last()?.as_ref());
    if names.len() > 1 {
        return Some(format!(
            "the voxels are in {} files, {} to {}",
            names.len(),
            quoted(first),
            quoted(last)
        ));
    }
    let stem = header.file_stem().unwrap_or_default().to_string_lossy();
    let own = first.strip_prefix("./").unwrap_or(first).strip_prefix(&*stem);
    let has_own_name = own.is_some_and(|end| end.starts_with('.') && !end.contains(['/', '\\']));
    (!has_own_name && file_name(header) != first)
        .then(|| format!("the voxels are in the file {}", quoted(first)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_leaves_its_folder_by_its_steps() {
        for inside in ["a", "./a", "a/b.raw", "a/../b", "a/b/../../c"] {
            assert!(stays_inside(Path::new(inside)), "{inside}");
        }
        for outside in ["..", "../a", "a/../../b", "./../a/b"] {
            assert!(!stays_inside(Path::new(outside)), "{outside}");
        }
    }

    #[test]
    fn only_data_files_of_another_name_are_noted() {
        let note = |names: &[&str]| note_on_data_files(Path::new("/data/scan.nhdr"), names);
        for own in ["scan.raw", "./scan.raw.gz"] {
            assert_eq!(note(&[own]), None, "{own}");
        }
        assert_eq!(note(&["scanner.raw"]).unwrap(), "the voxels are in the file \"scanner.raw\"");
        assert!(note(&["scan.d/../../x"]).is_some() && note(&["/etc/passwd"]).is_some());
        assert_eq!(note(&["s1", "s2", "s3"]).unwrap(), "the voxels are in 3 files, \"s1\" to \"s3\"");
        assert!(!note(&["a\nb\u{1b}[2J"]).unwrap().contains(char::is_control));
    }
}
