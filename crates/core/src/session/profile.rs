//! The values along a line of the volume.
//!
//! | message | content |
//! |---|---|
//! | [`ClientMessage::Profile`] | the line; at most 15 a second, the newest wins |
//! | [`ServerMessage::Profile`] | the values along it |

use super::pace::Pace;
use crate::ids::ProbeId;
use crate::volume::Volume;
use crate::wire::{ClientMessage, Profile, ProfileRequest, ServerMessage};

/// The client's half: the newest line, and its values.
#[derive(Debug)]
pub struct ProfileClient {
    newest: ProbeId,
    outbox: Pace<ProfileRequest>,
    /// The newest question, until it is answered.
    unanswered: Option<ProfileRequest>,
    answer: Option<Profile>,
}

impl Default for ProfileClient {
    fn default() -> Self {
        Self { newest: ProbeId(0), outbox: Pace::new(PERIOD_MICROS), unanswered: None, answer: None }
    }
}

impl ProfileClient {
    /// Asks for `num_points` values along a line in world space. Returns the number of the question.
    pub fn ask(&mut self, ends: [[f32; 3]; 2], num_points: u16) -> ProbeId {
        self.newest = self.newest.next();
        let question = ProfileRequest { id: self.newest, ends, num_points };
        if question.validate().is_ok() {
            self.unanswered = Some(question);
            self.outbox.offer(self.unanswered);
        }
        self.newest
    }

    /// The newest answer.
    pub fn answer(&self) -> Option<&Profile> {
        self.answer.as_ref()
    }

    /// A connection is up: an unanswered question is asked again.
    pub fn handle_welcome(&mut self) {
        self.outbox.offer(self.unanswered);
    }

    /// A message has arrived. A new volume makes the old answer useless.
    pub fn handle_message(&mut self, message: &ServerMessage) {
        match message {
            ServerMessage::Profile(answer) => self.handle_answer(answer.clone()),
            ServerMessage::VolumeChanged(_) => self.answer = None,
            _ => {}
        }
    }

    /// The server has answered.
    pub fn handle_answer(&mut self, answer: Profile) {
        self.unanswered.take_if(|asked| asked.id == answer.id);
        self.answer = Some(answer);
    }

    /// The next message.
    pub fn poll_message(&mut self, now_micros: u64) -> Option<ClientMessage> {
        self.outbox.poll(now_micros).map(ClientMessage::Profile)
    }

    /// When to poll again, µs.
    pub fn due(&self) -> Option<u64> {
        self.outbox.due()
    }
}

/// The server's half: the newest question.
#[derive(Debug, Default)]
pub struct ProfileServer {
    asked: Option<ProfileRequest>,
    answer: Option<Profile>,
}

impl ProfileServer {
    /// A message has arrived. Only the newest question remains.
    pub fn handle_message(&mut self, message: &ClientMessage) {
        if let ClientMessage::Profile(question) = message {
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
        self.answer.take().map(ServerMessage::Profile)
    }
}

/// Questions go out at most 15 times a second.
const PERIOD_MICROS: u64 = 66_667;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::pair::Pair;

    #[test]
    fn the_newest_line_is_answered_over_any_link() {
        for (loss, seed) in [(0.0, 1), (0.3, 2)] {
            let mut pair = Pair::new(80_000, loss, seed);
            let first = pair.client.profile.ask([[-0.1; 3], [0.1; 3]], 5);
            pair.run(2_000_000);
            assert_eq!(pair.client.profile.answer().map(|a| (a.id, a.values.len())), Some((first, 5)));
            let mut newest = first;
            for i in 0..50 {
                newest = pair.client.profile.ask([[0.0; 3], [0.01 * i as f32; 3]], 512);
                pair.run(4_000);
            }
            pair.run(2_000_000);
            assert_eq!(pair.client.profile.answer().map(|a| (a.id, a.values.len())), Some((newest, 512)));
            let refused = pair.client.profile.ask([[f32::NAN; 3]; 2], 5);
            pair.run(2_000_000);
            assert_ne!(pair.client.profile.answer().map(|a| a.id), Some(refused), "no line");
        }
    }

    #[test]
    fn a_line_without_values_is_asked_again_and_one_with_values_is_not() {
        let mut client = ProfileClient::default();
        let id = client.ask([[1.0; 3]; 2], 2);
        assert!(client.poll_message(0).is_some());
        client.handle_welcome();
        assert!(client.poll_message(100_000).is_some());
        client.handle_answer(Profile { id, values: vec![None; 2] });
        client.handle_welcome();
        assert!(client.poll_message(200_000).is_none());
    }
}
