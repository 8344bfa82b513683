//! Limits of frames and chunks. They bound time and memory of decoding for any bytes.

/// Most chunks of a frame: one for each band of rows.
pub const MAX_CHUNKS: usize = 8;
/// Most lists of a frame: its offsets fit a storage binding of 128 MiB.
pub const MAX_FRAME_LISTS: usize = (1 << 25) - 1;
/// Most segments of a frame: each of its planes fits a storage binding of 128 MiB.
pub const MAX_FRAME_SEGMENTS: usize = 1 << 25;
/// Most segments of a chunk. A forged chunk makes a decoder allocate at most 100 MB for them. A chunk in blocks may
/// have only four for each row of eight lists, and takes up to 200 MB.
pub const MAX_CHUNK_SEGMENTS: usize = 1 << 23;
/// Most bytes of a chunk, header included. A receiver stops reading there.
pub const MAX_CHUNK_BYTES: usize = 32 << 20;

const _: () = assert!(crate::layer::MAX_LISTS <= MAX_FRAME_LISTS);
