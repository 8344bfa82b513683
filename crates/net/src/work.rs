//! Long work on a frame, and a hook after each piece of it.

use std::sync::Arc;
use std::time::{Duration, Instant};

/// A kind of long work.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Work {
    /// Generates a layered frame.
    Generate,
    /// Encodes it to bytes.
    Encode,
    /// Decodes it from bytes.
    Decode,
}

/// A hook after each piece of work, in the same thread, with the time that it took. The result passes on when the
/// hook returns. By default it does nothing. A test uses it to simulate a slower machine.
#[derive(Clone)]
pub struct AfterWork(Arc<dyn Fn(Work, Duration) + Send + Sync>);

impl AfterWork {
    /// Calls `after`.
    pub fn new(after: impl Fn(Work, Duration) + Send + Sync + 'static) -> Self {
        Self(Arc::new(after))
    }

    /// Runs a piece of work, and the hook.
    pub fn run<T>(&self, work: Work, body: impl FnOnce() -> T) -> T {
        let started = Instant::now();
        let made = body();
        self.note(work, started.elapsed());
        made
    }

    /// Calls the hook for work that was done in pieces and took this time in all.
    pub fn note(&self, work: Work, took: Duration) {
        (self.0)(work, took);
    }
}

impl Default for AfterWork {
    fn default() -> Self {
        Self::new(|_, _| {})
    }
}

impl std::fmt::Debug for AfterWork {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("AfterWork")
    }
}
