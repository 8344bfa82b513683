//! Whether a refresh had to wait: for a lock, a disk, a socket or another thread.
//!
//! No clock can tell that, as a thread loses its core to others too. The system counts it: each time a thread gives up its
//! core by itself, because there is nothing that it could do, is a voluntary context switch.

/// Refreshes that were watched.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Waits {
    /// Refreshes so far.
    pub refreshes: u64,
    /// Those of them that waited for anything.
    pub waited: u64,
}

impl Waits {
    /// Does what a refresh does, and counts it, unless the system does not tell.
    pub(crate) fn watch<T>(&mut self, refresh: impl FnOnce() -> T) -> T {
        let before = voluntary_switches();
        let result = refresh();
        if let (Some(before), Some(after)) = (before, voluntary_switches()) {
            self.refreshes += 1;
            self.waited += u64::from(after != before);
        }
        result
    }
}

/// Voluntary context switches of this thread; Linux alone tells.
fn voluntary_switches() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/thread-self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("voluntary_ctxt_switches:"))?;
    line.trim().parse().ok()
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::sync::Mutex;
    use std::time::Duration;

    use super::*;

    #[test]
    fn waiting_is_told_from_working() {
        let mut waits = Waits::default();
        let sum = waits.watch(|| (0..1_000_000u64).fold(0, |a, b| std::hint::black_box(a ^ b)));
        assert_eq!((sum, waits), (0, Waits { refreshes: 1, waited: 0 }));
        waits.watch(|| std::thread::sleep(Duration::from_millis(1)));
        assert_eq!(waits, Waits { refreshes: 2, waited: 1 });
        // A lock that another thread holds.
        let lock = Mutex::new(());
        let (locked, is_locked) = std::sync::mpsc::sync_channel(1);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                let _held = lock.lock().unwrap();
                locked.send(()).unwrap();
                std::thread::sleep(Duration::from_millis(30));
            });
            is_locked.recv().unwrap();
            waits.watch(|| drop(lock.lock().unwrap()));
        });
        assert_eq!(waits, Waits { refreshes: 3, waited: 2 });
    }
}
