//! A session behind one lock. A change wakes the network's tasks, which then poll it. The lock is held for moments
//! and never across a wait, so a display loop may take it.

use std::ops::{Deref, DerefMut};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::watch;

use crate::clock::Clock;

/// A session behind its lock.
#[derive(Debug)]
pub(crate) struct Talk<S> {
    session: Mutex<S>,
    changed: watch::Sender<()>,
}

impl<S> Talk<S> {
    pub(crate) fn new(session: S) -> Self {
        Self { session: Mutex::new(session), changed: watch::Sender::new(()) }
    }

    /// Locks the session. When this is dropped after a change, the network's tasks wake.
    pub(crate) fn lock(&self) -> Talking<'_, S> {
        let mut talking = Talking::alone(&self.session);
        talking.changed = Some(&self.changed);
        talking
    }

    /// The same for the network's tasks, without waking them.
    pub(crate) fn lock_quietly(&self) -> Talking<'_, S> {
        Talking::alone(&self.session)
    }

    /// A receiver that is notified of changes.
    pub(crate) fn subscribe(&self) -> watch::Receiver<()> {
        self.changed.subscribe()
    }
}

/// A locked session. Its holder must not lock it again.
#[derive(Debug)]
pub struct Talking<'a, S> {
    /// Wakes the tasks that poll the session.
    changed: Option<&'a watch::Sender<()>>,
    is_changed: bool,
    /// `None` only during drop.
    session: Option<MutexGuard<'a, S>>,
}

impl<'a, S> Talking<'a, S> {
    /// A session without a network.
    pub fn alone(session: &'a Mutex<S>) -> Self {
        // Every change is one step, so a panic on another thread leaves the state in order.
        let session = session.lock().unwrap_or_else(PoisonError::into_inner);
        Self { changed: None, is_changed: false, session: Some(session) }
    }

    /// Changes that leave nothing to send: the network's tasks do not wake.
    pub fn quietly(&mut self) -> &mut S {
        self.session.as_mut().expect(HELD)
    }
}

impl<S> Deref for Talking<'_, S> {
    type Target = S;

    fn deref(&self) -> &S {
        self.session.as_ref().expect(HELD)
    }
}

impl<S> DerefMut for Talking<'_, S> {
    fn deref_mut(&mut self) -> &mut S {
        self.is_changed = true;
        self.session.as_mut().expect(HELD)
    }
}

impl<S> Drop for Talking<'_, S> {
    fn drop(&mut self) {
        // Unlocks first, so that the woken tasks do not block.
        self.session = None;
        if let Some(changed) = self.changed.filter(|_| self.is_changed) {
            changed.send_replace(());
        }
    }
}

const HELD: &str = "held until it is dropped";

/// Returns when a session must be polled again: after a change, or at its time.
pub(crate) async fn until_due(changed: &mut watch::Receiver<()>, clock: &Clock, due: Option<u64>) {
    let wait = Duration::from_micros(due.map_or(0, |due| due.saturating_sub(clock.now_micros())));
    tokio::select! {
        // The session outlives the tasks that poll it.
        _ = changed.changed() => {}
        () = tokio::time::sleep(wait), if due.is_some() => {}
    }
}
