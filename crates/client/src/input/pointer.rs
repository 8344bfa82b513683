//! From egui's events to [`ControlInput`].
//!
//! This reads the events themselves, not egui's summary of a refresh. So a drag that begins and ends between two slow
//! refreshes counts, and the wheel acts at once instead of over several refreshes.

use egui::{Event, MouseWheelUnit, PointerButton, Pos2, Rect};

use crate::input::bindings::{Bindings, Gesture};
use crate::input::camera_controls::{ControlInput, ZOOM_PER_HEIGHT, ZOOM_PER_NOTCH};

#[derive(Debug, Default)]
pub(crate) struct Pointer {
    position: Option<Pos2>,
    drag: Option<PointerDrag>,
    light: [f32; 2],
}

#[derive(Debug)]
struct PointerDrag {
    button: PointerButton,
    gesture: Gesture,
}

impl Pointer {
    /// What the events of a refresh mean for a picture in `rect`. `is_free`: no panel covers a point.
    pub(crate) fn control_input(
        &mut self,
        bindings: &Bindings,
        events: &[Event],
        rect: Rect,
        pixels_per_point: f32,
        is_free: impl Fn(Pos2) -> bool,
    ) -> ControlInput {
        let mut input = ControlInput::default();
        for event in events {
            match event {
                Event::PointerMoved(to) => self.move_to(*to, rect, pixels_per_point, &mut input),
                Event::PointerButton { pos, button, pressed, modifiers } => {
                    self.move_to(*pos, rect, pixels_per_point, &mut input);
                    if !pressed && self.drag.as_ref().is_some_and(|d| d.button == *button) {
                        self.drag = None;
                    } else if *pressed && self.drag.is_none() && rect.contains(*pos) && is_free(*pos) {
                        let Some(gesture) = bindings.gesture(*button, *modifiers) else { continue };
                        self.drag = Some(PointerDrag { button: *button, gesture });
                    }
                }
                // The system may never report the release.
                Event::WindowFocused(false) => self.drag = None,
                Event::MouseWheel { .. } | Event::Zoom(_) => {
                    let Some(at) = self.position.filter(|p| rect.contains(*p) && is_free(*p)) else {
                        continue;
                    };
                    let is_reversed = bindings.reverses_wheel && matches!(event, Event::MouseWheel { .. });
                    input.zoom += if is_reversed { -zoom_of(event) } else { zoom_of(event) };
                    input.zoom_at = ((at - rect.center()) * pixels_per_point).into();
                }
                _ => {}
            }
        }
        input
    }

    pub(crate) fn end_drag(&mut self) {
        self.drag = None;
    }

    /// The drag of the light since the last call, pixels; none if there was no drag.
    pub(crate) fn take_light_drag(&mut self) -> Option<[f32; 2]> {
        let drag = std::mem::take(&mut self.light);
        (drag != [0.0; 2]).then_some(drag)
    }

    fn move_to(&mut self, to: Pos2, rect: Rect, pixels_per_point: f32, input: &mut ControlInput) {
        let from = self.position.unwrap_or(to);
        let moved = (to - from) * pixels_per_point;
        self.position = Some(to);
        match self.drag.as_ref().map(|d| d.gesture) {
            Some(Gesture::Orbit) => input.orbit = [input.orbit[0] + moved.x, input.orbit[1] + moved.y],
            Some(Gesture::Roll) => input.roll += angle_around(rect.center(), from, to),
            Some(Gesture::Pan) => input.pan = [input.pan[0] + moved.x, input.pan[1] + moved.y],
            Some(Gesture::Zoom) => {
                input.zoom -= moved.y / (rect.height() * pixels_per_point).max(1.0) * ZOOM_PER_HEIGHT;
            }
            Some(Gesture::Light) => self.light = [self.light[0] + moved.x, self.light[1] + moved.y],
            None => {}
        }
    }
}

/// The angle from one point to another around `center`, radians, clockwise; y runs down.
fn angle_around(center: Pos2, from: Pos2, to: Pos2) -> f32 {
    let (a, b) = (from - center, to - center);
    // Near the centre the angle is arbitrary.
    if a.length().min(b.length()) < 4.0 {
        return 0.0;
    }
    (a.x * b.y - a.y * b.x).atan2(a.dot(b))
}

/// Notches of a wheel; touchpads count points.
pub(crate) fn notches_of(unit: MouseWheelUnit, delta: f32) -> f32 {
    match unit {
        MouseWheelUnit::Line => delta,
        MouseWheelUnit::Point => delta / POINTS_PER_NOTCH,
        MouseWheelUnit::Page => delta * NOTCHES_PER_PAGE,
    }
}

/// Natural logarithm of the magnification.
fn zoom_of(event: &Event) -> f32 {
    match event {
        Event::MouseWheel { unit, delta, .. } => notches_of(*unit, delta.y) * ZOOM_PER_NOTCH,
        Event::Zoom(factor) if *factor > 0.0 => factor.ln(),
        _ => 0.0,
    }
}

/// Touchpads scroll in points; this many feel like a notch of a wheel (egui's own line height for scrolling).
const POINTS_PER_NOTCH: f32 = 40.0;
/// A page is a large step: twice the size.
const NOTCHES_PER_PAGE: f32 = 5.0;

#[cfg(test)]
mod tests {
    use egui::{Modifiers, MouseWheelSource, TouchPhase, pos2, vec2};

    use super::*;

    fn button(x: f32, y: f32, button: PointerButton, pressed: bool, modifiers: Modifiers) -> Event {
        Event::PointerButton { pos: pos2(x, y), button, pressed, modifiers }
    }

    fn wheel(lines: f32) -> Event {
        Event::MouseWheel {
            unit: MouseWheelUnit::Line,
            delta: vec2(0.0, lines),
            phase: TouchPhase::Move,
            source: MouseWheelSource::Unknown,
            modifiers: Modifiers::NONE,
        }
    }

    fn rect() -> Rect {
        Rect::from_min_size(pos2(0.0, 0.0), vec2(200.0, 100.0))
    }

    /// Everything but a panel of 50×50 at the top left.
    fn is_free(p: Pos2) -> bool {
        p.x > 50.0 || p.y > 50.0
    }

    /// The drag 10 right, 20 down with a button, all in one refresh at two pixels a point.
    fn drag(with: PointerButton, modifiers: Modifiers) -> ControlInput {
        let events = [
            button(100.0, 50.0, with, true, modifiers),
            Event::PointerMoved(pos2(104.0, 60.0)),
            Event::PointerMoved(pos2(110.0, 70.0)),
            button(110.0, 70.0, with, false, modifiers),
            Event::PointerMoved(pos2(190.0, 90.0)),
        ];
        Pointer::default().control_input(&Bindings::default(), &events, rect(), 2.0, is_free)
    }

    #[test]
    fn each_button_has_its_action_in_pixels() {
        let none = ControlInput::default();
        let left = drag(PointerButton::Primary, Modifiers::NONE);
        assert_eq!(left, ControlInput { orbit: [20.0, 40.0], ..none });
        for pan in
            [drag(PointerButton::Middle, Modifiers::NONE), drag(PointerButton::Primary, Modifiers::SHIFT)]
        {
            assert_eq!(pan, ControlInput { pan: [20.0, 40.0], ..none });
        }
        let right = drag(PointerButton::Secondary, Modifiers::NONE);
        assert!((right.zoom + 0.2 * ZOOM_PER_HEIGHT).abs() < 1e-6, "down moves away: {right:?}");
        // From 50/-0 points right of the middle to 10/20: no button moves as much as this turns.
        let roll = drag(PointerButton::Primary, Modifiers::COMMAND);
        let expected: f32 = [(0.0f32, 0.0f32), (4.0, 10.0), (10.0, 20.0)]
            .windows(2)
            .map(|w| if w[0] == (0.0, 0.0) { 0.0 } else { w[1].1.atan2(w[1].0) - w[0].1.atan2(w[0].0) })
            .sum();
        assert!((roll.roll - expected).abs() < 1e-6 && roll.orbit == [0.0; 2], "{roll:?} {expected}");
        assert!(drag(PointerButton::Extra1, Modifiers::NONE).is_idle());
    }

    #[test]
    fn a_drag_goes_on_over_refreshes_and_beyond_the_picture_until_its_own_release() {
        let mut pointer = Pointer::default();
        let mut step =
            |events: &[Event]| pointer.control_input(&Bindings::default(), events, rect(), 1.0, is_free);
        let none = Modifiers::NONE;
        assert!(step(&[button(100.0, 50.0, PointerButton::Primary, true, none)]).is_idle());
        assert_eq!(step(&[Event::PointerMoved(pos2(10.0, 10.0))]).orbit, [-90.0, -40.0]);
        assert_eq!(step(&[Event::PointerMoved(pos2(-30.0, 10.0))]).orbit, [-40.0, 0.0]);
        assert!(step(&[button(-30.0, 10.0, PointerButton::Secondary, true, none)]).is_idle());
        assert!(step(&[button(-30.0, 10.0, PointerButton::Secondary, false, none)]).is_idle());
        assert_eq!(step(&[Event::PointerMoved(pos2(-30.0, 11.0))]).orbit, [0.0, 1.0]);
        assert!(step(&[button(-30.0, 11.0, PointerButton::Primary, false, none)]).is_idle());
        assert!(step(&[Event::PointerMoved(pos2(100.0, 50.0))]).is_idle());
    }

    #[test]
    fn the_light_is_dragged_and_the_camera_stays() {
        let mut pointer = Pointer::default();
        let events = [
            button(100.0, 50.0, PointerButton::Secondary, true, Modifiers::COMMAND),
            Event::PointerMoved(pos2(110.0, 45.0)),
        ];
        let bindings = Bindings::default();
        assert!(pointer.control_input(&bindings, &events, rect(), 2.0, is_free).is_idle());
        assert_eq!(pointer.take_light_drag(), Some([20.0, -10.0]));
        assert_eq!(pointer.take_light_drag(), None);
    }

    #[test]
    fn panels_keep_their_presses_and_their_wheel() {
        let mut pointer = Pointer::default();
        let events = [
            button(10.0, 10.0, PointerButton::Primary, true, Modifiers::NONE),
            wheel(1.0),
            Event::PointerMoved(pos2(100.0, 80.0)),
        ];
        assert!(pointer.control_input(&Bindings::default(), &events, rect(), 1.0, is_free).is_idle());
    }

    #[test]
    fn the_wheel_zooms_at_the_pointer() {
        let events = [Event::PointerMoved(pos2(150.0, 30.0)), wheel(2.0), Event::Zoom(2.0)];
        let input = Pointer::default().control_input(&Bindings::default(), &events, rect(), 2.0, is_free);
        assert!((input.zoom - 2.0 * ZOOM_PER_NOTCH - 2f32.ln()).abs() < 1e-6);
        assert_eq!(input.zoom_at, [100.0, -40.0]);
        let mut reversed = Bindings::default();
        reversed.set(crate::input::bindings::REVERSE_WHEEL, &["true".into()]).unwrap();
        let input = Pointer::default().control_input(&reversed, &events, rect(), 2.0, is_free);
        assert!((input.zoom + 2.0 * ZOOM_PER_NOTCH - 2f32.ln()).abs() < 1e-6, "but pinching stays");
        let mut never_seen = Pointer::default();
        assert!(
            never_seen.control_input(&Bindings::default(), &[wheel(1.0)], rect(), 1.0, is_free).is_idle()
        );
    }
}
