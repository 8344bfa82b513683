//! The rows that save and open states, and the files behind them.

use std::path::{Path, PathBuf};

use egui::{RichText, Ui};
use isinglass_formats::{ReadState, SavedState, SavedVolume, read_state};

use super::background::write_numbered;
use super::file_field::{FileField, FileOutcome};
use super::known_files::KnownFile;
use super::text::file_stem;
use crate::view::Waker;

pub(crate) enum FileContent {
    State(Box<ReadState>),
    Other(PathBuf),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum StateWish {
    Save,
    Open,
    CopyLink,
}

/// At most one file at a time.
#[derive(Default)]
pub(crate) struct StateFiles(FileField<FileContent>);

impl StateFiles {
    /// Reads the state in the file of the path field; whether there is a path.
    pub(crate) fn open(&mut self, wake: &Waker) -> bool {
        let Some(path) = self.0.path() else { return false };
        self.0.read(wake, move || read(&path));
        true
    }

    /// Reads a file that may hold a state or something else.
    pub(crate) fn open_any(&mut self, path: PathBuf, wake: &Waker) {
        self.0.read(wake, move || match KnownFile::at(&path) {
            KnownFile::State => read(&path),
            KnownFile::Transfer => Ok(FileContent::Other(path)),
            KnownFile::Volume => Err(format!(
                "{}: a volume cannot be opened beside this one; 'isinglass view' opens it",
                path.display()
            )),
            KnownFile::Unknown(problem) => Err(problem),
        });
    }

    /// Writes a state to the file of the path field. Without a path it becomes the first free `NAME.state.toml`,
    /// `NAME-2.state.toml` … of the folder that the viewer was started in.
    pub(crate) fn save(&mut self, text: String, name: &str, wake: &Waker) {
        let stem = file_stem(name);
        self.0.write(wake, text, move |text| write_numbered(text, &stem, ".state.toml"));
    }

    /// What has become of the file, once. Never waits. The rows say it, too.
    pub(crate) fn take(&mut self) -> Option<Result<FileOutcome<FileContent>, String>> {
        let outcome = self.0.take()?;
        if let Ok(FileOutcome::Read(FileContent::State(read))) = &outcome {
            self.0.message.clone_from(&read.note);
        }
        Some(outcome)
    }

    pub(crate) fn show(&mut self, ui: &mut Ui) -> Option<StateWish> {
        let mut wish = None;
        let hint = "file of a state; saved under a new name if empty";
        let field = self.0.show(ui, f32::INFINITY, "file of the state", hint);
        if field.lost_focus() && ui.input(|i| i.key_pressed(egui::Key::Enter)) {
            wish = Some(StateWish::Open);
        }
        ui.horizontal(|ui| {
            let is_free = !self.0.is_busy();
            let save = if self.0.is_replacing() { "replace state" } else { "save state" };
            let open_hint = "or drop the file on the window; without a path a list of files opens";
            for (text, hint, wanted) in [
                (save, "all that is seen, and how, as TOML", StateWish::Save),
                ("open state", open_hint, StateWish::Open),
                ("copy link", "to this view; it gives no access to the server", StateWish::CopyLink),
            ] {
                if ui.add_enabled(is_free, egui::Button::new(text)).on_hover_text(hint).clicked() {
                    wish = Some(wanted);
                }
            }
        });
        if let Some(message) = &self.0.message {
            ui.add(egui::Label::new(RichText::new(message).size(11.0)).wrap());
        }
        wish
    }

    #[cfg(test)]
    pub(crate) fn set_path(&mut self, path: &Path) {
        self.0.set_path(path);
    }
}

/// A path that does not exist on this machine is left out: the same voxels may be shown from elsewhere.
fn read(path: &Path) -> Result<FileContent, String> {
    let ReadState { state, note } = read_state(path).map_err(|e| e.to_string())?;
    let place = |v: SavedVolume| if v.is_here() { v } else { v.without_place() };
    let volume = state.volume.map(place);
    Ok(FileContent::State(Box::new(ReadState { state: SavedState { volume, ..state }, note })))
}
