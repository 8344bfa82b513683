//! Aids over the picture: the volume's box, its axes, a scale bar and the centre of rotation.

use egui::{Align2, Color32, FontId, Painter, Pos2, Rect, Stroke, Vec2, pos2, vec2};
use glam::Vec3;
use isinglass_core::camera::{Basis, Camera};
use isinglass_core::picture::linear_from_srgb;
use isinglass_core::space::Aabb;

use super::view_cube::{self, CubePart, ViewCube};
use crate::input::orientation::Orientation;

#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ViewAids {
    pub(crate) shows_box: bool,
    /// Axes and scale bar.
    pub(crate) shows_axes: bool,
    /// The key to the colours.
    pub(crate) shows_legend: bool,
    /// sRGB behind the volume.
    pub(crate) background: [u8; 3],
}

impl Default for ViewAids {
    fn default() -> Self {
        Self { shows_box: false, shows_axes: true, shows_legend: false, background: [0; 3] }
    }
}

pub(crate) struct AidsScene<'a> {
    pub(crate) rect: Rect,
    pub(crate) camera: &'a Camera,
    /// The volume's box.
    pub(crate) bounds: &'a Aabb,
    pub(crate) orientation: &'a Orientation,
    /// Unit of length, if known.
    pub(crate) unit: Option<&'a str>,
    pub(crate) center: Vec3,
    pub(crate) shows_center: bool,
    /// Height of axes and scale above the picture's lower edge, where that is covered, points.
    pub(crate) lift: f32,
    /// The part of the cube under the pointer.
    pub(crate) marked: Option<CubePart>,
}

impl AidsScene<'_> {
    /// The corner at the bottom left where axes and scale lie.
    fn corner(&self) -> Pos2 {
        self.rect.left_bottom() - vec2(0.0, self.lift)
    }
}

impl ViewAids {
    /// The background as the ray cast takes it.
    pub(crate) fn linear_background(&self) -> [f32; 3] {
        self.background.map(|c| linear_from_srgb(f32::from(c) / 255.0))
    }

    pub(crate) fn axes_in_words(scene: &AidsScene<'_>) -> String {
        let view_from_world = scene.camera.pose.world_from_view.inverse();
        let toward = |direction: Vec3| {
            let along = |axis: usize| (view_from_world * Vec3::AXES[axis]).dot(direction);
            let nearest = (0..3).max_by(|&a, &b| along(a).abs().total_cmp(&along(b).abs())).unwrap_or(0);
            scene.orientation.name(nearest, along(nearest) >= 0.0)
        };
        let (right, up, near) = (toward(Vec3::X), toward(Vec3::Y), toward(Vec3::Z));
        format!("axes: {right} to the right, {up} up, {near} towards you")
    }

    /// The cube that shows the directions of the axes.
    pub(crate) fn cube<'a>(&self, scene: &'a AidsScene<'a>) -> ViewCube<'a> {
        ViewCube {
            center: cube_center(scene.rect, scene.lift),
            camera: scene.camera,
            orientation: scene.orientation,
            is_dark: self.is_dark(),
        }
    }

    fn is_dark(&self) -> bool {
        let [r, g, b] = self.background.map(f32::from);
        0.299 * r + 0.587 * g + 0.114 * b < 128.0
    }

    pub(crate) fn pen<'a>(&self, painter: &'a Painter) -> Pen<'a> {
        let is_dark = self.is_dark();
        let ink = if is_dark { Color32::from_gray(225) } else { Color32::from_gray(25) };
        Pen { painter, ink, halo: if is_dark { Color32::from_gray(8) } else { Color32::from_gray(248) } }
    }

    pub(crate) fn paint(&self, painter: &Painter, scene: &AidsScene<'_>) {
        let pen = self.pen(painter);
        if self.shows_box {
            pen.draw_box(scene.rect, scene.camera, scene.bounds, pen.ink);
        }
        if self.shows_axes {
            self.cube(scene).paint(painter, scene.marked);
            pen.draw_scale(scene);
        }
        if scene.shows_center {
            pen.draw_center(scene);
        }
    }
}

/// Draws lines and words that stand out from any colour.
pub(crate) struct Pen<'a> {
    pub(crate) painter: &'a Painter,
    pub(crate) ink: Color32,
    halo: Color32,
}

impl Pen<'_> {
    pub(crate) fn line(&self, ends: [Pos2; 2], width: f32, color: Color32) {
        let halo = self.halo.gamma_multiply(f32::from(color.a()) / 255.0 * 0.6);
        self.painter.line_segment(ends, Stroke::new(width + 2.0, halo));
        self.painter.line_segment(ends, Stroke::new(width, color));
    }

    pub(crate) fn disc(&self, at: Pos2, radius: f32, color: Color32) {
        self.painter.circle(at, radius, color, Stroke::new(1.5, self.halo.gamma_multiply(0.8)));
    }

    pub(crate) fn text(&self, at: Pos2, align: Align2, text: &str, size: f32, color: Color32) {
        let font = FontId::proportional(size);
        for shift in [vec2(-1.0, 0.0), vec2(1.0, 0.0), vec2(0.0, -1.0), vec2(0.0, 1.0)] {
            self.painter.text(at + shift, align, text, font.clone(), self.halo.gamma_multiply(0.7));
        }
        self.painter.text(at, align, text, font, color);
    }

    /// A text on a patch of its own, over lines and pictures alike.
    pub(crate) fn label(&self, at: Pos2, align: Align2, text: &str, size: f32, color: Color32) {
        let galley = self.painter.layout_no_wrap(text.to_owned(), FontId::proportional(size), color);
        let rect = align.anchor_size(at, galley.size());
        let patch = self.halo.gamma_multiply(0.85);
        self.painter.rect_filled(rect.expand2(vec2(5.0, 2.0)), 4.0, patch);
        self.painter.galley(rect.min, galley, color);
    }

    /// Draws a box; edges of faces that look away are faint.
    pub(crate) fn draw_box(&self, rect: Rect, camera: &Camera, bounds: &Aabb, color: Color32) {
        let basis = camera.basis();
        let corners = bounds.corners();
        for (a, b) in edges() {
            let axis = (a ^ b).trailing_zeros() as usize;
            let others = [(axis + 1) % 3, (axis + 2) % 3];
            let is_front = others.iter().any(|&other| faces_eye(camera, bounds, other, a >> other & 1 == 1));
            let strength = if is_front { 0.85 } else { 0.3 };
            if let Some(ends) = projected(&basis, rect, corners[a], corners[b]) {
                self.line(ends, 1.0, color.gamma_multiply(strength));
            }
        }
    }

    /// Draws a length beside the axes. It is exact at the depth of the centre of rotation.
    fn draw_scale(&self, scene: &AidsScene<'_>) {
        let depth = (scene.center - scene.camera.pose.eye).dot(scene.camera.pose.forward());
        let intrinsics = &scene.camera.intrinsics;
        let world_per_point = 2.0 * intrinsics.half_size_at(depth).1 / scene.rect.height();
        let Some((length, text)) = round_length(world_per_point * MAX_SCALE_POINTS, scene.unit) else {
            return;
        };
        let left = scene.corner() + vec2(2.0 * AXES_MARGIN + 12.0, -32.0);
        let right = left + vec2(length / world_per_point, 0.0);
        self.line([left, right], 2.0, self.ink);
        for end in [left, right] {
            self.line([end + vec2(0.0, -4.0), end + vec2(0.0, 4.0)], 2.0, self.ink);
        }
        self.text(left + vec2(0.0, -8.0), Align2::LEFT_BOTTOM, &text, 13.0, self.ink);
        let is_parallel = intrinsics.projection.is_orthographic();
        let note =
            if is_parallel { "at any depth; parallel" } else { "at the centre of rotation; perspective" };
        self.text(left + vec2(0.0, 7.0), Align2::LEFT_TOP, note, 10.0, self.ink.gamma_multiply(0.7));
    }

    fn draw_center(&self, scene: &AidsScene<'_>) {
        let basis = scene.camera.basis();
        let Some([at, _]) = projected(&basis, scene.rect, scene.center, scene.center) else { return };
        for arm in [vec2(9.0, 0.0), vec2(0.0, 9.0)] {
            self.line([at - arm, at + arm], 1.5, Color32::from_rgb(255, 190, 70));
        }
    }
}

/// The middle of the cube in a picture, `lift` points above its usual place.
pub(crate) fn cube_center(rect: Rect, lift: f32) -> Pos2 {
    rect.left_bottom() + vec2(AXES_MARGIN, -AXES_MARGIN - lift)
}

/// The twelve edges of a box, by the numbers of its corners.
pub(crate) fn edges() -> impl Iterator<Item = (usize, usize)> {
    (0..8usize).flat_map(|a| (0..3).map(move |axis| (a, a | 1 << axis))).filter(|(a, b)| a != b)
}

/// Whether a face of a box shows its outer side.
pub(crate) fn faces_eye(camera: &Camera, bounds: &Aabb, axis: usize, is_high: bool) -> bool {
    let side = if is_high { bounds.max } else { bounds.min };
    if camera.intrinsics.projection.is_orthographic() {
        return (camera.pose.forward()[axis] < 0.0) == is_high;
    }
    (camera.pose.eye[axis] > side[axis]) == is_high
}

/// A line of the world on the screen, cut where it passes the eye.
pub(crate) fn projected(basis: &Basis, rect: Rect, a: Vec3, b: Vec3) -> Option<[Pos2; 2]> {
    let (mut a, mut b) = (basis.pixel_from_point(a), basis.pixel_from_point(b));
    // Homogeneous points are cut linearly. Nearer points are far outside the screen.
    let least = a.z.abs().max(b.z.abs()) * 1e-3;
    if a.z.max(b.z) <= least {
        return None;
    }
    if a.z < least {
        a += (b - a) * ((least - a.z) / (b.z - a.z));
    } else if b.z < least {
        b += (a - b) * ((least - b.z) / (a.z - b.z));
    }
    let points_per_pixel = vec2(rect.width() / basis.width, rect.height() / basis.height);
    Some([a, b].map(|h| {
        let (x, y) = (h.x / h.z, h.y / h.z);
        rect.min + vec2(x.clamp(-1e5, 1e5), y.clamp(-1e5, 1e5)) * points_per_pixel
    }))
}

/// The longest of 1, 2, 5, 10 … of the unit that is at most `most`, and its text.
pub(crate) fn round_length(most: f32, unit: Option<&str>) -> Option<(f32, String)> {
    if !(most > 0.0 && most.is_finite()) {
        return None;
    }
    let power = 10f32.powf(most.log10().floor());
    let step = [5.0, 2.0, 1.0].into_iter().find(|s| s * power <= most * 1.0001).unwrap_or(1.0);
    let length = step * power;
    if !(length > 0.0 && length.is_finite()) {
        return None;
    }
    let number = if (1e-3..1e5).contains(&length) { format!("{length:.3}") } else { format!("{length:.0e}") };
    let number =
        if number.contains('.') { number.trim_end_matches('0').trim_end_matches('.') } else { &number };
    let unit = unit.unwrap_or(if number == "1" { "unit" } else { "units" });
    Some((length, format!("{number} {unit}")))
}

const AXES_MARGIN: f32 = 58.0;
/// Colours of x, y and z.
pub(crate) const AXIS_COLORS: [Color32; 3] =
    [Color32::from_rgb(235, 95, 85), Color32::from_rgb(110, 200, 95), Color32::from_rgb(95, 150, 245)];
const MAX_SCALE_POINTS: f32 = 150.0;
/// Room for axes and scale at the bottom left, with the scale's longest note, points.
pub(crate) const CORNER: Vec2 = vec2(2.0 * AXES_MARGIN + 12.0 + 176.0, AXES_MARGIN + view_cube::RADIUS + 8.0);

/// The point of the picture under a point of the screen, pixels.
pub(crate) fn pixel_at(rect: Rect, camera: &Camera, at: Pos2) -> [f32; 2] {
    let i = &camera.intrinsics;
    let at = pos2(at.x - rect.left(), at.y - rect.top());
    [at.x / rect.width() * i.width as f32, at.y / rect.height() * i.height as f32]
}

#[cfg(test)]
mod tests {
    use isinglass_core::camera::{Intrinsics, Pose};

    use super::*;

    const BOUNDS: Aabb = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };

    #[test]
    fn a_box_has_twelve_edges_of_one_side_each() {
        let all: Vec<_> = edges().collect();
        assert_eq!(all.len(), 12);
        assert!(all.iter().all(|(a, b)| (a ^ b).count_ones() == 1));
    }

    #[test]
    fn lines_lie_where_the_ray_cast_sees_their_ends_and_pass_behind_the_eye() {
        let intrinsics = Intrinsics::perspective(200, 100, 0.7);
        let camera = Camera::new(Pose::orbit(Vec3::ZERO, 0.4, 0.3, 5.0), intrinsics, &BOUNDS);
        let rect = Rect::from_min_size(pos2(10.0, 20.0), vec2(100.0, 50.0));
        let basis = camera.basis();
        let point = |x, y| camera.ray(x, y).0.at(4.0);
        let ends = projected(&basis, rect, point(40.0, 60.0), point(150.0, 10.0)).unwrap();
        for (end, expected) in ends.iter().zip([pos2(30.0, 50.0), pos2(85.0, 25.0)]) {
            // A few roundings of coordinates up to 200.
            assert!(end.distance(expected) < 1e-3, "{end:?} {expected:?}");
            let [x, y] = pixel_at(rect, &camera, *end);
            assert!(
                (x - 2.0 * (expected.x - 10.0)).abs() < 1e-2 && (y - 2.0 * (expected.y - 20.0)).abs() < 1e-2
            );
        }
        let behind = camera.pose.eye - camera.pose.forward();
        let ends = projected(&basis, rect, point(40.0, 60.0), behind).unwrap();
        assert!(ends.iter().all(|p| p.x.is_finite() && p.y.is_finite()));
        assert!(ends[0].distance(pos2(30.0, 50.0)) < 1e-3, "the end in sight stays");
        assert_eq!(projected(&basis, rect, behind, behind), None);
    }

    #[test]
    fn parallel_rays_show_the_same_faces_and_lengths_from_any_distance() {
        let intrinsics = Intrinsics::perspective(200, 100, 0.7);
        let camera = Camera::new(Pose::orbit(Vec3::ZERO, 0.4, 0.3, 5.0), intrinsics, &BOUNDS);
        let parallel = camera.to_orthographic(5.0, &BOUNDS);
        let rect = Rect::from_min_size(pos2(10.0, 20.0), vec2(100.0, 50.0));
        let basis = parallel.basis();
        let right = camera.pose.world_from_view * Vec3::X;
        let length = |depth: f32| {
            let from = camera.pose.eye + camera.pose.forward() * depth;
            let [a, b] = projected(&basis, rect, from, from + right).unwrap();
            a.distance(b)
        };
        // Half of the height is 5·tan 0.35, over 25 points.
        assert!((length(5.0) - 25.0 / (5.0 * 0.35f32.tan())).abs() < 1e-3);
        assert!((length(5.0) - length(3.0)).abs() < 1e-3 && (length(5.0) - length(7.0)).abs() < 1e-3);
        for (axis, is_high) in (0..3).flat_map(|axis| [(axis, false), (axis, true)]) {
            assert_eq!(
                faces_eye(&parallel, &BOUNDS, axis, is_high),
                faces_eye(&camera, &BOUNDS, axis, is_high)
            );
        }
    }

    #[test]
    fn lengths_are_round_and_not_too_long() {
        for (most, text) in [
            (73.0, "50 mm"),
            (20.0, "20 mm"),
            (1.99, "1 mm"),
            (0.5, "0.5 mm"),
            (1e-7, "1e-7 mm"),
            (3e8, "2e8 mm"),
        ] {
            assert_eq!(round_length(most, Some("mm")).unwrap().1, text, "{most}");
        }
        assert_eq!(round_length(2.0, None).unwrap(), (2.0, "2 units".into()));
        assert_eq!(round_length(1.5, None).unwrap(), (1.0, "1 unit".into()));
        for most in [0.0, -1.0, f32::NAN, f32::INFINITY] {
            assert_eq!(round_length(most, None), None);
        }
    }
}
