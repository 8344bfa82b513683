//! A field for the path of a file, which is read or written on a thread.

use std::path::PathBuf;

use egui::{Response, Role, TextEdit, Ui};

use super::background::{Background, Written, path_from_text, write_text};
use super::style::named;
use crate::view::Waker;

pub(crate) enum FileOutcome<R> {
    Read(R),
    Written(Written),
}

/// At most one file at a time. `R` is what a file holds.
pub(crate) struct FileField<R> {
    path: String,
    /// A file that exists. It is replaced if it is written once more.
    replaces: Option<PathBuf>,
    running: Background<FileOutcome<R>>,
    /// News of the file for the person.
    pub(crate) message: Option<String>,
}

impl<R> Default for FileField<R> {
    fn default() -> Self {
        Self { path: String::new(), replaces: None, running: Background::default(), message: None }
    }
}

impl<R: Send + 'static> FileField<R> {
    pub(crate) fn path(&self) -> Option<PathBuf> {
        path_from_text(&self.path)
    }

    pub(crate) fn set_path(&mut self, path: &std::path::Path) {
        self.path = path.display().to_string();
    }

    pub(crate) fn is_busy(&self) -> bool {
        self.running.is_busy()
    }

    pub(crate) fn is_replacing(&self) -> bool {
        self.replaces.is_some()
    }

    /// The field. `name` is for screen readers, `hint` stands in the empty field.
    pub(crate) fn show(&mut self, ui: &mut Ui, width: f32, name: &str, hint: &str) -> Response {
        let field = ui.add(TextEdit::singleline(&mut self.path).desired_width(width).hint_text(hint));
        named(&field, Role::TextInput, name);
        if field.changed() {
            (self.replaces, self.message) = (None, None);
        }
        field
    }

    /// Reads a file by `work`.
    pub(crate) fn read(&mut self, wake: &Waker, work: impl FnOnce() -> Result<R, String> + Send + 'static) {
        self.message = None;
        self.running = Background::run(wake, move || work().map(FileOutcome::Read));
    }

    /// Writes a text to the path of the field. Without a path, `elsewhere` writes it.
    pub(crate) fn write(
        &mut self,
        wake: &Waker,
        text: String,
        elsewhere: impl FnOnce(&str) -> Result<Written, String> + Send + 'static,
    ) {
        self.message = None;
        let path = self.path();
        let replaces = path.is_some() && self.replaces.take() == path;
        self.running = Background::run(wake, move || {
            let written = match path {
                Some(path) => write_text(path, &text, replaces),
                None => elsewhere(&text),
            };
            written.map(FileOutcome::Written)
        });
    }

    /// What has become of the file, once. Never waits. What it says is in `message`, too.
    pub(crate) fn take(&mut self) -> Option<Result<FileOutcome<R>, String>> {
        let outcome = self.running.take()?;
        self.message = match &outcome {
            Ok(FileOutcome::Read(_)) => None,
            Ok(FileOutcome::Written(Written::At(path))) => Some(format!("saved as {}", path.display())),
            Ok(FileOutcome::Written(Written::Exists(path))) => {
                self.replaces = Some(path.clone());
                Some("there is such a file; press again to replace it".into())
            }
            Err(problem) => Some(problem.clone()),
        };
        Some(outcome)
    }

    #[cfg(test)]
    pub(crate) fn forget_that_it_exists(&mut self) {
        self.replaces = None;
    }
}
