//! Why bytes are not a frame, or a frame cannot be encoded.

use crate::ids::{ChunkIndex, FrameId};
use crate::mode::Mode;

/// Why bytes are not a chunk, a chunk does not belong to a frame, or a frame cannot be encoded.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CodecError {
    /// Bytes are missing or left over.
    #[error("chunk has {found} bytes, expected {expected}")]
    Length {
        /// Number of bytes given.
        found: usize,
        /// Number of bytes that the header states, or the size of a header.
        expected: usize,
    },
    /// The first bytes are not those of a chunk.
    #[error("not a layered-frame chunk: it begins with {0:02x?}")]
    Magic([u8; 4]),
    /// Another version of the format.
    #[error("chunk format version {found}, expected {expected}")]
    Version {
        /// The version in the header.
        found: u8,
        /// The version of this build.
        expected: u8,
    },
    /// A number in the header is out of its range.
    #[error("chunk header: {what} is {found}, expected {expected}")]
    Header {
        /// The field.
        what: &'static str,
        /// Its value.
        found: String,
        /// Its range.
        expected: String,
    },
    /// A plane of the payload is damaged.
    #[error("chunk payload: {plane}: {problem}")]
    Payload {
        /// The plane.
        plane: &'static str,
        /// What is wrong with it.
        problem: String,
    },
    /// More than any receiver accepts.
    #[error("{found} {what}, at most {limit} are accepted")]
    TooLarge {
        /// The counted thing.
        what: &'static str,
        /// Its number.
        found: usize,
        /// The limit.
        limit: usize,
    },
    /// The chunk disagrees with another chunk of its frame.
    #[error("chunk {index} of frame {frame} contradicts the others: {what}")]
    Contradiction {
        /// The chunk.
        index: ChunkIndex,
        /// The frame that it names.
        frame: FrameId,
        /// The contradiction.
        what: &'static str,
    },
    /// Two chunks have the same index.
    #[error("chunk {0} came twice")]
    Duplicate(ChunkIndex),
    /// The reference of a predicted frame is missing.
    #[error("frame {frame} is predicted from frame {reference}, which is not here")]
    Reference {
        /// The frame.
        frame: FrameId,
        /// The frame that it names.
        reference: FrameId,
    },
    /// Nobody waits for the frame any more.
    #[error("the frame is no longer wanted")]
    Abandoned,
    /// Blocks correct their picture by *over*, so they cannot hold a projection.
    #[error("a frame of mode {0} in blocks, expected the exact coding")]
    Projection(Mode),
    /// Another process could not encode its part of the frame.
    #[error("rank {rank}: {problem}")]
    Elsewhere {
        /// The process.
        rank: usize,
        /// Why.
        problem: String,
    },
    /// Chunks are missing.
    #[error("{found} chunks of a frame, expected {expected}")]
    Incomplete {
        /// Number of chunks given.
        found: usize,
        /// Number of chunks of the frame.
        expected: usize,
    },
}

/// [`CodecError::TooLarge`] if there is more than `limit`.
pub(super) fn at_most(what: &'static str, found: usize, limit: usize) -> Result<(), CodecError> {
    if found > limit { Err(CodecError::TooLarge { what, found, limit }) } else { Ok(()) }
}
