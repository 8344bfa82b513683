//! The lists of a block, and walks along 16 of them at once. A walk gives the optical depth, transmittance and colour
//! that lists collect up to a depth.

use super::super::model::{BLOCK, BLOCK_LISTS};
use super::{Column, SAMPLES, SampleColumn, greater, lesser, select};
use crate::kernels::raycast::{opacity, transmittance};
use crate::layer::{LayeredFrame, MAX_K, unpack_halves};

/// The segments of a block's lists, front to back. Its memory is reused from block to block.
#[derive(Clone, Debug)]
#[repr(align(64))]
pub(in crate::codec::blocks) struct BlockLists {
    /// The pieces of list `i` are `starts[i]..starts[i + 1]`. The last one stands for what lies behind all matter.
    starts: [u32; BLOCK_LISTS + 1],
    pieces: Vec<ListPiece>,
    /// Visibility of an error in each list: the darker the list, the greater. 1 for a bright one.
    pub(super) slope: Column,
    /// Roots of red, green and blue that a list composites to.
    roots: [Column; 3],
    /// Front of the most visible segment of a list; NaN if it has none.
    pub(super) depth: Column,
    /// The sampled lists: up to 16 of those with segments, evenly spread. If there are fewer, empty lists fill the
    /// rest.
    samples: [u8; SAMPLES],
    /// Number of lists with segments for each sample.
    per_sample: f32,
    unpacked: Box<Unpacked>,
}

wide! {
    fn read(lists: &mut BlockLists, frame: &LayeredFrame, x: u32, y: u32) = BlockLists::read_any;
}

/// Takes in the segments of a row of a block's lists.
#[derive(Clone, Debug)]
#[repr(align(64))]
struct Unpacked {
    front: RowOf<f32>,
    back: RowOf<f32>,
    tau: RowOf<f32>,
    alpha: RowOf<f32>,
    kappa: RowOf<f32>,
    rate: RowOf<f32>,
    c: [RowOf<f32>; 3],
    e: [RowOf<f32>; 3],
}

type RowOf<T> = [T; BLOCK * MAX_K];

/// A segment, and what lies in front of it.
#[derive(Clone, Copy, Debug, Default)]
#[repr(align(64))]
pub(super) struct ListPiece {
    pub(super) front: f32,
    pub(super) back: f32,
    /// Optical depth for each depth unit.
    rate: f32,
    /// Source colour C/α.
    e: [f32; 3],
    before: CollectedBefore,
}

/// What a ray collects in front of a piece.
#[derive(Clone, Copy, Debug)]
struct CollectedBefore {
    tau: f32,
    kappa: f32,
    c: [f32; 3],
}

impl Default for CollectedBefore {
    fn default() -> Self {
        Self { tau: 0.0, kappa: 1.0, c: [0.0; 3] }
    }
}

impl Default for BlockLists {
    fn default() -> Self {
        let behind = ListPiece { front: f32::INFINITY, back: f32::INFINITY, ..ListPiece::default() };
        Self {
            starts: std::array::from_fn(|i| i as u32),
            pieces: vec![behind; BLOCK_LISTS],
            slope: [1.0; BLOCK_LISTS],
            roots: [[0.0; BLOCK_LISTS]; 3],
            depth: [f32::NAN; BLOCK_LISTS],
            samples: [0; SAMPLES],
            per_sample: 1.0,
            unpacked: Box::default(),
        }
    }
}

impl Default for Unpacked {
    fn default() -> Self {
        let row = [0.0; BLOCK * MAX_K];
        Self {
            front: row,
            back: row,
            tau: row,
            alpha: row,
            kappa: row,
            rate: row,
            c: [row, row, row],
            e: [row, row, row],
        }
    }
}

impl Unpacked {
    /// Reads segments from their words.
    #[inline(always)]
    fn fill(&mut self, depth: &[u32], rg: &[u32], b_tau: &[u32]) {
        let num = depth.len().min(rg.len()).min(b_tau.len()).min(BLOCK * MAX_K);
        for i in 0..num {
            let ((r, g), (b, tau)) = (unpack_halves(rg[i]), unpack_halves(b_tau[i]));
            let tau = select(tau > TAU_MIN, tau, TAU_MIN);
            let alpha = opacity(tau);
            let (front, back) = ((depth[i] & 0xffff) as f32, (depth[i] >> 16) as f32);
            let per_alpha = 1.0 / alpha;
            self.front[i] = front;
            self.back[i] = back;
            self.tau[i] = tau;
            self.alpha[i] = alpha;
            self.kappa[i] = transmittance(tau);
            self.rate[i] = tau / (back - front);
            self.c[0][i] = r;
            self.c[1][i] = g;
            self.c[2][i] = b;
            self.e[0][i] = r * per_alpha;
            self.e[1][i] = g * per_alpha;
            self.e[2][i] = b * per_alpha;
        }
    }

    /// Returns segment `i`, its visible opacity, and what is collected before the next one.
    #[inline(always)]
    fn piece(&self, i: usize, before: CollectedBefore) -> (ListPiece, f32, CollectedBefore) {
        let i = i % (BLOCK * MAX_K);
        let piece = ListPiece {
            front: self.front[i],
            back: self.back[i],
            rate: self.rate[i],
            e: [self.e[0][i], self.e[1][i], self.e[2][i]],
            before,
        };
        let behind = CollectedBefore {
            tau: before.tau + self.tau[i],
            kappa: before.kappa * self.kappa[i],
            c: [0, 1, 2].map(|n| before.c[n] + before.kappa * self.c[n][i]),
        };
        (piece, before.kappa * self.alpha[i], behind)
    }
}

impl BlockLists {
    /// Reads the lists of a valid frame ([`LayeredFrame::validate`]) from (`x`·[`BLOCK`], `y`·[`BLOCK`]) on. Lists
    /// outside of the frame are empty.
    pub(in crate::codec::blocks) fn read(&mut self, frame: &LayeredFrame, x: u32, y: u32) {
        read(self, frame, x, y);
    }

    #[inline(always)]
    fn read_any(&mut self, frame: &LayeredFrame, x: u32, y: u32) {
        let intrinsics = frame.header.camera.intrinsics;
        let (width, height) = (intrinsics.width as usize, intrinsics.height as usize);
        let (x, y) = (x as usize * BLOCK, y as usize * BLOCK);
        let columns = width.saturating_sub(x).min(BLOCK);
        self.pieces.clear();
        for row in 0..BLOCK {
            let columns = if y + row < height { columns } else { 0 };
            let first = (y + row) * width + x;
            let offsets = if columns > 0 { &frame.offsets[first..=first + columns] } else { &[0][..] };
            let start = offsets[0] as usize;
            let range = start..offsets[columns] as usize;
            let words = [&frame.depth, &frame.c_rg, &frame.c_b_tau].map(|plane| &plane[range.clone()]);
            self.unpacked.fill(words[0], words[1], words[2]);
            for column in 0..BLOCK {
                let i = row * BLOCK + column;
                let mut before = CollectedBefore::default();
                let (mut most, mut depth) = (0.0, f32::NAN);
                if column < columns {
                    for index in offsets[column] as usize..offsets[column + 1] as usize {
                        let (piece, visible, behind) = self.unpacked.piece(index - start, before);
                        depth = select(visible > most, piece.front, depth);
                        most = greater(visible, most);
                        self.pieces.push(piece);
                        before = behind;
                    }
                }
                self.depth[i] = depth;
                self.pieces.push(ListPiece {
                    front: f32::INFINITY,
                    back: f32::INFINITY,
                    before,
                    ..ListPiece::default()
                });
                self.starts[i + 1] = self.pieces.len() as u32;
                for (roots, c) in self.roots.iter_mut().zip(before.c) {
                    roots[i] = greater(c, 0.0);
                }
            }
        }
        let [r, g, b] = &mut self.roots;
        for i in 0..BLOCK_LISTS {
            // The picture shows about the root of the colour, so an error in a dark list counts more.
            let brightest = greater(greater(r[i], g[i]), b[i]);
            self.slope[i] = (0.5 / greater(brightest, 0.01).sqrt()).sqrt();
            (r[i], g[i], b[i]) = (r[i].sqrt(), g[i].sqrt(), b[i].sqrt());
        }
        self.sample();
    }

    /// Whether a block of a frame is empty.
    pub(in crate::codec::blocks) fn is_nothing(frame: &LayeredFrame, x: u32, y: u32) -> bool {
        let intrinsics = frame.header.camera.intrinsics;
        let (width, height) = (intrinsics.width as usize, intrinsics.height as usize);
        let (left, top) = (x as usize * BLOCK, y as usize * BLOCK);
        let right = (left + BLOCK).min(width);
        (top..(top + BLOCK).min(height))
            .all(|y| frame.offsets[y * width + left] == frame.offsets[y * width + right])
    }

    /// The roots of red, green and blue that the lists composite to.
    pub(in crate::codec::blocks) fn roots(&self) -> &[[f32; BLOCK_LISTS]; 3] {
        &self.roots
    }

    /// Whether no list has a segment.
    pub(in crate::codec::blocks) fn is_empty(&self) -> bool {
        self.pieces.len() == BLOCK_LISTS
    }

    /// Chooses the samples.
    #[inline(always)]
    fn sample(&mut self) {
        let (mut chosen, mut num, mut empty) = ([0; BLOCK_LISTS], 0, 0);
        for list in SPREAD {
            let i = usize::from(list);
            let has_segments = self.starts[i + 1] - self.starts[i] > 1;
            chosen[num] = list;
            num += usize::from(has_segments);
            empty = if has_segments { empty } else { list };
        }
        chosen[num..].fill(empty);
        self.samples.copy_from_slice(&chosen[..SAMPLES]);
        self.per_sample = num as f32 / num.clamp(1, SAMPLES) as f32;
    }

    /// Number of lists with segments for each sample that has some.
    #[inline(always)]
    pub(super) fn per_sample(&self) -> f32 {
        self.per_sample
    }

    /// The list of sample `i`. Some sample has segments unless all lists are empty.
    #[inline(always)]
    pub(super) fn sampled(&self, i: usize) -> usize {
        usize::from(self.samples[i]) % BLOCK_LISTS
    }

    /// The colour between two depths of some pieces of a list, the last one included.
    #[inline(always)]
    pub(super) fn composite(&self, first: u32, last: u32, front: f32, back: f32) -> [f32; 3] {
        let (mut kappa, mut c) = (1.0, [0.0; 3]);
        for piece in &self.pieces[first as usize..=last as usize] {
            let depth = lesser(piece.back, back) - greater(piece.front, front);
            let next = kappa * transmittance(greater(depth, 0.0) * piece.rate);
            for (c, e) in c.iter_mut().zip(piece.e) {
                *c += e * (kappa - next);
            }
            kappa = next;
        }
        c
    }

    /// The segments of list `i`.
    #[inline(always)]
    pub(super) fn list(&self, i: usize) -> &[ListPiece] {
        &self.pieces[self.starts[i] as usize..self.starts[i + 1] as usize - 1]
    }
}

/// What sixteen lists collect up to a place in each.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
pub(super) struct CollectedLight {
    /// Optical depth.
    pub(super) tau: SampleColumn,
    /// Transmittance, and its inverse.
    pub(super) kappa: SampleColumn,
    pub(super) per_kappa: SampleColumn,
    /// Colour as visible from the front.
    pub(super) c: [SampleColumn; 3],
    /// Where matter begins at this cut or behind it; infinite behind all matter.
    pub(super) next: SampleColumn,
    /// Where matter ends at this cut or before it; −infinite in front of all matter.
    pub(super) last: SampleColumn,
}

impl CollectedLight {
    pub(super) const NOTHING: Self = Self {
        tau: [0.0; SAMPLES],
        kappa: [1.0; SAMPLES],
        per_kappa: [1.0; SAMPLES],
        c: [[0.0; SAMPLES]; 3],
        next: [f32::INFINITY; SAMPLES],
        last: [f32::NEG_INFINITY; SAMPLES],
    };
}

/// Walks through sixteen lists at once, front to back. Its depths are those of the lists minus `shear`.
#[derive(Clone, Debug)]
#[repr(align(64))]
pub(super) struct ListWalk {
    pub(super) shear: SampleColumn,
    /// Slopes of [`BlockLists`].
    pub(super) slope: SampleColumn,
    /// Index of the piece in which or in front of which the walk is.
    pub(super) index: [u32; SAMPLES],
    /// Values of these pieces, as columns.
    front: SampleColumn,
    back: SampleColumn,
    rate: SampleColumn,
    pub(super) e: [SampleColumn; 3],
    tau: SampleColumn,
    kappa: SampleColumn,
    c: [SampleColumn; 3],
    /// Ends of the previous pieces.
    last: SampleColumn,
    border: SampleColumn,
}

/// A listener that a walk tells when it leaves pieces. It is no closure, because a closure is not compiled for the
/// instructions of its caller.
pub(super) trait PieceObserver {
    /// Each list of the mask has left a piece, and the walk is at the front of the next.
    fn left(&mut self, walk: &ListWalk, lists: u64);
}

impl PieceObserver for () {
    #[inline(always)]
    fn left(&mut self, _: &ListWalk, _: u64) {}
}

/// Whether a piece ends in front of a border, or so little behind it that it counts as ending there.
#[inline(always)]
fn is_short_of(border: f32, front: f32, back: f32) -> bool {
    (back <= border) | ((front < border) & (back - border < SNAP * (back - front)))
}

/// Whether more than a small part of a piece lies in front of a border.
#[inline(always)]
fn is_within(border: f32, front: f32, back: f32) -> bool {
    border - front >= SNAP * (back - front)
}

impl Default for ListWalk {
    fn default() -> Self {
        let zero = [0.0; SAMPLES];
        Self {
            shear: zero,
            slope: zero,
            index: [0; SAMPLES],
            front: zero,
            back: zero,
            rate: zero,
            e: [zero; 3],
            tau: zero,
            kappa: zero,
            c: [zero; 3],
            last: zero,
            border: zero,
        }
    }
}

impl ListWalk {
    /// Starts at the front of lists.
    #[inline(always)]
    pub(super) fn start(&mut self, lists: &BlockLists, numbers: &[usize; SAMPLES]) {
        for (i, &list) in numbers.iter().enumerate() {
            self.index[i] = lists.starts[list];
            self.slope[i] = lists.slope[list];
            self.last[i] = f32::NEG_INFINITY;
            self.enter(lists, i);
        }
    }

    /// The piece `index[i]`.
    #[inline(always)]
    fn enter(&mut self, lists: &BlockLists, i: usize) {
        let piece = &lists.pieces[self.index[i] as usize];
        self.front[i] = piece.front - self.shear[i];
        self.back[i] = piece.back - self.shear[i];
        self.rate[i] = piece.rate;
        self.tau[i] = piece.before.tau;
        self.kappa[i] = piece.before.kappa;
        for channel in 0..3 {
            self.e[channel][i] = piece.e[channel];
            self.c[channel][i] = piece.before.c[channel];
        }
    }

    /// Moves on to `depth`, which must not be less than in the previous call.
    #[inline(always)]
    pub(super) fn go_to(&mut self, lists: &BlockLists, depth: f32, out: &mut CollectedLight) {
        self.enter_all(lists, |_, back, _| back <= depth, &mut ());
        self.collected(&[depth; SAMPLES], |depth, front, _| depth > front, out);
    }

    /// Starts at the front of lists, for [`Self::go_to_borders`].
    #[inline(always)]
    pub(super) fn start_at_borders(
        &mut self,
        lists: &BlockLists,
        numbers: &[usize; SAMPLES],
        out: &mut CollectedLight,
    ) {
        self.shear = [0.0; SAMPLES];
        self.border = [f32::NEG_INFINITY; SAMPLES];
        self.start(lists, numbers);
        self.collected(&self.border, |_, _, _| false, out);
    }

    /// Moves on to a depth for each list, or stays if it is already farther. A short end of a segment beyond the
    /// depth stays with the rest. `leaving` learns of the pieces that the walk leaves.
    #[inline(always)]
    pub(super) fn go_to_borders(
        &mut self,
        lists: &BlockLists,
        depth: &SampleColumn,
        out: &mut CollectedLight,
        leaving: &mut impl PieceObserver,
    ) {
        for (border, depth) in self.border.iter_mut().zip(depth) {
            *border = greater(*depth, *border);
        }
        let border = self.border;
        self.enter_all(lists, |front, back, i| is_short_of(border[i], front, back), leaving);
        self.collected(&border, is_within, out);
    }

    /// Leaves the pieces that `is_passed` names, from their front to their back.
    #[inline(always)]
    fn enter_all(
        &mut self,
        lists: &BlockLists,
        is_passed: impl Fn(f32, f32, usize) -> bool,
        leaving: &mut impl PieceObserver,
    ) {
        loop {
            let mut passed = 0u64;
            for i in 0..SAMPLES {
                passed |= u64::from(is_passed(self.front[i], self.back[i], i)) << i;
            }
            if passed == 0 {
                break;
            }
            let mut rest = passed;
            while rest != 0 {
                let i = rest.trailing_zeros() as usize;
                rest &= rest - 1;
                self.last[i] = self.back[i];
                self.index[i] += 1;
                self.enter(lists, i);
            }
            leaving.left(self, passed);
        }
    }

    /// What is collected where pieces begin and the previous ones have ended, without the inverse transmittance.
    #[inline(always)]
    pub(super) fn at_fronts(&self) -> CollectedLight {
        let Self { tau, kappa, c, front: next, last, .. } = *self;
        CollectedLight { tau, kappa, per_kappa: [1.0; SAMPLES], c, next, last }
    }

    /// Whether the piece of list `i` begins in front of the walk's next border.
    #[inline(always)]
    pub(super) fn begins(&self, i: usize) -> bool {
        is_within(self.border[i], self.front[i], self.back[i])
    }

    /// What is collected at these depths, which lie inside of their piece or before it.
    #[inline(always)]
    fn collected(
        &self,
        depth: &SampleColumn,
        is_inside: impl Fn(f32, f32, f32) -> bool,
        out: &mut CollectedLight,
    ) {
        for i in 0..SAMPLES {
            let (front, depth) = (self.front[i], depth[i]);
            let is_inside = is_inside(depth, front, self.back[i]);
            // Infinity minus infinity must give 0.
            let x = select(is_inside, (depth - front) * self.rate[i], 0.0);
            let kappa = transmittance(x);
            let alpha = 1.0 - kappa;
            out.tau[i] = self.tau[i] + x;
            out.kappa[i] = self.kappa[i] * kappa;
            out.per_kappa[i] = 1.0 / select(out.kappa[i] > KAPPA_MIN, out.kappa[i], KAPPA_MIN);
            for channel in 0..3 {
                out.c[channel][i] = self.c[channel][i] + self.kappa[i] * self.e[channel][i] * alpha;
            }
            out.next[i] = select(is_inside, depth, front);
            out.last[i] = select(is_inside, depth, self.last[i]);
        }
    }
}

/// The lists of a block in an order in which any first ones lie evenly spread. Each sixteen of them have two lists of
/// every row and of every column.
const SPREAD: [u8; BLOCK_LISTS] = {
    let mut order = [0; BLOCK_LISTS];
    let mut n = 0;
    while n < BLOCK_LISTS {
        let row = [0, 4, 2, 6, 1, 5, 3, 7][n % 16 / 2];
        let column = [0, 2, 1, 3][row % 4] + [0, 2, 1, 3][n / 16];
        order[n] = (row * BLOCK + n % 2 * 4 + column % 4) as u8;
        n += 1;
    }
    order
};

/// Least optical depth of a segment. The source colour C/α of a thinner one would not be reliable.
pub(super) const TAU_MIN: f32 = 1e-4;
/// An end of a segment that a border cuts off stays with the rest if it is shorter than this share of the segment.
const SNAP: f32 = 0.1;
/// Least transmittance in a division.
const KAPPA_MIN: f32 = 1e-35;

#[cfg(test)]
mod tests {
    use super::super::tests::{frame, slab};
    use super::*;

    #[test]
    fn samples_are_spread_evenly() {
        for part in SPREAD.as_chunks::<SAMPLES>().0 {
            let num = |of: &dyn Fn(usize) -> usize, place| {
                part.iter().filter(|&&list| of(usize::from(list)) == place).count()
            };
            for place in 0..BLOCK {
                assert_eq!([num(&|i| i / BLOCK, place), num(&|i| i % BLOCK, place)], [2, 2]);
            }
        }
        let mut all = SPREAD;
        all.sort_unstable();
        assert_eq!(all, std::array::from_fn(|i| i as u8));
    }

    #[test]
    fn samples_are_of_lists_that_have_segments() {
        for num in [1, 5, SAMPLES, 17, 40, BLOCK_LISTS] {
            let has_segments = |i: usize| i * 37 % BLOCK_LISTS < num;
            let list = |i| if has_segments(i) { vec![slab(i, 20000.0, 500.0, 0.8, 0.7)] } else { vec![] };
            let mut lists = BlockLists::default();
            lists.read(&frame(list), 0, 0);
            let mut found: Vec<_> =
                (0..SAMPLES).map(|i| lists.sampled(i)).filter(|&i| has_segments(i)).collect();
            found.sort_unstable();
            found.dedup();
            assert_eq!(found.len(), num.min(SAMPLES));
            assert_eq!(lists.per_sample(), num as f32 / num.min(SAMPLES) as f32);
        }
    }
}
