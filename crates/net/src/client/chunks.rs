//! Reads the streams of frames, and the parity that restores them.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use isinglass_core::codec::{self, ChunkHeader, HEADER_BYTES, MAX_CHUNK_BYTES};
use isinglass_core::session::chunks::{ChunkPlace, MAX_FRAME_BYTES, Prediction};
use isinglass_core::session::repair::RepairedStream;
use isinglass_core::wire::parity::ParityHead;
use isinglass_core::wire::screenshot::screenshot_id;
use isinglass_core::wire::slice::slice_id;
use quinn::{Connection, RecvStream};

use super::parities::{Listener, Parities};
use super::{Shared, whole};
use crate::transport::{RESET_SUPERSEDED, STOP_REPAIRED, STOP_UNUSABLE};

/// Reads each stream of a connection in a task of its own, and hands parity to these tasks, until the connection
/// ends.
pub(super) async fn read_all(shared: &Arc<Shared>, connection: &Connection, number: u32) {
    let budget = Arc::new(AtomicUsize::new(0));
    let parities = Arc::<Parities>::default();
    let reading = async {
        while let Ok(stream) = connection.accept_uni().await {
            let (shared, budget) = (shared.clone(), Budget { total: budget.clone(), ..Budget::default() });
            let parity = parities.listen(stream.id().into());
            tokio::spawn(async move {
                if let Err(problem) = read(&shared, stream, number, budget, parity).await {
                    shared.note_broken_chunk(problem);
                }
            });
        }
    };
    let repairing = async {
        while let Ok(datagram) = connection.read_datagram().await {
            if let Err(problem) = parities.pass_on(datagram) {
                shared.note_broken_chunk(problem.to_string());
            }
        }
    };
    tokio::join!(reading, repairing);
}

/// Reads one frame. A stream that is reset, superseded or cut off by the connection's end is no error.
async fn read(
    shared: &Shared,
    mut stream: RecvStream,
    number: u32,
    mut budget: Budget,
    mut parity: Listener,
) -> Result<(), String> {
    let mut frame = RepairedStream::default();
    let mut first_byte_micros = None;
    let mut header: Option<ChunkHeader> = None;
    loop {
        let due = frame.repair_due().map(|due| due.saturating_sub(shared.clock.now_micros()));
        let next = tokio::select! {
            biased;
            next = stream.read_chunk(usize::MAX, false) => next,
            Some(datagram) = parity.next() => {
                if let Ok((head, symbols)) = ParityHead::decode(&datagram)
                    && budget.take(symbols.len())
                {
                    frame.handle_parity(shared.clock.now_micros(), head, symbols);
                }
                continue;
            }
            () = tokio::time::sleep(Duration::from_micros(due.unwrap_or(0))), if due.is_some() => {
                if frame.repair() {
                    let _ = stream.stop(STOP_REPAIRED);
                    break;
                }
                continue;
            }
        };
        let Ok(next) = next else { return Ok(()) };
        let Some(part) = next else { break };
        let now = shared.clock.now_micros();
        first_byte_micros.get_or_insert(now);
        let end = part.offset as usize + part.bytes.len();
        if end > MAX_FRAME_BYTES || !budget.grow_to(end) {
            let _ = stream.stop(STOP_UNUSABLE);
            return Err(format!("a frame of more than {} bytes is not read", frame.num_bytes()));
        }
        frame.handle_part(now, part.offset as usize, &part.bytes);
        let bytes = frame.prefix();
        if header.is_none() && screenshot_id(bytes).is_some() {
            return whole::read_screenshot(shared, stream, frame, budget).await;
        }
        if header.is_none() && slice_id(bytes).is_some() {
            return whole::read_slice(shared, stream, frame, budget).await;
        }
        if header.is_none() && bytes.len() >= HEADER_BYTES {
            let read = codec::peek(bytes);
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
    let now = shared.clock.now_micros();
    let first = first_byte_micros.unwrap_or(now);
    let bytes = frame.into_bytes();
    let mut chunks = shared.chunks();
    if chunks.connection() != number {
        return Ok(());
    }
    let mut rest = &bytes[..];
    loop {
        let header =
            codec::peek(rest).map_err(|_| format!("a stream of {} bytes is no frame", bytes.len()))?;
        let length = header.chunk_bytes();
        let Some((chunk, after)) = rest.split_at_checked(length) else {
            return Err(format!("a frame ends after {} bytes of {length}", rest.len()));
        };
        let place = place(&header, chunk);
        chunks.handle_chunk(now, first, place, chunk.to_vec()).map_err(|e| e.to_string())?;
        rest = after;
        if rest.is_empty() {
            shared.decode_wanted.notify_one();
            return Ok(());
        }
    }
}

/// Whether others can be predicted from the frame.
fn is_predicting(header: &ChunkHeader) -> bool {
    !header.is_exact
}

fn place(header: &ChunkHeader, bytes: &[u8]) -> ChunkPlace {
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
#[derive(Debug, Default)]
pub(super) struct Budget {
    total: Arc<AtomicUsize>,
    taken: usize,
    /// Of these, bytes of the stream.
    of_stream: usize,
}

impl Budget {
    /// Takes what is missing for so many bytes of the stream.
    pub(super) fn grow_to(&mut self, bytes: usize) -> bool {
        let more = bytes.saturating_sub(self.of_stream);
        self.of_stream += more;
        self.take(more)
    }

    fn take(&mut self, bytes: usize) -> bool {
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
