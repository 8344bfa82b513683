//! The matter of lists put into layers.

use glam::Vec3;

use super::lists::{BlockLists, Piece};
use super::merge::move_of_union;
use super::{BLOCK_LISTS, Column, KAPPA_FLOOR, Lists, greater, power_5_4, select, sum};
use crate::codec::blocks::model::{BLOCK, BlockLayer, DepthPlane};
use crate::kernels::raycast::opacity;
use crate::layer::TAU_MAX;

/// The matter of some lists, put into layers: those of all lists or of the sampled ones. Columns are by their number
/// among these.
#[derive(Clone, Debug, Default)]
pub(super) struct Assigned {
    /// Those of the first `num` are of the layers.
    cells: Vec<Cells>,
    num: usize,
    joints: Joints,
    /// Error by joining pieces.
    joined: f32,
}

/// What the lists have in a layer.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
struct Cells {
    /// Which have anything. Of the others, only the opacity counts: 0.
    mask: u64,
    front: Column,
    back: Column,
    alpha: Column,
    tau: Column,
    c: [Column; 3],
    /// Where the layer ends.
    end: Column,
}

/// Pieces that are joined with what a list has in their layer, to be weighed all at once.
#[derive(Clone, Debug)]
#[repr(align(64))]
struct Joints {
    num: usize,
    /// As in [`move_of_union`].
    ends: [Column; 4],
    tau: Column,
    alphas: [Column; 2],
    first: [Column; 3],
    both: [Column; 3],
    /// How much of it is seen.
    weight: Column,
}

const ZERO: Column = [0.0; BLOCK_LISTS];
const NO_CELLS: Cells =
    Cells { mask: 0, front: ZERO, back: ZERO, alpha: ZERO, tau: ZERO, c: [ZERO; 3], end: ZERO };

impl Default for Joints {
    fn default() -> Self {
        Self {
            num: 0,
            ends: [ZERO; 4],
            tau: ZERO,
            alphas: [ZERO; 2],
            first: [ZERO; 3],
            both: [ZERO; 3],
            weight: ZERO,
        }
    }
}

impl Joints {
    /// How far matter is moved by these, and forgets them.
    #[inline(always)]
    fn weigh(&mut self) -> f32 {
        let num = std::mem::take(&mut self.num);
        self.weight[num..].fill(0.0);
        let mut moved = ZERO;
        for (i, moved) in moved.iter_mut().enumerate() {
            let ends = [self.ends[0][i], self.ends[1][i], self.ends[2][i], self.ends[3][i]];
            let alphas = [self.alphas[0][i], self.alphas[1][i]];
            let first = [self.first[0][i], self.first[1][i], self.first[2][i]];
            let both = [self.both[0][i], self.both[1][i], self.both[2][i]];
            let weight = self.weight[i];
            let weighted = weight * move_of_union(ends, self.tau[i], alphas, first, both);
            *moved = select(weight > 0.0, weighted, 0.0);
        }
        sum(BLOCK_LISTS, |i| [moved[i]])[0]
    }
}

impl Assigned {
    /// Begins with layers between these planes; a layer ends half way between its back plane and the front plane of the
    /// next.
    #[inline(always)]
    pub(super) fn start(&mut self, planes: &[(DepthPlane, DepthPlane)], of: &impl Lists) {
        self.joined = 0.0;
        self.joints.num = 0;
        self.num = planes.len();
        self.cells.resize(self.cells.len().max(self.num), NO_CELLS);
        for (n, cells) in self.cells[..self.num].iter_mut().enumerate() {
            cells.mask = 0;
            cells.alpha = ZERO;
            match planes.get(n + 1) {
                None => cells.end = [f32::INFINITY; BLOCK_LISTS],
                Some((next, _)) => {
                    for (slot, end) in cells.end[..of.num()].iter_mut().enumerate() {
                        let i = of.list(slot);
                        *end = 0.5 * (planes[n].1.at(i) + next.at(i));
                    }
                }
            }
        }
    }

    /// Puts the segments of lists into the layers, of which there must be one. What is joined is weighed for [`Self::error`]
    /// only if that `IS_WEIGHED`.
    #[inline(always)]
    pub(super) fn put_lists<const IS_WEIGHED: bool>(
        &mut self,
        lists: &BlockLists,
        slots: std::ops::Range<usize>,
        of: &impl Lists,
    ) {
        for slot in slots {
            let list = of.list(slot);
            let mut layer = 0;
            let mut end = self.cells[0].end[slot];
            for piece in lists.list(list) {
                let short = SNAP * (piece.back - piece.front);
                let mut from = piece.front;
                loop {
                    // An end of a segment that is short beside it stays with the rest.
                    while end < from || end - piece.front < short {
                        layer += 1;
                        end = self.cells[layer].end[slot];
                    }
                    let to = if piece.back - end < short { piece.back } else { end };
                    if to > from {
                        self.put::<IS_WEIGHED>(layer, slot, piece, from..to, lists.slope[list]);
                    }
                    if to >= piece.back {
                        break;
                    }
                    from = to;
                    layer += 1;
                    end = self.cells[layer].end[slot];
                }
            }
        }
        if IS_WEIGHED {
            self.joined += self.joints.weigh();
        }
    }

    /// Puts a part of a segment behind what a list has in the layer.
    #[inline(always)]
    fn put<const IS_WEIGHED: bool>(
        &mut self,
        layer: usize,
        slot: usize,
        piece: &Piece,
        part: std::ops::Range<f32>,
        slope: f32,
    ) {
        let cells = &mut self.cells[layer];
        let mut c = piece.c;
        let (mut tau, mut alpha) = (piece.tau, piece.alpha);
        let share = (part.end - part.start) / (piece.back - piece.front);
        if share < WHOLE {
            tau *= share;
            alpha = opacity(tau);
            let share = alpha / piece.alpha;
            c = c.map(|c| c * share);
        }
        if cells.mask >> slot & 1 == 0 {
            cells.mask |= 1 << slot;
            (cells.front[slot], cells.back[slot]) = (part.start, part.end);
            (cells.tau[slot], cells.alpha[slot]) = (tau, alpha);
            for (cells, c) in cells.c.iter_mut().zip(c) {
                cells[slot] = c;
            }
            return;
        }
        let alpha_first = cells.alpha[slot];
        let alpha_both = alpha_first + (1.0 - alpha_first) * alpha;
        cells.tau[slot] = (cells.tau[slot] + tau).min(TAU_MAX);
        let first = [0, 1, 2].map(|n| cells.c[n][slot]);
        let both = [0, 1, 2].map(|n| first[n] + c[n] * (1.0 - alpha_first));
        for (cells, both) in cells.c.iter_mut().zip(both) {
            cells[slot] = both;
        }
        let back_first = std::mem::replace(&mut cells.back[slot], part.end);
        cells.alpha[slot] = alpha_both;
        if !IS_WEIGHED {
            return;
        }
        let joints = &mut self.joints;
        let at = joints.num % BLOCK_LISTS;
        for n in 0..3 {
            joints.first[n][at] = first[n];
            joints.both[n][at] = both[n];
        }
        joints.ends[0][at] = cells.front[slot];
        joints.ends[1][at] = back_first;
        joints.ends[2][at] = part.start;
        joints.ends[3][at] = part.end;
        joints.tau[at] = cells.tau[slot];
        joints.alphas[0][at] = alpha_first;
        joints.alphas[1][at] = alpha_both;
        joints.weight[at] = greater(piece.before.kappa, KAPPA_FLOOR) * slope;
        joints.num = at + 1;
        if at + 1 == BLOCK_LISTS {
            self.joined += joints.weigh();
        }
    }

    /// What all lists have in the layers.
    #[inline(always)]
    pub(super) fn layers(&self, planes: &[(DepthPlane, DepthPlane)], out: &mut Vec<BlockLayer>) {
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

    /// The planes that suit what all lists have in the layers, with slopes near `slopes`, in place of `planes`; drops
    /// layers that have nothing.
    #[inline(always)]
    pub(super) fn fit(
        &mut self,
        slopes: [f32; 2],
        planes: &mut Vec<(DepthPlane, DepthPlane)>,
        of: &impl Lists,
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

    /// How far matter has moved: by being joined, and to the planes of its layer.
    #[inline(always)]
    pub(super) fn error(
        &self,
        lists: &BlockLists,
        planes: &[(DepthPlane, DepthPlane)],
        of: &impl Lists,
    ) -> f32 {
        let mut error = self.joined;
        let mut kappa = [1.0; BLOCK_LISTS];
        for (cells, (front, back)) in self.cells.iter().zip(planes) {
            let [moved] = sum(of.num(), |slot| {
                let i = of.list(slot);
                let d = (cells.front[slot] - front.at(i)).abs() + 0.5 * (cells.back[slot] - back.at(i)).abs();
                let seen = select(kappa[slot] > KAPPA_FLOOR, kappa[slot], KAPPA_FLOOR) * lists.slope[i];
                // Where a list has nothing, its opacity is 0.
                [cells.alpha[slot] * seen * power_5_4(d)]
            });
            error += moved;
            for (kappa, alpha) in kappa[..of.num()].iter_mut().zip(&cells.alpha) {
                *kappa *= 1.0 - alpha;
            }
        }
        error
    }
}

/// How much the ends of each of `num` lists are worth to a plane.
#[inline(always)]
fn weights(cells: &Cells, kappa: &Column, num: usize) -> Column {
    let mut weights = [0.0; BLOCK_LISTS];
    for i in 0..num {
        // The small addend lets a list that is all but clear have a say where no other has.
        let weight = (cells.alpha[i] + 1e-3) * kappa[i].max(KAPPA_FLOOR);
        weights[i] = select(cells.mask >> i & 1 == 1, weight, 0.0);
    }
    weights
}

/// The plane through depths `z` with least squared distance, its slopes held back to these.
#[inline(always)]
fn fitted(weights: &Column, z: &Column, [dx, dy]: [f32; 2], of: &impl Lists) -> DepthPlane {
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
    // What is left of the slopes.
    let (xz, yz) = (xz - dx * xx - dy * xy, yz - dx * xy - dy * yy);
    // Few lists in a row have no slope across it.
    let (xx, yy) = (xx + SLOPE_DAMPING * w, yy + SLOPE_DAMPING * w);
    let per_determinant = 1.0 / (xx * yy - xy * xy);
    let dx = dx + (xz * yy - yz * xy) * per_determinant;
    let dy = dy + (yz * xx - xz * xy) * per_determinant;
    DepthPlane { z: mz - dx * mx - dy * my, dx, dy }
}

/// An end of a segment that is cut off by a layer's border stays if it is shorter than this share of the segment.
const SNAP: f32 = 0.1;
/// A larger share of a segment is the whole.
const WHOLE: f32 = 0.999;
/// Square of the distance, in lists, over which slopes are held back.
const SLOPE_DAMPING: f32 = 0.5;
