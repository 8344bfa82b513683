//! AV1 on the planes of a sequence: its encoder looks ahead, so what it makes of a frame comes some frames later.

use std::collections::BTreeMap;

use isinglass_core::layer::{FrameHeader, LayeredFrame};

use super::{CodedSequence, Coder};
use crate::codec::av1::{Av1, Av1Stream, Kind, Picture, QUANTIZERS};
use crate::codec::contenders::{AVIF_SPEED, ladder};
use crate::codec::layout::{Layout, Part};
use crate::codec::raster::{ImageCodec, Raster};
use crate::error::LabError;

/// Planes as videos.
pub(super) struct Video {
    codec: Av1,
    at: [usize; 3],
    /// By part and plane.
    streams: [Vec<Av1Stream>; 3],
    /// Planes of kept frames, by frame.
    planes: BTreeMap<u32, Kept>,
    bytes: Vec<usize>,
}

struct Kept {
    header: FrameHeader,
    parts: [Vec<Option<Raster>>; 3],
}

impl Video {
    /// Settings of the parts as in a search.
    pub(super) fn new(at: [usize; 3]) -> Self {
        Self {
            codec: Av1 { speed: AVIF_SPEED },
            at,
            streams: Default::default(),
            planes: BTreeMap::new(),
            bytes: Vec::new(),
        }
    }

    fn take(&mut self, part: usize, plane: usize, pictures: Vec<Picture>) {
        for picture in pictures {
            let i = picture.index as usize;
            if let Some(bytes) = self.bytes.get_mut(i) {
                *bytes += picture.bytes;
            }
            if let Some(kept) = self.planes.get_mut(&(i as u32)) {
                kept.parts[part][plane] = picture.decoded;
            }
        }
    }
}

impl Coder for Video {
    fn lags(&self) -> bool {
        true
    }

    fn push(
        &mut self,
        i: u32,
        frame: &LayeredFrame,
        is_kept: bool,
    ) -> Result<Option<LayeredFrame>, LabError> {
        self.bytes.push(0);
        for (p, part) in Part::ALL.into_iter().enumerate() {
            let (divisor, level) = ladder(Layout::Weighted, part, QUANTIZERS.len(), false)[self.at[p]];
            let rasters = Layout::Weighted.split(frame, part, self.codec.max_bits(), divisor);
            if self.streams[p].is_empty() {
                let open = |r| Av1Stream::new(r, AVIF_SPEED, QUANTIZERS[level], Kind::Sequence);
                self.streams[p] = rasters.iter().map(open).collect::<Result<_, _>>()?;
            }
            if is_kept {
                let none = || std::array::from_fn(|_| Vec::new());
                let kept = Kept { header: frame.header, parts: none() };
                self.planes.entry(i).or_insert(kept).parts[p] = vec![None; rasters.len()];
            }
            for (plane, raster) in rasters.iter().enumerate() {
                let pictures = self.streams[p][plane].push(raster)?;
                self.take(p, plane, pictures);
            }
        }
        Ok(None)
    }

    fn finish(mut self: Box<Self>) -> Result<CodedSequence, LabError> {
        for part in 0..3 {
            for plane in 0..self.streams[part].len() {
                let pictures = self.streams[part][plane].finish()?;
                self.take(part, plane, pictures);
            }
        }
        let mut kept = BTreeMap::new();
        for (i, frame) in self.planes {
            let parts: Option<Vec<Vec<Raster>>> =
                frame.parts.into_iter().map(|planes| planes.into_iter().collect()).collect();
            if let Some([color, opacity, depth]) = parts.as_deref() {
                kept.insert(i, Layout::Weighted.join(frame.header, color, opacity, depth));
            }
        }
        Ok(CodedSequence { bytes: self.bytes, kept, ..CodedSequence::default() })
    }
}
