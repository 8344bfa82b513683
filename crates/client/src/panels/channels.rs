//! The channels of a volume: which are shown, in which colours, and how they count together; and the list of labels.

use egui::{RichText, Role, ScrollArea, Sense, Ui, WidgetInfo, vec2};
use isinglass_core::channels::Blend;
use isinglass_core::look::Look;
use isinglass_core::volume::label_color;
use isinglass_core::wire::ChannelDescription;

use super::color_well;
use super::controls::{self, percent, row};
use super::style::quiet;

/// Shows a row for each channel, and changes the look. The name of a channel chooses it: the curve and the modes are
/// those of the chosen one.
pub(crate) fn show(ui: &mut Ui, channels: &[ChannelDescription], look: &mut Look) {
    look.channels.complete(channels.len(), &look.transfer);
    for (number, channel) in channels.iter().enumerate() {
        let index = number as u8;
        ui.horizontal(|ui| {
            let name = &channel.name;
            if let Some(visibility) = look.channels.visibility_mut(number) {
                let mut is_shown = !visibility.is_hidden;
                let shown = controls::checkbox(ui, &mut is_shown, "");
                let hint = format!("show {name}");
                shown.widget_info(|| WidgetInfo::selected(Role::CheckBox, true, is_shown, &hint));
                shown.on_hover_text(&hint);
                visibility.is_hidden = !is_shown;
            }
            if channel.are_labels {
                ui.label(RichText::new("labels").color(quiet(ui.ctx())).size(11.0));
            } else {
                color(ui, look, index, name);
            }
            let is_chosen = channels.len() > 1 && look.channels.chosen == index;
            let chosen = ui.selectable_label(is_chosen, name);
            if chosen.on_hover_text("edit this channel's curve").clicked() {
                look.channels.chosen = index;
            }
        });
    }
    if channels.len() > 1 {
        ui.horizontal(|ui| {
            ui.label("blend");
            for blend in Blend::ALL {
                let hint = match blend {
                    Blend::Additive => "light adds up: red and green make yellow",
                    Blend::Over => "matter mixes: each channel hides what is behind it",
                };
                let button = ui.selectable_value(&mut look.channels.blend, blend, title_of(blend));
                button.on_hover_text(hint);
            }
        });
    }
    for (number, channel) in channels.iter().enumerate().filter(|(_, channel)| channel.are_labels) {
        labels(ui, number, channel, look);
    }
}

/// Whether the values of the chosen channel are labels.
pub(crate) fn chosen_are_labels(channels: &[ChannelDescription], look: &Look) -> bool {
    channels.get(usize::from(look.channels.chosen)).is_some_and(|channel| channel.are_labels)
}

fn title_of(blend: Blend) -> &'static str {
    match blend {
        Blend::Additive => "Additive",
        Blend::Over => "Over",
    }
}

/// The colour of a channel: that of its greatest values. A new one is given to all of them.
fn color(ui: &mut Ui, look: &mut Look, channel: u8, name: &str) {
    let points = &mut look.transfer_of_mut(channel).points;
    let Some(last) = points.last() else { return };
    let mut rgb = last.color.map(|c| (c * 255.0).round() as u8);
    if color_well::show(ui, &mut rgb, &format!("colour of {name}")) {
        let color = rgb.map(|c| f32::from(c) / 255.0);
        points.iter_mut().for_each(|point| point.color = color);
    }
}

/// The labels of a channel, each to switch on or off, and their opacity.
fn labels(ui: &mut Ui, number: usize, channel: &ChannelDescription, look: &mut Look) {
    row(ui, "opacity", "of the labels, for each voxel", |ui| {
        let points = &mut look.transfer_of_mut(number as u8).points;
        let mut opacity = points.iter().map(|p| p.opacity).fold(0.0, f32::max);
        let slider = percent(ui, &mut opacity, 0.0..=100.0);
        if slider.changed() {
            points.iter_mut().for_each(|point| point.opacity = opacity);
        }
        slider
    });
    let Some(visibility) = look.channels.visibility_mut(number) else { return };
    let known: Vec<(u16, String)> = known_labels(channel);
    ui.horizontal(|ui| {
        if ui.button("All").on_hover_text("show all labels").clicked() {
            visibility.hidden_labels.clear();
        }
        if ui.button("None").on_hover_text("hide all labels").clicked() {
            for (label, _) in &known {
                visibility.set_label(*label, false);
            }
        }
    });
    let area = ScrollArea::vertical().id_salt(("labels", number)).max_height(LIST_HEIGHT);
    area.show_rows(ui, ui.spacing().interact_size.y, known.len(), |ui, rows| {
        for (label, name) in &known[rows] {
            ui.horizontal(|ui| {
                let [r, g, b] = label_color(u32::from(*label), &channel.labels);
                let (rect, _) = ui.allocate_exact_size(vec2(14.0, 14.0), Sense::hover());
                ui.painter().rect_filled(rect, 3.0, egui::Color32::from_rgb(r, g, b));
                let mut is_shown = visibility.hidden_labels.binary_search(label).is_err();
                if controls::checkbox(ui, &mut is_shown, name).changed() {
                    visibility.set_label(*label, is_shown);
                }
            });
        }
    });
}

/// Those that the file names, or else the values that the histogram counts.
fn known_labels(channel: &ChannelDescription) -> Vec<(u16, String)> {
    let is_node = |value: u32| u16::try_from(value).ok().filter(|label| (1..MOST_LABELS).contains(label));
    if !channel.labels.is_empty() {
        let named = channel.labels.iter().filter_map(|l| Some((is_node(l.value)?, l.name.clone())));
        return named.collect();
    }
    let ((lo, hi), num_bins) = (channel.histogram_range, channel.histogram.len());
    let is_exact = hi - lo + 1.0 == num_bins as f32;
    // Bins of floats have other borders by a rounding; where there are many more than values, the next ones count too.
    let reach = usize::from(!is_exact && (hi - lo) * 4.0 < num_bins as f32);
    let occurs = |value: f32| {
        let share = if is_exact { value - lo } else { (value - lo) / (hi - lo) * num_bins as f32 };
        let bin = (share as usize).min(num_bins.saturating_sub(1));
        let bins = bin.saturating_sub(reach)..=(bin + reach).min(num_bins.saturating_sub(1));
        channel.histogram.get(bins).is_some_and(|counts| counts.iter().any(|count| *count > 0))
    };
    let last = hi.clamp(0.0, f32::from(MOST_LABELS - 1)) as u32;
    let each = (1..=last).filter(|value| *value as f32 >= lo && occurs(*value as f32)).filter_map(is_node);
    each.map(|label| (label, format!("label {label}"))).collect()
}

/// Labels that can be switched one by one.
const MOST_LABELS: u16 = isinglass_core::transfer::LABEL_NODES as u16;
const LIST_HEIGHT: f32 = 260.0;

#[cfg(test)]
mod tests {
    use egui_kittest::Harness;
    use egui_kittest::kittest::Queryable;
    use isinglass_core::channels::{ChannelLook, Channels, Visibility};
    use isinglass_core::volume::VolumeLabel;
    use isinglass_formats::preset;

    use super::*;

    fn channel(name: &str, are_labels: bool) -> ChannelDescription {
        let label = |value, name: &str| VolumeLabel { value, name: name.into(), color: None };
        ChannelDescription {
            name: name.into(),
            value_range: (0.0, 3.0),
            histogram_range: (0.0, 3.0),
            histogram: vec![5, 0, 2, 9],
            are_labels,
            labels: if are_labels { vec![label(2, "liver"), label(3, "spleen")] } else { Vec::new() },
        }
    }

    fn harness(channels: Vec<ChannelDescription>) -> Harness<'static, Look> {
        let transfer = preset("fluorescence").expect("a preset");
        let other = || ChannelLook { transfer: transfer.clone(), visibility: Visibility::default() };
        let others = channels.iter().skip(1).map(|_| other()).collect();
        let look =
            Look { channels: Channels { others, ..Channels::default() }, ..Look::new(transfer.clone()) };
        let app = move |ui: &mut Ui, look: &mut Look| show(ui, &channels, look);
        Harness::builder().with_size(vec2(400.0, 600.0)).build_ui_state(app, look)
    }

    #[test]
    fn channels_are_hidden_chosen_and_blended() {
        let mut h = harness(vec![channel("nuclei", false), channel("membrane", false)]);
        let before = h.state().clone();
        h.run();
        assert_eq!(*h.state(), before, "looking changes nothing");
        h.get_by_label("membrane").click();
        h.run();
        assert_eq!(h.state().channels.chosen, 1);
        h.get_by_label("Over").click();
        h.run();
        assert_eq!(h.state().channels.blend, Blend::Over);
        h.get_by_label("show nuclei").click();
        h.run();
        assert!(h.state().channels.first.is_hidden && !h.state().channels.others[0].visibility.is_hidden);
        assert!(h.query_by_label("colour of nuclei").is_some());
    }

    #[test]
    fn labels_are_listed_and_switched() {
        let mut h = harness(vec![channel("scan", false), channel("organs", true)]);
        h.run();
        h.get_by_label("spleen").click();
        h.run();
        let hidden = |h: &Harness<'_, Look>| h.state().channels.others[0].visibility.hidden_labels.clone();
        assert_eq!(hidden(&h), [3]);
        h.get_by_label("None").click();
        h.run();
        assert_eq!(hidden(&h), [2, 3]);
        h.get_by_label("All").click();
        h.run();
        assert!(hidden(&h).is_empty());
        assert!(h.query_by_label("colour of organs").is_none());
    }

    #[test]
    fn labels_without_names_are_those_that_occur() {
        let mut unnamed = channel("a", true);
        unnamed.labels.clear();
        let named: Vec<_> = known_labels(&unnamed);
        assert_eq!(named, [(2, "label 2".to_owned()), (3, "label 3".to_owned())]);
        // Bins of floats are much narrower than one.
        let mut counts = vec![0; 512];
        (counts[0], counts[341], counts[511]) = (5, 2, 9);
        unnamed.histogram = counts;
        assert_eq!(known_labels(&unnamed), named);
    }
}
