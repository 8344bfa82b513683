//! A frame whose rows are in several processes, which encode it together.
//!
//! The work of a row of the frame is a sum over the processes. So all of them cut it into the same bands, and each
//! encodes some. Their payloads are those that one process would make.

use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;

use super::blocks::{self, Band, Reference, Settings};
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
    /// What its coder noted for the next frame; empty in the exact coding.
    pub notes: Vec<f32>,
    /// `None` of a band that another process has coded.
    decoded: Option<Arc<Band>>,
}

impl CodedBand {
    /// A band that another process has coded.
    pub fn of_other(payload: Vec<u8>, notes: Vec<f32>) -> Self {
        Self { payload, notes, decoded: None }
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
                let blocks::EncodedBand { payload, decoded, notes } = plan.encode(frame, band, wanted)?;
                CodedBand { payload, notes, decoded: Some(decoded) }
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
        let (mut payloads, mut notes, mut decoded) = (vec![], vec![], vec![]);
        for band in bands {
            payloads.push(band.payload);
            notes.push(band.notes);
            decoded.push(band.decoded);
        }
        let plan = match &self.plan {
            BandsPlan::Exact(plan) => return Ok((plan.encoded(payloads)?, None)),
            BandsPlan::Blocks(plan) => plan,
        };
        let encoded = plan.encoded(payloads)?;
        let all = decoded.into_par_iter().zip(&encoded.chunks).map(|(decoded, chunk)| match decoded {
            Some(decoded) => Ok(decoded),
            None => self.decoded(&chunk.bytes),
        });
        let all = all.collect::<Result<Vec<_>, _>>()?;
        Ok((encoded, Some(Arc::new(plan.reference(all, notes)))))
    }

    fn decoded(&self, chunk: &[u8]) -> Result<Arc<Band>, CodecError> {
        let named = |name| self.reference.filter(|reference| reference.frame() == name);
        let (_, band) = blocks::decode_band(&peek(chunk)?, chunk, named)?;
        Ok(Arc::new(band))
    }
}

#[cfg(test)]
mod tests;
