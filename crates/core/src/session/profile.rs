//! The values along a line of the volume.
//!
//! | message | content |
//! |---|---|
//! | [`ClientMessage::Profile`] | the line; at most 15 a second, the newest wins |
//! | [`ServerMessage::Profile`] | the values along it |

use super::inquiry::{InquiryClient, InquiryServer, Question};
use crate::ids::ProbeId;
use crate::volume::ValuesAt;
use crate::wire::{ClientMessage, Profile, ProfileRequest, ServerMessage};

/// The client's half: the newest line, and its values.
pub type ProfileClient = InquiryClient<ProfileRequest>;

/// The server's half: the newest line.
pub type ProfileServer = InquiryServer<ProfileRequest>;

impl ProfileClient {
    /// Asks for `num_points` values along a line in world space, if that is a line. Returns the number of the newest
    /// question.
    pub fn ask(&mut self, ends: [[f32; 3]; 2], num_points: u16) -> ProbeId {
        self.ask_what(|id| Some(ProfileRequest { id, ends, num_points }).filter(|q| q.validate().is_ok()))
    }
}

impl Question for ProfileRequest {
    type Answer = Profile;
    const PERIOD_MICROS: u64 = 66_667;

    fn id(&self) -> ProbeId {
        self.id
    }

    fn id_of(answer: &Profile) -> ProbeId {
        answer.id
    }

    fn in_message(message: &ClientMessage) -> Option<Self> {
        if let ClientMessage::Profile(question) = message { Some(*question) } else { None }
    }

    fn answer_in(message: &ServerMessage) -> Option<Profile> {
        if let ServerMessage::Profile(answer) = message { Some(answer.clone()) } else { None }
    }

    fn to_message(self) -> ClientMessage {
        ClientMessage::Profile(self)
    }

    fn message_of(answer: Profile) -> ServerMessage {
        ServerMessage::Profile(answer)
    }

    fn answer_from(&self, values: &mut dyn ValuesAt) -> Profile {
        self.answer(values)
    }
}

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
            assert_eq!(refused, newest, "no line, so no question");
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
