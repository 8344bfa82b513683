//! The part of a file to read: channel, time, level, series and region.

use egui::Ui;
use isinglass_formats::{Outline, Region, Selection};

use crate::panels::controls::{self, whole};
use crate::panels::part_pickers::{channel_list, label, list, numbered, time_field};
use crate::panels::style::named;

/// The person's choices, and what the file offers.
#[derive(Default)]
pub(crate) struct SelectionForm {
    chosen: Selection,
    outline: Option<Outline>,
    region: [[u32; 2]; 3],
    takes_region: bool,
    /// Whether to open the volume as soon as its header is read.
    pub(crate) opens_when_read: bool,
}

impl SelectionForm {
    pub(crate) fn selection(&self) -> Selection {
        let [x, y, z] = self.region;
        let region = Region { min: [x[0], y[0], z[0]], max: [Some(x[1]), Some(y[1]), Some(z[1])] };
        Selection { region: self.takes_region.then_some(region), ..self.chosen }
    }

    pub(crate) fn learn(&mut self, outline: &Outline) {
        if self.outline.as_ref().is_none_or(|o| o.whole_dims != outline.whole_dims) {
            self.region = outline.whole_dims.map(|n| [0, u32::try_from(n).unwrap_or(u32::MAX)]);
        }
        self.outline = Some(outline.clone());
    }

    pub(crate) fn show(&mut self, ui: &mut Ui) {
        let Some(outline) = &self.outline else { return };
        let Outline { shown, channels, num_channels, joins_channels, .. } = outline;
        let Outline { num_times, levels, series, whole_dims, .. } = outline;
        let chosen = &mut self.chosen;
        let level = |i: u32| match levels.get(i as usize) {
            Some(isinglass_formats::Level { dims: [x, y, z], .. }) => format!("{i}: {x}×{y}×{z}"),
            None => String::new(),
        };
        let channel = |i: u32| numbered(i, channels.get(i as usize));
        let one_series = |i: u32| numbered(i, series.get(i as usize));
        ui.horizontal_wrapped(|ui| {
            if choose(ui, "series", series.len(), &mut chosen.series, shown.series, one_series) {
                // Another series has its own channels, times and levels.
                *chosen = Selection { series: chosen.series, ..Selection::default() };
                self.takes_region = false;
            }
            if choose(ui, "level", levels.len(), &mut chosen.level, shown.level, level) {
                self.takes_region = false;
            }
            if *num_channels > 1 {
                if !joins_channels {
                    chosen.channel = chosen.channel.or(shown.channel);
                }
                channel_list(ui, *num_channels as usize, *joins_channels, &mut chosen.channel, channel);
            }
            if *num_times > 1 {
                label(ui, "time");
                let mut time = chosen.time.or(shown.time).unwrap_or(0);
                let last = u32::try_from(num_times - 1).unwrap_or(u32::MAX);
                if time_field(ui, &mut time, last).changed() {
                    chosen.time = Some(time);
                }
                label(ui, &format!("of 0 to {last}"));
            }
        });
        ui.horizontal_wrapped(|ui| {
            controls::checkbox(ui, &mut self.takes_region, "only a region")
                .on_hover_text("voxels along x, y and z");
            if !self.takes_region {
                return;
            }
            for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
                let most = u32::try_from(whole_dims[axis]).unwrap_or(u32::MAX);
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

/// A list of `number` entries, if there are several. Returns whether the person chooses another entry.
fn choose(
    ui: &mut Ui,
    what: &str,
    number: usize,
    chosen: &mut Option<u32>,
    shown: Option<u32>,
    name: impl Fn(u32) -> String,
) -> bool {
    let mut index = chosen.or(shown).unwrap_or(0);
    let is_other = number > 1 && list(ui, what, number, &mut index, name);
    if is_other {
        *chosen = Some(index);
    }
    is_other
}
