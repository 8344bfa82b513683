//! The payload of a chunk: which tiles hold anything, the lengths of their lists, and the segments as byte planes of
//! prediction residuals. Planes are compressed one by one, since each has its own statistics.

use std::cell::RefCell;

use zstd::bulk::{Compressor, Decompressor};

use super::header::{ChunkHeader, HEADER_BYTES, num_tiles, peek};
use super::predict::{Walk, corrected};
use super::quantize::{Code, Lists};
use super::scale::{self, Scale};
use super::{CodecError, MAX_CHUNK_SEGMENTS, TILE, at_most};

/// The segments of one chunk, in the packed form of [`crate::layer::LayeredFrame`]. Every list is in order and within
/// the limits of its group.
#[derive(Clone, Debug, PartialEq)]
pub struct DecodedChunk {
    /// The header.
    pub header: ChunkHeader,
    /// Length of each list of [`ChunkHeader::rows`].
    pub(super) counts: Vec<u8>,
    pub(super) depth: Vec<u32>,
    pub(super) c_rg: Vec<u32>,
    pub(super) c_b_tau: Vec<u32>,
}

impl DecodedChunk {
    /// Number of segments.
    pub fn num_segments(&self) -> usize {
        self.depth.len()
    }
}

/// Encodes the lists of one chunk, which are `width` to a row.
pub(super) fn encode(lists: &Lists, width: usize, scale: &Scale, level: i32) -> Result<Vec<u8>, CodecError> {
    at_most("segments in a chunk", lists.codes.len(), MAX_CHUNK_SEGMENTS)?;
    let planes = planes_from_lists(lists, width, scale);
    let mut payload = vec![0; LENGTHS_BYTES];
    COMPRESSOR.with_borrow_mut(|(current_level, compressor)| {
        if *current_level != level {
            compressor.set_compression_level(level).map_err(|e| damaged(TILES, e))?;
            *current_level = level;
        }
        for (number, plane) in planes.iter().enumerate() {
            if plane.is_empty() {
                continue;
            }
            let start = payload.len();
            let bytes = compressor.compress(plane).map_err(|e| damaged(number, e))?;
            payload.extend_from_slice(&bytes);
            let length = (payload.len() - start) as u32;
            payload[number * 4..number * 4 + 4].copy_from_slice(&length.to_le_bytes());
        }
        Ok(payload)
    })
}

/// Decodes one chunk.
pub(super) fn decode_chunk(bytes: &[u8]) -> Result<DecodedChunk, CodecError> {
    let header = peek(bytes)?;
    let found = bytes.len();
    if found != header.chunk_bytes() || found < HEADER_BYTES + LENGTHS_BYTES {
        let expected = header.chunk_bytes().max(HEADER_BYTES + LENGTHS_BYTES);
        return Err(CodecError::Length { found, expected });
    }
    let (lengths, mut rest) = bytes[HEADER_BYTES..].split_at(LENGTHS_BYTES);
    let mut parts = [&[][..]; NUM_PLANES];
    for (number, part) in parts.iter_mut().enumerate() {
        let length = u32::from_le_bytes(std::array::from_fn(|i| lengths[number * 4 + i])) as usize;
        let problem = || format!("{length} bytes long, but {} are left", rest.len());
        (*part, rest) = rest.split_at_checked(length).ok_or_else(|| damaged(number, problem()))?;
    }
    if !rest.is_empty() {
        return Err(CodecError::Length { found, expected: found - rest.len() });
    }
    let width = header.frame.camera.intrinsics.width as usize;
    let scale = scale::of(header.color_bits)?;
    let counts = counts_from_parts(&header, &parts)?;
    let num_segments = counts.iter().map(|&c| usize::from(c)).sum();
    at_most("segments in a chunk", num_segments, MAX_CHUNK_SEGMENTS)?;
    let mut planes: [Vec<u8>; NUM_PLANES] = Default::default();
    for number in FRONT_LO..NUM_PLANES {
        let expected = plane_bytes(number, num_segments, header.color_bits);
        planes[number] = decompress(number, parts[number], expected)?;
    }
    let codes = codes_from_planes(&counts, &planes, width, scale)?;

    let half_c = |q: u16| u32::from(scale.color_half[usize::from(q)]);
    let half_tau = |q: u8| u32::from(scale.tau_half[usize::from(q)]);
    Ok(DecodedChunk {
        depth: codes.iter().map(|s| u32::from(s.front) | u32::from(s.back) << 16).collect(),
        c_rg: codes.iter().map(|s| half_c(s.c[0]) | half_c(s.c[1]) << 16).collect(),
        c_b_tau: codes.iter().map(|s| half_c(s.c[2]) | half_tau(s.tau) << 16).collect(),
        header,
        counts,
    })
}

fn counts_from_parts(header: &ChunkHeader, parts: &[&[u8]; NUM_PLANES]) -> Result<Vec<u8>, CodecError> {
    let intrinsics = header.frame.camera.intrinsics;
    let width = intrinsics.width as usize;
    let tiles_across = num_tiles(intrinsics.width);
    let num_lists = header.num_lists();
    let limit = usize::from(header.frame.k);
    let tile_count = tiles_across * num_tiles(header.rows().len() as u32);
    let tiles = decompress(TILES, parts[TILES], tile_count.div_ceil(8))?;
    let is_full = |list: usize| bit(&tiles, tile_of(list, width, tiles_across));
    let num_stored = (0..num_lists).filter(|&list| is_full(list)).count();
    let stored = decompress(COUNTS, parts[COUNTS], num_stored)?;
    let mut stored = stored.into_iter();
    let counts: Vec<u8> =
        (0..num_lists).map(|list| if is_full(list) { stored.next().unwrap_or(0) } else { 0 }).collect();
    match counts.iter().find(|&&count| usize::from(count) > limit) {
        Some(count) => Err(damaged(COUNTS, format!("a list of {count} segments, expected at most {limit}"))),
        None => Ok(counts),
    }
}

fn planes_from_lists(lists: &Lists, width: usize, scale: &Scale) -> [Vec<u8>; NUM_PLANES] {
    let color_bits = scale.color_bits;
    let tiles_across = width.div_ceil(TILE);
    let num_lists = lists.counts.len();
    let tile_rows = (num_lists / width).div_ceil(TILE);
    let mut planes: [Vec<u8>; NUM_PLANES] = Default::default();
    planes[TILES] = vec![0; (tiles_across * tile_rows).div_ceil(8)];
    for (list, _) in lists.counts.iter().enumerate().filter(|(_, count)| **count > 0) {
        let tile = tile_of(list, width, tiles_across);
        planes[TILES][tile / 8] |= 1 << (tile % 8);
    }
    for (number, plane) in planes.iter_mut().enumerate().skip(FRONT_LO) {
        *plane = vec![0; plane_bytes(number, lists.codes.len(), color_bits)];
    }
    let mut walk = Walk::new(width);
    for (list, &count) in lists.counts.iter().enumerate() {
        if bit(&planes[TILES], tile_of(list, width, tiles_across)) {
            planes[COUNTS].push(count);
        }
        let mut predictor = walk.next(usize::from(count));
        for at in predictor.own.clone() {
            let code = lists.codes[at];
            let front = zigzag16(code.front.wrapping_sub(predictor.front(&lists.codes, at)));
            let back = zigzag16(code.back.wrapping_sub(predictor.back(&lists.codes, at, code.front)));
            let near = predictor.near(&lists.codes, code.front, code.back);
            let tau = near.tau(scale, code.back.wrapping_sub(code.front));
            let expected = near.color(scale, code.tau);
            let c: [u16; 3] = std::array::from_fn(|ch| {
                let expected = corrected(scale, ch, &expected, &code.c);
                zigzag(code.c[ch].wrapping_sub(expected), color_bits)
            });
            planes[FRONT_LO][at] = front as u8;
            planes[FRONT_HI][at] = (front >> 8) as u8;
            planes[BACK_LO][at] = back as u8;
            planes[BACK_HI][at] = (back >> 8) as u8;
            for ch in 0..3 {
                planes[C_LO + ch][at] = c[ch] as u8;
            }
            if color_bits > 8 {
                planes[C_HI][at] = (c[0] >> 8 | c[1] >> 8 << 2 | c[2] >> 8 << 4) as u8;
            }
            planes[TAU][at] = zigzag(u16::from(code.tau).wrapping_sub(tau.into()), 8) as u8;
        }
    }
    planes
}

fn codes_from_planes(
    counts: &[u8],
    planes: &[Vec<u8>; NUM_PLANES],
    width: usize,
    scale: &Scale,
) -> Result<Vec<Code>, CodecError> {
    let mut codes: Vec<Code> = Vec::with_capacity(planes[FRONT_LO].len());
    let color_bits = scale.color_bits;
    let mut walk = Walk::new(width);
    for &count in counts {
        let mut predictor = walk.next(usize::from(count));
        let mut last_back = 0;
        for at in predictor.own.clone() {
            let word = |lo: usize, hi: usize| u16::from_le_bytes([planes[lo][at], planes[hi][at]]);
            let front = predictor.front(&codes, at).wrapping_add(unzigzag(word(FRONT_LO, FRONT_HI)));
            let back = predictor.back(&codes, at, front).wrapping_add(unzigzag(word(BACK_LO, BACK_HI)));
            if front < last_back || back <= front {
                return Err(damaged(
                    FRONT_LO,
                    format!("segment {front}..{back} after one that ends at {last_back}"),
                ));
            }
            last_back = back;
            let near = predictor.near(&codes, front, back);
            let tau = near.tau(scale, back - front).wrapping_add(unzigzag(planes[TAU][at].into()) as u8);
            let c_hi = if color_bits > 8 { planes[C_HI][at] } else { 0 };
            let expected = near.color(scale, tau);
            let mut c = [0; 3];
            for ch in 0..3 {
                let residual = u16::from_le_bytes([planes[C_LO + ch][at], c_hi >> (2 * ch) & 3]);
                c[ch] =
                    corrected(scale, ch, &expected, &c).wrapping_add(unzigzag(residual)) & scale.max_code();
            }
            codes.push(Code { front, back, c, tau });
        }
    }
    Ok(codes)
}

/// Bytes of a plane that has one for each segment, or none.
fn plane_bytes(number: usize, num_segments: usize, color_bits: u8) -> usize {
    if number == C_HI && color_bits == 8 { 0 } else { num_segments }
}

/// Which tile of its band a list lies in.
fn tile_of(list: usize, width: usize, tiles_across: usize) -> usize {
    list / width / TILE * tiles_across + list % width / TILE
}

fn bit(bytes: &[u8], i: usize) -> bool {
    bytes[i / 8] >> (i % 8) & 1 == 1
}

/// A difference modulo 2^`bits`, taken as the signed number nearest to zero: 0, −1, 1, −2 … become 0, 1, 2, 3 …
fn zigzag(difference: u16, bits: u8) -> u16 {
    let unused = 16 - bits;
    zigzag16(((difference << unused) as i16 >> unused) as u16)
}

fn zigzag16(difference: u16) -> u16 {
    difference << 1 ^ (difference as i16 >> 15) as u16
}

/// Inverse of [`zigzag`] up to a multiple of 2^`bits`.
fn unzigzag(residual: u16) -> u16 {
    residual >> 1 ^ (residual & 1).wrapping_neg()
}

fn decompress(number: usize, part: &[u8], expected: usize) -> Result<Vec<u8>, CodecError> {
    if expected == 0 {
        return match part.len() {
            0 => Ok(vec![]),
            n => Err(damaged(number, format!("{n} bytes long, expected none"))),
        };
    }
    // The buffer has room for the expected bytes alone: zstd stops there, whatever the frame claims.
    let mut plane = Vec::with_capacity(expected);
    let found = DECOMPRESSOR
        .with_borrow_mut(|d| d.decompress_to_buffer(part, &mut plane))
        .map_err(|e| damaged(number, e))?;
    if found != expected {
        return Err(damaged(number, format!("{found} bytes, expected {expected}")));
    }
    Ok(plane)
}

fn damaged(number: usize, problem: impl std::fmt::Display) -> CodecError {
    CodecError::Payload { plane: PLANE_NAMES[number], problem: problem.to_string() }
}

thread_local! {
    // A zstd context is some hundred kilobytes: one a thread, kept.
    static COMPRESSOR: RefCell<(i32, Compressor<'static>)> = RefCell::new((0, Compressor::default()));
    static DECOMPRESSOR: RefCell<Decompressor<'static>> = RefCell::new(Decompressor::default());
}

const TILES: usize = 0;
const COUNTS: usize = 1;
const FRONT_LO: usize = 2;
const FRONT_HI: usize = 3;
const BACK_LO: usize = 4;
const BACK_HI: usize = 5;
const C_LO: usize = 6;
const C_HI: usize = 9;
const TAU: usize = 10;
const NUM_PLANES: usize = 11;
const PLANE_NAMES: [&str; NUM_PLANES] = [
    "tiles",
    "lengths",
    "front, low",
    "front, high",
    "back, low",
    "back, high",
    "red",
    "green",
    "blue",
    "colour, high",
    "tau",
];
const LENGTHS_BYTES: usize = NUM_PLANES * 4;
