//! What the last session to each network showed of the path. The next one starts with half of it, because the path
//! may have changed.

use std::collections::VecDeque;
use std::net::IpAddr;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use tokio::time::Instant;

use super::pending_hellos::place_of;
use crate::congestion::{FIRST_WINDOW_BYTES, LinkGauge};

/// The newest paths, the latest last.
#[derive(Debug, Default)]
pub(super) struct KnownPaths(Mutex<VecDeque<Known>>);

#[derive(Clone, Copy, Debug)]
struct Known {
    place: IpAddr,
    at: Instant,
    window_bytes: u64,
}

impl KnownPaths {
    /// Bytes that may be in flight at first on the path to an address.
    pub(super) fn first_window_bytes(&self, to: IpAddr, now: Instant) -> u64 {
        let place = place_of(to);
        let known = self.lock().iter().find(|known| known.place == place).copied();
        match known {
            Some(known) if now.saturating_duration_since(known.at) < KNOWN_FOR => {
                (known.window_bytes / 2).clamp(FIRST_WINDOW_BYTES, MAX_FIRST_BYTES)
            }
            _ => FIRST_WINDOW_BYTES,
        }
    }

    /// A session to this address is over.
    pub(super) fn note(&self, to: IpAddr, now: Instant, gauge: &LinkGauge) {
        let Some(rate) = gauge.bytes_per_second().filter(|_| gauge.knows_rate()) else { return };
        let place = place_of(to);
        let window_bytes = (rate * gauge.least_rtt_micros() as f64 / 1e6) as u64;
        let mut paths = self.lock();
        paths.retain(|known| known.place != place);
        if paths.len() == MAX_KNOWN {
            paths.pop_front();
        }
        paths.push_back(Known { place, at: now, window_bytes });
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, VecDeque<Known>> {
        // Every change is one step, so a panic leaves the list in order.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A path is forgotten after this time.
const KNOWN_FOR: Duration = Duration::from_hours(1);
/// Most paths that are known.
const MAX_KNOWN: usize = 256;
const MAX_FIRST_BYTES: u64 = 2 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_session_decides_for_its_place_and_for_a_while() {
        let (paths, now) = (KnownPaths::default(), Instant::now());
        let [here, there]: [IpAddr; 2] = [[192, 0, 2, 1].into(), [192, 0, 2, 2].into()];
        let first = |to, later| paths.first_window_bytes(to, now + later);
        // Ten megabytes a second at 100 ms are a megabyte in flight.
        paths.note(here, now, &LinkGauge::of(10e6, 100_000));
        assert_eq!(first(here, Duration::ZERO), 500_000);
        assert_eq!(first(there, Duration::ZERO), FIRST_WINDOW_BYTES);
        assert_eq!(first(here, KNOWN_FOR), FIRST_WINDOW_BYTES);
        // Neither a slow path nor a session that has measured nothing makes the start worse.
        paths.note(here, now, &LinkGauge::default());
        assert_eq!(first(here, Duration::ZERO), 500_000);
        paths.note(here, now, &LinkGauge::of(1e4, 1000));
        assert_eq!(first(here, Duration::ZERO), FIRST_WINDOW_BYTES);
        (0..=255).for_each(|n| paths.note([203, 0, 113, n].into(), now, &LinkGauge::of(1e9, 100_000)));
        paths.note([203, 0, 112, 0].into(), now, &LinkGauge::of(1e9, 100_000));
        assert_eq!(paths.lock().len(), MAX_KNOWN);
        assert_eq!(first([203, 0, 113, 255].into(), Duration::ZERO), MAX_FIRST_BYTES);
    }
}
