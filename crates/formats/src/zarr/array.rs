//! The metadata of one array, Zarr version 2 or 3, and its chunks.

use std::path::{Path, PathBuf};

use serde_json::Value;

use super::codec::{Codec, Codecs};
use super::json;
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, quoted, shown};

/// An array. Axes are slowest first, as the format has them.
#[derive(Clone, Debug)]
pub(super) struct Array {
    pub(super) path: PathBuf,
    pub(super) shape: Vec<u64>,
    /// Numbers of a chunk along each axis, or of a shard.
    pub(super) chunk: Vec<u64>,
    /// The chunks of a shard, if there are shards.
    pub(super) shard: Option<Shard>,
    pub(super) dtype: Dtype,
    /// The value of what is not stored, as bytes.
    pub(super) fill: Vec<u8>,
    pub(super) codecs: Codecs,
    /// What stands between the numbers of a chunk in its name, and before them.
    separator: char,
    prefix: &'static str,
    pub(super) version: u8,
}

/// How the chunks of a shard are found.
#[derive(Clone, Debug)]
pub(super) struct Shard {
    pub(super) chunk: Vec<u64>,
    pub(super) is_index_first: bool,
    pub(super) has_checksum: bool,
}

impl Array {
    /// The array in the folder `path`.
    pub(super) fn read(path: &Path) -> Result<Self, FormatError> {
        let (value, version) = match json::read(&path.join("zarr.json"))? {
            Some(value) => (value, 3),
            None => (json::require(&path.join(".zarray"))?, 2),
        };
        let array = if version == 3 { Self::of_version_3(&value) } else { Self::of_version_2(&value) };
        let bad = |problem: String| FormatError::Malformed {
            path: shown(path),
            format: "Zarr array".into(),
            problem,
        };
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
        let dtype = value.get("dtype").and_then(Value::as_str).ok_or("its dtype is not one number")?;
        let (endian, kind) = match dtype.split_at_checked(1) {
            Some((">", kind)) => (Endian::Big, kind),
            Some(("<" | "|", kind)) => (Endian::Little, kind),
            _ => (Endian::Little, dtype),
        };
        let dtype = Dtype::from_numpy(kind).ok_or_else(|| {
            format!("its type is {}, expected b1, i1 to i8, u1 to u8 or f2 to f8", quoted(dtype))
        })?;
        let is_filtered = value.get("filters").and_then(Value::as_array).is_some_and(|f| !f.is_empty());
        if is_filtered {
            return Err("it has filters, expected none".into());
        }
        let shape = json::numbers(value.get("shape"), "shape")?;
        let num_axes = shape.len();
        let is_fortran = value.get("order").and_then(Value::as_str) == Some("F");
        let order = if is_fortran { (0..num_axes).rev().collect() } else { (0..num_axes).collect() };
        let compressor = value.get("compressor").filter(|c| !c.is_null());
        let packed = compressor.map(Codec::of_version_2).transpose()?.into_iter().collect();
        let separator = value.get("dimension_separator").and_then(Value::as_str).unwrap_or(".");
        Ok(Self {
            path: PathBuf::new(),
            chunk: json::numbers(value.get("chunks"), "chunks")?,
            shape,
            shard: None,
            dtype,
            fill: fill(value.get("fill_value"), dtype, endian),
            codecs: Codecs { order, endian, packed },
            separator: if separator == "/" { '/' } else { '.' },
            prefix: "",
            version: 2,
        })
    }

    fn of_version_3(value: &Value) -> Result<Self, String> {
        let kind = value.get("data_type").and_then(Value::as_str).unwrap_or_default();
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
        let list = value.get("codecs").and_then(Value::as_array).ok_or("it has no codecs")?;
        let (codecs, shard) = Codecs::of_version_3(list, shape.len())?;
        Ok(Self {
            path: PathBuf::new(),
            fill: fill(value.get("fill_value"), dtype, codecs.endian),
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

    /// The file of a chunk.
    pub(super) fn chunk_path(&self, index: &[u64]) -> PathBuf {
        let words: Vec<String> = index.iter().map(u64::to_string).collect();
        let words = words.join(&self.separator.to_string());
        let between =
            if self.prefix.is_empty() { String::new() } else { format!("{}{}", self.prefix, self.separator) };
        self.path.join(format!("{between}{words}"))
    }
}

/// A fill value as the bytes of a number.
fn fill(value: Option<&Value>, dtype: Dtype, endian: Endian) -> Vec<u8> {
    let number = match value {
        Some(Value::Number(n)) => n.as_f64().unwrap_or(0.0),
        Some(Value::Bool(true)) => 1.0,
        Some(Value::String(s)) if s == "NaN" => f64::NAN,
        _ => 0.0,
    };
    let mut bytes = match dtype {
        Dtype::Uint8 => (number as u8).to_le_bytes().to_vec(),
        Dtype::Int8 => (number as i8).to_le_bytes().to_vec(),
        Dtype::Uint16 => (number as u16).to_le_bytes().to_vec(),
        Dtype::Int16 => (number as i16).to_le_bytes().to_vec(),
        Dtype::Uint32 => (number as u32).to_le_bytes().to_vec(),
        Dtype::Int32 => (number as i32).to_le_bytes().to_vec(),
        Dtype::Uint64 => (number as u64).to_le_bytes().to_vec(),
        Dtype::Int64 => (number as i64).to_le_bytes().to_vec(),
        // Of half floats only zero and NaN: no writer fills them with more.
        Dtype::Half if number.is_nan() => 0x7e00u16.to_le_bytes().to_vec(),
        Dtype::Half => vec![0; 2],
        Dtype::Float => (number as f32).to_le_bytes().to_vec(),
        Dtype::Double => number.to_le_bytes().to_vec(),
    };
    if endian == Endian::Big {
        bytes.reverse();
    }
    bytes
}

const MAX_AXES: usize = 8;
