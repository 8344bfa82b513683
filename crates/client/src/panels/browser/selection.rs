//! What to take of a file before it is read: channel, time, level, series and region.

use egui::{RichText, Ui};
use isinglass_formats::{Outline, Region, Selection};

use crate::number::reader;
use crate::panels::{named, quiet};

/// The choices of a person, and what the file leaves to choose.
#[derive(Default)]
pub(crate) struct SelectionForm {
    chosen: Selection,
    /// As the header last said.
    choices: Option<Choices>,
    region: [[u32; 2]; 3],
    takes_region: bool,
    /// Whether it was asked to be opened before the header was read.
    pub(crate) opens_when_read: bool,
}

struct Choices {
    shown: Selection,
    whole_dims: [u32; 3],
    channels: Vec<String>,
    num_times: u32,
    levels: Vec<String>,
    series: Vec<String>,
}

impl SelectionForm {
    /// What was chosen.
    pub(crate) fn selection(&self) -> Selection {
        let [x, y, z] = self.region;
        let region = Region { min: [x[0], y[0], z[0]], max: [Some(x[1]), Some(y[1]), Some(z[1])] };
        Selection { region: self.takes_region.then_some(region), ..self.chosen }
    }

    /// Learns what there is.
    pub(crate) fn learn(&mut self, outline: &Outline) {
        let dims = outline.whole_dims.map(|n| u32::try_from(n).unwrap_or(u32::MAX));
        if self.choices.as_ref().is_none_or(|c| c.whole_dims != dims) {
            self.region = dims.map(|n| [0, n]);
        }
        let channels = match outline.num_channels {
            0 | 1 => Vec::new(),
            n => (0..n.min(MAX_ENTRIES))
                .map(|i| numbered(i as usize, outline.channels.get(i as usize)))
                .collect(),
        };
        let level = |(i, l): (usize, &isinglass_formats::Level)| {
            format!("{i}: {}×{}×{}", l.dims[0], l.dims[1], l.dims[2])
        };
        self.choices = Some(Choices {
            shown: outline.shown,
            whole_dims: dims,
            channels,
            num_times: u32::try_from(outline.num_times).unwrap_or(u32::MAX),
            levels: outline.levels.iter().enumerate().map(level).collect(),
            series: outline.series.iter().enumerate().map(|(i, s)| numbered(i, Some(s))).collect(),
        });
    }

    /// Shows what there is to choose.
    pub(crate) fn show(&mut self, ui: &mut Ui) {
        let Some(choices) = &self.choices else { return };
        let chosen = &mut self.chosen;
        ui.horizontal_wrapped(|ui| {
            let list =
                |ui: &mut Ui, what: &str, names: &[String], of: &mut Option<u32>, shown: Option<u32>| {
                    if names.len() < 2 {
                        return false;
                    }
                    label(ui, what);
                    let mut index = of.or(shown).unwrap_or(0) as usize;
                    let before = index;
                    let text = names.get(index).map_or("", String::as_str);
                    let combo = egui::ComboBox::from_id_salt(("selection", what)).width(120.0).truncate();
                    let combo = combo.selected_text(text).show_ui(ui, |ui| {
                        for (i, name) in names.iter().enumerate() {
                            ui.selectable_value(&mut index, i, name);
                        }
                    });
                    named(&combo.response, egui::Role::ComboBox, what);
                    if index != before {
                        *of = Some(index as u32);
                    }
                    index != before
                };
            if list(ui, "series", &choices.series, &mut chosen.series, choices.shown.series) {
                // Another series has channels, times and levels of its own.
                *chosen = Selection { series: chosen.series, ..Selection::default() };
                self.takes_region = false;
            }
            if list(ui, "level", &choices.levels, &mut chosen.level, choices.shown.level) {
                self.takes_region = false;
            }
            list(ui, "channel", &choices.channels, &mut chosen.channel, choices.shown.channel);
            if choices.num_times > 1 {
                label(ui, "time");
                let mut time = chosen.time.or(choices.shown.time).unwrap_or(0);
                let last = choices.num_times - 1;
                let number = egui::DragValue::new(&mut time).range(0..=last).update_while_editing(false);
                let number = ui.add(number.custom_parser(reader(ui)));
                named(&number, egui::Role::SpinButton, "time");
                if number.changed() {
                    chosen.time = Some(time);
                }
                label(ui, &format!("of 0 to {last}"));
            }
        });
        ui.horizontal_wrapped(|ui| {
            ui.checkbox(&mut self.takes_region, "only a region").on_hover_text("voxels along x, y and z");
            if !self.takes_region {
                return;
            }
            for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
                let most = choices.whole_dims[axis];
                let [from, to] = &mut self.region[axis];
                label(ui, name);
                let first = egui::DragValue::new(from).range(0..=to.saturating_sub(1));
                let first = ui.add(first.update_while_editing(false).custom_parser(reader(ui)));
                named(&first, egui::Role::SpinButton, &format!("first {name}"));
                label(ui, "to");
                let last = egui::DragValue::new(to).range(*from + 1..=most).update_while_editing(false);
                let last = ui.add(last.custom_parser(reader(ui)));
                named(&last, egui::Role::SpinButton, &format!("end of {name}"));
            }
        });
    }
}

fn numbered(i: usize, name: Option<&String>) -> String {
    match name {
        Some(name) if *name != i.to_string() => format!("{i}: {name}"),
        _ => i.to_string(),
    }
}

fn label(ui: &mut Ui, text: &str) {
    let color = quiet(ui.ctx());
    ui.label(RichText::new(text).size(12.0).color(color));
}

/// Entries of a list.
const MAX_ENTRIES: u64 = 4096;
