//! The pose that frames are made for: the viewer sends the predicted pose, and the server keeps the newest.
//!
//! The message is the datagram of [`crate::wire::PoseRequest`]. A lost datagram is not sent again: the newest pose is
//! repeated ten times a second. It also reports how the viewer copes with what it receives.

use super::bucket::Bucket;
use crate::camera::{Intrinsics, Pose};
use crate::ids::{FrameId, PoseId};
use crate::wire::{MAX_SHOWN_TURN_DEG, PoseError, PoseRequest};

/// The client's half: it numbers poses and says when a datagram is due.
#[derive(Debug, Default)]
pub struct PoseClient {
    newest: Option<PoseRequest>,
    shown_turn_deg: Option<u8>,
    /// The pose of the last datagram on this connection, and when it went out.
    sent: Option<(PoseId, u64)>,
}

/// The report in a datagram, beside the pose.
#[derive(Clone, Copy, Debug, Default)]
pub struct ReceiverReport {
    /// See [`PoseRequest::newest_complete`].
    pub newest_complete: Option<FrameId>,
    /// See [`PoseRequest::decode_nanos_per_list`].
    pub decode_nanos_per_list: u16,
}

impl PoseClient {
    /// Requests frames from this pose, unless it is the newest already. Returns the number of the newest pose.
    ///
    /// # Errors
    /// If the pose cannot be rendered. Then the previous one stays the newest.
    pub fn set(&mut self, now_micros: u64, pose: Pose, intrinsics: Intrinsics) -> Result<PoseId, PoseError> {
        let newest = self.newest.map_or(PoseId(0), |p| p.id);
        if self.newest.is_some_and(|p| p.pose == pose && p.intrinsics == intrinsics) {
            return Ok(newest);
        }
        let request = PoseRequest {
            id: newest.next(),
            stamp_micros: now_micros,
            ..PoseRequest::of_view(pose, intrinsics)
        };
        request.validate()?;
        self.newest = Some(request);
        Ok(request.id)
    }

    /// Sets the angle in degrees by which shown frames are turned. All later datagrams carry it.
    pub fn note_turn(&mut self, degrees: Option<f32>) {
        self.shown_turn_deg = degrees.map(|d| d.round().clamp(0.0, MAX_SHOWN_TURN_DEG.into()) as u8);
    }

    /// See [`PoseRequest::shown_turn_deg`].
    pub fn shown_turn_deg(&self) -> Option<u8> {
        self.shown_turn_deg
    }

    /// The newest pose.
    pub fn newest(&self) -> Option<&PoseRequest> {
        self.newest.as_ref()
    }

    /// A connection is up: nothing was sent over it.
    pub fn handle_welcome(&mut self) {
        self.sent = None;
    }

    /// The next datagram, if one is due.
    pub fn poll_datagram(&mut self, now_micros: u64, report: ReceiverReport) -> Option<PoseRequest> {
        if self.due()? > now_micros {
            return None;
        }
        let ReceiverReport { newest_complete, decode_nanos_per_list } = report;
        let shown_turn_deg = self.shown_turn_deg;
        let newest = self.newest?;
        self.sent = Some((newest.id, now_micros));
        Some(PoseRequest { newest_complete, decode_nanos_per_list, shown_turn_deg, ..newest })
    }

    /// When the next datagram is due, µs.
    pub fn due(&self) -> Option<u64> {
        let newest = self.newest.as_ref()?;
        let Some((sent, at)) = self.sent else { return Some(0) };
        Some(at + if sent == newest.id { REPEAT_MICROS } else { INTERVAL_MICROS })
    }
}

/// The server's half: the newest pose.
#[derive(Debug)]
pub struct PoseServer {
    newest: Option<PoseRequest>,
    is_new: bool,
    rate: Bucket,
}

impl PoseServer {
    /// Starts without a pose.
    pub fn new(now_micros: u64) -> Self {
        Self { newest: None, is_new: false, rate: Bucket::new(MAX_POSES_PER_SECOND, now_micros) }
    }

    /// A datagram has arrived. Returns its content unless it exceeds the rate, and whether its pose is the newest or
    /// repeats it.
    ///
    /// # Errors
    /// If it is not a pose; the connection can go on.
    pub fn handle_datagram(
        &mut self,
        now_micros: u64,
        bytes: &[u8],
    ) -> Result<Option<(PoseRequest, bool)>, PoseError> {
        if !self.rate.take(now_micros) {
            return Ok(None);
        }
        let request = PoseRequest::decode(bytes)?;
        let newest = self.newest.map_or(PoseId(0), |p| p.id);
        if request.id > newest {
            (self.newest, self.is_new) = (Some(request), true);
        }
        Ok(Some((request, request.id >= newest)))
    }

    /// The newest pose.
    pub fn newest(&self) -> Option<PoseRequest> {
        self.newest
    }

    /// The newest pose, if it was not polled before.
    pub fn poll_new(&mut self) -> Option<PoseRequest> {
        self.newest.filter(|_| std::mem::take(&mut self.is_new))
    }
}

/// Pose datagrams read per second. Clients send at most 120; twice that allows bursts.
pub const MAX_POSES_PER_SECOND: u32 = 240;
/// Time between datagrams of different poses: 120 a second.
const INTERVAL_MICROS: u64 = 8_300;
/// Time after which the newest pose is repeated. This replaces a lost one, acknowledges frames, and keeps timers
/// along the way awake.
const REPEAT_MICROS: u64 = 100_000;

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::session::pair::Pair;

    const VIEW: Intrinsics = Intrinsics::perspective(8, 8, 0.5);

    fn at(n: u32) -> Pose {
        Pose::orbit(Vec3::ZERO, 0.01 * n as f32, 0.0, 3.0)
    }

    #[test]
    fn the_newest_pose_arrives_whatever_is_lost() {
        for (loss, seed) in [(0.0, 1), (0.1, 2), (0.5, 3)] {
            let mut pair = Pair::new(120_000, loss, seed);
            for n in 1..=200 {
                let now = pair.now();
                assert_eq!(pair.client.pose.set(now, at(n), VIEW), Ok(PoseId(n)));
                pair.run(4_000);
                let heard: Vec<_> = pair.poses.iter().map(|p| p.id).collect();
                assert!(heard.is_sorted(), "an older pose never follows a newer one");
            }
            pair.run(3_000_000);
            let newest = pair.poses.last().unwrap();
            assert_eq!((newest.id, newest.pose), (PoseId(200), at(200)));
            assert!(pair.poses.len() <= 120, "800 ms have room for 97 poses: {}", pair.poses.len());
            assert_eq!(pair.num_datagrams_lost > 0, loss > 0.0, "the control: only a lossy link loses");
        }
    }

    #[test]
    fn a_datagram_goes_at_once_and_is_repeated_at_rest() {
        let mut client = PoseClient::default();
        let report = ReceiverReport::default();
        assert!(client.poll_datagram(0, report).is_none() && client.due().is_none());
        client.set(5, at(1), VIEW).unwrap();
        assert!(client.poll_datagram(5, report).is_some());
        client.set(10, at(2), VIEW).unwrap();
        assert_eq!(client.due(), Some(5 + INTERVAL_MICROS));
        assert!(client.poll_datagram(10, report).is_none());
        let now = 5 + INTERVAL_MICROS;
        client.note_turn(Some(500.0));
        let said = client.poll_datagram(now, report).unwrap();
        assert_eq!((said.id, said.stamp_micros, said.shown_turn_deg), (PoseId(2), 10, Some(180)));
        assert_eq!(client.set(now, at(2), VIEW), Ok(PoseId(2)), "the same is no new one");
        assert_eq!(client.due(), Some(now + REPEAT_MICROS));
        let broken = Pose { eye: Vec3::NAN, ..at(3) };
        assert!(client.set(now, broken, VIEW).is_err());
        assert_eq!(client.newest().map(|p| p.id), Some(PoseId(2)));
        client.handle_welcome();
        assert!(client.poll_datagram(now, report).is_some(), "another connection knows no pose");
    }

    #[test]
    fn only_newer_poses_count_and_only_within_the_rate() {
        let mut server = PoseServer::new(0);
        let datagram = |n| PoseRequest { id: PoseId(n), ..PoseRequest::of_view(at(n), VIEW) }.encode();
        let mut accepted = vec![];
        for n in [3, 1, 3, 2, 7, 5, 8] {
            server.handle_datagram(0, &datagram(n)).unwrap();
            accepted.extend(server.poll_new().map(|p| p.id.0));
        }
        assert_eq!(accepted, [3, 7, 8]);
        assert!(server.handle_datagram(0, b"junk").is_err());
        for _ in 0..1000 {
            server.handle_datagram(0, &datagram(1)).unwrap();
        }
        assert!(server.handle_datagram(0, &datagram(9)).unwrap().is_none(), "over the rate");
        assert!(server.handle_datagram(1_000_000, &datagram(9)).unwrap().is_some());
    }
}
