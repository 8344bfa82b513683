//! Separates the round trip of the path from waiting in queues.

/// The least round trip of a link, until the path itself becomes longer.
///
/// If a longer path counted as a queue, it would keep the window from being filled, and an unfilled window does not
/// recover from a loss. So when round trips stay longer, the link is drained for a moment. The delay that remains is
/// no queue of ours.
#[derive(Clone, Copy, Debug)]
pub(super) struct LeastRtt {
    least_micros: Option<u64>,
    /// Since when all round trips are longer, µs.
    longer_since_micros: Option<u64>,
    /// The end of draining and the least round trip since its start, µs.
    draining: Option<(u64, u64)>,
    /// How long round trips may be longer before the link is drained.
    patience_micros: u64,
    seen_at_micros: u64,
}

impl Default for LeastRtt {
    fn default() -> Self {
        Self {
            least_micros: None,
            longer_since_micros: None,
            draining: None,
            patience_micros: PATIENCE_MICROS,
            seen_at_micros: 0,
        }
    }
}

impl LeastRtt {
    /// Whether to send only a part of what the link carries.
    pub(super) fn is_draining(&self) -> bool {
        self.draining.is_some()
    }

    /// Takes a round trip into account and returns the least, µs. `ever_micros` is the least so far.
    pub(super) fn handle(&mut self, now_micros: u64, rtt_micros: u64, ever_micros: u64) -> u64 {
        // A pause leaves no queue of ours.
        let is_paused = now_micros.saturating_sub(self.seen_at_micros) > PATIENCE_MICROS;
        self.seen_at_micros = now_micros;
        let least = self.least_micros.unwrap_or(ever_micros).min(rtt_micros);
        self.least_micros = Some(least);
        if is_paused || !is_longer(rtt_micros, least) {
            if self.draining.take().is_some() {
                // The queue was ours, and will be again.
                self.patience_micros = (self.patience_micros * 2).min(MAX_PATIENCE_MICROS);
            }
            self.longer_since_micros = None;
            return least;
        }
        let since = *self.longer_since_micros.get_or_insert(now_micros);
        match &mut self.draining {
            Some((until, longer)) => {
                *longer = rtt_micros.min(*longer);
                if now_micros >= *until {
                    *self =
                        Self { least_micros: Some(*longer), seen_at_micros: now_micros, ..Self::default() };
                }
            }
            None if now_micros.saturating_sub(since) > self.patience_micros => {
                self.draining = Some((now_micros + DRAINING_MICROS + 3 * rtt_micros, rtt_micros));
            }
            None => {}
        }
        self.least_micros.unwrap_or(least)
    }
}

/// Whether a round trip is longer than the least by more than jitter.
pub(super) fn is_longer(rtt_micros: u64, least_micros: u64) -> bool {
    rtt_micros > least_micros + (least_micros / 4).max(QUEUE_MICROS)
}

/// Delay beyond the least round trip that means a queue and not jitter.
const QUEUE_MICROS: u64 = 15_000;
/// How long round trips may be longer before the link is drained. It doubles up to the second value where the queue
/// was ours.
const PATIENCE_MICROS: u64 = 5_000_000;
const MAX_PATIENCE_MICROS: u64 = 60_000_000;
/// In this time, a third of the link's rate drains a queue of a fifth of a second.
const DRAINING_MICROS: u64 = 300_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_round_trip_is_forgotten_when_all_are_longer_drained_or_not() {
        let second = 1_000_000;
        let found = |trips: &[(u64, u64)]| {
            let mut least = LeastRtt::default();
            trips.iter().map(|&(at, rtt)| least.handle(at * second, rtt, 10_000)).last()
        };
        let longer = [(0, 10_000), (1, 90_000), (4, 80_000), (7, 95_000), (8, 90_000)];
        assert_eq!(found(&longer[..4]), Some(10_000));
        assert_eq!(found(&longer), Some(90_000));
        let drains =
            [(0, 10_000), (1, 90_000), (7, 90_000), (8, 20_000), (9, 90_000), (15, 90_000), (17, 90_000)];
        assert_eq!(found(&drains), Some(10_000));
        assert_eq!(found(&[(0, 90_000), (20, 90_000)]), Some(10_000));
        assert_eq!(found(&[(0, 90_000), (1, 5_000), (2, 8_000)]), Some(5_000));
    }
}
