//! Controls that choose a part of a file: its time, and lists of channels, levels and series.

use egui::{ComboBox, Response, RichText, Role, Ui};

use super::controls::whole;
use super::style::{named, quiet};

pub(crate) fn time_field(ui: &mut Ui, time: &mut u32, last: u32) -> Response {
    let field = whole(ui, time, 0..=last);
    let field = ui.add(field);
    named(&field, Role::SpinButton, "time");
    field
}

/// A list of `number` entries; whether the person chooses another one.
pub(crate) fn list(
    ui: &mut Ui,
    what: &str,
    number: usize,
    chosen: &mut u32,
    name: impl Fn(u32) -> String,
) -> bool {
    label(ui, what);
    let before = *chosen;
    let combo = ComboBox::from_id_salt(what).width(LIST_WIDTH).truncate().selected_text(name(before));
    let combo = combo.show_ui(ui, |ui| {
        for i in 0..number.min(MAX_ENTRIES) as u32 {
            ui.selectable_value(chosen, i, name(i));
        }
    });
    named(&combo.response, Role::ComboBox, what);
    *chosen != before
}

pub(crate) fn label(ui: &mut Ui, text: &str) {
    let color = quiet(ui.ctx());
    ui.label(RichText::new(text).size(12.0).color(color));
}

/// The number of an entry and its name, unless the name is the number.
pub(crate) fn numbered(i: u32, name: Option<&String>) -> String {
    match name {
        Some(name) if *name != i.to_string() => format!("{i}: {name}"),
        _ => i.to_string(),
    }
}

/// Width of a list, points.
const LIST_WIDTH: f32 = 130.0;
/// Entries of a list, at most.
const MAX_ENTRIES: usize = 4096;
