//! The part of the file that all viewers of a server see.
//!
//! [`ClientMessage::Select`] requests another part, and [`ClientMessage::CancelSelection`] withdraws that.
//! [`ServerMessage::Choices`] lists what the file holds and what is shown. [`ServerMessage::Load`] reports the
//! progress of reading, at most ten times a second.

use std::sync::Arc;

use super::admission::ViewerId;
use crate::ids::LoadId;
use crate::wire::{Choices, ClientMessage, LoadState, LoadStatus, Part, ServerMessage};

/// The client's half.
#[derive(Debug, Default)]
pub struct SelectionClient {
    unsent: Option<Option<Part>>,
    choices: Option<Arc<Choices>>,
    load: Option<LoadStatus>,
}

impl SelectionClient {
    /// Requests another part for all viewers; `None` cancels the one that is being read. The newest request wins.
    pub fn open(&mut self, part: Option<Part>) {
        self.unsent = Some(part);
    }

    /// What the file holds, once the server has said so.
    pub fn choices(&self) -> Option<Arc<Choices>> {
        self.choices.clone()
    }

    /// The last known progress of reading another part.
    pub fn load(&self) -> Option<LoadStatus> {
        self.load.clone()
    }

    /// A connection is up. Except on the first one, a request from before is forgotten: it may be minutes old, and
    /// would change what all others see.
    pub fn handle_welcome(&mut self, is_first: bool) {
        if !is_first {
            self.unsent = None;
        }
        // The server sends both again.
        (self.choices, self.load) = (None, None);
    }

    /// A message has arrived.
    pub fn handle_message(&mut self, message: &ServerMessage) {
        match message {
            ServerMessage::Choices(choices) => self.handle_choices((**choices).clone()),
            ServerMessage::Load(load) => self.handle_load(load.clone()),
            _ => {}
        }
    }

    /// The server lists what the file holds.
    pub fn handle_choices(&mut self, choices: Choices) {
        self.choices = Some(Arc::new(choices));
    }

    /// The server reports the progress of reading.
    pub fn handle_load(&mut self, load: LoadStatus) {
        self.load = Some(load);
    }

    /// The next message.
    pub fn poll_message(&mut self) -> Option<ClientMessage> {
        let part = self.unsent.take()?;
        Some(part.map_or(ClientMessage::CancelSelection, ClientMessage::Select))
    }
}

/// The reading of another part, for all viewers.
#[derive(Clone, Debug, PartialEq)]
pub struct Load {
    /// Counts the loads of a server, from 1.
    pub id: LoadId,
    /// The viewer that requested it.
    pub viewer: ViewerId,
    /// The requested part.
    pub part: Part,
    /// Memory that it takes, bytes; 0 if not known yet.
    pub bytes_needed: u64,
    /// Its progress.
    pub state: LoadState,
}

impl Load {
    /// Whether the reading continues.
    pub fn is_reading(&self) -> bool {
        matches!(self.state, LoadState::Reading { .. })
    }
}

/// The server's half, for one viewer.
#[derive(Debug)]
pub struct SelectionServer {
    viewer: ViewerId,
    ordered: Option<Option<Part>>,
    choices: Option<Choices>,
    load: Option<Load>,
    /// When to report progress again, µs.
    tell_at: u64,
}

impl SelectionServer {
    /// Starts without any knowledge of the file.
    pub fn new(viewer: ViewerId) -> Self {
        Self { viewer, ordered: None, choices: None, load: None, tell_at: 0 }
    }

    /// A message has arrived. Only the newest request remains.
    pub fn handle_message(&mut self, message: &ClientMessage) {
        match message {
            ClientMessage::Select(part) => self.ordered = Some(Some(*part)),
            ClientMessage::CancelSelection => self.ordered = Some(None),
            _ => {}
        }
    }

    /// Takes the newest request.
    pub fn poll_order(&mut self) -> Option<Option<Part>> {
        self.ordered.take()
    }

    /// Sets what the file holds and what is shown.
    pub fn handle_choices(&mut self, choices: Choices) {
        self.choices = Some(choices);
    }

    /// Sets the progress of reading.
    pub fn handle_load(&mut self, load: Load) {
        self.load = Some(load);
    }

    /// The next message.
    pub fn poll_message(&mut self, now_micros: u64) -> Option<ServerMessage> {
        if let Some(choices) = self.choices.take() {
            return Some(ServerMessage::Choices(Box::new(choices)));
        }
        if self.due()? > now_micros {
            return None;
        }
        self.tell_at = now_micros + TELL_PERIOD_MICROS;
        let Load { id, viewer, part, bytes_needed, state } = self.load.take()?;
        let is_own = viewer == self.viewer;
        Some(ServerMessage::Load(LoadStatus { load: id, is_own, part, bytes_needed, state }))
    }

    /// When to poll again, µs. The end of a reading is reported at once.
    pub fn due(&self) -> Option<u64> {
        self.load.as_ref().map(|load| if load.is_reading() { self.tell_at } else { 0 })
    }
}

/// Time between progress reports to a viewer.
const TELL_PERIOD_MICROS: u64 = 100_000;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::pair::Pair;

    fn time(time: u32) -> Part {
        Part { time: Some(time), ..Part::default() }
    }

    fn load(id: u32, state: LoadState) -> Load {
        Load { id: LoadId(id), viewer: ViewerId(0), part: time(id), bytes_needed: 0, state }
    }

    #[test]
    fn an_order_arrives_once_and_its_outcome_too() {
        for (loss, seed) in [(0.0, 1), (0.3, 2)] {
            let mut pair = Pair::new(60_000, loss, seed);
            pair.run(1_000_000);
            pair.client.selection.open(Some(time(1)));
            pair.client.selection.open(Some(time(2)));
            pair.run(1_000_000);
            assert_eq!(pair.orders, [Some(time(2))], "the newest, once");
            let server = pair.server();
            for permille in 0..=1000 {
                server.selection.handle_load(load(1, LoadState::Reading { permille }));
            }
            server.selection.handle_load(load(1, LoadState::Done));
            pair.run(1_000_000);
            assert_eq!(
                pair.client.selection.load().map(|l| (l.state, l.is_own)),
                Some((LoadState::Done, true))
            );
            assert_eq!(pair.num_loads_heard, 1);
            pair.client.selection.open(None);
            pair.run(1_000_000);
            assert_eq!(pair.orders, [Some(time(2)), None]);
        }
    }

    #[test]
    fn an_order_that_could_not_be_sent_is_forgotten_over_another_connection_alone() {
        let mut client = SelectionClient::default();
        client.open(Some(time(1)));
        client.handle_welcome(true);
        assert!(client.poll_message().is_some());
        client.open(Some(time(1)));
        client.handle_welcome(false);
        assert!(client.poll_message().is_none());
    }

    #[test]
    fn progress_is_told_ten_times_a_second_and_the_end_at_once() {
        let mut server = SelectionServer::new(ViewerId(3));
        let mut num_told = 0;
        for ms in 0..1000u64 {
            server.handle_load(load(1, LoadState::Reading { permille: ms as u16 }));
            num_told += u32::from(server.poll_message(ms * 1000).is_some());
        }
        assert_eq!(num_told, 10);
        server.handle_load(load(1, LoadState::Failed("no".into())));
        let told = server.poll_message(1_000_000);
        assert!(matches!(told, Some(ServerMessage::Load(LoadStatus { is_own: false, .. }))), "another's");
        assert_eq!((server.poll_message(u64::MAX).is_none(), server.due()), (true, None));
    }
}
