//! The row of colour stops below the strip of colours.

use egui::{
    EventFilter, Key, Modifiers, PointerButton, Pos2, Rect, Response, Role, Sense, Shape, Stroke, Ui,
    WidgetInfo, pos2, vec2,
};
use isinglass_formats::ColorMap;

use super::plot::{Axes, GRIP_RADIUS, GripKind, Ink, KEY_STEP, color32};
use super::{Selected, TransferEditor};
use crate::panels::text::format_in;

impl TransferEditor {
    pub(super) fn press_stops(&mut self, pos: Pos2, button: PointerButton, row: Axes) {
        let near = self.stop_near(pos, row);
        match (button, near) {
            (PointerButton::Middle, Some(index)) => self.remove_stop(index),
            (PointerButton::Primary, Some(index)) => {
                self.selected = Some(Selected::Stop(index));
                self.hold(GripKind::Stop(index), button, pos);
            }
            (PointerButton::Primary, None) => self.add_stop_at(row.value(pos.x), Some((button, pos))),
            _ => {}
        }
    }

    fn add_stop_at(&mut self, value: f32, held: Option<(PointerButton, Pos2)>) {
        let Some((curve, index)) = self.curve.with_stop(value) else {
            return self.tell_full();
        };
        self.change(curve);
        self.selected = Some(Selected::Stop(index));
        if let Some((button, pos)) = held {
            self.hold(GripKind::Stop(index), button, pos);
        }
    }

    pub(super) fn remove_stop(&mut self, index: usize) {
        if let Some(curve) = self.curve.without_stop(index) {
            self.selected = match self.selected {
                Some(Selected::Stop(s)) if s == index => None,
                Some(Selected::Stop(s)) if s > index => Some(Selected::Stop(s - 1)),
                other => other,
            };
            self.change(curve);
        }
    }

    fn stop_near(&self, pos: Pos2, row: Axes) -> Option<usize> {
        let distance = |i: usize| (row.x(self.curve.stop_value(i)) - pos.x).abs();
        let is_other = |i: usize| self.selected != Some(Selected::Stop(i));
        let nearest = (0..self.curve.marks.stops.len()).min_by(|&a, &b| {
            let own = |i| (distance(i), is_other(i), std::cmp::Reverse(i));
            own(a).partial_cmp(&own(b)).unwrap_or(std::cmp::Ordering::Equal)
        })?;
        (distance(nearest) <= GRIP_RADIUS).then_some(nearest)
    }

    /// Left and right choose a stop, and move it with shift.
    pub(super) fn stops_keyboard(&mut self, ui: &Ui, row: Axes, response: &Response) {
        if !response.has_focus() {
            return;
        }
        let of = |selected| if let Some(Selected::Stop(i)) = selected { Some(i) } else { None };
        let escape = of(self.selected).is_some();
        let filter = EventFilter { horizontal_arrows: true, escape, ..Default::default() };
        ui.memory_mut(|m| m.set_focus_lock_filter(response.id, filter));
        let pressed = |modifiers, key| ui.input_mut(|i| i.consume_key(modifiers, key));
        let last = self.curve.marks.stops.len() - 1;
        for (key, sign) in [(Key::ArrowLeft, -1.0), (Key::ArrowRight, 1.0)] {
            if pressed(Modifiers::SHIFT, key) {
                if let Some(i) = of(self.selected) {
                    let value = self.curve.stop_value(i) + sign * row.span() * KEY_STEP;
                    self.change(self.curve.with_stop_at(i, value));
                }
            } else if pressed(Modifiers::NONE, key) {
                let next = match (of(self.selected), sign > 0.0) {
                    (None, true) => 0,
                    (None, false) => last,
                    (Some(i), true) => (i + 1).min(last),
                    (Some(i), false) => i.saturating_sub(1),
                };
                self.selected = Some(Selected::Stop(next));
            }
        }
        if (pressed(Modifiers::NONE, Key::Delete) || pressed(Modifiers::NONE, Key::Backspace))
            && let Some(i) = of(self.selected)
        {
            self.remove_stop(i);
        }
        if pressed(Modifiers::NONE, Key::Insert) || pressed(Modifiers::NONE, Key::Enter) {
            let value = |i: usize| self.curve.stop_value(i);
            let between = match of(self.selected) {
                Some(i) if i < last => 0.5 * (value(i) + value(i + 1)),
                Some(i) => 0.5 * (value(i) + row.view.1.max(value(i))),
                None => 0.5 * (row.view.0 + row.view.1),
            };
            self.add_stop_at(between, None);
        }
        if escape && pressed(Modifiers::NONE, Key::Escape) {
            self.selected = None;
        }
    }

    /// Draws the stops as arrows that point at the strip, and names each for screen readers and tests.
    pub(super) fn draw_stops(&self, ui: &Ui, row: Axes, response: &Response) {
        let ink = Ink::of(ui);
        let painter = ui.painter().with_clip_rect(response.rect.intersect(ui.clip_rect()));
        response.widget_info(|| WidgetInfo::labeled(Role::Canvas, true, "colour stops"));
        let window = self.curve.level_and_window().1;
        let count = self.curve.marks.stops.len();
        for (index, stop) in self.curve.marks.stops.iter().enumerate() {
            let is_selected = self.selected == Some(Selected::Stop(index));
            let tip = pos2(row.x(self.curve.stop_value(index)), row.rect.top() + 1.0);
            let corner = |x: f32, y: f32| tip + vec2(x, y);
            let outline = vec![
                tip,
                corner(HALF, HALF),
                corner(HALF, STOPS_HEIGHT - 3.0),
                corner(-HALF, STOPS_HEIGHT - 3.0),
                corner(-HALF, HALF),
            ];
            let pen = if is_selected { Stroke::new(2.0, ink.selection) } else { Stroke::new(1.0, ink.curve) };
            let color = color32(self.curve.tone.of_color(stop.is));
            painter.add(Shape::convex_polygon(outline, color, pen));
            let rect =
                Rect::from_center_size(tip + vec2(0.0, 0.5 * STOPS_HEIGHT), vec2(2.0 * HALF, STOPS_HEIGHT));
            let handle = ui.interact(rect, response.id.with(("stop", index)), Sense::hover());
            let value = format_in(self.curve.stop_value(index), window);
            let label = format!("stop {} of {count}: value {value}", index + 1);
            handle.widget_info(|| WidgetInfo::selected(Role::ListBoxOption, true, is_selected, &label));
        }
        if response.has_focus() {
            let frame = Stroke::new(1.5, ink.selection);
            painter.rect_stroke(response.rect, 2.0, frame, egui::StrokeKind::Inside);
        }
    }
}

pub(super) const STOPS_HEIGHT: f32 = 14.0;

/// A colour map in a list: its colours and its name. Returns whether it was clicked.
pub(super) fn map_label(ui: &mut Ui, map: &ColorMap) -> bool {
    let is_clicked = ui.horizontal(|ui| {
        let (rect, _) = ui.allocate_exact_size(vec2(56.0, 12.0), Sense::hover());
        for i in 0..28 {
            let left = rect.left() + i as f32 * 2.0;
            let column = Rect::from_x_y_ranges(left..=left + 2.0, rect.y_range());
            ui.painter().rect_filled(column, 0.0, color32(map.at(i as f32 / 27.0)));
        }
        ui.selectable_label(false, map.name()).clicked()
    });
    is_clicked.inner
}

/// Half the width of a stop, points.
const HALF: f32 = 4.5;
