//! The exact coding. It keeps all lists and depths, and uses range asymmetric numeral systems with contexts.
//!
//! Colour and optical depth are quantised (`scale`) front to back (`quantize`). Each segment makes up for the error
//! of the composite so far, so the picture from the frame's own pose does not drift. Numbers are predicted from
//! neighbouring lists (`predict`, `rows`) and coded plane by plane (`planes`, `contexts`, `rans`). A decoded frame
//! encodes to the same bytes.
//!
//! A file uses only those above it:
//!
//! | file | responsibility |
//! |---|---|
//! | `scale` | codes of colour and optical depth |
//! | `quantize` | lists to codes |
//! | `rans` | tokens and bits |
//! | `contexts` | planes of numbers, each in contexts |
//! | `rows` | two rows of lists: what predictions look at |
//! | `predict` | what a segment is expected to be |
//! | `planes` | the payload of a chunk |

mod contexts;
mod planes;
mod predict;
mod quantize;
mod rans;
mod rows;
mod scale;

use std::ops::Range;

use rayon::prelude::*;

use super::bands::{Borders, split_off};
use super::chunk::EncodedFrame;
use super::error::{CodecError, at_most};
use super::header::{ChunkHeader, TILE, num_bands, num_tiles};
use super::limits::{MAX_FRAME_LISTS, MAX_FRAME_SEGMENTS};
use crate::camera::Intrinsics;
use crate::cancel::Wanted;
use crate::layer::{FrameHeader, LayeredFrame};
use planes::{Opened, Words, rows_of};

/// Makes the tables.
pub(super) fn prepare() {
    scale::scale();
}

/// Encodes a valid frame, bands in parallel. Stops when the frame is no longer wanted.
pub(super) fn encode(frame: &LayeredFrame, wanted: Wanted<'_>) -> Result<EncodedFrame, CodecError> {
    let plan = ExactPlan::new(frame.header, &work_of_rows(frame))?;
    let payloads = (0..plan.num_bands()).into_par_iter().with_max_len(1);
    let payloads = payloads.map(|band| plan.encode(frame, band, wanted));
    plan.encoded(payloads.collect::<Result<_, _>>()?)
}

/// The work for each row of tiles of a frame. The time of a band is proportional to its segments.
pub(super) fn work_of_rows(frame: &LayeredFrame) -> Vec<usize> {
    let Intrinsics { width, height, .. } = frame.header.camera.intrinsics;
    let end = |row: usize| frame.offsets[(row * TILE).min(height as usize) * width as usize];
    (0..num_tiles(height)).map(|row| (end(row + 1) - end(row)) as usize).collect()
}

/// What all bands of a frame share.
#[derive(Clone, Copy)]
pub(super) struct ExactPlan {
    header: FrameHeader,
    borders: Borders,
    num_bands: u8,
}

impl ExactPlan {
    /// Cuts a frame into bands, given the segments of each row of tiles.
    pub(super) fn new(header: FrameHeader, work: &[usize]) -> Result<Self, CodecError> {
        let intrinsics = header.camera.intrinsics;
        at_most("lists", intrinsics.num_pixels(), MAX_FRAME_LISTS)?;
        at_most("segments in a frame", work.iter().sum(), MAX_FRAME_SEGMENTS)?;
        let num_bands = num_bands(intrinsics.height);
        Ok(Self { header, borders: Borders::sharing(work, num_bands), num_bands })
    }

    pub(super) fn num_bands(&self) -> usize {
        self.num_bands.into()
    }

    /// The rows of lists of a band.
    pub(super) fn rows(&self, band: usize) -> Range<usize> {
        rows_of(self.borders, band, self.header.camera.intrinsics.height)
    }

    /// The payload of a band of a valid frame, of which only the rows of the band are read.
    pub(super) fn encode(
        &self,
        frame: &LayeredFrame,
        band: usize,
        wanted: Wanted<'_>,
    ) -> Result<Vec<u8>, CodecError> {
        if !wanted() {
            return Err(CodecError::Abandoned);
        }
        let width = self.header.camera.intrinsics.width as usize;
        let rows = self.rows(band);
        let mut lists = quantize::band(frame, rows.start * width..rows.end * width);
        if !wanted() {
            return Err(CodecError::Abandoned);
        }
        planes::encode(&mut lists, width)
    }

    /// The chunks, given the payloads of all bands.
    pub(super) fn encoded(&self, payloads: Vec<Vec<u8>>) -> Result<EncodedFrame, CodecError> {
        let mut head = vec![];
        self.borders.write(&mut head);
        EncodedFrame::from_payloads(self.header, true, &head, payloads)
    }
}

/// Decodes all chunks of a frame, in order of index. Reuses the memory of `spare`.
pub(super) fn decode(
    chunks: &[(ChunkHeader, &[u8])],
    spare: Option<LayeredFrame>,
) -> Result<LayeredFrame, CodecError> {
    let opened = chunks.par_iter().with_max_len(1).map(|(header, bytes)| Opened::new(header, bytes));
    let opened: Vec<_> = opened.collect::<Result<_, _>>()?;
    let (Some(first), Some((header, _))) = (opened.first(), chunks.first()) else {
        return Err(CodecError::Incomplete { found: 0, expected: 1 });
    };
    if let Some(n) = opened.iter().position(|chunk| chunk.borders != first.borders) {
        return Err(chunks[n].0.contradicts("other borders of bands"));
    }
    let num_segments = opened.iter().map(|chunk| chunk.num_segments).sum();
    at_most("segments in a frame", num_segments, MAX_FRAME_SEGMENTS)?;

    let mut frame = LayeredFrame::in_memory_of(spare, header.frame, num_segments);
    let mut ends = &mut frame.offsets[1..];
    let mut words = [&mut frame.depth[..], &mut frame.c_rg, &mut frame.c_b_tau];
    let mut offset = 0;
    let mut bands: Vec<_> = opened
        .into_iter()
        .map(|chunk| {
            let ends = split_off(&mut ends, chunk.counts.len());
            let words = words.each_mut().map(|words| split_off(words, chunk.num_segments));
            let first = offset;
            offset += chunk.num_segments as u32;
            OpenBand { chunk, first, ends, words }
        })
        .collect();
    bands.par_iter_mut().with_max_len(1).try_for_each(|OpenBand { chunk, first, ends, words }| {
        let mut last = *first;
        for (end, &count) in ends.iter_mut().zip(&chunk.counts) {
            last += u32::from(count);
            *end = last;
        }
        planes::decode(chunk, std::mem::take(words))
    })?;
    Ok(frame)
}

/// A band to decode, and its place in the frame.
struct OpenBand<'a, 'b> {
    chunk: Opened<'a>,
    /// Index of its first segment in the frame.
    first: u32,
    ends: &'b mut [u32],
    words: Words<'b>,
}

#[cfg(test)]
pub(super) mod tests;
