//! Plays the times of a file: when the next one is requested.
//!
//! A step begins when it is due and the one before it is shown. So a slow server plays slower, and no requests queue.

use std::time::Duration;

use isinglass_core::ids::LoadId;
use isinglass_core::wire::{Choices, LoadState, LoadStatus};
use isinglass_formats::movie::interval_of_times;

#[derive(Debug, Default)]
pub(super) struct Player {
    playing: Option<Playing>,
}

#[derive(Debug)]
struct Playing {
    /// When the next step is due.
    due: Duration,
    /// When the last step was requested.
    stepped_at: Duration,
    /// The server's newest load when playing began.
    since: LoadId,
}

impl Player {
    pub(super) fn is_playing(&self) -> bool {
        self.playing.is_some()
    }

    pub(super) fn start(&mut self, now: Duration, load: Option<&LoadStatus>) {
        let since = load.map_or(LoadId(0), |load| load.load);
        self.playing = Some(Playing { due: now, stepped_at: now, since });
    }

    pub(super) fn stop(&mut self) {
        self.playing = None;
    }

    /// The next time, if its step begins now. `waits` while the server has not read what was requested, and `is_shown`
    /// if a frame of the present part is on the screen. Playing ends where a time cannot be read, or where another
    /// viewer chooses a part.
    pub(super) fn step(
        &mut self,
        now: Duration,
        parts: &Choices,
        load: Option<&LoadStatus>,
        (waits, is_shown): (bool, bool),
    ) -> Option<u32> {
        let playing = self.playing.as_mut()?;
        let newer = load.filter(|load| load.load > playing.since);
        let is_ended = newer.is_some_and(|load| match load.state {
            LoadState::Reading { .. } | LoadState::Done => !load.is_own,
            LoadState::Failed(_) | LoadState::Cancelled => !waits,
        });
        if is_ended || parts.num_times < 2 {
            self.playing = None;
            return None;
        }
        let is_reading = load.is_some_and(|load| matches!(load.state, LoadState::Reading { .. }));
        if waits || is_reading || !is_shown || now < playing.due {
            return None;
        }
        // A step that comes late does not shift those after it, unless they are late too.
        let interval = interval(parts);
        let next = playing.due + interval;
        playing.due = if next > now { next } else { now + interval };
        playing.stepped_at = now;
        Some((parts.shown.time.unwrap_or(0) + 1) % parts.num_times)
    }

    /// How long the next step is not due yet.
    pub(super) fn wait(&self, now: Duration) -> Option<Duration> {
        Some(self.playing.as_ref()?.due.saturating_sub(now)).filter(|wait| !wait.is_zero())
    }

    /// Whether a step has been requested lately, so that its reading is no news yet.
    pub(super) fn is_swift(&self, now: Duration) -> bool {
        self.playing.as_ref().is_some_and(|playing| now < playing.stepped_at + SWIFT)
    }
}

/// From one time to the next.
pub(super) fn interval(parts: &Choices) -> Duration {
    interval_of_times(parts.time_step.map(f64::from))
}

/// A reading that takes longer is told of.
const SWIFT: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use isinglass_core::wire::Part;

    use super::*;

    fn parts(time: u32) -> Choices {
        let shown = Part { time: Some(time), ..Part::default() };
        Choices { shown, num_times: 3, time_step: Some(0.5), ..Choices::default() }
    }

    fn load(number: u32, state: LoadState) -> LoadStatus {
        LoadStatus { load: LoadId(number), is_own: true, part: Part::default(), bytes_needed: 0, state }
    }

    fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    const SHOWN: (bool, bool) = (false, true);

    #[test]
    fn times_follow_each_other_at_their_interval_and_begin_anew() {
        let mut player = Player::default();
        assert_eq!(player.step(ms(0), &parts(0), None, SHOWN), None, "nobody plays");
        player.start(ms(0), None);
        let mut time = 0;
        let mut steps = Vec::new();
        for at in (0..2000).step_by(10) {
            if let Some(next) = player.step(ms(at), &parts(time), None, SHOWN) {
                steps.push((at, next));
                time = next;
            }
        }
        assert_eq!(steps, [(0, 1), (500, 2), (1000, 0), (1500, 1)]);
        assert_eq!((player.wait(ms(1900)), player.wait(ms(2100))), (Some(ms(100)), None));
    }

    #[test]
    fn no_step_begins_before_the_one_before_is_shown() {
        let mut player = Player::default();
        player.start(ms(0), None);
        assert_eq!(player.step(ms(0), &parts(0), None, SHOWN), Some(1));
        let reading = load(1, LoadState::Reading { permille: 9 });
        let done = load(1, LoadState::Done);
        for at in (0..4000).step_by(100) {
            assert_eq!(player.step(ms(at), &parts(0), None, (true, true)), None, "nobody has heard of it");
            assert_eq!(player.step(ms(at), &parts(0), Some(&reading), SHOWN), None, "it is read");
            assert_eq!(player.step(ms(at), &parts(1), Some(&done), (false, false)), None, "no frame");
        }
        assert_eq!(player.step(ms(4000), &parts(1), Some(&done), SHOWN), Some(2));
        // What was missed is not made up for.
        assert_eq!(player.step(ms(4490), &parts(2), Some(&done), SHOWN), None);
        // A little delay is.
        assert_eq!(player.step(ms(4700), &parts(2), Some(&done), SHOWN), Some(0));
        assert_eq!(player.step(ms(5000), &parts(0), Some(&done), SHOWN), Some(1));
    }

    #[test]
    fn playing_ends_where_a_time_is_bad_or_another_viewer_chooses() {
        for (number, is_own, state, is_ended) in [
            (8, true, LoadState::Failed("no".into()), true),
            (8, true, LoadState::Cancelled, true),
            (8, false, LoadState::Reading { permille: 0 }, true),
            (8, false, LoadState::Done, true),
            (8, true, LoadState::Done, false),
            // From before.
            (7, true, LoadState::Failed("no".into()), false),
            (7, false, LoadState::Done, false),
        ] {
            let mut player = Player::default();
            player.start(ms(0), Some(&load(7, LoadState::Done)));
            let load = LoadStatus { is_own, ..load(number, state) };
            player.step(ms(0), &parts(0), Some(&load), SHOWN);
            assert_eq!(player.is_playing(), !is_ended, "{load:?}");
        }
        let mut player = Player::default();
        player.start(ms(0), None);
        player.step(ms(0), &Choices { num_times: 1, ..parts(0) }, None, SHOWN);
        assert!(!player.is_playing());
    }
}
