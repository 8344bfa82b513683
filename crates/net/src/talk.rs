//! A session behind one lock. Whoever changes it tells the network's tasks, which poll it then. It is held for moments and
//! never across a wait, so that a display loop may take it.

use std::ops::{Deref, DerefMut};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::watch;

use crate::clock::Clock;

/// See the module.
#[derive(Debug)]
pub(crate) struct Talk<S> {
    session: Mutex<S>,
    changed: watch::Sender<()>,
}

impl<S> Talk<S> {
    pub(crate) fn new(session: S) -> Self {
        Self { session: Mutex::new(session), changed: watch::Sender::new(()) }
    }

    /// The session. If it is changed, the network's tasks are told when this is dropped.
    pub(crate) fn lock(&self) -> Talking<'_, S> {
        let mut talking = Talking::alone(&self.session);
        talking.changed = Some(&self.changed);
        talking
    }

    /// The same for the network's tasks themselves, which need not be told.
    pub(crate) fn lock_quietly(&self) -> Talking<'_, S> {
        Talking::alone(&self.session)
    }

    /// Is told of changes.
    pub(crate) fn subscribe(&self) -> watch::Receiver<()> {
        self.changed.subscribe()
    }
}

/// A session, locked. Whoever holds one must not ask for another.
#[derive(Debug)]
pub struct Talking<'a, S> {
    /// Behind it are the tasks that poll the session.
    changed: Option<&'a watch::Sender<()>>,
    is_changed: bool,
    /// None while this is dropped.
    session: Option<MutexGuard<'a, S>>,
}

impl<'a, S> Talking<'a, S> {
    /// A session that no network polls.
    pub fn alone(session: &'a Mutex<S>) -> Self {
        // A panic on another thread leaves state that is still in order: every change is one step.
        let session = session.lock().unwrap_or_else(PoisonError::into_inner);
        Self { changed: None, is_changed: false, session: Some(session) }
    }

    /// For what leaves nothing to send: the network's tasks are not told.
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
        // First, so that whoever is told does not run into the lock.
        self.session = None;
        if let Some(changed) = self.changed.filter(|_| self.is_changed) {
            changed.send_replace(());
        }
    }
}

const HELD: &str = "held until it is dropped";

/// Returns when a session is to be polled again: it was changed, or its time has come.
pub(crate) async fn until_due(changed: &mut watch::Receiver<()>, clock: &Clock, due: Option<u64>) {
    let wait = Duration::from_micros(due.map_or(0, |due| due.saturating_sub(clock.now_micros())));
    tokio::select! {
        // The session outlives the tasks that poll it.
        _ = changed.changed() => {}
        () = tokio::time::sleep(wait), if due.is_some() => {}
    }
}
