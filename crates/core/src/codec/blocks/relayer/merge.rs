//! The cuts of a block: many candidates, of which the least needed are dropped.

use super::lists::{BlockLists, Collected, Walk};
use super::{BLOCK, BLOCK_LISTS, Column, KAPPA_FLOOR, MAX_LAYERS, Rule, power_5_4, select, sum};
use crate::codec::blocks::model::DepthPlane;
use crate::kernels::raycast::opacity;

/// Scratch memory of the search for cuts.
#[derive(Clone, Debug, Default)]
pub(super) struct Merge {
    /// Depths of all ends of segments, sheared.
    ends: Vec<f32>,
    /// Candidate cuts, sheared, and what is collected up to them.
    cuts: Vec<f32>,
    rows: Vec<Collected>,
    /// Groups: those between two cuts with matter in them, that are still apart.
    groups: Vec<Group>,
    /// The fronts of the groups that are left.
    fronts: Vec<f32>,
}

/// What lies between the cuts numbered `from` and `to`.
#[derive(Clone, Copy, Debug)]
struct Group {
    from: usize,
    to: usize,
    /// Error of its flat ends.
    misfit: f32,
    /// Error that a union with the next group would add.
    cost: f32,
}

/// Growth of depth rightwards and downwards: the median difference between neighbours in the depth of their most
/// visible segments.
pub(super) fn slopes(lists: &BlockLists) -> [f32; 2] {
    let mut depth = [f32::NAN; BLOCK_LISTS];
    for (i, depth) in depth.iter_mut().enumerate() {
        let mut most = 0.0;
        for piece in lists.list(i) {
            let visible = piece.before[3] * piece.alpha;
            if visible > most {
                most = visible;
                *depth = piece.front;
            }
        }
    }
    [1, BLOCK].map(|step| {
        let mut differences = [0.0; BLOCK_LISTS];
        let mut num = 0;
        for i in 0..BLOCK_LISTS {
            let has_neighbor = if step == 1 { i % BLOCK + 1 < BLOCK } else { i + BLOCK < BLOCK_LISTS };
            if has_neighbor && (depth[i + step] - depth[i]).is_finite() {
                differences[num] = depth[i + step] - depth[i];
                num += 1;
            }
        }
        if num < MIN_DIFFERENCES {
            return 0.0;
        }
        *differences[..num].select_nth_unstable_by(num / 2, f32::total_cmp).1
    })
}

impl Merge {
    /// Depths where layers begin, along planes with these slopes.
    #[inline(always)]
    pub(super) fn cuts(
        &mut self,
        walk: &mut Walk,
        lists: &BlockLists,
        rule: &Rule,
        slopes: [f32; 2],
    ) -> &[f32] {
        let [dx, dy] = slopes;
        let mut shear = [0.0; BLOCK_LISTS];
        for (i, shear) in shear.iter_mut().enumerate() {
            *shear = DepthPlane { z: 0.0, dx, dy }.at(i);
        }
        self.candidates(lists, &shear);
        self.collect(walk, lists, &shear);
        self.groups.clear();
        for to in 1..self.cuts.len() {
            let mut group = Group { from: to - 1, to, misfit: 0.0, cost: f32::INFINITY };
            let (front, back) = (&self.rows[group.from], &self.rows[group.to]);
            if sum(|i| [select(front.next[i] < back.last[i], 1.0, 0.0)])[0] > 0.0 {
                group.misfit = misfit(front, back, lists, &shear);
                self.groups.push(group);
            }
        }
        for i in 1..self.groups.len() {
            self.groups[i - 1].cost = self.cost(i - 1, lists, &shear);
        }
        let limit = rule.error_per_layer();
        while self.groups.len() > 1 {
            let mut cheapest = 0;
            for (i, group) in self.groups.iter().enumerate() {
                if group.cost < self.groups[cheapest].cost {
                    cheapest = i;
                }
            }
            if self.groups[cheapest].cost > limit && self.groups.len() <= MAX_LAYERS {
                break;
            }
            let next = self.groups.remove(cheapest + 1);
            let group = &mut self.groups[cheapest];
            group.to = next.to;
            group.cost = f32::INFINITY;
            let (front, back) = (&self.rows[group.from], &self.rows[group.to]);
            group.misfit = misfit(front, back, lists, &shear);
            if cheapest > 0 {
                self.groups[cheapest - 1].cost = self.cost(cheapest - 1, lists, &shear);
            }
            if cheapest + 1 < self.groups.len() {
                self.groups[cheapest].cost = self.cost(cheapest, lists, &shear);
            }
        }
        self.fronts.clear();
        self.fronts.extend(self.groups.iter().map(|group| self.cuts[group.from]));
        &self.fronts
    }

    /// Candidate cuts: quantiles of the ends of segments.
    fn candidates(&mut self, lists: &BlockLists, shear: &Column) {
        self.ends.clear();
        for (i, shear) in shear.iter().enumerate() {
            for piece in lists.list(i) {
                self.ends.extend([piece.front - shear, piece.back - shear]);
            }
        }
        self.ends.sort_unstable_by(f32::total_cmp);
        let (Some(first), Some(last)) = (self.ends.first(), self.ends.last()) else { return };
        let stride = (self.ends.len() as f32 / CANDIDATES as f32).max(1.0);
        self.cuts.clear();
        self.cuts.push(first - 1.0);
        let mut previous = first - 1.0;
        let mut index = stride;
        while (index as usize) < self.ends.len() {
            // Just behind, so that what ends here is in front of the cut.
            let cut = self.ends[index as usize] + 0.01;
            if cut > previous + MIN_DISTANCE {
                self.cuts.push(cut);
                previous = cut;
            }
            index += stride;
        }
        self.cuts.push(last + 1.0);
    }

    /// Fills in the rows of all cuts.
    #[inline(always)]
    fn collect(&mut self, walk: &mut Walk, lists: &BlockLists, shear: &Column) {
        self.rows.resize(self.cuts.len().max(self.rows.len()), Collected::NOTHING);
        walk.restart(lists);
        for (cut, row) in self.cuts.iter().zip(&mut self.rows) {
            let mut depth = [0.0; BLOCK_LISTS];
            for i in 0..BLOCK_LISTS {
                depth[i] = cut + shear[i];
            }
            walk.go_to(lists, &depth, row);
        }
    }

    /// Error that a union of the group `index` with the next would add.
    #[inline(always)]
    fn cost(&self, index: usize, lists: &BlockLists, shear: &Column) -> f32 {
        let (a, b) = (&self.groups[index], &self.groups[index + 1]);
        let (front, back) = (&self.rows[a.from], &self.rows[b.to]);
        let joined = joined(front, &self.rows[a.to], &self.rows[b.from], back, lists);
        let misfit = misfit(front, back, lists, shear) - a.misfit - b.misfit;
        joined + misfit.max(0.0)
    }
}

/// Weight of an error behind `kappa`.
#[inline(always)]
fn weight(kappa: f32, slope: f32) -> f32 {
    select(kappa > KAPPA_FLOOR, kappa, KAPPA_FLOOR) * slope
}

/// How far the spread of fronts and backs about their means is from flat.
#[inline(always)]
fn misfit(front: &Collected, back: &Collected, lists: &BlockLists, shear: &Column) -> f32 {
    let w = |i: usize| {
        let alpha = opacity(back.tau[i] - front.tau[i]);
        select(front.next[i] < back.last[i], alpha * weight(front.kappa[i], lists.slope[i]), 0.0)
    };
    let [sum_w, sum_front, sum_back] = sum(|i| {
        let w = w(i);
        let is_there = w > 0.0;
        [
            w,
            select(is_there, w * (front.next[i] - shear[i]), 0.0),
            select(is_there, w * (back.last[i] - shear[i]), 0.0),
        ]
    });
    if sum_w <= 0.0 {
        return 0.0;
    }
    let (mean_front, mean_back) = (sum_front / sum_w, sum_back / sum_w);
    sum(|i| {
        let w = w(i);
        let d =
            (front.next[i] - shear[i] - mean_front).abs() + 0.5 * (back.last[i] - shear[i] - mean_back).abs();
        [select(w > 0.0, w * power_5_4(d), 0.0)]
    })[0]
}

/// How far matter moves when what lies between the first two rows becomes one medium with what lies between the last
/// two.
#[inline(always)]
fn joined(
    front: &Collected,
    mid: &Collected,
    mid_next: &Collected,
    back: &Collected,
    lists: &BlockLists,
) -> f32 {
    sum(|i| {
        let ends = [front.next[i], mid.last[i], mid_next.next[i], back.last[i]];
        let in_both = (ends[0] < ends[1]) & (ends[2] < ends[3]);
        let from_kappa = 1.0 / front.kappa[i].max(KAPPA_MIN);
        let color = [0, 1, 2].map(|n| {
            let from = front.c[n][i];
            ((mid.c[n][i] - from) * from_kappa, (back.c[n][i] - from) * from_kappa)
        });
        let alpha = opacity(mid.tau[i] - front.tau[i]);
        let moved = move_of_union(ends, back.tau[i] - front.tau[i], alpha, color);
        [select(in_both, moved * weight(front.kappa[i], lists.slope[i]), 0.0)]
    })[0]
}

/// How far the collected colour or opacity, whichever is more, moves when a piece from `ends[0]` to `ends[1]` and
/// one from `ends[2]` to `ends[3]` become one homogeneous medium of optical depth `tau`: ∫|change| ds, which is linear
/// between the ends, times length^¼. `alpha` is the opacity of the first piece, `color` its colour and that of both.
#[inline(always)]
pub(super) fn move_of_union(ends: [f32; 4], tau: f32, alpha: f32, color: [(f32, f32); 3]) -> f32 {
    let length = ends[3] - ends[0];
    let alpha_whole = opacity(tau);
    let tau_per_unit = tau / length;
    let per_alpha = 1.0 / alpha_whole.max(1e-6);
    let change = |s: f32| {
        let alpha_here = opacity(tau_per_unit * (s - ends[0]));
        let share = alpha_here * per_alpha;
        let mut change = (alpha - alpha_here).abs();
        for (first, both) in color {
            change = change.max((first - both * share).abs());
        }
        change
    };
    let [at_first, at_second] = [change(ends[1]), change(ends[2])];
    0.5 * (at_first * (ends[2] - ends[0]) + at_second * (ends[3] - ends[1])) * length.sqrt().sqrt()
}

/// Candidate cuts of a block.
const CANDIDATES: usize = 128;
/// Least distance of candidate cuts, in depth units: about a sixth of a pixel.
const MIN_DISTANCE: f32 = 20.0;
/// Fewer neighbours than this say nothing about a slope.
const MIN_DIFFERENCES: usize = 4;
/// What is behind less than this transmittance has no part in any picture; divided by.
const KAPPA_MIN: f32 = 1e-4;
