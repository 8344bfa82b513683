//! Where the numbers of an array are in the file, and how they are packed.

use std::sync::Arc;

use hdf5_pure::{ChunkIndex, Dataset, Error, Filter, Layout};

use super::contents::{ArrayFile, Listed, problem};
use super::source::SharedFile;
use crate::chunk_grid::{MAX_CHUNKS, next_index, place_chunk};
use crate::dtype::{Dtype, Endian, numbers_from_bytes};
use crate::unpack::Codec;

/// The numbers of an array in the file.
pub(super) struct Storage {
    file: Arc<SharedFile>,
    pub(super) path: String,
    pub(super) shape: Vec<u64>,
    pub(super) dtype: Dtype,
    pub(super) endian: Endian,
    /// Numbers of a chunk along each axis. What is not in chunks is divided for reading.
    pub(super) sides: Vec<u64>,
    /// The order of the axes in a chunk.
    pub(super) order: Vec<usize>,
    place: Place,
    /// The filters, in the order of writing.
    filters: Vec<Codec>,
    /// The bytes of a number that is not stored.
    pub(super) fill: Vec<u8>,
}

enum Place {
    Nowhere,
    /// In the metadata.
    Here(Vec<u8>),
    /// One after the other from this byte on.
    At(u64),
    Chunks(Vec<StoredChunk>),
}

/// A chunk in the file.
#[derive(Clone)]
pub(super) struct StoredChunk {
    /// Its first number along each axis.
    pub(super) start: Vec<u64>,
    address: u64,
    size: u64,
    /// A bit for each filter that it was not packed by.
    mask: u32,
}

impl Storage {
    /// Finds the numbers of an array. A chunk may have at most `most_bytes`.
    pub(super) fn of(contents: &ArrayFile, array: &Listed, most_bytes: u64) -> Result<Self, String> {
        let (dtype, endian) = array.kind.clone()?;
        let dataset = &array.dataset;
        let (filters, layout) = check(array)?;
        let size = dtype.num_bytes() as u64;
        let shape = array.shape.clone();
        let mut fill = vec![0; size as usize];
        let (sides, place) = match layout {
            Layout::Compact { .. } => (shape.clone(), Place::Here(row(dataset, &shape, 0, shape[0], size)?)),
            Layout::Contiguous { address: Some(address), .. } => (divided(&shape, size), Place::At(address)),
            Layout::Chunked { chunk_shape, .. } => {
                let num = chunk_shape.iter().zip(&shape).try_fold(1u64, |n, (side, length)| {
                    let along = length.checked_div(*side)?.checked_add(1)?;
                    n.checked_mul(along)
                });
                let bytes = chunk_shape.iter().try_fold(size, |n, side| n.checked_mul(*side));
                if chunk_shape.len() != shape.len()
                    || num.is_none_or(|n| n > 2 * MAX_CHUNKS)
                    || bytes.is_none_or(|bytes| bytes > most_bytes)
                {
                    return Err(format!(
                        "shape {shape:?} has chunks of {chunk_shape:?}, expected fewer or smaller ones"
                    ));
                }
                let chunks = dataset.chunks().map_err(|e| problem(&e))?;
                let chunks = chunks.into_iter().map(|chunk| StoredChunk {
                    start: chunk.offset,
                    address: chunk.address,
                    size: chunk.storage_size,
                    mask: chunk.filter_mask,
                });
                let chunks: Vec<StoredChunk> = chunks.collect();
                if let Some(empty) = empty_row(&shape, &chunk_shape, &chunks) {
                    fill = fill_of(dataset, &shape, empty, size)?;
                }
                (chunk_shape, Place::Chunks(chunks))
            }
            _ => {
                fill = fill_of(dataset, &shape, 0, size)?;
                (divided(&shape, size), Place::Nowhere)
            }
        };
        let order = (0..shape.len()).collect();
        let (file, path) = (Arc::clone(&contents.bytes), array.path.clone());
        Ok(Self { file, path, shape, dtype, endian, sides, order, place, filters, fill })
    }

    fn bytes_of_chunk(&self) -> u64 {
        self.sides.iter().fold(self.dtype.num_bytes() as u64, |n, side| n.saturating_mul(*side))
    }

    /// The chunks that are stored and that `is_wanted` by their first number.
    pub(super) fn chunks(&self, is_wanted: impl Fn(&[u64]) -> bool) -> Vec<StoredChunk> {
        let at = match &self.place {
            Place::Chunks(chunks) => return chunks.iter().filter(|c| is_wanted(&c.start)).cloned().collect(),
            Place::Nowhere => return Vec::new(),
            Place::Here(_) => 0,
            Place::At(address) => *address,
        };
        let size = self.dtype.num_bytes() as u64;
        let mut strides = vec![size; self.shape.len()];
        for axis in (1..self.shape.len()).rev() {
            strides[axis - 1] = strides[axis].saturating_mul(self.shape[axis]);
        }
        let end = at.saturating_add(strides[0].saturating_mul(self.shape[0]));
        let counts: Vec<_> =
            self.shape.iter().zip(&self.sides).map(|(n, side)| 0..n.div_ceil(*side)).collect();
        let mut index = vec![0; counts.len()];
        let mut found = Vec::new();
        loop {
            let start: Vec<u64> = index.iter().zip(&self.sides).map(|(i, side)| i * side).collect();
            if is_wanted(&start) {
                let offset = start
                    .iter()
                    .zip(&strides)
                    .fold(at, |sum, (i, n)| sum.saturating_add(i.saturating_mul(*n)));
                let size = self.bytes_of_chunk().min(end.saturating_sub(offset));
                found.push(StoredChunk { start, address: offset, size, mask: 0 });
            }
            if !next_index(&mut index, &counts) {
                return found;
            }
        }
    }

    /// The numbers of a chunk, as bytes.
    pub(super) fn bytes(&self, chunk: &StoredChunk) -> Result<Vec<u8>, String> {
        let num_bytes = self.bytes_of_chunk();
        if let Place::Here(bytes) = &self.place {
            return Ok(bytes.clone());
        }
        // Filters add little to numbers that do not shrink.
        if chunk.size > num_bytes.saturating_mul(2).saturating_add(FILTER_BYTES) {
            return Err(format!("it has {} bytes, expected at most {num_bytes}", chunk.size));
        }
        let mut bytes = self.file.read(chunk.address, chunk.size)?;
        if matches!(self.place, Place::At(_)) {
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

    /// All numbers of a short array with one axis or two, the last one fastest.
    pub(super) fn all_numbers(&self) -> Result<Vec<f64>, String> {
        let shape = (self.shape.len() <= 2).then_some(&self.shape[..]);
        let count = shape.and_then(|shape| shape.iter().try_fold(1u64, |n, side| n.checked_mul(*side)));
        let count = count.filter(|n| *n <= MAX_NUMBERS).ok_or("it has more axes, or is long")?;
        let mut all = self.fill.repeat(count as usize);
        for chunk in self.chunks(|start| start.len() == self.shape.len()) {
            let bytes = self.bytes(&chunk)?;
            place_chunk(&mut all, &self.shape, (&chunk.start, &self.sides), &bytes, self.dtype.num_bytes());
        }
        Ok(numbers_from_bytes(&all, self.dtype, self.endian))
    }
}

/// The filters of an array and its layout, if both can be read.
pub(super) fn check(array: &Listed) -> Result<(Vec<Codec>, Layout), String> {
    let dataset = &array.dataset;
    let size = array.kind.clone()?.0.num_bytes();
    if array.shape.is_empty() || array.shape.contains(&0) {
        return Err(format!("{} has no numbers", array.description()));
    }
    let layout = dataset.layout().map_err(|e| match e {
        Error::Format(hdf5_pure::FormatError::InvalidLayoutVersion(version)) => format!(
            "{} is stored as only new versions of HDF5 do (layout {version}), expected libver=\"v114\" or an earlier one",
            array.description()
        ),
        e => problem(&e),
    })?;
    if matches!(layout, Layout::Chunked { index: ChunkIndex::BTreeV2, .. }) {
        return Err(format!(
            "{} may grow along several axes (B-tree of version 2), expected one; `h5repack` with `--high=1` stores it anew",
            array.description()
        ));
    }
    if layout == Layout::Virtual {
        return Err(format!(
            "{} is virtual: its numbers are in other files or arrays, expected it to have them",
            array.description()
        ));
    }
    let filters = dataset.filter_pipeline();
    if filters.len() != dataset.filters().len() || filters.len() > MAX_FILTERS {
        return Err("its filters cannot be read".into());
    }
    let codec = |filter: &Filter| {
        codec(filter, size).map_err(|name| format!("{} is packed by {name}, expected deflate, shuffle, Fletcher-32, LZF, LZ4, zstd or blosc; `h5repack -f GZIP=4` packs it anew", array.description()))
    };
    Ok((filters.iter().map(codec).collect::<Result<_, _>>()?, layout))
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
        32_015 => Codec::Zstd,
        id => {
            let name = match id {
                4 => "szip",
                5 => "N-bit",
                6 => "scale-offset",
                32_008 => "bitshuffle",
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

/// A number along the slowest axis at which no chunk is stored.
fn empty_row(shape: &[u64], sides: &[u64], chunks: &[StoredChunk]) -> Option<u64> {
    let num_rows = shape[0].div_ceil(sides[0]);
    let mut is_there = vec![false; num_rows as usize];
    for chunk in chunks {
        if let Some(there) = is_there.get_mut((chunk.start[0] / sides[0]) as usize) {
            *there = true;
        }
    }
    is_there.iter().position(|there| !there).map(|i| i as u64 * sides[0])
}

/// The fill value, which the reader of metadata tells only as the numbers of a row that is not stored.
fn fill_of(dataset: &Dataset, shape: &[u64], at: u64, size: u64) -> Result<Vec<u8>, String> {
    let bytes = shape[1..].iter().try_fold(size, |n, side| n.checked_mul(*side));
    if bytes.is_none_or(|bytes| bytes > MAX_ROW_BYTES) {
        return Ok(vec![0; size as usize]);
    }
    let mut row = row(dataset, shape, at, 1, size)?;
    row.truncate(size as usize);
    Ok(row)
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
/// Most bytes of a row that is read for its fill value, or of numbers in the metadata.
const MAX_ROW_BYTES: u64 = 64 << 20;
/// Most numbers of a short array.
const MAX_NUMBERS: u64 = 1 << 22;
