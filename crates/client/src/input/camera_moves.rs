//! Moves of the camera by choice: a short turn to a chosen view, and the way back to views before it.
//!
//! One entry of the history is one gesture: a drag, a chosen view, or movements by wheel and keys without a pause.

use std::time::Duration;

use glam::{Quat, Vec3};

use super::camera_controls::CameraControls;

/// Where the camera is, as its controls keep it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Viewpoint {
    /// What the camera turns about, world space.
    pub(crate) center: Vec3,
    pub(crate) world_from_view: Quat,
    /// View space.
    pub(crate) eye_from_center: Vec3,
    /// Whether its rays are parallel.
    pub(crate) is_orthographic: bool,
}

impl Viewpoint {
    pub(crate) fn of(controls: &CameraControls, is_orthographic: bool) -> Self {
        let (world_from_view, eye_from_center) = controls.placement();
        Self { center: controls.center(), world_from_view, eye_from_center, is_orthographic }
    }

    /// Moves the camera here. Returns whether the controls can reach it.
    pub(crate) fn place(&self, controls: &mut CameraControls) -> bool {
        controls.place(self.center, (self.world_from_view, self.eye_from_center))
    }

    /// The view at the share `t` of the way to another.
    fn toward(&self, to: &Self, t: f32) -> Self {
        let depth = self.eye_from_center.z * (to.eye_from_center.z / self.eye_from_center.z).powf(t);
        Self {
            center: self.center.lerp(to.center, t),
            world_from_view: self.world_from_view.slerp(to.world_from_view, t).normalize(),
            eye_from_center: self.eye_from_center.lerp(to.eye_from_center, t).with_z(depth),
            is_orthographic: to.is_orthographic,
        }
    }
}

/// The history of the camera, and the turn in progress.
#[derive(Debug, Default)]
pub(crate) struct CameraMoves {
    travel: Option<Travel>,
    past: Vec<Viewpoint>,
    future: Vec<Viewpoint>,
    /// Where the newest gesture of the history ended.
    last: Option<Viewpoint>,
    /// The view of the refresh before, and when it changed.
    seen: Option<(Viewpoint, Duration)>,
    /// Whether a drag went on then.
    was_held: bool,
}

#[derive(Clone, Copy, Debug)]
struct Travel {
    from: Viewpoint,
    to: Viewpoint,
    began: Duration,
}

impl CameraMoves {
    /// Forgets everything: the views were those of another volume.
    pub(crate) fn clear(&mut self) {
        *self = Self::default();
    }

    /// Stays where the camera is.
    pub(crate) fn stop(&mut self) {
        self.travel = None;
    }

    /// Turns to a view that was chosen.
    pub(crate) fn turn(&mut self, now: Duration, from: Viewpoint, to: Viewpoint) {
        if self.travel.is_none() {
            self.note(from);
        }
        self.note(to);
        self.travel = Some(Travel { from, to, began: now });
    }

    /// Turns to the view before the newest gesture, or on to the one after. Returns that view.
    pub(crate) fn step(&mut self, now: Duration, from: Viewpoint, is_back: bool) -> Option<Viewpoint> {
        if self.travel.is_none() {
            self.note(from);
        }
        let (taken, kept) = match is_back {
            true => (&mut self.past, &mut self.future),
            false => (&mut self.future, &mut self.past),
        };
        let (to, last) = taken.pop().zip(self.last)?;
        kept.push(last);
        self.last = Some(to);
        self.travel = Some(Travel { from, to, began: now });
        Some(to)
    }

    /// Moves the camera on its way to a chosen view, unless the hand has taken it. `is_held`: a drag goes on.
    /// Returns whether the camera is on its way.
    pub(crate) fn follow(
        &mut self,
        now: Duration,
        (controls, is_orthographic): (&mut CameraControls, bool),
        is_by_hand: bool,
        is_held: bool,
    ) -> bool {
        let was_turning = self.travel.is_some();
        self.travel.take_if(|_| is_by_hand);
        if let Some(Travel { from, to, began }) = self.travel {
            let t = now.saturating_sub(began).as_secs_f32() / TRAVEL_TIME.as_secs_f32();
            let is_there = t >= 1.0;
            // Slow at both ends.
            let view = if is_there { to } else { from.toward(&to, t * t * (3.0 - 2.0 * t)) };
            if is_there || !view.place(controls) {
                to.place(controls);
                self.travel = None;
            }
        }
        let present = Viewpoint::of(controls, is_orthographic);
        if self.seen.is_none_or(|(seen, _)| seen != present) {
            // The display may have slept through the pause after the gesture before.
            let before = self.seen.replace((present, now)).filter(|_| !was_turning && !self.was_held);
            if let Some((before, _)) = before.filter(|(_, since)| now >= *since + PAUSE) {
                self.note(before);
            }
        }
        self.was_held = is_held;
        let is_quiet = self.seen.is_some_and(|(_, since)| now >= since + PAUSE);
        if self.last.is_none() || (self.travel.is_none() && is_quiet && !is_held) {
            self.note(present);
        }
        self.travel.is_some()
    }

    /// Adds the end of a gesture to the history.
    fn note(&mut self, view: Viewpoint) {
        if self.last == Some(view) {
            return;
        }
        if let Some(before) = self.last.replace(view) {
            if self.past.len() >= MAX_PAST {
                self.past.remove(0);
            }
            self.past.push(before);
            self.future.clear();
        }
    }
}

/// How long a turn to a chosen view takes.
const TRAVEL_TIME: Duration = Duration::from_millis(250);
/// Movements with a longer pause between them are two gestures.
const PAUSE: Duration = Duration::from_millis(400);
const MAX_PAST: usize = 100;

#[cfg(test)]
mod tests {
    use isinglass_core::camera::Intrinsics;
    use isinglass_core::space::Aabb;

    use super::super::camera_controls::InitialOrbit;
    use super::*;

    const PICTURE: Intrinsics = Intrinsics::perspective(640, 400, 0.7);

    struct Stage {
        moves: CameraMoves,
        controls: CameraControls,
        now: Duration,
    }

    impl Stage {
        fn new() -> Self {
            let bounds = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };
            let controls = CameraControls::new(InitialOrbit::default(), Quat::IDENTITY, &bounds, &PICTURE);
            let mut stage = Self { moves: CameraMoves::default(), controls, now: Duration::ZERO };
            stage.rest(1);
            stage
        }

        fn view(&self) -> Viewpoint {
            Viewpoint::of(&self.controls, false)
        }

        /// Refreshes of a display at 60 Hz.
        fn rest(&mut self, number: u32) {
            for _ in 0..number {
                self.now += Duration::from_micros(16_667);
                self.moves.follow(self.now, (&mut self.controls, false), false, false);
            }
        }

        fn drag(&mut self, x: f32) {
            for _ in 0..6 {
                self.now += Duration::from_micros(16_667);
                self.controls.orbit([x, 3.0], &PICTURE);
                self.moves.follow(self.now, (&mut self.controls, false), true, true);
            }
        }

        /// A notch of the wheel or a key, with one refresh.
        fn notch(&mut self, x: f32) {
            self.controls.orbit([x, 0.0], &PICTURE);
            self.moves.follow(self.now, (&mut self.controls, false), true, false);
        }

        fn step(&mut self, is_back: bool) {
            self.moves.step(self.now, self.view(), is_back);
        }
    }

    #[test]
    fn one_gesture_is_one_entry_and_both_ways_lead_to_the_bit() {
        let mut s = Stage::new();
        let mut views = vec![s.view()];
        for x in [10.0, -20.0, 33.0] {
            s.drag(x);
            s.rest(40);
            views.push(s.view());
        }
        assert_eq!(s.moves.past.len(), 3, "one entry a gesture");
        for wanted in [2, 1, 0, 0] {
            s.step(true);
            s.rest(20);
            assert_eq!(s.view(), views[wanted]);
        }
        for wanted in [1, 2, 3, 3] {
            s.step(false);
            s.rest(20);
            assert_eq!(s.view(), views[wanted]);
        }
        s.step(true);
        s.rest(20);
        assert!(!s.moves.future.is_empty());
        s.drag(5.0);
        s.rest(40);
        assert!(s.moves.future.is_empty(), "what comes after a new gesture is gone");
    }

    #[test]
    fn a_gesture_that_has_just_ended_is_undone_too() {
        let mut s = Stage::new();
        let first = s.view();
        s.drag(10.0);
        s.step(true);
        s.rest(20);
        assert_eq!(s.view(), first);
        // Control: without a gesture there is nothing to undo.
        let mut still = Stage::new();
        still.rest(60);
        assert!(still.moves.past.is_empty() && still.moves.future.is_empty());
    }

    #[test]
    fn a_pause_without_a_refresh_parts_two_gestures() {
        for (pause, entries) in [(PAUSE * 3, 2), (PAUSE / 3, 1)] {
            let mut s = Stage::new();
            s.rest(60);
            s.notch(10.0);
            let between = s.view();
            // Nothing happens, so the display sleeps.
            s.now += pause;
            s.notch(20.0);
            s.rest(60);
            assert_eq!(s.moves.past.len(), entries, "{pause:?}");
            s.step(true);
            s.rest(20);
            assert_eq!(s.view() == between, entries == 2);
        }
        // A drag that rests for a while is one gesture, and a turn to a chosen view is another.
        let mut s = Stage::new();
        s.rest(60);
        s.drag(5.0);
        s.now += PAUSE * 3;
        s.drag(5.0);
        s.now += PAUSE * 3;
        let mut target = s.controls.clone();
        target.look_from(Vec3::X, Vec3::Y);
        s.moves.turn(s.now, s.view(), Viewpoint::of(&target, false));
        s.rest(60);
        assert_eq!(s.moves.past.len(), 2, "{:?}", s.moves.past);
    }

    #[test]
    fn a_turn_goes_smoothly_to_its_end_and_the_hand_stops_it() {
        let mut s = Stage::new();
        let first = s.view();
        let mut target = s.controls.clone();
        target.look_from(Vec3::X, Vec3::Y);
        let to = Viewpoint::of(&target, false);
        s.moves.turn(s.now, first, to);
        let mut left = first.world_from_view.angle_between(to.world_from_view);
        let whole = left;
        for i in 0..14 {
            s.rest(1);
            let now = s.view().world_from_view.angle_between(to.world_from_view);
            assert!(left - now < 0.2 * whole && now <= left + 1e-3, "no jump: {left} {now} at {i}");
            left = now;
        }
        s.rest(2);
        assert_eq!(s.view(), to);
        // The hand takes the camera where it is.
        s.moves.turn(s.now, s.view(), first);
        s.rest(5);
        let on_the_way = s.view();
        s.drag(1.0);
        s.rest(60);
        let moved = s.view().world_from_view.angle_between(on_the_way.world_from_view);
        assert!(moved > 0.0 && moved < 0.2 && s.view() != first, "{moved}");
    }
}
