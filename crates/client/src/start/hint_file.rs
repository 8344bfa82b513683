//! How often the program was started, and which hints are done: a small file beside the recent list.

use std::io::Read;
use std::path::{Path, PathBuf};

use isinglass_formats::open_file;

use crate::panels::background::{Background, write_own};
use crate::panels::hints::{Hint, Hints};
use crate::view::waker_of;

/// Threads read and write the file.
pub(super) struct HintFile {
    path: Option<PathBuf>,
    num_starts: u32,
    /// The hints that the file says are left; none before it is read.
    stored: Option<Hints>,
    reading: Background<(u32, Hints)>,
    writing: Background<()>,
}

impl HintFile {
    pub(super) fn new(recent_file: Option<&Path>, ctx: &egui::Context) -> Self {
        let path = recent_file.and_then(Path::parent).map(|folder| folder.join("hints.txt"));
        let reading = match path.clone() {
            Some(path) => Background::run(&waker_of(ctx), move || Ok(read(&path))),
            None => Background::default(),
        };
        Self { path, num_starts: 0, stored: None, reading, writing: Background::default() }
    }

    /// The hints to show, once they are known. Counts this start.
    pub(super) fn take(&mut self, ctx: &egui::Context) -> Option<Hints> {
        let (before, hints) = self.reading.take()?.ok()?;
        self.num_starts = before.saturating_add(1);
        self.stored = Some(hints.clone());
        self.write(ctx, &hints);
        (before < STARTS_WITH_HINTS).then_some(hints)
    }

    /// Stores which hints are left, if that has changed.
    pub(super) fn follow(&mut self, ctx: &egui::Context, hints: &Hints) {
        let is_writing = self.writing.is_busy() && self.writing.take().is_none();
        if !is_writing && self.is_news(hints) {
            self.stored = Some(hints.clone());
            self.write(ctx, hints);
        }
    }

    /// The same at once, for a window that has closed.
    pub(super) fn finish(&mut self, hints: &Hints) {
        self.writing.finish();
        if let Some(path) = self.path.as_ref().filter(|_| self.is_news(hints)) {
            let _ = write_own(path, text_of(self.num_starts, hints).as_bytes());
        }
    }

    fn is_news(&self, hints: &Hints) -> bool {
        self.num_starts <= STARTS_WITH_HINTS && self.stored.as_ref().is_some_and(|s| s != hints)
    }

    fn write(&mut self, ctx: &egui::Context, hints: &Hints) {
        let Some(path) = self.path.clone() else { return };
        let text = text_of(self.num_starts, hints);
        self.writing = Background::run(&waker_of(ctx), move || write_own(&path, text.as_bytes()));
    }
}

fn text_of(num_starts: u32, hints: &Hints) -> String {
    let is_done = |hint: &Hint| !hints.left().contains(hint);
    let done: Vec<_> = Hint::ALL.into_iter().filter(is_done).map(Hint::word).collect();
    format!("starts {num_starts}\ndone {}\n", done.join(" "))
}

/// What the file says. One that cannot be read is that of a first start.
fn read(path: &Path) -> (u32, Hints) {
    let mut text = String::new();
    let is_read = open_file(path).map(|file| file.take(MOST_BYTES).read_to_string(&mut text));
    let line = |name: &str| {
        let mut lines = text.lines().filter_map(|line| line.strip_prefix(name)).map(str::trim);
        lines.next().unwrap_or_default()
    };
    let done: Vec<_> = line("done ").split(' ').collect();
    let left = Hint::ALL.into_iter().filter(|hint| !done.contains(&hint.word())).collect();
    match is_read {
        Ok(Ok(_)) => (line("starts ").parse().unwrap_or(0), Hints::of(left)),
        _ => (0, Hints::of(Hint::ALL.to_vec())),
    }
}

const MOST_BYTES: u64 = 1000;
/// Hints are shown in so many starts.
const STARTS_WITH_HINTS: u32 = 3;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn starts_are_counted_and_what_is_done_stays_done() {
        let folder = tempfile::TempDir::new().unwrap();
        let (path, all) = (folder.path().join("hints.txt"), Hints::of(Hint::ALL.to_vec()));
        assert_eq!(read(&path), (0, all.clone()));
        let mut hints = all.clone();
        hints.note(Hint::Zoom);
        std::fs::write(&path, text_of(2, &hints)).unwrap();
        assert_eq!(read(&path), (2, hints));
        // Anything else is a first start, and takes no memory.
        for bytes in [&b"\xff\xfe"[..], b"starts -1\n", &[b'7'; 100_000]] {
            std::fs::write(&path, bytes).unwrap();
            assert_eq!(read(&path), (0, all.clone()));
        }
    }

    #[test]
    fn hints_are_shown_in_the_first_three_starts() {
        let folder = tempfile::TempDir::new().unwrap();
        let (recent, ctx) = (folder.path().join("recent.toml"), egui::Context::default());
        let start = || {
            let mut file = HintFile::new(Some(&recent), &ctx);
            while file.reading.is_busy() {
                if let Some(hints) = file.take(&ctx) {
                    break_when_written(&mut file);
                    return Some(hints);
                }
                std::thread::sleep(std::time::Duration::from_millis(1));
            }
            break_when_written(&mut file);
            None
        };
        let shown: Vec<_> = (0..5).map(|_| start().is_some()).collect();
        assert_eq!(shown, [true, true, true, false, false]);
        // What is done last is kept at exit.
        std::fs::remove_file(folder.path().join("hints.txt")).unwrap();
        let mut file = HintFile::new(Some(&recent), &ctx);
        let mut hints = None;
        while hints.is_none() {
            hints = file.take(&ctx);
        }
        let mut hints = hints.unwrap();
        hints.note(Hint::Zoom);
        file.finish(&hints);
        assert_eq!(read(&folder.path().join("hints.txt")), (1, hints));
    }

    fn break_when_written(file: &mut HintFile) {
        while file.writing.is_busy() && file.writing.take().is_none() {
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
    }
}
