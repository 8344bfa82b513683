//! The payload of a chunk of the rate mode, and the chunks of a frame put together.

use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;

use super::super::bands::Borders;
use super::super::header::{ChunkHeader, HEADER_BYTES};
use super::super::{CodecError, MAX_BANDS, MAX_CHUNK_SEGMENTS, MAX_FRAME_SEGMENTS, at_most, split_off};
use super::band::{Band, Cells, NO_CELLS, blocks_along};
use super::coding::{BandCoder, Nothing, Place};
use super::entropy::{Decoder, Reader};
use super::model::{BLOCK, BLOCK_LISTS, MAX_LAYERS, lists_of};
use super::motion::Motion;
use super::picture::{self, Corrections, roots};
use super::reference::{Reference, References};
use super::scales::scales;
use super::steps::{STEPS_BYTES, Steps};
use crate::ids::FrameId;
use crate::layer::{LayeredFrame, pack_halves};

/// What the payload begins with; the same in all chunks of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Head {
    pub(super) steps: Steps,
    /// The frame that this one is predicted from.
    pub(super) reference: Option<FrameId>,
    /// Whether the corrections of the picture are chunks of their own; otherwise each follows its base.
    pub(super) is_split: bool,
    /// Whether planes are predicted from the edges of those beside, and not from their means.
    pub(super) has_edges: bool,
    /// Whether borders between blocks of the corrected picture are smoothed.
    pub(super) is_smooth: bool,
    /// Where the bands end; none if they are as high as each other.
    pub(super) borders: Option<Borders>,
}

impl Head {
    pub(super) fn to_bytes(self) -> Vec<u8> {
        let Self { reference, is_split, borders, has_edges, is_smooth, .. } = self;
        let flags = [reference.is_some(), is_split, borders.is_some(), has_edges, is_smooth];
        let mut bytes = Vec::with_capacity(HEAD_BYTES + 2 * MAX_BANDS);
        bytes.push(flags.iter().rev().fold(0, |bits, flag| bits << 1 | u8::from(*flag)));
        bytes.extend(self.reference.unwrap_or(FrameId(0)).0.to_le_bytes());
        bytes.extend(self.steps.to_bytes());
        if let Some(borders) = self.borders {
            borders.write(&mut bytes);
        }
        bytes
    }

    /// Takes it from the front of a payload.
    fn read(bytes: &mut &[u8], header: &ChunkHeader) -> Result<Self, CodecError> {
        let Some((fixed, rest)) = bytes.split_first_chunk::<HEAD_BYTES>() else {
            let expected = HEADER_BYTES + HEAD_BYTES;
            return Err(CodecError::Length { found: HEADER_BYTES + bytes.len(), expected });
        };
        let damaged = |problem: String| CodecError::Payload { plane: "head", problem };
        let [flags, _, _, _, _, steps @ ..] = *fixed;
        let reference = named(fixed)?;
        let steps = Steps::from_bytes(steps)
            .ok_or_else(|| damaged(format!("steps {steps:02x?}, expected positive ones")))?;
        *bytes = rest;
        let num_rows = blocks_along(header.frame.camera.intrinsics.height);
        let has_borders = flags & HAS_BORDERS != 0;
        let borders = has_borders.then(|| Borders::read(bytes, header.num_base, num_rows)).transpose()?;
        let [is_split, has_edges, is_smooth] = [IS_SPLIT, HAS_EDGES, IS_SMOOTH].map(|flag| flags & flag != 0);
        Ok(Self { steps, reference, is_split, has_edges, is_smooth, borders })
    }

    /// The steps that borders between blocks of the corrected picture are smoothed by, if they are.
    pub(super) fn smoothing(&self) -> Option<[f32; 3]> {
        self.is_smooth.then(|| self.steps.of_picture())
    }

    /// Whether a band has corrections.
    pub(super) fn has_corrections(&self, band: &Band) -> bool {
        self.steps.picture > 0.0 && band.num_cells() > 0
    }
}

/// The frame that the fixed part of a head names.
fn named(&[flags, a, b, c, d, ..]: &[u8; HEAD_BYTES]) -> Result<Option<FrameId>, CodecError> {
    let frame = FrameId(u32::from_le_bytes([a, b, c, d]));
    let is_known = flags & !(IS_PREDICTED | IS_SPLIT | HAS_BORDERS | HAS_EDGES | IS_SMOOTH) == 0
        && flags & (IS_PREDICTED | HAS_EDGES) != IS_PREDICTED | HAS_EDGES;
    match (flags & IS_PREDICTED != 0, frame) {
        (false, FrameId(0)) if is_known => Ok(None),
        (true, _) if is_known => Ok(Some(frame)),
        _ => {
            let problem = format!("flags {flags} with reference {frame}");
            Err(CodecError::Payload { plane: "head", problem })
        }
    }
}

/// The frame that a chunk of the rate mode says it is predicted from, if the bytes are such a chunk.
pub fn reference_named(bytes: &[u8]) -> Option<FrameId> {
    named(bytes.get(HEADER_BYTES..)?.first_chunk()?).ok()?
}

/// A decoded chunk of the rate mode.
#[derive(Clone, Debug, PartialEq)]
pub struct BlocksChunk {
    /// The header.
    pub header: ChunkHeader,
    head: Head,
    content: Content,
}

#[derive(Clone, Debug, PartialEq)]
enum Content {
    /// With corrections, if they are not split.
    Base(Arc<Band>),
    Corrections(Corrections),
}

impl BlocksChunk {
    /// Rows of lists that the chunk covers.
    pub fn rows(&self) -> Range<u32> {
        let Place { first_row, num_rows, size, .. } = place(&self.header, self.head.borders);
        let row = |block: usize| (block * BLOCK).min(size[1]) as u32;
        row(first_row)..row(first_row + num_rows)
    }

    /// Number of segments.
    pub fn num_segments(&self) -> usize {
        match &self.content {
            Content::Base(band) => band.num_cells(),
            Content::Corrections(_) => 0,
        }
    }
}

/// The blocks of a band of a frame.
pub(super) fn place(header: &ChunkHeader, borders: Option<Borders>) -> Place {
    let intrinsics = header.frame.camera.intrinsics;
    let rows = match borders {
        Some(borders) => borders.rows(header.band, blocks_along(intrinsics.height)),
        None => {
            let rows = header.rows(None);
            let first = rows.start as usize / BLOCK;
            first..first + blocks_along(rows.len() as u32)
        }
    };
    Place {
        across: blocks_along(intrinsics.width),
        first_row: rows.start,
        num_rows: rows.len(),
        size: [intrinsics.width as usize, intrinsics.height as usize],
    }
}

/// Decodes a chunk whose header says that it is of the rate mode.
pub(in super::super) fn decode(
    header: ChunkHeader,
    bytes: &[u8],
    references: &References,
) -> Result<BlocksChunk, CodecError> {
    read(header, bytes, references, Decoder::new).map(|(_, chunk)| chunk)
}

/// The same by the coder that `begin` makes of the coded bytes; returns it too.
pub(super) fn read<'a, C: Reader>(
    header: ChunkHeader,
    bytes: &'a [u8],
    references: &References,
    begin: impl FnOnce(&'a [u8]) -> C,
) -> Result<(C, BlocksChunk), CodecError> {
    let found = bytes.len();
    let mut coded = bytes.get(HEADER_BYTES..).unwrap_or_default();
    if found != header.chunk_bytes() {
        return Err(CodecError::Length { found, expected: header.chunk_bytes() });
    }
    if usize::from(header.frame.k) != MAX_LAYERS {
        let expected = MAX_LAYERS.to_string();
        return Err(CodecError::Header { what: "k", found: header.frame.k.to_string(), expected });
    }
    let head = Head::read(&mut coded, &header)?;
    if !head.is_split && header.num_chunks != header.num_base {
        let problem = "chunks of corrections, but they are said to follow the bases".into();
        return Err(CodecError::Payload { plane: "head", problem });
    }
    let place = place(&header, head.borders);
    let (decoder, content) = if header.is_base() {
        let reference = match head.reference {
            Some(name) => {
                let missing = CodecError::Reference { frame: header.frame.frame, reference: name };
                Some(references.get(name).ok_or(missing)?)
            }
            None => None,
        };
        let motion = reference.map(|r| (&**r, Motion::new(&header.frame.camera, &r.header.camera)));
        // About as many cells as a band of the reference has, but no more than so few bytes may be for.
        let num_cells =
            reference.map_or(0, |r| (r.num_cells() / r.num_bands()).min(coded.len() * CELLS_PER_BYTE));
        let coder = BandCoder::new(begin(coded), &head, place, motion, num_cells);
        let (mut decoder, mut band, _) = coder.run(&mut Nothing, MAX_CHUNK_SEGMENTS)?;
        if !head.is_split && head.has_corrections(&band) {
            let corrections;
            (decoder, corrections) = picture::code(decoder, &head.steps, place, |_, _| 0)?;
            corrections.apply(&mut band, head.smoothing());
        }
        (decoder, Content::Base(Arc::new(band)))
    } else {
        let (decoder, corrections) = picture::code(begin(coded), &head.steps, place, |_, _| 0)?;
        (decoder, Content::Corrections(corrections))
    };
    if !decoder.is_at_end() {
        return Err(CodecError::Payload {
            plane: "blocks",
            problem: "bytes are left over or missing".into(),
        });
    }
    Ok((decoder, BlocksChunk { header, head, content }))
}

/// Collects the chunks of a frame of the rate mode.
#[derive(Clone, Debug)]
pub(in super::super) struct BlocksAssembly {
    first: ChunkHeader,
    head: Option<Head>,
    bands: Vec<(Option<Arc<Band>>, Option<Corrections>)>,
    seen: u32,
}

impl BlocksAssembly {
    pub(in super::super) fn new(header: &ChunkHeader) -> Self {
        let bands = vec![(None, None); usize::from(header.num_base)];
        Self { first: *header, head: None, bands, seen: 0 }
    }

    pub(in super::super) fn first(&self) -> &ChunkHeader {
        &self.first
    }

    pub(in super::super) fn seen(&self) -> u32 {
        self.seen
    }

    pub(in super::super) fn base_complete(&self) -> bool {
        self.bands.iter().all(|(base, _)| base.is_some())
    }

    /// Adds a chunk. An error leaves the assembly as it was.
    pub(in super::super) fn insert(&mut self, chunk: BlocksChunk) -> Result<(), CodecError> {
        let header = &chunk.header;
        if let Some(what) = header.difference(&self.first) {
            return Err(header.contradicts(what));
        }
        if self.head.is_some_and(|head| head != chunk.head) {
            return Err(header.contradicts("other steps, predictions or bands"));
        }
        if self.seen >> header.index.0 & 1 == 1 {
            return Err(CodecError::Duplicate(header.index));
        }
        let num_segments: usize = self.bands.iter().flat_map(|(base, _)| base).map(|b| b.num_cells()).sum();
        at_most("segments in a frame", num_segments + chunk.num_segments(), MAX_FRAME_SEGMENTS)?;
        let num_rows: usize = self.bands.iter().flat_map(|(base, _)| base).map(|b| b.num_rows()).sum();
        let own = match &chunk.content {
            Content::Base(band) => band.num_rows(),
            Content::Corrections(_) => 0,
        };
        at_most("rows of segments in a frame", num_rows + own, MAX_FRAME_SEGMENTS / 4)?;
        let (base, corrections) = &mut self.bands[usize::from(header.band)];
        if if header.is_base() { base.is_some() } else { corrections.is_some() } {
            return Err(header.contradicts("its band and group are there under another index"));
        }
        self.seen |= 1 << header.index.0;
        self.head = Some(chunk.head);
        match chunk.content {
            Content::Base(band) => *base = Some(band),
            Content::Corrections(found) => *corrections = Some(found),
        }
        Ok(())
    }

    /// The bands with the corrections that are there; missing ones are empty.
    pub(in super::super) fn to_reference(&self) -> Reference {
        let bands = self.bands.par_iter().enumerate().map(|(number, (base, corrections))| {
            match (base, corrections) {
                (Some(base), None) => base.clone(),
                (Some(base), Some(corrections)) => {
                    let mut band = Band::clone(base);
                    corrections.apply(&mut band, self.head.and_then(|head| head.smoothing()));
                    Arc::new(band)
                }
                (None, _) => {
                    let borders = self.head.and_then(|head| head.borders);
                    let place = place(&ChunkHeader { band: number as u8, ..self.first }, borders);
                    let mut band = Band::new(place, 0);
                    let mut nothing = super::band::Lists::default();
                    (0..place.across * place.num_rows).for_each(|_| band.push(0, &mut nothing));
                    Arc::new(band)
                }
            }
        });
        Reference::new(self.first.frame, self.head.map(|h| h.steps), bands.collect())
    }
}

impl Reference {
    /// The frame that a client shows.
    pub fn to_frame(&self) -> LayeredFrame {
        self.to_frame_in(None)
    }

    /// The same, in the memory of a frame.
    pub(in super::super) fn to_frame_in(&self, spare: Option<LayeredFrame>) -> LayeredFrame {
        let width = self.header.camera.intrinsics.width as usize;
        let total: usize = self.bands.iter().map(|b| b.num_cells()).sum();
        let mut frame = LayeredFrame::in_memory_of(spare, self.header, total);
        let mut ends = &mut frame.offsets[1..];
        let mut planes = [&mut frame.depth[..], &mut frame.c_rg[..], &mut frame.c_b_tau[..]];
        let mut work = Vec::with_capacity(self.bands.len());
        let mut offset = 0;
        for band in &self.bands {
            let rows = band.blocks.len() / band.across.max(1) * BLOCK;
            let lists = (rows * width).min(ends.len());
            let count = band.num_cells();
            work.push((
                band,
                offset as u32,
                split_off(&mut ends, lists),
                planes.each_mut().map(|plane| split_off(plane, count)),
            ));
            offset += count;
        }
        work.into_par_iter().for_each(|(band, offset, ends, planes)| band.write(width, offset, ends, planes));
        frame
    }
}

impl Band {
    /// Writes the ends of the band's lists, counted from `offset`, and their segments.
    fn write(&self, columns: usize, offset: u32, ends: &mut [u32], planes: [&mut [u32]; 3]) {
        write_words(self, columns, offset, ends, planes);
    }
}

wide! {
    /// Writes the segments of a band list by list in the packed form of [`LayeredFrame`], and where those of each list end,
    /// counted from `offset`.
    fn write_words(
        band: &Band,
        columns: usize,
        offset: u32,
        ends: &mut [u32],
        planes: [&mut [u32]; 3],
    ) = write_words_any;
}

#[inline(always)]
fn write_words_any(
    band: &Band,
    columns: usize,
    offset: u32,
    ends: &mut [u32],
    [depth, c_rg, c_b_tau]: [&mut [u32]; 3],
) {
    let mut to = 0;
    let mut spread = NO_CELLS;
    for (y, ends) in ends.chunks_mut(columns * BLOCK).enumerate() {
        let blocks = y * band.across..(y + 1) * band.across;
        // How long lists are, then where they end.
        for (x, block) in blocks.clone().enumerate() {
            let mut lengths = [0; BLOCK_LISTS];
            for layer in band.cells_of(block).layers {
                for (i, length) in lengths.iter_mut().enumerate() {
                    *length += (layer.mask >> i & 1) as u32;
                }
            }
            for (ends, lengths) in ends.chunks_mut(columns).zip(lengths.chunks_exact(BLOCK)) {
                for (end, length) in ends[x * BLOCK..].iter_mut().zip(lengths) {
                    *end = *length;
                }
            }
        }
        let first = to;
        for end in &mut *ends {
            to += *end;
            *end = offset + to;
        }
        for (x, block) in blocks.enumerate() {
            // Where the next segment of each list goes.
            let mut places = [0; BLOCK_LISTS];
            for (row, places) in places.chunks_exact_mut(BLOCK).enumerate() {
                for (column, place) in places.iter_mut().enumerate() {
                    let list = row * columns + x * BLOCK + column;
                    // There is none below the last row of the frame.
                    *place = match list.checked_sub(1) {
                        Some(before) => ends.get(before).map_or(0, |end| end - offset),
                        None => first,
                    };
                }
            }
            let mut walk = band.cells_of(block).walk(&mut spread);
            while let Some((layer, cells)) = walk.next() {
                let words = words_of(cells);
                for i in lists_of(layer.mask) {
                    let place = places[i] as usize;
                    places[i] += 1;
                    depth[place] = words[0][i];
                    c_rg[place] = words[1][i];
                    c_b_tau[place] = words[2][i];
                }
            }
        }
    }
}

/// Cells as segments in the packed form.
#[inline(always)]
fn words_of([front, back, u, y, co, cg]: &Cells) -> [[u32; BLOCK_LISTS]; 3] {
    let scales = scales();
    let (mut alpha, mut tau) = ([0.0; BLOCK_LISTS], [0; BLOCK_LISTS]);
    for (i, code) in u.iter().enumerate() {
        alpha[i] = scales.alpha[usize::from(*code)];
        tau[i] = u32::from(scales.tau_half[usize::from(*code)]);
    }
    let mut words = [[0; BLOCK_LISTS]; 3];
    let [depth, rg, b_tau] = &mut words;
    for i in 0..BLOCK_LISTS {
        let [r, g, b] = roots([y[i] as i16, co[i] as i16, cg[i] as i16]).map(|root| root * root * alpha[i]);
        depth[i] = u32::from(front[i]) | u32::from(back[i]) << 16;
        rg[i] = pack_halves(r, g);
        b_tau[i] = pack_halves(b, 0.0) | tau[i] << 16;
    }
    words
}

/// More than a byte of a predicted frame is for.
const CELLS_PER_BYTE: usize = 64;
/// Bits of the first byte of a head.
const IS_PREDICTED: u8 = 1;
const IS_SPLIT: u8 = 2;
const HAS_BORDERS: u8 = 4;
const HAS_EDGES: u8 = 8;
const IS_SMOOTH: u8 = 16;
/// Bytes of [`Head`] without borders.
pub(super) const HEAD_BYTES: usize = 5 + STEPS_BYTES;
