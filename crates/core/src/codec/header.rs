//! The header in front of every chunk: fixed length, little-endian, readable without the payload.

use std::ops::Range;

use glam::{Quat, Vec3};

use super::{CodecError, MAX_BANDS, MAX_CHUNK_BYTES, MAX_FRAME_LISTS, TILE, at_most, scale};
use crate::camera::{Camera, Intrinsics, Pose, Projection};
use crate::ids::{ChunkIndex, FrameId, LookVersion, PoseId};
use crate::layer::{FrameHeader, MAX_K};
use crate::mode::{Compositing, Mode};

/// What a chunk says of itself and of its frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChunkHeader {
    /// The frame.
    pub frame: FrameHeader,
    /// Bits of a colour channel; 0 in the rate mode.
    pub color_bits: u8,
    /// Place in the order of sending, below `num_chunks`.
    pub index: ChunkIndex,
    /// Chunks of the frame.
    pub num_chunks: u8,
    /// Base chunks of the frame, which come first; also the number of bands.
    pub num_base: u8,
    /// The band, counted from the top, below `num_base`.
    pub band: u8,
    /// Bytes after the header.
    pub payload_bytes: u32,
}

impl ChunkHeader {
    /// Whether the frame cannot be shown without this chunk.
    pub fn is_base(&self) -> bool {
        self.index.0 < u16::from(self.num_base)
    }

    /// Whether the chunk is of the rate mode.
    pub fn is_rate(&self) -> bool {
        self.color_bits == 0
    }

    /// What all chunks of a frame have in common and this one has otherwise than `first`.
    pub(super) fn difference(&self, first: &Self) -> Option<&'static str> {
        let numbers = |header: &Self| (header.color_bits, header.num_chunks, header.num_base);
        if self.frame != first.frame {
            Some("another frame header")
        } else if numbers(self) != numbers(first) {
            Some("other numbers of chunks or another coding")
        } else {
            None
        }
    }

    /// Rows of lists that the chunk covers.
    pub fn rows(&self) -> Range<u32> {
        band_rows(self.frame.camera.intrinsics.height, self.num_base, self.band)
    }

    /// Length of the whole chunk, header included.
    pub fn chunk_bytes(&self) -> usize {
        HEADER_BYTES + self.payload_bytes as usize
    }

    /// Columns times rows.
    pub(super) fn num_lists(&self) -> usize {
        self.rows().len() * self.frame.camera.intrinsics.width as usize
    }

    pub(super) fn to_bytes(self) -> [u8; HEADER_BYTES] {
        let mut w = Writer { bytes: [0; HEADER_BYTES], at: 0 };
        let camera = &self.frame.camera;
        w.put(MAGIC);
        w.put([VERSION, self.frame.k, self.color_bits, self.band | (self.frame.mode as u8) << MODE_SHIFT]);
        w.put(self.index.0.to_le_bytes());
        w.put([self.num_chunks, self.num_base]);
        w.put(self.frame.frame.0.to_le_bytes());
        w.put(self.frame.pose.0.to_le_bytes());
        w.put(self.frame.look.0.to_le_bytes());
        w.put((camera.intrinsics.width as u16).to_le_bytes());
        w.put((camera.intrinsics.height as u16).to_le_bytes());
        let (eye, q) = (camera.pose.eye, camera.pose.world_from_view);
        for x in [
            eye.x,
            eye.y,
            eye.z,
            q.x,
            q.y,
            q.z,
            q.w,
            camera.intrinsics.projection.to_number(),
            camera.near,
            camera.far,
        ] {
            w.put(x.to_le_bytes());
        }
        w.put(self.payload_bytes.to_le_bytes());
        w.bytes
    }
}

/// Reads the header at the start of a chunk; the bytes after [`HEADER_BYTES`] need not be there yet.
pub fn peek(bytes: &[u8]) -> Result<ChunkHeader, CodecError> {
    let fixed: &[u8; HEADER_BYTES] =
        bytes.first_chunk().ok_or(CodecError::Length { found: bytes.len(), expected: HEADER_BYTES })?;
    let mut r = Reader { bytes: fixed, at: 0 };
    let magic = r.take();
    if magic != MAGIC {
        return Err(CodecError::Magic(magic));
    }
    let [version, k, color_bits, band_and_mode] = r.take();
    let (band, mode) = (band_and_mode & BAND_MASK, band_and_mode >> MODE_SHIFT);
    if version != VERSION {
        return Err(CodecError::Version(version));
    }
    let index = ChunkIndex(u16::from_le_bytes(r.take()));
    let [num_chunks, num_base] = r.take();
    let frame = FrameId(u32::from_le_bytes(r.take()));
    let pose = PoseId(u32::from_le_bytes(r.take()));
    let look = LookVersion(u32::from_le_bytes(r.take()));
    let width = u32::from(u16::from_le_bytes(r.take()));
    let height = u32::from(u16::from_le_bytes(r.take()));
    let [ex, ey, ez, qx, qy, qz, qw, projection, near, far] =
        std::array::from_fn(|_| f32::from_le_bytes(r.take()));
    let payload_bytes = u32::from_le_bytes(r.take());

    let camera = Camera {
        pose: Pose { eye: Vec3::new(ex, ey, ez), world_from_view: Quat::from_xyzw(qx, qy, qz, qw) },
        intrinsics: Intrinsics { width, height, projection: Projection::from_number(projection) },
        near,
        far,
    };
    if !camera.is_valid() {
        return Err(CodecError::Header {
            what: "camera",
            found: format!("{camera:?}"),
            expected: "a finite one of bounded size".into(),
        });
    }
    at_most("lists", camera.intrinsics.num_pixels(), MAX_FRAME_LISTS)?;
    if color_bits != 0 {
        scale::of(color_bits)?;
    }
    in_range("k", k.into(), 1, MAX_K)?;
    in_range("number of base chunks", num_base.into(), 1, MAX_BANDS.min(num_tiles(height)))?;
    in_range("number of chunks", num_chunks.into(), num_base.into(), 2 * usize::from(num_base))?;
    in_range("chunk index", index.0.into(), 0, usize::from(num_chunks) - 1)?;
    in_range("band", band.into(), 0, usize::from(num_base) - 1)?;
    in_range("payload length", payload_bytes as usize, 0, MAX_CHUNK_BYTES - HEADER_BYTES)?;
    in_range("mode", mode.into(), 0, Mode::ALL.len() - 1)?;
    let mode = Mode::ALL[usize::from(mode)];
    if color_bits == 0 && mode.is_projection() {
        return Err(CodecError::Header {
            what: "mode of a frame in blocks",
            found: mode.to_string(),
            expected: "composite or iso".into(),
        });
    }
    if mode.compositing() == Compositing::Mean && num_chunks != num_base {
        return Err(CodecError::Header {
            what: "number of chunks of an average",
            found: num_chunks.to_string(),
            expected: num_base.to_string(),
        });
    }
    let frame = FrameHeader { frame, pose, look, camera, k, mode };
    Ok(ChunkHeader { frame, color_bits, index, num_chunks, num_base, band, payload_bytes })
}

fn in_range(what: &'static str, found: usize, min: usize, max: usize) -> Result<(), CodecError> {
    if (min..=max).contains(&found) {
        return Ok(());
    }
    Err(CodecError::Header { what, found: found.to_string(), expected: format!("{min} to {max}") })
}

/// Bands of a frame of so many rows: one for every four tile rows, 1 to [`MAX_BANDS`].
pub(super) fn num_bands(height: u32) -> u8 {
    (num_tiles(height) / 4).clamp(1, MAX_BANDS) as u8
}

/// The rows of one band. Bands are whole tile rows, as equal as that allows.
pub(super) fn band_rows(height: u32, num_bands: u8, band: u8) -> Range<u32> {
    let edge = |band: u8| {
        let tiles = num_tiles(height) * usize::from(band) / usize::from(num_bands);
        ((tiles * TILE) as u32).min(height)
    };
    edge(band)..edge(band + 1)
}

/// Tiles along a side of so many lists.
pub(super) fn num_tiles(side: u32) -> usize {
    (side as usize).div_ceil(TILE)
}

struct Writer {
    bytes: [u8; HEADER_BYTES],
    at: usize,
}

impl Writer {
    fn put<const N: usize>(&mut self, bytes: [u8; N]) {
        self.bytes[self.at..self.at + N].copy_from_slice(&bytes);
        self.at += N;
    }
}

struct Reader<'a> {
    bytes: &'a [u8; HEADER_BYTES],
    at: usize,
}

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> [u8; N] {
        let bytes = std::array::from_fn(|i| self.bytes[self.at + i]);
        self.at += N;
        bytes
    }
}

/// Bytes of a chunk's header.
pub const HEADER_BYTES: usize = 72;

pub(super) const MAGIC: [u8; 4] = *b"IGLC";
pub(super) const VERSION: u8 = 2;
/// The mode stands above the band.
const MODE_SHIFT: u8 = 4;
const BAND_MASK: u8 = 15;
