//! What the caller may read at any moment. Reading never waits: a writer builds the next value aside and swaps it in.

use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use arc_swap::{ArcSwap, ArcSwapOption};
use isinglass_core::ids::LookVersion;
use isinglass_core::look::Look;
use isinglass_core::wire::{LoadStatus, Parts, Probed, Welcome};

use super::shot::ReceivedShot;
use super::{ConnectError, LinkStats, State};

/// How the connection stands, and what the server has said.
#[derive(Clone)]
pub(super) struct Status {
    pub(super) state: State,
    /// Number of the newest connection, from 1.
    pub(super) connection: u32,
    pub(super) welcome: Option<Arc<Welcome>>,
    pub(super) look: Option<(LookVersion, Arc<Look>)>,
    /// What the server's file holds.
    pub(super) parts: Option<Arc<Parts>>,
    /// How the reading of another part stands.
    pub(super) load: Option<LoadStatus>,
    pub(super) is_draft: bool,
    pub(super) probed: Option<Probed>,
    pub(super) last_problem: Option<String>,
    pub(super) stats: LinkStats,
}

/// The [`Status`] for many readers, and writers that take turns.
pub(super) struct StatusBoard {
    shown: ArcSwap<Status>,
    notice: ArcSwapOption<String>,
    shot: ArcSwapOption<ReceivedShot>,
    /// Whoever changes the status, or waits for a change.
    turn: Mutex<()>,
    changed: Condvar,
}

impl StatusBoard {
    pub(super) fn new() -> Self {
        let status = Status {
            state: State::Connecting { attempt: 1, problem: None },
            connection: 0,
            welcome: None,
            look: None,
            parts: None,
            load: None,
            is_draft: false,
            probed: None,
            last_problem: None,
            stats: LinkStats::default(),
        };
        Self {
            shown: ArcSwap::from_pointee(status),
            notice: ArcSwapOption::empty(),
            shot: ArcSwapOption::empty(),
            turn: Mutex::default(),
            changed: Condvar::new(),
        }
    }

    /// The status now.
    pub(super) fn read(&self) -> Arc<Status> {
        self.shown.load_full()
    }

    /// Changes the status.
    pub(super) fn update(&self, change: impl FnOnce(&mut Status)) {
        let _turn = self.turn.lock().unwrap_or_else(PoisonError::into_inner);
        let mut status = Status::clone(&self.shown.load());
        change(&mut status);
        self.shown.store(Arc::new(status));
        self.changed.notify_all();
    }

    /// Puts up a line for the person at the viewer, in place of the one before.
    pub(super) fn put_notice(&self, text: String) {
        self.notice.store(Some(Arc::new(text)));
    }

    /// The last such line; taken when it is asked for.
    pub(super) fn take_notice(&self) -> Option<String> {
        self.notice.swap(None).map(Arc::unwrap_or_clone)
    }

    /// Puts up what has become of a picture to keep.
    pub(super) fn put_shot(&self, shot: ReceivedShot) {
        self.shot.store(Some(Arc::new(shot)));
    }

    /// The same; taken when it is asked for.
    pub(super) fn take_shot(&self) -> Option<Arc<ReceivedShot>> {
        self.shot.swap(None)
    }

    /// Waits until the server has let this client in.
    pub(super) fn wait_connected(&self, timeout: Duration) -> Result<Arc<Welcome>, ConnectError> {
        let deadline = Instant::now() + timeout;
        let mut turn = self.turn.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            let status = self.read();
            match &status.state {
                // Others are at the door at this moment; it is knocked at again.
                State::Connecting { problem: Some(ConnectError::Busy), .. } if Instant::now() < deadline => {}
                State::Connecting { problem: Some(problem), .. } | State::Refused(problem) => {
                    return Err(problem.clone());
                }
                State::Connected => {
                    if let Some(welcome) = &status.welcome {
                        return Ok(welcome.clone());
                    }
                }
                State::Connecting { .. } | State::Reconnecting { .. } => {}
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(ConnectError::Undecided(timeout));
            }
            turn = self.changed.wait_timeout(turn, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}
