//! The cards of the start page: the three choices, and what was opened lately, with its last picture.

use egui::{Align2, FontId, Rect, Sense, Stroke, TextureHandle, Ui, pos2, vec2};
use isinglass_formats::{RecentEntry, RecentPlace, VolumeSource};
use isinglass_net::place_of;
use lucide_icons::Icon;

use super::recent_list::ago;
use crate::panels::style::{self, TEXT_SIZE, accent, bright, card, emblem, icon, named, quiet, title};

/// A large choice: a picture of it, a title, and what belongs to it.
pub(super) fn choice<R>(
    ui: &mut Ui,
    (symbol, name): (Icon, &str),
    height: f32,
    content: impl FnOnce(&mut Ui) -> R,
) -> R {
    let frame = card(ui.ctx());
    let shown = frame.show(ui, |ui| {
        ui.set_width(ui.available_width());
        ui.set_min_height((height - 32.0).max(0.0));
        ui.vertical(|ui| {
            ui.horizontal(|ui| {
                ui.label(icon(symbol).size(22.0).color(accent(ui.ctx())));
                ui.label(title(name).color(bright(ui.ctx())));
            });
            ui.add_space(8.0);
            content(ui)
        })
        .inner
    });
    shown.inner
}

pub(super) enum CardWish {
    Open,
    Forget,
}

/// Something that was opened, `width` points wide.
pub(super) fn recent_card(
    ui: &mut Ui,
    entry: &RecentEntry,
    picture: Option<&TextureHandle>,
    now: u64,
    width: f32,
) -> Option<CardWish> {
    let (name, place) = name_and_place(entry);
    let picture_height = (width * 0.625).round();
    let (rect, response) = ui.allocate_exact_size(vec2(width, picture_height + 48.0), Sense::click());
    named(&response, egui::Role::Button, &name);
    let corner = rect.right_top() + vec2(-16.0, 16.0);
    let cross = Rect::from_center_size(corner, vec2(24.0, 24.0));
    let forget = ui.interact(cross, response.id.with("forget"), Sense::click());
    named(&forget, egui::Role::Button, &format!("forget {name}"));
    if ui.is_rect_visible(rect) {
        let ctx = ui.ctx().clone();
        let is_marked = response.hovered() || response.has_focus() || forget.hovered() || forget.has_focus();
        let visuals = ui.visuals();
        let line = if is_marked { accent(&ctx) } else { visuals.widgets.noninteractive.bg_stroke.color };
        let look = card(&ctx).stroke(Stroke::new(1.0, line));
        let painter = ui.painter();
        painter.rect(rect, 8.0, look.fill, look.stroke, egui::StrokeKind::Inside);
        let above = rect.shrink(1.0).with_max_y(rect.top() + picture_height);
        show_picture(ui, above, picture);
        let texts = painter.with_clip_rect(rect.shrink2(vec2(8.0, 0.0)).intersect(ui.clip_rect()));
        let at = pos2(rect.left() + 10.0, above.bottom() + 6.0);
        texts.text(at, Align2::LEFT_TOP, &name, FontId::proportional(TEXT_SIZE), bright(&ctx));
        let when = match entry.place {
            RecentPlace::Server { .. } => format!("server, {}", ago(now, entry.used_at)),
            RecentPlace::Remote { .. } => format!("by ssh, {}", ago(now, entry.used_at)),
            RecentPlace::Volume(_) => ago(now, entry.used_at),
        };
        texts.text(at + vec2(0.0, 19.0), Align2::LEFT_TOP, when, FontId::proportional(12.0), quiet(&ctx));
        let color = if forget.hovered() || forget.has_focus() { bright(&ctx) } else { quiet(&ctx) };
        painter.circle(cross.center(), 11.0, look.fill, Stroke::new(1.0, line));
        let font = FontId::proportional(13.0);
        painter.text(cross.center(), Align2::CENTER_CENTER, Icon::X.unicode(), font, color);
    }
    let is_forgotten = forget.on_hover_text("take it off this list").clicked();
    let response = response.on_hover_text(place);
    match (is_forgotten, response.clicked()) {
        (true, _) => Some(CardWish::Forget),
        (false, true) => Some(CardWish::Open),
        (false, false) => None,
    }
}

/// Fills `rect` with the middle of a picture, or with the emblem.
fn show_picture(ui: &Ui, rect: Rect, picture: Option<&TextureHandle>) {
    let rounding = egui::CornerRadius { nw: 8, ne: 8, sw: 0, se: 0 };
    let Some(picture) = picture else {
        ui.painter().rect_filled(rect, rounding, style::surface(ui.ctx()));
        emblem(ui.painter(), rect.center(), 0.8, ui.visuals().dark_mode);
        return;
    };
    let size = picture.size_vec2();
    let scale = (rect.width() / size.x).max(rect.height() / size.y);
    let seen = rect.size() / (scale * size);
    let part = Rect::from_center_size(pos2(0.5, 0.5), seen);
    let shape = egui::epaint::RectShape::filled(rect, rounding, egui::Color32::WHITE);
    ui.painter().add(shape.with_texture(picture.id(), part));
}

fn name_and_place(entry: &RecentEntry) -> (String, String) {
    match &entry.place {
        RecentPlace::Server { host, port } => {
            (place_of(host, *port), format!("a server, which showed {}", entry.shows))
        }
        RecentPlace::Remote { place } => (entry.shows.clone(), place.clone()),
        RecentPlace::Volume(VolumeSource { source, raw, selection, spacing, .. }) => {
            let part = [
                ("channel", selection.channel),
                ("time", selection.time),
                ("level", selection.level),
                ("series", selection.series),
            ];
            let part = part.into_iter().filter_map(|(what, n)| n.map(|n| format!(", {what} {n}")));
            let region = selection.region.map(|r| format!(", region {r}"));
            let raw = raw.map(|raw| {
                let [x, y, z] = raw.dims;
                format!(", raw {x}×{y}×{z} {}", raw.dtype.name())
            });
            let spacing = spacing.map(|s| format!(", voxels of {}×{}×{}", s.x, s.y, s.z));
            let part: String = part.chain(region).chain(raw).chain(spacing).collect();
            (entry.shows.clone(), format!("{source}{part}"))
        }
    }
}
