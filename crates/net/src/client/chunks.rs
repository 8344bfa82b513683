//! Reads the streams of chunks.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use isinglass_core::codec::{self, HEADER_BYTES, MAX_CHUNK_BYTES};
use isinglass_core::session::chunks::{ChunkPlace, Prediction};
use isinglass_core::wire::screenshot::screenshot_id;
use isinglass_core::wire::slice::slice_id;
use quinn::{Connection, RecvStream};

use super::{Shared, whole};
use crate::transport::{RESET_SUPERSEDED, STOP_UNUSABLE};

/// Reads each stream of a connection in a task of its own, until the connection ends.
pub(super) async fn read_all(shared: &Arc<Shared>, connection: &Connection, number: u32) {
    let budget = Arc::new(AtomicUsize::new(0));
    while let Ok(stream) = connection.accept_uni().await {
        let (shared, budget) = (shared.clone(), Budget { total: budget.clone(), taken: 0 });
        tokio::spawn(async move {
            if let Err(problem) = read(&shared, stream, number, budget).await {
                shared.note_broken_chunk(problem);
            }
        });
    }
}

/// Reads one chunk. A stream that is reset, superseded or cut off by the connection's end is no error.
async fn read(
    shared: &Shared,
    mut stream: RecvStream,
    number: u32,
    mut budget: Budget,
) -> Result<(), String> {
    let mut bytes = Vec::new();
    let mut first_byte_micros = None;
    let mut header = None;
    while let Ok(next) = stream.read_chunk(usize::MAX, true).await {
        let Some(part) = next else {
            let header = header.ok_or_else(|| format!("a stream of {} bytes is no chunk", bytes.len()))?;
            let now = shared.clock.now_micros();
            let first = first_byte_micros.unwrap_or(now);
            let place = place(&header, &bytes);
            let mut chunks = shared.chunks();
            if chunks.connection() == number {
                chunks.handle_chunk(now, first, place, bytes).map_err(|e| e.to_string())?;
                shared.decode_wanted.notify_one();
            }
            return Ok(());
        };
        first_byte_micros.get_or_insert_with(|| shared.clock.now_micros());
        let length = bytes.len() + part.bytes.len();
        if length > MAX_CHUNK_BYTES || !budget.take(part.bytes.len()) {
            let _ = stream.stop(STOP_UNUSABLE);
            return Err(format!("a chunk of more than {} bytes is not read", bytes.len()));
        }
        bytes.extend_from_slice(&part.bytes);
        if header.is_none() && screenshot_id(&bytes).is_some() {
            return whole::read_screenshot(shared, stream, bytes, budget).await;
        }
        if header.is_none() && slice_id(&bytes).is_some() {
            return whole::read_slice(shared, stream, bytes, budget).await;
        }
        if header.is_none() && bytes.len() >= HEADER_BYTES {
            let read = codec::peek(&bytes);
            if read.is_err() {
                let _ = stream.stop(STOP_UNUSABLE);
            }
            header = Some(read.map_err(|e| e.to_string())?);
        }
        if header.as_ref().is_some_and(|h| !shared.chunks().wants(h.frame.frame, is_predicting(h))) {
            let _ = stream.stop(RESET_SUPERSEDED);
            return Ok(());
        }
    }
    Ok(())
}

/// Whether others can be predicted from the frame.
fn is_predicting(header: &codec::ChunkHeader) -> bool {
    !header.is_exact
}

fn place(header: &codec::ChunkHeader, bytes: &[u8]) -> ChunkPlace {
    let prediction =
        is_predicting(header).then(|| Prediction { reference: codec::blocks::reference_named(bytes) });
    ChunkPlace {
        prediction,
        frame: header.frame.frame,
        pose: header.frame.pose,
        index: header.index,
        num_chunks: header.num_chunks.into(),
    }
}

/// Bytes that all streams of a connection hold while they are read.
pub(super) struct Budget {
    total: Arc<AtomicUsize>,
    taken: usize,
}

impl Budget {
    pub(super) fn take(&mut self, bytes: usize) -> bool {
        self.taken += bytes;
        self.total.fetch_add(bytes, Ordering::Relaxed) + bytes <= MAX_READING_BYTES
    }
}

impl Drop for Budget {
    fn drop(&mut self) {
        self.total.fetch_sub(self.taken, Ordering::Relaxed);
    }
}

/// Eight of the longest chunks.
const MAX_READING_BYTES: usize = 8 * MAX_CHUNK_BYTES;
