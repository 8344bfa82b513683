//! Controls that panels share: fields and sliders for numbers, and rows of a grid.
//!
//! A number has more figures than its field shows. A text that nobody edits stands for the number itself, and an edit
//! counts when it ends. So a person who only looks changes nothing.

use std::ops::RangeInclusive;

use egui::emath::Numeric;
use egui::{DragValue, Id, Key, Response, Role, Slider, SliderClamping, Ui, WidgetInfo, WidgetText};

/// A field that shows its number by `format`.
pub(crate) fn field<'a>(ui: &Ui, value: &'a mut f32, format: impl Fn(f32) -> String + 'a) -> DragValue<'a> {
    let (read, shown) = (reader(ui), format(*value));
    let field = DragValue::new(value).update_while_editing(false);
    let field = field.custom_parser(move |text| read(text).filter(|_| text != shown));
    field.custom_formatter(move |v, _| format(v as f32))
}

/// The same with a slider. A number outside the range stays until the person changes it.
pub(crate) fn slider<'a>(
    ui: &Ui,
    value: &'a mut f32,
    range: RangeInclusive<f32>,
    format: impl Fn(f32) -> String + 'a,
) -> Slider<'a> {
    let (read, shown) = (reader(ui), format(*value));
    let slider = Slider::new(value, range).clamping(SliderClamping::Edits).update_while_editing(false);
    let slider = slider.custom_parser(move |text| read(text).filter(|_| text != shown));
    slider.custom_formatter(move |v, _| format(v as f32))
}

/// A slider for a share of 1, in steps of 5 %.
pub(crate) fn percent(ui: &mut Ui, share: &mut f32, range: RangeInclusive<f32>) -> Response {
    let mut percent = (*share * 100.0).round();
    let slider = slider(ui, &mut percent, range, |v| format!("{v:.0}"));
    let slider = ui.add(slider.step_by(5.0).suffix(" %"));
    if slider.changed() {
        *share = percent / 100.0;
    }
    slider
}

pub(crate) fn whole<'a, N: Numeric>(ui: &Ui, value: &'a mut N, range: RangeInclusive<N>) -> DragValue<'a> {
    DragValue::new(value).range(range).update_while_editing(false).custom_parser(reader(ui))
}

/// A box to check. An empty one looks empty, and a checked one has the colour of what is chosen.
pub(crate) fn checkbox(ui: &mut Ui, is_checked: &mut bool, text: impl Into<WidgetText>) -> Response {
    let text = text.into();
    let shown = ui.scope(|ui| {
        let visuals = ui.visuals_mut();
        let fill = if *is_checked { visuals.selection.bg_fill } else { visuals.extreme_bg_color };
        let mark = visuals.selection.stroke.color;
        let widgets = &mut visuals.widgets;
        for look in [&mut widgets.inactive, &mut widgets.hovered, &mut widgets.active] {
            look.bg_fill = fill;
        }
        let text_color = widgets.inactive.fg_stroke.color;
        if *is_checked {
            // The mark is on the fill, and the text beside it on the panel.
            for look in [&mut widgets.inactive, &mut widgets.hovered, &mut widgets.active] {
                look.fg_stroke.color = mark;
            }
        }
        ui.add(egui::Checkbox::new(is_checked, text.color(text_color)))
    });
    shown.inner
}

/// A line of a panel: a name in the column of names, and the control that screen readers call by it. A slider or list
/// fills the rest.
pub(crate) fn row(ui: &mut Ui, name: &str, hint: &str, control: impl FnOnce(&mut Ui) -> Response) {
    ui.horizontal(|ui| {
        let label = name_cell(ui, name).on_hover_text(hint);
        fill_row(ui);
        control(ui).labelled_by(label.id).on_hover_text(hint);
    });
}

/// A name in the column of names.
pub(crate) fn name_cell(ui: &mut Ui, name: &str) -> Response {
    let size = egui::vec2(NAME_WIDTH, ui.spacing().interact_size.y);
    let layout = egui::Layout::left_to_right(egui::Align::Center);
    let cell = ui.allocate_ui_with_layout(size, layout, |ui| {
        ui.set_min_width(NAME_WIDTH);
        ui.label(name)
    });
    cell.inner
}

/// Lets a slider with its number, or a list, fill the rest of a line.
pub(crate) fn fill_row(ui: &mut Ui) {
    let room = ui.available_width();
    let spacing = ui.spacing_mut();
    spacing.slider_width = (room - NUMBER_WIDTH).max(60.0);
    // All numbers are as wide, so that they are in one column.
    spacing.interact_size.x = NUMBER_WIDTH - spacing.item_spacing.x;
    ui.spacing_mut().combo_width = (room - 8.0).max(60.0);
}

/// Gives a control with a number its name and value for screen readers.
pub(crate) fn named_number(response: &Response, role: Role, name: &str, value: f32) {
    response.widget_info(|| WidgetInfo {
        value: Some(f64::from(value)),
        ..WidgetInfo::labeled(role, true, name)
    });
}

/// Reads the text of any number field. egui takes the text one refresh after Escape, so this ignores a text that
/// Escape ended.
pub(crate) fn reader(ui: &Ui) -> impl Fn(&str) -> Option<f64> + use<> {
    let (id, now) = (Id::unique("escape in a number"), ui.ctx().cumulative_pass_nr());
    if ui.input(|i| i.key_pressed(Key::Escape)) {
        ui.data_mut(|data| data.insert_temp(id, now));
    }
    let is_given_up = ui.data(|data| data.get_temp(id)).is_some_and(|at: u64| now <= at + 1);
    move |text| if is_given_up { None } else { read(text) }
}

/// Ignores spaces, and accepts a typographic minus.
fn read(text: &str) -> Option<f64> {
    let plain = text.chars().filter(|c| !c.is_whitespace()).map(|c| if c == '−' { '-' } else { c });
    plain.collect::<String>().parse().ok()
}

/// Width of the column of names, points.
const NAME_WIDTH: f32 = 112.0;
/// Room of a slider's number, points.
const NUMBER_WIDTH: f32 = 66.0;

#[cfg(test)]
mod tests {
    use egui::{Key, Modifiers};
    use egui_kittest::Harness;

    use super::*;

    /// A field and a slider of the same number, which shows no more than one figure behind the point.
    fn harness(value: f32) -> Harness<'static, [f32; 2]> {
        let show = |ui: &mut Ui, values: &mut [f32; 2]| {
            let format = |v: f32| format!("{v:.1}");
            let [a, b] = values;
            let label = ui.label("a number");
            let of_a = field(ui, a, format);
            ui.add(of_a).labelled_by(label.id);
            let of_b = slider(ui, b, 0.0..=10.0, format);
            ui.add(of_b).labelled_by(label.id);
        };
        Harness::new_ui_state(show, [value; 2])
    }

    fn press(h: &mut Harness<'_, [f32; 2]>, key: Key) {
        h.key_press_modifiers(Modifiers::NONE, key);
        h.run();
    }

    #[test]
    fn who_only_looks_changes_nothing() {
        for value in [0.123_456, 7.891_234, 12.345_678] {
            let mut h = harness(value);
            for key in [Key::Tab; 6].into_iter().chain([Key::Enter, Key::Tab, Key::Escape]) {
                press(&mut h, key);
                assert_eq!(*h.state(), [value; 2], "{key:?}");
            }
        }
    }

    #[test]
    fn what_is_written_is_taken_when_it_is_done_and_escape_gives_up() {
        for (tabs, index) in [(1, 0), (3, 1)] {
            let mut h = harness(0.123_456);
            let write = |h: &mut Harness<'_, [f32; 2]>, key| {
                (0..tabs).for_each(|_| press(h, Key::Tab));
                h.event(egui::Event::Text(" 4.5 6".into()));
                h.run();
                assert_eq!(*h.state(), [0.123_456; 2], "not while it is written");
                press(h, key);
            };
            write(&mut h, Key::Escape);
            assert_eq!(*h.state(), [0.123_456; 2]);
            let mut h = harness(0.123_456);
            write(&mut h, Key::Enter);
            assert_eq!(h.state()[index], 4.56);
        }
        assert_eq!([read("−1 000"), read("1e-3"), read("x")], [Some(-1000.0), Some(1e-3), None]);
    }
}
