//! Sends frames: it decides when to take the next one, and resets streams that the session gives up.
//!
//! quinn does not report how much of a stream has left. But it has a window for unacknowledged data. The window
//! follows the congestion window, so a write waits until the network has room. Then the next frame is made from the
//! newest pose in place of queueing behind older ones.

use std::sync::Arc;
use std::time::Duration;

use isinglass_core::codec::{self, Chunk};
use isinglass_core::ids::{FrameId, PoseId, ScreenshotId};
use isinglass_core::session::chunks::{
    Rank, SCREENSHOT_PRIORITY, SLICE_AHEAD_PRIORITY, SLICE_PRIORITY, priority,
};
use isinglass_core::session::ledger::Stage;
use isinglass_core::session::rate::LinkState;
use isinglass_core::session::repair::{overhead, parity};
use isinglass_core::wire::screenshot::screenshot_header;
use quinn::{SendStream, WriteError};
use tokio::sync::watch;
use tokio::time::Instant;
use tracing::Instrument;

use super::session::{CloseOnDrop, SessionClosed, ViewerLink};
use crate::transport;

/// Sends frames to one viewer.
#[derive(Clone, Debug)]
pub struct FrameSender {
    link: Arc<ViewerLink>,
    _close: Arc<CloseOnDrop>,
}

impl FrameSender {
    pub(super) fn new(link: Arc<ViewerLink>, close: Arc<CloseOnDrop>) -> Self {
        Self { link, _close: close }
    }

    /// Hands a frame over, and returns when the network has taken it. Frame numbers must ascend from 1.
    ///
    /// If the future is dropped, the frame is given up.
    ///
    /// # Errors
    /// If the connection is over.
    pub async fn send(&self, frame: FrameId, pose: PoseId, chunks: Vec<Chunk>) -> Result<(), SessionClosed> {
        let span = tracing::debug_span!("frame", frame = frame.0, pose = pose.0);
        self.send_inner(frame, chunks, false).instrument(span).await
    }

    /// The same for a finer version of the previous frame. It yields to other frames, unless later ones may be
    /// predicted from it.
    ///
    /// # Errors
    /// If the connection is over.
    pub async fn send_finer(
        &self,
        frame: FrameId,
        pose: PoseId,
        chunks: Vec<Chunk>,
    ) -> Result<(), SessionClosed> {
        let span = tracing::debug_span!("frame", frame = frame.0, pose = pose.0, finer = true);
        self.send_inner(frame, chunks, true).instrument(span).await
    }

    /// Sends a screenshot as PNG, behind all frames. Returns when the viewer has it.
    ///
    /// If the future is dropped, the picture is given up.
    ///
    /// # Errors
    /// If the connection is over.
    pub async fn send_screenshot(&self, id: ScreenshotId, png: &[u8]) -> Result<(), SessionClosed> {
        let mut stream = FrameStream::open_whole(&self.link, SCREENSHOT_PRIORITY).await?;
        let header = screenshot_header(id);
        for part in [&header[..]].into_iter().chain(png.chunks(4 * PIECE)) {
            if !stream.write_behind(&self.link, part).await? {
                return Ok(());
            }
        }
        let _ = stream.stream.finish();
        stream.is_delivered().await;
        Ok(())
    }

    /// Writes the stream of a slice, before all frames or, while `is_ahead`, behind them. Returns when the network has
    /// taken it.
    ///
    /// If the future or the result is dropped, the slice is given up.
    ///
    /// # Errors
    /// If the connection is over.
    pub async fn send_slice(
        &self,
        bytes: &[u8],
        is_ahead: &watch::Receiver<bool>,
    ) -> Result<SentSlice, SessionClosed> {
        let mut stream = FrameStream::open_whole(&self.link, SLICE_AHEAD_PRIORITY).await?;
        for part in bytes.chunks(4 * PIECE) {
            let is_ahead = *is_ahead.borrow();
            let _ = stream.stream.set_priority(if is_ahead { SLICE_AHEAD_PRIORITY } else { SLICE_PRIORITY });
            let is_taken = match is_ahead {
                true => stream.write_behind(&self.link, part).await?,
                false => stream.write_part(&self.link, part).await?,
            };
            if !is_taken {
                return Ok(SentSlice(stream));
            }
        }
        let _ = stream.stream.finish();
        Ok(SentSlice(stream))
    }

    /// The state of the link according to the congestion control.
    pub fn link_state(&self) -> LinkState {
        let gauge = &self.link.gauge;
        let Some(bytes_per_second) = gauge.bytes_per_second() else {
            // Before any data is acknowledged, or with a congestion control that knows no rates.
            let path = self.link.connection.stats().path;
            return LinkState {
                bytes_per_second: path.cwnd as f64 / path.rtt.as_secs_f64().max(1e-3),
                is_measured: false,
                least_rtt_micros: path.min_rtt.as_micros() as u64,
            };
        };
        // Parity is sent beside the frames.
        let usual = (bytes_per_second / USUAL_FRAMES_PER_SECOND) as usize;
        let overhead = overhead(usual, gauge.loss(), USUAL_PACKET_BYTES);
        LinkState {
            bytes_per_second: bytes_per_second / (1.0 + overhead),
            is_measured: gauge.knows_rate(),
            least_rtt_micros: gauge.least_rtt_micros(),
        }
    }

    /// Limits the rate of writing, bytes per second; `None` for no limit.
    pub fn set_rate(&self, bytes_per_second: Option<f64>) {
        self.link.pace().bytes_per_second = bytes_per_second;
    }

    async fn send_inner(
        &self,
        frame: FrameId,
        chunks: Vec<Chunk>,
        is_finer: bool,
    ) -> Result<(), SessionClosed> {
        let link = &self.link;
        link.talk.lock_quietly().chunks.handle_handed(frame);
        let is_exact = chunks.first().is_none_or(|c| codec::peek(&c.bytes).map_or(true, |h| h.is_exact));
        let rank = match (is_exact, is_finer) {
            (false, _) => Rank::Predicting,
            (true, false) => Rank::Independent,
            (true, true) => Rank::Finer,
        };
        let writing = Writing::of(link);
        let stream = link.connection.open_uni().await.map_err(|_| SessionClosed)?;
        let _ = stream.set_priority(priority(frame, rank));
        let mut stream = FrameStream { stream, first_of: Some(frame) };
        let mut is_taken = true;
        for chunk in &chunks {
            is_taken = is_taken && stream.write_part(link, &chunk.bytes).await?;
        }
        if is_taken {
            let _ = stream.stream.finish();
            if rank != Rank::Finer {
                let at = send_parity(link, &stream.stream, &chunks);
                tokio::time::sleep_until(at).await;
            }
        }
        drop(writing);
        link.journal.stamp(frame, Stage::LastByteSent);
        tracing::trace!("taken");
        let watched = link.clone();
        tokio::spawn(async move { deliver(&watched, frame, stream, rank).await }.in_current_span());
        Ok(())
    }
}

/// A slice that the network has taken.
#[derive(Debug)]
pub struct SentSlice(FrameStream);

impl SentSlice {
    /// Returns when the viewer has the slice, or wants it no longer.
    pub async fn delivered(self) {
        self.0.is_delivered().await;
    }
}

/// Waits until a frame is acknowledged. Gives it up when a newer one is, unless later frames may be predicted from it.
async fn deliver(link: &ViewerLink, frame: FrameId, stream: FrameStream, rank: Rank) {
    tokio::select! {
        biased;
        is_delivered = stream.is_delivered() => {
            if is_delivered {
                tracing::trace!("delivered");
                link.talk.lock_quietly().chunks.handle_delivered(frame);
                link.progress.send_replace(());
            }
        }
        () = superseded(link, frame), if rank != Rank::Predicting => drop(stream),
    }
}

/// Marks that a frame is being written.
struct Writing<'a>(&'a ViewerLink);

impl<'a> Writing<'a> {
    fn of(link: &'a ViewerLink) -> Self {
        link.num_writing.send_modify(|num| *num += 1);
        Self(link)
    }
}

impl Drop for Writing<'_> {
    fn drop(&mut self) {
        self.0.num_writing.send_modify(|num| *num -= 1);
    }
}

/// Returns when a frame is no longer worth sending.
async fn superseded(link: &ViewerLink, frame: FrameId) {
    let mut progress = link.progress.subscribe();
    while !link.talk.lock_quietly().chunks.is_superseded(frame) {
        if progress.changed().await.is_err() {
            return;
        }
    }
}

/// Sends what restores lost packets of a frame, if the link loses packets. Returns when the link has room for the
/// next frame.
fn send_parity(link: &ViewerLink, stream: &SendStream, chunks: &[Chunk]) -> Instant {
    let (connection, loss) = (&link.connection, link.gauge.loss());
    let mut num_bytes: usize = chunks.iter().map(|chunk| chunk.bytes.len()).sum();
    if overhead(num_bytes, loss, USUAL_PACKET_BYTES) == 0.0 {
        return Instant::now();
    }
    let bytes = chunks.iter().map(|chunk| &chunk.bytes[..]).collect::<Vec<_>>().concat();
    let packet_bytes = connection.max_datagram_size().unwrap_or(0);
    for datagram in parity(stream.id().into(), &bytes, loss, packet_bytes) {
        num_bytes += datagram.len();
        if connection.send_datagram(datagram.into()).is_err() {
            break;
        }
    }
    let mut room = link.room();
    room.bytes_per_second = link.gauge.bytes_per_second().map(|rate| MOST_FILLED * rate);
    let now = Instant::now();
    let (at, latest) = (room.take(now, num_bytes), now + LONGEST_ROOM);
    if at > latest {
        // The rate may be known badly.
        room.free_at = Some(latest);
    }
    at.min(latest)
}

/// A stream that is reset on drop, unless the client has all of it. Otherwise quinn would deliver a part of it as if
/// it were whole.
#[derive(Debug)]
struct FrameStream {
    stream: SendStream,
    /// The frame, until its first byte is written.
    first_of: Option<FrameId>,
}

impl FrameStream {
    /// Whether the client has all of it; `false` if it has stopped it or left.
    async fn is_delivered(&self) -> bool {
        match self.stream.stopped().await {
            Ok(None) => true,
            Ok(Some(code)) => code == transport::STOP_REPAIRED,
            Err(_) => false,
        }
    }

    /// A stream for something that is no frame.
    async fn open_whole(link: &ViewerLink, priority: i32) -> Result<Self, SessionClosed> {
        let stream = link.connection.open_uni().await.map_err(|_| SessionClosed)?;
        let _ = stream.set_priority(priority);
        Ok(Self { stream, first_of: None })
    }

    /// Writes a part of the stream when no frame is being written; returns whether the client still takes it.
    async fn write_behind(&mut self, link: &ViewerLink, part: &[u8]) -> Result<bool, SessionClosed> {
        // Priorities only order what is in quinn's window, so frames must enter it first. A piece goes out now and
        // then all the same, or a viewer that never rests would wait for ever.
        let mut writing = link.num_writing.subscribe();
        let _ = tokio::time::timeout(PATIENCE_BEHIND, writing.wait_for(|num| *num == 0)).await;
        self.write_part(link, part).await
    }

    /// Writes a part of the stream; returns whether the client still takes it.
    async fn write_part(&mut self, link: &ViewerLink, bytes: &[u8]) -> Result<bool, SessionClosed> {
        // Writing in pieces lets the window follow the congestion window during a long frame.
        for piece in bytes.chunks(PIECE) {
            let now = Instant::now();
            let at = link.pace().take(now, piece.len());
            // Even a sleep until now would last to the next tick of tokio's clock, a millisecond.
            if at > now {
                tokio::time::sleep_until(at).await;
            }
            link.connection.set_send_window(link.connection.stats().path.cwnd + SLACK);
            match self.stream.write_all(piece).await {
                Ok(()) => {
                    if let Some(frame) = self.first_of.take() {
                        link.journal.stamp(frame, Stage::FirstByteSent);
                    }
                }
                Err(WriteError::Stopped(_)) => return Ok(false),
                Err(_) => return Err(SessionClosed),
            }
        }
        Ok(true)
    }
}

impl Drop for FrameStream {
    fn drop(&mut self) {
        let _ = self.stream.reset(transport::RESET_SUPERSEDED);
    }
}

/// Delays writes so that they keep to a rate over any time longer than [`BURST`].
#[derive(Debug, Default)]
pub(super) struct Pace {
    bytes_per_second: Option<f64>,
    /// When everything taken has left at this rate.
    free_at: Option<Instant>,
}

impl Pace {
    /// Takes room for this many bytes, and returns when they may be written.
    fn take(&mut self, now: Instant, bytes: usize) -> Instant {
        let Some(rate) = self.bytes_per_second else { return now };
        let earliest = now.checked_sub(BURST).unwrap_or(now);
        let from = self.free_at.map_or(earliest, |at| at.max(earliest));
        let until = from + Duration::from_secs_f64((bytes as f64 / rate).min(MAX_WAIT_SECONDS));
        self.free_at = Some(until);
        until.max(now)
    }
}

/// Frames that share the rate of a link, for an estimate of their parity.
const USUAL_FRAMES_PER_SECOND: f64 = 60.0;
const USUAL_PACKET_BYTES: usize = 1200;
/// The share of a lossy link that frames of a moving camera and their parity fill. On a full link, each frame would
/// wait for the ones before it.
const MOST_FILLED: f64 = 0.94;
const LONGEST_ROOM: Duration = Duration::from_millis(100);
/// What may leave at once after a pause, as time at the rate: half a frame at 30 a second.
const BURST: Duration = Duration::from_millis(16);
/// Bounds the wait where a rate is absurdly small.
const MAX_WAIT_SECONDS: f64 = 60.0;
/// Bytes per write. quinn frees their window when all of them are acknowledged. With much more, a sender that fills
/// the window looks idle in between, and the congestion window does not grow.
const PIECE: usize = 4_000;
/// Longest wait of a screenshot or of a slice ahead for frames, before its next piece goes out all the same.
const PATIENCE_BEHIND: Duration = Duration::from_millis(250);
/// Bytes that may wait beyond the congestion window, so that a blocked sender never looks idle: quinn does not widen
/// the congestion window of an idle one. Waiting bytes are older than what could be made in their place. With 32 kB,
/// frames are twice as old where packets are lost.
const SLACK: u64 = 4_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_holds_after_its_burst() {
        let now = Instant::now();
        let mut pace = Pace { bytes_per_second: Some(1e6), free_at: None };
        let last = (0..100).map(|_| pace.take(now, PIECE)).last().unwrap_or(now);
        // 400 kB at 1 MB/s, less the burst.
        assert_eq!((last - now).as_millis(), 400 - BURST.as_millis());
        // A pause is worth no more than the burst.
        let later = now + Duration::from_secs(60);
        for _ in 0..4 {
            assert_eq!(pace.take(later, PIECE), later);
        }
        assert_eq!((pace.take(later, PIECE) - later).as_millis(), 4);
        // The control: without a rate nothing waits.
        let mut free = Pace::default();
        assert_eq!((0..100).map(|_| free.take(now, PIECE)).last(), Some(now));
    }
}
