//! The value at a point of the volume.
//!
//! | message | content |
//! |---|---|
//! | [`ClientMessage::Probe`] | the point; at most 30 a second, the newest wins |
//! | [`ServerMessage::Probed`] | the voxel there, if any |

use super::pace::Pace;
use crate::ids::ProbeId;
use crate::volume::Volume;
use crate::wire::{ClientMessage, ProbeRequest, Probed, ServerMessage};

/// The client's half: the newest question and the newest answer.
#[derive(Debug)]
pub struct ProbeClient {
    newest: ProbeId,
    outbox: Pace<ProbeRequest>,
    /// The newest question, until it is answered.
    unanswered: Option<ProbeRequest>,
    answer: Option<Probed>,
}

impl Default for ProbeClient {
    fn default() -> Self {
        Self { newest: ProbeId(0), outbox: Pace::new(PERIOD_MICROS), unanswered: None, answer: None }
    }
}

impl ProbeClient {
    /// Asks for the value at a point in world space, unless it is not finite. Returns the number of the newest
    /// question.
    pub fn ask(&mut self, point: [f32; 3]) -> ProbeId {
        if point.iter().all(|x| x.is_finite()) {
            self.newest = self.newest.next();
            self.unanswered = Some(ProbeRequest { id: self.newest, point });
            self.outbox.offer(self.unanswered);
        }
        self.newest
    }

    /// The newest answer.
    pub fn answer(&self) -> Option<Probed> {
        self.answer
    }

    /// A connection is up: an unanswered question is asked again.
    pub fn handle_welcome(&mut self) {
        self.outbox.offer(self.unanswered);
    }

    /// A message has arrived. A new volume makes the old answer useless.
    pub fn handle_message(&mut self, message: &ServerMessage) {
        match message {
            ServerMessage::Probed(answer) => self.handle_answer(*answer),
            ServerMessage::VolumeChanged(_) => self.answer = None,
            _ => {}
        }
    }

    /// The server has answered.
    pub fn handle_answer(&mut self, answer: Probed) {
        self.unanswered.take_if(|asked| asked.id == answer.id);
        self.answer = Some(answer);
    }

    /// The next message.
    pub fn poll_message(&mut self, now_micros: u64) -> Option<ClientMessage> {
        self.outbox.poll(now_micros).map(ClientMessage::Probe)
    }

    /// When to poll again, µs.
    pub fn due(&self) -> Option<u64> {
        self.outbox.due()
    }
}

/// The server's half: the newest question.
#[derive(Debug, Default)]
pub struct ProbeServer {
    asked: Option<ProbeRequest>,
    answer: Option<Probed>,
}

impl ProbeServer {
    /// A message has arrived. Only the newest question remains.
    pub fn handle_message(&mut self, message: &ClientMessage) {
        if let ClientMessage::Probe(question) = message {
            self.asked = Some(*question);
        }
    }

    /// Whether a question waits for its answer.
    pub fn is_asked(&self) -> bool {
        self.asked.is_some()
    }

    /// Answers the question from the shown volume.
    pub fn answer(&mut self, volume: &Volume) {
        if let Some(question) = self.asked.take() {
            self.answer = Some(question.answer(volume));
        }
    }

    /// The next message.
    pub fn poll_message(&mut self) -> Option<ServerMessage> {
        self.answer.take().map(ServerMessage::Probed)
    }
}

/// Questions go out at most 30 times a second.
const PERIOD_MICROS: u64 = 33_334;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::pair::Pair;

    #[test]
    fn the_newest_question_is_answered_over_any_link() {
        for (loss, seed) in [(0.0, 1), (0.3, 2)] {
            let mut pair = Pair::new(80_000, loss, seed);
            let first = pair.client.probe.ask([0.0; 3]);
            pair.run(2_000_000);
            let answer = pair.client.probe.answer().unwrap();
            assert_eq!(
                (answer.id, answer.voxel.is_some()),
                (first, true),
                "asked before there was a connection"
            );
            let mut newest = first;
            for i in 0..50 {
                newest = pair.client.probe.ask([0.01 * i as f32, 0.0, 0.0]);
                pair.run(4_000);
            }
            pair.run(2_000_000);
            assert_eq!(pair.client.probe.answer().map(|a| a.id), Some(newest));
            assert!(pair.num_answered < 12, "50 questions in 200 ms are about seven: {}", pair.num_answered);
            assert_eq!(pair.client.probe.ask([f32::NAN; 3]), newest, "no question");
        }
    }

    #[test]
    fn a_question_without_an_answer_is_asked_again_and_one_with_an_answer_is_not() {
        let mut client = ProbeClient::default();
        let id = client.ask([1.0; 3]);
        assert!(client.poll_message(0).is_some());
        client.handle_welcome();
        assert!(client.poll_message(100_000).is_some());
        client.handle_answer(Probed { id, point: [1.0; 3], voxel: None });
        client.handle_welcome();
        assert!(client.poll_message(200_000).is_none());
        assert!(client.answer().is_some());
        let volume = crate::session::pair::volume("second");
        let (look_version, look) = (crate::ids::LookVersion(2), crate::session::pair::look("second"));
        let change = crate::wire::VolumeChange { volume, look_version, look };
        client.handle_message(&ServerMessage::VolumeChanged(Box::new(change)));
        assert_eq!(client.answer(), None);
    }
}
