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

use rayon::prelude::*;

use super::bands::{Borders, split_off};
use super::chunk::EncodedFrame;
use super::error::{CodecError, at_most};
use super::header::{ChunkHeader, TILE, num_bands, num_tiles};
use super::limits::{MAX_FRAME_LISTS, MAX_FRAME_SEGMENTS};
use crate::cancel::Wanted;
use crate::layer::LayeredFrame;
use planes::{Opened, Words, rows_of};

/// Makes the tables.
pub(super) fn prepare() {
    scale::scale();
}

/// Encodes a valid frame, bands in parallel. Stops when the frame is no longer wanted.
pub(super) fn encode(frame: &LayeredFrame, wanted: Wanted<'_>) -> Result<EncodedFrame, CodecError> {
    let intrinsics = frame.header.camera.intrinsics;
    at_most("lists", intrinsics.num_pixels(), MAX_FRAME_LISTS)?;
    at_most("segments in a frame", frame.num_segments(), MAX_FRAME_SEGMENTS)?;
    let (width, height) = (intrinsics.width as usize, intrinsics.height as usize);
    // The time of a band is proportional to its segments.
    let end = |row: usize| frame.offsets[(row * TILE).min(height) * width];
    let num_rows = num_tiles(intrinsics.height);
    let work: Vec<_> = (0..num_rows).map(|row| (end(row + 1) - end(row)) as usize).collect();
    let num_bands = num_bands(intrinsics.height);
    let borders = Borders::sharing(&work, num_bands);
    let payloads = (0..usize::from(num_bands)).into_par_iter().with_max_len(1).map(|band| {
        if !wanted() {
            return Err(CodecError::Abandoned);
        }
        let rows = rows_of(borders, band, intrinsics.height);
        let mut lists = quantize::band(frame, rows.start * width..rows.end * width);
        if !wanted() {
            return Err(CodecError::Abandoned);
        }
        planes::encode(&mut lists, width)
    });
    let payloads = payloads.collect::<Result<_, _>>()?;
    let mut head = vec![];
    borders.write(&mut head);
    EncodedFrame::from_payloads(frame.header, true, &head, payloads)
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
