//! Work on files, on a thread of its own: the window never waits for a disk.

use std::fs::OpenOptions;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, TryRecvError, sync_channel};

/// One piece of work at a time, whose outcome is a `T`.
pub(crate) struct Background<T>(Option<Receiver<T>>);

impl<T> Default for Background<T> {
    fn default() -> Self {
        Self(None)
    }
}

/// The thread ended without an outcome, or never began.
#[derive(Debug)]
pub(crate) struct Lost;

impl<T: Send + 'static> Background<T> {
    /// Whether there is work that has not been taken.
    pub(crate) fn is_busy(&self) -> bool {
        self.0.is_some()
    }

    /// Starts `work` in place of what was done before, and wakes the window when it is done.
    pub(crate) fn start(&mut self, ctx: &egui::Context, work: impl FnOnce() -> T + Send + 'static) {
        let (sender, receiver) = sync_channel(1);
        let ctx = ctx.clone();
        let run = move || {
            // Nobody listens any more if the window is closed.
            let _ = sender.send(work());
            ctx.request_repaint();
        };
        // Without a thread the sender is gone, and the outcome lost.
        let _ = std::thread::Builder::new().name("files".into()).spawn(run);
        self.0 = Some(receiver);
    }

    /// The outcome, once. Never waits.
    pub(crate) fn take(&mut self) -> Option<Result<T, Lost>> {
        let outcome = match self.0.as_ref()?.try_recv() {
            Ok(outcome) => Ok(outcome),
            Err(TryRecvError::Empty) => return None,
            Err(TryRecvError::Disconnected) => Err(Lost),
        };
        self.0 = None;
        Some(outcome)
    }
}

/// The whole text or nothing: a file that is there is replaced only if `replaces`, and then by one written aside, under a name of
/// this process alone.
pub(crate) fn write_text(path: &Path, text: &str, replaces: bool) -> std::io::Result<()> {
    if !replaces {
        let mut file = OpenOptions::new().write(true).create_new(true).open(path)?;
        return file.write_all(text.as_bytes());
    }
    let mut aside = path.as_os_str().to_owned();
    aside.push(format!(".{}.new", std::process::id()));
    let result = std::fs::write(&aside, text).and_then(|()| std::fs::rename(&aside, path));
    if result.is_err() {
        // The first error is the one to tell; what is left of the file may not even exist.
        let _ = std::fs::remove_file(&aside);
    }
    result
}

/// The path that a person wrote: without blanks around it, and with `~` for the home folder.
pub(crate) fn path_from_text(text: &str) -> Option<PathBuf> {
    let text = text.trim();
    match text.strip_prefix("~/") {
        Some(rest) => Some(std::env::home_dir()?.join(rest)),
        None => (!text.is_empty()).then(|| PathBuf::from(text)),
    }
}
