//! The decoded blocks of a band: what the client shows, and what later frames are predicted from.

use super::model::{BLOCK, BLOCK_LISTS, DepthPlane, MAX_LAYERS, lists_of};
use super::scales::whole;

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
    /// Memory that its contents take.
    pub(super) fn num_bytes(&self) -> usize {
        size_of_val(&*self.blocks)
            + size_of_val(&*self.planes)
            + size_of_val(&*self.ends)
            + size_of_val(&*self.cells)
    }

    /// A band without blocks yet.
    pub(super) fn new(across: usize) -> Self {
        Self { across, ..Self::default() }
    }

    /// Layers of block `block`, as indices of `planes`.
    pub(super) fn layers(&self, block: usize) -> std::ops::Range<usize> {
        let Block { first_plane, num_planes, .. } = self.blocks[block];
        first_plane as usize..first_plane as usize + usize::from(num_planes)
    }

    /// Whether any list of the block has a cell.
    pub(super) fn has_matter(&self, block: usize) -> bool {
        self.blocks[block].ends != NO_ENDS
    }

    /// The cells of a block.
    pub(super) fn cells_of(&self, block: usize) -> CellsOf<'_> {
        let Block { first_cell, ends, .. } = self.blocks[block];
        match self.ends.get(ends as usize) {
            Some(ends) => {
                let first = first_cell as usize;
                let last = first + usize::from(ends[BLOCK_LISTS - 1]);
                CellsOf { cells: &self.cells[first..last], ends }
            }
            None => CellsOf::NONE,
        }
    }

    /// The cells of a block to change, and where those of each list end; `None` if there are none.
    pub(super) fn cells_mut(&mut self, block: usize) -> Option<(&mut [Cell], &[u16; BLOCK_LISTS])> {
        let Block { first_cell, ends, .. } = self.blocks[block];
        let ends = self.ends.get(ends as usize)?;
        let first = first_cell as usize;
        Some((&mut self.cells[first..first + usize::from(ends[BLOCK_LISTS - 1])], ends))
    }

    /// Appends a block that is one of another band.
    pub(super) fn copy(&mut self, other: &Band, block: usize) {
        let first_plane = self.planes.len();
        self.planes.extend_from_slice(&other.planes[other.layers(block)]);
        let CellsOf { cells, ends } = other.cells_of(block);
        let first_cell = self.cells.len();
        self.cells.extend_from_slice(cells);
        self.push_block(first_plane, first_cell, ends);
    }

    /// Appends a block, whose planes are those from `first_plane` on.
    pub(super) fn push(&mut self, first_plane: usize, lists: &Lists) {
        let first_cell = self.cells.len();
        let mut ends = [0; BLOCK_LISTS];
        if lists.num_layers > 0 {
            let total: u32 = lists.present.iter().map(|present| present.count_ones()).sum();
            self.cells.resize(first_cell + total as usize, Cell::default());
            lists.write(&mut self.cells[first_cell..], &mut ends);
        }
        self.push_block(first_plane, first_cell, &ends);
    }

    fn push_block(&mut self, first_plane: usize, first_cell: usize, ends: &[u16; BLOCK_LISTS]) {
        let has_matter = self.cells.len() > first_cell;
        self.blocks.push(Block {
            first_plane: first_plane as u32,
            num_planes: (self.planes.len() - first_plane) as u8,
            first_cell: first_cell as u32,
            ends: if has_matter { self.ends.len() as u32 } else { NO_ENDS },
        });
        if has_matter {
            self.ends.push(*ends);
        }
    }
}

/// The cells of a block, list by list.
#[derive(Clone, Copy, Debug)]
pub(super) struct CellsOf<'a> {
    pub(super) cells: &'a [Cell],
    /// Where those of each list end.
    pub(super) ends: &'a [u16; BLOCK_LISTS],
}

impl<'a> CellsOf<'a> {
    pub(super) const NONE: Self = Self { cells: &[], ends: &[0; BLOCK_LISTS] };

    /// Those of list `i`.
    #[inline(always)]
    pub(super) fn list(&self, i: usize) -> &'a [Cell] {
        let start = if i == 0 { 0 } else { self.ends[i - 1] };
        &self.cells[usize::from(start)..usize::from(self.ends[i])]
    }
}

/// The layers of the block that is being coded.
#[derive(Clone, Debug)]
pub(super) struct Lists {
    layers: Box<[Cells; MAX_LAYERS]>,
    num_layers: usize,
    /// The layers that each list has a cell in.
    present: [u32; BLOCK_LISTS],
    /// Where the last cell of each list ends; 0 for none.
    last: [f32; BLOCK_LISTS],
    /// Transmittance of what is there.
    pub(super) kappa: [f32; BLOCK_LISTS],
}

/// A cell for each list.
#[derive(Clone, Copy, Debug)]
struct Cells {
    front: [u16; BLOCK_LISTS],
    back: [u16; BLOCK_LISTS],
    u: [u16; BLOCK_LISTS],
    ycc: [[i16; BLOCK_LISTS]; 3],
}

impl Default for Lists {
    fn default() -> Self {
        let none = [0; BLOCK_LISTS];
        let cells = Cells { front: none, back: none, u: none, ycc: [[0; BLOCK_LISTS]; 3] };
        Self {
            layers: Box::new([cells; MAX_LAYERS]),
            num_layers: 0,
            present: [0; BLOCK_LISTS],
            last: [0.0; BLOCK_LISTS],
            kappa: [1.0; BLOCK_LISTS],
        }
    }
}

impl Lists {
    pub(super) fn clear(&mut self) {
        self.num_layers = 0;
        self.present = [0; BLOCK_LISTS];
        self.last = [0.0; BLOCK_LISTS];
        self.kappa = [1.0; BLOCK_LISTS];
    }

    /// Writes all cells, list by list, and where those of each list end.
    fn write(&self, out: &mut [Cell], ends: &mut [u16; BLOCK_LISTS]) {
        let mut out = out.iter_mut();
        let mut end = 0;
        for (i, (present, list_end)) in self.present.iter().zip(ends).enumerate() {
            for (layer, out) in lists_of(u64::from(*present)).zip(&mut out) {
                let Cells { front, back, u, ycc } = &self.layers[layer % MAX_LAYERS];
                *out =
                    Cell { front: front[i], back: back[i], u: u[i], ycc: [ycc[0][i], ycc[1][i], ycc[2][i]] };
                end += 1;
            }
            *list_end = end;
        }
    }

    /// Appends a cell to each list of the mask, between the planes as far as they leave room behind the cell before: it
    /// begins where that one ends at the earliest, and is at least [`LEAST_LENGTH`] long.
    pub(super) fn push(
        &mut self,
        planes: &Planes,
        mask: u64,
        u: &[u16; BLOCK_LISTS],
        ycc: &[[i16; BLOCK_LISTS]; 3],
        alphas: &[f32; BLOCK_LISTS],
    ) {
        let Some(cells) = self.layers.get_mut(self.num_layers) else { return };
        (cells.u, cells.ycc) = (*u, *ycc);
        let fits = place(cells, planes, mask, alphas, &mut self.last, &mut self.kappa);
        for (present, fits) in self.present.iter_mut().zip(fits) {
            *present |= u32::from(fits) << self.num_layers;
        }
        self.num_layers += 1;
    }
}

wide! {
    /// Places the cells of a layer behind the `last` of each list. Returns which lists get theirs.
    fn place(
        cells: &mut Cells,
        planes: &Planes,
        mask: u64,
        alphas: &[f32; BLOCK_LISTS],
        last: &mut [f32; BLOCK_LISTS],
        kappa: &mut [f32; BLOCK_LISTS],
    ) -> [bool; BLOCK_LISTS] = place_any;
}

#[inline(always)]
fn place_any(
    cells: &mut Cells,
    planes: &Planes,
    mask: u64,
    alphas: &[f32; BLOCK_LISTS],
    last: &mut [f32; BLOCK_LISTS],
    kappa: &mut [f32; BLOCK_LISTS],
) -> [bool; BLOCK_LISTS] {
    let mut fits = [false; BLOCK_LISTS];
    for i in 0..BLOCK_LISTS {
        let front = whole(lesser(greater(planes.0.at(i), last[i]), MAX_FRONT) + 0.5);
        let after = front as i32 as f32;
        let back = whole(lesser(greater(planes.1.at(i), after + LEAST_LENGTH), MAX_BACK) + 0.5);
        // The cell before may end so deep that none fits behind it.
        fits[i] = (mask >> i & 1 == 1) & (back > front) & (after >= last[i]);
        cells.front[i] = front as u16;
        cells.back[i] = back as u16;
        last[i] = if fits[i] { back as i32 as f32 } else { last[i] };
        kappa[i] *= if fits[i] { 1.0 - alphas[i] } else { 1.0 };
    }
    fits
}

/// As the machine has it: without a thought for NaN.
#[inline(always)]
pub(super) fn greater(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

#[inline(always)]
pub(super) fn lesser(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
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
