//! Wakes the window from other threads, but not in the middle of a refresh: one that begins just as somebody rings may still
//! meet that ring, for a moment.
//!
//! egui asks for a refresh under the lock of its context, which the display loop takes all the time. While the loop is at work,
//! whoever rings only leaves a note, and the loop asks for its next refresh itself.

use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};

/// See the module. Clones are the same bell.
#[derive(Clone)]
pub(crate) struct Bell {
    ctx: egui::Context,
    state: Arc<AtomicU8>,
}

impl Bell {
    /// The one of a window.
    pub(crate) fn of(ctx: &egui::Context) -> Self {
        let id = egui::Id::unique("bell");
        let state = ctx.data_mut(|data| data.get_temp_mut_or_default::<Arc<AtomicU8>>(id).clone());
        Self { ctx: ctx.clone(), state }
    }

    /// The window is to be refreshed. Returns at once, on any thread.
    pub(crate) fn ring(&self) {
        let at_work = self
            .state
            .fetch_update(Ordering::AcqRel, Ordering::Acquire, |state| (state != RESTING).then_some(RUNG));
        if at_work.is_err() {
            self.ctx.request_repaint();
        }
    }

    /// Does what a refresh does.
    pub(crate) fn during<T>(&self, refresh: impl FnOnce() -> T) -> T {
        self.state.store(AT_WORK, Ordering::Release);
        let result = refresh();
        if self.state.swap(RESTING, Ordering::AcqRel) == RUNG {
            self.ctx.request_repaint();
        }
        result
    }
}

/// The display loop does something else, or nothing.
const RESTING: u8 = 0;
/// It is at work on a refresh.
const AT_WORK: u8 = 1;
/// So it is, and somebody has rung meanwhile.
const RUNG: u8 = 2;

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicUsize;

    use super::*;

    #[test]
    fn who_rings_during_a_refresh_is_heard_after_it() {
        let ctx = egui::Context::default();
        let asked = Arc::new(AtomicUsize::new(0));
        let counted = asked.clone();
        ctx.set_request_repaint_callback(move |_| _ = counted.fetch_add(1, Ordering::SeqCst));
        let times = || asked.swap(0, Ordering::SeqCst);
        let settle = || {
            for _ in 0..5 {
                ctx.run_ui(egui::RawInput::default(), |_| ()).textures_delta.clear();
            }
        };
        let bell = Bell::of(&ctx);
        let of_thread = Bell::of(&ctx);
        bell.ring();
        assert_eq!(times(), 1);
        // egui asks once, until it has refreshed a few times.
        settle();
        times();
        let during = bell.during(|| {
            // With the lock of the context held: who took it would never come back.
            ctx.input(|_| std::thread::spawn(move || of_thread.ring()).join().unwrap());
            times()
        });
        assert_eq!((during, times()), (0, 1));
        settle();
        times();
        bell.during(|| ());
        assert_eq!(times(), 0, "nobody has rung");
    }
}
