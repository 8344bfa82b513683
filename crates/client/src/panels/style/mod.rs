//! What all panels share: panes, bars, icons, colours, and names for screen readers.

mod theme;

use std::sync::Arc;

use egui::{Color32, FontData, FontDefinitions, Frame, Margin, Rect, RichText, Stroke, Ui};
use lucide_icons::{Icon, LUCIDE_FONT_BYTES};

use self::theme::Palette;
pub(crate) use self::theme::{TEXT_SIZE, TITLE_SIZE};

/// A pane on which text is readable over any picture.
pub(crate) fn pane(ctx: &egui::Context) -> Frame {
    let colors = Palette::of(ctx.theme());
    Frame::new()
        .fill(colors.pane)
        .stroke(Stroke::new(1.0, colors.line))
        .corner_radius(6.0)
        .inner_margin(Margin::symmetric(10, 8))
}

/// Shows a pane at an edge or corner of `room`, `offset` points from there.
pub(crate) fn pane_at<R>(
    ctx: &egui::Context,
    id: &str,
    room: Rect,
    (align, offset): (egui::Align2, [f32; 2]),
    content: impl FnOnce(&mut Ui) -> R,
) -> egui::InnerResponse<R> {
    let area = egui::Area::new(egui::Id::unique(id)).constrain_to(room).anchor(align, offset);
    area.show(ctx, |ui| pane(ctx).show(ui, content).inner)
}

/// A bar at the edge of the window, on which the picture never lies.
pub(crate) fn bar(ctx: &egui::Context) -> Frame {
    Frame::new().fill(surface(ctx)).inner_margin(Margin::symmetric(8, 4))
}

/// Colour of bars and of the docked panel.
pub(crate) fn surface(ctx: &egui::Context) -> Color32 {
    Palette::of(ctx.theme()).surface
}

/// An icon as text.
pub(crate) fn icon(icon: Icon) -> RichText {
    RichText::new(icon.unicode()).size(ICON_SIZE)
}

/// Gives a window its fonts and the look of its controls, once.
pub(crate) fn install(ctx: &egui::Context) {
    let id = egui::Id::unique("fonts are installed");
    if ctx.data_mut(|data| std::mem::replace(data.get_temp_mut_or_default::<bool>(id), true)) {
        return;
    }
    let mut fonts = FontDefinitions::default();
    fonts.font_data.insert("icons".into(), Arc::new(FontData::from_static(LUCIDE_FONT_BYTES)));
    for family in fonts.families.values_mut() {
        // Text looks here only for what its own font lacks.
        family.insert(family.len().min(1), "icons".into());
    }
    ctx.set_fonts(fonts);
    theme::install(ctx);
}

/// Colours of main text, and of text beside it.
pub(crate) fn bright(ctx: &egui::Context) -> Color32 {
    Palette::of(ctx.theme()).bright
}

pub(crate) fn quiet(ctx: &egui::Context) -> Color32 {
    Palette::of(ctx.theme()).quiet
}

/// Colour of what is chosen or goes on.
pub(crate) fn accent(ctx: &egui::Context) -> Color32 {
    Palette::of(ctx.theme()).accent
}

/// Colour of what is done and good.
pub(crate) fn done(ctx: &egui::Context) -> Color32 {
    Palette::of(ctx.theme()).done
}

/// Colour of trouble.
pub(crate) fn amber(ctx: &egui::Context) -> Color32 {
    Palette::of(ctx.theme()).amber
}

/// Backgrounds of the picture that the panel offers, sRGB.
pub(crate) const BACKGROUNDS: [(&str, [u8; 3]); 3] =
    [("black", [0; 3]), ("grey", [58, 60, 66]), ("white", [255; 3])];

/// A card on a page.
pub(crate) fn card(ctx: &egui::Context) -> Frame {
    let colors = Palette::of(ctx.theme());
    Frame::new()
        .fill(colors.card)
        .stroke(Stroke::new(1.0, colors.line))
        .corner_radius(8.0)
        .inner_margin(Margin::same(16))
}

/// A title of a part of a page.
pub(crate) fn title(text: &str) -> RichText {
    RichText::new(text).size(TITLE_SIZE).strong()
}

pub(crate) fn named(response: &egui::Response, role: egui::Role, name: &str) {
    response.widget_info(|| egui::WidgetInfo::labeled(role, true, name));
}

pub(crate) fn name_window(ctx: &egui::Context, name: &str) {
    ctx.accesskit_node_builder(egui::accesskit_root_id(), |node| node.set_label(name));
}

/// Shows what went wrong.
pub(crate) fn problem(ui: &mut Ui, text: &str) {
    let text = RichText::new(text).color(amber(ui.ctx()));
    ui.add(egui::Label::new(text).wrap());
}

/// Names something painted for screen readers.
pub(crate) fn image(ui: &Ui, rect: Rect, id: &str, name: &str) {
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
        let sheet = Rect::from_center_size(center + egui::vec2(shift, -shift * 0.6), size);
        painter.rect_filled(sheet, 4.0 * scale, fill);
        painter.rect_stroke(sheet, 4.0 * scale, Stroke::new(1.0, line), egui::StrokeKind::Inside);
    }
}

/// Size of icons, points.
pub(crate) const ICON_SIZE: f32 = 16.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_signs_of_controls_have_glyphs() {
        let mut h = egui_kittest::Harness::new_ui_state(
            |ui, missing: &mut String| {
                install(ui.ctx());
                let font = egui::FontId::proportional(13.0);
                let has = |c: char| ui.ctx().fonts_mut(|fonts| fonts.has_glyph(&font, c));
                // Signs of rows and values.
                *missing = "−×°–…·\u{10fffd}".chars().filter(|c| !has(*c)).collect();
            },
            String::new(),
        );
        h.run();
        assert_eq!(h.state(), "\u{10fffd}", "the control has none");
    }
}
