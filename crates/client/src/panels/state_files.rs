//! The rows of the panel that save and open states, and the files behind them.

use std::path::{Path, PathBuf};

use egui::{RichText, Ui};
use isinglass_formats::{MAX_STATE_BYTES, ReadState, SavedState, SavedVolume, is_state, read_state};

use crate::background::{Background, Lost, path_from_text, write_text};

/// What has become of a file.
pub(crate) enum Outcome {
    /// The state in it.
    Read(Box<ReadState>),
    /// A file that was dropped on the window, or chosen in the dialog, is no state.
    NoState(PathBuf),
    /// It was written.
    Written(PathBuf),
    /// There is a file of that name already.
    Exists(PathBuf),
    /// One line of what went wrong.
    Failed(String),
}

/// What was asked for in the rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum StateWish {
    /// To write a file.
    Save,
    /// To read one.
    Open,
    /// A link to what is seen.
    CopyLink,
}

/// At most one file at a time.
#[derive(Default)]
pub(crate) struct StateFiles {
    path: String,
    /// A file that is there, and is replaced if it is asked for once more.
    replaces: Option<PathBuf>,
    running: Background<Outcome>,
    message: Option<String>,
}

impl StateFiles {
    /// Reads the state in the file of the path field; whether there is a path.
    pub(crate) fn open(&mut self, ctx: &egui::Context) -> bool {
        let Some(path) = path_from_text(&self.path) else { return false };
        self.message = None;
        self.running.start(ctx, move || read(&path));
        true
    }

    /// Reads the state in a file that may be one, or hold something else.
    pub(crate) fn open_any(&mut self, path: PathBuf, ctx: &egui::Context) {
        self.running.start(ctx, move || match begin_of(&path) {
            Ok(begin) if is_state(&begin) => read(&path),
            // Whoever opens other files says what is wrong with this one.
            _ => Outcome::NoState(path),
        });
    }

    /// Writes a state to the file of the path field; without a path to the first free `NAME.state.toml`, `NAME-2.state.toml` …
    /// of the folder that the viewer was started in.
    pub(crate) fn save(&mut self, text: String, name: &str, ctx: &egui::Context) {
        self.message = None;
        let path = path_from_text(&self.path);
        let replaces = path.is_some() && self.replaces.take() == path;
        let stem: String = name.chars().map(|c| if is_plain(c) { c } else { '_' }).take(80).collect();
        self.running.start(ctx, move || match path {
            Some(path) => match write_text(&path, &text, replaces) {
                Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => Outcome::Exists(path),
                result => outcome_of(result, path),
            },
            None => write_numbered(&text, &stem),
        });
    }

    /// What has become of the file, once. Never waits. What it says is shown in the rows too.
    pub(crate) fn take(&mut self) -> Option<Outcome> {
        let outcome = self.running.take()?;
        let outcome = outcome.unwrap_or_else(|Lost| Outcome::Failed("the file could not be used".into()));
        self.message = match &outcome {
            Outcome::Read(read) => read.note.clone(),
            Outcome::NoState(_) => None,
            Outcome::Written(path) => Some(format!("saved as {}", path.display())),
            Outcome::Exists(path) => {
                self.replaces = Some(path.clone());
                Some("there is such a file; save again to replace it".into())
            }
            Outcome::Failed(problem) => Some(problem.clone()),
        };
        Some(outcome)
    }

    /// The rows.
    pub(crate) fn show(&mut self, ui: &mut Ui) -> Option<StateWish> {
        let mut wish = None;
        let field = egui::TextEdit::singleline(&mut self.path)
            .desired_width(f32::INFINITY)
            .hint_text("file of a state; saved under a new name if empty");
        let field = ui.add(field);
        field.widget_info(|| egui::WidgetInfo::labeled(egui::Role::TextInput, true, "file of the state"));
        if field.changed() {
            self.replaces = None;
            self.message = None;
        }
        if field.lost_focus() && ui.input(|i| i.key_pressed(egui::Key::Enter)) {
            wish = Some(StateWish::Open);
        }
        ui.horizontal(|ui| {
            let is_free = !self.running.is_busy();
            let save = if self.replaces.is_some() { "replace state" } else { "save state" };
            for (text, hint, wanted) in [
                (save, "all that is seen, and how, as TOML", StateWish::Save),
                (
                    "open state",
                    "or drop the file on the window; without a path a list of files opens",
                    StateWish::Open,
                ),
                ("copy link", "to what is seen; it lets nobody in", StateWish::CopyLink),
            ] {
                if ui.add_enabled(is_free, egui::Button::new(text)).on_hover_text(hint).clicked() {
                    wish = Some(wanted);
                }
            }
        });
        if let Some(message) = &self.message {
            ui.add(egui::Label::new(RichText::new(message).size(11.0)).wrap());
        }
        wish
    }

    #[cfg(test)]
    pub(crate) fn set_path(&mut self, path: &Path) {
        self.path = path.display().to_string();
    }
}

/// A place that is none of this machine's is left out: the same voxels may be shown from elsewhere.
fn read(path: &Path) -> Outcome {
    match read_state(path) {
        Ok(ReadState { state, note }) => {
            let place = |v: SavedVolume| if v.is_here() { v } else { v.without_place() };
            let volume = state.volume.map(place);
            Outcome::Read(Box::new(ReadState { state: SavedState { volume, ..state }, note }))
        }
        Err(e) => Outcome::Failed(e.to_string()),
    }
}

fn begin_of(path: &Path) -> std::io::Result<Vec<u8>> {
    use std::io::Read;
    if !path.is_file() {
        return Ok(Vec::new());
    }
    let mut begin = Vec::new();
    std::fs::File::open(path)?.take(MAX_STATE_BYTES + 1).read_to_end(&mut begin)?;
    Ok(begin)
}

fn write_numbered(text: &str, stem: &str) -> Outcome {
    for number in 1..=MAX_NUMBER {
        let number = if number == 1 { String::new() } else { format!("-{number}") };
        let path = PathBuf::from(format!("{stem}{number}.state.toml"));
        match write_text(&path, text, false) {
            Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => {}
            result => return outcome_of(result, path),
        }
    }
    Outcome::Failed(format!("{stem}.state.toml: there are {MAX_NUMBER} such files; name another"))
}

fn outcome_of(result: std::io::Result<()>, path: PathBuf) -> Outcome {
    match result {
        Ok(()) => Outcome::Written(std::path::absolute(&path).unwrap_or(path)),
        Err(e) => Outcome::Failed(format!("{}: {e}", path.display())),
    }
}

/// Of a volume's name, what a file's name may have on every system.
fn is_plain(c: char) -> bool {
    c.is_alphanumeric() || "-_.".contains(c)
}

/// Files that are numbered.
const MAX_NUMBER: u32 = 999;
