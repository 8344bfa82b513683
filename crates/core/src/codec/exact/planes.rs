//! The payload of a chunk in the exact coding. It states which tiles have segments, the lengths of their lists, and
//! the segments as planes of numbers. Each plane is a stream of its own (`contexts`, `rans`).

use std::cell::RefCell;
use std::ops::Range;

use super::super::bands::{Borders, split_off};
use super::super::error::{CodecError, at_most};
use super::super::header::{ChunkHeader, HEADER_BYTES, TILE, num_tiles};
use super::super::limits::MAX_CHUNK_SEGMENTS;
use super::contexts::{
    LENGTHS, NUM_PLANES, PLANE_NAMES, PlaneCoder, PlaneReader, Recorder, TABLES, parts, readers,
};
use super::predict::{self, Misordered};
use super::quantize::CodedLists;
use super::rows::{ListRows, SegmentCodes};
use super::scale::scale;
use crate::camera::Intrinsics;

/// The rows of lists of a band in a frame of `height` rows.
pub(super) fn rows_of(borders: Borders, band: usize, height: u32) -> Range<usize> {
    let rows = borders.rows(band, num_tiles(height));
    let edge = |row: usize| (row * TILE).min(height as usize);
    edge(rows.start)..edge(rows.end)
}

/// Encodes the lists of a chunk, `width` in a row. Returns the payload without the borders of bands.
pub(super) fn encode(lists: &mut CodedLists, width: usize) -> Result<Vec<u8>, CodecError> {
    let CodedLists { counts, codes } = lists;
    at_most("segments in a chunk", codes.len(), MAX_CHUNK_SEGMENTS)?;
    let tiles = Tiles::of_lists(counts, width);
    let mut payload = tiles.bits.clone();
    if codes.is_empty() {
        return Ok(payload);
    }
    RECORDER.with_borrow_mut(|recorder| {
        walk_lengths(&mut recorder.planes[LENGTHS], &tiles, counts, width);
        let mut rows = ListRows::new(scale(), counts, width);
        let mut rest = &codes[..];
        for counts in counts.chunks_exact(width) {
            rows.advance(counts);
            let (codes, below) = rest.split_at(num_segments(counts));
            rest = below;
            rows.fill(counts, codes);
            predict::row(&mut recorder.planes, scale(), &mut rows, counts).map_err(misordered)?;
        }
        recorder.finish(&mut payload);
        Ok(payload)
    })
}

/// A chunk whose list lengths are known, and whose segments are still to be decoded.
pub(super) struct Opened<'a> {
    pub(super) borders: Borders,
    /// Length of each list.
    pub(super) counts: Vec<u8>,
    pub(super) num_segments: usize,
    /// Number of lists in a row.
    width: usize,
    readers: [PlaneReader<'a>; NUM_PLANES],
}

impl<'a> Opened<'a> {
    /// Opens a chunk, header included. Its length must be the one that the header states.
    pub(super) fn new(header: &ChunkHeader, bytes: &'a [u8]) -> Result<Self, CodecError> {
        let Intrinsics { width, height, .. } = header.frame.camera.intrinsics;
        let width = width as usize;
        let mut payload = bytes.get(HEADER_BYTES..).unwrap_or_default();
        let borders = Borders::read(&mut payload, header.num_chunks, num_tiles(height))?;
        let num_rows = rows_of(borders, header.index.0.into(), height).len();
        let (tiles, streams) = Tiles::read(payload, width, num_rows)?;
        let mut counts = vec![0; num_rows * width];
        if streams.is_empty() && tiles.are_empty() {
            return Ok(Self { borders, counts, num_segments: 0, width, readers: Default::default() });
        }
        let parts = parts(streams).map_err(|part| damaged(part, "its length does not fit"))?;
        let mut readers = readers(&parts).map_err(|problem| damaged(TABLES, problem))?;
        walk_lengths(&mut readers[LENGTHS], &tiles, &mut counts, width);
        let limit = header.frame.k;
        if let Some(count) = counts.iter().find(|&&count| count > limit) {
            let problem = format!("a list of {count} segments, expected at most {limit}");
            return Err(damaged(PLANE_NAMES[LENGTHS], problem));
        }
        let num_segments = num_segments(&counts);
        at_most("segments in a chunk", num_segments, MAX_CHUNK_SEGMENTS)?;
        Ok(Self { borders, counts, num_segments, width, readers })
    }
}

/// Segments as words, in the planes of [`crate::layer::LayeredFrame`]: depths, red and green, blue and τ.
pub(super) type Words<'a> = [&'a mut [u32]; 3];

/// Decodes the segments of a chunk into `words`, which have room for exactly these.
pub(super) fn decode(opened: &mut Opened<'_>, words: Words<'_>) -> Result<(), CodecError> {
    let Opened { counts, num_segments, width, readers, .. } = opened;
    let (scale, width) = (scale(), *width);
    let half_c = |q: u16| u32::from(scale.color_half[usize::from(q)]);
    let half_tau = |q: u8| u32::from(scale.tau_half[usize::from(q)]);
    // A chunk without segments may have many millions of lists.
    let counts = if *num_segments > 0 { &counts[..] } else { &[] };
    let mut rows = ListRows::new(scale, counts, width);
    let mut words = words;
    for counts in counts.chunks_exact(width) {
        rows.advance(counts);
        predict::row(readers, scale, &mut rows, counts).map_err(misordered)?;
        let ListRows { links, depths, matters, .. } = &rows;
        let [depth, c_rg, c_b_tau] = words.each_mut().map(|plane| split_off(plane, links.len()));
        for (((link, depth), c_rg), c_b_tau) in links.iter().zip(depth).zip(c_rg).zip(c_b_tau) {
            let slot = link.slot as usize;
            let SegmentCodes { c: [r, g, b], tau, .. } = matters[slot];
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

/// Which tiles of a band have segments.
struct Tiles {
    across: usize,
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
        Self { across, bits }
    }

    /// Reads the tiles of a band at the start of a payload. Returns the rest of the payload, too.
    fn read(payload: &[u8], width: usize, num_rows: usize) -> Result<(Self, &[u8]), CodecError> {
        let across = width.div_ceil(TILE);
        let num = across * num_rows.div_ceil(TILE);
        let Some((bits, streams)) = payload.split_at_checked(num.div_ceil(8)) else {
            return Err(damaged("tiles", format!("{} bytes, expected {}", payload.len(), num.div_ceil(8))));
        };
        let num_unused = 8 * bits.len() - num;
        if bits.last().is_some_and(|last| last.leading_zeros() < num_unused as u32) {
            return Err(damaged("tiles", format!("more than the band's {num} are marked")));
        }
        Ok((Self { across, bits: bits.to_vec() }, streams))
    }

    fn are_empty(&self) -> bool {
        self.bits.iter().all(|&bits| bits == 0)
    }

    fn is_filled(&self, x: usize, y: usize) -> bool {
        let tile = y * self.across + x;
        self.bits[tile / 8] >> (tile % 8) & 1 == 1
    }
}

/// Codes the lengths of the lists in all tiles with segments, `width` lists in a row. A decoder fills them in.
fn walk_lengths<P: PlaneCoder>(plane: &mut P, tiles: &Tiles, counts: &mut [u8], width: usize) {
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
    // A recorder grows to some megabytes, so each thread keeps one.
    static RECORDER: RefCell<Recorder> = RefCell::default();
}
