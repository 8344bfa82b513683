//! Hints over the picture in the first starts. Each goes once the person has done what it says.

use egui::{Align2, RichText, vec2};
use lucide_icons::Icon;

use super::style::{accent, bright, icon, pane};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Hint {
    Turn,
    Zoom,
    Menu,
}

impl Hint {
    pub(crate) const ALL: [Self; 3] = [Self::Turn, Self::Zoom, Self::Menu];

    /// The word for it in the file of hints.
    pub(crate) fn word(self) -> &'static str {
        match self {
            Self::Turn => "turn",
            Self::Zoom => "zoom",
            Self::Menu => "menu",
        }
    }

    fn text(self) -> (Icon, &'static str) {
        match self {
            Self::Turn => (Icon::Rotate3d, "drag to turn"),
            Self::Zoom => (Icon::Mouse, "wheel to zoom"),
            Self::Menu => (Icon::MousePointerClick, "right button for the menu"),
        }
    }
}

/// The hints that are left; none at first.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Hints {
    left: Vec<Hint>,
}

impl Hints {
    pub(crate) fn of(left: Vec<Hint>) -> Self {
        Self { left }
    }

    pub(crate) fn left(&self) -> &[Hint] {
        &self.left
    }

    /// The person has done it.
    pub(crate) fn note(&mut self, done: Hint) {
        self.left.retain(|hint| *hint != done);
    }

    /// Shows what is left at the bottom of `room`.
    pub(crate) fn show(&self, ctx: &egui::Context, room: egui::Rect) {
        if self.left.is_empty() {
            return;
        }
        let area = egui::Area::new(egui::Id::unique("hints")).constrain_to(room);
        let area = area.anchor(Align2::CENTER_BOTTOM, vec2(0.0, -12.0)).interactable(false);
        area.show(ctx, |ui| {
            pane(ctx).show(ui, |ui| {
                // One line, or one below the other where that has no room.
                if room.width() >= LEAST_WIDTH_OF_LINE {
                    ui.horizontal(|ui| self.lines(ui));
                } else {
                    ui.vertical(|ui| self.lines(ui));
                }
            });
        });
    }

    fn lines(&self, ui: &mut egui::Ui) {
        ui.spacing_mut().item_spacing = vec2(16.0, 4.0);
        for hint in &self.left {
            let (symbol, text) = hint.text();
            ui.horizontal(|ui| {
                ui.spacing_mut().item_spacing.x = 6.0;
                ui.label(icon(symbol).color(accent(ui.ctx())));
                ui.label(RichText::new(text).color(bright(ui.ctx())));
            });
        }
    }
}

/// The hints are in one line in rooms at least this wide, points.
const LEAST_WIDTH_OF_LINE: f32 = 480.0;
