//! Codes layered frames as bytes, in one of two codings.
//!
//! [`Coding::Exact`] keeps all lists and depths. [`Coding::Blocks`] takes far fewer bytes: 8×8 lists share their
//! depth planes, and a frame is predicted from an earlier one. Each band of rows is a chunk, and one thread codes it.
//! `docs/PROTOCOL.md`, "Layered-frame payload", describes the bytes of chunks. Nothing outside this module reads or
//! writes them.
//!
//! Decoding is total: any bytes give a value or an error, in time and memory that `limits` bounds.
//!
//! A file or folder uses only those above it; `tests/tests/module_order.rs` checks it.
//!
//! | file or folder | responsibility |
//! |---|---|
//! | `limits` | bounds on frames and chunks |
//! | `error` | why bytes are not a frame |
//! | `portable_math` | functions with the same bits on every machine |
//! | `bands` | where bands of rows end |
//! | `header` | the header of a chunk |
//! | `chunk` | the chunks of a frame |
//! | `exact/` | the exact coding |
//! | `blocks/` | the coding in blocks |
//! | `shares` | frames that several processes encode together |

mod bands;
pub mod blocks;
mod chunk;
mod error;
mod exact;
mod header;
mod limits;
mod portable_math;
mod shares;

use std::sync::Arc;

use crate::cancel::{ALWAYS, Wanted};
use crate::layer::{FrameHeader, LayeredFrame};
use crate::mode::Mode;
use blocks::{Reference, References};

pub use chunk::{Chunk, EncodedFrame};
pub use error::CodecError;
pub use header::{ChunkHeader, HEADER_BYTES, TILE, peek};
pub use limits::{MAX_CHUNK_BYTES, MAX_CHUNK_SEGMENTS, MAX_CHUNKS, MAX_FRAME_LISTS, MAX_FRAME_SEGMENTS};
pub use shares::{CodedBand, FrameBands};

/// How a frame is coded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Coding {
    /// All lists and depths as they are.
    #[default]
    Exact,
    /// Lists in blocks, for few bytes.
    Blocks(blocks::Settings),
}

impl Coding {
    /// This coding, or the one that replaces it for a mode: projections are always exact.
    pub fn for_mode(self, mode: Mode) -> Self {
        if mode.is_projection() { Self::Exact } else { self }
    }

    /// Encodes a valid frame ([`LayeredFrame::validate`]). A frame in blocks is predicted from the reference, if
    /// given. The receiver must have that reference. Also returns what later frames can be predicted from.
    ///
    /// # Errors
    /// On frames above the limits of this module, and on projections in blocks.
    pub fn encode(
        &self,
        frame: &LayeredFrame,
        reference: Option<&Reference>,
    ) -> Result<(EncodedFrame, Option<Arc<Reference>>), CodecError> {
        self.encode_while(frame, reference, ALWAYS)
    }

    /// The same, but it stops with [`CodecError::Abandoned`] when the frame is no longer wanted. Each band or row of
    /// blocks asks.
    pub fn encode_while(
        &self,
        frame: &LayeredFrame,
        reference: Option<&Reference>,
        wanted: Wanted<'_>,
    ) -> Result<(EncodedFrame, Option<Arc<Reference>>), CodecError> {
        match self {
            Self::Exact => Ok((exact::encode(frame, wanted)?, None)),
            Self::Blocks(_) if frame.header.mode.is_projection() => {
                Err(CodecError::Projection(frame.header.mode))
            }
            Self::Blocks(settings) => blocks::encode_while(frame, settings, reference, wanted)
                .map(|(encoded, reference)| (encoded, Some(Arc::new(reference)))),
        }
    }
}

/// What several processes need to code a frame together. Each has some of its rows.
impl Coding {
    /// The work for each row of tiles or of blocks of a frame. Rows that are elsewhere are empty here; the sums of all
    /// processes are those of the frame.
    pub fn work_of_rows(&self, frame: &LayeredFrame) -> Vec<usize> {
        match self {
            Self::Exact => exact::work_of_rows(frame),
            Self::Blocks(_) => blocks::work_of_rows(frame),
        }
    }

    /// The bands of a frame, given the work of each of its rows. See [`Coding::encode`] for the reference.
    ///
    /// # Errors
    /// On frames above the limits of this module, and on projections in blocks.
    pub fn bands<'a>(
        &self,
        frame: FrameHeader,
        reference: Option<&'a Reference>,
        work: &[usize],
    ) -> Result<FrameBands<'a>, CodecError> {
        match self {
            Self::Exact => FrameBands::exact(frame, work),
            Self::Blocks(_) if frame.mode.is_projection() => Err(CodecError::Projection(frame.mode)),
            Self::Blocks(settings) => FrameBands::in_blocks(frame, settings, reference, work),
        }
    }
}

/// Makes the tables of both codings. Otherwise the first frame would wait for them for some tens of milliseconds.
pub fn prepare() {
    exact::prepare();
    blocks::prepare();
}

/// Encodes a valid frame exactly. See [`Coding::encode`].
///
/// # Errors
/// On frames above the limits of this module.
pub fn encode(frame: &LayeredFrame) -> Result<EncodedFrame, CodecError> {
    exact::encode(frame, ALWAYS)
}

/// Decodes all chunks, in any order, of a frame without a reference.
///
/// # Errors
/// See [`decode_with`].
pub fn decode<B: AsRef<[u8]>>(chunks: &[B]) -> Result<LayeredFrame, CodecError> {
    decode_with(chunks, &References::default(), None).map(|(frame, _)| frame)
}

/// Decodes all chunks of a frame, in any order. The reference of a predicted frame must be among `references`. Reuses
/// the memory of `spare`. For a frame in blocks, also returns what later frames can be predicted from.
///
/// # Errors
/// If chunks are damaged, missing or of different frames, or if the reference is missing.
pub fn decode_with<B: AsRef<[u8]>>(
    chunks: &[B],
    references: &References,
    spare: Option<LayeredFrame>,
) -> Result<(LayeredFrame, Option<Arc<Reference>>), CodecError> {
    let chunks = chunk::all_of_frame(chunks)?;
    if chunks.iter().all(|(header, _)| header.is_exact) {
        return Ok((exact::decode(&chunks, spare)?, None));
    }
    let reference = blocks::decode(&chunks, references)?;
    Ok((reference.to_frame_in(spare), Some(Arc::new(reference))))
}
