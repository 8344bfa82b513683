//! Blosc 1 containers (c-blosc, README_CHUNK_FORMAT): blocks of shuffled numbers in LZ4, zlib or zstd.

use std::io::Read;

use flate2::bufread::ZlibDecoder;

use super::shuffle::{bit_unshuffled, shuffled, unshuffled};
use super::unpack_zstd;
use crate::dtype::Endian;
use crate::error::quoted;
use crate::header_bytes::HeaderBytes;

/// Decodes a container, to at most `most` bytes.
pub(crate) fn decode(bytes: &[u8], most: usize) -> Result<Vec<u8>, String> {
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

/// Encodes numbers of `type_size` bytes in a container of one block, shuffled and packed by zstd.
pub(crate) fn encode(bytes: &[u8], type_size: usize) -> Result<Vec<u8>, String> {
    let size =
        |n: usize| u32::try_from(n).map_err(|_| format!("a chunk of {n} bytes, expected fewer than 4 GiB"));
    let shuffled = if type_size > 1 { Some(shuffled(bytes, type_size)) } else { None };
    let packed = zstd::bulk::compress(shuffled.as_deref().unwrap_or(bytes), LEVEL);
    let packed = packed.map_err(|e| quoted(&e.to_string()))?;
    let num_more = HEADER_BYTES + 8;
    let is_packed = packed.len() + num_more < bytes.len() + HEADER_BYTES;
    let mut flags = SHUFFLE | DONT_SPLIT | ZSTD << 5;
    if !is_packed {
        flags |= MEMCPYED;
    }
    let whole = if is_packed { num_more + packed.len() } else { HEADER_BYTES + bytes.len() };
    let mut out = Vec::with_capacity(whole);
    out.extend([FORMAT, ZSTD_FORMAT, flags, type_size as u8]);
    for number in [bytes.len(), bytes.len(), whole] {
        out.extend(size(number)?.to_le_bytes());
    }
    if is_packed {
        // The place of the one block, and the length of its one stream.
        out.extend(size(HEADER_BYTES + 4)?.to_le_bytes());
        out.extend(size(packed.len())?.to_le_bytes());
        out.extend(packed);
    } else {
        out.extend_from_slice(bytes);
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

/// The version of the format and of its zstd streams.
const FORMAT: u8 = 2;
const ZSTD_FORMAT: u8 = 1;
/// The level of zstd. Higher ones take much longer, and pack a scan hardly better.
const LEVEL: i32 = 3;
const HEADER_BYTES: usize = 16;
const SHUFFLE: u8 = 1;
const MEMCPYED: u8 = 2;
const BIT_SHUFFLE: u8 = 4;
const DONT_SPLIT: u8 = 16;
const LZ4: u8 = 1;
const ZLIB: u8 = 3;
const ZSTD: u8 = 4;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_encoded_is_decoded() {
        let mut random = 1u32;
        let mut noise = || {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (random >> 24) as u8
        };
        for type_size in [1, 2, 4, 8] {
            for length in [0, type_size, 8 * type_size, 4096 * type_size] {
                let smooth: Vec<u8> = (0..length).map(|i| (i / 64) as u8).collect();
                let rough: Vec<u8> = (0..length).map(|_| noise()).collect();
                for bytes in [smooth, rough] {
                    let packed = encode(&bytes, type_size).unwrap();
                    assert_eq!(decode(&packed, length).unwrap(), bytes, "{type_size} {length}");
                    assert!(packed.len() <= length + HEADER_BYTES);
                    assert_eq!(packed[12..16], (packed.len() as u32).to_le_bytes());
                    // The control: a container that lost its end.
                    if length > 0 {
                        assert!(decode(&packed[..packed.len() - 1], length).is_err());
                    }
                }
            }
        }
        let smooth: Vec<u8> = (0..8192u16).flat_map(|i| (i / 3).to_le_bytes()).collect();
        let packed = encode(&smooth, 2).unwrap();
        assert!(packed.len() < smooth.len() / 10, "{}", packed.len());
    }
}
