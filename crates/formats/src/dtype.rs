//! The types a voxel can have in a file.

use std::str::FromStr;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Type of a voxel in a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dtype {
    /// Signed, 8 bits.
    Int8,
    /// Unsigned, 8 bits.
    Uint8,
    /// Signed, 16 bits.
    Int16,
    /// Unsigned, 16 bits.
    Uint16,
    /// Signed, 32 bits.
    Int32,
    /// Unsigned, 32 bits.
    Uint32,
    /// Signed, 64 bits.
    Int64,
    /// Unsigned, 64 bits.
    Uint64,
    /// Floating point, 16 bits.
    Half,
    /// Floating point, 32 bits.
    Float,
    /// Floating point, 64 bits.
    Double,
}

impl Dtype {
    /// The type with this NumPy name, without the letter for the byte order. Truth values are bytes.
    pub(crate) fn from_numpy(kind: &str) -> Option<Self> {
        Some(match kind {
            "b1" | "u1" => Self::Uint8,
            "i1" => Self::Int8,
            "u2" => Self::Uint16,
            "i2" => Self::Int16,
            "u4" => Self::Uint32,
            "i4" => Self::Int32,
            "u8" => Self::Uint64,
            "i8" => Self::Int64,
            "f2" => Self::Half,
            "f4" => Self::Float,
            "f8" => Self::Double,
            _ => return None,
        })
    }

    /// Every type, in the order of their sizes.
    pub const ALL: [Self; 11] = [
        Self::Int8,
        Self::Uint8,
        Self::Int16,
        Self::Uint16,
        Self::Int32,
        Self::Uint32,
        Self::Int64,
        Self::Uint64,
        Self::Half,
        Self::Float,
        Self::Double,
    ];

    /// The name used in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Int8 => "int8",
            Self::Uint8 => "uint8",
            Self::Int16 => "int16",
            Self::Uint16 => "uint16",
            Self::Int32 => "int32",
            Self::Uint32 => "uint32",
            Self::Int64 => "int64",
            Self::Uint64 => "uint64",
            Self::Half => "float16",
            Self::Float => "float",
            Self::Double => "double",
        }
    }

    /// Bytes of one voxel in the file.
    pub fn num_bytes(self) -> usize {
        match self {
            Self::Int8 | Self::Uint8 => 1,
            Self::Int16 | Self::Uint16 | Self::Half => 2,
            Self::Int32 | Self::Uint32 | Self::Float => 4,
            Self::Int64 | Self::Uint64 | Self::Double => 8,
        }
    }

    /// Bytes of one voxel in memory. Integers of 8 and 16 bits keep their size, and all other types become `f32`.
    pub fn num_bytes_in_memory(self) -> usize {
        if self == Self::Half { 4 } else { self.num_bytes().min(4) }
    }

    /// Least and greatest integer of the type, `None` for floating point.
    pub(crate) fn integer_range(self) -> Option<(f64, f64)> {
        let signed = |bits: i32| (-(2f64.powi(bits - 1)), 2f64.powi(bits - 1) - 1.0);
        let unsigned = |bits: i32| (0.0, 2f64.powi(bits) - 1.0);
        Some(match self {
            Self::Int8 => signed(8),
            Self::Uint8 => unsigned(8),
            Self::Int16 => signed(16),
            Self::Uint16 => unsigned(16),
            Self::Int32 => signed(32),
            Self::Uint32 => unsigned(32),
            Self::Int64 => signed(64),
            Self::Uint64 => unsigned(64),
            Self::Half | Self::Float | Self::Double => return None,
        })
    }

    /// The bytes of a number; `None` if the type is one of integers that do not have it.
    pub(crate) fn bytes_of(self, number: f64, endian: Endian) -> Option<Vec<u8>> {
        if let Some((lo, hi)) = self.integer_range()
            && !(number.fract() == 0.0 && number >= lo && number <= hi)
        {
            return None;
        }
        let mut bytes = match self {
            Self::Int8 => (number as i8).to_le_bytes().to_vec(),
            Self::Uint8 => (number as u8).to_le_bytes().to_vec(),
            Self::Int16 => (number as i16).to_le_bytes().to_vec(),
            Self::Uint16 => (number as u16).to_le_bytes().to_vec(),
            Self::Int32 => (number as i32).to_le_bytes().to_vec(),
            Self::Uint32 => (number as u32).to_le_bytes().to_vec(),
            Self::Int64 => (number as i64).to_le_bytes().to_vec(),
            Self::Uint64 => (number as u64).to_le_bytes().to_vec(),
            Self::Half => half::f16::from_f64(number).to_le_bytes().to_vec(),
            Self::Float => (number as f32).to_le_bytes().to_vec(),
            Self::Double => number.to_le_bytes().to_vec(),
        };
        if endian == Endian::Big {
            bytes.reverse();
        }
        Some(bytes)
    }

    /// The names that [`Dtype::from_str`] accepts, for messages.
    pub const EXPECTED: &'static str =
        "int8, uint8, int16, uint16, int32, uint32, int64, uint64, float16, float or double";
}

impl FromStr for Dtype {
    type Err = String;

    /// Accepts all spellings of the NRRD format (`unsigned short`, `ushort`, `uint16_t`, …) and the short names of
    /// Rust and NumPy (`u8`, `f32`, `float64`, …). Case does not matter.
    fn from_str(text: &str) -> Result<Self, String> {
        let words = text.to_ascii_lowercase();
        let words: Vec<&str> = words.split_ascii_whitespace().collect();
        // These are the names in the section "Basic field specifications" of the NRRD format. A bare "long" is not
        // one of them, because its size depends on the machine.
        Ok(match words.join(" ").trim_end_matches("_t") {
            "signed char" | "int8" | "i8" => Self::Int8,
            "uchar" | "unsigned char" | "uint8" | "u8" => Self::Uint8,
            "short" | "short int" | "signed short" | "signed short int" | "int16" | "i16" => Self::Int16,
            "ushort" | "unsigned short" | "unsigned short int" | "uint16" | "u16" => Self::Uint16,
            "int" | "signed int" | "int32" | "i32" => Self::Int32,
            "uint" | "unsigned int" | "uint32" | "u32" => Self::Uint32,
            "longlong"
            | "long long"
            | "long long int"
            | "signed long long"
            | "signed long long int"
            | "int64"
            | "i64" => Self::Int64,
            "ulonglong" | "unsigned long long" | "unsigned long long int" | "uint64" | "u64" => Self::Uint64,
            "float16" | "f16" => Self::Half,
            "float" | "float32" | "f32" => Self::Float,
            "double" | "float64" | "f64" => Self::Double,
            _ => {
                return Err(format!(
                    "unknown type {}, expected {}",
                    crate::error::quoted(text),
                    Self::EXPECTED
                ));
            }
        })
    }
}

impl Serialize for Dtype {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl<'de> Deserialize<'de> for Dtype {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(serde::de::Error::custom)
    }
}

/// Order of the bytes of a number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Endian {
    /// Least significant byte first.
    #[default]
    Little,
    /// Most significant byte first.
    Big,
}

impl FromStr for Endian {
    type Err = String;

    /// Accepts `little` and `big`. Case does not matter.
    fn from_str(text: &str) -> Result<Self, String> {
        match text.to_ascii_lowercase().as_str() {
            "little" => Ok(Self::Little),
            "big" => Ok(Self::Big),
            _ => Err(format!("unknown byte order {}, expected little or big", crate::error::quoted(text))),
        }
    }
}

/// Numbers in double precision, as coordinates need.
pub(crate) fn numbers_from_bytes(bytes: &[u8], dtype: Dtype, endian: Endian) -> Vec<f64> {
    let number = |word: &[u8]| {
        let mut low = [0; 8];
        low[..word.len()].copy_from_slice(word);
        if endian == Endian::Big {
            low[..word.len()].reverse();
        }
        let bits = u64::from_le_bytes(low);
        match dtype {
            Dtype::Uint8 | Dtype::Uint16 | Dtype::Uint32 | Dtype::Uint64 => bits as f64,
            Dtype::Int8 => f64::from(bits as i8),
            Dtype::Int16 => f64::from(bits as i16),
            Dtype::Int32 => f64::from(bits as i32),
            Dtype::Int64 => bits as i64 as f64,
            Dtype::Half => half::f16::from_bits(bits as u16).to_f64(),
            Dtype::Float => f64::from(f32::from_bits(bits as u32)),
            Dtype::Double => f64::from_bits(bits),
        }
    };
    bytes.chunks_exact(dtype.num_bytes()).map(number).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_spelling_of_the_format_is_known_and_nothing_else() {
        for dtype in Dtype::ALL {
            assert_eq!(dtype.name().parse(), Ok(dtype));
            assert_eq!(dtype.name().to_uppercase().parse(), Ok(dtype));
        }
        for (spelling, dtype) in [
            ("signed char", Dtype::Int8),
            ("int8_t", Dtype::Int8),
            ("unsigned  char", Dtype::Uint8),
            ("uint8_t", Dtype::Uint8),
            ("signed short int", Dtype::Int16),
            ("unsigned short", Dtype::Uint16),
            ("signed int", Dtype::Int32),
            ("uint", Dtype::Uint32),
            ("long long", Dtype::Int64),
            ("unsigned long long int", Dtype::Uint64),
            ("f32", Dtype::Float),
            ("float64", Dtype::Double),
        ] {
            assert_eq!(spelling.parse(), Ok(dtype), "{spelling}");
        }
        for wrong in ["", "block", "char16", "long", "int128", "uint8 uint8", "half"] {
            assert!(wrong.parse::<Dtype>().is_err(), "{wrong}");
        }
    }
}
