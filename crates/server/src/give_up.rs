//! Work on other threads that ends when nobody waits for it any more.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Held by whoever waits. When this is dropped, the work is given up.
#[derive(Debug, Default)]
pub(crate) struct GiveUp(Arc<AtomicBool>);

impl GiveUp {
    /// Tells the work whether somebody waits.
    pub(crate) fn wanted(&self) -> impl Fn() -> bool + Clone + Send + Sync + 'static + use<> {
        let is_over = self.0.clone();
        move || !is_over.load(Ordering::Relaxed)
    }
}

impl Drop for GiveUp {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}
