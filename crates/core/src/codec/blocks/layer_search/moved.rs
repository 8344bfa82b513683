//! The error of given layers: how far matter moves when it goes into them.

use super::assign::borders;
use super::cuts::{joined_in_list, weight};
use super::lists::{BlockLists, CollectedLight, ListWalk, PieceObserver};
use super::{ListSubset, PlaneFit, SAMPLES, SampleColumn, power_5_4, select, sum};
use crate::kernels::raycast::opacity;

/// The partings of lists in a layer: a gap, or the border of two pieces. Has what lists collect up to there.
struct Gaps<'a> {
    /// What is collected up to the layer.
    before: &'a CollectedLight,
    slope: &'a SampleColumn,
    /// Mask of the lists with a parting that is not weighed yet.
    mask: u64,
    at: CollectedLight,
    /// How far matter moves by the weighed partings.
    joined: f32,
}

impl<'a> Gaps<'a> {
    #[inline(always)]
    fn new(before: &'a CollectedLight, slope: &'a SampleColumn) -> Self {
        Self { before, slope, mask: 0, at: CollectedLight::NOTHING, joined: 0.0 }
    }

    /// Weighs the partings of these lists and forgets them. The matter in front and that behind, up to `to`, become
    /// one medium.
    #[inline(always)]
    fn weigh(&mut self, lists: u64, to: &CollectedLight) {
        let lists = self.mask & lists;
        if lists == 0 {
            return;
        }
        self.mask &= !lists;
        let mut moved = [0.0; SAMPLES];
        for (i, moved) in moved.iter_mut().enumerate() {
            let joined = joined_in_list([self.before, &self.at, &self.at, to], i);
            let weighted = joined * weight(self.at.kappa[i], self.slope[i]);
            *moved = select(lists >> i & 1 == 1, weighted, 0.0);
        }
        self.joined += sum(SAMPLES, |i| [moved[i]])[0];
    }
}

impl PieceObserver for Gaps<'_> {
    #[inline(always)]
    fn left(&mut self, walk: &ListWalk, lists: u64) {
        let here = walk.at_fronts();
        self.weigh(lists, &here);
        let mut mask = 0;
        for i in 0..SAMPLES {
            mask |= u64::from(walk.begins(i)) << i;
        }
        mask &= lists;
        self.mask |= mask;
        let at = &mut self.at;
        for i in 0..SAMPLES {
            let is_noted = mask >> i & 1 == 1;
            at.kappa[i] = select(is_noted, here.kappa[i], at.kappa[i]);
            at.next[i] = select(is_noted, here.next[i], at.next[i]);
            at.last[i] = select(is_noted, here.last[i], at.last[i]);
            for n in 0..3 {
                at.c[n][i] = select(is_noted, here.c[n][i], at.c[n][i]);
            }
        }
    }
}

/// How far the matter of lists moves when it is joined in layers and moved to their planes. Each list has a weight.
/// The result is infinite once it exceeds `limit`.
#[inline(always)]
pub(super) fn moved(
    walk: &mut ListWalk,
    lists: &BlockLists,
    planes: &[(PlaneFit, PlaneFit)],
    of: &impl ListSubset,
    num_each: f32,
    limit: f32,
) -> f32 {
    let mut error = 0.0;
    for first in (0..of.num()).step_by(SAMPLES) {
        let numbers = std::array::from_fn(|i| of.list(first + i));
        let mut before = CollectedLight::NOTHING;
        walk.start_at_borders(lists, &numbers, &mut before);
        let slope = walk.slope;
        for (n, (front, back)) in planes.iter().enumerate() {
            let (mut partings, mut here) = (Gaps::new(&before, &slope), CollectedLight::NOTHING);
            walk.go_to_borders(lists, &borders(planes, n, &numbers), &mut here, &mut partings);
            partings.weigh(u64::MAX, &here);
            error += partings.joined;
            let mut to_planes = [0.0; SAMPLES];
            for (i, to_planes) in to_planes.iter_mut().enumerate() {
                let d = (before.next[i] - front.at(numbers[i])).abs()
                    + 0.5 * (here.last[i] - back.at(numbers[i])).abs();
                let alpha = opacity(here.tau[i] - before.tau[i]);
                let moved = alpha * weight(before.kappa[i], slope[i]) * power_5_4(d);
                *to_planes = select(before.next[i] < here.last[i], moved, 0.0);
            }
            error += sum(SAMPLES, |i| [to_planes[i]])[0];
            if error * num_each > limit {
                return f32::INFINITY;
            }
            before = here;
        }
    }
    error * num_each
}
