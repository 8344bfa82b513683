//! Reads the chunks of an array on several threads, and puts their numbers in place.

use std::ops::Range;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

use rayon::prelude::*;

use super::array::{Array, Shard};
use super::store::{Part, Store};
use crate::channels::Piece;
use crate::chunk_grid::{ChunkGrid, MAX_CHUNKS, covering, next_index};
use crate::collector::Collector;
use crate::error::{FormatError, shown};
use crate::hyperslab::Steps;
use crate::unpack::crc32c;
use crate::warning::WarningKind;

/// The selected part of an array.
struct Chunks<'a> {
    array: &'a Array,
    store: &'a Store,
    /// The chunks that are decoded: those within shards, if there are shards.
    grid: ChunkGrid<'a>,
    cancel: Option<&'a AtomicBool>,
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
    let grid = ChunkGrid {
        sides: array.shard.as_ref().map_or(&array.chunk, |s| &s.chunk),
        order: &array.codecs.order,
        dtype: array.dtype,
        endian: array.codecs.endian,
        selected,
        channel_axis: collector.channel_axis().map(|axis| num_axes - 1 - axis),
        channel: 0,
        num_more_axes: collector.selected().len() - num_axes,
    };
    grid.check_sizes(collector, &array.path, most_bytes)?;
    Chunks { array, store, grid, cancel: collector.cancel() }.read_all(collector)
}

impl Chunks<'_> {
    fn read_all(&self, collector: &mut Collector) -> Result<(), FormatError> {
        let array = self.array;
        let selected = self.grid.selected.iter();
        let files: Vec<Range<u64>> =
            selected.zip(&array.chunk).map(|(s, &side)| covering(&s.range, side)).collect();
        let mut index: Vec<u64> = files.iter().map(|r| r.start).collect();
        let num_at_once = self.grid.num_at_once();
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
        let Some((bytes, length)) = self.store.read(&path, part, size)? else { return Ok(None) };
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
        // Codecs add little to numbers that do not shrink.
        let num_bytes = self.grid.bytes_of_chunk();
        let most = num_bytes.saturating_mul(2).saturating_add(CODEC_BYTES);
        let Some((packed, _)) = self.store.read(&chunk.path, chunk.part, most)? else { return Ok(None) };
        let damaged = |problem: String| FormatError::Data {
            path: shown(&chunk.path),
            problem: format!("chunk: {problem}"),
        };
        let bytes = self.array.codecs.decode(packed, num_bytes as usize).map_err(damaged)?;
        self.grid.pieces(&chunk.start, &bytes, &chunk.path).map(Some)
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

/// What codecs may add to the numbers.
const CODEC_BYTES: u64 = 1 << 16;
