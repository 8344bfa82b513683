//! The chunks of one frame put together again, in whatever order they come.

use rayon::prelude::*;

use super::bands::Borders;
use super::header::ChunkHeader;
use super::planes::DecodedChunk;
use super::{CodecError, MAX_FRAME_SEGMENTS, at_most, split_off};
use crate::ids::ChunkIndex;
use crate::layer::{FrameHeader, LayeredFrame};

/// Which chunks of a frame are there.
#[derive(Clone, Debug)]
pub(super) struct Roll {
    first: ChunkHeader,
    /// As the chunks that are there say.
    borders: Option<Borders>,
    seen: u32,
    pub(super) num_segments: usize,
}

impl Roll {
    /// Of the frame that `header` belongs to, without chunks.
    pub(super) fn new(header: &ChunkHeader) -> Self {
        Self { first: *header, borders: None, seen: 0, num_segments: 0 }
    }

    /// Whether a chunk may be added: whether it is one of this frame, agrees with those before, and is not there.
    pub(super) fn check(
        &self,
        header: &ChunkHeader,
        borders: Option<Borders>,
        num_segments: usize,
    ) -> Result<(), CodecError> {
        if let Some(what) = header.difference(&self.first) {
            return Err(header.contradicts(what));
        }
        if self.contains(header.index) {
            return Err(CodecError::Duplicate(header.index));
        }
        if self.seen != 0 && borders != self.borders {
            return Err(header.contradicts("other borders of bands"));
        }
        at_most("segments in a frame", self.num_segments + num_segments, MAX_FRAME_SEGMENTS)
    }

    /// Adds a chunk that may be added.
    pub(super) fn add(&mut self, header: &ChunkHeader, borders: Option<Borders>, num_segments: usize) {
        self.seen |= 1 << header.index.0;
        self.borders = borders;
        self.num_segments += num_segments;
    }

    fn contains(&self, index: ChunkIndex) -> bool {
        self.seen.checked_shr(index.0.into()).unwrap_or(0) & 1 == 1
    }
}

/// Collects the chunks of one frame.
#[derive(Clone, Debug)]
pub(super) struct Assembly {
    roll: Roll,
    bands: Vec<Band>,
}

#[derive(Clone, Debug, Default)]
struct Band {
    base: Option<DecodedChunk>,
    refinement: Option<DecodedChunk>,
}

impl Assembly {
    /// An assembly without chunks for the frame that `header` belongs to.
    pub(super) fn new(header: &ChunkHeader) -> Self {
        let bands = vec![Band::default(); usize::from(header.num_base)];
        Self { roll: Roll::new(header), bands }
    }

    /// The frame.
    pub(super) fn header(&self) -> &FrameHeader {
        &self.roll.first.frame
    }

    /// Chunks the frame has.
    pub(super) fn num_chunks(&self) -> usize {
        self.roll.first.num_chunks.into()
    }

    /// Chunks that are there.
    pub(super) fn num_inserted(&self) -> usize {
        self.roll.seen.count_ones() as usize
    }

    /// Whether the frame can be shown: the base of every band is there.
    pub(super) fn base_complete(&self) -> bool {
        self.bands.iter().all(|b| b.base.is_some())
    }

    /// Whether every chunk is there.
    pub(super) fn complete(&self) -> bool {
        self.num_inserted() == self.num_chunks()
    }

    /// Whether the chunk is there.
    pub(super) fn contains(&self, index: ChunkIndex) -> bool {
        self.roll.contains(index)
    }

    /// Adds a chunk. An error leaves the assembly as it was.
    pub(super) fn insert(&mut self, chunk: DecodedChunk) -> Result<(), CodecError> {
        let header = &chunk.header;
        self.roll.check(header, chunk.borders, chunk.num_segments())?;
        let Band { base, refinement } = &mut self.bands[usize::from(header.band)];
        let (slot, other) = if header.is_base() { (base, refinement) } else { (refinement, base) };
        if slot.is_some() {
            return Err(header.contradicts("its band and group are there under another index"));
        }
        if let Some(other) = other {
            if !is_disjoint(&chunk, other) {
                return Err(header.contradicts("its segments overlap those of the other group"));
            }
            let k = header.frame.k;
            if chunk.counts.iter().zip(&other.counts).any(|(a, b)| a + b > k) {
                return Err(header.contradicts("its lists are too long with those of the other group"));
            }
        }
        self.roll.add(header, chunk.borders, chunk.num_segments());
        *slot = Some(chunk);
        Ok(())
    }

    /// The frame as far as it is there, in the memory of `spare`; lists of missing bands are empty. Always valid. Bands are
    /// merged in parallel.
    pub(super) fn to_frame(&self, spare: Option<LayeredFrame>) -> LayeredFrame {
        let Roll { first, borders, num_segments, .. } = self.roll;
        let mut frame = LayeredFrame::in_memory_of(spare, first.frame, num_segments);

        let width = first.frame.camera.intrinsics.width as usize;
        let mut lists = &mut frame.offsets[1..];
        let mut planes = [&mut frame.depth[..], &mut frame.c_rg[..], &mut frame.c_b_tau[..]];
        let mut work = Vec::with_capacity(self.bands.len());
        let mut offset = 0;
        for (number, band) in self.bands.iter().enumerate() {
            let rows = ChunkHeader { band: number as u8, ..first }.rows(borders);
            let count = band.num_segments();
            work.push((
                band,
                offset,
                split_off(&mut lists, rows.len() * width),
                planes.each_mut().map(|plane| split_off(plane, count)),
            ));
            offset += count as u32;
        }
        work.into_par_iter().for_each(|(band, offset, ends, planes)| band.merge(offset, ends, planes));
        frame
    }
}

impl Band {
    fn num_segments(&self) -> usize {
        [&self.base, &self.refinement].into_iter().flatten().map(DecodedChunk::num_segments).sum()
    }

    /// Writes the ends of the band's lists, counted from `offset`, and their segments.
    fn merge(&self, offset: u32, ends: &mut [u32], [depth, c_rg, c_b_tau]: [&mut [u32]; 3]) {
        let (one, other) = match (&self.base, &self.refinement) {
            (Some(base), refinement) => (base, refinement.as_ref()),
            (None, Some(refinement)) => (refinement, None),
            (None, None) => return ends.fill(offset),
        };
        let Some(other) = other else {
            depth.copy_from_slice(&one.depth);
            c_rg.copy_from_slice(&one.c_rg);
            c_b_tau.copy_from_slice(&one.c_b_tau);
            let mut last = offset;
            for (end, &count) in ends.iter_mut().zip(&one.counts) {
                last += u32::from(count);
                *end = last;
            }
            return;
        };
        let mut to = 0;
        let mut from = [0, 0];
        for (list, end) in ends.iter_mut().enumerate() {
            let mut left = [one.counts[list], other.counts[list]];
            while let Some((chunk, side)) = match left {
                [0, 0] => None,
                [_, 0] => Some((one, 0)),
                [0, _] => Some((other, 1)),
                [_, _] => {
                    // Fronts are in the low bits; segments are disjoint, so their fronts give the order.
                    let is_nearer = one.depth[from[0]] as u16 > other.depth[from[1]] as u16;
                    Some(if is_nearer { (other, 1) } else { (one, 0) })
                }
            } {
                depth[to] = chunk.depth[from[side]];
                c_rg[to] = chunk.c_rg[from[side]];
                c_b_tau[to] = chunk.c_b_tau[from[side]];
                from[side] += 1;
                left[side] -= 1;
                to += 1;
            }
            *end = offset + to as u32;
        }
    }
}

/// Whether no segment of one chunk overlaps one of the other in the same list.
fn is_disjoint(a: &DecodedChunk, b: &DecodedChunk) -> bool {
    let ends = |depth: u32| (depth as u16, (depth >> 16) as u16);
    let (mut i, mut j) = (0, 0);
    a.counts.iter().zip(&b.counts).all(|(&m, &n)| {
        let (end_i, end_j) = (i + usize::from(m), j + usize::from(n));
        let mut disjoint = true;
        while disjoint && i < end_i && j < end_j {
            let ((front_a, back_a), (front_b, back_b)) = (ends(a.depth[i]), ends(b.depth[j]));
            if back_a <= front_b {
                i += 1;
            } else if back_b <= front_a {
                j += 1;
            } else {
                disjoint = false;
            }
        }
        (i, j) = (end_i, end_j);
        disjoint
    })
}
