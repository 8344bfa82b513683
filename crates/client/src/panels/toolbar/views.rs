//! The menu *Views*: sides, steps of the camera, the axis that points up, and views with a name.

use egui::containers::menu::{MenuButton, MenuConfig};
use egui::{PopupCloseBehavior, Role, TextEdit, Ui};
use isinglass_formats::{MAX_VIEWS, UpAxis, is_view_name};
use lucide_icons::Icon;

use super::{Toolbar, ToolbarWish};
use crate::input::bindings::{Action, Side};
use crate::panels::style::{icon, named};

/// What to do with views that have a name.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum NamedViewWish {
    Remember(String),
    Show(usize),
    Remove(usize),
}

impl Toolbar<'_> {
    pub(super) fn views(&self, ui: &mut Ui, has_word: bool, wish: &mut Option<ToolbarWish>) {
        let symbol = icon(Icon::Rotate3d);
        let button = match has_word {
            true => egui::Button::new((symbol, "Views", super::down())),
            false => egui::Button::new(symbol),
        };
        // A name is written in the menu, so a click inside does not close it.
        let config = MenuConfig::new().close_behavior(PopupCloseBehavior::CloseOnClickOutside);
        let (response, _) = MenuButton::from_button(button).config(config).ui(ui, |ui| {
            self.sides(ui, wish);
            self.item(ui, "Isometric", Action::Isometric, wish);
            ui.separator();
            self.item(ui, "Fit the volume", Action::Fit, wish);
            self.item(ui, "Previous view", Action::PreviousView, wish);
            self.item(ui, "Next view", Action::NextView, wish);
            ui.separator();
            let projection = if self.is_orthographic { "Perspective" } else { "Parallel" };
            self.item(ui, projection, Action::Projection, wish);
            self.item(ui, "Next kind of stereo", Action::Stereo, wish);
            ui.menu_button("Up", |ui| self.up_axes(ui, wish));
            if let Some(flip) = self.flip {
                let menu = ui.menu_button("Mirror", |ui| self.mirrors(ui, flip, wish));
                menu.response.on_hover_text("where the file tells its directions wrongly");
            }
            ui.separator();
            self.named_views(ui, wish);
        });
        named(&response, Role::Button, "Views");
        if !has_word {
            response.on_hover_text("Views");
        }
    }

    pub(super) fn sides(&self, ui: &mut Ui, wish: &mut Option<ToolbarWish>) {
        for (name, side, opposite) in [
            ("Front", Side::Front, false),
            ("Back", Side::Front, true),
            ("Right", Side::Right, false),
            ("Left", Side::Right, true),
            ("Top", Side::Top, false),
            ("Bottom", Side::Top, true),
        ] {
            self.item(ui, name, Action::StandardView(side, opposite), wish);
        }
    }

    fn up_axes(&self, ui: &mut Ui, wish: &mut Option<ToolbarWish>) {
        for axis in UpAxis::ALL {
            let name = match axis.direction() {
                Some(up) => {
                    let number = up.abs().max_position();
                    self.axes.name(number, up[number] > 0.0)
                }
                None => "As in the file".to_owned(),
            };
            if ui.selectable_label(axis == self.up, name).clicked() {
                *wish = Some(ToolbarWish::TurnUp(axis));
                ui.close();
            }
        }
    }

    /// A line for each axis along which the volume can be mirrored.
    fn mirrors(&self, ui: &mut Ui, flip: [bool; 3], wish: &mut Option<ToolbarWish>) {
        for axis in 0..3 {
            let name = format!("Along {}", self.axes.axis_name(axis));
            if ui.selectable_label(flip[axis], name).clicked() {
                let mut flip = flip;
                flip[axis] = !flip[axis];
                *wish = Some(ToolbarWish::Mirror(flip));
                ui.close();
            }
        }
    }

    /// A line for each view with a name, and one for the name of a new one.
    fn named_views(&self, ui: &mut Ui, wish: &mut Option<ToolbarWish>) {
        let mut chosen = None;
        for (number, name) in self.named_views.iter().enumerate() {
            ui.horizontal(|ui| {
                if ui.button(*name).on_hover_text("show this view").clicked() {
                    chosen = Some(NamedViewWish::Show(number));
                    ui.close();
                }
                let remove = ui.add(egui::Button::new(icon(Icon::Trash2)).frame_when_inactive(false));
                named(&remove, Role::Button, &format!("remove the view {name}"));
                if remove.on_hover_text("remove").clicked() {
                    chosen = Some(NamedViewWish::Remove(number));
                }
            });
        }
        if self.named_views.len() < MAX_VIEWS {
            let id = ui.scope_id().with("name of a new view");
            let mut text = ui.data(|data| data.get_temp::<String>(id)).unwrap_or_default();
            ui.horizontal(|ui| {
                let field = ui.add(TextEdit::singleline(&mut text).desired_width(130.0).hint_text("name"));
                named(&field, Role::TextInput, "name of the present view");
                let is_entered = field.lost_focus() && ui.input(|i| i.key_pressed(egui::Key::Enter));
                let can_keep = is_view_name(&text);
                let keep = ui.add_enabled(can_keep, egui::Button::new("Remember"));
                let keep = keep.on_hover_text("keep the present view under this name");
                if keep.clicked() || (is_entered && can_keep) {
                    let name = std::mem::take(&mut text).trim().to_owned();
                    chosen = Some(NamedViewWish::Remember(name));
                    ui.close();
                }
            });
            ui.data_mut(|data| data.insert_temp(id, text));
        }
        if let Some(chosen) = chosen {
            *wish = Some(ToolbarWish::View(chosen));
        }
    }
}
