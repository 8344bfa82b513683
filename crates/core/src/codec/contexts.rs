//! The planes of a chunk and their contexts, and the two sides of coding a number in one: [`Recorder`] and [`Reader`].

use super::rans::{
    BitReader, BitWriter, Counts, DecodeTable, EncodeTable, Frequencies, Stream, TOKENS, TokenWriter,
    frequencies, frequency_bits, token,
};

/// One side of coding: walks over the segments call this for every number, in the same order on both sides.
pub(super) trait Coder {
    /// Codes a number of a plane in one of the plane's contexts. An encoder asks for it, a decoder tells it.
    fn code(&mut self, plane: usize, context: usize, given: impl FnOnce() -> u32) -> u32;
}

/// Notes down numbers until the statistics of all are known.
pub(super) struct Recorder {
    counts: Vec<Counts>,
    /// Context and token of each number.
    symbols: [Vec<u16>; NUM_PLANES],
    raw: [BitWriter; NUM_PLANES],
    writers: [TokenWriter; NUM_PLANES],
    tables: Vec<EncodeTable>,
}

impl Default for Recorder {
    fn default() -> Self {
        Self {
            counts: vec![[0; TOKENS]; NUM_CONTEXTS],
            symbols: Default::default(),
            raw: Default::default(),
            writers: Default::default(),
            tables: vec![],
        }
    }
}

impl Coder for Recorder {
    #[inline(always)]
    fn code(&mut self, plane: usize, context: usize, given: impl FnOnce() -> u32) -> u32 {
        let number = given();
        let context = FIRST_CONTEXT[plane] + context;
        let (token, bits, rest) = token(number);
        self.counts[context][usize::from(token)] += 1;
        self.symbols[plane].push((context << TOKEN_BITS) as u16 | u16::from(token));
        if bits > 0 {
            self.raw[plane].push(rest, bits);
        }
        number
    }
}

impl Recorder {
    /// Appends lengths, tables and streams of what was noted down, and forgets it.
    pub(super) fn finish(&mut self, bytes: &mut Vec<u8>) {
        let lengths = bytes.len();
        bytes.resize(lengths + DIRECTORY_BYTES, 0);
        let mut number = 0;
        let mut from = lengths + DIRECTORY_BYTES;
        let mut close = |bytes: &mut Vec<u8>| {
            let length = (bytes.len() - from) as u32;
            bytes[lengths + 4 * number..][..4].copy_from_slice(&length.to_le_bytes());
            number += 1;
            from = bytes.len();
        };
        let table_of = self.write_tables(bytes);
        close(bytes);

        // From the last number to the first, as decoding goes the other way; the planes of segments side by side, since
        // each state waits for itself alone.
        let mut push = |plane: usize, number: usize| {
            let symbol = self.symbols[plane][number];
            let table = &self.tables[usize::from(table_of[usize::from(symbol >> TOKEN_BITS)])];
            self.writers[plane].push(table, symbol as u8 & (TOKENS - 1) as u8);
        };
        for list in (0..self.symbols[LENGTHS].len()).rev() {
            push(LENGTHS, list);
        }
        for segment in (0..self.symbols[FRONT].len()).rev() {
            for plane in FRONT..NUM_PLANES {
                push(plane, segment);
            }
        }
        for plane in 0..NUM_PLANES {
            self.writers[plane].finish(bytes);
            close(bytes);
            self.raw[plane].finish(bytes);
            close(bytes);
            self.symbols[plane].clear();
        }
        self.counts.fill([0; TOKENS]);
    }

    /// Appends the tables, and fills `self.tables`; says which is whose. Neighbouring contexts share a table where two
    /// would take more bits than they save.
    fn write_tables(&mut self, bytes: &mut Vec<u8>) -> [u8; NUM_CONTEXTS] {
        let mut table_of = [0; NUM_CONTEXTS];
        let mut bits = BitWriter::default();
        self.tables.clear();
        for plane in 0..NUM_PLANES {
            let mut sharing = Sharing::new(self.counts[FIRST_CONTEXT[plane]]);
            let mut shared = vec![];
            for context in FIRST_CONTEXT[plane] + 1..FIRST_CONTEXT[plane + 1] {
                let alone = Sharing::new(self.counts[context]);
                let together = Sharing::new(sum(&sharing.counts, &alone.counts));
                if together.bits <= sharing.bits + alone.bits {
                    sharing = together;
                } else {
                    shared.push((context, std::mem::replace(&mut sharing, alone)));
                }
            }
            shared.push((FIRST_CONTEXT[plane + 1], sharing));
            let mut context = FIRST_CONTEXT[plane];
            for (end, Sharing { frequencies, .. }) in shared {
                let table = self.tables.len() as u8;
                self.tables.push(EncodeTable::new(&frequencies));
                for (number, table_of) in table_of[context..end].iter_mut().enumerate() {
                    *table_of = table;
                    if context + number > FIRST_CONTEXT[plane] {
                        bits.push(u32::from(number > 0), 1);
                    }
                    if number == 0 {
                        bits.frequencies(&frequencies);
                    }
                }
                context = end;
            }
        }
        bits.finish(bytes);
        table_of
    }
}

/// Contexts that share a table.
struct Sharing {
    counts: Counts,
    frequencies: Frequencies,
    /// What the table and the tokens coded with it take.
    bits: f32,
}

impl Sharing {
    fn new(counts: Counts) -> Self {
        let frequencies = frequencies(&counts);
        if counts.iter().all(|&c| c == 0) {
            return Self { counts, frequencies, bits: 0.0 };
        }
        let tokens = counts.iter().zip(&frequencies).filter(|(c, _)| **c > 0);
        let bits = tokens.map(|(&c, &f)| c as f32 * (12.0 - f32::from(f).log2())).sum::<f32>();
        Self { counts, frequencies, bits: bits + frequency_bits(&frequencies) as f32 }
    }
}

fn sum(a: &Counts, b: &Counts) -> Counts {
    std::array::from_fn(|i| a[i] + b[i])
}

/// Reads numbers back.
pub(super) struct Reader<'a> {
    tables: Box<[DecodeTable; MAX_CONTEXTS]>,
    streams: [Stream<'a>; NUM_PLANES],
}

impl Coder for Reader<'_> {
    #[inline(always)]
    fn code(&mut self, plane: usize, context: usize, _: impl FnOnce() -> u32) -> u32 {
        let table = &self.tables[(FIRST_CONTEXT[plane] + context) % MAX_CONTEXTS];
        // Most numbers of these planes are small: a branch then costs less than reading no bits.
        if plane == FRONT || plane == TAU {
            self.streams[plane].next_small(table)
        } else {
            self.streams[plane].next(table)
        }
    }
}

impl<'a> Reader<'a> {
    /// From what [`Recorder::finish`] has appended, split by [`parts`].
    pub(super) fn new(parts: &[&'a [u8]; NUM_PARTS]) -> Result<Self, &'static str> {
        let mut bits = BitReader::new(parts[0]);
        let mut tables = Vec::with_capacity(MAX_CONTEXTS);
        for plane in 0..NUM_PLANES {
            for context in FIRST_CONTEXT[plane]..FIRST_CONTEXT[plane + 1] {
                let shared = context > FIRST_CONTEXT[plane] && bits.take(1) == 1;
                let table = match tables.last() {
                    Some(last) if shared => DecodeTable::clone(last),
                    _ => DecodeTable::new(&bits.frequencies()?),
                };
                tables.push(table);
            }
        }
        if !bits.ended() {
            return Err("too long or too short");
        }
        tables.resize(MAX_CONTEXTS, DecodeTable::EMPTY);
        let tables = tables.into_boxed_slice().try_into().map_err(|_| "too many")?;
        let streams = std::array::from_fn(|plane| Stream::new(parts[1 + 2 * plane], parts[2 + 2 * plane]));
        Ok(Self { tables, streams })
    }

    /// The first plane in use whose stream does not end where an encoder's would.
    pub(super) fn unended(&self) -> Option<usize> {
        self.streams.iter().position(|stream| !stream.ended())
    }
}

/// Splits what [`Recorder::finish`] has appended: the tables, then tokens and raw bits of every plane. The error is the
/// number of the part that is longer than what is left, its length, and what is left; or, behind the last
/// part, the bytes left over.
pub(super) fn parts(bytes: &[u8]) -> Result<[&[u8]; NUM_PARTS], (usize, usize, usize)> {
    let (lengths, mut rest) =
        bytes.split_at_checked(DIRECTORY_BYTES).ok_or((0, DIRECTORY_BYTES, bytes.len()))?;
    let mut parts = [&[][..]; NUM_PARTS];
    for (number, part) in parts.iter_mut().enumerate() {
        let length = u32::from_le_bytes(std::array::from_fn(|i| lengths[number * 4 + i])) as usize;
        (*part, rest) = rest.split_at_checked(length).ok_or((number, length, rest.len()))?;
    }
    if rest.is_empty() { Ok(parts) } else { Err((NUM_PARTS, 0, rest.len())) }
}

pub(super) const LENGTHS: usize = 0;
pub(super) const FRONT: usize = 1;
pub(super) const BACK: usize = 2;
pub(super) const TAU: usize = 3;
pub(super) const GREEN: usize = 4;
pub(super) const RED: usize = 5;
pub(super) const BLUE: usize = 6;
/// Planes that are coded: one number a list in the first, one a segment in the others.
pub(super) const NUM_PLANES: usize = 7;
/// Tables, and tokens and raw bits of each plane.
pub(super) const NUM_PARTS: usize = 1 + 2 * NUM_PLANES;
pub(super) const DIRECTORY_BYTES: usize = 4 * NUM_PARTS;
pub(super) const PLANE_NAMES: [&str; NUM_PLANES] =
    ["lengths", "front", "back", "tau", "green", "red", "blue"];
/// Contexts of lengths, front, back, τ, green, red and blue, as `predict` numbers them.
pub(super) const CONTEXTS: [usize; NUM_PLANES] = [36, 25, 30, 24, 12, 16, 16];
/// Number of the first context of each plane, and in the end of all.
const FIRST_CONTEXT: [usize; NUM_PLANES + 1] = {
    let mut first = [0; NUM_PLANES + 1];
    let mut plane = 0;
    while plane < NUM_PLANES {
        first[plane + 1] = first[plane] + CONTEXTS[plane];
        plane += 1;
    }
    first
};
const NUM_CONTEXTS: usize = FIRST_CONTEXT[NUM_PLANES];
const TOKEN_BITS: u32 = TOKENS.ilog2();

/// Room for tables: a power of two, so that no place is outside.
const MAX_CONTEXTS: usize = 256;

const _: () = assert!(NUM_CONTEXTS <= MAX_CONTEXTS && MAX_CONTEXTS <= 256, "a table's number is a byte");
