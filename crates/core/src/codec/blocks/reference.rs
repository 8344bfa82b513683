//! Frames that later ones are predicted from, and the fetching of a layer's content from one.

use std::collections::VecDeque;
use std::sync::Arc;

use super::band::{Band, Cell, CellsOf, greater, lesser};
use super::model::{BLOCK, BLOCK_LISTS, DepthPlane, lists_of};
use super::motion::{Motion, Shift};
use super::scales::{Scales, f32_from_fixed, scales, whole};
use super::steps::Steps;
use super::transform::Plane;
use crate::ids::FrameId;
use crate::layer::FrameHeader;

/// A decoded frame as far as predictions need it. What an encoder has noted of it beside that does not count when two are
/// compared.
#[derive(Clone, Debug)]
pub struct Reference {
    pub(super) header: FrameHeader,
    /// The steps it was coded with.
    pub(super) steps: Option<Steps>,
    pub(super) bands: Vec<Arc<Band>>,
    /// Band and row of blocks in it, for each row of blocks.
    pub(super) rows: Vec<(u8, u32)>,
    /// What its layers were worth; none of a frame that was decoded.
    pub(super) lambda: Option<f32>,
    /// Band by band, block by block; none of a frame that was decoded.
    pub(super) notes: Vec<Notes>,
}

/// For each block of a band the error of its planes as the last search for them left it, for each layer in what a layer is
/// worth, or less if they came to suit better. 0 where nothing is known.
pub(super) type Notes = Vec<f32>;

impl PartialEq for Reference {
    fn eq(&self, other: &Self) -> bool {
        (&self.header, &self.steps, &self.bands) == (&other.header, &other.steps, &other.bands)
    }
}

impl Reference {
    pub(super) fn new(header: FrameHeader, steps: Option<Steps>, bands: Vec<Arc<Band>>) -> Self {
        let rows = bands
            .iter()
            .enumerate()
            .flat_map(|(n, band)| {
                (0..band.blocks.len() / band.across.max(1)).map(move |row| (n as u8, row as u32))
            })
            .collect();
        Self { header, steps, bands, rows, lambda: None, notes: Vec::new() }
    }

    /// With what was noted when it was encoded.
    pub(super) fn with_notes(self, lambda: f32, notes: Vec<Notes>) -> Self {
        Self { lambda: Some(lambda), notes, ..self }
    }

    /// The frame.
    pub fn frame(&self) -> FrameId {
        self.header.frame
    }

    /// Memory that it takes, the same for who has encoded it and who has decoded it.
    fn num_bytes(&self) -> usize {
        self.bands.iter().map(|band| band.num_bytes()).sum()
    }

    /// The band and the number in it of the block at column `x` and row `y` of blocks.
    pub(super) fn block(&self, x: i32, y: i32) -> Option<(&Band, usize)> {
        let &(band, row) = self.rows.get(usize::try_from(y).ok()?)?;
        let band = &*self.bands[usize::from(band)];
        let x = usize::try_from(x).ok().filter(|&x| x < band.across)?;
        Some((band, row as usize * band.across + x))
    }

    /// What was noted of the block at column `x` and row `y` of blocks; 0 for nothing.
    pub(super) fn note(&self, [x, y]: [i32; 2]) -> f32 {
        let Some((_, block)) = self.block(x, y) else { return 0.0 };
        // There is a block, so there is such a row.
        let (band, _) = self.rows[y as usize];
        self.notes.get(usize::from(band)).and_then(|notes| notes.get(block)).copied().unwrap_or(0.0)
    }

    /// Column and row of the reference's block that the middle of the block at (`x`, `y`) of a frame moves to; there may be
    /// no such block.
    pub(super) fn moved_to(&self, motion: &Motion, x: usize, y: usize) -> Option<[i32; 2]> {
        // About how deep is the block? As the reference was here, or beside.
        let (front, _) = [(0, 0), (0, -1), (-1, 0), (1, 0), (0, 1)].into_iter().find_map(|(dx, dy)| {
            let (band, block) = self.block(x as i32 + dx, y as i32 + dy)?;
            band.planes[band.layers(block)].first()
        })?;
        let middle = [x, y].map(|v| (v * BLOCK) as f32 + HALF);
        let shift = motion.at(middle[0], middle[1], front.z)?;
        Some([middle[0] + shift.x, middle[1] + shift.y].map(|v| (v / BLOCK as f32).floor() as i32))
    }
}

/// The last frames that a receiver has decoded, or a sender has sent, for those that name them.
#[derive(Clone, Debug, Default)]
pub struct References {
    newest_last: VecDeque<Arc<Reference>>,
    num_bytes: usize,
    /// The last frames that were added, also those whose memory is needed for newer ones.
    frames: VecDeque<FrameId>,
}

impl References {
    /// Adds one. The oldest give way, beyond [`MAX_REFERENCES`] of them or [`MAX_REFERENCE_BYTES`]; the newest stays. A
    /// receiver has added no more than its sender, so it still has what that still has.
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

    /// Forgets all.
    pub fn clear(&mut self) {
        *self = Self::default();
    }

    /// The frame, if it is there.
    pub fn get(&self, frame: FrameId) -> Option<&Arc<Reference>> {
        self.newest_last.iter().rev().find(|r| r.frame() == frame)
    }

    /// What to predict the next frame from, if the last that the receiver is known to have decoded is `decoded`: the
    /// newest, which will arrive; but where many are on their way, or one may be lost, the one it is known to have, if
    /// that can be predicted from.
    pub fn next(&self, decoded: FrameId) -> Option<&Arc<Reference>> {
        let ahead = self.frames.iter().rev().take_while(|&&frame| frame > decoded).count();
        if ahead <= MAX_AHEAD { self.newest() } else { self.get(decoded) }
    }

    /// The newest.
    pub fn newest(&self) -> Option<&Arc<Reference>> {
        self.newest_last.back()
    }
}

/// What a reference has where a layer is.
#[derive(Clone, Debug)]
pub(super) struct Fetched {
    /// u, Y, Co, Cg of each list; of those without matter the mean.
    pub(super) planes: [Plane; 4],
    /// The lists where there is matter.
    pub(super) mask: u64,
}

/// A list of the reference between two depths.
#[derive(Clone, Copy, Default)]
struct Content {
    u: f32,
    /// 0 for no matter.
    alpha: f32,
    /// Times α.
    ycc: [f32; 3],
}

impl Fetched {
    pub(super) fn new() -> Self {
        Self { planes: [[0.0; BLOCK_LISTS]; 4], mask: 0 }
    }
}

wide! {
    /// Fetches what the reference has between two planes of the block at (`x`, `y`) of blocks, moved by `shift`: to a
    /// quarter of a list, between lists by nearness, colours also by opacity. Where it has nothing in any list, the
    /// planes stay what they were.
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
    let blocks = [0, 1].map(|dy| {
        [0, 1].map(|dx| {
            let found = reference.block(first_x + dx, first_y + dy);
            found.map_or(CellsOf::NONE, |(band, block)| band.cells_of(block))
        })
    });
    if blocks.as_flattened().iter().all(|block| block.cells.is_empty()) {
        return;
    }
    let scales = scales();
    let (inner_x, inner_y) = ((left - first_x * SIDE) as usize, (top - first_y * SIDE) as usize);
    let mut content = Contents::NOTHING;
    let mut has_any = false;
    for row in 0..rows {
        let y = inner_y + row;
        let dy = row as f32 - fy - MIDDLE;
        let mut between = Between::NOWHERE;
        for column in 0..LANES {
            let dx = column as f32 - fx - MIDDLE;
            let low = front.z + front.dx * dx + front.dy * dy + shift.z;
            let high = (back.z + back.dx * dx + back.dy * dy + shift.z).max(low + least_length);
            between.set(column, low, high);
        }
        for column in 0..columns {
            let x = inner_x + column;
            let cells = blocks[y / BLOCK][x / BLOCK].list(y % BLOCK * BLOCK + x % BLOCK);
            if !cells.is_empty() {
                has_any |= content.set(row, column, &between.content(column, scales, cells));
            }
        }
    }
    if !has_any {
        return;
    }
    let (gx, gy) = (1.0 - fx, 1.0 - fy);
    let taps = [(0, 0, gx * gy), (0, 1, fx * gy), (1, 0, gx * fy), (1, 1, fx * fy)];
    let mut sums = [[0.0; BLOCK_LISTS]; 6];
    // What has no weight adds zeros.
    for (dy, dx, w) in taps.into_iter().filter(|(.., w)| *w > 0.0) {
        let [weight, sums @ ..] = &mut sums;
        for row in 0..BLOCK {
            let alpha = &content.values[0][row + dy][dx..dx + BLOCK];
            // Where nothing is, all is zero.
            for (sum, alpha) in weight[row * BLOCK..][..BLOCK].iter_mut().zip(alpha) {
                *sum += if *alpha > 0.0 { w } else { 0.0 };
            }
            for (sums, values) in sums.iter_mut().zip(&content.values) {
                let values = &values[row + dy][dx..dx + BLOCK];
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

/// Rows of a number for each of the lists that a block's may lie between.
type Rows = [[f32; BLOCK + 1]; BLOCK + 1];

/// What these lists of the reference have between two depths: opacity, u, and Y, Co, Cg times opacity.
struct Contents {
    values: [Rows; 5],
}

impl Contents {
    const NOTHING: Self = Self { values: [[[0.0; BLOCK + 1]; BLOCK + 1]; 5] };

    /// Returns whether there is anything.
    #[inline(always)]
    fn set(&mut self, row: usize, column: usize, content: &Content) -> bool {
        let &Content { u, alpha, ycc: [y, co, cg] } = content;
        for (rows, value) in self.values.iter_mut().zip([alpha, u, y, co, cg]) {
            rows[row][column] = value;
        }
        alpha > 0.0
    }
}

/// Between which two depths the lists of a row are looked at.
struct Between {
    low: [f32; LANES],
    high: [f32; LANES],
    /// A cell is in front of these depths if it ends at this depth unit or before, and behind if it begins at this one or
    /// after.
    in_front: [u32; LANES],
    behind: [u32; LANES],
}

impl Between {
    const NOWHERE: Self =
        Self { low: [0.0; LANES], high: [0.0; LANES], in_front: [0; LANES], behind: [0; LANES] };

    #[inline(always)]
    fn set(&mut self, i: usize, low: f32, high: f32) {
        (self.low[i], self.high[i]) = (low, high);
        // No cell ends at 0 or before, and none goes on beyond 65535.
        let units = |depth: f32| whole(lesser(depth, BEYOND_ALL));
        self.in_front[i] = units(low);
        let below = units(high);
        self.behind[i] = below + u32::from((below as i32 as f32) < high);
    }

    /// The parts of a list's cells between the two depths, composited: the colour of parts is that of their cells, mixed
    /// by what of them is seen.
    #[inline(always)]
    fn content(&self, i: usize, scales: &Scales, cells: &[Cell]) -> Content {
        let (low, high) = (self.low[i], self.high[i]);
        let mut sum = Content::default();
        let mut tau = 0.0;
        let mut kappa = 1.0;
        let mut count = 0;
        for cell in cells {
            if u32::from(cell.back) <= self.in_front[i] {
                continue;
            }
            if u32::from(cell.front) >= self.behind[i] {
                break;
            }
            let (front, back) = (f32::from(cell.front), f32::from(cell.back));
            let part = (lesser(back, high) - greater(front, low)) / (back - front);
            let [of_cell, alpha] = scales.tau_and_alpha(cell.u);
            let (code, [of_part, alpha]) = if part > WHOLE {
                (cell.u, [of_cell, alpha])
            } else {
                let code = scales.code_of_one(scales.u_from_tau(of_cell * part));
                (code, scales.tau_and_alpha(code))
            };
            let seen = kappa * alpha;
            for (sum, value) in sum.ycc.iter_mut().zip(cell.ycc) {
                *sum += seen * f32_from_fixed(value);
            }
            sum.u = scales.u(code);
            sum.alpha += seen;
            tau += of_part;
            kappa *= 1.0 - alpha;
            count += 1;
        }
        if count > 1 {
            sum.u = scales.u_from_tau(tau);
        }
        sum
    }
}

/// Frames that are kept: a frame names none that is older.
pub const MAX_REFERENCES: usize = 12;
/// Memory of the frames that are kept. A cell takes 12 bytes, so that 1280×720 lists of 4 in the mean take 44 MB, of which
/// twelve fit, and 1920×1080 lists of 8 200 MB, of which two do. Where fewer fit, a frame that is lost costs one without a
/// reference.
pub const MAX_REFERENCE_BYTES: usize = 512 << 20;
/// Frames that may be named although the receiver is not known to have them: at 30 a second a third of one, and so the
/// longest that a lost one is missed.
const MAX_AHEAD: usize = 10;
/// Part of a cell that is taken for all of it.
const WHOLE: f32 = 0.999;
/// Depth units beyond all matter.
const BEYOND_ALL: f32 = 70_000.0;
/// Lists of a row that are looked at, with some to fill vectors.
const LANES: usize = 16;
/// Half of a block in lists.
pub(super) const HALF: f32 = BLOCK as f32 / 2.0;
const MIDDLE: f32 = (BLOCK as f32 - 1.0) / 2.0;
