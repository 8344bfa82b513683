//! The refresh rate over the last second, from times that the caller gives.

use std::collections::VecDeque;
use std::time::Duration;

/// The time from refresh to refresh, while refreshes follow each other.
#[derive(Clone, Debug, Default)]
pub(crate) struct RefreshMeter {
    times: VecDeque<Duration>,
}

impl RefreshMeter {
    /// Records a refresh at `now`. `continuous`: it follows the last one without a rest. A rest does not count as a
    /// slow refresh.
    pub(crate) fn record(&mut self, now: Duration, continuous: bool) {
        if !continuous {
            self.times.clear();
        }
        self.times.push_back(now);
        while self.times.len() > 2 && self.times[0] + WINDOW < now {
            self.times.pop_front();
        }
    }

    /// The mean interval; none at rest.
    pub(crate) fn interval(&self) -> Option<Duration> {
        let (first, last) = (self.times.front()?, self.times.back()?);
        let intervals = u32::try_from(self.times.len() - 1).ok().filter(|&n| n > 0)?;
        Some((*last - *first) / intervals)
    }
}

/// The time over which the mean is taken.
const WINDOW: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(x: u64) -> Duration {
        Duration::from_millis(x)
    }

    #[test]
    fn a_rest_is_not_a_slow_refresh() {
        let mut m = RefreshMeter::default();
        for i in 0..10 {
            m.record(ms(i * 16), true);
        }
        assert_eq!(m.interval(), Some(ms(16)));
        m.record(ms(9_000), false);
        assert_eq!(m.interval(), None);
        m.record(ms(9_020), true);
        assert_eq!(m.interval(), Some(ms(20)));
    }
}
