//! Where the numbers of an array are in the file, and how they are packed.

use std::ops::Range;
use std::sync::Arc;

use hdf5_pure::{ChunkIndex, Dataset, Error, Filter, Layout};

use super::contents::{ArrayFile, Listed, problem};
use super::layouts::{chunks_in_tree, fill_value, has_external_files, has_plain_edges, tell_layout};
use super::source::SharedFile;
use crate::chunk_grid::{MAX_CHUNKS, covering, next_index};
use crate::dtype::{Dtype, Endian, numbers_from_bytes};
use crate::unpack::{BitPacking, Codec};

/// The numbers of an array in the file.
pub(super) struct Storage {
    file: Arc<SharedFile>,
    pub(super) shape: Vec<u64>,
    pub(super) dtype: Dtype,
    pub(super) endian: Endian,
    /// Numbers of a chunk along each axis. What is not in chunks is divided for reading.
    pub(super) sides: Vec<u64>,
    /// The order of the axes in a chunk.
    pub(super) order: Vec<usize>,
    place: DataPlace,
    /// The filters, in the order of writing.
    filters: Vec<Codec>,
    /// The bytes of a number that is not stored.
    pub(super) fill: Vec<u8>,
}

enum DataPlace {
    Nowhere,
    /// In the metadata.
    Here(Vec<u8>),
    /// One after the other from this byte on.
    At(u64),
    /// In the order of their first numbers.
    Chunks(Vec<StoredChunk>),
}

/// A chunk in the file.
#[derive(Clone)]
pub(super) struct StoredChunk {
    /// Its first number along each axis.
    pub(super) start: Vec<u64>,
    pub(super) address: u64,
    pub(super) size: u64,
    /// A bit for each filter that it was not packed by.
    pub(super) mask: u32,
}

/// What is known of how an array is stored.
pub(super) struct StorageForm {
    dataset: Dataset,
    /// The filters, in the order of writing.
    filters: Vec<Codec>,
    layout: Layout,
}

impl Storage {
    /// Finds the numbers of an array. A chunk may have at most `most_bytes`.
    pub(super) fn of(contents: &ArrayFile, array: &Listed, most_bytes: u64) -> Result<Self, String> {
        let (dtype, endian) = array.kind.clone()?;
        let StorageForm { dataset, filters, layout } = StorageForm::of(contents, array)?;
        let size = dtype.num_bytes() as u64;
        let shape = array.shape.clone();
        let fill = fill_value(&contents.objects, array.at, size as usize);
        let (sides, place) = match layout {
            Layout::Compact { .. } => {
                (shape.clone(), DataPlace::Here(row(&dataset, &shape, 0, shape[0], size)?))
            }
            Layout::Contiguous { address: Some(address), .. } => {
                (divided(&shape, size), DataPlace::At(address))
            }
            Layout::Chunked { chunk_shape, index } => {
                check_chunks(&shape, &chunk_shape, size, most_bytes)?;
                let chunks = stored_chunks(contents, array, &dataset, (&chunk_shape, index))?;
                (chunk_shape, DataPlace::Chunks(chunks))
            }
            _ => (divided(&shape, size), DataPlace::Nowhere),
        };
        let order = (0..shape.len()).collect();
        let file = Arc::clone(&contents.bytes);
        Ok(Self { file, shape, dtype, endian, sides, order, place, filters, fill })
    }

    pub(super) fn bytes_of_chunk(&self) -> u64 {
        self.sides.iter().fold(self.dtype.num_bytes() as u64, |n, side| n.saturating_mul(*side))
    }

    /// The byte of the file from which on all numbers lie one after the other.
    pub(super) fn offset(&self) -> Option<u64> {
        match self.place {
            DataPlace::At(address) => Some(address),
            _ => None,
        }
    }

    /// The first numbers of the chunks that have numbers of these ranges along each axis.
    pub(super) fn starts(&self, ranges: &[Range<u64>]) -> impl Iterator<Item = Vec<u64>> {
        let counts: Vec<_> =
            ranges.iter().zip(&self.sides).map(|(range, side)| covering(range, *side)).collect();
        let first: Vec<u64> = counts.iter().map(|range| range.start).collect();
        let mut next = Some(first).filter(|_| !counts.iter().any(Range::is_empty));
        std::iter::from_fn(move || {
            let mut index = next.take()?;
            let start = index.iter().zip(&self.sides).map(|(i, side)| i * side).collect();
            next = next_index(&mut index, &counts).then_some(index);
            Some(start)
        })
    }

    /// The chunk whose first number is `start`, if it is stored.
    pub(super) fn chunk(&self, start: &[u64]) -> Option<StoredChunk> {
        let at = match &self.place {
            DataPlace::Chunks(chunks) => {
                let found = chunks.binary_search_by(|chunk| chunk.start[..].cmp(start));
                return found.ok().map(|i| chunks[i].clone());
            }
            DataPlace::Nowhere => return None,
            DataPlace::Here(_) => 0,
            DataPlace::At(address) => *address,
        };
        let strides = strides(&self.shape, self.dtype.num_bytes() as u64);
        let end = at.saturating_add(strides[0].saturating_mul(self.shape[0]));
        let steps = start.iter().zip(&strides);
        let address = steps.fold(at, |sum, (i, n)| sum.saturating_add(i.saturating_mul(*n)));
        let size = self.bytes_of_chunk().min(end.saturating_sub(address));
        Some(StoredChunk { start: start.to_vec(), address, size, mask: 0 })
    }

    /// The numbers of a chunk, as bytes.
    pub(super) fn bytes(&self, chunk: &StoredChunk) -> Result<Vec<u8>, String> {
        let num_bytes = self.bytes_of_chunk();
        if let DataPlace::Here(bytes) = &self.place {
            return Ok(bytes.clone());
        }
        // Filters add little to numbers that do not shrink.
        if chunk.size > num_bytes.saturating_mul(2).saturating_add(FILTER_BYTES) {
            return Err(format!("it has {} bytes, expected at most {num_bytes}", chunk.size));
        }
        let mut bytes = self.file.read(chunk.address, chunk.size)?;
        if matches!(self.place, DataPlace::At(_)) {
            // The last one along an axis is short.
            bytes.resize(num_bytes as usize, 0);
            return Ok(bytes);
        }
        for (i, codec) in self.filters.iter().enumerate().rev().filter(|(i, _)| chunk.mask >> i & 1 == 0) {
            let checksums = self.filters[..i].iter().filter(|f| **f == Codec::Fletcher32).count();
            bytes = codec.decode(&bytes, num_bytes as usize + 4 * checksums)?;
        }
        if bytes.len() as u64 != num_bytes {
            return Err(format!("it has {} bytes, expected {num_bytes}", bytes.len()));
        }
        Ok(bytes)
    }

    /// The numbers of these ranges along each axis, which are few, the last axis fastest.
    pub(super) fn numbers(&self, ranges: &[Range<u64>]) -> Result<Vec<f64>, String> {
        let sizes: Vec<u64> = ranges.iter().map(|range| range.end.saturating_sub(range.start)).collect();
        let count = sizes.iter().try_fold(1u64, |n, size| n.checked_mul(*size));
        let is_part = ranges.iter().zip(&self.shape).all(|(range, n)| range.end <= *n);
        let count =
            count.filter(|n| (1..=MAX_NUMBERS).contains(n) && is_part && ranges.len() == self.shape.len());
        let count = count.ok_or("it has too many numbers")? as usize;
        let size = self.dtype.num_bytes();
        let mut all = self.fill.repeat(count);
        let (to, from) = (strides(&sizes, size as u64), strides(&self.sides, size as u64));
        for chunk in self.starts(ranges).filter_map(|start| self.chunk(&start)) {
            let bytes = self.bytes(&chunk)?;
            let part = ranges.iter().zip(chunk.start.iter().zip(&self.sides));
            let part: Vec<Range<u64>> = part
                .map(|(range, (start, side))| {
                    range.start.max(*start)..range.end.min(start.saturating_add(*side))
                })
                .collect();
            let mut index: Vec<u64> = part.iter().map(|range| range.start).collect();
            loop {
                let place = |strides: &[u64], first: &mut dyn Iterator<Item = u64>| -> usize {
                    index
                        .iter()
                        .zip(first)
                        .zip(strides)
                        .map(|((i, first), n)| ((i - first) * n) as usize)
                        .sum()
                };
                let at = place(&from, &mut chunk.start.iter().copied());
                let number = bytes.get(at..at + size).ok_or("a chunk is short")?;
                let at = place(&to, &mut ranges.iter().map(|range| range.start));
                all[at..at + size].copy_from_slice(number);
                if !next_index(&mut index, &part) {
                    break;
                }
            }
        }
        Ok(numbers_from_bytes(&all, self.dtype, self.endian))
    }

    /// All numbers of a short array.
    pub(super) fn all_numbers(&self) -> Result<Vec<f64>, String> {
        self.numbers(&self.shape.iter().map(|n| 0..*n).collect::<Vec<_>>())
    }
}

impl StorageForm {
    /// How an array is stored, if it can be read.
    pub(super) fn of(contents: &ArrayFile, array: &Listed) -> Result<Self, String> {
        let size = array.kind.clone()?.0.num_bytes();
        if array.shape.is_empty() || array.shape.contains(&0) {
            return Err(format!("{} has no numbers", array.description()));
        }
        let (dataset, layout) = layout(contents, array)?;
        if layout == Layout::Virtual {
            return Err(format!(
                "{} is virtual: its numbers are in other files or arrays, expected it to have them",
                array.description()
            ));
        }
        if has_external_files(&contents.objects, array.at) {
            return Err(format!(
                "{} has its numbers in external files, expected it to have them",
                array.description()
            ));
        }
        let filters = dataset.filter_pipeline();
        if filters.len() != dataset.filters().len() || filters.len() > MAX_FILTERS {
            return Err("its filters cannot be read".into());
        }
        let codec = |filter: &Filter| {
            codec(filter, size).map_err(|name| format!("{} is packed by {name}, expected deflate, shuffle, Fletcher-32, LZF, LZ4, zstd, blosc or bitshuffle; `h5repack -f GZIP=4` packs it anew", array.description()))
        };
        let filters = filters.iter().map(codec).collect::<Result<_, _>>()?;
        Ok(Self { dataset, filters, layout })
    }
}

/// The layout of an array, told in a version that the reader of metadata knows.
fn layout(contents: &ArrayFile, array: &Listed) -> Result<(Dataset, Layout), String> {
    match array.dataset.layout() {
        Ok(layout) => Ok((array.dataset.clone(), layout)),
        Err(Error::Format(hdf5_pure::FormatError::InvalidLayoutVersion(_))) => {
            let size = array.kind.as_ref().map_or(0, |kind| kind.0.num_bytes() as u64);
            let num_bytes = array.shape.iter().fold(size, |n, side| n.saturating_mul(*side));
            tell_layout(&contents.objects, array.at, num_bytes)?;
            let dataset = contents.array(&array.path)?.dataset;
            let layout = dataset.layout().map_err(|e| problem(&e))?;
            Ok((dataset, layout))
        }
        Err(e) => Err(problem(&e)),
    }
}

/// Refuses chunks of more than `most_bytes`, and too many of them.
fn check_chunks(shape: &[u64], sides: &[u64], size: u64, most_bytes: u64) -> Result<(), String> {
    let num = sides.iter().zip(shape).try_fold(1u64, |n, (side, length)| {
        let along = length.checked_div(*side)?.checked_add(1)?;
        n.checked_mul(along)
    });
    let bytes = sides.iter().try_fold(size, |n, side| n.checked_mul(*side));
    if sides.len() != shape.len()
        || num.is_none_or(|n| n > 2 * MAX_CHUNKS)
        || bytes.is_none_or(|bytes| bytes > most_bytes)
    {
        return Err(format!("shape {shape:?} has chunks of {sides:?}, expected fewer or smaller ones"));
    }
    Ok(())
}

/// The chunks of an array with these sides and this index, in the order of their first numbers.
fn stored_chunks(
    contents: &ArrayFile,
    array: &Listed,
    dataset: &Dataset,
    (sides, index): (&[u64], ChunkIndex),
) -> Result<Vec<StoredChunk>, String> {
    let size = array.kind.as_ref().map_or(1, |kind| kind.0.num_bytes() as u64);
    let chunk_bytes = sides.iter().fold(size, |n, side| n.saturating_mul(*side));
    let mut chunks = if index == ChunkIndex::BTreeV2 {
        chunks_in_tree(&contents.objects, array.at, sides, chunk_bytes)?
    } else {
        let stored = |chunk: hdf5_pure::Chunk| StoredChunk {
            start: chunk.offset,
            address: chunk.address,
            size: chunk.storage_size,
            mask: chunk.filter_mask,
        };
        dataset.chunks().map_err(|e| problem(&e))?.into_iter().map(stored).collect()
    };
    if has_plain_edges(&contents.objects, array.at) {
        let ends = |chunk: &StoredChunk| {
            let mut axes = chunk.start.iter().zip(sides).zip(&array.shape);
            axes.any(|((start, side), n)| start.saturating_add(*side) > *n)
        };
        chunks.iter_mut().filter(|chunk| ends(chunk)).for_each(|chunk| chunk.mask = u32::MAX);
    }
    chunks.retain(|chunk| chunk.start.len() == sides.len());
    chunks.sort_unstable_by(|a, b| a.start.cmp(&b.start));
    Ok(chunks)
}

/// Bytes from a number to the next along each axis of a box.
fn strides(sizes: &[u64], bytes_per_number: u64) -> Vec<u64> {
    let mut strides = vec![bytes_per_number; sizes.len()];
    for axis in (1..sizes.len()).rev() {
        strides[axis - 1] = strides[axis].saturating_mul(sizes[axis]);
    }
    strides
}

/// How a filter packs; the error is its name.
fn codec(filter: &Filter, size: usize) -> Result<Codec, String> {
    Ok(match filter.id {
        1 => Codec::Zlib,
        2 => Codec::Shuffle(filter.client_data.first().map_or(size, |n| *n as usize)),
        3 => Codec::Fletcher32,
        32_000 => Codec::Lzf,
        32_001 => Codec::Blosc,
        32_004 => Codec::Lz4Blocks,
        32_008 => {
            let number = |i: usize| filter.client_data.get(i).copied().unwrap_or(0);
            let packing = match number(4) {
                0 => BitPacking::None,
                2 => BitPacking::Lz4,
                3 => BitPacking::Zstd,
                other => return Err(format!("bitshuffle of kind {other} (filter 32008)")),
            };
            let size = if number(2) > 0 { number(2) } else { size as u32 };
            Codec::BitShuffle { size, block: number(3), packing }
        }
        32_015 => Codec::Zstd,
        id => {
            let name = match id {
                4 => "szip",
                5 => "N-bit",
                6 => "scale-offset",
                32_013 => "ZFP",
                32_017 => "SZ",
                32_026 => "blosc2",
                _ => "another filter",
            };
            return Err(format!("{name} (filter {id})"));
        }
    })
}

/// Sides of blocks for reading what is in no chunks: whole rows, planes and so on of a few MiB.
fn divided(shape: &[u64], bytes_per_number: u64) -> Vec<u64> {
    let mut left = (READ_BYTES / bytes_per_number).max(1);
    let mut sides = vec![1; shape.len()];
    for (side, length) in sides.iter_mut().zip(shape).rev() {
        *side = left.min(*length).max(1);
        left = if side == length { left / *length } else { 1 };
    }
    sides
}

/// The numbers of rows as bytes, from the reader of metadata.
fn row(dataset: &Dataset, shape: &[u64], at: u64, num: u64, size: u64) -> Result<Vec<u8>, String> {
    let expected =
        shape[1..].iter().try_fold(size, |n, side| n.checked_mul(*side)).and_then(|n| n.checked_mul(num));
    let expected =
        expected.filter(|n| *n <= MAX_ROW_BYTES).ok_or("its numbers are more than the metadata may have")?;
    let bytes = dataset.read_raw_rows(at, num).map_err(|e| problem(&e))?;
    match bytes.len() as u64 == expected {
        true => Ok(bytes),
        false => Err(format!("it has {} bytes, expected {expected}", bytes.len())),
    }
}

/// What filters may add to the numbers.
const FILTER_BYTES: u64 = 1 << 16;
/// Most filters of an array.
const MAX_FILTERS: usize = 8;
/// Bytes to read at a time.
const READ_BYTES: u64 = 4 << 20;
/// Most bytes of numbers in the metadata.
const MAX_ROW_BYTES: u64 = 64 << 20;
/// Most numbers that are read as coordinates and the like.
const MAX_NUMBERS: u64 = 1 << 22;
