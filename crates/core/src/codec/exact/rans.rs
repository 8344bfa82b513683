//! The entropy stage of the exact coding: static range asymmetric numeral systems (Duda 2013) with a table for each
//! context.
//!
//! Numbers become *tokens* and raw bits (`token`). Each small number is a token; larger ones share a token with their
//! half of an octave. The tokens of a plane are one stream with one 32-bit state, renewed by 16 bits at a time.
//! Frequencies sum to 2¹². A decoder finds a token by the alias method (Walker 1977; Vose 1991), as JPEG XL does: the
//! 4096 slots are 64 buckets of 64, and a bucket holds slots of its own token and of one other. A table has about a
//! kilobyte, so tables in use stay in the first caches. Finding a token takes no search and no branch.
//!
//! Decoding is total: any number is a state, and a stream that has ended gives zeros. At the end,
//! [`TokenStream::ended`] tells whether an encoder made the stream.

use std::hint::select_unpredictable;

/// Number of tokens in a table.
pub(super) const TOKENS: usize = 64;
/// Sum of the frequencies of a table.
const SLOTS: u32 = 1 << SLOT_BITS;
const SLOT_BITS: u32 = 12;
/// Number of slots in a bucket.
const BUCKET: u32 = SLOTS / TOKENS as u32;
const BUCKET_BITS: u32 = 6;
/// Number of bits for the least number of a token in [`NUMBERS`].
const NUMBER_BITS: u32 = 24;
const LEAST_NUMBER: u32 = (1 << NUMBER_BITS) - 1;
/// Least state between two tokens, and the initial state of an encoder.
const LEAST_STATE: u32 = 1 << 16;
/// Numbers below this are tokens of their own.
const SMALL: u32 = 16;

/// How often each token occurs.
pub(super) type TokenCounts = [u32; TOKENS];
/// Frequencies of the tokens, summing to 2¹².
pub(super) type Frequencies = [u16; TOKENS];

/// The token of a number below 2¹⁷, how many raw bits follow it, and those bits.
pub(super) fn token(number: u32) -> (u8, u32, u32) {
    // A branch would be hard to predict.
    let octave = (number | (SMALL - 1)).ilog2();
    let bits = select_unpredictable(number < SMALL, 0, octave - 1);
    let first = select_unpredictable(number < SMALL, 0, SMALL - 10 + 2 * octave);
    ((first + (number >> bits)) as u8, bits, number & ((1 << bits) - 1))
}

/// For each token the least number, in the low [`NUMBER_BITS`], and the number of raw bits that complete it. Unused
/// tokens repeat the greatest used one.
static NUMBERS: [u32; TOKENS] = {
    let mut numbers = [0; TOKENS];
    let mut token = 0;
    while token < TOKENS as u32 {
        numbers[token as usize] = if token < SMALL {
            token
        } else {
            let capped = if token < 42 { token } else { 41 };
            let bits = 3 + (capped - SMALL) / 2;
            (2 + capped % 2) << bits | bits << NUMBER_BITS
        };
        token += 1;
    }
    numbers
};

/// Frequencies in proportion to the counts. Every token that occurs has at least 1. Without any count, token 0 has
/// all.
pub(super) fn frequencies(counts: &TokenCounts) -> Frequencies {
    let total: u64 = counts.iter().map(|&c| u64::from(c)).sum();
    let mut out = [0; TOKENS];
    if total == 0 {
        out[0] = SLOTS as u16;
        return out;
    }
    let mut sum = 0;
    for (frequency, &count) in out.iter_mut().zip(counts) {
        if count > 0 {
            *frequency = ((u64::from(count) * u64::from(SLOTS) + total / 2) / total).max(1) as u16;
            sum += u32::from(*frequency);
        }
    }
    // The most frequent tokens take what rounding left over or overspent, because it matters least there.
    while sum != SLOTS {
        let Some(most) = out.iter_mut().max() else { break };
        let excess = sum.saturating_sub(SLOTS).min(u32::from(*most) / 2);
        *most = (u32::from(*most) - excess + SLOTS.saturating_sub(sum)) as u16;
        sum = sum - excess + SLOTS.saturating_sub(sum);
    }
    out
}

/// Number of bits that [`BitWriter::frequencies`] writes.
pub(super) fn frequency_bits(frequencies: &Frequencies) -> u32 {
    let last = last_token(frequencies);
    let bits = |&f: &u16| CLASS_BITS + class(f).saturating_sub(1);
    TOKEN_BITS + frequencies[..last].iter().map(bits).sum::<u32>()
}

fn last_token(frequencies: &Frequencies) -> usize {
    frequencies.iter().rposition(|&f| f > 0).unwrap_or(0)
}

/// Bits of a number without leading zeros.
fn class(frequency: u16) -> u32 {
    u16::BITS - frequency.leading_zeros()
}

const TOKEN_BITS: u32 = 6;
const CLASS_BITS: u32 = 4;

/// Distribution of a table's slots over buckets.
struct Alias {
    /// Number of a bucket's own slots. They come first, in order.
    cutoff: [u16; TOKENS],
    /// The token of the other slots.
    other: [u8; TOKENS],
    /// Index of the first of these among the slots of that token.
    start: [u16; TOKENS],
}

impl Alias {
    /// Buckets with too few slots of their own token take the rest from the token that last had too many.
    fn new(frequencies: &Frequencies) -> Self {
        let mut cutoff = *frequencies;
        let mut other: [u8; TOKENS] = std::array::from_fn(|i| i as u8);
        let mut start = [0; TOKENS];
        let bucket = BUCKET as u16;
        let (mut over, mut under) = (Vec::with_capacity(TOKENS), Vec::with_capacity(TOKENS));
        for (token, &frequency) in frequencies.iter().enumerate() {
            match frequency.cmp(&bucket) {
                std::cmp::Ordering::Greater => over.push(token),
                std::cmp::Ordering::Less => under.push(token),
                std::cmp::Ordering::Equal => {}
            }
        }
        while let (Some(&giver), Some(taker)) = (over.last(), under.pop()) {
            cutoff[giver] -= bucket - cutoff[taker];
            other[taker] = giver as u8;
            start[taker] = cutoff[giver];
            if cutoff[giver] <= bucket {
                over.pop();
                if cutoff[giver] < bucket {
                    under.push(giver);
                }
            }
        }
        Self { cutoff, other, start }
    }
}

/// A table for decoding, by buckets.
#[derive(Clone)]
#[repr(align(64))]
pub(super) struct DecodeTable {
    /// Slots of a bucket below this belong to its own token.
    cutoffs: [u8; TOKENS],
    /// Meaning of a bucket's own slots, and of the others.
    meanings: [[Meaning; 2]; TOKENS],
}

/// The meaning of a slot.
#[derive(Clone, Copy)]
#[repr(C, align(8))]
struct Meaning {
    /// The token's entry of [`NUMBERS`].
    number: u32,
    frequency: u16,
    /// Difference between a slot's index among those of its token and its place in the bucket.
    add: i16,
}

impl DecodeTable {
    /// Makes the table of these frequencies.
    pub(super) fn new(frequencies: &Frequencies) -> Self {
        let Alias { cutoff, other, start } = Alias::new(frequencies);
        let meaning =
            |token: usize, add: i16| Meaning { number: NUMBERS[token], frequency: frequencies[token], add };
        Self {
            cutoffs: cutoff.map(|cutoff| cutoff as u8),
            meanings: std::array::from_fn(|i| {
                [meaning(i, 0), meaning(other[i].into(), start[i] as i16 - cutoff[i] as i16)]
            }),
        }
    }
}

/// The tables of many contexts for encoding.
#[derive(Default)]
pub(super) struct EncodeTables {
    /// [`TOKENS`] entries for each context.
    tokens: Vec<EncodeToken>,
    /// The slots of each table, ordered by token.
    slots: Vec<u16>,
}

/// A token in a context.
#[derive(Clone, Copy, Default)]
struct EncodeToken {
    /// ⌊2⁴⁴/f⌋ + 1. Its product with a state x < f·2²⁰ is below 2⁶⁴, and exceeds 2⁴⁴·x/f by at most x, which is below
    /// 2⁴⁴/f. So the upper bits are ⌊x/f⌋.
    inverse: u64,
    /// Its frequency f, at least 1.
    frequency: u32,
    /// Index of its first slot.
    first: u32,
}

impl EncodeTables {
    /// Forgets all tables.
    pub(super) fn clear(&mut self) {
        self.tokens.clear();
        self.slots.clear();
    }

    /// Appends a table that this many contexts share.
    pub(super) fn add(&mut self, frequencies: &Frequencies, num_contexts: usize) {
        let first_slot = self.slots.len();
        let first_token = self.tokens.len();
        let mut sum = first_slot as u32;
        self.tokens.extend(frequencies.iter().map(|&frequency| {
            let first = sum;
            sum += u32::from(frequency);
            let frequency = u32::from(frequency.max(1));
            EncodeToken { inverse: (1 << 44) / u64::from(frequency) + 1, frequency, first }
        }));
        self.slots.resize(first_slot + SLOTS as usize, 0);
        let (tokens, slots) = (&self.tokens[first_token..], &mut self.slots);
        let alias = Alias::new(frequencies);
        for bucket in 0..TOKENS {
            let cutoff = alias.cutoff[bucket];
            let first = bucket as u16 * BUCKET as u16;
            let mut fill = |token: usize, number: u16, slots_of_bucket: std::ops::Range<u16>| {
                let to = tokens[token].first as usize + usize::from(number);
                for (slot, i) in slots[to..].iter_mut().zip(slots_of_bucket) {
                    *slot = first + i;
                }
            };
            fill(bucket, 0, 0..cutoff);
            fill(alias.other[bucket].into(), alias.start[bucket], cutoff..BUCKET as u16);
        }
        for _ in 1..num_contexts {
            self.tokens.extend_from_within(first_token..first_token + TOKENS);
        }
    }

    /// Codes planes with the same number of tokens side by side, last tokens first. A token is given as 64 times its
    /// context in the plane plus itself. Each plane comes with 64 times its first context. Every token must occur in
    /// its table.
    pub(super) fn push<const N: usize>(
        &self,
        mut writers: [&mut TokenWriter; N],
        planes: [(&[u16], usize); N],
    ) {
        let num_tokens = planes.iter().map(|(symbols, _)| symbols.len()).min().unwrap_or(0);
        let planes = planes.map(|(symbols, first)| (&symbols[..num_tokens], &self.tokens[first..]));
        let mut states = writers.each_ref().map(|writer| writer.state);
        for writer in &mut writers {
            writer.words.clear();
            // At most one word a token; the last ones come first.
            writer.words.resize(num_tokens, 0);
        }
        let words = writers.each_mut().map(|writer| &mut writer.words[..num_tokens]);
        let mut at = [0; N];
        for number in (0..num_tokens).rev() {
            for plane in 0..N {
                let (symbols, tokens) = planes[plane];
                let token = &tokens[usize::from(symbols[number])];
                let state = states[plane];
                words[plane][at[plane]] = state as u16;
                let is_high = u64::from(state) >= u64::from(token.frequency) << (32 - SLOT_BITS);
                at[plane] += usize::from(is_high);
                let state = select_unpredictable(is_high, state >> 16, state);
                let quotient = (u64::from(state).wrapping_mul(token.inverse) >> 44) as u32;
                let rest = state.wrapping_sub(quotient.wrapping_mul(token.frequency));
                let slot = self.slots[(token.first + rest) as usize];
                states[plane] = quotient << SLOT_BITS | u32::from(slot);
            }
        }
        for plane in 0..N {
            writers[plane].state = states[plane];
            writers[plane].words.truncate(at[plane]);
        }
    }
}

/// Writes the tokens of a plane, last token first.
pub(super) struct TokenWriter {
    state: u32,
    words: Vec<u16>,
}

impl Default for TokenWriter {
    fn default() -> Self {
        Self { state: LEAST_STATE, words: vec![] }
    }
}

impl TokenWriter {
    /// Appends the stream to `bytes` and begins another.
    pub(super) fn finish(&mut self, bytes: &mut Vec<u8>) {
        bytes.extend_from_slice(&self.state.to_le_bytes());
        bytes.extend(self.words.iter().rev().flat_map(|word| word.to_le_bytes()));
        self.words.clear();
        self.state = LEAST_STATE;
    }
}

/// Writes bits, lowest first.
#[derive(Default)]
pub(super) struct BitWriter {
    bytes: Vec<u8>,
    pending: u64,
    num_pending: u32,
}

impl BitWriter {
    /// Appends the low `count` bits of a number, at most 32. Its other bits must be zero.
    #[inline]
    pub(super) fn push(&mut self, bits: u32, count: u32) {
        self.pending |= u64::from(bits) << self.num_pending;
        self.num_pending += count;
        if self.num_pending >= 32 {
            self.bytes.extend_from_slice(&(self.pending as u32).to_le_bytes());
            self.pending >>= 32;
            self.num_pending -= 32;
        }
    }

    /// Appends frequencies: the last token that occurs, then for each token before it the length in bits and the bits
    /// below the highest. The last frequency follows from the sum.
    pub(super) fn frequencies(&mut self, frequencies: &Frequencies) {
        let last = last_token(frequencies);
        self.push(last as u32, TOKEN_BITS);
        for &frequency in &frequencies[..last] {
            let class = class(frequency);
            self.push(class, CLASS_BITS);
            if class > 1 {
                self.push(u32::from(frequency) ^ 1 << (class - 1), class - 1);
            }
        }
    }

    /// Appends the bits to `bytes`, padded with zeros to whole bytes, and starts again.
    pub(super) fn finish(&mut self, bytes: &mut Vec<u8>) {
        bytes.extend_from_slice(&self.bytes);
        bytes.extend_from_slice(&self.pending.to_le_bytes()[..self.num_pending.div_ceil(8) as usize]);
        self.bytes.clear();
        (self.pending, self.num_pending) = (0, 0);
    }
}

/// Reads bits, lowest first; zeros after the end.
#[derive(Default)]
pub(super) struct BitReader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> BitReader<'a> {
    /// Starts at the first bit.
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0 }
    }

    /// The next `count` bits, at most 25.
    #[inline(always)]
    pub(super) fn take(&mut self, count: u32) -> u32 {
        let byte = self.at / 8;
        let word = match self.bytes.get(byte..byte + 4).map(<[u8; 4]>::try_from) {
            Some(Ok(word)) => u32::from_le_bytes(word),
            _ => last_word(self.bytes, byte),
        };
        let bits = word >> (self.at % 8) & ((1 << count) - 1);
        self.at += count as usize;
        bits
    }

    /// Whether the last bit taken lies in the last byte.
    pub(super) fn ended(&self) -> bool {
        self.at.div_ceil(8) == self.bytes.len()
    }

    /// Inverse of [`BitWriter::frequencies`]. The error says what is wrong.
    pub(super) fn frequencies(&mut self) -> Result<Frequencies, &'static str> {
        let mut frequencies = [0; TOKENS];
        let last = self.take(TOKEN_BITS) as usize;
        let mut left = SLOTS;
        for frequency in &mut frequencies[..last] {
            let class = self.take(CLASS_BITS);
            if class > SLOT_BITS {
                return Err("a frequency is too large");
            }
            if class > 0 {
                let value = 1 << (class - 1) | self.take(class - 1);
                *frequency = value as u16;
                left = left.saturating_sub(value);
            }
        }
        if left == 0 {
            return Err("the frequencies of a table sum to more than 4096");
        }
        frequencies[last] = left as u16;
        Ok(frequencies)
    }
}

#[cold]
fn last_word(bytes: &[u8], byte: usize) -> u32 {
    u32::from_le_bytes(std::array::from_fn(|i| bytes.get(byte + i).copied().unwrap_or(0)))
}

/// Reads the numbers of a plane from its tokens and raw bits.
pub(super) struct TokenStream<'a> {
    state: u32,
    words: &'a [[u8; 2]],
    at: usize,
    raw: BitReader<'a>,
}

impl Default for TokenStream<'_> {
    /// A reader without numbers.
    fn default() -> Self {
        Self { state: LEAST_STATE, words: &[], at: 0, raw: BitReader::default() }
    }
}

impl<'a> TokenStream<'a> {
    /// Starts at the first number. `tokens` comes from [`TokenWriter::finish`], `raw` from [`BitWriter::finish`].
    pub(super) fn new(tokens: &'a [u8], raw: &'a [u8]) -> Self {
        let (state, words) = tokens.split_first_chunk().unwrap_or((&[0; 4], &[]));
        let (words, odd) = words.as_chunks();
        Self { state: u32::from_le_bytes(*state), words, at: odd.len(), raw: BitReader::new(raw) }
    }

    /// The next number.
    #[inline(always)]
    pub(super) fn next(&mut self, table: &DecodeTable) -> u32 {
        let least = self.token(table);
        (least & LEAST_NUMBER) + self.raw.take(least >> NUMBER_BITS)
    }

    /// The next number, which probably has no raw bits.
    #[inline(always)]
    pub(super) fn next_small(&mut self, table: &DecodeTable) -> u32 {
        let least = self.token(table);
        if least < SMALL {
            return least;
        }
        (least & LEAST_NUMBER) + self.raw.take(least >> NUMBER_BITS)
    }

    /// The next token's entry of [`NUMBERS`].
    #[inline(always)]
    fn token(&mut self, table: &DecodeTable) -> u32 {
        let bucket = (self.state >> BUCKET_BITS) as usize % TOKENS;
        let within = self.state % BUCKET;
        let is_other = within >= table.cutoffs[bucket].into();
        let Meaning { number, frequency, add } = table.meanings[bucket][usize::from(is_other)];
        let slot = within.wrapping_add_signed(add.into());
        let state = u32::from(frequency).wrapping_mul(self.state >> SLOT_BITS).wrapping_add(slot);
        let word = if self.at < self.words.len() { u16::from_le_bytes(self.words[self.at]) } else { 0 };
        let is_low = state < LEAST_STATE;
        self.state = select_unpredictable(is_low, state << 16 | u32::from(word), state);
        self.at += usize::from(is_low);
        number
    }

    /// Whether an encoder's stream would end here.
    pub(super) fn ended(&self) -> bool {
        self.state == LEAST_STATE && self.at == self.words.len() && self.raw.ended()
    }
}

#[cfg(test)]
mod tests;
