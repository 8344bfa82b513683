//! The measured scenes: the built-in volumes and six scanned or simulated ones.

use std::path::{Path, PathBuf};

use isinglass_formats::{FormatError, VolumeSource, outline};

use crate::error::BenchError;

/// A scene that can be measured.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneSource {
    /// Short name in tables.
    pub name: String,
    /// The volume.
    pub volume: VolumeSource,
}

impl SceneSource {
    /// All of `source`, as [`isinglass_formats::open`] takes it.
    pub fn new(name: impl Into<String>, source: impl Into<String>) -> Self {
        Self { name: name.into(), volume: VolumeSource::new(source) }
    }

    /// Reads the header, so that an unreadable file is rejected before any measurement.
    pub fn check(&self) -> Result<(), FormatError> {
        outline(&self.volume.source, &self.volume.options()).map(|_| ())
    }
}

/// The scenes to measure, and the missing ones.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Selection {
    /// The scenes to measure.
    pub scenes: Vec<SceneSource>,
    /// One sentence per scene that is left out.
    pub skipped: Vec<String>,
}

/// Selects the scenes called `names_asked`, each once, or all that are available. A name is one of [`names`], or a
/// volume as on the command line (`builtin:cloud@64` or a path). Scanned volumes come from `folder`.
pub fn select(names_asked: &[String], folder: Option<&Path>) -> Result<Selection, BenchError> {
    let mut selection = Selection::default();
    let all: Vec<String> = names().map(str::to_owned).collect();
    let asked = if names_asked.is_empty() { &all[..] } else { names_asked };
    for name in distinct(asked.iter().cloned()) {
        let name = &name;
        if let Some(known) = BUILTINS.iter().find(|n| *n == name) {
            selection.scenes.push(SceneSource::new(*known, format!("builtin:{known}")));
        } else if let Some(known) = FILES.iter().find(|n| *n == name) {
            let found = folder.map(|f| f.join(format!("{known}.nrrd"))).filter(|p| p.is_file());
            match (found, folder) {
                (Some(path), _) => {
                    selection.scenes.push(SceneSource::new(*known, path.display().to_string()));
                }
                (None, Some(folder)) => {
                    selection.skipped.push(format!("{known}: no {known}.nrrd in {}", folder.display()));
                }
                (None, None) => selection
                    .skipped
                    .push(format!("{known}: no folder of volumes; name one with {DATA_VARIABLE}")),
            }
        } else if name.starts_with("builtin:") || Path::new(name).exists() {
            selection.scenes.push(SceneSource::new(name, name));
        } else {
            let expected = format!("{}, a built-in volume, a file or a folder", all.join(", "));
            return Err(BenchError::UnknownScene { found: name.clone(), expected });
        }
    }
    if selection.scenes.is_empty() || !(names_asked.is_empty() || selection.skipped.is_empty()) {
        return Err(BenchError::NoScene(selection.skipped.join("; ")));
    }
    Ok(selection)
}

/// Keeps the first of equal items.
pub fn distinct<T: PartialEq>(items: impl IntoIterator<Item = T>) -> Vec<T> {
    let mut all = Vec::new();
    for item in items {
        if !all.contains(&item) {
            all.push(item);
        }
    }
    all
}

/// The names of all scenes.
pub fn names() -> impl Iterator<Item = &'static str> {
    BUILTINS.into_iter().chain(FILES)
}

/// The folder of scanned volumes: that in [`DATA_VARIABLE`], or `shared/data` beside the current folder or one above
/// it.
pub fn data_folder() -> Option<PathBuf> {
    if let Some(named) = std::env::var_os(DATA_VARIABLE) {
        return Some(named.into());
    }
    let here = std::env::current_dir().ok()?;
    here.ancestors().map(|folder| folder.join("shared/data")).find(|folder| folder.is_dir())
}

/// The environment variable with the folder of scanned volumes.
pub const DATA_VARIABLE: &str = "ISINGLASS_DATA";
const BUILTINS: [&str; 3] = ["cloud", "cubus", "shells"];
const FILES: [&str; 6] = ["bonsai", "engine", "avm", "t1_head", "heptane", "mouse_brain"];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_scenes_are_found_or_skipped_and_unknown_ones_refused() {
        let empty = std::env::temp_dir().join(format!("isinglass-no-volumes-{}", std::process::id()));
        std::fs::create_dir_all(&empty).unwrap();
        let selection = select(&[], Some(&empty)).unwrap();
        assert_eq!(selection.scenes.iter().map(|s| &s.name[..]).collect::<Vec<_>>(), BUILTINS);
        assert_eq!(selection.skipped.len(), FILES.len());
        std::fs::write(empty.join("bonsai.nrrd"), b"").unwrap();
        let selection = select(&["bonsai".into(), "cloud".into()], Some(&empty)).unwrap();
        assert_eq!(selection.scenes.len(), 2);
        // A scene that is named must be there, a folder is a volume, and what is named twice is measured once.
        let missing = select(&["engine".into(), "cloud".into()], Some(&empty)).unwrap_err().to_string();
        assert!(missing.contains("no engine.nrrd"), "{missing}");
        let folder = empty.display().to_string();
        let names = ["cloud".into(), folder.clone(), "cloud".into()];
        let selection = select(&names, None).unwrap();
        let found: Vec<&str> = selection.scenes.iter().map(|s| &s.volume.source[..]).collect();
        assert_eq!(found, ["builtin:cloud", &folder]);
        std::fs::remove_dir_all(&empty).unwrap();
        let unknown = select(&["bonzai".into()], None).unwrap_err().to_string();
        assert!(unknown.contains("bonzai") && unknown.contains("mouse_brain"), "{unknown}");
        assert!(matches!(select(&["bonsai".into()], None), Err(BenchError::NoScene(_))));
        for (source, is_sound) in
            [("builtin:shells@16", true), ("builtin:shels", false), ("no such file", false)]
        {
            assert_eq!(SceneSource::new("a", source).check().is_ok(), is_sound, "{source}");
        }
    }
}
