//! The display may disappear while the window is open: the X server ends, or its connection breaks. Window libraries
//! then panic.

use std::panic::{self, AssertUnwindSafe, PanicHookInfo};
use std::sync::Arc;
use std::thread;

#[derive(Debug, PartialEq)]
pub(crate) struct DisplayLost;

/// Runs `work`. A panic without a display (`is_available`) is returned, and prints nothing. Every other panic
/// continues.
pub(crate) fn told_apart<T>(is_available: fn() -> bool, work: impl FnOnce() -> T) -> Result<T, DisplayLost> {
    type Hook = dyn Fn(&PanicHookInfo<'_>) + Send + Sync;
    let hook: Arc<Hook> = Arc::from(panic::take_hook());
    let (here, usual) = (thread::current().id(), hook.clone());
    panic::set_hook(Box::new(move |info| {
        if thread::current().id() != here || is_available() {
            usual(info);
        }
    }));
    let result = panic::catch_unwind(AssertUnwindSafe(work));
    panic::set_hook(Box::new(move |info| hook(info)));
    match result {
        Ok(result) => Ok(result),
        Err(_) if !is_available() => Err(DisplayLost),
        Err(panic) => panic::resume_unwind(panic),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_panic_without_a_display_is_its_loss() {
        let gone = || false;
        let there = || true;
        assert_eq!(told_apart(gone, || 5), Ok(5));
        assert_eq!(told_apart(gone, || -> i32 { panic!("BadWindow") }), Err(DisplayLost));
        let other = panic::catch_unwind(|| told_apart(there, || panic!("a defect, as this test wants it")));
        let message = other.unwrap_err().downcast_ref::<&str>().copied();
        assert_eq!(message, Some("a defect, as this test wants it"));
    }
}
