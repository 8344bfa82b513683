//! Controls that choose a part of a file: its time, and lists of channels, levels and series.

use egui::{ComboBox, EventFilter, Key, Modifiers, Response, RichText, Role, Ui};

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
    let is_closed = combo.inner.is_none();
    if combo.response.has_focus() && is_closed {
        step_by_keys(ui, &combo.response, chosen, number.min(MAX_ENTRIES) as u32);
    }
    *chosen != before
}

/// A list of channels. Where they can be shown together, all of them come first, which no number stands for.
pub(crate) fn channel_list(
    ui: &mut Ui,
    number: usize,
    joins_channels: bool,
    chosen: &mut Option<u32>,
    name: impl Fn(u32) -> String,
) {
    let first = u32::from(joins_channels);
    let mut index = chosen.map_or(0, |channel| channel.saturating_add(first));
    let name = |i: u32| i.checked_sub(first).map_or_else(|| "all".to_owned(), &name);
    if list(ui, "channel", number + first as usize, &mut index, name) {
        *chosen = index.checked_sub(first);
    }
}

/// Up and down choose the entry before and the next one of a closed list, as everywhere in the system.
fn step_by_keys(ui: &Ui, list: &Response, chosen: &mut u32, number: u32) {
    let filter = EventFilter { vertical_arrows: true, ..Default::default() };
    ui.memory_mut(|m| m.set_focus_lock_filter(list.id, filter));
    let pressed = |key| ui.input_mut(|i| i.consume_key(Modifiers::NONE, key));
    if pressed(Key::ArrowUp) {
        *chosen = chosen.saturating_sub(1);
    }
    if pressed(Key::ArrowDown) {
        *chosen = (*chosen + 1).min(number.saturating_sub(1));
    }
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

#[cfg(test)]
mod tests {
    use egui_kittest::Harness;
    use egui_kittest::kittest::Queryable;

    use super::*;

    #[test]
    fn arrows_choose_in_a_closed_list_and_stop_at_its_ends() {
        let show = |ui: &mut Ui, chosen: &mut u32| {
            list(ui, "channel", 3, chosen, |i| format!("channel {i}"));
            _ = ui.button("other");
        };
        let mut h = Harness::new_ui_state(show, 0);
        let press = |h: &mut Harness<'_, u32>, key| {
            h.key_press_modifiers(Modifiers::NONE, key);
            h.run();
        };
        // Negative control: without the focus, arrows are for others.
        press(&mut h, Key::ArrowDown);
        assert_eq!(*h.state(), 0);
        h.get_by_role_and_label(Role::ComboBox, "channel").focus();
        h.run();
        for expected in [1, 2, 2] {
            press(&mut h, Key::ArrowDown);
            assert_eq!(*h.state(), expected);
        }
        press(&mut h, Key::ArrowUp);
        assert_eq!(*h.state(), 1);
        assert!(h.get_by_role_and_label(Role::ComboBox, "channel").is_focused(), "the list keeps the focus");
    }

    #[test]
    fn all_channels_come_before_the_first_where_they_can_be_shown_together() {
        for (joins_channels, steps) in
            [(true, [Some(0), Some(1), Some(1)]), (false, [Some(1), Some(1), Some(1)])]
        {
            let show = move |ui: &mut Ui, chosen: &mut Option<u32>| {
                channel_list(ui, 2, joins_channels, chosen, |i| i.to_string());
            };
            let mut h = Harness::new_ui_state(show, None);
            h.get_by_role_and_label(Role::ComboBox, "channel").focus();
            h.run();
            for expected in steps {
                h.key_press_modifiers(Modifiers::NONE, Key::ArrowDown);
                h.run();
                assert_eq!(*h.state(), expected, "{joins_channels}");
            }
            h.key_press_modifiers(Modifiers::NONE, Key::ArrowUp);
            h.key_press_modifiers(Modifiers::NONE, Key::ArrowUp);
            h.run();
            assert_eq!(*h.state(), if joins_channels { None } else { Some(0) });
        }
    }
}
