//! The server's halves of all subjects, for one viewer. Each inspects every message and takes its own.

use super::admission::ViewerId;
use super::chunks::ChunksServer;
use super::link::LinkServer;
use super::look::LookServer;
use super::pages::PagesServer;
use super::pose::PoseServer;
use super::probe::ProbeServer;
use super::profile::ProfileServer;
use super::screenshot::ScreenshotServer;
use super::selection::SelectionServer;
use super::slices::SlicesServer;
use super::viewers::ViewersServer;
use crate::ids::LookVersion;
use crate::look::Look;
use crate::wire::control::{self, ControlError, one_line};
use crate::wire::{ClientMessage, ClientStats, PoseError, Refusal, ServerMessage};

/// The conversation with one viewer as the server sees it, over one connection.
///
/// Call `handle_datagram` and `handle_message` for what arrives. Send what `poll_message` returns, and poll again at
/// `due`. Times are µs on the server's clock, which must not run backwards.
#[derive(Debug)]
pub struct ServerSession {
    /// The camera that frames are for.
    pub pose: PoseServer,
    /// The chunks that are worth sending.
    pub chunks: ChunksServer,
    /// The look of the frames.
    pub look: LookServer,
    /// The shown part of the file.
    pub selection: SelectionServer,
    /// The value at a point.
    pub probe: ProbeServer,
    /// The values along a line.
    pub profile: ProfileServer,
    /// A picture to keep.
    pub screenshot: ScreenshotServer,
    /// Slices through the volume.
    pub slices: SlicesServer,
    /// Who is there.
    pub viewers: ViewersServer,
    /// The pages of a large volume.
    pub pages: PagesServer,
    /// The connection.
    pub link: LinkServer,
}

/// What a message means for the connection.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Heard {
    /// One of the subjects takes it.
    Taken,
    /// How the viewer fares, for the log.
    Stats(ClientStats),
    /// The viewer leaves.
    Bye,
}

impl ServerSession {
    /// Starts for a viewer that was welcomed now, with this look.
    pub fn new(now_micros: u64, viewer: ViewerId, version: LookVersion, look: Look) -> Self {
        Self {
            pose: PoseServer::new(now_micros),
            chunks: ChunksServer::default(),
            look: LookServer::new(version, look),
            selection: SelectionServer::new(viewer),
            probe: ProbeServer::default(),
            profile: ProfileServer::default(),
            screenshot: ScreenshotServer::default(),
            slices: SlicesServer::new(version),
            viewers: ViewersServer::default(),
            pages: PagesServer::default(),
            link: LinkServer::new(now_micros),
        }
    }

    /// A datagram has arrived. Returns whether it brought a new pose.
    ///
    /// # Errors
    /// If it is not a pose; the connection can go on.
    pub fn handle_datagram(&mut self, now_micros: u64, bytes: &[u8]) -> Result<bool, PoseError> {
        let before = self.pose.newest().map(|pose| pose.id);
        if let Some((request, is_newest)) = self.pose.handle_datagram(now_micros, bytes)?
            && let Some(frame) = request.newest_complete
        {
            self.chunks.handle_report(frame, is_newest);
        }
        Ok(self.pose.newest().map(|pose| pose.id) != before)
    }

    /// A control message has arrived after the hello.
    ///
    /// # Errors
    /// If the viewer must be dismissed for it.
    pub fn handle_message(&mut self, body: &[u8]) -> Result<Heard, Refusal> {
        let message: ClientMessage = control::decode(body).map_err(|e| violation(&e))?;
        match message {
            ClientMessage::Hello { .. } => return Err(Refusal::Protocol("a second hello".into())),
            ClientMessage::Stats(stats) => return Ok(Heard::Stats(stats)),
            ClientMessage::Bye => return Ok(Heard::Bye),
            _ => {}
        }
        self.look.handle_message(&message);
        self.selection.handle_message(&message);
        self.probe.handle_message(&message);
        self.profile.handle_message(&message);
        self.screenshot.handle_message(&message);
        self.slices.handle_message(&message);
        self.viewers.handle_message(&message);
        Ok(Heard::Taken)
    }

    /// The next message to the viewer.
    pub fn poll_message(&mut self, now_micros: u64) -> Option<ServerMessage> {
        self.look
            .poll_message()
            .or_else(|| self.selection.poll_message(now_micros))
            .or_else(|| self.link.poll_message())
            .or_else(|| self.screenshot.poll_message())
            .or_else(|| self.probe.poll_message())
            .or_else(|| self.profile.poll_message())
            .or_else(|| self.viewers.poll_message())
            .or_else(|| self.pages.poll_message())
    }

    /// When to poll messages again if nothing happens, µs.
    pub fn due(&self) -> Option<u64> {
        self.selection.due()
    }
}

/// The answer to a client that sent something unreadable.
pub fn violation(error: &ControlError) -> Refusal {
    Refusal::Protocol(one_line(&error.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::pair::look;
    use crate::wire::Token;

    #[test]
    fn a_second_hello_is_a_violation_and_a_bye_is_not() {
        let mut server = ServerSession::new(0, ViewerId(0), LookVersion(1), look("first"));
        let token = || Token::new([0; 16]);
        let hello = control::encode(&control::hello(token(), token(), "x")).unwrap();
        assert!(matches!(server.handle_message(&hello[4..]), Err(Refusal::Protocol(_))));
        assert!(matches!(server.handle_message(b"junk"), Err(Refusal::Protocol(_))));
        let bye = control::encode(&ClientMessage::Bye).unwrap();
        assert_eq!(server.handle_message(&bye[4..]), Ok(Heard::Bye));
    }
}
