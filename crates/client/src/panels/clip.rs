//! Numbers for the clip box and plane.

use egui::Ui;
use glam::Vec3;
use isinglass_core::clip::{Clip, Plane};
use isinglass_core::space::Aabb;

use super::controls::{self, row, slider};
use super::text::format_in;
use crate::input::bindings::{Action, Bindings};
use crate::paint::clip_editor::{ClipEditor, LEAST_SIDE, offsets};

/// Shows and changes the clip of a volume in `bounds`. `unit` is the unit of length, if known; `forward` the viewing
/// direction.
pub(crate) fn show(
    ui: &mut Ui,
    clip: &mut Clip,
    editor: &mut ClipEditor,
    bounds: &Aabb,
    unit: Option<&str>,
    forward: Vec3,
    bindings: &Bindings,
) {
    let suffix = unit.map_or(String::new(), |unit| format!(" {unit}"));
    ui.horizontal(|ui| {
        let mut has_box = clip.bounds.is_some();
        if controls::checkbox(ui, &mut has_box, "clip box").changed() {
            editor.toggle_box(clip, bounds);
        }
        let mut has_plane = clip.plane.is_some();
        if controls::checkbox(ui, &mut has_plane, "clip plane").changed() {
            editor.toggle_plane(clip, bounds, forward);
        }
        controls::checkbox(ui, &mut editor.is_shown, bindings.with_key("handles", Action::Clip));
    });
    ui.vertical(|ui| {
        if let Some(inner) = &mut clip.bounds {
            box_rows(ui, inner, bounds, &suffix);
        }
        if let Some(plane) = &mut clip.plane {
            let [least, most] = offsets(bounds, plane.normal);
            row(ui, "plane at", "along its normal, from the middle of the volume", |ui| {
                let slider = slider(ui, &mut plane.offset, least..=most, |v| format_in(v, most - least));
                ui.add(slider.suffix(&suffix))
            });
        }
    });
    ui.horizontal(|ui| {
        if let Some(plane) = &mut clip.plane {
            if ui.button("flip").on_hover_text("show the other side of the plane").clicked() {
                *plane = plane.flipped();
            }
            let hint = "turn the plane across the view, through where it is";
            if ui.button("face the view").on_hover_text(hint).clicked() {
                let middle = bounds.center() - plane.normal * plane.distance(bounds.center());
                *plane = Plane::new(forward, forward.dot(middle)).unwrap_or(*plane);
            }
        }
        let is_clipped = clip.bounds.is_some_and(|b| b != *bounds) || clip.plane.is_some();
        if ui.add_enabled(is_clipped, egui::Button::new("show all")).clicked() {
            *clip = Clip { bounds: clip.bounds.map(|_| *bounds), plane: None };
        }
    });
}

/// Six ends, each bounded by the opposite one.
fn box_rows(ui: &mut Ui, inner: &mut Aabb, bounds: &Aabb, suffix: &str) {
    let names = ["x from", "x to", "y from", "y to", "z from", "z to"];
    for (i, name) in names.into_iter().enumerate() {
        let (axis, is_high) = (i / 2, i % 2 == 1);
        let (least, most) = (bounds.min[axis], bounds.max[axis]);
        row(ui, name, "in the unit of the spacing, from the middle of the volume", |ui| {
            let mut end = if is_high { inner.max[axis] } else { inner.min[axis] };
            let slider = slider(ui, &mut end, least..=most, |v| format_in(v, most - least));
            let slider = ui.add(slider.suffix(suffix));
            // A thinner box came from elsewhere, and stays.
            if slider.changed() {
                let gap = (most - least) * LEAST_SIDE;
                match is_high {
                    true => inner.max[axis] = end.max(inner.min[axis] + gap),
                    false => inner.min[axis] = end.min(inner.max[axis] - gap),
                }
            }
            slider
        });
    }
}
