//! Corrects the picture at the frame's own pose. The composite of decoded layers has the sum of many small errors.
//! One more plane for each block removes most of it.

use rayon::prelude::*;

use super::super::error::CodecError;
use super::entropy::Coder;
use super::model::{BLOCK_LISTS, TilePlace};
use super::residual::{Expected, residual, stored_of};
use super::scales::{FINE, MAX_ROOT, UNIT, behind, root_of, roots, roots_from_ycc, scales, seen};
use super::smooth::{Border, smooth_roots};
use super::steps::StepSizes;
use super::syntax::{Contexts, NO_CLASS};
use super::tile::{CellPlanes, CellsOf, FrameTile, NO_CELLS};
use super::transform::{BlockNumbers, BlockPlane};

/// Differences of the roots of a picture's red, green and blue.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Corrections {
    /// Index in `planes` for each block of a tile; [`NONE`] for none.
    places: Vec<u32>,
    /// Y, Co, Cg in units of 1/8192.
    planes: Vec<[[i16; BLOCK_LISTS]; 3]>,
}

/// Codes the corrections of a tile. `source` writes those of a block and returns the mask of lists with matter. Only
/// an encoder calls it, block by block.
pub(super) fn code<C: Coder>(
    mut coder: C,
    steps: &StepSizes,
    place: TilePlace,
    mut source: impl FnMut(usize, &mut [BlockPlane; 3]) -> u64,
) -> Result<(C, Corrections), CodecError> {
    let contexts = Contexts::all();
    let mut out = Corrections { places: Vec::new(), planes: Vec::new() };
    let mut classes: Vec<[u8; 3]> = Vec::new();
    let mut wanted = [[0.0; BLOCK_LISTS]; 3];
    for block in 0..place.across * place.num_rows {
        let mask = if C::ENCODES { source(block, &mut wanted) } else { 0 };
        let left = (block % place.across > 0).then(|| block - 1);
        let above = block.checked_sub(place.across);
        let state = |b: Option<usize>| b.map_or(0, |b| 1 + usize::from(out.places[b] != NONE));
        let context = state(left) * 3 + state(above);
        let mut own = [0; 3];
        if coder.bit(contexts.has_correction[context], mask != 0) {
            let mut planes = [[0; BLOCK_LISTS]; 3];
            let mut class_before = NO_CLASS;
            for c in 0..3 {
                let class_of = |b: Option<usize>| b.filter(|&b| out.places[b] != NONE).map(|b| classes[b][c]);
                let beside = match (class_of(left), class_of(above)) {
                    (Some(a), Some(b)) => (a + b) / 2,
                    (Some(a), None) | (None, Some(a)) => a,
                    (None, None) => NO_CLASS,
                };
                let mut values = [0; BLOCK_LISTS];
                let (class, _) = residual(
                    &mut coder,
                    contexts,
                    if c == 0 { 3 } else { 7 },
                    [class_before, beside],
                    steps.of_picture()[c],
                    mask,
                    Some(&wanted[c]),
                    &Expected::Constant(0),
                    &mut values,
                );
                own[c] = class;
                class_before = class;
                stored_of(&values, [-(FINE as i32), FINE as i32], &mut planes[c]);
            }
            out.places.push(out.planes.len() as u32);
            out.planes.push(planes);
        } else {
            out.places.push(NONE);
        }
        classes.push(own);
        if coder.is_overrun() {
            return Err(CodecError::Payload { plane: "corrections", problem: "ends too early".into() });
        }
    }
    Ok((coder, out))
}

wide! {
    /// Writes the roots of red, green and blue that the lists of a block composite to, into `found`. Units of 1/32768.
    pub(super) fn composite_roots(of: CellsOf<'_>, found: &mut [BlockNumbers; 3]) = composite_roots_any;
}

wide! {
    /// The factors that make roots what they should be.
    fn factors_of(wanted: &[BlockNumbers; 3], found: &[BlockNumbers; 3], factors: &mut [BlockNumbers; 3])
        = factors_any;
}

wide! {
    /// Multiplies the roots of the colours of a layer's cells, list by list.
    fn multiply(cells: &mut CellPlanes, factors: &[BlockNumbers; 3]) = multiply_any;
}

#[inline(always)]
fn composite_roots_any(of: CellsOf<'_>, found: &mut [BlockNumbers; 3]) {
    let scales = scales();
    let mut kappa = [UNIT - 1; BLOCK_LISTS];
    *found = [[0; BLOCK_LISTS]; 3];
    let [r, g, b] = &mut *found;
    let mut spread = NO_CELLS;
    let mut walk = of.walk(&mut spread);
    // Colours are sums in units of 2⁻³⁰.
    let visible = |seen: i32, root: i32| {
        let square = root * root;
        seen * (square >> 12) + ((seen * (square & 0xfff)) >> 12)
    };
    while let Some((_, [_, _, u, y, co, cg])) = walk.next() {
        // A list without a cell has α = 0.
        let mut alpha = [0; BLOCK_LISTS];
        for (alpha, code) in alpha.iter_mut().zip(u) {
            *alpha = scales.opacity(*code);
        }
        for i in 0..BLOCK_LISTS {
            let roots = roots([y[i] as i16, co[i] as i16, cg[i] as i16]);
            let seen = seen(kappa[i], alpha[i]);
            r[i] += visible(seen, roots[0]);
            g[i] += visible(seen, roots[1]);
            b[i] += visible(seen, roots[2]);
            kappa[i] = behind(kappa[i], alpha[i]);
        }
    }
    for found in found.as_flattened_mut() {
        *found = root_of(*found).max(LEAST_ROOT);
    }
}

#[inline(always)]
fn factors_any(wanted: &[BlockNumbers; 3], found: &[BlockNumbers; 3], factors: &mut [BlockNumbers; 3]) {
    let pairs = wanted.as_flattened().iter().zip(found.as_flattened());
    for (factor, (wanted, found)) in factors.as_flattened_mut().iter_mut().zip(pairs) {
        // Exact: a quotient of whole numbers below 2³² is farther from the next one than doubles round.
        let by = f64::from((*wanted).max(0)) * f64::from(ONE) / f64::from(*found);
        *factor = (by as i32).clamp(ONE / MAX_FACTOR, ONE * MAX_FACTOR);
    }
}

/// The factor is the same in all cells of a list. Lists without a cell keep their zeros.
#[inline(always)]
fn multiply_any([_, _, _, y, co, cg]: &mut CellPlanes, [of_r, of_g, of_b]: &[BlockNumbers; 3]) {
    // A quarter of 1/8192.
    let changed = |root: i32, by: i32| ((root * by) >> (FACTOR_BITS - 2)).min(4 * MAX_ROOT);
    for i in 0..BLOCK_LISTS {
        let own = [y[i] as i16, co[i] as i16, cg[i] as i16];
        let [r, g, b] = roots(own);
        let (r, g, b) = (changed(r, of_r[i]), changed(g, of_g[i]), changed(b, of_b[i]));
        // A list with factors of 1 stays the same to the bit.
        let is_right = (of_r[i] == ONE) & (of_g[i] == ONE) & (of_b[i] == ONE);
        y[i] = if is_right { own[0] } else { ((r + 2 * g + b + 8) >> 4) as i16 } as u16;
        co[i] = if is_right { own[1] } else { ((r - b + 4) >> 3) as i16 } as u16;
        cg[i] = if is_right { own[2] } else { ((2 * g - r - b + 8) >> 4) as i16 } as u16;
    }
}

/// The picture of a tile's corrected blocks, as roots of red, green and blue.
#[derive(Clone, Debug, Default)]
pub(in crate::codec) struct TilePicture {
    /// The corrected blocks, with their index in the tile.
    blocks: Vec<(usize, Box<CorrectedBlock>)>,
}

#[derive(Clone, Debug)]
#[repr(align(64))]
struct CorrectedBlock {
    /// Mask of the lists with matter.
    mask: u64,
    /// What the lists composite to, and what they should, in units of 1/32768.
    found: [BlockNumbers; 3],
    wanted: [BlockNumbers; 3],
}

impl TilePicture {
    /// What a tile shows, and what it should show.
    pub(super) fn new(tile: &FrameTile, corrections: &Corrections) -> Self {
        let corrected = corrections.places.iter().enumerate().filter_map(|(block, place)| {
            let differences = corrections.planes.get(*place as usize)?;
            Some((block, Box::new(CorrectedBlock::new(tile.cells_of(block), differences))))
        });
        Self { blocks: corrected.collect() }
    }

    /// Number of corrected blocks.
    pub(super) fn num_blocks(&self) -> usize {
        self.blocks.len()
    }
}

/// Multiplies the colours of a frame's cells so that every list composites to what it should. There is a picture for
/// each tile. The frame has so many columns and rows of blocks. `steps` are those of the corrections' Y, Co and Cg, by
/// which borders between corrected blocks are smoothed: first those between blocks side by side.
pub(super) fn correct(
    tiles: &mut [FrameTile],
    pictures: &mut [TilePicture],
    [across, down]: [usize; 2],
    steps: [i32; 3],
) {
    let mut blocks: Vec<Option<Box<CorrectedBlock>>> = Vec::new();
    blocks.resize_with(across * down, || None);
    for (tile, picture) in tiles.iter().zip(pictures) {
        for (block, corrected) in picture.blocks.drain(..) {
            if let Some(place) = blocks.get_mut(index_of(tile, block, across)) {
                *place = Some(corrected);
            }
        }
    }
    blocks.par_chunks_mut(across.max(1)).for_each(|row| {
        for x in 1..row.len() {
            if let [Some(left), Some(right)] = &mut row[x - 1..=x] {
                smooth_between(Border::Beside, left, right, &steps);
            }
        }
    });
    // Every second border between rows, and then the others. No sample is near two of them.
    for first in [0, across] {
        let Some(rows) = blocks.get_mut(first..) else { continue };
        rows.par_chunks_mut((2 * across).max(1)).for_each(|two| {
            let (upper, lower) = two.split_at_mut(across.min(two.len()));
            for pair in upper.iter_mut().zip(lower) {
                if let (Some(above), Some(below)) = pair {
                    smooth_between(Border::Below, above, below, &steps);
                }
            }
        });
    }
    tiles.par_iter_mut().for_each(|tile| {
        for block in 0..tile.blocks.len() {
            if let Some(Some(corrected)) = blocks.get(index_of(tile, block, across)) {
                let mut factors = [[0; BLOCK_LISTS]; 3];
                factors_of(&corrected.wanted, &corrected.found, &mut factors);
                tile.change(block, |cells| multiply(cells, &factors));
            }
        }
    });
}

/// Index in the frame of a block of a tile.
fn index_of(tile: &FrameTile, block: usize, across: usize) -> usize {
    let [x, y] = tile.place.in_frame(block % tile.place.across, block / tile.place.across);
    y * across + x
}

impl CorrectedBlock {
    /// What the cells of a block composite to, and what they should: that plus the differences.
    fn new(cells: CellsOf<'_>, differences: &[[i16; BLOCK_LISTS]; 3]) -> Self {
        let mut found = [[0; BLOCK_LISTS]; 3];
        composite_roots(cells, &mut found);
        let mut wanted = found;
        for i in 0..BLOCK_LISTS {
            let difference = [differences[0][i], differences[1][i], differences[2][i]];
            let difference = roots_from_ycc(difference.map(|d| 4 * i32::from(d)));
            wanted.iter_mut().zip(difference).for_each(|(wanted, difference)| wanted[i] += difference);
        }
        Self { mask: cells.mask(), found, wanted }
    }
}

fn smooth_between(border: Border, first: &mut CorrectedBlock, second: &mut CorrectedBlock, steps: &[i32; 3]) {
    let lines = border.lines(first.mask, second.mask);
    if lines != 0 {
        smooth_roots(border, &mut first.wanted, &mut second.wanted, lines, steps);
    }
}

/// A factor of 1.
const ONE: i32 = 1 << FACTOR_BITS;
const FACTOR_BITS: u32 = 14;
/// A list whose root is off by more than this factor has lost a cell. The others must not make up for it, because
/// they would look wrong from another pose.
const MAX_FACTOR: i32 = 2;
/// Least root of a list: that of a colour of 10⁻⁵.
const LEAST_ROOT: i32 = 104;
const NONE: u32 = u32::MAX;

#[cfg(test)]
mod tests {
    use super::super::model::{BLOCK, DepthPlane};
    use super::super::tile::OpenBlock;
    use super::*;

    const ACROSS: usize = 4;
    const ROWS: usize = 5;
    const STEPS: [i32; 3] = [983, 2621, 2621];

    /// A frame in tiles of so many blocks, with layers that differ from block to block, and its corrections.
    fn corrected(columns: &[usize], rows: &[usize]) -> (Vec<FrameTile>, Vec<TilePicture>) {
        let starts = |sizes: &[usize]| {
            sizes.iter().scan(0, |end, n| Some(std::mem::replace(end, *end + n))).collect::<Vec<_>>()
        };
        let (lefts, tops) = (starts(columns), starts(rows));
        let mut all = (vec![], vec![]);
        for (top, num_rows) in tops.iter().zip(rows) {
            for (left, across) in lefts.iter().zip(columns) {
                let size = [ACROSS * BLOCK, ROWS * BLOCK];
                let place = TilePlace { first: [*left, *top], across: *across, num_rows: *num_rows, size };
                let (tile, corrections) = corrected_tile(place);
                all.1.push(TilePicture::new(&tile, &corrections));
                all.0.push(tile);
            }
        }
        all
    }

    fn corrected_tile(place: TilePlace) -> (FrameTile, Corrections) {
        let (mut tile, mut lists) = (FrameTile::new(place, 0), OpenBlock::default());
        let mut corrections = Corrections { places: vec![], planes: vec![] };
        for i in 0..place.across * place.num_rows {
            let [x, y] = place.in_frame(i % place.across, i / place.across);
            let block = y * ACROSS + x;
            let first_plane = tile.planes.len();
            lists.clear();
            let mask = if block == 6 { 0xffff_fe7f_ffff_ff0f } else { u64::MAX };
            for layer in 0..if block == 9 { 0 } else { 1 + block % 3 } {
                let plane = |z| DepthPlane { z: 16 * (z + 3000 * layer as i32), dx: 160, dy: -112 };
                let planes = (plane(20_000), plane(21_000));
                let u: [u16; BLOCK_LISTS] =
                    std::array::from_fn(|i| (600 + 40 * layer + i + 9 * block) as u16);
                let ycc = [4000, 300, -200].map(|v| std::array::from_fn(|i| v + (3 * i + 11 * block) as i16));
                let opacities = u.map(|code| scales().opacity(code));
                tile.planes.push(planes);
                lists.push(&planes, mask, &u, &ycc, &opacities);
            }
            tile.push(first_plane, &mut lists);
            if [3, 9, 14].contains(&block) {
                corrections.places.push(NONE);
            } else {
                corrections.places.push(corrections.planes.len() as u32);
                let of = |c: usize, i: usize| ((i * 7 + block * 31 + c * 5) % 23) as i16 * 9 - 90;
                corrections.planes.push(std::array::from_fn(|c| std::array::from_fn(|i| of(c, i))));
            }
        }
        (tile, corrections)
    }

    /// Y, Co, Cg of the cells of each block of the frame.
    fn colors(tiles: &[FrameTile], columns: &[usize], rows: &[usize]) -> Vec<Vec<[u16; 3]>> {
        let mut colors = vec![vec![]; ACROSS * ROWS];
        let (mut top, mut tiles) = (0, tiles.iter());
        for num_rows in rows {
            let mut left = 0;
            for across in columns {
                let tile = tiles.next().unwrap();
                for i in 0..across * num_rows {
                    let at = (top + i / across) * ACROSS + left + i % across;
                    let mut spread = NO_CELLS;
                    let mut walk = tile.cells_of(i).walk(&mut spread);
                    while let Some((_, [_, _, _, y, co, cg])) = walk.next() {
                        colors[at].extend((0..BLOCK_LISTS).map(|i| [y[i], co[i], cg[i]]));
                    }
                }
                left += across;
            }
            top += num_rows;
        }
        colors
    }

    /// The colours of all blocks when the frame is cut into tiles.
    fn shown(columns: &[usize], rows: &[usize], steps: [i32; 3]) -> Vec<Vec<[u16; 3]>> {
        let (mut tiles, mut pictures) = corrected(columns, rows);
        correct(&mut tiles, &mut pictures, [ACROSS, ROWS], steps);
        colors(&tiles, columns, rows)
    }

    #[test]
    fn borders_of_tiles_are_smoothed_as_those_within() {
        let whole = shown(&[ACROSS], &[ROWS], STEPS);
        for (columns, rows) in
            [(&[2, 2][..], &[5][..]), (&[4], &[3, 2]), (&[3, 1], &[1, 2, 2]), (&[1; 4], &[1; 5])]
        {
            assert!(shown(columns, rows, STEPS) == whole, "{columns:?} {rows:?}");
        }
        // Steps of nothing move nothing.
        let plain = shown(&[ACROSS], &[ROWS], [0; 3]);
        let moved = |block: usize| whole[block].iter().zip(&plain[block]).filter(|(a, b)| a != b).count();
        assert!((0..ACROSS * ROWS).map(moved).sum::<usize>() > 200);
        // Blocks without corrections stay as they were, also beside those that have some.
        let before = colors(&corrected(&[ACROSS], &[ROWS]).0, &[ACROSS], &[ROWS]);
        assert!([3, 14].iter().all(|&block| whole[block] == before[block]));
        assert!(moved(10) > 0);
    }
}
