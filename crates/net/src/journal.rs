//! The ledger of a server's session beside the clock that its stamps are read from.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use isinglass_core::ids::{FrameId, PoseId};
use isinglass_core::session::ledger::{Ledger, Life, Stage};

use crate::clock::Clock;

/// The lives of the frames of one session. Clones are the same.
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

    /// A frame has so many bytes.
    pub fn add_bytes(&self, frame: FrameId, bytes: u64) {
        self.ledger().add_bytes(frame, bytes);
    }

    /// A frame is not worked on any more.
    pub fn give_up(&self, frame: FrameId) {
        self.ledger().give_up(frame);
    }

    /// The last lives, oldest first.
    pub fn lives(&self) -> Vec<Life> {
        self.ledger().iter().copied().collect()
    }

    fn ledger(&self) -> MutexGuard<'_, Ledger> {
        // Its methods change single lives.
        self.ledger.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
