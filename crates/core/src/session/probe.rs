//! The value at a point of the volume.
//!
//! | message | content |
//! |---|---|
//! | [`ClientMessage::Probe`] | the point; at most 30 a second, the newest wins |
//! | [`ServerMessage::Probed`] | the voxel there, if any |

use super::inquiry::{InquiryClient, InquiryServer, Question};
use crate::ids::ProbeId;
use crate::volume::ValuesAt;
use crate::wire::{ClientMessage, ProbeRequest, Probed, ServerMessage};

/// The client's half: the newest question and the newest answer.
pub type ProbeClient = InquiryClient<ProbeRequest>;

/// The server's half: the newest question.
pub type ProbeServer = InquiryServer<ProbeRequest>;

impl ProbeClient {
    /// Asks for the value at a point in world space, unless it is not finite. Returns the number of the newest
    /// question.
    pub fn ask(&mut self, point: [f32; 3]) -> ProbeId {
        let is_good = point.iter().all(|x| x.is_finite());
        self.ask_what(|id| is_good.then_some(ProbeRequest { id, point }))
    }
}

impl Question for ProbeRequest {
    type Answer = Probed;
    const PERIOD_MICROS: u64 = 33_334;

    fn id(&self) -> ProbeId {
        self.id
    }

    fn id_of(answer: &Probed) -> ProbeId {
        answer.id
    }

    fn in_message(message: &ClientMessage) -> Option<Self> {
        if let ClientMessage::Probe(question) = message { Some(*question) } else { None }
    }

    fn answer_in(message: &ServerMessage) -> Option<Probed> {
        if let ServerMessage::Probed(answer) = message { Some(*answer) } else { None }
    }

    fn to_message(self) -> ClientMessage {
        ClientMessage::Probe(self)
    }

    fn message_of(answer: Probed) -> ServerMessage {
        ServerMessage::Probed(answer)
    }

    fn answer_from(&self, values: &mut dyn ValuesAt) -> Probed {
        self.answer(values)
    }
}

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
        assert!(client.answer().is_none());
    }
}
