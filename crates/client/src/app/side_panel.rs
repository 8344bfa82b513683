//! The panel at the right. It composes the panels of the look, the frames, the clip, the view and the state.

use egui::{Align2, RichText, Ui, vec2};
use glam::Vec3;
use isinglass_core::layer::MAX_K;
use isinglass_core::look::Look;
use isinglass_core::space::Aabb;

use crate::input::bindings::{Action, Bindings};
use crate::paint::clip_editor::ClipEditor;
use crate::paint::stereo::{self, MAX_EYE_ANGLE_DEGREES, Stereo};
use crate::paint::view_aids::ViewAids;
use crate::panels::controls::{self, percent, row};
use crate::panels::state_files::{StateFiles, StateWish};
use crate::panels::style::pane;
use crate::panels::transfer::TransferEditor;
use crate::panels::value_scale::ValueScale;
use crate::panels::{clip, light, mode};
use crate::view::viewing::FrameSize;

/// What the panel shows and changes beside the transfer function.
pub(crate) struct LookSettings<'a> {
    pub(crate) look: Look,
    pub(crate) frame_size: &'a mut FrameSize,
    pub(crate) methods: &'a [&'static str],
    pub(crate) method: &'a mut usize,
    pub(crate) stereo: &'a mut Stereo,
    pub(crate) aids: &'a mut ViewAids,
    pub(crate) is_orthographic: &'a mut bool,
    pub(crate) clip_editor: &'a mut ClipEditor,
    pub(crate) bounds: Aabb,
    /// Unit of length, if known.
    pub(crate) unit: Option<&'a str>,
    /// Viewing direction, world space.
    pub(crate) forward: Vec3,
    pub(crate) bindings: &'a Bindings,
    pub(crate) world_from_view: glam::Quat,
}

/// Shows the panel, open or folded, and changes the settings. Returns what to do with states.
pub(crate) fn show(
    ctx: &egui::Context,
    is_open: &mut bool,
    editor: &mut TransferEditor,
    scale: &ValueScale,
    settings: &mut LookSettings<'_>,
    state_files: &mut StateFiles,
) -> Option<StateWish> {
    let mut wish = None;
    // One area for both would keep the width of the open panel.
    let area_id = egui::Id::unique(if *is_open { "look" } else { "look, folded" });
    // The window's height without title and margins; the rest scrolls.
    let height = (ctx.content_rect().height() - 70.0).max(100.0);
    let area = egui::Area::new(area_id).anchor(Align2::RIGHT_TOP, vec2(-10.0, 10.0));
    area.show(ctx, |ui| {
        pane(ctx).show(ui, |ui| {
            let title = egui::Button::new(RichText::new("Look").strong().size(13.0)).frame(false);
            let hint = if *is_open { "click: fold" } else { "transfer function, shading, view" };
            let hint = settings.bindings.with_key(hint, Action::LookPanel);
            if ui.add(title).on_hover_text(hint).clicked() {
                *is_open = !*is_open;
            }
            if !*is_open {
                return;
            }
            ui.set_width(PANEL_WIDTH);
            // An area keeps its height of the refresh before: without a least height it would never grow with its
            // content.
            let scroll = egui::ScrollArea::vertical().max_height(height).min_scrolled_height(height);
            scroll.show(ui, |ui| {
                ui.set_width(PANEL_WIDTH);
                mode::show(ui, &mut settings.look, scale);
                section(ui, "Transfer function", true, |ui| editor.show(ui, scale));
                section(ui, "Light", false, |ui| {
                    light::show(ui, &mut settings.look.lighting, settings.world_from_view);
                });
                section(ui, "Frames", false, |ui| frames(ui, settings));
                section(ui, "Clip", false, |ui| {
                    let LookSettings { look, clip_editor, bounds, unit, forward, bindings, .. } =
                        &mut *settings;
                    clip::show(ui, &mut look.clip, clip_editor, bounds, *unit, *forward, bindings);
                });
                section(ui, "View", false, |ui| view(ui, settings));
                section(ui, "State", false, |ui| wish = state_files.show(ui));
            });
        });
    });
    wish
}

fn section(ui: &mut Ui, title: &str, is_open: bool, content: impl FnOnce(&mut Ui)) {
    let header = egui::CollapsingHeader::new(RichText::new(title).size(12.5)).default_open(is_open);
    header.show_unindented(ui, content);
}

fn frames(ui: &mut Ui, settings: &mut LookSettings<'_>) {
    let LookSettings { look, frame_size, methods, method, stereo, .. } = settings;
    egui::Grid::new("frames").num_columns(2).spacing([14.0, 6.0]).show(ui, |ui| {
        row(ui, "shading", "by gradients, with a light fixed in the world", |ui| {
            ui.checkbox(&mut look.shaded, "")
        });
        row(ui, "segments a ray", "K: more is truer after a turn, and more to send", |ui| {
            let slider = egui::Slider::new(&mut look.k, 1..=MAX_K as u8).update_while_editing(false);
            ui.add(slider.custom_parser(controls::reader(ui)))
        });
        if methods.len() > 1 {
            row(ui, "picture by", "how the server's frames become pictures here", |ui| {
                let combo = egui::ComboBox::from_id_salt("method").selected_text(methods[**method]);
                let choices = |ui: &mut Ui| {
                    for (number, name) in methods.iter().enumerate() {
                        ui.selectable_value(*method, number, *name);
                    }
                };
                combo.show_ui(ui, choices).response
            });
        }
        row(ui, "frame size", "of the server's frames, in units of the window's", |ui| {
            percent(ui, &mut frame_size.scale, 25.0..=100.0)
        });
        if **method == 0 {
            stereo_rows(ui, stereo);
        }
    });
}

fn stereo_rows(ui: &mut Ui, stereo: &mut Stereo) {
    row(ui, "stereo", "two eyes, side by side or for red-cyan glasses", |ui| {
        let name = stereo::MODES[stereo.mode as usize].1;
        let combo = egui::ComboBox::from_id_salt("stereo").selected_text(name);
        let choices = |ui: &mut Ui| {
            for (mode, name) in stereo::MODES {
                ui.selectable_value(&mut stereo.mode, mode, name);
            }
        };
        combo.show_ui(ui, choices).response
    });
    row(ui, "eye distance", "as an angle, seen from the centre", |ui| {
        let is_stereo = !stereo.is_mono();
        let range = 0.0..=MAX_EYE_ANGLE_DEGREES;
        let slider = controls::slider(ui, &mut stereo.eye_angle_degrees, range, |v| format!("{v:.1}"));
        ui.add_enabled(is_stereo, slider.step_by(0.1).fixed_decimals(1).suffix("°"))
    });
}

fn view(ui: &mut Ui, settings: &mut LookSettings<'_>) {
    let projection = settings.bindings.with_key("projection", Action::Projection);
    ui.horizontal(|ui| {
        ui.label(projection);
        for (name, is_orthographic) in [("perspective", false), ("orthographic", true)] {
            ui.selectable_value(settings.is_orthographic, is_orthographic, name);
        }
    });
    let axes = settings.bindings.with_key("axes and scale", Action::Axes);
    let volume_box = settings.bindings.with_key("box", Action::Box);
    let aids = &mut *settings.aids;
    ui.horizontal(|ui| {
        ui.checkbox(&mut aids.shows_axes, axes);
        ui.checkbox(&mut aids.shows_box, volume_box);
    });
    ui.horizontal(|ui| {
        ui.label("background");
        for (name, color) in [("black", [0; 3]), ("grey", [58, 60, 66]), ("white", [255; 3])] {
            ui.selectable_value(&mut aids.background, color, name);
        }
        let color = ui.color_edit_button_srgb(&mut aids.background);
        color.widget_info(|| egui::WidgetInfo::labeled(egui::Role::ColorWell, true, "background colour"));
    });
    ui.horizontal(|ui| {
        ui.label("theme");
        let mut theme = ui.ctx().options(|o| o.theme_preference);
        for (name, wanted) in [
            ("dark", egui::ThemePreference::Dark),
            ("light", egui::ThemePreference::Light),
            ("system's", egui::ThemePreference::System),
        ] {
            if ui.selectable_value(&mut theme, wanted, name).clicked() {
                ui.ctx().set_theme(wanted);
            }
        }
    });
}

/// Room for nine points of a curve, and for a third of a small screen beside it, points.
const PANEL_WIDTH: f32 = 312.0;
/// What the folded panel takes of the window's right, with a gap, points.
pub(crate) const FOLDED_WIDTH: f32 = 74.0;
/// What the open panel takes of the window's right, with a gap, points.
pub(crate) const OPEN_WIDTH: f32 = PANEL_WIDTH + 40.0;
