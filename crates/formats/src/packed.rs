//! Files in gzip, and archives of files. They are unpacked into a temporary folder and opened there, like any other.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Component, Path, PathBuf};

use crate::collector::Collector;
use crate::error::{FormatError, io_error, malformed, quoted, shown};
use crate::plan::{Plan, VolumeFile};
use crate::scratch::ScratchFolder;
use crate::sniff::{self, FileKind};
use crate::source::{OpenOptions, open_path, read_start};
use crate::stream::{Packing, Unpacked};
use crate::{nifti, npy, zip};

/// A file that was unpacked.
struct PackedFile {
    inner: Box<dyn VolumeFile>,
    /// The file as the user named it.
    path: PathBuf,
    folder: ScratchFolder,
}

impl VolumeFile for PackedFile {
    fn plan(&self) -> &Plan {
        self.inner.plan()
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        self.inner.read(collector).map_err(|e| e.named_within(&self.folder.path(), &self.path))
    }
}

/// The start of what `start` unpacks to, and the name without the ending of gzip.
pub(crate) fn inside_gzip(start: &[u8], path: &Path) -> (Vec<u8>, PathBuf) {
    let mut inside = Vec::new();
    // The data end in the middle of the stream, so an error at the end is expected.
    let _ = flate2::read::MultiGzDecoder::new(start).take(sniff::SNIFFED_BYTES).read_to_end(&mut inside);
    let end = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    let name = match end.as_str() {
        "gz" => path.with_extension(""),
        "mgz" => path.with_extension("mgh"),
        _ => path.to_owned(),
    };
    (inside, name)
}

/// Opens the gzip file at `path`, which begins with `start`.
pub(crate) fn open_gzip(
    file: File,
    start: &[u8],
    path: &Path,
    options: &OpenOptions,
) -> Result<Box<dyn VolumeFile>, FormatError> {
    let (inside, name) = inside_gzip(start, path);
    match sniff::kind_of(&inside, &name) {
        FileKind::Nifti => return Ok(Box::new(nifti::NiftiFile::open(file, path, true, options)?)),
        FileKind::Other(_) | FileKind::Gzip | FileKind::Zip => {
            let found = sniff::gzip_name(path);
            return Err(FormatError::Unsupported {
                path: shown(path),
                found,
                expected: sniff::expected_for(found),
            });
        }
        _ => {}
    }
    let io = io_error(path);
    let mut folder = ScratchFolder::new().map_err(io)?;
    let name = Path::new(name.file_name().unwrap_or(path.as_os_str()));
    let mut left = options.max_bytes;
    let mut stream = Unpacked::open(file, path, 0, None, Packing::Gzip)?;
    unpack(&mut stream, folder.file(name, true).map_err(io)?, &mut left, path, options)?;
    opened(&folder.path().join(name), path, folder, options)
}

/// Opens the archive at `path`: arrays of NumPy, or a file or folder of any format.
pub(crate) fn open_zip(
    mut file: File,
    path: &Path,
    options: &OpenOptions,
) -> Result<Box<dyn VolumeFile>, FormatError> {
    let again = file.try_clone().map_err(io_error(path))?;
    if !zip::entries(again, path, ".npy", 1)?.is_empty() {
        file.seek(SeekFrom::Start(0)).map_err(io_error(path))?;
        return Ok(Box::new(npy::NpyFile::open_archive(file, path, options)?));
    }
    file.seek(SeekFrom::Start(0)).map_err(io_error(path))?;
    let io = io_error(path);
    let mut folder = ScratchFolder::new().map_err(io)?;
    let mut left = options.max_bytes;
    let mut files = Vec::new();
    let entries = zip::entries(file, path, "", MAX_FILES)?;
    let are_few = entries.len() <= MAX_NAMELESS;
    for entry in entries {
        let Some(name) = inner_path(&entry.name) else { continue };
        let packing = match entry.method {
            0 => Packing::Plain,
            8 => Packing::Deflate,
            other => {
                let problem = format!("{} is packed by method {other}, expected 0 or 8", quoted(&entry.name));
                return Err(malformed(path, "ZIP archive")(problem));
            }
        };
        let mut stream = Unpacked::open(
            crate::source::open_file(path)?,
            path,
            entry.offset,
            Some(entry.packed_bytes),
            packing,
        )?;
        // A plain stream goes on to the end of the archive.
        let most = if packing == Packing::Plain { entry.packed_bytes } else { u64::MAX };
        let target = folder.file(&name, are_few).map_err(io)?;
        unpack(&mut Read::take(&mut stream, most), target, &mut left, path, options)?;
        files.push(folder.path().join(name));
    }
    let target = match &files[..] {
        [] => {
            return Err(FormatError::Unsupported {
                path: shown(path),
                found: "a ZIP archive without files",
                expected: "one with a volume",
            });
        }
        // An archive may even contain itself.
        [one] if is_zip(one) => {
            return Err(FormatError::Unsupported {
                path: shown(path),
                found: "a ZIP archive in a ZIP archive",
                expected: "one with a volume",
            });
        }
        [one] => one.clone(),
        // The folder that holds everything.
        [first, rest @ ..] => rest.iter().fold(first.parent().unwrap_or(first).to_owned(), |common, file| {
            common.ancestors().find(|a| file.starts_with(a)).unwrap_or(&common).to_owned()
        }),
    };
    opened(&target, path, folder, options)
}

fn is_zip(path: &Path) -> bool {
    read_start(path).is_some_and(|start| matches!(sniff::kind_of(&start, path), FileKind::Zip))
}

/// The file or folder at `target`, which was unpacked from `path`.
fn opened(
    target: &Path,
    path: &Path,
    folder: ScratchFolder,
    options: &OpenOptions,
) -> Result<Box<dyn VolumeFile>, FormatError> {
    let inner = open_path(target, options).map_err(|e| e.named_within(&folder.path(), path))?;
    Ok(Box::new(PackedFile { inner, path: path.to_owned(), folder }))
}

/// The path of an entry below a folder; `None` for folders, hidden files and paths that lead elsewhere.
fn inner_path(name: &str) -> Option<PathBuf> {
    let parts: Option<Vec<_>> = Path::new(name)
        .components()
        .map(|part| match part {
            Component::Normal(name) => name.to_str(),
            _ => None,
        })
        .collect();
    let parts = parts.filter(|parts| !name.ends_with('/') && !parts.is_empty())?;
    let is_kept = |part: &&str| !part.contains(['\\', ':']) && **part != *"__MACOSX";
    // The names of Zarr's older metadata begin with a dot.
    let is_hidden = |part: &&str| part.starts_with('.') && !part.starts_with(".z");
    (parts.iter().all(is_kept) && !parts.iter().any(is_hidden)).then(|| parts.iter().collect())
}

/// Writes all of `stream` to `target`. `left` are the bytes that may still be unpacked of `path`.
fn unpack(
    stream: &mut dyn Read,
    mut target: File,
    left: &mut u64,
    path: &Path,
    options: &OpenOptions,
) -> Result<(), FormatError> {
    let mut chunk = Vec::new();
    loop {
        options.check_cancelled(path)?;
        chunk.clear();
        let damaged = |e: std::io::Error| {
            let problem = format!("compressed data is damaged or cut: {e}");
            FormatError::Data { path: shown(path), problem }
        };
        stream.take(CHUNK_BYTES).read_to_end(&mut chunk).map_err(damaged)?;
        if chunk.is_empty() {
            return Ok(());
        }
        *left = left.checked_sub(chunk.len() as u64).ok_or_else(|| FormatError::TooLarge {
            path: shown(path),
            needed: options.max_bytes.saturating_add(1),
            limit: options.max_bytes,
            advice: "",
        })?;
        target.write_all(&chunk).map_err(io_error(path))?;
    }
}

/// Bytes to unpack at a time.
const CHUNK_BYTES: u64 = 1 << 20;
/// Most files of an archive.
const MAX_FILES: usize = 1 << 17;
/// Most files of an archive that are unpacked without a name, because each stays open.
const MAX_NAMELESS: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entries_stay_below_their_folder() {
        for (name, path) in [("a/b.dcm", "a/b.dcm"), ("x.zarr/.zattrs", "x.zarr/.zattrs")] {
            assert_eq!(inner_path(name), Some(PathBuf::from(path)));
        }
        for bad in ["", "a/", "/etc/passwd", "../a", "a/../../b", "a\\b", "c:a", ".hidden/a", "__MACOSX/a"] {
            assert_eq!(inner_path(bad), None, "{bad}");
        }
    }
}
