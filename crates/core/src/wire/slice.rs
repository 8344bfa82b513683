//! A slice through the volume: the request, and the stream that brings its values.
//!
//! | offset | type | meaning |
//! |---|---|---|
//! | 0 | 4 bytes | `IGSL` |
//! | 4 | u32 | id of the request |
//! | 8 | u16 | columns, 1 to 2048 |
//! | 10 | u16 | rows, 1 to 2048 |
//! | 12 | f32 | value of code 0 |
//! | 16 | f32 | difference of two neighbouring codes |
//! | 20 | u8 | bytes of a code, 1 or 2 |
//! | 21 | u8 | whether a finer slice follows |
//! | 22 | | the codes in a Zstandard frame |
//!
//! Numbers are little-endian. Each code stands as its difference from the one before it in its row, modulo 2⁸ or 2¹⁶.
//! The first code of a row follows 0. Of 16-bit codes, all low bytes come first, and then all high bytes.

use serde::{Deserialize, Serialize};

use super::control::ControlError;
use crate::ids::{LookVersion, SliceId};
use crate::volume::{MAX_SLICE_SIDE, Slice, SliceCodes, SliceSpec};

/// All slices that the client wants now, in the order of their urgency. A later list replaces this one.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct WantedSlices {
    /// The look version with which the volume came. The server ignores a list for another volume.
    pub volume: LookVersion,
    /// At most [`MAX_WANTED_SLICES`].
    pub slices: Vec<SliceRequest>,
}

/// One slice that the client wants.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SliceRequest {
    /// Number of the request.
    pub id: SliceId,
    /// The slice.
    pub spec: SliceSpec,
    /// Whether nobody looks at it yet. Frames go before it.
    pub is_ahead: bool,
}

impl WantedSlices {
    /// Checks what the types cannot say.
    pub(super) fn validate(&self) -> Result<(), ControlError> {
        match self.slices.len() <= MAX_WANTED_SLICES && self.slices.iter().all(|s| s.spec.is_valid()) {
            true => Ok(()),
            false => Err(ControlError::Value("slice")),
        }
    }
}

/// Why bytes are no slice.
#[derive(Debug, thiserror::Error)]
pub enum SliceError {
    /// The header is too short, or its numbers are out of range.
    #[error("a slice with an unusable header")]
    Header,
    /// The codes do not decode, or are too many.
    #[error("a slice that does not unpack: {0}")]
    Packing(#[from] std::io::Error),
    /// There are too few codes.
    #[error("a slice of {found} bytes, expected {expected}")]
    Length {
        /// Bytes after unpacking.
        found: usize,
        /// Bytes by the header.
        expected: usize,
    },
}

/// The stream of a slice. A finer slice follows a draft.
///
/// # Errors
/// If it cannot be packed.
pub fn encode_slice(id: SliceId, slice: &Slice, is_draft: bool) -> Result<Vec<u8>, SliceError> {
    let width = slice.size[0] as usize;
    let (plain, code_bytes) = match &slice.codes {
        SliceCodes::U8(codes) => {
            let mut plain = Vec::with_capacity(codes.len());
            for row in codes.chunks(width) {
                let mut before = 0u8;
                plain.extend(row.iter().map(|&code| code.wrapping_sub(std::mem::replace(&mut before, code))));
            }
            (plain, 1)
        }
        SliceCodes::U16(codes) => {
            let mut plain = vec![0; 2 * codes.len()];
            let (low, high) = plain.split_at_mut(codes.len());
            for (r, row) in codes.chunks(width).enumerate() {
                let mut before = 0u16;
                for (c, &code) in row.iter().enumerate() {
                    let [l, h] = code.wrapping_sub(std::mem::replace(&mut before, code)).to_le_bytes();
                    (low[r * width + c], high[r * width + c]) = (l, h);
                }
            }
            (plain, 2)
        }
    };
    let packed = zstd::bulk::compress(&plain, PACKING_LEVEL)?;
    let mut out = Vec::with_capacity(SLICE_HEADER_BYTES + packed.len());
    out.extend_from_slice(&SLICE_MAGIC);
    out.extend_from_slice(&id.0.to_le_bytes());
    for side in slice.size {
        out.extend_from_slice(&(side as u16).to_le_bytes());
    }
    out.extend_from_slice(&slice.lo.to_le_bytes());
    out.extend_from_slice(&slice.step.to_le_bytes());
    out.extend_from_slice(&[code_bytes, u8::from(is_draft)]);
    out.extend_from_slice(&packed);
    Ok(out)
}

/// The request that a stream answers; `None` if it does not begin as a slice.
pub fn slice_id(header: &[u8]) -> Option<SliceId> {
    let header: &[u8; 8] = header.first_chunk()?;
    let id = u32::from_le_bytes([header[4], header[5], header[6], header[7]]);
    (header[..4] == SLICE_MAGIC).then_some(SliceId(id))
}

/// The slice of `size` columns and rows in a whole stream, and whether a finer one follows. Memory is bounded by the size.
///
/// # Errors
/// If the bytes are no slice, or one of another size.
pub fn decode_slice(bytes: &[u8], size: [u32; 2]) -> Result<(Slice, bool), SliceError> {
    let header: &[u8; SLICE_HEADER_BYTES] = bytes.first_chunk().ok_or(SliceError::Header)?;
    let side = |at: usize| u32::from(u16::from_le_bytes([header[at], header[at + 1]]));
    let number = |at: usize| f32::from_le_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]]);
    let (lo, step, code_bytes, more) = (number(12), number(16), header[20], header[21]);
    let is_size = [side(8), side(10)] == size && size.iter().all(|side| (1..=MAX_SLICE_SIDE).contains(side));
    let are_values = lo.is_finite() && step.is_finite() && (step * 65535.0 + lo).is_finite();
    if slice_id(header).is_none() || !is_size || !are_values || !(1..=2).contains(&code_bytes) || more > 1 {
        return Err(SliceError::Header);
    }
    let (width, num) = (size[0] as usize, size[0] as usize * size[1] as usize);
    let expected = num * usize::from(code_bytes);
    let plain = zstd::bulk::decompress(&bytes[SLICE_HEADER_BYTES..], expected)?;
    if plain.len() != expected {
        return Err(SliceError::Length { found: plain.len(), expected });
    }
    let codes = if code_bytes == 1 {
        let mut codes = plain;
        for row in codes.chunks_mut(width) {
            let mut before = 0u8;
            for code in row {
                *code = code.wrapping_add(before);
                before = *code;
            }
        }
        SliceCodes::U8(codes)
    } else {
        let (low, high) = plain.split_at(num);
        let mut codes: Vec<u16> = low.iter().zip(high).map(|(l, h)| u16::from_le_bytes([*l, *h])).collect();
        for row in codes.chunks_mut(width) {
            let mut before = 0u16;
            for code in row {
                *code = code.wrapping_add(before);
                before = *code;
            }
        }
        SliceCodes::U16(codes)
    };
    Ok((Slice { size, lo, step, codes }, more == 1))
}

/// First bytes of a slice's stream.
pub const SLICE_MAGIC: [u8; 4] = *b"IGSL";
/// Bytes before the codes.
pub const SLICE_HEADER_BYTES: usize = 22;
/// Most slices in a list.
pub const MAX_WANTED_SLICES: usize = 32;
/// Bytes of the longest stream: the codes, and the overhead of packing.
pub const MAX_SLICE_BYTES: usize = 2 * (MAX_SLICE_SIDE * MAX_SLICE_SIDE) as usize + (1 << 16);
/// Fast: a slice is on its way sooner than with a better one on most links.
const PACKING_LEVEL: i32 = 1;

#[cfg(test)]
mod tests {
    use super::*;

    fn slices() -> [Slice; 2] {
        let size = [7, 5];
        let code = |i: u32| (i * 7919 + i * i * 31) as u16;
        [
            Slice {
                size,
                lo: -3.0,
                step: 0.5,
                codes: SliceCodes::U8((0..35).map(|i| code(i) as u8).collect()),
            },
            Slice { size, lo: 1e30, step: -2.0, codes: SliceCodes::U16((0..35).map(code).collect()) },
        ]
    }

    #[test]
    fn decoding_inverts_encoding() {
        for slice in slices() {
            for is_draft in [false, true] {
                let bytes = encode_slice(SliceId(0x0102_0304), &slice, is_draft).unwrap();
                assert_eq!(slice_id(&bytes), Some(SliceId(0x0102_0304)));
                assert_eq!(decode_slice(&bytes, slice.size).unwrap(), (slice.clone(), is_draft));
            }
        }
        assert_eq!((slice_id(b"IGLS\x01\x02\x03\x04"), slice_id(b"IGSL\x01")), (None, None));
    }

    #[test]
    fn any_bytes_are_read_within_bounds() {
        for slice in slices() {
            let good = encode_slice(SliceId(7), &slice, false).unwrap();
            for length in 0..good.len() {
                assert!(decode_slice(&good[..length], slice.size).is_err());
            }
            assert!(matches!(decode_slice(&good, [5, 7]), Err(SliceError::Header)), "another size");
            for bit in 0..good.len() * 8 {
                let mut bytes = good.clone();
                bytes[bit / 8] ^= 1 << (bit % 8);
                if let Ok((found, _)) = decode_slice(&bytes, slice.size) {
                    let [width, height] = found.size.map(|side| side as usize);
                    let num = match &found.codes {
                        SliceCodes::U8(codes) => codes.len(),
                        SliceCodes::U16(codes) => codes.len(),
                    };
                    assert_eq!(num, width * height);
                    assert!(found.value_from_code(65535.0).is_finite());
                }
            }
            // A frame that holds more than its header says does not unpack.
            let mut bomb = good[..SLICE_HEADER_BYTES].to_vec();
            bomb.extend(zstd::bulk::compress(&vec![0; 100 << 20], 1).unwrap());
            assert!(matches!(decode_slice(&bomb, slice.size), Err(SliceError::Packing(_))));
            let mut short = good[..SLICE_HEADER_BYTES].to_vec();
            short.extend(zstd::bulk::compress(&[0; 3], 1).unwrap());
            assert!(matches!(decode_slice(&short, slice.size), Err(SliceError::Length { found: 3, .. })));
        }
    }

    #[test]
    fn a_list_is_bounded() {
        let plane = crate::volume::SlicePlane::Axis { axis: 1, index: 9 };
        let spec = SliceSpec { plane, thickness: 0.0, mode: Default::default() };
        let request = SliceRequest { id: SliceId(1), spec, is_ahead: false };
        let list = |num| WantedSlices { volume: LookVersion(1), slices: vec![request; num] }.validate();
        assert!(list(MAX_WANTED_SLICES).is_ok() && list(MAX_WANTED_SLICES + 1).is_err());
        let bad = SliceRequest { spec: SliceSpec { thickness: -1.0, ..spec }, ..request };
        assert!(WantedSlices { volume: LookVersion(1), slices: vec![bad] }.validate().is_err());
    }
}
