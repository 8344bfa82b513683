//! Where pictures go.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use isinglass_formats::write_new;
use time::OffsetDateTime;

use crate::panels::background::path_from_text;

/// Writes a picture to `path`, or beside it under another number if there is a file already. Its folder is made.
///
/// # Errors
/// If the file cannot be written. No file is ever replaced.
pub(super) fn write(path: &Path, bytes: &[u8]) -> std::io::Result<PathBuf> {
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder)?;
    }
    for path in numbered(path) {
        match write_new(&path, bytes) {
            Err(e) if e.kind() == ErrorKind::AlreadyExists => {}
            result => return result.map(|()| path),
        }
    }
    Err(ErrorKind::AlreadyExists.into())
}

/// The first of the names for a file that no file has.
pub(super) fn free(path: PathBuf) -> PathBuf {
    let free = numbered(&path).find(|path| !path.exists());
    free.unwrap_or(path)
}

/// The path itself, and then with numbers.
fn numbered(path: &Path) -> impl Iterator<Item = PathBuf> {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let end = path.extension().unwrap_or_default().to_string_lossy();
    (1..MAX_NUMBER).map(move |number| match number {
        1 => path.to_owned(),
        _ => path.with_file_name(format!("{stem}-{number}.{end}")),
    })
}

/// The person's folder for pictures, or the next best.
pub(super) fn default_folder() -> PathBuf {
    let home = std::env::home_dir().filter(|home| home.is_dir());
    let pictures = home.as_ref().map(|home| home.join("Pictures")).filter(|p| p.is_dir());
    pictures.or(home).unwrap_or_else(|| PathBuf::from("."))
}

/// A folder as a person writes it.
pub(super) fn folder_from_text(text: &str) -> PathBuf {
    path_from_text(text).unwrap_or_else(default_folder)
}

/// The name of a file or folder about the volume `name`, with the time `at` and an end.
pub(super) fn file_name(name: &str, at: OffsetDateTime, end: &str) -> String {
    let stem = name.split('.').next().unwrap_or_default();
    let keeps = |c: char| c.is_alphanumeric() || matches!(c, '-' | '_');
    let stem: String = stem.chars().map(|c| if keeps(c) { c } else { '_' }).take(60).collect();
    let stem = if stem.is_empty() { "volume" } else { &stem };
    let (year, month, day) = at.to_calendar_date();
    let (hour, minute, second) = at.to_hms();
    let month = u8::from(month);
    format!("{stem}-{year:04}{month:02}{day:02}-{hour:02}{minute:02}{second:02}{end}")
}

/// Files of one name in a folder, at most.
const MAX_NUMBER: u32 = 1000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_called_by_volume_and_time() {
        let at = OffsetDateTime::from_unix_timestamp(951_782_400).unwrap();
        assert_eq!(file_name("my head.nii.gz", at, ".png"), "my_head-20000229-000000.png");
        assert_eq!(file_name("../../etc", at, "-turntable"), "volume-20000229-000000-turntable");
        let at = OffsetDateTime::from_unix_timestamp(1_735_689_599).unwrap();
        assert_eq!(file_name("builtin:shells", at, ".png"), "builtin_shells-20241231-235959.png");
    }

    #[test]
    fn no_file_is_replaced() {
        let folder = std::env::temp_dir().join(format!("isinglass-shots-{}", std::process::id()));
        let path = folder.join("deeper").join("a.png");
        assert_eq!(write(&path, b"one").unwrap(), path);
        let second = write(&path, b"two").unwrap();
        assert_eq!(second, folder.join("deeper").join("a-2.png"));
        assert_eq!(std::fs::read(&path).unwrap(), b"one");
        assert_eq!(std::fs::read(&second).unwrap(), b"two");
        let movie = folder.join("b.gif");
        assert_eq!(free(movie.clone()), movie);
        std::fs::write(&movie, b"another").unwrap();
        assert_eq!(free(movie), folder.join("b-2.gif"));
        assert!(write(&path.join("below a file").join("b.png"), b"").is_err());
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
