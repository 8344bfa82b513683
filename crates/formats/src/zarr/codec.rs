//! Decodes the bytes of a chunk to its numbers.

use std::io::{self, Read};

use flate2::bufread::{MultiGzDecoder, ZlibDecoder};
use serde_json::Value;

use super::array::Shard;
use super::{blosc, json};
use crate::dtype::Endian;
use crate::error::quoted;

/// The steps that turn the numbers of a chunk into bytes.
#[derive(Clone, Debug)]
pub(super) struct Codecs {
    /// The order of the axes in a chunk, the slowest first.
    pub(super) order: Vec<usize>,
    pub(super) endian: Endian,
    /// The codecs for the bytes, in the order of writing.
    pub(super) packed: Vec<Codec>,
}

/// A codec for bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Codec {
    Gzip,
    Zlib,
    Zstd,
    Blosc,
    /// A block of LZ4 after its length.
    Lz4,
    /// A checksum of four bytes at the end, which is verified.
    Crc32c,
}

impl Codec {
    pub(super) fn of_version_2(value: &Value) -> Result<Self, String> {
        let id = value["id"].as_str().unwrap_or_default();
        Ok(match id {
            "gzip" => Self::Gzip,
            "zlib" => Self::Zlib,
            "zstd" => Self::Zstd,
            "blosc" => Self::Blosc,
            "lz4" => Self::Lz4,
            _ => {
                return Err(format!(
                    "its compressor is {}, expected blosc, gzip, zlib, zstd or lz4",
                    quoted(id)
                ));
            }
        })
    }

    /// Decodes to at most `most` bytes.
    fn decode(self, bytes: &[u8], most: usize) -> Result<Vec<u8>, String> {
        let error = |e: &dyn std::fmt::Display| quoted(&e.to_string());
        let mut out = Vec::new();
        let mut all = |reader: &mut dyn Read| -> io::Result<()> {
            reader.take(most as u64).read_to_end(&mut out).map(drop)
        };
        match self {
            Self::Gzip => all(&mut MultiGzDecoder::new(bytes)).map_err(|e| error(&e))?,
            Self::Zlib => all(&mut ZlibDecoder::new(bytes)).map_err(|e| error(&e))?,
            Self::Zstd => unpack_zstd(bytes, most, &mut out).map_err(|e| error(&e))?,
            Self::Blosc => out = blosc::decode(bytes, most)?,
            Self::Lz4 => {
                let (length, rest) = bytes.split_first_chunk().ok_or("it ends early")?;
                let length =
                    (u32::from_le_bytes(*length) as usize).min(most).min(rest.len().saturating_mul(256));
                out.resize(length, 0);
                let n = lz4_flex::block::decompress_into(rest, &mut out).map_err(|e| error(&e))?;
                out.truncate(n);
            }
            Self::Crc32c => {
                let (data, sum) = bytes.split_last_chunk().ok_or("it ends early")?;
                if crc32c(data) != u32::from_le_bytes(*sum) {
                    return Err("its checksum does not match".into());
                }
                out = data.to_vec();
            }
        }
        Ok(out)
    }
}

impl Codecs {
    /// The codecs of an array in version 3, and its shards.
    pub(super) fn of_version_3(list: &[Value], num_axes: usize) -> Result<(Self, Option<Shard>), String> {
        let mut codecs = Self { order: (0..num_axes).collect(), endian: Endian::Little, packed: Vec::new() };
        let mut shard = None;
        for value in list {
            let name = value["name"].as_str().unwrap_or_default();
            let configuration = value.get("configuration");
            let get = |key: &str| configuration.and_then(|c| c.get(key));
            match name {
                "bytes" => {
                    if get("endian").and_then(Value::as_str) == Some("big") {
                        codecs.endian = Endian::Big;
                    }
                }
                "transpose" if codecs.packed.is_empty() && shard.is_none() => {
                    let order: Option<Vec<usize>> = get("order").and_then(Value::as_array).and_then(|l| {
                        l.iter().map(|v| v.as_u64().and_then(|n| usize::try_from(n).ok())).collect()
                    });
                    let order = order
                        .filter(|o| is_permutation(o, num_axes))
                        .ok_or("transpose has no order of its axes")?;
                    codecs.order = order.iter().map(|&i| codecs.order[i]).collect();
                }
                "sharding_indexed" if codecs.packed.is_empty() && shard.is_none() && list.len() == 1 => {
                    let inner = get("codecs").and_then(Value::as_array).ok_or("shards have no codecs")?;
                    let (inner, nested) = Self::of_version_3(inner, num_axes)?;
                    if nested.is_some() {
                        return Err("shards within shards, expected one level of them".into());
                    }
                    let index = get("index_codecs").and_then(Value::as_array).map_or(&[][..], |l| l);
                    let names: Vec<&str> = index.iter().filter_map(|c| c.get("name")?.as_str()).collect();
                    if names.iter().any(|n| !matches!(*n, "bytes" | "crc32c")) {
                        return Err("the index of a shard is compressed, expected bytes and crc32c".into());
                    }
                    shard = Some(Shard {
                        chunk: json::numbers(get("chunk_shape"), "chunk_shape")?,
                        is_index_first: get("index_location").and_then(Value::as_str) == Some("start"),
                        has_checksum: names.contains(&"crc32c"),
                    });
                    codecs = inner;
                }
                "gzip" => codecs.packed.push(Codec::Gzip),
                "zstd" => codecs.packed.push(Codec::Zstd),
                "blosc" => codecs.packed.push(Codec::Blosc),
                "crc32c" => codecs.packed.push(Codec::Crc32c),
                "numcodecs.zlib" | "zlib" => codecs.packed.push(Codec::Zlib),
                "numcodecs.lz4" | "lz4" => codecs.packed.push(Codec::Lz4),
                _ => {
                    return Err(format!(
                        "it has codec {} in this place, expected transpose, bytes, sharding_indexed, blosc, gzip, zstd or crc32c",
                        quoted(name)
                    ));
                }
            }
        }
        if codecs.packed.len() > MAX_STEPS {
            return Err(format!("it has {} codecs, expected at most {MAX_STEPS}", codecs.packed.len()));
        }
        Ok((codecs, shard))
    }

    /// The bytes of the numbers of a chunk, `num_bytes` in all.
    pub(super) fn decode(&self, bytes: Vec<u8>, num_bytes: usize) -> Result<Vec<u8>, String> {
        let mut bytes = bytes;
        for codec in self.packed.iter().rev() {
            // A checksum inside another codec adds four bytes.
            bytes = codec.decode(&bytes, num_bytes + 4 * self.packed.len())?;
        }
        if bytes.len() != num_bytes {
            return Err(format!("it has {} bytes, expected {num_bytes}", bytes.len()));
        }
        Ok(bytes)
    }
}

/// Decodes the frames in `packed` and appends at most `most` bytes to `out`. The window of a frame may have this
/// size, or the 8 MiB that every decoder should support (RFC 8878, section 3.1.1.1.2).
pub(super) fn unpack_zstd(packed: &[u8], most: usize, out: &mut Vec<u8>) -> io::Result<()> {
    let mut decoder = zstd::Decoder::with_buffer(packed)?;
    decoder.window_log_max(most.clamp(LEAST_WINDOW_BYTES, MOST_WINDOW_BYTES).next_power_of_two().ilog2())?;
    decoder.take(most as u64).read_to_end(out).map(drop)
}

fn is_permutation(order: &[usize], n: usize) -> bool {
    let mut sorted = order.to_vec();
    sorted.sort_unstable();
    sorted.into_iter().eq(0..n)
}

/// CRC-32C (Castagnoli), a byte at a time.
pub(super) fn crc32c(bytes: &[u8]) -> u32 {
    const TABLE: [u32; 256] = {
        let mut table = [0; 256];
        let mut i = 0;
        while i < 256 {
            let (mut crc, mut bit) = (i as u32, 0);
            while bit < 8 {
                crc = if crc & 1 == 1 { crc >> 1 ^ 0x82f6_3b78 } else { crc >> 1 };
                bit += 1;
            }
            table[i] = crc;
            i += 1;
        }
        table
    };
    !bytes.iter().fold(u32::MAX, |crc, b| TABLE[usize::from(crc as u8 ^ b)] ^ crc >> 8)
}

/// Most codecs of an array.
const MAX_STEPS: usize = 4;
const LEAST_WINDOW_BYTES: usize = 8 << 20;
/// The largest window that the reference decoder accepts by default.
const MOST_WINDOW_BYTES: usize = 128 << 20;

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    #[test]
    fn zstd_gives_no_more_bytes_and_takes_no_more_memory_than_allowed() {
        let unpacked = |packed: &[u8], most: usize| {
            let mut out = Vec::new();
            unpack_zstd(packed, most, &mut out).map(|()| out.len())
        };
        let packed = zstd::bulk::compress(&[7; 5000], 1).unwrap();
        assert_eq!(unpacked(&packed, 5000).unwrap(), 5000);
        assert_eq!(unpacked(&packed, 1000).unwrap(), 1000);
        let mut encoder = zstd::Encoder::new(Vec::new(), 1).unwrap();
        encoder.window_log(24).unwrap();
        encoder.write_all(&[7; 5000]).unwrap();
        let packed = encoder.finish().unwrap();
        assert!(unpacked(&packed, 5000).is_err(), "the window has 16 MiB");
        assert_eq!(unpacked(&packed, 16 << 20).unwrap(), 5000);
    }

    #[test]
    fn the_checksum_is_that_of_the_standard() {
        // RFC 3720, B.4: 32 bytes of zeros, of ones, and ascending.
        assert_eq!(crc32c(&[0; 32]), 0x8a91_36aa);
        assert_eq!(crc32c(&[0xff; 32]), 0x62a8_ab43);
        assert_eq!(crc32c(&(0..32).collect::<Vec<u8>>()), 0x46dd_794e);
    }
}
