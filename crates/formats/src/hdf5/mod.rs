//! HDF5 files: an array of them is a volume, whose axes and values other programs describe (ilastik, Fiji, netCDF-4,
//! NeXus, MATLAB and others). Files of Imaris, BigDataViewer, Chimera and openPMD have several arrays for one image. Only
//! the chunks of the selected part are read.

mod array_plan;
mod bdv;
mod bdv_xml;
mod chimerax;
mod choice;
mod contents;
mod coordinates;
mod dialects;
mod dream3d;
mod emd;
mod heaps;
mod image;
mod imaris;
mod layouts;
mod links;
mod nexus;
mod objects;
mod openpmd;
mod outside;
mod pages;
mod source;
mod storage;

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;

use rayon::prelude::*;

use self::bdv_xml::BdvXml;
use self::choice::{ArrayChoice, Choice, choose};
use self::contents::{ArrayFile, with_contents};
use self::image::ArrayImage;
use self::links::Place;
use self::storage::{Storage, StoredChunk};
use crate::channels::Piece;
use crate::chunk_grid::ChunkGrid;
use crate::collector::Collector;
use crate::error::{FormatError, malformed, quoted, shown};
use crate::foreign::HomeFolder;
use crate::hyperslab::Steps;
use crate::plan::{BoxLevel, Plan, VolumeFile};
use crate::pyramid::warn_of_level;
use crate::source::{OpenOptions, file_name, open_file, read_file};
use crate::warning::WarningKind;

/// A file whose metadata were read.
pub(crate) struct Hdf5File {
    plan: Plan,
    /// The file that has the arrays.
    path: PathBuf,
    /// Other files that say what the arrays are.
    beside: Vec<PathBuf>,
    image: ShownImage,
    most_bytes: u64,
}

/// The arrays of an image.
#[derive(Clone)]
enum ShownImage {
    /// One, at this path within the file.
    Array(String),
    /// One for each channel and point in time of this level.
    Image { image: Arc<ArrayImage>, level: usize },
}

/// Whether `start` begins a file. Other bytes may be before its mark.
pub(crate) fn is_header(start: &[u8]) -> bool {
    [0, 512].iter().any(|at| start.get(*at..).is_some_and(|rest| rest.starts_with(MAGIC)))
}

/// Whether the mark of the plain file at `path` is after other bytes, twice as many as may be at its start.
pub(crate) fn is_after_user_block(path: &Path) -> bool {
    let Ok(mut file) = open_file(path) else { return false };
    let mut has_mark_at = |at: u64| {
        let mut mark = [0; MAGIC.len()];
        file.seek(SeekFrom::Start(at)).is_ok() && file.read_exact(&mut mark).is_ok() && mark == MAGIC
    };
    (10..MOST_USER_BLOCK_BITS).any(|bits| has_mark_at(1 << bits))
}

/// Whether `start` begins a description of BigDataViewer.
pub(crate) fn is_description(start: &[u8]) -> bool {
    let is_xml = start.starts_with(b"<?xml") || start.starts_with(b"<SpimData");
    is_xml && start.windows(SPIM_DATA.len()).any(|word| word == SPIM_DATA)
}

impl Hdf5File {
    /// `file` is the file at `path`. `inside` is an array in it, or a group of arrays.
    pub(crate) fn open(
        file: File,
        path: &Path,
        inside: &str,
        options: &OpenOptions,
    ) -> Result<Self, FormatError> {
        // BigDataViewer keeps its description beside the file.
        let beside = path.with_extension("xml");
        let is_there = inside == "/" && beside != path && beside.is_file();
        let xml = is_there.then(|| read_description(&beside).ok()).flatten();
        let xml = xml.filter(|xml| Path::new(&xml.file).file_name() == path.file_name());
        let beside = xml.is_some().then_some(beside);
        let mut found = Self::open_at((file, path, inside), xml.as_ref(), options, 0)?;
        found.beside.extend(beside);
        Ok(found)
    }

    /// Opens the images that the description of BigDataViewer at `path` is of.
    pub(crate) fn open_description(path: &Path, options: &OpenOptions) -> Result<Self, FormatError> {
        let bad = malformed(path, "BigDataViewer");
        let xml = read_description(path)?;
        if xml.format != "bdv.hdf5" {
            return Err(bad(format!("its images are in {}, expected bdv.hdf5", quoted(&xml.format))));
        }
        let home = HomeFolder::of_header(path, options);
        // A file that was moved along with its description keeps its name.
        let own_name = Path::new(&xml.file).file_name().map(|name| name.to_string_lossy().into_owned());
        let is_absolute = Path::new(&xml.file).is_absolute();
        let file = match home.data_file(&xml.file) {
            Err(_) if is_absolute => home.data_file(&own_name.unwrap_or_default())?,
            found => found?,
        };
        let mut found = Self::open_at((open_file(&file)?, &file, "/"), Some(&xml), options, 0)?;
        found.beside.push(file);
        Ok(found)
    }

    /// Opens a file that `num_hops` links led to.
    fn open_at(
        (file, path, inside): (File, &Path, &str),
        xml: Option<&BdvXml>,
        options: &OpenOptions,
        num_hops: usize,
    ) -> Result<Self, FormatError> {
        let most_bytes = options.max_bytes;
        let (series, cancel) = (options.selection.series, options.cancel);
        let choice = Choice { series, home: HomeFolder::of_header(path, options), xml, cancel };
        let found = with_contents(file, path, |contents| choose(contents, path, inside, &choice))?;
        let (plan, image) = match found {
            ArrayChoice::Array(plan, name) => (*plan, ShownImage::Array(name)),
            ArrayChoice::Image(image) => {
                let level = image.level(path, options)?;
                let mut plan = image.plan(level);
                warn_of_level(&mut plan, options);
                (plan, ShownImage::Image { image: Arc::new(*image), level })
            }
            ArrayChoice::Outside { file, inside, series, usual, warnings } => {
                if num_hops >= MAX_HOPS {
                    let problem = "links to other files lead in a circle";
                    return Err(malformed(path, contents::FORMAT)(problem.into()));
                }
                // The series are those of this file.
                let selection = crate::selection::Selection { series: None, ..options.selection };
                let options = OpenOptions { selection, ..*options };
                let mut found =
                    Self::open_at((open_file(&file)?, &file, &inside), None, &options, num_hops + 1)?;
                let text = format!("the voxels are in the file {}", quoted(&file_name(&file)));
                found.plan.warn(WarningKind::Data, text);
                found.plan.warnings.extend(warnings);
                (found.plan.series, found.plan.usual_series) = (series, usual);
                found.beside.push(file);
                return Ok(found);
            }
        };
        Ok(Self { plan, path: path.to_owned(), beside: Vec::new(), image, most_bytes })
    }
}

/// Reads the description of BigDataViewer at `path`.
fn read_description(path: &Path) -> Result<BdvXml, FormatError> {
    let bad = malformed(path, "BigDataViewer");
    let bytes = read_file(path, MAX_XML_BYTES)?;
    let bytes = bytes.ok_or_else(|| bad(format!("it has more than {MAX_XML_BYTES} bytes")))?;
    BdvXml::from_text(&String::from_utf8_lossy(&bytes)).map_err(bad)
}

impl VolumeFile for Hdf5File {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        let path = &self.path;
        let parts = self.parts(collector);
        let image = match &self.image {
            ShownImage::Array(_) => None,
            ShownImage::Image { image, .. } => Some(&**image),
        };
        let stored = with_contents(open_file(path)?, path, |contents| {
            let storage = |(channel, name): &(usize, String)| {
                let found = part_storage(contents, name, (&self.plan, image), self.most_bytes)?;
                Ok(found.map(|storage| (*channel, storage)))
            };
            let found = parts.iter().map(storage).collect::<Result<Vec<_>, String>>();
            found.map_err(malformed(path, &self.plan.format))
        })?;
        let stored: Vec<(usize, Storage)> = stored.into_iter().flatten().collect();
        if stored.len() < parts.len() {
            let num = parts.len() - stored.len();
            let text = format!("arrays not found: {num} of {}, shown as zero", parts.len());
            collector.warn(WarningKind::Data, text);
        }
        let zero = vec![0; self.plan.dtype.num_bytes()];
        collector.fill(stored.first().map_or(&zero, |(_, storage)| &storage.fill))?;
        for (channel, storage) in &stored {
            self.read_array(storage, *channel, collector)?;
        }
        Ok(())
    }

    fn is_chunked(&self) -> bool {
        true
    }

    fn data_files(&self) -> Vec<PathBuf> {
        self.beside.clone()
    }

    fn boxes(&self, path: &Path) -> Result<Vec<BoxLevel>, FormatError> {
        pages::levels(self, path)
    }

    fn finest_level(&self) -> Option<Box<dyn VolumeFile>> {
        let ShownImage::Image { image, level: 1.. } = &self.image else { return None };
        let (plan, path, beside) = (image.plan(0), self.path.clone(), self.beside.clone());
        let image = ShownImage::Image { image: Arc::clone(image), level: 0 };
        Some(Box::new(Self { plan, path, beside, image, most_bytes: self.most_bytes }))
    }
}

impl Hdf5File {
    /// The arrays that are read, and the channel that each is, counted from the first that is read.
    fn parts(&self, collector: &Collector) -> Vec<(usize, String)> {
        match &self.image {
            ShownImage::Array(path) => vec![(0, path.clone())],
            ShownImage::Image { image, level } => {
                let [.., channels, time] = collector.selected() else { return Vec::new() };
                let time = time.range.start as usize;
                let name = |channel| image.names().path(*level, time, channel as usize);
                channels.range.clone().map(name).enumerate().collect()
            }
        }
    }

    fn read_array(
        &self,
        storage: &Storage,
        channel: usize,
        collector: &mut Collector,
    ) -> Result<(), FormatError> {
        let is_array = matches!(self.image, ShownImage::Array(_));
        let channel_axis = collector.channel_axis().filter(|_| is_array);
        let grid = grid_of(storage, collector.selected(), channel_axis, channel);
        let grid = ChunkGrid { is_raw: collector.is_raw(), ..grid };
        grid.check_sizes(collector, &self.path, self.most_bytes)?;
        let cancel = collector.cancel();
        let pieces = |chunk: &StoredChunk| -> Result<Vec<Piece>, FormatError> {
            if cancel.is_some_and(|cancel| cancel.load(Ordering::Relaxed)) {
                return Err(FormatError::Cancelled { path: shown(&self.path) });
            }
            let bytes = storage.bytes(chunk).map_err(|problem| damaged(&self.path, problem))?;
            grid.pieces(&chunk.start, &bytes, &self.path)
        };
        let (mut num, mut num_absent, mut chunks) = (0u64, 0u64, Vec::new());
        for start in storage.starts(&grid.ranges()) {
            let chunk = storage.chunk(&start);
            num += 1;
            num_absent += u64::from(chunk.is_none());
            chunks.extend(chunk.filter(|_| grid.num_within(&start) > 0));
        }
        for batch in chunks.chunks(grid.num_at_once()) {
            let found = batch.par_iter().map(pieces).collect::<Result<Vec<_>, _>>()?;
            let num_passed = batch.iter().map(|chunk| grid.num_within(&chunk.start)).sum();
            collector.place(found.into_iter().flatten().collect(), num_passed)?;
        }
        if num_absent > 0 {
            let text =
                format!("chunks not found: {num_absent} of {num}, shown as the fill value of the array");
            collector.warn(WarningKind::Data, text);
        }
        Ok(())
    }
}

/// How the array at `name` is stored, which is as `plan` says; `None` if it is a part of `image` that is not there.
fn part_storage(
    contents: &ArrayFile,
    name: &str,
    (plan, image): (&Plan, Option<&ArrayImage>),
    most_bytes: u64,
) -> Result<Option<Storage>, String> {
    if image.is_some() && contents.resolve(name).is_err() {
        return Ok(None);
    }
    if let Ok(Place::Elsewhere(link)) = contents.resolve(name) {
        return Err(format!("{} is in the file {}, expected all in one", quoted(name), quoted(&link.file)));
    }
    let mut storage = Storage::of(contents, &contents.array(name)?, most_bytes)?;
    if let Some(image) = image {
        storage.dtype = image.names().dtype(storage.dtype);
    }
    let mut sizes = storage.shape.iter().rev().zip(&plan.axes);
    let fits = storage.shape.len() <= plan.axes.len() && sizes.all(|(stored, axis)| *stored >= axis.size);
    if !fits || (storage.dtype, storage.endian) != (plan.dtype, plan.endian) {
        return Err(format!("{} is unlike the others", quoted(name)));
    }
    Ok(Some(storage))
}

/// The grid of an array. `selected` and `channel_axis` are those of the plan.
fn grid_of<'a>(
    storage: &'a Storage,
    selected: &[Steps],
    channel_axis: Option<usize>,
    channel: usize,
) -> ChunkGrid<'a> {
    let num_axes = storage.shape.len();
    ChunkGrid {
        sides: &storage.sides,
        order: &storage.order,
        dtype: storage.dtype,
        endian: storage.endian,
        selected: selected.iter().take(num_axes).rev().cloned().collect(),
        channel_axis: channel_axis.map(|axis| num_axes - 1 - axis),
        channel,
        num_more_axes: selected.len() - num_axes,
        is_raw: false,
    }
}

/// The error that a chunk of the file at `path` cannot be decoded.
fn damaged(path: &Path, problem: String) -> FormatError {
    FormatError::Data { path: shown(path), problem: format!("chunk: {problem}") }
}

const MAGIC: &[u8] = b"\x89HDF\r\n\x1a\n";
const SPIM_DATA: &[u8] = b"<SpimData";
/// The longest user block has 2 to this number of bytes, less one.
const MOST_USER_BLOCK_BITS: u32 = 31;
/// Most links to other files on the way to an array.
const MAX_HOPS: usize = 8;
/// Longest description.
const MAX_XML_BYTES: u64 = 16 << 20;
