//! The correction of the picture at the frame's own pose: what the decoded layers composite to is off by the sum of
//! many small errors, and one more plane a block takes most of it back.

use super::super::{CodecError, MAX_CHUNK_SEGMENTS, at_most};
use super::band::{Band, Cell};
use super::coding::{Place, residual};
use super::entropy::Coder;
use super::model::BLOCK_LISTS;
use super::scales::{f32_from_fixed, fixed_from_f32, roots_from_ycc, scales, ycc_from_roots};
use super::steps::Steps;
use super::syntax::{Contexts, NO_CLASS};
use super::transform::Plane;

/// Differences of the roots of a picture's red, green and blue.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Corrections {
    /// Place in `planes` for each block of a band; [`NONE`] for none.
    places: Vec<u32>,
    /// Y, Co, Cg in units of 1/8192.
    planes: Vec<[[i16; BLOCK_LISTS]; 3]>,
}

/// Codes the corrections of a band. `source` gives those of a block and which lists have matter; it is asked in the
/// order of blocks, and by an encoder only.
pub(super) fn code<C: Coder>(
    mut coder: C,
    steps: &Steps,
    place: Place,
    mut source: impl FnMut(usize, &mut [Plane; 3]) -> u64,
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
                let step = if c == 0 { steps.picture } else { steps.picture * steps.chroma };
                let mut values = [0.0; BLOCK_LISTS];
                let near = [class_before, beside];
                let component = if c == 0 { 3 } else { 7 };
                let expected = [0.0; BLOCK_LISTS];
                let (class, _) = residual(
                    &mut coder,
                    &mut contexts,
                    component,
                    near,
                    step,
                    mask,
                    Some(&wanted[c]),
                    &expected,
                    &mut values,
                );
                own[c] = class;
                class_before = class;
                planes[c] = values.map(|v| fixed_from_f32(v.clamp(-1.0, 1.0)));
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

/// The roots of red, green and blue that the lists of a cell composite to.
pub(super) fn composite_roots(cells: &[Cell]) -> [f32; 3] {
    let mut sum = [0.0; 3];
    let mut kappa = 1.0;
    for cell in cells {
        let alpha = scales().alpha[usize::from(cell.u)];
        for (sum, root) in sum.iter_mut().zip(roots(cell)) {
            *sum += kappa * alpha * root * root;
        }
        kappa *= 1.0 - alpha;
    }
    sum.map(|s: f32| s.max(LEAST).sqrt())
}

/// The roots of red, green and blue of a cell, within what colours can be.
pub(super) fn roots(cell: &Cell) -> [f32; 3] {
    roots_from_ycc(cell.ycc.map(f32_from_fixed)).map(|r| r.clamp(0.0, MAX_ROOT))
}

impl Corrections {
    /// Changes the colours of a band's cells so that every list composites to what it should, by the same factor in all
    /// cells of a list.
    pub(super) fn apply(&self, band: &mut Band) {
        for (block, &place) in self.places.iter().enumerate() {
            let Some(planes) = self.planes.get(place as usize) else { continue };
            if !band.has_matter(block) {
                continue;
            }
            for i in 0..BLOCK_LISTS {
                let difference = planes.map(|plane| plane[i]);
                let cells = band.list(block, i);
                if difference == [0; 3] || cells.is_empty() {
                    continue;
                }
                let difference = roots_from_ycc(difference.map(f32_from_fixed));
                let found = composite_roots(&band.cells[cells.clone()]);
                let factors: [f32; 3] = std::array::from_fn(|c| {
                    ((found[c] + difference[c]) / found[c]).clamp(1.0 / MAX_FACTOR, MAX_FACTOR)
                });
                for cell in &mut band.cells[cells] {
                    let own = roots(cell);
                    let changed = [0, 1, 2].map(|c| (own[c] * factors[c]).min(MAX_ROOT));
                    cell.ycc = ycc_from_roots(changed).map(fixed_from_f32);
                }
            }
        }
    }
}

/// Greatest root of a colour: shading can lift one above 1.
pub(super) const MAX_ROOT: f32 = 1.2;
/// A list that is off by more than this factor, on the scale of roots, has lost a cell; the rest shall not make up for
/// it, since they would be seen from another pose.
const MAX_FACTOR: f32 = 2.0;
/// Least colour of a list.
const LEAST: f32 = 1e-5;
const NONE: u32 = u32::MAX;
