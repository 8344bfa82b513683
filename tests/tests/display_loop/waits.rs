//! Whether a refresh of the window had to wait: for a lock, a disk, a socket or another thread.
//!
//! No clock can tell that, as a thread loses its core to others too. The system counts it: each time a thread gives up its
//! core by itself, because there is nothing that it could do, is a voluntary context switch. Some of them are no wait of the
//! viewer's own: the C library's allocator has locks that all threads of the process meet at, the driver's among them. The
//! test's allocator says so with [`excuse`].

use std::cell::Cell;

use crate::allocator::voluntary_switches;

/// Refreshes that were watched.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Waits {
    /// Refreshes so far.
    pub(crate) refreshes: u64,
    /// Those of them that waited for anything that was not excused.
    pub(crate) waited: u64,
    /// Those that had nothing but waits that were excused.
    pub(crate) excused: u64,
}

/// A refresh of this thread has begun; called again before it has ended, nothing.
pub(crate) fn begin_refresh() {
    if BEGUN.get().is_none() {
        BEGUN.set(Some((voluntary_switches(), EXCUSED.get())));
    }
}

impl Waits {
    /// The refresh of this thread has ended.
    pub(crate) fn end_refresh(&mut self) {
        let Some((switches, excused)) = BEGUN.take() else { return };
        let (switches, excused) = (voluntary_switches() - switches, EXCUSED.get() - excused);
        self.refreshes += 1;
        self.waited += u64::from(switches > excused);
        self.excused += u64::from(switches > 0 && switches <= excused);
    }
}

/// So many voluntary context switches of this thread were no wait of the viewer's.
pub(crate) fn excuse(switches: u64) {
    EXCUSED.set(EXCUSED.get() + switches);
}

thread_local! {
    static BEGUN: Cell<Option<(u64, u64)>> = const { Cell::new(None) };
    static EXCUSED: Cell<u64> = const { Cell::new(0) };
}
