//! Blosc 1 containers (c-blosc, README_CHUNK_FORMAT): blocks of shuffled numbers in LZ4, zlib or zstd.

use std::io::Read;

use flate2::bufread::ZlibDecoder;

use super::shuffle::{bit_unshuffled, unshuffled};
use super::unpack_zstd;
use crate::dtype::Endian;
use crate::error::quoted;
use crate::header_bytes::HeaderBytes;

/// Decodes a container, to at most `most` bytes.
pub(super) fn decode(bytes: &[u8], most: usize) -> Result<Vec<u8>, String> {
    if bytes.len() < HEADER_BYTES {
        return Err("a blosc container ends within its header".into());
    }
    let w = HeaderBytes { bytes, endian: Endian::Little };
    let (flags, type_size) = (bytes[2], usize::from(bytes[3]).max(1));
    let (num_bytes, block_bytes) = (w.u32(4) as usize, w.u32(8) as usize);
    if num_bytes > most {
        return Err(format!("a blosc container of {num_bytes} bytes, expected at most {most}"));
    }
    if flags & MEMCPYED != 0 {
        let plain = bytes.get(HEADER_BYTES..HEADER_BYTES + num_bytes);
        return plain.map(<[u8]>::to_vec).ok_or_else(|| "a blosc container ends early".into());
    }
    let coder = flags >> 5;
    if !matches!(coder, LZ4 | ZLIB | ZSTD) {
        let name = match coder {
            0 => "blosclz",
            2 => "snappy",
            _ => "unknown",
        };
        return Err(format!("a blosc container packed by {name}, expected LZ4, zlib or zstd"));
    }
    let num_blocks = if block_bytes == 0 { 0 } else { num_bytes.div_ceil(block_bytes) };
    if num_blocks > bytes.len() / 4 || (num_bytes > 0 && block_bytes == 0) {
        return Err(format!("a blosc container of {num_blocks} blocks in {} bytes", bytes.len()));
    }
    let mut out = Vec::new();
    for i in 0..num_blocks {
        let size = block_bytes.min(num_bytes - i * block_bytes);
        let is_last_part = size < block_bytes;
        let num_streams = if flags & DONT_SPLIT == 0 && !is_last_part { type_size } else { 1 };
        if size % num_streams != 0 {
            return Err(format!("a blosc block of {size} bytes for {num_streams} streams"));
        }
        let mut at = w.u32(HEADER_BYTES + 4 * i) as usize;
        let mut block = Vec::new();
        for _ in 0..num_streams {
            let packed_bytes =
                bytes.get(at..).and_then(|rest| rest.first_chunk()).map(|b| u32::from_le_bytes(*b) as usize);
            let packed =
                packed_bytes.and_then(|n| bytes.get(at + 4..)?.get(..n)).ok_or("a blosc block ends early")?;
            at += 4 + packed.len();
            stream(packed, size / num_streams, coder, &mut block)?;
        }
        if flags & SHUFFLE != 0 && type_size > 1 {
            block = unshuffled(&block, type_size);
        } else if flags & BIT_SHUFFLE != 0 {
            block = bit_unshuffled(&block, type_size);
        }
        out.extend_from_slice(&block);
    }
    Ok(out)
}

/// Decodes a stream and appends its `size` bytes to `out`.
fn stream(packed: &[u8], size: usize, coder: u8, out: &mut Vec<u8>) -> Result<(), String> {
    let error = |e: &dyn std::fmt::Display| quoted(&e.to_string());
    if packed.len() == size {
        out.extend_from_slice(packed);
        return Ok(());
    }
    let start = out.len();
    match coder {
        LZ4 => {
            if size > packed.len().saturating_mul(256) {
                return Err("a blosc stream is too short".into());
            }
            out.resize(start + size, 0);
            let n = lz4_flex::block::decompress_into(packed, &mut out[start..]).map_err(|e| error(&e))?;
            out.truncate(start + n);
        }
        ZLIB => {
            ZlibDecoder::new(packed).take(size as u64).read_to_end(out).map_err(|e| error(&e))?;
        }
        _ => unpack_zstd(packed, size, out).map_err(|e| error(&e))?,
    }
    if out.len() == start + size {
        Ok(())
    } else {
        Err(format!("a blosc stream has {} bytes, expected {size}", out.len() - start))
    }
}

const HEADER_BYTES: usize = 16;
const SHUFFLE: u8 = 1;
const MEMCPYED: u8 = 2;
const BIT_SHUFFLE: u8 = 4;
const DONT_SPLIT: u8 = 16;
const LZ4: u8 = 1;
const ZLIB: u8 = 3;
const ZSTD: u8 = 4;
