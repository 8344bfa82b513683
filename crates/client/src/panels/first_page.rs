//! The page before the first picture.

use egui::{Color32, Ui, vec2};
use isinglass_net::State;

use super::style::{self, emblem};
use super::text::sentence;

pub(crate) fn show(ui: &mut Ui, server: &str, state: &State, seconds: f64, help: &str) {
    let rect = ui.max_rect();
    let painter = ui.painter();
    let ctx = ui.ctx();
    let (bright, quiet) = (style::bright(ctx), style::quiet(ctx));
    painter.rect_filled(rect, 0.0, style::surface(ctx));
    let center = rect.center();
    emblem(painter, center + vec2(0.0, -86.0), 1.0, ui.visuals().dark_mode);
    // Returns where the text ends.
    let text = |y: f32, s: &str, size: f32, color: Color32| {
        let wrapped =
            painter.layout(s.to_owned(), egui::FontId::proportional(size), color, rect.width() - 80.0);
        let (at, end) = (center + vec2(-wrapped.size().x * 0.5, y), wrapped.pos_from_cursor(wrapped.end()));
        painter.galley(at, wrapped, color);
        at + end.left_bottom().to_vec2()
    };
    text(-36.0, "isinglass", 30.0, bright);
    let (line, problem) = match state {
        State::Connecting { problem, .. } => (format!("connecting to {server}"), problem.as_ref()),
        State::Connected => (format!("{server} prepares the first picture"), None),
        State::Reconnecting { problem, .. } => (format!("connecting to {server} again"), Some(problem)),
        State::Refused(problem) => (format!("not connected to {server}"), Some(problem)),
    };
    let end = text(10.0, &line, 15.0, bright);
    if !matches!(state, State::Refused(_)) {
        // Beside the line, which stays in its place.
        let dots = &"..."[..1 + (seconds * 2.0) as usize % 3];
        let font = egui::FontId::proportional(15.0);
        painter.text(end + vec2(4.0, 0.0), egui::Align2::LEFT_BOTTOM, dots, font, bright);
    }
    if let Some(problem) = problem {
        text(38.0, &sentence(problem), 13.0, style::amber(ui.ctx()));
    }
    if !help.is_empty() {
        text(96.0, &format!("{help} shows the keys"), 12.0, quiet);
    }
}
