//! The matter of lists put into layers.

use glam::Vec3;

use super::lists::{BlockLists, Piece};
use super::merge::move_of_union;
use super::{BLOCK_LISTS, Column, KAPPA_FLOOR, greater, power_5_4, select, sum};
use crate::codec::blocks::model::{BLOCK, BlockLayer, DepthPlane};
use crate::kernels::raycast::opacity;
use crate::layer::TAU_MAX;

/// What is known of layers beside what they say themselves.
#[derive(Clone, Debug, Default)]
pub(super) struct Assigned {
    cells: Vec<Cells>,
    joints: Joints,
    /// Error by joining pieces.
    joined: f32,
}

/// What the lists have in a layer.
#[derive(Clone, Copy, Debug)]
struct Cells {
    front: Column,
    back: Column,
    alpha: Column,
    /// Where the layer ends.
    end: Column,
}

/// Pieces that are joined with what a list has in their layer, to be weighed all at once.
#[derive(Clone, Debug)]
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
const NO_CELLS: Cells = Cells { front: ZERO, back: ZERO, alpha: ZERO, end: [f32::INFINITY; BLOCK_LISTS] };

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
    /// Puts every segment into the layers; a layer ends half way between its back plane and the front plane of the next.
    #[inline(always)]
    pub(super) fn assign(
        &mut self,
        lists: &BlockLists,
        planes: &[(DepthPlane, DepthPlane)],
        out: &mut Vec<BlockLayer>,
    ) {
        out.clear();
        out.extend(planes.iter().map(|&(front, back)| BlockLayer { front, back, ..BlockLayer::default() }));
        self.cells.clear();
        self.cells.resize(planes.len(), NO_CELLS);
        for (cells, pair) in self.cells.iter_mut().zip(planes.windows(2)) {
            for (i, end) in cells.end.iter_mut().enumerate() {
                *end = 0.5 * (pair[0].1.at(i) + pair[1].0.at(i));
            }
        }
        self.joined = 0.0;
        if planes.is_empty() {
            return;
        }
        for i in 0..BLOCK_LISTS {
            let mut layer = 0;
            let mut end = self.cells[0].end[i];
            for piece in lists.list(i) {
                let short = SNAP * (piece.back - piece.front);
                let mut from = piece.front;
                loop {
                    // An end of a segment that is short beside it stays with the rest.
                    while end < from || end - piece.front < short {
                        layer += 1;
                        end = self.cells[layer].end[i];
                    }
                    let to = if piece.back - end < short { piece.back } else { end };
                    if to > from {
                        self.put(layer, &mut out[layer], i, piece, from..to, lists.slope[i]);
                    }
                    if to >= piece.back {
                        break;
                    }
                    from = to;
                    layer += 1;
                    end = self.cells[layer].end[i];
                }
            }
        }
        self.joined += self.joints.weigh();
    }

    /// Puts a part of a segment behind what list `i` has in the layer.
    #[inline(always)]
    fn put(
        &mut self,
        number: usize,
        layer: &mut BlockLayer,
        i: usize,
        piece: &Piece,
        part: std::ops::Range<f32>,
        slope: f32,
    ) {
        let cells = &mut self.cells[number];
        let mut c = Vec3::from_array(piece.c);
        let (mut tau, mut alpha) = (piece.tau, piece.alpha);
        let share = (part.end - part.start) / (piece.back - piece.front);
        if share < WHOLE {
            tau *= share;
            alpha = opacity(tau);
            c *= alpha / piece.alpha;
        }
        if layer.mask >> i & 1 == 0 {
            layer.mask |= 1 << i;
            (layer.tau[i], layer.c[i]) = (tau, c);
            (cells.front[i], cells.back[i], cells.alpha[i]) = (part.start, part.end, alpha);
            return;
        }
        let alpha_first = cells.alpha[i];
        let alpha_both = alpha_first + (1.0 - alpha_first) * alpha;
        let first = layer.c[i];
        let both = first + c * (1.0 - alpha_first);
        layer.tau[i] = (layer.tau[i] + tau).min(TAU_MAX);
        layer.c[i] = both;

        let joints = &mut self.joints;
        let at = joints.num % BLOCK_LISTS;
        joints.ends[0][at] = cells.front[i];
        joints.ends[1][at] = cells.back[i];
        joints.ends[2][at] = part.start;
        joints.ends[3][at] = part.end;
        joints.tau[at] = layer.tau[i];
        joints.alphas[0][at] = alpha_first;
        joints.alphas[1][at] = alpha_both;
        for n in 0..3 {
            joints.first[n][at] = first[n];
            joints.both[n][at] = both[n];
        }
        joints.weight[at] = greater(piece.before.kappa, KAPPA_FLOOR) * slope;
        joints.num = at + 1;
        cells.back[i] = part.end;
        cells.alpha[i] = alpha_both;
        if at + 1 == BLOCK_LISTS {
            self.joined += joints.weigh();
        }
    }

    /// Gives each layer the planes that suit what it has, with slopes near `slopes`, and drops those that have nothing.
    #[inline(always)]
    pub(super) fn fit(&mut self, slopes: [f32; 2], out: &mut Vec<BlockLayer>) {
        let mut kept = 0;
        let mut kappa = [1.0; BLOCK_LISTS];
        for index in 0..out.len() {
            if out[index].mask == 0 {
                continue;
            }
            let cells = self.cells[index];
            let weights = weights(&cells, &kappa, &out[index]);
            out[index].front = fitted(&weights, &cells.front, slopes);
            out[index].back = fitted(&weights, &cells.back, slopes);
            for (kappa, alpha) in kappa.iter_mut().zip(&cells.alpha) {
                *kappa *= 1.0 - alpha;
            }
            out.swap(kept, index);
            self.cells[kept] = cells;
            kept += 1;
        }
        out.truncate(kept);
        self.cells.truncate(kept);
    }

    /// How far matter has moved: by being joined, and to the planes of its layer.
    #[inline(always)]
    pub(super) fn error(&self, lists: &BlockLists, out: &[BlockLayer]) -> f32 {
        let mut error = self.joined;
        let mut kappa = [1.0; BLOCK_LISTS];
        for (cells, layer) in self.cells.iter().zip(out) {
            let [moved] = sum(BLOCK_LISTS, |i| {
                let d = (cells.front[i] - layer.front.at(i)).abs()
                    + 0.5 * (cells.back[i] - layer.back.at(i)).abs();
                let seen = select(kappa[i] > KAPPA_FLOOR, kappa[i], KAPPA_FLOOR) * lists.slope[i];
                // Where a list has nothing, its opacity is 0.
                [cells.alpha[i] * seen * power_5_4(d)]
            });
            error += moved;
            for (kappa, alpha) in kappa.iter_mut().zip(&cells.alpha) {
                *kappa *= 1.0 - alpha;
            }
        }
        error
    }
}

/// How much the ends of each list are worth to a plane.
#[inline(always)]
fn weights(cells: &Cells, kappa: &Column, layer: &BlockLayer) -> Column {
    let mut weights = [0.0; BLOCK_LISTS];
    for i in 0..BLOCK_LISTS {
        // The small addend lets a list that is all but clear have a say where no other has.
        let weight = (cells.alpha[i] + 1e-3) * kappa[i].max(KAPPA_FLOOR);
        weights[i] = select(layer.mask >> i & 1 == 1, weight, 0.0);
    }
    weights
}

/// The plane through depths `z` with least squared distance, its slopes held back to these.
#[inline(always)]
fn fitted(weights: &Column, z: &Column, [dx, dy]: [f32; 2]) -> DepthPlane {
    let middle = (BLOCK as f32 - 1.0) / 2.0;
    let [w, wx, wy, wz] = sum(BLOCK_LISTS, |i| {
        let (x, y) = ((i % BLOCK) as f32 - middle, (i / BLOCK) as f32 - middle);
        let w = weights[i];
        [w, w * x, w * y, w * z[i]]
    });
    let (mx, my, mz) = (wx / w, wy / w, wz / w);
    let [xx, xy, yy, xz, yz] = sum(BLOCK_LISTS, |i| {
        let (x, y) = ((i % BLOCK) as f32 - middle - mx, (i / BLOCK) as f32 - middle - my);
        let w = weights[i];
        let z = z[i] - mz;
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
