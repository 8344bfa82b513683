//! The rate mode: lists in blocks of 8×8 that share their cuts as depth planes, so that opacity and colour of a layer are
//! small planes a transform can code.
//!
//! A block's layers ([`model`]) are found by the server (`relayer`, `encode`); their planes are coded in steps or taken
//! from a neighbour or from the frame before, moved (`coding`, `motion`, `reference`). Opacity and colour of a layer
//! are 8×8 planes on the scales of `scales`, predicted and transformed (`transform`) and said in adaptive bits
//! (`syntax`, `entropy`). One more plane a block takes back what the picture of the decoded layers is off at the
//! frame's own pose (`picture`), whose borders between blocks are smoothed (`smooth`). What decodes is what the encoder
//! itself worked with (closed loop).
//!
//! The one rule that makes every machine decode alike: whatever a decoder computes is integers, tables made of sums,
//! products, quotients and square roots, or single and double precision operations in the order written. No
//! function of a mathematics library takes part.

mod band;
mod bands;
mod chunk;
mod coding;
mod edges;
mod encode;
mod entropy;
mod meter;
pub mod model;
mod motion;
mod picture;
pub mod raster;
mod rate;
mod reference;
pub mod relayer;
mod scales;
mod smooth;
mod steps;
mod syntax;
#[cfg(test)]
mod tests;
mod trained;
mod transform;

use std::sync::Arc;

use rayon::prelude::*;

use super::header::{self, ChunkHeader};
use super::{Chunk, CodecError, EncodedFrame, MAX_CHUNK_BYTES, MAX_FRAME_LISTS, at_most};
use crate::cancel::{ALWAYS, Wanted};
use crate::ids::ChunkIndex;
use crate::layer::{FrameHeader, LayeredFrame};
use chunk::Head;
use model::MAX_LAYERS;
use motion::Motion;

pub(super) use chunk::{BlocksAssembly, decode};
pub use chunk::{BlocksChunk, reference_named};
pub(super) use meter::spent;
pub use rate::{MAX_ENCODES, RateControl, encode_within};
pub use reference::{MAX_REFERENCE_BYTES, MAX_REFERENCES, Reference, References};
pub use steps::{MAX_QUALITY, MAX_TURN_DEG};

/// How to encode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Settings {
    /// 0 to [`MAX_QUALITY`].
    pub quality: u8,
    /// The turn that the frame is made to be seen at: degrees between its camera and the one that it is shown from, at most
    /// [`MAX_TURN_DEG`]. The less, the more of the bytes is spent on the picture at the frame's own pose, and the less on
    /// depths. None where it is not known: fit for all turns.
    pub turn_deg: Option<u8>,
    /// Whether the corrections of the picture are chunks of their own, so that a frame can be shown before they are
    /// there. Costs the headers, and a frame can be a reference only with all of its chunks.
    pub is_split: bool,
    /// Most bands, each of which a thread encodes or decodes. More cost some percent of the bytes: headers, and estimates
    /// that start anew.
    pub max_bands: u8,
}

impl Settings {
    /// Of a quality, for all turns, in one piece, for up to four threads.
    pub const fn of(quality: u8) -> Self {
        Self { quality, turn_deg: None, is_split: false, max_bands: 4 }
    }
}

/// Encodes a frame, which must be valid ([`LayeredFrame::validate`]); if a reference is given, which the receiver must
/// have, predicted from it. Bands are encoded in parallel. Returns what a receiver will have as a reference, too.
///
/// Lists may grow or shrink: the header says that they have at most [`MAX_LAYERS`] segments.
///
/// Fails only on frames and bands above the limits of this module.
pub fn encode(
    frame: &LayeredFrame,
    settings: &Settings,
    reference: Option<&Reference>,
) -> Result<(EncodedFrame, Reference), CodecError> {
    encode_while(frame, settings, reference, ALWAYS)
}

/// The same; ends early with [`CodecError::Abandoned`] when the frame is no longer wanted.
pub(super) fn encode_while(
    frame: &LayeredFrame,
    settings: &Settings,
    reference: Option<&Reference>,
    wanted: Wanted<'_>,
) -> Result<(EncodedFrame, Reference), CodecError> {
    let camera = frame.header.camera;
    at_most("lists", camera.intrinsics.num_pixels(), MAX_FRAME_LISTS)?;
    let frame_header = FrameHeader { k: MAX_LAYERS as u8, ..frame.header };
    let (rule, steps) = steps::from_settings(settings, reference.is_some(), &camera);
    let num_bands = header::num_bands(camera.intrinsics.height).min(settings.max_bands.max(1));
    let borders = bands::borders(frame, num_bands);
    let reference_frame = reference.map(Reference::frame);
    let head = Head {
        steps,
        reference: reference_frame,
        is_split: settings.is_split,
        has_edges: reference.is_none(),
        is_smooth: true,
        borders,
    };
    let first = ChunkHeader {
        frame: frame_header,
        color_bits: 0,
        index: ChunkIndex(0),
        num_chunks: num_bands,
        num_base: num_bands,
        band: 0,
        has_borders: false,
        payload_bytes: 0,
    };
    // From both ends, so that a thread with two neighbours in this order has one from the border and one from the middle:
    // what either takes longer than was thought evens out.
    let from_both_ends = |n: u8| if n.is_multiple_of(2) { n / 2 } else { num_bands - 1 - n / 2 };
    let mut bands: Vec<_> = (0..num_bands)
        .into_par_iter()
        .with_max_len(1)
        .map(|n| {
            let band = from_both_ends(n);
            let place = chunk::place(&ChunkHeader { band, ..first }, borders);
            let motion = reference.map(|r| (r, Motion::new(&camera, &r.header.camera)));
            Ok((band, encode::band(frame, place, rule, &head, motion, wanted)?))
        })
        .collect::<Result<_, CodecError>>()?;
    bands.sort_unstable_by_key(|(band, _)| *band);

    let mut parts = Vec::with_capacity(2 * bands.len());
    let mut corrections = Vec::new();
    let mut decoded = Vec::with_capacity(bands.len());
    let mut notes = Vec::with_capacity(bands.len());
    for (band, encoded) in bands {
        parts.push((band, encoded.base));
        corrections.extend(encoded.corrections.map(|bytes| (band, bytes)));
        decoded.push(Arc::new(encoded.decoded));
        notes.push(encoded.notes);
    }
    parts.append(&mut corrections);
    let num_chunks = parts.len() as u8;
    let head = head.to_bytes();
    let chunks = parts
        .into_iter()
        .enumerate()
        .map(|(index, (band, coded))| {
            let index = ChunkIndex(index as u16);
            let payload_bytes = (head.len() + coded.len()) as u32;
            let header = ChunkHeader { index, num_chunks, band, payload_bytes, ..first };
            let mut bytes = header.to_bytes().to_vec();
            bytes.extend_from_slice(&head);
            bytes.extend_from_slice(&coded);
            at_most("bytes in a chunk", bytes.len(), MAX_CHUNK_BYTES)?;
            Ok(Chunk { index, is_base: header.is_base(), bytes })
        })
        .collect::<Result<_, CodecError>>()?;
    let reference = Reference::new(frame_header, Some(steps), decoded).with_notes(rule.lambda, notes);
    Ok((EncodedFrame { header: frame_header, chunks }, reference))
}

/// Makes the tables.
pub(super) fn prepare() {
    scales::scales();
    syntax::Contexts::new();
}
