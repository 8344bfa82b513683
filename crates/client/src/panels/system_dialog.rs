//! The system's own dialog for files, where there is one. A thread waits for it.

use std::path::{Path, PathBuf};

use super::background::Background;
use crate::view::Waker;

/// At most one dialog at a time.
pub(crate) struct SystemDialog {
    is_wanted: bool,
    picking: Background<Picked>,
}

pub(crate) enum Picked {
    File(PathBuf),
    /// The person closed the dialog.
    Nothing,
    /// The system has no such dialog.
    NoDialog,
}

impl SystemDialog {
    /// Where it is not wanted, none is ever shown.
    pub(crate) fn new(is_wanted: bool) -> Self {
        Self { is_wanted, picking: Background::default() }
    }

    /// Opens the dialog in `folder`. Returns false if it is known that none opens: another has to be shown.
    pub(crate) fn open(&mut self, wake: &Waker, folder: &Path) -> bool {
        // A second wish means that the first dialog is not seen.
        if !self.is_wanted || self.picking.is_busy() {
            return false;
        }
        let dialog = rfd::AsyncFileDialog::new().set_title("Open a file").set_directory(folder);
        // On some systems the dialog has to begin on the thread of the window.
        let picked = dialog.pick_file();
        self.picking = Background::run(wake, move || {
            if !has_dialog() {
                return Ok(Picked::NoDialog);
            }
            let file = pollster::block_on(picked);
            Ok(file.map_or(Picked::Nothing, |file| Picked::File(file.path().to_owned())))
        });
        true
    }

    /// The outcome, once. Never waits.
    pub(crate) fn take(&mut self) -> Option<Picked> {
        let picked = self.picking.take()?.unwrap_or(Picked::NoDialog);
        if matches!(picked, Picked::NoDialog) {
            self.is_wanted = false;
        }
        Some(picked)
    }
}

/// Whether the desktop answers for its dialog.
#[cfg(all(unix, not(target_os = "macos")))]
fn has_dialog() -> bool {
    let version = || {
        let session = zbus::blocking::connection::Builder::session()?.method_timeout(PATIENCE).build()?;
        let arguments = ("org.freedesktop.portal.FileChooser", "version");
        let (to, path) = ("org.freedesktop.portal.Desktop", "/org/freedesktop/portal/desktop");
        session.call_method(Some(to), path, Some("org.freedesktop.DBus.Properties"), "Get", &arguments)
    };
    version().is_ok()
}

#[cfg(not(all(unix, not(target_os = "macos"))))]
fn has_dialog() -> bool {
    true
}

/// The desktop answers within this time, or counts as none.
#[cfg(all(unix, not(target_os = "macos")))]
const PATIENCE: std::time::Duration = std::time::Duration::from_secs(2);
