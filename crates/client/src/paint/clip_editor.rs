//! The clip box and plane under the user's hand: handles in the picture, and what dragging them does.
//!
//! A box has a handle in the middle of each face, which moves along the face's normal under the pointer. A plane has
//! one handle in its middle, which moves it along its normal, and one at the tip of the normal, which tilts it. Faces
//! that look away have faint handles. Where two handles overlap, the nearer face gets the drag.

use egui::{Color32, Event, PointerButton, Pos2, Rect, vec2};
use glam::{Quat, Vec3};
use isinglass_core::camera::Camera;
use isinglass_core::clip::{Clip, Plane};
use isinglass_core::space::{Aabb, Ray};

use crate::paint::view_aids::{AXIS_COLORS, Pen, edges, faces_eye, pixel_at, projected};

/// Whether handles are shown, and what the pointer does with them.
#[derive(Clone, Debug, Default)]
pub(crate) struct ClipEditor {
    pub(crate) is_shown: bool,
    /// The last box and plane, which return when they are switched on again.
    last: Clip,
    hovered: Option<Handle>,
    drag: Option<HandleDrag>,
}

#[derive(Clone, Copy, Debug)]
pub(crate) struct ClipView {
    pub(crate) rect: Rect,
    pub(crate) camera: Camera,
    pub(crate) bounds: Aabb,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Handle {
    /// A face of the box: its axis, and whether it has the greater coordinate.
    Face(usize, bool),
    /// Moves the plane along its normal.
    Slide,
    /// Tilts the plane.
    Tilt,
}

#[derive(Clone, Copy, Debug)]
struct HandleDrag {
    handle: Handle,
    /// Where the button was pressed, and the clip at that time.
    from: Pos2,
    start: Clip,
}

impl ClipEditor {
    /// Shows or hides the handles. Without a clip, a box around the whole volume appears.
    pub(crate) fn toggle(&mut self, clip: &mut Clip, bounds: &Aabb) {
        self.is_shown = !self.is_shown;
        if self.is_shown && *clip == Clip::default() {
            clip.bounds = Some(*bounds);
        }
        (self.hovered, self.drag) = (None, None);
    }

    /// Switches the box off, or on as it was.
    pub(crate) fn toggle_box(&mut self, clip: &mut Clip, bounds: &Aabb) {
        let last = self.last.bounds.unwrap_or(*bounds);
        match clip.bounds.take() {
            Some(bounds) => self.last.bounds = Some(bounds),
            None => (clip.bounds, self.is_shown) = (Some(last), true),
        }
    }

    /// Switches the plane off, or on as it was. At first it passes through the middle, across `forward`.
    pub(crate) fn toggle_plane(&mut self, clip: &mut Clip, bounds: &Aabb, forward: Vec3) {
        match clip.plane.take() {
            Some(plane) => self.last.plane = Some(plane),
            None => {
                clip.plane = self.last.plane.or_else(|| Plane::new(forward, forward.dot(bounds.center())));
                self.is_shown = true;
            }
        }
    }

    pub(crate) fn end_drag(&mut self) {
        self.drag = None;
    }

    pub(crate) fn is_busy(&self) -> bool {
        self.hovered.is_some() || self.drag.is_some()
    }

    /// Takes the events of the handles out of a refresh's events. Returns the clip if it changes. `is_free`: no panel
    /// covers a point.
    pub(crate) fn take_events(
        &mut self,
        events: &mut Vec<Event>,
        view: &ClipView,
        clip: &Clip,
        is_free: impl Fn(Pos2) -> bool,
    ) -> Option<Clip> {
        if !self.is_shown {
            return None;
        }
        let mut changed = None;
        events.retain(|event| match event {
            Event::PointerMoved(to) => {
                match &self.drag {
                    Some(drag) => changed = Some(drag.moved(view, *to)),
                    None => self.hovered = handle_at(view, clip, *to).filter(|_| is_free(*to)),
                }
                true
            }
            Event::PointerButton { pos, button: PointerButton::Primary, pressed: true, .. } => {
                self.hovered = handle_at(view, clip, *pos).filter(|_| is_free(*pos));
                self.drag = self.hovered.map(|handle| HandleDrag { handle, from: *pos, start: *clip });
                self.drag.is_none()
            }
            Event::PointerButton { pos, button: PointerButton::Primary, pressed: false, .. } => {
                let Some(drag) = self.drag.take() else { return true };
                changed = Some(drag.moved(view, *pos));
                self.hovered = None;
                false
            }
            // The system may never report the release.
            Event::WindowFocused(false) => {
                (self.drag, self.hovered) = (None, None);
                true
            }
            _ => true,
        });
        changed.filter(|changed| changed != clip)
    }

    pub(crate) fn paint(&self, pen: &Pen<'_>, view: &ClipView, clip: &Clip) {
        if !self.is_shown {
            return;
        }
        if let Some(bounds) = box_of(view, clip) {
            pen.draw_box(view.rect, &view.camera, &bounds, BOX_COLOR);
        }
        if let Some(plane) = clip.plane {
            self.paint_plane(pen, view, clip, &plane);
        }
        let busy = self.drag.map(|d| d.handle).or(self.hovered);
        // Nearer handles cover the others.
        let mut handles = handles(view, clip);
        handles.sort_by_key(|(handle, _)| is_front(view, clip, *handle));
        for (handle, at) in handles {
            let color = match handle {
                Handle::Face(axis, _) => AXIS_COLORS[axis],
                Handle::Slide | Handle::Tilt => PLANE_COLOR,
            };
            let strength = if is_front(view, clip, handle) || busy == Some(handle) { 1.0 } else { 0.45 };
            if busy == Some(handle) {
                pen.disc(at, HANDLE_RADIUS + 3.0, Color32::WHITE);
            }
            pen.disc(at, HANDLE_RADIUS, color.gamma_multiply(strength));
        }
    }

    /// Draws the outline of the plane in the box, and its normal.
    fn paint_plane(&self, pen: &Pen<'_>, view: &ClipView, clip: &Clip, plane: &Plane) {
        let basis = view.camera.basis();
        let outline = outline(&box_of(view, clip).unwrap_or(view.bounds), plane);
        for (i, a) in outline.iter().enumerate() {
            let b = outline[(i + 1) % outline.len()];
            if let Some(ends) = projected(&basis, view.rect, *a, b) {
                pen.line(ends, 1.5, PLANE_COLOR);
            }
        }
        let middle = middle_of(view, clip, plane);
        if let Some(ends) = projected(&basis, view.rect, middle, tip_of(view, middle, plane)) {
            pen.line(ends, 1.5, PLANE_COLOR);
        }
    }
}

impl HandleDrag {
    /// The clip with the pointer at `to`.
    fn moved(&self, view: &ClipView, to: Pos2) -> Clip {
        let mut clip = self.start;
        match self.handle {
            Handle::Face(axis, is_high) => {
                if let Some(bounds) = box_of(view, &self.start) {
                    let shift = shift_along(
                        view,
                        face_middle(&bounds, axis, is_high),
                        Vec3::AXES[axis],
                        self.from,
                        to,
                    );
                    clip.bounds = Some(with_face(&bounds, &view.bounds, axis, is_high, shift));
                }
            }
            Handle::Slide => {
                if let Some(plane) = self.start.plane {
                    let middle = middle_of(view, &self.start, &plane);
                    let [least, most] = offsets(&view.bounds, plane.normal);
                    let shift = shift_along(view, middle, plane.normal, self.from, to);
                    let offset = (plane.offset + shift).clamp(least, most);
                    clip.plane = Some(Plane { offset, ..plane });
                }
            }
            Handle::Tilt => {
                if let Some(plane) = self.start.plane {
                    let middle = middle_of(view, &self.start, &plane);
                    let is_near = is_front(view, &self.start, Handle::Tilt);
                    let [a, b] = [self.from, to].map(|at| direction_at(view, middle, at, is_near));
                    let normal = (Quat::from_rotation_arc(a, b) * plane.normal).normalize();
                    clip.plane = Some(Plane { normal, offset: normal.dot(middle) });
                }
            }
        }
        // A pointer far outside can give invalid numbers.
        if clip.validate().is_ok() { clip } else { self.start }
    }
}

/// The least and greatest offset of planes with this normal that touch a box.
pub(crate) fn offsets(bounds: &Aabb, normal: Vec3) -> [f32; 2] {
    let middle = normal.dot(bounds.center());
    let reach = normal.abs().dot((bounds.max - bounds.min) * 0.5);
    [middle - reach, middle + reach]
}

/// A box with a face shifted along its axis, within the volume and not up to the opposite face.
pub(crate) fn with_face(bounds: &Aabb, volume: &Aabb, axis: usize, is_high: bool, shift: f32) -> Aabb {
    let mut moved = *bounds;
    let gap = (volume.max[axis] - volume.min[axis]) * LEAST_SIDE;
    if is_high {
        let least = (bounds.min[axis] + gap).min(volume.max[axis]);
        moved.max[axis] = (bounds.max[axis] + shift).clamp(least, volume.max[axis]);
    } else {
        let most = (bounds.max[axis] - gap).max(volume.min[axis]);
        moved.min[axis] = (bounds.min[axis] + shift).clamp(volume.min[axis], most);
    }
    moved
}

/// The part of the clip box inside the volume.
fn box_of(view: &ClipView, clip: &Clip) -> Option<Aabb> {
    clip.bounds?;
    let bounds = clip.region(&view.bounds).bounds;
    // A box outside the volume has nothing to drag; the whole volume does.
    Some(if bounds.min.cmplt(bounds.max).all() { bounds } else { view.bounds })
}

fn face_middle(bounds: &Aabb, axis: usize, is_high: bool) -> Vec3 {
    let mut middle = bounds.center();
    middle[axis] = if is_high { bounds.max[axis] } else { bounds.min[axis] };
    middle
}

/// The point of the plane nearest to the middle of the clip box.
fn middle_of(view: &ClipView, clip: &Clip, plane: &Plane) -> Vec3 {
    let center = box_of(view, clip).unwrap_or(view.bounds).center();
    center - plane.normal * plane.distance(center)
}

fn tip_of(view: &ClipView, middle: Vec3, plane: &Plane) -> Vec3 {
    middle + plane.normal * (TIP_IN_RADII * view.bounds.radius())
}

fn handles(view: &ClipView, clip: &Clip) -> Vec<(Handle, Pos2)> {
    let basis = view.camera.basis();
    let on_screen = |p: Vec3| projected(&basis, view.rect, p, p).map(|[at, _]| at);
    let mut handles = Vec::with_capacity(8);
    if let Some(bounds) = box_of(view, clip) {
        for (axis, is_high) in (0..3).flat_map(|axis| [(axis, false), (axis, true)]) {
            let at = on_screen(face_middle(&bounds, axis, is_high));
            handles.extend(at.map(|at| (Handle::Face(axis, is_high), at)));
        }
    }
    if let Some(plane) = clip.plane {
        let middle = middle_of(view, clip, &plane);
        let (slide, tilt) = (on_screen(middle), on_screen(tip_of(view, middle, &plane)));
        // A plane across the view has both handles at one point; one moves aside.
        let is_across = slide.zip(tilt).is_some_and(|(slide, tilt)| slide.distance(tilt) < 2.0 * REACH);
        let tilt = if is_across { slide.map(|slide| slide + vec2(2.5 * REACH, 0.0)) } else { tilt };
        handles.extend(slide.map(|at| (Handle::Slide, at)));
        handles.extend(tilt.map(|at| (Handle::Tilt, at)));
    }
    handles
}

/// Whether a face shows its outer side, or the plane's normal points at the eye.
fn is_front(view: &ClipView, clip: &Clip, handle: Handle) -> bool {
    match (handle, clip.plane) {
        (Handle::Face(axis, is_high), _) => {
            box_of(view, clip).is_some_and(|bounds| faces_eye(&view.camera, &bounds, axis, is_high))
        }
        (Handle::Slide, _) => true,
        (Handle::Tilt, Some(plane)) => plane.normal.dot(view.camera.pose.forward()) <= 0.0,
        (Handle::Tilt, None) => false,
    }
}

fn handle_at(view: &ClipView, clip: &Clip, at: Pos2) -> Option<Handle> {
    if !view.rect.contains(at) {
        return None;
    }
    let near = handles(view, clip).into_iter().filter_map(|(handle, on_screen)| {
        let distance = on_screen.distance(at);
        // Of two handles at the same distance, the one in front wins.
        let behind = if is_front(view, clip, handle) { 0.0 } else { BEHIND };
        (distance <= REACH).then_some((handle, distance + behind))
    });
    near.min_by(|a, b| a.1.total_cmp(&b.1)).map(|(handle, _)| handle)
}

fn ray_at(view: &ClipView, at: Pos2) -> Ray {
    let [x, y] = pixel_at(view.rect, &view.camera, at);
    view.camera.ray(x, y).0
}

/// How far a point on the line from `origin` along the unit vector `axis` moves to follow the pointer.
fn shift_along(view: &ClipView, origin: Vec3, axis: Vec3, from: Pos2, to: Pos2) -> f32 {
    let forward = view.camera.pose.forward();
    let depth = (origin - view.camera.pose.eye).dot(forward);
    let (ray_from, ray_to) = (ray_at(view, from), ray_at(view, to));
    let along = |ray: &Ray| {
        // The point of the line nearest to the ray.
        let (between, cosine) = (origin - ray.origin, axis.dot(ray.dir));
        (cosine * ray.dir.dot(between) - axis.dot(between)) / (1.0 - cosine * cosine)
    };
    let is_steep = |ray: &Ray| 1.0 - axis.dot(ray.dir).powi(2) < LEAST_SINE_SQUARED;
    if is_steep(&ray_from) || is_steep(&ray_to) {
        // A movement along the view is invisible: dragging down moves towards the eye.
        let world_per_point = 2.0 * view.camera.intrinsics.half_size_at(depth).1 / view.rect.height();
        return (to.y - from.y) * world_per_point * -axis.dot(forward).signum();
    }
    along(&ray_to) - along(&ray_from)
}

/// The direction from `middle` to the point under the pointer on a sphere around it, on the near or far side. Beside
/// the sphere it is the nearest point.
fn direction_at(view: &ClipView, middle: Vec3, at: Pos2, is_near: bool) -> Vec3 {
    let ray = ray_at(view, at);
    let radius = TIP_IN_RADII * view.bounds.radius();
    let nearest = (middle - ray.origin).dot(ray.dir);
    let aside = ray.at(nearest) - middle;
    let half = (radius * radius - aside.length_squared()).max(0.0).sqrt();
    (aside + ray.dir * if is_near { -half } else { half }).normalize_or(Vec3::Z)
}

/// The corners of a plane's intersection with a box, in order around it.
fn outline(bounds: &Aabb, plane: &Plane) -> Vec<Vec3> {
    let corners = bounds.corners();
    let mut points: Vec<Vec3> = edges()
        .filter_map(|(a, b)| {
            let (of_a, of_b) = (plane.distance(corners[a]), plane.distance(corners[b]));
            let is_cut = (of_a < 0.0) != (of_b < 0.0);
            is_cut.then(|| corners[a].lerp(corners[b], of_a / (of_a - of_b)))
        })
        .collect();
    let center = points.iter().sum::<Vec3>() / points.len().max(1) as f32;
    let right = plane.normal.any_orthonormal_vector();
    let up = plane.normal.cross(right);
    let angle = |p: &Vec3| (*p - center).dot(up).atan2((*p - center).dot(right));
    points.sort_by(|a, b| angle(a).total_cmp(&angle(b)));
    points
}

/// Least side of a dragged box, as a share of the volume's: a voxel or two.
pub(crate) const LEAST_SIDE: f32 = 0.005;
/// Length of the normal that tilts the plane, in radii of the volume.
const TIP_IN_RADII: f32 = 0.45;
/// Radius of a handle, and the distance from which it can be dragged, points.
const HANDLE_RADIUS: f32 = 6.0;
const REACH: f32 = 12.0;
/// A handle behind must be nearer to the pointer by this distance, points.
const BEHIND: f32 = 6.0;
/// Below an angle of about nine degrees to the view, a movement along an axis is invisible.
const LEAST_SINE_SQUARED: f32 = 0.025;
const BOX_COLOR: Color32 = Color32::from_rgb(120, 200, 255);
const PLANE_COLOR: Color32 = Color32::from_rgb(255, 190, 70);

#[cfg(test)]
mod tests {
    use egui::{Modifiers, pos2};
    use isinglass_core::camera::{Intrinsics, Pose};

    use super::*;

    const BOUNDS: Aabb = Aabb { min: Vec3::new(-2.0, -1.0, -1.5), max: Vec3::new(2.0, 1.0, 1.5) };

    fn views() -> [ClipView; 2] {
        let rect = Rect::from_min_size(pos2(30.0, 10.0), vec2(400.0, 300.0));
        let intrinsics = Intrinsics::perspective(800, 600, 0.7);
        let camera = Camera::new(Pose::orbit(Vec3::ZERO, 0.6, 0.4, 9.0), intrinsics, &BOUNDS);
        [camera, camera.to_orthographic(9.0, &BOUNDS)].map(|camera| ClipView { rect, camera, bounds: BOUNDS })
    }

    fn on_screen(view: &ClipView, p: Vec3) -> Pos2 {
        projected(&view.camera.basis(), view.rect, p, p).unwrap()[0]
    }

    fn boxed() -> Clip {
        Clip { bounds: Some(Aabb { min: BOUNDS.min * 0.5, max: BOUNDS.max * 0.5 }), plane: None }
    }

    fn press(pos: Pos2, pressed: bool) -> Event {
        Event::PointerButton { pos, button: PointerButton::Primary, pressed, modifiers: Modifiers::NONE }
    }

    fn dragged(view: &ClipView, clip: &Clip, from: Pos2, to: Pos2) -> Option<Clip> {
        let mut editor = ClipEditor { is_shown: true, ..ClipEditor::default() };
        let mut events = vec![press(from, true), Event::PointerMoved(to), press(to, false)];
        let changed = editor.take_events(&mut events, view, clip, |_| true);
        assert!(changed.is_none() || events.len() == 1, "the rest is the camera's");
        changed
    }

    #[test]
    fn every_face_follows_the_pointer_along_its_normal() {
        for view in views() {
            let mut num_back = 0;
            for (axis, is_high) in (0..3).flat_map(|axis| [(axis, false), (axis, true)]) {
                let clip = boxed();
                let bounds = clip.bounds.unwrap();
                let from = face_middle(&bounds, axis, is_high);
                let mut to = from;
                to[axis] += if is_high { 0.3 } else { -0.2 };
                let moved = dragged(&view, &clip, on_screen(&view, from), on_screen(&view, to)).unwrap();
                let moved = moved.bounds.unwrap();
                let mut expected = bounds;
                if is_high {
                    expected.max = expected.max.max(to);
                } else {
                    expected.min = expected.min.min(to);
                }
                let off = (moved.min - expected.min).length() + (moved.max - expected.max).length();
                // Single precision over a projection and back.
                assert!(off < 1e-3, "{axis} {is_high}: {moved:?} {expected:?}");
                num_back += usize::from(!is_front(&view, &clip, Handle::Face(axis, is_high)));
            }
            assert_eq!(num_back, 3, "faces that look away are reached, too");
        }
    }

    #[test]
    fn a_face_stays_in_the_volume_and_before_the_opposite_one() {
        for (shift, expected) in [(100.0, 2.0), (-100.0, -0.98)] {
            assert_eq!(with_face(&boxed().bounds.unwrap(), &BOUNDS, 0, true, shift).max.x, expected);
        }
        for view in views() {
            let clip = boxed();
            let from = on_screen(&view, face_middle(&clip.bounds.unwrap(), 0, true));
            for to in [pos2(-9e9, 100.0), pos2(9e9, -9e9), pos2(f32::NAN, 0.0), pos2(200.0, 9e3)] {
                let moved = dragged(&view, &clip, from, to).unwrap_or(clip);
                let bounds = moved.bounds.unwrap();
                assert!(moved.validate().is_ok() && bounds.min.cmpge(BOUNDS.min).all());
                assert!(bounds.max.cmple(BOUNDS.max).all(), "{bounds:?}");
            }
        }
    }

    #[test]
    fn along_the_view_down_is_towards_the_eye() {
        let view = views()[1];
        let camera = Camera { pose: Pose::orbit(Vec3::ZERO, 0.0, 0.0, 6.0), ..view.camera };
        let view = ClipView { camera, ..view };
        let clip = boxed();
        let at = on_screen(&view, face_middle(&clip.bounds.unwrap(), 2, true));
        let moved = dragged(&view, &clip, at, at + vec2(0.0, 20.0)).unwrap().bounds.unwrap();
        assert!(moved.max.z > 0.8 && moved.min == clip.bounds.unwrap().min, "the front face: {moved:?}");
    }

    #[test]
    fn a_plane_slides_along_its_normal_and_tilts_about_its_middle() {
        for view in views() {
            let plane = Plane::new(Vec3::new(0.3, 1.0, 0.2), 0.2).unwrap();
            let clip = Clip { bounds: None, plane: Some(plane) };
            let middle = middle_of(&view, &clip, &plane);
            assert!(plane.distance(middle).abs() < 1e-6);
            let to = on_screen(&view, middle + plane.normal * 0.3);
            let moved = dragged(&view, &clip, on_screen(&view, middle), to).unwrap().plane.unwrap();
            assert!(moved.normal == plane.normal && (moved.offset - plane.offset - 0.3).abs() < 1e-3);
            let tilted = Plane::new(Vec3::new(0.5, 0.9, 0.3), 0.0).unwrap().normal;
            let [from, to] = [plane.normal, tilted]
                .map(|normal| on_screen(&view, tip_of(&view, middle, &Plane { normal, ..plane })));
            let moved = dragged(&view, &clip, from, to).unwrap().plane.unwrap();
            assert!((moved.normal - tilted).length() < 1e-3, "{moved:?} {tilted}");
            assert!(moved.distance(middle).abs() < 1e-5, "its middle stays");
        }
    }

    #[test]
    fn a_plane_across_the_view_can_be_tilted_as_well_as_moved() {
        for view in views() {
            let forward = view.camera.pose.forward();
            let clip = Clip { bounds: None, plane: Plane::new(forward, 0.1) };
            let places = handles(&view, &clip);
            let at = |handle| places.iter().find(|(h, _)| *h == handle).unwrap().1;
            assert!(at(Handle::Slide).distance(at(Handle::Tilt)) > 2.0 * REACH);
            let tilt = at(Handle::Tilt);
            let tilted = dragged(&view, &clip, tilt, tilt + vec2(25.0, 0.0)).unwrap().plane.unwrap();
            let right = view.camera.pose.world_from_view * Vec3::X;
            assert!(tilted.normal.dot(right) > 0.1, "its far end goes to the right with the pointer");
            let slide = at(Handle::Slide);
            let moved = dragged(&view, &clip, slide, slide + vec2(0.0, 20.0)).unwrap().plane.unwrap();
            assert!(moved.normal == clip.plane.unwrap().normal, "it does not turn");
            assert!(moved.offset < 0.1, "down is towards the eye: {moved:?}");
        }
    }

    #[test]
    fn beside_the_handles_and_under_panels_events_are_the_camera_s() {
        let view = views()[0];
        let clip = boxed();
        assert_eq!(dragged(&view, &clip, pos2(40.0, 20.0), pos2(90.0, 90.0)), None);
        let at = on_screen(&view, face_middle(&clip.bounds.unwrap(), 0, true));
        let mut hidden = ClipEditor::default();
        let mut shown = ClipEditor { is_shown: true, ..ClipEditor::default() };
        let events = vec![press(at, true), Event::PointerMoved(at + vec2(9.0, 9.0))];
        for (editor, is_free) in [(&mut hidden, true), (&mut shown, false)] {
            let mut taken = events.clone();
            assert_eq!(editor.take_events(&mut taken, &view, &clip, |_| is_free), None);
            assert!(taken == events && !editor.is_busy());
        }
    }

    #[test]
    fn what_is_switched_off_comes_back() {
        let mut editor = ClipEditor::default();
        let mut clip = Clip::default();
        editor.toggle(&mut clip, &BOUNDS);
        assert_eq!((clip.bounds, editor.is_shown), (Some(BOUNDS), true));
        clip = boxed();
        editor.toggle_box(&mut clip, &BOUNDS);
        assert_eq!(clip, Clip::default());
        editor.toggle_box(&mut clip, &BOUNDS);
        assert_eq!(clip, boxed());
        editor.toggle_plane(&mut clip, &BOUNDS, Vec3::X);
        assert_eq!(clip.plane, Some(Plane { normal: Vec3::X, offset: 0.0 }));
        editor.toggle(&mut clip, &BOUNDS);
        assert!(!editor.is_shown && clip.bounds.is_some(), "hidden, and still cut");
    }

    #[test]
    fn an_outline_goes_around_once() {
        let whole = outline(&BOUNDS, &Plane { normal: Vec3::Y, offset: 0.25 });
        assert_eq!(whole.len(), 4);
        let around: f32 = (0..4).map(|i| whole[i].distance(whole[(i + 1) % 4])).sum();
        assert!((around - 14.0).abs() < 1e-5 && whole.iter().all(|p| p.y == 0.25));
        assert_eq!(outline(&BOUNDS, &Plane::new(Vec3::ONE, 0.0).unwrap()).len(), 6);
        assert!(outline(&BOUNDS, &Plane { normal: Vec3::X, offset: 9.0 }).is_empty());
    }
}
