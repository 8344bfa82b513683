//! The images of a group that is none itself: fields of a plate or well, labels, and those of bioformats2raw.

use std::path::Path;

use serde_json::Value;

use super::store::Store;
use super::{METADATA, json};
use crate::error::{FormatError, quoted};
use crate::source::OpenOptions;

/// The images of a group.
pub(super) struct ImageList {
    /// Their paths in the group.
    pub(super) paths: Vec<String>,
    /// What the group is, and what its images are, for the warning.
    pub(super) group: &'static str,
    pub(super) images: &'static str,
}

impl ImageList {
    /// The images that the group in the folder `path` lists or has.
    pub(super) fn read(store: &Store, path: &Path, options: &OpenOptions) -> Result<Self, FormatError> {
        let attributes = json::attributes(store, path)?.unwrap_or_default();
        if let Some(wells) = attributes["plate"]["wells"].as_array() {
            let paths = fields(store, path, wells, options)?;
            return Ok(Self { paths, group: "plate", images: "fields" });
        }
        if attributes["well"].is_object() {
            return Ok(Self { paths: fields_of_well(&attributes), group: "well", images: "fields" });
        }
        if let Some(labels) = attributes["labels"].as_array() {
            let paths =
                labels.iter().filter_map(Value::as_str).filter_map(inner).take(store.max_images()).collect();
            return Ok(Self { paths, group: "group", images: "images of labels" });
        }
        let mut paths = Vec::new();
        // bioformats2raw puts each image into its own group.
        while paths.len() < store.max_images() {
            options.check_cancelled(path)?;
            let name = paths.len().to_string();
            let files = METADATA.iter().map(|file| store.has(&path.join(&name).join(file)));
            // The first file that is there is enough.
            let Some(found) = files.into_iter().find(|found| !matches!(found, Ok(false))) else { break };
            found?;
            paths.push(name);
        }
        Ok(Self { paths, group: "group", images: "images" })
    }

    /// The warning that one of them was chosen.
    pub(super) fn choice(&self) -> String {
        let first = match self.group {
            "group" if self.images == "images" => self.paths[0].clone(),
            _ => format!("{}, that is 0,", quoted(&self.paths[0]).trim_matches('"')),
        };
        format!("the {} has {} {}, of which {first} is shown", self.group, self.paths.len(), self.images)
    }
}

/// The fields of all wells of a plate.
fn fields(
    store: &Store,
    path: &Path,
    wells: &[Value],
    options: &OpenOptions,
) -> Result<Vec<String>, FormatError> {
    let mut paths = Vec::new();
    for well in wells.iter().filter_map(|well| inner(well["path"].as_str()?)) {
        options.check_cancelled(path)?;
        let attributes = json::attributes(store, &path.join(&well))?.unwrap_or_default();
        paths.extend(fields_of_well(&attributes).into_iter().map(|field| format!("{well}/{field}")));
        if paths.len() >= store.max_images() {
            break;
        }
    }
    Ok(paths)
}

fn fields_of_well(attributes: &Value) -> Vec<String> {
    let images = attributes["well"]["images"].as_array().map_or(&[][..], |list| list);
    images.iter().filter_map(|image| inner(image["path"].as_str()?)).take(MAX_FIELDS).collect()
}

/// A path within a group; `None` if it leads elsewhere.
fn inner(path: &str) -> Option<String> {
    let path = path.trim_end_matches('/');
    let is_good = path.split('/').all(|part| !matches!(part, "" | "." | "..")) && !path.contains('\\');
    is_good.then(|| path.to_owned())
}

/// Most fields of a well.
const MAX_FIELDS: usize = 1024;
