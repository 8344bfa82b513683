//! Reads and writes transfer functions on a thread of its own: the window never waits for a disk.

use std::fs::OpenOptions;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, sync_channel};

use isinglass_core::transfer::TransferFunction;
use isinglass_formats::{ImportedTransfer, import_transfers, transfer_to_toml};

/// What has become of a file.
#[derive(Debug)]
pub(super) enum Outcome {
    /// What it holds.
    Read(Vec<ImportedTransfer>),
    /// It was written.
    Written(PathBuf),
    /// There is a file of that name already.
    Exists(PathBuf),
    /// One line of what went wrong.
    Failed(String),
}

/// At most one file at a time.
#[derive(Default)]
pub(super) struct Files {
    running: Option<Receiver<Outcome>>,
}

impl Files {
    /// Whether a file is being read or written.
    pub(super) fn is_busy(&self) -> bool {
        self.running.is_some()
    }

    /// Reads every look in a file.
    pub(super) fn read(&mut self, path: PathBuf, ctx: &egui::Context) {
        self.start(ctx, move || match import_transfers(&path) {
            Ok(found) => Outcome::Read(found),
            Err(e) => Outcome::Failed(e.to_string()),
        });
    }

    /// Writes a transfer function as TOML. A file that is there is replaced only if `replaces`.
    pub(super) fn write(
        &mut self,
        path: PathBuf,
        transfer: &TransferFunction,
        replaces: bool,
        ctx: &egui::Context,
    ) {
        let text = transfer_to_toml(transfer);
        self.start(ctx, move || match write(&path, &text, replaces) {
            Ok(()) => Outcome::Written(path),
            Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => Outcome::Exists(path),
            Err(e) => Outcome::Failed(format!("{}: {e}", path.display())),
        });
    }

    /// What has become of the file, once. Never waits.
    pub(super) fn take(&mut self) -> Option<Outcome> {
        let outcome = match self.running.as_ref()?.try_recv() {
            Ok(outcome) => outcome,
            Err(std::sync::mpsc::TryRecvError::Empty) => return None,
            Err(std::sync::mpsc::TryRecvError::Disconnected) => {
                Outcome::Failed("the file could not be used".into())
            }
        };
        self.running = None;
        Some(outcome)
    }

    fn start(&mut self, ctx: &egui::Context, work: impl FnOnce() -> Outcome + Send + 'static) {
        let (sender, receiver) = sync_channel(1);
        let ctx = ctx.clone();
        let run = move || {
            // Nobody listens any more if the window is closed.
            let _ = sender.send(work());
            ctx.request_repaint();
        };
        // Without a thread the sender is gone, and the outcome a failure.
        let _ = std::thread::Builder::new().name("presets".into()).spawn(run);
        self.running = Some(receiver);
    }
}

/// The whole text or nothing: under another name first.
fn write(path: &Path, text: &str, replaces: bool) -> std::io::Result<()> {
    if !replaces {
        let mut file = OpenOptions::new().write(true).create_new(true).open(path)?;
        return file.write_all(text.as_bytes());
    }
    let mut aside = path.as_os_str().to_owned();
    aside.push(".new");
    std::fs::write(&aside, text)?;
    std::fs::rename(&aside, path)
}

/// The path that a person wrote: without blanks around it, and with `~` for the home folder.
pub(super) fn path_from_text(text: &str) -> Option<PathBuf> {
    let text = text.trim();
    match text.strip_prefix("~/") {
        Some(rest) => Some(std::env::home_dir()?.join(rest)),
        None => (!text.is_empty()).then(|| PathBuf::from(text)),
    }
}
