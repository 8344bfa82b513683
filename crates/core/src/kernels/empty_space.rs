//! The empty cells of a layered frame (Gupta 2022, section 5). Twin of `shaders/empty_space.wgsl`.
//!
//! A cell is a tile of [`TILE`]×[`TILE`] lists in one of [`DEPTH_CELLS`] slices of equal view depth between near and
//! far. A segment occupies every cell that it reaches into. The grid is derived from the frame and never transmitted.
//! Each tile has a word with one bit per occupied cell, so a ray tests any stretch of its path with one *and*.

use rayon::prelude::*;

use crate::layer::LayeredFrame;

/// The occupied cells of one frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EmptySpace {
    /// Tiles along x and y.
    pub tiles: [u32; 2],
    /// One word per tile, row by row: bit i is set if a segment reaches into cell i.
    pub occupied: Vec<u32>,
}

impl EmptySpace {
    /// Derives the grid of a frame.
    pub fn new(frame: &LayeredFrame) -> Self {
        let size = frame.header.camera.intrinsics;
        let tiles = [size.width.div_ceil(TILE), size.height.div_ceil(TILE)];
        let tile = |i| occupied(frame, i % tiles[0], i / tiles[0]);
        Self { tiles, occupied: (0..tiles[0] * tiles[1]).into_par_iter().map(tile).collect() }
    }

    /// Fraction of cells that are empty.
    pub fn empty_share(&self) -> f32 {
        let num_occupied: u32 = self.occupied.iter().map(|bits| bits.count_ones()).sum();
        1.0 - num_occupied as f32 / (self.occupied.len() as f32 * DEPTH_CELLS as f32)
    }
}

/// The word of one tile.
fn occupied(frame: &LayeredFrame, tile_x: u32, tile_y: u32) -> u32 {
    let size = frame.header.camera.intrinsics;
    let rows = tile_y * TILE..size.height.min((tile_y + 1) * TILE);
    let columns = tile_x * TILE..size.width.min((tile_x + 1) * TILE);
    let lists = rows.flat_map(|y| columns.clone().map(move |x| (y * size.width + x) as usize));
    let bits = |i: usize| {
        let (first, last) = cells_of_segment(frame.depth[i]);
        cell_bits(first, last)
    };
    lists.flat_map(|list| frame.list(list)).map(bits).fold(0, |all, bits| all | bits)
}

/// First and last cell of a segment, from its word in the depth plane. A segment that ends on a border does not reach
/// into the next cell.
fn cells_of_segment(word: u32) -> (u32, u32) {
    ((word & 0xffff) / CELL_UNITS, ((word >> 16).max(1) - 1) / CELL_UNITS)
}

/// The cell at a depth in units.
pub(super) fn cell_of_depth(depth: f32) -> u32 {
    (depth * (1.0 / CELL_UNITS as f32)).clamp(0.0, DEPTH_CELLS as f32 - 1.0) as u32
}

/// Bits `first` to `last`.
pub(super) fn cell_bits(first: u32, last: u32) -> u32 {
    // In two steps, because a shift by 32 does nothing.
    (0xffff_ffff << first) & !(0xffff_fffe << last)
}

/// Lists along the side of a tile.
pub const TILE: u32 = 8;
/// Slices between near and far: one bit of a word each.
pub const DEPTH_CELLS: u32 = 32;
/// Depth units of a slice.
pub const CELL_UNITS: u32 = 2048;
