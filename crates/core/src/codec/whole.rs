//! Frames of the exact mode whose chunks are all here: they are decoded to where they stay.

use rayon::prelude::*;

use super::assembly::Roll;
use super::header::peek;
use super::planes::{self, Opened, Words};
use super::{CodecError, split_off};
use crate::layer::LayeredFrame;

/// Decodes a frame in the exact mode that is one group of segments, if these are all of its chunks, in whatever order. Takes
/// the memory of `spare` if it is one.
pub(super) fn decode(
    chunks: &[&[u8]],
    spare: &mut Option<LayeredFrame>,
) -> Result<Option<LayeredFrame>, CodecError> {
    let Some(bytes) = chunks.first() else { return Ok(None) };
    let first = peek(bytes)?;
    let num_chunks = usize::from(first.num_chunks);
    if first.is_rate() || first.num_chunks != first.num_base || num_chunks != chunks.len() {
        return Ok(None);
    }
    let opened = chunks.par_iter().with_max_len(1).map(|bytes| Opened::new(bytes));
    let mut opened: Vec<_> = opened.collect::<Result<_, _>>()?;
    let mut roll = Roll::new(&first);
    let mut bands = 0u32;
    for Opened { header, borders, num_segments, .. } in &opened {
        roll.check(header, *borders, *num_segments)?;
        if bands >> header.band & 1 == 1 {
            return Err(header.contradicts("its band and group are there under another index"));
        }
        bands |= 1 << header.band;
        roll.add(header, *borders, *num_segments);
    }
    // As many as there are bands, and no two of one: all of them.
    opened.sort_by_key(|chunk| chunk.header.band);

    let mut frame = LayeredFrame::in_memory_of(spare.take(), first.frame, roll.num_segments);
    let mut ends = &mut frame.offsets[1..];
    let mut words = [&mut frame.depth[..], &mut frame.c_rg, &mut frame.c_b_tau];
    let mut offset = 0;
    let mut parts: Vec<_> = opened
        .into_iter()
        .map(|chunk| {
            let ends = split_off(&mut ends, chunk.counts.len());
            let words = words.each_mut().map(|words| split_off(words, chunk.num_segments));
            let first = offset;
            offset += chunk.num_segments as u32;
            Part { chunk, first, ends, words }
        })
        .collect();
    parts.par_iter_mut().with_max_len(1).try_for_each(|Part { chunk, first, ends, words }| {
        let mut last = *first;
        for (end, &count) in ends.iter_mut().zip(&chunk.counts) {
            last += u32::from(count);
            *end = last;
        }
        planes::decode(chunk, std::mem::take(words))
    })?;
    Ok(Some(frame))
}

/// A band and where it goes.
struct Part<'a, 'b> {
    chunk: Opened<'a>,
    /// Number of its first segment in the frame.
    first: u32,
    ends: &'b mut [u32],
    words: Words<'b>,
}
