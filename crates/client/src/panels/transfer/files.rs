//! Reads and writes transfer functions on a thread of its own.

use std::path::PathBuf;

use isinglass_core::transfer::TransferFunction;
use isinglass_formats::{ImportedTransfer, import_transfers, transfer_to_toml};

use crate::background::{Background, Lost, write_text};

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
    running: Background<Outcome>,
}

impl Files {
    /// Whether a file is being read or written.
    pub(super) fn is_busy(&self) -> bool {
        self.running.is_busy()
    }

    /// Reads every look in a file.
    pub(super) fn read(&mut self, path: PathBuf, ctx: &egui::Context) {
        self.running.start(ctx, move || match import_transfers(&path) {
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
        self.running.start(ctx, move || match write_text(&path, &text, replaces) {
            Ok(()) => Outcome::Written(path),
            Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => Outcome::Exists(path),
            Err(e) => Outcome::Failed(format!("{}: {e}", path.display())),
        });
    }

    /// What has become of the file, once. Never waits.
    pub(super) fn take(&mut self) -> Option<Outcome> {
        let outcome = self.running.take()?;
        Some(outcome.unwrap_or_else(|Lost| Outcome::Failed("the file could not be used".into())))
    }
}
