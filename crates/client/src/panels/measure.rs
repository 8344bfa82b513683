//! The bar of the measurements: what to measure, what was measured, the values along a line, and the CSV file.

use std::fmt::Write;
use std::sync::Arc;

use egui::{
    Align, Layout, Pos2, Rect, RichText, Role, ScrollArea, Sense, Shape, Stroke, Ui, UiBuilder, WidgetInfo,
    pos2, vec2,
};
use glam::Vec3;
use isinglass_core::ids::ProbeId;
use isinglass_core::wire::{MAX_PROFILE_POINTS, Profile, VolumeDescription, Welcome};
use isinglass_formats::{MeasureKind, SavedMeasure};
use lucide_icons::Icon;

use super::background::write_numbered;
use super::file_field::FileField;
use super::style::{bright, icon, named, quiet};
use super::text::format_in;
use crate::input::bindings::{Action, Bindings};
use crate::paint::measure::{LengthScale, MeasureEditor, angle_degrees, length};
use crate::view::Waker;

/// What the bar knows beside the measurements themselves.
#[derive(Default)]
pub(crate) struct MeasureBar {
    /// Whether the list is shown.
    is_open: bool,
    /// The profile that the person chose; otherwise the newest is shown.
    chosen: Option<usize>,
    /// The volume that the lines below go through.
    volume: Option<Arc<Welcome>>,
    /// Lines whose values are on the way, the newest last.
    asked: Vec<(ProbeId, MeasuredLine)>,
    /// The newest values that came of each measurement.
    known: Vec<(MeasuredLine, Arc<Profile>)>,
    files: FileField<()>,
}

/// The number of a measurement, and the ends of its line.
#[derive(Clone, Copy, Debug, PartialEq)]
struct MeasuredLine {
    number: usize,
    ends: [[f32; 3]; 2],
}

/// A line to ask the server for.
pub(crate) struct WantedProfile {
    line: MeasuredLine,
    pub(crate) num_points: u16,
}

impl WantedProfile {
    pub(crate) fn ends(&self) -> [[f32; 3]; 2] {
        self.line.ends
    }
}

impl MeasureBar {
    /// The profile to ask for now: the shown one first, then the others, one at a time. A line that rests is asked for
    /// once of each volume.
    pub(crate) fn wanted(
        &mut self,
        measures: &[SavedMeasure],
        volume: &Arc<Welcome>,
    ) -> Option<WantedProfile> {
        // Another volume may be described alike, and the answers are gone with the one before.
        if self.volume.as_ref().is_none_or(|of| !Arc::ptr_eq(of, volume)) {
            self.volume = Some(volume.clone());
            (self.asked, self.known) = (Vec::new(), Vec::new());
        }
        let is_known = |line: &MeasuredLine| self.known.iter().any(|(known, _)| known == line);
        let shown = line_of(measures, self.shown_profile(measures)?)?;
        let line = if !is_known(&shown) {
            Some(shown).filter(|line| self.asked.last().is_none_or(|(_, asked)| asked != line))
        } else if self.asked.is_empty() {
            (0..measures.len()).filter_map(|number| line_of(measures, number)).find(|line| !is_known(line))
        } else {
            None
        }?;
        let finest = finest(&volume.volume);
        // Two values a voxel show all that there is.
        let num_points =
            (2.0 * length(&line.ends) / f64::from(finest)).clamp(32.0, f64::from(MAX_PROFILE_POINTS));
        Some(WantedProfile { line, num_points: num_points as u16 })
    }

    pub(crate) fn note_asked(&mut self, wanted: &WantedProfile, id: ProbeId) {
        // Older questions than these are never answered.
        if self.asked.len() >= MAX_ASKED {
            self.asked.remove(0);
        }
        self.asked.push((id, wanted.line));
    }

    /// Keeps an answer with its line. Earlier questions are not answered any more.
    pub(crate) fn note_answer(&mut self, answer: Option<&Profile>) {
        let Some(answer) = answer else { return };
        let Some(at) = self.asked.iter().position(|(id, _)| *id == answer.id) else { return };
        let Some((_, line)) = self.asked.drain(..=at).next_back() else { return };
        self.known.retain(|(known, _)| known.number != line.number);
        self.known.push((line, Arc::new(answer.clone())));
    }

    /// The values of a profile, and whether they are those of the present line.
    fn values(&self, measures: &[SavedMeasure], number: usize) -> Option<(&Profile, bool)> {
        let (line, profile) = self.known.iter().find(|(known, _)| known.number == number)?;
        Some((profile, line_of(measures, number) == Some(*line)))
    }

    fn shown_profile(&self, measures: &[SavedMeasure]) -> Option<usize> {
        let is_profile =
            |number: &usize| measures.get(*number).is_some_and(|m| m.kind == MeasureKind::Profile);
        let newest = || (0..measures.len()).rev().find(is_profile);
        self.chosen.filter(is_profile).or_else(newest)
    }

    /// Height of the bar, points.
    pub(crate) fn height(&self) -> f32 {
        ROW_HEIGHT + if self.is_open { LIST_HEIGHT } else { 0.0 }
    }

    /// Shows the bar: what to measure and what was measured last, and all of it below if the person opens the list.
    /// Returns whether to close it.
    pub(crate) fn show(
        &mut self,
        ui: &mut Ui,
        editor: &mut MeasureEditor,
        volume: &VolumeDescription,
        bindings: &Bindings,
        wake: &Waker,
    ) -> bool {
        let _ = self.files.take();
        let row = vec2(ui.available_width(), ROW_HEIGHT - 8.0);
        let centered = Layout::left_to_right(Align::Center);
        let is_closed =
            ui.allocate_ui_with_layout(row, centered, |ui| self.row(ui, editor, volume, bindings)).inner;
        if self.is_open {
            self.details(ui, editor, volume, wake);
        }
        is_closed
    }

    fn row(
        &mut self,
        ui: &mut Ui,
        editor: &mut MeasureEditor,
        volume: &VolumeDescription,
        bindings: &Bindings,
    ) -> bool {
        for (kind, name) in KINDS {
            if ui.selectable_label(editor.kind == kind, name).clicked() {
                editor.choose(kind);
                // Its values are a plot.
                self.is_open |= kind == MeasureKind::Profile;
            }
        }
        ui.separator();
        if editor.num_begun() > 0 {
            if editor.kind == MeasureKind::Path && ui.button("End the path").clicked() {
                editor.finish();
            }
            if ui.button("Start again").clicked() {
                editor.give_up();
            }
        }
        ui.with_layout(Layout::right_to_left(Align::Center), |ui| {
            let close = ui.add(egui::Button::new(icon(Icon::X)).frame_when_inactive(false));
            named(&close, Role::Button, "stop measuring");
            let is_closed =
                close.on_hover_text(bindings.with_key("stop measuring", Action::Measure)).clicked();
            let symbol = if self.is_open { Icon::ChevronDown } else { Icon::ChevronUp };
            let list = ui.add(egui::Button::new(icon(symbol)).frame_when_inactive(false));
            let is_open = self.is_open;
            list.widget_info(|| WidgetInfo::selected(Role::CheckBox, true, is_open, "list of measurements"));
            if list.on_hover_text("all measurements, the values along a line, and the table").clicked() {
                self.is_open = !self.is_open;
                // The picture beneath is drawn already.
                ui.ctx().request_repaint();
            }
            let newest = editor.measures().len().checked_sub(1).filter(|_| !is_open);
            ui.with_layout(Layout::left_to_right(Align::Center), |ui| match newest {
                Some(number) => {
                    let text = told(number, &editor.measures()[number], &scale(volume));
                    ui.add(egui::Label::new(text).truncate());
                }
                None => {
                    let hint = RichText::new(hint_of(editor.kind)).size(12.0).color(quiet(ui.ctx()));
                    ui.add(egui::Label::new(hint).truncate());
                }
            });
            is_closed
        })
        .inner
    }

    /// The list and its file at the left, the values along a line at the right.
    fn details(&mut self, ui: &mut Ui, editor: &mut MeasureEditor, volume: &VolumeDescription, wake: &Waker) {
        let room = ui.available_rect_before_wrap();
        let middle = room.left() + (room.width() * 0.5).min(MOST_LIST_WIDTH);
        let left = room.with_max_x(middle - 8.0);
        let right = room.with_min_x(middle + 8.0);
        ui.advance_cursor_after_rect(room);
        let part = |ui: &mut Ui, rect: Rect| ui.new_child(UiBuilder::new().max_rect(rect));
        let file_height = ui.spacing().interact_size.y + 8.0;
        let list = left.with_max_y(left.bottom() - file_height);
        self.list(&mut part(ui, list), editor, volume);
        self.file(&mut part(ui, left.with_min_y(list.bottom() + 4.0)), editor.measures(), volume, wake);
        let ui = &mut part(ui, right);
        let text = self.news(editor.measures());
        let news_height = if text.is_some() { 16.0 } else { 0.0 };
        if let Some(number) = self.shown_profile(editor.measures()) {
            let values = self.values(editor.measures(), number).map(|(profile, _)| profile);
            let height = (right.height() - 24.0 - news_height).max(24.0);
            show_profile(ui, height, values, &editor.measures()[number], volume);
        }
        if let Some(text) = text {
            ui.add(egui::Label::new(RichText::new(text).size(12.0)).truncate());
        }
    }

    fn list(&mut self, ui: &mut Ui, editor: &mut MeasureEditor, volume: &VolumeDescription) {
        let scale = scale(volume);
        let shown = self.shown_profile(editor.measures());
        let mut removed = None;
        if editor.measures().is_empty() {
            ui.label(RichText::new("Nothing is measured yet.").color(quiet(ui.ctx())));
        }
        ScrollArea::vertical().auto_shrink(false).show(ui, |ui| {
            for (number, measure) in editor.measures().iter().enumerate() {
                let text = told(number, measure, &scale);
                ui.horizontal(|ui| {
                    let bin = ui.add(egui::Button::new(icon(Icon::Trash2)).frame_when_inactive(false));
                    named(&bin, Role::Button, &format!("remove measurement {}", number + 1));
                    if bin.on_hover_text("remove").clicked() {
                        removed = Some(number);
                    }
                    match measure.kind {
                        MeasureKind::Profile => {
                            if ui.selectable_label(shown == Some(number), text).clicked() {
                                self.chosen = Some(number);
                            }
                        }
                        _ => drop(ui.add(egui::Label::new(text).truncate())),
                    }
                });
            }
        });
        if let Some(number) = removed {
            editor.remove(number);
            (self.chosen, self.asked, self.known) = (None, Vec::new(), Vec::new());
        }
    }

    /// What the person should know of the file and the values.
    fn news(&self, measures: &[SavedMeasure]) -> Option<String> {
        let is_missing = |number: &usize| {
            measures[*number].kind == MeasureKind::Profile
                && !self.values(measures, *number).is_some_and(|(_, is_new)| is_new)
        };
        let missing: Vec<String> =
            (0..measures.len()).filter(is_missing).map(|number| (number + 1).to_string()).collect();
        match missing.is_empty() {
            true => self.files.message.clone(),
            false => Some(format!("The values of {} are on the way.", missing.join(", "))),
        }
    }

    fn file(&mut self, ui: &mut Ui, measures: &[SavedMeasure], volume: &VolumeDescription, wake: &Waker) {
        let name = if self.files.is_replacing() { "Replace the CSV file" } else { "Save as CSV" };
        let is_asked = ui.with_layout(Layout::right_to_left(Align::Min), |ui| {
            let can_save = !self.files.is_busy() && !measures.is_empty();
            let is_asked = ui.add_enabled(can_save, egui::Button::new(name)).clicked();
            let width = ui.available_width();
            self.files.show(ui, width, "file of the measurements", "file; a new name if empty");
            is_asked
        });
        if is_asked.inner {
            let known =
                |number| self.values(measures, number).filter(|(_, is_new)| *is_new).map(|(known, _)| known);
            let text = csv(measures, volume, known);
            let stem = super::text::file_stem(&volume.name);
            self.files.write(wake, text, move |text| write_numbered(text, &stem, ".measures.csv"));
        }
    }

    #[cfg(test)]
    pub(crate) fn set_path(&mut self, path: &std::path::Path) {
        self.files.set_path(path);
    }
}

fn show_profile(
    ui: &mut Ui,
    height: f32,
    values: Option<&Profile>,
    of: &SavedMeasure,
    volume: &VolumeDescription,
) {
    let (rect, response) = ui.allocate_exact_size(vec2(ui.available_width(), height), Sense::hover());
    let painter = ui.painter_at(rect);
    let known = values.map(|profile| &profile.values[..]).unwrap_or_default();
    let numbers = known.iter().flatten().copied();
    let (lo, hi) = numbers.fold((f32::INFINITY, f32::NEG_INFINITY), |(lo, hi), v| (lo.min(v), hi.max(v)));
    let unit = volume.value_unit.as_deref().map_or(String::new(), |unit| format!(" {unit}"));
    let whole = scale(volume).length(length(&of.points));
    let words = match lo <= hi {
        true => {
            let [lo, hi] = [lo, hi].map(|value| format_in(value, hi - lo));
            format!("values along {whole}: {lo}{unit} to {hi}{unit}")
        }
        false if values.is_some() => "the line does not meet the volume".to_owned(),
        false => "the values are on the way".to_owned(),
    };
    named(&response, Role::Image, "plot of the values");
    painter.rect_filled(rect, 4.0, ui.visuals().extreme_bg_color);
    let plot = rect.shrink2(vec2(6.0, 8.0));
    let height = if hi > lo { hi - lo } else { 1.0 };
    let at = |i: usize, value: f32| {
        let x = i as f32 / (known.len().max(2) - 1) as f32;
        pos2(plot.left() + x * plot.width(), plot.bottom() - (value - lo) / height * plot.height())
    };
    let stroke = Stroke::new(1.5, ui.visuals().selection.stroke.color);
    let mut run: Vec<Pos2> = Vec::new();
    for (i, value) in known.iter().enumerate() {
        run.extend(value.map(|value| at(i, value)));
        if value.is_none() || i + 1 == known.len() {
            painter.add(Shape::line(std::mem::take(&mut run), stroke));
        }
    }
    let hover = response.hover_pos().filter(|_| known.len() > 1);
    if let Some(pos) = hover {
        let share = ((pos.x - plot.left()) / plot.width()).clamp(0.0, 1.0);
        let i = (share * (known.len() - 1) as f32).round() as usize;
        if let Some(value) = known[i] {
            painter.circle_filled(at(i, value), 3.5, bright(ui.ctx()));
            let way = scale(volume).length(length(&of.points) * i as f64 / (known.len() - 1) as f64);
            let value = format_in(value, hi - lo);
            response.on_hover_text(format!("{value}{unit} at {way}"));
        }
    }
    ui.add(egui::Label::new(RichText::new(words).size(12.0)).truncate());
}

/// The measurements as a table, a line for each point, and for each value of those profiles that `known` has.
fn csv<'a>(
    measures: &[SavedMeasure],
    volume: &VolumeDescription,
    known: impl Fn(usize) -> Option<&'a Profile>,
) -> String {
    let of = |unit: Option<&String>| unit.map_or(String::new(), |unit| format!(" [{unit}]"));
    let (unit, value_unit) = (of(volume.unit.as_ref()), of(volume.value_unit.as_ref()));
    let header = ["measurement", "kind", "point", "x", "y", "z", "length", "angle [deg]", "value"];
    let header = header.map(|name| match name {
        "x" | "y" | "z" | "length" => escaped(&format!("{name}{unit}")),
        "value" => escaped(&format!("value{value_unit}")),
        name => name.to_owned(),
    });
    let mut out = header.join(",") + "\n";
    for (number, measure) in measures.iter().enumerate() {
        let kind = name_of(measure.kind).to_lowercase();
        let values = known(number).map(|profile| &profile.values);
        let points: Vec<[f32; 3]> = match (values, &measure.points[..]) {
            (Some(values), [from, .., to]) => {
                let [from, to] = [*from, *to].map(Vec3::from_array);
                let last = (values.len().max(2) - 1) as f32;
                (0..values.len()).map(|i| from.lerp(to, i as f32 / last).to_array()).collect()
            }
            (_, points) => points.to_vec(),
        };
        let mut way = 0.0;
        for (i, point) in points.iter().enumerate() {
            let [x, y, z] = match &volume.placement {
                Some(placement) => placement.file_from_world(Vec3::from_array(*point)).map(|x| x.to_string()),
                None => point.map(|x| x.to_string()),
            };
            way += length(&points[i.saturating_sub(1)..=i]);
            let length = way as f32;
            let angle = match (measure.kind, i) {
                (MeasureKind::Angle, 1) => format!("{}", angle_degrees(&points) as f32),
                _ => String::new(),
            };
            let value = values.and_then(|values| values[i]).map_or(String::new(), |value| value.to_string());
            let _ = writeln!(out, "{},{kind},{},{x},{y},{z},{length},{angle},{value}", number + 1, i + 1);
        }
    }
    out
}

/// A text as a field of a CSV file (RFC 4180).
fn escaped(text: &str) -> String {
    let is_plain = !text.contains([',', '"', '\n', '\r']);
    if is_plain { text.to_owned() } else { format!("\"{}\"", text.replace('"', "\"\"")) }
}

/// How lengths of a volume are told.
pub(crate) fn scale(volume: &VolumeDescription) -> LengthScale<'_> {
    LengthScale { unit: volume.unit.as_deref(), finest: finest(volume) }
}

fn finest(volume: &VolumeDescription) -> f32 {
    volume.spacing.iter().copied().fold(f32::INFINITY, f32::min)
}

fn line_of(measures: &[SavedMeasure], number: usize) -> Option<MeasuredLine> {
    let measure = measures.get(number).filter(|measure| measure.kind == MeasureKind::Profile)?;
    Some(MeasuredLine { number, ends: [*measure.points.first()?, *measure.points.last()?] })
}

/// A measurement in a line.
fn told(number: usize, measure: &SavedMeasure, scale: &LengthScale<'_>) -> String {
    format!("{}: {} {}", number + 1, name_of(measure.kind), scale.told(measure))
}

fn hint_of(kind: MeasureKind) -> &'static str {
    match kind {
        MeasureKind::Distance => "Click two points on a surface or a slice.",
        MeasureKind::Angle => "Click three points: the angle is at the second.",
        MeasureKind::Path => "Click points; click the last one again to end.",
        MeasureKind::Profile => "Click both ends of a line through the volume.",
    }
}

fn name_of(kind: MeasureKind) -> &'static str {
    KINDS.iter().find(|(of, _)| *of == kind).map_or("", |(_, name)| name)
}

const KINDS: [(MeasureKind, &str); 4] = [
    (MeasureKind::Distance, "Distance"),
    (MeasureKind::Angle, "Angle"),
    (MeasureKind::Path, "Path"),
    (MeasureKind::Profile, "Profile"),
];
/// Height of the row of kinds, and of what opens below it, points.
const ROW_HEIGHT: f32 = 34.0;
const LIST_HEIGHT: f32 = 132.0;
/// Width of the list, points.
const MOST_LIST_WIDTH: f32 = 420.0;
/// Questions about lines that are remembered until an answer comes.
const MAX_ASKED: usize = 64;

#[cfg(test)]
mod tests {
    use isinglass_core::volume::Placement;

    use super::*;
    use crate::view::frame_source::FrameSource;
    use crate::view::viewing::tests::FakeSource;

    fn welcome() -> Arc<Welcome> {
        FakeSource { max_side: Some(1), ..Default::default() }.description().unwrap()
    }

    fn measure(kind: MeasureKind, points: &[[f32; 3]]) -> SavedMeasure {
        SavedMeasure { kind, points: points.to_vec() }
    }

    #[test]
    fn the_table_has_a_line_a_point_in_the_world_of_the_file() {
        let axes = [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]];
        let volume = VolumeDescription {
            unit: Some("mm, \"s\"".into()),
            value_unit: Some("HU".into()),
            placement: Some(Placement { center: [10.0, 20.0, 30.0], axes }),
            ..welcome().volume.clone()
        };
        let measures = [
            measure(MeasureKind::Distance, &[[0.0; 3], [3.0, 4.0, 12.0]]),
            measure(MeasureKind::Angle, &[[1.0, 0.0, 0.0], [0.0; 3], [0.0, 0.0, 2.0]]),
            measure(MeasureKind::Profile, &[[0.0; 3], [0.0, 0.0, 1.0]]),
        ];
        let profile = Profile { id: ProbeId(1), values: vec![Some(5.0), None, Some(-7.5)] };
        let text = csv(&measures, &volume, |number| (number == 2).then_some(&profile));
        let lines: Vec<&str> = text.lines().collect();
        assert!(lines[0].starts_with("measurement,kind,point,\"x [mm, \"\"s\"\"]\","), "{}", lines[0]);
        assert!(lines[0].ends_with("angle [deg],value [HU]"));
        assert_eq!(lines[1], "1,distance,1,10,20,30,0,,");
        assert_eq!(lines[2], "1,distance,2,14,23,18,13,,");
        assert_eq!(lines[4], "2,angle,2,10,20,30,1,90,");
        assert_eq!(
            lines[6..],
            ["3,profile,1,10,20,30,0,,5", "3,profile,2,10,20,29.5,0.5,,", "3,profile,3,10,20,29,1,,-7.5"]
        );
        // Without its values a profile is a line of two points.
        assert_eq!(csv(&measures, &volume, |_| None).lines().count(), 1 + 2 + 3 + 2);
    }

    #[test]
    fn a_line_that_rests_is_asked_for_once_of_each_volume() {
        let (a, b, mut pane) = (welcome(), welcome(), MeasureBar::default());
        assert_eq!(a.volume, b.volume, "another volume may be described alike");
        let line = |x: f32| [measure(MeasureKind::Profile, &[[0.0; 3], [x, 0.0, 0.0]])];
        let profile = |id| Profile { id: ProbeId(id), values: vec![Some(id as f32)] };
        let ask = |pane: &mut MeasureBar, x: f32, volume: &Arc<Welcome>, id: u32| {
            let wanted = pane.wanted(&line(x), volume);
            if let Some(wanted) = &wanted {
                pane.note_asked(wanted, ProbeId(id));
            }
            wanted.is_some()
        };
        assert!(ask(&mut pane, 1.0, &a, 1) && !ask(&mut pane, 1.0, &a, 2));
        pane.note_answer(Some(&profile(1)));
        assert!(!ask(&mut pane, 1.0, &a, 2) && ask(&mut pane, 2.0, &a, 3));
        let (old, is_new) = pane.values(&line(2.0), 0).unwrap();
        assert!(old.id == ProbeId(1) && !is_new, "the line before is shown until the answer");
        pane.note_answer(Some(&profile(3)));
        assert!(pane.values(&line(2.0), 0).is_some_and(|(_, is_new)| is_new));
        for (volume, id) in [(&b, 4), (&a, 5)] {
            assert!(ask(&mut pane, 2.0, volume, id), "the same line of another volume");
            assert!(pane.values(&line(2.0), 0).is_none(), "the values were another volume's");
            pane.note_answer(Some(&profile(id - 1)));
            assert!(pane.values(&line(2.0), 0).is_none(), "an answer to an older question");
            pane.note_answer(Some(&profile(id)));
            assert!(pane.values(&line(2.0), 0).is_some_and(|(_, is_new)| is_new));
        }
        assert!(pane.wanted(&[measure(MeasureKind::Distance, &[[0.0; 3]; 2])], &a).is_none());
        let far = pane.wanted(&line(1e6), &a).unwrap();
        assert!(far.num_points == MAX_PROFILE_POINTS && pane.wanted(&line(0.0), &a).unwrap().num_points >= 2);
    }

    #[test]
    fn the_values_of_every_profile_are_fetched_one_after_another() {
        let (volume, mut pane) = (welcome(), MeasureBar::default());
        let line = |x: f32| measure(MeasureKind::Profile, &[[0.0; 3], [x, 0.0, 0.0]]);
        let measures = [line(1.0), measure(MeasureKind::Distance, &[[0.0; 3]; 2]), line(2.0)];
        let mut asked = Vec::new();
        while let Some(wanted) = pane.wanted(&measures, &volume) {
            let id = ProbeId(asked.len() as u32 + 1);
            asked.push(wanted.line.number);
            pane.note_asked(&wanted, id);
            assert!(pane.wanted(&measures, &volume).is_none(), "one at a time");
            pane.note_answer(Some(&Profile { id, values: vec![Some(7.0); 3] }));
        }
        assert_eq!(asked, [2, 0], "the shown one first");
        let known = |number| pane.values(&measures, number).map(|(profile, _)| profile);
        assert_eq!(csv(&measures, &volume.volume, known).matches(",7\n").count(), 6);
    }
}
