//! The sources of settings; each overrides the ones before.

use std::env;
use std::fmt;
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use isinglass_core::text::is_control;
use isinglass_formats::{SettingValue, read_settings};

use super::known::{BINDINGS, SERVER, SETTINGS, VIEWER, expected};

#[derive(Clone, Debug)]
pub(super) struct Sourced {
    pub(super) section: String,
    pub(super) key: String,
    pub(super) value: SettingValue,
    pub(super) origin: Origin,
}

impl Sourced {
    /// The value, if there is exactly one.
    pub(super) fn text(&self) -> Option<&str> {
        match &self.value {
            SettingValue::Text(text) => Some(text),
            SettingValue::List(_) => None,
        }
    }

    /// All values; a variable separates several by commas.
    pub(super) fn list(&self) -> Vec<String> {
        match &self.value {
            SettingValue::List(items) => items.clone(),
            SettingValue::Text(text) if text.trim().is_empty() => Vec::new(),
            SettingValue::Text(text) if text.trim() == "," => vec![text.trim().into()],
            SettingValue::Text(text) => text.split(',').map(|t| t.trim().to_owned()).collect(),
        }
    }
}

/// Where a setting comes from.
#[derive(Clone, Debug)]
pub(super) enum Origin {
    /// A line of a file.
    File(PathBuf, usize),
    /// An environment variable.
    Variable(String),
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File(path, line) => {
                let path: String =
                    path.display().to_string().chars().map(|c| if is_control(c) { '?' } else { c }).collect();
                write!(f, "{path}:{line}")
            }
            Self::Variable(name) => f.write_str(name),
        }
    }
}

/// All settings for the command `name`, the strongest last. `given` is the file after `--config`.
pub(super) fn all(name: &str, given: Option<&Path>) -> Result<Vec<Sourced>> {
    let files: &[&str] = match name {
        "serve" => &[SERVER],
        "view" => &[VIEWER],
        _ => &[SERVER, VIEWER],
    };
    let mut found = Vec::new();
    for folder in [system_folder(), user_folder()].into_iter().flatten() {
        for file in files {
            let of_file = in_file(&folder.join(file))?.unwrap_or_default();
            if let Some(other) = of_file.iter().find(|s| !belongs(s, file)) {
                let other_file = if *file == SERVER { VIEWER } else { SERVER };
                bail!(
                    "{}: found {}.{} in {file}, expected it in {other_file}",
                    other.origin,
                    other.section,
                    other.key
                );
            }
            found.extend(of_file);
        }
    }
    if let Some(path) = given {
        match in_file(path)? {
            Some(settings) => found.extend(settings),
            None => bail!("{}: there is no such file, expected settings", path.display()),
        }
    }
    found.extend(in_environment()?);
    Ok(found)
}

/// Whether a known setting belongs into that file. Unknown ones are reported later, by name.
fn belongs(setting: &Sourced, file: &str) -> bool {
    if setting.section == BINDINGS {
        return file == VIEWER;
    }
    let known = SETTINGS.iter().find(|k| k.section == setting.section && k.key == setting.key);
    known.is_none_or(|k| k.file() == file)
}

fn in_file(path: &Path) -> Result<Option<Vec<Sourced>>> {
    let Some(settings) = read_settings(path)? else { return Ok(None) };
    let sourced = settings.into_iter().map(|s| Sourced {
        section: s.section,
        key: s.key,
        value: s.value,
        origin: Origin::File(path.to_owned(), s.line),
    });
    Ok(Some(sourced.collect()))
}

/// The variables `ISINGLASS_SECTION_KEY`. Others with this prefix are ignored unless their section is one of ours.
fn in_environment() -> Result<Vec<Sourced>> {
    let mut found = Vec::new();
    for (name, value) in env::vars_os() {
        let Some(name) = name.to_str() else { continue };
        let Some((section, key)) = name.strip_prefix("ISINGLASS_").and_then(|rest| rest.split_once('_'))
        else {
            continue;
        };
        let section = section.to_lowercase();
        let is_ours = section == BINDINGS || SETTINGS.iter().any(|k| k.section == section);
        if !is_ours {
            continue;
        }
        let Some(value) = value.to_str() else {
            bail!("{name}: found bytes that are not UTF-8, expected a text")
        };
        let key = key.to_lowercase();
        let key = if section == BINDINGS { key.replace('_', "-") } else { key };
        if section != BINDINGS && !SETTINGS.iter().any(|k| k.section == section && k.key == key) {
            bail!("{name}: found {section}.{key}, expected {}", expected(&section));
        }
        found.push(Sourced {
            section,
            key,
            value: SettingValue::Text(value.to_owned()),
            origin: Origin::Variable(name.to_owned()),
        });
    }
    // Sorting gives the same errors each time.
    found.sort_by_key(|s| s.origin.to_string());
    Ok(found)
}

/// The folder of the machine's settings; [`SYSTEM_VARIABLE`] overrides it.
fn system_folder() -> Option<PathBuf> {
    if let Some(folder) = env::var_os(SYSTEM_VARIABLE) {
        return Some(folder.into());
    }
    if cfg!(windows) {
        Some(PathBuf::from(env::var_os("PROGRAMDATA")?).join("isinglass"))
    } else if cfg!(target_os = "macos") {
        Some("/Library/Application Support/isinglass".into())
    } else {
        Some("/etc/isinglass".into())
    }
}

fn user_folder() -> Option<PathBuf> {
    let absolute = |name| env::var_os(name).map(PathBuf::from).filter(|p| p.is_absolute());
    let folder = if let Some(folder) = absolute("XDG_CONFIG_HOME") {
        folder
    } else if cfg!(windows) {
        absolute("APPDATA")?
    } else if cfg!(target_os = "macos") {
        env::home_dir()?.join("Library/Application Support")
    } else {
        env::home_dir()?.join(".config")
    };
    Some(folder.join("isinglass"))
}

/// The variable that overrides the system's folder.
const SYSTEM_VARIABLE: &str = "ISINGLASS_SYSTEM_CONFIG";
