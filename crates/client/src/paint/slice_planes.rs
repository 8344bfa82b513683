//! Slices in the picture of the volume: their outlines on its box, and the slices themselves.

use egui::{Color32, Mesh, Rect, TextureId, pos2};
use glam::Vec3;
use isinglass_core::camera::{Basis, Camera};
use isinglass_core::space::Aabb;
use isinglass_core::volume::SliceGrid;

use super::view_aids::{Pen, faces_eye, projected};

/// Draws the outline of a slice on the faces of the volume's box. Lines on faces that look away are faint.
pub(crate) fn paint_outline(
    pen: &Pen<'_>,
    rect: Rect,
    camera: &Camera,
    bounds: &Aabb,
    corners: &[Vec3],
    color: Color32,
) {
    let basis = camera.basis();
    for (a, b) in corners.iter().zip(corners.iter().cycle().skip(1)) {
        let strength = if is_in_front(camera, bounds, (*a + *b) * 0.5) { 0.95 } else { 0.35 };
        if let Some(ends) = projected(&basis, rect, *a, *b) {
            pen.line(ends, 1.5, color.gamma_multiply(strength));
        }
    }
}

/// A slice with its picture.
#[derive(Clone, Debug)]
pub(crate) struct TexturedSlice {
    /// Its corners in order, world space.
    pub(crate) corners: Vec<Vec3>,
    /// Its unit normal.
    pub(crate) normal: Vec3,
    pub(crate) grid: SliceGrid,
    pub(crate) texture: TextureId,
}

/// Draws slices over the picture, each behind those in front of it. The volume shines through a little.
pub(crate) fn paint_textured(pen: &Pen<'_>, rect: Rect, camera: &Camera, slices: Vec<TexturedSlice>) {
    let basis = camera.basis();
    let is_parallel = camera.intrinsics.projection.is_orthographic();
    let eye = if is_parallel { camera.pose.eye - basis.forward * FAR_AWAY } else { camera.pose.eye };
    for slice in back_to_front(slices, eye) {
        pen.painter.add(mesh_of(&slice, &basis, rect));
    }
}

/// What lies before the eye of a slice on the screen.
fn mesh_of(slice: &TexturedSlice, basis: &Basis, rect: Rect) -> Mesh {
    let mut mesh = Mesh::with_texture(slice.texture);
    let depth = |p: Vec3| basis.pixel_from_point(p).z;
    let near = slice.corners.iter().map(|p| depth(*p)).fold(0.0, f32::max) * NEAR;
    let corners = clipped(&slice.corners, |p| depth(p) - near);
    let middle = corners.iter().sum::<Vec3>() / corners.len().max(1) as f32;
    for (a, b) in corners.iter().zip(corners.iter().cycle().skip(1)) {
        add_triangle(&mut mesh, basis, rect, &slice.grid, [middle, *a, *b], DIVISIONS);
    }
    mesh
}

/// Cuts slices where they meet, and orders the pieces by what hides what from `eye`.
fn back_to_front(mut slices: Vec<TexturedSlice>, eye: Vec3) -> Vec<TexturedSlice> {
    let Some(divider) = slices.pop().filter(|slice| slice.corners.len() > 2) else {
        return if slices.is_empty() { slices } else { back_to_front(slices, eye) };
    };
    let side = |p: Vec3| (p - divider.corners[0]).dot(divider.normal);
    let towards = if side(eye) >= 0.0 { 1.0 } else { -1.0 };
    let part = |sign: f32| -> Vec<TexturedSlice> {
        let cut = |s: &TexturedSlice| {
            let corners = clipped(&s.corners, |p| side(p) * sign);
            TexturedSlice { corners, ..s.clone() }
        };
        slices.iter().map(cut).filter(|s| s.corners.len() > 2).collect()
    };
    let (far, near) = (part(-towards), part(towards));
    let mut ordered = back_to_front(far, eye);
    ordered.push(divider);
    ordered.extend(back_to_front(near, eye));
    ordered
}

/// The part of a convex polygon where `side` is positive.
fn clipped(corners: &[Vec3], side: impl Fn(Vec3) -> f32) -> Vec<Vec3> {
    let mut left = Vec::with_capacity(corners.len() + 1);
    for (a, b) in corners.iter().zip(corners.iter().cycle().skip(1)) {
        let (da, db) = (side(*a), side(*b));
        if da > 0.0 {
            left.push(*a);
        }
        if (da > 0.0) != (db > 0.0) {
            left.push(*a + (*b - *a) * (da / (da - db)));
        }
    }
    left
}

/// egui's textures know no perspective, so a triangle is divided until the error is small.
fn add_triangle(
    mesh: &mut Mesh,
    basis: &Basis,
    rect: Rect,
    grid: &SliceGrid,
    corners: [Vec3; 3],
    divisions: u32,
) {
    let [a, b, c] = corners;
    if divisions > 0 {
        let [ab, bc, ca] = [(a + b) * 0.5, (b + c) * 0.5, (c + a) * 0.5];
        for part in [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]] {
            add_triangle(mesh, basis, rect, grid, part, divisions - 1);
        }
        return;
    }
    let first = mesh.vertices.len() as u32;
    for corner in corners {
        let h = basis.pixel_from_point(corner);
        let (x, y) = (h.x / h.z / basis.width, h.y / h.z / basis.height);
        let [column, row] = grid.place(corner);
        let uv = pos2((column + 0.5) / grid.size[0] as f32, (row + 0.5) / grid.size[1] as f32);
        let pos = rect.min + egui::vec2(x, y) * rect.size();
        mesh.vertices.push(egui::epaint::Vertex { pos, uv, color: Color32::from_white_alpha(COVER) });
    }
    mesh.add_triangle(first, first + 1, first + 2);
}

/// Whether a point of the box lies on a face that looks at the eye.
fn is_in_front(camera: &Camera, bounds: &Aabb, point: Vec3) -> bool {
    let slack = (bounds.max - bounds.min) * 1e-3;
    (0..3).any(|axis| {
        let is_at = |side: f32| (point[axis] - side).abs() <= slack[axis];
        (is_at(bounds.min[axis]) && faces_eye(camera, bounds, axis, false))
            || (is_at(bounds.max[axis]) && faces_eye(camera, bounds, axis, true))
    })
}

/// How much a slice covers what lies behind it, of 255.
const COVER: u8 = 225;
/// What is nearer to the eye than this share of a slice's greatest depth is left out.
const NEAR: f32 = 0.01;
/// Each division makes four triangles of one.
const DIVISIONS: u32 = 3;
/// Parallel rays come from this many world units away.
const FAR_AWAY: f32 = 1e9;

#[cfg(test)]
mod tests {
    use isinglass_core::camera::{Intrinsics, Pose};

    use super::*;

    #[test]
    fn lines_on_the_near_faces_are_told_from_those_behind() {
        let bounds = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };
        let intrinsics = Intrinsics::perspective(200, 100, 0.7);
        // The eye is in front, above and to the right.
        let camera = Camera::new(Pose::orbit(Vec3::ZERO, 0.5, 0.4, 6.0), intrinsics, &bounds);
        for (point, is_near) in [
            (Vec3::Z, true),
            (Vec3::Y, true),
            (Vec3::NEG_Z, false),
            (Vec3::NEG_Y, false),
            (Vec3::ZERO, false),
        ] {
            assert_eq!(is_in_front(&camera, &bounds, point), is_near, "{point}");
        }
    }

    #[test]
    fn a_plane_that_passes_the_eye_has_no_holes() {
        let bounds = Aabb { min: Vec3::NEG_ONE, max: Vec3::ONE };
        let intrinsics = Intrinsics::perspective(200, 100, 0.7);
        let camera = Camera::new(Pose::orbit(Vec3::ZERO, 0.3, 0.2, 0.5), intrinsics, &bounds);
        let (basis, rect) = (camera.basis(), Rect::from_min_size(pos2(0.0, 0.0), egui::vec2(200.0, 100.0)));
        let corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];
        let corners = corners.map(|(x, z)| Vec3::new(x, -0.1, z)).to_vec();
        let depth = |p: Vec3| basis.pixel_from_point(p).z;
        assert!(corners.iter().any(|c| depth(*c) < 0.0), "it passes the eye");
        let grid = SliceGrid { origin: Vec3::ZERO, column: Vec3::X, row: Vec3::Z, size: [1, 1] };
        let slice = TexturedSlice { corners, normal: Vec3::Y, grid, texture: TextureId::User(0) };
        let mesh = mesh_of(&slice, &basis, rect);
        let covers = |at: egui::Pos2| {
            mesh.indices.chunks(3).any(|t| {
                let [a, b, c] = [t[0], t[1], t[2]].map(|i| mesh.vertices[i as usize].pos);
                let side = |a: egui::Pos2, b: egui::Pos2| (b - a).rot90().dot(at - a);
                let sides = [side(a, b), side(b, c), side(c, a)];
                sides.iter().all(|s| *s >= -1e-2) || sides.iter().all(|s| *s <= 1e-2)
            })
        };
        let mut num_seen = 0;
        for (i, j) in (0..40).flat_map(|i| (0..40).map(move |j| (i, j))) {
            let p = Vec3::new(i as f32 / 20.0 - 0.98, -0.1, j as f32 / 20.0 - 0.98);
            let h = basis.pixel_from_point(p);
            let at = pos2(h.x / h.z, h.y / h.z);
            if h.z > 0.05 && rect.contains(at) {
                num_seen += 1;
                assert!(covers(at), "{p} at {at}");
            }
        }
        assert!(num_seen > 20, "{num_seen}");
    }

    #[test]
    fn pieces_are_drawn_before_those_that_hide_them() {
        let square = |axis: usize, at: f32| {
            let [u, v] = [Vec3::AXES[(axis + 1) % 3], Vec3::AXES[(axis + 2) % 3]];
            let corners = [-u - v, u - v, u + v, -u + v].map(|c| c + Vec3::AXES[axis] * at).to_vec();
            let grid = SliceGrid { origin: Vec3::ZERO, column: u, row: v, size: [1, 1] };
            TexturedSlice { corners, normal: Vec3::AXES[axis], grid, texture: TextureId::User(axis as u64) }
        };
        let slices = vec![square(0, 0.3), square(1, -0.2), square(2, 0.1)];
        for eye in [Vec3::new(3.0, 4.0, 5.0), Vec3::new(-3.0, 4.0, 1.0), Vec3::new(0.1, -5.0, -0.6)] {
            let ordered = back_to_front(slices.clone(), eye);
            assert_eq!(ordered.len(), 1 + 2 + 4, "one is whole, one in two pieces, one in four");
            let area = |s: &TexturedSlice| {
                let c = &s.corners;
                (2..c.len()).map(|i| (c[i - 1] - c[0]).cross(c[i] - c[0]).length() / 2.0).sum::<f32>()
            };
            assert!((ordered.iter().map(area).sum::<f32>() - 12.0).abs() < 1e-4);
            // No ray from the eye to a piece meets one that was drawn before it.
            for (i, front) in ordered.iter().enumerate() {
                let target = front.corners.iter().sum::<Vec3>() / front.corners.len() as f32;
                for behind in &ordered[..i] {
                    let (p, n) = (behind.corners[0], behind.normal);
                    let t = (p - eye).dot(n) / (target - eye).dot(n);
                    let at = eye + (target - eye) * t;
                    let middle = behind.corners.iter().sum::<Vec3>() / behind.corners.len() as f32;
                    let is_inside = (0..behind.corners.len()).all(|k| {
                        let (a, b) = (behind.corners[k], behind.corners[(k + 1) % behind.corners.len()]);
                        let outwards = (b - a).cross(n);
                        let sign = (middle - a).dot(outwards).signum();
                        (at - a).dot(outwards) * sign > 1e-4
                    });
                    assert!(!(is_inside && t > 0.0 && t < 0.999), "{eye}: drawn over what hides it");
                }
            }
        }
    }
}
