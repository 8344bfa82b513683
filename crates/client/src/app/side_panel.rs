//! The panel at the right. It composes the panels of the look, the frames, the clip, the view and the state.

use egui::{Panel, Ui};
use glam::Vec3;
use isinglass_core::layer::MAX_K;
use isinglass_core::look::Look;
use isinglass_core::mode::Mode;
use isinglass_core::space::Aabb;
use isinglass_core::wire::VolumeDescription;

use super::icon_strip;
use crate::input::bindings::{Action, Bindings};
use crate::paint::clip_editor::ClipEditor;
use crate::paint::stereo::{self, MAX_EYE_ANGLE_DEGREES, Stereo};
use crate::paint::view_aids::ViewAids;
use crate::panels::controls::{self, percent, row};
use crate::panels::gallery::Gallery;
use crate::panels::state_files::{StateFiles, StateWish};
use crate::panels::style::{BACKGROUNDS, title};
use crate::panels::transfer::TransferEditor;
use crate::panels::value_scale::ValueScale;
use crate::panels::{channels, clip, color_well, light};
use crate::view::viewing::FrameSize;

/// What the panel shows and changes beside the transfer function.
pub(crate) struct LookSettings<'a> {
    pub(crate) look: Look,
    pub(crate) gallery: &'a Gallery,
    pub(crate) volume: &'a VolumeDescription,
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
    /// Set when the person resets the choices.
    pub(crate) resets_choices: &'a mut bool,
}

/// Docks the panel at the right of `ui` while it is open, and changes the settings. Returns what to do with states.
pub(crate) fn show(
    ui: &mut Ui,
    frame: egui::Frame,
    is_open: &mut bool,
    editor: &mut TransferEditor,
    scale: &ValueScale,
    settings: &mut LookSettings<'_>,
    state_files: &mut StateFiles,
) -> Option<StateWish> {
    let mut wish = None;
    if !*is_open {
        icon_strip::note_closed(ui);
        return None;
    }
    let has_channels = !settings.volume.channels.is_empty();
    let mut sections = |ui: &mut Ui, layout: Layout| {
        layout.section(ui, "Presets", true, |ui| {
            if let Some(entry) =
                settings.gallery.show(ui, &settings.look, editor.is_edited(), settings.volume)
            {
                editor.note_present();
                entry.set(&mut settings.look, scale);
            }
        });
        let VolumeDescription { name, value_range, channels, .. } = settings.volume;
        if has_channels {
            layout.section(ui, "Channels", true, |ui| channels::show(ui, channels, &mut settings.look));
        }
        let presets: Vec<_> = isinglass_formats::fitting_presets(name, *value_range).collect();
        layout.section(ui, "Transfer function", true, |ui| {
            if channels::chosen_are_labels(channels, &settings.look) {
                ui.label("Labels have colours of their own: see the channels.");
                return;
            }
            let Look { mode, isos, .. } = &mut settings.look;
            editor.show(ui, scale, &presets, Some(isos).filter(|_| *mode == Mode::Iso));
        });
        layout.section(ui, "Light", false, |ui| {
            light::show(ui, &mut settings.look, settings.world_from_view);
        });
        layout.section(ui, "Clip", false, |ui| {
            let LookSettings { look, clip_editor, bounds, unit, forward, bindings, .. } = &mut *settings;
            clip::show(ui, &mut look.clip, clip_editor, bounds, *unit, *forward, bindings);
        });
        layout.section(ui, "View", false, |ui| view(ui, settings));
        layout.section(ui, "Advanced", false, |ui| frames(ui, settings));
        layout.section(ui, "State", false, |ui| wish = state_files.show(ui));
    };
    if ui.ctx().content_rect().width() < STRIP_BELOW {
        let shown: Vec<_> = SECTIONS.into_iter().filter(|name| has_channels || *name != "Channels").collect();
        icon_strip::show(ui, &shown, |ui, name| sections(ui, Layout::Only(name)));
        return wish;
    }
    icon_strip::note_docked(ui);
    // A small window keeps most of its room for the picture.
    let widest = (ui.available_width() * 0.6).max(LEAST_WIDTH);
    let panel = Panel::right("look").frame(frame).resizable(true).default_size(PANEL_WIDTH.min(widest));
    panel.size_range(LEAST_WIDTH.min(widest)..=widest).show(ui, |ui| {
        // A child of its own: what is too wide must not widen the panel.
        let room = ui.available_rect_before_wrap();
        let mut inside = ui.new_child(egui::UiBuilder::new().max_rect(room));
        ui.advance_cursor_after_rect(room);
        let area = egui::ScrollArea::vertical().auto_shrink(false);
        area.show(&mut inside, |ui| sections(ui, Layout::Docked));
    });
    wish
}

/// Which sections are shown, and how.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Layout {
    /// All of them below each other; each unfolds.
    Docked,
    /// One of them, without its title.
    Only(&'static str),
}

impl Layout {
    fn section(self, ui: &mut Ui, name: &str, is_open: bool, content: impl FnOnce(&mut Ui)) {
        match self {
            Self::Docked => {
                let header = egui::CollapsingHeader::new(title(name)).default_open(is_open);
                header.show_unindented(ui, content);
            }
            Self::Only(only) if only == name => content(ui),
            Self::Only(_) => {}
        }
    }
}

fn frames(ui: &mut Ui, settings: &mut LookSettings<'_>) {
    let LookSettings { look, frame_size, methods, method, stereo, .. } = settings;
    ui.vertical(|ui| {
        row(ui, "layers per pixel", "more follow a turn better, and take more of the network", |ui| {
            let slider = egui::Slider::new(&mut look.k, 1..=MAX_K as u8).update_while_editing(false);
            ui.add(slider.custom_parser(controls::reader(ui)))
        });
        if methods.len() > 1 {
            row(ui, "method", "how the server's frames become pictures here", |ui| {
                let combo = egui::ComboBox::from_id_salt("method").selected_text(methods[**method]);
                let choices = |ui: &mut Ui| {
                    for (number, name) in methods.iter().enumerate() {
                        ui.selectable_value(*method, number, *name);
                    }
                };
                combo.show_ui(ui, choices).response
            });
        }
        row(ui, "server resolution", "of the server's frames, relative to the picture", |ui| {
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
        for (name, is_orthographic) in [("Perspective", false), ("Parallel", true)] {
            ui.selectable_value(settings.is_orthographic, is_orthographic, name);
        }
    });
    let axes = settings.bindings.with_key("axes and scale", Action::Axes);
    let volume_box = settings.bindings.with_key("box", Action::Box);
    let aids = &mut *settings.aids;
    ui.horizontal(|ui| {
        controls::checkbox(ui, &mut aids.shows_axes, axes);
        controls::checkbox(ui, &mut aids.shows_box, volume_box);
        controls::checkbox(ui, &mut aids.shows_legend, settings.bindings.with_key("legend", Action::Legend));
    });
    ui.horizontal(|ui| {
        ui.label("background");
        for (name, color) in BACKGROUNDS {
            ui.selectable_value(&mut aids.background, color, name);
        }
        color_well::show(ui, &mut aids.background, "background colour");
    });
    ui.horizontal(|ui| {
        ui.label("theme");
        let mut theme = ui.ctx().options(|o| o.theme_preference);
        for (name, wanted) in [
            ("Dark", egui::ThemePreference::Dark),
            ("Light", egui::ThemePreference::Light),
            ("System", egui::ThemePreference::System),
        ] {
            if ui.selectable_value(&mut theme, wanted, name).clicked() {
                ui.ctx().set_theme(wanted);
            }
        }
    });
    let reset = ui.button("Reset settings");
    let reset = reset.on_hover_text("theme, background, axes, box, legend and light");
    *settings.resets_choices |= reset.clicked();
}

const SECTIONS: [&str; 8] =
    ["Presets", "Channels", "Transfer function", "Light", "Clip", "View", "Advanced", "State"];
/// In a narrower window the panel is a strip of icons, points.
const STRIP_BELOW: f32 = 800.0;
/// Room for nine points of a curve, points.
const PANEL_WIDTH: f32 = 336.0;
const LEAST_WIDTH: f32 = 280.0;
