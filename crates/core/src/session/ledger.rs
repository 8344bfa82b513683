//! The ledger: when each frame reached each stage of its life, and which frames were given up.
//!
//! Server and client each keep a ledger on their own clock; the frame number connects the two. Their stamps are never
//! mixed, except within one process, where both use one clock ([`Life::joined`]).

use std::collections::VecDeque;

use crate::ids::{FrameId, PoseId};

/// A stage of a frame's life, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stage {
    /// The client set the pose that the frame answers.
    Asked,
    /// The server began to generate it.
    Begun,
    /// The server has generated it.
    Generated,
    /// The coder began with it.
    CodingBegun,
    /// The coder has finished it.
    Coded,
    /// The network has its first byte.
    FirstByteSent,
    /// The network has its last byte.
    LastByteSent,
    /// Its first byte has arrived.
    FirstByteReceived,
    /// All of it has arrived.
    Received,
    /// The decoder began with it.
    DecodingBegun,
    /// It is decoded.
    Decoded,
    /// It appeared on the screen for the first time.
    Shown,
}

impl Stage {
    /// All stages, in order.
    pub const ALL: [Self; 12] = [
        Self::Asked,
        Self::Begun,
        Self::Generated,
        Self::CodingBegun,
        Self::Coded,
        Self::FirstByteSent,
        Self::LastByteSent,
        Self::FirstByteReceived,
        Self::Received,
        Self::DecodingBegun,
        Self::Decoded,
        Self::Shown,
    ];

    /// The name that people see.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Asked => "asked",
            Self::Begun => "generation begun",
            Self::Generated => "generated",
            Self::CodingBegun => "coding begun",
            Self::Coded => "coded",
            Self::FirstByteSent => "first byte sent",
            Self::LastByteSent => "last byte sent",
            Self::FirstByteReceived => "first byte received",
            Self::Received => "received",
            Self::DecodingBegun => "decoding begun",
            Self::Decoded => "decoded",
            Self::Shown => "first shown",
        }
    }
}

/// One frame's life, with stamps in µs on the clock of the side that keeps it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Life {
    /// The connection, from 1; frame numbers start again with each.
    pub connection: u32,
    /// The frame.
    pub frame: FrameId,
    /// The pose it answers.
    pub pose: PoseId,
    /// Bytes of its chunks that were sent or have arrived.
    pub bytes: u64,
    /// Whether work on it stopped before its end.
    pub is_given_up: bool,
    stamps: [Option<u64>; Stage::ALL.len()],
}

impl Life {
    /// A life without stamps.
    pub fn new(frame: FrameId, pose: PoseId) -> Self {
        Self { frame, pose, ..Self::default() }
    }

    /// When a stage was reached, µs.
    pub fn at(&self, stage: Stage) -> Option<u64> {
        self.stamps[stage as usize]
    }

    /// The same life with one more stage.
    #[must_use]
    pub fn with(mut self, stage: Stage, now_micros: u64) -> Self {
        self.stamp(stage, now_micros);
        self
    }

    /// The last stage that it has reached.
    pub fn last_stage(&self) -> Option<Stage> {
        Stage::ALL.into_iter().rev().find(|stage| self.at(*stage).is_some())
    }

    /// Joins this side's part of a life with the `other` side's, on one clock. This side's stamps win.
    #[must_use]
    pub fn joined(mut self, other: &Self) -> Self {
        for (own, others) in self.stamps.iter_mut().zip(other.stamps) {
            *own = own.or(others);
        }
        self.bytes = self.bytes.max(other.bytes);
        self.is_given_up |= other.is_given_up;
        self
    }

    /// Sets a stage's stamp unless it is set.
    fn stamp(&mut self, stage: Stage, now_micros: u64) {
        self.stamps[stage as usize].get_or_insert(now_micros);
    }
}

/// The lives of recent frames. Call `handle_connected` for each connection, `open` for each frame, then `stamp` and
/// `give_up`. Calls for unknown or forgotten frames do nothing.
#[derive(Clone, Debug, Default)]
pub struct Ledger {
    connection: u32,
    lives: VecDeque<Life>,
}

impl Ledger {
    /// A connection is up: frame numbers start again.
    pub fn handle_connected(&mut self) {
        self.connection += 1;
    }

    /// Number of the connection, from 1.
    pub fn connection(&self) -> u32 {
        self.connection
    }

    /// Begins a frame's life on this connection and forgets the oldest one.
    pub fn open(&mut self, life: Life) {
        if self.lives.len() == MAX_LIVES {
            self.lives.pop_front();
        }
        self.lives.push_back(Life { connection: self.connection, ..life });
    }

    /// A frame has reached a stage.
    pub fn stamp(&mut self, now_micros: u64, frame: FrameId, stage: Stage) {
        if let Some(life) = self.get_mut(frame) {
            life.stamp(stage, now_micros);
        }
    }

    /// Work on the frame has stopped.
    pub fn give_up(&mut self, frame: FrameId) {
        if let Some(life) = self.get_mut(frame) {
            life.is_given_up = true;
        }
    }

    /// Adds to the bytes of a frame.
    pub fn add_bytes(&mut self, frame: FrameId, bytes: u64) {
        if let Some(life) = self.get_mut(frame) {
            life.bytes += bytes;
        }
    }

    /// The life of a frame of this connection.
    pub fn get(&self, frame: FrameId) -> Option<&Life> {
        self.lives.iter().rev().find(|life| self.is(life, frame))
    }

    /// The lives, oldest first.
    pub fn iter(&self) -> impl Iterator<Item = &Life> {
        self.lives.iter()
    }

    fn get_mut(&mut self, frame: FrameId) -> Option<&mut Life> {
        let connection = self.connection;
        self.lives.iter_mut().rev().find(|life| life.connection == connection && life.frame == frame)
    }

    fn is(&self, life: &Life, frame: FrameId) -> bool {
        life.connection == self.connection && life.frame == frame
    }
}

/// Number of lives that are kept: four seconds' worth at 60 frames a second.
pub const MAX_LIVES: usize = 256;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_stamp_of_a_stage_counts_and_those_of_unknown_frames_do_nothing() {
        let mut ledger = Ledger::default();
        ledger.handle_connected();
        ledger.open(Life::new(FrameId(1), PoseId(7)).with(Stage::Asked, 3));
        ledger.stamp(10, FrameId(1), Stage::Generated);
        ledger.stamp(12, FrameId(1), Stage::Generated);
        ledger.stamp(12, FrameId(2), Stage::Generated);
        ledger.give_up(FrameId(2));
        ledger.add_bytes(FrameId(1), 5);
        ledger.add_bytes(FrameId(1), 6);
        let life = *ledger.get(FrameId(1)).unwrap();
        assert_eq!(
            (life.at(Stage::Asked), life.at(Stage::Generated), life.at(Stage::Coded)),
            (Some(3), Some(10), None)
        );
        assert_eq!((life.pose, life.bytes, life.is_given_up, life.connection), (PoseId(7), 11, false, 1));
        assert_eq!(life.last_stage(), Some(Stage::Generated));
        assert_eq!(ledger.get(FrameId(2)), None);
        ledger.give_up(FrameId(1));
        assert!(ledger.get(FrameId(1)).unwrap().is_given_up);
    }

    #[test]
    fn frames_of_another_connection_are_others() {
        let mut ledger = Ledger::default();
        ledger.handle_connected();
        ledger.open(Life::new(FrameId(1), PoseId(1)));
        ledger.handle_connected();
        assert_eq!(ledger.get(FrameId(1)), None);
        ledger.open(Life::new(FrameId(1), PoseId(9)));
        ledger.stamp(4, FrameId(1), Stage::Shown);
        let shown: Vec<_> = ledger.iter().map(|life| (life.connection, life.at(Stage::Shown))).collect();
        assert_eq!(shown, [(1, None), (2, Some(4))]);
    }

    #[test]
    fn memory_is_bounded() {
        let mut ledger = Ledger::default();
        for n in 0..10 * MAX_LIVES as u32 {
            ledger.open(Life::new(FrameId(n), PoseId(n)));
        }
        assert_eq!(ledger.iter().count(), MAX_LIVES);
        assert!(ledger.get(FrameId(0)).is_none() && ledger.get(FrameId(10 * MAX_LIVES as u32 - 1)).is_some());
    }

    #[test]
    fn two_sides_make_one_life() {
        let server = Life::new(FrameId(3), PoseId(1)).with(Stage::Generated, 20).with(Stage::Coded, 30);
        let client = Life { bytes: 9, ..Life::new(FrameId(3), PoseId(1)) }
            .with(Stage::Asked, 5)
            .with(Stage::Coded, 99);
        let whole = server.joined(&client);
        let stamps =
            [Stage::Asked, Stage::Generated, Stage::Coded, Stage::Shown].map(|stage| whole.at(stage));
        assert_eq!((stamps, whole.bytes), ([Some(5), Some(20), Some(30), None], 9));
        // In the order of their numbers, so that the last one is the furthest.
        assert!(Stage::ALL.windows(2).all(|w| w[0] < w[1]));
    }
}
