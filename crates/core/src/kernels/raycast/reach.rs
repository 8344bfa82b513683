//! Where the rays of a picture can meet anything. Occupied cells are drawn into coarse blocks of the picture as
//! intervals of view depth. A ray walks only within its block's interval, and is not cast if that is empty.

use glam::{Vec3, Vec4};

use super::Raycaster;
use crate::camera::Basis;
use crate::kernels::empty_space::{CELL_UNITS, DEPTH_CELLS, TILE};

/// Intervals of view depth, one per block of [`SIDE`]×[`SIDE`] pixels.
pub(super) struct Reach {
    blocks_x: usize,
    /// Least and greatest depth; the first is the greater where there is nothing.
    intervals: Vec<[f32; 2]>,
}

/// What something covers in a picture: intervals of pixels along x and y, and of view depth.
#[derive(Clone, Copy)]
struct Cover {
    x: [f32; 2],
    y: [f32; 2],
    depth: [f32; 2],
}

const NOTHING: [f32; 2] = [f32::INFINITY, f32::NEG_INFINITY];

fn grown([a, b]: [f32; 2], by: [f32; 2]) -> [f32; 2] {
    [a.min(by[0]), b.max(by[1])]
}

impl Cover {
    const NONE: Self = Self { x: NOTHING, y: NOTHING, depth: NOTHING };

    /// Covers one corner, from its homogeneous pixel coordinates and view depth.
    fn of(corner: Vec4) -> Self {
        let [x, y, z, depth] = corner.to_array();
        // So near the plane of the eye, rounding would choose the side.
        if z > FARTHEST_PIXEL.recip() * (x.abs() + y.abs()) {
            Self { x: [x / z; 2], y: [y / z; 2], depth: [depth; 2] }
        } else {
            // The corner is beside or behind the eye, so its cell may appear anywhere.
            let anywhere = [f32::NEG_INFINITY, f32::INFINITY];
            Self { x: anywhere, y: anywhere, depth: [depth; 2] }
        }
    }

    fn and(self, other: &Self) -> Self {
        Self { x: grown(self.x, other.x), y: grown(self.y, other.y), depth: grown(self.depth, other.depth) }
    }
}

impl Reach {
    /// Draws what `caster` holds into the picture of a view.
    pub(super) fn new(caster: &Raycaster, view: &Basis) -> Self {
        let [blocks_x, blocks_y] = [view.width, view.height].map(|n| (n as usize).div_ceil(SIDE));
        let mut reach = Self { blocks_x, intervals: vec![NOTHING; blocks_x * blocks_y] };
        let grid = &caster.empty_space;
        let point = |p: Vec3| view.pixel_from_point(p).extend(view.depth_of(p));
        let direction = |d: Vec3| view.pixel_from_direction(d).extend(d.dot(view.forward));
        for (tile, &occupied) in grid.occupied.iter().enumerate().filter(|(_, occupied)| **occupied != 0) {
            let tile = [tile as u32 % grid.tiles[0], tile as u32 / grid.tiles[0]];
            // Rays between the centres of two lists read both.
            let first = tile.map(|tile| (tile * TILE) as f32 - MARGIN);
            let past = first.map(|first| first + TILE as f32 + 2.0 * MARGIN);
            let edges = [first, [past[0], first[1]], [first[0], past[1]], past]
                .map(|[x, y]| (point(caster.basis.origin(x, y)), direction(caster.basis.direction(x, y))));
            let border = |cell: u32| {
                let depth = caster.near + (cell * CELL_UNITS) as f32 / caster.units_per_depth;
                edges.into_iter().fold(Cover::NONE, |cover, (o, d)| cover.and(&Cover::of(o + d * depth)))
            };
            let mut front = None;
            for cell in 0..DEPTH_CELLS {
                if occupied >> cell & 1 == 0 {
                    front = None;
                    continue;
                }
                let back = border(cell + 1);
                reach.draw(&front.unwrap_or_else(|| border(cell)).and(&back));
                front = Some(back);
            }
        }
        reach
    }

    fn draw(&mut self, cover: &Cover) {
        let blocks_y = self.intervals.len() / self.blocks_x;
        // Casts saturate.
        let range = |[a, b]: [f32; 2], num: usize| {
            ((a - ROUNDING_PIXELS) / SIDE as f32) as usize
                ..(((b + ROUNDING_PIXELS) / SIDE as f32 + 1.0) as usize).min(num)
        };
        let depth = [cover.depth[0] * (1.0 - ROUNDING), cover.depth[1] * (1.0 + ROUNDING)];
        if depth[1] <= 0.0 {
            return;
        }
        for y in range(cover.y, blocks_y) {
            for x in range(cover.x, self.blocks_x) {
                let interval = &mut self.intervals[y * self.blocks_x + x];
                *interval = grown(*interval, depth);
            }
        }
    }

    /// View depths between which a pixel's ray may meet something.
    pub(super) fn at(&self, x: usize, y: usize) -> [f32; 2] {
        self.intervals[y / SIDE * self.blocks_x + x / SIDE]
    }
}

/// Side of a block, pixels.
const SIDE: usize = 8;
/// Lists by which a tile reaches beyond itself: a half, and a half to spare.
const MARGIN: f32 = 1.0;
/// Far more pixels than single precision can move a corner.
const ROUNDING_PIXELS: f32 = 0.05;
const ROUNDING: f32 = 1e-4;
/// Corners this far from the picture count as beside the eye, pixels.
const FARTHEST_PIXEL: f32 = 1e5;
