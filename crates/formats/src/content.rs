//! What a file is, by its content, for windows that list files or take what is dropped on them.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use crate::error::FormatError;
use crate::sniff::{self, Kind};
use crate::state::is_state;
use crate::{error, nifti, zarr};

/// What a file or folder is, as far as its first bytes tell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Content {
    /// A volume in a format that is read here, with a short name of the format.
    Volume(&'static str),
    /// A folder; it may hold the slices of a volume.
    Folder,
    /// A saved state.
    State,
    /// Other text: a transfer function, or presets.
    Text,
    /// None of these; what it looks like.
    Other(&'static str),
}

/// Looks at the file or folder at `path`. May wait for a disk.
///
/// # Errors
/// If it cannot be read.
pub fn content_of(path: &Path) -> Result<Content, FormatError> {
    if path.is_dir() {
        return Ok(if zarr::is_group(path) { Content::Volume("OME-Zarr") } else { Content::Folder });
    }
    if !std::fs::metadata(path).map_err(error::io_error(path))?.is_file() {
        return Ok(Content::Other("a pipe or device"));
    }
    let mut start = Vec::new();
    let file = File::open(path).map_err(error::io_error(path))?;
    file.take(sniff::SNIFFED_BYTES).read_to_end(&mut start).map_err(error::io_error(path))?;
    Ok(of_start(&start, path))
}

fn of_start(start: &[u8], path: &Path) -> Content {
    let ends_with = |end: &str| {
        let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default();
        name.len() >= end.len()
            && name.is_char_boundary(name.len() - end.len())
            && name[name.len() - end.len()..].eq_ignore_ascii_case(end)
    };
    match sniff::kind_of(start, path) {
        Kind::Nrrd => Content::Volume("NRRD"),
        Kind::Nifti => Content::Volume("NIfTI"),
        Kind::Gzip if is_nifti_in_gzip(start) => Content::Volume("NIfTI"),
        Kind::Gzip => Content::Other("gzip data"),
        Kind::MetaImage => Content::Volume("MetaImage"),
        Kind::Npy => Content::Volume("NumPy"),
        Kind::Zip if ends_with(".npz") => Content::Volume("NumPy"),
        Kind::Zip => Content::Other("a ZIP archive"),
        Kind::Mrc => Content::Volume("MRC"),
        Kind::Tiff => Content::Volume("TIFF"),
        Kind::Dicom => Content::Volume("DICOM"),
        Kind::Vti => Content::Volume("VTI"),
        Kind::Other("an XML document of another kind") => Content::Text,
        Kind::Other("no header that is known") if is_text(start) => match is_state(start) {
            true => Content::State,
            false => Content::Text,
        },
        Kind::Other(found) => Content::Other(found),
    }
}

fn is_nifti_in_gzip(start: &[u8]) -> bool {
    let mut inside = Vec::new();
    // The start of a stream ends in the middle of it; what came before that counts.
    let _ = flate2::read::MultiGzDecoder::new(start).take(NIFTI_HEADER_BYTES).read_to_end(&mut inside);
    nifti::is_header(&inside)
}

/// Characters that can be read, but for one that may have been cut.
fn is_text(start: &[u8]) -> bool {
    let text = match std::str::from_utf8(start) {
        Ok(text) => text,
        Err(e) if e.error_len().is_none() => {
            std::str::from_utf8(&start[..e.valid_up_to()]).unwrap_or_default()
        }
        Err(_) => return false,
    };
    !text.is_empty() && !text.chars().any(|c| c.is_control() && !c.is_whitespace())
}

const NIFTI_HEADER_BYTES: u64 = 352;

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    #[test]
    fn files_are_told_apart_by_what_is_in_them() {
        let folder = tempfile::TempDir::new().unwrap();
        let content = |name: &str, bytes: &[u8]| {
            let path = folder.path().join(name);
            std::fs::write(&path, bytes).unwrap();
            content_of(&path).unwrap()
        };
        let mut nifti = vec![0; 352];
        nifti[..4].copy_from_slice(&348i32.to_le_bytes());
        nifti[344..348].copy_from_slice(b"n+1\0");
        let gzip = |bytes: &[u8]| {
            let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
            encoder.write_all(bytes).unwrap();
            encoder.finish().unwrap()
        };
        for (name, bytes, expected) in [
            ("a.txt", b"NRRD0004\ntype: uchar\n".to_vec(), Content::Volume("NRRD")),
            ("a.nii", nifti.clone(), Content::Volume("NIfTI")),
            ("a.gz", gzip(&nifti), Content::Volume("NIfTI")),
            ("b.nii.gz", gzip(&[7; 4000]), Content::Other("gzip data")),
            ("a.npz", b"PK\x03\x04".to_vec(), Content::Volume("NumPy")),
            ("a.docx", b"PK\x03\x04".to_vec(), Content::Other("a ZIP archive")),
            ("a.toml", "name = \"µ\"\n".into(), Content::Text),
            ("b.toml", "# seen\nisinglass_state = 1\n".into(), Content::State),
            ("a.json", b"[{\"ColorSpace\": \"RGB\"}]".to_vec(), Content::Text),
            ("a.xml", b"<?xml version=\"1.0\"?><MRML/>".to_vec(), Content::Text),
            ("a.nrrd", vec![0; 100], Content::Other("no header that is known")),
            ("empty", vec![], Content::Other("an empty file")),
            ("a.png", b"\x89PNG\r\n".to_vec(), Content::Other("a PNG picture")),
        ] {
            assert_eq!(content(name, &bytes), expected, "{name}");
        }
        assert_eq!(content_of(folder.path()).unwrap(), Content::Folder);
        assert!(content_of(&folder.path().join("nowhere")).unwrap_err().to_string().contains("nowhere"));
        // A text that is cut in the middle of a character is one still.
        let long = "µ".repeat(600);
        assert_eq!(content("long", &[b"a", long.as_bytes()].concat()), Content::Text);
    }
}
