//! Codes a layer of a block: which of its lists have matter, and its planes of opacity and colour.

use std::ops::Range;

use super::super::entropy::Coder;
use super::super::model::{BLOCK, BLOCK_LISTS, BlockLayer, lists_of};
use super::super::reference::{HALF, fetch};
use super::super::residual::{Expected, fixed_of, residual};
use super::super::scales::{scales, ycc_from_roots};
use super::super::syntax::NO_CLASS;
use super::super::tile::Planes;
use super::super::transform::BlockPlane;
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
    pub(super) means: [f32; 4],
    pub(super) classes: [u8; 4],
    /// Mask of the lists with matter.
    pub(super) mask: u64,
}

impl CodedLayer {
    /// A layer without matter, which passes on these means.
    pub(super) fn without_matter(means: [f32; 4]) -> Self {
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
        let means_in_front = in_front.map_or([0.0; 4], |l| l.means);
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

        let means: [f32; 4] = std::array::from_fn(|c| match matches {
            [Some(a), Some(b)] => 0.5 * (a.means[c] + b.means[c]),
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

        let scales = scales();
        let lists = || lists_of(mask);
        let num_lists = mask.count_ones() as f32;
        let kappa = lists().map(|i| self.scratch.lists.kappa[i]).sum::<f32>() / num_lists;
        let mut coded = CodedLayer { means, classes: [0; 4], mask };
        if is_inter {
            let [u, y, co, cg] = &self.scratch.fetched.planes;
            let mut sums = [0.0; 4];
            for (((u, y), co), cg) in u.iter().zip(y).zip(co).zip(cg) {
                for (sum, value) in sums.iter_mut().zip([u, y, co, cg]) {
                    *sum += value;
                }
            }
            coded.means = sums.map(|sum| sum * (1.0 / BLOCK_LISTS as f32));
        }
        let mut step = self.steps.opacity / kappa.max(KAPPA_FLOOR).sqrt();
        let mut values = [[0.0; BLOCK_LISTS]; 4];
        let mut codes = [0; BLOCK_LISTS];
        let mut alphas = [0.0; BLOCK_LISTS];
        for c in 0..4 {
            if c == 1 {
                // The decoded opacities tell how visible a colour is.
                let seen = |i: usize| self.scratch.lists.kappa[i].max(KAPPA_FLOOR) * alphas[i];
                let seen = lists().map(seen).sum::<f32>() / num_lists;
                step = self.steps.color / seen.max(SEEN_FLOOR).sqrt();
            } else if c == 2 {
                step *= self.steps.chroma;
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
            coded.means[c] += mean;
            if c == 0 {
                codes_of(&values[0], &mut codes);
                alphas = codes.map(|code| scales.alpha[usize::from(code)]);
            }
        }
        let mut ycc = [[0; BLOCK_LISTS]; 3];
        for (c, range) in [[0.0, MAX_BRIGHTNESS], [-1.0, 1.0], [-1.0, 1.0]].into_iter().enumerate() {
            fixed_of(&values[c + 1], range, &mut ycc[c]);
        }
        self.scratch.lists.push(&planes, mask, &codes, &ycc, &alphas);
        coded
    }

    /// Fetches what the reference has between two planes. Returns the mask of lists with matter.
    fn fetch(&mut self, (x, y): (usize, usize), planes: &Planes) -> Option<u64> {
        let (reference, motion) = self.reference.as_ref()?;
        let [x, y] = self.place.in_frame(x, y);
        let [mx, my] = [x, y].map(|v| (v * BLOCK) as f32 + HALF);
        let shift = motion.at(mx, my, 0.5 * (planes.0.z + planes.1.z))?;
        fetch(&mut self.scratch.fetched, reference, (x, y), planes, shift, self.steps.depth);
        Some(self.scratch.fetched.mask)
    }

    /// Index of the layer that shares most depth with a pair of planes.
    fn overlapping(&self, layers: Range<usize>, planes: &Planes) -> Option<usize> {
        let common = |l: usize| {
            let (front, back) = self.tile.planes[l];
            back.z.min(planes.1.z) - front.z.max(planes.0.z)
        };
        let best =
            layers.map(|l| (common(l), l)).filter(|(c, _)| *c > 0.0).max_by(|a, b| a.0.total_cmp(&b.0));
        best.map(|(_, l)| l)
    }
}

wide! {
    /// Codes of opacities.
    fn codes_of(values: &BlockPlane, codes: &mut [u16; BLOCK_LISTS]) = codes_of_any;
}

wide! {
    /// u, Y, Co, Cg of a layer's lists. Values outside of `mask` mean nothing.
    fn planes_of(layer: &BlockLayer, mask: u64) -> [BlockPlane; 4] = planes_of_any;
}

#[inline(always)]
fn codes_of_any(values: &BlockPlane, codes: &mut [u16; BLOCK_LISTS]) {
    let scales = scales();
    for (code, u) in codes.iter_mut().zip(values) {
        *code = scales.code(*u);
    }
}

#[inline(always)]
fn planes_of_any(layer: &BlockLayer, mask: u64) -> [BlockPlane; 4] {
    let mut planes = [[0.0; BLOCK_LISTS]; 4];
    let [u, y, co, cg] = &mut planes;
    for i in 0..BLOCK_LISTS {
        let per_alpha = 1.0 / opacity(layer.tau[i]).max(LEAST_ALPHA);
        let roots = layer.c[i].to_array().map(|c| (c * per_alpha).clamp(0.0, MAX_COLOR).sqrt());
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
/// Least visibility for the steps: what is hidden here is visible from another pose.
const KAPPA_FLOOR: f32 = 0.2;
/// Least visible opacity for the steps of colour.
const SEEN_FLOOR: f32 = 0.02;
const MAX_BRIGHTNESS: f32 = 1.5;
