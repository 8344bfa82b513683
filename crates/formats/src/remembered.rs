//! What a person chose in the viewer's window, kept between starts in a small TOML file.

use std::path::Path;

use isinglass_core::volume::Lighting;
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use crate::error::{FormatError, io_error, one_line, shown, syntax_error};
use crate::source::read_file;
use crate::state::SavedView;

/// Choices of the window. What is `None` was not chosen.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Remembered {
    /// Columns and rows of the window, points.
    pub size: Option<[u32; 2]>,
    /// Whether the panel is open.
    pub panel: Option<bool>,
    /// Background, theme, axes, box and legend.
    pub view: SavedView,
    /// The light of volumes that are opened without one.
    pub light: Option<Lighting>,
}

impl Remembered {
    /// Reads the file at `path`. A missing file holds no choices. A value that cannot be used is left out, and `tell` gets
    /// one line about it.
    ///
    /// # Errors
    /// The file cannot be read, or it is no TOML.
    pub fn read(path: &Path, mut tell: impl FnMut(String)) -> Result<Self, FormatError> {
        if !path.try_exists().map_err(io_error(path))? {
            return Ok(Self::default());
        }
        let expected = "choices of the window, of at most 16 kB";
        let unsupported = |found| FormatError::Unsupported { path: shown(path), found, expected };
        let bytes = read_file(path, MAX_BYTES)?.ok_or_else(|| unsupported("a longer file"))?;
        let text = String::from_utf8(bytes).map_err(|_| unsupported("bytes that are not UTF-8"))?;
        let found: Table = toml::from_str(&text).map_err(syntax_error(path, &text))?;
        Ok(Self::usable(found, |what, problem| tell(format!("{}: {what}: {problem}", shown(path)))))
    }

    /// What is good in a table. `tell` gets the name of each other value, and what is wrong with it.
    fn usable(found: Table, mut tell: impl FnMut(&str, &str)) -> Self {
        let (mut good, mut usable) = (Table::new(), Self::default());
        let mut take = |part: Option<&str>, key: String, value: Value| {
            let mut tried = good.clone();
            let place = match part {
                Some(part) => tried.entry(part).or_insert_with(|| Table::new().into()).as_table_mut(),
                None => Some(&mut tried),
            };
            let Some(place) = place else { return };
            place.insert(key.clone(), value);
            match Self::parse(tried.clone()) {
                Ok(read) => (good, usable) = (tried, read),
                Err(problem) => {
                    let what = part.map_or(key.clone(), |part| format!("{part}.{key}"));
                    tell(&one_line(&what), &one_line(&problem));
                }
            }
        };
        for (key, value) in found {
            match value {
                Value::Table(of_part) => {
                    of_part.into_iter().for_each(|(name, value)| take(Some(&key), name, value));
                }
                value => take(None, key, value),
            }
        }
        usable
    }

    fn parse(table: Table) -> Result<Self, String> {
        let read: Self = table.try_into().map_err(|e: toml::de::Error| e.message().to_owned())?;
        read.problem().map_or(Ok(read), Err)
    }

    /// The choices as TOML for [`Remembered::read`].
    pub fn to_toml(&self) -> String {
        toml::to_string(self).expect("choices are a table of numbers and names")
    }

    fn problem(&self) -> Option<String> {
        let of_size = self.size.filter(|size| size.iter().any(|side| !(SIDES.contains(side))));
        let of_size = of_size.map(|[width, height]| format!("a window of {width}×{height}"));
        let of_light = || self.light.and_then(|light| light.validate().err()).map(|e| e.to_string());
        of_size.or_else(of_light).or_else(|| self.view.problem())
    }
}

/// Sides of a window, points.
const SIDES: std::ops::RangeInclusive<u32> = 100..=16_384;
const MAX_BYTES: u64 = 1 << 14;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::state::{Srgb, Theme};

    /// Every choice, none of them the default.
    fn all() -> Remembered {
        let view = SavedView {
            theme: Some(Theme::Light),
            background: Some(Srgb([1, 2, 3])),
            shows_axes: Some(false),
            shows_legend: Some(true),
            ..SavedView::default()
        };
        let light = Some(Lighting { ambient_occlusion: 0.25, shadows: 0.5, ..Lighting::default() });
        Remembered { size: Some([1200, 800]), panel: Some(true), view, light }
    }

    /// What is read of a file, and how many values were left out.
    fn read(text: &[u8]) -> (Result<Remembered, FormatError>, usize) {
        let folder = tempfile::TempDir::new().unwrap();
        let file = folder.path().join("choices.toml");
        std::fs::write(&file, text).unwrap();
        let mut told = Vec::new();
        let found = Remembered::read(&file, |line| told.push(line));
        assert!(told.iter().all(|line| line.contains("choices.toml: ") && !line.contains('\n')), "{told:?}");
        (found, told.len())
    }

    #[test]
    fn choices_are_read_as_they_are_written() {
        let nowhere = Path::new("/nowhere/choices.toml");
        assert_eq!(Remembered::read(nowhere, |_| ()).unwrap(), Remembered::default(), "no file yet");
        for choices in [all(), Remembered::default()] {
            assert!(matches!(read(choices.to_toml().as_bytes()), (Ok(found), 0) if found == choices));
        }
        for wrong in [&b"\0"[..], b"size = ", b"\xff", &vec![b'#'; 1 << 20]] {
            let problem = read(wrong).0.unwrap_err().to_string();
            assert!(problem.contains("choices.toml"), "{problem}");
        }
    }

    #[test]
    fn a_bad_value_takes_no_other_with_it() {
        let whole: Table = toml::from_str(&all().to_toml()).unwrap();
        let bad = [
            (None, "size", "[0, 5]", Remembered { size: None, ..all() }),
            (None, "size", "[-1, 5]", Remembered { size: None, ..all() }),
            (None, "panel", "3", Remembered { panel: None, ..all() }),
            (None, "light", "7", Remembered { light: None, ..all() }),
            (None, "other", "1", all()),
            (Some("other"), "theme", "1", all()),
            (Some("view"), "theme", "\"blue\"", of_view(|view| view.theme = None)),
            (Some("view"), "background", "[1, 2]", of_view(|view| view.background = None)),
            (Some("view"), "axes", "\"yes\"", of_view(|view| view.shows_axes = None)),
            (Some("view"), "legend", "{}", of_view(|view| view.shows_legend = None)),
            (Some("view"), "frame_scale", "0.0", all()),
            (Some("light"), "ambient_occlusion", "7.0", of_light(|light| light.ambient_occlusion = 0.0)),
            (Some("light"), "shadows", "\"some\"", of_light(|light| light.shadows = 0.0)),
        ];
        for (part, key, value, kept) in bad {
            let mut table = whole.clone();
            let value = toml::from_str::<Table>(&format!("x = {value}")).unwrap()["x"].clone();
            let place = match part {
                Some(part) => {
                    table.entry(part).or_insert_with(|| Table::new().into()).as_table_mut().unwrap()
                }
                None => &mut table,
            };
            place.insert(key.into(), value);
            let (found, num_told) = read(toml::to_string(&table).unwrap().as_bytes());
            assert_eq!((found.unwrap(), num_told), (kept, 1), "{part:?} {key}");
        }
    }

    fn of_view(change: impl Fn(&mut SavedView)) -> Remembered {
        let mut all = all();
        change(&mut all.view);
        all
    }

    fn of_light(change: impl Fn(&mut Lighting)) -> Remembered {
        Remembered { light: all().light.map(|mut light| (change(&mut light), light).1), ..all() }
    }
}
