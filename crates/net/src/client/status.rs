//! The status of the connection, and those who wait for it.

use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use isinglass_core::wire::Welcome;

use super::{ConnectError, LinkStats, State, lock};

/// The status of the connection.
#[derive(Clone, Debug)]
pub(super) struct Status {
    pub(super) state: State,
    pub(super) welcome: Option<Arc<Welcome>>,
    pub(super) last_problem: Option<String>,
    pub(super) stats: LinkStats,
}

/// The [`Status`], with notification of changes.
pub(super) struct StatusBoard {
    status: Mutex<Status>,
    changed: Condvar,
}

impl StatusBoard {
    pub(super) fn new() -> Self {
        let state = State::Connecting { attempt: 1, problem: None };
        let status = Status { state, welcome: None, last_problem: None, stats: LinkStats::default() };
        Self { status: Mutex::new(status), changed: Condvar::new() }
    }

    /// The current status.
    pub(super) fn read(&self) -> MutexGuard<'_, Status> {
        lock(&self.status)
    }

    /// Changes the status.
    pub(super) fn update(&self, change: impl FnOnce(&mut Status)) {
        change(&mut lock(&self.status));
        self.changed.notify_all();
    }

    /// Waits until the server admits this client.
    pub(super) fn wait_connected(&self, timeout: Duration) -> Result<Arc<Welcome>, ConnectError> {
        let deadline = Instant::now() + timeout;
        let mut status = self.read();
        loop {
            match (&status.state, &status.welcome) {
                // The server has too many pending connections at the moment; the client retries.
                (State::Connecting { problem: Some(ConnectError::Busy), .. }, _)
                    if Instant::now() < deadline => {}
                (State::Connecting { problem: Some(problem), .. } | State::Refused(problem), _) => {
                    return Err(problem.clone());
                }
                (State::Connected, Some(welcome)) => return Ok(welcome.clone()),
                _ => {}
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(ConnectError::Undecided(timeout));
            }
            let waited = self.changed.wait_timeout(status, left);
            status = waited.unwrap_or_else(std::sync::PoisonError::into_inner).0;
        }
    }
}
