//! Where a volume comes from: a file, a folder, or the name of a built-in volume.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use glam::Vec3;
use isinglass_core::volume::Volume;
use isinglass_core::volume::procedural::Builtin;

use crate::axes::Geometry;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, quoted, shown};
use crate::outline::Outline;
use crate::plan::{Axis, Plan, VolumeFile, read_volume};
use crate::raw::RawShape;
use crate::select::Selection;
use crate::sniff::{self, Kind};
use crate::{dicom, metaimage, mrc, nifti, npy, nrrd, raw, tiff, vti, zarr};

/// How to open a volume.
#[derive(Clone, Copy)]
pub struct OpenOptions<'a> {
    /// The shape of a raw file; without it a file must say its own.
    pub raw: Option<RawShape>,
    /// Which part of a file with more than one volume.
    pub selection: Selection,
    /// Distances between voxels along x, y and z, in place of those that the file knows.
    pub spacing: Option<Vec3>,
    /// Most bytes of memory the voxels may take, counting the second copy that some files need while reading.
    pub max_bytes: u64,
    /// Told the fraction that was read, 0 to 1, now and then.
    pub progress: Option<&'a dyn Fn(f32)>,
    /// Reading ends soon after this becomes true.
    pub cancel: Option<&'a AtomicBool>,
}

impl Default for OpenOptions<'_> {
    fn default() -> Self {
        Self {
            raw: None,
            selection: Selection::default(),
            spacing: None,
            max_bytes: DEFAULT_MAX_BYTES,
            progress: None,
            cancel: None,
        }
    }
}

impl OpenOptions<'_> {
    /// Whether `needed` bytes are allowed.
    pub(crate) fn check_memory(&self, path: &Path, needed: u64) -> Result<(), FormatError> {
        if needed > self.max_bytes {
            return Err(FormatError::TooLarge { path: shown(path), needed, limit: self.max_bytes });
        }
        Ok(())
    }

    /// Whether reading may go on.
    pub(crate) fn check_cancelled(&self, path: &Path) -> Result<(), FormatError> {
        match self.cancel {
            Some(cancel) if cancel.load(Ordering::Relaxed) => {
                Err(FormatError::Cancelled { path: shown(path) })
            }
            _ => Ok(()),
        }
    }
}

/// Opens `source`: the path of a file or folder in one of the formats of this crate, of a raw file whose shape the options
/// tell, or `builtin:cloud|cubus|shells`, optionally with `@N` for N voxels along each side.
pub fn open(source: &str, options: &OpenOptions) -> Result<Volume, FormatError> {
    match source.strip_prefix("builtin:") {
        Some(name) => open_builtin(name, options),
        None => {
            let path = Path::new(source);
            read_volume(open_path(path, options)?, path, options)
        }
    }
}

/// Reads the header of `source` alone: what there is, what [`open`] would take of it, and how much memory that needs.
pub fn outline(source: &str, options: &OpenOptions) -> Result<Outline, FormatError> {
    let path = Path::new(source);
    if let Some(name) = source.strip_prefix("builtin:") {
        let (_, side) = builtin(name)?;
        let axes = Axis::in_space([u64::from(side); 3]);
        let spacing = [2.0 / f64::from(side); 3];
        let geometry = Geometry::along_axes(spacing, None);
        let plan = Plan::new("built-in volume", Dtype::Uint8, Endian::Little, axes, geometry);
        return Ok(plan.outline(path, &plan.choose(path, options)?, options));
    }
    let file = open_path(path, options)?;
    let chosen = file.plan().choose(path, options)?;
    Ok(file.plan().outline(path, &chosen, options))
}

fn open_builtin(name: &str, options: &OpenOptions) -> Result<Volume, FormatError> {
    let (builtin, side) = builtin(name)?;
    options.check_memory(Path::new(&format!("builtin:{name}")), u64::from(side).pow(3))?;
    Ok(builtin.volume(side))
}

/// A built-in volume and its side.
fn builtin(name: &str) -> Result<(Builtin, u32), FormatError> {
    let (kind, side) = name.split_once('@').map_or((name, None), |(kind, side)| (kind, Some(side)));
    let side = match side {
        Some(text) => text.parse().ok().filter(|n| (MIN_SIDE..=Volume::MAX_SIDE).contains(n)),
        None => Some(Builtin::DEFAULT_SIDE),
    };
    let (Some(builtin), Some(side)) = (Builtin::from_name(kind), side) else {
        let names = Builtin::ALL.map(|b| format!("builtin:{}", b.name())).join(", ");
        let expected =
            format!("{names}, or with @N for N = {MIN_SIDE} to {} voxels a side", Volume::MAX_SIDE);
        return Err(FormatError::Builtin { found: quoted(name), expected });
    };
    Ok((builtin, side))
}

/// Reads the header of the file or folder at `path`.
fn open_path<'a>(path: &Path, options: &OpenOptions) -> Result<Box<dyn VolumeFile + 'a>, FormatError> {
    if path.is_dir() && options.raw.is_none() {
        return open_folder(path, options);
    }
    let mut file = open_file(path)?;
    let mut start = Vec::new();
    (&mut file).take(sniff::SNIFFED_BYTES).read_to_end(&mut start).map_err(io_error(path))?;
    file.seek(SeekFrom::Start(0)).map_err(io_error(path))?;
    let kind = sniff::kind_of(&start, path);
    let unsupported = |found, expected| FormatError::Unsupported { path: shown(path), found, expected };
    if let Some(shape) = &options.raw {
        return match kind {
            Kind::Other(_) | Kind::Gzip | Kind::Mrc | Kind::Zip => {
                Ok(Box::new(raw::RawFile::open(file, path, shape)?))
            }
            kind => Err(unsupported(kind.name(), "raw voxels, because a shape was given")),
        };
    }
    Ok(match kind {
        Kind::Nrrd => Box::new(nrrd::NrrdFile::open(file, path)?),
        Kind::Nifti => Box::new(nifti::NiftiFile::open(file, path, false)?),
        Kind::Gzip => Box::new(nifti::NiftiFile::open(file, path, true)?),
        Kind::MetaImage => Box::new(metaimage::MetaImageFile::open(file, path)?),
        Kind::Npy => Box::new(npy::NpyFile::open(file, path)?),
        Kind::Zip => Box::new(npy::NpyFile::open_archive(file, path, options)?),
        Kind::Mrc => Box::new(mrc::MrcFile::open(file, path)?),
        Kind::Tiff => Box::new(tiff::TiffFile::open(vec![path.to_owned()], path, options)?),
        Kind::Dicom => Box::new(dicom::DicomFiles::open(vec![path.to_owned()], path, options)?),
        Kind::Vti => Box::new(vti::VtiFile::open(file, path, options)?),
        Kind::Other(found) => return Err(unsupported(found, sniff::expected_for(found))),
    })
}

/// Reads the headers of a folder: an OME-Zarr image, slices in TIFF files if they are more than the DICOM files beside them, or
/// else DICOM files in it and the folders below.
fn open_folder<'a>(path: &Path, options: &OpenOptions) -> Result<Box<dyn VolumeFile + 'a>, FormatError> {
    if zarr::is_group(path) {
        return Ok(Box::new(zarr::ZarrImage::open(path, options)?));
    }
    let mut files = Vec::new();
    let num_folders = &mut 0;
    list_files(path, options, 0, num_folders, &mut files)?;
    let is_tiff = |file: &PathBuf| {
        let end = file.extension().and_then(|e| e.to_str()).unwrap_or_default();
        file.parent() == Some(path) && (end.eq_ignore_ascii_case("tif") || end.eq_ignore_ascii_case("tiff"))
    };
    let mut slices: Vec<PathBuf> = files.iter().filter(|f| is_tiff(f)).cloned().collect();
    let is_dicom = |file: &Path| read_start(file).is_some_and(|start| dicom::is_header(&start));
    // A picture beside the slices of a series is none of them.
    let num_dicom =
        || files.iter().filter(|f| f.parent() == Some(path) && !is_tiff(f) && is_dicom(f)).count();
    if !slices.is_empty() && num_dicom() < slices.len() {
        tiff::sort_by_number(&mut slices);
        return Ok(Box::new(tiff::TiffFile::open(slices, path, options)?));
    }
    let mut has_others = false;
    files.retain(|file| {
        let start = read_start(file).unwrap_or_default();
        let is_dicom = dicom::is_header(&start);
        has_others |=
            !is_dicom && file.parent() == Some(path) && sniff::kind_of(&start, file).is_whole_volume();
        is_dicom
    });
    // A series that lies somewhere below is not what such a folder is opened for.
    if has_others && files.iter().all(|file| file.parent() != Some(path)) {
        return Err(FormatError::Unsupported {
            path: shown(path),
            found: "a folder of volumes",
            expected: "one of them, or a folder of slices",
        });
    }
    if files.is_empty() {
        return Err(FormatError::Unsupported {
            path: shown(path),
            found: "a folder without slices",
            expected: sniff::EXPECTED,
        });
    }
    Ok(Box::new(dicom::DicomFiles::open(files, path, options)?))
}

/// The first bytes of a file, if it can be read.
fn read_start(file: &Path) -> Option<Vec<u8>> {
    let mut start = Vec::new();
    File::open(file).and_then(|f| f.take(sniff::SNIFFED_BYTES).read_to_end(&mut start)).ok()?;
    Some(start)
}

/// The files in a folder and those below, sorted, within bounds. Hidden ones, which systems leave there, are none.
fn list_files(
    folder: &Path,
    options: &OpenOptions,
    depth: usize,
    num_folders: &mut usize,
    files: &mut Vec<PathBuf>,
) -> Result<(), FormatError> {
    options.check_cancelled(folder)?;
    *num_folders += 1;
    let too_many =
        |found| FormatError::Unsupported { path: shown(folder), found, expected: "the folder of one volume" };
    if *num_folders > MAX_FOLDERS {
        return Err(too_many("too many folders"));
    }
    let mut entries = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(io_error(folder))? {
        if entries.len() + files.len() == MAX_FILES {
            return Err(too_many("too many files"));
        }
        let entry = entry.map_err(io_error(folder))?;
        if entry.file_name().as_encoded_bytes().starts_with(b".") {
            continue;
        }
        entries.push((entry.path(), entry.file_type().map_err(io_error(folder))?));
    }
    entries.sort_by(|a, b| a.0.cmp(&b.0));
    for (path, kind) in entries {
        // A link to a file is one; a link to a folder may lead in circles.
        if kind.is_dir() && depth < MAX_DEPTH {
            list_files(&path, options, depth + 1, num_folders, files)?;
        } else if kind.is_file() || (kind.is_symlink() && path.is_file()) {
            files.push(path);
        }
    }
    Ok(())
}

/// Opens a regular file. Pipes and devices are refused: they have no length to check, and may never end.
pub(crate) fn open_file(path: &Path) -> Result<File, FormatError> {
    let metadata = std::fs::metadata(path).map_err(io_error(path))?;
    if !metadata.is_file() {
        let found = if metadata.is_dir() { "a folder" } else { "a pipe or device" };
        return Err(FormatError::Unsupported { path: shown(path), found, expected: "a regular file" });
    }
    File::open(path).map_err(io_error(path))
}

/// The bytes of the regular file at `path`; `None` if there are more than `max_bytes`.
pub(crate) fn read_file(path: &Path, max_bytes: u64) -> Result<Option<Vec<u8>>, FormatError> {
    let mut bytes = Vec::new();
    open_file(path)?.take(max_bytes + 1).read_to_end(&mut bytes).map_err(io_error(path))?;
    Ok((bytes.len() as u64 <= max_bytes).then_some(bytes))
}

/// The last part of a path, for display.
pub(crate) fn file_name(path: &Path) -> String {
    path.file_name().map_or_else(|| shown(path), |name| shown(Path::new(name)))
}

/// Eight gigabytes: a volume of 2048³ bytes, about what a large GPU can hold.
const DEFAULT_MAX_BYTES: u64 = 8 << 30;
/// Files of a folder that are looked at.
const MAX_FILES: usize = 1 << 17;
/// Folders in it.
const MAX_FOLDERS: usize = 4096;
/// How deep they may lie.
const MAX_DEPTH: usize = 8;
/// Fewest voxels along a side of a built-in volume.
const MIN_SIDE: u32 = 8;
