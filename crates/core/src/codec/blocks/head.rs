//! The head of a payload: step sizes, reference and bands. It is the same in all chunks of a frame.

use super::super::bands::Borders;
use super::super::error::CodecError;
use super::super::header::{ChunkHeader, HEADER_BYTES};
use super::super::limits::MAX_CHUNKS;
use super::model::{BandPlace, blocks_along};
use super::steps::{STEPS_BYTES, StepSizes};
use crate::ids::FrameId;

/// The head of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in crate::codec) struct Head {
    pub(super) steps: StepSizes,
    /// The frame that this one is predicted from.
    pub(super) reference: Option<FrameId>,
    /// Where the bands end, in rows of blocks.
    pub(super) borders: Borders,
}

impl Head {
    pub(super) fn to_bytes(self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(HEAD_BYTES + 2 * MAX_CHUNKS);
        bytes.push(self.reference.is_some().into());
        bytes.extend(self.reference.unwrap_or(FrameId(0)).0.to_le_bytes());
        bytes.extend(self.steps.to_bytes());
        self.borders.write(&mut bytes);
        bytes
    }

    /// Reads it from the start of a payload.
    pub(super) fn read(bytes: &mut &[u8], header: &ChunkHeader) -> Result<Self, CodecError> {
        let damaged = |problem: String| CodecError::Payload { plane: "head", problem };
        let Some((fixed, rest)) = bytes.split_first_chunk::<HEAD_BYTES>() else {
            return Err(damaged(format!("{} bytes, expected {HEAD_BYTES}", bytes.len())));
        };
        let [_, _, _, _, _, steps @ ..] = *fixed;
        let reference = named(fixed)?;
        let steps = StepSizes::from_bytes(steps)
            .ok_or_else(|| damaged(format!("steps {steps:02x?}, expected positive ones")))?;
        *bytes = rest;
        let num_rows = blocks_along(header.frame.camera.intrinsics.height);
        let borders = Borders::read(bytes, header.num_chunks, num_rows)?;
        Ok(Self { steps, reference, borders })
    }

    /// The place of the chunk's band in the frame.
    pub(super) fn place(&self, header: &ChunkHeader) -> BandPlace {
        place(self.borders, &header.frame, header.index.0.into())
    }
}

/// The place of a band in a frame.
pub(super) fn place(borders: Borders, frame: &crate::layer::FrameHeader, band: usize) -> BandPlace {
    let intrinsics = frame.camera.intrinsics;
    let rows = borders.rows(band, blocks_along(intrinsics.height));
    BandPlace {
        across: blocks_along(intrinsics.width),
        first_row: rows.start,
        num_rows: rows.len(),
        size: [intrinsics.width as usize, intrinsics.height as usize],
    }
}

/// The reference that the fixed part of a head names.
fn named(&[is_predicted, a, b, c, d, ..]: &[u8; HEAD_BYTES]) -> Result<Option<FrameId>, CodecError> {
    match (is_predicted, FrameId(u32::from_le_bytes([a, b, c, d]))) {
        (0, FrameId(0)) => Ok(None),
        (1, frame) => Ok(Some(frame)),
        (flag, frame) => {
            let problem =
                format!("prediction {flag} from reference {frame}, expected 0 from 0 or 1 from any");
            Err(CodecError::Payload { plane: "head", problem })
        }
    }
}

/// The reference that a chunk in blocks names. `None` for other bytes.
pub fn reference_named(bytes: &[u8]) -> Option<FrameId> {
    named(bytes.get(HEADER_BYTES..)?.first_chunk()?).ok()?
}

/// Size of [`Head`] without borders, bytes.
pub(super) const HEAD_BYTES: usize = 5 + STEPS_BYTES;
