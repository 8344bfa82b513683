//! Recognises the content of a file, for windows that list files or accept dropped ones.

use std::io::Read;
use std::path::Path;

use crate::error::FormatError;
use crate::packed::inside_gzip;
use crate::sniff::{self, FileKind};
use crate::source::{kind_but_file, open_file};
use crate::state::is_state;
use crate::{error, zarr};

/// What a file or folder is, judged by its first bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Content {
    /// A volume in a supported format, with a short name of the format.
    Volume(&'static str),
    /// A folder, which may contain the slices of a volume.
    Folder,
    /// A saved state.
    State,
    /// Other text, which may be a transfer function or presets.
    Text,
    /// Something else, with a description for messages.
    Other(&'static str),
}

/// Recognises the file or folder at `path`. This may wait for a disk.
///
/// # Errors
/// The file or folder cannot be read.
pub fn content_of(path: &Path) -> Result<Content, FormatError> {
    if path.is_dir() {
        return Ok(if zarr::is_group(path) { Content::Volume("OME-Zarr") } else { Content::Folder });
    }
    if let Some(kind) = kind_but_file(&std::fs::metadata(path).map_err(error::io_error(path))?) {
        return Ok(Content::Other(kind));
    }
    let mut start = Vec::new();
    open_file(path)?.take(sniff::SNIFFED_BYTES).read_to_end(&mut start).map_err(error::io_error(path))?;
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
        FileKind::Nrrd => Content::Volume("NRRD"),
        FileKind::Nifti => Content::Volume("NIfTI"),
        FileKind::Gzip => {
            let (inside, name) = inside_gzip(start, path);
            match of_start(&inside, &name) {
                found @ Content::Volume(_) if !matches!(sniff::kind_of(&inside, &name), FileKind::Zip) => {
                    found
                }
                _ => Content::Other("gzip data"),
            }
        }
        FileKind::MetaImage => Content::Volume("MetaImage"),
        FileKind::Npy => Content::Volume("NumPy"),
        FileKind::Zip if ends_with(".npz") => Content::Volume("NumPy"),
        FileKind::Zip if ends_with(".zip") || ends_with(".ozx") => Content::Volume("ZIP"),
        FileKind::Zip => Content::Other("a ZIP archive"),
        FileKind::Mrc => Content::Volume("MRC"),
        FileKind::Tiff => Content::Volume("TIFF"),
        FileKind::Dicom => Content::Volume("DICOM"),
        FileKind::Vti => Content::Volume("VTI"),
        FileKind::Vtk => Content::Volume("VTK"),
        FileKind::Mgh => Content::Volume("MGH"),
        FileKind::Hdf5 | FileKind::BigDataViewer => Content::Volume("HDF5"),
        FileKind::Netcdf => Content::Volume("NetCDF"),
        FileKind::Png => Content::Other("a PNG picture"),
        FileKind::Other("an XML document of another kind") => Content::Text,
        FileKind::Other("no header that is known") if is_text(start) => match is_state(start) {
            true => Content::State,
            false => Content::Text,
        },
        FileKind::Other(found) => Content::Other(found),
    }
}

/// Whether the bytes are printable UTF-8. The last character may be cut.
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
            ("a.nhdr.gz", gzip(b"NRRD0004\n"), Content::Volume("NRRD")),
            ("a.mgz", gzip(&[0, 0, 0, 1, 0, 0, 0, 5]), Content::Volume("MGH")),
            ("a.gz", gzip(&[0, 0, 0, 1, 0, 0, 0, 5]), Content::Other("gzip data")),
            ("a.zip", b"PK\x03\x04".to_vec(), Content::Volume("ZIP")),
            ("a.vtk", b"# vtk DataFile Version 3.0\n".to_vec(), Content::Volume("VTK")),
            (
                "p.nrrd",
                b"version https://git-lfs.github.com/spec/v1\n".to_vec(),
                Content::Other(sniff::LFS_NAME),
            ),
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
        // A cut in the middle of a character does not matter.
        let long = "µ".repeat(600);
        assert_eq!(content("long", &[b"a", long.as_bytes()].concat()), Content::Text);
    }
}
