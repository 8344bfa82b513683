//! Groups of arrays that are no OME-Zarr image: those of xarray and other writers of the CF conventions, and plain ones.

use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde_json::Value;

use super::array::Array;
use super::chunks::short_numbers;
use super::json;
use super::store::Store;
use crate::cf::{self, Coordinates, Standing, Variable, Variables, VolumeCandidate, signed_as_told};
use crate::error::{FormatError, malformed, not_there, one_line, quoted};
use crate::plan::Plan;
use crate::source::OpenOptions;

/// The arrays of a group and those below it.
pub(super) struct ArrayGroup {
    /// The attributes of the group.
    attributes: Value,
    arrays: Vec<GroupArray>,
    /// Why the first of the others cannot be read.
    unread: Option<String>,
}

struct GroupArray {
    /// Its path in the group, with a slash before it.
    path: String,
    array: Array,
    attributes: Value,
    /// The names of its dimensions, the slowest first.
    dims: Vec<Option<String>>,
}

/// An array that is shown, and its plan.
pub(super) struct GroupVolume {
    pub(super) array: Array,
    pub(super) plan: Plan,
}

/// The documents of an array or group: what it is, and its attributes.
struct Documents {
    value: Value,
    version: u8,
    attributes: Value,
}

impl ArrayGroup {
    /// Reads the group in the folder `path`; `None` if it is none.
    pub(super) fn read(
        store: &Store,
        path: &Path,
        options: &OpenOptions,
    ) -> Result<Option<Self>, FormatError> {
        let root = match documents(store, path)? {
            Some(root) if !root.is_array() => root,
            _ => return Ok(None),
        };
        let known = match root.version {
            3 => root.value["consolidated_metadata"]["metadata"].as_object().map(of_version_3),
            _ => {
                let all = json::read(store, &path.join(".zmetadata"))?;
                all.as_ref().and_then(|all| all["metadata"].as_object()).map(of_version_2)
            }
        };
        let found = match known {
            Some(known) => known,
            None => walked(store, path, options)?,
        };
        let (mut arrays, mut unread) = (Vec::new(), None);
        for (name, documents) in found {
            let folder = path.join(name.trim_start_matches('/'));
            match Array::of(&folder, &documents.value, documents.version) {
                Ok(array) => arrays.push(GroupArray::new(name, array, documents)),
                // An array that cannot be read, such as one of texts, hides no other one.
                Err(FormatError::Malformed { problem, .. }) => {
                    unread.get_or_insert_with(|| {
                        format!("{}: {problem}", quoted(name.trim_start_matches('/')))
                    });
                }
                Err(e) => return Err(e),
            }
        }
        Ok(Some(Self { attributes: root.attributes, arrays, unread }))
    }

    /// The array in the folder `path` by itself, if its dimensions have names.
    pub(super) fn alone(store: &Store, path: &Path) -> Result<Option<Self>, FormatError> {
        let Some(found) = documents(store, path)?.filter(Documents::has_names) else { return Ok(None) };
        let array = Array::of(path, &found.value, found.version)?;
        let name = path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned());
        Ok(Some(Self {
            attributes: Value::Null,
            arrays: vec![GroupArray::new(format!("/{name}"), array, found)],
            unread: None,
        }))
    }

    /// Whether there is no array.
    pub(super) fn is_empty(&self) -> bool {
        self.arrays.is_empty() && self.unread.is_none()
    }

    /// Chooses the array that is called `name`, or the one that the options select, or the largest.
    pub(super) fn volume(
        &self,
        store: &Store,
        path: &Path,
        name: Option<&str>,
        options: &OpenOptions,
    ) -> Result<GroupVolume, FormatError> {
        let bad = malformed(path, FORMAT);
        let all = &self.arrays;
        let variables =
            Variables::new(self.variables(), all.iter().any(|array| array.is_geo(&self.attributes)));
        let axes = |i: usize| variables.axes_of(i, None, None);
        let choice = |i: usize| {
            let sizes = cf::num_in_space(&all[i].array.shape, &axes(i))?;
            let standing = Standing::of(variables.is_auxiliary(i));
            Some((VolumeCandidate { sizes, standing }, i))
        };
        let (choices, found): (Vec<VolumeCandidate>, Vec<usize>) = (0..all.len()).filter_map(choice).unzip();
        let shown = VolumeCandidate::shown(&choices);
        let named =
            name.and_then(|name| found.iter().position(|i| all[*i].path.trim_start_matches('/') == name));
        let selected = options.selection.series.map(|i| i as usize);
        let usual = VolumeCandidate::usual(&choices, &shown);
        let index = match named {
            Some(named) => found[named],
            None => match shown.get(selected.unwrap_or(usual)) {
                Some(n) => found[*n],
                None if shown.is_empty() => return Err(bad(self.nothing_to_show())),
                None => return Err(not_there(path, "series", selected.unwrap_or(0) as u64, shown.len())),
            },
        };
        let numbers = |i: usize| short_numbers(&all[i].array, store);
        let found_axes = variables.axes_of(index, Some(&numbers), Some(&self.attributes));
        let mut plan = all[index].plan(&found_axes).ok_or_else(|| bad(self.nothing_to_show()))?;
        if named.is_none() {
            let names = shown.iter().map(|n| all[found[*n]].description()).collect();
            plan.set_series(names, usual, options.selection.series);
        }
        Ok(GroupVolume { array: all[index].array.clone(), plan })
    }

    fn variables(&self) -> Vec<Variable<'_>> {
        let lines = self.arrays.iter().filter(|a| a.array.shape.len() == 1);
        let lines: HashSet<&str> = lines.map(|a| &a.path[..]).collect();
        // A dimension is that of the nearest group which has coordinates for it.
        let place = |array: &GroupArray, dim: &str| {
            let mut folder = array.path.rsplit_once('/').map_or("", |(folder, _)| folder);
            let own = format!("{folder}/{dim}");
            loop {
                let path = format!("{folder}/{dim}");
                if lines.contains(&path[..]) {
                    return path;
                }
                match folder.rsplit_once('/') {
                    Some((above, _)) => folder = above,
                    None => return own,
                }
            }
        };
        let mut list = Vec::new();
        for array in &self.arrays {
            let dims = array.dims.iter().map(|dim| dim.as_ref().map(|dim| place(array, dim))).collect();
            let shape = array.array.shape.clone();
            list.push(Variable { path: array.path.clone(), dims, shape, attributes: &array.attributes });
        }
        list
    }

    fn nothing_to_show(&self) -> String {
        let listed: Vec<String> = self.arrays.iter().take(MAX_NAMED).map(GroupArray::description).collect();
        let listed = if listed.is_empty() { "no other".to_owned() } else { listed.join(", ") };
        let unread = self
            .unread
            .as_ref()
            .map_or_else(String::new, |unread| format!("; it has an array that cannot be read, {unread}"));
        format!("it has no image, and no array with two or three axes in space; it has {listed}{unread}")
    }
}

impl GroupArray {
    fn new(path: String, mut array: Array, documents: Documents) -> Self {
        let attributes = documents.attributes;
        array.dtype = signed_as_told(array.dtype, &attributes);
        let names = match documents.version {
            3 => documents.value["dimension_names"].as_array(),
            _ => attributes["_ARRAY_DIMENSIONS"].as_array(),
        };
        let names = names.filter(|names| names.len() == array.shape.len());
        let name = |name: &Value| name.as_str().filter(|name| !name.is_empty()).map(str::to_owned);
        let dims =
            names.map_or_else(|| vec![None; array.shape.len()], |names| names.iter().map(name).collect());
        Self { path, array, attributes, dims }
    }

    /// Whether a name such as `depth` is one of the earth.
    fn is_geo(&self, group: &Value) -> bool {
        let is_cf = |value: &Value| value["Conventions"].as_str().is_some_and(|text| text.contains("CF"));
        let has_words = ["standard_name", "positive"].iter().any(|key| self.attributes[*key].is_string());
        has_words || is_cf(group)
    }

    fn description(&self) -> String {
        let sides: Vec<String> = self.array.shape.iter().map(u64::to_string).collect();
        let name = one_line(self.path.trim_start_matches('/'));
        format!("{name} ({} {})", sides.join("×"), self.array.dtype.name())
    }

    fn plan(&self, axes: &[Coordinates]) -> Option<Plan> {
        let array = &self.array;
        let name = one_line(self.path.trim_start_matches('/'));
        let format = format!("{FORMAT} {}, {name}", array.version);
        let mut plan =
            cf::plan(format, (array.dtype, array.codecs.endian), &array.shape, axes, &self.attributes)?;
        // In version 2, xarray has the marker of what is missing there.
        let is_marked = ["_FillValue", "missing_value"].iter().any(|key| self.attributes.get(*key).is_some());
        if array.version == 2 && !is_marked && self.dims.iter().any(Option::is_some) {
            let (slope, intercept) = plan.value_map;
            let marker = array.fill_number().filter(|number| number.is_finite() && *number != 0.0);
            plan.missing.values.extend(marker.map(|number| number * slope + intercept));
        }
        Some(plan)
    }
}

impl Documents {
    fn is_array(&self) -> bool {
        match self.version {
            3 => self.value["node_type"].as_str() == Some("array"),
            _ => self.value.get("shape").is_some(),
        }
    }

    /// Whether they are those of an array whose dimensions have names.
    fn has_names(&self) -> bool {
        let names = match self.version {
            3 => &self.value["dimension_names"],
            _ => &self.attributes["_ARRAY_DIMENSIONS"],
        };
        self.is_array() && names.as_array().is_some_and(|names| names.iter().any(Value::is_string))
    }
}

/// The documents in the folder `path`; `None` if it has none.
fn documents(store: &Store, path: &Path) -> Result<Option<Documents>, FormatError> {
    if let Some(value) = json::read(store, &path.join("zarr.json"))? {
        let attributes = value.get("attributes").cloned().unwrap_or_default();
        return Ok(Some(Documents { value, version: 3, attributes }));
    }
    let value = match json::read(store, &path.join(".zarray"))? {
        Some(value) => Some(value),
        None => json::read(store, &path.join(".zgroup"))?,
    };
    let attributes = json::read(store, &path.join(".zattrs"))?;
    // The attributes of a group may be alone.
    let Some(value) = value.or_else(|| attributes.as_ref().map(|_| Value::Null)) else { return Ok(None) };
    Ok(Some(Documents { value, version: 2, attributes: attributes.unwrap_or_default() }))
}

/// The arrays in consolidated metadata of version 3, by their paths.
fn of_version_3(all: &serde_json::Map<String, Value>) -> BTreeMap<String, Documents> {
    let documents = |(name, value): (&String, &Value)| {
        let attributes = value.get("attributes").cloned().unwrap_or_default();
        let found = Documents { value: value.clone(), version: 3, attributes };
        Some((inner_path(name)?, found)).filter(|(_, found)| found.is_array())
    };
    all.iter().filter_map(documents).take(MAX_ARRAYS).collect()
}

/// The same of version 2.
fn of_version_2(all: &serde_json::Map<String, Value>) -> BTreeMap<String, Documents> {
    let documents = |(name, value): (&String, &Value)| {
        let name = name.strip_suffix("/.zarray")?;
        let attributes = all.get(&format!("{name}/.zattrs")).cloned().unwrap_or_default();
        Some((inner_path(name)?, Documents { value: value.clone(), version: 2, attributes }))
    };
    all.iter().filter_map(documents).take(MAX_ARRAYS).collect()
}

/// The path of an array in its group, with a slash before it; `None` if it leads elsewhere.
fn inner_path(name: &str) -> Option<String> {
    let is_good = name.split('/').all(|part| !matches!(part, "" | "." | "..")) && !name.contains('\\');
    is_good.then(|| format!("/{name}"))
}

/// The arrays in the folders below `path`.
fn walked(
    store: &Store,
    path: &Path,
    options: &OpenOptions,
) -> Result<BTreeMap<String, Documents>, FormatError> {
    let mut found = BTreeMap::new();
    let mut folders: Vec<(String, PathBuf)> = vec![(String::new(), path.to_owned())];
    for _ in 0..MAX_DEPTH {
        let mut inner = Vec::new();
        for (name, folder) in &folders {
            options.check_cancelled(path)?;
            let children = store.folders_in(folder, MAX_ARRAYS)?;
            inner.extend(children.into_iter().map(|child| (format!("{name}/{child}"), folder.join(child))));
        }
        inner.truncate(MAX_ARRAYS);
        let read =
            inner.par_iter().map(|(_, folder)| documents(store, folder)).collect::<Result<Vec<_>, _>>()?;
        folders = Vec::new();
        for (place, documents) in inner.into_iter().zip(read) {
            match documents {
                Some(documents) if documents.is_array() => drop(found.insert(place.0, documents)),
                Some(_) => folders.push(place),
                None => {}
            }
        }
        if folders.is_empty() || found.len() >= MAX_ARRAYS {
            break;
        }
    }
    Ok(found)
}

const FORMAT: &str = "Zarr";
/// Most arrays of a group, and deepest group.
const MAX_ARRAYS: usize = 4096;
const MAX_DEPTH: usize = 6;
/// Most arrays in a message.
const MAX_NAMED: usize = 8;
