//! The curve over the histogram, and below it the strip of its colours, which sets window and level.
//! Colour stops lie below the strip, see `stops`.

use egui::{
    Color32, Event, EventFilter, Key, Mesh, Modifiers, PointerButton, Pos2, Rect, Response, Role, Sense,
    Shape, Stroke, StrokeKind, Ui, WidgetInfo, pos2, vec2,
};

use super::curve::{Curve, height_of, opacity_at};
use super::stops::STOPS_HEIGHT;
use super::{Selected, TransferEditor};
use crate::input::pointer::notches_of;
use crate::panels::style::accent;
use crate::panels::text::{format_in, format_value};
use crate::panels::value_scale::ValueScale;

#[derive(Clone, Debug)]
pub(super) struct Grip {
    kind: GripKind,
    button: PointerButton,
    from: Pos2,
    before: Curve,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum GripKind {
    Point(usize),
    Stop(usize),
    Window,
    LowEnd,
    HighEnd,
}

/// A rectangle with values across and opacities upwards.
#[derive(Clone, Copy)]
pub(super) struct Axes {
    pub(super) rect: Rect,
    pub(super) view: (f32, f32),
}

impl Axes {
    pub(super) fn x(&self, value: f32) -> f32 {
        let t = (value - self.view.0) / (self.view.1 - self.view.0);
        // Values far outside are clamped to keep the numbers small.
        self.rect.left() + self.rect.width() * t.clamp(-10.0, 10.0)
    }

    pub(super) fn span(&self) -> f32 {
        self.view.1 - self.view.0
    }

    pub(super) fn value(&self, x: f32) -> f32 {
        self.view.0 + (self.view.1 - self.view.0) * ((x - self.rect.left()) / self.rect.width())
    }

    fn y(&self, opacity: f32) -> f32 {
        self.rect.bottom() - self.rect.height() * height_of(opacity)
    }

    fn opacity(&self, y: f32) -> f32 {
        opacity_at((self.rect.bottom() - y) / self.rect.height())
    }

    fn point(&self, curve: &Curve, index: usize) -> Pos2 {
        pos2(self.x(curve.value(index)), self.y(curve.opacity(index)))
    }
}

impl TransferEditor {
    /// Draws plot and strip over the whole width, and handles pointer and keys.
    pub(super) fn plot(&mut self, ui: &mut Ui, scale: &ValueScale) {
        let view = self.view(scale);
        let width = ui.available_width();
        let (outer, response) = ui.allocate_exact_size(vec2(width, PLOT_HEIGHT), Sense::click_and_drag());
        // Room for half a point at each side.
        let plot = Axes { rect: outer.shrink2(vec2(POINT_RADIUS + 1.0, POINT_RADIUS)), view };
        let (bar, bar_response) = ui.allocate_exact_size(vec2(width, STRIP_HEIGHT), Sense::click_and_drag());
        let strip = Axes { rect: bar.shrink2(vec2(POINT_RADIUS + 1.0, 0.0)), view };
        let (below, stops_response) =
            ui.allocate_exact_size(vec2(width, STOPS_HEIGHT), Sense::click_and_drag());
        let stops = Axes { rect: below.shrink2(vec2(POINT_RADIUS + 1.0, 0.0)), view };
        self.pointer(ui, scale, plot, [&response, &bar_response, &stops_response], strip);
        self.wheel(ui, scale, plot, outer.union(bar));
        self.keyboard(ui, plot, &response);
        self.stops_keyboard(ui, stops, &stops_response);
        self.strip_keyboard(ui, scale, plot, &bar_response);
        self.draw_plot(ui, scale, plot, outer, response.has_focus());
        self.draw_strip(ui, strip, bar, bar_response.has_focus());
        self.draw_stops(ui, stops, &stops_response);
        self.draw_axis(ui, plot);
        self.describe(ui, plot, &response, &bar_response);
        self.hover_text(ui, scale, plot, outer);
    }

    fn pointer(
        &mut self,
        ui: &Ui,
        scale: &ValueScale,
        plot: Axes,
        [response, strip_response, stops_response]: [&Response; 3],
        strip: Axes,
    ) {
        let is_ours =
            |at: Pos2| ui.ctx().layer_id_at(at) == Some(ui.layer_id()) && ui.clip_rect().contains(at);
        for event in ui.input(|i| i.events.clone()) {
            match event {
                Event::PointerButton { pos, button, pressed: true, modifiers } if is_ours(pos) => {
                    if self.grip.is_some() {
                        continue;
                    }
                    if response.rect.contains(pos) {
                        response.request_focus();
                        self.press_plot(pos, button, modifiers, plot);
                    } else if strip_response.rect.contains(pos) && button == PointerButton::Primary {
                        self.press_strip(pos, strip);
                    } else if stops_response.rect.contains(pos) {
                        stops_response.request_focus();
                        self.press_stops(pos, button, strip);
                    }
                }
                Event::PointerMoved(pos) => self.drag(pos, scale, plot),
                Event::PointerButton { pos, button, pressed: false, .. }
                    if self.grip.as_ref().is_some_and(|g| g.button == button) =>
                {
                    self.drag(pos, scale, plot);
                    self.grip = None;
                }
                // The system may never report the release.
                Event::WindowFocused(false) => self.grip = None,
                _ => {}
            }
        }
    }

    fn press_plot(&mut self, pos: Pos2, button: PointerButton, modifiers: Modifiers, plot: Axes) {
        let near = self.point_near(pos, plot);
        match (button, near) {
            (PointerButton::Middle, Some(index)) => self.remove_point(index),
            (PointerButton::Secondary, _) => self.hold(GripKind::Window, button, pos),
            (PointerButton::Primary, _) if modifiers.command => self.hold(GripKind::Window, button, pos),
            (PointerButton::Primary, Some(index)) => {
                self.selected = Some(Selected::Point(index));
                self.hold(GripKind::Point(index), button, pos);
            }
            (PointerButton::Primary, None) => {
                let Some((curve, index)) = self.curve.with_point(plot.value(pos.x), plot.opacity(pos.y))
                else {
                    return self.tell_full();
                };
                self.change(curve);
                self.selected = Some(Selected::Point(index));
                self.hold(GripKind::Point(index), button, pos);
            }
            _ => {}
        }
    }

    fn press_strip(&mut self, pos: Pos2, strip: Axes) {
        let (lo, hi) = self.curve.domain;
        let (to_lo, to_hi) = ((pos.x - strip.x(lo)).abs(), (pos.x - strip.x(hi)).abs());
        let kind = match to_lo.min(to_hi) {
            nearest if nearest > GRIP_RADIUS => GripKind::Window,
            nearest if nearest == to_lo => GripKind::LowEnd,
            _ => GripKind::HighEnd,
        };
        self.hold(kind, PointerButton::Primary, pos);
    }

    pub(super) fn tell_full(&mut self) {
        self.files.message = Some("At most 256 control points".into());
    }

    pub(super) fn hold(&mut self, kind: GripKind, button: PointerButton, from: Pos2) {
        self.grip = Some(Grip { kind, button, from, before: self.curve.clone() });
    }

    fn drag(&mut self, pos: Pos2, scale: &ValueScale, plot: Axes) {
        let Some(Grip { kind, from, before, .. }) = &self.grip else { return };
        let moved = pos - *from;
        if moved == egui::Vec2::ZERO {
            return;
        }
        let values_per_pixel = (plot.view.1 - plot.view.0) / plot.rect.width();
        let least = scale.span() * LEAST_WINDOW;
        let (lo, hi) = before.domain;
        let curve = match *kind {
            GripKind::Point(index) => {
                let start = plot.point(before, index);
                let value = before.value(index) + moved.x * values_per_pixel;
                // Sideways only: a level part of the curve stays level.
                let opacity =
                    if moved.y == 0.0 { before.opacity(index) } else { plot.opacity(start.y + moved.y) };
                before.with_point_at(index, value.max(plot.view.0).min(plot.view.1), opacity)
            }
            GripKind::Stop(index) => {
                let value = before.stop_value(index) + moved.x * values_per_pixel;
                before.with_stop_at(index, value.max(plot.view.0).min(plot.view.1))
            }
            GripKind::Window => {
                let (level, window) = before.level_and_window();
                // Dragging up narrows the window: about ten times over the height of the plot.
                let narrower = (moved.y / plot.rect.height() * 2.3).exp();
                before.with_level_and_window(level + moved.x * values_per_pixel, window * narrower, least)
            }
            GripKind::LowEnd => before.with_domain((lo + moved.x * values_per_pixel).min(hi - least), hi),
            GripKind::HighEnd => before.with_domain(lo, (hi + moved.x * values_per_pixel).max(lo + least)),
        };
        self.change(curve);
    }

    /// Zooms the axis about the pointer.
    fn wheel(&mut self, ui: &Ui, scale: &ValueScale, plot: Axes, area: Rect) {
        let Some(at) = ui.input(|i| i.pointer.latest_pos()).filter(|at| area.contains(*at)) else { return };
        if ui.ctx().layer_id_at(at) != Some(ui.layer_id()) {
            return;
        }
        let steps: f32 = ui.input(|i| {
            let of = |event: &Event| match event {
                Event::MouseWheel { unit, delta, .. } => notches_of(*unit, delta.y).clamp(-3.0, 3.0),
                _ => 0.0,
            };
            i.events.iter().map(of).sum()
        });
        if steps != 0.0 {
            ui.input_mut(|i| i.smooth_scroll_delta.y = 0.0);
            let (center, factor) = (plot.value(at.x), (-0.2 * steps).exp());
            let zoomed = |v: f32| center + (v - center) * factor;
            let (lo, hi) = (zoomed(plot.view.0), zoomed(plot.view.1));
            let (least, most) = self.widest_view(scale);
            let (lo, hi) = (lo.max(least), hi.min(most));
            if hi - lo > scale.span() * LEAST_WINDOW {
                self.view = Some((lo, hi));
            } else if plot.view.0 < least || plot.view.1 > most {
                // The curve is narrower than the view, which is useless then.
                self.fit();
            }
        }
    }

    fn keyboard(&mut self, ui: &Ui, plot: Axes, response: &Response) {
        if !response.has_focus() {
            return;
        }
        let filter = EventFilter {
            horizontal_arrows: true,
            vertical_arrows: true,
            escape: self.selected_point().is_some(),
            ..Default::default()
        };
        ui.memory_mut(|m| m.set_focus_lock_filter(response.id, filter));
        let pressed = |modifiers, key| ui.input_mut(|i| i.consume_key(modifiers, key));
        let last = self.curve.num_points() - 1;
        let step_in_values = (plot.view.1 - plot.view.0) * KEY_STEP;
        for (key, sign) in [(Key::ArrowLeft, -1.0), (Key::ArrowRight, 1.0)] {
            if pressed(Modifiers::SHIFT, key) {
                self.nudge(sign * step_in_values, 0.0);
            } else if pressed(Modifiers::NONE, key) {
                self.selected = Some(Selected::Point(match (self.selected_point(), sign > 0.0) {
                    (None, true) => 0,
                    (None, false) => last,
                    (Some(i), true) => (i + 1).min(last),
                    (Some(i), false) => i.saturating_sub(1),
                }));
            }
        }
        for (key, sign) in [(Key::ArrowUp, 1.0), (Key::ArrowDown, -1.0)] {
            if pressed(Modifiers::NONE, key) {
                self.nudge(0.0, sign * 2.0 * KEY_STEP);
            }
        }
        if (pressed(Modifiers::NONE, Key::Delete) || pressed(Modifiers::NONE, Key::Backspace))
            && let Some(index) = self.selected_point()
        {
            self.remove_point(index);
        }
        if pressed(Modifiers::NONE, Key::Insert) || pressed(Modifiers::NONE, Key::Enter) {
            self.add_point(plot);
        }
        if self.selected_point().is_some() && pressed(Modifiers::NONE, Key::Escape) {
            self.selected = None;
        }
    }

    /// Adds a point on the curve, half-way between the selected one and the next, or in the middle of the view.
    fn add_point(&mut self, plot: Axes) {
        let last = self.curve.num_points() - 1;
        let value = match self.selected_point() {
            Some(i) if i < last => 0.5 * (self.curve.value(i) + self.curve.value(i + 1)),
            Some(i) => 0.5 * (self.curve.value(i) + plot.view.1.max(self.curve.value(i))),
            None => 0.5 * (plot.view.0 + plot.view.1),
        };
        match self.curve.with_point(value, self.curve.at(value).1) {
            Some((curve, index)) => {
                self.change(curve);
                self.selected = Some(Selected::Point(index));
            }
            None => self.tell_full(),
        }
    }

    /// Left and right change the level, up and down the window.
    fn strip_keyboard(&mut self, ui: &Ui, scale: &ValueScale, plot: Axes, response: &Response) {
        if !response.has_focus() {
            return;
        }
        let filter = EventFilter { horizontal_arrows: true, vertical_arrows: true, ..Default::default() };
        ui.memory_mut(|m| m.set_focus_lock_filter(response.id, filter));
        let (level, window) = self.curve.level_and_window();
        let step_in_values = (plot.view.1 - plot.view.0) * KEY_STEP;
        for (key, across, narrower) in [
            (Key::ArrowLeft, -1.0, 0.0),
            (Key::ArrowRight, 1.0, 0.0),
            (Key::ArrowUp, 0.0, -1.0f32),
            (Key::ArrowDown, 0.0, 1.0),
        ] {
            if ui.input_mut(|i| i.consume_key(Modifiers::NONE, key)) {
                let window = window * (narrower * WINDOW_KEY_STEP).exp();
                let least = scale.span() * LEAST_WINDOW;
                self.change(self.curve.with_level_and_window(level + across * step_in_values, window, least));
            }
        }
    }

    fn nudge(&mut self, by_value: f32, by_height: f32) {
        let Some(index) = self.selected_point() else { return };
        let opacity = self.curve.opacity(index);
        let opacity = if by_height == 0.0 { opacity } else { opacity_at(height_of(opacity) + by_height) };
        self.change(self.curve.with_point_at(index, self.curve.value(index) + by_value, opacity));
    }

    pub(super) fn remove_point(&mut self, index: usize) {
        if let Some(curve) = self.curve.without_point(index) {
            self.selected = match self.selected {
                Some(Selected::Point(s)) if s == index => None,
                Some(Selected::Point(s)) if s > index => Some(Selected::Point(s - 1)),
                other => other,
            };
            self.change(curve);
        }
    }

    fn point_near(&self, pos: Pos2, plot: Axes) -> Option<usize> {
        let distance = |i: usize| plot.point(&self.curve, i).distance(pos);
        let points = 0..self.curve.num_points();
        // Of two points in one place the selected one, else the last, which is drawn on top.
        let nearest = points.min_by(|&a, &b| {
            let own = |i| (distance(i), self.selected_point() != Some(i), std::cmp::Reverse(i));
            own(a).partial_cmp(&own(b)).unwrap_or(std::cmp::Ordering::Equal)
        })?;
        (distance(nearest) <= GRIP_RADIUS).then_some(nearest)
    }

    fn draw_plot(&self, ui: &Ui, scale: &ValueScale, plot: Axes, outer: Rect, has_focus: bool) {
        let ink = Ink::of(ui);
        let painter = ui.painter().with_clip_rect(outer.intersect(ui.clip_rect()));
        painter.rect_filled(outer, 3.0, ink.ground);
        for opacity in OPACITY_LINES {
            let y = plot.y(opacity);
            painter.hline(plot.rect.x_range(), y, Stroke::new(1.0, ink.line));
        }
        let columns = (plot.rect.width() / 2.0).max(1.0) as usize;
        let column_width = plot.rect.width() / columns as f32;
        let mut bars = Mesh::default();
        for (i, height) in scale.columns(plot.view, columns, self.is_log).into_iter().enumerate() {
            let left = plot.rect.left() + i as f32 * column_width;
            let top = plot.rect.bottom() - height * plot.rect.height() * 0.96;
            bars.add_colored_rect(
                Rect::from_min_max(pos2(left, top), pos2(left + column_width, plot.rect.bottom())),
                ink.histogram,
            );
        }
        painter.add(bars);
        for opacity in OPACITY_LINES {
            let at = pos2(plot.rect.left() + 3.0, plot.y(opacity));
            let font = egui::FontId::proportional(9.0);
            painter.text(at, egui::Align2::LEFT_BOTTOM, format!("{opacity}"), font, ink.quiet);
        }
        // Outside the domain, colour and opacity of its end hold.
        for (from, to) in
            [(outer.left(), plot.x(self.curve.domain.0)), (plot.x(self.curve.domain.1), outer.right())]
        {
            if to > from {
                painter.rect_filled(Rect::from_x_y_ranges(from..=to, outer.y_range()), 0.0, ink.beyond);
            }
        }
        let mut xs: Vec<f32> = (0..=columns).map(|i| plot.rect.left() + i as f32 * column_width).collect();
        let points: Vec<Pos2> = (0..self.curve.num_points()).map(|i| plot.point(&self.curve, i)).collect();
        xs.extend(points.iter().map(|p| p.x).filter(|x| plot.rect.x_range().contains(*x)));
        xs.sort_by(f32::total_cmp);
        let mut fill = Mesh::default();
        let mut line = Vec::with_capacity(xs.len());
        for x in xs {
            let (color, opacity) = self.curve.at(plot.value(x));
            let top = pos2(x, plot.y(opacity));
            let color = color32(color);
            let under = color.gamma_multiply(0.5);
            fill.colored_vertex(top, under);
            fill.colored_vertex(pos2(x, plot.rect.bottom()), under);
            let n = fill.vertices.len() as u32;
            if n > 2 {
                fill.add_triangle(n - 4, n - 3, n - 2);
                fill.add_triangle(n - 3, n - 2, n - 1);
            }
            line.push(top);
        }
        painter.add(fill);
        painter.add(Shape::line(line, Stroke::new(1.5, ink.curve)));
        for (i, at) in points.iter().enumerate() {
            let is_selected = self.selected_point() == Some(i);
            let radius = if is_selected { POINT_RADIUS } else { POINT_RADIUS - 1.5 };
            // A point has an opacity and no colour of its own.
            painter.circle(*at, radius, ink.ground, Stroke::new(1.5, ink.curve));
            if is_selected {
                painter.circle_stroke(*at, radius + 2.0, Stroke::new(1.5, ink.selection));
            }
        }
        for (i, value) in self.surfaces.iter().enumerate() {
            let x = plot.x(*value);
            painter.vline(x, outer.y_range(), Stroke::new(1.5, ink.selection));
            let font = egui::FontId::proportional(10.0);
            let at = pos2(x + 2.0, outer.top() + 1.0);
            painter.text(at, egui::Align2::LEFT_TOP, format!("{}", i + 1), font, ink.selection);
        }
        let frame = if has_focus { Stroke::new(1.5, ink.selection) } else { Stroke::new(1.0, ink.line) };
        painter.rect_stroke(outer, 3.0, frame, StrokeKind::Inside);
    }

    fn draw_strip(&self, ui: &Ui, strip: Axes, outer: Rect, has_focus: bool) {
        let ink = Ink::of(ui);
        let painter = ui.painter().with_clip_rect(outer.intersect(ui.clip_rect()));
        let mut colors = Mesh::default();
        let columns = strip.rect.width().max(1.0) as usize;
        let width = strip.rect.width() / columns as f32;
        for i in 0..columns {
            let left = strip.rect.left() + i as f32 * width;
            let color = color32(self.curve.at(strip.value(left + 0.5 * width)).0);
            let column =
                Rect::from_x_y_ranges(left..=left + width, strip.rect.top() + 2.0..=strip.rect.bottom());
            colors.add_colored_rect(column, color);
        }
        painter.add(colors);
        for end in [self.curve.domain.0, self.curve.domain.1] {
            let x = strip.x(end);
            let handle =
                Rect::from_center_size(pos2(x, strip.rect.center().y + 1.0), vec2(5.0, STRIP_HEIGHT - 2.0));
            painter.rect(handle, 2.0, ink.curve, Stroke::new(1.0, ink.ground), StrokeKind::Outside);
        }
        if has_focus {
            painter.rect_stroke(outer, 2.0, Stroke::new(1.5, ink.selection), StrokeKind::Inside);
        }
    }

    fn draw_axis(&self, ui: &mut Ui, plot: Axes) {
        let (row, _) = ui.allocate_exact_size(vec2(ui.available_width(), 12.0), Sense::hover());
        let ink = Ink::of(ui);
        for (at, align) in
            [(0.0, egui::Align2::LEFT_TOP), (0.5, egui::Align2::CENTER_TOP), (1.0, egui::Align2::RIGHT_TOP)]
        {
            let x = egui::lerp(plot.rect.x_range(), at);
            let text = format_in(plot.value(x), plot.span());
            ui.painter().text(pos2(x, row.top()), align, text, egui::FontId::proportional(10.0), ink.quiet);
        }
    }

    /// Names the plot, the strip and each point for screen readers and tests.
    fn describe(&self, ui: &Ui, plot: Axes, response: &Response, strip: &Response) {
        response.widget_info(|| WidgetInfo::labeled(Role::Canvas, true, "opacity over values"));
        let (level, window) = self.curve.level_and_window();
        let text = format!("level {}, window {}", format_in(level, window), format_in(window, window));
        strip.widget_info(|| WidgetInfo {
            current_text_value: Some(text.clone()),
            ..WidgetInfo::labeled(Role::Canvas, true, "window and level")
        });
        for (end, name) in [(self.curve.domain.0, "low end"), (self.curve.domain.1, "high end")] {
            let at = pos2(plot.x(end), strip.rect.center().y);
            let rect = Rect::from_center_size(at, vec2(5.0, STRIP_HEIGHT));
            let handle = ui.interact(rect, strip.id.with(name), Sense::hover());
            let label = format!("{name} at {}", format_in(end, window));
            handle.widget_info(|| WidgetInfo::labeled(Role::Label, true, &label));
        }
        for (i, value) in self.surfaces.iter().enumerate() {
            let rect =
                Rect::from_center_size(pos2(plot.x(*value), plot.rect.center().y), vec2(2.0, PLOT_HEIGHT));
            let line = ui.interact(rect, response.id.with(("surface", i)), Sense::hover());
            let label = format!("line of surface {} at {}", i + 1, format_in(*value, window));
            line.widget_info(|| WidgetInfo::labeled(Role::Label, true, &label));
        }
        let count = self.curve.num_points();
        for index in 0..count {
            let at = plot.point(&self.curve, index);
            let rect = Rect::from_center_size(at, vec2(2.0, 2.0) * POINT_RADIUS);
            let point = ui.interact(rect, response.id.with(("point", index)), Sense::hover());
            let (value, opacity) = (self.curve.value(index), self.curve.opacity(index));
            let label = format!(
                "point {} of {count}: value {}, opacity {}",
                index + 1,
                format_in(value, window),
                format_value(opacity)
            );
            let is_selected = self.selected_point() == Some(index);
            point.widget_info(|| WidgetInfo::selected(Role::ListBoxOption, true, is_selected, &label));
        }
    }

    /// The values under the pointer, in the plot's upper left corner.
    fn hover_text(&self, ui: &Ui, scale: &ValueScale, plot: Axes, outer: Rect) {
        let pointer = ui.input(|i| i.pointer.latest_pos()).filter(|at| outer.contains(*at));
        let Some(at) = pointer else { return };
        let value = plot.value(at.x);
        let (opacity, share) = (self.curve.at(value).1, scale.share(value) * 100.0);
        let text = format!(
            "value {}   opacity {}   {share:.2} % of voxels",
            format_in(value, plot.span()),
            format_value(opacity)
        );
        let (ink, corner) = (Ink::of(ui), outer.left_top() + vec2(8.0, 3.0));
        ui.painter().text(corner, egui::Align2::LEFT_TOP, text, egui::FontId::proportional(11.0), ink.curve);
    }
}

pub(super) struct Ink {
    ground: Color32,
    line: Color32,
    histogram: Color32,
    beyond: Color32,
    pub(super) curve: Color32,
    quiet: Color32,
    pub(super) selection: Color32,
}

impl Ink {
    pub(super) fn of(ui: &Ui) -> Self {
        if ui.visuals().dark_mode {
            Self {
                ground: Color32::from_gray(16),
                line: Color32::from_white_alpha(26),
                histogram: Color32::from_gray(74),
                beyond: Color32::from_black_alpha(120),
                curve: Color32::from_gray(235),
                quiet: Color32::from_gray(165),
                selection: accent(ui.ctx()),
            }
        } else {
            Self {
                ground: Color32::from_gray(250),
                line: Color32::from_black_alpha(40),
                histogram: Color32::from_gray(190),
                beyond: Color32::from_black_alpha(22),
                curve: Color32::from_gray(30),
                quiet: Color32::from_gray(85),
                selection: accent(ui.ctx()),
            }
        }
    }
}

pub(super) fn color32(color: [f32; 3]) -> Color32 {
    let [r, g, b] = color.map(|c| (c * 255.0).round() as u8);
    Color32::from_rgb(r, g, b)
}

const PLOT_HEIGHT: f32 = 148.0;
const STRIP_HEIGHT: f32 = 15.0;
const POINT_RADIUS: f32 = 6.0;
/// Reach of a point or an end, points.
pub(super) const GRIP_RADIUS: f32 = 9.0;
/// Opacities with a line of their own.
const OPACITY_LINES: [f32; 3] = [0.01, 0.1, 0.5];
/// The narrowest window and view, as a share of the volume's range.
pub(super) const LEAST_WINDOW: f32 = 1e-4;
/// Step of an arrow key, as a share of the view.
pub(super) const KEY_STEP: f32 = 0.005;
/// Change of the window by an arrow key, as an exponent.
const WINDOW_KEY_STEP: f32 = 0.02;
