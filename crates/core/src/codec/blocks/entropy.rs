//! Binary entropy coding with fixed probabilities, by rANS (Duda 2014). A tile is a stream, and no bit waits for the
//! estimate that another one leaves.
//!
//! The syntax is written once, over [`Coder`]. A [`BitRecorder`] notes the values that it is given; a [`Decoder`] ignores
//! them and returns the ones that it reads. So the two cannot disagree. What is noted becomes bytes by [`encoded`], when
//! the probabilities of all contexts are known.

use super::prior::PRIOR;

/// A recorder or a decoder of values.
pub(super) trait Coder {
    /// Whether values come from a frame.
    const ENCODES: bool;

    /// A bit with the probability of a context.
    fn bit(&mut self, context: Context, bit: bool) -> bool;

    /// Whether a decoder has read beyond the end; never for a recorder.
    fn is_overrun(&self) -> bool;

    /// `count` equally likely bits, at most 24, highest first.
    fn raw(&mut self, count: u32, value: u32) -> u32 {
        (0..count).rev().fold(0, |all, i| all << 1 | u32::from(self.bit(Context::EVEN, value >> i & 1 == 1)))
    }

    /// `count` bits, highest first. Each has a context for the bits before it; `contexts` has 2^`count`.
    fn tree(&mut self, contexts: &[Context], count: u32, value: u32) -> u32 {
        let mut node = 1;
        for i in (0..count).rev() {
            let bit = self.bit(contexts[node], value >> i & 1 == 1);
            node = node << 1 | usize::from(bit);
        }
        node as u32 & ((1 << count) - 1)
    }

    /// Number of ones before the first zero, at most one for each context.
    fn unary(&mut self, contexts: &[Context], value: u32) -> u32 {
        for (i, context) in contexts.iter().enumerate() {
            if !self.bit(*context, (i as u32) < value) {
                return i as u32;
            }
        }
        contexts.len() as u32
    }

    /// A number up to 2²⁰: the length of `value` + 1 in bits, and then the bits below the highest. The first of them
    /// has a context. Small numbers take fewer bits.
    fn number(&mut self, contexts: &NumberContexts, value: u32) -> u32 {
        let up = value.min(MAX_NUMBER) + 1;
        let length = self.unary(&contexts.length, up.ilog2());
        if length == 0 {
            return 0;
        }
        let rest = length - 1;
        let first = self.bit(contexts.first[length as usize - 1], up >> rest & 1 == 1);
        let low = self.raw(rest, up & ((1 << rest) - 1));
        (((2 | u32::from(first)) << rest) | low) - 1
    }

    /// A number from −2²⁰ to 2²⁰.
    fn signed(&mut self, contexts: &SignedContexts, value: i32) -> i32 {
        if !self.bit(contexts.is_not_zero, value != 0) {
            return 0;
        }
        let is_negative = self.bit(contexts.is_negative, value < 0);
        let size = self.number(&contexts.size, value.unsigned_abs().saturating_sub(1)) as i32 + 1;
        if is_negative { -size } else { size }
    }
}

/// The place of a bit's probability in the tables.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Context(pub(super) u16);

impl Context {
    /// The context of bits that are equally likely.
    pub(super) const EVEN: Self = Self(EVEN_PLACE);
}

/// The contexts of [`Coder::number`].
#[derive(Clone, Copy, Debug)]
pub(super) struct NumberContexts {
    pub(super) length: [Context; NUMBER_BITS],
    pub(super) first: [Context; NUMBER_BITS],
}

/// The contexts of [`Coder::signed`].
#[derive(Clone, Copy, Debug)]
pub(super) struct SignedContexts {
    pub(super) is_not_zero: Context,
    pub(super) is_negative: Context,
    pub(super) size: NumberContexts,
}

/// A bit and its context, in one word.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct CodedBit(u16);

impl CodedBit {
    fn new(Context(place): Context, bit: bool) -> Self {
        Self(place << 1 | u16::from(bit))
    }

    /// The place of the context, unless the bit is one of the equally likely ones.
    pub(super) fn place(self) -> Option<usize> {
        let place = self.0 >> 1;
        (place != EVEN_PLACE).then_some(usize::from(place))
    }

    pub(super) fn is_one(self) -> bool {
        self.0 & 1 == 1
    }
}

/// The probability of a one in each context, in units of 2⁻¹⁵.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Tables {
    pub(super) ones: Vec<u16>,
}

impl Tables {
    /// The probability of a one in the context of a bit.
    #[inline(always)]
    fn one(&self, bit: CodedBit) -> u32 {
        bit.place().and_then(|place| self.ones.get(place)).map_or(ONE / 2, |one| u32::from(*one))
    }
}

/// Notes all bits of a tile.
#[derive(Clone, Debug, Default)]
pub(super) struct BitRecorder {
    pub(super) bits: Vec<CodedBit>,
}

impl BitRecorder {
    /// How often each context had a zero and a one.
    pub(super) fn tally(&self) -> Tally {
        let mut tally = Tally::default();
        self.bits.iter().for_each(|bit| tally.add(*bit));
        tally
    }
}

impl Coder for BitRecorder {
    const ENCODES: bool = true;

    fn bit(&mut self, context: Context, bit: bool) -> bool {
        self.bits.push(CodedBit::new(context, bit));
        bit
    }

    fn is_overrun(&self) -> bool {
        false
    }
}

/// The bytes of a tile's bits: a state of 32 bits, and words of 16 bits. All are little-endian, in the order in which a
/// decoder reads them.
pub(super) fn encoded(bits: &[CodedBit], tables: &Tables) -> Vec<u8> {
    let mut state = LEAST_STATE;
    let mut words = Vec::with_capacity(bits.len() / 32);
    // The last bit that is coded is the first that is read.
    for bit in bits.iter().rev() {
        let one = tables.one(*bit);
        let (start, width) = if bit.is_one() { (0, one) } else { (one, ONE - one) };
        if u64::from(state) >= u64::from(width) << (32 - PROBABILITY_BITS) {
            words.push(state as u16);
            state >>= 16;
        }
        state = ((state / width) << PROBABILITY_BITS) + state % width + start;
    }
    let mut bytes = state.to_le_bytes().to_vec();
    bytes.extend(words.iter().rev().flat_map(|word| word.to_le_bytes()));
    bytes
}

/// How often each context had a zero and a one.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::codec) struct Tally {
    pub(super) of_places: Vec<[u32; 2]>,
}

impl Default for Tally {
    fn default() -> Self {
        Self { of_places: vec![[0; 2]; PRIOR.len()] }
    }
}

impl Tally {
    /// Adds a bit. The sums do not depend on the order.
    #[inline(always)]
    pub(super) fn add(&mut self, bit: CodedBit) {
        if let Some(counts) = bit.place().and_then(|place| self.of_places.get_mut(place)) {
            let count = &mut counts[usize::from(bit.is_one())];
            *count = count.wrapping_add(1);
        }
    }

    /// Both together.
    pub(in crate::codec) fn and(mut self, other: &Self) -> Self {
        for (counts, others) in
            self.of_places.as_flattened_mut().iter_mut().zip(other.of_places.as_flattened())
        {
            *counts = counts.wrapping_add(*others);
        }
        self
    }
}

/// Reads the bits of a tile. It reads zeros beyond the end of its bytes.
#[derive(Debug)]
pub(super) struct Decoder<'a> {
    state: u32,
    words: &'a [[u8; 2]],
    at: usize,
    tables: &'a Tables,
    /// What was read.
    pub(super) tally: Tally,
}

impl<'a> Decoder<'a> {
    /// A decoder that adds what it reads to a tally.
    pub(super) fn new(bytes: &'a [u8], tables: &'a Tables, tally: Tally) -> Self {
        let words = bytes.as_chunks().0;
        let mut decoder = Self { state: 0, words, at: 0, tables, tally };
        let low = decoder.next();
        decoder.state = low | decoder.next() << 16;
        decoder
    }

    #[inline(always)]
    fn next(&mut self) -> u32 {
        let word = self.words.get(self.at).map_or(0, |word| u16::from_le_bytes(*word));
        self.at += 1;
        word.into()
    }

    /// Whether exactly the bits of an encoder were read.
    pub(super) fn is_at_end(&self) -> bool {
        self.at == self.words.len() && self.state == LEAST_STATE
    }
}

impl Coder for Decoder<'_> {
    const ENCODES: bool = false;

    #[inline(always)]
    fn bit(&mut self, context: Context, _: bool) -> bool {
        let one = self.tables.one(CodedBit::new(context, false));
        let low = self.state & (ONE - 1);
        let bit = low < one;
        let (start, width) = if bit { (0, one) } else { (one, ONE - one) };
        // The product has at most 32 bits: a state of s becomes at most s.
        self.state = width * (self.state >> PROBABILITY_BITS) + low - start;
        if self.state < LEAST_STATE {
            self.state = self.state << 16 | self.next();
        }
        self.tally.add(CodedBit::new(context, bit));
        bit
    }

    fn is_overrun(&self) -> bool {
        self.at > self.words.len()
    }
}

pub(super) const PROBABILITY_BITS: u32 = 15;
/// Certainty, in the unit of probabilities.
pub(super) const ONE: u32 = 1 << PROBABILITY_BITS;
/// States are from here to 2³² − 1 between two bits.
const LEAST_STATE: u32 = 1 << 16;
const EVEN_PLACE: u16 = u16::MAX >> 1;
const NUMBER_BITS: usize = 20;
const MAX_NUMBER: u32 = (1 << NUMBER_BITS) - 2;

#[cfg(test)]
mod tests {
    use super::super::tables::Counts;
    use super::*;

    const NUMBER: NumberContexts = NumberContexts { length: [Context(40); 20], first: [Context(41); 20] };
    const SIGNED: SignedContexts =
        SignedContexts { is_not_zero: Context(42), is_negative: Context(43), size: NUMBER };

    /// A walk over all forms of coding, the same in both directions.
    fn walk(coder: &mut impl Coder, values: &mut [i32]) {
        let tree: [Context; 32] = std::array::from_fn(|i| Context(i as u16));
        let unary: [Context; 7] = std::array::from_fn(|i| Context(50 + i as u16));
        for (i, v) in values.iter_mut().enumerate() {
            *v = match i % 5 {
                0 => i32::from(coder.bit(Context(60 + (i / 5 % 2) as u16), *v != 0)),
                1 => coder.tree(&tree, 5, *v as u32) as i32,
                2 => coder.unary(&unary, *v as u32) as i32,
                3 => coder.signed(&SIGNED, *v),
                _ => coder.raw(13, *v as u32) as i32,
            };
        }
    }

    fn values(n: usize) -> Vec<i32> {
        let mut seed = 7u64;
        let mut random = || {
            seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (seed >> 33) as i32
        };
        (0..n)
            .map(|i| match i % 5 {
                0 => i32::from(random() % 50 == 0),
                1 => random() % 32,
                2 => random() % 8,
                3 => (random() % (1 << 20)) >> (random() % 21) << (random() % 2) >> 1,
                _ => random() % 8192,
            })
            .map(|v| if v % 3 == 1 { v } else { v.abs() })
            .collect()
    }

    #[test]
    fn what_goes_in_comes_out_and_every_byte_is_read() {
        for n in [0, 1, 5, 400, 20_000] {
            let mut wanted = values(n);
            if n > 0 {
                wanted.iter_mut().skip(3).step_by(5).step_by(7).for_each(|v| *v = -((1 << 20) - 1));
            }
            let mut recorder = BitRecorder::default();
            walk(&mut recorder, &mut wanted.clone());
            let counts = Counts::default().with(&recorder.tally());
            for tables in [Tables::prior(), &counts.tables()] {
                let bytes = encoded(&recorder.bits, tables);
                let mut decoder = Decoder::new(&bytes, tables, Tally::default());
                let mut found = vec![0; n];
                walk(&mut decoder, &mut found);
                assert_eq!((&found, &decoder.tally), (&wanted, &recorder.tally()));
                assert!(decoder.is_at_end() && !decoder.is_overrun());
                if n > 400 {
                    let mut decoder = Decoder::new(&bytes[..bytes.len() - 10], tables, Tally::default());
                    walk(&mut decoder, &mut found);
                    assert!(decoder.is_overrun() && !decoder.is_at_end());
                    // The control: another bit gives other values.
                    let mut damaged = bytes.clone();
                    damaged[n / 3] ^= 4;
                    walk(&mut Decoder::new(&damaged, tables, Tally::default()), &mut found);
                    assert_ne!(found, wanted);
                }
            }
        }
    }

    #[test]
    fn bytes_come_near_to_the_entropy() {
        let n = 40_000;
        let mut recorder = BitRecorder::default();
        let mut ones = 0;
        for v in values(5 * n).into_iter().step_by(5) {
            ones += v;
            recorder.bit(Context(3), v != 0);
        }
        let p = f64::from(ones) / n as f64;
        let entropy = -(p * p.log2() + (1.0 - p) * (1.0 - p).log2()) * n as f64 / 8.0;
        let counts = Counts::default().with(&recorder.tally());
        let found = encoded(&recorder.bits, &counts.tables()).len() as f64;
        assert!(found < 1.01 * entropy && found > 0.99 * entropy, "{found} {entropy}");
        // The control: the prior fits worse.
        assert!(encoded(&recorder.bits, Tables::prior()).len() as f64 > 1.05 * entropy);
    }
}
