//! Bounds on frames and chunks. They bound time and memory of decoding, whatever the bytes are.

/// Most chunks of a frame: one for each band of rows.
pub const MAX_CHUNKS: usize = 8;
/// Most lists of a frame: its offsets fit a storage binding of 128 MiB.
pub const MAX_FRAME_LISTS: usize = (1 << 25) - 1;
/// Most segments of a frame: each of its planes fits a storage binding of 128 MiB.
pub const MAX_FRAME_SEGMENTS: usize = 1 << 25;
/// Most segments of a chunk. A forged chunk cannot ask for more than 100 MB of them. In blocks it may have only four to a
/// row of eight lists, and then asks for 200 MB.
pub const MAX_CHUNK_SEGMENTS: usize = 1 << 23;
/// Most bytes of a chunk, header included; a receiver need not read further.
pub const MAX_CHUNK_BYTES: usize = 32 << 20;

const _: () = assert!(crate::layer::MAX_LISTS <= MAX_FRAME_LISTS);
