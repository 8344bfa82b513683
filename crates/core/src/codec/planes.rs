//! The payload of a chunk in the exact mode: which tiles hold anything, then the lengths of their lists and the
//! segments as planes of numbers, each plane a stream of its own (`contexts`, `rans`).

use std::cell::RefCell;
use std::ops::Range;

use super::bands::Borders;
use super::contexts::{
    DIRECTORY_BYTES, LENGTHS, NUM_PARTS, NUM_PLANES, PLANE_NAMES, Plane, PlaneReader, Recorder, parts,
    readers,
};
use super::header::{ChunkHeader, HEADER_BYTES, num_tiles, peek};
use super::predict::{self, Misordered};
use super::quantize::Lists;
use super::rows::{Matter, Rows};
use super::scale::{self, Scale};
use super::spent::{Spent, TileClass};
use super::{CodecError, MAX_CHUNK_SEGMENTS, TILE, at_most, split_off};
use crate::camera::Intrinsics;

/// The segments of one chunk, in the packed form of [`crate::layer::LayeredFrame`]. Every list is in order and within
/// the limits of its group.
#[derive(Clone, Debug, PartialEq)]
pub struct DecodedChunk {
    /// The header.
    pub header: ChunkHeader,
    /// Where the bands of the frame end, in rows of tiles; none if they are as high as each other.
    pub(super) borders: Option<Borders>,
    /// Length of each list of [`DecodedChunk::rows`].
    pub(super) counts: Vec<u8>,
    pub(super) depth: Vec<u32>,
    pub(super) c_rg: Vec<u32>,
    pub(super) c_b_tau: Vec<u32>,
}

impl DecodedChunk {
    /// Rows of lists that the chunk covers.
    pub fn rows(&self) -> Range<u32> {
        self.header.rows(self.borders)
    }

    /// Number of segments.
    pub fn num_segments(&self) -> usize {
        self.depth.len()
    }
}

/// Encodes the lists of one chunk, which are `width` to a row. What the payload has in front of them is not its part.
pub(super) fn encode(lists: &mut Lists, width: usize, scale: &Scale) -> Result<Vec<u8>, CodecError> {
    let Lists { counts, codes } = lists;
    at_most("segments in a chunk", codes.len(), MAX_CHUNK_SEGMENTS)?;
    let tiles = Tiles::of_lists(counts, width);
    let mut payload = tiles.bits.clone();
    if codes.is_empty() {
        return Ok(payload);
    }
    RECORDER.with_borrow_mut(|recorder| {
        walk_lengths(&mut recorder.planes[LENGTHS], &tiles, counts, width);
        let mut rows = Rows::new(scale, counts, width);
        let mut rest = &codes[..];
        for counts in counts.chunks_exact(width) {
            rows.advance(counts);
            let (codes, below) = rest.split_at(num_segments(counts));
            rest = below;
            rows.fill(counts, codes);
            predict::row(&mut recorder.planes, scale, &mut rows, counts).map_err(misordered)?;
        }
        recorder.finish(&mut payload);
        Ok(payload)
    })
}

/// Decodes one chunk.
pub(super) fn decode_chunk(bytes: &[u8]) -> Result<DecodedChunk, CodecError> {
    let mut opened = Opened::new(bytes)?;
    let [mut depth, mut c_rg, mut c_b_tau] = [(); 3].map(|()| vec![0; opened.num_segments]);
    decode(&mut opened, [&mut depth, &mut c_rg, &mut c_b_tau])?;
    let Opened { header, borders, counts, .. } = opened;
    Ok(DecodedChunk { header, borders, counts, depth, c_rg, c_b_tau })
}

/// A chunk whose lists are known, and whose segments are still to be decoded.
pub(super) struct Opened<'a> {
    pub(super) header: ChunkHeader,
    pub(super) borders: Option<Borders>,
    /// Length of each list.
    pub(super) counts: Vec<u8>,
    pub(super) num_segments: usize,
    scale: &'static Scale,
    readers: [PlaneReader<'a>; NUM_PLANES],
}

impl<'a> Opened<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Result<Self, CodecError> {
        let header = peek(bytes)?;
        let scale = scale::of(header.color_bits)?;
        let width = header.frame.camera.intrinsics.width as usize;
        let (borders, tiles, streams) = split(&header, bytes)?;
        let mut counts = vec![0; header.rows(borders).len() * width];
        if streams.is_empty() && tiles.are_empty() {
            return Ok(Self { header, borders, counts, num_segments: 0, scale, readers: Default::default() });
        }
        let parts = split_parts(streams)?;
        let mut readers = readers(&parts).map_err(|problem| damaged(TABLES, problem))?;
        walk_lengths(&mut readers[LENGTHS], &tiles, &mut counts, width);
        let limit = header.frame.k;
        if let Some(count) = counts.iter().find(|&&count| count > limit) {
            let problem = format!("a list of {count} segments, expected at most {limit}");
            return Err(damaged(PLANE_NAMES[LENGTHS], problem));
        }
        let num_segments = num_segments(&counts);
        at_most("segments in a chunk", num_segments, MAX_CHUNK_SEGMENTS)?;
        Ok(Self { header, borders, counts, num_segments, scale, readers })
    }
}

/// The words of so many segments, as planes of [`crate::layer::LayeredFrame`]: depths, red and green, blue and τ.
pub(super) type Words<'a> = [&'a mut [u32]; 3];

/// Decodes the segments of a chunk, into as many words.
pub(super) fn decode(opened: &mut Opened<'_>, words: Words<'_>) -> Result<(), CodecError> {
    let Opened { header, counts, num_segments, scale, readers, .. } = opened;
    let half_c = |q: u16| u32::from(scale.color_half[usize::from(q)]);
    let half_tau = |q: u8| u32::from(scale.tau_half[usize::from(q)]);
    let width = header.frame.camera.intrinsics.width as usize;
    // Of a chunk without segments there may be many millions of lists.
    let counts = if *num_segments > 0 { &counts[..] } else { &[] };
    let mut rows = Rows::new(scale, counts, width);
    let mut words = words;
    for counts in counts.chunks_exact(width) {
        rows.advance(counts);
        predict::row(readers, scale, &mut rows, counts).map_err(misordered)?;
        let Rows { links, depths, matters, .. } = &rows;
        let [depth, c_rg, c_b_tau] = words.each_mut().map(|plane| split_off(plane, links.len()));
        for (((link, depth), c_rg), c_b_tau) in links.iter().zip(depth).zip(c_rg).zip(c_b_tau) {
            let slot = link.slot as usize;
            let Matter { c: [r, g, b], tau, .. } = matters[slot];
            *depth = depths[slot];
            *c_rg = half_c(r) | half_c(g) << 16;
            *c_b_tau = half_c(b) | half_tau(tau) << 16;
        }
    }
    match readers.iter().position(|plane| !PlaneReader::ended(plane)) {
        Some(plane) => Err(damaged(PLANE_NAMES[plane], "its stream does not end with its last number")),
        None => Ok(()),
    }
}

/// What a chunk spends its bytes on: the header, with the borders of bands behind it, the bitmap of tiles, the lengths of the
/// parts, the tables, and every plane.
pub(super) fn spent(header: &ChunkHeader, bytes: &[u8]) -> Result<Spent, CodecError> {
    let (borders, tiles, streams) = split(header, bytes)?;
    let borders = borders.map_or(0, |borders| borders.num_bytes());
    let mut parts = vec![("header", HEADER_BYTES + borders), ("tiles", tiles.bits.len())];
    if !streams.is_empty() {
        let streams = split_parts(streams)?;
        parts.extend([("part lengths", DIRECTORY_BYTES), (TABLES, streams[0].len())]);
        parts.extend(
            (0..NUM_PLANES).map(|p| (PLANE_NAMES[p], streams[1 + 2 * p].len() + streams[2 + 2 * p].len())),
        );
    }
    let num = tiles.num;
    let num_filled = tiles.bits.iter().map(|bits| bits.count_ones() as usize).sum();
    let in_planes = parts.iter().skip(NUM_BEFORE_PLANES).map(|(_, bytes)| bytes).sum();
    let num_of_base = |num: usize| if header.is_base() { num } else { 0 };
    let tiles = vec![
        TileClass { name: "empty", num: num_of_base(num - num_filled), bytes: 0 },
        TileClass { name: "with segments", num: num_of_base(num_filled), bytes: in_planes },
    ];
    Ok(Spent { parts, tile_side: TILE, tiles })
}

/// Of what a chunk has: header, bitmap, lengths and tables.
const NUM_BEFORE_PLANES: usize = 4;

/// Where the bands of a frame end, if the chunk says so, its tiles that hold anything, and the bytes behind their bitmap.
fn split<'a>(
    header: &ChunkHeader,
    bytes: &'a [u8],
) -> Result<(Option<Borders>, Tiles, &'a [u8]), CodecError> {
    let Intrinsics { width, height, .. } = header.frame.camera.intrinsics;
    let mut payload = bytes.get(HEADER_BYTES..).unwrap_or_default();
    let (found, expected) = (bytes.len(), header.chunk_bytes());
    if found != expected {
        return Err(CodecError::Length { found, expected });
    }
    let read = || Borders::read(&mut payload, header.num_base, num_tiles(height));
    let borders = header.has_borders.then(read).transpose()?;
    let across = num_tiles(width);
    let num_tiles = across * num_tiles(header.rows(borders).len() as u32);
    let bitmap = num_tiles.div_ceil(8);
    let Some((bits, streams)) = payload.split_at_checked(bitmap) else {
        return Err(CodecError::Length { found, expected: found - payload.len() + bitmap });
    };
    let num_unused = 8 * bitmap - num_tiles;
    if bits.last().is_some_and(|last| last.leading_zeros() < num_unused as u32) {
        return Err(damaged("tiles", format!("more than the band's {num_tiles} are marked")));
    }
    Ok((borders, Tiles { across, num: num_tiles, bits: bits.to_vec() }, streams))
}

fn split_parts(streams: &[u8]) -> Result<[&[u8]; NUM_PARTS], CodecError> {
    parts(streams).map_err(|(number, length, left)| match number {
        0 if length == DIRECTORY_BYTES => damaged("part lengths", format!("{left} bytes, expected {length}")),
        0 => damaged(TABLES, format!("{length} bytes long, but {left} are left")),
        NUM_PARTS => damaged(PLANE_NAMES[NUM_PLANES - 1], format!("{left} bytes are left over")),
        _ => damaged(PLANE_NAMES[(number - 1) / 2], format!("{length} bytes long, but {left} are left")),
    })
}

/// Which tiles of a band hold anything.
struct Tiles {
    across: usize,
    num: usize,
    /// One bit a tile, row by row, lowest bit first.
    bits: Vec<u8>,
}

impl Tiles {
    fn of_lists(counts: &[u8], width: usize) -> Self {
        let across = width.div_ceil(TILE);
        let num = across * (counts.len() / width).div_ceil(TILE);
        let mut bits = vec![0; num.div_ceil(8)];
        for (y, row) in counts.chunks_exact(width).enumerate() {
            for (x, lists) in row.chunks(TILE).enumerate() {
                if lists.iter().any(|&count| count > 0) {
                    let tile = y / TILE * across + x;
                    bits[tile / 8] |= 1 << (tile % 8);
                }
            }
        }
        Self { across, num, bits }
    }

    fn are_empty(&self) -> bool {
        self.bits.iter().all(|&bits| bits == 0)
    }

    fn is_filled(&self, x: usize, y: usize) -> bool {
        let tile = y * self.across + x;
        self.bits[tile / 8] >> (tile % 8) & 1 == 1
    }
}

/// Codes the lengths of the lists, `width` to a row, of all tiles that hold any; a decoder fills them in.
fn walk_lengths<P: Plane>(plane: &mut P, tiles: &Tiles, counts: &mut [u8], width: usize) {
    for y in 0..counts.len() / width {
        let (above, row) = counts.split_at_mut(y * width);
        let above = above.len().checked_sub(width).map_or(&[][..], |start| &above[start..]);
        for tile in (0..tiles.across).filter(|&x| tiles.is_filled(x, y / TILE)) {
            for x in tile * TILE..((tile + 1) * TILE).min(width) {
                let left = if x > 0 { row[x - 1] } else { 0 };
                let context = predict::length_context(left, above.get(x).copied().unwrap_or(0));
                let given = row[x];
                row[x] = plane.code::<false>(context, || given.into()).min(u8::MAX.into()) as u8;
            }
        }
    }
}

fn num_segments(counts: &[u8]) -> usize {
    counts.iter().map(|&count| usize::from(count)).sum()
}

fn misordered(Misordered([front, back, last_back]): Misordered) -> CodecError {
    damaged("front", format!("segment {front}..{back} after one that ends at {last_back}"))
}

fn damaged(plane: &'static str, problem: impl std::fmt::Display) -> CodecError {
    CodecError::Payload { plane, problem: problem.to_string() }
}

thread_local! {
    // A recorder is some megabytes in the end: one a thread, kept.
    static RECORDER: RefCell<Recorder> = RefCell::default();
}

const TABLES: &str = "tables";
