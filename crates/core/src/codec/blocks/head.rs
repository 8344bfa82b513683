//! The head of a payload: step sizes, reference and bands. It is the same in all chunks of a frame. Then, where the
//! streams of tiles are.

use std::sync::atomic::{AtomicUsize, Ordering};

use super::super::bands::Borders;
use super::super::error::{CodecError, at_most};
use super::super::header::{ChunkHeader, HEADER_BYTES};
use super::super::limits::MAX_CHUNKS;
use super::model::{BLOCK_LISTS, TilePlace, tiles_along};
use super::steps::{STEPS_BYTES, StepSizes};
use super::tile::FrameTile;
use crate::camera::Intrinsics;
use crate::ids::FrameId;
use crate::layer::FrameHeader;

/// The head of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::codec) struct Head {
    pub(super) steps: StepSizes,
    /// The frame that this one is predicted from.
    pub(super) reference: Option<FrameId>,
    /// Where the bands end, in rows of tiles.
    pub(super) borders: Borders,
}

impl Head {
    pub(super) fn to_bytes(self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(HEAD_BYTES + 2 * MAX_CHUNKS);
        bytes.push(self.reference.is_some().into());
        bytes.extend(self.reference.unwrap_or(FrameId(0)).0.to_le_bytes());
        bytes.extend(self.steps.to_bytes());
        self.borders.write(&mut bytes);
        bytes
    }

    /// Reads it from the start of a payload.
    pub(super) fn read(bytes: &mut &[u8], header: &ChunkHeader) -> Result<Self, CodecError> {
        let damaged = |problem: String| CodecError::Payload { plane: "head", problem };
        let Some((fixed, rest)) = bytes.split_first_chunk::<HEAD_BYTES>() else {
            return Err(damaged(format!("{} bytes, expected {HEAD_BYTES}", bytes.len())));
        };
        let [_, _, _, _, _, steps @ ..] = *fixed;
        let reference = named(fixed)?;
        let steps = StepSizes::from_bytes(steps)
            .ok_or_else(|| damaged(format!("steps {steps:02x?}, expected positive ones")))?;
        *bytes = rest;
        let num_rows = tiles_along(header.frame.camera.intrinsics.height);
        let borders = Borders::read(bytes, header.num_chunks, num_rows)?;
        Ok(Self { steps, reference, borders })
    }

    /// The tiles of a band, row by row.
    pub(super) fn tiles(&self, frame: &FrameHeader, band: usize) -> Vec<TilePlace> {
        let Intrinsics { width, height, .. } = frame.camera.intrinsics;
        let size = [width as usize, height as usize];
        let rows = self.borders.rows(band, tiles_along(height));
        let of_row = |row| (0..tiles_along(width)).map(move |column| TilePlace::of(column, row, size));
        rows.flat_map(of_row).collect()
    }
}

/// The reference that the fixed part of a head names.
fn named(&[is_predicted, a, b, c, d, ..]: &[u8; HEAD_BYTES]) -> Result<Option<FrameId>, CodecError> {
    match (is_predicted, FrameId(u32::from_le_bytes([a, b, c, d]))) {
        (0, FrameId(0)) => Ok(None),
        (1, frame) => Ok(Some(frame)),
        (flag, frame) => {
            let problem =
                format!("prediction {flag} from reference {frame}, expected 0 from 0 or 1 from any");
            Err(CodecError::Payload { plane: "head", problem })
        }
    }
}

/// The reference that a chunk in blocks names. `None` for other bytes.
pub fn reference_named(bytes: &[u8]) -> Option<FrameId> {
    named(bytes.get(HEADER_BYTES..)?.first_chunk()?).ok()?
}

/// Writes the streams of a band's tiles: which there are, the words of each, and the streams. A tile has none, one, or
/// one for each of its quarters, of which some are empty.
pub(super) fn write_streams(tiles: &[Vec<Vec<u8>>], out: &mut Vec<u8>) {
    let mut bits = Vec::new();
    for streams in tiles {
        bits.push(!streams.is_empty());
        if !streams.is_empty() {
            bits.push(streams.len() > 1);
        }
        if streams.len() > 1 {
            bits.extend(streams.iter().map(|stream| !stream.is_empty()));
        }
    }
    let byte = |eight: &[bool]| eight.iter().enumerate().fold(0, |byte, (i, bit)| byte | u8::from(*bit) << i);
    out.extend(bits.chunks(8).map(byte));
    let streams = || tiles.iter().flatten().filter(|stream| !stream.is_empty());
    for stream in streams() {
        let mut num_words = stream.len() / 2;
        while num_words >= 0x80 {
            out.push(num_words as u8 | 0x80);
            num_words >>= 7;
        }
        out.push(num_words as u8);
    }
    streams().for_each(|stream| out.extend(stream));
}

/// Reads what [`write_streams`] writes for tiles at these places: the blocks of each stream, and its bytes.
pub(super) fn read_streams<'a>(
    bytes: &'a [u8],
    tiles: &[TilePlace],
) -> Result<Vec<(TilePlace, &'a [u8])>, CodecError> {
    let damaged = |problem: &str| CodecError::Payload { plane: "tiles", problem: problem.into() };
    let early = || damaged("ends too early");
    let mut num_bits = 0;
    let mut bit = || {
        let byte = bytes.get(num_bits / 8).ok_or_else(early)?;
        num_bits += 1;
        Ok(byte >> ((num_bits - 1) % 8) & 1 == 1)
    };
    let mut places = Vec::new();
    for tile in tiles {
        if !bit()? {
            continue;
        }
        if !bit()? {
            places.push(*tile);
            continue;
        }
        for quarter in 0..4 {
            if bit()? {
                places.push(tile.quarter(quarter).ok_or_else(|| damaged("a stream outside of the frame"))?);
            }
        }
    }
    let (map, mut rest) = bytes.split_at_checked(num_bits.div_ceil(8)).ok_or_else(early)?;
    if num_bits % 8 > 0 && map.last().is_some_and(|byte| byte >> (num_bits % 8) != 0) {
        return Err(damaged("a stream for a tile outside of the frame"));
    }
    let mut lengths = Vec::with_capacity(places.len());
    for _ in &places {
        let (mut num_words, mut shift) = (0usize, 0);
        loop {
            let (&byte, after) = rest.split_first().ok_or_else(early)?;
            rest = after;
            num_words |= usize::from(byte & 0x7f) << shift;
            shift += 7;
            if byte < 0x80 {
                break;
            }
            if shift > 21 {
                return Err(damaged("a stream that is too long"));
            }
        }
        lengths.push(2 * num_words);
    }
    let mut streams = Vec::with_capacity(places.len());
    for (place, length) in places.into_iter().zip(lengths) {
        let (stream, after) = rest.split_at_checked(length).ok_or_else(early)?;
        rest = after;
        streams.push((place, stream));
    }
    if !rest.is_empty() {
        return Err(damaged("bytes are left over"));
    }
    Ok(streams)
}

/// Counts what the tiles of a chunk have, so that few bytes do not take much memory.
#[derive(Debug)]
pub(super) struct Room {
    /// Most segments.
    limit: usize,
    segments: AtomicUsize,
    rows: AtomicUsize,
    layers: AtomicUsize,
    corrected: AtomicUsize,
}

impl Room {
    /// Room for so many segments, and for what they may need.
    pub(super) fn new(limit: usize) -> Self {
        let [segments, rows, layers, corrected] = Default::default();
        Self { limit, segments, rows, layers, corrected }
    }

    /// Adds a tile with so many corrected blocks.
    ///
    /// # Errors
    /// If all tiles together are above the limits of a chunk.
    pub(super) fn take(&self, tile: &FrameTile, num_corrected: usize) -> Result<(), CodecError> {
        let add = |all: &AtomicUsize, num| all.fetch_add(num, Ordering::Relaxed) + num;
        let limit = self.limit;
        at_most("segments in a chunk", add(&self.segments, tile.num_cells()), limit)?;
        at_most("rows of segments in a chunk", add(&self.rows, tile.num_rows()), limit / 4)?;
        at_most("layers in a chunk", add(&self.layers, tile.planes.len()), limit / 8)?;
        at_most("corrected blocks in a chunk", add(&self.corrected, num_corrected), limit / BLOCK_LISTS)
    }
}

/// Size of [`Head`] without borders, bytes.
pub(super) const HEAD_BYTES: usize = 5 + STEPS_BYTES;
