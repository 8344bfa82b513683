//! The pane of the measurements: what to measure, what was measured, the values along a line, and the CSV file.

use std::fmt::Write;
use std::sync::Arc;

use egui::{Align2, Context, Pos2, Rect, RichText, Role, ScrollArea, Sense, Shape, Stroke, Ui, pos2, vec2};
use glam::Vec3;
use isinglass_core::ids::ProbeId;
use isinglass_core::wire::{MAX_PROFILE_POINTS, Profile, VolumeDescription, Welcome};
use isinglass_formats::{MeasureKind, SavedMeasure};
use lucide_icons::Icon;

use super::background::write_numbered;
use super::file_field::FileField;
use super::style::{bright, icon, named, pane_at, quiet};
use super::text::format_in;
use crate::paint::measure::{LengthScale, MeasureEditor, angle_degrees, length};
use crate::view::Waker;

/// What the pane knows beside the measurements themselves.
#[derive(Default)]
pub(crate) struct MeasurePane {
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

impl MeasurePane {
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

    /// Shows the pane at the right of `room`.
    pub(crate) fn show(
        &mut self,
        ctx: &Context,
        room: Rect,
        editor: &mut MeasureEditor,
        volume: &VolumeDescription,
        wake: &Waker,
    ) {
        let _ = self.files.take();
        let place = (Align2::RIGHT_TOP, [-8.0, 8.0]);
        let shown = pane_at(ctx, "measure", room, place, |ui| {
            ui.set_width(PANE_WIDTH);
            self.kinds(ui, editor);
            self.list(ui, editor, volume);
            if let Some(number) = self.shown_profile(editor.measures()) {
                let values = self.values(editor.measures(), number).map(|(profile, _)| profile);
                show_profile(ui, values, &editor.measures()[number], volume);
            }
            if !editor.measures().is_empty() {
                self.file(ui, editor.measures(), volume, wake);
            }
            ui.add(egui::Button::new("Close").small()).clicked()
        });
        if shown.inner {
            editor.toggle();
        }
    }

    fn kinds(&mut self, ui: &mut Ui, editor: &mut MeasureEditor) {
        ui.horizontal(|ui| {
            for (kind, name) in KINDS {
                if ui.selectable_label(editor.kind == kind, name).clicked() {
                    editor.choose(kind);
                }
            }
        });
        let hint = match editor.kind {
            MeasureKind::Distance => "Click two points on a surface or a slice.",
            MeasureKind::Angle => "Click three points: the angle is at the second.",
            MeasureKind::Path => "Click points; click the last one again to end.",
            MeasureKind::Profile => "Click both ends of a line through the volume.",
        };
        ui.horizontal(|ui| {
            ui.label(RichText::new(hint).size(11.5).color(quiet(ui.ctx())));
        });
        if editor.num_begun() > 0 {
            ui.horizontal(|ui| {
                if editor.kind == MeasureKind::Path && ui.button("End the path").clicked() {
                    editor.finish();
                }
                if ui.button("Start again").clicked() {
                    editor.give_up();
                }
            });
        }
    }

    fn list(&mut self, ui: &mut Ui, editor: &mut MeasureEditor, volume: &VolumeDescription) {
        let scale = scale(volume);
        let shown = self.shown_profile(editor.measures());
        let mut removed = None;
        ScrollArea::vertical().max_height(LIST_HEIGHT).show(ui, |ui| {
            for (number, measure) in editor.measures().iter().enumerate() {
                let kind = name_of(measure.kind);
                let text = format!("{}: {kind} {}", number + 1, scale.told(measure));
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
                        _ => drop(ui.label(text)),
                    }
                });
            }
        });
        if let Some(number) = removed {
            editor.remove(number);
            (self.chosen, self.asked, self.known) = (None, Vec::new(), Vec::new());
        }
    }

    fn file(&mut self, ui: &mut Ui, measures: &[SavedMeasure], volume: &VolumeDescription, wake: &Waker) {
        self.files.show(ui, f32::INFINITY, "file of the measurements", "file; a new name if empty");
        let name = if self.files.is_replacing() { "Replace the CSV file" } else { "Save as CSV" };
        let known =
            |number| self.values(measures, number).filter(|(_, is_new)| *is_new).map(|(known, _)| known);
        let of_profile = |number: &usize| measures[*number].kind == MeasureKind::Profile;
        let missing = (0..measures.len()).filter(of_profile).filter(|number| known(*number).is_none());
        let missing: Vec<String> = missing.map(|number| (number + 1).to_string()).collect();
        if !missing.is_empty() {
            let told = format!("The values of {} are on the way.", missing.join(", "));
            ui.add(egui::Label::new(RichText::new(told).size(11.0)).wrap());
        }
        if ui.add_enabled(!self.files.is_busy(), egui::Button::new(name)).clicked() {
            let text = csv(measures, volume, known);
            let stem = super::text::file_stem(&volume.name);
            self.files.write(wake, text, move |text| write_numbered(text, &stem, ".measures.csv"));
        }
        if let Some(message) = &self.files.message {
            ui.add(egui::Label::new(RichText::new(message).size(11.0)).wrap());
        }
    }

    #[cfg(test)]
    pub(crate) fn set_path(&mut self, path: &std::path::Path) {
        self.files.set_path(path);
    }
}

fn show_profile(ui: &mut Ui, values: Option<&Profile>, of: &SavedMeasure, volume: &VolumeDescription) {
    let (rect, response) = ui.allocate_exact_size(vec2(PANE_WIDTH, PLOT_HEIGHT), Sense::hover());
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
    ui.label(RichText::new(words).size(11.5));
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

fn name_of(kind: MeasureKind) -> &'static str {
    KINDS.iter().find(|(of, _)| *of == kind).map_or("", |(_, name)| name)
}

const KINDS: [(MeasureKind, &str); 4] = [
    (MeasureKind::Distance, "Distance"),
    (MeasureKind::Angle, "Angle"),
    (MeasureKind::Path, "Path"),
    (MeasureKind::Profile, "Profile"),
];
/// Width of the pane's content, points.
const PANE_WIDTH: f32 = 264.0;
const PLOT_HEIGHT: f32 = 96.0;
const LIST_HEIGHT: f32 = 150.0;
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
        let (a, b, mut pane) = (welcome(), welcome(), MeasurePane::default());
        assert_eq!(a.volume, b.volume, "another volume may be described alike");
        let line = |x: f32| [measure(MeasureKind::Profile, &[[0.0; 3], [x, 0.0, 0.0]])];
        let profile = |id| Profile { id: ProbeId(id), values: vec![Some(id as f32)] };
        let ask = |pane: &mut MeasurePane, x: f32, volume: &Arc<Welcome>, id: u32| {
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
        let (volume, mut pane) = (welcome(), MeasurePane::default());
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
