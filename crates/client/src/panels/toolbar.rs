//! The bar at the top: a button or menu for what is done most. Each stands for an action that a key does too.

mod views;

use egui::{Role, Ui};
use isinglass_core::mode::Mode;
use isinglass_formats::UpAxis;
use lucide_icons::Icon;

use super::style::{ICON_SIZE, icon, named};
use super::text::mode_name;
use crate::input::bindings::{Action, Bindings};
use crate::input::orientation::Orientation;

pub(crate) use views::NamedViewWish;

/// What the bar shows.
pub(crate) struct Toolbar<'a> {
    pub(crate) bindings: &'a Bindings,
    /// None before the volume is known.
    pub(crate) mode: Option<Mode>,
    pub(crate) is_orthographic: bool,
    pub(crate) has_clip_handles: bool,
    pub(crate) has_probe: bool,
    pub(crate) is_measuring: bool,
    pub(crate) is_recording: bool,
    /// Whether the way of the camera was recorded.
    pub(crate) has_path: bool,
    pub(crate) shows_axes: bool,
    pub(crate) shows_box: bool,
    pub(crate) shows_slices: bool,
    pub(crate) is_look_open: bool,
    /// Whether this window can open other volumes and servers.
    pub(crate) opens_volumes: bool,
    pub(crate) axes: Orientation,
    pub(crate) up: UpAxis,
    /// The axes along which the volume is mirrored; `None` if the server does not let viewers choose.
    pub(crate) flip: Option<[bool; 3]>,
    /// Names of remembered views.
    pub(crate) named_views: Vec<&'a str>,
}

/// What the person chose.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum ToolbarWish {
    Act(Action),
    Show(Mode),
    /// Ask for the movie of the recorded path.
    MovieOfPath,
    TurnUp(UpAxis),
    /// Mirror the volume along these of its axes.
    Mirror([bool; 3]),
    View(NamedViewWish),
}

impl Toolbar<'_> {
    /// Shows the bar in a line. Menus have no words in a narrow window, and switches are left out in a narrower one.
    pub(crate) fn show(&self, ui: &mut Ui) -> Option<ToolbarWish> {
        let mut wish = None;
        let width = ui.available_width();
        let has_words = width >= LEAST_WIDTH_WITH_WORDS;
        ui.horizontal_centered(|ui| {
            ui.spacing_mut().item_spacing.x = 2.0;
            self.files(ui, has_words, &mut wish);
            ui.separator();
            self.button(ui, Icon::Undo2, "undo", Action::Undo, &mut wish);
            self.button(ui, Icon::Redo2, "redo", Action::Redo, &mut wish);
            self.button(ui, Icon::House, "first view", Action::FirstView, &mut wish);
            self.button(ui, Icon::Focus, "fit the volume", Action::Fit, &mut wish);
            self.views(ui, has_words, &mut wish);
            ui.separator();
            self.modes(ui, has_words, &mut wish);
            for (symbol, name, action, is_on) in [
                (Icon::Grid2x2, "slices", Action::Slices, self.shows_slices),
                (Icon::Crop, "clip", Action::Clip, self.has_clip_handles),
                (Icon::Pipette, "probe values", Action::Probe, self.has_probe),
                (Icon::Ruler, "measure", Action::Measure, self.is_measuring),
                (Icon::Box, "box", Action::Box, self.shows_box),
                (Icon::Axis3d, "axes and scale", Action::Axes, self.shows_axes),
            ] {
                // What has no room is in the menu of the picture.
                if width >= LEAST_WIDTH_WITH_SWITCHES {
                    self.toggle(ui, symbol, name, action, is_on, &mut wish);
                }
            }
            let right = egui::Layout::right_to_left(egui::Align::Center);
            ui.with_layout(right, |ui| {
                ui.spacing_mut().item_spacing.x = 2.0;
                self.button(ui, Icon::CircleQuestionMark, "keys and mouse", Action::Help, &mut wish);
                let panel = Icon::SlidersHorizontal;
                self.toggle(ui, panel, "look", Action::LookPanel, self.is_look_open, &mut wish);
                self.button(ui, Icon::Fullscreen, "full screen", Action::FullScreen, &mut wish);
            });
        });
        wish
    }

    /// The menu behind the right mouse button in the picture.
    pub(crate) fn show_menu(&self, ui: &mut Ui) -> Option<ToolbarWish> {
        let mut wish = None;
        let projection = if self.is_orthographic { "Perspective" } else { "Parallel" };
        for (name, action) in [
            ("First view", Action::FirstView),
            ("Fit the volume", Action::Fit),
            ("Previous view", Action::PreviousView),
            (projection, Action::Projection),
        ] {
            self.item(ui, name, action, &mut wish);
        }
        ui.menu_button("View from", |ui| self.sides(ui, &mut wish));
        ui.separator();
        for (name, action) in [
            ("Slices", Action::Slices),
            ("Clip", Action::Clip),
            ("Probe values", Action::Probe),
            ("Measure", Action::Measure),
            ("Legend of the colours", Action::Legend),
            ("Save a picture", Action::Picture),
            ("Copy a link to the view", Action::CopyLink),
            ("Full screen", Action::FullScreen),
        ] {
            self.item(ui, name, action, &mut wish);
        }
        wish
    }

    fn files(&self, ui: &mut Ui, has_words: bool, wish: &mut Option<ToolbarWish>) {
        self.open(ui, has_words, wish);
        menu(ui, Icon::Save, "Save", has_words, |ui| {
            self.item(ui, "State of the view", Action::SaveState, wish);
            self.item(ui, "Copy a link to the view", Action::CopyLink, wish);
        });
        menu(ui, Icon::Camera, "Picture", has_words, |ui| {
            self.item(ui, "Save a picture", Action::Picture, wish);
            self.item(ui, "Other size, or a turntable…", Action::PictureDialog, wish);
            let record = if self.is_recording { "End the recording" } else { "Record a path" };
            self.item(ui, record, Action::RecordPath, wish);
            let movie = ui.add_enabled(self.has_path, egui::Button::new("Movie of the path…"));
            named(&movie, Role::Button, "Movie of the path…");
            if movie.on_disabled_hover_text("record a path first").clicked() {
                *wish = Some(ToolbarWish::MovieOfPath);
                ui.close();
            }
        });
    }

    /// The page of all that can be opened, or the list of files where only files open.
    fn open(&self, ui: &mut Ui, has_word: bool, wish: &mut Option<ToolbarWish>) {
        let (hint, action) = match self.opens_volumes {
            true => ("a file, a server or a sample", Action::Start),
            false => ("a file", Action::OpenFile),
        };
        let symbol = icon(Icon::FolderOpen);
        let response = if has_word { ui.button((symbol, "Open")) } else { ui.button(symbol) };
        named(&response, Role::Button, "Open");
        if response.on_hover_text(self.bindings.with_key(hint, action)).clicked() {
            *wish = Some(ToolbarWish::Act(action));
        }
    }

    fn modes(&self, ui: &mut Ui, has_words: bool, wish: &mut Option<ToolbarWish>) {
        let Some(shown) = self.mode else { return };
        menu(ui, Icon::Layers, "Mode", has_words, |ui| {
            for each in Mode::ALL {
                if ui.selectable_label(each == shown, mode_name(each)).clicked() {
                    *wish = Some(ToolbarWish::Show(each));
                    ui.close();
                }
            }
        });
    }

    /// A line of a menu, with its key at the right.
    fn item(&self, ui: &mut Ui, name: &str, action: Action, wish: &mut Option<ToolbarWish>) {
        let button = egui::Button::new(name).right_text(self.bindings.hint(action));
        let response = ui.add(button);
        named(&response, Role::Button, name);
        if response.clicked() {
            *wish = Some(ToolbarWish::Act(action));
            ui.close();
        }
    }

    fn button(&self, ui: &mut Ui, symbol: Icon, name: &str, action: Action, wish: &mut Option<ToolbarWish>) {
        let response = ui.add(egui::Button::new(icon(symbol)).frame_when_inactive(false));
        named(&response, Role::Button, name);
        if response.on_hover_text(self.bindings.with_key(name, action)).clicked() {
            *wish = Some(ToolbarWish::Act(action));
        }
    }

    fn toggle(
        &self,
        ui: &mut Ui,
        symbol: Icon,
        name: &str,
        action: Action,
        is_on: bool,
        wish: &mut Option<ToolbarWish>,
    ) {
        let button = egui::Button::new(icon(symbol)).selected(is_on).frame_when_inactive(is_on);
        let response = ui.add(button);
        response.widget_info(|| egui::WidgetInfo::selected(Role::CheckBox, true, is_on, name));
        if response.on_hover_text(self.bindings.with_key(name, action)).clicked() {
            *wish = Some(ToolbarWish::Act(action));
        }
    }
}

fn menu(ui: &mut Ui, symbol: Icon, name: &str, has_word: bool, content: impl FnOnce(&mut Ui)) {
    let symbol = icon(symbol);
    let shown = match has_word {
        true => ui.menu_button((symbol, name, down()), content),
        false => ui.menu_button(symbol, content),
    };
    named(&shown.response, Role::Button, name);
    if !has_word {
        shown.response.on_hover_text(name);
    }
}

/// The sign of a menu.
fn down() -> egui::RichText {
    icon(Icon::ChevronDown).size(12.0)
}

/// Height of the bar, points.
pub(crate) const TOOLBAR_HEIGHT: f32 = ICON_SIZE + 20.0;
/// Switches are in bars at least this wide, points.
const LEAST_WIDTH_WITH_SWITCHES: f32 = 650.0;
/// Menus have words in bars at least this wide, points.
const LEAST_WIDTH_WITH_WORDS: f32 = 920.0;
