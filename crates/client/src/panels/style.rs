//! What all panels share: panes, colours, names for screen readers, and the room that a pane has.

use egui::{Color32, Frame, Margin, Stroke, Ui};

/// The room that is taken around a pane, points.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Taken {
    pub(crate) left: f32,
    pub(crate) right: f32,
    /// At the edge of the window where the pane lies.
    pub(crate) edge: f32,
}

impl Taken {
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

/// Shows a pane at an edge or corner of the window, `offset` points from there.
pub(crate) fn pane_at<R>(
    ctx: &egui::Context,
    id: &str,
    (align, offset): (egui::Align2, [f32; 2]),
    content: impl FnOnce(&mut Ui) -> R,
) -> egui::InnerResponse<R> {
    let area = egui::Area::new(egui::Id::unique(id)).anchor(align, offset);
    area.show(ctx, |ui| pane(ctx).show(ui, content).inner)
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

/// Shows what went wrong.
pub(crate) fn problem(ui: &mut Ui, text: &str) {
    let text = egui::RichText::new(text).color(warning(ui));
    ui.add(egui::Label::new(text).wrap());
}

/// Names something painted for screen readers.
pub(crate) fn image(ui: &Ui, rect: egui::Rect, id: &str, name: &str) {
    let response = ui.interact(rect, egui::Id::unique(id), egui::Sense::hover());
    response.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Image, true, name));
}

/// Draws the emblem: sheets of mica, one behind the other.
pub(crate) fn emblem(painter: &egui::Painter, center: egui::Pos2, scale: f32, is_dark: bool) {
    let (fill, line) = match is_dark {
        true => (
            Color32::from_rgba_unmultiplied(150, 190, 225, 38),
            Color32::from_rgba_unmultiplied(190, 215, 240, 85),
        ),
        false => (
            Color32::from_rgba_unmultiplied(40, 90, 140, 30),
            Color32::from_rgba_unmultiplied(30, 70, 110, 110),
        ),
    };
    for i in 0..4u8 {
        let shift = (f32::from(i) * 9.0 - 13.5) * scale;
        let size = egui::vec2(54.0, 40.0) * scale;
        let sheet = egui::Rect::from_center_size(center + egui::vec2(shift, -shift * 0.6), size);
        painter.rect_filled(sheet, 4.0 * scale, fill);
        painter.rect_stroke(sheet, 4.0 * scale, Stroke::new(1.0, line), egui::StrokeKind::Inside);
    }
}
