//! The matter of lists put into layers.

use glam::Vec3;

use super::lists::{BlockLists, Piece};
use super::merge::move_of_union;
use super::{BLOCK_LISTS, Column, KAPPA_FLOOR, power_5_4, select, sum};
use crate::codec::blocks::model::{BLOCK, BlockLayer, DepthPlane};
use crate::kernels::raycast::opacity;
use crate::layer::TAU_MAX;

/// What is known of layers beside what they say themselves.
#[derive(Clone, Debug, Default)]
pub(super) struct Assigned {
    cells: Vec<Cells>,
    /// Error by joining pieces.
    joined: f32,
}

/// What the lists have in a layer.
#[derive(Clone, Copy, Debug)]
struct Cells {
    front: Column,
    back: Column,
    alpha: Column,
}

const NO_CELLS: Cells =
    Cells { front: [0.0; BLOCK_LISTS], back: [0.0; BLOCK_LISTS], alpha: [0.0; BLOCK_LISTS] };

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
        self.joined = 0.0;
        if planes.is_empty() {
            return;
        }
        for i in 0..BLOCK_LISTS {
            let end_of = |layer: usize| match planes.get(layer + 1) {
                Some((next_front, _)) => 0.5 * (planes[layer].1.at(i) + next_front.at(i)),
                None => f32::INFINITY,
            };
            let mut layer = 0;
            let mut end = end_of(0);
            for piece in lists.list(i) {
                let short = SNAP * (piece.back - piece.front);
                let mut from = piece.front;
                loop {
                    // An end of a segment that is short beside it stays with the rest.
                    while end < from || end - piece.front < short {
                        layer += 1;
                        end = end_of(layer);
                    }
                    let to = if piece.back - end < short { piece.back } else { end };
                    if to > from {
                        self.joined +=
                            put(&mut self.cells[layer], &mut out[layer], lists, i, piece, from..to);
                    }
                    if to >= piece.back {
                        break;
                    }
                    from = to;
                    layer += 1;
                    end = end_of(layer);
                }
            }
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
            let [moved] = sum(|i| {
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

/// Puts a part of a segment behind what the list has in the layer; returns the error.
#[inline(always)]
fn put(
    cells: &mut Cells,
    layer: &mut BlockLayer,
    lists: &BlockLists,
    i: usize,
    piece: &Piece,
    part: std::ops::Range<f32>,
) -> f32 {
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
        return 0.0;
    }
    let ends = [cells.front[i], cells.back[i], part.start, part.end];
    let first = layer.c[i];
    layer.c[i] += c * (1.0 - cells.alpha[i]);
    layer.tau[i] = (layer.tau[i] + tau).min(TAU_MAX);
    let color = [0, 1, 2].map(|n| (first[n], layer.c[i][n]));
    let moved = move_of_union(ends, layer.tau[i], cells.alpha[i], color);
    cells.back[i] = part.end;
    cells.alpha[i] = opacity(layer.tau[i]);
    moved * piece.before[3].max(KAPPA_FLOOR) * lists.slope[i]
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
    let [w, wx, wy, wz] = sum(|i| {
        let (x, y) = ((i % BLOCK) as f32 - middle, (i / BLOCK) as f32 - middle);
        let w = weights[i];
        [w, w * x, w * y, w * z[i]]
    });
    let (mx, my, mz) = (wx / w, wy / w, wz / w);
    let [xx, xy, yy, xz, yz] = sum(|i| {
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
