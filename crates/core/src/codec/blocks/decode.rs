//! Decodes the chunks of a frame in blocks.

use std::cmp::Reverse;

use rayon::prelude::*;

use super::super::error::{CodecError, at_most};
use super::super::header::{ChunkHeader, HEADER_BYTES};
use super::super::limits::{MAX_CHUNK_SEGMENTS, MAX_FRAME_SEGMENTS};
use super::coding::{NoSource, TileCoder, TileScratch};
use super::corrections::{self, TilePicture};
use super::entropy::{Decoder, Tables, Tally};
use super::head::{Head, Room, read_streams};
use super::model::{MAX_LAYERS, TilePlace};
use super::motion::ReferenceMotion;
use super::reference::{CodedTile, Reference, References};
use super::steps::StepSizes;
use crate::ids::FrameId;

/// Decodes all chunks of a frame, in order of index.
pub(in crate::codec) fn decode(
    chunks: &[(ChunkHeader, &[u8])],
    references: &References,
) -> Result<Reference, CodecError> {
    let named = |name| references.get(name).map(AsRef::as_ref);
    let bands = chunks.par_iter().map(|(header, bytes)| Ok((header, decode_band(header, bytes, named)?)));
    let bands: Vec<_> = bands.collect::<Result<_, CodecError>>()?;
    let Some(&(header, DecodedBand { head, .. })) = bands.first() else {
        return Err(CodecError::Incomplete { found: 0, expected: 1 });
    };
    if let Some((header, _)) = bands.iter().find(|(_, other)| other.head != head) {
        return Err(header.contradicts("other steps, predictions or bands"));
    }
    let tally = bands.iter().fold(Tally::default(), |all, (_, band)| all.and(&band.tally));
    let tiles: Vec<CodedTile> = bands.into_iter().flat_map(|(_, band)| band.tiles).collect();
    let num_cells = tiles.iter().map(|coded| coded.tile.num_cells()).sum();
    at_most("segments in a frame", num_cells, MAX_FRAME_SEGMENTS)?;
    let num_rows = tiles.iter().map(|coded| coded.tile.num_rows()).sum();
    at_most("rows of segments in a frame", num_rows, MAX_FRAME_SEGMENTS / 4)?;
    Ok(Reference::of_tiles(header.frame, head.steps, tiles, &tally, head.reference.and_then(named)))
}

/// A decoded chunk.
pub(in crate::codec) struct DecodedBand {
    head: Head,
    pub(in crate::codec) tiles: Vec<CodedTile>,
    /// What its bits were.
    pub(in crate::codec) tally: Tally,
}

/// Decodes the tiles of a chunk, given the reference of a name.
pub(in crate::codec) fn decode_band<'a>(
    header: &ChunkHeader,
    bytes: &[u8],
    named: impl Fn(FrameId) -> Option<&'a Reference>,
) -> Result<DecodedBand, CodecError> {
    let mut coded = bytes.get(HEADER_BYTES..).unwrap_or_default();
    if usize::from(header.frame.k) != MAX_LAYERS {
        let expected = MAX_LAYERS.to_string();
        return Err(CodecError::Header { what: "k", found: header.frame.k.to_string(), expected });
    }
    let head = Head::read(&mut coded, header)?;
    let reference = match head.reference {
        Some(name) => {
            let missing = CodecError::Reference { frame: header.frame.frame, reference: name };
            Some(named(name).ok_or(missing)?)
        }
        None => None,
    };
    let own;
    let tables = match reference {
        Some(reference) => &reference.tables,
        None => {
            own = Tables::read(&mut coded)?;
            &own
        }
    };
    let motion = reference.map(|r| (r, ReferenceMotion::new(&header.frame.camera, &r.header.camera)));
    let num_cells = reference.map_or(0, Reference::cells_per_tile);
    let chunk = ChunkCoding { steps: head.steps, tables, motion, num_cells };
    let streams = read_streams(coded, &head.tiles(&header.frame, header.index.0.into()))?;
    let (tiles, tally) = chunk.decode_all(streams.into_iter().enumerate().collect())?;
    Ok(DecodedBand { head, tiles, tally })
}

/// What the tiles of a chunk share.
struct ChunkCoding<'a> {
    steps: StepSizes,
    tables: &'a Tables,
    motion: Option<(&'a Reference, ReferenceMotion)>,
    /// About as many cells as a tile of the reference has.
    num_cells: usize,
}

/// The number of a stream, the place of its blocks, and its bytes.
type TileStream<'a> = (usize, (TilePlace, &'a [u8]));

impl ChunkCoding<'_> {
    /// Decodes all streams of a chunk, in the order of their numbers. The tally has the bits of all.
    fn decode_all(&self, mut streams: Vec<TileStream<'_>>) -> Result<(Vec<CodedTile>, Tally), CodecError> {
        streams.sort_by_key(|(_, (_, stream))| Reverse(stream.len()));
        let room = Room::new(MAX_CHUNK_SEGMENTS);
        // Each thread takes one at a time, so no thread has a long one left at the end. Each has a tally of its own.
        let nothing = || Ok((Vec::new(), Tally::default()));
        let first = || (nothing(), TileScratch::default());
        let decoded = streams.into_iter().par_bridge().fold(
            first,
            |(all, mut scratch): (Result<(Vec<_>, Tally), CodecError>, _), (index, (place, stream))| {
                let all = all.and_then(|(mut tiles, tally)| {
                    let (tile, tally) = self.decode(stream, place, tally, &mut scratch)?;
                    room.take(&tile.tile, tile.picture.num_blocks())?;
                    tiles.push((index, tile));
                    Ok((tiles, tally))
                });
                (all, scratch)
            },
        );
        let (mut tiles, tally) = decoded.map(|(all, _)| all).reduce(nothing, |a, b| {
            let ((mut tiles, tally), (others, other)) = (a?, b?);
            tiles.extend(others);
            Ok((tiles, tally.and(&other)))
        })?;
        tiles.sort_unstable_by_key(|(index, _)| *index);
        Ok((tiles.into_iter().map(|(_, tile)| tile).collect(), tally))
    }

    /// Decodes a tile, whose bits are added to the tally.
    fn decode(
        &self,
        stream: &[u8],
        place: TilePlace,
        tally: Tally,
        scratch: &mut TileScratch,
    ) -> Result<(CodedTile, Tally), CodecError> {
        let Self { steps, tables, motion, .. } = *self;
        // Few bytes take little memory.
        let num_cells = self.num_cells.min(stream.len() * CELLS_PER_BYTE);
        let decoder = Decoder::new(stream, tables, tally);
        let coder = TileCoder::new(decoder, steps, place, motion, num_cells, scratch);
        let (mut decoder, tile, _) = coder.run(&mut NoSource)?;
        let mut picture = TilePicture::default();
        if tile.num_cells() > 0 {
            let corrections;
            (decoder, corrections) = corrections::code(decoder, &steps, place, |_, _| 0)?;
            picture = TilePicture::new(&tile, &corrections);
        }
        if !decoder.is_at_end() {
            return Err(CodecError::Payload {
                plane: "blocks",
                problem: "bits are left over or missing".into(),
            });
        }
        Ok((CodedTile { tile, picture }, decoder.tally))
    }
}

/// Upper bound on the cells of a predicted frame for each byte.
const CELLS_PER_BYTE: usize = 64;
