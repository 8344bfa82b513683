//! Passes the newest of many values on at a bounded rate. A newer value replaces one that waits.

/// Holds one value until it may go. Times are µs.
#[derive(Debug)]
pub struct Pace<T> {
    period_micros: u64,
    /// When the next value may go.
    free_at: u64,
    waiting: Option<T>,
}

impl<T> Pace<T> {
    /// Passes at most one value in `period_micros`.
    pub const fn new(period_micros: u64) -> Self {
        Self { period_micros, free_at: 0, waiting: None }
    }

    /// Replaces the value that waits; `None` withdraws it.
    pub fn offer(&mut self, value: Option<T>) {
        self.waiting = value;
    }

    /// Takes the value that waits, if it may go now.
    pub fn poll(&mut self, now_micros: u64) -> Option<T> {
        if self.due()? > now_micros {
            return None;
        }
        self.free_at = now_micros + self.period_micros;
        self.waiting.take()
    }

    /// The value that waits.
    pub fn waiting(&self) -> Option<&T> {
        self.waiting.as_ref()
    }

    /// When the value that waits may go.
    pub fn due(&self) -> Option<u64> {
        self.waiting.as_ref().map(|_| self.free_at)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: u64 = 33_334;

    /// Values offered at `hz` for a second, with a poll at every refresh of a display at 60 Hz.
    fn let_through(hz: u64) -> Vec<(u64, u64)> {
        let mut pace = Pace::new(PERIOD);
        let mut times: Vec<_> = (0..hz).map(|i| (i * 1_000_000 / hz, Some(i))).collect();
        times.extend((0..70).map(|i| (i * 16_667, None)));
        times.sort_by_key(|t| t.0);
        let mut out = Vec::new();
        for (now, value) in times {
            if value.is_some() {
                pace.offer(value);
            }
            out.extend(pace.poll(now).map(|value| (now, value)));
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
        let mut offer = |now, value| {
            pace.offer(value);
            (pace.poll(now), pace.due())
        };
        assert_eq!(offer(0, Some(1)), (Some(1), None));
        assert_eq!(offer(1000, Some(2)), (None, Some(PERIOD)));
        assert_eq!(offer(PERIOD, Some(3)), (Some(3), None));
        assert_eq!(offer(PERIOD + 1, Some(4)), (None, Some(2 * PERIOD)));
        assert_eq!(offer(2 * PERIOD, None), (None, None), "taken back");
        assert_eq!(offer(1_000_000, Some(5)), (Some(5), None));
    }
}
