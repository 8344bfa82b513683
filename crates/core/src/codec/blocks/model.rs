//! A block of 8×8 lists, and the layers that its lists share. Depths are in depth units, see [`crate::layer`].

use glam::Vec3;

/// Number of lists along a side of a block.
pub(super) const BLOCK: usize = 8;
/// Number of lists in a block.
pub(super) const BLOCK_LISTS: usize = BLOCK * BLOCK;
/// Number of blocks along a side of a tile.
pub(super) const TILE: usize = 8;
/// Most layers of a block.
pub(super) const MAX_LAYERS: usize = 24;

/// The lists in a mask, from the first.
pub(super) fn lists_of(mut mask: u64) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let list = mask.trailing_zeros() as usize;
        mask &= mask.wrapping_sub(1);
        (list < BLOCK_LISTS).then_some(list)
    })
}

/// A depth plane over a block, in sixteenths of a depth unit. The middle of the block is (3.5, 3.5) lists from its first
/// list.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct DepthPlane {
    /// Depth at the middle of the block.
    pub(super) z: i32,
    /// Growth for each list rightwards.
    pub(super) dx: i32,
    /// Growth for each list downwards.
    pub(super) dy: i32,
}

impl DepthPlane {
    /// A plane whose numbers are bounded, so that sums of them have room.
    pub(super) fn bounded(z: i32, dx: i32, dy: i32) -> Self {
        let slope = |s: i32| s.clamp(-MAX_SLOPE, MAX_SLOPE);
        Self { z: z.clamp(-MAX_DEPTH, MAX_DEPTH), dx: slope(dx), dy: slope(dy) }
    }

    /// Depth at a place, in quarters of a list from the middle of the block.
    #[inline(always)]
    pub(super) fn at(&self, [x, y]: [i32; 2]) -> i32 {
        self.z + ((self.dx * x + self.dy * y) >> 2)
    }

    /// The plane of the block that lies so many blocks to the right and below.
    pub(super) fn continued(&self, [x, y]: [i32; 2]) -> Self {
        Self::bounded(self.z + BLOCK as i32 * (x * self.dx + y * self.dy), self.dx, self.dy)
    }

    /// The plane in depth units.
    pub(super) fn fit(&self) -> PlaneFit {
        let units = |v: i32| v as f32 / SIXTEENTHS as f32;
        PlaneFit { z: units(self.z), dx: units(self.dx), dy: units(self.dy) }
    }
}

/// Place of list `i` of a block along an axis, in quarters of a list from the middle.
#[inline(always)]
pub(super) fn quarters_from_middle(list: usize) -> i32 {
    4 * list as i32 - 2 * (BLOCK as i32 - 1)
}

/// Column and row of lists in the middle of the block at a column and a row of blocks.
pub(super) fn middle_of(block: [i32; 2]) -> [i32; 2] {
    block.map(|at| at * BLOCK as i32 + BLOCK as i32 / 2)
}

/// A depth plane over a block as a search finds it, in depth units. The middle is that of [`DepthPlane`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct PlaneFit {
    /// Depth at the middle of the block.
    pub(super) z: f32,
    /// Growth for each list rightwards.
    pub(super) dx: f32,
    /// Growth for each list downwards.
    pub(super) dy: f32,
}

impl PlaneFit {
    /// Depth at list `i` of the block, counted row by row.
    #[inline]
    pub(super) fn at(&self, i: usize) -> f32 {
        const MIDDLE: f32 = (BLOCK as f32 - 1.0) / 2.0;
        let (x, y) = ((i % BLOCK) as f32 - MIDDLE, (i / BLOCK) as f32 - MIDDLE);
        self.z + self.dx * x + self.dy * y
    }
}

/// Matter of a block's lists between two depth planes.
#[derive(Clone, Debug, PartialEq)]
#[repr(align(64))]
pub(super) struct BlockLayer {
    /// Front of the layer.
    pub front: PlaneFit,
    /// Back of the layer.
    pub back: PlaneFit,
    /// Mask of the lists with matter; list (x, y) has bit 8y + x.
    pub mask: u64,
    /// Optical depth of each list; 0 where it has none.
    pub tau: [f32; BLOCK_LISTS],
    /// Premultiplied linear colour of each list; 0 where it has none.
    pub c: [Vec3; BLOCK_LISTS],
}

impl Default for BlockLayer {
    fn default() -> Self {
        Self {
            front: PlaneFit::default(),
            back: PlaneFit::default(),
            mask: 0,
            tau: [0.0; BLOCK_LISTS],
            c: [Vec3::ZERO; BLOCK_LISTS],
        }
    }
}

/// The blocks of a tile in their frame, or those of a quarter of it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct TilePlace {
    /// Column and row of its first block in the frame.
    pub(super) first: [usize; 2],
    /// Blocks to a row.
    pub(super) across: usize,
    pub(super) num_rows: usize,
    /// Columns and rows of lists in the frame.
    pub(super) size: [usize; 2],
}

impl TilePlace {
    /// The tile at a column and a row of tiles.
    pub(super) fn of(column: usize, row: usize, size: [usize; 2]) -> Self {
        let first = [column * TILE, row * TILE];
        let [across, num_rows] =
            [0, 1].map(|axis| size[axis].div_ceil(BLOCK).saturating_sub(first[axis]).min(TILE));
        Self { first, across, num_rows, size }
    }

    /// A quarter of a tile: left or right, upper or lower. `None` outside of the frame.
    pub(super) fn quarter(&self, quarter: usize) -> Option<Self> {
        let [right, lower] = [quarter % 2, quarter / 2].map(|half| half * TILE / 2);
        let across = self.across.checked_sub(right).filter(|num| *num > 0)?.min(TILE / 2);
        let num_rows = self.num_rows.checked_sub(lower).filter(|num| *num > 0)?.min(TILE / 2);
        Some(Self { first: [self.first[0] + right, self.first[1] + lower], across, num_rows, ..*self })
    }

    /// Column and row in the frame of a block of the tile.
    pub(super) fn in_frame(&self, x: usize, y: usize) -> [usize; 2] {
        [x + self.first[0], y + self.first[1]]
    }

    /// Mask of a block's lists inside the frame.
    pub(super) fn inside(&self, x: usize, y: usize) -> u64 {
        let at = self.in_frame(x, y);
        let [columns, rows] = [0, 1].map(|axis| self.size[axis].saturating_sub(at[axis] * BLOCK).min(BLOCK));
        let row = (1u64 << columns) - 1;
        (0..rows).fold(0, |mask, y| mask | row << (y * BLOCK))
    }
}

/// Depths are counted in this part of a depth unit.
pub(super) const SIXTEENTHS: i32 = 16;
/// Greatest depth and slope of a plane, in sixteenths: four times the range of depths, and half of it for each list.
const MAX_DEPTH: i32 = 1 << 22;
const MAX_SLOPE: i32 = 1 << 19;

/// Number of blocks along a side of `side` lists.
pub(super) fn blocks_along(side: u32) -> usize {
    (side as usize).div_ceil(BLOCK)
}

/// Number of tiles along a side of `side` lists.
pub(super) fn tiles_along(side: u32) -> usize {
    blocks_along(side).div_ceil(TILE)
}
