//! Progress on standard error: a bar on a terminal, or else a line from time to time.

use std::io::{IsTerminal, Write};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// A task with a known number of steps.
pub struct Progress {
    what: String,
    bar: ProgressBar,
    num_steps: u64,
    done: u64,
    /// Time of the last line; `None` on a terminal.
    last_line: Option<Instant>,
}

impl Progress {
    /// A task of `num_steps` steps.
    pub fn new(what: impl Into<String>, num_steps: u64) -> Self {
        let what = what.into();
        let is_terminal = std::io::stderr().is_terminal();
        let target = if is_terminal { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() };
        let bar = ProgressBar::with_draw_target(Some(num_steps), target);
        if let Ok(style) = ProgressStyle::with_template("{prefix:>10} [{wide_bar}] {pos}/{len} {eta} {msg}") {
            bar.set_style(style.progress_chars("=> "));
        }
        bar.set_prefix(what.clone());
        // The bar appears at once and moves during long steps.
        bar.enable_steady_tick(TICK);
        Self { what, bar, num_steps, done: 0, last_line: (!is_terminal).then(Instant::now) }
    }

    /// Names the next step, at once even without a terminal.
    pub fn begin(&mut self, now: &str) {
        self.bar.set_message(now.to_owned());
        if let Some(last) = &mut self.last_line {
            *last = Instant::now();
            note(&format!("{}: {}/{} {now}", self.what, self.done, self.num_steps));
        }
    }

    /// `num_steps` more are done; `now` is the next.
    pub fn advance(&mut self, num_steps: u64, now: &str) {
        self.done = (self.done + num_steps).min(self.num_steps);
        self.bar.set_message(now.to_owned());
        self.bar.set_position(self.done);
        if let Some(last) = &mut self.last_line
            && last.elapsed() >= LINE_INTERVAL
        {
            *last = Instant::now();
            note(&format!("{}: {}/{} {now}", self.what, self.done, self.num_steps));
        }
    }

    /// Removes the bar.
    pub fn finish(self) {
        self.bar.finish_and_clear();
    }
}

/// Writes a line to standard error. A closed stream is no reason to fail.
pub fn note(line: &str) {
    let _ = writeln!(std::io::stderr().lock(), "{line}");
}

const TICK: Duration = Duration::from_millis(200);
/// Rare enough for a log file, and often enough to show life.
const LINE_INTERVAL: Duration = Duration::from_secs(5);
