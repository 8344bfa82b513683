//! From egui's events to [`ControlInput`].

use egui::{Key, MouseWheelUnit, PointerButton, Response};
use isinglass_core::camera::Intrinsics;

use crate::camera_controls::{ControlInput, ZOOM_PER_HEIGHT, ZOOM_PER_NOTCH};

/// What the pointer did over the picture since the last refresh.
pub(crate) fn control_input(response: &Response, picture: &Intrinsics, keys_are_free: bool) -> ControlInput {
    let ctx = &response.ctx;
    let mut input = ControlInput::default();
    let pixels_per_point = ctx.pixels_per_point();
    let moved = response.drag_delta() * pixels_per_point;
    let shift = ctx.input(|i| i.modifiers.shift);
    if response.dragged_by(PointerButton::Middle) || response.dragged_by(PointerButton::Primary) && shift {
        input.pan = moved.into();
    } else if response.dragged_by(PointerButton::Primary) {
        input.orbit = moved.into();
    } else if response.dragged_by(PointerButton::Secondary) {
        input.zoom -= moved.y / picture.height.max(1) as f32 * ZOOM_PER_HEIGHT;
    }
    // The wheel's own events, not egui's smoothed scrolling: that would answer several refreshes late.
    if let Some(position) = response.hover_pos().filter(|_| response.contains_pointer()) {
        let zoom: f32 = ctx.input(|i| {
            let one = |event: &egui::Event| match event {
                egui::Event::MouseWheel { unit, delta, .. } => {
                    let notches = match unit {
                        MouseWheelUnit::Line => delta.y,
                        MouseWheelUnit::Point => delta.y / POINTS_PER_NOTCH,
                        MouseWheelUnit::Page => delta.y * NOTCHES_PER_PAGE,
                    };
                    notches * ZOOM_PER_NOTCH
                }
                egui::Event::Zoom(factor) if *factor > 0.0 => factor.ln(),
                _ => 0.0,
            };
            i.events.iter().map(one).sum()
        });
        if zoom != 0.0 {
            input.zoom += zoom;
            input.zoom_at = ((position - response.rect.center()) * pixels_per_point).into();
        }
    }
    input.reset = keys_are_free && ctx.input(|i| i.modifiers.is_none() && i.key_pressed(Key::R));
    input
}

/// Touch pads scroll in points; about so many feel like a notch of a wheel (egui's own line height for scrolling).
const POINTS_PER_NOTCH: f32 = 40.0;
/// A page is a bold step: twice the size.
const NOTCHES_PER_PAGE: f32 = 5.0;
