//! What all panels share: panes, colours, names for screen readers, and the room that a pane has.

use egui::{Color32, Frame, Margin, Stroke, Ui};

/// The room that is taken around a pane, points.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Taken {
    /// On the left.
    pub(crate) left: f32,
    /// On the right.
    pub(crate) right: f32,
    /// At the edge of the window where the pane lies.
    pub(crate) edge: f32,
}

impl Taken {
    /// The width left for a pane.
    pub(crate) fn width(&self, ctx: &egui::Context) -> f32 {
        ctx.content_rect().width() - self.left - self.right
    }

    /// From the middle of the window to the middle of the room.
    pub(crate) fn shift(&self) -> f32 {
        0.5 * (self.left - self.right)
    }
}

/// A pane on which text is readable over any picture.
pub(crate) fn pane(ctx: &egui::Context) -> Frame {
    let (fill, line) = if is_dark(ctx) {
        (Color32::from_rgba_unmultiplied(14, 16, 20, 225), Color32::from_white_alpha(28))
    } else {
        (Color32::from_rgba_unmultiplied(246, 247, 249, 240), Color32::from_black_alpha(60))
    };
    Frame::new()
        .fill(fill)
        .stroke(Stroke::new(1.0, line))
        .corner_radius(6.0)
        .inner_margin(Margin::symmetric(10, 8))
}

fn is_dark(ctx: &egui::Context) -> bool {
    ctx.theme() == egui::Theme::Dark
}

/// Colours of main text, and of text beside it.
pub(crate) fn bright(ctx: &egui::Context) -> Color32 {
    if is_dark(ctx) { Color32::from_gray(232) } else { Color32::from_gray(20) }
}

pub(crate) fn quiet(ctx: &egui::Context) -> Color32 {
    if is_dark(ctx) { Color32::from_gray(178) } else { Color32::from_gray(70) }
}

/// Colour of a line about a problem.
pub(crate) fn warning(ui: &Ui) -> Color32 {
    if ui.visuals().dark_mode { Color32::from_rgb(245, 205, 130) } else { Color32::from_rgb(150, 70, 0) }
}

pub(crate) fn named(response: &egui::Response, role: egui::Role, name: &str) {
    response.widget_info(|| egui::WidgetInfo::labeled(role, true, name));
}

pub(crate) fn name_window(ctx: &egui::Context, name: &str) {
    ctx.accesskit_node_builder(egui::accesskit_root_id(), |node| node.set_label(name));
}

/// Names something painted for screen readers.
pub(crate) fn image(ui: &Ui, rect: egui::Rect, id: &str, name: &str) {
    let response = ui.interact(rect, egui::Id::unique(id), egui::Sense::hover());
    response.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Image, true, name));
}
