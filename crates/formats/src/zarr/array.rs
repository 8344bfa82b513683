//! The metadata of an array in Zarr version 2 or 3, and the paths of its chunks.

use std::path::{Path, PathBuf};

use serde_json::Value;

use super::codec::{Codecs, compressor_of};
use super::json;
use super::store::Store;
use crate::dtype::{Dtype, Endian, numbers_from_bytes};
use crate::error::{FormatError, malformed, quoted};

/// An array. Axes are slowest first, as in the format.
#[derive(Clone, Debug)]
pub(super) struct Array {
    pub(super) path: PathBuf,
    pub(super) shape: Vec<u64>,
    /// Size of a chunk or shard along each axis, in numbers.
    pub(super) chunk: Vec<u64>,
    /// The chunks of a shard, if there are shards.
    pub(super) shard: Option<Shard>,
    pub(super) dtype: Dtype,
    /// The bytes of a number that is not stored.
    pub(super) fill: Vec<u8>,
    pub(super) codecs: Codecs,
    /// Separator of the numbers in the name of a chunk, and the prefix before them.
    separator: char,
    prefix: &'static str,
    pub(super) version: u8,
}

#[derive(Clone, Debug)]
pub(super) struct Shard {
    pub(super) chunk: Vec<u64>,
    pub(super) is_index_first: bool,
    pub(super) has_checksum: bool,
}

impl Array {
    /// Reads the array in the folder `path`.
    pub(super) fn read(store: &Store, path: &Path) -> Result<Self, FormatError> {
        let (value, version) = match json::read(store, &path.join("zarr.json"))? {
            Some(value) => (value, 3),
            None => (json::require(store, &path.join(".zarray"))?, 2),
        };
        Self::of(path, &value, version)
    }

    /// The array in the folder `path`, which `value` describes.
    pub(super) fn of(path: &Path, value: &Value, version: u8) -> Result<Self, FormatError> {
        let array = if version == 3 { Self::of_version_3(value) } else { Self::of_version_2(value) };
        let bad = malformed(path, "Zarr array");
        let mut array = array.and_then(Self::checked).map_err(bad)?;
        array.path = path.to_owned();
        Ok(array)
    }

    fn checked(self) -> Result<Self, String> {
        let inner = self.shard.as_ref().map_or(&self.chunk, |s| &s.chunk);
        let n = self.shape.len();
        let fits =
            self.chunk.iter().zip(inner).all(|(outer, inner)| *inner > 0 && outer.is_multiple_of(*inner));
        if !(1..=MAX_AXES).contains(&n) || self.chunk.len() != n || inner.len() != n || !fits {
            return Err(format!(
                "shape {:?} has chunks of {:?} and {inner:?}, expected as many numbers, above zero",
                self.shape, self.chunk
            ));
        }
        let count =
            |sides: &[u64]| sides.iter().try_fold(self.dtype.num_bytes() as u64, |n, s| n.checked_mul(*s));
        if count(&self.chunk).is_none() || self.codecs.order.len() != n {
            return Err(format!(
                "chunks of {:?} are too large, or their codecs are for other axes",
                self.chunk
            ));
        }
        Ok(self)
    }

    fn of_version_2(value: &Value) -> Result<Self, String> {
        let dtype = value["dtype"].as_str().ok_or("its dtype is not one number")?;
        let (endian, kind) = match dtype.split_at_checked(1) {
            Some((">", kind)) => (Endian::Big, kind),
            Some(("<" | "|", kind)) => (Endian::Little, kind),
            _ => (Endian::Little, dtype),
        };
        let dtype = Dtype::from_numpy(kind).ok_or_else(|| {
            format!("its type is {}, expected b1, i1 to i8, u1 to u8 or f2 to f8", quoted(dtype))
        })?;
        let is_filtered = value["filters"].as_array().is_some_and(|f| !f.is_empty());
        if is_filtered {
            return Err("it has filters, expected none".into());
        }
        let shape = json::numbers(value.get("shape"), "shape")?;
        let num_axes = shape.len();
        let is_fortran = value["order"].as_str() == Some("F");
        let order = if is_fortran { (0..num_axes).rev().collect() } else { (0..num_axes).collect() };
        let compressor = value.get("compressor").filter(|c| !c.is_null());
        let packed = compressor.map(compressor_of).transpose()?.into_iter().collect();
        let separator = value["dimension_separator"].as_str().unwrap_or(".");
        Ok(Self {
            path: PathBuf::new(),
            chunk: json::numbers(value.get("chunks"), "chunks")?,
            shape,
            shard: None,
            dtype,
            fill: fill(value.get("fill_value"), dtype, endian)?,
            codecs: Codecs { order, endian, packed },
            separator: if separator == "/" { '/' } else { '.' },
            prefix: "",
            version: 2,
        })
    }

    fn of_version_3(value: &Value) -> Result<Self, String> {
        let kind = value["data_type"].as_str().unwrap_or_default();
        let dtype = match kind {
            "bool" | "uint8" => Dtype::Uint8,
            "int8" => Dtype::Int8,
            "uint16" => Dtype::Uint16,
            "int16" => Dtype::Int16,
            "uint32" => Dtype::Uint32,
            "int32" => Dtype::Int32,
            "uint64" => Dtype::Uint64,
            "int64" => Dtype::Int64,
            "float16" => Dtype::Half,
            "float32" => Dtype::Float,
            "float64" => Dtype::Double,
            _ => return Err(format!("its data_type is {}, expected bool, int8 to float64", quoted(kind))),
        };
        let shape = json::numbers(value.get("shape"), "shape")?;
        let grid =
            value.get("chunk_grid").filter(|g| g.get("name").and_then(Value::as_str) == Some("regular"));
        let grid = grid.and_then(|g| g.get("configuration")).ok_or("its chunks are on no regular grid")?;
        let chunk = json::numbers(grid.get("chunk_shape"), "chunk_shape")?;
        let keys = value.get("chunk_key_encoding");
        let is_old = keys.and_then(|k| k.get("name")).and_then(Value::as_str) == Some("v2");
        let told = keys
            .and_then(|k| k.get("configuration"))
            .and_then(|c| c.get("separator"))
            .and_then(Value::as_str);
        let separator = told.unwrap_or(if is_old { "." } else { "/" });
        let list = value["codecs"].as_array().ok_or("it has no codecs")?;
        let (codecs, shard) = Codecs::of_version_3(list, shape.len())?;
        Ok(Self {
            path: PathBuf::new(),
            fill: fill(value.get("fill_value"), dtype, codecs.endian)?,
            shape,
            chunk,
            shard,
            dtype,
            codecs,
            separator: if separator == "." { '.' } else { '/' },
            prefix: if is_old { "" } else { "c" },
            version: 3,
        })
    }

    /// The sides of the chunks that are decoded.
    pub(super) fn sides(&self) -> &[u64] {
        self.shard.as_ref().map_or(&self.chunk, |shard| &shard.chunk)
    }

    /// Bytes of such a chunk.
    pub(super) fn chunk_bytes(&self) -> u64 {
        self.sides().iter().fold(self.dtype.num_bytes() as u64, |n, side| n.saturating_mul(*side))
    }

    /// The number that is not stored.
    pub(super) fn fill_number(&self) -> Option<f64> {
        numbers_from_bytes(&self.fill, self.dtype, self.codecs.endian).first().copied()
    }

    /// The folder of the files of chunks, and whether each number in their names is a folder.
    pub(super) fn chunk_folder(&self) -> (PathBuf, bool) {
        let is_nested = self.separator == '/';
        (if is_nested { self.path.join(self.prefix) } else { self.path.clone() }, is_nested)
    }

    /// The numbers in the name of a file of a chunk, where they are in one name.
    pub(super) fn index_of(&self, name: &str) -> Option<Vec<u64>> {
        let rest =
            if self.prefix.is_empty() { name } else { name.strip_prefix(self.prefix)?.strip_prefix('.')? };
        rest.split('.').map(|word| word.parse().ok()).collect()
    }

    pub(super) fn chunk_path(&self, index: &[u64]) -> PathBuf {
        let words: Vec<String> = index.iter().map(u64::to_string).collect();
        let words = words.join(&self.separator.to_string());
        let between =
            if self.prefix.is_empty() { String::new() } else { format!("{}{}", self.prefix, self.separator) };
        self.path.join(format!("{between}{words}"))
    }
}

/// The bytes of a fill value; zero if there is none.
fn fill(value: Option<&Value>, dtype: Dtype, endian: Endian) -> Result<Vec<u8>, String> {
    let bad = |value: &Value| format!("its fill_value is {}, expected a number", quoted(&value.to_string()));
    let number = match value {
        None | Some(Value::Null) => 0.0,
        Some(Value::Bool(is_set)) => f64::from(u8::from(*is_set)),
        Some(Value::String(text)) => match (text.as_str(), text.strip_prefix("0x")) {
            ("NaN", _) => f64::NAN,
            ("Infinity", _) => f64::INFINITY,
            ("-Infinity", _) => f64::NEG_INFINITY,
            // Zarr 3 may give the bits of a float, the highest first.
            (_, Some(digits)) if digits.len() == 2 * dtype.num_bytes() => {
                let bits = u64::from_str_radix(digits, 16).map_err(|_| bad(&Value::from(text.as_str())))?;
                let mut bytes = bits.to_le_bytes()[..dtype.num_bytes()].to_vec();
                if endian == Endian::Big {
                    bytes.reverse();
                }
                return Ok(bytes);
            }
            _ => text.parse().map_err(|_| bad(&Value::from(text.as_str())))?,
        },
        Some(Value::Number(n)) => n.as_f64().unwrap_or(0.0),
        Some(other) => return Err(bad(other)),
    };
    let exact = value.and_then(|v| v.as_i64().map(i128::from).or(v.as_u64().map(i128::from)));
    let whole = exact.unwrap_or(number as i128);
    let mut bytes = match dtype {
        Dtype::Uint8 => (whole as u8).to_le_bytes().to_vec(),
        Dtype::Int8 => (whole as i8).to_le_bytes().to_vec(),
        Dtype::Uint16 => (whole as u16).to_le_bytes().to_vec(),
        Dtype::Int16 => (whole as i16).to_le_bytes().to_vec(),
        Dtype::Uint32 => (whole as u32).to_le_bytes().to_vec(),
        Dtype::Int32 => (whole as i32).to_le_bytes().to_vec(),
        Dtype::Uint64 => (whole as u64).to_le_bytes().to_vec(),
        Dtype::Int64 => (whole as i64).to_le_bytes().to_vec(),
        Dtype::Half => half::f16::from_f64(number).to_le_bytes().to_vec(),
        Dtype::Float => (number as f32).to_le_bytes().to_vec(),
        Dtype::Double => number.to_le_bytes().to_vec(),
    };
    if endian == Endian::Big {
        bytes.reverse();
    }
    Ok(bytes)
}

const MAX_AXES: usize = 8;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::decode::VoxelSink;

    #[test]
    fn what_is_not_stored_has_the_value_of_the_array() {
        let values = |value: Value, dtype: Dtype| {
            [Endian::Little, Endian::Big].map(|endian| {
                let mut sink = VoxelSink::new(dtype, endian, 1).expect("one voxel fits");
                sink.push_bytes(&fill(Some(&value), dtype, endian).unwrap());
                let decoded = sink.finish(false);
                decoded.voxels.get(0) + decoded.value_map.1
            })
        };
        let floats = [Dtype::Half, Dtype::Float, Dtype::Double];
        for (value, expected) in [
            (Value::from("Infinity"), f32::INFINITY),
            (Value::from("-Infinity"), f32::NEG_INFINITY),
            (Value::from(-2.5), -2.5),
            (Value::from(6.0e-8), 5.960_464_5e-8),
            (Value::from("7"), 7.0),
            (Value::Null, 0.0),
        ] {
            for dtype in floats {
                for found in values(value.clone(), dtype) {
                    // 6e-8 rounds to the least half float.
                    assert!(found == expected || (found - expected).abs() < 1e-9, "{value} {}", dtype.name());
                }
            }
        }
        for (dtype, bits) in floats.into_iter().zip(["0x7e00", "0x7fc00000", "0x7ff8000000000000"]) {
            assert!(values(Value::from("NaN"), dtype).iter().all(|x| x.is_nan()));
            assert!(values(Value::from(bits), dtype).iter().all(|x| x.is_nan()));
        }
        assert_eq!(values(Value::from(-7), Dtype::Int16), [-7.0; 2]);
        assert_eq!(values(Value::from(true), Dtype::Uint8), [1.0; 2]);
        assert_eq!(values(Value::from(u64::MAX), Dtype::Uint64), [u64::MAX as f32; 2]);
        assert!(fill(Some(&Value::from("none")), Dtype::Float, Endian::Little).is_err());
    }
}
