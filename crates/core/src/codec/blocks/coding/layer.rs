//! Codes a layer of a block: which of its lists have matter, and its planes of opacity and colour.

use std::ops::Range;

use super::super::entropy::Coder;
use super::super::fetch::fetch;
use super::super::model::{BLOCK_LISTS, BlockLayer, lists_of, middle_of};
use super::super::residual::{Expected, residual, stored_of};
use super::super::scales::{FINE, code_from_quarters, scales, seen, ycc_from_roots};
use super::super::syntax::NO_CLASS;
use super::super::tile::Planes;
use super::super::transform::{BlockNumbers, BlockPlane};
use super::{Origin, TileCoder};
use crate::kernels::raycast::opacity;

/// The block of a layer.
pub(super) struct BlockContext {
    pub(super) x: usize,
    pub(super) y: usize,
    pub(super) origin: Origin,
    pub(super) first_layer: usize,
    /// Layers of the left block and of the upper one.
    pub(super) neighbors: [Range<usize>; 2],
}

/// What later blocks and layers use of a layer.
#[derive(Clone, Copy, Debug)]
pub(super) struct CodedLayer {
    pub(super) means: [i32; 4],
    pub(super) classes: [u8; 4],
    /// Mask of the lists with matter.
    pub(super) mask: u64,
}

impl CodedLayer {
    /// A layer without matter, which passes on these means.
    pub(super) fn without_matter(means: [i32; 4]) -> Self {
        Self { means, classes: [0; 4], mask: 0 }
    }
}

impl<C: Coder> TileCoder<'_, C> {
    /// Codes the matter between the planes with index `layer`.
    pub(super) fn layer(
        &mut self,
        layer: usize,
        around: &BlockContext,
        wanted: Option<&BlockLayer>,
        mask_before: &mut Option<u64>,
    ) -> CodedLayer {
        let &BlockContext { x, y, origin, first_layer, ref neighbors } = around;
        let planes = self.tile.planes[layer];
        let in_front = layer.checked_sub(1).filter(|&l| l >= first_layer).map(|l| self.layers[l]);
        let expected = self.fetch((x, y), &planes);
        let wanted_mask = wanted.map_or(0, |w| w.mask);
        let likely = match expected.map(u64::count_ones) {
            None => 0,
            Some(0) => 1,
            Some(1..=8) => 2,
            Some(9..=63) => 3,
            Some(_) => 4,
        };
        let kind = match origin {
            Origin::Fresh => 0,
            Origin::Left | Origin::Above => 1,
            Origin::Kept | Origin::Copied => 2,
        };
        let means_in_front = in_front.map_or([0; 4], |l| l.means);
        if !self.coder.bit(self.contexts.has_matter[kind][likely], wanted_mask != 0) {
            return CodedLayer::without_matter(means_in_front);
        }
        let matches = neighbors.clone().map(|n| self.overlapping(n, &planes).map(|l| self.layers[l]));
        let inside = self.place.inside(x, y);
        let said = if wanted_mask == inside { u64::MAX } else { wanted_mask };
        let mask = self.contexts.mask(
            &mut self.coder,
            *mask_before,
            expected,
            matches.map(|m| m.map(|m| m.mask)),
            said,
        ) & inside;
        if mask == 0 {
            return CodedLayer::without_matter(means_in_front);
        }
        *mask_before = Some(mask);

        let means: [i32; 4] = std::array::from_fn(|c| match matches {
            [Some(a), Some(b)] => a.means[c].wrapping_add(b.means[c]) >> 1,
            [Some(a), None] | [None, Some(a)] => a.means[c],
            [None, None] => means_in_front[c],
        });
        let classes: [[u8; 2]; 4] = std::array::from_fn(|c| {
            let beside = match matches {
                [Some(a), Some(b)] => (a.classes[c] + b.classes[c]) / 2,
                [Some(a), None] | [None, Some(a)] => a.classes[c],
                [None, None] => NO_CLASS,
            };
            [in_front.map_or(NO_CLASS, |l| l.classes[c]), beside]
        });
        let known = expected.map_or(0, |e| (e & mask).count_ones());
        let sources = wanted.filter(|_| C::ENCODES).map(|w| planes_of(w, mask));
        // A choice between the two costs more than it saves.
        let is_inter = 2 * known > mask.count_ones();

        let mut coded = CodedLayer { means, classes: [0; 4], mask };
        if is_inter {
            let sum = |plane: &BlockNumbers| plane.iter().sum::<i32>();
            coded.means = self.scratch.fetched.planes.each_ref().map(|plane| sum(plane) / BLOCK_LISTS as i32);
        }
        let kappa = &self.scratch.lists.kappa;
        // The mean over the lists with matter.
        let mean = |of: &dyn Fn(usize) -> i32| lists_of(mask).map(of).sum::<i32>() / mask.count_ones() as i32;
        let mut step = scales().per_root(self.steps.opacity, mean(&|i| kappa[i]).max(KAPPA_FLOOR));
        let mut values = [[0; BLOCK_LISTS]; 4];
        let (mut codes, mut opacities) = ([0; BLOCK_LISTS], [0; BLOCK_LISTS]);
        for c in 0..4 {
            if c == 1 {
                // The decoded opacities tell how visible a colour is.
                let visible = mean(&|i| seen(kappa[i].max(KAPPA_FLOOR), opacities[i]));
                step = scales().per_root(self.steps.color, visible.max(SEEN_FLOOR));
            } else if c == 2 {
                step = self.steps.of_chroma(step);
            }
            let component = [0, 1, 2, 2][c] + if is_inter { 4 } else { 0 };
            let source = sources.as_ref().map(|s| &s[c]);
            let expected = match is_inter {
                true => Expected::Plane(&self.scratch.fetched.planes[c]),
                false => Expected::Constant(means[c]),
            };
            let (class, mean) = residual(
                &mut self.coder,
                self.contexts,
                component,
                classes[c],
                step,
                mask,
                source,
                &expected,
                &mut values[c],
            );
            coded.classes[c] = class;
            coded.means[c] = coded.means[c].wrapping_add(mean);
            if c == 0 {
                codes = values[0].map(code_from_quarters);
                opacities = codes.map(|code| scales().opacity(code));
            }
        }
        let mut ycc = [[0; BLOCK_LISTS]; 3];
        for (c, range) in [[0, MAX_BRIGHTNESS], [-ONE, ONE], [-ONE, ONE]].into_iter().enumerate() {
            stored_of(&values[c + 1], range, &mut ycc[c]);
        }
        self.scratch.lists.push(&planes, mask, &codes, &ycc, &opacities);
        coded
    }

    /// Fetches what the reference has between two planes. Returns the mask of lists with matter.
    fn fetch(&mut self, (x, y): (usize, usize), planes: &Planes) -> Option<u64> {
        let (reference, motion) = self.reference.as_ref()?;
        let [x, y] = self.place.in_frame(x, y);
        let shift = motion.at(middle_of([x, y].map(|v| v as i32)), (planes.0.z + planes.1.z) >> 1)?;
        fetch(&mut self.scratch.fetched, reference, [x, y], planes, shift, self.steps.depth);
        Some(self.scratch.fetched.mask)
    }

    /// Index of the layer that shares most depth with a pair of planes.
    fn overlapping(&self, layers: Range<usize>, planes: &Planes) -> Option<usize> {
        let common = |l: usize| {
            let (front, back) = self.tile.planes[l];
            back.z.min(planes.1.z) - front.z.max(planes.0.z)
        };
        let best = layers.map(|l| (common(l), l)).filter(|(c, _)| *c > 0).max_by_key(|(common, _)| *common);
        best.map(|(_, l)| l)
    }
}

wide! {
    /// u, Y, Co, Cg of a layer's lists, in the numbers of [`residual`]. Values outside of `mask` mean nothing.
    fn planes_of(layer: &BlockLayer, mask: u64) -> [BlockPlane; 4] = planes_of_any;
}

#[inline(always)]
fn planes_of_any(layer: &BlockLayer, mask: u64) -> [BlockPlane; 4] {
    let mut planes = [[0.0; BLOCK_LISTS]; 4];
    let [u, y, co, cg] = &mut planes;
    for i in 0..BLOCK_LISTS {
        let per_alpha = 1.0 / opacity(layer.tau[i]).max(LEAST_ALPHA);
        let roots = layer.c[i].to_array().map(|c| (c * per_alpha).clamp(0.0, MAX_COLOR).sqrt() * FINE);
        [y[i], co[i], cg[i]] = ycc_from_roots(roots);
    }
    let scales = scales();
    for i in lists_of(mask) {
        u[i] = scales.u_from_tau(layer.tau[i]);
    }
    planes
}

/// Greatest source colour.
const MAX_COLOR: f32 = 2.25;
/// Below this opacity there is no colour.
const LEAST_ALPHA: f32 = 1e-4;
/// Least visibility for the steps, .2: what is hidden here is visible from another pose. Units of 2⁻¹⁶.
const KAPPA_FLOOR: i32 = 13_107;
/// Least visible opacity for the steps of colour, .02.
const SEEN_FLOOR: i32 = 1311;
/// A colour difference of 1, and a brightness of 1.5.
const ONE: i32 = FINE as i32;
const MAX_BRIGHTNESS: i32 = ONE + ONE / 2;
