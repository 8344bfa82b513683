//! A frame whose rows are in several processes, which encode it together.
//!
//! The work of a row of the frame is a sum over the processes. So all of them cut it into the same bands, and each
//! encodes some. Their payloads are those that one process would make.

use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;

use super::blocks::{self, CodedTile, Notes, Reference, Settings, Tally};
use super::chunk::EncodedFrame;
use super::error::CodecError;
use super::exact;
use super::header::peek;
use crate::cancel::Wanted;
use crate::layer::{FrameHeader, LayeredFrame};

/// The bands of a frame, as all processes find them.
pub struct FrameBands<'a> {
    plan: BandsPlan<'a>,
    reference: Option<&'a Reference>,
}

enum BandsPlan<'a> {
    Exact(exact::ExactPlan),
    Blocks(Box<blocks::BlocksPlan<'a>>),
}

/// A coded band of a frame.
#[derive(Clone, Debug)]
pub struct CodedBand {
    /// The bytes of its chunk behind what all chunks share.
    pub payload: Vec<u8>,
    /// What its coder noted for the next frame, block by block of its tiles with matter; empty in the exact coding.
    pub notes: Vec<f32>,
    /// `None` of a band that another process has coded.
    tiles: Option<(Vec<CodedTile>, Tally)>,
}

impl CodedBand {
    /// A band that another process has coded.
    pub fn of_other(payload: Vec<u8>, notes: Vec<f32>) -> Self {
        Self { payload, notes, tiles: None }
    }
}

impl<'a> FrameBands<'a> {
    /// Bands of a frame in the exact coding, given the work of each row of tiles.
    pub(super) fn exact(frame: FrameHeader, work: &[usize]) -> Result<Self, CodecError> {
        let plan = BandsPlan::Exact(exact::ExactPlan::new(frame, work)?);
        Ok(Self { plan, reference: None })
    }

    /// Bands of a frame in blocks, given the work of each row of blocks.
    pub(super) fn in_blocks(
        frame: FrameHeader,
        settings: &Settings,
        reference: Option<&'a Reference>,
        work: &[usize],
    ) -> Result<Self, CodecError> {
        let plan = Box::new(blocks::BlocksPlan::new(frame, settings, reference, work)?);
        Ok(Self { plan: BandsPlan::Blocks(plan), reference })
    }

    /// Number of bands.
    pub fn num(&self) -> usize {
        match &self.plan {
            BandsPlan::Exact(plan) => plan.num_bands(),
            BandsPlan::Blocks(plan) => plan.num_bands(),
        }
    }

    /// The rows of lists of a band.
    pub fn rows(&self, band: usize) -> Range<usize> {
        match &self.plan {
            BandsPlan::Exact(plan) => plan.rows(band),
            BandsPlan::Blocks(plan) => plan.rows(band),
        }
    }

    /// Encodes a band of a valid frame, of which only the rows of the band are read.
    ///
    /// # Errors
    /// On bands above the limits of the codec, and when the frame is no longer wanted.
    pub fn encode(
        &self,
        frame: &LayeredFrame,
        band: usize,
        wanted: Wanted<'_>,
    ) -> Result<CodedBand, CodecError> {
        Ok(match &self.plan {
            BandsPlan::Exact(plan) => CodedBand::of_other(plan.encode(frame, band, wanted)?, Vec::new()),
            BandsPlan::Blocks(plan) => {
                let blocks::EncodedBand { payload, tiles, notes, tally } =
                    plan.encode(frame, band, wanted)?;
                CodedBand { payload, notes: notes.concat(), tiles: Some((tiles, tally)) }
            }
        })
    }

    /// The frame with all of its bands, and what later frames can be predicted from. Bands of others are decoded for
    /// that.
    ///
    /// # Errors
    /// If a band is missing, damaged or too large.
    pub fn join(&self, bands: Vec<CodedBand>) -> Result<(EncodedFrame, Option<Arc<Reference>>), CodecError> {
        if bands.len() != self.num() {
            return Err(CodecError::Incomplete { found: bands.len(), expected: self.num() });
        }
        let (mut payloads, mut parts) = (vec![], vec![]);
        for band in bands {
            payloads.push(band.payload);
            parts.push((band.tiles, band.notes));
        }
        let plan = match &self.plan {
            BandsPlan::Exact(plan) => return Ok((plan.encoded(payloads)?, None)),
            BandsPlan::Blocks(plan) => plan,
        };
        let encoded = plan.encoded(payloads)?;
        let all = parts.into_par_iter().zip(&encoded.chunks).map(|((tiles, notes), chunk)| {
            let (tiles, tally) = match tiles {
                Some(tiles) => tiles,
                None => self.decoded(&chunk.bytes)?,
            };
            let notes = notes_of_tiles(&tiles, &notes);
            Ok((tiles, notes, tally))
        });
        let (mut tiles, mut notes, mut tally) = (vec![], vec![], Tally::default());
        for (own, of_own, counts) in all.collect::<Result<Vec<_>, CodecError>>()? {
            tiles.extend(own);
            notes.extend(of_own);
            tally = tally.and(&counts);
        }
        Ok((encoded, Some(Arc::new(plan.reference(tiles, &tally, notes)))))
    }

    fn decoded(&self, chunk: &[u8]) -> Result<(Vec<CodedTile>, Tally), CodecError> {
        let named = |name| self.reference.filter(|reference| reference.frame() == name);
        let band = blocks::decode_band(&peek(chunk)?, chunk, named)?;
        Ok((band.tiles, band.tally))
    }
}

/// The notes of each tile. A tile without matter has none.
fn notes_of_tiles(tiles: &[CodedTile], mut notes: &[f32]) -> Vec<Notes> {
    let of_tile = |tile: &CodedTile| {
        let (own, rest) = notes.split_at(tile.num_blocks().min(notes.len()));
        notes = rest;
        own.to_vec()
    };
    tiles.iter().map(of_tile).collect()
}

#[cfg(test)]
mod tests;
