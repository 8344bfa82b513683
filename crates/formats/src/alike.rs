//! Files of a folder that are slices of one volume, and others beside them, such as a preview.

use std::path::{Path, PathBuf};

use crate::error::FormatError;
use crate::source::file_name;

/// The files with the shape that most have, the first of equally frequent ones, and a warning that names the others.
/// A file whose shape cannot be read is one of the others.
///
/// # Errors
/// The error of the first file, if no shape can be read.
pub(crate) fn alike<S: PartialEq>(
    files: Vec<PathBuf>,
    mut shape_of: impl FnMut(&Path) -> Result<S, FormatError>,
) -> Result<(Vec<PathBuf>, Option<String>), FormatError> {
    let mut shapes: Vec<(S, usize)> = Vec::new();
    let mut first_error = None;
    let mut of = Vec::new();
    for file in &files {
        let shape = match shape_of(file) {
            Ok(shape) => shape,
            Err(e @ FormatError::Cancelled { .. }) => return Err(e),
            Err(e) => {
                first_error.get_or_insert(e);
                of.push(None);
                continue;
            }
        };
        let at = shapes.iter().position(|(known, _)| *known == shape).unwrap_or_else(|| {
            shapes.push((shape, 0));
            shapes.len() - 1
        });
        shapes[at].1 += 1;
        of.push(Some(at));
    }
    let most = (0..shapes.len()).rev().max_by_key(|&i| shapes[i].1);
    if let (None, Some(e)) = (most, first_error) {
        return Err(e);
    }
    let is_slice: Vec<bool> = of.iter().map(|at| *at == most).collect();
    let other = is_slice.iter().position(|is| !is);
    let warning = other.map(|i| {
        let (num, name) = (is_slice.iter().filter(|is| !**is).count(), file_name(&files[i]));
        match num {
            1 => format!("{name} is not like the other files and was left out"),
            _ => format!("{num} files are not like the others and were left out, the first: {name}"),
        }
    });
    let kept = files.into_iter().zip(is_slice).filter(|(_, is)| *is).map(|(file, _)| file);
    Ok((kept.collect(), warning))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn most_files_decide() {
        let files = |names: &[&str]| names.iter().map(PathBuf::from).collect::<Vec<_>>();
        let by_length = |path: &Path| match path.as_os_str().len() {
            9 => Err(FormatError::Cancelled { path: String::new() }),
            0..=4 => Ok(path.as_os_str().len()),
            _ => Err(crate::error::io_error(path)(std::io::ErrorKind::NotFound.into())),
        };
        let (kept, said) = alike(files(&["xx", "a", "b", "longer", "c"]), by_length).unwrap();
        assert_eq!(kept, files(&["a", "b", "c"]));
        assert_eq!(said.unwrap(), "2 files are not like the others and were left out, the first: xx");
        let one = alike(files(&["a", "b", "cc"]), by_length).unwrap().1;
        assert_eq!(one.unwrap(), "cc is not like the other files and was left out");
        assert_eq!(alike(files(&["a", "b"]), by_length).unwrap(), (files(&["a", "b"]), None));
        assert_eq!(alike(files(&["aa", "b"]), by_length).unwrap().0, files(&["aa"]));
        assert!(alike(files(&["longer"]), by_length).is_err());
        assert!(alike(files(&["a", "cancelled"]), by_length).is_err());
    }
}
