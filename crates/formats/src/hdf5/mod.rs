//! HDF5 files: an array of them is a volume, whose axes and values other programs describe (ilastik, Fiji, netCDF-4).
//! Imaris files have several arrays for one image. Only the chunks of the selected part are read.

mod array_plan;
mod contents;
mod coordinates;
mod imaris;
mod source;
mod storage;

use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use rayon::prelude::*;

use self::contents::{ArrayFile, FORMAT, Listed, with_contents};
use self::coordinates::Scales;
use self::imaris::Imaris;
use self::storage::Storage;
use crate::channels::Piece;
use crate::chunk_grid::{ChunkGrid, covering};
use crate::collector::Collector;
use crate::error::{FormatError, malformed, not_there, shown};
use crate::plan::{Plan, VolumeFile};
use crate::pyramid::warn_of_level;
use crate::source::{OpenOptions, open_file};
use crate::warning::WarningKind;

/// A file whose metadata were read.
pub(crate) struct Hdf5File {
    plan: Plan,
    path: PathBuf,
    image: ShownImage,
    most_bytes: u64,
}

/// The arrays of an image.
enum ShownImage {
    /// One, at this path within the file.
    Array(String),
    /// One for each channel and point in time of this level.
    Imaris {
        level: usize,
        /// The plan of the finest level, if this is another one.
        finest: Option<Box<Plan>>,
    },
}

/// Whether `start` begins a file. Other bytes may be before its mark.
pub(crate) fn is_header(start: &[u8]) -> bool {
    [0, 512].iter().any(|at| start.get(*at..).is_some_and(|rest| rest.starts_with(MAGIC)))
}

impl Hdf5File {
    /// `file` is the file at `path`. `inside` is an array in it, or a group of arrays.
    pub(crate) fn open(
        file: File,
        path: &Path,
        inside: &str,
        options: &OpenOptions,
    ) -> Result<Self, FormatError> {
        let (selected, cancel) = (options.selection.series, options.cancel);
        let found = with_contents(file, path, |contents| {
            if inside == "/" && imaris::is_imaris(contents) {
                return Imaris::read(contents).map(Found::Imaris).map_err(malformed(path, "Imaris"));
            }
            open_array(contents, path, inside, (selected, cancel))
        })?;
        let (mut plan, image) = match found {
            Found::Array(plan, name) => (*plan, ShownImage::Array(name)),
            Found::Imaris(found) => {
                let level = found.level(path, options)?;
                let finest = (level > 0).then(|| Box::new(found.clone().plan(0)));
                (found.plan(level), ShownImage::Imaris { level, finest })
            }
        };
        warn_of_level(&mut plan, options);
        Ok(Self { plan, path: path.to_owned(), image, most_bytes: options.max_bytes })
    }
}

/// What was found in a file.
enum Found {
    /// The plan of an array, and its path.
    Array(Box<Plan>, String),
    Imaris(Imaris),
}

/// Chooses an array at `inside` or below it: the one that is `selected`, or the largest.
fn open_array(
    contents: &ArrayFile,
    path: &Path,
    inside: &str,
    (selected, cancel): (Option<u32>, Option<&AtomicBool>),
) -> Result<Found, FormatError> {
    let bad = malformed(path, FORMAT);
    let all = contents.arrays("/", path, cancel)?;
    let is_inside = |array: &&Listed| {
        let rest = array.path.strip_prefix(inside.trim_end_matches('/'));
        rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
    };
    let own: Vec<&Listed> = all.iter().filter(is_inside).collect();
    let scales = Scales::of(&all);
    let sides = |sizes: &[u64]| sizes.iter().filter(|n| **n > 1).count();
    let volumes: Vec<(Vec<u64>, &Listed)> =
        own.iter().filter_map(|array| Some((array_plan::sizes(array, &scales).ok()?, *array))).collect();
    // Planes are volumes only where there is nothing else.
    let most_sides = volumes.iter().map(|(sizes, _)| sides(sizes)).max().unwrap_or(0);
    let is_one = |(sizes, _): &(Vec<u64>, &Listed)| most_sides > 1 && sides(sizes) == most_sides;
    let volumes: Vec<(Vec<u64>, &Listed)> = volumes.into_iter().filter(is_one).collect();
    if volumes.is_empty() {
        return Err(bad(nothing_to_show(inside, &own, &scales)));
    }
    let num_voxels = |i: usize| volumes[i].0.iter().fold(1u64, |n, side| n.saturating_mul(*side));
    let usual = (0..volumes.len())
        .rev()
        .max_by_key(|&i| (!scales.is_auxiliary(volumes[i].1), num_voxels(i)))
        .unwrap_or(0);
    let names: Vec<String> = volumes.iter().map(|(_, array)| array.description()).collect();
    let index = selected.map_or(usual, |i| i as usize);
    let Some((_, array)) = volumes.get(index) else {
        return Err(not_there(path, "series", index as u64, volumes.len()));
    };
    let mut plan = array_plan::plan(contents, array, &scales).map_err(bad)?;
    storage::check(array).map_err(bad)?;
    if names.len() > 1 {
        if selected.is_none() {
            let text = format!(
                "the file has {} arrays, of which the largest is shown: {}",
                names.len(),
                names[index]
            );
            plan.warn(WarningKind::Choice, text);
        }
        plan.series = names;
        plan.usual_series = usual as u32;
    }
    Ok(Found::Array(Box::new(plan), array.path.clone()))
}

/// Why nothing in a file is a volume.
fn nothing_to_show(inside: &str, own: &[&Listed], scales: &Scales) -> String {
    if let [array] = own {
        return match array_plan::sizes(array, scales) {
            Err(problem) => problem,
            Ok(_) => format!("{} is not even a plane", array.description()),
        };
    }
    let listed = own.iter().take(MAX_NAMED).map(|array| array.description()).collect::<Vec<_>>().join(", ");
    match own.is_empty() {
        true if inside == "/" => {
            "it has no arrays of its own, expected a volume; links to other files are not followed".into()
        }
        true => format!("it has no arrays at {}", crate::error::quoted(inside)),
        false => format!(
            "it has no volume, expected an array of numbers with two or three axes in space; it has {listed}"
        ),
    }
}

impl VolumeFile for Hdf5File {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        let path = &self.path;
        let parts = self.parts(collector);
        let first = self.plan.axes.iter().map(|axis| axis.size);
        let stored = with_contents(open_file(path)?, path, |contents| {
            let storage = |(channel, name): &(usize, String)| {
                let array = contents.array(name)?;
                Ok((*channel, Storage::of(contents, &array, self.most_bytes)?))
            };
            let found = parts.iter().map(storage).collect::<Result<Vec<_>, String>>();
            found.map_err(malformed(path, &self.plan.format))
        })?;
        let dims: Vec<u64> = first.collect();
        for (n, (channel, storage)) in stored.iter().enumerate() {
            let fits = storage.shape.iter().rev().zip(&dims).all(|(stored, dim)| stored >= dim);
            if !fits || (storage.dtype, storage.endian) != (self.plan.dtype, self.plan.endian) {
                let problem = format!("{} is unlike the others", crate::error::quoted(&storage.path));
                return Err(collector.data_error(path, problem));
            }
            if n == 0 {
                collector.fill(&storage.fill)?;
            }
            self.read_array(storage, *channel, collector)?;
        }
        Ok(())
    }

    fn is_chunked(&self) -> bool {
        true
    }

    fn finest_level(&self) -> Option<Box<dyn VolumeFile>> {
        let ShownImage::Imaris { finest: Some(plan), .. } = &self.image else { return None };
        let image = ShownImage::Imaris { level: 0, finest: None };
        let (plan, path) = (Plan::clone(plan), self.path.clone());
        Some(Box::new(Self { plan, path, image, most_bytes: self.most_bytes }))
    }
}

impl Hdf5File {
    /// The arrays that are read, and the channel that each is, counted from the first that is read.
    fn parts(&self, collector: &Collector) -> Vec<(usize, String)> {
        match &self.image {
            ShownImage::Array(path) => vec![(0, path.clone())],
            ShownImage::Imaris { level, .. } => {
                let [.., channels, time] = collector.selected() else { return Vec::new() };
                let time = time.range.start as usize;
                let name = |channel| imaris::array_path(*level, time, channel as usize);
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
        let num_axes = storage.shape.len();
        let is_array = matches!(self.image, ShownImage::Array(_));
        let grid = ChunkGrid {
            sides: &storage.sides,
            order: &storage.order,
            dtype: storage.dtype,
            endian: storage.endian,
            selected: collector.selected().iter().take(num_axes).rev().cloned().collect(),
            channel_axis: collector.channel_axis().filter(|_| is_array).map(|axis| num_axes - 1 - axis),
            channel,
            num_more_axes: collector.selected().len() - num_axes,
            is_raw: collector.is_raw(),
        };
        grid.check_sizes(collector, &self.path, self.most_bytes)?;
        let chunks = storage.chunks(|start| start.len() == num_axes && grid.num_within(start) > 0);
        let cancel = collector.cancel();
        let pieces = |chunk: &storage::StoredChunk| -> Result<Vec<Piece>, FormatError> {
            if cancel.is_some_and(|cancel| cancel.load(Ordering::Relaxed)) {
                return Err(FormatError::Cancelled { path: shown(&self.path) });
            }
            let bytes = storage.bytes(chunk).map_err(|problem| FormatError::Data {
                path: shown(&self.path),
                problem: format!("chunk: {problem}"),
            })?;
            grid.pieces(&chunk.start, &bytes, &self.path)
        };
        for batch in chunks.chunks(grid.num_at_once()) {
            let found = batch.par_iter().map(pieces).collect::<Result<Vec<_>, _>>()?;
            let num_passed = batch.iter().map(|chunk| grid.num_within(&chunk.start)).sum();
            collector.place(found.into_iter().flatten().collect(), num_passed)?;
        }
        let num = grid.selected.iter().zip(&storage.sides).map(|(steps, side)| covering(&steps.range, *side));
        let num: u64 = num.map(|range| range.end - range.start).product();
        let num_absent = num.saturating_sub(chunks.len() as u64);
        if num_absent > 0 {
            let text =
                format!("chunks not found: {num_absent} of {num}, shown as the fill value of the array");
            collector.warn(WarningKind::Data, text);
        }
        Ok(())
    }
}

const MAGIC: &[u8] = b"\x89HDF\r\n\x1a\n";
/// Most arrays in a message.
const MAX_NAMED: usize = 8;
