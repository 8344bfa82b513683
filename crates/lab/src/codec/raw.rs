//! Segments as they are in memory, with a general compressor, as scenery sends them.

use isinglass_core::layer::{FrameHeader, LayeredFrame};

use crate::error::LabError;

/// A compressor of bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Compressor {
    /// zstd at level 3, its default.
    Zstd,
    /// LZ4, as scenery uses it.
    #[cfg(feature = "rivals")]
    Lz4,
}

impl Compressor {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Zstd => "raw-zstd",
            #[cfg(feature = "rivals")]
            Self::Lz4 => "raw-lz4",
        }
    }

    pub(crate) fn setting(self) -> &'static str {
        match self {
            Self::Zstd => "halves, level 3",
            #[cfg(feature = "rivals")]
            Self::Lz4 => "halves",
        }
    }

    pub(crate) fn encode(self, frame: &LayeredFrame) -> Result<Vec<u8>, LabError> {
        let raw = raw_from_frame(frame);
        match self {
            Self::Zstd => zstd::bulk::compress(&raw, 3).map_err(|e| self.failed(&e)),
            #[cfg(feature = "rivals")]
            Self::Lz4 => Ok(lz4_flex::block::compress(&raw)),
        }
    }

    /// The frame again. `header` and the number of segments are those of the frame that was encoded.
    pub(crate) fn decode(
        self,
        bytes: &[u8],
        header: FrameHeader,
        num_segments: usize,
    ) -> Result<LayeredFrame, LabError> {
        let size = header.camera.intrinsics.num_pixels() + num_segments * SEGMENT_BYTES;
        let raw = match self {
            Self::Zstd => zstd::bulk::decompress(bytes, size).map_err(|e| self.failed(&e))?,
            #[cfg(feature = "rivals")]
            Self::Lz4 => lz4_flex::block::decompress(bytes, size).map_err(|e| self.failed(&e))?,
        };
        frame_from_raw(&raw, header)
            .ok_or_else(|| self.failed(&format!("{} bytes are not a frame, expected {size}", raw.len())))
    }

    fn failed(self, cause: &dyn std::fmt::Display) -> LabError {
        LabError::Rival { codec: self.name(), cause: cause.to_string() }
    }
}

/// A byte of length for each list; then for each segment red, green, blue and optical depth as halves; then for each
/// segment front and back: scenery's buffers for colour and depth, without the slots it leaves empty, and of half
/// floats and 16-bit depths in place of single floats.
fn raw_from_frame(frame: &LayeredFrame) -> Vec<u8> {
    let mut raw: Vec<u8> = frame.offsets.windows(2).map(|w| (w[1] - w[0]) as u8).collect();
    let colors = frame.c_rg.iter().zip(&frame.c_b_tau).flat_map(|(rg, b_tau)| [rg, b_tau]);
    raw.extend(colors.chain(&frame.depth).flat_map(|word| word.to_le_bytes()));
    raw
}

fn frame_from_raw(raw: &[u8], header: FrameHeader) -> Option<LayeredFrame> {
    let mut frame = LayeredFrame::empty(header);
    let (lengths, words) = raw.split_at_checked(header.camera.intrinsics.num_pixels())?;
    let mut end = 0;
    for (offset, length) in frame.offsets[1..].iter_mut().zip(lengths) {
        end += u32::from(*length);
        *offset = end;
    }
    let num = end as usize;
    if words.len() != num * SEGMENT_BYTES {
        return None;
    }
    let word = |bytes: &[u8]| u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
    let (colors, depths) = words.split_at(num * 8);
    frame.c_rg = colors.chunks_exact(8).map(word).collect();
    frame.c_b_tau = colors.chunks_exact(8).map(|c| word(&c[4..])).collect();
    frame.depth = depths.chunks_exact(4).map(word).collect();
    Some(frame)
}

const SEGMENT_BYTES: usize = 12;

#[cfg(test)]
mod tests {
    use crate::rules::Rule;

    use super::super::tests::frame;
    use super::*;

    #[test]
    fn raw_frames_come_back_bit_for_bit() {
        let frame = frame(Rule::default(), 4);
        let all = [
            Compressor::Zstd,
            #[cfg(feature = "rivals")]
            Compressor::Lz4,
        ];
        for compressor in all {
            let bytes = compressor.encode(&frame).unwrap();
            let raw = frame.offsets.len() - 1 + frame.num_segments() * SEGMENT_BYTES;
            assert!(bytes.len() < raw, "{} of {raw}", bytes.len());
            assert_eq!(compressor.decode(&bytes, frame.header, frame.num_segments()).unwrap(), frame);
            let mut other = frame.clone();
            other.c_rg[5] ^= 1;
            assert_ne!(compressor.encode(&other).unwrap(), bytes);
            assert!(
                compressor.decode(&bytes[..bytes.len() / 2], frame.header, frame.num_segments()).is_err()
            );
        }
        assert_eq!(frame_from_raw(&[1; 7], frame.header), None);
    }
}
