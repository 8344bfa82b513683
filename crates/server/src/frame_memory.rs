//! The memory of all viewers' frames: those in the making, those on their way, those that rest, and references.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use isinglass_core::codec::MAX_FRAME_SEGMENTS;

/// A limit for all frames of a server. Clones share it.
#[derive(Clone, Debug)]
pub(crate) struct FrameMemory {
    limit: u64,
    used: Arc<AtomicU64>,
}

/// A part of the memory, free again when this is dropped.
#[derive(Debug)]
pub(crate) struct Held {
    memory: FrameMemory,
    bytes: u64,
}

impl FrameMemory {
    pub(crate) fn new(limit: u64) -> Self {
        Self { limit, used: Arc::default() }
    }

    /// All bytes, free or not.
    pub(crate) fn limit(&self) -> u64 {
        self.limit
    }

    /// Bytes that are free.
    pub(crate) fn room(&self) -> u64 {
        self.limit.saturating_sub(self.used.load(Ordering::Relaxed))
    }

    /// Holds `wanted` bytes, or half of what is free if that is less: others begin frames too. Nobody gets less than
    /// `least`, so that everyone sees something.
    pub(crate) fn hold(&self, wanted: u64, least: u64) -> Held {
        let granted = |used: u64| wanted.min(self.limit.saturating_sub(used) / 2).max(least);
        let take = |used: u64| Some(used + granted(used));
        let before = self.used.fetch_update(Ordering::Relaxed, Ordering::Relaxed, take);
        let (Ok(before) | Err(before)) = before;
        Held { memory: self.clone(), bytes: granted(before) }
    }

    /// Holds nothing yet.
    pub(crate) fn nothing(&self) -> Held {
        Held { memory: self.clone(), bytes: 0 }
    }
}

/// Bytes of a frame that is there.
pub(crate) fn bytes_of(num_segments: usize, num_lists: usize) -> u64 {
    (num_segments * SEGMENT_BYTES + (num_lists + 1) * OFFSET_BYTES) as u64
}

/// Bytes that a frame takes while it is made: its rows, and then the frame.
pub(crate) fn bytes_of_making(num_segments: usize, num_lists: usize) -> u64 {
    2 * bytes_of(num_segments, num_lists)
}

/// Most segments of a frame of so many lists that is made in these bytes.
pub(crate) fn max_segments(bytes: u64, num_lists: usize) -> usize {
    let left = usize::try_from(bytes).unwrap_or(usize::MAX) / 2;
    (left.saturating_sub((num_lists + 1) * OFFSET_BYTES) / SEGMENT_BYTES).clamp(1, MAX_FRAME_SEGMENTS)
}

/// Bytes of a frame that every viewer may make, however little is free: 128×128 lists of 32 segments and more.
pub(crate) const LEAST_BYTES: u64 = 16 << 20;
const SEGMENT_BYTES: usize = 12;
const OFFSET_BYTES: usize = 4;

impl Held {
    pub(crate) fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Holds `wanted` bytes, if that is at most half of what is free without this part. Returns whether it does.
    pub(crate) fn grow(&mut self, wanted: u64) -> bool {
        let more = wanted.saturating_sub(self.bytes);
        let most = (self.memory.limit + self.bytes) / 2;
        let take = |used: u64| (wanted <= most.saturating_sub(used / 2)).then_some(used + more);
        let is_held = self.memory.used.fetch_update(Ordering::Relaxed, Ordering::Relaxed, take).is_ok();
        self.bytes += if is_held { more } else { 0 };
        is_held
    }

    /// Hands all of it on.
    pub(crate) fn take(&mut self) -> Self {
        let nothing = self.memory.nothing();
        std::mem::replace(self, nothing)
    }

    /// Holds as much as something takes that is there already.
    pub(crate) fn set(&mut self, bytes: u64) {
        self.memory.used.fetch_add(bytes, Ordering::Relaxed);
        self.memory.used.fetch_sub(std::mem::replace(&mut self.bytes, bytes), Ordering::Relaxed);
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        self.set(0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_held_is_bounded_and_comes_back() {
        let memory = FrameMemory::new(1000);
        let mut first = memory.hold(300, 10);
        assert_eq!((first.bytes(), memory.room()), (300, 700));
        let second = memory.hold(u64::MAX, 10);
        assert_eq!((second.bytes(), memory.room()), (350, 350), "half of what was left");
        first.set(100);
        assert_eq!(memory.room(), 550);
        drop(second);
        assert_eq!(memory.room(), 900);
        assert!(!first.grow(501), "others begin frames too");
        assert_eq!((first.bytes(), memory.room()), (100, 900));
        assert!(first.grow(500) && first.grow(200));
        assert_eq!((first.bytes(), memory.room()), (500, 500));
        first.set(100);
        // What is there already counts even beyond the limit, and later frames are small but not nothing.
        first.set(5000);
        assert_eq!((memory.room(), memory.hold(300, 10).bytes()), (0, 10));
        drop(first);
        assert_eq!(memory.room(), 1000);
    }

    #[test]
    fn a_frame_is_made_within_what_is_held() {
        for (num_segments, num_lists) in [(1, 1), (1000, 100), (20_000_000, 2_000_000)] {
            let bytes = bytes_of_making(num_segments, num_lists);
            assert_eq!(max_segments(bytes, num_lists), num_segments);
            assert!(bytes_of(num_segments, num_lists) <= bytes);
        }
        assert_eq!((max_segments(0, 1000), max_segments(u64::MAX, 1)), (1, MAX_FRAME_SEGMENTS));
        assert!(max_segments(LEAST_BYTES, 128 * 128) >= 128 * 128 * 32);
    }

    #[test]
    fn many_at_once_never_exceed_the_limit_by_more_than_their_least() {
        let memory = FrameMemory::new(1 << 20);
        let all: Vec<Held> = std::thread::scope(|scope| {
            let begin = |_| scope.spawn(|| (0..100).map(|_| memory.hold(1 << 16, 1)).collect::<Vec<_>>());
            let threads: Vec<_> = (0..8).map(begin).collect();
            threads.into_iter().flat_map(|t| t.join().unwrap()).collect()
        });
        let sum: u64 = all.iter().map(Held::bytes).sum();
        assert!(sum <= (1 << 20) + 800, "{sum}");
        drop(all);
        assert_eq!(memory.room(), 1 << 20);
    }
}
