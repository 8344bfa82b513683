//! What the metadata say of how a chunk was packed.

use serde_json::Value;

use super::array::Shard;
use super::json;
use crate::dtype::Endian;
use crate::error::quoted;
use crate::unpack::Codec;

/// The steps that turn the numbers of a chunk into bytes.
#[derive(Clone, Debug)]
pub(super) struct Codecs {
    /// The order of the axes in a chunk, the slowest first.
    pub(super) order: Vec<usize>,
    pub(super) endian: Endian,
    /// The codecs for the bytes, in the order of writing.
    pub(super) packed: Vec<Codec>,
}

/// The compressor of an array in version 2.
pub(super) fn compressor_of(value: &Value) -> Result<Codec, String> {
    let id = value["id"].as_str().unwrap_or_default();
    Ok(match id {
        "gzip" => Codec::Gzip,
        "zlib" => Codec::Zlib,
        "zstd" => Codec::Zstd,
        "blosc" => Codec::Blosc,
        "lz4" => Codec::Lz4,
        _ => {
            return Err(format!("its compressor is {}, expected blosc, gzip, zlib, zstd or lz4", quoted(id)));
        }
    })
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

fn is_permutation(order: &[usize], n: usize) -> bool {
    let mut sorted = order.to_vec();
    sorted.sort_unstable();
    sorted.into_iter().eq(0..n)
}

/// Most codecs of an array.
const MAX_STEPS: usize = 4;
