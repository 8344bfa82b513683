//! Arrays of other files that links lead to. Only files of the own folder are opened, unless the options allow others.

use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

use super::array_plan;
use super::choice::Choice;
use super::contents::{FORMAT, Listed, with_contents};
use super::coordinates::Scales;
use super::dialects;
use super::links::OutsideLink;
use crate::error::{FormatError, malformed, quoted, shown};
use crate::source::open_file;

/// An array in another file.
pub(super) struct OutsideArray {
    /// The array, with the path of the link.
    pub(super) listed: Listed,
    pub(super) file: PathBuf,
    /// Its path in that file.
    pub(super) inside: String,
}

/// The volumes that `links` of the file at `path` lead to, and what is to be told of the other links.
pub(super) fn arrays(
    links: &[OutsideLink],
    path: &Path,
    choice: &Choice,
) -> Result<(Vec<OutsideArray>, Vec<String>), FormatError> {
    let (mut found, mut notes) = (Vec::new(), Vec::new());
    for link in links.iter().take(MAX_LINKS) {
        if choice.cancel.is_some_and(|cancel| cancel.load(Ordering::Relaxed)) {
            return Err(FormatError::Cancelled { path: shown(path) });
        }
        let words = format!("{} leads to the file {}", quoted(&link.path), quoted(&link.file));
        match choice.home.data_file(&link.file) {
            Ok(file) => match array(link, &file) {
                Ok(array) => found.push(array),
                Err(e) => notes.push(format!("{words}, which cannot be read: {e}")),
            },
            Err(FormatError::MissingData { .. }) => notes.push(format!("{words}, which is missing")),
            Err(FormatError::Foreign { .. }) => {
                notes.push(format!("{words}, which is outside its folder; --foreign-files allows that"));
            }
            Err(e) => notes.push(format!("{words}, which cannot be read: {e}")),
        }
    }
    if links.len() > MAX_LINKS {
        notes.push(format!("{} more links to other files are not followed", links.len() - MAX_LINKS));
    }
    Ok((found, notes))
}

/// The array that a link to `file` leads to.
fn array(link: &OutsideLink, file: &Path) -> Result<OutsideArray, FormatError> {
    with_contents(open_file(file)?, file, |contents| {
        let bad = malformed(file, FORMAT);
        let mut array = [contents.array(&link.inside).map_err(bad)?];
        dialects::tell(contents, &mut array);
        let [mut listed] = array;
        listed.path.clone_from(&link.path);
        array_plan::sizes(&listed, &Scales::of(&[])).map_err(bad)?;
        Ok(OutsideArray { listed, file: file.to_owned(), inside: link.inside.clone() })
    })
}

/// Most links to other files that are followed.
const MAX_LINKS: usize = 256;
