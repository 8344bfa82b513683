//! Chunks of either mode, and frames put together from them.

use std::ops::Range;
use std::sync::Arc;

use super::blocks::{self, BlocksAssembly, BlocksChunk, Reference, References};
use super::header::{ChunkHeader, peek};
use super::spent::Spent;
use super::{CodecError, assembly, planes};
use crate::ids::ChunkIndex;
use crate::layer::{FrameHeader, LayeredFrame};

/// A decoded chunk.
#[derive(Clone, Debug, PartialEq)]
pub enum DecodedChunk {
    /// Of the exact mode.
    Exact(planes::DecodedChunk),
    /// Of the rate mode.
    Blocks(BlocksChunk),
}

impl DecodedChunk {
    /// The header.
    pub fn header(&self) -> &ChunkHeader {
        match self {
            Self::Exact(chunk) => &chunk.header,
            Self::Blocks(chunk) => &chunk.header,
        }
    }

    /// Rows of lists that the chunk covers.
    pub fn rows(&self) -> Range<u32> {
        match self {
            Self::Exact(chunk) => chunk.rows(),
            Self::Blocks(chunk) => chunk.rows(),
        }
    }

    /// Number of segments.
    pub fn num_segments(&self) -> usize {
        match self {
            Self::Exact(chunk) => chunk.num_segments(),
            Self::Blocks(chunk) => chunk.num_segments(),
        }
    }
}

/// Decodes one chunk. Frames that it names must be among the references.
pub fn decode_chunk(bytes: &[u8], references: &References) -> Result<DecodedChunk, CodecError> {
    let header = peek(bytes)?;
    Ok(if header.is_rate() {
        DecodedChunk::Blocks(blocks::decode(header, bytes, references)?)
    } else {
        DecodedChunk::Exact(planes::decode_chunk(bytes)?)
    })
}

/// What a chunk spends its bytes on. One of the rate mode is decoded for it: frames that it names must be among the
/// references.
pub fn spent(bytes: &[u8], references: &References) -> Result<Spent, CodecError> {
    let header = peek(bytes)?;
    if header.is_rate() { blocks::spent(header, bytes, references) } else { planes::spent(&header, bytes) }
}

/// Collects the chunks of one frame.
#[derive(Clone, Debug)]
pub struct Assembly(Kind);

#[derive(Clone, Debug)]
enum Kind {
    Exact(assembly::Assembly),
    Blocks(BlocksAssembly),
}

impl Assembly {
    /// An assembly without chunks for the frame that `header` belongs to.
    pub fn new(header: &ChunkHeader) -> Self {
        Self(if header.is_rate() {
            Kind::Blocks(BlocksAssembly::new(header))
        } else {
            Kind::Exact(assembly::Assembly::new(header))
        })
    }

    /// The frame.
    pub fn header(&self) -> &FrameHeader {
        match &self.0 {
            Kind::Exact(a) => a.header(),
            Kind::Blocks(a) => &a.first().frame,
        }
    }

    /// Chunks the frame has.
    pub fn num_chunks(&self) -> usize {
        match &self.0 {
            Kind::Exact(a) => a.num_chunks(),
            Kind::Blocks(a) => a.first().num_chunks.into(),
        }
    }

    /// Chunks that are there.
    pub fn num_inserted(&self) -> usize {
        match &self.0 {
            Kind::Exact(a) => a.num_inserted(),
            Kind::Blocks(a) => a.seen().count_ones() as usize,
        }
    }

    /// Whether the frame can be shown: the base of every band is there.
    pub fn base_complete(&self) -> bool {
        match &self.0 {
            Kind::Exact(a) => a.base_complete(),
            Kind::Blocks(a) => a.base_complete(),
        }
    }

    /// Whether every chunk is there.
    pub fn complete(&self) -> bool {
        match &self.0 {
            Kind::Exact(a) => a.complete(),
            Kind::Blocks(_) => self.num_inserted() == self.num_chunks(),
        }
    }

    /// Whether the frame is the server's own, all lists and depths as they are.
    pub fn is_exact(&self) -> bool {
        matches!(self.0, Kind::Exact(_))
    }

    /// Whether the chunk is there.
    pub fn contains(&self, index: ChunkIndex) -> bool {
        match &self.0 {
            Kind::Exact(a) => a.contains(index),
            Kind::Blocks(a) => a.seen().checked_shr(index.0.into()).unwrap_or(0) & 1 == 1,
        }
    }

    /// Adds a chunk. An error leaves the assembly as it was.
    pub fn insert(&mut self, chunk: DecodedChunk) -> Result<(), CodecError> {
        match (&mut self.0, chunk) {
            (Kind::Exact(a), DecodedChunk::Exact(chunk)) => a.insert(chunk),
            (Kind::Blocks(a), DecodedChunk::Blocks(chunk)) => a.insert(chunk),
            (_, chunk) => Err(chunk.header().contradicts("another mode")),
        }
    }

    /// The frame as far as it is there; lists of missing bands are empty. Always valid.
    pub fn to_frame(&self) -> LayeredFrame {
        self.to_frame_and_reference(None).0
    }

    /// The frame, and what later frames may be predicted from: a frame of the rate mode with all of its chunks. The frame
    /// takes the memory of `spare`, which is no longer needed.
    pub fn to_frame_and_reference(
        &self,
        spare: Option<LayeredFrame>,
    ) -> (LayeredFrame, Option<Arc<Reference>>) {
        match &self.0 {
            Kind::Exact(a) => (a.to_frame(spare), None),
            Kind::Blocks(a) => {
                let reference = a.to_reference();
                (reference.to_frame_in(spare), self.complete().then(|| Arc::new(reference)))
            }
        }
    }
}
