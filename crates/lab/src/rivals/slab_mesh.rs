//! The second variant of Mueller 1999: the image of each slab on a mesh of 16×16-pixel quads, whose vertices lie at the
//! mean of the near and the far depth of the content around them.
//!
//! A quad is two triangles. The image is projected on them from the old camera, so that the picture from there is the
//! image itself whatever the depths. Slabs are drawn in their order from the new eye, the quads of a slab in the order
//! that needs no sort ([`ScanOrder`]).
//!
//! A triangle with homogeneous corners a, b, c in new pixel coordinates is rasterised without clipping or division
//! (Olano and Greer 1997, Triangle scan conversion using 2D homogeneous coordinates): the point (x, y, 1) has the
//! edge functions (b × c)·(x, y, 1) and so on, of one sign inside. A corner's value f, linear on the triangle, appears
//! as Σ edge·f up to a factor that is the same for all f; so the ratio of the sums of the old (x·w, y·w) and w is the
//! old pixel.

use glam::{DVec3, Vec3};
use isinglass_core::camera::Camera;
use isinglass_core::picture::Picture;
use rayon::prelude::*;

use super::slabs::{Slabs, TILE, Tile};
use super::warp::{Band, ScanOrder, Warp, in_bands};

/// Slabs on meshes.
pub struct SlabMesh {
    slabs: Slabs,
    /// View depths at the corners of tiles, slab by slab, row by row.
    depths: Vec<f32>,
}

/// A triangle in the new picture. Each vector is a linear function of (x, y, 1).
#[derive(Clone, Copy)]
struct Triangle {
    slab: u32,
    /// The rows of its bounding box, as a half-open interval.
    rows: [u32; 2],
    columns: [u32; 2],
    /// Positive inside.
    edges: [DVec3; 3],
    /// Old x·w, y·w and w up to a common factor.
    old: [DVec3; 3],
}

impl SlabMesh {
    /// Lays the meshes.
    pub fn new(slabs: Slabs) -> Self {
        let [columns, rows] = slabs.num_tiles;
        let depths = (0..slabs.num)
            .flat_map(|slab| (0..=rows).flat_map(move |y| (0..=columns).map(move |x| (slab, x, y))))
            .map(|(slab, x, y)| vertex_depth(&slabs, slab, x, y))
            .collect();
        Self { slabs, depths }
    }

    /// The picture from a camera, premultiplied linear.
    pub fn view(&self, camera: &Camera) -> Picture {
        let triangles = self.triangles(camera);
        in_bands(camera, |mut band| {
            for triangle in &triangles {
                if (triangle.rows[0] as usize) < band.y1 && triangle.rows[1] as usize > band.y0 {
                    self.draw(triangle, &mut band);
                }
            }
        })
    }

    fn triangles(&self, camera: &Camera) -> Vec<Triangle> {
        let (slabs, new) = (&self.slabs, camera.basis());
        let [columns, rows] = slabs.num_tiles;
        let warp = Warp::new(&slabs.basis, &new);
        let order = ScanOrder::new(&slabs.basis, &new, columns as u32, rows as u32, TILE as f32);
        // The slab of the new eye, and from there to both sides: slabs on one side hide none on the other.
        let eye = slabs.slab_at(slabs.basis.depth_of(new.eye));
        let beyond = (eye.clamp(0.0, slabs.num as f32)) as usize;
        let nearest_first: Vec<usize> = (beyond..slabs.num).chain((0..beyond).rev()).collect();
        nearest_first
            .par_iter()
            .flat_map_iter(|&slab| {
                let tiles = order.rows.iter().flat_map(|&y| order.columns.iter().map(move |&x| (x, y)));
                tiles
                    .filter(move |&(x, y)| slabs.tile(slab, x as usize, y as usize).is_drawn)
                    .flat_map(move |(x, y)| self.quad(slab, x as usize, y as usize, &warp, camera))
                    .flatten()
            })
            .collect()
    }

    /// The two triangles of a tile.
    fn quad(&self, slab: usize, x: usize, y: usize, warp: &Warp, camera: &Camera) -> [Option<Triangle>; 2] {
        let [columns, rows] = self.slabs.num_tiles;
        let corner = |x: usize, y: usize| {
            let depth = self.depths[(slab * (rows + 1) + y) * (columns + 1) + x];
            let at = |i: usize, n: usize| (i * TILE).min(n) as f32;
            let (x, y) = (at(x, self.slabs.width), at(y, self.slabs.height));
            (warp.apply(x, y, depth), Vec3::new(x * depth, y * depth, depth))
        };
        let [a, b, c, d] = [corner(x, y), corner(x + 1, y), corner(x, y + 1), corner(x + 1, y + 1)];
        [[a, b, c], [c, b, d]].map(|corners| Triangle::new(slab, corners, camera))
    }

    fn draw(&self, triangle: &Triangle, band: &mut Band<'_>) {
        let rows = (triangle.rows[0] as usize).max(band.y0)..(triangle.rows[1] as usize).min(band.y1);
        for y in rows {
            // The parts of the linear functions that are the same along a row.
            let of_row = |f: DVec3| f.y * (y as f64 + 0.5) + f.z;
            let edges = triangle.edges.map(of_row);
            let old = triangle.old.map(of_row);
            for x in triangle.columns[0] as usize..triangle.columns[1] as usize {
                let px = x as f64 + 0.5;
                let is_inside =
                    (0..3).all(|i| is_inside(triangle.edges[i], triangle.edges[i].x * px + edges[i]));
                if is_inside {
                    band.put_behind(x, y, || {
                        let [xw, yw, w] = [0, 1, 2].map(|i| triangle.old[i].x * px + old[i]);
                        self.slabs.sample(triangle.slab as usize, [(xw / w) as f32, (yw / w) as f32])
                    });
                }
            }
        }
    }
}

impl Triangle {
    /// Corners are homogeneous new pixel coordinates and old (x·w, y·w, w). None if it cannot be seen, or reaches
    /// behind the new eye.
    fn new(slab: usize, corners: [(Vec3, Vec3); 3], camera: &Camera) -> Option<Self> {
        let size = [camera.intrinsics.width as f32, camera.intrinsics.height as f32];
        let (mut least, mut greatest) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for (new, _) in corners {
            if new.z < 0.5 * camera.near {
                return None;
            }
            let p = new / new.z;
            (least, greatest) = (least.min(p), greatest.max(p));
        }
        let interval = |least: f32, greatest: f32, size: f32| {
            [least.floor().clamp(0.0, size) as u32, greatest.ceil().clamp(0.0, size) as u32]
        };
        let columns = interval(least.x, greatest.x, size[0]);
        let rows = interval(least.y, greatest.y, size[1]);
        let [a, b, c] = corners.map(|(new, _)| new.as_dvec3());
        let edges = [b.cross(c), c.cross(a), a.cross(b)];
        let determinant = a.dot(edges[0]);
        if columns[0] == columns[1] || rows[0] == rows[1] || determinant == 0.0 {
            return None;
        }
        // A mesh that folds shows its back.
        let edges = edges.map(|e| e * determinant.signum());
        let value = |i: usize| (0..3).map(|j| edges[j] * f64::from(corners[j].1[i])).sum();
        Some(Self { slab: slab as u32, rows, columns, edges, old: [value(0), value(1), value(2)] })
    }
}

/// Whether a point with the value `at` of an edge function is inside. Two triangles with an edge in common compute it
/// with opposite signs to the last bit, so a point on it belongs to one of them and no pixel is missed or drawn twice.
fn is_inside(edge: DVec3, at: f64) -> bool {
    at > 0.0 || (at == 0.0 && (edge.x > 0.0 || (edge.x == 0.0 && edge.y > 0.0)))
}

/// The mean of near and far depth in the four tiles around a vertex; the slab's middle if they are empty.
fn vertex_depth(slabs: &Slabs, slab: usize, x: usize, y: usize) -> f32 {
    let [columns, rows] = slabs.num_tiles;
    let mut content = Tile::EMPTY;
    for y in y.saturating_sub(1)..(y + 1).min(rows) {
        for x in x.saturating_sub(1)..(x + 1).min(columns) {
            content.include(slabs.tile(slab, x, y).depth);
        }
    }
    if content.has_content() { 0.5 * (content.depth[0] + content.depth[1]) } else { slabs.middle(slab) }
}
