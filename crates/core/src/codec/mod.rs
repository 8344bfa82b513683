//! Layered frames to bytes and back: quantised planes, predicted and coded in contexts.
//!
//! A frame becomes up to [`MAX_CHUNKS`] chunks, each decodable without any other: bands of whole tile rows, times two
//! groups of segments. The *base* group of a list holds its most visible segments, the *refinement* the rest; a frame
//! can be shown as soon as its base is complete. Base chunks come first, and within a group the band that
//! contributes most to the picture comes first. Chunk bytes are documented in `docs/PROTOCOL.md`, "Layered-frame
//! payload"; nothing outside of this module reads or writes them.
//!
//! Depths are kept as they are. Colour and optical depth are quantised (`scale`) front to back with the error of
//! the composite carried on (`quantize`), so that the picture from the frame's own pose does not drift. Encoding a
//! decoded frame again gives the same bytes.
//!
//! Decoding is total: any bytes give a value or an error, in time and memory bounded by the constants here.

mod assembly;
mod bands;
pub mod blocks;
mod contexts;
mod either;
mod header;
mod planes;
mod predict;
mod quantize;
mod rans;
mod rows;
mod scale;
mod spent;
#[cfg(test)]
mod tests;
mod whole;

use std::cmp::Reverse;
use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;

use crate::cancel::{ALWAYS, Wanted};
use crate::ids::ChunkIndex;
use crate::layer::{FrameHeader, LayeredFrame, MAX_K};
use crate::mode::{Compositing, Mode};
use bands::Borders;
use blocks::{Reference, References};

pub use either::{Assembly, DecodedChunk, decode_chunk, spent};
pub use header::{ChunkHeader, HEADER_BYTES, peek};
pub use spent::{Spent, TileClass};

/// How to encode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// Bits of a colour channel: 8 or 10.
    pub color_bits: u8,
    /// Groups of segments: 2, so that a frame can be shown before the hidden ones are there, or 1, which is smaller.
    pub num_groups: u8,
}

impl Default for Settings {
    fn default() -> Self {
        Self { color_bits: 10, num_groups: 2 }
    }
}

/// How a frame is coded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Coding {
    /// All lists and depths as they are.
    Exact(Settings),
    /// Lists in blocks, for few bytes.
    Blocks(blocks::Settings),
}

impl Default for Coding {
    fn default() -> Self {
        Self::Exact(Settings::default())
    }
}

impl Coding {
    /// This, or the one that stands for it in frames of a mode: of projections only the exact lists, and of means all of
    /// them at once, as the picture of some would be too dark.
    pub fn for_mode(self, mode: Mode) -> Self {
        let num_groups = match (mode.compositing(), self) {
            (Compositing::Over, _) | (Compositing::Greatest, Self::Exact(_)) => return self,
            (Compositing::Greatest, Self::Blocks(_)) => 2,
            (Compositing::Mean, _) => 1,
        };
        Self::Exact(Settings { num_groups, ..Settings::default() })
    }

    /// Encodes a frame, which must be valid; one in blocks is predicted from the reference, if there is one, which the
    /// receiver must have, and can be the reference of later ones.
    pub fn encode(
        &self,
        frame: &LayeredFrame,
        reference: Option<&Reference>,
    ) -> Result<(EncodedFrame, Option<Arc<Reference>>), CodecError> {
        self.encode_while(frame, reference, ALWAYS)
    }

    /// The same; ends early with [`CodecError::Abandoned`] when the frame is no longer wanted, which is asked for each
    /// band or row of blocks.
    pub fn encode_while(
        &self,
        frame: &LayeredFrame,
        reference: Option<&Reference>,
        wanted: Wanted<'_>,
    ) -> Result<(EncodedFrame, Option<Arc<Reference>>), CodecError> {
        match self {
            Self::Exact(settings) => Ok((encode_while(frame, settings, wanted)?, None)),
            Self::Blocks(_) if frame.header.mode.is_projection() => {
                Err(CodecError::Projection(frame.header.mode))
            }
            Self::Blocks(settings) => blocks::encode_while(frame, settings, reference, wanted)
                .map(|(encoded, reference)| (encoded, Some(Arc::new(reference)))),
        }
    }
}

/// One encoded frame.
#[derive(Clone, Debug, PartialEq)]
pub struct EncodedFrame {
    /// The header of the frame, as in every chunk.
    pub header: FrameHeader,
    /// In the order of sending.
    pub chunks: Vec<Chunk>,
}

impl EncodedFrame {
    /// Bytes of all chunks.
    pub fn num_bytes(&self) -> usize {
        self.chunks.iter().map(|c| c.bytes.len()).sum()
    }
}

/// One part of an encoded frame: what a stream carries.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Chunk {
    /// Place in the order of sending.
    pub index: ChunkIndex,
    /// Whether the frame cannot be shown without it.
    pub is_base: bool,
    /// Header and payload.
    pub bytes: Vec<u8>,
}

/// Why bytes are not a chunk, a chunk does not belong to a frame, or a frame cannot be encoded.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CodecError {
    /// Bytes are missing or left over.
    #[error("chunk has {found} bytes, expected {expected}")]
    Length {
        /// Bytes given.
        found: usize,
        /// Bytes that the header asks for, or those of a header.
        expected: usize,
    },
    /// The first bytes are not those of a chunk.
    #[error("not a layered-frame chunk: it begins with {0:02x?}, expected {expected:02x?}", expected = header::MAGIC)]
    Magic([u8; 4]),
    /// Made by another version of the format.
    #[error("chunk format version {0}, expected {expected}", expected = header::VERSION)]
    Version(u8),
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
        /// What there is too much of.
        what: &'static str,
        /// How much there is.
        found: usize,
        /// The limit.
        limit: usize,
    },
    /// The chunk says other than the first chunk of its frame.
    #[error("chunk {index} of frame {frame} contradicts the chunks before it: {what}")]
    Contradiction {
        /// The chunk.
        index: ChunkIndex,
        /// The frame it names.
        frame: crate::ids::FrameId,
        /// Where they differ.
        what: &'static str,
    },
    /// The chunk is there already.
    #[error("chunk {0} came twice")]
    Duplicate(ChunkIndex),
    /// What the frame is predicted from is not here.
    #[error("frame {frame} is predicted from frame {reference}, which is not here")]
    Reference {
        /// The frame.
        frame: crate::ids::FrameId,
        /// The frame that it names.
        reference: crate::ids::FrameId,
    },
    /// Nobody waits for the frame any more.
    #[error("the frame is no longer wanted")]
    Abandoned,
    /// Blocks correct their picture by *over*.
    #[error("a frame of mode {0} in blocks, expected the exact coding")]
    Projection(Mode),
    /// Chunks are missing.
    #[error("{found} chunks of a frame, expected {expected}")]
    Incomplete {
        /// Chunks given.
        found: usize,
        /// Chunks the frame has.
        expected: usize,
    },
}

/// Makes the tables of all codings, some tens of milliseconds of work that the first frame would wait for otherwise.
pub fn prepare() {
    for color_bits in [8, 10] {
        // There are scales with so many bits.
        let _ = scale::of(color_bits);
    }
    blocks::prepare();
}

/// Encodes a frame, which must be valid ([`LayeredFrame::validate`]). Bands are encoded in parallel.
///
/// Fails only on settings out of range and on frames above [`MAX_FRAME_LISTS`], [`MAX_FRAME_SEGMENTS`],
/// [`MAX_CHUNK_SEGMENTS`] or [`MAX_CHUNK_BYTES`].
pub fn encode(frame: &LayeredFrame, settings: &Settings) -> Result<EncodedFrame, CodecError> {
    encode_while(frame, settings, ALWAYS)
}

fn encode_while(
    frame: &LayeredFrame,
    settings: &Settings,
    wanted: Wanted<'_>,
) -> Result<EncodedFrame, CodecError> {
    let scale = scale::of(settings.color_bits)?;
    if !(1..=2).contains(&settings.num_groups) {
        return Err(CodecError::Header {
            what: "number of groups",
            found: settings.num_groups.to_string(),
            expected: "1 or 2".into(),
        });
    }
    at_most("lists", frame.header.camera.intrinsics.num_pixels(), MAX_FRAME_LISTS)?;
    at_most("segments in a frame", frame.num_segments(), MAX_FRAME_SEGMENTS)?;

    let intrinsics = frame.header.camera.intrinsics;
    let width = intrinsics.width as usize;
    let num_bands = header::num_bands(intrinsics.height);
    // A mean has all of its lists at once: the picture of some would be too dark.
    let is_whole = settings.num_groups == 1 || frame.header.mode.compositing() == Compositing::Mean;
    let base_k = if is_whole { MAX_K } else { base_k(frame) };
    // Bands take as long as they have segments.
    let num_segments = |rows: Range<usize>| {
        let end = |row: usize| frame.offsets[(row * TILE).min(intrinsics.height as usize) * width];
        (end(rows.end) - end(rows.start)) as usize
    };
    let work: Vec<_> =
        (0..header::num_tiles(intrinsics.height)).map(|row| num_segments(row..row + 1)).collect();
    let borders = Borders::sharing(&work, num_bands);
    let first = ChunkHeader {
        frame: frame.header,
        color_bits: settings.color_bits,
        index: ChunkIndex(0),
        num_chunks: num_bands,
        num_base: num_bands,
        band: 0,
        has_borders: borders.is_some(),
        payload_bytes: 0,
    };
    let bands: Vec<_> = (0..num_bands)
        .into_par_iter()
        .with_max_len(1)
        .map(|band| {
            let rows = ChunkHeader { band, ..first }.rows(borders);
            let lists = rows.start as usize * width..rows.end as usize * width;
            if !wanted() {
                return Err(CodecError::Abandoned);
            }
            let groups = quantize::band(frame, lists, base_k, scale).map(|mut group| {
                if !wanted() {
                    return Err(CodecError::Abandoned);
                }
                let payload = planes::encode(&mut group.lists, width, scale)?;
                Ok((group, payload))
            });
            Ok((band, groups))
        })
        .collect::<Result<_, _>>()?;
    // (group, contribution, band, payload); a refinement without segments is not sent.
    let mut parts = Vec::with_capacity(MAX_CHUNKS);
    for (band, groups) in bands {
        for (number, group) in groups.into_iter().enumerate() {
            let (group, payload) = group?;
            if number == 0 || !group.lists.codes.is_empty() {
                parts.push((number, group.contribution, band, payload));
            }
        }
    }
    parts.sort_by(|a, b| a.0.cmp(&b.0).then(b.1.total_cmp(&a.1)).then(a.2.cmp(&b.2)));
    let num_chunks = parts.len() as u8;
    let mut ends = vec![];
    if let Some(borders) = borders {
        borders.write(&mut ends);
    }
    let chunks = parts
        .into_iter()
        .enumerate()
        .map(|(index, (group, _, band, payload))| {
            let index = ChunkIndex(index as u16);
            let payload_bytes = (ends.len() + payload.len()) as u32;
            let header = ChunkHeader { index, num_chunks, band, payload_bytes, ..first };
            let mut bytes = header.to_bytes().to_vec();
            bytes.extend_from_slice(&ends);
            bytes.extend_from_slice(&payload);
            at_most("bytes in a chunk", bytes.len(), MAX_CHUNK_BYTES)?;
            Ok(Chunk { index, is_base: group == 0, bytes })
        })
        .collect::<Result<_, CodecError>>()?;
    Ok(EncodedFrame { header: frame.header, chunks })
}

/// Decodes all chunks of one frame that is predicted from no other, in any order.
pub fn decode<B: AsRef<[u8]> + Sync>(chunks: &[B]) -> Result<LayeredFrame, CodecError> {
    decode_with(chunks, &References::default())
}

/// Decodes all chunks of one frame, in any order. What it is predicted from must be among the references.
pub fn decode_with<B: AsRef<[u8]> + Sync>(
    chunks: &[B],
    references: &References,
) -> Result<LayeredFrame, CodecError> {
    decode_in(chunks, references, None).map(|(frame, _)| frame)
}

/// The same in the memory of `spare`, a frame that is no longer needed. Returns what later frames may be predicted from,
/// too: see [`Assembly::to_frame_and_reference`].
pub fn decode_in<B: AsRef<[u8]> + Sync>(
    chunks: &[B],
    references: &References,
    mut spare: Option<LayeredFrame>,
) -> Result<(LayeredFrame, Option<Arc<Reference>>), CodecError> {
    match decode_whole(chunks, &mut spare)? {
        Some(frame) => Ok((frame, None)),
        None => Ok(assemble(chunks, references)?.to_frame_and_reference(spare)),
    }
}

/// Decodes a frame in the exact mode that is one group of segments, if these are all of its chunks, in any order: faster
/// than to assemble it. It takes the memory of `spare`, a frame that is no longer needed.
pub fn decode_whole<B: AsRef<[u8]>>(
    chunks: &[B],
    spare: &mut Option<LayeredFrame>,
) -> Result<Option<LayeredFrame>, CodecError> {
    at_most("chunks", chunks.len(), MAX_CHUNKS)?;
    let chunks: Vec<_> = chunks.iter().map(AsRef::as_ref).collect();
    whole::decode(&chunks, spare)
}

/// Decodes all chunks of one frame, in any order. What it is predicted from must be among the references.
pub fn assemble<B: AsRef<[u8]> + Sync>(
    chunks: &[B],
    references: &References,
) -> Result<Assembly, CodecError> {
    let first = chunks.first().ok_or(CodecError::Incomplete { found: 0, expected: 1 })?;
    let mut assembly = Assembly::new(&peek(first.as_ref())?);
    at_most("chunks", chunks.len(), MAX_CHUNKS)?;
    for chunk in decode_chunks(chunks, references)? {
        assembly.insert(chunk)?;
    }
    if !assembly.complete() {
        return Err(CodecError::Incomplete { found: chunks.len(), expected: assembly.num_chunks() });
    }
    Ok(assembly)
}

/// Decodes chunks, in whatever order. The longest begin, as bands differ by what there is to see: so no thread is left with a
/// long one at the end.
pub fn decode_chunks<B: AsRef<[u8]> + Sync>(
    chunks: &[B],
    references: &References,
) -> Result<Vec<DecodedChunk>, CodecError> {
    let mut longest_first: Vec<_> = chunks.iter().map(AsRef::as_ref).collect();
    longest_first.sort_by_key(|bytes| Reverse(bytes.len()));
    // One at a time for each thread.
    longest_first.into_iter().par_bridge().map(|bytes| decode_chunk(bytes, references)).collect()
}

fn at_most(what: &'static str, found: usize, limit: usize) -> Result<(), CodecError> {
    if found > limit { Err(CodecError::TooLarge { what, found, limit }) } else { Ok(()) }
}

/// Cuts the first `n` elements off a slice.
fn split_off<'a, T>(slice: &mut &'a mut [T], n: usize) -> &'a mut [T] {
    let (head, tail) = std::mem::take(slice).split_at_mut(n);
    *slice = tail;
    head
}

/// Side of a tile in lists: what is skipped when empty, and the unit of bands.
pub const TILE: usize = 16;
/// Most bands of a frame.
pub const MAX_BANDS: usize = 8;
/// Most chunks of a frame: every band's base and refinement.
pub const MAX_CHUNKS: usize = 2 * MAX_BANDS;
/// Most lists of a frame: its offsets fit a storage binding of 128 MiB.
pub const MAX_FRAME_LISTS: usize = (1 << 25) - 1;
/// Most segments of a frame: each of its planes fits a storage binding of 128 MiB.
pub const MAX_FRAME_SEGMENTS: usize = 1 << 25;
/// Most segments of a chunk. A band of a 3840×2160 frame with K = 16 has 8 in the base of each of its 1 044 480 lists,
/// just less than this; a forged chunk cannot ask for more than 100 MB of them, or in blocks, where it may have but four to a row
/// of eight lists, for 200 MB.
pub const MAX_CHUNK_SEGMENTS: usize = 1 << 23;
/// Most bytes of a chunk, header included; a receiver need not read further.
pub const MAX_CHUNK_BYTES: usize = 32 << 20;

/// Longest list of the base group: half of the mean of the lists that are not empty, rounded up.
fn base_k(frame: &LayeredFrame) -> usize {
    let num_filled = frame.offsets.windows(2).filter(|ends| ends[1] > ends[0]).count();
    frame.num_segments().div_ceil(2 * num_filled.max(1)).max(1)
}

const _: () = assert!(crate::layer::MAX_LISTS <= MAX_FRAME_LISTS);
const _: () = assert!(MAX_K == 32, "a list's base is marked in 32 bits");
