//! The header in front of every chunk: fixed length, little-endian, readable without the payload.

use glam::{Quat, Vec3};

use super::error::{CodecError, at_most};
use super::limits::{MAX_CHUNK_BYTES, MAX_CHUNKS, MAX_FRAME_LISTS};
use crate::camera::{Camera, Intrinsics, Pose, Projection};
use crate::ids::{ChunkIndex, FrameId, LookVersion, PoseId};
use crate::layer::{Fineness, FrameHeader, MAX_K};
use crate::mode::Mode;

/// The header of a chunk.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChunkHeader {
    /// The frame.
    pub frame: FrameHeader,
    /// Whether the frame is coded exactly; otherwise it is in blocks.
    pub is_exact: bool,
    /// The band, counted from the top, below `num_chunks`.
    pub index: ChunkIndex,
    /// Number of chunks of the frame, which is its number of bands.
    pub num_chunks: u8,
    /// Number of bytes after the header.
    pub payload_bytes: u32,
}

impl ChunkHeader {
    /// The error of a chunk that contradicts other chunks of its frame.
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
        let kind = u8::from(self.is_exact) + 2 * self.frame.fineness as u8;
        w.put([VERSION, self.frame.k, kind, self.frame.mode as u8]);
        w.put(self.index.0.to_le_bytes());
        w.put(u16::from(self.num_chunks).to_le_bytes());
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

/// Reads the header at the start of a chunk. The bytes after [`HEADER_BYTES`] may still be missing.
pub fn peek(bytes: &[u8]) -> Result<ChunkHeader, CodecError> {
    let fixed: &[u8; HEADER_BYTES] =
        bytes.first_chunk().ok_or(CodecError::Length { found: bytes.len(), expected: HEADER_BYTES })?;
    let mut r = Reader { bytes: fixed, at: 0 };
    let magic = r.take();
    if magic != MAGIC {
        return Err(CodecError::Magic(magic));
    }
    let [version, k, kind, mode] = r.take();
    if version != VERSION {
        return Err(CodecError::Version { found: version, expected: VERSION });
    }
    let index = ChunkIndex(u16::from_le_bytes(r.take()));
    let num_chunks = u16::from_le_bytes(r.take());
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
    in_range("k", k.into(), 1, MAX_K)?;
    in_range("coding and fineness", kind.into(), 0, 2 * Fineness::ALL.len() - 1)?;
    in_range("number of chunks", num_chunks.into(), 1, MAX_CHUNKS.min(num_tiles(height)))?;
    in_range("chunk index", index.0.into(), 0, usize::from(num_chunks) - 1)?;
    in_range("payload length", payload_bytes as usize, 0, MAX_CHUNK_BYTES - HEADER_BYTES)?;
    in_range("mode", mode.into(), 0, Mode::ALL.len() - 1)?;
    let (is_exact, fineness) = (kind % 2 == 1, Fineness::ALL[usize::from(kind / 2)]);
    let mode = Mode::ALL[usize::from(mode)];
    if !is_exact && mode.is_projection() {
        return Err(CodecError::Header {
            what: "mode of a frame in blocks",
            found: mode.to_string(),
            expected: "composite or iso".into(),
        });
    }
    let frame = FrameHeader { frame, pose, look, camera, k, mode, fineness };
    Ok(ChunkHeader { frame, is_exact, index, num_chunks: num_chunks as u8, payload_bytes })
}

fn in_range(what: &'static str, found: usize, min: usize, max: usize) -> Result<(), CodecError> {
    if (min..=max).contains(&found) {
        return Ok(());
    }
    Err(CodecError::Header { what, found: found.to_string(), expected: format!("{min} to {max}") })
}

/// Number of bands of a frame with `height` rows: one for every four tile rows, 1 to [`MAX_CHUNKS`].
pub(super) fn num_bands(height: u32) -> u8 {
    (num_tiles(height) / 4).clamp(1, MAX_CHUNKS) as u8
}

/// Number of tiles along a side of `side` lists.
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

/// Size of a chunk's header, bytes.
pub const HEADER_BYTES: usize = 72;
/// Side of a tile, lists. A band has at least one row of tiles.
pub const TILE: usize = 16;

const MAGIC: [u8; 4] = *b"IGLC";
const VERSION: u8 = 4;
