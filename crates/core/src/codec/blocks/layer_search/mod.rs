//! Finds the layers that the lists of a block share.
//!
//! [`LayerSearch::find`] starts from candidate cuts through a block, parallel to its first surface. It drops the cuts
//! whose loss moves matter least, until the next would move too much. [`LayerSearch::fit`] moves the layers of a
//! similar block to where they fit. [`LayerSearch::assign`] puts the lists' matter into given layers. Matter is
//! conserved: the parts of a list in its layers composite to the same as the list.
//!
//! A move counts where it is visible, as (opacity or colour) × depth units^(5/4). Joined parts of a list become one
//! homogeneous medium, whose collected colour and opacity differ along the way. A layer has one front and one back
//! plane, from which the ends of its lists differ. The power 5/4 makes one long move cost more than many short ones.
//! One list in four is enough to choose cuts where all have matter.
//!
//! Only an encoder runs this, so results may differ between machines. Loops over 16 or 64 lists become vector
//! instructions.

mod assign;
mod cuts;
mod lists;
mod moved;
#[cfg(test)]
pub(super) mod tests;

use super::model::{BLOCK, BLOCK_LISTS, BlockLayer, MAX_LAYERS, PlaneFit};
use super::steps::LayerCost;
use assign::Assigned;
use cuts::CutSearch;
pub(super) use lists::BlockLists;
use lists::ListWalk;

/// Scratch memory to find layers with; one for each thread.
#[derive(Clone, Debug, Default)]
pub(super) struct LayerSearch {
    walk: ListWalk,
    merge: CutSearch,
    assigned: Assigned,
}

wide! {
    fn find(search: &mut LayerSearch, lists: &BlockLists, cost: &LayerCost, out: &mut Vec<(PlaneFit, PlaneFit)>)
        = LayerSearch::find_any;
}

wide! {
    fn fit(search: &mut LayerSearch, lists: &BlockLists, planes: &mut Vec<(PlaneFit, PlaneFit)>)
        = LayerSearch::fit_any;
}

wide! {
    fn assign(
        search: &mut LayerSearch,
        lists: &BlockLists,
        planes: &[(PlaneFit, PlaneFit)],
        out: &mut Vec<BlockLayer>,
    ) = LayerSearch::assign_any;
}

wide! {
    fn error(search: &mut LayerSearch, lists: &BlockLists, planes: &[(PlaneFit, PlaneFit)], limit: f32) -> f32
        = LayerSearch::error_any;
}

impl LayerSearch {
    /// Front and back planes of layers that suit the lists, at most [`MAX_LAYERS`] and at least one if there is matter, in
    /// the order of their depth, into `out`.
    pub(super) fn find(&mut self, lists: &BlockLists, cost: &LayerCost, out: &mut Vec<(PlaneFit, PlaneFit)>) {
        find(self, lists, cost, out);
    }

    /// Moves planes of layers to what lies in them, and drops layers without matter in the lists that are looked at. Costs
    /// a fraction of [`LayerSearch::find`], and finds as good planes where these suited lists much like these.
    pub(super) fn fit(&mut self, lists: &BlockLists, planes: &mut Vec<(PlaneFit, PlaneFit)>) {
        fit(self, lists, planes);
    }

    /// Puts the lists' matter between given pairs of front and back planes, in the order of their depth, into `out`: a
    /// layer for each pair, whether it has matter or not. What lies between two layers goes to the nearer.
    pub(super) fn assign(
        &mut self,
        lists: &BlockLists,
        planes: &[(PlaneFit, PlaneFit)],
        out: &mut Vec<BlockLayer>,
    ) {
        assign(self, lists, planes, out);
    }

    /// About the error of [`LayerSearch::assign`], from some of the lists: how far matter has moved, times how much of it is seen.
    /// Infinite as soon as it is above `limit`.
    pub(super) fn error(&mut self, lists: &BlockLists, planes: &[(PlaneFit, PlaneFit)], limit: f32) -> f32 {
        error(self, lists, planes, limit)
    }

    #[inline(always)]
    fn find_any(&mut self, lists: &BlockLists, cost: &LayerCost, out: &mut Vec<(PlaneFit, PlaneFit)>) {
        out.clear();
        if lists.is_empty() {
            return;
        }
        let slopes = cuts::slopes(lists);
        let plane = |z| PlaneFit { z, dx: slopes[0], dy: slopes[1] };
        for (i, shear) in self.walk.shear.iter_mut().enumerate() {
            *shear = plane(0.0).at(lists.sampled(i));
        }
        let cuts = self.merge.cuts(&mut self.walk, lists, cost);
        for (i, &cut) in cuts.iter().enumerate() {
            out.push((plane(cut), plane(cuts.get(i + 1).copied().unwrap_or(cut))));
        }
        self.fit_near(slopes, lists, out);
    }

    #[inline(always)]
    fn fit_any(&mut self, lists: &BlockLists, planes: &mut Vec<(PlaneFit, PlaneFit)>) {
        if !planes.is_empty() {
            self.fit_near(cuts::slopes(lists), lists, planes);
        }
    }

    #[inline(always)]
    fn fit_near(&mut self, slopes: [f32; 2], lists: &BlockLists, planes: &mut Vec<(PlaneFit, PlaneFit)>) {
        self.assigned.put_all::<false>(&mut self.walk, lists, planes, lists);
        self.assigned.fit(slopes, planes, lists);
    }

    #[inline(always)]
    fn assign_any(&mut self, lists: &BlockLists, planes: &[(PlaneFit, PlaneFit)], out: &mut Vec<BlockLayer>) {
        self.assigned.put_all::<true>(&mut self.walk, lists, planes, &AllLists);
        self.assigned.layers(planes, out);
    }

    #[inline(always)]
    fn error_any(&mut self, lists: &BlockLists, planes: &[(PlaneFit, PlaneFit)], limit: f32) -> f32 {
        // No error is less than 0.
        if planes.is_empty() || limit < 0.0 {
            return f32::INFINITY;
        }
        moved::moved(&mut self.walk, lists, planes, lists, lists.per_sample(), limit)
    }
}

/// Which lists are worked on.
trait ListSubset {
    /// How many.
    fn num(&self) -> usize;

    /// The list that is number `slot` of them.
    fn list(&self, slot: usize) -> usize;
}

/// All lists of a block.
struct AllLists;

impl ListSubset for AllLists {
    #[inline(always)]
    fn num(&self) -> usize {
        BLOCK_LISTS
    }

    #[inline(always)]
    fn list(&self, slot: usize) -> usize {
        slot
    }
}

/// The sampled ones.
impl ListSubset for BlockLists {
    #[inline(always)]
    fn num(&self) -> usize {
        SAMPLES
    }

    #[inline(always)]
    fn list(&self, slot: usize) -> usize {
        self.sampled(slot % SAMPLES)
    }
}

/// A number for each list of a block.
type Column = [f32; BLOCK_LISTS];

/// A number for each list that is looked at where not all are.
type SampleColumn = [f32; SAMPLES];

/// Sums over so many lists, a multiple of [`LANES`].
#[inline(always)]
#[expect(clippy::needless_range_loop, reason = "two loops over both indices of one array")]
fn sum<const N: usize>(num: usize, f: impl Fn(usize) -> [f32; N]) -> [f32; N] {
    // Additions are not reordered by the compiler, so the lanes are written out.
    let mut lanes = [[0.0; LANES]; N];
    for start in (0..num).step_by(LANES) {
        for lane in 0..LANES {
            let terms = f(start + lane);
            for n in 0..N {
                lanes[n][lane] += terms[n];
            }
        }
    }
    let mut sums = [0.0; N];
    for n in 0..N {
        sums[n] = folded(&lanes[n]);
    }
    sums
}

/// The sum of all lanes. Each half is written out: as a loop over halves it would go by way of memory, several times
/// slower.
#[inline(always)]
fn folded(lanes: &[f32; LANES]) -> f32 {
    let (mut eight, mut four) = ([0.0; LANES / 2], [0.0; LANES / 4]);
    for i in 0..LANES / 2 {
        eight[i] = lanes[i] + lanes[i + LANES / 2];
    }
    for i in 0..LANES / 4 {
        four[i] = eight[i] + eight[i + LANES / 4];
    }
    (four[0] + four[2]) + (four[1] + four[3])
}

#[inline(always)]
fn select(condition: bool, yes: f32, no: f32) -> f32 {
    if condition { yes } else { no }
}

/// As the machine has it: without a thought for NaN.
#[inline(always)]
fn greater(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// The same.
#[inline(always)]
fn lesser(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

/// x^(5/4) for x ≥ 0.
#[inline(always)]
fn power_5_4(x: f32) -> f32 {
    x * fourth_root(x)
}

/// x^¼ for x ≥ 0, to 4 %: a quarter of the exponent, and of the mantissa as if it were the logarithm's fraction.
#[inline(always)]
fn fourth_root(x: f32) -> f32 {
    f32::from_bits((x.to_bits() >> 2) + FOURTH_ROOT_BIAS)
}

const LANES: usize = 16;
const SAMPLES: usize = BLOCK_LISTS / 4;
/// Three quarters of the bits of 1, less what makes the error alike to both sides.
const FOURTH_ROOT_BIAS: u32 = 0x2fa0_0000 - 0x0005_0000;
/// Least visibility in errors: what is hidden here is seen from another pose.
const KAPPA_FLOOR: f32 = 0.3;
const _: () = assert!(SAMPLES == LANES && BLOCK_LISTS.is_multiple_of(LANES) && BLOCK * BLOCK == BLOCK_LISTS);
