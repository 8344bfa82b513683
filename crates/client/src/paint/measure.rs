//! Measurements in the picture and on slices: points under the user's hand, lines between them, and what they measure.
//!
//! A short click sets a point where something is visible. A point can be dragged. A longer drag that begins beside the
//! points moves the camera, or the point of the slices, as ever.

use egui::{Align2, Color32, Event, PointerButton, Pos2, vec2};
use glam::Vec3;
use isinglass_formats::{MAX_MEASURE_POINTS, MAX_MEASURES, MeasureKind, SavedMeasure};

use super::clip_editor::ClipView;
use super::view_aids::{Pen, projected};

/// The measurements, and what the pointer does with them.
#[derive(Clone, Debug)]
pub(crate) struct MeasureEditor {
    pub(crate) is_on: bool,
    /// What the next points measure.
    pub(crate) kind: MeasureKind,
    done: Vec<SavedMeasure>,
    /// Points of a measurement that lacks some, or of a path that goes on.
    begun: Vec<[f32; 3]>,
    hovered: Option<PointPlace>,
    /// The point that is dragged, and where the drag began.
    drag: Option<(PointPlace, Pos2)>,
    pressed_at: Option<Pos2>,
    /// Whether a point was refused because there are too many measurements.
    is_refused: bool,
}

/// A point: the number of its measurement, and its own.
type PointPlace = (usize, usize);

/// What measurements are drawn on: the picture, or a slice.
pub(crate) trait Canvas {
    /// A line of the world on the screen.
    fn ends(&self, a: Vec3, b: Vec3) -> Option<[Pos2; 2]>;

    /// Whether a point of the world lies in what is shown, and not before or behind it.
    fn holds(&self, point: Vec3) -> bool;

    fn on_screen(&self, point: [f32; 3]) -> Option<Pos2> {
        let point = Vec3::from_array(point);
        self.ends(point, point).map(|[at, _]| at)
    }
}

impl Canvas for ClipView {
    fn ends(&self, a: Vec3, b: Vec3) -> Option<[Pos2; 2]> {
        projected(&self.camera.basis(), self.rect, a, b)
    }

    fn holds(&self, _point: Vec3) -> bool {
        true
    }
}

/// Where points are set.
pub(crate) struct Ground<'a> {
    pub(crate) canvas: &'a dyn Canvas,
    /// Finds the visible point of the volume under a point of the screen.
    pub(crate) pick: Box<dyn Fn(Pos2) -> Option<Vec3> + 'a>,
    /// Whether a point of the screen is its own, and no panel covers it.
    pub(crate) is_free: Box<dyn Fn(Pos2) -> bool + 'a>,
}

impl Default for MeasureEditor {
    fn default() -> Self {
        Self {
            is_on: false,
            kind: MeasureKind::Distance,
            done: Vec::new(),
            begun: Vec::new(),
            hovered: None,
            drag: None,
            pressed_at: None,
            is_refused: false,
        }
    }
}

impl MeasureEditor {
    pub(crate) fn toggle(&mut self) {
        self.is_on = !self.is_on;
        self.end_drag();
        self.begun.clear();
    }

    pub(crate) fn measures(&self) -> &[SavedMeasure] {
        &self.done
    }

    /// Replaces the measurements.
    pub(crate) fn set(&mut self, measures: Vec<SavedMeasure>) {
        self.is_on |= !measures.is_empty();
        *self = Self { is_on: self.is_on, kind: self.kind, done: measures, ..Self::default() };
    }

    pub(crate) fn remove(&mut self, number: usize) {
        if number < self.done.len() {
            self.done.remove(number);
            self.end_drag();
        }
    }

    /// Number of points of the measurement that is not complete.
    pub(crate) fn num_begun(&self) -> usize {
        self.begun.len()
    }

    /// Measures something else from now on.
    pub(crate) fn choose(&mut self, kind: MeasureKind) {
        self.kind = kind;
        self.begun.clear();
    }

    /// Ends a path.
    pub(crate) fn finish(&mut self) {
        if self.kind == MeasureKind::Path && self.begun.len() >= 2 {
            self.complete();
        }
    }

    /// Gives up the measurement that is not complete.
    pub(crate) fn give_up(&mut self) {
        self.begun.clear();
    }

    pub(crate) fn end_drag(&mut self) {
        (self.drag, self.hovered, self.pressed_at) = (None, None, None);
    }

    pub(crate) fn is_busy(&self) -> bool {
        self.hovered.is_some() || self.drag.is_some()
    }

    /// Moves all points.
    pub(crate) fn shift(&mut self, by: Vec3) {
        let points = self.done.iter_mut().flat_map(|measure| &mut measure.points).chain(&mut self.begun);
        points.for_each(|point| *point = (Vec3::from_array(*point) + by).to_array());
    }

    /// Whether a point was refused since the last call, because there are [`MAX_MEASURES`] measurements.
    pub(crate) fn take_refusal(&mut self) -> bool {
        std::mem::take(&mut self.is_refused)
    }

    /// Takes the events of the points out of a refresh's events. Returns whether something changed.
    pub(crate) fn take_events(&mut self, events: &mut Vec<Event>, grounds: &[Ground<'_>]) -> bool {
        if !self.is_on {
            return false;
        }
        let ground_at = |at: Pos2| grounds.iter().find(|ground| (ground.is_free)(at));
        let (mut dragged_to, mut changed) = (None, false);
        events.retain(|event| match event {
            Event::PointerMoved(to) => {
                match self.drag {
                    Some(drag) => dragged_to = Some((drag, *to)),
                    None => self.hovered = ground_at(*to).and_then(|ground| self.point_at(ground, *to)),
                }
                true
            }
            Event::PointerButton { pos, button: PointerButton::Primary, pressed: true, modifiers } => {
                let ground = ground_at(*pos);
                self.hovered = ground.and_then(|ground| self.point_at(ground, *pos));
                self.drag = self.hovered.map(|place| (place, *pos));
                let can_set = self.drag.is_none() && modifiers.is_none() && ground.is_some();
                self.pressed_at = can_set.then_some(*pos);
                self.drag.is_none()
            }
            Event::PointerButton { pos, button: PointerButton::Primary, pressed: false, .. } => {
                if let Some(drag) = self.drag.take() {
                    dragged_to = Some((drag, *pos));
                    return false;
                }
                let pressed_at = self.pressed_at.take().filter(|at| at.distance(*pos) < CLICK_POINTS);
                if let Some(ground) = pressed_at.and_then(ground_at) {
                    changed |= self.click(ground, *pos);
                }
                true
            }
            // The system may never report the release.
            Event::WindowFocused(false) => {
                self.end_drag();
                true
            }
            _ => true,
        });
        // Of many movements in a refresh, the last counts. A point stays on the ground where its drag began.
        if let Some((((number, point), from), to)) = dragged_to
            && let Some(found) = ground_at(from).and_then(|ground| (ground.pick)(to))
            && let Some(place) = self.done.get_mut(number).and_then(|m| m.points.get_mut(point))
        {
            changed |= *place != found.to_array();
            *place = found.to_array();
        }
        changed
    }

    /// Sets a point. A click on the last point of a path ends the path.
    fn click(&mut self, ground: &Ground<'_>, at: Pos2) -> bool {
        let is_at_last = self.begun.last().and_then(|p| ground.canvas.on_screen(*p));
        if self.kind == MeasureKind::Path && is_at_last.is_some_and(|last| last.distance(at) < GRAB_POINTS) {
            self.finish();
            return true;
        }
        let Some(point) = (ground.pick)(at) else { return false };
        if self.done.len() >= MAX_MEASURES {
            self.is_refused = true;
            return true;
        }
        self.begun.push(point.to_array());
        let most = match self.kind {
            MeasureKind::Distance | MeasureKind::Profile => 2,
            MeasureKind::Angle => 3,
            MeasureKind::Path => MAX_MEASURE_POINTS,
        };
        if self.begun.len() >= most {
            self.complete();
        }
        true
    }

    fn complete(&mut self) {
        let points = std::mem::take(&mut self.begun);
        self.done.push(SavedMeasure { kind: self.kind, points });
    }

    fn point_at(&self, ground: &Ground<'_>, at: Pos2) -> Option<PointPlace> {
        let places = self.done.iter().enumerate().flat_map(|(number, measure)| {
            measure.points.iter().enumerate().map(move |(point, p)| ((number, point), *p))
        });
        let near =
            places.filter(|(_, p)| ground.canvas.holds(Vec3::from_array(*p))).filter_map(|(place, p)| {
                let distance = ground.canvas.on_screen(p)?.distance(at);
                (distance < GRAB_POINTS).then_some((place, distance))
            });
        near.min_by(|a, b| a.1.total_cmp(&b.1)).map(|(place, _)| place)
    }

    /// Draws all measurements. `scale` tells lengths.
    pub(crate) fn paint(&self, pen: &Pen<'_>, canvas: &dyn Canvas, scale: &LengthScale<'_>) {
        if !self.is_on {
            return;
        }
        let busy = self.drag.map(|(place, _)| place).or(self.hovered);
        for (number, measure) in self.done.iter().enumerate() {
            paint_points(pen, canvas, &measure.points, |point| busy == Some((number, point)));
            let (at, is_line) = match measure.kind {
                MeasureKind::Distance | MeasureKind::Profile => (middle(&measure.points), true),
                MeasureKind::Angle => (measure.points.get(1).copied(), false),
                MeasureKind::Path => (measure.points.last().copied(), false),
            };
            let at = at.filter(|at| canvas.holds(Vec3::from_array(*at)));
            if let Some(at) = at.and_then(|at| canvas.on_screen(at)) {
                let text = format!("{}: {}", number + 1, scale.told(measure));
                let reach = measure.points.first().and_then(|end| canvas.on_screen(*end));
                // In the line if that has room for it, and above the point or the short line otherwise.
                let (up, align) = match reach.map_or(0.0, |end| end.distance(at)) {
                    reach if is_line && reach > LEAST_REACH => (0.0, Align2::CENTER_CENTER),
                    reach => (if is_line { reach } else { 0.0 } + 12.0, Align2::CENTER_BOTTOM),
                };
                pen.label(at - vec2(0.0, up), align, &text, 13.0, LINE);
            }
        }
        paint_points(pen, canvas, &self.begun, |_| false);
    }
}

/// Draws points and the lines between them; faint where the canvas does not show that part of the volume.
fn paint_points(pen: &Pen<'_>, canvas: &dyn Canvas, points: &[[f32; 3]], is_busy: impl Fn(usize) -> bool) {
    let strength = |points: &[[f32; 3]]| {
        let is_shown = points.iter().all(|point| canvas.holds(Vec3::from_array(*point)));
        if is_shown { 1.0 } else { FAINT }
    };
    for pair in points.windows(2) {
        let [a, b] = [pair[0], pair[1]].map(Vec3::from_array);
        if let Some(ends) = canvas.ends(a, b) {
            pen.line(ends, 2.0, LINE.gamma_multiply(strength(pair)));
        }
    }
    for (i, point) in points.iter().enumerate() {
        if let Some(at) = canvas.on_screen(*point) {
            let (radius, color) = if is_busy(i) { (7.0, Color32::WHITE) } else { (4.5, LINE) };
            pen.disc(at, radius, color.gamma_multiply(strength(&[*point])));
        }
    }
}

fn middle(points: &[[f32; 3]]) -> Option<[f32; 3]> {
    let [a, b] = [*points.first()?, *points.last()?].map(Vec3::from_array);
    Some(a.midpoint(b).to_array())
}

/// The length of a way through points, world units.
pub(crate) fn length(points: &[[f32; 3]]) -> f64 {
    let distance = |pair: &[[f32; 3]]| {
        let [a, b] = [pair[0], pair[1]].map(|p| glam::DVec3::from_array(p.map(f64::from)));
        a.distance(b)
    };
    // An empty sum of floats is −0.
    points.windows(2).map(distance).sum::<f64>().abs()
}

/// The angle at the second of three points, degrees.
pub(crate) fn angle_degrees(points: &[[f32; 3]]) -> f64 {
    let [a, at, b] = [0, 1, 2].map(|i| {
        let p = points.get(i).copied().unwrap_or_default();
        glam::DVec3::from_array(p.map(f64::from))
    });
    let (a, b) = (a - at, b - at);
    a.cross(b).length().atan2(a.dot(b)).to_degrees()
}

/// How lengths of a volume are told.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LengthScale<'a> {
    /// Unit of the spacing, if known.
    pub(crate) unit: Option<&'a str>,
    /// Length of a voxel's shortest edge, world units.
    pub(crate) finest: f32,
}

impl LengthScale<'_> {
    /// A length with its unit, to a tenth of a voxel.
    pub(crate) fn length(&self, length: f64) -> String {
        let finest = f64::from(self.finest);
        let decimals = (1.0 - finest.log10()).ceil().clamp(0.0, 6.0) as usize;
        let number = if length == 0.0 {
            format!("{length:.decimals$}")
        } else if finest < LEAST_WITHOUT_EXPONENT {
            // 10⁻⁶ in single precision is a little less than that.
            let power = |length: f64| (length.log10() + 1e-6).floor();
            let figures = (1.0 + power(length) - power(finest)).clamp(1.0, 9.0) as usize;
            format!("{length:.figures$e}")
        } else if length < 0.5 * 0.1f64.powi(6) {
            format!("{length:.3e}")
        } else {
            format!("{length:.decimals$}")
        };
        format!("{number} {}", self.unit.unwrap_or("units"))
    }

    /// What a measurement says.
    pub(crate) fn told(&self, measure: &SavedMeasure) -> String {
        match measure.kind {
            MeasureKind::Angle => format!("{:.1}°", angle_degrees(&measure.points)),
            _ => self.length(length(&measure.points)),
        }
    }
}

/// Lengths of smaller voxels are told with an exponent.
const LEAST_WITHOUT_EXPONENT: f64 = 1e-4;
/// Colour of lines and points.
const LINE: Color32 = Color32::from_rgb(255, 205, 90);
/// Half the length of a line that has its label in it, points.
const LEAST_REACH: f32 = 56.0;
/// Strength of what lies beside a slice.
const FAINT: f32 = 0.25;
/// A release nearer to its press is a click, points.
const CLICK_POINTS: f32 = 4.0;
/// The pointer takes points up to this distance, points.
const GRAB_POINTS: f32 = 9.0;

#[cfg(test)]
mod tests {
    use egui::{Modifiers, Rect, pos2};
    use isinglass_core::camera::{Camera, Intrinsics, Pose};
    use isinglass_core::space::Aabb;

    use super::*;

    /// Parallel rays along −z, ten points a world unit; the middle is at 100, 100.
    fn view() -> ClipView {
        let bounds = Aabb { min: Vec3::splat(-10.0), max: Vec3::splat(10.0) };
        let intrinsics = Intrinsics::perspective(200, 200, 0.5);
        let camera = Camera::new(Pose::orbit(Vec3::ZERO, 0.0, 0.0, 40.0), intrinsics, &bounds);
        let depth = 10.0 / 0.25f32.tan();
        let rect = Rect::from_min_size(pos2(0.0, 0.0), vec2(200.0, 200.0));
        ClipView { rect, camera: camera.to_orthographic(depth, &bounds), bounds }
    }

    /// A wall at z = 2 that ends at the left of x = −5.
    fn wall(at: Pos2) -> Option<Vec3> {
        let p = Vec3::new((at.x - 100.0) / 10.0, (100.0 - at.y) / 10.0, 2.0);
        (p.x > -5.0).then_some(p)
    }

    fn button(pos: Pos2, pressed: bool) -> Event {
        Event::PointerButton { pos, button: PointerButton::Primary, pressed, modifiers: Modifiers::NONE }
    }

    fn feed(editor: &mut MeasureEditor, mut events: Vec<Event>) -> usize {
        let view = view();
        let ground = Ground { canvas: &view, pick: Box::new(wall), is_free: Box::new(|_| true) };
        editor.take_events(&mut events, &[ground]);
        events.len()
    }

    fn click(editor: &mut MeasureEditor, x: f32, y: f32) {
        feed(editor, vec![button(pos2(x, y), true), button(pos2(x + 1.0, y), false)]);
    }

    #[test]
    fn clicks_measure_and_points_follow_the_hand() {
        let mut editor = MeasureEditor::default();
        click(&mut editor, 100.0, 100.0);
        assert_eq!(editor.num_begun(), 0, "it is off");
        editor.toggle();
        click(&mut editor, 99.0, 100.0);
        click(&mut editor, 20.0, 100.0);
        assert_eq!(editor.num_begun(), 1, "nothing is visible there");
        click(&mut editor, 129.0, 140.0);
        assert_eq!(editor.measures().len(), 1);
        assert!((length(&editor.measures()[0].points) - 5.0).abs() < 1e-5, "{:?}", editor.measures());
        // A drag beside the points is the camera's.
        let at = |x, y| Event::PointerMoved(pos2(x, y));
        let camera = vec![button(pos2(60.0, 60.0), true), at(90.0, 60.0), button(pos2(90.0, 60.0), false)];
        assert_eq!((feed(&mut editor, camera), editor.num_begun()), (3, 0));
        let drag =
            vec![button(pos2(131.0, 139.0), true), at(150.0, 100.0), button(pos2(160.0, 100.0), false)];
        assert_eq!(feed(&mut editor, drag), 1, "the camera sees no press");
        assert!((length(&editor.measures()[0].points) - 6.0).abs() < 1e-5);
        // Off the wall there is nowhere to go.
        feed(
            &mut editor,
            vec![button(pos2(160.0, 100.0), true), at(10.0, 100.0), button(pos2(10.0, 100.0), false)],
        );
        assert!((length(&editor.measures()[0].points) - 6.0).abs() < 1e-5);
        editor.remove(0);
        editor.remove(7);
        assert!(editor.measures().is_empty());
    }

    #[test]
    fn angles_take_three_points_and_paths_end_where_they_are_clicked_twice() {
        let mut editor = MeasureEditor { is_on: true, kind: MeasureKind::Angle, ..Default::default() };
        for (x, y) in [(149.0, 100.0), (99.0, 100.0), (99.0, 50.0)] {
            click(&mut editor, x, y);
        }
        assert!((angle_degrees(&editor.measures()[0].points) - 90.0).abs() < 1e-4);
        editor.choose(MeasureKind::Path);
        for (x, y) in [(60.0, 150.0), (100.0, 150.0), (100.0, 180.0)] {
            click(&mut editor, x, y);
        }
        assert_eq!((editor.measures().len(), editor.num_begun()), (1, 3));
        click(&mut editor, 100.0, 180.0);
        assert!((length(&editor.measures()[1].points) - 7.0).abs() < 1e-4);
        click(&mut editor, 100.0, 20.0);
        editor.finish();
        assert_eq!(editor.num_begun(), 1, "one point is no path");
        editor.give_up();
        assert_eq!(editor.num_begun(), 0);
        // No more than a state holds.
        editor.choose(MeasureKind::Distance);
        let state = editor.measures()[0].clone();
        editor.set(vec![state; MAX_MEASURES]);
        assert!(!editor.take_refusal());
        click(&mut editor, 160.0, 20.0);
        assert_eq!((editor.num_begun(), editor.measures().len()), (0, MAX_MEASURES));
        assert!(editor.take_refusal() && !editor.take_refusal());
    }

    #[test]
    fn lengths_are_told_in_the_unit_of_the_file() {
        let scale = LengthScale { unit: Some("mm"), finest: 0.5 };
        let measure = |kind, points: &[[f32; 3]]| SavedMeasure { kind, points: points.to_vec() };
        let three_four = [[0.0; 3], [3.0, 0.0, 0.0], [3.0, 0.0, 4.0]];
        assert_eq!(scale.told(&measure(MeasureKind::Distance, &[[0.0; 3], [3.0, 4.0, 12.0]])), "13.00 mm");
        assert_eq!(scale.told(&measure(MeasureKind::Path, &three_four)), "7.00 mm");
        assert_eq!(scale.told(&measure(MeasureKind::Angle, &three_four)), "90.0°");
        let scale = LengthScale { unit: None, finest: 3.0 };
        assert_eq!(scale.length(1e-9), "1.000e-9 units");
        assert_eq!(scale.length(0.0), "0.0 units");
        let small = LengthScale { unit: Some("m"), finest: 1e-6 };
        assert_eq!([1.3e-6, 1.234_56e-3].map(|l| small.length(l)), ["1.3e-6 m", "1.2346e-3 m"]);
        let less_small = LengthScale { unit: Some("m"), finest: 2e-4 };
        assert_eq!(less_small.length(1.3e-3), "0.00130 m", "control");
        assert_eq!(angle_degrees(&[[1.0; 3]; 3]), 0.0, "points in one place");
    }
}
