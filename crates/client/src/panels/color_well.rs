//! A button with a colour, and the controls for it behind the button.

use egui::ecolor::{Hsva, HsvaGamma};
use egui::{Color32, Popup, PopupCloseBehavior, Role, Sense, Stroke, StrokeKind, Ui, vec2};

use super::controls::{fill_row, name_cell, named_number, slider, whole};
use super::style::named;

/// Shows an opaque sRGB colour under a name. Returns whether the person has changed it.
pub(crate) fn show(ui: &mut Ui, rgb: &mut [u8; 3], name: &str) -> bool {
    let (rect, response) = ui.allocate_exact_size(vec2(36.0, ui.spacing().interact_size.y), Sense::click());
    let visuals = ui.style().interact(&response);
    let [r, g, b] = *rgb;
    ui.painter().rect(
        rect.shrink(1.0),
        3.0,
        Color32::from_rgb(r, g, b),
        Stroke::new(1.0, visuals.fg_stroke.color),
        StrokeKind::Inside,
    );
    named(&response, Role::ColorWell, name);
    let response = response.on_hover_text(name);
    let popup =
        Popup::from_toggle_button_response(&response).close_behavior(PopupCloseBehavior::CloseOnClickOutside);
    popup.show(|ui| controls(ui, rgb)).is_some_and(|shown| shown.inner)
}

/// Hue, saturation and brightness, and the colour as text.
fn controls(ui: &mut Ui, rgb: &mut [u8; 3]) -> bool {
    ui.set_width(POPUP_WIDTH);
    let before = *rgb;
    // Grey has no hue, and black no saturation: what the sliders had is kept.
    let id = ui.scope_id().with("colour");
    let kept = ui.data(|data| data.get_temp::<HsvaGamma>(id)).filter(|kept| bytes_of(*kept) == *rgb);
    let mut color = kept.unwrap_or_else(|| Hsva::from_srgb(*rgb).into());
    let (mut hue, mut saturation, mut value) = (color.h * 360.0, color.s * 100.0, color.v * 100.0);
    for (name, number, most, unit) in [
        ("hue", &mut hue, 360.0, "°"),
        ("saturation", &mut saturation, 100.0, " %"),
        ("brightness", &mut value, 100.0, " %"),
    ] {
        ui.horizontal(|ui| {
            name_cell(ui, name);
            fill_row(ui);
            let slider = slider(ui, number, 0.0..=most, |v| format!("{v:.0}"));
            let slider = ui.add(slider.suffix(unit));
            named_number(&slider, Role::Slider, name, *number);
            if slider.changed() {
                let share = *number / most;
                match name {
                    "hue" => color.h = share,
                    "saturation" => color.s = share,
                    _ => color.v = share,
                }
                *rgb = bytes_of(color);
            }
        });
    }
    ui.data_mut(|data| data.insert_temp(id, color));
    ui.horizontal(|ui| {
        name_cell(ui, "sRGB");
        for (i, name) in ["red", "green", "blue"].into_iter().enumerate() {
            let field = whole(ui, &mut rgb[i], 0..=255);
            let field = ui.add(field);
            named_number(&field, Role::SpinButton, name, f32::from(rgb[i]));
        }
    });
    *rgb != before
}

fn bytes_of(color: HsvaGamma) -> [u8; 3] {
    Hsva::from(color).to_srgb()
}

const POPUP_WIDTH: f32 = 300.0;

#[cfg(test)]
mod tests {
    use egui_kittest::Harness;
    use egui_kittest::kittest::Queryable;

    use super::*;

    #[test]
    fn a_colour_is_chosen_by_its_numbers_and_has_no_opacity() {
        let show_it = |ui: &mut Ui, rgb: &mut [u8; 3]| _ = show(ui, rgb, "a colour");
        let mut h = Harness::builder().with_size(vec2(500.0, 400.0)).build_ui_state(show_it, [200, 100, 50]);
        assert!(h.query_by_label("hue").is_none());
        h.get_by_label("a colour").click();
        h.run();
        assert_eq!(*h.state(), [200, 100, 50], "looking changes nothing");
        let set = |h: &mut Harness<'_, [u8; 3]>, role, name: &str, value: f64| {
            h.get_by_role_and_label(role, name).set_value_accesskit(value);
            h.run();
        };
        set(&mut h, Role::SpinButton, "green", 120.0);
        assert_eq!(*h.state(), [200, 120, 50]);
        set(&mut h, Role::Slider, "brightness", 0.0);
        assert_eq!(*h.state(), [0; 3]);
        // Black has a hue still.
        set(&mut h, Role::Slider, "brightness", 100.0);
        let [r, g, b] = *h.state();
        assert!(r == 255 && g > 100 && b < 100, "{r} {g} {b}");
        assert!(h.query_by_label("alpha").is_none() && h.query_by_label("opacity").is_none());
    }
}
