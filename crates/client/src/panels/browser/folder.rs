//! The content of a folder. A thread lists names at once, and then what the files hold.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};

use isinglass_core::text::is_control;
use isinglass_formats::{Content, content_of};

use crate::view::Waker;

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Entry {
    pub(crate) name: String,
    pub(crate) path: PathBuf,
    pub(crate) is_folder: bool,
    pub(crate) bytes: u64,
    /// None until the file was read.
    pub(crate) content: Option<Content>,
}

impl Entry {
    /// Whether it is a state, which opens with its volume.
    pub(crate) fn is_state(&self) -> bool {
        self.content == Some(Content::State)
    }

    /// The kind of file, in a word or two.
    pub(crate) fn kind(&self) -> &'static str {
        match self.content {
            Some(Content::Volume(name)) => name,
            Some(Content::Other(what)) => what,
            Some(Content::State) => "saved state",
            Some(Content::Text) => "text",
            Some(Content::Folder) => "folder",
            None if self.is_folder => "folder",
            None => "",
        }
    }
}

/// A folder and its entries, as far as they are known.
pub(crate) struct Folder {
    pub(crate) path: PathBuf,
    pub(crate) entries: Vec<Entry>,
    pub(crate) problem: Option<String>,
    pub(crate) is_listing: bool,
    news: Option<Receiver<News>>,
    is_left: Arc<AtomicBool>,
}

enum News {
    Names(Vec<Entry>),
    Contents(Vec<(usize, Content)>),
    Problem(String),
}

impl Folder {
    pub(crate) fn open(path: PathBuf, wake: &Waker) -> Self {
        let (sender, news) = sync_channel(4);
        let is_left = Arc::new(AtomicBool::new(false));
        let (of_thread, left, wake) = (path.clone(), is_left.clone(), wake.clone());
        let run = move || list(&of_thread, &sender, &left, &wake);
        // Without a thread the sender is gone, and the list stays empty.
        let _ = std::thread::Builder::new().name("folder".into()).spawn(run);
        Self { path, entries: Vec::new(), problem: None, is_listing: true, news: Some(news), is_left }
    }

    pub(crate) fn poll(&mut self) {
        while let Some(news) = &self.news {
            match news.try_recv() {
                Ok(News::Names(entries)) => (self.entries, self.is_listing) = (entries, false),
                Ok(News::Contents(found)) => {
                    for (i, content) in found {
                        self.entries[i].content = Some(content);
                    }
                }
                Ok(News::Problem(problem)) => (self.problem, self.is_listing) = (Some(problem), false),
                Err(TryRecvError::Empty) => return,
                Err(TryRecvError::Disconnected) => (self.news, self.is_listing) = (None, false),
            }
        }
    }

    /// Whether the folder itself may be a volume, as it holds slices.
    pub(crate) fn may_be_volume(&self) -> Option<&'static str> {
        let has = |name| self.entries.iter().any(|e| e.content == Some(Content::Volume(name)));
        ["DICOM", "TIFF"].into_iter().find(|name| has(name))
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        self.is_left.store(true, Ordering::Relaxed);
    }
}

fn list(path: &Path, news: &SyncSender<News>, is_left: &AtomicBool, wake: &Waker) {
    let send = |found: News| news.send(found).map(|()| wake()).is_ok();
    let mut entries = match read(path, is_left) {
        Ok(entries) => entries,
        Err(e) => {
            send(News::Problem(format!("{}: {e}", path.display())));
            return;
        }
    };
    // Folders first, then by name without case.
    entries.sort_by_cached_key(|e| (!e.is_folder, e.name.to_lowercase(), e.name.clone()));
    if !send(News::Names(entries.clone())) {
        return;
    }
    let mut found = Vec::new();
    for (i, entry) in entries.iter().enumerate() {
        if is_left.load(Ordering::Relaxed) {
            return;
        }
        let content = content_of(&entry.path).unwrap_or(Content::Other("cannot be read"));
        found.push((i, content));
        if found.len() == BATCH && !send(News::Contents(std::mem::take(&mut found))) {
            return;
        }
    }
    send(News::Contents(found));
}

/// Names, except those that begin with a dot.
fn read(path: &Path, is_left: &AtomicBool) -> std::io::Result<Vec<Entry>> {
    let mut entries = Vec::new();
    for entry in std::fs::read_dir(path)? {
        let entry = entry?;
        let name = entry.file_name().to_string_lossy().into_owned();
        if name.starts_with('.') {
            continue;
        }
        if entries.len() == MAX_ENTRIES || is_left.load(Ordering::Relaxed) {
            break;
        }
        // A link counts as its target; a broken link is a file that cannot be read.
        let metadata = std::fs::metadata(entry.path()).ok();
        entries.push(Entry {
            name: name.chars().map(|c| if is_control(c) { '?' } else { c }).collect(),
            path: entry.path(),
            is_folder: metadata.as_ref().is_some_and(std::fs::Metadata::is_dir),
            bytes: metadata.map_or(0, |m| m.len()),
            content: None,
        });
    }
    Ok(entries)
}

/// Files between two messages to the window.
const BATCH: usize = 32;
/// Entries of a list, at most.
const MAX_ENTRIES: usize = 20_000;
