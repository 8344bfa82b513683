//! Reads the chunks of an array on several threads, and puts their numbers in place.

use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use rayon::prelude::*;

use super::array::{Array, Shard};
use super::boxes::SharedChunks;
use super::store::{Part, Store};
use crate::channels::{ChannelSinks, Piece, StreamShape};
use crate::chunk_grid::{ChunkGrid, MAX_CHUNKS, covering, next_index, place_chunk};
use crate::collector::Collector;
use crate::decode::VoxelSink;
use crate::dtype::numbers_from_bytes;
use crate::error::{FormatError, io_error, shown};
use crate::hyperslab::Steps;
use crate::unpack::crc32c;
use crate::warning::WarningKind;

/// The selected part of an array.
pub(super) struct Chunks<'a> {
    array: &'a Array,
    store: &'a Store,
    /// The chunks that are decoded: those within shards, if there are shards.
    grid: ChunkGrid<'a>,
    cancel: Option<&'a AtomicBool>,
    /// The level, and what is kept of all levels.
    shared: Option<(usize, &'a SharedChunks)>,
}

/// Files of chunks or shards.
#[derive(Clone, Copy, Default)]
struct FileCounts {
    met: u64,
    absent: u64,
}

/// The decoded bytes of a chunk; `None` if its file is absent.
pub(super) type ReadChunk = Option<Arc<Vec<u8>>>;

/// A chunk in a file.
struct Located {
    path: PathBuf,
    part: Part,
    /// Its first number along each axis.
    start: Vec<u64>,
}

/// Reads all that is selected of `array`. A chunk may have at most `most_bytes`.
pub(super) fn read_chunks(
    array: &Array,
    store: &Store,
    collector: &mut Collector,
    most_bytes: u64,
) -> Result<(), FormatError> {
    let is_raw = collector.is_raw();
    let grid = ChunkGrid { is_raw, ..grid_of(array, collector.selected(), collector.channel_axis()) };
    grid.check_sizes(collector, &array.path, most_bytes)?;
    Chunks { array, store, grid, cancel: collector.cancel(), shared: None }.read_all(collector)
}

/// All numbers of a short array with one axis or two, the last one fastest, as coordinates are; `None` if it is long, or
/// cannot be read.
pub(super) fn short_numbers(array: &Array, store: &Store) -> Option<Vec<f64>> {
    let count = array.shape.iter().try_fold(1u64, |n, side| n.checked_mul(*side))?;
    if array.shape.len() > 2 || count > MAX_SHORT || array.chunk_bytes() > MAX_SHORT * 8 {
        return None;
    }
    let selected: Vec<Steps> = array.shape.iter().rev().map(|n| Steps::all(0..*n)).collect();
    let grid = grid_of(array, &selected, None);
    let chunks = Chunks { array, store, grid, cancel: None, shared: None };
    let size = array.dtype.num_bytes();
    let mut all = array.fill.repeat(count as usize);
    let placed = chunks.for_batches(|batch, _| {
        for chunk in batch {
            // Chunks with another order of their axes are rare, and such coordinates are left out.
            if let Some(bytes) = chunks.decoded(&chunk)?.filter(|_| array.codecs.order.is_sorted()) {
                place_chunk(&mut all, &array.shape, (&chunk.start, array.sides()), &bytes, size);
            }
        }
        Ok(())
    });
    placed.ok()?;
    Some(numbers_from_bytes(&all, array.dtype, array.codecs.endian))
        .filter(|_| array.codecs.order.is_sorted())
}

/// The warning about files of chunks that are not there.
pub(super) fn absent_text(num_absent: u64, num_files: u64) -> String {
    let hint = if num_absent == num_files { "; is the dimension separator right?" } else { "" };
    format!("chunks not found: {num_absent} of {num_files}, shown as the fill value of the array{hint}")
}

/// The grid of an array. `selected` and `channel_axis` are those of the plan.
fn grid_of<'a>(array: &'a Array, selected: &[Steps], channel_axis: Option<usize>) -> ChunkGrid<'a> {
    let num_axes = array.shape.len();
    ChunkGrid {
        sides: array.sides(),
        order: &array.codecs.order,
        dtype: array.dtype,
        endian: array.codecs.endian,
        // The plan of a plane has one axis more than its array.
        selected: selected.iter().take(num_axes).rev().cloned().collect(),
        channel_axis: channel_axis.map(|axis| num_axes - 1 - axis),
        channel: 0,
        num_more_axes: selected.len() - num_axes,
        is_raw: false,
    }
}

impl<'a> Chunks<'a> {
    /// The chunks of a box, for which `selected` has the axes of the plan. `shared` has the level.
    pub(super) fn of_box(
        array: &'a Array,
        store: &'a Store,
        selected: &[Steps],
        channel_axis: Option<usize>,
        shared: (usize, &'a SharedChunks),
    ) -> Self {
        let grid = grid_of(array, selected, channel_axis);
        Self { array, store, grid, cancel: None, shared: Some(shared) }
    }

    fn read_all(&self, collector: &mut Collector) -> Result<(), FormatError> {
        let (mut num_files, mut num_absent) = (0, 0);
        collector.fill(&self.array.fill)?;
        self.for_batches(|batch, in_files| {
            num_files += in_files.met;
            num_absent += in_files.absent + self.read_batch(&batch, collector)?;
            collector.tick()
        })?;
        if num_absent > 0 {
            collector.warn(WarningKind::Data, absent_text(num_absent, num_files));
        }
        Ok(())
    }

    /// The numbers of a box of one channel. `selected` and `channel_axis` are those of the plan.
    pub(super) fn read_box(
        &self,
        selected: &[Steps],
        channel_axis: Option<usize>,
    ) -> Result<VoxelSink, FormatError> {
        let array = self.array;
        let files = self.grid.selected.iter().zip(&array.chunk).map(|(s, &side)| covering(&s.range, side));
        let num_files = files.fold(1u64, |n, range| n.saturating_mul(range.end - range.start));
        if num_files > MAX_CHUNKS {
            let problem = format!("{num_files} chunks at once, expected at most {MAX_CHUNKS}");
            return Err(FormatError::Data { path: shown(&array.path), problem });
        }
        let no_memory = || io_error(&array.path)(std::io::ErrorKind::OutOfMemory.into());
        let num_voxels = selected.iter().map(Steps::len).product::<u64>() as usize;
        let (dtype, endian) = (array.dtype, array.codecs.endian);
        let shape = StreamShape { dtype, endian, selected, channel_axis, num_channels: 1, num_voxels };
        let mut sinks = ChannelSinks::new(&shape, Some(&array.fill)).map_err(|_| no_memory())?;
        self.for_batches(|batch, _| {
            let in_turn = || batch.iter().map(|chunk| self.pieces(chunk)).collect::<Result<Vec<_>, _>>();
            let at_once = || batch.par_iter().map(|chunk| self.pieces(chunk)).collect::<Result<Vec<_>, _>>();
            let found = match self.store {
                Store::Folder(_) if batch.len() <= FEW_CHUNKS => in_turn()?,
                store => store.on_threads(at_once)?,
            };
            sinks.place(found.into_iter().flatten().flatten().collect(), 0);
            Ok(())
        })?;
        sinks.into_first().ok_or_else(no_memory)
    }

    /// Calls `each` with all chunks, some at once, and with the files that were met since the last call.
    fn for_batches(
        &self,
        mut each: impl FnMut(Vec<Located>, FileCounts) -> Result<(), FormatError>,
    ) -> Result<(), FormatError> {
        let array = self.array;
        let files: Vec<Range<u64>> =
            self.grid.selected.iter().zip(&array.chunk).map(|(s, &side)| covering(&s.range, side)).collect();
        let mut index: Vec<u64> = files.iter().map(|r| r.start).collect();
        let num_at_once = self.grid.num_at_once();
        let mut waiting = Vec::new();
        loop {
            let start: Vec<u64> = index.iter().zip(&array.chunk).map(|(i, n)| i * n).collect();
            let path = array.chunk_path(&index);
            let mut counts = FileCounts { met: 1, absent: 0 };
            match &array.shard {
                None if self.grid.num_within(&start) > 0 => {
                    waiting.push(Located { path, part: Part::Whole, start });
                }
                None => counts.met = 0,
                Some(shard) => match self.in_shard(shard, path, &start)? {
                    Some(found) => waiting.extend(found),
                    None => counts.absent = 1,
                },
            }
            let is_last = !next_index(&mut index, &files);
            each(Vec::new(), counts)?;
            while waiting.len() >= num_at_once || (is_last && !waiting.is_empty()) {
                let batch = waiting.drain(..num_at_once.min(waiting.len())).collect();
                each(batch, FileCounts::default())?;
            }
            if is_last {
                return Ok(());
            }
        }
    }

    /// Reads chunks at once. Returns how many of their files are absent.
    fn read_batch(&self, batch: &[Located], collector: &mut Collector) -> Result<u64, FormatError> {
        if batch.is_empty() {
            return Ok(0);
        }
        let read = || batch.par_iter().map(|chunk| self.pieces(chunk)).collect::<Result<Vec<_>, _>>();
        let found = self.store.on_threads(read)?;
        let num_absent = found.iter().filter(|pieces| pieces.is_none()).count() as u64;
        let num_passed = batch.iter().map(|chunk| self.grid.num_within(&chunk.start)).sum();
        collector.place(found.into_iter().flatten().flatten().collect(), num_passed)?;
        Ok(num_absent)
    }

    /// The wanted chunks of a shard; `None` if its file is absent.
    fn in_shard(
        &self,
        shard: &Shard,
        path: PathBuf,
        start: &[u64],
    ) -> Result<Option<Vec<Located>>, FormatError> {
        let inner: Vec<Range<u64>> =
            self.array.chunk.iter().zip(&shard.chunk).map(|(n, m)| 0..n / m).collect();
        let bad = |problem: String| FormatError::Data { path: shown(&path), problem };
        let count = inner.iter().try_fold(1u64, |n, r| n.checked_mul(r.end)).filter(|n| *n <= MAX_CHUNKS);
        let count = count.ok_or_else(|| bad(format!("a shard of more than {MAX_CHUNKS} chunks")))?;
        let size = 16 * count + if shard.has_checksum { 4 } else { 0 };
        let part = if shard.is_index_first { Part::At(0, size) } else { Part::End(size) };
        let read = || -> Result<_, FormatError> {
            let found = self.store.read(&path, part, size)?;
            Ok(found.map(|(bytes, length)| (Arc::new(bytes), length)))
        };
        let found = match self.shared {
            Some((level, shared)) => shared.tables.get((level, start.to_vec()), size, read)?,
            None => read()?,
        };
        let Some((bytes, length)) = found else {
            self.note_absent(start);
            return Ok(None);
        };
        let table = shard_index(&bytes, count as usize, shard.has_checksum).map_err(bad)?;
        let mut at: Vec<u64> = vec![0; inner.len()];
        let mut found = Vec::new();
        for (offset, size) in table {
            let first: Vec<u64> = (0..at.len()).map(|i| start[i] + at[i] * shard.chunk[i]).collect();
            next_index(&mut at, &inner);
            if (offset, size) == (u64::MAX, u64::MAX) || self.grid.num_within(&first) == 0 {
                continue;
            }
            if offset.checked_add(size).is_none_or(|end| end > length) {
                return Err(bad(format!("chunk: it ends at {offset} + {size} of {length} bytes")));
            }
            found.push(Located { path: path.clone(), part: Part::At(offset, size), start: first });
        }
        Ok(Some(found))
    }

    /// The selected numbers of a chunk, a box for each channel; `None` if its file is absent.
    fn pieces(&self, chunk: &Located) -> Result<Option<Vec<Piece>>, FormatError> {
        if self.cancel.is_some_and(|cancel| cancel.load(Ordering::Relaxed)) {
            return Err(FormatError::Cancelled { path: shown(&self.array.path) });
        }
        let found = match self.shared {
            Some((level, shared)) => {
                let key = (level, chunk.start.clone());
                shared.chunks.get(key, self.grid.bytes_of_chunk(), || self.decoded(chunk))?
            }
            None => self.decoded(chunk)?,
        };
        let Some(bytes) = found else {
            self.note_absent(&chunk.start);
            return Ok(None);
        };
        self.grid.pieces(&chunk.start, &bytes, &chunk.path).map(Some)
    }

    /// Reads and decodes a chunk.
    fn decoded(&self, chunk: &Located) -> Result<ReadChunk, FormatError> {
        let num_bytes = self.grid.bytes_of_chunk();
        // Codecs add little to numbers that do not shrink.
        let most = num_bytes.saturating_mul(2).saturating_add(CODEC_BYTES);
        let Some((packed, _)) = self.store.read(&chunk.path, chunk.part, most)? else { return Ok(None) };
        let bytes = self.array.codecs.decode(packed, num_bytes as usize);
        let damaged = |problem: String| FormatError::Data {
            path: shown(&chunk.path),
            problem: format!("chunk: {problem}"),
        };
        bytes.map(|bytes| Some(Arc::new(bytes))).map_err(damaged)
    }

    /// Notes that the chunk or shard at `start` is not there.
    fn note_absent(&self, start: &[u64]) {
        if let Some((level, shared)) = self.shared {
            shared.note_absent((level, start.to_vec()));
        }
    }
}

/// Offsets and lengths of the chunks in a shard.
fn shard_index(bytes: &[u8], count: usize, has_checksum: bool) -> Result<Vec<(u64, u64)>, String> {
    let (index, sum) = bytes.split_at_checked(16 * count).ok_or("a shard is shorter than its index")?;
    if has_checksum && sum != crc32c(index).to_le_bytes() {
        return Err("the index of a shard does not match its checksum".into());
    }
    let entry = |[a, b]: &[[u8; 8]; 2]| (u64::from_le_bytes(*a), u64::from_le_bytes(*b));
    Ok(index.as_chunks::<8>().0.as_chunks::<2>().0.iter().map(entry).collect())
}

/// Chunks in a folder that are not worth several threads.
const FEW_CHUNKS: usize = 128;
/// Most numbers of coordinates.
const MAX_SHORT: u64 = 1 << 22;
/// What codecs may add to the numbers.
const CODEC_BYTES: u64 = 1 << 16;
