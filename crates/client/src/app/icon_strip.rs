//! The panel of a narrow window: a strip of icons at the right edge. One section at a time lies over the picture.

use egui::{Align2, Area, Id, Panel, Role, ScrollArea, Ui, vec2};
use lucide_icons::Icon;

use crate::panels::style::{self, icon, title};

/// Shows the strip at the right of `ui`, and the chosen one of the sections over what is left. `content` fills it.
pub(crate) fn show(ui: &mut Ui, sections: &[&'static str], content: impl FnOnce(&mut Ui, &'static str)) {
    let ctx = ui.ctx().clone();
    let id = shown_id();
    let mut shown: Option<&'static str> = ui.data(|data| data.get_temp(id)).unwrap_or(Some(FIRST));
    let strip = Panel::right("look strip").frame(style::bar(&ctx)).resizable(false).exact_size(WIDTH);
    strip.show(ui, |ui| {
        for name in sections {
            let is_shown = shown == Some(*name);
            let button =
                egui::Button::new(icon(icon_of(name))).selected(is_shown).frame_when_inactive(is_shown);
            let response = ui.add(button.min_size(vec2(WIDTH - 16.0, 28.0)));
            response.widget_info(|| egui::WidgetInfo::selected(Role::CheckBox, true, is_shown, *name));
            if response.on_hover_text(*name).clicked() {
                shown = (!is_shown).then_some(*name);
            }
        }
    });
    ui.data_mut(|data| data.insert_temp(id, shown));
    let room = ui.available_rect_before_wrap();
    let Some(name) = shown.filter(|name| sections.contains(name)) else { return };
    let size = vec2((room.width() - 2.0 * GAP).clamp(120.0, MOST_WIDTH), room.height() - 2.0 * GAP);
    let area = Area::new(Id::unique("section")).constrain_to(room).anchor(Align2::RIGHT_TOP, [-GAP, GAP]);
    area.show(&ctx, |ui| {
        style::pane(&ctx).fill(style::surface(&ctx)).show(ui, |ui| {
            let inner = size - vec2(20.0, 18.0);
            ui.set_width(inner.x);
            ui.label(title(name));
            let height = (inner.y - 24.0).max(60.0);
            ScrollArea::vertical().max_height(height).show(ui, |ui| {
                ui.set_width(ui.available_width());
                content(ui, name);
            });
        });
    });
}

/// All sections are docked: when the window becomes narrow, none of them covers the picture.
pub(crate) fn note_docked(ui: &Ui) {
    ui.data_mut(|data| data.insert_temp(shown_id(), None::<&'static str>));
}

/// The panel is closed: when a narrow window opens it again, the first section is there.
pub(crate) fn note_closed(ui: &Ui) {
    ui.data_mut(|data| data.remove::<Option<&'static str>>(shown_id()));
}

fn shown_id() -> Id {
    Id::unique("the section over the picture")
}

fn icon_of(section: &str) -> Icon {
    match section {
        "Presets" => Icon::LayoutGrid,
        "Channels" => Icon::Layers,
        "Light" => Icon::Sun,
        "Clip" => Icon::Crop,
        "View" => Icon::Eye,
        "State" => Icon::Bookmark,
        "Advanced" => Icon::Settings2,
        _ => Icon::ChartSpline,
    }
}

/// Opens with the strip.
const FIRST: &str = "Transfer function";
/// Width of the strip, points.
const WIDTH: f32 = 44.0;
/// Between a section and the edges of the picture, points.
const GAP: f32 = 8.0;
/// Width of a section, points.
const MOST_WIDTH: f32 = 352.0;
