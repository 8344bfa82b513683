//! What an HDF5 file contains. The crate `hdf5-pure` reads its metadata here, and nothing else.

use std::collections::HashMap;
use std::fs::File;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use hdf5_pure::{AttrValue, Datatype, DatatypeByteOrder, Group};

use super::source::{MetadataSource, SharedFile};
use crate::cf::{AttributeList, signed_as_told};
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, malformed, one_line, shown};

/// An open file. Only [`with_contents`] makes one, on a thread of its own.
pub(super) struct ArrayFile {
    pub(super) metadata: hdf5_pure::File,
    pub(super) bytes: Arc<SharedFile>,
}

/// An array in the file.
pub(super) struct Listed {
    /// Its path from the root, which begins with a slash.
    pub(super) path: String,
    /// Its sides, the slowest axis first.
    pub(super) shape: Vec<u64>,
    /// The type of its numbers, or what else it has.
    pub(super) kind: Result<(Dtype, Endian), String>,
    pub(super) attributes: Attributes,
    pub(super) dataset: hdf5_pure::Dataset,
}

/// The attributes of an array or a group.
pub(super) struct Attributes(HashMap<String, AttrValue>);

/// Opens `file`, the file at `path`, and does `work` with it. The types and trees of a hostile file are deep, so this
/// takes a thread with a large stack. If the reader of metadata panics after all, only that thread ends.
pub(super) fn with_contents<T: Send>(
    file: File,
    path: &Path,
    work: impl FnOnce(&ArrayFile) -> Result<T, FormatError> + Send,
) -> Result<T, FormatError> {
    let bytes = Arc::new(SharedFile::new(file).map_err(io_error(path))?);
    let bad = malformed(path, FORMAT);
    let open = move || {
        let metadata = hdf5_pure::File::from_source(MetadataSource::new(Arc::clone(&bytes)));
        work(&ArrayFile { metadata: metadata.map_err(|e| bad(problem(&e)))?, bytes })
    };
    thread::scope(|scope| {
        let thread = thread::Builder::new().name("hdf5".into()).stack_size(STACK_BYTES);
        let thread = thread.spawn_scoped(scope, open).map_err(io_error(path))?;
        thread.join().unwrap_or_else(|_| Err(bad("its metadata contradict each other".into())))
    })
}

impl ArrayFile {
    /// All arrays at `inside` or below it.
    pub(super) fn arrays(
        &self,
        inside: &str,
        path: &Path,
        cancel: Option<&AtomicBool>,
    ) -> Result<Vec<Listed>, FormatError> {
        let bad = malformed(path, FORMAT);
        let mut found = Vec::new();
        match self.metadata.dataset(inside) {
            Ok(dataset) => found.push(Listed::of(inside.to_owned(), dataset).map_err(|e| bad(problem(&e)))?),
            Err(hdf5_pure::Error::NotADataset(_)) => {
                let group = self.metadata.group(inside).map_err(|e| bad(problem(&e)))?;
                let inside = inside.trim_end_matches('/').to_owned();
                let mut waiting = vec![(inside, group, 0)];
                while let Some((name, group, depth)) = waiting.pop() {
                    if cancel.is_some_and(|cancel| cancel.load(Ordering::Relaxed)) {
                        return Err(FormatError::Cancelled { path: shown(path) });
                    }
                    let groups = list(&name, &group, &mut found).map_err(|e| bad(problem(&e)))?;
                    let groups = groups.into_iter().filter(|_| depth < MAX_DEPTH);
                    waiting.extend(groups.map(|(name, group)| (name, group, depth + 1)));
                    if found.len() > MAX_ARRAYS {
                        return Err(bad(format!("it has more than {MAX_ARRAYS} arrays, expected fewer")));
                    }
                }
            }
            Err(e) => return Err(bad(problem(&e))),
        }
        found.sort_by(|a, b| a.path.cmp(&b.path));
        Ok(found)
    }

    /// The attributes of a group; `None` if there is no such group.
    pub(super) fn attributes(&self, group: &str) -> Option<Attributes> {
        Some(Attributes(self.metadata.group(group).ok()?.attrs().ok()?))
    }

    /// How many groups `group` has that are called `prefix` and a number, from 0 on.
    pub(super) fn num_numbered(&self, group: &str, prefix: &str) -> usize {
        let names = self.metadata.group(group).and_then(|group| group.groups()).unwrap_or_default();
        (0..names.len()).take_while(|i| names.iter().any(|name| *name == format!("{prefix}{i}"))).count()
    }

    /// The array at `path` within the file.
    pub(super) fn array(&self, path: &str) -> Result<Listed, String> {
        let dataset = self.metadata.dataset(path).map_err(|e| problem(&e))?;
        Listed::of(path.to_owned(), dataset).map_err(|e| problem(&e))
    }
}

/// Adds the arrays of a group to `found`. Returns the groups in it.
fn list(
    name: &str,
    group: &Group,
    found: &mut Vec<Listed>,
) -> Result<Vec<(String, Group)>, hdf5_pure::Error> {
    for (own, dataset) in group.iter_datasets()? {
        // An array that cannot be read hides no other one.
        found.extend(Listed::of(format!("{name}/{own}"), dataset));
    }
    Ok(group.iter_groups()?.map(|(own, group)| (format!("{name}/{own}"), group)).collect())
}

impl Listed {
    fn of(path: String, dataset: hdf5_pure::Dataset) -> Result<Self, hdf5_pure::Error> {
        let attributes = Attributes(dataset.attrs().unwrap_or_default());
        let kind = number_type(&dataset.datatype()?);
        let kind = kind.map(|(dtype, endian)| (signed_as_told(dtype, &attributes), endian));
        Ok(Self { path, shape: dataset.shape()?, kind, attributes, dataset })
    }

    /// Its shape and type, the slowest axis first.
    pub(super) fn description(&self) -> String {
        let sides: Vec<String> = self.shape.iter().map(u64::to_string).collect();
        let kind = self.kind.as_ref().map_or_else(String::as_str, |kind| kind.0.name());
        format!("{} ({} {kind})", one_line(&self.path), sides.join("×"))
    }
}

/// The type of numbers, or what else the type is.
fn number_type(datatype: &Datatype) -> Result<(Dtype, Endian), String> {
    let endian = |order: DatatypeByteOrder| match order {
        DatatypeByteOrder::LittleEndian => Ok(Endian::Little),
        DatatypeByteOrder::BigEndian => Ok(Endian::Big),
        DatatypeByteOrder::Vax => Err("numbers in the order of a VAX".to_owned()),
    };
    match datatype {
        Datatype::FixedPoint { size, byte_order, layout } => {
            // Numbers of fewer bits have zeros above them, unless they have a sign.
            let bits = u32::from(layout.bit_precision);
            let is_whole =
                layout.bit_offset == 0 && (bits == 8 * size || (bits < 8 * size && !layout.signed));
            let dtype = match (size, layout.signed) {
                (1, false) => Dtype::Uint8,
                (1, true) => Dtype::Int8,
                (2, false) => Dtype::Uint16,
                (2, true) => Dtype::Int16,
                (4, false) => Dtype::Uint32,
                (4, true) => Dtype::Int32,
                (8, false) => Dtype::Uint64,
                (8, true) => Dtype::Int64,
                _ => return Err(format!("integers of {size} bytes")),
            };
            if !is_whole {
                return Err(format!("integers of {bits} bits in {size} bytes"));
            }
            Ok((dtype, endian(*byte_order)?))
        }
        Datatype::FloatingPoint { size, byte_order, layout } => {
            let dtype = match (size, layout.exponent_size, layout.mantissa_size) {
                (2, 5, 10) => Dtype::Half,
                (4, 8, 23) => Dtype::Float,
                (8, 11, 52) => Dtype::Double,
                _ => {
                    return Err(format!(
                        "floats of {size} bytes with {} bits of exponent",
                        layout.exponent_size
                    ));
                }
            };
            Ok((dtype, endian(*byte_order)?))
        }
        // Truth values are a list of names for bytes.
        Datatype::Enumeration { base_type, .. } => number_type(base_type),
        Datatype::String { .. } => Err("text".into()),
        Datatype::VariableLength { .. } => Err("lists or text".into()),
        Datatype::Compound { .. } => Err("structures".into()),
        Datatype::Reference { .. } => Err("references".into()),
        _ => Err("other types".into()),
    }
}

impl Attributes {
    /// The numbers of an attribute; empty if there is none.
    pub(super) fn numbers(&self, name: &str) -> Vec<f64> {
        let Some(value) = self.0.get(name) else { return Vec::new() };
        let whole = || value.to_i64s().map(|list| list.into_iter().map(|x| x as f64).collect());
        let large = || value.to_u64s().map(|list| list.into_iter().map(|x| x as f64).collect());
        value.to_f64s().or_else(whole).or_else(large).unwrap_or_default()
    }

    /// The one number of an attribute.
    pub(super) fn number(&self, name: &str) -> Option<f64> {
        self.numbers(name).first().copied()
    }

    /// The text of an attribute. Imaris writes each letter as a text of its own.
    pub(super) fn text(&self, name: &str) -> Option<String> {
        let value = self.0.get(name)?;
        let text = value.as_str().map(str::to_owned);
        text.or_else(|| value.as_strings().map(<[String]>::concat))
            .filter(|text| text.len() <= MAX_TEXT_BYTES)
    }

    /// The texts of an attribute; empty if there is none.
    pub(super) fn texts(&self, name: &str) -> &[String] {
        self.0.get(name).and_then(AttrValue::as_strings).unwrap_or_default()
    }
}

impl AttributeList for Attributes {
    fn numbers(&self, name: &str) -> Vec<f64> {
        Self::numbers(self, name)
    }

    fn text(&self, name: &str) -> Option<String> {
        Self::text(self, name)
    }

    fn has_floats(&self, name: &str) -> bool {
        self.0.get(name).is_some_and(|value| value.to_f64s().is_some())
    }
}

/// The message of the reader of metadata.
pub(super) fn problem(e: &hdf5_pure::Error) -> String {
    let text = one_line(&e.to_string());
    text.strip_prefix("HDF5 format error: ").map_or(text.clone(), str::to_owned)
}

pub(super) const FORMAT: &str = "HDF5";
/// Deepest group.
const MAX_DEPTH: usize = 32;
const MAX_ARRAYS: usize = 1 << 16;
/// The types of the largest block of metadata are nested this deep at most.
const STACK_BYTES: usize = 256 << 20;
/// Longest text of an attribute.
const MAX_TEXT_BYTES: usize = 1 << 16;
