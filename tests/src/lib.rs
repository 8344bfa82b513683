//! What the tests that cross crates share.

pub mod host;
pub mod levels;
pub mod twins;

use std::path::PathBuf;

/// The folder with the real volumes: the environment variable `ISINGLASS_DATA`, or `../shared/data` beside the
/// workspace. Without it the caller prints that it skips, and returns; with `ISINGLASS_STRICT=1` this panics instead,
/// so that a machine meant to check everything cannot check less in silence.
pub fn data_dir() -> Option<PathBuf> {
    let beside = || PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/data"));
    let folder = std::env::var_os("ISINGLASS_DATA").map_or_else(beside, PathBuf::from);
    if folder.is_dir() {
        return Some(folder);
    }
    let is_strict = std::env::var_os("ISINGLASS_STRICT").is_some_and(|v| v == "1");
    assert!(!is_strict, "no real volumes in {}; set ISINGLASS_DATA", folder.display());
    eprintln!("skipped: no real volumes in {}; set ISINGLASS_DATA", folder.display());
    None
}
