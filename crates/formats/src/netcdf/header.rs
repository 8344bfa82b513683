//! The header of a classic netCDF file (NetCDF Classic Format Specification): dimensions, attributes and variables.

use std::collections::HashMap;
use std::io::Read;

use crate::cf::{AttributeList, signed_as_told};
use crate::dtype::{Dtype, Endian, numbers_from_bytes};
use crate::error::quoted;

/// What the header says.
pub(super) struct ClassicHeader {
    /// 1 for classic files, 2 for those with offsets of 64 bits, and 5 for those with sizes of 64 bits.
    pub(super) version: u8,
    pub(super) dims: Vec<Dimension>,
    pub(super) attributes: ClassicAttributes,
    pub(super) variables: Vec<ClassicVariable>,
    /// Bytes from one record to the next.
    pub(super) record_bytes: u64,
}

pub(super) struct Dimension {
    pub(super) name: String,
    pub(super) length: u64,
    /// Whether its entries are the records of the file.
    pub(super) is_record: bool,
}

pub(super) struct ClassicVariable {
    pub(super) name: String,
    /// The places of its dimensions, the slowest first.
    pub(super) dims: Vec<usize>,
    pub(super) attributes: ClassicAttributes,
    /// The type of its numbers; `None` if it has text.
    pub(super) dtype: Option<Dtype>,
    /// Byte of its first number.
    pub(super) begin: u64,
}

/// The attributes of a variable or of the file.
#[derive(Default)]
pub(super) struct ClassicAttributes(HashMap<String, ClassicValue>);

enum ClassicValue {
    Text(String),
    Numbers { list: Vec<f64>, are_floats: bool },
}

impl AttributeList for ClassicAttributes {
    fn numbers(&self, name: &str) -> Vec<f64> {
        match self.0.get(name) {
            Some(ClassicValue::Numbers { list, .. }) => list.clone(),
            _ => Vec::new(),
        }
    }

    fn text(&self, name: &str) -> Option<String> {
        match self.0.get(name) {
            Some(ClassicValue::Text(text)) => Some(text.clone()),
            _ => None,
        }
    }

    fn has_floats(&self, name: &str) -> bool {
        matches!(self.0.get(name), Some(ClassicValue::Numbers { are_floats: true, .. }))
    }
}

impl ClassicHeader {
    /// Reads the header at the beginning of `stream`, a file of `file_bytes`. The error says what is wrong.
    pub(super) fn read(stream: impl Read, file_bytes: u64) -> Result<Self, String> {
        let mut parser =
            Parser { stream: stream.take(MAX_HEADER_BYTES), is_wide: false, has_wide_offsets: false };
        let [.., version] = parser.bytes(4)?[..] else { return Err("it has no header".into()) };
        if !matches!(version, 1 | 2 | 5) {
            return Err(format!("version is {version}, expected 1, 2 or 5"));
        }
        (parser.is_wide, parser.has_wide_offsets) = (version == 5, version > 1);
        let num_records = parser.size()?;
        let is_open = num_records == if parser.is_wide { u64::MAX } else { u32::MAX.into() };
        let mut dims = parser.list(DIMENSION, |parser| {
            let (name, length) = (parser.name()?, parser.size()?);
            Ok(Dimension { name, length, is_record: length == 0 })
        })?;
        let attributes = parser.attributes()?;
        let variables = parser.list(VARIABLE, |parser| parser.variable(dims.len()))?;
        let is_record =
            |variable: &ClassicVariable| variable.dims.first().is_some_and(|i| dims[*i].is_record);
        let in_records: Vec<&ClassicVariable> =
            variables.iter().map(|(v, _)| v).filter(|v| is_record(v)).collect();
        let bytes = |(variable, size): &(ClassicVariable, u64)| {
            let sides = variable.dims.iter().map(|i| &dims[*i]).filter(|dim| !dim.is_record);
            sides.fold(*size, |n, dim| n.saturating_mul(dim.length))
        };
        // Each part of a record begins at a multiple of four bytes, unless it is the only one.
        let is_alone = in_records.len() == 1;
        let part = |found: &(ClassicVariable, u64)| {
            let bytes = bytes(found);
            if is_alone { bytes } else { bytes.checked_next_multiple_of(4).unwrap_or(bytes) }
        };
        let parts = variables.iter().filter(|(v, _)| is_record(v)).map(part);
        let record_bytes = parts.fold(0, u64::saturating_add);
        // A writer that was cut short has not told how many records there are.
        let first = in_records.iter().map(|v| v.begin).min().unwrap_or(0);
        let num_records = match is_open {
            true => file_bytes.saturating_sub(first).checked_div(record_bytes).unwrap_or(0),
            false => num_records,
        };
        dims.iter_mut().filter(|dim| dim.is_record).for_each(|dim| dim.length = num_records);
        let variables = variables.into_iter().map(|(variable, _)| variable).collect();
        Ok(Self { version, dims, attributes, variables, record_bytes })
    }
}

/// Reads the parts of a header, big-endian.
struct Parser<R> {
    stream: std::io::Take<R>,
    /// Whether sizes and offsets have 64 bits.
    is_wide: bool,
    has_wide_offsets: bool,
}

impl<R: Read> Parser<R> {
    fn bytes(&mut self, count: u64) -> Result<Vec<u8>, String> {
        if count > self.stream.limit() {
            return Err(format!("its header has more than {MAX_HEADER_BYTES} bytes"));
        }
        let mut bytes = Vec::new();
        let read = self.stream.by_ref().take(count).read_to_end(&mut bytes).map_err(|e| e.to_string())?;
        if (read as u64) < count { Err("its header is cut".into()) } else { Ok(bytes) }
    }

    fn u32(&mut self) -> Result<u32, String> {
        Ok(self.bytes(4)?.iter().fold(0, |n, byte| n << 8 | u32::from(*byte)))
    }

    fn number(&mut self, is_wide: bool) -> Result<u64, String> {
        Ok(self.bytes(if is_wide { 8 } else { 4 })?.iter().fold(0, |n, byte| n << 8 | u64::from(*byte)))
    }

    /// A length or a count.
    fn size(&mut self) -> Result<u64, String> {
        self.number(self.is_wide)
    }

    /// Bytes, and those up to a multiple of four.
    fn padded(&mut self, count: u64) -> Result<Vec<u8>, String> {
        let mut bytes = self.bytes(count)?;
        let rest = (4 - count % 4) % 4;
        self.bytes(rest)?;
        bytes.truncate(count as usize);
        Ok(bytes)
    }

    fn name(&mut self) -> Result<String, String> {
        let count = self.size()?;
        if count > MAX_NAME_BYTES {
            return Err(format!("a name has {count} bytes, expected at most {MAX_NAME_BYTES}"));
        }
        Ok(String::from_utf8_lossy(&self.padded(count)?).into_owned())
    }

    /// A list of what has this tag; an empty one has the tag zero.
    fn list<T>(
        &mut self,
        tag: u32,
        mut item: impl FnMut(&mut Self) -> Result<T, String>,
    ) -> Result<Vec<T>, String> {
        let (found, count) = (self.u32()?, self.size()?);
        if (found != tag && !(found == 0 && count == 0)) || count > MAX_ITEMS {
            return Err(format!(
                "a list of {count} has the tag {found}, expected {tag} and at most {MAX_ITEMS}"
            ));
        }
        (0..count).map(|_| item(self)).collect()
    }

    fn attributes(&mut self) -> Result<ClassicAttributes, String> {
        let list = self.list(ATTRIBUTE, |parser| {
            let name = parser.name()?;
            let (kind, count) = (parser.u32()?, parser.size()?);
            let (dtype, size) = type_of(kind)?;
            let bytes = parser.padded(count.checked_mul(size).ok_or("an attribute is too long")?)?;
            let value = match dtype {
                None => ClassicValue::Text(String::from_utf8_lossy(&bytes).trim_end_matches('\0').to_owned()),
                Some(dtype) => ClassicValue::Numbers {
                    list: numbers_from_bytes(&bytes, dtype, Endian::Big),
                    are_floats: dtype.integer_range().is_none(),
                },
            };
            Ok((name, value))
        })?;
        Ok(ClassicAttributes(list.into_iter().collect()))
    }

    /// A variable, and the bytes of one of its numbers.
    fn variable(&mut self, num_dims: usize) -> Result<(ClassicVariable, u64), String> {
        let name = self.name()?;
        let count = self.size()?;
        if count > MAX_AXES {
            return Err(format!("{} has {count} dimensions, expected at most {MAX_AXES}", quoted(&name)));
        }
        let mut dims = Vec::new();
        for _ in 0..count {
            let place = self.size()?;
            let known = usize::try_from(place).ok().filter(|place| *place < num_dims);
            dims.push(known.ok_or_else(|| {
                format!("{} has the dimension {place}, expected one of {num_dims}", quoted(&name))
            })?);
        }
        let attributes = self.attributes()?;
        let (dtype, size) = type_of(self.u32()?)?;
        // The size in the header is too small for large variables, and follows from the dimensions.
        self.size()?;
        let begin = self.number(self.has_wide_offsets)?;
        let dtype = dtype.map(|dtype| signed_as_told(dtype, &attributes));
        Ok((ClassicVariable { name, dims, attributes, dtype, begin }, size))
    }
}

/// A type and its bytes; `None` for text.
fn type_of(kind: u32) -> Result<(Option<Dtype>, u64), String> {
    let dtype = match kind {
        1 => Dtype::Int8,
        2 => return Ok((None, 1)),
        3 => Dtype::Int16,
        4 => Dtype::Int32,
        5 => Dtype::Float,
        6 => Dtype::Double,
        7 => Dtype::Uint8,
        8 => Dtype::Uint16,
        9 => Dtype::Uint32,
        10 => Dtype::Int64,
        11 => Dtype::Uint64,
        _ => return Err(format!("a type is {kind}, expected 1 to 11")),
    };
    Ok((Some(dtype), dtype.num_bytes() as u64))
}

const DIMENSION: u32 = 10;
const VARIABLE: u32 = 11;
const ATTRIBUTE: u32 = 12;
/// Longest header.
const MAX_HEADER_BYTES: u64 = 16 << 20;
const MAX_NAME_BYTES: u64 = 4096;
/// Most dimensions, attributes or variables.
const MAX_ITEMS: u64 = 1 << 16;
/// Most dimensions of a variable.
const MAX_AXES: u64 = 32;
