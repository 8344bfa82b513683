//! The decoded blocks of a tile. The client shows them, and later frames are predicted from them.

use super::model::{
    BLOCK, BLOCK_LISTS, DepthPlane, MAX_LAYERS, SIXTEENTHS, TilePlace, lists_of, quarters_from_middle,
};
use super::scales::{UNIT, behind};

/// Front and back of a layer.
pub(super) type Planes = (DepthPlane, DepthPlane);

/// Blocks side by side.
#[derive(Clone, Debug, Default, PartialEq)]
pub(in crate::codec) struct FrameTile {
    pub(super) place: TilePlace,
    /// All blocks, row by row.
    pub(super) blocks: Vec<Block>,
    /// Depth planes of the blocks' layers.
    pub(super) planes: Vec<Planes>,
    /// The layers that have cells, block by block and front to back.
    layers: Vec<CellLayer>,
    /// For each of these layers, its rows of lists that have cells: the fronts of all lists, then backs, codes of u,
    /// Y, Co and Cg. Lists without a cell have zeros.
    cells: Vec<u16>,
    num_cells: usize,
    num_with_matter: usize,
}

/// A block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Block {
    first_plane: u32,
    num_planes: u8,
    /// Number of its layers with cells.
    num_layers: u8,
    first_layer: u32,
}

/// A layer of a block that has cells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct CellLayer {
    /// The lists with a cell.
    pub(super) mask: u64,
    /// The least front and the greatest back of its cells.
    pub(super) front: u16,
    pub(super) back: u16,
    /// Index in the tile's `cells`, in rows.
    first_row: u32,
}

/// The decoded cells of a layer. A cell is the part of a list in a layer: front and back in depth units, the code of
/// u from 1 on, and Y, Co, Cg, signed, in units of 1/8192. A list without a cell has zeros.
pub(super) type CellPlanes = [[u16; BLOCK_LISTS]; NUM_PLANES];

impl FrameTile {
    /// Size in bytes by the count that sender and receiver share.
    pub(super) fn num_bytes(&self) -> usize {
        BYTES_OF_BLOCK * self.blocks.len()
            + BYTES_OF_LAYER * self.planes.len()
            + BYTES_OF_MATTER * self.num_with_matter
            + BYTES_OF_CELL * self.num_cells
    }

    /// A tile without blocks, with memory for those of `place` and for about `num_cells` cells.
    pub(super) fn new(place: TilePlace, num_cells: usize) -> Self {
        let num_blocks = place.across * place.num_rows;
        Self {
            place,
            blocks: Vec::with_capacity(num_blocks),
            planes: Vec::with_capacity(num_cells / BLOCK_LISTS),
            layers: Vec::with_capacity(num_cells / BLOCK_LISTS),
            // Some lists of a row have no cell.
            cells: Vec::with_capacity(num_cells / 6 * WORDS_OF_ROW),
            ..Self::default()
        }
    }

    /// The layers of a block, as indices of `planes`.
    pub(super) fn layers(&self, block: usize) -> std::ops::Range<usize> {
        let Block { first_plane, num_planes, .. } = self.blocks[block];
        first_plane as usize..first_plane as usize + usize::from(num_planes)
    }

    /// Whether any list of the block has a cell.
    pub(super) fn has_matter(&self, block: usize) -> bool {
        self.blocks[block].num_layers > 0
    }

    /// Number of cells in all blocks.
    pub(super) fn num_cells(&self) -> usize {
        self.num_cells
    }

    /// Number of rows with cells in all layers.
    pub(super) fn num_rows(&self) -> usize {
        self.cells.len() / WORDS_OF_ROW
    }

    /// The layers of a block that have cells.
    fn filled(&self, block: usize) -> std::ops::Range<usize> {
        let Block { first_layer, num_layers, .. } = self.blocks[block];
        first_layer as usize..first_layer as usize + usize::from(num_layers)
    }

    /// The cells of a block.
    pub(super) fn cells_of(&self, block: usize) -> CellsOf<'_> {
        CellsOf { layers: &self.layers[self.filled(block)], cells: &self.cells }
    }

    /// Changes the cells of a block, layer by layer. Lists without a cell keep their zeros.
    pub(super) fn change(&mut self, block: usize, mut change: impl FnMut(&mut CellPlanes)) {
        for layer in &self.layers[self.filled(block)] {
            let own = &mut self.cells[layer.words()];
            match own.as_chunks_mut().0.first_chunk_mut() {
                Some(all) => change(all),
                None => {
                    let mut cells = layer.spread(own);
                    change(&mut cells);
                    layer.write(&cells, own);
                }
            }
        }
    }

    /// Appends a copy of a block of another tile.
    pub(super) fn copy(&mut self, other: &FrameTile, block: usize) {
        let (first_plane, first_layer) = (self.planes.len(), self.layers.len());
        self.planes.extend_from_slice(&other.planes[other.layers(block)]);
        for layer in &other.layers[other.filled(block)] {
            self.layers.push(CellLayer { first_row: self.num_rows() as u32, ..*layer });
            self.cells.extend_from_slice(&other.cells[layer.words()]);
        }
        self.push_block(first_plane, first_layer);
    }

    /// Appends a block with the planes from `first_plane` on.
    pub(super) fn push(&mut self, first_plane: usize, lists: &mut OpenBlock) {
        let first_layer = self.layers.len();
        for (mask, cells) in &mut lists.layers[..lists.num_layers] {
            if *mask == 0 {
                continue;
            }
            let (front, back) = clean(cells, *mask);
            let layer = CellLayer { mask: *mask, front, back, first_row: self.num_rows() as u32 };
            let words = layer.words();
            self.cells.resize(words.end, 0);
            layer.write(cells, &mut self.cells[words]);
            self.layers.push(layer);
        }
        self.push_block(first_plane, first_layer);
    }

    fn push_block(&mut self, first_plane: usize, first_layer: usize) {
        let layers = &self.layers[first_layer..];
        self.num_cells += layers.iter().map(|layer| layer.mask.count_ones() as usize).sum::<usize>();
        self.num_with_matter += usize::from(!layers.is_empty());
        self.blocks.push(Block {
            first_plane: first_plane as u32,
            num_planes: (self.planes.len() - first_plane) as u8,
            num_layers: layers.len() as u8,
            first_layer: first_layer as u32,
        });
    }
}

wide! {
    /// Sets lists outside of the mask to zero. Returns the least front and the greatest back.
    fn clean(cells: &mut CellPlanes, mask: u64) -> (u16, u16) = clean_any;
}

#[inline(always)]
fn clean_any(cells: &mut CellPlanes, mask: u64) -> (u16, u16) {
    let mut kept = [0u16; BLOCK_LISTS];
    for (i, kept) in kept.iter_mut().enumerate() {
        *kept = if mask >> i & 1 == 1 { u16::MAX } else { 0 };
    }
    let mut first = u16::MAX;
    for (front, kept) in cells[0].iter().zip(kept) {
        first = first.min(front | !kept);
    }
    for plane in &mut *cells {
        for (value, kept) in plane.iter_mut().zip(kept) {
            *value &= kept;
        }
    }
    (first, cells[1].iter().fold(0, |last, back| last.max(*back)))
}

impl CellLayer {
    /// A mask with the first bit of each row of lists that has a cell.
    #[inline(always)]
    fn rows(&self) -> u64 {
        let halves = self.mask | self.mask >> 4;
        let quarters = halves | halves >> 2;
        (quarters | quarters >> 1) & FIRST_OF_ROWS
    }

    /// The range of its words in the tile's `cells`.
    #[inline(always)]
    fn words(&self) -> std::ops::Range<usize> {
        let first = self.first_row as usize;
        first * WORDS_OF_ROW..(first + self.rows().count_ones() as usize) * WORDS_OF_ROW
    }

    /// Spreads the layer's words to cells of all lists.
    #[inline(always)]
    fn spread(&self, own: &[u16]) -> CellPlanes {
        let mut cells = NO_CELLS;
        for (plane, own) in cells.iter_mut().zip(own.chunks_exact(own.len() / NUM_PLANES)) {
            for (first, row) in lists_of(self.rows()).zip(own.chunks_exact(BLOCK)) {
                plane[first..first + BLOCK].copy_from_slice(row);
            }
        }
        cells
    }

    /// Inverse of [`CellLayer::spread`].
    #[inline(always)]
    fn write(&self, cells: &CellPlanes, own: &mut [u16]) {
        match own.as_chunks_mut().0.first_chunk_mut() {
            Some(all) => *all = *cells,
            None => {
                let num_words = own.len() / NUM_PLANES;
                for (plane, own) in cells.iter().zip(own.chunks_exact_mut(num_words)) {
                    for (first, row) in lists_of(self.rows()).zip(own.chunks_exact_mut(BLOCK)) {
                        row.copy_from_slice(&plane[first..first + BLOCK]);
                    }
                }
            }
        }
    }
}

/// The cells of a block, layer by layer.
#[derive(Clone, Copy, Debug)]
pub(super) struct CellsOf<'a> {
    pub(super) layers: &'a [CellLayer],
    /// Words of the whole tile.
    cells: &'a [u16],
}

impl<'a> CellsOf<'a> {
    /// Mask of the lists that have cells.
    pub(super) fn mask(&self) -> u64 {
        self.layers.iter().fold(0, |mask, layer| mask | layer.mask)
    }

    /// Starts a walk over the layers. `spread` is scratch memory.
    #[inline(always)]
    pub(super) fn walk(self, spread: &'a mut CellPlanes) -> LayerWalk<'a> {
        LayerWalk { layers: self.layers.iter(), cells: self.cells, spread }
    }
}

/// A walk over the layers of a block.
pub(super) struct LayerWalk<'a> {
    layers: std::slice::Iter<'a, CellLayer>,
    cells: &'a [u16],
    /// Memory for the cells of a layer that lacks some rows.
    spread: &'a mut CellPlanes,
}

impl LayerWalk<'_> {
    /// The next layer.
    #[inline(always)]
    pub(super) fn next(&mut self) -> Option<(&CellLayer, &CellPlanes)> {
        self.next_of(|_| true)
    }

    /// The next layer for which `wants` holds.
    #[inline(always)]
    pub(super) fn next_of(
        &mut self,
        is_wanted: impl Fn(&CellLayer) -> bool,
    ) -> Option<(&CellLayer, &CellPlanes)> {
        let layer = self.layers.by_ref().find(|layer| is_wanted(layer))?;
        let own = &self.cells[layer.words()];
        let cells = own.as_chunks().0.first_chunk().unwrap_or_else(|| {
            *self.spread = layer.spread(own);
            self.spread
        });
        Some((layer, cells))
    }
}

/// The layers of the block in progress.
#[derive(Clone, Debug)]
#[repr(align(64))]
pub(super) struct OpenBlock {
    /// Cells with the mask of their lists. Values of other lists mean nothing.
    layers: Box<[(u64, CellPlanes); MAX_LAYERS]>,
    num_layers: usize,
    /// Back of the last cell of each list; 0 for none.
    last: [i32; BLOCK_LISTS],
    /// Transmittance of each list so far, in units of [`UNIT`].
    pub(super) kappa: [i32; BLOCK_LISTS],
}

impl Default for OpenBlock {
    fn default() -> Self {
        Self {
            layers: Box::new([(0, NO_CELLS); MAX_LAYERS]),
            num_layers: 0,
            last: [0; BLOCK_LISTS],
            kappa: [UNIT - 1; BLOCK_LISTS],
        }
    }
}

impl OpenBlock {
    pub(super) fn clear(&mut self) {
        self.num_layers = 0;
        self.last = [0; BLOCK_LISTS];
        self.kappa = [UNIT - 1; BLOCK_LISTS];
    }

    /// Appends a cell to each list of the mask, between the planes. `opacities` are in units of [`UNIT`]. A cell begins
    /// no earlier than the previous cell ends, and is at least [`LEAST_LENGTH`] long. A list without room gets none.
    pub(super) fn push(
        &mut self,
        planes: &Planes,
        mask: u64,
        u: &[u16; BLOCK_LISTS],
        ycc: &[[i16; BLOCK_LISTS]; 3],
        opacities: &[i32; BLOCK_LISTS],
    ) {
        let Some((cells_mask, cells)) = self.layers.get_mut(self.num_layers) else { return };
        let [_, _, of_u, of_ycc @ ..] = cells;
        *of_u = *u;
        for (to, from) in of_ycc.iter_mut().zip(ycc) {
            for (to, from) in to.iter_mut().zip(from) {
                *to = *from as u16;
            }
        }
        *cells_mask = place(cells, planes, mask, opacities, &mut self.last, &mut self.kappa);
        self.num_layers += 1;
    }
}

wide! {
    /// Places the cells of a layer behind the `last` back of each list. Returns the mask of lists that get one.
    fn place(
        cells: &mut CellPlanes,
        planes: &Planes,
        mask: u64,
        opacities: &[i32; BLOCK_LISTS],
        last: &mut [i32; BLOCK_LISTS],
        kappa: &mut [i32; BLOCK_LISTS],
    ) -> u64 = place_any;
}

#[inline(always)]
fn place_any(
    cells: &mut CellPlanes,
    planes: &Planes,
    mask: u64,
    opacities: &[i32; BLOCK_LISTS],
    last: &mut [i32; BLOCK_LISTS],
    kappa: &mut [i32; BLOCK_LISTS],
) -> u64 {
    let mut fits = [false; BLOCK_LISTS];
    let units = |depth: i32, most: i32| {
        (depth.min(most * SIXTEENTHS) + SIXTEENTHS / 2) >> SIXTEENTHS.trailing_zeros()
    };
    for i in 0..BLOCK_LISTS {
        let at = [quarters_from_middle(i % BLOCK), quarters_from_middle(i / BLOCK)];
        let front = units(planes.0.at(at).max(last[i] * SIXTEENTHS), MAX_FRONT);
        let back = units(planes.1.at(at).max((front + LEAST_LENGTH) * SIXTEENTHS), MAX_BACK);
        // The previous cell may end so deep that none fits behind it.
        fits[i] = (mask >> i & 1 == 1) & (back > front) & (front >= last[i]);
        cells[0][i] = front as u16;
        cells[1][i] = back as u16;
        last[i] = if fits[i] { back } else { last[i] };
        kappa[i] = behind(kappa[i], if fits[i] { opacities[i] } else { 0 });
    }
    fits.iter().enumerate().fold(0, |mask, (i, fits)| mask | u64::from(*fits) << i)
}

/// Mask of the first list of each row of a block.
const FIRST_OF_ROWS: u64 = u64::from_ne_bytes([1; 8]);
/// Number of words of a cell, and of a row of cells.
const NUM_PLANES: usize = 6;
pub(super) const NO_CELLS: CellPlanes = [[0; BLOCK_LISTS]; NUM_PLANES];
const WORDS_OF_ROW: usize = NUM_PLANES * BLOCK;
/// Sizes by which sender and receiver count the parts of a tile, bytes.
const BYTES_OF_BLOCK: usize = 16;
const BYTES_OF_LAYER: usize = 24;
const BYTES_OF_MATTER: usize = 128;
const BYTES_OF_CELL: usize = 12;
/// Least length of a cell, depth units.
const LEAST_LENGTH: i32 = 16;
const MAX_FRONT: i32 = 65500;
const MAX_BACK: i32 = 65535;

#[cfg(test)]
impl FrameTile {
    /// An empty tile that is counted as so many bytes, or a few less.
    pub(super) fn counted_as(num_bytes: usize) -> Self {
        Self { num_cells: num_bytes / BYTES_OF_CELL, ..Self::default() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PLACE: TilePlace = TilePlace { first: [0; 2], across: 2, num_rows: 2, size: [16, 16] };
    const PLANES: Planes =
        (DepthPlane { z: 48_000, dx: 80, dy: -64 }, DepthPlane { z: 80_000, dx: 80, dy: 112 });
    /// All lists, none, one, a row, two in rows that do not touch.
    const MASKS: [u64; 5] = [u64::MAX, 0, 1 << 29, 0xff00, 1 << 63 | 2];

    /// A tile of a block for each mask and one with all of them, and what these blocks have: the masks that are not empty.
    fn tile() -> (FrameTile, Vec<Vec<u64>>) {
        let (mut tile, mut lists) = (FrameTile::new(PLACE, 100), OpenBlock::default());
        let alone = MASKS.iter().map(|mask| vec![*mask]);
        let blocks: Vec<Vec<u64>> = alone.chain([MASKS.to_vec()]).collect();
        for masks in &blocks {
            let first_plane = tile.planes.len();
            lists.clear();
            for (n, &mask) in masks.iter().enumerate() {
                tile.planes.push(moved(n));
                let value = |i: usize| 1 + (100 * n + i) as u16;
                let ycc = [0, 1, 2].map(|c| std::array::from_fn(|i| -(value(i) as i16) * (c + 1)));
                lists.push(&moved(n), mask, &std::array::from_fn(value), &ycc, &[UNIT / 2; BLOCK_LISTS]);
            }
            tile.push(first_plane, &mut lists);
        }
        (tile, blocks)
    }

    fn moved(n: usize) -> Planes {
        let deeper = |plane: DepthPlane| DepthPlane { z: plane.z + 64_000 * n as i32, ..plane };
        (deeper(PLANES.0), deeper(PLANES.1))
    }

    fn found(tile: &FrameTile, block: usize) -> Vec<(u64, CellPlanes)> {
        let (mut spread, mut found) = (NO_CELLS, vec![]);
        let mut walk = tile.cells_of(block).walk(&mut spread);
        while let Some((layer, cells)) = walk.next() {
            assert_eq!(
                cells[0].iter().zip(cells[1]).filter(|(_, back)| *back > 0).map(|(f, _)| *f).min(),
                Some(layer.front)
            );
            assert_eq!(cells[1].iter().max(), Some(&layer.back));
            found.push((layer.mask, *cells));
        }
        found
    }

    #[test]
    fn cells_are_where_they_were_put_and_nowhere_else() {
        let (tile, blocks) = tile();
        let filled = |masks: &[u64]| {
            masks.iter().copied().enumerate().filter(|(_, mask)| *mask != 0).collect::<Vec<_>>()
        };
        for (block, masks) in blocks.iter().enumerate() {
            let (found, filled) = (found(&tile, block), filled(masks));
            assert_eq!(tile.has_matter(block), !filled.is_empty());
            assert_eq!(tile.cells_of(block).mask(), masks.iter().fold(0, |all, mask| all | mask));
            assert_eq!(found.len(), filled.len());
            for ((found_mask, cells), (n, mask)) in found.into_iter().zip(filled) {
                assert_eq!(found_mask, mask);
                let n = if masks.len() > 1 { n } else { 0 };
                let [front, back, u, y, co, cg] = cells;
                for i in 0..BLOCK_LISTS {
                    let there = mask >> i & 1 == 1;
                    let value = if there { 1 + (100 * n + i) as u16 } else { 0 };
                    assert_eq!(
                        (u[i], y[i] as i16, co[i] as i16, cg[i] as i16),
                        (value, -(value as i16), -2 * value as i16, -3 * value as i16)
                    );
                    let at = |plane: DepthPlane| if there { (plane.fit().at(i) + 0.5) as u16 } else { 0 };
                    assert_eq!([front[i], back[i]], [at(moved(n).0), at(moved(n).1)]);
                }
            }
        }
        let num: u32 = blocks.iter().flatten().map(|mask| mask.count_ones()).sum();
        assert_eq!(tile.num_cells(), num as usize);
        // A row of eight each for one list and for a row, two for lists far apart.
        assert_eq!(tile.num_rows(), 2 * (8 + 1 + 1 + 2));
        assert_eq!(tile.num_bytes(), 16 * 6 + 24 * 10 + 128 * 5 + 12 * num as usize);
    }

    #[test]
    fn blocks_are_copied_to_other_places_and_changed_alone() {
        let (tile, blocks) = tile();
        let mut other = FrameTile::new(PLACE, 0);
        for block in [5, 2, 1, 5, 0] {
            other.copy(&tile, block);
        }
        for (copied, block) in [5, 2, 1, 5, 0].into_iter().enumerate() {
            assert_eq!(found(&other, copied), found(&tile, block));
            assert_eq!(other.planes[other.layers(copied)], tile.planes[tile.layers(block)]);
        }
        let before = other.clone();
        other.change(3, |[.., y, _, _]| y.iter_mut().for_each(|y| *y = y.wrapping_mul(2)));
        for copied in 0..5 {
            let [now, before] = [&other, &before].map(|tile| found(tile, copied));
            assert_eq!(now == before, copied != 3);
            for ((_, now), (_, before)) in now.iter().zip(&before) {
                let times = if copied == 3 { 2 } else { 1 };
                assert!(now[3].iter().zip(before[3]).all(|(now, before)| *now == before.wrapping_mul(times)));
                assert_eq!(
                    (now[..3].to_vec(), now[4..].to_vec()),
                    (before[..3].to_vec(), before[4..].to_vec())
                );
            }
        }
        assert_eq!(blocks.len(), 6);
    }
}
