//! Which viewers have had work for the rendering thread lately.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use isinglass_core::session::admission::ViewerId;

/// Clones share it.
#[derive(Clone, Debug, Default)]
pub(crate) struct Company(Arc<Mutex<HashMap<ViewerId, Instant>>>);

impl Company {
    /// A viewer has had a turn.
    pub(crate) fn note(&self, viewer: ViewerId, now: Instant) {
        let mut seen = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        seen.insert(viewer, now);
        seen.retain(|_, at| now.saturating_duration_since(*at) < LATELY);
    }

    /// Whether anybody else has had one lately.
    pub(crate) fn has_others(&self, viewer: ViewerId, now: Instant) -> bool {
        let seen = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        seen.iter().any(|(other, at)| *other != viewer && now.saturating_duration_since(*at) < LATELY)
    }
}

/// Whoever had a turn in this time will have another one.
const LATELY: Duration = Duration::from_millis(500);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn others_are_seen_while_they_have_work() {
        let (company, start) = (Company::default(), Instant::now());
        company.note(ViewerId(1), start);
        assert!(!company.has_others(ViewerId(1), start), "one is no company");
        assert!(company.has_others(ViewerId(2), start));
        assert!(!company.has_others(ViewerId(2), start + LATELY));
        company.note(ViewerId(2), start + LATELY);
        assert!(company.has_others(ViewerId(1), start + LATELY));
    }
}
