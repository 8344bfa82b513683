//! The part of a file to read: channel, time, level, series and region.

use egui::Ui;
use isinglass_formats::{Outline, Region, Selection};

use crate::panels::controls::whole;
use crate::panels::part_pickers::{MAX_ENTRIES, label, list, numbered, time_field};
use crate::panels::style::named;

/// The person's choices, and what the file offers.
#[derive(Default)]
pub(crate) struct SelectionForm {
    chosen: Selection,
    /// From the newest header.
    choices: Option<Choices>,
    region: [[u32; 2]; 3],
    takes_region: bool,
    /// Whether to open the volume as soon as its header is read.
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
    pub(crate) fn selection(&self) -> Selection {
        let [x, y, z] = self.region;
        let region = Region { min: [x[0], y[0], z[0]], max: [Some(x[1]), Some(y[1]), Some(z[1])] };
        Selection { region: self.takes_region.then_some(region), ..self.chosen }
    }

    /// Takes over what the file offers.
    pub(crate) fn learn(&mut self, outline: &Outline) {
        let dims = outline.whole_dims.map(|n| u32::try_from(n).unwrap_or(u32::MAX));
        if self.choices.as_ref().is_none_or(|c| c.whole_dims != dims) {
            self.region = dims.map(|n| [0, n]);
        }
        let channels = match outline.num_channels {
            0 | 1 => Vec::new(),
            n => (0..n.min(MAX_ENTRIES as u64) as u32)
                .map(|i| numbered(i, outline.channels.get(i as usize)))
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
            series: (0..).zip(&outline.series).map(|(i, s)| numbered(i, Some(s))).collect(),
        });
    }

    /// Shows the choices.
    pub(crate) fn show(&mut self, ui: &mut Ui) {
        let Some(choices) = &self.choices else { return };
        let chosen = &mut self.chosen;
        ui.horizontal_wrapped(|ui| {
            if choose(ui, "series", &choices.series, &mut chosen.series, choices.shown.series) {
                // Another series has its own channels, times and levels.
                *chosen = Selection { series: chosen.series, ..Selection::default() };
                self.takes_region = false;
            }
            if choose(ui, "level", &choices.levels, &mut chosen.level, choices.shown.level) {
                self.takes_region = false;
            }
            choose(ui, "channel", &choices.channels, &mut chosen.channel, choices.shown.channel);
            if choices.num_times > 1 {
                label(ui, "time");
                let mut time = chosen.time.or(choices.shown.time).unwrap_or(0);
                let last = choices.num_times - 1;
                if time_field(ui, &mut time, last).changed() {
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
                let first = whole(ui, from, 0..=to.saturating_sub(1));
                let first = ui.add(first);
                named(&first, egui::Role::SpinButton, &format!("first {name}"));
                label(ui, "to");
                let last = whole(ui, to, *from + 1..=most);
                let last = ui.add(last);
                named(&last, egui::Role::SpinButton, &format!("end of {name}"));
            }
        });
    }
}

/// A list of `names`, if there are several. Returns whether the person chooses another entry.
fn choose(ui: &mut Ui, what: &str, names: &[String], chosen: &mut Option<u32>, shown: Option<u32>) -> bool {
    let mut index = chosen.or(shown).unwrap_or(0);
    let name = |i: u32| names.get(i as usize).cloned().unwrap_or_default();
    let is_other = names.len() > 1 && list(ui, what, names.len(), &mut index, name);
    if is_other {
        *chosen = Some(index);
    }
    is_other
}
