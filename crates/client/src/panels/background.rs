//! Work that may wait for a disk, on a thread of its own: the window never waits.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, RecvTimeoutError, TryRecvError, sync_channel};
use std::time::Duration;

use isinglass_formats::{write_new, write_private, write_whole};

use crate::view::Waker;

/// One piece of work at a time. It yields a `T`, or one line that says why not.
pub(crate) struct Background<T>(Option<Receiver<Result<T, String>>>);

impl<T> Default for Background<T> {
    fn default() -> Self {
        Self(None)
    }
}

impl<T: Send + 'static> Background<T> {
    /// Starts `work` on a thread, which wakes the window at the end.
    pub(crate) fn run(wake: &Waker, work: impl FnOnce() -> Result<T, String> + Send + 'static) -> Self {
        let (sender, receiver) = sync_channel(1);
        let wake = wake.clone();
        let run = move || {
            // After a panic the sender is gone. The receiver reports that as an error.
            if let Ok(outcome) = catch_unwind(AssertUnwindSafe(work)) {
                // Nobody listens any more if the window is closed.
                let _ = sender.send(outcome);
            }
            drop(sender);
            wake();
        };
        // Without a thread the sender is gone, too.
        let _ = std::thread::Builder::new().name("background".into()).spawn(run);
        Self(Some(receiver))
    }

    pub(crate) fn is_busy(&self) -> bool {
        self.0.is_some()
    }

    /// The outcome, once. Never waits.
    pub(crate) fn take(&mut self) -> Option<Result<T, String>> {
        let outcome = match self.0.as_ref()?.try_recv() {
            Ok(outcome) => outcome,
            Err(TryRecvError::Empty) => return None,
            Err(TryRecvError::Disconnected) => Err(DEFECT.into()),
        };
        self.0 = None;
        Some(outcome)
    }

    /// The same, but waits. Only a window that has closed may call it.
    pub(crate) fn finish(&mut self) -> Option<Result<T, String>> {
        Some(match self.0.take()?.recv_timeout(EXIT_PATIENCE) {
            Ok(outcome) => outcome,
            Err(RecvTimeoutError::Timeout) => Err("the disk does not answer".into()),
            Err(RecvTimeoutError::Disconnected) => Err(DEFECT.into()),
        })
    }
}

#[derive(Debug, PartialEq)]
pub(crate) enum Written {
    /// It is at this absolute path.
    At(PathBuf),
    /// A file of that name exists already, and was not to be replaced.
    Exists(PathBuf),
}

/// Writes the whole text or nothing. A file that exists is replaced only if `replaces`, and then atomically.
///
/// # Errors
/// One line with the path.
pub(crate) fn write_text(path: PathBuf, text: &str, replaces: bool) -> Result<Written, String> {
    if replaces {
        write_whole(&path, text.as_bytes()).map_err(|e| e.to_string())?;
    } else if let Err(e) = write_new(&path, text.as_bytes()) {
        return match e.kind() {
            std::io::ErrorKind::AlreadyExists => Ok(Written::Exists(path)),
            _ => Err(format!("{}: {e}", path.display())),
        };
    }
    Ok(Written::At(std::path::absolute(&path).unwrap_or(path)))
}

/// Writes a new file: the first free one of `stem` and `ending`, `stem-2` and `ending` … in the folder that the viewer
/// was started in.
///
/// # Errors
/// One line with the path.
pub(crate) fn write_numbered(text: &str, stem: &str, ending: &str) -> Result<Written, String> {
    for number in 1..=MAX_NUMBER {
        let number = if number == 1 { String::new() } else { format!("-{number}") };
        match write_text(PathBuf::from(format!("{stem}{number}{ending}")), text, false) {
            Ok(Written::Exists(_)) => {}
            written => return written,
        }
    }
    Err(format!("{stem}{ending}: there are {MAX_NUMBER} such files; name another"))
}

/// Writes a file of the program, whole or not at all. It and its folder are their owner's alone.
///
/// # Errors
/// One line with the path.
pub(crate) fn write_own(path: &Path, bytes: &[u8]) -> Result<(), String> {
    write_private(path, bytes).map_err(|e| e.to_string())
}

/// The path that a person wrote: without blanks around it, and with `~` for the home folder.
pub(crate) fn path_from_text(text: &str) -> Option<PathBuf> {
    let text = text.trim();
    match text.strip_prefix("~/") {
        Some(rest) => Some(std::env::home_dir()?.join(rest)),
        None => (!text.is_empty()).then(|| PathBuf::from(text)),
    }
}

/// A window that has closed waits this long for a disk.
const EXIT_PATIENCE: Duration = Duration::from_secs(5);
const DEFECT: &str = "a defect of the program ended this early";
/// Numbered files of one name, at most.
const MAX_NUMBER: u32 = 999;

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    #[test]
    fn work_that_panics_wakes_and_has_failed() {
        let (wake, woken) = sync_channel(1);
        let wake: Waker = Arc::new(move || wake.send(()).unwrap());
        let mut work = Background::<()>::run(&wake, || panic!("for the test"));
        woken.recv().unwrap();
        assert!(work.is_busy() && matches!(work.take(), Some(Err(_))) && !work.is_busy());
        let mut work = Background::run(&wake, || Ok(7));
        woken.recv().unwrap();
        assert_eq!((work.take(), work.take()), (Some(Ok(7)), None));
        let quiet: Waker = Arc::new(|| {});
        let mut slow = Background::run(&quiet, || {
            std::thread::sleep(Duration::from_millis(50));
            Ok(8)
        });
        assert_eq!((slow.take(), slow.finish(), slow.finish()), (None, Some(Ok(8)), None));
    }
}
