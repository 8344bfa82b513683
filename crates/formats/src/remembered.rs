//! What a person chose in the viewer's window, kept between starts in a small TOML file.

use std::path::Path;

use isinglass_core::volume::Lighting;
use serde::{Deserialize, Serialize};

use crate::error::{FormatError, io_error, shown, syntax_error};
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
    /// Reads the file at `path`. A missing file holds no choices.
    ///
    /// # Errors
    /// The file cannot be read, or it holds something else.
    pub fn read(path: &Path) -> Result<Self, FormatError> {
        if !path.try_exists().map_err(io_error(path))? {
            return Ok(Self::default());
        }
        let expected = "choices of the window, of at most 16 kB";
        let unsupported = |found| FormatError::Unsupported { path: shown(path), found, expected };
        let bytes = read_file(path, MAX_BYTES)?.ok_or_else(|| unsupported("a longer file"))?;
        let text = String::from_utf8(bytes).map_err(|_| unsupported("bytes that are not UTF-8"))?;
        Self::parse(&text).map_err(syntax_error(path, &text))
    }

    fn parse(text: &str) -> Result<Self, toml::de::Error> {
        let read: Self = toml::from_str(text)?;
        read.problem().map_or(Ok(read), |problem| Err(serde::de::Error::custom(problem)))
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

    #[test]
    fn choices_are_read_as_they_are_written_and_wrong_ones_are_named() {
        let folder = tempfile::TempDir::new().unwrap();
        let file = folder.path().join("choices.toml");
        assert_eq!(Remembered::read(&file).unwrap(), Remembered::default(), "there is no file yet");
        let view = SavedView {
            theme: Some(Theme::Light),
            background: Some(Srgb([1, 2, 3])),
            shows_axes: Some(false),
            shows_legend: Some(true),
            ..SavedView::default()
        };
        let light = Some(Lighting { ambient_occlusion: 0.25, ..Lighting::default() });
        let chosen = Remembered { size: Some([1200, 800]), panel: Some(true), view, light };
        for choices in [chosen, Remembered::default()] {
            std::fs::write(&file, choices.to_toml()).unwrap();
            assert_eq!(Remembered::read(&file).unwrap(), choices);
        }
        for wrong in [
            "size = [0, 5]",
            "size = [-1, 5]",
            "panel = 3",
            "other = 1",
            "[light]\nambient_occlusion = 7.0",
            "[view]\nframe_scale = 0.0",
            "\u{0}",
        ] {
            std::fs::write(&file, wrong).unwrap();
            let problem = Remembered::read(&file).unwrap_err().to_string();
            assert!(problem.contains("choices.toml"), "{wrong}: {problem}");
        }
        std::fs::write(&file, vec![b'#'; 1 << 20]).unwrap();
        assert!(Remembered::read(&file).is_err());
    }
}
