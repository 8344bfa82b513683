//! The frame around the window while files are dragged over it: it says what happens if they are dropped. What is
//! wrong with dropped files stands there, too.

use std::path::PathBuf;

use egui::{Align2, Context, Id, LayerId, Order, RichText, Stroke, StrokeKind, vec2};

use crate::panels::background::Background;
use crate::panels::known_files::announce;
use crate::panels::style::{self, named, pane_at};
use crate::view::Waker;

#[derive(Default)]
pub(super) struct DropFrame {
    /// The files over the window.
    over: Vec<PathBuf>,
    asking: Background<(String, bool)>,
    told: Option<(String, bool)>,
}

impl DropFrame {
    /// Shows the frame if there is a reason. `problem` is that of the files that were dropped last. Returns whether the
    /// person has read it, or drags other files.
    pub(super) fn show(&mut self, ctx: &Context, wake: &Waker, problem: Option<&str>) -> bool {
        let over: Vec<PathBuf> =
            ctx.input(|i| i.raw.hovered_files.iter().filter_map(|file| file.path.clone()).collect());
        if over != self.over {
            (self.told, self.asking) = (None, Background::default());
            if let Some(first) = over.first().cloned() {
                self.asking = Background::run(wake, move || Ok(announce(&first)));
            }
            self.over = over;
        }
        if let Some(Ok(told)) = self.asking.take() {
            self.told = Some(told);
        }
        if !self.over.is_empty() {
            let (text, opens) = self.told.clone().unwrap_or_else(|| ("looking…".into(), true));
            let more = self.over.len() - 1;
            let text =
                if more > 0 { format!("{text} (the first that opens of {} files)", more + 1) } else { text };
            frame(ctx, &text, opens, false);
            return true;
        }
        problem.is_some_and(|problem| frame(ctx, problem, false, true))
    }
}

/// Returns whether the person has read it.
fn frame(ctx: &Context, text: &str, opens: bool, has_button: bool) -> bool {
    let room = ctx.content_rect();
    let painter = ctx.layer_painter(LayerId::new(Order::Foreground, Id::unique("drop shade")));
    if !has_button {
        painter.rect_filled(room, 0.0, style::surface(ctx).gamma_multiply(0.6));
    }
    let color = if opens { style::accent(ctx) } else { style::amber(ctx) };
    painter.rect_stroke(room.shrink(8.0), 8.0, Stroke::new(3.0, color), StrokeKind::Inside);
    let shown = pane_at(ctx, "drop", room, (Align2::CENTER_CENTER, [0.0, 0.0]), |ui| {
        ui.set_max_width((room.width() - 80.0).clamp(120.0, 480.0));
        let size = if has_button { style::TEXT_SIZE } else { style::TITLE_SIZE };
        let color = if opens { style::bright(ctx) } else { style::amber(ctx) };
        ui.add(egui::Label::new(RichText::new(text).size(size).color(color)).wrap());
        if !has_button {
            return false;
        }
        ui.add_space(4.0);
        let ok = ui.add(egui::Button::new("OK").min_size(vec2(56.0, 0.0)));
        named(&ok, egui::Role::Button, "OK");
        ok.clicked() || ui.input_mut(|i| i.consume_key(egui::Modifiers::NONE, egui::Key::Escape))
    });
    shown.inner
}
