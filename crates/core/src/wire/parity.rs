//! A parity datagram: some bytes from which a receiver restores lost parts of a stream.
//!
//! | offset | type | meaning |
//! |---|---|---|
//! | 0 | 4 bytes | `IGFP` |
//! | 4 | u32 | bytes of the stream, 1 to 2²⁰ |
//! | 8 | u64 | QUIC stream id |
//! | 16 | u16 | bytes of a symbol, even |
//! | 18 | u16 | number of all parity symbols of the stream |
//! | 20 | u16 | index of the first parity symbol of this datagram |
//! | 22 | | whole symbols, to the end |
//!
//! Numbers are little-endian. The stream's bytes, with zeros up to a whole symbol, are the original symbols of a
//! Reed-Solomon code over GF(2¹⁶), that of the crate `reed-solomon-simd`, version 3.

/// What a parity datagram says of itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ParityHead {
    /// Length of the stream, bytes.
    pub stream_bytes: u32,
    /// QUIC stream id.
    pub stream: u64,
    /// Length of a symbol, bytes.
    pub symbol_bytes: u16,
    /// Number of all parity symbols of the stream.
    pub num_parity: u16,
    /// Index of the first parity symbol in the datagram.
    pub first: u16,
}

/// Why a datagram from the server is not read.
#[derive(Clone, Copy, Debug, thiserror::Error, PartialEq, Eq)]
#[error("a parity datagram with an unusable {0}")]
pub struct ParityError(&'static str);

impl ParityHead {
    /// Number of original symbols.
    pub fn num_original(&self) -> usize {
        (self.stream_bytes as usize).div_ceil(usize::from(self.symbol_bytes.max(1)))
    }

    /// The bytes of the head.
    pub fn encode(&self) -> [u8; PARITY_HEAD_BYTES] {
        let mut out = [0; PARITY_HEAD_BYTES];
        let mut put = |at: usize, bytes: &[u8]| out[at..at + bytes.len()].copy_from_slice(bytes);
        put(0, MAGIC);
        put(4, &self.stream_bytes.to_le_bytes());
        put(8, &self.stream.to_le_bytes());
        put(16, &self.symbol_bytes.to_le_bytes());
        put(18, &self.num_parity.to_le_bytes());
        put(20, &self.first.to_le_bytes());
        out
    }

    /// Reads a datagram: its head and its symbols.
    ///
    /// # Errors
    /// If a number is out of its range, or the length is wrong.
    pub fn decode(bytes: &[u8]) -> Result<(Self, &[u8]), ParityError> {
        let (head, symbols) = bytes.split_first_chunk::<PARITY_HEAD_BYTES>().ok_or(ParityError("length"))?;
        if !head.starts_with(MAGIC) {
            return Err(ParityError("kind"));
        }
        let u16_at = |at: usize| u16::from_le_bytes([head[at], head[at + 1]]);
        let [.., s0, s1, s2, s3, s4, s5, s6, s7] = head.first_chunk::<16>().copied().unwrap_or_default();
        let head = Self {
            stream_bytes: u32::from_le_bytes([head[4], head[5], head[6], head[7]]),
            stream: u64::from_le_bytes([s0, s1, s2, s3, s4, s5, s6, s7]),
            symbol_bytes: u16_at(16),
            num_parity: u16_at(18),
            first: u16_at(20),
        };
        if !(1..=MAX_REPAIRED_BYTES as u32).contains(&head.stream_bytes) {
            return Err(ParityError("length of the stream"));
        }
        let size = usize::from(head.symbol_bytes);
        if size == 0 || !size.is_multiple_of(2) || head.num_original() > MAX_SYMBOLS {
            return Err(ParityError("size of its symbols"));
        }
        let num = symbols.len() / size;
        let is_whole = num > 0 && symbols.len().is_multiple_of(size);
        let end = usize::from(head.first) + num;
        if !is_whole || usize::from(head.num_parity) > MAX_SYMBOLS || end > usize::from(head.num_parity) {
            return Err(ParityError("number of symbols"));
        }
        Ok((head, symbols))
    }
}

const MAGIC: &[u8; 4] = b"IGFP";
/// Bytes before the symbols.
pub const PARITY_HEAD_BYTES: usize = 22;
/// Longest stream that has parity.
pub const MAX_REPAIRED_BYTES: usize = 1 << 20;
/// Most original symbols, and most parity symbols.
pub const MAX_SYMBOLS: usize = 8192;

#[cfg(test)]
mod tests {
    use super::*;

    const HEAD: ParityHead =
        ParityHead { stream_bytes: 1000, stream: 0x1_0000_0003, symbol_bytes: 128, num_parity: 9, first: 7 };

    fn datagram(head: ParityHead, num: usize) -> Vec<u8> {
        [&head.encode()[..], &vec![5; num * usize::from(head.symbol_bytes)]].concat()
    }

    #[test]
    fn heads_are_read_back_and_the_bytes_are_these() {
        let bytes = datagram(HEAD, 2);
        assert_eq!(bytes[..22], *b"IGFP\xe8\x03\0\0\x03\0\0\0\x01\0\0\0\x80\0\x09\0\x07\0");
        let (head, symbols) = ParityHead::decode(&bytes).unwrap();
        assert_eq!((head, symbols.len(), head.num_original()), (HEAD, 256, 8));
    }

    #[test]
    fn heads_that_no_server_makes_are_errors() {
        let refused = |head, num| ParityHead::decode(&datagram(head, num)).is_err();
        assert!(!refused(HEAD, 1) && !refused(HEAD, 2));
        assert!(refused(HEAD, 3), "more than there are");
        assert!(refused(HEAD, 0) && refused(ParityHead { stream_bytes: 0, ..HEAD }, 2));
        assert!(refused(ParityHead { stream_bytes: u32::MAX, ..HEAD }, 2));
        assert!(refused(ParityHead { symbol_bytes: 0, ..HEAD }, 2));
        assert!(refused(ParityHead { symbol_bytes: 127, ..HEAD }, 2));
        assert!(refused(ParityHead { symbol_bytes: 2, stream_bytes: 1 << 20, ..HEAD }, 2));
        assert!(refused(ParityHead { num_parity: u16::MAX, ..HEAD }, 2));
        let bytes = datagram(HEAD, 2);
        for length in 0..bytes.len() {
            let is_whole = length == 22 + 128;
            assert_eq!(ParityHead::decode(&bytes[..length]).is_ok(), is_whole, "{length}");
        }
        assert!(ParityHead::decode(&[&b"IGSL"[..], &bytes[4..]].concat()).is_err());
    }
}
