//! Frames on their way out: when a frame is taken, and which streams are given up.
//!
//! quinn tells nobody how much of a stream has left. What it has is a window for data that is not acknowledged; kept
//! at the congestion window, a write waits until the network has room, so the next frame is made from the newest
//! pose instead of queueing behind older ones.

use std::sync::Arc;

use isinglass_core::codec::{self, Chunk};
use isinglass_core::ids::{FrameId, PoseId};
use isinglass_core::session::server::priority;
use quinn::{Connection, SendStream, WriteError};
use tracing::Instrument;

use super::session::{CloseOnDrop, Link, SessionClosed};
use crate::transport;

/// Sends frames to one viewer.
#[derive(Clone, Debug)]
pub struct FrameSender {
    link: Arc<Link>,
    _close: Arc<CloseOnDrop>,
}

impl FrameSender {
    pub(super) fn new(link: Arc<Link>, close: Arc<CloseOnDrop>) -> Self {
        Self { link, _close: close }
    }

    /// Hands a frame over, and returns when the network has taken its base. Refinements follow on their own, until
    /// they are through or a newer frame is handed over. Frame numbers must ascend from 1.
    ///
    /// If the future is dropped, the frame is given up.
    ///
    /// # Errors
    /// If the connection is over.
    pub async fn send(&self, frame: FrameId, pose: PoseId, chunks: Vec<Chunk>) -> Result<(), SessionClosed> {
        let span = tracing::debug_span!("frame", frame = frame.0, pose = pose.0);
        self.send_inner(frame, chunks).instrument(span).await
    }

    /// The newest frame that the viewer has decoded, where frames are predicted from each other; 0 for none.
    pub fn newest_decoded(&self) -> FrameId {
        self.link.state().reported()
    }

    /// The newest frame whose base the viewer has; 0 for none.
    pub fn newest_complete(&self) -> FrameId {
        self.link.state().newest_complete()
    }

    /// Round-trip time as QUIC measures it.
    pub fn rtt(&self) -> std::time::Duration {
        self.link.connection.rtt()
    }

    async fn send_inner(&self, frame: FrameId, chunks: Vec<Chunk>) -> Result<(), SessionClosed> {
        let link = &self.link;
        // From here on refinements of older frames are superseded, which frees the window for this base.
        link.state().handle_base_handed(frame);
        link.progress.send_replace(());
        // Later frames may be predicted from this one, so it must arrive.
        let is_kept = chunks.first().is_some_and(|c| codec::peek(&c.bytes).is_ok_and(|h| h.is_rate()));
        let (base, refinements): (Vec<_>, Vec<_>) = chunks.into_iter().partition(|c| c.is_base);
        let mut streams = Vec::with_capacity(base.len());
        for chunk in base {
            let mut stream = ChunkStream::open(&link.connection, frame, &chunk).await?;
            stream.write(&link.connection, &chunk.bytes).await?;
            streams.push(stream);
        }
        tracing::trace!("base taken");
        let watched = link.clone();
        tokio::spawn(async move { deliver_base(&watched, frame, streams, is_kept).await }.in_current_span());
        if !refinements.is_empty() {
            let link = link.clone();
            tokio::spawn(async move { send_refinements(&link, frame, refinements).await }.in_current_span());
        }
        Ok(())
    }
}

/// Waits until the base is acknowledged, or gives it up when a newer one is, unless it is kept.
async fn deliver_base(link: &Link, frame: FrameId, mut streams: Vec<ChunkStream>, is_kept: bool) {
    tokio::select! {
        biased;
        is_delivered = all_delivered(&streams) => {
            if is_delivered {
                tracing::trace!("base delivered");
                link.state().handle_base_delivered(frame);
                link.progress.send_replace(());
            }
        }
        () = superseded(link, frame, true), if !is_kept => streams.iter_mut().for_each(ChunkStream::give_up),
    }
}

/// Writes refinements in their order, and gives up what is not through when a newer frame is handed over.
async fn send_refinements(link: &Link, frame: FrameId, chunks: Vec<Chunk>) {
    let mut streams = Vec::with_capacity(chunks.len());
    let writing = async {
        for chunk in &chunks {
            let mut stream = ChunkStream::open(&link.connection, frame, chunk).await?;
            stream.write(&link.connection, &chunk.bytes).await?;
            streams.push(stream);
        }
        Ok::<_, SessionClosed>(())
    };
    tokio::select! {
        biased;
        // Dropping the writer gives up the stream it was at.
        () = superseded(link, frame, false) => {}
        written = writing => if written.is_err() { return },
    }
    tokio::select! {
        biased;
        () = superseded(link, frame, false) => {
            tracing::trace!("refinements given up");
            streams.iter_mut().for_each(ChunkStream::give_up);
        }
        _ = all_delivered(&streams) => tracing::trace!("refinements delivered"),
    }
}

/// Returns when the chunks of a frame are not worth sending any more.
async fn superseded(link: &Link, frame: FrameId, is_base: bool) {
    let mut progress = link.progress.subscribe();
    while !link.state().is_superseded(frame, is_base) {
        if progress.changed().await.is_err() {
            return;
        }
    }
}

/// Whether the client has all of these streams. `false` if it has stopped one, or is gone.
async fn all_delivered(streams: &[ChunkStream]) -> bool {
    for stream in streams {
        if !matches!(stream.stream.stopped().await, Ok(None)) {
            return false;
        }
    }
    true
}

/// A stream that is reset when it is dropped half-written: quinn would end it as if it were whole.
#[derive(Debug)]
struct ChunkStream {
    stream: SendStream,
    is_whole: bool,
}

impl ChunkStream {
    async fn open(connection: &Connection, frame: FrameId, chunk: &Chunk) -> Result<Self, SessionClosed> {
        let stream = connection.open_uni().await.map_err(|_| SessionClosed)?;
        let _ = stream.set_priority(priority(frame, chunk.index, chunk.is_base));
        Ok(Self { stream, is_whole: false })
    }

    /// Writes a whole chunk as the window lets it. A client that stops the stream has no use for it: not an error.
    async fn write(&mut self, connection: &Connection, bytes: &[u8]) -> Result<(), SessionClosed> {
        // In pieces, so that the window follows the congestion window while a long chunk is written.
        for piece in bytes.chunks(PIECE) {
            connection.set_send_window(connection.stats().path.cwnd + SLACK);
            match self.stream.write_all(piece).await {
                Ok(()) => {}
                Err(WriteError::Stopped(_)) => return Ok(()),
                Err(_) => return Err(SessionClosed),
            }
        }
        self.is_whole = self.stream.finish().is_ok();
        Ok(())
    }

    fn give_up(&mut self) {
        let _ = self.stream.reset(transport::RESET_SUPERSEDED);
    }
}

impl Drop for ChunkStream {
    fn drop(&mut self) {
        if !self.is_whole {
            self.give_up();
        }
    }
}

/// Bytes written at a time.
const PIECE: usize = 16_000;
/// Bytes that may wait beyond the congestion window, so that a blocked sender is never taken for an idle one: quinn does
/// not widen the congestion window of those. At 300 ms and without a bandwidth limit it made no difference above the
/// noise; more would queue in front of the next frame.
const SLACK: u64 = 2 * PIECE as u64;
