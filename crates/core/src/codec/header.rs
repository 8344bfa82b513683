//! The header in front of every chunk: fixed length, little-endian, readable without the payload.

use std::ops::Range;

use glam::{Quat, Vec3};

use super::bands::Borders;
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
    /// Whether the payload begins with where the bands end. Otherwise, and in the rate mode, which says it elsewhere, bands are
    /// as high as each other.
    pub has_borders: bool,
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
        let numbers =
            |header: &Self| (header.color_bits, header.num_chunks, header.num_base, header.has_borders);
        if self.frame != first.frame {
            Some("another frame header")
        } else if numbers(self) != numbers(first) {
            Some("other numbers of chunks or another coding")
        } else {
            None
        }
    }

    /// Rows of lists that the chunk covers: as the borders say, or without any in bands as equal as tile rows allow.
    pub(super) fn rows(&self, borders: Option<Borders>) -> Range<u32> {
        let height = self.frame.camera.intrinsics.height;
        let num_rows = num_tiles(height);
        let equal = |band: u8| num_rows * usize::from(band) / usize::from(self.num_base);
        let rows = match borders {
            Some(borders) => borders.rows(self.band, num_rows),
            None => equal(self.band)..equal(self.band + 1),
        };
        let edge = |row: usize| ((row * TILE) as u32).min(height);
        edge(rows.start)..edge(rows.end)
    }

    /// The error of a chunk that is not as its frame's others are.
    pub(super) fn contradicts(&self, what: &'static str) -> CodecError {
        CodecError::Contradiction { index: self.index, frame: self.frame.frame, what }
    }

    /// Length of the whole chunk, header included.
    pub fn chunk_bytes(&self) -> usize {
        HEADER_BYTES + self.payload_bytes as usize
    }

    pub(super) fn to_bytes(self) -> [u8; HEADER_BYTES] {
        let mut w = Writer { bytes: [0; HEADER_BYTES], at: 0 };
        let camera = &self.frame.camera;
        w.put(MAGIC);
        let borders = if self.has_borders { HAS_BORDERS } else { 0 };
        let band_and_mode = self.band | (self.frame.mode as u8) << MODE_SHIFT | borders;
        w.put([VERSION, self.frame.k, self.color_bits, band_and_mode]);
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
    let has_borders = band_and_mode & HAS_BORDERS != 0;
    let (band, mode) = (band_and_mode & BAND_MASK, (band_and_mode & !HAS_BORDERS) >> MODE_SHIFT);
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
    if color_bits == 0 && has_borders {
        return Err(CodecError::Header {
            what: "borders in front of blocks",
            found: "some".into(),
            expected: "none".into(),
        });
    }
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
    Ok(ChunkHeader { frame, color_bits, index, num_chunks, num_base, band, has_borders, payload_bytes })
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
/// The mode stands above the band, and above that whether there are borders.
const MODE_SHIFT: u8 = 4;
const BAND_MASK: u8 = 15;
const HAS_BORDERS: u8 = 1 << 7;
