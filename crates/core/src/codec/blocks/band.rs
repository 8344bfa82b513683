//! The decoded blocks of a band: what the client shows, and what later frames are predicted from.

use super::model::{BLOCK, BLOCK_LISTS, DepthPlane, MAX_LAYERS};

/// A part of a list in a layer, as it is decoded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Cell {
    /// Depth units.
    pub(super) front: u16,
    /// Behind `front`.
    pub(super) back: u16,
    /// Code of u, from 1 on.
    pub(super) u: u16,
    /// Y, Co, Cg in units of 1/8192.
    pub(super) ycc: [i16; 3],
}

/// Front and back of a layer.
pub(super) type Planes = (DepthPlane, DepthPlane);

/// Rows of blocks.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Band {
    /// Blocks to a row.
    pub(super) across: usize,
    /// One after the other, row by row.
    pub(super) blocks: Vec<Block>,
    /// Layers of the blocks.
    pub(super) planes: Vec<Planes>,
    /// For each block that has matter: where the cells of its lists end, from the block's first.
    ends: Vec<[u16; BLOCK_LISTS]>,
    /// List by list in each block, front to back.
    pub(super) cells: Vec<Cell>,
}

/// A block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Block {
    first_plane: u32,
    num_planes: u8,
    first_cell: u32,
    /// Place in the band's `ends`; none has [`NO_ENDS`].
    ends: u32,
}

impl Band {
    /// A band without blocks yet.
    pub(super) fn new(across: usize) -> Self {
        Self { across, ..Self::default() }
    }

    /// Layers of block `block`, as indices of `planes`.
    pub(super) fn layers(&self, block: usize) -> std::ops::Range<usize> {
        let Block { first_plane, num_planes, .. } = self.blocks[block];
        first_plane as usize..first_plane as usize + usize::from(num_planes)
    }

    /// Cells of list `i` of block `block`, as indices of `cells`.
    pub(super) fn list(&self, block: usize, i: usize) -> std::ops::Range<usize> {
        let Block { first_cell, ends, .. } = self.blocks[block];
        let Some(ends) = self.ends.get(ends as usize) else { return 0..0 };
        let start = if i == 0 { 0 } else { ends[i - 1] };
        (first_cell + u32::from(start)) as usize..(first_cell + u32::from(ends[i])) as usize
    }

    /// Whether any list of the block has a cell.
    pub(super) fn has_matter(&self, block: usize) -> bool {
        self.blocks[block].ends != NO_ENDS
    }

    /// Appends a block that is one of another band.
    pub(super) fn copy(&mut self, other: &Band, block: usize) {
        let first_plane = self.planes.len();
        self.planes.extend_from_slice(&other.planes[other.layers(block)]);
        self.push_cells(first_plane, |i| &other.cells[other.list(block, i)]);
    }

    /// Appends a block, whose planes are those from `first_plane` on.
    pub(super) fn push(&mut self, first_plane: usize, lists: &Lists) {
        self.push_cells(first_plane, |i| lists.list(i));
    }

    fn push_cells<'a>(&mut self, first_plane: usize, list: impl Fn(usize) -> &'a [Cell]) {
        let first_cell = self.cells.len();
        let mut ends = [0; BLOCK_LISTS];
        for (i, end) in ends.iter_mut().enumerate() {
            self.cells.extend_from_slice(list(i));
            *end = (self.cells.len() - first_cell) as u16;
        }
        let has_matter = self.cells.len() > first_cell;
        self.blocks.push(Block {
            first_plane: first_plane as u32,
            num_planes: (self.planes.len() - first_plane) as u8,
            first_cell: first_cell as u32,
            ends: if has_matter { self.ends.len() as u32 } else { NO_ENDS },
        });
        if has_matter {
            self.ends.push(ends);
        }
    }
}

/// The lists of the block that is being coded, and how far they have come.
#[derive(Clone, Debug)]
pub(super) struct Lists {
    cells: Box<[[Cell; MAX_LAYERS]; BLOCK_LISTS]>,
    lengths: [u8; BLOCK_LISTS],
    /// Transmittance of what is there.
    pub(super) kappa: [f32; BLOCK_LISTS],
}

impl Default for Lists {
    fn default() -> Self {
        let cells = Box::new([[Cell::default(); MAX_LAYERS]; BLOCK_LISTS]);
        Self { cells, lengths: [0; BLOCK_LISTS], kappa: [1.0; BLOCK_LISTS] }
    }
}

impl Lists {
    pub(super) fn clear(&mut self) {
        self.lengths = [0; BLOCK_LISTS];
        self.kappa = [1.0; BLOCK_LISTS];
    }

    pub(super) fn list(&self, i: usize) -> &[Cell] {
        &self.cells[i][..usize::from(self.lengths[i])]
    }

    /// Appends a cell to list `i` between the planes, as far as they leave room behind the cell before: it begins
    /// where that one ends at the earliest, and is at least [`LEAST_LENGTH`] long.
    pub(super) fn push(&mut self, i: usize, planes: &Planes, u: u16, ycc: [i16; 3], alpha: f32) {
        let length = usize::from(self.lengths[i]);
        let last = if length == 0 { 0.0 } else { f32::from(self.cells[i][length - 1].back) };
        let front = (planes.0.at(i).max(last).min(MAX_FRONT) + 0.5) as u16;
        let back = (planes.1.at(i).max(f32::from(front) + LEAST_LENGTH).min(MAX_BACK) + 0.5) as u16;
        // The cell before may end so deep that none fits behind it.
        if back > front && f32::from(front) >= last && length < MAX_LAYERS {
            self.cells[i][length] = Cell { front, back, u, ycc };
            self.lengths[i] += 1;
            self.kappa[i] *= 1.0 - alpha;
        }
    }
}

/// The row of blocks that a row of lists is in.
pub(super) fn blocks_along(side: u32) -> usize {
    (side as usize).div_ceil(BLOCK)
}

const NO_ENDS: u32 = u32::MAX;
/// Depth units that a cell has at least.
const LEAST_LENGTH: f32 = 16.0;
const MAX_FRONT: f32 = 65500.0;
const MAX_BACK: f32 = 65535.0;
