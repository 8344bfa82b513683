//! A token bucket: it allows a number of actions per second, in bursts of up to a second's worth.

/// Levels are in millionths, so that each microsecond adds a whole number.
#[derive(Clone, Debug)]
pub(super) struct Bucket {
    per_second: u64,
    millionths: u64,
    last_micros: u64,
}

impl Bucket {
    pub(super) fn new(per_second: u32, now_micros: u64) -> Self {
        let per_second = per_second.into();
        Self { per_second, millionths: per_second * 1_000_000, last_micros: now_micros }
    }

    /// Returns whether an action is allowed now, and counts it.
    pub(super) fn take(&mut self, now_micros: u64) -> bool {
        // A second fills the bucket; the clamp keeps longer waits from overflowing.
        let waited = now_micros.saturating_sub(self.last_micros).min(1_000_000);
        self.last_micros = self.last_micros.max(now_micros);
        self.millionths = (self.millionths + waited * self.per_second).min(self.per_second * 1_000_000);
        let may = self.millionths >= 1_000_000;
        if may {
            self.millionths -= 1_000_000;
        }
        may
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_holds_over_any_second_after_the_burst() {
        let mut bucket = Bucket::new(100, 5);
        assert_eq!((0..1000).filter(|_| bucket.take(5)).count(), 100);
        // One attempt a millisecond for ten seconds: 100 a second get through.
        assert_eq!((0..10_000).filter(|ms| bucket.take(5 + ms * 1000)).count(), 999);
        // A clock that jumps back, or far ahead, neither panics nor fills above the burst.
        assert!(!bucket.take(0));
        assert_eq!((0..1000).filter(|_| bucket.take(u64::MAX)).count(), 100);
    }
}
