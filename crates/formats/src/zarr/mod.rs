//! OME-Zarr 0.1 to 0.5 (ngff.openmicroscopy.org) on Zarr 2 and 3: pyramids of chunked arrays, and single arrays. Only
//! the selected level and region are read.

mod array;
mod blosc;
mod codec;
mod json;
mod multiscale;

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::Path;

use self::array::{Array, Shard};
use self::multiscale::Multiscale;
use crate::collector::Collector;
use crate::dtype::Dtype;
use crate::error::{FormatError, io_error, malformed, not_there};
use crate::foreign::HomeFolder;
use crate::plan::{Plan, VolumeFile};
use crate::source::OpenOptions;
use crate::warning::WarningKind;

pub(crate) struct ZarrImage {
    plan: Plan,
    array: Array,
    most_bytes: u64,
    home: HomeFolder,
}

/// Whether a folder is an array or a group of arrays.
pub(crate) fn is_group(path: &Path) -> bool {
    METADATA.iter().any(|name| path.join(name).is_file())
}

/// Refuses links out of the folder that was opened.
fn check_metadata(home: &HomeFolder, folder: &Path) -> Result<(), FormatError> {
    METADATA.iter().try_for_each(|name| home.check(&folder.join(name)))
}

impl ZarrImage {
    /// Opens the group or array in the folder `path`.
    pub(crate) fn open(path: &Path, options: &OpenOptions) -> Result<Self, FormatError> {
        let bad = malformed(path, "OME-Zarr");
        let home = HomeFolder::of_folder(path, options);
        check_metadata(&home, path)?;
        let mut image = path.to_owned();
        let mut series = Vec::new();
        let mut found = Multiscale::read(path)?;
        if found.is_none() {
            // bioformats2raw puts each image into its own group.
            series = (0..MAX_SERIES).map(|i| i.to_string()).take_while(|i| is_group(&path.join(i))).collect();
            let index = options.selection.series.unwrap_or(0) as usize;
            if let Some(name) = series.get(index) {
                image = path.join(name);
                check_metadata(&home, &image)?;
                found = Multiscale::read(&image)?;
            } else if !series.is_empty() {
                return Err(not_there(path, "series", index as u64, series.len()));
            }
        }
        let Some(multiscale) = found else {
            return Err(bad("found no image in its attributes, expected multiscales".into()));
        };
        let mut arrays = Vec::new();
        for level in &multiscale.levels {
            options.check_cancelled(path)?;
            check_metadata(&home, &image.join(&level.path))?;
            arrays.push(Array::read(&image.join(&level.path))?);
        }
        let level = match options.selection.level {
            Some(level) if level as usize >= arrays.len() => {
                return Err(not_there(path, "level", level.into(), arrays.len()));
            }
            Some(level) => level as usize,
            None if options.selection.region.is_some() => 0,
            None => arrays.iter().position(|a| fits(a, &multiscale, options)).unwrap_or(arrays.len() - 1),
        };
        let mut plan = multiscale.plan(&arrays, level).map_err(bad)?;
        if level > 0 && options.selection.level.is_none() {
            let text = format!(
                "level {level} of {} is shown, the finest that fits into memory and a texture",
                arrays.len()
            );
            plan.warn(WarningKind::Choice, text);
        }
        if series.len() > 1 {
            if options.selection.series.is_none() {
                plan.warn(
                    WarningKind::Choice,
                    format!("the group has {} images, of which 0 is shown", series.len()),
                );
            }
            plan.series = series;
        }
        Ok(Self { plan, array: arrays.swap_remove(level), most_bytes: options.max_bytes, home })
    }
}

/// Whether a channel of a level can be shown as a whole.
fn fits(array: &Array, multiscale: &Multiscale, options: &OpenOptions) -> bool {
    let dims = multiscale.space_of(&array.shape);
    let max_side = u64::from(isinglass_core::volume::Volume::MAX_SIDE);
    let count = dims.iter().try_fold(array.dtype.num_bytes_in_memory() as u64, |n, d| n.checked_mul(*d));
    dims.iter().all(|d| *d <= max_side) && count.is_some_and(|n| n <= options.max_bytes)
}

impl VolumeFile for ZarrImage {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn read(&mut self, collector: &mut Collector) -> Result<(), FormatError> {
        let array = &self.array;
        let num_axes = array.shape.len();
        // The slowest axis comes first, as in chunks. The plan of a plane has one axis more than its array.
        let mut selected: Vec<Range<u64>> = collector.ranges().iter().take(num_axes).rev().cloned().collect();
        let chunks = |range: &Range<u64>, side: u64| range.start / side..range.end.div_ceil(side);
        let grid: Vec<Range<u64>> = selected.iter().zip(&array.chunk).map(|(r, &n)| chunks(r, n)).collect();
        let inner = array.shard.as_ref().map_or(&array.chunk, |s| &s.chunk);
        let num_chunks = selected.iter().zip(inner).try_fold(1u64, |n, (r, &side)| {
            let range = chunks(r, side);
            n.checked_mul(range.end - range.start)
        });
        let bytes_of = |sides: &[u64]| sides.iter().product::<u64>() * array.dtype.num_bytes() as u64;
        if num_chunks.is_none_or(|n| n > MAX_CHUNKS) || bytes_of(inner) > self.most_bytes {
            let problem = format!(
                "{} chunks of {} bytes, expected fewer or smaller ones",
                num_chunks.unwrap_or(u64::MAX),
                bytes_of(inner)
            );
            return Err(collector.data_error(&array.path, problem));
        }
        // Each step reads one layer of chunks along the slowest axis with more than one number.
        let axis = selected.iter().position(|r| r.end - r.start > 1).unwrap_or(0);
        let whole = selected[axis].clone();
        let (mut num_files, mut num_absent) = (0u64, 0u64);
        for layer in grid[axis].clone() {
            let side = array.chunk[axis];
            selected[axis] = whole.start.max(layer * side)..whole.end.min((layer + 1) * side);
            let mut slab = Slab::new(&selected, array.dtype, &array.fill);
            let mut here = grid.clone();
            here[axis] = layer..layer + 1;
            let mut index: Vec<u64> = here.iter().map(|r| r.start).collect();
            loop {
                collector.tick()?;
                num_files += 1;
                num_absent += u64::from(!self.chunk(&index, &mut slab, collector)?);
                if !next_index(&mut index, &here) {
                    break;
                }
            }
            collector.push_selected(&slab.bytes)?;
        }
        if num_absent > 0 {
            let hint = if num_absent == num_files { "; is the dimension separator right?" } else { "" };
            let text = format!(
                "chunks not found: {num_absent} of {num_files}, shown as the fill value of the array{hint}"
            );
            collector.warn(WarningKind::Data, text);
        }
        Ok(())
    }
}

impl ZarrImage {
    /// Copies the selected part of a chunk or shard into `slab`. Returns whether its file is there.
    fn chunk(&self, index: &[u64], slab: &mut Slab, collector: &Collector) -> Result<bool, FormatError> {
        let array = &self.array;
        let path = array.chunk_path(index);
        self.home.check(&path)?;
        let mut file = match File::open(&path) {
            Ok(file) => file,
            // Chunks that are not stored have the fill value, which is in the slab already.
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(false),
            Err(e) => return Err(io_error(&path)(e)),
        };
        let io = io_error(&path);
        let length = file.metadata().map_err(&io)?;
        if !length.is_file() {
            return Err(collector.data_error(&path, "a chunk is no file"));
        }
        let length = length.len();
        let start: Vec<u64> = index.iter().zip(&array.chunk).map(|(i, n)| i * n).collect();
        let damaged = |problem: String| collector.data_error(&path, format!("chunk: {problem}"));
        let mut part =
            |file: &mut File, at: u64, size: u64, start: &[u64], sides: &[u64]| -> Result<(), FormatError> {
                if at.checked_add(size).is_none_or(|end| end > length) {
                    return Err(damaged(format!("it ends at {at} + {size} of {length} bytes")));
                }
                let mut bytes = Vec::new();
                file.seek(SeekFrom::Start(at)).map_err(&io)?;
                Read::by_ref(file).take(size).read_to_end(&mut bytes).map_err(&io)?;
                let num_bytes = sides.iter().product::<u64>() as usize * array.dtype.num_bytes();
                let bytes = array.codecs.decode(bytes, num_bytes).map_err(damaged)?;
                slab.put(&bytes, start, sides, &array.codecs.order);
                Ok(())
            };
        let Some(shard) = &array.shard else {
            return part(&mut file, 0, length, &start, &array.chunk).map(|()| true);
        };
        let inner: Vec<Range<u64>> = array.chunk.iter().zip(&shard.chunk).map(|(n, m)| 0..n / m).collect();
        let table = index_of(&mut file, length, &inner, shard)
            .map_err(|problem| collector.data_error(&path, problem))?;
        let mut at: Vec<u64> = vec![0; inner.len()];
        for entry in table {
            let first: Vec<u64> = (0..at.len()).map(|i| start[i] + at[i] * shard.chunk[i]).collect();
            let is_wanted = self.overlaps(&first, &shard.chunk, collector);
            let (offset, size) = entry;
            if is_wanted && (offset, size) != (u64::MAX, u64::MAX) {
                part(&mut file, offset, size, &first, &shard.chunk)?;
            }
            next_index(&mut at, &inner);
        }
        Ok(true)
    }

    /// Whether a box overlaps the selection.
    fn overlaps(&self, start: &[u64], sides: &[u64], collector: &Collector) -> bool {
        let selected = collector.ranges().iter().take(start.len()).rev();
        selected.zip(start.iter().zip(sides)).all(|(r, (s, n))| *s < r.end && s + n > r.start)
    }
}

/// Offsets and lengths of the chunks in a shard.
fn index_of(
    file: &mut File,
    length: u64,
    inner: &[Range<u64>],
    shard: &Shard,
) -> Result<Vec<(u64, u64)>, String> {
    let count = inner.iter().try_fold(1u64, |n, r| n.checked_mul(r.end)).filter(|n| *n <= length / 16);
    let count = count.ok_or("a shard is shorter than its index")?;
    let size = 16 * count + if shard.has_checksum { 4 } else { 0 };
    let at = if shard.is_index_first {
        0
    } else {
        length.checked_sub(size).ok_or("a shard is shorter than its index")?
    };
    let mut bytes = Vec::new();
    file.seek(SeekFrom::Start(at)).map_err(|e| e.to_string())?;
    Read::by_ref(file).take(size).read_to_end(&mut bytes).map_err(|e| e.to_string())?;
    let (index, sum) =
        bytes.split_at_checked(16 * count as usize).ok_or("a shard is shorter than its index")?;
    if shard.has_checksum && sum != codec::crc32c(index).to_le_bytes() {
        return Err("the index of a shard does not match its checksum".into());
    }
    let words = index.as_chunks::<8>().0;
    Ok(words
        .as_chunks::<2>()
        .0
        .iter()
        .map(|[a, b]| (u64::from_le_bytes(*a), u64::from_le_bytes(*b)))
        .collect())
}

/// Moves to the next index, the last axis first. Returns `false` after the last.
fn next_index(index: &mut [u64], ranges: &[Range<u64>]) -> bool {
    for (i, range) in index.iter_mut().zip(ranges).rev() {
        *i += 1;
        if *i < range.end {
            return true;
        }
        *i = range.start;
    }
    false
}

/// A box of numbers that chunks are copied into, the last axis fastest.
struct Slab {
    ranges: Vec<Range<u64>>,
    bytes: Vec<u8>,
    size: usize,
}

impl Slab {
    fn new(ranges: &[Range<u64>], dtype: Dtype, fill: &[u8]) -> Self {
        let count = ranges.iter().map(|r| (r.end - r.start) as usize).product::<usize>();
        let bytes =
            if fill.iter().all(|b| *b == 0) { vec![0; count * fill.len()] } else { fill.repeat(count) };
        Self { ranges: ranges.to_vec(), bytes, size: dtype.num_bytes() }
    }

    /// Copies the overlap with a chunk of these sides at `start`. Its axes are in `order`, the slowest first.
    fn put(&mut self, chunk: &[u8], start: &[u64], sides: &[u64], order: &[usize]) {
        let num_axes = sides.len();
        let mut strides = vec![0; num_axes];
        let mut stride = 1;
        for &axis in order.iter().rev() {
            strides[axis] = stride;
            stride *= sides[axis] as usize;
        }
        let overlap: Vec<Range<u64>> = self
            .ranges
            .iter()
            .zip(start.iter().zip(sides))
            .map(|(r, (s, n))| r.start.max(*s)..r.end.min(s + n))
            .collect();
        if overlap.iter().any(|r| r.is_empty()) {
            return;
        }
        let last = num_axes - 1;
        let run = (overlap[last].end - overlap[last].start) as usize;
        let mut index: Vec<u64> = overlap.iter().map(|r| r.start).collect();
        let mut rows = overlap.clone();
        rows[last] = overlap[last].start..overlap[last].start + 1;
        loop {
            let from: usize = (0..num_axes).map(|i| (index[i] - start[i]) as usize * strides[i]).sum();
            let to = (0..num_axes).fold(0, |at, i| {
                at * (self.ranges[i].end - self.ranges[i].start) as usize
                    + (index[i] - self.ranges[i].start) as usize
            });
            let size = self.size;
            let row = &mut self.bytes[to * size..(to + run) * size];
            if strides[last] == 1 {
                row.copy_from_slice(&chunk[from * size..(from + run) * size]);
            } else {
                for (i, number) in row.chunks_exact_mut(size).enumerate() {
                    let at = (from + i * strides[last]) * size;
                    number.copy_from_slice(&chunk[at..at + size]);
                }
            }
            if !next_index(&mut index, &rows) {
                break;
            }
        }
    }
}

/// The files that describe arrays and groups.
const METADATA: [&str; 4] = [".zattrs", ".zgroup", ".zarray", "zarr.json"];
/// Most images of a group.
const MAX_SERIES: usize = 4096;
/// Most chunks of a volume.
const MAX_CHUNKS: u64 = 1 << 22;
