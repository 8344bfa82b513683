//! A viewer and a server that talk over a simulated link with delay, loss and reordering. The clock is simulated too,
//! so a test with the same seed always runs the same way.
//!
//! Messages arrive in order: a lost message and its successors arrive a round trip later. A lost datagram never
//! arrives, and datagrams may overtake each other. Each chunk arrives by itself.

use super::admission::ViewerId;
use super::chunks::{ChunkPlace, ChunksClient};
use super::client::ClientSession;
use super::pose::ReceiverReport;
use super::server::ServerSession;
use crate::cancel::ALWAYS;
use crate::ids::{ChunkIndex, FrameId, LookVersion, PoseId, ScreenshotId};
use crate::look::Look;
use crate::transfer::{ControlPoint, Domain, TransferFunction, UnitLength};
use crate::volume::procedural::Builtin;
use crate::volume::{Slice, Volume};
use crate::wire::control::{decode, encode};
use crate::wire::slice::{decode_slice, encode_slice, slice_id};
use crate::wire::{ClientMessage, Part, PoseRequest, ServerMessage, Token, VolumeDescription, Welcome};

/// A simulated pair. The server answers probes, confirms looks, and makes a frame of one chunk for each new pose and
/// look.
pub(crate) struct Pair {
    pub(crate) client: ClientSession,
    pub(crate) chunks: ChunksClient,
    /// None until the client is welcomed.
    pub(crate) server: Option<ServerSession>,
    link: Simulated,
    now: u64,
    frame: FrameId,
    answered: Option<(PoseId, LookVersion)>,
    volume: Volume,
    /// Poses that the server has polled.
    pub(crate) poses: Vec<PoseRequest>,
    pub(crate) num_datagrams_lost: usize,
    /// Number of probe answers and load messages at the client.
    pub(crate) num_answered: usize,
    pub(crate) num_loads_heard: usize,
    /// Number of slices that the server has sent.
    pub(crate) num_slices: usize,
    /// Requested parts of the file.
    pub(crate) orders: Vec<Option<Part>>,
    /// Requested screenshots, and the look in force.
    pub(crate) shots: Vec<(ScreenshotId, String)>,
    /// Frames that the client has shown, with their look versions.
    pub(crate) shown: Vec<(FrameId, LookVersion)>,
}

/// Everything in flight, with its arrival time.
struct Simulated {
    rtt_micros: u64,
    loss: f64,
    random: u64,
    /// Arrival of the last message, up and down.
    ordered: [u64; 2],
    up: Vec<(u64, Up)>,
    down: Vec<(u64, Down)>,
}

enum Up {
    Message(Vec<u8>),
    Datagram(Vec<u8>),
}

enum Down {
    Welcome,
    Message(Vec<u8>),
    Chunk(ChunkPlace, LookVersion),
    Slice(Vec<u8>),
}

impl Simulated {
    /// From 0 to 1 (Marsaglia 2003, xorshift).
    fn random(&mut self) -> f64 {
        self.random ^= self.random << 13;
        self.random ^= self.random >> 7;
        self.random ^= self.random << 17;
        (self.random >> 11) as f64 / (1u64 << 53) as f64
    }

    fn is_lost(&mut self) -> bool {
        self.random() < self.loss
    }

    /// Arrival time of something that is sent until it arrives.
    fn arrival(&mut self, now: u64) -> u64 {
        let mut at = now + self.rtt_micros / 2;
        while self.is_lost() {
            at += self.rtt_micros;
        }
        at
    }

    fn in_order(&mut self, now: u64, way: usize) -> u64 {
        self.ordered[way] = self.arrival(now).max(self.ordered[way]);
        self.ordered[way]
    }
}

/// Takes what has arrived, in order of arrival.
fn arrived<T>(queue: &mut Vec<(u64, T)>, now: u64) -> Vec<T> {
    queue.sort_by_key(|(at, _)| *at);
    let num = queue.partition_point(|(at, _)| *at <= now);
    queue.drain(..num).map(|(_, what)| what).collect()
}

impl Pair {
    /// A client that has just said hello over a link with this round trip and loss rate.
    pub(crate) fn new(rtt_micros: u64, loss: f64, seed: u64) -> Self {
        let random = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
        let link = Simulated { rtt_micros, loss, random, ordered: [0; 2], up: vec![], down: vec![] };
        let mut pair = Self {
            client: ClientSession::default(),
            chunks: ChunksClient::default(),
            server: None,
            link,
            now: 0,
            frame: FrameId(0),
            answered: None,
            volume: Builtin::Cloud.volume(8),
            poses: vec![],
            num_datagrams_lost: 0,
            num_answered: 0,
            num_loads_heard: 0,
            num_slices: 0,
            orders: vec![],
            shots: vec![],
            shown: vec![],
        };
        pair.connect();
        pair
    }

    /// The connection breaks and loses everything in flight; the client says hello again.
    pub(crate) fn connect(&mut self) {
        (self.link.up, self.link.down) = (vec![], vec![]);
        self.server = None;
        self.client.handle_lost();
        let at = self.link.in_order(self.now + self.link.rtt_micros, 1);
        self.link.down.push((at, Down::Welcome));
    }

    pub(crate) fn now(&self) -> u64 {
        self.now
    }

    /// The server, which must have welcomed the client.
    pub(crate) fn server(&mut self) -> &mut ServerSession {
        self.server.as_mut().unwrap()
    }

    /// Lets time pass, in steps of a millisecond.
    pub(crate) fn run(&mut self, micros: u64) {
        for _ in 0..micros / 1000 {
            self.now += 1000;
            self.arrive();
            self.serve();
            self.leave();
        }
    }

    fn arrive(&mut self) {
        let now = self.now;
        for what in arrived(&mut self.link.down, now) {
            match what {
                Down::Welcome => {
                    let welcome = welcome("first");
                    let (version, look) = (welcome.look_version, welcome.look.clone());
                    self.server = Some(ServerSession::new(now, ViewerId(0), version, look));
                    (self.frame, self.answered) = (FrameId(0), None);
                    self.chunks.handle_connected();
                    self.client.handle_welcome(now, welcome);
                }
                Down::Message(bytes) => {
                    let message: ServerMessage = decode(&bytes[4..]).unwrap();
                    self.num_answered += usize::from(matches!(message, ServerMessage::Probed(_)));
                    self.num_loads_heard += usize::from(matches!(message, ServerMessage::Load(_)));
                    self.client.handle_message(now, message).unwrap();
                }
                Down::Slice(bytes) => {
                    let id = slice_id(&bytes).unwrap();
                    if let Some(size) = self.client.slices.begin(id) {
                        let (slice, is_draft) = decode_slice(&bytes, size).unwrap();
                        self.client.slices.handle_slice(id, slice, is_draft);
                    }
                }
                Down::Chunk(place, version) => {
                    self.chunks.handle_chunk(now, now, place, vec![0]).unwrap();
                    while let Some(job) = self.chunks.poll_decode(now) {
                        let life = self.chunks.handle_decoded(now, job.connection, job.frame);
                        self.shown.extend(life.map(|life| (life.frame, version)));
                    }
                }
            }
        }
        let Some(server) = &mut self.server else { return };
        for what in arrived(&mut self.link.up, now) {
            match what {
                Up::Message(bytes) => _ = server.handle_message(&bytes[4..]).unwrap(),
                Up::Datagram(bytes) => _ = server.handle_datagram(now, &bytes).unwrap(),
            }
        }
    }

    /// Acts as the server's application.
    fn serve(&mut self) {
        let Some(server) = &mut self.server else { return };
        if let Some(look) = server.look.poll_wanted() {
            server.look.begin(self.now, look, true);
        }
        server.probe.answer(&mut &self.volume);
        server.profile.answer(&mut &self.volume);
        self.orders.extend(server.selection.poll_order());
        if let Some(Some(shot)) = server.screenshot.poll_request() {
            self.shots.push((shot.id, server.look.look().transfer.name.clone()));
        }
        // One slice takes 20 ms.
        if self.now.is_multiple_of(20_000)
            && let Some(next) = server.slices.poll_next(|_| true)
        {
            let slice = Slice::of(&self.volume, &next.spec, ALWAYS).unwrap();
            self.num_slices += 1;
            let at = self.link.arrival(self.now);
            self.link.down.push((at, Down::Slice(encode_slice(next.id, &slice, false).unwrap())));
        }
        self.poses.extend(server.pose.poll_new());
        let Some(newest) = server.pose.newest() else { return };
        let answer = (newest.id, server.look.version());
        if self.answered.replace(answer) != Some(answer) {
            self.frame = self.frame.next();
            let place = ChunkPlace {
                frame: self.frame,
                pose: newest.id,
                index: ChunkIndex(0),
                num_chunks: 1,
                prediction: None,
            };
            server.chunks.handle_handed(self.frame);
            let at = self.link.arrival(self.now);
            self.link.down.push((at, Down::Chunk(place, answer.1)));
        }
    }

    /// Sends what both sides have to say.
    fn leave(&mut self) {
        let now = self.now;
        while let Some(message) = self.client.poll_message(now) {
            let at = self.link.in_order(now, 0);
            self.link.up.push((at, Up::Message(encode::<ClientMessage>(&message).unwrap())));
        }
        let newest_complete = self.chunks.newest_complete();
        let report = ReceiverReport { newest_complete, ..ReceiverReport::default() };
        // Without a connection there is nobody to send to.
        let is_up = self.server.is_some();
        let datagram = if is_up { self.client.pose.poll_datagram(now, report) } else { None };
        if let Some(request) = datagram {
            self.chunks.handle_pose(now, request.id);
            if self.link.is_lost() {
                self.num_datagrams_lost += 1;
            } else {
                // Delays by up to half a round trip.
                let jitter = self.link.random() * self.link.rtt_micros as f64 / 2.0;
                let at = now + self.link.rtt_micros / 2 + jitter as u64;
                self.link.up.push((at, Up::Datagram(request.encode().to_vec())));
            }
        }
        while let Some(message) = self.server.as_mut().and_then(|server| server.poll_message(now)) {
            let at = self.link.in_order(now, 1);
            self.link.down.push((at, Down::Message(encode(&message).unwrap())));
        }
    }
}

pub(crate) fn look(name: &str) -> Look {
    let point = |x: f32| ControlPoint { x, color: [1.0; 3], opacity: x };
    let (domain, unit_length) = (Domain::Full, UnitLength::Voxel);
    Look::new(TransferFunction {
        name: name.into(),
        domain,
        unit_length,
        points: vec![point(0.0), point(1.0)],
    })
}

pub(crate) fn volume(name: &str) -> VolumeDescription {
    VolumeDescription {
        name: name.into(),
        dims: [8; 3],
        spacing: [1.0; 3],
        unit: None,
        orientation: None,
        placement: None,
        value_unit: None,
        value_range: (0.0, 1.0),
        histogram_range: (0.0, 1.0),
        histogram: vec![1; 4],
        channels: vec![],
    }
}

/// A welcome to a server with a volume of this name and the look "first", as version 1.
pub(crate) fn welcome(name: &str) -> Welcome {
    Welcome {
        ticket: Token::new([3; 16]),
        volume: volume(name),
        look_version: LookVersion(1),
        look: look("first"),
        max_side: 4096,
        max_poses_per_second: 240,
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::camera::{Intrinsics, Pose};

    /// A camera that turns while its look is edited.
    fn play(loss: f64, seed: u64) -> Pair {
        let mut pair = Pair::new(150_000, loss, seed);
        for n in 0..300 {
            let (now, pose) = (pair.now(), Pose::orbit(Vec3::ZERO, 0.01 * n as f32, 0.0, 3.0));
            pair.client.pose.set(now, pose, Intrinsics::perspective(8, 8, 0.5)).unwrap();
            if n % 10 == 0 {
                pair.client.look.set(now, look(&n.to_string())).unwrap();
            }
            pair.run(10_000);
        }
        pair.run(3_000_000);
        pair
    }

    #[test]
    fn a_frame_of_an_older_look_is_never_shown_after_one_of_a_newer() {
        let mut num_dropped = 0;
        for (loss, seed) in [(0.0, 1), (0.05, 2), (0.3, 3), (0.3, 4)] {
            let pair = play(loss, seed);
            assert!(pair.shown.is_sorted(), "frames and looks go forward: {:?}", pair.shown);
            let last = pair.shown.last().unwrap();
            assert_eq!(last.0, pair.frame, "the newest frame is shown in the end");
            assert!(pair.client.look.is_chosen(last.1));
            num_dropped += pair.frame.0 as usize - pair.shown.len();
        }
        assert!(num_dropped > 20, "the control: the link does reorder frames: {num_dropped}");
    }

    #[test]
    fn the_same_seed_goes_the_same_way() {
        let [a, b, c] = [7, 7, 8].map(|seed| play(0.3, seed).shown);
        assert!(a == b && a != c);
    }

    #[test]
    fn over_another_connection_both_sides_agree_again() {
        let mut pair = play(0.1, 9);
        pair.connect();
        pair.run(3_000_000);
        let in_force = pair.client.look.in_force().unwrap();
        assert_eq!(in_force.1.transfer.name, "290");
        assert_eq!(
            (in_force.0, &in_force.1),
            (pair.server().look.version(), &pair.server().look.look().clone())
        );
        assert_eq!(pair.poses.last().map(|p| p.id), Some(PoseId(300)), "without being told to");
    }
}
