//! The end of the program by a signal: what it has unpacked goes with it.

use std::sync::atomic::{AtomicBool, Ordering};

use isinglass_formats::{before_scratch, remove_scratch};

/// Prepares for signals, as soon as there is something to remove. Before that, a signal ends the program as usual.
pub(crate) fn prepare() {
    #[cfg(unix)]
    before_scratch(signals::listen);
    #[cfg(not(unix))]
    before_scratch(|| ());
}

/// Removes what the program has unpacked, for an end without a signal.
pub(crate) fn clean_up() {
    remove_scratch();
}

/// The command ends by itself after Ctrl-C, and with `and_terminate` after SIGTERM.
pub(crate) fn leave_to_command(and_terminate: bool) {
    ENDS_AT_INTERRUPT.store(true, Ordering::Relaxed);
    ENDS_AT_TERMINATE.store(and_terminate, Ordering::Relaxed);
}

static ENDS_AT_INTERRUPT: AtomicBool = AtomicBool::new(false);
static ENDS_AT_TERMINATE: AtomicBool = AtomicBool::new(false);

#[cfg(unix)]
mod signals {
    use std::sync::Once;
    use std::sync::atomic::{AtomicBool, Ordering};

    use isinglass_formats::remove_scratch;
    use tokio::signal::unix::{Signal, SignalKind, signal};

    use super::{ENDS_AT_INTERRUPT, ENDS_AT_TERMINATE};

    /// Listens from now on, on a thread of its own. Without one, signals end the program at once.
    pub(super) fn listen() {
        static ONCE: Once = Once::new();
        ONCE.call_once(|| {
            let Ok(runtime) = tokio::runtime::Builder::new_current_thread().enable_all().build() else {
                return;
            };
            let entered = runtime.enter();
            // Whoever ignores a signal, as `nohup` does, still ignores it.
            let heard = |kind: SignalKind| (!is_ignored(kind)).then(|| signal(kind).ok()).flatten();
            let kinds = [SignalKind::interrupt(), SignalKind::terminate(), SignalKind::hangup()];
            let [interrupt, terminate, hang_up] = kinds.map(heard);
            drop(entered);
            let wait = async move {
                tokio::select! {
                    () = next(interrupt, &ENDS_AT_INTERRUPT) => SignalKind::interrupt(),
                    () = next(terminate, &ENDS_AT_TERMINATE) => SignalKind::terminate(),
                    () = next(hang_up, &NEVER) => SignalKind::hangup(),
                }
            };
            let run = move || {
                let kind = runtime.block_on(wait);
                remove_scratch();
                // The exit code of shells for a signal.
                std::process::exit(128 + kind.as_raw_value());
            };
            let _ = std::thread::Builder::new().name("signals".into()).spawn(run);
        });
    }

    static NEVER: AtomicBool = AtomicBool::new(false);

    /// Returns at the next signal that the command does not handle.
    async fn next(signal: Option<Signal>, is_of_command: &AtomicBool) {
        let Some(mut signal) = signal else { return std::future::pending().await };
        while signal.recv().await.is_some() {
            if !is_of_command.load(Ordering::Relaxed) {
                return;
            }
        }
        std::future::pending::<()>().await;
    }

    /// Whether this process ignores a signal, as far as Linux tells.
    fn is_ignored(kind: SignalKind) -> bool {
        let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
        let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
        let mask = mask.and_then(|text| u64::from_str_radix(text.trim(), 16).ok()).unwrap_or(0);
        mask >> (kind.as_raw_value() - 1) & 1 == 1
    }
}
