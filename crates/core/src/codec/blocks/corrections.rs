//! Corrects the picture at the frame's own pose. The composite of decoded layers has the sum of many small errors.
//! One more plane for each block removes most of it.

use super::super::error::{CodecError, at_most};
use super::super::limits::MAX_CHUNK_SEGMENTS;
use super::band::{Band, CellPlanes, CellsOf, NO_CELLS};
use super::entropy::Coder;
use super::model::{BLOCK_LISTS, BandPlace};
use super::residual::{Expected, fixed_of, residual};
use super::scales::{
    MAX_ROOT, f32_from_fixed, fixed_from_f32, roots, roots_from_ycc, scales, ycc_from_roots,
};
use super::smooth::{Border, smooth_roots};
use super::steps::StepSizes;
use super::syntax::{Contexts, NO_CLASS};
use super::transform::BlockPlane;

/// Differences of the roots of a picture's red, green and blue.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Corrections {
    /// Index in `planes` for each block of a band; [`NONE`] for none.
    places: Vec<u32>,
    /// Y, Co, Cg in units of 1/8192.
    planes: Vec<[[i16; BLOCK_LISTS]; 3]>,
}

/// Codes the corrections of a band. `source` writes those of a block and returns the mask of lists with matter. Only
/// an encoder calls it, block by block.
pub(super) fn code<C: Coder>(
    mut coder: C,
    steps: &StepSizes,
    place: BandPlace,
    mut source: impl FnMut(usize, &mut [BlockPlane; 3]) -> u64,
) -> Result<(C, Corrections), CodecError> {
    let mut contexts = Contexts::new();
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
        if coder.bit(&mut contexts.has_correction[context], mask != 0) {
            let mut planes = [[0; BLOCK_LISTS]; 3];
            let mut class_before = NO_CLASS;
            for c in 0..3 {
                let class_of = |b: Option<usize>| b.filter(|&b| out.places[b] != NONE).map(|b| classes[b][c]);
                let beside = match (class_of(left), class_of(above)) {
                    (Some(a), Some(b)) => (a + b) / 2,
                    (Some(a), None) | (None, Some(a)) => a,
                    (None, None) => NO_CLASS,
                };
                let step = steps.of_picture()[c];
                let mut values = [0.0; BLOCK_LISTS];
                let near = [class_before, beside];
                let component = if c == 0 { 3 } else { 7 };
                let (class, _) = residual(
                    &mut coder,
                    &mut contexts,
                    component,
                    near,
                    step,
                    mask,
                    Some(&wanted[c]),
                    &Expected::Constant(0.0),
                    &mut values,
                );
                own[c] = class;
                class_before = class;
                fixed_of(&values, [-1.0, 1.0], &mut planes[c]);
            }
            out.places.push(out.planes.len() as u32);
            out.planes.push(planes);
        } else {
            out.places.push(NONE);
        }
        classes.push(own);
        at_most("corrected blocks in a chunk", out.planes.len(), MAX_CHUNK_SEGMENTS / BLOCK_LISTS)?;
        if coder.is_overrun() {
            return Err(CodecError::Payload { plane: "corrections", problem: "ends too early".into() });
        }
    }
    Ok((coder, out))
}

wide! {
    /// Writes the roots of red, green and blue that the lists of a block composite to, into `found`.
    pub(super) fn composite_roots(of: CellsOf<'_>, found: &mut [BlockPlane; 3]) = composite_roots_any;
}

wide! {
    /// Multiplies the roots of the colours of a layer's cells, list by list.
    fn multiply(cells: &mut CellPlanes, factors: &[BlockPlane; 3]) = multiply_any;
}

#[inline(always)]
fn composite_roots_any(of: CellsOf<'_>, found: &mut [BlockPlane; 3]) {
    let scales = scales();
    let mut kappa = [1.0; BLOCK_LISTS];
    *found = [[0.0; BLOCK_LISTS]; 3];
    let [r, g, b] = &mut *found;
    let mut spread = NO_CELLS;
    let mut walk = of.walk(&mut spread);
    while let Some((_, [_, _, u, y, co, cg])) = walk.next() {
        // A list without a cell has α = 0.
        let mut alpha = [0.0; BLOCK_LISTS];
        for (alpha, code) in alpha.iter_mut().zip(u) {
            *alpha = scales.alpha[usize::from(*code)];
        }
        for i in 0..BLOCK_LISTS {
            let roots = roots([y[i] as i16, co[i] as i16, cg[i] as i16]);
            let seen = kappa[i] * alpha[i];
            r[i] += seen * roots[0] * roots[0];
            g[i] += seen * roots[1] * roots[1];
            b[i] += seen * roots[2] * roots[2];
            kappa[i] *= 1.0 - alpha[i];
        }
    }
    for found in found.as_flattened_mut() {
        *found = found.max(LEAST).sqrt();
    }
}

/// The factor is the same in all cells of a list. Lists without a cell keep their zeros.
#[inline(always)]
fn multiply_any([_, _, _, y, co, cg]: &mut CellPlanes, [of_r, of_g, of_b]: &[BlockPlane; 3]) {
    for i in 0..BLOCK_LISTS {
        let own = [y[i] as i16, co[i] as i16, cg[i] as i16];
        let [r, g, b] = roots(own);
        let changed = [(r * of_r[i]).min(MAX_ROOT), (g * of_g[i]).min(MAX_ROOT), (b * of_b[i]).min(MAX_ROOT)];
        let changed = ycc_from_roots(changed).map(fixed_from_f32);
        // A list with factors of 1 stays the same to the bit.
        let is_right = (of_r[i] == 1.0) & (of_g[i] == 1.0) & (of_b[i] == 1.0);
        y[i] = if is_right { own[0] } else { changed[0] } as u16;
        co[i] = if is_right { own[1] } else { changed[1] } as u16;
        cg[i] = if is_right { own[2] } else { changed[2] } as u16;
    }
}

/// The picture of a row of blocks, as roots of red, green and blue.
struct PictureRow {
    blocks: Vec<CorrectedBlock>,
}

#[derive(Clone)]
#[repr(align(64))]
struct CorrectedBlock {
    /// Mask of the lists with matter; 0 for a block without corrections.
    mask: u64,
    /// What the lists composite to, and what they should.
    found: [BlockPlane; 3],
    wanted: [BlockPlane; 3],
}

impl PictureRow {
    fn new(across: usize) -> Self {
        const NOTHING: BlockPlane = [0.0; BLOCK_LISTS];
        Self { blocks: vec![CorrectedBlock { mask: 0, found: [NOTHING; 3], wanted: [NOTHING; 3] }; across] }
    }

    /// Smooths the borders within this row, then those to the row above.
    fn smooth_below(&mut self, above: &mut Self, steps: &[f32; 3]) {
        for x in 1..self.blocks.len() {
            if let [first, second] = &mut self.blocks[x - 1..=x] {
                smooth_between(Border::Beside, first, second, steps);
            }
        }
        for (first, second) in above.blocks.iter_mut().zip(&mut self.blocks) {
            smooth_between(Border::Below, first, second, steps);
        }
    }

    /// Multiplies the colours of a row's lists so that they composite to what they should.
    fn apply(&self, band: &mut Band, first_block: usize) {
        for (x, CorrectedBlock { mask, found, wanted }) in self.blocks.iter().enumerate() {
            if *mask == 0 {
                continue;
            }
            let mut factors = *wanted;
            for (factor, found) in factors.as_flattened_mut().iter_mut().zip(found.as_flattened()) {
                *factor = (*factor / *found).clamp(1.0 / MAX_FACTOR, MAX_FACTOR);
            }
            band.change(first_block + x, |cells| multiply(cells, &factors));
        }
    }
}

impl Corrections {
    /// Multiplies the colours of a band's cells so that every list composites to what it should. `steps` are those of
    /// the corrections' Y, Co and Cg, by which borders between corrected blocks are smoothed.
    pub(super) fn apply(&self, band: &mut Band, steps: [f32; 3]) {
        if self.planes.is_empty() {
            return;
        }
        let across = band.across.max(1);
        let [mut above, mut own] = [(); 2].map(|()| PictureRow::new(across));
        for (y, places) in self.places.chunks(across).enumerate() {
            for (x, (&place, shown)) in places.iter().zip(&mut own.blocks).enumerate() {
                match self.planes.get(place as usize) {
                    Some(differences) => {
                        shown.set(band.cells_of(y * across + x), differences);
                    }
                    None => shown.mask = 0,
                }
            }
            own.smooth_below(&mut above, &steps);
            // Nothing changes the row above any more.
            if y > 0 {
                above.apply(band, (y - 1) * across);
            }
            std::mem::swap(&mut above, &mut own);
        }
        let num_rows = self.places.len().div_ceil(across);
        above.apply(band, num_rows.saturating_sub(1) * across);
    }
}

impl CorrectedBlock {
    /// Sets what the cells of a block composite to, and what they should: that plus the differences.
    fn set(&mut self, cells: CellsOf<'_>, differences: &[[i16; BLOCK_LISTS]; 3]) {
        composite_roots(cells, &mut self.found);
        self.mask = cells.mask();
        for i in 0..BLOCK_LISTS {
            let difference = [differences[0][i], differences[1][i], differences[2][i]];
            let difference = roots_from_ycc(difference.map(f32_from_fixed));
            for ((wanted, found), difference) in self.wanted.iter_mut().zip(&self.found).zip(difference) {
                wanted[i] = found[i] + difference;
            }
        }
    }
}

fn smooth_between(border: Border, first: &mut CorrectedBlock, second: &mut CorrectedBlock, steps: &[f32; 3]) {
    let lines = border.lines(first.mask, second.mask);
    if lines != 0 {
        smooth_roots(border, &mut first.wanted, &mut second.wanted, lines, steps);
    }
}

/// A list whose root is off by more than this factor has lost a cell. The others must not make up for it, because
/// they would look wrong from another pose.
const MAX_FACTOR: f32 = 2.0;
/// Least colour of a list before its root is taken.
const LEAST: f32 = 1e-5;
const NONE: u32 = u32::MAX;

#[cfg(test)]
mod tests {
    use super::super::band::OpenBlock;
    use super::super::model::{BLOCK, DepthPlane};
    use super::*;

    const ACROSS: usize = 4;
    const ROWS: usize = 5;
    const PLACE: BandPlace =
        BandPlace { across: ACROSS, first_row: 0, num_rows: ROWS, size: [ACROSS * BLOCK, ROWS * BLOCK] };

    /// A band of smooth layers, with blocks that have no matter and lists that have none, and corrections for most of it.
    fn corrected() -> (Band, Corrections) {
        let (mut band, mut lists) = (Band::new(PLACE, 0), OpenBlock::default());
        let mut corrections = Corrections { places: vec![], planes: vec![] };
        for block in 0..ACROSS * ROWS {
            let first_plane = band.planes.len();
            lists.clear();
            let mask = if block == 6 { 0xffff_fe7f_ffff_ff0f } else { u64::MAX };
            for layer in 0..if block == 9 { 0 } else { 1 + block % 3 } {
                let plane = |z: f32| DepthPlane { z: z + 3000.0 * layer as f32, dx: 10.0, dy: -7.0 };
                let planes = (plane(20000.0), plane(21000.0));
                let u: [u16; BLOCK_LISTS] =
                    std::array::from_fn(|i| (600 + 40 * layer + i + 9 * block) as u16);
                let ycc = [4000, 300, -200].map(|v| std::array::from_fn(|i| v + (3 * i + 11 * block) as i16));
                let alphas = u.map(|code| scales().alpha[usize::from(code)]);
                band.planes.push(planes);
                lists.push(&planes, mask, &u, &ycc, &alphas);
            }
            band.push(first_plane, &mut lists);
            if [3, 9, 14].contains(&block) {
                corrections.places.push(NONE);
            } else {
                corrections.places.push(corrections.planes.len() as u32);
                let of = |c: usize, i: usize| ((i * 7 + block * 31 + c * 5) % 23) as i16 * 9 - 90;
                corrections.planes.push(std::array::from_fn(|c| std::array::from_fn(|i| of(c, i))));
            }
        }
        (band, corrections)
    }

    /// Y, Co, Cg of the cells of a block.
    fn colors(band: &Band, block: usize) -> Vec<[u16; 3]> {
        let mut colors = vec![];
        let mut spread = NO_CELLS;
        let mut walk = band.cells_of(block).walk(&mut spread);
        while let Some((_, [_, _, _, y, co, cg])) = walk.next() {
            colors.extend((0..BLOCK_LISTS).map(|i| [y[i], co[i], cg[i]]));
        }
        colors
    }

    /// All of the picture at once: first the borders between blocks beside each other, then those to blocks below.
    fn at_once(band: &mut Band, corrections: &Corrections, steps: &[f32; 3]) {
        let mut shown = PictureRow::new(ACROSS * ROWS);
        for (block, &place) in corrections.places.iter().enumerate() {
            if let Some(differences) = corrections.planes.get(place as usize) {
                shown.blocks[block].set(band.cells_of(block), differences);
            }
        }
        for (border, back) in [(Border::Beside, 1), (Border::Below, ACROSS)] {
            for block in back..ACROSS * ROWS {
                if border == Border::Below || !block.is_multiple_of(ACROSS) {
                    let [first, second] = shown.blocks.get_disjoint_mut([block - back, block]).unwrap();
                    smooth_between(border, first, second, steps);
                }
            }
        }
        shown.apply(band, 0);
    }

    #[test]
    fn rows_are_smoothed_as_all_of_a_band_at_once_is() {
        let steps = [0.03, 0.08, 0.08];
        let (mut by_rows, corrections) = corrected();
        let [mut all, mut plain] = [(); 2].map(|()| by_rows.clone());
        let before = by_rows.clone();
        corrections.apply(&mut by_rows, steps);
        at_once(&mut all, &corrections, &steps);
        assert!(by_rows == all);
        // Steps of nothing move nothing.
        corrections.apply(&mut plain, [0.0; 3]);
        let moved = |block: usize| {
            let [smoothed, plain] = [&by_rows, &plain].map(|band| colors(band, block));
            smoothed.iter().zip(&plain).filter(|(a, b)| a != b).count()
        };
        assert!((0..ACROSS * ROWS).map(moved).sum::<usize>() > 200);
        // Blocks without corrections stay as they were, also beside those that have some.
        assert!([3, 14].iter().all(|&block| colors(&by_rows, block) == colors(&before, block)));
        assert!(moved(10) > 0);
    }
}
