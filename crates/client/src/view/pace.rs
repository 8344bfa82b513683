//! Lets the newest of many values through at a bounded rate: what comes too soon waits, and is forgotten for what comes
//! after it. The time is an argument.

use std::time::Duration;

/// See the module.
#[derive(Debug)]
pub(crate) struct Pace<T> {
    period: Duration,
    let_through_at: Option<Duration>,
    waiting: Option<T>,
}

impl<T> Pace<T> {
    /// At most one value in `period`.
    pub(crate) fn new(period: Duration) -> Self {
        Self { period, let_through_at: None, waiting: None }
    }

    /// Takes a value, and gives it back at once if it may go.
    pub(crate) fn offer(&mut self, now: Duration, value: T) -> Option<T> {
        self.waiting = Some(value);
        self.poll(now)
    }

    /// The value that waited, if it may go now.
    pub(crate) fn poll(&mut self, now: Duration) -> Option<T> {
        if self.due()? > now {
            return None;
        }
        self.let_through_at = Some(now);
        self.waiting.take()
    }

    /// When the value that waits may go.
    pub(crate) fn due(&self) -> Option<Duration> {
        self.waiting.as_ref()?;
        Some(self.let_through_at.map_or(Duration::ZERO, |at| at + self.period))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: Duration = Duration::from_micros(33_334);

    /// Values offered at `hz` for a second, with a poll at every refresh of a display at 60 Hz.
    fn let_through(hz: u64) -> Vec<(Duration, u64)> {
        let mut pace = Pace::new(PERIOD);
        let mut out = Vec::new();
        let mut times: Vec<_> =
            (0..hz).map(|i| (Duration::from_micros(i * 1_000_000 / hz), Some(i))).collect();
        times.extend((0..70).map(|i| (Duration::from_micros(i * 16_667), None)));
        times.sort_by_key(|t| t.0);
        for (now, value) in times {
            let passed = match value {
                Some(value) => pace.offer(now, value),
                None => pace.poll(now),
            };
            out.extend(passed.map(|value| (now, value)));
        }
        assert_eq!(pace.due(), None, "nothing waits for ever");
        out
    }

    #[test]
    fn no_more_than_thirty_a_second_and_the_newest_last() {
        for hz in [1, 10, 29, 60, 144, 1000] {
            let out = let_through(hz);
            assert!(out.windows(2).all(|w| w[1].0 - w[0].0 >= PERIOD && w[1].1 > w[0].1), "{hz} Hz");
            assert_eq!(out.last().map(|o| o.1), Some(hz - 1), "{hz} Hz: the newest arrives");
            let expected = if hz <= 29 { hz..=hz } else { 20..=31 };
            assert!(expected.contains(&(out.len() as u64)), "{hz} Hz: {}", out.len());
        }
    }

    #[test]
    fn one_after_a_pause_goes_at_once() {
        let mut pace = Pace::new(PERIOD);
        assert_eq!(pace.offer(Duration::ZERO, 1), Some(1));
        assert_eq!(pace.offer(Duration::from_millis(1), 2), None);
        assert_eq!(pace.due(), Some(PERIOD));
        assert_eq!(pace.poll(Duration::from_millis(33)), None);
        assert_eq!(pace.poll(PERIOD), Some(2));
        assert_eq!(pace.poll(2 * PERIOD), None);
        assert_eq!(pace.offer(Duration::from_secs(1), 3), Some(3));
    }
}
