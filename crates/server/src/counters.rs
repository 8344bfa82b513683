//! Counts of what a server has done since its start.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// Clones share the counts.
#[derive(Clone, Debug, Default)]
pub struct Counters(Arc<Counts>);

#[derive(Debug, Default)]
struct Counts {
    frames: AtomicU64,
    frame_bytes: AtomicU64,
    render_micros: AtomicU64,
    refusals: Arc<AtomicU64>,
}

impl Counters {
    /// `refusals` counts connections that came to nothing.
    pub(crate) fn new(refusals: Arc<AtomicU64>) -> Self {
        Self(Arc::new(Counts { refusals, ..Counts::default() }))
    }

    /// Frames that the network has taken.
    pub fn frames(&self) -> u64 {
        self.0.frames.load(Ordering::Relaxed)
    }

    /// Bytes of all coded frames.
    pub fn frame_bytes(&self) -> u64 {
        self.0.frame_bytes.load(Ordering::Relaxed)
    }

    /// Time in which the rendering threads have worked, of all together.
    pub fn rendering(&self) -> Duration {
        Duration::from_micros(self.0.render_micros.load(Ordering::Relaxed))
    }

    /// Connections that came to nothing before their viewer was let in.
    pub fn refusals(&self) -> u64 {
        self.0.refusals.load(Ordering::Relaxed)
    }

    pub(crate) fn note_frame(&self) {
        self.0.frames.fetch_add(1, Ordering::Relaxed);
    }

    pub(crate) fn note_bytes(&self, num: usize) {
        self.0.frame_bytes.fetch_add(num as u64, Ordering::Relaxed);
    }

    pub(crate) fn note_rendering(&self, micros: u64) {
        self.0.render_micros.fetch_add(micros, Ordering::Relaxed);
    }
}
