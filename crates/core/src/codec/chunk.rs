//! The chunks of a frame: one for each band of rows, each a stream on the wire. A frame can be shown when all are there.

use super::error::{CodecError, at_most};
use super::header::{ChunkHeader, peek};
use super::limits::MAX_CHUNK_BYTES;
use crate::ids::ChunkIndex;
use crate::layer::FrameHeader;

/// One encoded frame.
#[derive(Clone, Debug, PartialEq)]
pub struct EncodedFrame {
    /// The header of the frame, as in every chunk.
    pub header: FrameHeader,
    /// One for each band, from the top.
    pub chunks: Vec<Chunk>,
}

/// One band of an encoded frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Chunk {
    /// The band, counted from the top.
    pub index: ChunkIndex,
    /// Header and payload.
    pub bytes: Vec<u8>,
}

impl EncodedFrame {
    /// Bytes of all chunks.
    pub fn num_bytes(&self) -> usize {
        self.chunks.iter().map(|c| c.bytes.len()).sum()
    }

    /// Makes a frame from the payloads of its bands. Each chunk has `head` in front of its payload.
    pub(super) fn from_payloads(
        frame: FrameHeader,
        is_exact: bool,
        head: &[u8],
        payloads: Vec<Vec<u8>>,
    ) -> Result<Self, CodecError> {
        let num_chunks = payloads.len() as u8;
        let chunk = |(index, payload): (usize, Vec<u8>)| {
            let index = ChunkIndex(index as u16);
            let payload_bytes = (head.len() + payload.len()) as u32;
            let header = ChunkHeader { frame, is_exact, index, num_chunks, payload_bytes };
            let bytes = [&header.to_bytes()[..], head, &payload].concat();
            at_most("bytes in a chunk", bytes.len(), MAX_CHUNK_BYTES)?;
            Ok(Chunk { index, bytes })
        };
        let chunks = payloads.into_iter().enumerate().map(chunk).collect::<Result<_, _>>()?;
        Ok(Self { header: frame, chunks })
    }
}

/// Returns all chunks of a frame with their headers, from the top band.
///
/// # Errors
/// If a chunk is missing, appears twice, is damaged or belongs to another frame.
pub(super) fn all_of_frame<B: AsRef<[u8]>>(chunks: &[B]) -> Result<Vec<(ChunkHeader, &[u8])>, CodecError> {
    let first = chunks.first().ok_or(CodecError::Incomplete { found: 0, expected: 1 })?;
    let first = peek(first.as_ref())?;
    let num_chunks = usize::from(first.num_chunks);
    at_most("chunks", chunks.len(), num_chunks)?;
    let mut found = Vec::with_capacity(num_chunks);
    for bytes in chunks.iter().map(AsRef::as_ref) {
        let header = peek(bytes)?;
        if (header.frame, header.num_chunks, header.is_exact)
            != (first.frame, first.num_chunks, first.is_exact)
        {
            return Err(header.contradicts("another frame header"));
        }
        if bytes.len() != header.chunk_bytes() {
            return Err(CodecError::Length { found: bytes.len(), expected: header.chunk_bytes() });
        }
        found.push((header, bytes));
    }
    found.sort_by_key(|(header, _)| header.index);
    if let Some(twice) = found.windows(2).find(|two| two[0].0.index == two[1].0.index) {
        return Err(CodecError::Duplicate(twice[0].0.index));
    }
    if found.len() != num_chunks {
        return Err(CodecError::Incomplete { found: found.len(), expected: num_chunks });
    }
    Ok(found)
}
