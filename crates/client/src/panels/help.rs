//! The help: every key and mouse gesture, and what it does.

use egui::{Align2, Color32, RichText, Ui, vec2};

use super::style::{bright, quiet};
use crate::input::bindings::Bindings;

/// Shows the keys in the middle of the window: in two columns if one is too high and there is room.
pub(crate) fn show(ctx: &egui::Context, bindings: &Bindings, open: &mut bool) {
    egui::Window::new(RichText::new("Keys and mouse").size(14.0))
        .id(egui::Id::unique("help"))
        .open(open)
        .anchor(Align2::CENTER_CENTER, vec2(0.0, 0.0))
        .auto_sized()
        .collapsible(false)
        .show(ctx, |ui| {
            let screen = ctx.content_rect().size();
            let height = (screen.y - 100.0).max(100.0);
            let lines = bindings.lines();
            let row_height = ui.text_style_height(&egui::TextStyle::Body) + HELP_GAPS.y;
            let is_high = lines.len() as f32 * row_height > height;
            let num_columns = if is_high && screen.x >= LEAST_WIDTH_OF_TWO { 2 } else { 1 };
            let room = (screen.x - 60.0).max(120.0) / num_columns as f32 - 2.0 * HELP_GAPS.x;
            let columns = lines.chunks(lines.len().div_ceil(num_columns));
            let columns: Vec<_> = columns.map(|lines| KeyColumn::of(ui, lines, room)).collect();
            if columns.iter().all(|column| column.height() <= height) {
                key_columns(ui, &columns, -HELP_GAPS.x);
            } else {
                let scroll = egui::ScrollArea::vertical().max_height(height).min_scrolled_height(height);
                // The scroll bar needs room at the right.
                scroll.show(ui, |ui| key_columns(ui, &columns, 0.0));
            }
        });
}

/// Keys and what they do. Sizes are known before drawing: egui would cut off a table whose size it has to find.
struct KeyColumn<'a> {
    lines: &'a [(String, &'static str)],
    /// Widths of the keys and of the texts, with a gap beside each, points.
    widths: [f32; 2],
    /// Height of each line, with a gap below it, points.
    heights: Vec<f32>,
}

impl<'a> KeyColumn<'a> {
    /// Lines whose texts take at most `room` points, and wrap where they need more.
    fn of(ui: &Ui, lines: &'a [(String, &'static str)], room: f32) -> Self {
        let font = egui::TextStyle::Body.resolve(ui.style());
        let size = |text: &str, width: f32| {
            ui.painter().layout(text.to_owned(), font.clone(), Color32::WHITE, width).size().ceil()
        };
        let widest = |texts: &mut dyn Iterator<Item = &str>| {
            texts.map(|text| size(text, f32::INFINITY).x + 1.0).fold(0.0, f32::max)
        };
        let keys = widest(&mut lines.iter().map(|(keys, _)| &keys[..])).min(0.5 * room);
        let text = widest(&mut lines.iter().map(|(_, text)| *text)).min(room - keys);
        let height = |(of_keys, of_text): &(String, &str)| size(of_keys, keys).y.max(size(of_text, text).y);
        let heights = lines.iter().map(|line| height(line) + HELP_GAPS.y).collect();
        Self { lines, widths: [keys + HELP_GAPS.x, text + HELP_GAPS.x], heights }
    }

    fn height(&self) -> f32 {
        self.heights.iter().sum()
    }
}

/// Draws columns side by side, with `more` points at their right.
fn key_columns(ui: &mut Ui, columns: &[KeyColumn<'_>], more: f32) {
    let width = columns.iter().flat_map(|column| column.widths).sum::<f32>() + more;
    let height = columns.iter().map(KeyColumn::height).fold(0.0, f32::max);
    let (rect, _) = ui.allocate_exact_size(vec2(width, height), egui::Sense::hover());
    let (bright, quiet) = (bright(ui.ctx()), quiet(ui.ctx()));
    let mut left = rect.left();
    for KeyColumn { lines, widths: [keys_width, text_width], heights } in columns {
        let mut top = rect.top();
        for ((keys, text), height) in lines.iter().zip(heights) {
            for (x, width, text) in [
                (left, keys_width, RichText::new(keys).color(bright).strong()),
                (left + keys_width, text_width, RichText::new(*text).color(quiet)),
            ] {
                let size = vec2(width - HELP_GAPS.x, *height);
                let cell = egui::Rect::from_min_size(egui::pos2(x, top), size);
                let cell = egui::UiBuilder::new().max_rect(cell);
                ui.scope_builder(cell, |ui| ui.add(egui::Label::new(text).wrap()));
            }
            top += height;
        }
        left += keys_width + text_width;
    }
}

const HELP_GAPS: egui::Vec2 = vec2(24.0, 4.0);
/// Two columns of keys need a window at least this wide, points.
const LEAST_WIDTH_OF_TWO: f32 = 1240.0;
