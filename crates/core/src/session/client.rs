//! The client's halves of all subjects. Each inspects every message and takes its own.

use super::link::LinkClient;
use super::look::LookClient;
use super::pages::PagesClient;
use super::pose::PoseClient;
use super::probe::ProbeClient;
use super::profile::ProfileClient;
use super::screenshot::ScreenshotClient;
use super::selection::SelectionClient;
use super::slices::SlicesClient;
use super::viewers::ViewersClient;
use crate::ids::LookVersion;
use crate::wire::{ClientMessage, Refusal, ServerMessage, Welcome};

/// The conversation as the client sees it. It outlives connections.
///
/// Call `handle_welcome` for each connection, `handle_message` for each later message, and `handle_lost` at the end.
/// Send what `poll_message` and [`PoseClient::poll_datagram`] return, and poll again at `due`. Times are µs on the
/// client's clock, which must not run backwards.
#[derive(Debug, Default)]
pub struct ClientSession {
    /// The camera that frames are for.
    pub pose: PoseClient,
    /// The look of the frames.
    pub look: LookClient,
    /// The shown part of the file.
    pub selection: SelectionClient,
    /// The value at a point.
    pub probe: ProbeClient,
    /// The values along a line.
    pub profile: ProfileClient,
    /// A picture to keep.
    pub screenshot: ScreenshotClient,
    /// Slices through the volume.
    pub slices: SlicesClient,
    /// Who is there.
    pub viewers: ViewersClient,
    /// The pages of a large volume.
    pub pages: PagesClient,
    /// The connection.
    pub link: LinkClient,
    is_up: bool,
}

/// The reason why no more messages of the server are read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Ended {
    /// The server refuses or dismisses this client.
    Refused(Refusal),
    /// The server broke the protocol.
    Broken(&'static str),
}

impl ClientSession {
    /// A connection is up.
    pub fn handle_welcome(&mut self, now_micros: u64, welcome: Welcome) {
        let (version, look) = (welcome.look_version, welcome.look.clone());
        let volume = welcome.volume.clone();
        let is_other_file = self.link.handle_welcome(welcome);
        self.look.handle_welcome(now_micros, version, look, is_other_file);
        self.selection.handle_welcome(self.link.connection() == 1);
        self.probe.handle_welcome();
        self.profile.handle_welcome();
        self.screenshot.handle_welcome();
        self.slices.handle_welcome(&volume, version);
        self.viewers.handle_welcome();
        self.pages.handle_welcome();
        self.pose.handle_welcome();
        self.is_up = true;
    }

    /// The connection is lost.
    pub fn handle_lost(&mut self) {
        self.is_up = false;
    }

    /// A message has arrived after the welcome.
    ///
    /// # Errors
    /// If the message ends the connection.
    pub fn handle_message(&mut self, now_micros: u64, message: ServerMessage) -> Result<(), Ended> {
        match message {
            ServerMessage::Refused(refusal) => return Err(Ended::Refused(refusal)),
            ServerMessage::Welcome(_) => return Err(Ended::Broken("a second welcome")),
            _ => {}
        }
        self.link.handle_message(&message);
        self.look.handle_message(now_micros, &message);
        self.selection.handle_message(&message);
        self.probe.handle_message(&message);
        self.profile.handle_message(&message);
        self.screenshot.handle_message(&message);
        self.slices.handle_message(&message);
        self.viewers.handle_message(&message);
        self.pages.handle_message(&message);
        Ok(())
    }

    /// Whether a frame of this connection and look version shows the described volume and not an earlier one.
    pub fn is_of_volume(&self, connection: u32, version: LookVersion) -> bool {
        let since = self.link.description().map_or(LookVersion(0), |welcome| welcome.look_version);
        connection == self.link.connection() && version >= since
    }

    /// The next message to the server; `None` without a connection.
    pub fn poll_message(&mut self, now_micros: u64) -> Option<ClientMessage> {
        if !self.is_up {
            return None;
        }
        if let Some(message) = self.look.poll_message(now_micros).or_else(|| self.selection.poll_message()) {
            return Some(message);
        }
        // The server renders a screenshot with its current look, so a pending look goes first.
        let is_ready = !self.look.is_waiting();
        let shot = if is_ready { self.screenshot.poll_message(now_micros) } else { None };
        shot.or_else(|| self.slices.poll_message(now_micros))
            .or_else(|| self.probe.poll_message(now_micros))
            .or_else(|| self.profile.poll_message(now_micros))
            .or_else(|| self.viewers.poll_message())
            .or_else(|| self.link.poll_message(now_micros))
    }

    /// When to poll messages again if nothing happens, µs.
    pub fn due(&self) -> Option<u64> {
        let screenshot = self.screenshot.due().filter(|_| !self.look.is_waiting());
        let of_places = [self.slices.due(), self.probe.due(), self.profile.due()];
        let dues = [self.look.due(), screenshot, self.link.due()].into_iter().chain(of_places);
        dues.flatten().filter(|_| self.is_up).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::pair::{look, welcome};
    use crate::wire::VolumeChange;

    #[test]
    fn nothing_is_said_without_a_connection() {
        let mut client = ClientSession::default();
        client.look.set(0, look("mine")).unwrap();
        assert!(client.poll_message(0).is_none() && client.due().is_none());
        client.handle_welcome(0, welcome("a"));
        assert!(client.poll_message(0).is_some());
        client.handle_lost();
        client.probe.ask([0.0; 3]);
        assert!(client.poll_message(100_000).is_none());
    }

    #[test]
    fn a_second_welcome_and_a_refusal_end_the_connection() {
        let mut client = ClientSession::default();
        client.handle_welcome(0, welcome("a"));
        let again = client.handle_message(1, ServerMessage::Welcome(Box::new(welcome("a"))));
        assert!(matches!(again, Err(Ended::Broken(_))));
        let refused = client.handle_message(1, ServerMessage::Refused(Refusal::Full(3)));
        assert_eq!(refused, Err(Ended::Refused(Refusal::Full(3))));
        assert_eq!(client.handle_message(1, ServerMessage::Notice("hello".into())), Ok(()));
    }

    #[test]
    fn frames_of_an_older_volume_or_connection_are_told_apart() {
        let mut client = ClientSession::default();
        client.handle_welcome(0, welcome("a"));
        assert!(client.is_of_volume(1, LookVersion(1)) && !client.is_of_volume(0, LookVersion(1)));
        let change =
            VolumeChange { volume: welcome("a").volume, look_version: LookVersion(4), look: look("other") };
        client.handle_message(1, ServerMessage::VolumeChanged(Box::new(change))).unwrap();
        assert!(client.is_of_volume(1, LookVersion(4)) && !client.is_of_volume(1, LookVersion(3)));
    }
}
