//! Reads the chunks of an array on several threads, and puts their numbers in place.

use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use rayon::prelude::*;

use super::array::{Array, Shard};
use super::boxes::SharedChunks;
use super::codec;
use super::store::{Part, Store};
use crate::channels::{ChannelSinks, Piece, StreamShape};
use crate::collector::Collector;
use crate::decode::VoxelSink;
use crate::dtype::Dtype;
use crate::error::{FormatError, io_error, shown};
use crate::hyperslab::Steps;
use crate::warning::WarningKind;

/// The selected part of an array. Axes are slowest first, as in chunks.
pub(super) struct Chunks<'a> {
    array: &'a Array,
    store: &'a Store,
    selected: Vec<Steps>,
    channel_axis: Option<usize>,
    /// Axes that the plan has and the array has not.
    num_more_axes: usize,
    cancel: Option<&'a AtomicBool>,
    /// The level, and what is kept of all levels.
    shared: Option<(usize, &'a SharedChunks)>,
    /// Whether the bytes of numbers are wanted as they are.
    is_raw: bool,
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
    let num_axes = array.shape.len();
    // The plan of a plane has one axis more than its array.
    let selected: Vec<Steps> = collector.selected().iter().take(num_axes).rev().cloned().collect();
    let channel_axis = collector.channel_axis().map(|axis| num_axes - 1 - axis);
    let num_more_axes = collector.selected().len() - num_axes;
    let (cancel, is_raw, shared) = (collector.cancel(), collector.is_raw(), None);
    let chunks = Chunks { array, store, selected, channel_axis, num_more_axes, cancel, shared, is_raw };
    chunks.check_sizes(collector, most_bytes)?;
    chunks.read_all(collector)
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
        let num_axes = array.shape.len();
        Self {
            array,
            store,
            selected: selected.iter().take(num_axes).rev().cloned().collect(),
            channel_axis: channel_axis.map(|axis| num_axes - 1 - axis),
            num_more_axes: selected.len() - num_axes,
            cancel: None,
            shared: Some(shared),
            is_raw: false,
        }
    }

    fn check_sizes(&self, collector: &Collector, most_bytes: u64) -> Result<(), FormatError> {
        let num_chunks = self.selected.iter().zip(self.array.sides()).try_fold(1u64, |n, (steps, &side)| {
            let range = covering(&steps.range, side);
            n.checked_mul(range.end - range.start)
        });
        let bytes = self.array.chunk_bytes();
        if num_chunks.is_none_or(|n| n > MAX_CHUNKS) || bytes > most_bytes {
            let n = num_chunks.unwrap_or(u64::MAX);
            let problem = format!("{n} chunks of {bytes} bytes, expected fewer or smaller ones");
            return Err(collector.data_error(&self.array.path, problem));
        }
        Ok(())
    }

    /// How many chunks are in memory at once: a layer of them across the slowest axis, or a few MiB.
    fn num_at_once(&self) -> usize {
        let lengths = self.selected.iter().zip(self.array.sides()).map(|(steps, side)| (steps.len(), *side));
        let slow = lengths.clone().position(|(length, _)| length > 1).unwrap_or(0);
        let layer = lengths.enumerate().fold(1u64, |n, (axis, (length, side))| {
            n.saturating_mul(if axis == slow { length.min(side) } else { length })
        });
        let layer = layer.saturating_mul(self.array.dtype.num_bytes() as u64);
        // A chunk is there twice: as bytes, and as voxels.
        let num = layer.clamp(LEAST_BYTES, MOST_BYTES) / (2 * self.array.chunk_bytes()).max(1);
        num.clamp(1, MAX_AT_ONCE) as usize
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
            let hint = if num_absent == num_files { "; is the dimension separator right?" } else { "" };
            let text = format!(
                "chunks not found: {num_absent} of {num_files}, shown as the fill value of the array{hint}"
            );
            collector.warn(WarningKind::Data, text);
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
        let files = self.selected.iter().zip(&array.chunk).map(|(s, &side)| covering(&s.range, side));
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
            self.selected.iter().zip(&array.chunk).map(|(s, &side)| covering(&s.range, side)).collect();
        let mut index: Vec<u64> = files.iter().map(|r| r.start).collect();
        let num_at_once = self.num_at_once();
        let mut waiting = Vec::new();
        loop {
            let start: Vec<u64> = index.iter().zip(&array.chunk).map(|(i, n)| i * n).collect();
            let path = array.chunk_path(&index);
            let mut counts = FileCounts { met: 1, absent: 0 };
            match &array.shard {
                None if self.num_within(&start) > 0 => {
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
        let num_passed = batch.iter().map(|chunk| self.num_within(&chunk.start)).sum();
        collector.place(found.into_iter().flatten().flatten().collect(), num_passed)?;
        Ok(num_absent)
    }

    /// The selected numbers in the chunk at `start`, along each axis.
    fn within(&self, start: &[u64]) -> Vec<Range<u64>> {
        let axes = self.selected.iter().zip(start.iter().zip(self.array.sides()));
        axes.map(|(steps, (s, n))| steps.within(*s..s.saturating_add(*n))).collect()
    }

    fn num_within(&self, start: &[u64]) -> u64 {
        self.within(start).iter().map(|r| r.end.saturating_sub(r.start)).product()
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
            if (offset, size) == (u64::MAX, u64::MAX) || self.num_within(&first) == 0 {
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
        let array = self.array;
        let found = match self.shared {
            Some((level, shared)) => {
                let key = (level, chunk.start.clone());
                shared.chunks.get(key, array.chunk_bytes(), || self.decoded(chunk))?
            }
            None => self.decoded(chunk)?,
        };
        let Some(bytes) = found else {
            self.note_absent(&chunk.start);
            return Ok(None);
        };
        let strides = strides(array.sides(), &array.codecs.order);
        let within = self.within(&chunk.start);
        if within.iter().any(|r| r.start >= r.end) {
            return Ok(Some(Vec::new()));
        }
        let channels = self.channel_axis.map_or(0..1, |axis| within[axis].clone());
        let mut pieces = Vec::new();
        for channel in channels {
            let mut part = within.clone();
            if let Some(axis) = self.channel_axis {
                part[axis] = channel..channel + 1;
            }
            let numbers = self.gather(&bytes, chunk, &part, &strides);
            let size = array.dtype.num_bytes();
            let (dtype, bytes_each) = if self.is_raw { (Dtype::Uint8, 1) } else { (array.dtype, size) };
            let sink = VoxelSink::new(dtype, array.codecs.endian, numbers.len() / bytes_each);
            let mut sink = sink.map_err(|_| io_error(&chunk.path)(std::io::ErrorKind::OutOfMemory.into()))?;
            sink.push_bytes(&numbers);
            if let Some(axis) = self.channel_axis {
                part[axis] = 0..1;
            }
            let mut ranges: Vec<Range<usize>> = self.is_raw.then_some(0..size).into_iter().collect();
            ranges.extend(part.iter().rev().map(|r| r.start as usize..r.end as usize));
            ranges.extend(std::iter::repeat_n(0..1, self.num_more_axes));
            pieces.push(Piece { channel: channel as usize, ranges, sink });
        }
        Ok(Some(pieces))
    }

    /// Reads and decodes a chunk.
    fn decoded(&self, chunk: &Located) -> Result<ReadChunk, FormatError> {
        let num_bytes = self.array.chunk_bytes();
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

    /// The numbers of a box of selected ones, the last axis fastest. `bytes` are those of the chunk.
    fn gather<'b>(
        &self,
        bytes: &'b [u8],
        chunk: &Located,
        part: &[Range<u64>],
        strides: &[usize],
    ) -> std::borrow::Cow<'b, [u8]> {
        let size = self.array.dtype.num_bytes();
        let is_plain = self.array.codecs.order.is_sorted() && self.selected.iter().all(|s| s.step == 1);
        let is_whole = part.iter().zip(self.array.sides()).all(|(r, n)| r.end - r.start == *n);
        if is_plain && is_whole {
            return bytes.into();
        }
        let last = part.len() - 1;
        let count: u64 = part.iter().map(|r| r.end - r.start).product();
        let mut numbers = Vec::with_capacity(count as usize * size);
        let offset = |axis: usize, i: u64| {
            (self.selected[axis].at(i) - chunk.start[axis]) as usize * strides[axis] * size
        };
        let mut rows = part.to_vec();
        rows[last] = part[last].start..part[last].start + 1;
        let mut index: Vec<u64> = part.iter().map(|r| r.start).collect();
        let (run, step) =
            ((part[last].end - part[last].start) as usize, self.selected[last].step as usize * strides[last]);
        loop {
            let from: usize = index.iter().enumerate().map(|(axis, i)| offset(axis, *i)).sum();
            if step == 1 {
                numbers.extend_from_slice(&bytes[from..from + run * size]);
            } else {
                for i in 0..run {
                    let at = from + i * step * size;
                    numbers.extend_from_slice(&bytes[at..at + size]);
                }
            }
            if !next_index(&mut index, &rows) {
                return numbers.into();
            }
        }
    }
}

/// The distance of neighbours along each axis in a chunk, whose axes are in `order`, the slowest first.
fn strides(sides: &[u64], order: &[usize]) -> Vec<usize> {
    let mut strides = vec![0; sides.len()];
    let mut stride = 1;
    for &axis in order.iter().rev() {
        strides[axis] = stride;
        stride *= sides[axis] as usize;
    }
    strides
}

/// The chunks of this side that hold a range.
fn covering(range: &Range<u64>, side: u64) -> Range<u64> {
    range.start / side..range.end.div_ceil(side)
}

/// Offsets and lengths of the chunks in a shard.
fn shard_index(bytes: &[u8], count: usize, has_checksum: bool) -> Result<Vec<(u64, u64)>, String> {
    let (index, sum) = bytes.split_at_checked(16 * count).ok_or("a shard is shorter than its index")?;
    if has_checksum && sum != codec::crc32c(index).to_le_bytes() {
        return Err("the index of a shard does not match its checksum".into());
    }
    let entry = |[a, b]: &[[u8; 8]; 2]| (u64::from_le_bytes(*a), u64::from_le_bytes(*b));
    Ok(index.as_chunks::<8>().0.as_chunks::<2>().0.iter().map(entry).collect())
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

/// Most chunks of a volume, or of a shard.
const MAX_CHUNKS: u64 = 1 << 22;
/// Bytes of chunks in memory at once, at least and at most.
const LEAST_BYTES: u64 = 16 << 20;
const MOST_BYTES: u64 = 256 << 20;
/// Most chunks at once.
const MAX_AT_ONCE: u64 = 4096;
/// Chunks in a folder that are not worth several threads.
const FEW_CHUNKS: usize = 128;
/// What codecs may add to the numbers.
const CODEC_BYTES: u64 = 1 << 16;
