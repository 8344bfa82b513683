//! Reference frames. A layer's prediction is fetched from one: its matter between two depths, to a quarter of a list.

use std::collections::VecDeque;
use std::sync::Arc;

use super::corrections::{self, TilePicture};
use super::entropy::Tables;
use super::entropy::Tally;
use super::model::{BLOCK, BLOCK_LISTS, DepthPlane, TILE, lists_of, tiles_along};
use super::motion::{ReferenceMotion, Shift};
use super::scales::{f32_from_fixed, scales, whole};
use super::steps::StepSizes;
use super::tables::Counts;
use super::tile::{CellLayer, CellPlanes, FrameTile, NO_CELLS, greater, lesser};
use super::transform::BlockPlane;
use crate::ids::FrameId;
use crate::layer::FrameHeader;

/// A decoded frame as predictions need it. A comparison of two ignores the encoder's notes.
#[derive(Clone, Debug)]
pub struct Reference {
    pub(super) header: FrameHeader,
    /// The steps of its coding.
    pub(super) steps: Option<StepSizes>,
    /// Its tiles, row by row.
    pub(super) tiles: Vec<Arc<FrameTile>>,
    /// What its contexts had, and the frames before.
    pub(super) counts: Counts,
    /// The probabilities that follow, of a frame that is predicted from it.
    pub(super) tables: Tables,
    /// λ of its layers; `None` for a decoded frame.
    pub(super) lambda: Option<f32>,
    /// Notes for each tile; empty for a decoded frame.
    pub(super) notes: Vec<Notes>,
}

/// A tile before the picture of its frame is corrected.
#[derive(Clone, Debug, Default)]
pub(in crate::codec) struct CodedTile {
    pub(super) tile: FrameTile,
    pub(super) picture: TilePicture,
}

impl CodedTile {
    /// Number of its blocks; 0 if nothing was sent of it.
    pub(in crate::codec) fn num_blocks(&self) -> usize {
        self.tile.blocks.len()
    }
}

/// For each block of a tile, the error of its planes after the last search, in units of the cost of a layer. It is
/// less if the planes fit better since. 0 where nothing is known.
pub(in crate::codec) type Notes = Vec<f32>;

impl PartialEq for Reference {
    fn eq(&self, other: &Self) -> bool {
        (&self.header, &self.steps, &self.tiles, &self.counts)
            == (&other.header, &other.steps, &other.tiles, &other.counts)
    }
}

impl Reference {
    pub(super) fn new(
        header: FrameHeader,
        steps: Option<StepSizes>,
        tiles: Vec<Arc<FrameTile>>,
        counts: Counts,
    ) -> Self {
        let tables = counts.tables();
        Self { header, steps, tiles, counts, tables, lambda: None, notes: Vec::new() }
    }

    /// Corrects the picture of all tiles of a frame, whose bits are counted. `before` is what it was predicted from.
    pub(super) fn of_tiles(
        header: FrameHeader,
        steps: StepSizes,
        coded: Vec<CodedTile>,
        tally: &Tally,
        before: Option<&Self>,
    ) -> Self {
        let counts = before.map(|reference| reference.counts.faded()).unwrap_or_default().with(tally);
        let (mut tiles, mut pictures): (Vec<FrameTile>, Vec<TilePicture>) =
            coded.into_iter().map(|CodedTile { tile, picture }| (tile, picture)).unzip();
        let across = tiles_along(header.camera.intrinsics.width);
        corrections::correct(&mut tiles, &mut pictures, across, steps.of_picture());
        Self::new(header, Some(steps), tiles.into_iter().map(Arc::new).collect(), counts)
    }

    /// Adds the notes of its encoding.
    pub(super) fn with_notes(self, lambda: f32, notes: Vec<Notes>) -> Self {
        Self { lambda: Some(lambda), notes, ..self }
    }

    /// The frame.
    pub fn frame(&self) -> FrameId {
        self.header.frame
    }

    /// Its size in bytes, by the count that sender and receiver share.
    fn num_bytes(&self) -> usize {
        self.tiles.iter().map(|tile| tile.num_bytes()).sum()
    }

    /// Mean number of cells in the tiles that were sent.
    pub(super) fn cells_per_tile(&self) -> usize {
        let sent = self.tiles.iter().filter(|tile| !tile.blocks.is_empty());
        let (num, cells) = sent.fold((0, 0), |(num, cells), tile| (num + 1, cells + tile.num_cells()));
        cells / num.max(1)
    }

    /// Index of the tile with the block at column `x` and row `y` of blocks, and of the block in it. None outside of the
    /// frame, and in a tile that was not sent.
    fn place(&self, x: i32, y: i32) -> Option<(usize, usize)> {
        let (x, y) = (usize::try_from(x).ok()?, usize::try_from(y).ok()?);
        let across = tiles_along(self.header.camera.intrinsics.width);
        let index = y / TILE * across + x / TILE;
        let tile = self.tiles.get(index).filter(|tile| x / TILE < across && x % TILE < tile.across)?;
        let block = y % TILE * tile.across + x % TILE;
        (block < tile.blocks.len()).then_some((index, block))
    }

    /// The tile of the block at column `x` and row `y` of blocks, and its index there.
    pub(super) fn block(&self, x: i32, y: i32) -> Option<(&FrameTile, usize)> {
        let (tile, block) = self.place(x, y)?;
        Some((&self.tiles[tile], block))
    }

    /// The note on the block at column `x` and row `y` of blocks; 0 for none.
    pub(super) fn note(&self, [x, y]: [i32; 2]) -> f32 {
        let Some((tile, block)) = self.place(x, y) else { return 0.0 };
        self.notes.get(tile).and_then(|notes| notes.get(block)).copied().unwrap_or(0.0)
    }

    /// Column and row of the reference's block that the middle of the block at (`x`, `y`) of a frame moves to. They
    /// may lie outside.
    pub(super) fn moved_to(&self, motion: &ReferenceMotion, x: usize, y: usize) -> Option<[i32; 2]> {
        // The depth of the move is the reference's, here or in a neighbour.
        let (front, _) = [(0, 0), (0, -1), (-1, 0), (1, 0), (0, 1)].into_iter().find_map(|(dx, dy)| {
            let (tile, block) = self.block(x as i32 + dx, y as i32 + dy)?;
            tile.planes[tile.layers(block)].first()
        })?;
        let middle = [x, y].map(|v| (v * BLOCK) as f32 + HALF);
        let shift = motion.at(middle[0], middle[1], front.z)?;
        Some([middle[0] + shift.x, middle[1] + shift.y].map(|v| (v / BLOCK as f32).floor() as i32))
    }
}

/// The last frames that a receiver decoded or a sender sent, from which later frames may be predicted.
#[derive(Clone, Debug, Default)]
pub struct References {
    newest_last: VecDeque<Arc<Reference>>,
    num_bytes: usize,
    /// Ids of the last added frames, including those that gave way to newer ones.
    frames: VecDeque<FrameId>,
}

impl References {
    /// Adds a frame. The oldest give way beyond [`MAX_REFERENCES`] frames or [`MAX_REFERENCE_BYTES`]; the newest
    /// stays. A receiver adds no more frames than its sender, so it keeps every frame that the sender keeps.
    pub fn insert(&mut self, reference: Arc<Reference>) {
        if self.frames.len() == MAX_REFERENCES {
            self.frames.pop_front();
        }
        self.frames.push_back(reference.frame());
        self.num_bytes += reference.num_bytes();
        self.newest_last.push_back(reference);
        let is_over =
            |kept: &Self| kept.newest_last.len() > MAX_REFERENCES || kept.num_bytes > MAX_REFERENCE_BYTES;
        while is_over(self) && self.newest_last.len() > 1 {
            let oldest = self.newest_last.pop_front();
            self.num_bytes -= oldest.map_or(0, |reference| reference.num_bytes());
        }
    }

    /// The size of all in bytes, by the count that sender and receiver share.
    pub fn num_bytes(&self) -> usize {
        self.num_bytes
    }

    /// Keeps only the newest frame. A sender may keep fewer than its receiver.
    pub fn keep_newest(&mut self) {
        if let Some(newest) = self.newest_last.pop_back() {
            self.num_bytes = newest.num_bytes();
            self.newest_last = VecDeque::from([newest]);
        }
    }

    /// Forgets all frames.
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// The frame with this id, if it is kept.
    pub fn get(&self, frame: FrameId) -> Option<&Arc<Reference>> {
        self.newest_last.iter().rev().find(|r| r.frame() == frame)
    }

    /// The reference for the next frame, if `decoded` is the last frame that the receiver has reported. It is the
    /// newest frame, which will arrive. If too many are on their way, or one may be lost, it is the reported one, if
    /// that is kept.
    pub fn next(&self, decoded: FrameId) -> Option<&Arc<Reference>> {
        let ahead = self.frames.iter().rev().take_while(|&&frame| frame > decoded).count();
        if ahead <= MAX_AHEAD { self.newest() } else { self.get(decoded) }
    }

    /// The newest frame.
    pub fn newest(&self) -> Option<&Arc<Reference>> {
        self.newest_last.back()
    }
}

/// The reference's matter in a layer.
#[derive(Clone, Debug)]
#[repr(align(64))]
pub(super) struct Fetched {
    /// u, Y, Co, Cg of each list. Lists without matter have the mean.
    pub(super) planes: [BlockPlane; 4],
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
        Self { planes: [[0.0; BLOCK_LISTS]; 4], mask: 0, scratch: Box::new(scratch) }
    }
}

wide! {
    /// Fetches what the reference has between two planes of the block at (`x`, `y`), moved by `shift` to a quarter of
    /// a list. Lists are mixed by nearness, and their colours also by opacity. If no list has matter, the planes stay
    /// the same.
    pub(super) fn fetch(
        fetched: &mut Fetched,
        reference: &Reference,
        at: (usize, usize),
        planes: &(DepthPlane, DepthPlane),
        shift: Shift,
        least_length: f32,
    ) = fetch_any;
}

#[inline(always)]
fn fetch_any(
    fetched: &mut Fetched,
    reference: &Reference,
    (x, y): (usize, usize),
    (front, back): &(DepthPlane, DepthPlane),
    shift: Shift,
    least_length: f32,
) {
    fetched.mask = 0;
    let quarter = |s: f32| (s * 4.0 + 0.5).floor() as i32;
    let (qx, qy) = (quarter(shift.x), quarter(shift.y));
    let (fx, fy) = ((qx & 3) as f32 * 0.25, (qy & 3) as f32 * 0.25);
    let (left, top) = ((x * BLOCK) as i32 + (qx >> 2), (y * BLOCK) as i32 + (qy >> 2));
    let (columns, rows) = (BLOCK + usize::from(fx > 0.0), BLOCK + usize::from(fy > 0.0));
    const SIDE: i32 = BLOCK as i32;
    let (first_x, first_y) = (left.div_euclid(SIDE), top.div_euclid(SIDE));
    let (inner_x, inner_y) = ((left - first_x * SIDE) as usize, (top - first_y * SIDE) as usize);
    let mut found = [[[0.0; 2 * BLOCK]; BLOCK + 1]; NUM_VALUES];
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
        look(
            between,
            &DepthQuery {
                planes: (*front, *back),
                at: [(bx * BLOCK) as f32 - inner_x as f32, (by * BLOCK) as f32 - inner_y as f32],
                part: [fx, fy],
                shift: shift.z,
                least_length,
            },
        );
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
    if !has_any {
        return;
    }
    let (gx, gy) = (1.0 - fx, 1.0 - fy);
    let taps = [(0, 0, gx * gy), (0, 1, fx * gy), (1, 0, gx * fy), (1, 1, fx * fy)];
    let mut sums = [[0.0; BLOCK_LISTS]; 6];
    // Lists without weight add zeros.
    for (dy, dx, w) in taps.into_iter().filter(|(.., w)| *w > 0.0) {
        let [weight, sums @ ..] = &mut sums;
        for row in 0..BLOCK {
            let alpha = &found[0][row + dy][inner_x + dx..][..BLOCK];
            // Without matter, all values are zero.
            for (sum, alpha) in weight[row * BLOCK..][..BLOCK].iter_mut().zip(alpha) {
                *sum += if *alpha > 0.0 { w } else { 0.0 };
            }
            for (sums, values) in sums.iter_mut().zip(&found) {
                let values = &values[row + dy][inner_x + dx..][..BLOCK];
                for (sum, value) in sums[row * BLOCK..][..BLOCK].iter_mut().zip(values) {
                    *sum += w * value;
                }
            }
        }
    }
    let [weight, alpha, u, ycc @ ..] = &sums;
    let [fetched_u, fetched_ycc @ ..] = &mut fetched.planes;
    let mut is_there = [0u8; BLOCK_LISTS];
    for i in 0..BLOCK_LISTS {
        is_there[i] = u8::from(weight[i] > 0.5);
        fetched_u[i] = u[i] / weight[i];
    }
    for (plane, ycc) in fetched_ycc.iter_mut().zip(ycc) {
        for ((value, ycc), alpha) in plane.iter_mut().zip(ycc).zip(alpha) {
            *value = ycc / alpha;
        }
    }
    let mask = is_there.iter().enumerate().fold(0, |mask, (i, there)| mask | u64::from(*there) << i);
    fetched.mask = mask;
    if mask != 0 && mask != u64::MAX {
        let (mut sums, mut sum_alpha, mut count) = ([0.0; 4], 0.0, 0.0);
        for i in lists_of(mask) {
            sums[0] += fetched.planes[0][i];
            count += 1.0;
            sum_alpha += alpha[i];
            for (sum, ycc) in sums[1..].iter_mut().zip(ycc) {
                *sum += ycc[i];
            }
        }
        let means = [sums[0] / count, sums[1] / sum_alpha, sums[2] / sum_alpha, sums[3] / sum_alpha];
        for i in lists_of(!mask) {
            for (plane, mean) in fetched.planes.iter_mut().zip(means) {
                plane[i] = mean;
            }
        }
    }
}

/// The two depths between which the lists of a reference's block are read.
#[derive(Clone, Debug)]
#[repr(align(64))]
struct DepthRange {
    low: BlockPlane,
    high: BlockPlane,
    /// For each list, a cell lies in front if it ends at the first of these depth units or before, and behind if it
    /// begins at the second or after. All cells of an unread list do.
    in_front: [i32; BLOCK_LISTS],
    behind: [i32; BLOCK_LISTS],
    /// The least and the greatest of these.
    range: [i32; 2],
    /// The rows and columns that are read. Depths of lists in other rows mean nothing.
    ys: std::ops::Range<usize>,
    xs: std::ops::Range<usize>,
}

/// The inputs for the depths of a block's lists.
struct DepthQuery {
    planes: (DepthPlane, DepthPlane),
    /// First column and row of the reference's block, relative to the predicted block.
    at: [f32; 2],
    /// The fraction of a list by which they are shifted, and the shift in depth.
    part: [f32; 2],
    shift: f32,
    least_length: f32,
}

wide! {
    /// Fills in the depths of the rows and columns.
    fn look(between: &mut DepthRange, looked: &DepthQuery) = DepthRange::look_any;
}

impl DepthRange {
    const NOWHERE: Self = Self {
        low: [0.0; BLOCK_LISTS],
        high: [0.0; BLOCK_LISTS],
        in_front: [i32::MAX; BLOCK_LISTS],
        behind: [0; BLOCK_LISTS],
        range: [i32::MAX, 0],
        ys: 0..0,
        xs: 0..0,
    };

    /// The lists of the rows.
    #[inline(always)]
    fn lists(&self) -> std::ops::Range<usize> {
        (self.ys.start * BLOCK).min(BLOCK_LISTS)..(self.ys.end * BLOCK).min(BLOCK_LISTS)
    }

    #[inline(always)]
    fn look_any(&mut self, looked: &DepthQuery) {
        let &DepthQuery { planes: (front, back), at, part, shift, least_length } = looked;
        let (first, last) = (self.xs.start as u32, self.xs.end as u32);
        let [mut least, mut most] = [i32::MAX, 0];
        for i in self.lists() {
            let (x, y) = (i as u32 % BLOCK as u32, i as u32 / BLOCK as u32);
            let (dx, dy) = (x as f32 + at[0] - part[0] - MIDDLE, y as f32 + at[1] - part[1] - MIDDLE);
            let low = front.z + front.dx * dx + front.dy * dy + shift;
            let high = (back.z + back.dx * dx + back.dy * dy + shift).max(low + least_length);
            // No cell ends at 0 or before, or beyond 65535.
            let units = |depth: f32| whole(lesser(depth, BEYOND_ALL)) as i32;
            let below = units(high);
            let is_looked_at = (x >= first) & (x < last);
            (self.low[i], self.high[i]) = (low, high);
            self.in_front[i] = if is_looked_at { units(low) } else { i32::MAX };
            self.behind[i] = if is_looked_at { below + i32::from((below as f32) < high) } else { 0 };
            least = least.min(self.in_front[i]);
            most = most.max(self.behind[i]);
        }
        self.range = [least, most];
    }

    /// Whether a layer may have a cell between any of the depths.
    #[inline(always)]
    fn has(&self, layer: &CellLayer) -> bool {
        i32::from(layer.back) > self.range[0] && i32::from(layer.front) < self.range[1]
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
    /// Opacity, u, and Y, Co, Cg times opacity.
    values: [BlockPlane; NUM_VALUES],
    tau: BlockPlane,
    kappa: BlockPlane,
    /// Number of cells.
    count: [u32; BLOCK_LISTS],
}

impl Contents {
    const NOTHING: Self = Self {
        values: [[0.0; BLOCK_LISTS]; NUM_VALUES],
        tau: [0.0; BLOCK_LISTS],
        kappa: [1.0; BLOCK_LISTS],
        count: [0; BLOCK_LISTS],
    };

    #[inline(always)]
    fn clear(&mut self) {
        self.values = [[0.0; BLOCK_LISTS]; NUM_VALUES];
        self.tau = [0.0; BLOCK_LISTS];
        self.kappa = [1.0; BLOCK_LISTS];
        self.count = [0; BLOCK_LISTS];
    }

    #[inline(always)]
    fn add_any(&mut self, between: &DepthRange, cells: &CellPlanes) -> bool {
        let scales = scales();
        let [fronts, backs, of_u, ycc @ ..] = cells;
        let lists = between.lists();
        let (mut codes, mut part) = ([0u16; BLOCK_LISTS], [0.0; BLOCK_LISTS]);
        let (mut num, mut num_parts) = (0, 0);
        for i in lists.clone() {
            let (front, back) = (f32::from(fronts[i]), f32::from(backs[i]));
            let is_in =
                (i32::from(backs[i]) > between.in_front[i]) & (i32::from(fronts[i]) < between.behind[i]);
            part[i] = (lesser(back, between.high[i]) - greater(front, between.low[i])) / (back - front);
            codes[i] = if is_in { of_u[i] } else { 0 };
            num += i32::from(is_in);
            num_parts += i32::from(is_in & (part[i] <= WHOLE));
        }
        if num == 0 {
            return false;
        }
        // Every cell has optical depth and opacity.
        let (mut tau, mut alpha) = ([0.0; BLOCK_LISTS], [0.0; BLOCK_LISTS]);
        for i in lists.clone() {
            [tau[i], alpha[i]] = scales.tau_and_alpha(codes[i]);
        }
        if num_parts > 0 {
            for i in lists.clone() {
                let code = scales.code(scales.u_from_tau(tau[i] * part[i]));
                let is_part = (codes[i] > 0) & (part[i] <= WHOLE);
                codes[i] = if is_part { code } else { codes[i] };
            }
            for i in lists.clone() {
                [tau[i], alpha[i]] = scales.tau_and_alpha(codes[i]);
            }
        }
        let [sum_alpha, u, sums @ ..] = &mut self.values;
        for i in lists.clone() {
            let seen = self.kappa[i] * alpha[i];
            sum_alpha[i] += seen;
            u[i] = if codes[i] > 0 { scales.u(codes[i]) } else { u[i] };
            self.tau[i] += tau[i];
            self.kappa[i] *= 1.0 - alpha[i];
            self.count[i] += u32::from(codes[i] > 0);
            for (sum, ycc) in sums.iter_mut().zip(ycc) {
                sum[i] += seen * f32_from_fixed(ycc[i] as i16);
            }
        }
        true
    }

    /// For several cells, u is that of their total optical depth.
    #[inline(always)]
    fn finish(&mut self, lists: std::ops::Range<usize>) {
        let [_, u, ..] = &mut self.values;
        let (u, tau, count) = (&mut u[lists.clone()], &self.tau[lists.clone()], &self.count[lists]);
        if count.iter().fold(0, |most, count| most.max(*count)) > 1 {
            let scales = scales();
            let mut together = [0.0; BLOCK_LISTS];
            for (together, tau) in together.iter_mut().zip(tau) {
                *together = scales.u_from_tau(*tau);
            }
            for ((u, together), count) in u.iter_mut().zip(&together).zip(count) {
                *u = if *count > 1 { *together } else { *u };
            }
        }
    }
}

/// Most frames that are kept. A frame names no older one.
pub const MAX_REFERENCES: usize = 32;
/// Most bytes of kept frames, as counted. A cell counts 12 bytes. So 1280×720 lists of 4 cells on average count 44
/// MB, and eleven such frames fit. 1920×1080 lists of 8 cells count 200 MB, and two fit. Real memory is a tenth more,
/// and up to seven times as much for layers with few cells. If only one fits, a lost frame costs a frame without a
/// reference.
pub const MAX_REFERENCE_BYTES: usize = 512 << 20;
/// Most frames that may be named before the receiver reports one of them: those of a round trip of 400 ms at 60
/// frames a second. This is also the longest time for which a lost frame is missed.
const MAX_AHEAD: usize = 24;
/// A larger part of a cell counts as the whole cell.
const WHOLE: f32 = 0.999;
/// A depth beyond all matter, depth units.
const BEYOND_ALL: f32 = 70_000.0;
/// Number of values: opacity, u, Y, Co and Cg.
const NUM_VALUES: usize = 5;
/// Half of a block's side, lists.
pub(super) const HALF: f32 = BLOCK as f32 / 2.0;
const MIDDLE: f32 = (BLOCK as f32 - 1.0) / 2.0;

#[cfg(test)]
mod tests;
