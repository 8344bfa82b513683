//! Single lines over the picture: news at the bottom, and at the top that the picture is older than the look.

use egui::{Align2, RichText, vec2};
use isinglass_net::State;

use super::style::{bright, pane, warning};

/// Shows news at the bottom, or trouble in amber.
pub(crate) fn show(ctx: &egui::Context, text: &str, is_trouble: bool, room: egui::Rect) {
    let area = egui::Area::new(egui::Id::unique("banner"));
    let area = area.constrain_to(room).anchor(Align2::CENTER_BOTTOM, vec2(0.0, -12.0));
    area.interactable(false).show(ctx, |ui| {
        pane(ctx).show(ui, |ui| {
            ui.set_max_width((room.width() - 40.0).max(100.0));
            let color = if is_trouble { warning(ui) } else { bright(ctx) };
            ui.label(RichText::new(text).color(color));
        });
    });
}

/// Shows at the top that the picture has an older look than was requested.
pub(crate) fn older_look(ctx: &egui::Context, is_of_volume: bool, state: &State, room: egui::Rect) {
    let area = egui::Area::new(egui::Id::unique("older look"));
    let area = area.constrain_to(room).anchor(Align2::CENTER_TOP, vec2(0.0, 12.0));
    area.interactable(false).show(ctx, |ui| {
        pane(ctx).show(ui, |ui| {
            ui.set_max_width((room.width() - 40.0).max(60.0));
            let what = if is_of_volume { "shown with the look before" } else { "the volume before" };
            let coming = match state {
                State::Connected => "the new one is on its way",
                State::Connecting { .. } | State::Reconnecting { .. } => {
                    "the new one waits until connected again"
                }
                State::Refused(_) => "there is no connection for the new one",
            };
            ui.label(RichText::new(format!("{what}; {coming}")).size(12.0));
        });
    });
}
