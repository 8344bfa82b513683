//! How finely the picture is cast while the camera moves, so that it holds a refresh rate. Pure: time is an argument.
//!
//! Quality is given up along a ladder. Kept frames go first: they fill edges, and cost more than the whole picture.
//! Then the cast picture shrinks, and is enlarged.
//!
//! The measured time is the time between refreshes, which is never shorter than the display's period: at 60 Hz every
//! cast of up to 16.7 ms takes 16.7 ms. A step that takes no more than that has an unknown cost, so the next finer
//! one is tried.
//!
//! Order of calls: [`QualityControl::handle_cast`] for each measured time, [`QualityControl::quality`] for each
//! refresh.

use std::time::Duration;

use isinglass_core::camera::Intrinsics;

/// How finely to cast.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quality {
    /// Side of the cast picture, as a share of the shown one; at most 1.
    pub scale: f32,
    /// Whether older frames are cast where the newest does not see all of the picture.
    pub keeps: bool,
}

impl Quality {
    /// Everything.
    pub const FULL: Self = LADDER[0];

    /// The intrinsics to cast with when `shown` is shown.
    pub fn size_of(&self, shown: Intrinsics) -> Intrinsics {
        let scaled = |side: u32| ((side as f32 * self.scale).round() as u32).max(1);
        Intrinsics { width: scaled(shown.width), height: scaled(shown.height), ..shown }
    }
}

/// Chooses a step of the ladder by the measured times.
#[derive(Clone, Debug)]
pub struct QualityControl {
    /// Longest time of a refresh.
    target: Duration,
    step: usize,
    /// The time of each step when it was last cast, and when that was.
    measured: [Option<(Duration, Duration)>; LADDER.len()],
    changed_at: Duration,
    /// The shortest recent time between refreshes: the display's period if casts are fast.
    period: Duration,
    /// The step whose first time was slightly too long, which needs a second one to count.
    doubted: Option<usize>,
}

impl QualityControl {
    /// Holds `refreshes_per_second`, which is positive.
    pub fn new(refreshes_per_second: f32) -> Self {
        let target = Duration::from_secs_f32(SLACK / refreshes_per_second.max(MIN_RATE));
        let measured = [None; LADDER.len()];
        Self { target, step: 0, measured, changed_at: Duration::ZERO, period: LONGEST_PERIOD, doubted: None }
    }

    /// Reports that a refresh with a cast of `quality` took `time`, known at `now`. If no kept frames were cast,
    /// `keeps` is false.
    pub fn handle_cast(&mut self, now: Duration, quality: Quality, time: Duration) {
        let Some(step) = LADDER.iter().position(|q| *q == quality) else { return };
        let longer = self.period + time.saturating_sub(self.period).mul_f32(PERIOD_GAIN);
        self.period = time.min(longer).min(LONGEST_PERIOD);
        // A single slow refresh may be a compiling driver or a clock that speeds up, so the next one decides.
        let is_hiccup =
            time > self.target && time <= self.target.mul_f32(HICCUP) && !self.is_known(now, step);
        if is_hiccup && self.doubted != Some(step) {
            self.doubted = Some(step);
            return;
        }
        self.doubted = None;
        let smoothed = match self.measured[step] {
            Some((before, at)) if now < at + MEMORY => before.mul_f32(1.0 - GAIN) + time.mul_f32(GAIN),
            _ => time,
        };
        self.measured[step] = Some((smoothed, now));
        if (self.step, step) == (0, ALONE) && smoothed > self.target {
            self.go_to(now, ALONE);
            self.measured[step] = Some((smoothed, now));
        }
        if step == self.step {
            self.choose(now);
        }
    }

    /// The quality of the next cast. At rest the picture is whole at once, without kept frames that were too slow:
    /// the window would stop for as long. A camera that moves again starts from the step that held the rate.
    pub fn quality(&self, is_moving: bool) -> Quality {
        LADDER[if is_moving { self.step } else { self.step.min(ALONE) }]
    }

    /// Chooses the finest step that should hold the rate.
    fn choose(&mut self, now: Duration) {
        let Some((here, _)) = self.measured[self.step] else { return };
        let may_hold_alone =
            self.step < ALONE && !self.is_known(now, ALONE) && here <= self.target * MOST_OF_KEPT;
        if here > self.target && may_hold_alone {
            // The cost of kept frames is unknown beforehand. The picture shrinks only if it is too slow without them.
            self.go_to(now, ALONE);
        } else if here > self.target {
            let holds = |step: &usize| self.expected(now, *step, here) <= self.target.mul_f32(HEADROOM);
            let step = (self.step + 1..LADDER.len()).find(holds);
            self.go_to(now, step.unwrap_or_else(|| self.finest_of_fastest(now, here)));
        } else if self.step > 0 && now >= self.changed_at + PATIENCE {
            // One step up at a time, and only with time to spare. The last time of a step counts for a while, so that
            // a step that is too fine is not tried again and again.
            let finer = self.step - 1;
            let is_at_period = here <= self.period.mul_f32(AT_PERIOD) && !self.is_known(now, finer);
            if is_at_period || self.expected(now, finer, here) <= self.target.mul_f32(HEADROOM) {
                self.go_to(now, finer);
            }
        }
    }

    /// If nothing holds the rate, only what brings it nearer is given up. A coarser picture does not help if the time
    /// does not depend on pixels, or other programs keep the machine busy.
    fn finest_of_fastest(&self, now: Duration, here: Duration) -> usize {
        let expected = |step| self.expected(now, step, here);
        let least = (0..LADDER.len()).map(expected).min().unwrap_or(here);
        (0..LADDER.len()).find(|step| expected(*step).mul_f32(HEADROOM) <= least).unwrap_or(self.step)
    }

    /// The recent time of a step, or an estimate: most of the time is proportional to pixels.
    fn expected(&self, now: Duration, step: usize, here: Duration) -> Duration {
        match self.measured[step] {
            Some((time, at)) if now < at + MEMORY => time,
            _ => here.mul_f32(COSTS[step] / COSTS[self.step]),
        }
    }

    fn is_known(&self, now: Duration, step: usize) -> bool {
        self.measured[step].is_some_and(|(_, at)| now < at + MEMORY)
    }

    fn go_to(&mut self, now: Duration, step: usize) {
        if step != self.step {
            self.step = step;
            self.changed_at = now;
            // Older times of this step may be of another view.
            self.measured[step] = None;
        }
    }
}

/// From the whole picture to one that still shows where things are.
const LADDER: [Quality; 6] = [
    Quality { scale: 1.0, keeps: true },
    Quality { scale: 1.0, keeps: false },
    Quality { scale: 0.75, keeps: false },
    Quality { scale: 0.5, keeps: false },
    Quality { scale: 0.35, keeps: false },
    Quality { scale: 0.25, keeps: false },
];
/// The step of the whole picture from the newest frame alone.
const ALONE: usize = 1;
/// Time of each step relative to the second: the share of its pixels, and a constant tenth. Kept frames are tried if
/// there is some time to spare: their cost depends on how much of the picture they fill.
const COSTS: [f32; LADDER.len()] = [1.4, 1.0, 0.61, 0.33, 0.21, 0.16];
/// Factor that kept frames may add to the time of a picture.
const MOST_OF_KEPT: u32 = 4;
/// A step is chosen if it should need no more than this share of the time.
const HEADROOM: f32 = 0.85;
/// Weight of a new time: the mean of about the last five (Gupta 2022, section 5).
const GAIN: f32 = 0.3;
/// A step holds for this time before a finer one is tried.
const PATIENCE: Duration = Duration::from_millis(400);
/// Measured times count for this long.
const MEMORY: Duration = Duration::from_secs(5);
/// A rate counts as held if it is missed by this factor: two periods at 59.94 Hz are longer than a thirtieth of a
/// second.
const SLACK: f32 = 1.05;
/// The longest period of a display: longer times are those of casts.
const LONGEST_PERIOD: Duration = Duration::from_millis(21);
/// How fast the period follows longer times, so that two refreshes without a wait between them are soon forgotten.
const PERIOD_GAIN: f32 = 0.05;
/// Up to this many periods, the cost of a step is unknown.
const AT_PERIOD: f32 = 1.15;
/// A first time of up to this many targets counts only when it repeats.
const HICCUP: f32 = 2.5;
/// Least refresh rate, 1/s.
const MIN_RATE: f32 = 0.1;

#[cfg(test)]
mod tests {
    use super::*;

    /// Moves the camera for `seconds` with a machine on which `cost` tells the time of a cast; returns the steps.
    fn run(
        control: &mut QualityControl,
        now: &mut Duration,
        seconds: f32,
        cost: impl Fn(Quality) -> f32,
    ) -> Vec<f32> {
        let end = *now + Duration::from_secs_f32(seconds);
        let mut scales = vec![];
        while *now < end {
            let quality = control.quality(true);
            let time = Duration::from_secs_f32(cost(quality));
            *now += time.max(Duration::from_millis(16));
            control.handle_cast(*now, quality, time);
            scales.push(quality.scale);
        }
        scales
    }

    fn pixels(full: f32) -> impl Fn(Quality) -> f32 {
        move |q| full * (0.1 + 0.9 * q.scale * q.scale)
    }

    #[test]
    fn a_machine_that_is_fast_enough_gives_up_nothing() {
        let (mut control, mut now) = (QualityControl::new(30.0), Duration::ZERO);
        assert!(run(&mut control, &mut now, 3.0, pixels(0.030)).iter().all(|s| *s == 1.0));
    }

    #[test]
    fn the_rate_is_held_by_the_finest_step_that_holds_it() {
        for (full, expected) in [(0.045, 0.75), (0.085, 0.5), (0.12, 0.35), (0.17, 0.25)] {
            let (mut control, mut now) = (QualityControl::new(30.0), Duration::ZERO);
            let scales = run(&mut control, &mut now, 4.0, pixels(full));
            let settled = &scales[scales.len() / 2..];
            assert!(settled.iter().all(|s| *s == expected), "{full}: {settled:?}");
            assert!(pixels(full)(control.quality(true)) <= SLACK / 30.0, "{full}");
        }
    }

    /// What is measured on a display of `hertz`: whole periods.
    fn on_display(hertz: f32, cost: impl Fn(Quality) -> f32) -> impl Fn(Quality) -> f32 {
        move |q| (cost(q) * hertz).ceil().max(1.0) / hertz
    }

    #[test]
    fn no_display_holds_a_fast_picture_small() {
        for hertz in [50.0, 59.94, 60.0, 75.0, 144.0] {
            let (mut control, mut now) = (QualityControl::new(30.0), Duration::ZERO);
            let fast = on_display(hertz, pixels(0.003));
            // So slow that the picture is made smaller, as a server that takes the same GPU for a while makes it.
            let slow = run(&mut control, &mut now, 1.0, on_display(hertz, pixels(0.06)));
            assert!(slow.last().is_some_and(|scale| *scale <= 0.75), "{hertz}: {slow:?}");
            let scales = run(&mut control, &mut now, 8.0, &fast);
            assert_eq!(scales.last(), Some(&1.0), "{hertz}");
            assert!(run(&mut control, &mut now, 20.0, fast).iter().all(|s| *s == 1.0), "{hertz}");
        }
        // A cast of between one period and two of 59.94 Hz holds the rate.
        let (mut control, mut now) = (QualityControl::new(30.0), Duration::ZERO);
        let scales = run(&mut control, &mut now, 20.0, on_display(59.94, pixels(0.025)));
        assert!(scales.iter().all(|s| *s == 1.0));
    }

    #[test]
    fn one_slow_refresh_changes_nothing_and_two_do() {
        for (num_slow, expected) in [(1, 1.0), (2, 0.5)] {
            let (mut control, mut now) = (QualityControl::new(30.0), Duration::ZERO);
            let mut scales = vec![];
            for number in 0..4 {
                let time = Duration::from_millis(if number < num_slow { 70 } else { 16 });
                now += time;
                let quality = Quality { keeps: false, ..control.quality(true) };
                control.handle_cast(now, quality, time);
                scales.push(control.quality(true).scale);
            }
            let least = scales.into_iter().fold(1.0, f32::min);
            assert_eq!(least, expected, "{num_slow}");
        }
    }

    /// At every cost, also between two steps, and with times that jitter by a tenth.
    #[test]
    fn there_is_no_oscillation() {
        for full in (20..400).map(|ms| ms as f32 * 1e-3) {
            let (mut control, mut now) = (QualityControl::new(30.0), Duration::ZERO);
            let count = std::cell::Cell::new(0u32);
            let scales = run(&mut control, &mut now, 20.0, |q| {
                count.set(count.get().wrapping_mul(1_664_525).wrapping_add(1_013_904_223));
                pixels(full)(q) * (0.95 + 0.1 * (count.get() >> 8) as f32 / (1 << 24) as f32)
            });
            let changes = scales.windows(2).filter(|w| w[0] != w[1]).count();
            // Down at the start, and now and then a step that is tried again when its time is forgotten.
            assert!(changes <= 12, "{full}: {changes} changes");
        }
    }

    /// Kept frames are given up before pixels are, tried now and then, and kept where there is time for them.
    #[test]
    fn kept_frames_go_first() {
        for (alone, kept) in [(0.012, 0.05), (0.02, 0.08), (0.03, 0.04), (0.01, 0.03), (0.06, 0.3)] {
            let (mut control, mut now) = (QualityControl::new(30.0), Duration::ZERO);
            let (num, num_kept) = (std::cell::Cell::new(0u32), std::cell::Cell::new(0u32));
            let scales = run(&mut control, &mut now, 20.0, |q| {
                num.set(num.get() + 1);
                num_kept.set(num_kept.get() + u32::from(q.keeps));
                if q.keeps { kept } else { pixels(alone)(q) }
            });
            let share = num_kept.get() as f32 / num.get() as f32;
            if kept < SLACK / 30.0 {
                assert_eq!(share, 1.0, "{alone} {kept}");
            } else {
                assert!(share < 0.02, "{alone} {kept}: {share}");
            }
            if alone < SLACK / 30.0 {
                assert!(scales.iter().all(|s| *s == 1.0), "{alone} {kept}: the picture was made smaller");
            }
            // At rest, too: the window would stand still as long.
            assert_eq!(control.quality(false), LADDER[usize::from(share < 1.0)]);
        }
    }

    /// Where there are no kept frames to cast, nothing is learnt of them, and a slow picture is made smaller all the
    /// same.
    #[test]
    fn without_kept_frames_the_picture_itself_counts() {
        let (mut control, mut now) = (QualityControl::new(30.0), Duration::ZERO);
        let mut cast = |control: &mut QualityControl, full: f32| {
            let quality = Quality { keeps: false, ..control.quality(true) };
            let time = Duration::from_secs_f32(pixels(full)(quality));
            now += time.max(Duration::from_millis(16));
            control.handle_cast(now, quality, time);
        };
        (0..100).for_each(|_| cast(&mut control, 0.03));
        assert_eq!(control.quality(true), Quality::FULL, "kept frames may come");
        (0..100).for_each(|_| cast(&mut control, 0.085));
        assert_eq!(control.quality(true).scale, 0.5);
        assert_eq!(control.quality(false), LADDER[ALONE]);
        (0..400).for_each(|_| cast(&mut control, 0.01));
        assert_eq!(control.quality(true), Quality::FULL);
    }

    #[test]
    fn a_camera_that_rests_is_shown_in_full_and_goes_on_as_before() {
        let (mut control, mut now) = (QualityControl::new(30.0), Duration::ZERO);
        run(&mut control, &mut now, 2.0, pixels(0.1));
        let moving = control.quality(true);
        assert!(moving.scale < 1.0);
        assert_eq!(control.quality(false), LADDER[ALONE]);
        control.handle_cast(now, LADDER[ALONE], Duration::from_millis(100));
        assert_eq!(control.quality(true), moving);
    }

    #[test]
    fn everything_comes_back_when_time_allows() {
        let (mut control, mut now) = (QualityControl::new(30.0), Duration::ZERO);
        run(&mut control, &mut now, 2.0, pixels(0.2));
        assert!(control.quality(true).scale < 0.5);
        run(&mut control, &mut now, 12.0, pixels(0.02));
        assert_eq!(control.quality(true), Quality::FULL);
    }

    /// A machine that can hold no rate at all gives up what brings it nearer, and only that.
    #[test]
    fn what_does_not_help_is_not_given_up() {
        let shares = |cost: &dyn Fn(Quality) -> f32, is_wanted: &dyn Fn(Quality) -> bool| {
            let (mut control, mut now) = (QualityControl::new(30.0), Duration::ZERO);
            run(&mut control, &mut now, 2.0, cost);
            let (wanted, all) = (std::cell::Cell::new(0), std::cell::Cell::new(0));
            run(&mut control, &mut now, 20.0, |q| {
                wanted.set(wanted.get() + u32::from(is_wanted(q)));
                all.set(all.get() + 1);
                cost(q)
            });
            f64::from(wanted.get()) / f64::from(all.get())
        };
        assert_eq!(shares(&pixels(2.0), &|q| q.scale == 0.25), 1.0);
        // Time that nothing changes: the picture is whole but for a few tries.
        let share = shares(&|_| 0.1, &|q| q == Quality::FULL);
        assert!(share > 0.8, "{share}");
    }
}
