//! Chooses where layers begin. Of many candidate depths, it drops those whose loss moves matter least (greedy
//! merging).

use super::lists::{BlockLists, CollectedLight, ListWalk};
use super::{
    BLOCK, BLOCK_LISTS, KAPPA_FLOOR, LayerCost, MAX_LAYERS, SAMPLES, SampleColumn, fourth_root, greater,
    lesser, power_5_4, select, sum,
};
use crate::kernels::raycast::opacity;

/// Scratch memory of the search for cuts.
#[derive(Clone, Debug, Default)]
pub(super) struct CutSearch {
    /// Candidate cuts, sheared, and what lists collect up to them.
    cuts: Vec<f32>,
    rows: Vec<CollectedLight>,
    /// Groups: the ranges between two cuts that have matter and are still separate.
    groups: Vec<Group>,
    /// Error that a union with the next group would add; infinite for the last group.
    costs: Vec<f32>,
    /// Fronts of the remaining groups.
    fronts: Vec<f32>,
}

/// The matter between the cuts with indices `from` and `to`.
#[derive(Clone, Copy, Debug)]
struct Group {
    from: usize,
    to: usize,
    /// Error of its flat ends.
    misfit: f32,
    /// Error of the flat ends of a union with the next group.
    misfit_of_union: f32,
    /// Whether one of the two has grown since then.
    is_stale: bool,
}

/// Ends of segments in a bin of depth.
#[derive(Clone, Copy, Debug)]
struct Bin {
    num: u32,
    /// The deepest of them.
    last: f32,
}

/// Growth of depth rightwards and downwards: the median difference of neighbouring lists in the depth of their most
/// visible segments.
pub(super) fn slopes(lists: &BlockLists) -> [f32; 2] {
    let depth = &lists.depth;
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

impl CutSearch {
    /// Depths at which layers begin, along planes with the slopes of the walk's shear.
    #[inline(always)]
    pub(super) fn cuts(&mut self, walk: &mut ListWalk, lists: &BlockLists, cost: &LayerCost) -> &[f32] {
        self.candidates(lists, &walk.shear);
        self.collect(walk, lists);
        self.groups.clear();
        for to in 1..self.cuts.len() {
            let mut group = Group { from: to - 1, to, ..Group::ALONE };
            let (front, back) = (&self.rows[group.from], &self.rows[group.to]);
            if sum(SAMPLES, |i| [select(front.next[i] < back.last[i], 1.0, 0.0)])[0] > 0.0 {
                group.misfit = misfit(front, back, &walk.slope);
                self.groups.push(group);
            }
        }
        self.costs.clear();
        self.costs.resize(self.groups.len(), f32::INFINITY);
        for i in 1..self.groups.len() {
            self.weigh(i - 1, &walk.slope);
        }
        let limit = cost.error_per_layer() / lists.per_sample();
        while self.groups.len() > 1 {
            let least = least(&self.costs);
            // A union with a group that has grown seldom costs less than before. So its cost is updated when its turn
            // comes, or when the search would end.
            let is_dear = least > limit && self.groups.len() <= MAX_LAYERS;
            let bound = if is_dear { f32::INFINITY } else { greater(least, lesser(RISE * least, limit)) };
            let num_groups = self.groups.len();
            let mut num_weighed = 0;
            for i in 0..num_groups - 1 {
                if self.groups[i].is_stale && self.costs[i] <= bound {
                    self.weigh(i, &walk.slope);
                    num_weighed += 1;
                }
            }
            if !is_dear {
                self.join(bound);
            }
            // A cost that is not a number ends the search, too.
            if num_weighed == 0 && self.groups.len() == num_groups {
                break;
            }
        }
        self.fronts.clear();
        self.fronts.extend(self.groups.iter().map(|group| self.cuts[group.from]));
        &self.fronts
    }

    /// Candidate cuts: they lie behind quantiles of the ends of segments, to the accuracy of a bin.
    #[inline(always)]
    fn candidates(&mut self, lists: &BlockLists, shear: &SampleColumn) {
        let (mut lo, mut hi) = (f32::INFINITY, f32::NEG_INFINITY);
        for (i, shear) in shear.iter().enumerate() {
            if let [first, ..] = lists.list(lists.sampled(i)) {
                lo = lo.min(first.front - shear);
            }
            if let [.., last] = lists.list(lists.sampled(i)) {
                hi = hi.max(last.back - shear);
            }
        }
        // The deepest end lies in the last bin.
        let bins_per_unit = (BINS as f32 - 0.01) / (hi - lo);
        let mut bins = [Bin { num: 0, last: f32::NEG_INFINITY }; BINS];
        let mut total = 0;
        for (i, shear) in shear.iter().enumerate() {
            for piece in lists.list(lists.sampled(i)) {
                for end in [piece.front - shear, piece.back - shear] {
                    let bin = &mut bins[((end - lo) * bins_per_unit) as usize % BINS];
                    bin.num += 1;
                    bin.last = greater(end, bin.last);
                }
                total += 2;
            }
        }
        let num = (total / ENDS_PER_CANDIDATE).clamp(MIN_CANDIDATES, MAX_CANDIDATES);
        let stride = total as f32 / num as f32;
        self.cuts.clear();
        self.cuts.push(lo - 1.0);
        let (mut previous, mut sum, mut next) = (lo - 1.0, 0, stride);
        for bin in &bins {
            sum += bin.num;
            if sum as f32 >= next {
                // Just behind, so that a segment with this end is in front of the cut.
                let cut = bin.last + 0.01;
                if cut > previous + MIN_DISTANCE {
                    self.cuts.push(cut);
                    previous = cut;
                }
                next = sum as f32 + stride;
            }
        }
        self.cuts.push(hi + 1.0);
    }

    /// Fills in the walk's values at all cuts.
    #[inline(always)]
    fn collect(&mut self, walk: &mut ListWalk, lists: &BlockLists) {
        self.rows.resize(self.cuts.len().max(self.rows.len()), CollectedLight::NOTHING);
        walk.start(lists, &std::array::from_fn(|i| lists.sampled(i)));
        for (cut, row) in self.cuts.iter().zip(&mut self.rows) {
            walk.go_to(lists, *cut, row);
        }
    }

    /// Joins two groups if their union costs at most `bound`, and at most as much as that of the second with the
    /// next. No group is joined twice.
    #[inline(always)]
    fn join(&mut self, bound: f32) {
        let (mut from, mut to) = (0, 0);
        while from < self.groups.len() {
            let mut group = self.groups[from];
            let mut cost = self.costs[from];
            from += 1;
            let behind = self.costs.get(from).copied().unwrap_or(f32::INFINITY);
            if cost <= bound
                && cost <= behind
                && let Some(&next) = self.groups.get(from)
            {
                cost = behind;
                // The last group has no next one.
                let (is_stale, first, misfit) = (cost.is_finite(), group.from, group.misfit_of_union);
                group = Group { from: first, misfit, is_stale, ..next };
                if to > 0 {
                    self.groups[to - 1].is_stale = true;
                }
                from += 1;
            }
            (self.groups[to], self.costs[to]) = (group, cost);
            to += 1;
        }
        self.groups.truncate(to);
        self.costs.truncate(to);
    }

    /// Fills in the cost of a union of the group `index` with the next.
    #[inline(always)]
    fn weigh(&mut self, index: usize, slope: &SampleColumn) {
        let (a, b) = (self.groups[index], self.groups[index + 1]);
        let rows = [a.from, a.to, b.from, b.to].map(|row| &self.rows[row]);
        let misfit_of_union = misfit(rows[0], rows[3], slope);
        let cost = joined(rows, slope) + (misfit_of_union - a.misfit - b.misfit).max(0.0);
        self.groups[index] = Group { misfit_of_union, is_stale: false, ..a };
        self.costs[index] = cost;
    }
}

/// The least of the numbers.
#[inline(always)]
fn least(costs: &[f32]) -> f32 {
    let mut lanes = [f32::INFINITY; LEAST_LANES];
    let (whole, rest) = costs.as_chunks::<LEAST_LANES>();
    for costs in whole {
        for (lane, cost) in lanes.iter_mut().zip(costs) {
            *lane = lesser(*cost, *lane);
        }
    }
    for (lane, cost) in lanes.iter_mut().zip(rest) {
        *lane = lesser(*cost, *lane);
    }
    lanes.into_iter().fold(f32::INFINITY, lesser)
}

impl Group {
    const ALONE: Self = Self { from: 0, to: 0, misfit: 0.0, misfit_of_union: 0.0, is_stale: false };
}

/// Weight of an error behind the transmittance `kappa`.
#[inline(always)]
pub(super) fn weight(kappa: f32, slope: f32) -> f32 {
    select(kappa > KAPPA_FLOOR, kappa, KAPPA_FLOOR) * slope
}

/// The spread of fronts and backs about their means.
#[inline(always)]
fn misfit(front: &CollectedLight, back: &CollectedLight, slope: &SampleColumn) -> f32 {
    let mut w = [0.0; SAMPLES];
    for (i, w) in w.iter_mut().enumerate() {
        let alpha = 1.0 - back.kappa[i] * front.per_kappa[i];
        let is_there = front.next[i] < back.last[i];
        *w = select(is_there, alpha * weight(front.kappa[i], slope[i]), 0.0);
    }
    let [sum_w, sum_front, sum_back] = sum(SAMPLES, |i| {
        let is_there = w[i] > 0.0;
        [w[i], select(is_there, w[i] * front.next[i], 0.0), select(is_there, w[i] * back.last[i], 0.0)]
    });
    if sum_w <= 0.0 {
        return 0.0;
    }
    let (mean_front, mean_back) = (sum_front / sum_w, sum_back / sum_w);
    sum(SAMPLES, |i| {
        let d = (front.next[i] - mean_front).abs() + 0.5 * (back.last[i] - mean_back).abs();
        [select(w[i] > 0.0, w[i] * power_5_4(d), 0.0)]
    })[0]
}

/// How far matter moves when the matter between the first two rows and that between the last two become one medium.
#[inline(always)]
fn joined(rows: [&CollectedLight; 4], slope: &SampleColumn) -> f32 {
    let mut moved = [0.0; SAMPLES];
    for (i, moved) in moved.iter_mut().enumerate() {
        *moved = joined_in_list(rows, i) * weight(rows[0].kappa[i], slope[i]);
    }
    sum(SAMPLES, |i| [moved[i]])[0]
}

/// The same for list `i`, without the weight.
#[inline(always)]
pub(super) fn joined_in_list([front, mid, mid_next, back]: [&CollectedLight; 4], i: usize) -> f32 {
    let ends = [front.next[i], mid.last[i], mid_next.next[i], back.last[i]];
    let in_both = (ends[0] < ends[1]) & (ends[2] < ends[3]);
    let per_kappa = front.per_kappa[i];
    // Behind this, the difference of two colours is only rounding noise.
    let per_kappa_color = select(per_kappa < PER_KAPPA_MAX, per_kappa, PER_KAPPA_MAX);
    let (mut first, mut both) = ([0.0; 3], [0.0; 3]);
    for n in 0..3 {
        first[n] = (mid.c[n][i] - front.c[n][i]) * per_kappa_color;
        both[n] = (back.c[n][i] - front.c[n][i]) * per_kappa_color;
    }
    let alpha = 1.0 - mid.kappa[i] * per_kappa;
    let alphas = [alpha, 1.0 - back.kappa[i] * per_kappa];
    let moved = move_of_union(ends, back.tau[i] - front.tau[i], alphas, first, both);
    select(in_both, moved, 0.0)
}

/// How far the collected colour or opacity, whichever is more, moves when two pieces become one homogeneous medium of
/// optical depth `tau`. The pieces go from `ends[0]` to `ends[1]` and from `ends[2]` to `ends[3]`. The result is
/// ∫|change| ds times length^¼, with a change that is linear between the ends. `alphas` are the opacities of the
/// first piece and of both, and `first` and `both` their colours.
#[inline(always)]
fn move_of_union(
    ends: [f32; 4],
    tau: f32,
    [alpha, alpha_of_both]: [f32; 2],
    first: [f32; 3],
    both: [f32; 3],
) -> f32 {
    let length = ends[3] - ends[0];
    let tau_per_unit = tau / length;
    let per_alpha = 1.0 / greater(alpha_of_both, 1e-6);
    let mut changes = [0.0; 2];
    for n in 0..2 {
        let alpha_here = opacity(tau_per_unit * (ends[n + 1] - ends[0]));
        let share = alpha_here * per_alpha;
        let mut change = (alpha - alpha_here).abs();
        for n in 0..3 {
            change = greater(change, (first[n] - both[n] * share).abs());
        }
        changes[n] = change;
    }
    0.5 * (changes[0] * (ends[2] - ends[0]) + changes[1] * (ends[3] - ends[1])) * fourth_root(length)
}

/// Least and greatest number of candidate cuts of a block. Long lists need more, because each of their ends says
/// less. Time is proportional to this number.
const MIN_CANDIDATES: u32 = 64;
const MAX_CANDIDATES: u32 = 128;
/// Between these, there is one candidate for this number of segment ends.
const ENDS_PER_CANDIDATE: u32 = 4;
/// Least distance of candidate cuts, depth units: about a sixth of a pixel.
const MIN_DISTANCE: f32 = 20.0;
/// Fewer neighbours than this say nothing about a slope.
const MIN_DIFFERENCES: usize = 4;
/// Inverse of the least transmittance in front of a colour.
const PER_KAPPA_MAX: f32 = 1e4;
/// Unions that cost up to this multiple of the least are made in one round.
const RISE: f32 = 4.0;
/// Number of lanes in the search for the least number.
const LEAST_LANES: usize = 16;
/// Number of bins of depth for ends of segments.
const BINS: usize = 512;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_is_found_wherever_it_is() {
        for num in 1..70 {
            for place in 0..num {
                let costs: Vec<f32> =
                    (0..num).map(|i| if i == place { 2.0 } else { 3.0 + i as f32 }).collect();
                assert_eq!(least(&costs), 2.0);
            }
        }
        assert_eq!(least(&[]), f32::INFINITY);
    }

    /// If it costs little, but not where the second of them is nearer to the third.
    #[test]
    fn groups_are_joined_in_pairs() {
        let group = |n| Group { from: n, to: n + 1, misfit_of_union: n as f32, ..Group::ALONE };
        let mut merge = CutSearch {
            groups: (0..6).map(group).collect(),
            costs: vec![1.9, 1.0, 5.0, 2.0, 1.0, f32::INFINITY],
            ..CutSearch::default()
        };
        merge.join(2.0);
        let found: Vec<_> = merge.groups.iter().map(|g| (g.from, g.to, g.is_stale)).collect();
        assert_eq!(found, [(0, 1, true), (1, 3, true), (3, 4, true), (4, 6, false)]);
        assert_eq!(merge.costs, [1.9, 5.0, 2.0, f32::INFINITY]);
        let misfits: Vec<_> = merge.groups.iter().map(|g| g.misfit).collect();
        assert_eq!(misfits, [0.0, 1.0, 0.0, 4.0]);
        // With a bound below all, nothing changes.
        merge.join(0.5);
        assert_eq!(merge.costs.len(), 4);
    }
}
