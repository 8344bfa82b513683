//! What a block has between two of its depth planes.

use std::ops::Range;

use super::super::band::Planes;
use super::super::edges::{Edges, spread};
use super::super::entropy::Coder;
use super::super::meter::About;
use super::super::model::{BLOCK, BLOCK_LISTS, BlockLayer, lists_of};
use super::super::reference::{HALF, fetch};
use super::super::scales::{fixed_from_f32, scales, whole, ycc_from_roots};
use super::super::syntax::{Contexts, Levels, NO_CLASS};
use super::super::transform::{Plane, ZIGZAG, fill_in, forward, inverse};
use super::{BandCoder, Origin};
use crate::kernels::raycast::opacity;

/// The block that a layer is in.
pub(super) struct Around {
    pub(super) x: usize,
    pub(super) y: usize,
    pub(super) origin: Origin,
    pub(super) first_layer: usize,
    /// Layers of the block on the left and of the one above.
    pub(super) neighbors: [Range<usize>; 2],
}

/// What later blocks and layers want to know of a layer.
#[derive(Clone, Copy, Debug)]
pub(super) struct Coded {
    pub(super) means: [f32; 4],
    pub(super) classes: [u8; 4],
    /// The lists with matter.
    pub(super) mask: u64,
}

impl<C: Coder> BandCoder<'_, C> {
    /// Codes what is between the planes number `layer`.
    pub(super) fn layer(
        &mut self,
        layer: usize,
        around: &Around,
        wanted: Option<&BlockLayer>,
        mask_before: &mut Option<u64>,
    ) -> Coded {
        let &Around { x, y, origin, first_layer, ref neighbors } = around;
        let planes = self.band.planes[layer];
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
        self.coder.about(About::Lists);
        let means_in_front = in_front.map_or([0.0; 4], |l| l.means);
        if !self.coder.bit(&mut self.contexts.has_matter[kind][likely], wanted_mask != 0) {
            return self.nothing(means_in_front);
        }
        let numbers = neighbors.clone().map(|n| self.overlapping(n, &planes));
        let matches = numbers.map(|n| n.map(|l| self.layers[l]));
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
            return self.nothing(means_in_front);
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
        let mut is_inter = 2 * known > mask.count_ones();
        if is_inter {
            let is_better = sources.as_ref().is_some_and(|s| self.is_inter_better(s, &means, mask));
            let full = usize::from(expected == Some(u64::MAX));
            is_inter = self.coder.bit(&mut self.contexts.is_inter[full], is_better);
        }

        let scales = scales();
        let lists = || lists_of(mask);
        let num_lists = mask.count_ones() as f32;
        let kappa = lists().map(|i| self.lists.kappa[i]).sum::<f32>() / num_lists;
        let mut coded = Coded { means, classes: [0; 4], mask };
        let beside = numbers.map(|n| n.and_then(|l| self.edges.get(l)));
        let mut edges = [Edges::default(); 4];
        if is_inter {
            let [u, y, co, cg] = &self.fetched.planes;
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
                // How much of a colour is seen is known from what is decoded.
                let seen = |i: usize| self.lists.kappa[i].max(KAPPA_FLOOR) * alphas[i];
                let seen = lists().map(seen).sum::<f32>() / num_lists;
                step = self.steps.color / seen.max(SEEN_FLOOR).sqrt();
            } else if c == 2 {
                step *= self.steps.chroma;
            }
            let component = [0, 1, 2, 2][c] + if is_inter { 4 } else { 0 };
            let source = sources.as_ref().map(|s| &s[c]);
            let [left, above] = beside.map(|edges| edges.map(|e| &e[c]));
            let waves = spread(left, above, step);
            let expected = match &waves {
                _ if is_inter => Expected::Plane(&self.fetched.planes[c]),
                Some(waves) => {
                    coded.means[c] = waves[0] * (1.0 / BLOCK as f32);
                    Expected::Waves(waves)
                }
                None => Expected::Constant(means[c]),
            };
            let (class, mean) = residual(
                &mut self.coder,
                &mut self.contexts,
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
            if self.has_edges {
                edges[c] = Edges::of(&values[c]);
            }
            if c == 0 {
                codes_of(&values[0], &mut codes);
                alphas = codes.map(|code| scales.alpha[usize::from(code)]);
            }
        }
        let mut ycc = [[0; BLOCK_LISTS]; 3];
        for (c, range) in [[0.0, MAX_BRIGHTNESS], [-1.0, 1.0], [-1.0, 1.0]].into_iter().enumerate() {
            fixed_of(&values[c + 1], range, &mut ycc[c]);
        }
        self.lists.push(&planes, mask, &codes, &ycc, &alphas);
        if self.has_edges {
            self.edges.push(edges);
        }
        coded
    }

    /// A layer without matter.
    pub(super) fn nothing(&mut self, means: [f32; 4]) -> Coded {
        if self.has_edges {
            self.edges.push(means.map(Edges::flat));
        }
        Coded { means, classes: [0; 4], mask: 0 }
    }

    /// Fetches what the reference has between two planes; the lists that have any.
    fn fetch(&mut self, (x, y): (usize, usize), planes: &Planes) -> Option<u64> {
        let (reference, motion) = self.reference.as_ref()?;
        let y = y + self.place.first_row;
        let [mx, my] = [x, y].map(|v| (v * BLOCK) as f32 + HALF);
        let shift = motion.at(mx, my, 0.5 * (planes.0.z + planes.1.z))?;
        fetch(&mut self.fetched, reference, (x, y), planes, shift, self.steps.depth);
        Some(self.fetched.mask)
    }

    /// Number of the layer that has most depth in common with a pair of planes.
    fn overlapping(&self, layers: Range<usize>, planes: &Planes) -> Option<usize> {
        let common = |l: usize| {
            let (front, back) = self.band.planes[l];
            back.z.min(planes.1.z) - front.z.max(planes.0.z)
        };
        let best =
            layers.map(|l| (common(l), l)).filter(|(c, _)| *c > 0.0).max_by(|a, b| a.0.total_cmp(&b.0));
        best.map(|(_, l)| l)
    }

    /// Whether the moved reference is nearer to the source than a constant is.
    fn is_inter_better(&self, sources: &[Plane; 4], means: &[f32; 4], mask: u64) -> bool {
        let lists = || lists_of(mask);
        let (mut intra, mut inter) = (0.0, 0.0);
        for c in 0..2 {
            let mean = lists().map(|i| sources[c][i]).sum::<f32>() / mask.count_ones() as f32;
            intra += 8.0 * (mean - means[c]).abs();
            for i in lists() {
                intra += (sources[c][i] - mean).abs();
                inter += (sources[c][i] - self.fetched.planes[c][i]).abs();
            }
        }
        inter < intra
    }
}

/// What is expected of a plane.
#[derive(Clone, Copy, Debug)]
pub(in super::super) enum Expected<'a> {
    Constant(f32),
    Plane(&'a Plane),
    /// Its coefficients.
    Waves(&'a Plane),
}

impl Expected<'_> {
    fn values(&self) -> Plane {
        match self {
            Self::Constant(value) => [*value; BLOCK_LISTS],
            Self::Plane(plane) => **plane,
            Self::Waves(waves) => inverse(waves),
        }
    }
}

/// Codes what a plane differs by from what is expected of it, and writes its values. Returns the class, and by how
/// much the mean differs.
#[expect(clippy::too_many_arguments, reason = "two directions in one function")]
pub(in super::super) fn residual<C: Coder>(
    coder: &mut C,
    contexts: &mut Contexts,
    component: usize,
    near: [u8; 2],
    step: f32,
    mask: u64,
    source: Option<&Plane>,
    expected: &Expected<'_>,
    values: &mut Plane,
) -> (u8, f32) {
    let mut levels = Levels::ZERO;
    if let (true, Some(source)) = (C::ENCODES, source) {
        let coefficients = match expected {
            Expected::Waves(waves) if mask == u64::MAX => {
                let all = forward(source);
                std::array::from_fn(|i| all[i] - waves[i])
            }
            _ => {
                let expected = expected.values();
                let mut difference: Plane = std::array::from_fn(|i| source[i] - expected[i]);
                fill_in(&mut difference, mask);
                forward(&difference)
            }
        };
        let rounding =
            if component < FIRST_INTER || component == CORRECTION { ROUNDING } else { INTER_ROUNDING };
        quantize(&coefficients, step, rounding, &mut levels);
    }
    let class = contexts.coefficients(coder, component, near, &mut levels);
    let mut coefficients = [0.0; BLOCK_LISTS];
    for (k, &level) in levels.values[..levels.length].iter().enumerate() {
        if level != 0 {
            let size = level.unsigned_abs() as f32 - if k > 0 { TOWARDS_ZERO } else { 0.0 };
            coefficients[usize::from(ZIGZAG[k])] = if level < 0 { -size * step } else { size * step };
        }
    }
    let mean = coefficients[0] * (1.0 / BLOCK as f32);
    match expected {
        Expected::Waves(waves) => {
            coefficients.iter_mut().zip(*waves).for_each(|(c, wave)| *c += wave);
            let is_flat = coefficients[1..].iter().all(|&c| c == 0.0);
            let flat = [coefficients[0] * (1.0 / BLOCK as f32); BLOCK_LISTS];
            *values = if is_flat { flat } else { inverse(&coefficients) };
        }
        _ => {
            *values = expected.values();
            if levels.length == 1 {
                values.iter_mut().for_each(|v| *v += mean);
            } else if levels.length > 1 {
                for (value, difference) in values.iter_mut().zip(inverse(&coefficients)) {
                    *value += difference;
                }
            }
        }
    }
    (class, mean)
}

wide! {
    /// Codes of opacities.
    fn codes_of(values: &Plane, codes: &mut [u16; BLOCK_LISTS]) = codes_of_any;
}

wide! {
    /// Colours as they are kept, within a range.
    pub(in super::super) fn fixed_of(values: &Plane, range: [f32; 2], fixed: &mut [i16; BLOCK_LISTS])
        = fixed_of_any;
}

wide! {
    /// Levels of coefficients.
    fn quantize(coefficients: &Plane, step: f32, rounding: [f32; 2], levels: &mut Levels) = quantize_any;
}

wide! {
    /// u, Y, Co, Cg of a layer's lists; those outside of `mask` mean nothing.
    fn planes_of(layer: &BlockLayer, mask: u64) -> [Plane; 4] = planes_of_any;
}

#[inline(always)]
fn codes_of_any(values: &Plane, codes: &mut [u16; BLOCK_LISTS]) {
    let scales = scales();
    for (code, u) in codes.iter_mut().zip(values) {
        *code = scales.code(*u);
    }
}

#[inline(always)]
fn fixed_of_any(values: &Plane, [least, most]: [f32; 2], fixed: &mut [i16; BLOCK_LISTS]) {
    for (fixed, value) in fixed.iter_mut().zip(values) {
        *fixed = fixed_from_f32(value.clamp(least, most));
    }
}

#[inline(always)]
fn quantize_any(coefficients: &Plane, step: f32, rounding: [f32; 2], levels: &mut Levels) {
    let size = |c: f32, rounding: f32| {
        let size = c.abs() / step + rounding;
        whole(if size < MAX_SIZE { size } else { MAX_SIZE }) as i32
    };
    let mut all = [0; BLOCK_LISTS];
    let mut any = 0;
    for (level, &c) in all.iter_mut().zip(coefficients) {
        let size = size(c, rounding[1]);
        *level = if c < 0.0 { -size } else { size };
        any |= size;
    }
    let first = size(coefficients[0], rounding[0]);
    all[0] = if coefficients[0] < 0.0 { -first } else { first };
    levels.length = 0;
    if any | first == 0 {
        return;
    }
    for (level, &place) in levels.values.iter_mut().zip(&ZIGZAG) {
        *level = all[usize::from(place) % BLOCK_LISTS];
    }
    let mut length = 0;
    for (k, &level) in levels.values.iter().enumerate() {
        let end = if level != 0 { k as u32 + 1 } else { 0 };
        length = length.max(end);
    }
    levels.length = length as usize;
}

#[inline(always)]
fn planes_of_any(layer: &BlockLayer, mask: u64) -> [Plane; 4] {
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

/// More than any coefficient has steps.
const MAX_SIZE: f32 = (1 << 20) as f32;
/// Greatest source colour.
const MAX_COLOR: f32 = 2.25;
/// Opacity below which there is no colour.
const LEAST_ALPHA: f32 = 1e-4;
/// Least visibility in the steps: what is hidden here is seen from another pose.
const KAPPA_FLOOR: f32 = 0.2;
/// Least visible opacity in the steps of colour.
const SEEN_FLOOR: f32 = 0.02;
const MAX_BRIGHTNESS: f32 = 1.5;
/// What is added to constant and other coefficients before levels are cut off. Larger dead zones cost more of the picture than they
/// save.
const ROUNDING: [f32; 2] = [0.5, 0.45];
/// After a moved reference, which has errors of about half a step itself, they save more than they cost. Measured along
/// orbits, .4 and .3 takes 1 % more for the same picture, .3 and .2 as much.
const INTER_ROUNDING: [f32; 2] = [0.35, 0.25];
/// Components from here on are predicted from a reference, but for the last.
const FIRST_INTER: usize = 4;
const CORRECTION: usize = 7;
/// How much nearer to zero than its level a coefficient is on average.
const TOWARDS_ZERO: f32 = 0.05;
