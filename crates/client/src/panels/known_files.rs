//! What a file is for this window, judged by what it holds. All of this may wait for a disk.

use std::io::Read;
use std::path::Path;

use isinglass_core::text::is_control;
use isinglass_formats::{Content, MAX_STATE_BYTES, content_of, import_transfers, is_state, open_file};

use super::text::format_bytes;

/// What a window does with a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum KnownFile {
    /// A volume, or a folder that may be one.
    Volume,
    State,
    /// Colours and opacities. A broken file of this kind counts, as whoever reads it says what is wrong.
    Transfer,
    /// It does not open, with one line that says what does.
    Unknown(String),
}

impl KnownFile {
    pub(crate) fn at(path: &Path) -> Self {
        match content_of(path) {
            Ok(Content::Volume(_) | Content::Folder) => Self::Volume,
            Ok(Content::State) => Self::State,
            Ok(Content::Text) if is_state(&begin_of(path)) => Self::State,
            Ok(Content::Text) if is_named_as_transfer(path) || import_transfers(path).is_ok() => {
                Self::Transfer
            }
            Ok(Content::Text) => Self::Unknown(not_opened(path, "another kind of text")),
            Ok(Content::Other(found)) => Self::Unknown(not_opened(path, found)),
            Err(e) => Self::Unknown(e.to_string()),
        }
    }
}

/// What happens if this file is dropped; and whether it opens.
pub(crate) fn announce(path: &Path) -> (String, bool) {
    let name = name_of(path);
    let size = std::fs::metadata(path).ok().filter(|m| m.is_file()).map(|m| m.len());
    let size = size.map_or(String::new(), |bytes| format!(", {}", format_bytes(bytes)));
    match KnownFile::at(path) {
        KnownFile::Volume if path.is_dir() => (format!("Open the folder {name} as one volume"), true),
        KnownFile::Volume => (format!("Open {name}{size}"), true),
        KnownFile::State => (format!("Show what {name} saved"), true),
        KnownFile::Transfer => (format!("Use the colours and opacities of {name}"), true),
        KnownFile::Unknown(problem) => (problem, false),
    }
}

/// One byte more than a state may have, or nothing if the file cannot be read.
fn begin_of(path: &Path) -> Vec<u8> {
    let mut begin = Vec::new();
    let read = open_file(path).map(|file| file.take(MAX_STATE_BYTES + 1).read_to_end(&mut begin));
    if matches!(read, Ok(Ok(_))) { begin } else { Vec::new() }
}

fn is_named_as_transfer(path: &Path) -> bool {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_lowercase();
    ["toml", "json", "xml"].contains(&extension.as_str())
}

fn not_opened(path: &Path, found: &str) -> String {
    format!("{} is not supported: {found}. {WHAT_OPENS}", name_of(path))
}

fn name_of(path: &Path) -> String {
    let name =
        path.file_name().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into_owned());
    name.chars().take(80).map(|c| if is_control(c) { '?' } else { c }).collect()
}

const WHAT_OPENS: &str = "isinglass opens volumes (NRRD, NIfTI, DICOM, TIFF, MetaImage, MRC, NumPy, VTI, HDF5, OME-Zarr), \
                          saved views, and files of colours and opacities.";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_does_not_open_is_told_what_does() {
        let folder = tempfile::TempDir::new().unwrap();
        let told = |name: &str, bytes: &[u8]| {
            let path = folder.path().join(name);
            std::fs::write(&path, bytes).unwrap();
            announce(&path)
        };
        for bytes in [&b"some text\n"[..], &[0xff; 40], &[]] {
            let (text, opens) = told("thing.xyz", bytes);
            assert!(
                text.starts_with("thing.xyz is not supported: ") && text.contains("opens volumes (NRRD, "),
                "{text}"
            );
            assert!(!opens && !text.contains("TOML") && !text.contains('\n'), "{text}");
        }
        let header = "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: raw\n\n12345678";
        let bytes = header.len();
        assert_eq!(told("a.xyz", header.as_bytes()), (format!("Open a.xyz, {bytes} bytes"), true));
        assert!(told("seen.toml", b"isinglass_state = 1\n").0.starts_with("Show what seen.toml"));
        let late = format!("# {}\nisinglass_state = 1\n", "a comment ".repeat(20_000));
        assert!(told("late.toml", late.as_bytes()).0.starts_with("Show what late.toml"));
        // What is named as such and is broken gets its own message where it is read.
        assert!(told("broken.toml", b"name = ").1);
        assert!(!announce(&folder.path().join("nowhere.nrrd")).1);
    }
}
