//! Whether a refresh had to wait: for a lock, a disk, a socket or another thread.
//!
//! No clock can tell that, as a thread loses its core to others too. The system counts it: each time a thread gives up its
//! core by itself, because there is nothing that it could do, is a voluntary context switch. Some of them are no wait of the
//! viewer's own: the C library's allocator has locks that all threads of the process meet at, the driver's among them. Whoever
//! has an allocator that counts those says so with [`excuse_wait`].

use std::cell::Cell;
use std::fs::File;
use std::io::Read;

use crate::view::bell::Bell;

/// Refreshes that were watched.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Waits {
    /// Refreshes so far.
    pub refreshes: u64,
    /// Those of them that waited for anything that was not excused.
    pub waited: u64,
    /// Those that had nothing but waits that were excused.
    pub excused: u64,
}

impl Waits {
    /// Does what a refresh of the window does, and counts it if it `is_watched` and the system tells. What is counted then.
    #[must_use]
    pub(crate) fn watch(self, ctx: &egui::Context, is_watched: bool, refresh: impl FnOnce()) -> Self {
        let bell = Bell::of(ctx);
        if !is_watched {
            bell.during(refresh);
            return self;
        }
        let after = self.count(|| bell.during(refresh));
        if after.waited > self.waited {
            tracing::trace!(refreshes = after.refreshes, waited = after.waited, "a refresh waited");
        }
        after
    }

    fn count(mut self, refresh: impl FnOnce()) -> Self {
        let before = (voluntary_switches(), EXCUSED.get());
        refresh();
        if let (Some(before_switches), Some(after)) = (before.0, voluntary_switches()) {
            let switches = after - before_switches;
            let excused = EXCUSED.get() - before.1;
            self.refreshes += 1;
            self.waited += u64::from(switches > excused);
            self.excused += u64::from(switches > 0 && switches <= excused);
        }
        self
    }
}

/// Says that so many voluntary context switches of this thread were no wait of the viewer's.
pub fn excuse_wait(switches: u64) {
    EXCUSED.set(EXCUSED.get() + switches);
}

thread_local! {
    static EXCUSED: Cell<u64> = const { Cell::new(0) };
}

/// Voluntary context switches of this thread; Linux alone tells. Allocates nothing, as that may be a wait.
fn voluntary_switches() -> Option<u64> {
    let mut text = [0; 4096];
    let mut file = File::open("/proc/thread-self/status").ok()?;
    let mut len = 0;
    while len < text.len() {
        match file.read(&mut text[len..]).ok()? {
            0 => break,
            more => len += more,
        }
    }
    let text = std::str::from_utf8(&text[..len]).ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("voluntary_ctxt_switches:"))?;
    line.trim().parse().ok()
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::sync::Mutex;
    use std::time::Duration;

    use super::*;

    #[test]
    fn waiting_is_told_from_working_and_from_what_is_excused() {
        let waits = Waits::default();
        let waits = waits.count(|| {
            let sum = (0..1_000_000u64).fold(0, |a, b| std::hint::black_box(a ^ b));
            assert_eq!(sum, 0);
        });
        assert_eq!(waits, Waits { refreshes: 1, ..Waits::default() });
        let sleep = || std::thread::sleep(Duration::from_millis(1));
        let waits = waits.count(sleep);
        assert_eq!(waits, Waits { refreshes: 2, waited: 1, excused: 0 });
        // A lock that another thread holds.
        let lock = Mutex::new(());
        let (locked, is_locked) = std::sync::mpsc::sync_channel(1);
        let waits = std::thread::scope(|scope| {
            scope.spawn(|| {
                let _held = lock.lock().unwrap();
                locked.send(()).unwrap();
                std::thread::sleep(Duration::from_millis(30));
            });
            is_locked.recv().unwrap();
            waits.count(|| drop(lock.lock().unwrap()))
        });
        assert_eq!(waits, Waits { refreshes: 3, waited: 2, excused: 0 });
        let excused = |more: bool| {
            let before = voluntary_switches().unwrap();
            sleep();
            excuse_wait(voluntary_switches().unwrap() - before);
            if more {
                sleep();
            }
        };
        let waits = waits.count(|| excused(false));
        assert_eq!(waits, Waits { refreshes: 4, waited: 2, excused: 1 });
        let waits = waits.count(|| excused(true));
        assert_eq!(waits, Waits { refreshes: 5, waited: 3, excused: 1 });
    }
}
