//! The server's side of a connection: newest pose wins, and newest frame wins without starving.
//!
//! A frame is a *base*, which can be shown alone, and *refinements*. If every superseded chunk were dropped, a link
//! slower than the offer would deliver nothing: each frame would be cancelled just before it is through. So
//! - a base is dropped only when a *newer base is known to be complete* at the client;
//! - refinements are dropped the moment a newer base is handed over.

use super::bucket::Bucket;
use crate::ids::{ChunkIndex, FrameId, PoseId};
use crate::look::Look;
use crate::wire::control::ControlError;
use crate::wire::{
    ClientMessage, ClientStats, Part, PoseError, PoseRequest, ProbeRequest, Refusal, ShotRequest,
};

/// State of one admitted connection.
///
/// Call `handle_datagram` and `handle_message` for what arrives, `handle_base_handed` before the base of a frame is
/// written, `handle_base_delivered` when all of it is acknowledged; ask `is_superseded` after any of these.
#[derive(Clone, Debug)]
pub struct Session {
    newest_pose: PoseId,
    handed: FrameId,
    complete: FrameId,
    reported: FrameId,
    poses: Bucket,
    messages: Bucket,
}

/// What a client asks for on the control stream.
#[derive(Clone, Debug, PartialEq)]
pub enum Request {
    /// Another look.
    SetLook(Look),
    /// How the client fares.
    Stats(ClientStats),
    /// The client leaves.
    Bye,
    /// Another part of the file.
    OpenPart(Part),
    /// No other part any more.
    CancelPart,
    /// The value at a point.
    Probe(ProbeRequest),
    /// A picture to keep.
    Shoot(ShotRequest),
    /// The picture is no longer wanted.
    CancelShot,
}

impl Session {
    /// A session that was admitted now.
    pub fn new(now_micros: u64) -> Self {
        Self {
            newest_pose: PoseId(0),
            handed: FrameId(0),
            complete: FrameId(0),
            reported: FrameId(0),
            poses: Bucket::new(MAX_POSES_PER_SECOND, now_micros),
            messages: Bucket::new(MAX_MESSAGES_PER_SECOND, now_micros),
        }
    }

    /// A datagram has arrived. The pose in it, if it is newer than all before and within the rate.
    ///
    /// # Errors
    /// If the datagram is not a pose; the connection can go on.
    pub fn handle_datagram(
        &mut self,
        now_micros: u64,
        bytes: &[u8],
    ) -> Result<Option<PoseRequest>, PoseError> {
        if !self.poses.take(now_micros) {
            return Ok(None);
        }
        let request = PoseRequest::decode(bytes)?;
        if let Some(frame) = request.newest_complete {
            self.handle_base_delivered(frame);
            if request.id >= self.newest_pose {
                self.reported = frame.min(self.handed);
            }
        }
        if request.id <= self.newest_pose {
            return Ok(None);
        }
        self.newest_pose = request.id;
        Ok(Some(request))
    }

    /// Whether one more message may be handled now. If not, it has to wait, and those behind it in the stream: many come at
    /// once where the network has stood still, which is not their sender's fault.
    pub fn takes_message(&mut self, now_micros: u64) -> bool {
        self.messages.take(now_micros)
    }

    /// A control message has arrived after the hello.
    ///
    /// # Errors
    /// If the client must be sent away for it.
    pub fn handle_message(&self, body: &[u8]) -> Result<Request, Refusal> {
        match crate::wire::control::decode(body).map_err(|e| violation(&e))? {
            ClientMessage::SetLook(look) => Ok(Request::SetLook(look)),
            ClientMessage::Stats(stats) => Ok(Request::Stats(stats)),
            ClientMessage::Bye => Ok(Request::Bye),
            ClientMessage::OpenPart(part) => Ok(Request::OpenPart(part)),
            ClientMessage::CancelPart => Ok(Request::CancelPart),
            ClientMessage::Probe(probe) => Ok(Request::Probe(probe)),
            ClientMessage::Shoot(shot) => Ok(Request::Shoot(shot)),
            ClientMessage::CancelShot => Ok(Request::CancelShot),
            ClientMessage::Hello { .. } => Err(Refusal::Protocol("a second hello".into())),
        }
    }

    /// The base of a frame is about to be written.
    pub fn handle_base_handed(&mut self, frame: FrameId) {
        self.handed = self.handed.max(frame);
    }

    /// The client has all of a frame's base. A client that claims frames it was never sent gains nothing.
    pub fn handle_base_delivered(&mut self, frame: FrameId) {
        self.complete = self.complete.max(frame.min(self.handed));
    }

    /// Whether a chunk is not worth its bytes any more.
    pub fn is_superseded(&self, frame: FrameId, is_base: bool) -> bool {
        if is_base { self.complete > frame } else { self.handed > frame }
    }

    /// The frame that the client's newest pose named as its newest; 0 for none. Where frames are predicted from each
    /// other, the client has decoded it.
    pub fn reported(&self) -> FrameId {
        self.reported
    }

    /// The newest frame whose base the client has; 0 for none.
    pub fn newest_complete(&self) -> FrameId {
        self.complete
    }
}

/// What a client is told that sent something unreadable.
pub fn violation(error: &ControlError) -> Refusal {
    Refusal::Protocol(crate::wire::control::one_line(&error.to_string()))
}

/// What a chunk is to the frames beside its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rank {
    /// Later frames may be predicted from it: those wait at the client until it is there.
    Predicting,
    /// It is a picture by itself, or the base of one.
    Base,
    /// It makes a picture finer.
    Refinement,
}

/// Priority of a chunk's stream: what others may be predicted from before any base, that before any refinement. Of the first older
/// frames come first, of the others newer ones; within a frame it goes by index. The control stream has [`CONTROL_PRIORITY`].
///
/// Frame numbers are taken modulo 2²⁵, six days at 60 frames a second, so that the bands never meet.
pub fn priority(frame: FrameId, index: ChunkIndex, rank: Rank) -> i32 {
    let newer_first = (frame.0 & FRAMES) as i32;
    let (band, frame) = match rank {
        Rank::Predicting => (2, FRAMES as i32 - newer_first),
        Rank::Base => (1, newer_first),
        Rank::Refinement => (0, newer_first),
    };
    // The last of them is the control stream's.
    band * BAND + (frame << 4) + 14 - i32::from(index.0.min(14))
}

/// Below every chunk: a picture to keep waits for what is looked at.
pub const SHOT_PRIORITY: i32 = -1;
/// Above every chunk.
pub const CONTROL_PRIORITY: i32 = i32::MAX;
/// Pose datagrams read per second. Clients send at most 120; twice that leaves room for bunching.
pub const MAX_POSES_PER_SECOND: u32 = 240;
/// Control messages handled per second.
pub const MAX_MESSAGES_PER_SECOND: u32 = 100;
/// After so long one more may be handled, µs.
pub const MESSAGE_WAIT_MICROS: u64 = 1_000_000 / MAX_MESSAGES_PER_SECOND as u64;
/// Frame numbers that priorities tell apart.
const FRAMES: u32 = 0x01ff_ffff;
/// Priorities of a rank.
const BAND: i32 = 1 << 29;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Intrinsics, Pose};
    use glam::Vec3;

    fn datagram(id: u32, newest_complete: Option<FrameId>) -> Vec<u8> {
        let pose = Pose::orbit(Vec3::ZERO, 0.1 * id as f32, 0.0, 3.0);
        let intrinsics = Intrinsics::perspective(8, 8, 0.5);
        PoseRequest {
            id: PoseId(id),
            stamp_micros: 0,
            pose,
            intrinsics,
            newest_complete,
            shown_turn_deg: None,
            decode_nanos_per_list: 0,
        }
        .encode()
        .to_vec()
    }

    #[test]
    fn only_newer_poses_count() {
        let mut s = Session::new(0);
        let mut accepted = vec![];
        for id in [3, 1, 3, 2, 7, 5, 8] {
            accepted.extend(s.handle_datagram(0, &datagram(id, None)).unwrap().map(|p| p.id.0));
        }
        assert_eq!(accepted, [3, 7, 8]);
        assert!(s.handle_datagram(0, b"junk").is_err());
        assert!((0..1000).all(|_| s.handle_datagram(0, &datagram(1, None)).is_ok_and(|p| p.is_none())));
        assert!(matches!(s.handle_datagram(0, &datagram(9, None)), Ok(None)), "over the rate");
        assert!(matches!(s.handle_datagram(1_000_000, &datagram(9, None)), Ok(Some(_))));
    }

    #[test]
    fn a_base_outlives_newer_frames_until_one_of_them_is_complete() {
        let mut s = Session::new(0);
        for n in 1..100 {
            s.handle_base_handed(FrameId(n));
            assert!(!s.is_superseded(FrameId(1), true), "frame 1 is all that may ever arrive");
            assert_eq!(s.is_superseded(FrameId(1), false), n > 1);
            assert!(!s.is_superseded(FrameId(n), false));
        }
        s.handle_base_delivered(FrameId(40));
        for n in 1..100 {
            assert_eq!(s.is_superseded(FrameId(n), true), n < 40);
        }
    }

    #[test]
    fn a_claim_of_frames_never_sent_does_not_stop_the_newest() {
        let mut s = Session::new(0);
        s.handle_base_handed(FrameId(5));
        s.handle_datagram(0, &datagram(1, Some(FrameId(u32::MAX)))).unwrap();
        assert_eq!((s.newest_complete(), s.reported()), (FrameId(5), FrameId(5)));
        s.handle_base_handed(FrameId(6));
        assert!(!s.is_superseded(FrameId(6), true));
    }

    #[test]
    fn what_the_newest_pose_reports_may_go_back() {
        let mut s = Session::new(0);
        s.handle_base_handed(FrameId(9));
        for (id, named, reported) in [(2, 5, 5), (3, 7, 7), (1, 4, 7), (3, 6, 6), (4, 5, 5)] {
            s.handle_datagram(0, &datagram(id, Some(FrameId(named)))).unwrap();
            assert_eq!(s.reported(), FrameId(reported));
        }
        assert_eq!(s.newest_complete(), FrameId(7));
    }

    #[test]
    fn priorities_never_mix_ranks() {
        use Rank::{Base, Predicting, Refinement};
        for n in [1u32, 2, 1_000_000, 0x01ff_fffe] {
            let (old, new) = (FrameId(n), FrameId(n + 1));
            let p = |f, i, rank| priority(f, ChunkIndex(i), rank);
            assert!(p(new, 0, Base) > p(old, 0, Base));
            assert!(p(new, 15, Refinement) > p(old, 0, Refinement));
            assert!(p(old, 0, Base) > p(old, 1, Base));
            assert!(p(old, 15, Base) > p(new, 0, Refinement));
            assert!(p(FrameId(0), 15, Base) > p(FrameId(FRAMES), 0, Refinement));
            // What others wait for goes before them.
            assert!(p(old, 15, Predicting) > p(new, 0, Predicting));
            assert!(p(old, 0, Predicting) > p(old, 1, Predicting));
            assert!(p(FrameId(FRAMES), 15, Predicting) > p(FrameId(FRAMES), 0, Base));
            assert!(p(FrameId(0), 0, Predicting) < CONTROL_PRIORITY);
            assert!(p(FrameId(0), 15, Refinement) > SHOT_PRIORITY);
        }
    }

    #[test]
    fn a_second_hello_is_a_violation_and_a_flood_waits() {
        let mut s = Session::new(0);
        let t = || crate::wire::Token::new([0; 16]);
        let hello = crate::wire::control::encode(&crate::wire::control::hello(t(), t(), "x")).unwrap();
        assert!(matches!(s.handle_message(&hello[4..]), Err(Refusal::Protocol(_))));
        let bye = crate::wire::control::encode(&ClientMessage::Bye).unwrap();
        assert_eq!(s.handle_message(&bye[4..]), Ok(Request::Bye));
        assert_eq!((0..1000).filter(|_| s.takes_message(0)).count(), 100);
        assert!(s.takes_message(MESSAGE_WAIT_MICROS) && !s.takes_message(MESSAGE_WAIT_MICROS));
    }
}
