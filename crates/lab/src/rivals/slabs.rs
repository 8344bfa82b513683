//! Mueller 1999, IBR-Assisted Volume Rendering: the volume is cut into K slabs of equal thickness, parallel to the
//! picture, from the nearest to the farthest corner of its box; each is rendered to an image of its own.
//!
//! The slabs are derived from a layered frame of any rule: a segment that a plane cuts is split as a homogeneous
//! medium, α' = 1 − (1 − α)^(l/z). This file draws the simpler of the paper's two variants, billboards: each image on
//! the middle plane of its slab.

use glam::Vec3;
use isinglass_core::camera::{Basis, Camera};
use isinglass_core::kernels::raycast::opacity;
use isinglass_core::layer::{DEPTH_UNITS, LayeredFrame, Segment, depth_to_units};
use isinglass_core::picture::Picture;
use isinglass_core::space::Aabb;
use rayon::prelude::*;

use super::warp::{Warp, bilinear, in_bands};

/// K images and what is known of their 16×16-pixel tiles.
pub struct Slabs {
    pub(super) basis: Basis,
    pub(super) num: usize,
    pub(super) width: usize,
    pub(super) height: usize,
    /// Tiles in a row and in a column.
    pub(super) num_tiles: [usize; 2],
    /// View depth of the first plane, world units.
    first: f32,
    /// Thickness, world units of view depth.
    thickness: f32,
    /// Premultiplied linear, row by row, in each row slab by slab.
    pixels: Vec<[f32; 4]>,
    /// Slab by slab, row by row.
    tiles: Vec<Tile>,
}

#[derive(Clone, Copy, Debug)]
pub(super) struct Tile {
    /// Least and greatest view depth of its content, world units; least above greatest if there is none.
    pub(super) depth: [f32; 2],
    /// Whether its content, or that of a neighbour blended over the border, shows in it.
    pub(super) is_drawn: bool,
}

impl Slabs {
    /// Cuts a frame into as many slabs as its lists can be long. `bounds` is the box of the volume.
    pub fn new(frame: &LayeredFrame, bounds: &Aabb) -> Self {
        let camera = &frame.header.camera;
        let basis = camera.basis();
        let num = usize::from(frame.header.k.max(1));
        let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
        let num_tiles = [width.div_ceil(TILE), height.div_ceil(TILE)];
        let mut pixels = vec![[0.0; 4]; width * height * num];
        // The same planes as those of the rule `slabs`. A box that is larger than the frame's is cut at near and far.
        let middle = (bounds.center() - basis.eye).dot(basis.forward);
        let reach = ((bounds.max - bounds.min) * 0.5).dot(basis.forward.abs());
        let first = (middle - reach).max(camera.near);
        let thickness =
            ((middle + reach).min(camera.far) - first).max(LEAST_THICKNESS * camera.far) / num as f32;
        let cut = Cut { num, camera, first, thickness };
        // Strips of tiles, each with its tiles slab by slab.
        let strips: Vec<Vec<Tile>> = pixels
            .par_chunks_mut(width * num * TILE)
            .enumerate()
            .map(|(strip, rows)| {
                let mut tiles = vec![Tile::EMPTY; num * num_tiles[0]];
                for (row, pixels) in rows.chunks_mut(width * num).enumerate() {
                    let y = strip * TILE + row;
                    for x in 0..width {
                        cut.list(frame, y * width + x, |slab, depth, color| {
                            let pixel = &mut pixels[slab * width + x];
                            let transmittance = 1.0 - pixel[3];
                            for (p, c) in pixel.iter_mut().zip(color) {
                                *p += c * transmittance;
                            }
                            tiles[slab * num_tiles[0] + x / TILE].include(depth);
                        });
                    }
                }
                tiles
            })
            .collect();
        let tiles = (0..num)
            .flat_map(|slab| strips.iter().map(move |strip| (slab, strip)))
            .flat_map(|(slab, strip)| strip[slab * num_tiles[0]..][..num_tiles[0]].iter().copied())
            .collect();
        let mut slabs = Self { basis, num, width, height, num_tiles, first, thickness, pixels, tiles };
        slabs.mark_borders();
        slabs
    }

    /// The view depth of a slab's middle, world units.
    pub(super) fn middle(&self, slab: usize) -> f32 {
        self.first + (slab as f32 + 0.5) * self.thickness
    }

    /// The slab at a view depth, as an unbounded number.
    pub(super) fn slab_at(&self, depth: f32) -> f32 {
        (depth - self.first) / self.thickness
    }

    /// The tile in column `x` and row `y` of tiles.
    pub(super) fn tile(&self, slab: usize, x: usize, y: usize) -> &Tile {
        &self.tiles[(slab * self.num_tiles[1] + y) * self.num_tiles[0] + x]
    }

    /// The colour of a slab at a point of the old pixel space.
    pub(super) fn sample(&self, slab: usize, at: [f32; 2]) -> [f32; 4] {
        bilinear([self.width, self.height], at, |x, y| self.pixel(slab, x, y))
    }

    /// The billboards from a camera. Premultiplied linear.
    ///
    /// A ray of the new camera meets the parallel planes in the order of their depth, or the reverse if it runs
    /// towards the old eye, so gathering along rays is drawing the planes in their order.
    pub fn view(&self, camera: &Camera) -> Picture {
        let warp = Warp::new(&camera.basis(), &self.basis);
        in_bands(camera, |mut band| {
            for y in band.y0..band.y1 {
                let left = warp.per_y * (y as f32 + 0.5) + warp.per_depth;
                // All rays of a row, plane by plane: neighbours in the row are neighbours in memory.
                for i in 0..self.num {
                    for x in 0..band.width {
                        let dir = warp.per_x * (x as f32 + 0.5) + left;
                        let slab = if dir.z >= 0.0 { i } else { self.num - 1 - i };
                        if let Some(at) = self.hit(slab, warp.offset, dir) {
                            band.put_behind(x, y, || self.sample(slab, at));
                        }
                    }
                }
            }
        })
    }

    /// Where the line `origin` + s·`dir` of homogeneous old pixel coordinates meets a slab's plane, if there is
    /// anything there.
    fn hit(&self, slab: usize, origin: Vec3, dir: Vec3) -> Option<[f32; 2]> {
        let depth = self.middle(slab);
        let s = (depth - origin.z) / dir.z;
        // Not for planes behind the new eye, nor for a ray along them, which makes this infinite or no number.
        if !(s > 0.0 && s.is_finite()) {
            return None;
        }
        let per_depth = depth.recip();
        let (x, y) = ((origin.x + s * dir.x) * per_depth, (origin.y + s * dir.y) * per_depth);
        let is_inside = (0.0..=self.width as f32).contains(&x) && (0.0..=self.height as f32).contains(&y);
        let tile = |p: f32, n: usize| (p as usize / TILE).min(n - 1);
        let [columns, rows] = self.num_tiles;
        (is_inside && self.tile(slab, tile(x, columns), tile(y, rows)).is_drawn).then_some([x, y])
    }

    fn pixel(&self, slab: usize, x: usize, y: usize) -> [f32; 4] {
        self.pixels[(y * self.num + slab) * self.width + x]
    }

    /// Content in a pixel is blended over half a pixel beyond it, which may lie in another tile.
    fn mark_borders(&mut self) {
        let [columns, rows] = self.num_tiles;
        let is_drawn: Vec<bool> = (0..self.tiles.len())
            .into_par_iter()
            .map(|i| {
                let (slab, x, y) = (i / (columns * rows), i % columns, i / columns % rows);
                if self.tiles[i].has_content() {
                    return true;
                }
                let around = |i: usize, n: usize| (i * TILE).saturating_sub(1)..((i + 1) * TILE + 1).min(n);
                let mut pixels =
                    around(y, self.height).flat_map(|y| around(x, self.width).map(move |x| (x, y)));
                pixels.any(|(x, y)| self.pixel(slab, x, y)[3] > 0.0)
            })
            .collect();
        for (tile, is_drawn) in self.tiles.iter_mut().zip(is_drawn) {
            tile.is_drawn = is_drawn;
        }
    }
}

impl Tile {
    pub(super) const EMPTY: Self = Self { depth: [f32::INFINITY, f32::NEG_INFINITY], is_drawn: false };

    pub(super) fn has_content(&self) -> bool {
        self.depth[0] <= self.depth[1]
    }

    /// Makes room for more content.
    pub(super) fn include(&mut self, [least, greatest]: [f32; 2]) {
        self.depth = [self.depth[0].min(least), self.depth[1].max(greatest)];
    }
}

/// Planes of equal view depth through a frame.
struct Cut<'a> {
    num: usize,
    camera: &'a Camera,
    first: f32,
    thickness: f32,
}

impl Cut<'_> {
    /// Hands out the pieces of a list, front to back: slab, interval of view depth and colour.
    fn list(&self, frame: &LayeredFrame, list: usize, mut piece: impl FnMut(usize, [f32; 2], [f32; 4])) {
        let depth_per_unit = (self.camera.far - self.camera.near) / DEPTH_UNITS;
        let (first_plane, units_per_slab) =
            (depth_to_units(self.camera, self.first), self.thickness / depth_per_unit);
        for segment in frame.list(list) {
            let Segment { front, back, c, tau } = frame.segment(segment);
            let (front, back) = (f32::from(front), f32::from(back));
            // Matter before the first and behind the last plane, of a wrong box, is given to the outermost slabs.
            let slab_at = |units: f32| (((units - first_plane) / units_per_slab) as usize).min(self.num - 1);
            let margin = LEAST_PIECE_UNITS.min(0.5 * (back - front));
            let (first, last) = (slab_at(front + margin), slab_at(back - margin));
            let whole = opacity(tau);
            for slab in first..=last {
                let a = if slab == first { front } else { first_plane + slab as f32 * units_per_slab };
                let b = if slab == last { back } else { first_plane + (slab + 1) as f32 * units_per_slab };
                let alpha = opacity(tau * ((b - a) / (back - front)));
                // A segment without light has no colour to divide.
                let c = if whole > 0.0 { c * (alpha / whole) } else { c };
                let depth = [a, b].map(|units| self.camera.near + units * depth_per_unit);
                piece(slab, depth, [c.x, c.y, c.z, alpha]);
            }
        }
    }
}

/// Side of a tile in pixels, as in the paper.
pub(super) const TILE: usize = 16;
/// A plane that would cut off less of a segment than this cuts nothing: the segment ends at the plane but for the
/// rounding of depths, and a thousandth of an opaque one would still be seen.
const LEAST_PIECE_UNITS: f32 = 4.0;
/// Least thickness of all slabs, in units of the far depth: that of a box which lies behind the eye.
const LEAST_THICKNESS: f32 = 1e-4;
