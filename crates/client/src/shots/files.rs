//! Where pictures go, and their way there.

use std::fs::OpenOptions;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, TryRecvError, sync_channel};
use std::time::{SystemTime, UNIX_EPOCH};

use isinglass_core::session::screenshot::ReceivedScreenshot;

/// A picture that a thread writes.
pub(super) struct Writing {
    outcome: Receiver<Result<PathBuf, String>>,
}

impl Writing {
    /// Writes a picture to `path`, or beside it under another number if there is a file already. Its folder is made.
    pub(super) fn start(path: PathBuf, shot: Arc<ReceivedScreenshot>, ctx: &egui::Context) -> Self {
        let (sender, outcome) = sync_channel(1);
        let ctx = ctx.clone();
        let run = move || {
            let png = shot.png.as_deref().unwrap_or_default();
            // Nobody listens any more if the window is closed.
            let _ = sender.send(write(&path, png).map_err(|e| format!("{}: {e}", path.display())));
            ctx.request_repaint();
        };
        // Without a thread the sender is gone, and the outcome a failure.
        let _ = std::thread::Builder::new().name("picture".into()).spawn(run);
        Self { outcome }
    }

    /// The file, or one line of what went wrong, once. Never waits.
    pub(super) fn take(&mut self) -> Option<Result<PathBuf, String>> {
        match self.outcome.try_recv() {
            Ok(outcome) => Some(outcome),
            Err(TryRecvError::Empty) => None,
            Err(TryRecvError::Disconnected) => Some(Err("the file could not be written".into())),
        }
    }
}

/// No file is ever replaced.
fn write(path: &Path, bytes: &[u8]) -> std::io::Result<PathBuf> {
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder)?;
    }
    for number in 1..MAX_NUMBER {
        let path = match number {
            1 => path.to_owned(),
            _ => {
                let stem = path.file_stem().unwrap_or_default().to_string_lossy();
                path.with_file_name(format!("{stem}-{number}.png"))
            }
        };
        let mut file = match OpenOptions::new().write(true).create_new(true).open(&path) {
            Err(e) if e.kind() == ErrorKind::AlreadyExists => continue,
            file => file?,
        };
        if let Err(e) = file.write_all(bytes) {
            // Half a picture is none.
            drop(file);
            let _ = std::fs::remove_file(&path);
            return Err(e);
        }
        return Ok(path);
    }
    Err(ErrorKind::AlreadyExists.into())
}

/// The folder for pictures of the person at the window, or the next best.
pub(super) fn default_folder() -> PathBuf {
    let home = std::env::home_dir().filter(|home| home.is_dir());
    let pictures = home.as_ref().map(|home| home.join("Pictures")).filter(|p| p.is_dir());
    pictures.or(home).unwrap_or_else(|| PathBuf::from("."))
}

/// A folder as a person writes it.
pub(super) fn folder_from_text(text: &str) -> PathBuf {
    let text = text.trim();
    match (text.strip_prefix("~/"), std::env::home_dir()) {
        (Some(rest), Some(home)) => home.join(rest),
        _ if text.is_empty() => default_folder(),
        _ => PathBuf::from(text),
    }
}

/// A moment, as files are named by it: universal time.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stamp {
    seconds: u64,
}

impl Stamp {
    pub(super) fn now() -> Self {
        Self { seconds: SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs()) }
    }

    /// The name of a picture, or of the folder of several, of a volume called `name`.
    pub(super) fn file_name(self, name: &str, is_folder: bool) -> String {
        let stem = name.split('.').next().unwrap_or_default();
        let keeps = |c: char| c.is_alphanumeric() || matches!(c, '-' | '_');
        let stem: String = stem.chars().map(|c| if keeps(c) { c } else { '_' }).take(60).collect();
        let stem = if stem.is_empty() { "volume" } else { &stem };
        let end = if is_folder { "-turntable" } else { ".png" };
        format!("{stem}-{self}{end}")
    }
}

impl std::fmt::Display for Stamp {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (days, seconds) = (self.seconds / 86_400, self.seconds % 86_400);
        // Years from March on, so that a leap day ends one: 400 of them have 146 097 days (Hinnant, civil_from_days).
        let days = days + 719_468;
        let (era, day) = (days / 146_097, days % 146_097);
        let year = (day - day / 1460 + day / 36_524 - day / 146_096) / 365;
        let day = day - (365 * year + year / 4 - year / 100);
        let month = (5 * day + 2) / 153;
        let day = day - (153 * month + 2) / 5 + 1;
        let (month, year) = if month < 10 { (month + 3, year) } else { (month - 9, year + 1) };
        let (hours, minutes) = (seconds / 3600, seconds / 60 % 60);
        write!(f, "{:04}{month:02}{day:02}-{hours:02}{minutes:02}{:02}", era * 400 + year, seconds % 60)
    }
}

/// Files of one name in a folder, at most.
const MAX_NUMBER: u32 = 1000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_called_by_volume_and_time() {
        for (seconds, text) in [
            (0, "19700101-000000"),
            (951_782_400, "20000229-000000"),
            (1_795_311_301, "20261122-013501"),
            (1_735_689_599, "20241231-235959"),
        ] {
            assert_eq!(Stamp { seconds }.to_string(), text);
        }
        let stamp = Stamp { seconds: 0 };
        assert_eq!(stamp.file_name("my head.nii.gz", false), "my_head-19700101-000000.png");
        assert_eq!(stamp.file_name("../../etc", true), "volume-19700101-000000-turntable");
        assert_eq!(stamp.file_name("builtin:shells", false), "builtin_shells-19700101-000000.png");
    }

    #[test]
    fn no_file_is_replaced() {
        let folder = std::env::temp_dir().join(format!("isinglass-shots-{}", std::process::id()));
        let path = folder.join("deeper").join("a.png");
        assert_eq!(write(&path, b"one").unwrap(), path);
        let second = write(&path, b"two").unwrap();
        assert_eq!(second, folder.join("deeper").join("a-2.png"));
        assert_eq!(std::fs::read(&path).unwrap(), b"one");
        assert_eq!(std::fs::read(&second).unwrap(), b"two");
        assert!(write(&path.join("below a file").join("b.png"), b"").is_err());
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
