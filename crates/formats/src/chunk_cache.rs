//! Decoded chunks that several threads share, of a bounded number of bytes.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Values by the level and the first number of their chunk. Threads that ask for the same one wait for the first.
pub(crate) struct ChunkCache<V> {
    most_bytes: u64,
    state: Mutex<CacheState<V>>,
}

/// A level, and the first number along each axis.
pub(crate) type ChunkKey = (usize, Vec<u64>);

type Slot<V> = Arc<Mutex<Option<V>>>;

struct CacheState<V> {
    entries: HashMap<ChunkKey, CacheEntry<V>>,
    num_bytes: u64,
    /// Counts uses.
    clock: u64,
}

struct CacheEntry<V> {
    slot: Slot<V>,
    num_bytes: u64,
    used: u64,
}

impl<V: Clone> ChunkCache<V> {
    /// An empty cache of at most so many bytes, beside those in use.
    pub(crate) fn new(most_bytes: u64) -> Self {
        let state = CacheState { entries: HashMap::new(), num_bytes: 0, clock: 0 };
        Self { most_bytes, state: Mutex::new(state) }
    }

    /// The value of `key`, of `num_bytes` bytes, which `read` reads if it is not here. An error is not kept.
    pub(crate) fn get<E>(
        &self,
        key: ChunkKey,
        num_bytes: u64,
        read: impl FnOnce() -> Result<V, E>,
    ) -> Result<V, E> {
        let slot = self.slot(key, num_bytes);
        let mut value = locked(&slot);
        if let Some(value) = &*value {
            return Ok(value.clone());
        }
        let found = read()?;
        *value = Some(found.clone());
        Ok(found)
    }

    /// The place of a value, for which room is made.
    fn slot(&self, key: ChunkKey, num_bytes: u64) -> Slot<V> {
        let mut state = locked(&self.state);
        state.clock += 1;
        let clock = state.clock;
        if let Some(entry) = state.entries.get_mut(&key) {
            entry.used = clock;
            return Arc::clone(&entry.slot);
        }
        if state.num_bytes.saturating_add(num_bytes) > self.most_bytes {
            state.make_room(num_bytes, self.most_bytes);
        }
        let slot: Slot<V> = Arc::default();
        state.num_bytes = state.num_bytes.saturating_add(num_bytes);
        state.entries.insert(key, CacheEntry { slot: Arc::clone(&slot), num_bytes, used: clock });
        slot
    }
}

impl<V> CacheState<V> {
    /// Gives up the values that were not used for the longest time. An eighth is freed at once.
    fn make_room(&mut self, num_bytes: u64, most_bytes: u64) {
        let wanted = most_bytes - most_bytes / 8;
        let mut order: Vec<(u64, ChunkKey)> =
            self.entries.iter().map(|(key, entry)| (entry.used, key.clone())).collect();
        order.sort_unstable();
        for (_, key) in order {
            if self.num_bytes.saturating_add(num_bytes) <= wanted {
                return;
            }
            if let Some(entry) = self.entries.remove(&key) {
                self.num_bytes -= entry.num_bytes;
            }
        }
    }
}

/// The lock, also after a panic of another thread: what it guards is changed in one step.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};

    use super::*;

    #[test]
    fn a_chunk_is_read_once_and_the_least_used_make_room() {
        let cache = ChunkCache::new(80);
        let num_read = AtomicU64::new(0);
        let get = |i: u64| {
            let read = || {
                num_read.fetch_add(1, Ordering::Relaxed);
                if i == 99 { Err("damaged") } else { Ok(i) }
            };
            cache.get((0, vec![i]), 10, read)
        };
        std::thread::scope(|scope| {
            (0..4).for_each(|_| drop(scope.spawn(|| (0..7).for_each(|i| assert_eq!(get(i), Ok(i))))));
        });
        assert_eq!(num_read.swap(0, Ordering::Relaxed), 7);
        // An error is asked for again.
        assert_eq!((get(99), get(99)), (Err("damaged"), Err("damaged")));
        assert_eq!(num_read.swap(0, Ordering::Relaxed), 2);
        // The control: more values than there is room for are read again.
        (0..20).for_each(|i| assert_eq!(get(i), Ok(i)));
        num_read.store(0, Ordering::Relaxed);
        (0..20).for_each(|i| assert_eq!(get(i), Ok(i)));
        assert_eq!(num_read.load(Ordering::Relaxed), 20);
        assert!(locked(&cache.state).num_bytes <= 80);
    }
}
