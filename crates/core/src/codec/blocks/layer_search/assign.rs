//! Assigns the matter of lists to given layers, and fits depth planes to what is in each layer.

use glam::Vec3;

use super::super::model::{BLOCK, BlockLayer, PlaneFit};
use super::lists::{BlockLists, CollectedLight, ListWalk, TAU_MIN};
use super::{
    BLOCK_LISTS, Column, KAPPA_FLOOR, ListSubset, SAMPLES, SampleColumn, greater, lesser, select, sum,
};
use crate::kernels::raycast::opacity;
use crate::layer::TAU_MAX;

/// The matter of all lists or of the sampled ones, put into layers. Columns are indices among these lists.
#[derive(Clone, Debug, Default)]
pub(super) struct Assigned {
    /// The first `num` belong to layers.
    cells: Vec<AssignedLayer>,
    num: usize,
}

/// The lists' matter in a layer.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
struct AssignedLayer {
    /// Mask of the lists with matter. The others have opacity 0, and their other values mean nothing.
    mask: u64,
    front: Column,
    back: Column,
    alpha: Column,
    tau: Column,
    c: [Column; 3],
}

const ZERO: Column = [0.0; BLOCK_LISTS];
const NO_CELLS: AssignedLayer =
    AssignedLayer { mask: 0, front: ZERO, back: ZERO, alpha: ZERO, tau: ZERO, c: [ZERO; 3] };

impl AssignedLayer {
    /// Sets what lists from `first` on collect between two places. The first place is in or in front of pieces with
    /// the source colours `e`; `pieces` are the indices of the pieces at both. Returns a mask of lists whose colours
    /// are still unknown: the difference of two nearly equal colours is only rounding noise.
    #[inline(always)]
    fn fill(
        &mut self,
        first: usize,
        from: &CollectedLight,
        to: &CollectedLight,
        e: &[SampleColumn; 3],
        pieces: [&[u32; SAMPLES]; 2],
    ) -> u64 {
        let slots = first..first + SAMPLES;
        let [front, back, alpha, tau] = [&mut self.front, &mut self.back, &mut self.alpha, &mut self.tau]
            .map(|column| &mut column[slots.clone()]);
        let [r, g, b] = self.c.each_mut().map(|column| &mut column[slots.clone()]);
        let (mut mask, mut hidden) = (0, 0);
        for i in 0..SAMPLES {
            let has_matter = from.next[i] < to.last[i];
            mask |= u64::from(has_matter) << i;
            let is_one = pieces[0][i] == pieces[1][i];
            let is_hidden = from.kappa[i] - to.kappa[i] < LEAST_SEEN;
            hidden |= u64::from(has_matter & is_hidden & !is_one) << i;
            // Without matter these are infinite.
            front[i] = select(has_matter, from.next[i], 0.0);
            back[i] = select(has_matter, to.last[i], 0.0);
            tau[i] = lesser(greater(to.tau[i] - from.tau[i], TAU_MIN), TAU_MAX);
            // The quotient of two tiny transmittances would mean nothing.
            alpha[i] = select(has_matter, opacity(tau[i]), 0.0);
            let color = |n: usize| {
                let seen = (to.c[n][i] - from.c[n][i]) * from.per_kappa[i];
                select(is_one, e[n][i] * alpha[i], seen)
            };
            (r[i], g[i], b[i]) = (color(0), color(1), color(2));
        }
        self.mask |= mask << first;
        hidden << first
    }

    /// Takes the colours of lists from some of their pieces.
    #[inline(always)]
    fn fill_hidden(&mut self, mut hidden: u64, lists: &BlockLists, pieces: [&[u32; SAMPLES]; 2]) {
        while hidden != 0 {
            let slot = hidden.trailing_zeros() as usize;
            hidden &= hidden - 1;
            let [first, last] = pieces.map(|pieces| pieces[slot % SAMPLES]);
            let c = lists.composite(first, last, self.front[slot], self.back[slot]);
            for (column, c) in self.c.iter_mut().zip(c) {
                column[slot] = c;
            }
        }
    }
}

impl Assigned {
    /// Puts the matter of lists into layers between these planes: what they collect up to the end of a layer, minus
    /// what they have at its front. A layer ends half-way between its back plane and the next front plane.
    #[inline(always)]
    pub(super) fn put_all<const HAS_COLORS: bool>(
        &mut self,
        walk: &mut ListWalk,
        lists: &BlockLists,
        planes: &[(PlaneFit, PlaneFit)],
        of: &impl ListSubset,
    ) {
        self.num = planes.len();
        self.cells.resize(self.cells.len().max(self.num), NO_CELLS);
        for cells in &mut self.cells[..self.num] {
            cells.mask = 0;
        }
        for first in (0..of.num()).step_by(SAMPLES) {
            let numbers = std::array::from_fn(|i| of.list(first + i));
            let mut before = CollectedLight::NOTHING;
            walk.start_at_borders(lists, &numbers, &mut before);
            for (n, cells) in self.cells[..self.num].iter_mut().enumerate() {
                let (first_pieces, e) = (walk.index, walk.e);
                let mut here = CollectedLight::NOTHING;
                walk.go_to_borders(lists, &borders(planes, n, &numbers), &mut here, &mut ());
                let pieces = [&first_pieces, &walk.index];
                let hidden = cells.fill(first, &before, &here, &e, pieces);
                if HAS_COLORS {
                    cells.fill_hidden(hidden, lists, pieces);
                }
                before = here;
            }
        }
    }

    /// Puts the matter of all lists into the layers.
    #[inline(always)]
    pub(super) fn layers(&self, planes: &[(PlaneFit, PlaneFit)], out: &mut Vec<BlockLayer>) {
        out.resize_with(self.num, BlockLayer::default);
        for ((cells, layer), &(front, back)) in self.cells.iter().zip(&mut *out).zip(planes) {
            (layer.front, layer.back, layer.mask) = (front, back, cells.mask);
            for i in 0..BLOCK_LISTS {
                let is_there = cells.mask >> i & 1 == 1;
                layer.tau[i] = select(is_there, cells.tau[i], 0.0);
                layer.c[i] =
                    Vec3::new(cells.c[0][i], cells.c[1][i], cells.c[2][i]) * select(is_there, 1.0, 0.0);
            }
        }
    }

    /// Replaces `planes` by those that fit the matter of all lists in the layers, with slopes near `slopes`. Drops
    /// layers without matter.
    #[inline(always)]
    pub(super) fn fit(
        &mut self,
        slopes: [f32; 2],
        planes: &mut Vec<(PlaneFit, PlaneFit)>,
        of: &impl ListSubset,
    ) {
        let mut kept = 0;
        let mut kappa = [1.0; BLOCK_LISTS];
        for index in 0..self.num {
            let cells = &self.cells[index];
            if cells.mask == 0 {
                continue;
            }
            let weights = weights(cells, &kappa, of.num());
            planes[kept] =
                (fitted(&weights, &cells.front, slopes, of), fitted(&weights, &cells.back, slopes, of));
            for (kappa, alpha) in kappa[..of.num()].iter_mut().zip(&cells.alpha) {
                *kappa *= 1.0 - alpha;
            }
            self.cells.swap(kept, index);
            kept += 1;
        }
        planes.truncate(kept);
        self.num = kept;
    }
}

/// The end of layer `n` in some lists.
#[inline(always)]
pub(super) fn borders(planes: &[(PlaneFit, PlaneFit)], n: usize, lists: &[usize; SAMPLES]) -> SampleColumn {
    match planes.get(n + 1) {
        None => [f32::MAX; SAMPLES],
        Some((next, _)) => lists.map(|i| 0.5 * (planes[n].1.at(i) + next.at(i))),
    }
}

/// Weights of the ends of `num` lists for a plane.
#[inline(always)]
fn weights(cells: &AssignedLayer, kappa: &Column, num: usize) -> Column {
    let mut weights = [0.0; BLOCK_LISTS];
    for i in 0..num {
        // The small addend lets a nearly clear list count where no other does.
        let weight = (cells.alpha[i] + 1e-3) * kappa[i].max(KAPPA_FLOOR);
        weights[i] = select(cells.mask >> i & 1 == 1, weight, 0.0);
    }
    weights
}

/// The plane with least squared distance from depths `z`, whose slopes are drawn towards these.
#[inline(always)]
fn fitted(weights: &Column, z: &Column, [dx, dy]: [f32; 2], of: &impl ListSubset) -> PlaneFit {
    let middle = (BLOCK as f32 - 1.0) / 2.0;
    let [w, wx, wy, wz] = sum(of.num(), |slot| {
        let i = of.list(slot);
        let (x, y) = ((i % BLOCK) as f32 - middle, (i / BLOCK) as f32 - middle);
        let w = weights[slot];
        [w, w * x, w * y, w * z[slot]]
    });
    let (mx, my, mz) = (wx / w, wy / w, wz / w);
    let [xx, xy, yy, xz, yz] = sum(of.num(), |slot| {
        let i = of.list(slot);
        let (x, y) = ((i % BLOCK) as f32 - middle - mx, (i / BLOCK) as f32 - middle - my);
        let w = weights[slot];
        let z = z[slot] - mz;
        [w * x * x, w * x * y, w * y * y, w * x * z, w * y * z]
    });
    // The remaining slopes.
    let (xz, yz) = (xz - dx * xx - dy * xy, yz - dx * xy - dy * yy);
    // Few lists in a row give no slope across it.
    let (xx, yy) = (xx + SLOPE_DAMPING * w, yy + SLOPE_DAMPING * w);
    let per_determinant = 1.0 / (xx * yy - xy * xy);
    let dx = dx + (xz * yy - yz * xy) * per_determinant;
    let dy = dy + (yz * xx - xz * xy) * per_determinant;
    PlaneFit { z: mz - dx * mx - dy * my, dx, dy }
}

/// Below this visible opacity, the visible colour does not tell the colour.
const LEAST_SEEN: f32 = 5e-5;
/// Square of the distance over which slopes are drawn back, lists.
const SLOPE_DAMPING: f32 = 0.5;
