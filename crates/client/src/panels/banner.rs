//! Single lines over the picture: news at the bottom, and at the top that the picture is older than the look.

use egui::{Align2, RichText, vec2};
use isinglass_net::State;

use super::style::{amber, bright, named, pane};

/// Shows news at the bottom.
pub(crate) fn news(ctx: &egui::Context, text: &str, room: egui::Rect) {
    let area = egui::Area::new(egui::Id::unique("banner"));
    let area = area.constrain_to(room).anchor(Align2::CENTER_BOTTOM, vec2(0.0, -12.0));
    area.interactable(false).show(ctx, |ui| {
        pane(ctx).show(ui, |ui| {
            ui.set_max_width((room.width() - 40.0).max(100.0));
            ui.label(RichText::new(text).color(bright(ctx)));
        });
    });
}

/// Shows trouble at the bottom, in amber, with `details` to unfold. Where a window `takes_link`, a button pastes the
/// link of a server that was started again.
pub(crate) fn trouble(
    ctx: &egui::Context,
    text: &str,
    details: Option<&str>,
    takes_link: bool,
    room: egui::Rect,
) {
    let area = egui::Area::new(egui::Id::unique("trouble"));
    let area = area.constrain_to(room).anchor(Align2::CENTER_BOTTOM, vec2(0.0, -12.0));
    area.show(ctx, |ui| {
        pane(ctx).stroke(egui::Stroke::new(1.0, amber(ctx))).show(ui, |ui| {
            ui.set_max_width((room.width() - 40.0).clamp(100.0, 560.0));
            ui.label(RichText::new(text).color(amber(ctx)));
            if takes_link {
                let button = egui::Button::new("Paste new link");
                let button = ui.add(button).on_hover_text("connects, and keeps camera and look");
                named(&button, egui::Role::Button, "Paste new link");
                if button.clicked() {
                    ctx.send_viewport_cmd(egui::ViewportCommand::RequestPaste);
                }
            }
            if let Some(details) = details {
                let shown = ui.collapsing("Details", |ui| {
                    ui.add(egui::Label::new(RichText::new(details).monospace()).wrap());
                });
                named(&shown.header_response, egui::Role::Button, "Details");
            }
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
