//! Decodes the chunks of a frame in blocks.

use std::cmp::Reverse;
use std::sync::Arc;

use rayon::prelude::*;

use super::super::error::{CodecError, at_most};
use super::super::header::{ChunkHeader, HEADER_BYTES};
use super::super::limits::{MAX_CHUNK_SEGMENTS, MAX_FRAME_SEGMENTS};
use super::band::Band;
use super::coding::{BandCoder, NoSource};
use super::corrections;
use super::entropy::Decoder;
use super::head::Head;
use super::model::MAX_LAYERS;
use super::motion::ReferenceMotion;
use super::reference::{Reference, References};
use crate::ids::FrameId;

/// Decodes all chunks of a frame, in order of index.
pub(in crate::codec) fn decode(
    chunks: &[(ChunkHeader, &[u8])],
    references: &References,
) -> Result<Reference, CodecError> {
    let mut longest_first: Vec<_> = chunks.iter().collect();
    longest_first.sort_by_key(|(_, bytes)| Reverse(bytes.len()));
    // Each thread takes one at a time, so no thread has a long one left at the end.
    let bands = longest_first.into_iter().par_bridge().map(|(header, bytes)| {
        let (head, band) = decode_band(header, bytes, |name| references.get(name).map(AsRef::as_ref))?;
        Ok((header, head, Arc::new(band)))
    });
    let mut bands: Vec<_> = bands.collect::<Result<_, CodecError>>()?;
    bands.sort_unstable_by_key(|(header, ..)| header.index);
    let Some(&(header, head, _)) = bands.first() else {
        return Err(CodecError::Incomplete { found: 0, expected: 1 });
    };
    if let Some((header, ..)) = bands.iter().find(|(_, other, _)| *other != head) {
        return Err(header.contradicts("other steps, predictions or bands"));
    }
    let num_cells = bands.iter().map(|(.., band)| band.num_cells()).sum();
    at_most("segments in a frame", num_cells, MAX_FRAME_SEGMENTS)?;
    let num_rows = bands.iter().map(|(.., band)| band.num_rows()).sum();
    at_most("rows of segments in a frame", num_rows, MAX_FRAME_SEGMENTS / 4)?;
    let bands = bands.into_iter().map(|(.., band)| band).collect();
    Ok(Reference::new(header.frame, Some(head.steps), bands))
}

/// Decodes a chunk, given the reference of a name.
pub(in crate::codec) fn decode_band<'a>(
    header: &ChunkHeader,
    bytes: &[u8],
    named: impl Fn(FrameId) -> Option<&'a Reference>,
) -> Result<(Head, Band), CodecError> {
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
    let motion = reference.map(|r| (r, ReferenceMotion::new(&header.frame.camera, &r.header.camera)));
    // Memory for about as many cells as a band of the reference has, but bounded by the number of bytes.
    let num_cells =
        reference.map_or(0, |r| (r.num_cells() / r.num_bands()).min(coded.len() * CELLS_PER_BYTE));
    let place = head.place(header);
    let coder = BandCoder::new(Decoder::new(coded), head.steps, place, motion, num_cells);
    let (mut decoder, mut band, _) = coder.run(&mut NoSource, MAX_CHUNK_SEGMENTS)?;
    if band.num_cells() > 0 {
        let corrections;
        (decoder, corrections) = corrections::code(decoder, &head.steps, place, |_, _| 0)?;
        corrections.apply(&mut band, head.steps.of_picture());
    }
    if !decoder.is_at_end() {
        return Err(CodecError::Payload {
            plane: "blocks",
            problem: "bytes are left over or missing".into(),
        });
    }
    Ok((head, band))
}

/// Upper bound on the cells of a predicted frame for each byte.
const CELLS_PER_BYTE: usize = 64;
