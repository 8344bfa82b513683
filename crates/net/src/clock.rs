//! The clock behind all stamps.

use std::sync::Arc;
use std::time::Instant;

/// Microseconds since some moment of this process. Clones are the same clock.
#[derive(Clone)]
pub struct Clock(Arc<dyn Fn() -> u64 + Send + Sync>);

impl Clock {
    /// A clock that starts at 0 and follows the machine's monotonic clock.
    pub fn start() -> Self {
        let epoch = Instant::now();
        Self::new(move || epoch.elapsed().as_micros() as u64)
    }

    /// Any source of microseconds that does not run backwards.
    pub fn new(now_micros: impl Fn() -> u64 + Send + Sync + 'static) -> Self {
        Self(Arc::new(now_micros))
    }

    /// The time.
    pub fn now_micros(&self) -> u64 {
        (self.0)()
    }
}

impl Default for Clock {
    fn default() -> Self {
        Self::start()
    }
}

impl std::fmt::Debug for Clock {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Clock({})", self.now_micros())
    }
}
