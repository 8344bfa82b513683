//! Where a volume comes from: a path or the name of a built-in volume.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

use isinglass_core::volume::Volume;
use isinglass_core::volume::procedural::Builtin;

use crate::error::{FormatError, io_error, quoted, shown};
use crate::raw::RawShape;
use crate::{nrrd, raw};

/// How to open a volume.
#[derive(Clone, Copy)]
pub struct OpenOptions<'a> {
    /// The shape of a raw file; without it a file must say its own.
    pub raw: Option<RawShape>,
    /// Most bytes of memory the voxels may take, counting the second copy that some files need while reading.
    pub max_bytes: u64,
    /// Told the fraction that was read, 0 to 1, now and then.
    pub progress: Option<&'a dyn Fn(f32)>,
}

impl Default for OpenOptions<'_> {
    fn default() -> Self {
        Self { raw: None, max_bytes: DEFAULT_MAX_BYTES, progress: None }
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
}

/// Opens `source`: the path of an NRRD file or of a raw file whose shape the options tell, or
/// `builtin:cloud|cubus|shells`, optionally with `@N` for N voxels along each side.
pub fn open(source: &str, options: &OpenOptions) -> Result<Volume, FormatError> {
    match source.strip_prefix("builtin:") {
        Some(name) => open_builtin(name, options),
        None => open_path(Path::new(source), options),
    }
}

fn open_builtin(name: &str, options: &OpenOptions) -> Result<Volume, FormatError> {
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
    options.check_memory(Path::new(&format!("builtin:{name}")), u64::from(side).pow(3))?;
    Ok(builtin.volume(side))
}

fn open_path(path: &Path, options: &OpenOptions) -> Result<Volume, FormatError> {
    let mut file = open_file(path)?;
    let mut start = Vec::new();
    (&mut file).take(SNIFFED_BYTES).read_to_end(&mut start).map_err(io_error(path))?;
    file.seek(SeekFrom::Start(0)).map_err(io_error(path))?;
    let unsupported = |found, expected| FormatError::Unsupported { path: shown(path), found, expected };
    match (&options.raw, start.starts_with(b"NRRD")) {
        (None, true) => nrrd::read(file, path, options),
        (Some(shape), false) => raw::read(file, path, shape, options),
        (Some(_), true) => Err(unsupported("an NRRD file", "raw voxels, because a shape was given")),
        (None, false) => Err(unsupported(
            kind_of_file(&start),
            "an NRRD file, or raw voxels with their dimensions and type given",
        )),
    }
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

/// The last part of a path, for display.
pub(crate) fn file_name(path: &Path) -> String {
    path.file_name().map_or_else(|| shown(path), |name| shown(Path::new(name)))
}

/// What a file that cannot be read looks like, so that the message helps.
fn kind_of_file(start: &[u8]) -> &'static str {
    let is_at = |at: usize, magic: &[u8]| start.get(at..).is_some_and(|rest| rest.starts_with(magic));
    match () {
        () if start.is_empty() => "an empty file",
        () if is_at(0, &[0x1f, 0x8b]) => "gzip data",
        () if is_at(0, b"II*\0") || is_at(0, b"MM\0*") => "a TIFF file",
        () if is_at(128, b"DICM") => "a DICOM file",
        () if is_at(344, b"n+1\0") || is_at(344, b"ni1\0") => "a NIfTI file",
        () if is_at(0, b"ObjectType") => "a MetaImage file",
        () if is_at(0, b"<?xml") || is_at(0, b"<VTKFile") || is_at(0, b"# vtk") => "a VTK file",
        () => "no header that is known",
    }
}

/// Eight gigabytes: a volume of 2048³ bytes, about what a large GPU can hold.
const DEFAULT_MAX_BYTES: u64 = 8 << 30;
/// Fewest voxels along a side of a built-in volume.
const MIN_SIDE: u32 = 8;
/// Enough for the magic numbers of the formats that are told apart.
const SNIFFED_BYTES: u64 = 352;
