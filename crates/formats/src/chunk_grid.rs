//! The chunks of an array, and where the selected numbers of each lie in the volume.

use std::borrow::Cow;
use std::ops::Range;
use std::path::Path;

use crate::channels::Piece;
use crate::collector::Collector;
use crate::decode::VoxelSink;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error};
use crate::hyperslab::Steps;

/// The selected part of an array in chunks of one size. Axes are slowest first, as in chunks.
pub(crate) struct ChunkGrid<'a> {
    /// Numbers of a chunk along each axis.
    pub(crate) sides: &'a [u64],
    /// The order of the axes in a chunk, the slowest first.
    pub(crate) order: &'a [usize],
    pub(crate) dtype: Dtype,
    pub(crate) endian: Endian,
    pub(crate) selected: Vec<Steps>,
    /// The axis that has the channels, if there is one.
    pub(crate) channel_axis: Option<usize>,
    /// The channel that the array is, counted from the first that is read, if no axis has them.
    pub(crate) channel: usize,
    /// Axes that the plan has and the array has not.
    pub(crate) num_more_axes: usize,
    /// Whether the bytes of numbers are wanted as they are, as a first axis.
    pub(crate) is_raw: bool,
}

impl ChunkGrid<'_> {
    pub(crate) fn bytes_of_chunk(&self) -> u64 {
        let size = self.dtype.num_bytes() as u64;
        self.sides.iter().fold(size, |n, side| n.saturating_mul(*side))
    }

    /// Refuses too many chunks, and those of more than `most_bytes`.
    pub(crate) fn check_sizes(
        &self,
        collector: &Collector,
        path: &Path,
        most_bytes: u64,
    ) -> Result<(), FormatError> {
        let num_chunks = self.selected.iter().zip(self.sides).try_fold(1u64, |n, (steps, &side)| {
            let range = covering(&steps.range, side);
            n.checked_mul(range.end - range.start)
        });
        let bytes = self.bytes_of_chunk();
        if num_chunks.is_none_or(|n| n > MAX_CHUNKS) || bytes > most_bytes {
            let n = num_chunks.unwrap_or(u64::MAX);
            let problem = format!("{n} chunks of {bytes} bytes, expected fewer or smaller ones");
            return Err(collector.data_error(path, problem));
        }
        Ok(())
    }

    /// How many chunks are in memory at once: a layer of them across the slowest axis, or a few MiB.
    pub(crate) fn num_at_once(&self) -> usize {
        let lengths = self.selected.iter().zip(self.sides).map(|(steps, side)| (steps.len(), *side));
        let slow = lengths.clone().position(|(length, _)| length > 1).unwrap_or(0);
        let layer = lengths.enumerate().fold(1u64, |n, (axis, (length, side))| {
            n.saturating_mul(if axis == slow { length.min(side) } else { length })
        });
        let layer = layer.saturating_mul(self.dtype.num_bytes() as u64);
        // A chunk is there twice: as bytes, and as voxels.
        let num = layer.clamp(LEAST_BYTES, MOST_BYTES) / (2 * self.bytes_of_chunk()).max(1);
        num.clamp(1, MAX_AT_ONCE) as usize
    }

    /// The selected numbers in the chunk at `start`, along each axis.
    fn within(&self, start: &[u64]) -> Vec<Range<u64>> {
        let axes = self.selected.iter().zip(start.iter().zip(self.sides));
        axes.map(|(steps, (s, n))| steps.within(*s..s.saturating_add(*n))).collect()
    }

    /// The ranges that hold all selected numbers, along each axis.
    pub(crate) fn ranges(&self) -> Vec<Range<u64>> {
        self.selected.iter().map(|steps| steps.range.clone()).collect()
    }

    /// How many selected numbers are in the chunk at `start`.
    pub(crate) fn num_within(&self, start: &[u64]) -> u64 {
        self.within(start).iter().map(|r| r.end.saturating_sub(r.start)).product()
    }

    /// The selected numbers of the chunk at `start`, a box for each channel. `bytes` are its numbers; `path` is for
    /// messages.
    pub(crate) fn pieces(&self, start: &[u64], bytes: &[u8], path: &Path) -> Result<Vec<Piece>, FormatError> {
        let strides = strides(self.sides, self.order);
        let within = self.within(start);
        if within.iter().any(|r| r.start >= r.end) {
            return Ok(Vec::new());
        }
        let channels = self.channel_axis.map_or(0..1, |axis| within[axis].clone());
        let mut pieces = Vec::new();
        for channel in channels {
            let mut part = within.clone();
            if let Some(axis) = self.channel_axis {
                part[axis] = channel..channel + 1;
            }
            let numbers = self.gather(bytes, start, &part, &strides);
            let size = self.dtype.num_bytes();
            let (dtype, bytes_each) = if self.is_raw { (Dtype::Uint8, 1) } else { (self.dtype, size) };
            let sink = VoxelSink::new(dtype, self.endian, numbers.len() / bytes_each);
            let mut sink = sink.map_err(|_| io_error(path)(std::io::ErrorKind::OutOfMemory.into()))?;
            sink.push_bytes(&numbers);
            if let Some(axis) = self.channel_axis {
                part[axis] = 0..1;
            }
            let mut ranges: Vec<Range<usize>> = self.is_raw.then_some(0..size).into_iter().collect();
            ranges.extend(part.iter().rev().map(|r| r.start as usize..r.end as usize));
            ranges.extend(std::iter::repeat_n(0..1, self.num_more_axes));
            pieces.push(Piece { channel: self.channel + channel as usize, ranges, sink });
        }
        Ok(pieces)
    }

    /// The numbers of a box of selected ones, the last axis fastest. `bytes` are those of the chunk at `start`.
    fn gather<'b>(
        &self,
        bytes: &'b [u8],
        start: &[u64],
        part: &[Range<u64>],
        strides: &[usize],
    ) -> Cow<'b, [u8]> {
        let size = self.dtype.num_bytes();
        let is_plain = self.order.is_sorted() && self.selected.iter().all(|s| s.step == 1);
        let is_whole = part.iter().zip(self.sides).all(|(r, n)| r.end - r.start == *n);
        if is_plain && is_whole {
            return bytes.into();
        }
        let last = part.len() - 1;
        let count: u64 = part.iter().map(|r| r.end - r.start).product();
        let mut numbers = Vec::with_capacity(count as usize * size);
        let offset =
            |axis: usize, i: u64| (self.selected[axis].at(i) - start[axis]) as usize * strides[axis] * size;
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

/// Copies the numbers of a chunk into those of the whole array, each of `size` bytes and the last axis fastest. The
/// chunk has its first number and its sides.
pub(crate) fn place_chunk(
    all: &mut [u8],
    shape: &[u64],
    (start, sides): (&[u64], &[u64]),
    bytes: &[u8],
    size: usize,
) {
    let Some(last) = shape.len().checked_sub(1) else { return };
    let within: Vec<Range<u64>> =
        (0..shape.len()).map(|i| 0..sides[i].min(shape[i].saturating_sub(start[i]))).collect();
    if within.iter().any(Range::is_empty) {
        return;
    }
    let run = within[last].end as usize * size;
    let mut rows = within;
    rows[last] = 0..1;
    let mut index = vec![0; shape.len()];
    loop {
        let at = |lengths: &[u64], first: &dyn Fn(usize) -> u64| {
            (0..shape.len()).fold(0, |at, i| at * lengths[i] + first(i) + index[i]) as usize * size
        };
        let (to, from) = (at(shape, &|i| start[i]), at(sides, &|_| 0));
        if let (Some(to), Some(from)) = (all.get_mut(to..to + run), bytes.get(from..from + run)) {
            to.copy_from_slice(from);
        }
        if !next_index(&mut index, &rows) {
            return;
        }
    }
}

/// The chunks of this side that hold a range.
pub(crate) fn covering(range: &Range<u64>, side: u64) -> Range<u64> {
    range.start / side..range.end.div_ceil(side)
}

/// Moves to the next index, the last axis first. Returns `false` after the last.
pub(crate) fn next_index(index: &mut [u64], ranges: &[Range<u64>]) -> bool {
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
pub(crate) const MAX_CHUNKS: u64 = 1 << 22;
/// Bytes of chunks in memory at once, at least and at most.
const LEAST_BYTES: u64 = 16 << 20;
const MOST_BYTES: u64 = 256 << 20;
/// Most chunks at once.
const MAX_AT_ONCE: u64 = 4096;
