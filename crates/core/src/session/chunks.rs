//! The chunks of frames in flight: which ones the server sends or gives up, and which ones the client decodes.
//!
//! A stream carries the chunks of one frame; see [`crate::codec`]. A frame can be decoded when all of them are there.
//! On a slow link, dropping every superseded frame would deliver nothing: a newer frame would cancel each one just
//! before its end. So the server drops a frame only when the client is known to have a newer one.
//!
//! The client assembles at most [`MAX_ASSEMBLING`] frames of [`MAX_ASSEMBLING_BYTES`] in total; a newer frame evicts
//! the oldest. A complete frame ends the older ones. Decoding never returns to an older frame, except to one that other
//! frames may be predicted from. A predicted frame waits for its reference.

use std::collections::{BTreeMap, VecDeque};

use super::ledger::{Ledger, Life, Stage};
use crate::codec::MAX_CHUNKS;
use crate::codec::blocks::MAX_REFERENCES;
use crate::ids::{ChunkIndex, FrameId, PoseId};

/// The place of a chunk, from its own header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ChunkPlace {
    /// The frame.
    pub frame: FrameId,
    /// The pose that the frame answers.
    pub pose: PoseId,
    /// Position of the chunk in the frame.
    pub index: ChunkIndex,
    /// Number of chunks in the frame, 1 to [`MAX_CHUNKS`].
    pub num_chunks: u16,
    /// How the frame takes part in prediction; `None` if no frame is predicted from it.
    pub prediction: Option<Prediction>,
}

/// How a frame takes part in prediction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Prediction {
    /// The frame that must be decoded first.
    pub reference: Option<FrameId>,
}

/// The reason why a chunk cannot be used.
#[derive(Clone, Copy, Debug, thiserror::Error, PartialEq, Eq)]
pub enum ChunkError {
    /// The numbers in its header contradict each other.
    #[error("frame {}: chunk {} of {}, expected at most {MAX_CHUNKS}", .0.frame, .0.index, .0.num_chunks)]
    Place(ChunkPlace),
    /// Its header contradicts that of an earlier chunk.
    #[error("frame {0}: chunks disagree about the frame")]
    Disagree(FrameId),
    /// The chunk has already arrived.
    #[error("frame {0}: chunk {1} arrived twice")]
    Twice(FrameId, ChunkIndex),
    /// The frame exceeds [`MAX_FRAME_BYTES`].
    #[error("frame {0}: more than {MAX_FRAME_BYTES} bytes")]
    TooLong(FrameId),
}

/// A frame to decode now.
#[derive(Debug)]
pub struct DecodeJob {
    /// Its connection; see [`ChunksClient::handle_connected`].
    pub connection: u32,
    /// The frame.
    pub frame: FrameId,
    /// All its chunks, in any order.
    pub chunks: Vec<Vec<u8>>,
}

/// The client's half for one viewer; it outlives connections.
///
/// Call `handle_connected` for each new connection, `handle_pose` for each new pose and `handle_chunk` for each
/// complete chunk. Then call `poll_decode` until it returns `None`, and `handle_decoded` or `handle_broken` after
/// each job. `now` must not run backwards.
#[derive(Debug, Default)]
pub struct ChunksClient {
    poses: VecDeque<(PoseId, u64)>,
    assembling: BTreeMap<FrameId, Assembling>,
    /// The newest frame that was ready to be decoded.
    newest: Option<FrameId>,
    /// The last frames of this connection that others can be predicted from.
    references: VecDeque<FrameId>,
    /// A future reference that is being decoded.
    coming: Option<FrameId>,
    /// Whether other frames can be predicted from the newest.
    is_predicting: bool,
    newest_decoded: Option<Life>,
    ledger: Ledger,
    decoded_at: VecDeque<u64>,
    /// Recent time to decode a list, ns.
    decode_nanos_per_list: f64,
}

#[derive(Debug)]
struct Assembling {
    place: ChunkPlace,
    chunks: Vec<Vec<u8>>,
    /// A bit for each chunk.
    arrived: u32,
    num_bytes: usize,
}

impl Assembling {
    /// Whether everything needed to decode it is there, its reference included.
    fn is_ready(&self, references: &VecDeque<FrameId>) -> bool {
        let named = self.place.prediction.and_then(|p| p.reference);
        self.is_complete() && named.is_none_or(|r| references.contains(&r))
    }

    fn is_complete(&self) -> bool {
        self.arrived.count_ones() == u32::from(self.place.num_chunks)
    }
}

impl ChunksClient {
    /// A new connection is up. Frame numbers start again, and undecoded chunks are lost.
    pub fn handle_connected(&mut self) {
        self.ledger.handle_connected();
        self.assembling.clear();
        self.references.clear();
        self.coming = None;
        self.newest = None;
        self.is_predicting = false;
    }

    /// Number of the connection, from 1.
    pub fn connection(&self) -> u32 {
        self.ledger.connection()
    }

    /// Notes a new pose. A repeated pose is ignored.
    pub fn handle_pose(&mut self, now_micros: u64, pose: PoseId) {
        if self.poses.back().is_some_and(|(newest, _)| *newest == pose) {
            return;
        }
        if self.poses.len() == MAX_POSES {
            self.poses.pop_front();
        }
        self.poses.push_back((pose, now_micros));
    }

    /// Whether a chunk of this frame can still be useful; `is_predicting` if others can be predicted from the frame.
    pub fn wants(&self, frame: FrameId, is_predicting: bool) -> bool {
        let is_new = self.newest.is_none_or(|newest| frame >= newest);
        // Later frames may refer to it although the newest has overtaken it.
        let is_late = is_predicting
            && !self.is_predicting
            && self.references.iter().chain(&self.coming).all(|decoded| frame > *decoded);
        (is_new || is_late)
            && (self.assembling.len() < MAX_ASSEMBLING
                || self.assembling.keys().next().is_some_and(|o| frame >= *o))
    }

    /// A complete chunk has arrived; `first_byte_micros` is the arrival of its first byte. Late chunks are dropped
    /// silently.
    ///
    /// # Errors
    /// If the chunk contradicts itself or others. The connection can go on.
    pub fn handle_chunk(
        &mut self,
        now_micros: u64,
        first_byte_micros: u64,
        place: ChunkPlace,
        bytes: Vec<u8>,
    ) -> Result<(), ChunkError> {
        let ChunkPlace { frame, index, num_chunks, .. } = place;
        if usize::from(num_chunks) > MAX_CHUNKS || index.0 >= num_chunks {
            return Err(ChunkError::Place(place));
        }
        if !self.wants(frame, place.prediction.is_some()) {
            return Ok(());
        }
        if !self.assembling.contains_key(&frame) {
            match self.ledger.get(frame).map(|life| life.at(Stage::Received).is_some()) {
                Some(true) => return Err(ChunkError::Twice(frame, index)),
                // Its earlier chunks were evicted and are not sent again, so it can never be complete.
                Some(false) => return Ok(()),
                None => {}
            }
            if self.assembling.len() == MAX_ASSEMBLING {
                self.drop_oldest();
            }
            self.assembling.insert(frame, Assembling { place, chunks: vec![], arrived: 0, num_bytes: 0 });
            self.open_ledger(first_byte_micros, place);
        }
        let Some(a) = self.assembling.get_mut(&frame) else { return Ok(()) };
        let same = ChunkPlace { index, ..a.place };
        if same != place {
            return Err(ChunkError::Disagree(frame));
        }
        if a.arrived & 1 << index.0 != 0 {
            return Err(ChunkError::Twice(frame, index));
        }
        if a.num_bytes + bytes.len() > MAX_FRAME_BYTES {
            return Err(ChunkError::TooLong(frame));
        }
        a.arrived |= 1 << index.0;
        a.num_bytes += bytes.len();
        self.ledger.add_bytes(frame, bytes.len() as u64);
        a.chunks.push(bytes);
        if a.is_complete() {
            self.ledger.stamp(now_micros, frame, Stage::Received);
            self.choose();
        }
        while self.assembling.values().map(|a| a.num_bytes).sum::<usize>() > MAX_ASSEMBLING_BYTES {
            self.drop_oldest();
        }
        Ok(())
    }

    /// Whether an older frame that others can be predicted from can still be decoded once it is complete.
    fn is_reference_coming(&self, frame: FrameId) -> bool {
        if self.coming.is_some_and(|coming| coming < frame) {
            return true;
        }
        let mut coming = Vec::with_capacity(MAX_ASSEMBLING);
        for (&id, a) in self.assembling.range(..frame) {
            let Some(Prediction { reference }) = a.place.prediction else { continue };
            if reference.is_none_or(|r| self.references.contains(&r) || coming.contains(&r)) {
                coming.push(id);
            }
        }
        !coming.is_empty()
    }

    /// Ends the frames before the newest decodable one. A frame that predicts nothing waits for older references,
    /// because later frames may refer to them.
    fn choose(&mut self) {
        let can_be_next = |(frame, a): &(&FrameId, &Assembling)| {
            a.is_ready(&self.references)
                && (a.place.prediction.is_some() || !self.is_reference_coming(**frame))
        };
        let ready = self.assembling.iter().rev().find(can_be_next);
        let Some((&frame, assembling)) = ready else { return };
        if self.newest.is_some_and(|newest| frame <= newest) {
            return;
        }
        self.is_predicting = assembling.place.prediction.is_some();
        let newer = self.assembling.split_off(&frame);
        for (old, _) in std::mem::replace(&mut self.assembling, newer) {
            self.ledger.give_up(old);
        }
        self.newest = Some(frame);
    }

    fn drop_oldest(&mut self) {
        if let Some((oldest, _)) = self.assembling.pop_first() {
            self.ledger.give_up(oldest);
        }
    }

    /// Returns the next job: the newest frame, or a reference that it has overtaken.
    pub fn poll_decode(&mut self, now_micros: u64) -> Option<DecodeJob> {
        let frame = self.next()?;
        let Assembling { place, chunks, .. } = self.assembling.remove(&frame)?;
        self.coming = place.prediction.map(|_| frame);
        self.ledger.stamp(now_micros, frame, Stage::DecodingBegun);
        Some(DecodeJob { connection: self.connection(), frame, chunks })
    }

    fn next(&self) -> Option<FrameId> {
        let newest = self.newest?;
        if let Some(a) = self.assembling.get(&newest) {
            return a.is_ready(&self.references).then_some(newest);
        }
        if self.is_predicting || self.coming.is_some() {
            return None;
        }
        let is_late = |a: &Assembling| a.place.prediction.is_some() && a.is_ready(&self.references);
        self.assembling.range(..newest).find(|(_, a)| is_late(a)).map(|(frame, _)| *frame)
    }

    /// A frame is decoded. Returns its life if the picture may be shown: it belongs to this connection and is newer
    /// than the previous one.
    pub fn handle_decoded(&mut self, now_micros: u64, connection: u32, frame: FrameId) -> Option<Life> {
        if connection != self.connection() {
            return None;
        }
        if self.coming.take_if(|coming| *coming == frame).is_some() {
            if self.references.len() == MAX_REFERENCES {
                self.references.pop_front();
            }
            self.references.push_back(frame);
            self.choose();
        }
        if self.newest_decoded.is_some_and(|t| t.connection == connection && t.frame > frame) {
            return None;
        }
        self.ledger.stamp(now_micros, frame, Stage::Decoded);
        if self.decoded_at.len() == MAX_RATE_SAMPLES {
            self.decoded_at.pop_front();
        }
        self.decoded_at.push_back(now_micros);
        self.newest_decoded = Some(*self.ledger.get(frame)?);
        self.newest_decoded
    }

    /// A frame could not be decoded and is given up.
    pub fn handle_broken(&mut self, connection: u32, frame: FrameId) {
        if connection == self.connection() {
            self.ledger.give_up(frame);
            self.coming.take_if(|coming| *coming == frame);
            if self.newest == Some(frame) {
                self.newest = self.newest_decoded.filter(|t| t.connection == connection).map(|t| t.frame);
            }
            // Other frames may have waited for it.
            self.choose();
        }
    }

    /// Notes the time to decode `num_lists` lists.
    pub fn handle_decode_time(&mut self, micros: u64, num_lists: usize) {
        let nanos = micros as f64 * 1e3 / num_lists.max(1) as f64;
        let before = self.decode_nanos_per_list;
        self.decode_nanos_per_list =
            if before == 0.0 { nanos } else { before + DECODE_GAIN * (nanos - before) };
    }

    /// Recent decoding time for the next pose datagram, ns per list; 0 if unknown.
    pub fn decode_nanos_per_list(&self) -> u16 {
        self.decode_nanos_per_list as u16
    }

    /// A frame is on the screen.
    pub fn handle_shown(&mut self, now_micros: u64, frame: FrameId) {
        self.ledger.stamp(now_micros, frame, Stage::Shown);
    }

    /// The newest complete frame, for the next pose datagram. With prediction, the newest decoded frame.
    pub fn newest_complete(&self) -> Option<FrameId> {
        if self.is_predicting { self.references.back().copied() } else { self.newest }
    }

    /// Number of frames decoded in the last second.
    pub fn frames_per_second(&self, now_micros: u64) -> u32 {
        self.decoded_at.iter().filter(|&&t| t + 1_000_000 > now_micros).count() as u32
    }

    /// The lives of recent frames.
    pub fn ledger(&self) -> &Ledger {
        &self.ledger
    }

    fn open_ledger(&mut self, first_byte: u64, place: ChunkPlace) {
        let life = Life::new(place.frame, place.pose).with(Stage::FirstByteReceived, first_byte);
        let asked = self.poses.iter().rev().find(|(p, _)| *p == place.pose).map(|(_, t)| *t);
        self.ledger.open(match asked {
            Some(asked) => life.with(Stage::Asked, asked),
            None => life,
        });
    }
}

/// The server's half: which frames are still worth sending.
///
/// Call `handle_handed` before a frame is written, `handle_delivered` when all of it is acknowledged, and
/// `handle_report` for each pose datagram. Check `is_superseded` after the last two.
#[derive(Clone, Debug, Default)]
pub struct ChunksServer {
    handed: FrameId,
    complete: FrameId,
    reported: FrameId,
}

impl ChunksServer {
    /// A frame is about to be written.
    pub fn handle_handed(&mut self, frame: FrameId) {
        self.handed = self.handed.max(frame);
    }

    /// The client has a whole frame. A client that claims frames it never got gains nothing.
    pub fn handle_delivered(&mut self, frame: FrameId) {
        self.complete = self.complete.max(frame.min(self.handed));
    }

    /// A pose datagram names the newest complete frame; `is_newest` unless a newer datagram has overtaken it.
    pub fn handle_report(&mut self, newest_complete: FrameId, is_newest: bool) {
        self.handle_delivered(newest_complete);
        if is_newest {
            self.reported = newest_complete.min(self.handed);
        }
    }

    /// Whether a frame is no longer worth sending, because the client has a newer one.
    pub fn is_superseded(&self, frame: FrameId) -> bool {
        self.complete > frame
    }

    /// The newest frame according to the client's newest pose; 0 for none. With prediction, the client has decoded
    /// it.
    pub fn reported(&self) -> FrameId {
        self.reported
    }

    /// The newest frame that the client has; 0 for none.
    pub fn newest_complete(&self) -> FrameId {
        self.complete
    }
}

/// The role of a frame in relation to others.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rank {
    /// Later frames may be predicted from it and wait for it at the client.
    Predicting,
    /// No frame is predicted from it.
    Independent,
    /// The same, and it repeats the previous frame with a finer coding.
    Finer,
}

/// Priority of a frame's stream. The rank decides first. Older frames come first among predicting ones, and newer frames
/// among others. The control stream has [`CONTROL_PRIORITY`].
///
/// Frame numbers are taken modulo 2²⁵, six days at 60 frames a second, so that ranks never mix.
pub fn priority(frame: FrameId, rank: Rank) -> i32 {
    let newer_first = (frame.0 & FRAMES) as i32;
    let (rank, frame) = match rank {
        Rank::Predicting => (2, FRAMES as i32 - newer_first),
        Rank::Independent => (1, newer_first),
        Rank::Finer => (0, newer_first),
    };
    rank * PER_RANK + frame
}

/// Most frames in reassembly: half a second of predicted frames at 60 Hz, while a lost packet of the first is sent
/// again.
pub const MAX_ASSEMBLING: usize = 32;
/// Most bytes of chunks in reassembly.
pub const MAX_ASSEMBLING_BYTES: usize = 256 << 20;
/// Most bytes in one frame's chunks: half of the largest picture with full lists, unpacked.
pub const MAX_FRAME_BYTES: usize = 192 << 20;
/// Weight of the newest decoding time in the mean.
const DECODE_GAIN: f64 = 0.25;
/// Poses whose time is remembered: four seconds' worth, longer than any round trip.
const MAX_POSES: usize = 512;
/// Number of times that give the frame rate, and so the highest displayed rate.
const MAX_RATE_SAMPLES: usize = 512;
/// A slice that somebody looks at goes before every chunk, so that paging feels local. The picture waits meanwhile.
pub const SLICE_PRIORITY: i32 = i32::MAX - 1;
/// A slice that is fetched ahead goes after every chunk, but before a screenshot.
pub const SLICE_AHEAD_PRIORITY: i32 = -1;
/// A screenshot goes after everything else.
pub const SCREENSHOT_PRIORITY: i32 = -2;
/// Control messages go before every chunk.
pub const CONTROL_PRIORITY: i32 = i32::MAX;
/// Frame numbers that priorities distinguish.
const FRAMES: u32 = 0x01ff_ffff;
/// Number of priorities per rank.
const PER_RANK: i32 = 1 << 25;

#[cfg(test)]
mod tests;
