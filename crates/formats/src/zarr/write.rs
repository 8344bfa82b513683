//! Writes arrays of Zarr version 2 with blosc and zstd, which every reader of OME-Zarr knows.

use std::fs;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use crate::dtype::Dtype;
use crate::error::{FormatError, io_error, shown};
use crate::output::write_synced;
use crate::unpack::blosc;

/// An array with axes t, c, z, y and x, of which t and c may be missing.
#[derive(Clone, Debug)]
pub(crate) struct ArrayWriter {
    folder: PathBuf,
    /// Voxels along x, y and z.
    dims: [u64; 3],
    /// Sides of a chunk along x, y and z.
    chunk: [u64; 3],
    /// Points in time and channels; `None` if there is no such axis.
    more: [Option<u64>; 2],
    dtype: Dtype,
}

impl ArrayWriter {
    /// An array in `folder` of `dims` voxels along x, y and z, in chunks of at most `side` a side.
    pub(crate) fn new(
        folder: PathBuf,
        dims: [u64; 3],
        side: u64,
        num_times: Option<u64>,
        num_channels: Option<u64>,
        dtype: Dtype,
    ) -> Self {
        Self { folder, dims, chunk: dims.map(|n| n.min(side)), more: [num_times, num_channels], dtype }
    }

    /// Voxels along x, y and z.
    pub(crate) fn dims(&self) -> [u64; 3] {
        self.dims
    }

    /// Sides of a chunk along x, y and z.
    pub(crate) fn chunk(&self) -> [u64; 3] {
        self.chunk
    }

    /// Chunks along x, y and z.
    pub(crate) fn num_chunks(&self) -> [u64; 3] {
        std::array::from_fn(|k| self.dims[k].div_ceil(self.chunk[k]))
    }

    /// Bytes of a chunk that is not packed.
    pub(crate) fn bytes_of_chunk(&self) -> u64 {
        self.chunk.iter().product::<u64>() * self.dtype.num_bytes() as u64
    }

    /// Writes the metadata, with the attributes of the array.
    ///
    /// # Errors
    /// The system refuses.
    pub(crate) fn describe(&self, attributes: &Value) -> Result<(), FormatError> {
        let with_more = |more: [Option<u64>; 2], space: [u64; 3]| -> Vec<u64> {
            more.into_iter().flatten().chain(space.into_iter().rev()).collect()
        };
        let document = json!({
            "zarr_format": 2,
            "shape": with_more(self.more, self.dims),
            "chunks": with_more(self.more.map(|n| n.map(|_| 1)), self.chunk),
            "dtype": numpy_name(self.dtype),
            "compressor": {"id": "blosc", "cname": "zstd", "clevel": 3, "shuffle": 1, "blocksize": 0},
            "fill_value": 0,
            "filters": null,
            "order": "C",
            "dimension_separator": "/",
        });
        fs::create_dir_all(&self.folder).map_err(io_error(&self.folder))?;
        write_document(&self.folder.join(".zarray"), &document)?;
        if attributes.as_object().is_some_and(|list| !list.is_empty()) {
            write_document(&self.folder.join(".zattrs"), attributes)?;
        }
        Ok(())
    }

    fn chunk_path(&self, [time, channel]: [u64; 2], [x, y, z]: [u64; 3]) -> PathBuf {
        let more = self.more.iter().zip([time, channel]).filter(|(axis, _)| axis.is_some()).map(|(_, i)| i);
        let words: Vec<String> = more.chain([z, y, x]).map(|i| i.to_string()).collect();
        self.folder.join(words.join("/"))
    }

    /// Writes a chunk of a time and channel, by its number along x, y and z. `numbers` are little-endian, x fastest.
    /// They have the size `found` along x, y and z; the rest of the chunk is filled by zeros.
    ///
    /// # Errors
    /// The system refuses.
    pub(crate) fn write(
        &self,
        time_and_channel: [u64; 2],
        at: [u64; 3],
        numbers: &[u8],
        found: [u64; 3],
    ) -> Result<(), FormatError> {
        let path = self.chunk_path(time_and_channel, at);
        let damaged = |problem| FormatError::Data { path: shown(&path), problem };
        let size = self.dtype.num_bytes();
        let packed = match found == self.chunk {
            true => blosc::encode(numbers, size),
            false => blosc::encode(&self.filled_up(numbers, found), size),
        };
        write_in_folder(&path, &packed.map_err(damaged)?).map_err(io_error(&path))
    }

    /// A whole chunk of numbers that do not fill it.
    fn filled_up(&self, numbers: &[u8], found: [u64; 3]) -> Vec<u8> {
        let size = self.dtype.num_bytes();
        let [nx, ny, _] = self.chunk.map(|n| n as usize);
        let [fx, fy, _] = found.map(|n| n as usize);
        let mut whole = vec![0; self.bytes_of_chunk() as usize];
        for (row, from) in numbers.chunks_exact((fx * size).max(1)).enumerate() {
            let to = (row / fy.max(1) * ny + row % fy.max(1)) * nx * size;
            whole[to..to + from.len()].copy_from_slice(from);
        }
        whole
    }

    /// Voxels of a chunk along x, y and z that the array has.
    pub(crate) fn found_in(&self, at: [u64; 3]) -> [u64; 3] {
        std::array::from_fn(|k| self.chunk[k].min(self.dims[k].saturating_sub(at[k] * self.chunk[k])))
    }

    /// Reads a whole chunk that was written.
    ///
    /// # Errors
    /// It is missing or damaged.
    pub(crate) fn read(&self, time_and_channel: [u64; 2], at: [u64; 3]) -> Result<Vec<u8>, FormatError> {
        let path = self.chunk_path(time_and_channel, at);
        let packed = fs::read(&path).map_err(io_error(&path))?;
        let num_bytes = self.bytes_of_chunk() as usize;
        let found = blosc::decode(&packed, num_bytes).and_then(|bytes| match bytes.len() == num_bytes {
            true => Ok(bytes),
            false => Err(format!("it has {} bytes, expected {num_bytes}", bytes.len())),
        });
        found
            .map_err(|problem| FormatError::Data { path: shown(&path), problem: format!("chunk: {problem}") })
    }
}

/// Writes a document.
///
/// # Errors
/// The system refuses.
pub(crate) fn write_document(path: &Path, document: &Value) -> Result<(), FormatError> {
    let text = serde_json::to_string_pretty(document).map_err(|e| io_error(path)(io::Error::other(e)))?;
    write_synced(path, (text + "\n").as_bytes()).map_err(io_error(path))
}

/// Writes a file, and its folder if that is missing.
fn write_in_folder(path: &Path, bytes: &[u8]) -> io::Result<()> {
    match write_synced(path, bytes) {
        Err(e) if e.kind() == ErrorKind::NotFound => {
            path.parent().map_or(Ok(()), fs::create_dir_all)?;
            write_synced(path, bytes)
        }
        done => done,
    }
}

/// The name of a type in NumPy, little-endian.
fn numpy_name(dtype: Dtype) -> &'static str {
    match dtype {
        Dtype::Int8 => "|i1",
        Dtype::Uint8 => "|u1",
        Dtype::Int16 => "<i2",
        Dtype::Uint16 => "<u2",
        Dtype::Int32 => "<i4",
        Dtype::Uint32 => "<u4",
        Dtype::Int64 => "<i8",
        Dtype::Uint64 => "<u8",
        Dtype::Half => "<f2",
        Dtype::Float => "<f4",
        Dtype::Double => "<f8",
    }
}
