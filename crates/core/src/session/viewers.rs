//! Who is there, and whose frames a viewer gets.
//!
//! [`ServerMessage::Viewers`] lists the viewers of a server. With [`ClientMessage::Follow`] a viewer asks for the
//! frames of another one, under that one's look, in place of its own. It watches them from its own camera, and they
//! are rendered once for all.

use super::admission::ViewerId;
use crate::text::printable;
use crate::wire::{ClientMessage, MAX_VIEWERS, ServerMessage, ViewerEntry};

/// The client's half.
#[derive(Debug, Default)]
pub struct ViewersClient {
    list: Vec<ViewerEntry>,
    unsent: Option<Option<u32>>,
    following: Option<u32>,
}

impl ViewersClient {
    /// Asks for the frames of another viewer, or with `None` for own ones.
    pub fn follow(&mut self, leader: Option<u32>) {
        self.unsent = Some(leader);
        self.following = leader;
    }

    /// All viewers of the server, this one among them.
    pub fn list(&self) -> &[ViewerEntry] {
        &self.list
    }

    /// Whose frames this viewer gets, as far as it knows.
    pub fn following(&self) -> Option<&ViewerEntry> {
        self.following.and_then(|leader| self.list.iter().find(|viewer| viewer.number == leader))
    }

    /// A connection is up: the server is asked again.
    pub fn handle_welcome(&mut self) {
        self.list.clear();
        self.unsent = self.following.map(Some);
    }

    /// A message has arrived.
    pub fn handle_message(&mut self, message: &ServerMessage) {
        let ServerMessage::Viewers(list) = message else { return };
        self.list.clone_from(list);
        // A request on its way is newer than the list.
        if self.unsent.is_none()
            && let Some(own) = list.iter().find(|viewer| viewer.is_own)
        {
            self.following = own.follows;
        }
    }

    /// The next message.
    pub fn poll_message(&mut self) -> Option<ClientMessage> {
        self.unsent.take().map(ClientMessage::Follow)
    }
}

/// The server's half, for one viewer.
#[derive(Debug, Default)]
pub struct ViewersServer {
    wanted: Option<Option<ViewerId>>,
    untold: Option<Vec<ViewerEntry>>,
}

impl ViewersServer {
    /// A message has arrived. Only the newest wish remains.
    pub fn handle_message(&mut self, message: &ClientMessage) {
        if let ClientMessage::Follow(leader) = message {
            self.wanted = Some(leader.map(ViewerId));
        }
    }

    /// Takes the newest wish: whose frames this viewer wants.
    pub fn poll_wanted(&mut self) -> Option<Option<ViewerId>> {
        self.wanted.take()
    }

    /// Sets who is there, as this viewer should see it. More than a message holds are left out.
    pub fn handle_list(&mut self, mut list: Vec<ViewerEntry>) {
        list.truncate(MAX_VIEWERS);
        for viewer in &mut list {
            viewer.name = printable(&viewer.name, MAX_NAME_CHARS);
        }
        self.untold = Some(list);
    }

    /// The next message.
    pub fn poll_message(&mut self) -> Option<ServerMessage> {
        self.untold.take().map(ServerMessage::Viewers)
    }
}

/// Longest name in a list, characters.
const MAX_NAME_CHARS: usize = 60;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::pair::Pair;

    fn list(follows: Option<u32>) -> Vec<ViewerEntry> {
        let viewer = |number, is_own, follows| ViewerEntry {
            number,
            name: format!("viewer {number}\u{202e}"),
            is_own,
            follows,
        };
        vec![viewer(0, true, follows), viewer(1, false, None)]
    }

    #[test]
    fn a_wish_arrives_on_a_lossy_link_and_again_on_the_next_connection() {
        let mut pair = Pair::new(100_000, 0.2, 5);
        pair.run(1_000_000);
        pair.server().viewers.handle_list(list(None));
        pair.run(1_000_000);
        assert_eq!(pair.client.viewers.list().len(), 2);
        assert!(!pair.client.viewers.list()[0].name.contains('\u{202e}'));
        assert_eq!(pair.client.viewers.following(), None);
        pair.client.viewers.follow(Some(1));
        pair.run(1_000_000);
        assert_eq!(pair.server().viewers.poll_wanted(), Some(Some(ViewerId(1))));
        assert_eq!(pair.server().viewers.poll_wanted(), None, "it is asked once");
        pair.connect();
        pair.run(2_000_000);
        assert_eq!(pair.server().viewers.poll_wanted(), Some(Some(ViewerId(1))));
        // The server has the last word: the leader has left.
        pair.server().viewers.handle_list(list(None));
        pair.run(1_000_000);
        assert_eq!(pair.client.viewers.following(), None);
    }
}
