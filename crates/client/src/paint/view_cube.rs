//! The cube in the corner: how the volume is turned, and a click on a side, an edge or a corner shows it from there.

use egui::{Align2, Color32, FontId, Painter, Pos2, Rect, Shape, Stroke, Vec2, vec2};
use glam::Vec3;
use isinglass_core::camera::Camera;

use super::view_aids::AXIS_COLORS;
use crate::input::orientation::Orientation;

/// A part of the cube: for x, y and z −1, 0 or 1. One number other than 0 is a side, two an edge, three a corner.
pub(crate) type CubePart = [i8; 3];

/// The cube on the screen.
pub(crate) struct ViewCube<'a> {
    pub(crate) center: Pos2,
    pub(crate) camera: &'a Camera,
    pub(crate) orientation: &'a Orientation,
    pub(crate) is_dark: bool,
}

impl ViewCube<'_> {
    pub(crate) fn rect(&self) -> Rect {
        Rect::from_center_size(self.center, Vec2::splat(2.0 * RADIUS))
    }

    /// The part under a point of the screen.
    pub(crate) fn part_at(&self, at: Pos2) -> Option<CubePart> {
        let flat = (at - self.center) / HALF_SIDE;
        let world_from_view = self.camera.pose.world_from_view;
        let from = world_from_view * Vec3::new(flat.x, -flat.y, 4.0);
        let forward = isinglass_core::space::safe_dir(world_from_view * Vec3::NEG_Z);
        let near = (-forward.signum() - from) / forward;
        let far = (forward.signum() - from) / forward;
        let s = near.max_element();
        if s > far.min_element() {
            return None;
        }
        Some((from + forward * s).to_array().map(|x| if x.abs() > BEVEL { x.signum() as i8 } else { 0 }))
    }

    /// The side that faces the viewer most.
    pub(crate) fn nearest_side(&self) -> CubePart {
        let towards = self.camera.pose.world_from_view * Vec3::Z;
        let axis = (0..3).max_by(|&a, &b| towards[a].abs().total_cmp(&towards[b].abs())).unwrap_or(0);
        let mut part = [0; 3];
        part[axis] = towards[axis].signum() as i8;
        part
    }

    /// The name of a part: the names of its sides.
    pub(crate) fn name(&self, part: CubePart) -> String {
        let sides = (0..3).filter(|&i| part[i] != 0).map(|i| self.orientation.name(i, part[i] > 0));
        sides.collect::<Vec<_>>().join(" ")
    }

    /// Draws the cube, with `marked` lit.
    pub(crate) fn paint(&self, painter: &Painter, marked: Option<CubePart>) {
        let view_from_world = self.camera.pose.world_from_view.inverse();
        for axis in 0..3 {
            for sign in [-1.0, 1.0] {
                let normal = view_from_world * (Vec3::AXES[axis] * sign);
                if normal.z > LEAST_FACING {
                    self.paint_side(painter, axis, sign, normal.z, marked);
                }
            }
        }
    }

    fn paint_side(&self, painter: &Painter, axis: usize, sign: f32, facing: f32, marked: Option<CubePart>) {
        let (right, up) = (Vec3::AXES[(axis + 1) % 3], Vec3::AXES[(axis + 2) % 3]);
        let at = |u: f32, v: f32| self.screen_from_world(Vec3::AXES[axis] * sign + right * u + up * v);
        let quad =
            |[u0, u1]: [f32; 2], [v0, v1]: [f32; 2]| vec![at(u0, v0), at(u1, v0), at(u1, v1), at(u0, v1)];
        let shade = |low: f32, high: f32| Color32::from_gray((low + (high - low) * facing) as u8);
        let (fill, line) = match self.is_dark {
            true => (shade(38.0, 74.0), Color32::from_gray(150)),
            false => (shade(196.0, 240.0), Color32::from_gray(110)),
        };
        let whole = [-1.0, 1.0];
        painter.add(Shape::convex_polygon(quad(whole, whole), fill, Stroke::new(1.0, line)));
        if let Some(part) = marked.filter(|part| f32::from(part[axis]) == sign) {
            let cell = |side: i8| match side {
                0 => [-BEVEL, BEVEL],
                1 => [BEVEL, 1.0],
                _ => [-1.0, -BEVEL],
            };
            let lit = quad(cell(part[(axis + 1) % 3]), cell(part[(axis + 2) % 3]));
            painter.add(Shape::convex_polygon(lit, MARK, Stroke::NONE));
        }
        // A letter on a side that is seen at a flat angle would lie on its neighbour.
        let strength = ((facing - 0.22) * 10.0).clamp(0.0, 1.0);
        if strength > 0.0 {
            let color = AXIS_COLORS[axis];
            let color = if self.is_dark { color } else { color.lerp_to_gamma(Color32::BLACK, 0.45) };
            let font = FontId::proportional(LETTER_SIZE);
            let name = self.orientation.name(axis, sign > 0.0);
            painter.text(at(0.0, 0.0), Align2::CENTER_CENTER, name, font, color.gamma_multiply(strength));
        }
    }

    fn screen_from_world(&self, p: Vec3) -> Pos2 {
        let seen = self.camera.pose.world_from_view.inverse() * p;
        self.center + vec2(seen.x, -seen.y) * HALF_SIDE
    }
}

/// The direction from which a part is seen in the middle, a unit vector.
pub(crate) fn direction_of(part: CubePart) -> Vec3 {
    Vec3::from_array(part.map(f32::from)).normalize()
}

/// Half the length of an edge, points. A corner is √3 as far from the middle.
const HALF_SIDE: f32 = 24.0;
/// What the cube takes around its middle, points.
pub(crate) const RADIUS: f32 = 42.0;
/// Where the cells of edges and corners begin, in halves of an edge.
const BEVEL: f32 = 0.6;
/// Sides that face the viewer less are not drawn.
const LEAST_FACING: f32 = 0.02;
const LETTER_SIZE: f32 = 15.0;
/// Colour of what a click would choose.
const MARK: Color32 = Color32::from_rgba_premultiplied(64, 116, 176, 190);

#[cfg(test)]
mod tests {
    use egui::pos2;
    use isinglass_core::camera::{Intrinsics, Pose};
    use isinglass_core::space::Aabb;

    use super::*;

    fn camera(azimuth: f32, elevation: f32) -> Camera {
        let bounds = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };
        let pose = Pose::orbit(Vec3::ZERO, azimuth, elevation, 5.0);
        Camera::new(pose, Intrinsics::perspective(64, 64, 0.7), &bounds)
    }

    #[test]
    fn every_part_that_is_seen_is_hit_where_it_is_drawn() {
        let orientation = Orientation::of(Some("RAS"));
        for (azimuth, elevation) in [(0.0, 0.0), (0.6, 0.4), (-2.0, -0.9), (3.0, 0.1)] {
            let camera = camera(azimuth, elevation);
            let cube = ViewCube {
                center: pos2(80.0, 90.0),
                camera: &camera,
                orientation: &orientation,
                is_dark: true,
            };
            let mut num_seen = 0;
            for i in 0..27 {
                let part: CubePart = [i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1];
                if part == [0; 3] {
                    continue;
                }
                // The middle of its cell on a side that is well seen.
                for axis in (0..3).filter(|&axis| part[axis] != 0) {
                    let normal = Vec3::AXES[axis] * f32::from(part[axis]);
                    let facing = (camera.pose.world_from_view.inverse() * normal).z;
                    let mut middle = Vec3::from_array(part.map(f32::from)) * 0.8;
                    middle[axis] = f32::from(part[axis]);
                    let found = cube.part_at(cube.screen_from_world(middle));
                    if facing > 0.1 {
                        assert_eq!(found, Some(part), "{azimuth} {elevation}");
                        num_seen += 1;
                    } else if facing < -0.1 && part.iter().filter(|x| **x != 0).count() == 1 {
                        assert_ne!(found, Some(part), "control: it is behind");
                    }
                }
            }
            assert!(num_seen >= 9, "{num_seen}");
            assert_eq!(cube.part_at(cube.center + vec2(RADIUS + 1.0, 0.0)), None);
        }
    }

    #[test]
    fn parts_have_the_names_of_their_sides() {
        let camera = camera(0.1, 0.1);
        let name = |letters: Option<&str>, part| {
            let orientation = Orientation::of(letters);
            let center = Pos2::ZERO;
            ViewCube { center, camera: &camera, orientation: &orientation, is_dark: true }.name(part)
        };
        assert_eq!(name(Some("RAS"), [1, 0, 0]), "R");
        assert_eq!(name(Some("RAS"), [-1, 1, -1]), "L A I");
        assert_eq!(name(None, [0, -1, 1]), "-y z");
        let orientation = Orientation::of(None);
        let cube =
            ViewCube { center: Pos2::ZERO, camera: &camera, orientation: &orientation, is_dark: false };
        assert_eq!(cube.nearest_side(), [0, 0, 1]);
        assert!((direction_of([1, -1, 0]).length() - 1.0).abs() < 1e-6);
    }
}
