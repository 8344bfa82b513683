//! The matter of a reference between two depth planes, to a quarter of a list. A layer is predicted from it.

use super::model::{BLOCK, BLOCK_LISTS, DepthPlane, SIXTEENTHS, lists_of, quarters_from_middle};
use super::motion::Shift;
use super::reference::Reference;
use super::scales::{Scales, UNIT, behind, scales, seen};
use super::tile::{CellLayer, CellPlanes, NO_CELLS};
use super::transform::BlockNumbers;

/// The reference's matter in a layer.
#[derive(Clone, Debug)]
#[repr(align(64))]
pub(super) struct Fetched {
    /// u, Y, Co, Cg of each list, in quarters of a code and in 1/32768. Lists without matter have the mean.
    pub(super) planes: [BlockNumbers; 4],
    /// Mask of the lists with matter.
    pub(super) mask: u64,
    scratch: Box<FetchScratch>,
}

/// Scratch memory.
#[derive(Clone, Debug)]
struct FetchScratch {
    between: DepthRange,
    contents: Contents,
    spread: CellPlanes,
}

impl Fetched {
    pub(super) fn new() -> Self {
        let scratch =
            FetchScratch { between: DepthRange::NOWHERE, contents: Contents::NOTHING, spread: NO_CELLS };
        Self { planes: [[0; BLOCK_LISTS]; 4], mask: 0, scratch: Box::new(scratch) }
    }
}

wide! {
    /// Fetches what the reference has between two planes of the block at a column and a row, moved by `shift` to a
    /// quarter of a list. Lists are mixed by nearness, and their colours also by opacity. If no list has matter, the
    /// planes stay the same.
    pub(super) fn fetch(
        fetched: &mut Fetched,
        reference: &Reference,
        at: [usize; 2],
        planes: &(DepthPlane, DepthPlane),
        shift: Shift,
        least_length: u16,
    ) = fetch_any;
}

#[inline(always)]
fn fetch_any(
    fetched: &mut Fetched,
    reference: &Reference,
    at: [usize; 2],
    planes: &(DepthPlane, DepthPlane),
    shift: Shift,
    least_length: u16,
) {
    const SIDE: i32 = BLOCK as i32;
    fetched.mask = 0;
    let quarters = [shift.x, shift.y].map(|s| (s + 8) >> 4);
    let part = quarters.map(|q| q & 3);
    let [left, top] = [0, 1].map(|axis| at[axis] as i32 * SIDE + (quarters[axis] >> 2));
    let [columns, rows] = part.map(|p| BLOCK + usize::from(p > 0));
    let (first_x, first_y) = (left.div_euclid(SIDE), top.div_euclid(SIDE));
    let (inner_x, inner_y) = ((left - first_x * SIDE) as usize, (top - first_y * SIDE) as usize);
    let mut found = [[[0; 2 * BLOCK]; BLOCK + 1]; NUM_VALUES];
    let mut has_any = false;
    let FetchScratch { between, contents, spread } = &mut *fetched.scratch;
    for (by, bx) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
        // The relevant rows and columns of the block.
        let [ys, xs] = [(by, inner_y, rows), (bx, inner_x, columns)].map(|(n, inner, num)| {
            let inside = |v: usize| v.saturating_sub(n * BLOCK).min(BLOCK);
            inside(inner)..inside(inner + num)
        });
        let Some((tile, block)) = reference.block(first_x + bx as i32, first_y + by as i32) else { continue };
        let cells = tile.cells_of(block);
        if xs.is_empty() || ys.is_empty() || cells.layers.is_empty() {
            continue;
        }
        between.ys = ys.clone();
        between.xs = xs;
        let from = [(bx, inner_x, part[0]), (by, inner_y, part[1])];
        let query = DepthQuery {
            planes: *planes,
            from: from.map(|(n, inner, part)| 4 * ((n * BLOCK) as i32 - inner as i32) - part),
            shift: shift.z,
            least_length: i32::from(least_length) * SIXTEENTHS,
        };
        look(between, &query);
        contents.clear();
        let mut is_there = false;
        let mut walk = cells.walk(spread);
        while let Some((_, cells)) = walk.next_of(|layer| between.has(layer)) {
            is_there |= add(contents, between, cells);
        }
        if !is_there {
            continue;
        }
        has_any = true;
        contents.finish(between.lists());
        for (found, values) in found.iter_mut().zip(&contents.values) {
            for y in ys.clone() {
                let row = by * BLOCK + y - inner_y;
                found[row][bx * BLOCK..][..BLOCK].copy_from_slice(&values[y * BLOCK..][..BLOCK]);
            }
        }
    }
    if has_any {
        fetched.mix(&found, inner_x, part);
    }
}

/// Opacity, code of u, and Y, Co, Cg times opacity of lists, of which each has up to four neighbours.
type Neighborhood = [[[i32; 2 * BLOCK]; BLOCK + 1]; NUM_VALUES];

impl Fetched {
    /// Mixes four neighbours for each list, the first of which is in column `first`. `part` has quarters of a list.
    #[inline(always)]
    fn mix(&mut self, found: &Neighborhood, first: usize, [fx, fy]: [i32; 2]) {
        let (gx, gy) = (4 - fx, 4 - fy);
        let taps = [(0, 0, gx * gy), (0, 1, fx * gy), (1, 0, gx * fy), (1, 1, fx * fy)];
        let mut sums = [[0; BLOCK_LISTS]; 6];
        // Lists without weight add zeros.
        for (dy, dx, w) in taps.into_iter().filter(|(.., w)| *w > 0) {
            let [weight, sums @ ..] = &mut sums;
            for row in 0..BLOCK {
                let alpha = &found[0][row + dy][first + dx..][..BLOCK];
                // Without matter, all values are zero.
                for (sum, alpha) in weight[row * BLOCK..][..BLOCK].iter_mut().zip(alpha) {
                    *sum += if *alpha > 0 { w } else { 0 };
                }
                for (sums, values) in sums.iter_mut().zip(found) {
                    let values = &values[row + dy][first + dx..][..BLOCK];
                    for (sum, value) in sums[row * BLOCK..][..BLOCK].iter_mut().zip(values) {
                        *sum += w * value;
                    }
                }
            }
        }
        let [weight, alpha, u, ycc @ ..] = &sums;
        let [own_u, own_ycc @ ..] = &mut self.planes;
        let mut is_there = [0u8; BLOCK_LISTS];
        for i in 0..BLOCK_LISTS {
            is_there[i] = u8::from(weight[i] > 8);
            own_u[i] = quotient(4 * u[i] + (weight[i] >> 1), weight[i]);
        }
        for (plane, ycc) in own_ycc.iter_mut().zip(ycc) {
            for ((value, ycc), alpha) in plane.iter_mut().zip(ycc).zip(alpha) {
                // The sum is in units of 8/8192, the value in 1/32768.
                *value = (32.0 * f64::from(*ycc) / f64::from((*alpha).max(1))) as i32;
            }
        }
        self.mask = is_there.iter().enumerate().fold(0, |mask, (i, there)| mask | u64::from(*there) << i);
        if self.mask != 0 && self.mask != u64::MAX {
            let num_lists = self.mask.count_ones() as i32;
            for plane in &mut self.planes {
                let mean = lists_of(self.mask).map(|i| plane[i]).sum::<i32>() / num_lists;
                lists_of(!self.mask).for_each(|i| plane[i] = mean);
            }
        }
    }
}

/// The integer quotient of numbers below 2²⁴. The divisor is small, so the quotient of floats is not rounded to the next
/// whole number. 0 over 0 is 0.
#[inline(always)]
fn quotient(number: i32, by: i32) -> i32 {
    (number as f32 / by.max(1) as f32) as i32
}

/// The two depths between which the lists of a reference's block are read, sixteenths of a unit.
#[derive(Clone, Debug)]
#[repr(align(64))]
struct DepthRange {
    /// [`NOWHERE`] for a list that is not read.
    low: BlockNumbers,
    high: BlockNumbers,
    /// The least and the greatest of these.
    range: [i32; 2],
    /// The rows and columns that are read. Depths of lists in other rows mean nothing.
    ys: std::ops::Range<usize>,
    xs: std::ops::Range<usize>,
}

/// The inputs for the depths of a block's lists.
struct DepthQuery {
    planes: (DepthPlane, DepthPlane),
    /// First column and row of the reference's block, relative to the first of the predicted block, quarters of a list.
    from: [i32; 2],
    /// Added to the depths, and the least length, sixteenths of a unit.
    shift: i32,
    least_length: i32,
}

wide! {
    /// Fills in the depths of the rows and columns.
    fn look(between: &mut DepthRange, query: &DepthQuery) = DepthRange::look_any;
}

impl DepthRange {
    const NOWHERE: Self =
        Self { low: [NOWHERE; BLOCK_LISTS], high: [0; BLOCK_LISTS], range: [NOWHERE, 0], ys: 0..0, xs: 0..0 };

    /// The lists of the rows.
    #[inline(always)]
    fn lists(&self) -> std::ops::Range<usize> {
        (self.ys.start * BLOCK).min(BLOCK_LISTS)..(self.ys.end * BLOCK).min(BLOCK_LISTS)
    }

    #[inline(always)]
    fn look_any(&mut self, query: &DepthQuery) {
        let &DepthQuery { planes: (front, back), from, shift, least_length } = query;
        let (first, last) = (self.xs.start as u32, self.xs.end as u32);
        let [mut least, mut most] = [NOWHERE, 0];
        for i in self.lists() {
            let (x, y) = (i as u32 % BLOCK as u32, i as u32 / BLOCK as u32);
            let at = [quarters_from_middle(x as usize) + from[0], quarters_from_middle(y as usize) + from[1]];
            let low = front.at(at).wrapping_add(shift);
            let high = back.at(at).wrapping_add(shift).max(low.saturating_add(least_length));
            let is_read = (x >= first) & (x < last);
            self.low[i] = if is_read { low } else { NOWHERE };
            self.high[i] = if is_read { high } else { 0 };
            least = least.min(self.low[i]);
            most = most.max(self.high[i]);
        }
        self.range = [least, most];
    }

    /// Whether a layer may have a cell between any of the depths.
    #[inline(always)]
    fn has(&self, layer: &CellLayer) -> bool {
        i32::from(layer.back) * SIXTEENTHS > self.range[0]
            && i32::from(layer.front) * SIXTEENTHS < self.range[1]
    }
}

wide! {
    /// Adds the parts of a layer's cells between the two depths, behind the present ones. A part has the colour of
    /// its cell, and counts by its visible opacity. Returns whether there are any.
    fn add(contents: &mut Contents, between: &DepthRange, cells: &CellPlanes) -> bool = Contents::add_any;
}

/// Composite of a block's lists between two depths.
#[derive(Clone, Debug)]
#[repr(align(64))]
struct Contents {
    /// Opacity, code of u, and Y, Co, Cg times opacity.
    values: [BlockNumbers; NUM_VALUES],
    /// log₂ of the optical depth, of a list with a cell.
    log: BlockNumbers,
    kappa: BlockNumbers,
    /// Number of cells.
    count: BlockNumbers,
}

impl Contents {
    const NOTHING: Self = Self {
        values: [[0; BLOCK_LISTS]; NUM_VALUES],
        log: [0; BLOCK_LISTS],
        kappa: [UNIT - 1; BLOCK_LISTS],
        count: [0; BLOCK_LISTS],
    };

    #[inline(always)]
    fn clear(&mut self) {
        self.values = [[0; BLOCK_LISTS]; NUM_VALUES];
        self.kappa = [UNIT - 1; BLOCK_LISTS];
        self.count = [0; BLOCK_LISTS];
    }

    #[inline(always)]
    fn add_any(&mut self, between: &DepthRange, cells: &CellPlanes) -> bool {
        let scales = scales();
        let [fronts, backs, of_u, ycc @ ..] = cells;
        let lists = between.lists();
        let (mut codes, mut is_part) = ([0u16; BLOCK_LISTS], [false; BLOCK_LISTS]);
        let (mut num, mut num_parts) = (0, 0);
        for i in lists.clone() {
            let (front, back) = (i32::from(fronts[i]) * SIXTEENTHS, i32::from(backs[i]) * SIXTEENTHS);
            let is_in = (back > between.low[i]) & (front < between.high[i]);
            let common = back.min(between.high[i]) - front.max(between.low[i]);
            // Nearly the whole cell counts as that.
            is_part[i] = is_in & (common + (common >> 10) < back - front);
            codes[i] = if is_in { of_u[i] } else { 0 };
            num += i32::from(is_in);
            num_parts += i32::from(is_part[i]);
        }
        if num == 0 {
            return false;
        }
        if num_parts > 0 {
            for i in lists.clone() {
                if is_part[i] {
                    let (front, back) = (i32::from(fronts[i]) * SIXTEENTHS, i32::from(backs[i]) * SIXTEENTHS);
                    let common = back.min(between.high[i]) - front.max(between.low[i]);
                    codes[i] = part_of(scales, codes[i], common, back - front);
                }
            }
        }
        let mut alpha = [0; BLOCK_LISTS];
        for i in lists.clone() {
            alpha[i] = scales.opacity(codes[i]);
            if codes[i] > 0 {
                let log = scales.log_of_tau(codes[i]);
                self.log[i] = if self.count[i] > 0 { scales.log_of_sum(self.log[i], log) } else { log };
            }
        }
        let [sum_alpha, u, sums @ ..] = &mut self.values;
        for i in lists.clone() {
            let is_there = i32::from(codes[i] > 0);
            // What is hidden counts a little, so that it has a colour.
            let seen = seen(self.kappa[i], alpha[i]).max(is_there);
            sum_alpha[i] += seen;
            u[i] = if codes[i] > 0 { i32::from(codes[i]) } else { u[i] };
            self.kappa[i] = behind(self.kappa[i], alpha[i]);
            self.count[i] += is_there;
            for (sum, ycc) in sums.iter_mut().zip(ycc) {
                sum[i] += seen * i32::from(ycc[i] as i16);
            }
        }
        true
    }

    /// For several cells, u is that of their total optical depth. Sums of colours become eighths, so that sixteen fit.
    #[inline(always)]
    fn finish(&mut self, lists: std::ops::Range<usize>) {
        let [_, u, sums @ ..] = &mut self.values;
        for i in lists.clone() {
            if self.count[i] > 1 {
                u[i] = scales().code_of_log(self.log[i]).into();
            }
        }
        for sum in sums.iter_mut().flat_map(|sums| &mut sums[lists.clone()]) {
            *sum = (*sum + 4) >> 3;
        }
    }
}

/// The code of a part of a cell, given the code and the length of the whole.
#[inline(always)]
fn part_of(scales: &Scales, code: u16, part: i32, whole: i32) -> u16 {
    scales.code_of_log(scales.log_of_tau(code) + scales.log_of(part) - scales.log_of(whole))
}

/// A depth behind all matter, sixteenths of a unit. Sums with it have room.
const NOWHERE: i32 = 1 << 30;
/// Number of values: opacity, code of u, Y, Co and Cg.
const NUM_VALUES: usize = 5;

#[cfg(test)]
mod tests;
