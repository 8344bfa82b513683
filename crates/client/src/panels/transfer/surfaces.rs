//! The values and opacities of surfaces.

use egui::{SliderClamping, Ui};
use isinglass_core::mode::{Iso, Isos, MAX_ISOS};

use super::super::controls::{self, named_number};
use super::super::text::format_in;
use super::super::value_scale::ValueScale;

/// A line for each surface, and a button that adds one.
pub(super) fn show(ui: &mut Ui, surfaces: &mut Isos, scale: &ValueScale) {
    let shown = scale.shown_surfaces(*surfaces);
    let mut isos = shown.as_slice().to_vec();
    let mut removed = None;
    let (lo, hi) = scale.range;
    let num = isos.len();
    for (i, iso) in isos.iter_mut().enumerate() {
        ui.horizontal(|ui| {
            ui.label(format!("surface {}", i + 1));
            let remove = ui.add_enabled(num > 1, egui::Button::new("−").small());
            let name = format!("remove surface {}", i + 1);
            remove.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Button, num > 1, &name));
            if remove.on_hover_text(name.clone()).clicked() {
                removed = Some(i);
            }
        });
        ui.horizontal(|ui| {
            controls::name_cell(ui, "value");
            controls::fill_row(ui);
            let slider = controls::slider(ui, &mut iso.value, lo..=hi, |v| format_in(v, scale.span()));
            let slider = ui.add(slider.clamping(SliderClamping::Never));
            named_number(&slider, egui::Role::Slider, &format!("value of surface {}", i + 1), iso.value);
            slider.on_hover_text("the surface lies where the volume has this value: a line in the histogram");
        });
        ui.horizontal(|ui| {
            controls::name_cell(ui, "opacity");
            controls::fill_row(ui);
            let mut percent = iso.opacity * 100.0;
            let slider = controls::slider(ui, &mut percent, 0.0..=100.0, |v| format!("{v:.0}"));
            let slider = ui.add(slider.max_decimals(0).suffix(" %"));
            named_number(&slider, egui::Role::Slider, &format!("opacity of surface {}", i + 1), percent);
            if slider.changed() {
                iso.opacity = percent / 100.0;
            }
        });
    }
    if let Some(i) = removed {
        isos.remove(i);
    }
    let add = ui.add_enabled(isos.len() < MAX_ISOS, egui::Button::new("add a surface").small());
    if add.clicked() {
        isos.push(another(&isos, scale.range));
    }
    if isos != shown.as_slice() {
        // Numbers from elsewhere may be invalid.
        *surfaces = Isos::new(&isos).unwrap_or(*surfaces);
    }
}

/// A new surface beside others, which stay. It is translucent and encloses the outermost opaque one. Without an
/// opaque surface it lies half-way up from the highest. Lower values lie further out.
fn another(isos: &[Iso], (lo, hi): (f32, f32)) -> Iso {
    let hides = |iso: &&Iso| iso.opacity >= HIDING_OPACITY;
    let outermost = isos.iter().filter(hides).map(|iso| iso.value).min_by(f32::total_cmp);
    match outermost.filter(|value| *value > lo) {
        Some(hiding) => {
            let around = isos.iter().map(|iso| iso.value).filter(|value| *value < hiding);
            let next = around.fold(lo, f32::max);
            Iso { value: 0.5 * (next + hiding), opacity: OUTER_OPACITY }
        }
        None => {
            let highest = isos.iter().map(|iso| iso.value).fold(lo, f32::max).min(hi);
            Iso { value: 0.5 * (highest + hi), opacity: 1.0 }
        }
    }
}

/// Opacity of a surface in front of another one.
const OUTER_OPACITY: f32 = 0.3;
/// From this opacity on, next to nothing is visible behind a surface.
const HIDING_OPACITY: f32 = 0.9;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_surface_is_added_where_it_is_seen_and_sees_the_others() {
        let iso = |value, opacity| Iso { value, opacity };
        for (isos, added) in [
            (vec![iso(300.0, 1.0)], iso(-350.0, 0.3)),
            (vec![iso(300.0, 1.0), iso(-350.0, 0.3)], iso(-25.0, 0.3)),
            (vec![iso(300.0, 0.3)], iso(650.0, 1.0)),
            (vec![iso(100.0, 0.5), iso(300.0, 1.0)], iso(200.0, 0.3)),
            (vec![iso(-1000.0, 1.0)], iso(0.0, 1.0)),
        ] {
            assert_eq!(another(&isos, (-1000.0, 1000.0)), added, "{isos:?}");
        }
    }
}
