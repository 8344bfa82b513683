//! Opens a volume from a file, a folder or the name of a built-in volume.

use std::fs::{File, Metadata};
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use glam::Vec3;
use isinglass_core::volume::{Histogram, Volume};

use crate::builtin::BuiltinFile;
use crate::dtype::Dtype;
use crate::error::{FormatError, io_error, shown};
use crate::foreign::HomeFolder;
use crate::outline::Outline;
use crate::overlay::{bytes_of_labels, with_labels};
use crate::paged::{open_paged, page_count};
use crate::plan::{Memory, VolumeFile};
use crate::raw::RawShape;
use crate::read_volume::{self, read_volume};
use crate::reading::Reading;
use crate::selection::Selection;
use crate::sniff::{self, FileKind};
use crate::web::{is_address, shown_address};
use crate::{
    dicom, hdf5, metaimage, mgh, mrc, netcdf, nifti, npy, nrrd, packed, png_stack, raw, tiff, vti, vtk, zarr,
};

/// How to open a volume.
#[derive(Clone, Copy)]
pub struct OpenOptions<'a> {
    /// The shape of a raw file; `None` for files with a header.
    pub raw: Option<RawShape>,
    /// The part of the file to read.
    pub selection: Selection,
    /// Distances between voxels along x, y and z, instead of those in the file.
    pub spacing: Option<Vec3>,
    /// Most bytes of memory for the voxels, including the second copy that some files need during reading.
    pub max_bytes: u64,
    /// Bytes of them that other volumes take until this one is shown. One that does not fit beside them is read by pages,
    /// which get all of the memory later.
    pub held: u64,
    /// Whether a header may name files outside its own folder, and links in a folder may lead outside.
    pub foreign_files: bool,
    /// How the numbers become voxels.
    pub reading: &'a Reading,
    /// The folder with indices of volumes that were read before, which this may add to.
    pub index_folder: Option<&'a Path>,
    /// Whether a volume that does not fit may be read by pages: its coarsest level then comes with their reader.
    pub by_pages: bool,
    /// Called now and then with the fraction that has been read, 0 to 1.
    pub progress: Option<&'a dyn Fn(f32)>,
    /// Set this flag to stop reading.
    pub cancel: Option<&'a AtomicBool>,
}

impl Default for OpenOptions<'_> {
    fn default() -> Self {
        Self {
            raw: None,
            selection: Selection::default(),
            spacing: None,
            max_bytes: DEFAULT_MAX_BYTES,
            held: 0,
            foreign_files: false,
            reading: Reading::USUAL,
            by_pages: false,
            index_folder: None,
            progress: None,
            cancel: None,
        }
    }
}

impl OpenOptions<'_> {
    /// The same options for a volume that is read whole beside others. A level that is chosen stays, and so do the channels
    /// that are shown together.
    fn beside(&self) -> Self {
        let held = if self.selection.level.is_none() { self.held } else { 0 };
        Self { max_bytes: self.max_bytes.saturating_sub(held), held: 0, ..*self }
    }

    /// Refuses to use more than the allowed bytes of memory.
    pub(crate) fn check_memory(&self, path: &Path, needed: u64) -> Result<(), FormatError> {
        if needed > self.max_bytes {
            return Err(FormatError::TooLarge {
                path: shown(path),
                needed,
                limit: self.max_bytes,
                advice: "",
            });
        }
        Ok(())
    }

    /// Returns an error if reading was cancelled.
    pub(crate) fn check_cancelled(&self, path: &Path) -> Result<(), FormatError> {
        match self.cancel {
            Some(cancel) if cancel.load(Ordering::Relaxed) => {
                Err(FormatError::Cancelled { path: shown(path) })
            }
            _ => Ok(()),
        }
    }
}

/// Opens `source`: the path of a file or folder, the address of an OME-Zarr image, or `builtin:cloud|cubus|shells`.
/// The path of an array within an HDF5 file follows that of the file. A built-in name may end with `@N` for N voxels
/// along each side. The path of a raw file needs [`OpenOptions::raw`].
///
/// # Errors
/// The file cannot be read, or its format or selection is not supported. The message is one line.
pub fn open(source: &str, options: &OpenOptions) -> Result<Volume, FormatError> {
    if outline_by_pages(source, options)?.is_some() {
        return Ok(open_paged(source, &for_pages(options))?.into_volume(options.max_bytes));
    }
    open_whole(source, options).map_err(|e| if may_page(options) { e.with_advice() } else { e })
}

fn open_whole(source: &str, options: &OpenOptions) -> Result<Volume, FormatError> {
    let volume = match source.strip_prefix("builtin:") {
        Some(name) => open_builtin(name, options)?,
        None => {
            let options = &options.beside();
            let (path, file) = open_source(source, options)?;
            read_volume(file, &path, options)?
        }
    };
    match &options.reading.labels {
        Some(labels) => with_labels(volume, labels, options),
        None => Ok(volume),
    }
}

/// Least and greatest stored number and histogram of each channel, in the selected part of the finest level, which
/// [`open`] uses for a coarser one. `None` for the finest level, and if it is too large to be read for them.
///
/// # Errors
/// As [`open`].
pub fn finest_numbers(
    source: &str,
    options: &OpenOptions,
) -> Result<Option<Vec<ChannelNumbers>>, FormatError> {
    let (path, file) = open_any(source, options)?;
    let (plan, chosen) = (file.plan(), file.plan().choose(&path, options)?);
    let (scale, offset) = plan.value_map;
    let maps = vec![(scale as f32, offset as f32); chosen.channels.len()];
    let known = read_volume::finest_numbers((&maps, 0), &*file, &chosen, &path, options)?;
    Ok(known.map(|known| known.into_iter().map(|k| (k.stored_range, k.histogram)).collect()))
}

/// Least and greatest stored number of a channel, and its histogram.
pub type ChannelNumbers = ((f32, f32), Arc<Histogram>);

/// Reads only the header of `source`. Returns its contents, what [`open`] would select, and the memory it needs.
///
/// # Errors
/// As [`open`], except for errors in the voxels.
pub fn outline(source: &str, options: &OpenOptions) -> Result<Outline, FormatError> {
    if let Some(found) = outline_by_pages(source, options)? {
        return Ok(found);
    }
    let found = outline_of(source, &options.beside());
    let mut found = found.map_err(|e| if may_page(options) { e.with_advice() } else { e })?;
    if let Some(labels) = &options.reading.labels {
        let num_voxels = found.dims.iter().map(|&n| u64::from(n)).product();
        let [when_read, while_reading] = bytes_of_labels(labels, num_voxels, options)?;
        found.bytes_while_reading =
            found.bytes_while_reading.max(found.bytes_in_memory.saturating_add(while_reading));
        found.bytes_in_memory = found.bytes_in_memory.saturating_add(when_read);
    }
    Ok(found)
}

/// Whether a volume may be read by pages, if its file can.
fn may_page(options: &OpenOptions) -> bool {
    let asks_for_finest =
        options.selection.level.is_none_or(|level| level == 0) && options.reading.thin.is_none();
    let is_allowed = options.by_pages && options.max_bytes >= LEAST_FOR_PAGES;
    is_allowed && asks_for_finest && options.reading.labels.is_none()
}

/// The finest level, if it is wanted, does not fit, and can be read by pages.
fn outline_by_pages(source: &str, options: &OpenOptions) -> Result<Option<Outline>, FormatError> {
    if !may_page(options) {
        return Ok(None);
    }
    let fits = |outline: &Outline| {
        let finest = outline.levels.first().map_or(outline.whole_dims, |level| level.dims);
        outline.level == 0 && (options.selection.region.is_some() || outline.dims.map(u64::from) == finest)
    };
    let alone = match outline_of(source, options) {
        Ok(found) if fits(&found) => Some(found),
        // Whoever opens it is told of other errors.
        Ok(_) | Err(_) => None,
    };
    let room = options.max_bytes.saturating_sub(options.held);
    if alone.as_ref().is_some_and(|alone| options.held == 0 || alone.bytes_needed() <= room) {
        return Ok(None);
    }
    let Some(pages) = page_count(source, &for_pages(options)) else { return Ok(None) };
    let selection = Selection { level: Some(0), ..options.selection };
    let mut found = outline_of(source, &OpenOptions { selection, max_bytes: u64::MAX, ..*options })?;
    // What fits alone shows the same channels beside others.
    if alone.is_some_and(|alone| alone.shown.channel != found.shown.channel) {
        return Ok(None);
    }
    if options.selection.region.is_none() {
        let finest = found.levels.first().map_or(found.whole_dims, |level| level.dims);
        found.dims = finest.map(|n| u32::try_from(n).unwrap_or(u32::MAX));
    }
    found.pages = Some(pages);
    (found.bytes_in_memory, found.bytes_while_reading) = (options.max_bytes, 0);
    Ok(Some(found))
}

/// The same options for all levels.
fn for_pages<'a>(options: &OpenOptions<'a>) -> OpenOptions<'a> {
    OpenOptions { selection: Selection { level: None, ..options.selection }, ..*options }
}

fn outline_of(source: &str, options: &OpenOptions) -> Result<Outline, FormatError> {
    let (path, file) = open_any(source, options)?;
    let chosen = file.plan().choose(&path, options)?;
    Ok(file.plan().outline(&path, &chosen, options))
}

/// Reads the header of any source, a built-in one too. Returns its path, too.
pub(crate) fn open_any(
    source: &str,
    options: &OpenOptions,
) -> Result<(PathBuf, Box<dyn VolumeFile>), FormatError> {
    match source.strip_prefix("builtin:") {
        Some(name) => Ok((PathBuf::from(source), Box::new(BuiltinFile::named(name)?))),
        None => open_source(source, options),
    }
}

/// Reads the header of a file, a folder or an image at an address. Returns its path, too.
pub(crate) fn open_source(
    source: &str,
    options: &OpenOptions,
) -> Result<(PathBuf, Box<dyn VolumeFile>), FormatError> {
    if is_address(source) {
        let path = PathBuf::from(shown_address(source));
        return Ok((path, Box::new(zarr::ZarrImage::open_web(source, options)?)));
    }
    let path = path_of(source)?;
    if let Some((path, inside)) = within_file(&path) {
        let file = hdf5::Hdf5File::open(open_file(&path)?, &path, &inside, options)?;
        return Ok((path, Box::new(file)));
    }
    let file = open_path(&path, options)?;
    Ok((path, file))
}

fn open_builtin(name: &str, options: &OpenOptions) -> Result<Volume, FormatError> {
    let BuiltinFile { builtin, side, .. } = BuiltinFile::named(name)?;
    let memory = Memory { num_voxels: u64::from(side).pow(3), dtype: Dtype::Uint8, is_permuted: false };
    options.check_memory(Path::new(&format!("builtin:{name}")), memory.needed(1))?;
    Ok(builtin.volume(side))
}

/// Whether `source` is a built-in volume, an address of the web, or names a file or folder that exists, or an array in
/// a file. This may wait for a disk, but asks no server.
pub fn source_exists(source: &str) -> bool {
    let is_there = |path: PathBuf| path.exists() || within_file(&path).is_some();
    source.starts_with("builtin:") || is_address(source) || path_of(source).is_ok_and(is_there)
}

/// The HDF5 file that `path` goes through, and the rest of the path within it, which begins with a slash. No such path
/// exists for the system.
fn within_file(path: &Path) -> Option<(PathBuf, String)> {
    let file = path.ancestors().skip(1).find(|part| part.is_file()).filter(|_| !path.exists())?;
    let start = read_start(file)?;
    (hdf5::is_header(&start) || hdf5::is_after_user_block(file)).then_some(())?;
    let rest = path.strip_prefix(file).ok()?.iter().map(|name| name.to_string_lossy());
    Some((file.to_owned(), rest.fold(String::new(), |all, name| all + "/" + &name)))
}

/// The path that `source` names. Some names are no UTF-8. They have � in place of what is not, and the file whose
/// name reads so is meant.
fn path_of(source: &str) -> Result<PathBuf, FormatError> {
    let path = Path::new(source);
    if path.exists() {
        return Ok(path.to_owned());
    }
    if source.split_once("://").is_some_and(|(scheme, _)| scheme.chars().all(|c| c.is_ascii_alphanumeric())) {
        return Err(FormatError::Unsupported {
            path: shown(path),
            found: "an address",
            expected: "a path on the machine that reads it, or OME-Zarr at http://, https:// or s3://",
        });
    }
    if !source.contains(char::REPLACEMENT_CHARACTER) {
        return Ok(path.to_owned());
    }
    let mut found = PathBuf::new();
    for part in path.components() {
        let next = found.join(part);
        let name = part.as_os_str().to_string_lossy();
        let folder = if found.as_os_str().is_empty() { Path::new(".") } else { &found };
        let reads_so = |entry: &std::fs::DirEntry| entry.file_name().to_string_lossy() == name;
        let other = || std::fs::read_dir(folder).ok()?.flatten().find(reads_so);
        found = match if next.exists() { None } else { other() } {
            Some(entry) => found.join(entry.file_name()),
            None => next,
        };
    }
    Ok(found)
}

/// Reads the header of the file or folder at `path`.
pub(crate) fn open_path(path: &Path, options: &OpenOptions) -> Result<Box<dyn VolumeFile>, FormatError> {
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
            FileKind::Other(_) | FileKind::Gzip | FileKind::Mrc | FileKind::Zip | FileKind::Png => {
                Ok(Box::new(raw::RawFile::open(file, path, shape)?))
            }
            kind => Err(unsupported(kind.name(), "raw voxels, because a shape was given")),
        };
    }
    Ok(match kind {
        FileKind::Nrrd => Box::new(nrrd::NrrdFile::open(file, path, options)?),
        FileKind::Nifti => Box::new(nifti::NiftiFile::open(file, path, false, options)?),
        FileKind::Gzip => packed::open_gzip(file, &start, path, options)?,
        FileKind::MetaImage => Box::new(metaimage::MetaImageFile::open(file, path, options)?),
        FileKind::Npy => Box::new(npy::NpyFile::open(file, path)?),
        FileKind::Zip => packed::open_zip(file, path, options)?,
        FileKind::Mrc => Box::new(mrc::MrcFile::open(file, path)?),
        FileKind::Tiff => Box::new(tiff::TiffFile::open(vec![path.to_owned()], path, options)?),
        FileKind::Dicom => dicom::open(vec![path.to_owned()], path, options)?,
        FileKind::Vti => Box::new(vti::VtiFile::open(file, path, options)?),
        FileKind::Vtk => Box::new(vtk::VtkFile::open(file, path)?),
        FileKind::Mgh => Box::new(mgh::MghFile::open(file, path)?),
        FileKind::Netcdf => Box::new(netcdf::NetcdfFile::open(file, path, options)?),
        FileKind::Hdf5 => Box::new(hdf5::Hdf5File::open(file, path, "/", options)?),
        FileKind::BigDataViewer => Box::new(hdf5::Hdf5File::open_description(path, options)?),
        FileKind::Png => Box::new(png_stack::PngStack::open(vec![path.to_owned()], path, options)?),
        FileKind::Other(sniff::PAIR) => return open_path(&path.with_extension("hdr"), options),
        FileKind::Other(found) => return Err(unsupported(found, sniff::expected_for(found))),
    })
}

/// Reads the headers of a folder. It may be an OME-Zarr image. TIFF files, or else PNG files, are slices if they
/// outnumber the DICOM files beside them. Otherwise, the folder and those below it are searched for DICOM files.
fn open_folder(path: &Path, options: &OpenOptions) -> Result<Box<dyn VolumeFile>, FormatError> {
    if zarr::is_group(path) {
        return Ok(Box::new(zarr::ZarrImage::open(path, options)?));
    }
    if let Some((found, expected)) = zarr::other_group(path) {
        return Err(FormatError::Unsupported { path: shown(path), found, expected });
    }
    let home = HomeFolder::of_folder(path, options);
    let mut files = Vec::new();
    let num_folders = &mut 0;
    list_files(path, options, 0, num_folders, &mut files)?;
    let is_named = |file: &PathBuf, ends: &[&str]| {
        let end = file.extension().and_then(|e| e.to_str()).unwrap_or_default();
        file.parent() == Some(path) && ends.iter().any(|e| end.eq_ignore_ascii_case(e))
    };
    let is_dicom = |file: &Path| read_start(file).is_some_and(|start| dicom::is_header(&start));
    for (ends, is_tiff) in [(&["tif", "tiff"][..], true), (&["png"], false)] {
        let mut slices: Vec<PathBuf> = files.iter().filter(|f| is_named(f, ends)).cloned().collect();
        // A picture beside a DICOM series is not a slice, and neither is a lone PNG picture.
        let others = || files.iter().filter(|f| f.parent() == Some(path) && !is_named(f, ends));
        let least = if is_tiff { 1 } else { 2 };
        if slices.len() < least || others().filter(|f| is_dicom(f)).count() >= slices.len() {
            continue;
        }
        home.check_all(&slices)?;
        tiff::sort_by_number(&mut slices);
        return Ok(if is_tiff {
            Box::new(tiff::TiffFile::open(slices, path, options)?)
        } else {
            Box::new(png_stack::PngStack::open(slices, path, options)?)
        });
    }
    let (mut empty, mut has_others, mut has_pointers) = (Vec::new(), false, false);
    files.retain(|file| {
        let start = read_start(file).unwrap_or_default();
        let is_dicom = dicom::is_header(&start);
        if start.is_empty() {
            empty.push(file.clone());
        } else if !is_dicom && file.parent() == Some(path) {
            let kind = match sniff::kind_of(&start, file) {
                FileKind::Gzip => {
                    let (inside, name) = packed::inside_gzip(&start, file);
                    sniff::kind_of(&inside, &name)
                }
                kind => kind,
            };
            has_others |= kind.is_whole_volume();
            has_pointers |= kind == FileKind::Other(sniff::LFS_NAME);
        }
        is_dicom
    });
    let unsupported = |found, expected| Err(FormatError::Unsupported { path: shown(path), found, expected });
    // Somebody who opens a folder of volumes does not want a series in a folder below it.
    if has_others && files.iter().all(|file| file.parent() != Some(path)) {
        return unsupported("a folder of volumes", "one of them, or a folder of slices");
    }
    if files.is_empty() && has_pointers {
        return unsupported(
            "a folder of Git LFS pointers",
            "the files themselves, which `git lfs pull` fetches",
        );
    }
    if files.is_empty() {
        return unsupported("a folder without slices", sniff::EXPECTED);
    }
    // Empty files in a folder of slices may be slices that were lost.
    files.extend(empty);
    home.check_all(&files)?;
    dicom::open(files, path, options)
}

/// The first bytes of a file; `None` if it cannot be read.
pub(crate) fn read_start(file: &Path) -> Option<Vec<u8>> {
    let mut start = Vec::new();
    open_file(file).ok()?.take(sniff::SNIFFED_BYTES).read_to_end(&mut start).ok()?;
    Some(start)
}

/// The files in a folder and those below it, sorted and limited in number. Hidden files are left out.
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
        // Links to folders are not followed, because they can form circles.
        if kind.is_dir() && depth < MAX_DEPTH {
            list_files(&path, options, depth + 1, num_folders, files)?;
        } else if kind.is_file() || (kind.is_symlink() && path.is_file()) {
            files.push(path);
        }
    }
    Ok(())
}

/// Opens a regular file. Pipes, sockets and devices are refused, because they have no length and may never end. This
/// never waits for another program, even if the file becomes a pipe meanwhile.
///
/// # Errors
/// It is no regular file, or the system refuses.
pub fn open_file(path: &Path) -> Result<File, FormatError> {
    let io = io_error(path);
    // To open a device may already do something, and a pipe waits for its writer.
    check_is_file(path, &std::fs::metadata(path).map_err(io)?)?;
    let mut options = File::options();
    options.read(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::custom_flags(
        &mut options,
        rustix::fs::OFlags::NONBLOCK.bits().cast_signed(),
    );
    let file = options.open(path).map_err(io)?;
    check_is_file(path, &file.metadata().map_err(io)?)?;
    Ok(file)
}

fn check_is_file(path: &Path, metadata: &Metadata) -> Result<(), FormatError> {
    let refusal = |found| FormatError::Unsupported { path: shown(path), found, expected: "a regular file" };
    kind_but_file(metadata).map_or(Ok(()), |found| Err(refusal(found)))
}

/// What it is, if it is no regular file.
pub(crate) fn kind_but_file(metadata: &Metadata) -> Option<&'static str> {
    let kind = metadata.file_type();
    #[cfg(unix)]
    {
        use std::os::unix::fs::FileTypeExt;
        if kind.is_fifo() {
            return Some("a pipe");
        }
        if kind.is_socket() {
            return Some("a socket");
        }
    }
    match () {
        () if kind.is_file() => None,
        () if kind.is_dir() => Some("a folder"),
        () => Some("a device"),
    }
}

/// The bytes of the regular file at `path`; `None` if there are more than `max_bytes`.
pub(crate) fn read_file(path: &Path, max_bytes: u64) -> Result<Option<Vec<u8>>, FormatError> {
    let mut bytes = Vec::new();
    open_file(path)?.take(max_bytes + 1).read_to_end(&mut bytes).map_err(io_error(path))?;
    Ok((bytes.len() as u64 <= max_bytes).then_some(bytes))
}

/// The text in the regular file at `path`, of at most `max_bytes`.
///
/// # Errors
/// It is no regular file, longer or not UTF-8, or the system refuses.
pub fn read_text(path: &Path, max_bytes: u64) -> Result<String, FormatError> {
    let unsupported =
        |found| FormatError::Unsupported { path: shown(path), found, expected: "a short text in UTF-8" };
    let bytes = read_file(path, max_bytes)?.ok_or_else(|| unsupported("a longer file"))?;
    String::from_utf8(bytes).map_err(|_| unsupported("bytes that are not UTF-8"))
}

/// The last part of a path, for display.
pub(crate) fn file_name(path: &Path) -> String {
    path.file_name().map_or_else(|| shown(path), |name| shown(Path::new(name)))
}

/// Least memory for reading by pages: a coarsest level, some pages, and what is kept of the file.
pub const LEAST_FOR_PAGES: u64 = 128 << 20;
/// 8 GiB: a volume of 2048³ bytes, which about fills a large GPU.
const DEFAULT_MAX_BYTES: u64 = 8 << 30;
/// Most files in a folder.
const MAX_FILES: usize = 1 << 17;
/// Most folders in a folder.
const MAX_FOLDERS: usize = 4096;
/// Greatest depth of a folder.
const MAX_DEPTH: usize = 8;
