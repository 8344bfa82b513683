//! The system's own dialog for files, where there is one. A thread waits for it.

use std::path::{Path, PathBuf};
use std::pin::Pin;

use super::background::Background;
use crate::view::Waker;

/// At most one dialog at a time.
pub(crate) struct SystemDialog {
    is_wanted: bool,
    picking: Background<Picked>,
}

type PickedHandle = Pin<Box<dyn Future<Output = Option<rfd::FileHandle>> + Send>>;

pub(crate) enum Picked {
    Path(PathBuf),
    /// The person closed the dialog.
    Nothing,
    /// The system has no such dialog.
    NoDialog,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Wanted {
    File,
    Folder,
}

impl SystemDialog {
    /// Where it is not wanted, none is ever shown.
    pub(crate) fn new(is_wanted: bool) -> Self {
        Self { is_wanted, picking: Background::default() }
    }

    /// Whether there may be such a dialog.
    pub(crate) fn is_wanted(&self) -> bool {
        self.is_wanted
    }

    /// Opens the dialog in `folder`. Returns false if it is known that none opens: another has to be shown.
    pub(crate) fn open(&mut self, wanted: Wanted, wake: &Waker, folder: &Path) -> bool {
        // A second wish means that the first dialog is not seen.
        if !self.is_wanted || self.picking.is_busy() {
            return false;
        }
        let dialog = |title| rfd::AsyncFileDialog::new().set_title(title).set_directory(folder);
        // On some systems the dialog has to begin on the thread of the window.
        let picked: PickedHandle = match wanted {
            Wanted::File => Box::pin(dialog("Open a file").pick_file()),
            Wanted::Folder => Box::pin(dialog("Open a folder").pick_folder()),
        };
        self.picking = Background::run(wake, move || {
            if !has_dialog() {
                return Ok(Picked::NoDialog);
            }
            let file = pollster::block_on(picked);
            Ok(file.map_or(Picked::Nothing, |file| Picked::Path(file.path().to_owned())))
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
