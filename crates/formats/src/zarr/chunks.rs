//! Reads the chunks of an array on several threads, and puts their numbers in place.

use std::ops::Range;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

use rayon::prelude::*;

use super::array::{Array, Shard};
use super::codec;
use super::store::{Part, Store};
use crate::channels::Piece;
use crate::collector::Collector;
use crate::decode::VoxelSink;
use crate::dtype::Dtype;
use crate::error::{FormatError, io_error, shown};
use crate::hyperslab::Steps;
use crate::warning::WarningKind;

/// The selected part of an array. Axes are slowest first, as in chunks.
struct Chunks<'a> {
    array: &'a Array,
    store: &'a Store,
    selected: Vec<Steps>,
    channel_axis: Option<usize>,
    /// Axes that the plan has and the array has not.
    num_more_axes: usize,
    cancel: Option<&'a AtomicBool>,
    /// Whether the bytes of numbers are wanted as they are.
    is_raw: bool,
}

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
    let (cancel, is_raw) = (collector.cancel(), collector.is_raw());
    let chunks = Chunks { array, store, selected, channel_axis, num_more_axes, cancel, is_raw };
    chunks.check_sizes(collector, most_bytes)?;
    chunks.read_all(collector)
}

impl<'a> Chunks<'a> {
    /// The sides of the chunks that are decoded.
    fn sides(&self) -> &'a [u64] {
        self.array.shard.as_ref().map_or(&self.array.chunk, |s| &s.chunk)
    }

    fn bytes_of_chunk(&self) -> u64 {
        let size = self.array.dtype.num_bytes() as u64;
        self.sides().iter().fold(size, |n, side| n.saturating_mul(*side))
    }

    fn check_sizes(&self, collector: &Collector, most_bytes: u64) -> Result<(), FormatError> {
        let num_chunks = self.selected.iter().zip(self.sides()).try_fold(1u64, |n, (steps, &side)| {
            let range = covering(&steps.range, side);
            n.checked_mul(range.end - range.start)
        });
        let bytes = self.bytes_of_chunk();
        if num_chunks.is_none_or(|n| n > MAX_CHUNKS) || bytes > most_bytes {
            let n = num_chunks.unwrap_or(u64::MAX);
            let problem = format!("{n} chunks of {bytes} bytes, expected fewer or smaller ones");
            return Err(collector.data_error(&self.array.path, problem));
        }
        Ok(())
    }

    /// How many chunks are in memory at once: a layer of them across the slowest axis, or a few MiB.
    fn num_at_once(&self) -> usize {
        let lengths = self.selected.iter().zip(self.sides()).map(|(steps, side)| (steps.len(), *side));
        let slow = lengths.clone().position(|(length, _)| length > 1).unwrap_or(0);
        let layer = lengths.enumerate().fold(1u64, |n, (axis, (length, side))| {
            n.saturating_mul(if axis == slow { length.min(side) } else { length })
        });
        let layer = layer.saturating_mul(self.array.dtype.num_bytes() as u64);
        // A chunk is there twice: as bytes, and as voxels.
        let num = layer.clamp(LEAST_BYTES, MOST_BYTES) / (2 * self.bytes_of_chunk()).max(1);
        num.clamp(1, MAX_AT_ONCE) as usize
    }

    fn read_all(&self, collector: &mut Collector) -> Result<(), FormatError> {
        let array = self.array;
        let files: Vec<Range<u64>> =
            self.selected.iter().zip(&array.chunk).map(|(s, &side)| covering(&s.range, side)).collect();
        let mut index: Vec<u64> = files.iter().map(|r| r.start).collect();
        let num_at_once = self.num_at_once();
        let (mut num_files, mut num_absent) = (0u64, 0u64);
        let mut waiting = Vec::new();
        collector.fill(&array.fill)?;
        loop {
            num_files += 1;
            let path = array.chunk_path(&index);
            let start: Vec<u64> = index.iter().zip(&array.chunk).map(|(i, n)| i * n).collect();
            match &array.shard {
                None => waiting.push(Located { path, part: Part::Whole, start }),
                Some(shard) => match self.in_shard(shard, path, &start)? {
                    Some(found) => waiting.extend(found),
                    None => num_absent += 1,
                },
            }
            let is_last = !next_index(&mut index, &files);
            while waiting.len() >= num_at_once || (is_last && !waiting.is_empty()) {
                let batch: Vec<Located> = waiting.drain(..num_at_once.min(waiting.len())).collect();
                num_absent += self.read_batch(&batch, collector)?;
            }
            collector.tick()?;
            if is_last {
                break;
            }
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

    /// Reads chunks at once. Returns how many of their files are absent.
    fn read_batch(&self, batch: &[Located], collector: &mut Collector) -> Result<u64, FormatError> {
        let read = || batch.par_iter().map(|chunk| self.pieces(chunk)).collect::<Result<Vec<_>, _>>();
        let found = self.store.on_threads(read)?;
        let num_absent = found.iter().filter(|pieces| pieces.is_none()).count() as u64;
        let num_passed = batch.iter().map(|chunk| self.num_within(&chunk.start)).sum();
        collector.place(found.into_iter().flatten().flatten().collect(), num_passed)?;
        Ok(num_absent)
    }

    /// The selected numbers in the chunk at `start`, along each axis.
    fn within(&self, start: &[u64]) -> Vec<Range<u64>> {
        let axes = self.selected.iter().zip(start.iter().zip(self.sides()));
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
        let Some((bytes, length)) = self.store.read(&path, part, size)? else { return Ok(None) };
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
        let (array, sides) = (self.array, self.sides());
        // Codecs add little to numbers that do not shrink.
        let most = self.bytes_of_chunk().saturating_mul(2).saturating_add(CODEC_BYTES);
        let Some((packed, _)) = self.store.read(&chunk.path, chunk.part, most)? else { return Ok(None) };
        let damaged = |problem: String| FormatError::Data {
            path: shown(&chunk.path),
            problem: format!("chunk: {problem}"),
        };
        let bytes = array.codecs.decode(packed, self.bytes_of_chunk() as usize).map_err(damaged)?;
        let strides = strides(sides, &array.codecs.order);
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
        let is_whole = part.iter().zip(self.sides()).all(|(r, n)| r.end - r.start == *n);
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
/// What codecs may add to the numbers.
const CODEC_BYTES: u64 = 1 << 16;
