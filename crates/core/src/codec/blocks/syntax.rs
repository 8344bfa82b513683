//! The syntax of masks and coefficients, and the contexts of all bits, which choose the estimate of each bit.

use super::entropy::{Coder, Context, NumberContexts, SignedContexts};
use super::model::{BLOCK, BLOCK_LISTS};
use super::prior::PRIOR;

/// The contexts of all bits, in the order of their places in the tables.
#[derive(Clone, Debug)]
pub(super) struct Contexts {
    pub(super) has_planes: [[Context; 3]; 9],
    pub(super) is_copied: [Context; 9],
    pub(super) is_kept: [Context; 9],
    pub(super) is_merged: [Context; 9],
    pub(super) is_above: [Context; 3],
    pub(super) num_layers: [[[Context; 32]; COUNT_CLASSES]; COUNT_CLASSES],
    pub(super) touches: [Context; 2],
    pub(super) depth: [[SignedContexts; DEPTH_CONTEXTS]; 2],
    pub(super) slope: [[SignedContexts; 4]; 2],
    pub(super) has_matter: [[Context; 6]; 3],
    pub(super) is_full: [[Context; 4]; 3],
    pub(super) is_same: [[Context; 2]; 3],
    pub(super) occupancy: [[Context; 256]; 3],
    pub(super) has_correction: [Context; 9],
    pub(super) is_zero: [[[Context; CLASSES + 1]; CLASSES + 1]; COMPONENTS],
    pub(super) class: [[[[Context; 16]; COARSE]; COARSE]; COMPONENTS],
    pub(super) rest: [[Context; 32]; CLASSES],
    pub(super) size: [[[[Context; MAX_UNARY]; 4]; POSITIONS]; COMPONENTS],
    pub(super) escape: NumberContexts,
}

impl Contexts {
    /// All contexts.
    pub(super) fn all() -> &'static Self {
        static ALL: Contexts = {
            let (mut places, mut all) = (ContextPlaces(0), Contexts::NONE);
            places.two(&mut all.has_planes);
            places.one(&mut all.is_copied);
            places.one(&mut all.is_kept);
            places.one(&mut all.is_merged);
            places.one(&mut all.is_above);
            places.three(&mut all.num_layers);
            places.one(&mut all.touches);
            places.signed(&mut all.depth);
            places.signed(&mut all.slope);
            places.two(&mut all.has_matter);
            places.two(&mut all.is_full);
            places.two(&mut all.is_same);
            places.two(&mut all.occupancy);
            places.one(&mut all.has_correction);
            places.three(&mut all.is_zero);
            places.four(&mut all.class);
            places.two(&mut all.rest);
            places.four(&mut all.size);
            places.number(&mut all.escape);
            assert!(places.0 as usize == NUM_CONTEXTS);
            all
        };
        &ALL
    }

    const NONE: Self = {
        let c = Context::EVEN;
        let number = NumberContexts { length: [c; 20], first: [c; 20] };
        let signed = SignedContexts { is_not_zero: c, is_negative: c, size: number };
        Self {
            has_planes: [[c; 3]; 9],
            is_copied: [c; 9],
            is_kept: [c; 9],
            is_merged: [c; 9],
            is_above: [c; 3],
            num_layers: [[[c; 32]; COUNT_CLASSES]; COUNT_CLASSES],
            touches: [c; 2],
            depth: [[signed; DEPTH_CONTEXTS]; 2],
            slope: [[signed; 4]; 2],
            has_matter: [[c; 6]; 3],
            is_full: [[c; 4]; 3],
            is_same: [[c; 2]; 3],
            occupancy: [[c; 256]; 3],
            has_correction: [c; 9],
            is_zero: [[[c; CLASSES + 1]; CLASSES + 1]; COMPONENTS],
            class: [[[[c; 16]; COARSE]; COARSE]; COMPONENTS],
            rest: [[c; 32]; CLASSES],
            size: [[[[c; MAX_UNARY]; 4]; POSITIONS]; COMPONENTS],
            escape: number,
        }
    };

    /// Codes quantised coefficients in zigzag order: their number up to the last that is not zero, and then sizes and
    /// signs. `near` has the classes of the layer in front and of the neighbours, [`NO_CLASS`] for none. Returns the
    /// class.
    pub(super) fn coefficients(
        &self,
        coder: &mut impl Coder,
        component: usize,
        near: [u8; 2],
        levels: &mut Levels,
    ) -> u8 {
        let class = class_of(levels.length);
        let [a, b] = near.map(usize::from);
        if coder.bit(self.is_zero[component][a][b], class == 0) {
            levels.length = 0;
            return 0;
        }
        let contexts = &self.class[component][coarse(a)][coarse(b)];
        let class = (coder.tree(contexts, 4, u32::from(class).wrapping_sub(1)) as usize + 1).min(CLASSES - 1);
        let first = usize::from(CLASS_FIRST[class]);
        let count =
            if class + 1 < CLASSES { usize::from(CLASS_FIRST[class + 1]) } else { BLOCK_LISTS + 1 } - first;
        let rest = if count > 1 {
            let bits = (count - 1).ilog2() + 1;
            let rest = (levels.length as u32).wrapping_sub(first as u32);
            coder.tree(&self.rest[class], bits, rest).min(count as u32 - 1) as usize
        } else {
            0
        };
        let length = first + rest;
        levels.length = length;
        let (mut one, mut two) = (0u32, 0u32);
        for (k, level) in levels.values[..length].iter_mut().enumerate() {
            let activity = (2 * one + two).div_ceil(2).min(3) as usize;
            let contexts = &self.size[component][POSITION[k] as usize][activity];
            // The last coefficient is not zero.
            let least = u32::from(k + 1 == length);
            let size = level.unsigned_abs();
            let mut coded = least + coder.unary(&contexts[least as usize..], size.saturating_sub(least));
            if coded == MAX_UNARY as u32 {
                coded += coder.number(&self.escape, size.saturating_sub(MAX_UNARY as u32));
            }
            let is_negative = coded > 0 && coder.raw(1, u32::from(*level < 0)) == 1;
            *level = if is_negative { -(coded as i32) } else { coded as i32 };
            (one, two) = (coded, one);
        }
        class as u8
    }

    /// Codes the mask of a layer's lists with matter. `before` is the mask of the layer in front, if any, `expected`
    /// that of the moved reference. `beside` has those of the matching layers on the left and above.
    pub(super) fn mask(
        &self,
        coder: &mut impl Coder,
        before: Option<u64>,
        expected: Option<u64>,
        beside: [Option<u64>; 2],
        mask: u64,
    ) -> u64 {
        let reference = expected.map_or(0, |e| 1 + usize::from(e == u64::MAX));
        let shape = before.map_or(0, |b| 1 + usize::from(b == u64::MAX));
        if coder.bit(self.is_full[reference][shape], mask == u64::MAX) {
            return u64::MAX;
        }
        let previous = before.unwrap_or(u64::MAX);
        if before.is_some_and(|b| b != u64::MAX) && coder.bit(self.is_same[reference][0], mask == previous) {
            return previous;
        }
        // List (x, y) is bit x + 1 of row y + 1. Around the block are the masks of the matching layers beside it.
        // Without one, it is the edge of the layer in front.
        let mut rows = [0u16; BLOCK + 1];
        let above = beside[1].map_or(previous & 0xff, |m| m >> (BLOCK_LISTS - BLOCK)) as u16;
        rows[0] = above << 1 | above & 1 | (above & 0x80) << 2;
        let is_edge = beside.map(|m| usize::from(m.is_none()));
        let mut coded = 0u64;
        for y in 0..BLOCK {
            let left = beside[0].map_or(previous >> (y * BLOCK), |m| m >> (y * BLOCK + BLOCK - 1));
            let mut row = (left & 1) as u16;
            for x in 0..BLOCK {
                let i = y * BLOCK + x;
                let context = usize::from(row >> x & 1)
                    | usize::from(rows[y] >> x & 7) << 1
                    | usize::from(previous >> i & 1 == 1) << 4
                    | (usize::from(y == 0) * is_edge[1]) << 5
                    | (usize::from(x == 0) * is_edge[0]) << 6
                    | usize::from(before.is_none()) << 7;
                let reference = expected.map_or(0, |e| 1 + (e >> i & 1) as usize);
                let bit = coder.bit(self.occupancy[reference][context], mask >> i & 1 == 1);
                row |= u16::from(bit) << (x + 1);
                coded |= u64::from(bit) << i;
            }
            rows[y + 1] = row | (row & 0x100) << 1;
        }
        coded
    }
}

/// Gives places to contexts, one after the other.
struct ContextPlaces(u16);

impl ContextPlaces {
    const fn one(&mut self, contexts: &mut [Context]) {
        let mut i = 0;
        while i < contexts.len() {
            contexts[i] = Context(self.0);
            self.0 += 1;
            i += 1;
        }
    }

    const fn two<const N: usize>(&mut self, contexts: &mut [[Context; N]]) {
        self.one(contexts.as_flattened_mut());
    }

    const fn three<const N: usize, const M: usize>(&mut self, contexts: &mut [[[Context; N]; M]]) {
        self.two(contexts.as_flattened_mut());
    }

    const fn four<const N: usize, const M: usize, const L: usize>(
        &mut self,
        contexts: &mut [[[[Context; N]; M]; L]],
    ) {
        self.three(contexts.as_flattened_mut());
    }

    const fn number(&mut self, contexts: &mut NumberContexts) {
        self.one(&mut contexts.length);
        self.one(&mut contexts.first);
    }

    const fn signed<const N: usize>(&mut self, contexts: &mut [[SignedContexts; N]]) {
        let all = contexts.as_flattened_mut();
        let mut i = 0;
        while i < all.len() {
            self.one(std::slice::from_mut(&mut all[i].is_not_zero));
            self.one(std::slice::from_mut(&mut all[i].is_negative));
            self.number(&mut all[i].size);
            i += 1;
        }
    }
}

/// Quantised coefficients.
#[derive(Clone, Debug)]
pub(super) struct Levels {
    /// Coefficients in zigzag order. Those from `length` on mean nothing.
    pub(super) values: [i32; BLOCK_LISTS],
    /// Number of coefficients up to the last that is not zero.
    pub(super) length: usize,
}

impl Levels {
    pub(super) const ZERO: Self = Self { values: [0; BLOCK_LISTS], length: 0 };
}

/// Class of a number of coefficients.
fn class_of(length: usize) -> u8 {
    CLASS_FIRST.iter().rposition(|&first| usize::from(first) <= length).unwrap_or(0) as u8
}

fn coarse(class: usize) -> usize {
    match class {
        0 => 0,
        1..=2 => 1,
        3..=6 => 2,
        12 => 4,
        _ => 3,
    }
}

/// Class of a number of layers.
pub(super) fn count_class(count: usize) -> usize {
    match count {
        0..=2 => count,
        3..=4 => 3,
        5..=7 => 4,
        8..=11 => 5,
        _ => 6,
    }
}

/// The class of a missing layer.
pub(super) const NO_CLASS: u8 = CLASSES as u8;
/// Number of components: opacity, brightness, colour, and the correction's brightness; the first three again with a
/// moved reference, and the correction's colour.
pub(super) const COMPONENTS: usize = 8;
/// Number of contexts of a depth: the difference of two predictions, or their number if there are fewer.
pub(super) const DEPTH_CONTEXTS: usize = 9;
/// Number of contexts.
pub(super) const NUM_CONTEXTS: usize = PRIOR.len();
const COUNT_CLASSES: usize = 7;
const CLASSES: usize = 12;
/// Least number of coefficients of each class.
const CLASS_FIRST: [u8; CLASSES] = [0, 1, 2, 3, 4, 5, 7, 10, 15, 21, 32, 48];
const COARSE: usize = 5;
const POSITIONS: usize = 6;
/// Sizes from here on continue as a number.
const MAX_UNARY: usize = 15;
/// Context of a coefficient's place in zigzag order.
const POSITION: [u8; BLOCK_LISTS] = {
    let mut position = [5; BLOCK_LISTS];
    let mut k = 0;
    while k <= 20 {
        position[k] = match k {
            0 => 0,
            1..=2 => 1,
            3..=5 => 2,
            6..=9 => 3,
            _ => 4,
        };
        k += 1;
    }
    position
};

#[cfg(test)]
mod tests {
    use super::super::entropy::{BitRecorder, Decoder, Tables, Tally, encoded};
    use super::*;

    #[test]
    fn coefficients_and_masks_come_back() {
        let mut recorder = BitRecorder::default();
        let contexts = Contexts::all();
        let planes: Vec<Levels> = (0..200usize)
            .map(|n| {
                let length = n % 65;
                let mut values = [0; BLOCK_LISTS];
                for (k, v) in values[..length].iter_mut().enumerate() {
                    *v = (((n * 31 + k * 17) % 9) as i32 - 4) * if n % 11 == 0 { 7000 } else { 1 };
                }
                if length > 0 {
                    values[length - 1] = if n % 2 == 0 { -1 } else { 40 };
                }
                Levels { values, length }
            })
            .collect();
        let masks: Vec<u64> = (0..50u64)
            .map(|n| if n % 5 == 0 { u64::MAX } else { 0x0f0f_3c3c_7e7e_0001 << (n / 9) })
            .collect();
        let near = |n: usize| [(n % 13) as u8, (n / 3 % 13) as u8];
        for (n, plane) in planes.iter().enumerate() {
            contexts.coefficients(&mut recorder, n % COMPONENTS, near(n), &mut plane.clone());
        }
        let before = |n: usize| n.checked_sub(1).map(|n| masks[n]);
        let expected = |n: usize| (!n.is_multiple_of(3)).then(|| masks[(n + 1) % 50]);
        let beside = |n: usize| [2, 3].map(|m| n.is_multiple_of(m).then(|| masks[(n + m) % 50]));
        for (n, &mask) in masks.iter().enumerate() {
            contexts.mask(&mut recorder, before(n), expected(n), beside(n), mask);
        }
        let bytes = encoded(&recorder.bits, Tables::prior());
        let mut decoder = Decoder::new(&bytes, Tables::prior(), Tally::default());
        for (n, plane) in planes.iter().enumerate() {
            let mut found = Levels::ZERO;
            let class = contexts.coefficients(&mut decoder, n % COMPONENTS, near(n), &mut found);
            assert_eq!(found.values[..found.length], plane.values[..plane.length], "{n}");
            assert_eq!(class, class_of(plane.length));
        }
        for (n, &mask) in masks.iter().enumerate() {
            assert_eq!(contexts.mask(&mut decoder, before(n), expected(n), beside(n), 0), mask);
        }
        assert!(decoder.is_at_end());
    }

    #[test]
    fn every_context_has_a_place_of_its_own() {
        let text = format!("{:?}", Contexts::all());
        let places: Vec<usize> = text
            .split("Context(")
            .skip(1)
            .map(|rest| rest.split(')').next().unwrap().parse().unwrap())
            .collect();
        assert!(places.into_iter().eq(0..NUM_CONTEXTS));
    }

    #[test]
    fn classes_are_those_of_their_first_lengths() {
        for (class, &first) in CLASS_FIRST.iter().enumerate() {
            assert_eq!(usize::from(class_of(first.into())), class);
            assert!(first == 0 || usize::from(class_of(usize::from(first) - 1)) == class - 1);
        }
        assert_eq!(class_of(64), 11);
    }
}
