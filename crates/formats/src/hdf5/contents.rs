//! What an HDF5 file contains. The crate `hdf5-pure` reads the metadata of its objects, and nothing else.

use std::cell::RefCell;
use std::collections::HashMap;
use std::fs::File;
use std::path::Path;
use std::rc::Rc;
use std::sync::Arc;
use std::thread;

use hdf5_pure::{AttrValue, Datatype, DatatypeByteOrder};

use super::links::{ObjectPlace, Place};
use super::objects::{Link, ObjectReader};
use super::source::{MetadataSource, SharedFile};
use super::storage::Storage;
use crate::cf::{AttributeList, Coordinates, Standing, signed_as_told};
use crate::dtype::{Dtype, Endian};
use crate::error::{FormatError, io_error, malformed, one_line, quoted};

/// An open file. Only [`with_contents`] makes one, on a thread of its own.
pub(super) struct ArrayFile {
    pub(super) metadata: hdf5_pure::File,
    pub(super) bytes: Arc<SharedFile>,
    pub(super) objects: ObjectReader,
    /// The byte at which the first group begins.
    pub(super) root: u64,
    /// The links of groups that were read.
    pub(super) known_links: RefCell<HashMap<u64, Arc<Vec<Link>>>>,
    /// The attributes of objects that were read; `None` where there are no objects.
    known_attributes: RefCell<HashMap<String, Option<Rc<Attributes>>>>,
}

/// An array in the file.
pub(super) struct Listed {
    /// Its path from the root, which begins with a slash.
    pub(super) path: String,
    /// The byte at which its header begins.
    pub(super) at: u64,
    /// Its sides, the slowest axis first.
    pub(super) shape: Vec<u64>,
    /// The type of its numbers, or what else it has.
    pub(super) kind: Result<(Dtype, Endian), String>,
    pub(super) attributes: Attributes,
    pub(super) dataset: hdf5_pure::Dataset,
    /// What the program that wrote it tells of its axes, the slowest first, if that program is known.
    pub(super) told: Option<Vec<Coordinates>>,
    pub(super) standing: Standing,
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
        let source = MetadataSource::new(Arc::clone(&bytes));
        work(&ArrayFile::new(source, bytes).map_err(|e| bad(problem(&e)))?)
    };
    thread::scope(|scope| {
        let thread = thread::Builder::new().name("hdf5".into()).stack_size(STACK_BYTES);
        let thread = thread.spawn_scoped(scope, open).map_err(io_error(path))?;
        thread.join().unwrap_or_else(|_| Err(bad("its metadata contradict each other".into())))
    })
}

impl ArrayFile {
    fn new(file: MetadataSource, bytes: Arc<SharedFile>) -> Result<Self, hdf5_pure::Error> {
        let metadata = hdf5_pure::File::from_source(file.clone())?;
        let start = metadata.superblock();
        let objects = ObjectReader {
            source: file,
            base: start.base_address.get(),
            offset_size: start.offset_size.into(),
            length_size: start.length_size.into(),
        };
        let root = start.root_group_address;
        Ok(Self {
            metadata,
            bytes,
            objects,
            root,
            known_links: RefCell::default(),
            known_attributes: RefCell::default(),
        })
    }

    /// The attributes of a group or an array, which are read once; `None` if there is no such object.
    pub(super) fn attributes(&self, path: &str) -> Option<Rc<Attributes>> {
        if let Some(found) = self.known_attributes.borrow().get(path) {
            return found.clone();
        }
        let place = self.place(path).ok();
        let found = place.and_then(|place| match self.metadata.group(&place.path) {
            Ok(group) => group.attrs().ok(),
            Err(_) => self.metadata.dataset(&place.path).ok()?.attrs().ok(),
        });
        let found = found.map(|found| Rc::new(Attributes(found)));
        let mut known = self.known_attributes.borrow_mut();
        if known.len() < MAX_KNOWN {
            known.insert(path.to_owned(), found.clone());
        }
        found
    }

    /// The names in a group, in their order; none if there is no such group.
    pub(super) fn names(&self, group: &str) -> Vec<String> {
        let links = self.place(group).and_then(|place| self.links(place.at));
        links.map(|links| links.iter().map(|link| link.name.clone()).collect()).unwrap_or_default()
    }

    /// The numbers that follow `prefix` in the names of a group, the least first.
    pub(super) fn numbers_after(&self, group: &str, prefix: &str) -> Vec<u32> {
        let names = self.names(group);
        let numbers = names.iter().filter_map(|name| name.strip_prefix(prefix)?.parse().ok());
        let mut numbers: Vec<u32> = numbers.collect();
        numbers.sort_unstable();
        numbers.dedup();
        numbers
    }

    /// Where the object at `path` is in this file.
    fn place(&self, path: &str) -> Result<ObjectPlace, String> {
        match self.resolve(path)? {
            Place::Here(place) => Ok(place),
            Place::Elsewhere(link) => Err(format!("{} is in the file {}", quoted(path), quoted(&link.file))),
        }
    }

    /// The numbers of a short array; `None` if there is none.
    pub(super) fn numbers(&self, path: &str) -> Option<Vec<f64>> {
        let array = self.array(path).ok()?;
        Storage::of(self, &array, MAX_NUMBER_BYTES).ok()?.all_numbers().ok()
    }

    /// The array at `path` within the file.
    pub(super) fn array(&self, path: &str) -> Result<Listed, String> {
        let place = self.place(path)?;
        let dataset = self.metadata.dataset(&place.path).map_err(|e| problem(&e))?;
        Listed::of(path.to_owned(), place.at, dataset).map_err(|e| problem(&e))
    }
}

impl Listed {
    pub(super) fn of(path: String, at: u64, dataset: hdf5_pure::Dataset) -> Result<Self, hdf5_pure::Error> {
        let attributes = Attributes(dataset.attrs().unwrap_or_default());
        let datatype = dataset.datatype()?;
        let standing = if is_truth(&datatype) { Standing::Aside } else { Standing::Usual };
        let kind = number_type(&datatype);
        let kind = kind.map(|(dtype, endian)| (signed_as_told(dtype, &attributes), endian));
        let shape = dataset.shape()?;
        Ok(Self { path, at, shape, kind, attributes, dataset, told: None, standing })
    }

    /// The group that it is in, without a slash at the end.
    pub(super) fn folder(&self) -> &str {
        self.path.rsplit_once('/').map_or("", |(folder, _)| folder)
    }

    /// Its own name.
    pub(super) fn name(&self) -> &str {
        self.path.rsplit('/').next().unwrap_or_default()
    }

    /// Its shape and type, the slowest axis first.
    pub(super) fn description(&self) -> String {
        let sides: Vec<String> = self.shape.iter().map(u64::to_string).collect();
        let kind = self.kind.as_ref().map_or_else(String::as_str, |kind| kind.0.name());
        format!("{} ({} {kind})", one_line(&self.path), sides.join("×"))
    }
}

/// Whether a type has truth values.
fn is_truth(datatype: &Datatype) -> bool {
    let Datatype::Enumeration { members, .. } = datatype else { return false };
    members.len() == 2 && members.iter().any(|member| member.name.eq_ignore_ascii_case("true"))
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
    /// Whether there is an attribute of this name.
    pub(super) fn has(&self, name: &str) -> bool {
        self.0.contains_key(name)
    }

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
/// The types of the largest block of metadata are nested this deep at most.
const STACK_BYTES: usize = 256 << 20;
/// Most groups whose links and objects whose attributes are kept.
pub(super) const MAX_KNOWN: usize = 4096;
/// Largest chunk of a short array.
const MAX_NUMBER_BYTES: u64 = 16 << 20;
/// Longest text of an attribute.
const MAX_TEXT_BYTES: usize = 1 << 16;
