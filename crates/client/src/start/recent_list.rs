//! The recent list and its file.

use std::path::{Path, PathBuf};

use isinglass_formats::{Recent, RecentEntry, RecentPlace};

use crate::panels::background::{Background, write_own};
use crate::view::waker_of;

/// Background threads read and write, so that the page need not wait for its list.
pub(crate) struct RecentList {
    file: Option<PathBuf>,
    /// Before the file is read, this holds what was added meanwhile.
    list: Recent,
    reading: Background<Recent>,
    writing: Background<()>,
    /// The text to write when the disk is free again.
    waiting: Option<String>,
    problem: Option<String>,
    /// What the list has dropped since it was last asked.
    dropped: Vec<RecentPlace>,
}

impl RecentList {
    pub(crate) fn new(file: Option<PathBuf>, ctx: &egui::Context) -> Self {
        let mut reading = Background::default();
        if let Some(file) = file.clone() {
            reading = Background::run(&waker_of(ctx), move || Recent::read(&file).map_err(|e| e.to_string()));
        }
        let (list, writing) = (Recent::default(), Background::default());
        Self { file, list, reading, writing, waiting: None, problem: None, dropped: Vec::new() }
    }

    /// Takes news of the file. Returns whether the list was read just now.
    pub(crate) fn poll(&mut self, ctx: &egui::Context) -> bool {
        if let Some(Err(problem)) = self.writing.take() {
            self.problem = Some(problem);
        }
        let read = self.reading.take();
        let is_read = read.is_some();
        self.take_read(read);
        self.write_on(ctx);
        is_read
    }

    fn take_read(&mut self, read: Option<Result<Recent, String>>) {
        match read {
            Some(Ok(list)) => {
                let early = std::mem::replace(&mut self.list, list);
                // The waiting text holds only what was added before the list was read.
                if self.waiting.take().is_some() {
                    self.change(|list| list.note_all(early));
                }
            }
            // The list then holds only what is opened from now on.
            Some(Err(problem)) => self.problem = Some(problem),
            None => {}
        }
    }

    /// Writes what waits, at once, for a window that has closed.
    pub(crate) fn finish(&mut self) {
        let read = self.reading.finish();
        self.take_read(read);
        self.writing.finish();
        if let (Some(file), Some(text)) = (&self.file, self.waiting.take())
            && let Err(problem) = write_own(file, text.as_bytes())
        {
            tracing::warn!("the recent list is not kept: {problem}");
        }
    }

    /// The places that the list has dropped since the last call.
    pub(crate) fn take_dropped(&mut self) -> Vec<RecentPlace> {
        std::mem::take(&mut self.dropped)
    }

    pub(crate) fn entries(&self) -> &[RecentEntry] {
        &self.list.entries
    }

    pub(crate) fn folder(&self) -> Option<&Path> {
        self.list.folder.as_deref()
    }

    pub(crate) fn problem(&self) -> Option<&str> {
        self.problem.as_deref()
    }

    pub(crate) fn note(&mut self, entry: RecentEntry, folder: Option<PathBuf>, ctx: &egui::Context) {
        self.change(|list| {
            list.note(entry);
            list.folder = folder.or(list.folder.take());
        });
        self.write_on(ctx);
    }

    pub(crate) fn forget(&mut self, number: usize, ctx: &egui::Context) {
        self.change(|list| {
            if number < list.entries.len() {
                list.entries.remove(number);
            }
        });
        self.write_on(ctx);
    }

    fn change(&mut self, change: impl FnOnce(&mut Recent)) {
        let before = self.list.entries.clone();
        change(&mut self.list);
        let is_gone = |entry: &RecentEntry| self.list.entries.iter().all(|e| e.place != entry.place);
        self.dropped.extend(before.into_iter().filter(is_gone).map(|entry| entry.place));
        self.waiting = Some(self.list.to_toml());
    }

    fn write_on(&mut self, ctx: &egui::Context) {
        if self.writing.is_busy() || self.reading.is_busy() {
            return;
        }
        if let (Some(file), Some(text)) = (self.file.clone(), self.waiting.take()) {
            self.writing = Background::run(&waker_of(ctx), move || write_own(&file, text.as_bytes()));
        }
    }
}

pub(crate) fn ago(now: u64, then: u64) -> String {
    let seconds = now.saturating_sub(then);
    let plural = |n: u64, unit: &str| format!("{n} {unit}{} ago", if n == 1 { "" } else { "s" });
    match seconds {
        0..60 => "just now".into(),
        60..3600 => plural(seconds / 60, "minute"),
        3600..86_400 => plural(seconds / 3600, "hour"),
        86_400..5_184_000 => plural(seconds / 86_400, "day"),
        _ => plural(seconds / 2_592_000, "month"),
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use isinglass_formats::{RecentPlace, VolumeSource};

    use super::*;

    #[test]
    fn what_is_noted_and_forgotten_before_the_list_was_read_changes_nothing_in_it() {
        let entry = |source: &str| {
            let place = RecentPlace::Volume(VolumeSource::new(source));
            RecentEntry { place, shows: source.into(), used_at: 1 }
        };
        let folder = tempfile::TempDir::new().unwrap();
        let file = folder.path().join("recent.toml");
        let before = Recent { folder: Some("/data".into()), entries: vec![entry("/a"), entry("/b")] };
        let ctx = egui::Context::default();
        for (num_forgotten, expected) in
            [(0, vec![entry("/c"), entry("/a"), entry("/b")]), (1, before.entries.clone())]
        {
            std::fs::write(&file, before.to_toml()).unwrap();
            let mut list = RecentList::new(Some(file.clone()), &ctx);
            // What the disk has said is taken by `poll` alone.
            list.note(entry("/c"), None, &ctx);
            for _ in 0..num_forgotten {
                list.forget(0, &ctx);
            }
            assert!(list.reading.is_busy() && list.entries().len() == 1 - num_forgotten);
            let patience = Instant::now() + Duration::from_secs(60);
            while list.reading.is_busy() || list.writing.is_busy() {
                list.poll(&ctx);
                assert!(Instant::now() < patience, "it is never read or written");
                std::thread::sleep(Duration::from_millis(1));
            }
            let expected = Recent { entries: expected, ..before.clone() };
            assert_eq!(list.list, expected);
            assert_eq!(Recent::read(&file).unwrap(), expected);
            // A window that closes at once loses nothing either.
            std::fs::write(&file, before.to_toml()).unwrap();
            let mut list = RecentList::new(Some(file.clone()), &ctx);
            list.note(entry("/c"), None, &ctx);
            (0..num_forgotten).for_each(|_| list.forget(0, &ctx));
            list.finish();
            assert_eq!(Recent::read(&file).unwrap(), expected);
        }
    }

    #[test]
    fn times_are_told_in_one_word_and_a_unit() {
        let words =
            [0, 59, 60, 7199, 7200, 86_400, 400_000, 6_000_000].map(|s| ago(10_000_000, 10_000_000 - s));
        let expected = [
            "just now",
            "just now",
            "1 minute ago",
            "1 hour ago",
            "2 hours ago",
            "1 day ago",
            "4 days ago",
            "2 months ago",
        ];
        assert_eq!(words, expected);
        assert_eq!(ago(5, 9), "just now", "a clock that was set back");
    }
}
