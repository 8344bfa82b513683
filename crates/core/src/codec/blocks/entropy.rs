//! Adaptive binary range coding (Martin 1979, in the byte-wise form of LZMA). Estimates move by 1/(n + 1.5) at the
//! n-th bit. So a new context learns within a few bits, and an old one is steady.
//!
//! The syntax is written once, over [`Coder`]. An encoder writes the values that it is given; a decoder ignores them
//! and returns the ones that it reads. So the two cannot disagree.

/// An encoder or a decoder of values.
pub(super) trait Coder {
    /// Whether this is an encoder.
    const ENCODES: bool;

    /// A bit with an estimate, which learns from it.
    fn bit(&mut self, model: &mut Model, bit: bool) -> bool;

    /// `count` equally likely bits, at most 24, highest first.
    fn raw(&mut self, count: u32, value: u32) -> u32;

    /// Whether a decoder has read beyond the end; never for an encoder.
    fn is_overrun(&self) -> bool;

    /// `count` bits, highest first. Each has an estimate for the bits before it; `models` has 2^`count`.
    fn tree(&mut self, models: &mut [Model], count: u32, value: u32) -> u32 {
        let mut node = 1;
        for i in (0..count).rev() {
            let bit = self.bit(&mut models[node], value >> i & 1 == 1);
            node = node << 1 | usize::from(bit);
        }
        node as u32 & ((1 << count) - 1)
    }

    /// Number of ones before the first zero, at most one for each model.
    fn unary(&mut self, models: &mut [Model], value: u32) -> u32 {
        for (i, model) in models.iter_mut().enumerate() {
            if !self.bit(model, (i as u32) < value) {
                return i as u32;
            }
        }
        models.len() as u32
    }

    /// A number up to 2²⁰: the length of `value` + 1 in bits, and then the bits below the highest. The first of them
    /// has an estimate. Small numbers take fewer bits.
    fn number(&mut self, models: &mut NumberModels, value: u32) -> u32 {
        let up = value.min(MAX_NUMBER) + 1;
        let length = self.unary(&mut models.length, up.ilog2());
        if length == 0 {
            return 0;
        }
        let rest = length - 1;
        let first = self.bit(&mut models.first[length as usize - 1], up >> rest & 1 == 1);
        let low = self.raw(rest, up & ((1 << rest) - 1));
        (((2 | u32::from(first)) << rest) | low) - 1
    }

    /// A number from −2²⁰ to 2²⁰.
    fn signed(&mut self, models: &mut SignedModels, value: i32) -> i32 {
        if !self.bit(&mut models.is_not_zero, value != 0) {
            return 0;
        }
        let is_negative = self.bit(&mut models.is_negative, value < 0);
        let size = self.number(&mut models.size, value.unsigned_abs().saturating_sub(1)) as i32 + 1;
        if is_negative { -size } else { size }
    }
}

/// The probability of a one, and the number of bits that it has learnt from.
#[derive(Clone, Copy, Debug)]
pub(super) struct Model {
    /// Probability in units of 2⁻¹⁶.
    one: u16,
    seen: u16,
}

impl Model {
    pub(super) const START: Self = Self { one: 1 << 15, seen: 0 };

    /// An estimate that counts as learnt from `seen` bits.
    pub(super) const fn trained(one: u16, seen: u16) -> Self {
        Self { one, seen }
    }

    /// Probability in units of 2⁻¹⁵, away from 0 and 1.
    fn probability(self) -> u32 {
        (u32::from(self.one) >> 1).clamp(LEAST, (1 << PROBABILITY_BITS) - LEAST)
    }

    fn learn(&mut self, bit: bool) {
        let goal = if bit { 0xffff } else { 0 };
        let change = ((goal - i32::from(self.one)) * RATES[usize::from(self.seen)]) >> RATE_BITS;
        self.one = (i32::from(self.one) + change) as u16;
        self.seen = (self.seen + 1).min(RATES.len() as u16 - 1);
    }
}

/// Models in a fixed order.
pub(super) trait Models {
    /// Sets each model.
    fn set(&mut self, next: &mut dyn FnMut() -> Model);
}

impl Models for Model {
    fn set(&mut self, next: &mut dyn FnMut() -> Model) {
        *self = next();
    }
}

impl<M: Models, const N: usize> Models for [M; N] {
    fn set(&mut self, next: &mut dyn FnMut() -> Model) {
        self.iter_mut().for_each(|models| models.set(next));
    }
}

/// The models of [`Coder::number`].
#[derive(Clone, Copy, Debug)]
pub(super) struct NumberModels {
    length: [Model; NUMBER_BITS],
    first: [Model; NUMBER_BITS],
}

impl NumberModels {
    pub(super) const START: Self =
        Self { length: [Model::START; NUMBER_BITS], first: [Model::START; NUMBER_BITS] };
}

impl Models for NumberModels {
    fn set(&mut self, next: &mut dyn FnMut() -> Model) {
        self.length.set(next);
        self.first.set(next);
    }
}

/// The models of [`Coder::signed`].
#[derive(Clone, Copy, Debug)]
pub(super) struct SignedModels {
    is_not_zero: Model,
    is_negative: Model,
    size: NumberModels,
}

impl SignedModels {
    pub(super) const START: Self =
        Self { is_not_zero: Model::START, is_negative: Model::START, size: NumberModels::START };
}

impl Models for SignedModels {
    fn set(&mut self, next: &mut dyn FnMut() -> Model) {
        self.is_not_zero.set(next);
        self.is_negative.set(next);
        self.size.set(next);
    }
}

/// The encoder.
#[derive(Debug)]
pub(super) struct Encoder {
    low: u64,
    range: u32,
    /// The last byte that a carry can change. With the 0xff bytes after it, there are `num_held` bytes.
    held: u8,
    num_held: u32,
    bytes: Vec<u8>,
}

impl Encoder {
    pub(super) fn new() -> Self {
        Self { low: 0, range: u32::MAX, held: 0, num_held: 1, bytes: Vec::new() }
    }

    /// Returns all bytes.
    pub(super) fn finish(mut self) -> Vec<u8> {
        for _ in 0..5 {
            self.shift();
        }
        // The byte held before the first one is always 0.
        self.bytes.remove(0);
        self.bytes
    }

    fn shift(&mut self) {
        let carry = (self.low >> 32) as u8;
        if carry == 1 || self.low < 0xff00_0000 {
            self.bytes.push(self.held.wrapping_add(carry));
            for _ in 1..self.num_held {
                self.bytes.push(0xffu8.wrapping_add(carry));
            }
            self.held = (self.low >> 24) as u8;
            self.num_held = 0;
        }
        self.num_held += 1;
        self.low = (self.low & 0x00ff_ffff) << 8;
    }
}

impl Coder for Encoder {
    const ENCODES: bool = true;

    fn bit(&mut self, model: &mut Model, bit: bool) -> bool {
        let bound = (self.range >> PROBABILITY_BITS) * model.probability();
        if bit {
            self.range = bound;
        } else {
            self.low += u64::from(bound);
            self.range -= bound;
        }
        model.learn(bit);
        while self.range < 1 << 24 {
            self.range <<= 8;
            self.shift();
        }
        bit
    }

    fn raw(&mut self, count: u32, value: u32) -> u32 {
        for i in (0..count).rev() {
            self.range >>= 1;
            if value >> i & 1 == 1 {
                self.low += u64::from(self.range);
            }
            while self.range < 1 << 24 {
                self.range <<= 8;
                self.shift();
            }
        }
        value
    }

    fn is_overrun(&self) -> bool {
        false
    }
}

/// The decoder. It reads zeros beyond the end of its bytes.
#[derive(Debug)]
pub(super) struct Decoder<'a> {
    code: u32,
    range: u32,
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Decoder<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        let mut decoder = Self { code: 0, range: u32::MAX, bytes, at: 0 };
        for _ in 0..4 {
            decoder.code = decoder.code << 8 | decoder.next();
        }
        decoder
    }

    fn next(&mut self) -> u32 {
        let byte = self.bytes.get(self.at).copied().unwrap_or(0);
        self.at += 1;
        byte.into()
    }
}

impl Coder for Decoder<'_> {
    const ENCODES: bool = false;

    fn bit(&mut self, model: &mut Model, _: bool) -> bool {
        let bound = (self.range >> PROBABILITY_BITS) * model.probability();
        let bit = self.code < bound;
        if bit {
            self.range = bound;
        } else {
            self.code -= bound;
            self.range -= bound;
        }
        model.learn(bit);
        while self.range < 1 << 24 {
            self.range <<= 8;
            self.code = self.code << 8 | self.next();
        }
        bit
    }

    fn raw(&mut self, count: u32, _: u32) -> u32 {
        let mut value = 0;
        for _ in 0..count {
            self.range >>= 1;
            let bit = self.code >= self.range;
            if bit {
                self.code -= self.range;
            }
            value = value << 1 | u32::from(bit);
            while self.range < 1 << 24 {
                self.range <<= 8;
                self.code = self.code << 8 | self.next();
            }
        }
        value
    }

    fn is_overrun(&self) -> bool {
        self.at > self.bytes.len()
    }
}

impl Decoder<'_> {
    /// Whether exactly the bytes of an encoder were read.
    pub(super) fn is_at_end(&self) -> bool {
        self.at == self.bytes.len()
    }
}

const PROBABILITY_BITS: u32 = 15;
/// Least probability of either bit, in units of 2⁻¹⁵. The likely one then takes 0.002 bits.
const LEAST: u32 = 24;
/// Steps of an estimate in units of 2⁻¹⁴: 1/(n + 1.5).
const RATES: [i32; MAX_SEEN] = {
    let mut rates = [0; MAX_SEEN];
    let mut n = 0;
    while n < MAX_SEEN {
        rates[n] = (2 << RATE_BITS) / (2 * n as i32 + 3);
        n += 1;
    }
    rates
};
const RATE_BITS: u32 = 14;
/// After this number of bits, the steps of an estimate stay the same. It is steady but follows the picture.
const MAX_SEEN: usize = 80;
const NUMBER_BITS: usize = 20;
const MAX_NUMBER: u32 = (1 << NUMBER_BITS) - 2;

#[cfg(test)]
mod tests {
    use super::*;

    /// A walk over all forms of coding, the same in both directions.
    fn walk(coder: &mut impl Coder, values: &mut [i32]) {
        let mut bit = [Model::START; 2];
        let mut tree = [Model::START; 32];
        let mut unary = [Model::START; 7];
        let mut signed = SignedModels::START;
        for (i, v) in values.iter_mut().enumerate() {
            *v = match i % 5 {
                0 => i32::from(coder.bit(&mut bit[i / 5 % 2], *v != 0)),
                1 => coder.tree(&mut tree, 5, *v as u32) as i32,
                2 => coder.unary(&mut unary, *v as u32) as i32,
                3 => coder.signed(&mut signed, *v),
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
                // The extremes of a signed number, and runs that carry.
                wanted.iter_mut().skip(3).step_by(5).step_by(7).for_each(|v| *v = -((1 << 20) - 1));
            }
            let mut encoder = Encoder::new();
            walk(&mut encoder, &mut wanted.clone());
            let bytes = encoder.finish();
            let mut decoder = Decoder::new(&bytes);
            let mut found = vec![0; n];
            walk(&mut decoder, &mut found);
            assert_eq!(found, wanted);
            assert!(decoder.is_at_end() && !decoder.is_overrun());
            if n > 400 {
                let mut decoder = Decoder::new(&bytes[..bytes.len() - 9]);
                walk(&mut decoder, &mut found);
                assert!(decoder.is_overrun() && !decoder.is_at_end());
            }
        }
    }

    #[test]
    fn bytes_come_near_to_the_entropy() {
        let n = 40_000;
        let mut encoder = Encoder::new();
        let mut model = Model::START;
        let mut ones = 0;
        for v in values(5 * n).into_iter().step_by(5) {
            ones += v;
            encoder.bit(&mut model, v != 0);
        }
        let p = f64::from(ones) / n as f64;
        let entropy = -(p * p.log2() + (1.0 - p) * (1.0 - p).log2()) * n as f64 / 8.0;
        let found = encoder.finish().len() as f64;
        // An estimate that moves by 1/80 of the error is off by so much that a bit in fifty costs some 5 % more.
        assert!(found < 1.06 * entropy && found > 0.98 * entropy, "{found} {entropy}");
    }
}
