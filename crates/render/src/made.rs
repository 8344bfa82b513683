//! Layered frames that are here, or in the processes that have made them.

use std::sync::Arc;

use isinglass_core::cancel::Wanted;
use isinglass_core::codec::blocks::Reference;
use isinglass_core::codec::{CodecError, Coding, EncodedFrame};
use isinglass_core::layer::{FrameHeader, LayeredFrame};

/// A layered frame.
#[derive(Clone, Debug)]
pub enum MadeFrame {
    /// All of it is here.
    Here(LayeredFrame),
    /// Several processes have its rows.
    Elsewhere(FrameElsewhere),
}

/// A frame whose rows several processes have.
#[derive(Clone)]
pub struct FrameElsewhere {
    /// Its header.
    pub header: FrameHeader,
    /// Number of segments in all lists.
    pub num_segments: usize,
    /// The rows. The processes forget them with the last clone.
    pub rows: Arc<dyn RowsElsewhere>,
}

impl std::fmt::Debug for FrameElsewhere {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} segments elsewhere, {:?}", self.num_segments, self.header)
    }
}

/// What processes do with a frame whose rows they have.
pub trait RowsElsewhere: Send + Sync {
    /// The frame as bytes under this header, thinned if wanted ([`LayeredFrame::thinned`]).
    ///
    /// # Errors
    /// See [`Coding::encode_while`].
    fn encode(
        &self,
        header: &FrameHeader,
        coding: Coding,
        is_thinned: bool,
        reference: Option<&Arc<Reference>>,
    ) -> Result<(EncodedFrame, Option<Arc<Reference>>), CodecError>;

    /// The frame; `None` if the processes have ended.
    fn gather(&self) -> Option<LayeredFrame>;
}

impl MadeFrame {
    /// The header.
    pub fn header(&self) -> &FrameHeader {
        match self {
            Self::Here(frame) => &frame.header,
            Self::Elsewhere(frame) => &frame.header,
        }
    }

    /// The header, whose numbers may change.
    pub fn header_mut(&mut self) -> &mut FrameHeader {
        match self {
            Self::Here(frame) => &mut frame.header,
            Self::Elsewhere(frame) => &mut frame.header,
        }
    }

    /// Number of segments in all lists.
    pub fn num_segments(&self) -> usize {
        match self {
            Self::Here(frame) => frame.num_segments(),
            Self::Elsewhere(frame) => frame.num_segments,
        }
    }

    /// Number of lists.
    pub fn num_lists(&self) -> usize {
        self.header().camera.intrinsics.num_pixels()
    }

    /// The frame here. `None` if it is elsewhere, and the processes have ended.
    pub fn gathered(self) -> Option<LayeredFrame> {
        match self {
            Self::Here(frame) => Some(frame),
            Self::Elsewhere(frame) => {
                let FrameElsewhere { header, rows, .. } = frame;
                rows.gather().map(|frame| LayeredFrame { header, ..frame })
            }
        }
    }

    /// The frame as bytes while it is wanted, thinned if it should be ([`LayeredFrame::thinned`]). Several processes
    /// code all of it once they have begun.
    ///
    /// # Errors
    /// See [`Coding::encode_while`].
    pub fn encode_while(
        &self,
        coding: Coding,
        is_thinned: bool,
        reference: Option<&Arc<Reference>>,
        wanted: Wanted<'_>,
    ) -> Result<(EncodedFrame, Option<Arc<Reference>>), CodecError> {
        match self {
            Self::Here(frame) if is_thinned => {
                coding.encode_while(&frame.thinned(), reference.map(AsRef::as_ref), wanted)
            }
            Self::Here(frame) => coding.encode_while(frame, reference.map(AsRef::as_ref), wanted),
            Self::Elsewhere(_) if !wanted() => Err(CodecError::Abandoned),
            Self::Elsewhere(frame) => frame.rows.encode(&frame.header, coding, is_thinned, reference),
        }
    }
}
