//! The editor of the transfer function: the curve over the histogram, the list of surfaces, and the rows below.

mod curve;
mod history;
mod plot;
mod stops;
mod surfaces;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::LazyLock;

use egui::{RichText, Ui, vec2};
use isinglass_core::mode::Isos;
use isinglass_core::transfer::{ControlPoint, Domain, TransferFunction};
use isinglass_formats::{ColorMap, ImportedTransfer, import_transfers, transfer_to_toml};

use self::curve::{Curve, Marks, Tone};
use self::history::History;
use self::plot::{Grip, LEAST_WINDOW};
use super::color_well;
use super::controls::{self, named_number};
use super::file_field::{FileField, FileOutcome};
use super::style::named;
use super::text::{format_in, preset_title};
use super::value_scale::ValueScale;
use crate::view::{Waker, waker_of};

/// The state of the editor. It shows the function it is given, and returns edits.
pub(crate) struct TransferEditor {
    curve: Curve,
    /// The function that the server or the editor last had.
    known: Option<TransferFunction>,
    /// The volume's values at the refresh before.
    scale: Option<ValueScale>,
    /// The function that reset returns to.
    preset: TransferFunction,
    history: History<Snapshot>,
    /// The state before a movement that is in progress.
    before: Option<Snapshot>,
    selected: Option<Selected>,
    grip: Option<Grip>,
    view: Option<(f32, f32)>,
    /// Values of surfaces, each a line in the histogram.
    surfaces: Vec<f32>,
    is_log: bool,
    files: FileField<Vec<ImportedTransfer>>,
    found: Vec<ImportedTransfer>,
    /// Shading of an imported preset, until it is taken.
    shaded: Option<bool>,
}

#[derive(Clone, Debug, PartialEq)]
struct Snapshot {
    transfer: TransferFunction,
    marks: Marks,
    tone: Tone,
    /// The function that reset returned to then.
    preset: TransferFunction,
}

/// The selected opacity point or colour stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Selected {
    Point(usize),
    Stop(usize),
}

#[derive(Debug, Default, PartialEq)]
pub(crate) struct Edit {
    pub(crate) transfer: Option<TransferFunction>,
    pub(crate) shaded: Option<bool>,
}

impl Default for TransferEditor {
    fn default() -> Self {
        let nothing = TransferFunction {
            name: String::new(),
            domain: Domain::Full,
            unit_length: isinglass_core::transfer::UnitLength::Voxel,
            points: Vec::new(),
        };
        Self {
            curve: Curve::new(nothing.clone(), (0.0, 1.0)),
            known: None,
            scale: None,
            preset: nothing,
            history: History::default(),
            before: None,
            selected: None,
            grip: None,
            view: None,
            surfaces: Vec::new(),
            is_log: true,
            files: FileField::default(),
            found: Vec::new(),
            shaded: None,
        }
    }
}

impl TransferEditor {
    /// Follows the function of the picture; one that is not the editor's own comes from elsewhere. Call this at each
    /// refresh, even if the editor is not shown.
    pub(crate) fn follow(&mut self, given: &TransferFunction, scale: &ValueScale) {
        if self.known.as_ref() != Some(given) && self.grip.is_none() {
            self.known = Some(given.clone());
            self.preset = given.clone();
            self.before = None;
            self.set(given.clone(), scale);
            self.fit();
        }
        // Values of percentiles depend on the volume.
        self.curve.domain = scale.domain(&self.curve.transfer.domain);
        if self.scale.as_ref() != Some(scale) && self.scale.replace(scale.clone()).is_some() {
            // The former view may be empty in another volume: show everything.
            self.view = Some(self.widest_view(scale));
        }
        self.take_outcome(scale);
    }

    /// The edits since the last call. A movement ends when no button is held.
    pub(crate) fn take_edit(&mut self, ctx: &egui::Context) -> Edit {
        if ctx.input(|i| !i.pointer.any_down()) {
            // A plot that was folded during a drag does not see the release.
            self.grip = None;
        }
        if self.grip.is_none()
            && !ctx.input(|i| i.pointer.any_down())
            && let Some(before) = self.before.take().filter(|b| *b != self.present())
        {
            self.history.note(before);
        }
        let mut edit = Edit { shaded: self.shaded.take(), ..Edit::default() };
        if self.known.as_ref() != Some(&self.curve.transfer) {
            self.known = Some(self.curve.transfer.clone());
            edit.transfer.clone_from(&self.known);
        }
        edit
    }

    #[cfg(test)]
    pub(crate) fn has_selection(&self) -> bool {
        self.selected.is_some()
    }

    pub(crate) fn undo(&mut self, scale: &ValueScale) {
        if self.before.is_none()
            && let Some(step) = self.history.undo(self.present())
        {
            self.go_to(step, scale);
        }
    }

    pub(crate) fn redo(&mut self, scale: &ValueScale) {
        if self.before.is_none()
            && let Some(step) = self.history.redo(self.present())
        {
            self.go_to(step, scale);
        }
    }

    pub(crate) fn open(&mut self, path: PathBuf, wake: &Waker) {
        self.files.set_path(&path);
        self.read(path, wake);
    }

    fn read(&mut self, path: PathBuf, wake: &Waker) {
        self.files.read(wake, move || import_transfers(&path).map_err(|e| e.to_string()));
    }

    /// Whether the function has the name of a preset, and is another one. The domain of the first function is the
    /// server's choice.
    pub(crate) fn is_edited(&self) -> bool {
        let transfer = &self.curve.transfer;
        PRESETS.get(&transfer.name[..]).is_some_and(|points| *points != transfer.points)
            || (self.preset.name == transfer.name && self.preset.domain != transfer.domain)
    }

    /// Shows the editor. `presets` are offered. Each of the `isos` is a line in the histogram, and rows below it.
    pub(crate) fn show(
        &mut self,
        ui: &mut Ui,
        scale: &ValueScale,
        presets: &[&str],
        isos: Option<&mut Isos>,
    ) {
        let shown = isos.as_deref().map(|isos| scale.shown_surfaces(*isos)).unwrap_or_default();
        self.surfaces = shown.as_slice().iter().map(|iso| iso.value).collect();
        ui.spacing_mut().item_spacing = vec2(6.0, 4.0);
        self.presets_row(ui, scale, presets);
        self.plot(ui, scale);
        if let Some(isos) = isos {
            surfaces::show(ui, isos, scale);
        }
        self.point_row(ui);
        self.window_row(ui, scale);
        self.shift_row(ui, scale);
        self.tone_rows(ui);
        self.range_row(ui, scale);
        self.history_row(ui, scale);
        self.file_rows(ui, scale);
    }

    /// Replaces the function in one step, and resets the view.
    fn take(&mut self, transfer: TransferFunction, scale: &ValueScale) {
        self.begin();
        self.preset = transfer.clone();
        self.set(transfer, scale);
        self.fit();
    }

    fn set(&mut self, transfer: TransferFunction, scale: &ValueScale) {
        let domain = scale.domain(&transfer.domain);
        self.curve = Curve::new(transfer, domain);
        self.drop_selection();
    }

    /// Ends a selection of what is no longer there.
    fn drop_selection(&mut self) {
        let Marks { points, stops } = &self.curve.marks;
        self.selected = self.selected.filter(|selected| match *selected {
            Selected::Point(i) => i < points.len(),
            Selected::Stop(i) => i < stops.len(),
        });
    }

    fn selected_point(&self) -> Option<usize> {
        if let Some(Selected::Point(i)) = self.selected { Some(i) } else { None }
    }

    /// Continues a movement, or makes a step of its own.
    fn change(&mut self, curve: Curve) {
        self.begin();
        self.curve = curve;
    }

    fn begin(&mut self) {
        if self.before.is_none() {
            self.before = Some(self.present());
        }
    }

    fn present(&self) -> Snapshot {
        let Curve { transfer, marks, tone, .. } = self.curve.clone();
        Snapshot { transfer, marks, tone, preset: self.preset.clone() }
    }

    /// Makes a change from elsewhere, such as a saved state, undoable.
    pub(crate) fn note_present(&mut self) {
        if self.known.is_some() {
            let present = self.present();
            self.history.note(present);
        }
    }

    /// Goes to a state of the history; another preset resets the view.
    fn go_to(&mut self, step: Snapshot, scale: &ValueScale) {
        if step.preset != self.preset {
            self.preset = step.preset;
            self.fit();
        }
        let domain = scale.domain(&step.transfer.domain);
        self.curve = Curve { transfer: step.transfer, domain, marks: step.marks, tone: step.tone };
        self.drop_selection();
    }

    /// The values across the plot: at first the part of the function inside the volume's range.
    fn view(&mut self, scale: &ValueScale) -> (f32, f32) {
        let (lo, hi) = self.curve.domain;
        let margin = (hi - lo) * 0.06;
        let (lo, hi) = ((lo - margin).max(scale.range.0), (hi + margin).min(scale.range.1));
        let wide = self.widest_view(scale);
        *self.view.get_or_insert(if lo < hi { (lo, hi) } else { wide })
    }

    /// The range of the volume and the function together.
    fn widest_view(&self, scale: &ValueScale) -> (f32, f32) {
        (scale.range.0.min(self.curve.domain.0), scale.range.1.max(self.curve.domain.1))
    }

    fn fit(&mut self) {
        self.view = None;
    }

    fn presets_row(&mut self, ui: &mut Ui, scale: &ValueScale, offered: &[&str]) {
        let half = (ui.available_width() - 6.0) * 0.5;
        let mut taken = None;
        let mut colored = None;
        ui.horizontal(|ui| {
            let transfer = &self.curve.transfer;
            let name = match transfer.name.as_str() {
                "" => "unnamed".to_owned(),
                name if self.is_edited() => format!("{} (edited)", preset_title(name)),
                name => preset_title(name).to_owned(),
            };
            let presets = egui::ComboBox::from_id_salt("preset").width(half).height(LIST_HEIGHT).truncate();
            let presets = presets.selected_text(name).show_ui(ui, |ui| {
                for &name in offered {
                    if ui.selectable_label(self.curve.transfer.name == name, preset_title(name)).clicked() {
                        taken = isinglass_formats::preset(name);
                    }
                }
            });
            named(&presets.response, egui::Role::ComboBox, "preset");
            let maps = egui::ComboBox::from_id_salt("colours").width(half).height(LIST_HEIGHT).truncate();
            let maps = maps.selected_text("colour map").show_ui(ui, |ui| {
                for map in ColorMap::all() {
                    if stops::map_label(ui, &map) {
                        colored = Some(map);
                    }
                }
            });
            named(&maps.response, egui::Role::ComboBox, "colour map");
        });
        if let Some(transfer) = taken {
            self.take(transfer, scale);
        }
        if let Some(map) = colored {
            self.paint(&map);
        }
    }

    /// Replaces the colour stops by those of a map over the domain. No opacity changes.
    fn paint(&mut self, map: &ColorMap) {
        let end = |x| ControlPoint { x, color: [0.0; 3], opacity: 1.0 };
        let flat = TransferFunction { points: vec![end(0.0), end(1.0)], ..self.curve.transfer.clone() };
        match self.curve.with_colors_of(&map.onto(&flat).points) {
            Some(curve) => {
                self.change(curve);
                self.drop_selection();
            }
            None => self.tell_full(),
        }
    }

    /// The selected point or stop, or what the mouse does. The row always has one height, so that those below stay.
    fn point_row(&mut self, ui: &mut Ui) {
        let height = ui.spacing().interact_size.y;
        ui.horizontal(|ui| {
            ui.set_min_height(height);
            match self.selected {
                None => _ = ui.label(RichText::new(MOUSE).size(12.0).weak()),
                Some(Selected::Point(index)) => self.selected_point_row(ui, index),
                Some(Selected::Stop(index)) => self.selected_stop_row(ui, index),
            }
        });
    }

    fn selected_point_row(&mut self, ui: &mut Ui, index: usize) {
        let (mut value, mut opacity) = (self.curve.value(index), self.curve.opacity(index));
        let before = (value, opacity);
        let span = self.curve.domain.1 - self.curve.domain.0;
        ui.label("value");
        let of_value = number(ui, "value", &mut value, f64::from(span) * 0.002, f32::MIN..=f32::MAX, span);
        of_value.on_hover_text("value of the selected point");
        ui.label("opacity");
        let of_opacity = number(ui, "opacity", &mut opacity, 0.002, 0.0..=1.0, 1.0);
        of_opacity.on_hover_text("opacity of matter one unit thick");
        if ui.button("remove").clicked() {
            self.remove_point(index);
        } else if (value, opacity) != before {
            self.change(self.curve.with_point_at(index, value, opacity));
        }
    }

    fn selected_stop_row(&mut self, ui: &mut Ui, index: usize) {
        let mut value = self.curve.stop_value(index);
        let before = value;
        let span = self.curve.domain.1 - self.curve.domain.0;
        ui.label("value");
        let of_value = number(ui, "value", &mut value, f64::from(span) * 0.002, f32::MIN..=f32::MAX, span);
        of_value.on_hover_text("value of the selected colour stop");
        let shown = self.curve.tone.of_color(self.curve.marks.stops[index].is);
        let mut rgb = plot::color32(shown).to_array()[..3].try_into().unwrap_or([0; 3]);
        let is_recolored = color_well::show(ui, &mut rgb, "colour of the stop");
        if ui.button("remove").clicked() {
            self.remove_stop(index);
        } else if is_recolored {
            self.change(self.curve.with_color(index, rgb.map(|c| f32::from(c) / 255.0)));
        } else if value != before {
            self.change(self.curve.with_stop_at(index, value));
        }
    }

    fn window_row(&mut self, ui: &mut Ui, scale: &ValueScale) {
        let (mut level, mut window) = self.curve.level_and_window();
        let before = (level, window);
        let speed = f64::from(window) * 0.005;
        ui.horizontal(|ui| {
            controls::name_cell(ui, "level");
            controls::fill_row(ui);
            number(ui, "level", &mut level, speed, f32::MIN..=f32::MAX, before.1)
                .on_hover_text("middle of the function's values; or drag the strip sideways");
            ui.label("window");
            number(ui, "window", &mut window, speed, 0.0..=f32::MAX, before.1)
                .on_hover_text("width of the function's values; or drag the strip up and down");
        });
        if (level, window) != before {
            self.change(self.curve.with_level_and_window(level, window, scale.span() * LEAST_WINDOW));
        }
    }

    fn shift_row(&mut self, ui: &mut Ui, scale: &ValueScale) {
        let (level, window) = self.curve.level_and_window();
        let (lo, hi) = scale.domain(&self.preset.domain);
        let start = lo + (hi - lo) * 0.5;
        let reach = scale.span() * 0.5;
        let mut shift = level - start;
        ui.horizontal(|ui| {
            controls::name_cell(ui, "position");
            controls::fill_row(ui);
            let slider = ui.add(controls::slider(ui, &mut shift, -reach..=reach, |v| format_in(v, window)));
            named_number(&slider, egui::Role::Slider, "shift of the whole curve", shift);
            slider.on_hover_text("moves the whole curve along the values");
        });
        if shift != level - start {
            self.change(self.curve.with_level_and_window(start + shift, window, 0.0));
        }
    }

    fn tone_rows(&mut self, ui: &mut Ui) {
        let before = self.curve.tone;
        let mut tone = before;
        for (name, factor, hint) in [
            ("opacity", &mut tone.opacity, "Scales opacity"),
            ("brightness", &mut tone.brightness, "of all colours"),
        ] {
            ui.horizontal(|ui| {
                controls::name_cell(ui, name);
                controls::fill_row(ui);
                let slider = controls::slider(ui, factor, FACTORS, |v| format!("{v:.2}"));
                let slider = ui.add(slider.logarithmic(true).suffix(" ×"));
                named_number(&slider, egui::Role::Slider, &format!("{name} of the whole curve"), *factor);
                slider.on_hover_text(hint);
            });
        }
        if tone != before {
            self.change(self.curve.with_tone(tone));
        }
    }

    fn range_row(&mut self, ui: &mut Ui, scale: &ValueScale) {
        let mut domain = None;
        ui.horizontal_wrapped(|ui| {
            controls::name_cell(ui, "range");
            ui.spacing_mut().button_padding.x = 6.0;
            for (text, wanted, hint) in [
                ("full", Domain::Full, "from the least to the greatest value"),
                (
                    "0.1–99.9 %",
                    Domain::Percentiles(0.1, 99.9),
                    "leaves out a thousandth of the voxels at each end",
                ),
                (
                    "1–99 %",
                    Domain::Percentiles(1.0, 99.0),
                    "leaves out a hundredth of the voxels at each end",
                ),
                ("±", Domain::AboutZero(99.9), "as far below zero as above it"),
            ] {
                let is_selected = self.curve.transfer.domain == wanted;
                let button = ui.add(egui::Button::new(text).selected(is_selected));
                if button.on_hover_text(hint).clicked() && !is_selected {
                    domain = Some(wanted);
                }
            }
        });
        if let Some(domain) = domain {
            let transfer = TransferFunction { domain, ..self.curve.transfer.clone() };
            let domain = scale.domain(&transfer.domain);
            self.change(Curve { transfer, domain, ..self.curve.clone() });
            self.fit();
        }
    }

    fn history_row(&mut self, ui: &mut Ui, scale: &ValueScale) {
        let (can_undo, can_redo) = self.history.has();
        ui.horizontal(|ui| {
            if ui.add_enabled(can_undo, egui::Button::new("undo")).on_hover_text("Ctrl+Z").clicked() {
                self.undo(scale);
            }
            if ui.add_enabled(can_redo, egui::Button::new("redo")).on_hover_text("Ctrl+Shift+z").clicked() {
                self.redo(scale);
            }
            let differs = self.curve.transfer != self.preset;
            let hint = format!(
                "back to {}",
                if self.preset.name.is_empty() { "the first" } else { &self.preset.name }
            );
            if ui.add_enabled(differs, egui::Button::new("reset")).on_hover_text(hint).clicked() {
                self.take(self.preset.clone(), scale);
            }
            ui.with_layout(egui::Layout::right_to_left(egui::Align::Center), |ui| {
                controls::checkbox(ui, &mut self.is_log, "log").on_hover_text("logarithm of the histogram");
                if ui.button("fit").on_hover_text("shows the whole function; the wheel zooms").clicked() {
                    self.fit();
                }
            });
        });
    }

    fn file_rows(&mut self, ui: &mut Ui, scale: &ValueScale) {
        let (mut is_opened, mut is_saved) = (false, false);
        ui.horizontal(|ui| {
            let width = (ui.available_width() - 96.0).max(60.0);
            let field = self.files.show(ui, width, "file of presets", "file of presets");
            field.on_hover_text("TOML; ParaView's colour maps (.json); Slicer's presets.xml and .vp.json");
            let path = self.files.path().filter(|_| !self.files.is_busy());
            let open = ui.add_enabled(path.is_some(), egui::Button::new("open"));
            is_opened = open.on_hover_text("or drop a file on the window").clicked();
            let save = if self.files.is_replacing() { "replace" } else { "save" };
            let save = ui.add_enabled(path.is_some(), egui::Button::new(save)).on_hover_text("as TOML");
            is_saved = save.clicked();
        });
        let wake = waker_of(ui.ctx());
        if let Some(path) = self.files.path().filter(|_| is_opened) {
            self.read(path, &wake);
        }
        if is_saved {
            let no_path = |_: &str| Err("name a file".into());
            self.files.write(&wake, transfer_to_toml(&self.curve.transfer), no_path);
        }
        if self.found.len() > 1 {
            let mut chosen = None;
            let combo = egui::ComboBox::from_id_salt("found").width(ui.available_width()).truncate();
            let text = format!("{} presets in the file", self.found.len());
            let combo = combo.selected_text(text).show_ui(ui, |ui| {
                for (i, item) in self.found.iter().enumerate() {
                    if ui.selectable_label(self.curve.transfer.name == item.name(), item.name()).clicked() {
                        chosen = Some(i);
                    }
                }
            });
            named(&combo.response, egui::Role::ComboBox, "presets in the file");
            if let Some(i) = chosen {
                self.take_imported(i, scale);
            }
        }
        if let Some(message) = &self.files.message {
            ui.add(egui::Label::new(RichText::new(message).size(11.0)).wrap());
        }
    }

    fn take_outcome(&mut self, scale: &ValueScale) {
        if let Some(Ok(FileOutcome::Read(found))) = self.files.take() {
            self.found = found;
            self.take_imported(0, scale);
        }
    }

    fn take_imported(&mut self, index: usize, scale: &ValueScale) {
        let Some(item) = self.found.get(index) else { return };
        let transfer = item.onto(&self.curve.transfer);
        match transfer.validate() {
            Ok(()) => {
                self.shaded = item.shaded();
                self.take(transfer, scale);
            }
            Err(e) => self.files.message = Some(format!("{}: {e}", item.name())),
        }
    }
}

/// A number field behind its name, with figures for a range that is `span` wide.
fn number(
    ui: &mut Ui,
    name: &str,
    value: &mut f32,
    speed: f64,
    range: std::ops::RangeInclusive<f32>,
    span: f32,
) -> egui::Response {
    let before = *value;
    let field = controls::field(ui, value, |v| format_in(v, span));
    let response = ui.add(field.speed(speed).range(range));
    if !value.is_finite() {
        *value = before;
    }
    named_number(&response, egui::Role::SpinButton, name, *value);
    response
}

/// The points of each preset, parsed once.
static PRESETS: LazyLock<BTreeMap<&str, Vec<ControlPoint>>> = LazyLock::new(|| {
    let points = |name| Some((name, isinglass_formats::preset(name)?.points));
    isinglass_formats::preset_names().filter_map(points).collect()
});

const MOUSE: &str = "click: add   drag: move   Del, middle click: remove";
/// Factors of opacity and brightness.
const FACTORS: std::ops::RangeInclusive<f32> = 0.1..=10.0;
/// Lists of presets and colour maps need no scrolling, points.
const LIST_HEIGHT: f32 = 460.0;
