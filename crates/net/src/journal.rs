//! The ledger of a server's session, with the clock of its stamps.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use isinglass_core::ids::{FrameId, PoseId};
use isinglass_core::session::ledger::{Ledger, Life, Stage};

use crate::clock::Clock;

/// The lives of one session's frames. Clones share them.
#[derive(Clone, Debug)]
pub struct Journal {
    clock: Clock,
    ledger: Arc<Mutex<Ledger>>,
}

impl Journal {
    pub(crate) fn new(clock: Clock) -> Self {
        let mut ledger = Ledger::default();
        ledger.handle_connected();
        Self { clock, ledger: Arc::new(Mutex::new(ledger)) }
    }

    /// The clock of the stamps.
    pub fn clock(&self) -> &Clock {
        &self.clock
    }

    /// A frame's life begins.
    pub fn open(&self, frame: FrameId, pose: PoseId) {
        self.ledger().open(Life::new(frame, pose));
    }

    /// A frame has reached a stage now.
    pub fn stamp(&self, frame: FrameId, stage: Stage) {
        let now = self.clock.now_micros();
        self.ledger().stamp(now, frame, stage);
    }

    /// Adds to the bytes of a frame.
    pub fn add_bytes(&self, frame: FrameId, bytes: u64) {
        self.ledger().add_bytes(frame, bytes);
    }

    /// Work on a frame has stopped.
    pub fn give_up(&self, frame: FrameId) {
        self.ledger().give_up(frame);
    }

    /// The recent lives, oldest first.
    pub fn lives(&self) -> Vec<Life> {
        self.ledger().iter().copied().collect()
    }

    fn ledger(&self) -> MutexGuard<'_, Ledger> {
        // Every change is to a single life, so a panic leaves the ledger in order.
        self.ledger.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
