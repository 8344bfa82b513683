//! The long pieces of work on a frame, and what follows each of them.

use std::sync::Arc;
use std::time::{Duration, Instant};

/// A long piece of work.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Work {
    /// Generating a layered frame.
    Generate,
    /// Making bytes of it.
    Encode,
    /// Making a frame of bytes.
    Decode,
}

/// Is called after each piece of work with the time that it took, in the thread that did it; the result goes on when it returns.
/// Does nothing by default. A test lets work take as long as it does on another machine.
#[derive(Clone)]
pub struct AfterWork(Arc<dyn Fn(Work, Duration) + Send + Sync>);

impl AfterWork {
    /// Calls `after`.
    pub fn new(after: impl Fn(Work, Duration) + Send + Sync + 'static) -> Self {
        Self(Arc::new(after))
    }

    /// Does a piece of work, and what follows it.
    pub fn run<T>(&self, work: Work, body: impl FnOnce() -> T) -> T {
        let started = Instant::now();
        let made = body();
        (self.0)(work, started.elapsed());
        made
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
