//! Predicts the camera at the time when the frame that is requested now will be shown.
//!
//! A user turns the camera about the volume, shifts across it and moves closer. So a pose is split as the viewer's
//! controls do: into the rotation, and the eye's position relative to the volume's centre in view space. Both have a
//! velocity, fitted over recent samples and extrapolated until the frame is shown, with two corrections:
//! - A hand that slows down is about to stop: the speed keeps falling at its rate, but not below zero.
//! - Predictability depends on the hand and the delay. Each forecast is compared with its outcome. New ones are
//!   scaled by the factor, at most 1, that would have fitted the last second best (least squares). A steady turn has
//!   a factor of 1; forecasts no better than chance get 0, which means no prediction.
//!
//! A camera at rest is never moved: its pose is returned to the bit.

use std::collections::VecDeque;
use std::time::Duration;

use glam::{Quat, Vec3};

use crate::camera::Pose;

/// Predicts the pose of one camera. Call [`Predictor::observe`] for every displayed pose in order of time, and
/// [`Predictor::note_shown`] whenever a frame first appears on the screen.
#[derive(Clone, Debug, Default)]
pub struct Predictor {
    center: Vec3,
    samples: VecDeque<Observation>,
    moved_at: Duration,
    /// Sums over about a second of forecast · outcome and forecast · forecast, radians squared.
    agreement: f32,
    forecasts: f32,
    horizon: Horizon,
}

/// A displayed pose.
#[derive(Clone, Copy, Debug)]
struct Observation {
    at: Duration,
    pose: Pose,
    /// Eye minus centre, view space.
    place: Vec3,
    velocity: CameraMotion,
    /// The expected motion and its end time; `None` once it was scored.
    forecast: Option<(CameraMotion, Duration)>,
}

/// A turn about the view's own axes, radians, and a shift of the eye along them, in units of its distance from the
/// centre. Both are angles by which the volume's picture moves.
#[derive(Clone, Copy, Debug, Default)]
struct CameraMotion {
    turn: Vec3,
    shift: Vec3,
}

impl CameraMotion {
    fn plus(self, other: Self) -> Self {
        Self { turn: self.turn + other.turn, shift: self.shift + other.shift }
    }

    fn scaled(self, by: f32) -> Self {
        Self { turn: self.turn * by, shift: self.shift * by }
    }

    fn dot(self, other: Self) -> f32 {
        self.turn.dot(other.turn) + self.shift.dot(other.shift)
    }

    fn length(self) -> f32 {
        self.dot(self).sqrt()
    }
}

impl Predictor {
    /// The camera is now at `pose`; `center` is that of the volume.
    pub fn observe(&mut self, now: Duration, pose: Pose, center: Vec3) {
        let place = pose.world_from_view.inverse() * (pose.eye - center);
        let mut sample =
            Observation { at: now, pose, place, velocity: CameraMotion::default(), forecast: None };
        let is_same_hand = center == self.center
            && self
                .samples
                .back()
                .is_none_or(|last| now >= last.at && sample.motion_from(last).length() < JUMP);
        if !is_same_hand {
            // After another volume, a reset or a clock that ran backwards, older samples are meaningless.
            *self = Self { center, horizon: self.horizon, ..Self::default() };
        }
        if self.samples.back().is_none_or(|last| last.pose != pose) {
            self.moved_at = now;
        }
        self.score(&sample);
        self.samples.push_back(sample);
        while self.samples.len() > MAX_SAMPLES {
            self.samples.pop_front();
        }
        sample.velocity = self.velocity(&sample);
        let forecast = self.carried_on(&sample);
        sample.forecast = Some((forecast, now + self.horizon.length()));
        if let Some(last) = self.samples.back_mut() {
            *last = sample;
        }
    }

    /// A frame that was requested at `asked_at` is now on the screen for the first time.
    pub fn note_shown(&mut self, now: Duration, asked_at: Duration) {
        self.horizon.note(now, asked_at);
    }

    /// Time from the request for a frame to the middle of its display.
    pub fn horizon(&self) -> Duration {
        self.horizon.length()
    }

    /// Whether the camera was at rest when it was last observed.
    pub fn is_resting(&self) -> bool {
        self.samples.back().is_none_or(|last| last.at.saturating_sub(self.moved_at) >= STILL)
    }

    /// The pose to request: the predicted camera at the end of the horizon. `None` before the first observation.
    pub fn predict(&self) -> Option<Pose> {
        self.pose_after(self.gain())
    }

    /// The same as if no forecast had ever failed: how far the camera may get.
    pub fn reach(&self) -> Option<Pose> {
        self.pose_after(1.0)
    }

    fn pose_after(&self, gain: f32) -> Option<Pose> {
        let last = self.samples.back()?;
        let motion = last.forecast.map_or(CameraMotion::default(), |(motion, _)| motion.scaled(gain));
        if self.is_resting() || motion.length() == 0.0 {
            return Some(last.pose);
        }
        let world_from_view = (last.pose.world_from_view * Quat::from_scaled_axis(motion.turn)).normalize();
        let place = last.place + motion.shift * last.place.length();
        let pose = Pose { eye: self.center + world_from_view * place, world_from_view };
        Some(if pose.is_valid() { pose } else { last.pose })
    }

    /// The factor that would have fitted the forecasts of the last second best.
    fn gain(&self) -> f32 {
        ((self.agreement + PRIOR) / (self.forecasts + PRIOR)).clamp(0.0, 1.0)
    }

    /// Compares the forecasts that end now with the camera.
    fn score(&mut self, now: &Observation) {
        let Some(before) = self.samples.back().copied() else { return };
        let interval = now.at.saturating_sub(before.at).as_secs_f32();
        let keep = (-interval / MEMORY_SECONDS).exp();
        self.agreement *= keep;
        self.forecasts *= keep;
        for i in 0..self.samples.len() {
            let Some((forecast, due)) = self.samples[i].forecast.filter(|(_, due)| *due <= now.at) else {
                continue;
            };
            let began = self.samples[i];
            // Interpolates between the observations before and after its end.
            let after = (now.at - due).as_secs_f32() / interval.max(f32::MIN_POSITIVE);
            let (last, next) = (before.motion_from(&began), now.motion_from(&began));
            let outcome = last.scaled(after.min(1.0)).plus(next.scaled(1.0 - after.min(1.0)));
            // Weights do not depend on the rate of observations.
            let weight = interval.min(1.0 / PRIOR_RATE) * PRIOR_RATE;
            self.agreement += weight * forecast.dot(outcome);
            self.forecasts += weight * forecast.dot(forecast);
            self.samples[i].forecast = None;
        }
    }

    /// The velocity by least squares over the last [`WINDOW`], or over three observations if they are slow.
    fn velocity(&self, now: &Observation) -> CameraMotion {
        let recent = self.samples.iter().rev().enumerate().take_while(|(i, s)| {
            let age = now.at.saturating_sub(s.at);
            age <= WINDOW || (*i < 3 && age <= LONGEST_WINDOW)
        });
        let points: Vec<(f32, CameraMotion)> =
            recent.map(|(_, s)| (-now.at.saturating_sub(s.at).as_secs_f32(), s.motion_from(now))).collect();
        let mean = points.iter().map(|p| p.0).sum::<f32>() / points.len().max(1) as f32;
        let (mut sum, mut squares) = (CameraMotion::default(), 0.0);
        for (t, m) in &points {
            let dt = t - mean;
            sum = sum.plus(m.scaled(dt));
            squares += dt * dt;
        }
        if squares > 1e-9 { sum.scaled(1.0 / squares) } else { CameraMotion::default() }
    }

    /// The motion from `now` to the end of the horizon.
    fn carried_on(&self, now: &Observation) -> CameraMotion {
        let horizon = self.horizon.length().as_secs_f32();
        let speed = now.velocity.length();
        if speed == 0.0 {
            return CameraMotion::default();
        }
        let direction = now.velocity.scaled(1.0 / speed);
        let earlier = self.samples.iter().rev().find(|s| now.at.saturating_sub(s.at) >= SLOWING_OVER);
        let slowing = earlier
            .map_or(0.0, |e| (e.velocity.dot(direction) - speed) / now.at.saturating_sub(e.at).as_secs_f32());
        // A growing speed does not say how long it will go on growing.
        let slowing = slowing.max(0.0);
        let until = horizon.min(if slowing > 0.0 { speed / slowing } else { f32::INFINITY });
        let length = speed * until - 0.5 * slowing * until * until;
        direction.scaled(length.min(MAX_MOTION))
    }
}

impl Observation {
    /// The motion from `before` to here.
    fn motion_from(&self, before: &Self) -> CameraMotion {
        let turn = before.pose.world_from_view.inverse() * self.pose.world_from_view;
        // Of the two quaternions of a rotation, this is the shorter way.
        let turn = if turn.w < 0.0 { -turn } else { turn };
        let distance = before.place.length().max(f32::MIN_POSITIVE);
        CameraMotion { turn: turn.to_scaled_axis(), shift: (self.place - before.place) / distance }
    }
}

/// Time from a request to the screen, measured on one clock and smoothed.
#[derive(Clone, Copy, Debug, Default)]
struct Horizon {
    delay_seconds: Option<f32>,
    interval_seconds: Option<f32>,
    shown_at: Option<Duration>,
}

impl Horizon {
    fn note(&mut self, now: Duration, asked_at: Duration) {
        let smooth = |old: &mut Option<f32>, new: f32| {
            *old = Some(old.map_or(new, |old| old + (new - old) * SMOOTHING));
        };
        smooth(&mut self.delay_seconds, now.saturating_sub(asked_at).as_secs_f32().min(MAX_HORIZON_SECONDS));
        let interval = self.shown_at.map(|before| now.saturating_sub(before).as_secs_f32());
        // A longer pause is caused by the user and not by the server.
        if let Some(interval) = interval.filter(|i| *i < MAX_HORIZON_SECONDS) {
            smooth(&mut self.interval_seconds, interval);
        }
        self.shown_at = Some(now);
    }

    fn length(&self) -> Duration {
        let seconds = self.delay_seconds.unwrap_or(0.0) + 0.5 * self.interval_seconds.unwrap_or(0.0);
        Duration::from_secs_f32(seconds.min(MAX_HORIZON_SECONDS))
    }
}

/// Time over which velocities are fitted. On simulated drags, scrubs and turns 50 ms is 5 % better and 120 ms 5 %
/// worse in degrees; a real mouse is noisier.
const WINDOW: Duration = Duration::from_millis(80);
/// The same for a slow display.
const LONGEST_WINDOW: Duration = Duration::from_millis(250);
/// A slowing speed is compared with that of this time ago.
const SLOWING_OVER: Duration = Duration::from_millis(60);
/// A pose that stays for this time is at rest: two refreshes at 60 Hz and one at 30 Hz. Less would take a slow hand
/// for one at rest; more would request frames for poses that nobody sees.
pub const STILL: Duration = Duration::from_millis(24);
/// Memory of forecasts. Between half a second and two, errors differ by 1 %.
const MEMORY_SECONDS: f32 = 1.0;
/// Initial trust in forecasts, radians squared: that of one forecast of 10°.
const PRIOR: f32 = 0.03;
/// Rate of observations that the trust is based on, per second.
const PRIOR_RATE: f32 = 30.0;
/// Longest forecast, radians: 45°.
const MAX_MOTION: f32 = 0.785;
/// Longest horizon, s.
const MAX_HORIZON_SECONDS: f32 = 1.0;
/// Motion between refreshes that no hand makes, radians.
const JUMP: f32 = 0.6;
/// Weight of the newest measurement of a delay.
const SMOOTHING: f32 = 0.25;
/// Number of observations that are kept: two seconds' worth at 60 Hz, longer than any horizon.
const MAX_SAMPLES: usize = 128;

#[cfg(test)]
mod tests {
    use super::*;

    const CENTER: Vec3 = Vec3::new(1.0, -2.0, 0.5);

    fn orbit(azimuth_degrees: f32) -> Pose {
        Pose::orbit(CENTER, azimuth_degrees.to_radians(), 0.3, 4.0)
    }

    fn degrees(a: &Pose, b: &Pose) -> f32 {
        (a.eye - CENTER).angle_between(b.eye - CENTER).to_degrees()
    }

    /// Plays a path at 60 Hz with frames that are shown `delay` after their wish; the mean error in degrees of the
    /// poses asked for and of the poses at the time of asking, both against the pose at the time of showing, counted from
    /// second `from` to 8.
    fn play(path: impl Fn(f32) -> Pose, from: f32, delay: f32) -> (f32, f32) {
        let mut p = Predictor::default();
        let at = |s: f32| Duration::from_secs_f32(s);
        // 20 frames a second, each on the screen for 50 ms.
        p.note_shown(at(10.0), at(10.0 - delay));
        p.note_shown(at(10.05), at(10.05 - delay));
        let (mut asked, mut unpredicted, mut n) = (0.0, 0.0, 0);
        for i in 0..480 {
            let t = i as f32 / 60.0;
            p.observe(at(20.0 + t), path(t), CENTER);
            if t < from {
                continue;
            }
            let later = path(t + p.horizon().as_secs_f32());
            asked += degrees(&p.predict().unwrap(), &later);
            unpredicted += degrees(&path(t), &later);
            n += 1;
        }
        (asked / n as f32, unpredicted / n as f32)
    }

    #[test]
    fn steady_orbit_pan_and_zoom_are_foreseen() {
        let turning = |t: f32| orbit(40.0 * t);
        let panning = |t: f32| {
            let pose = orbit(10.0);
            Pose { eye: pose.eye + pose.world_from_view * Vec3::new(0.8 * t, -0.3 * t, 0.0), ..pose }
        };
        let zooming = |t: f32| Pose::orbit(CENTER, 0.2, 0.1, 5.0 - t);
        for path in [&turning as &dyn Fn(f32) -> Pose, &panning, &zooming] {
            let mut p = Predictor::default();
            let at = |s: f32| Duration::from_secs_f32(s);
            p.note_shown(at(1.0), at(0.7));
            for i in 0..90 {
                p.observe(at(5.0 + i as f32 / 60.0), path(i as f32 / 60.0), CENTER);
            }
            let (now, later) = (path(89.0 / 60.0), path(89.0 / 60.0 + 0.3));
            let foreseen = p.predict().unwrap();
            let error = (foreseen.eye - later.eye).length();
            // A hundredth of the way: the place is measured in units of a distance that changes with zooming.
            assert!(error < 0.01 * (now.eye - later.eye).length(), "{error}");
            assert!((now.eye - later.eye).length() > 0.1, "the path does move");
        }
    }

    #[test]
    fn a_resting_camera_is_asked_for_to_the_bit() {
        let mut p = Predictor::default();
        p.note_shown(Duration::from_secs(1), Duration::from_millis(700));
        let at = |i: u64| Duration::from_micros(2_000_000 + i * 16_667);
        for i in 0..60 {
            p.observe(at(i), orbit(i as f32), CENTER);
        }
        assert!(!p.is_resting() && degrees(&p.predict().unwrap(), &orbit(59.0)) > 5.0);
        // The first refresh that shows the same pose again may lie between two events of a slow hand.
        for i in 60..62 {
            p.observe(at(i), orbit(59.0), CENTER);
        }
        assert!(p.is_resting());
        assert_eq!(p.predict(), Some(orbit(59.0)));
        assert_eq!(p.reach(), Some(orbit(59.0)));
    }

    #[test]
    fn paths_of_a_hand_are_foreseen_in_part_and_never_at_a_loss() {
        let smooth_step = |s: f32| s * s * s * (10.0 - 15.0 * s + 6.0 * s * s);
        let drags = |t: f32| orbit(70.0 * (t.floor() + smooth_step((t.fract() / 0.7).min(1.0))));
        let circling = |t: f32| Pose::orbit(CENTER, 0.4 * (2.5 * t).sin(), 0.4 * (2.5 * t).cos(), 4.0);
        for (path, delay, gain) in [
            (&drags as &dyn Fn(f32) -> Pose, 0.1, 0.6),
            (&drags, 0.3, 0.95),
            (&drags, 0.6, 1.05),
            (&circling, 0.1, 0.3),
            (&circling, 0.3, 0.6),
            (&circling, 0.6, 0.95),
        ] {
            let (asked, unpredicted) = play(path, 0.0, delay);
            assert!(asked < unpredicted * gain, "{delay}: {asked} {unpredicted}");
        }
    }

    #[test]
    fn what_cannot_be_foreseen_is_not_asked_for() {
        // The hand shakes at 4 Hz, faster than any frame comes back.
        let shaking = |t: f32| orbit(15.0 * (t * 25.0).sin());
        for delay in [0.2, 0.3, 0.5] {
            // In the first second nothing is known of this hand.
            let (asked, unpredicted) = play(shaking, 1.0, delay);
            assert!(asked < unpredicted * 1.05, "{delay}: {asked} {unpredicted}");
        }
        // Without scoring the forecasts it would be far worse.
        let mut p = Predictor::default();
        p.note_shown(Duration::from_secs(1), Duration::from_millis(700));
        let (mut trusting, mut scored) = (0.0, 0.0);
        for i in 0..600 {
            let t = i as f32 / 60.0;
            p.observe(Duration::from_secs_f32(2.0 + t), shaking(t), CENTER);
            let later = shaking(t + 0.3);
            trusting += degrees(&p.reach().unwrap(), &later);
            scored += degrees(&p.predict().unwrap(), &later);
        }
        assert!(trusting > scored * 1.5, "{trusting} {scored}");
    }

    #[test]
    fn jumps_odd_clocks_and_odd_poses_are_survived() {
        let mut p = Predictor::default();
        assert_eq!(p.predict(), None);
        let ms = Duration::from_millis;
        p.note_shown(ms(5), ms(900));
        let odd = Pose { eye: Vec3::splat(f32::NAN), ..orbit(0.0) };
        let far = Pose { eye: Vec3::splat(1e15), ..orbit(0.0) };
        let poses =
            [orbit(0.0), orbit(1.0), orbit(180.0), far, orbit(2.0), Pose { eye: CENTER, ..orbit(3.0) }];
        for (i, pose) in poses.into_iter().cycle().take(50).enumerate() {
            p.observe(ms([10, 20, 20, 15, 1_000_000][i % 5] + i as u64), pose, CENTER);
            p.note_shown(ms(i as u64 * 7), ms(3));
            assert!(p.predict().unwrap().is_valid());
        }
        p.observe(ms(2_000_000), odd, CENTER);
        // A reset of the camera is no movement.
        p.observe(ms(2_000_010), orbit(0.0), CENTER);
        p.observe(ms(2_000_020), orbit(90.0), CENTER);
        assert_eq!(p.predict(), Some(orbit(90.0)));
    }
}
