//! How far the pages of a large volume are.
//!
//! A volume that does not fit into memory is read by pages while it is shown. With [`ServerMessage::Pages`] the server
//! says how many of a frame's pages are there.

use crate::volume::PageProgress;
use crate::wire::ServerMessage;

/// The client's half.
#[derive(Debug, Default)]
pub struct PagesClient {
    progress: Option<PageProgress>,
}

impl PagesClient {
    /// How far the newest frame's pages are; `None` for a volume that is in memory whole.
    pub fn progress(&self) -> Option<PageProgress> {
        self.progress
    }

    /// A connection is up.
    pub fn handle_welcome(&mut self) {
        self.progress = None;
    }

    /// A message has arrived.
    pub fn handle_message(&mut self, message: &ServerMessage) {
        match message {
            ServerMessage::Pages(progress) => self.progress = Some(*progress),
            ServerMessage::VolumeChanged(_) => self.progress = None,
            _ => {}
        }
    }
}

/// The server's half, for one viewer.
#[derive(Debug, Default)]
pub struct PagesServer {
    told: Option<PageProgress>,
    untold: Option<PageProgress>,
}

impl PagesServer {
    /// Another volume is shown.
    pub fn handle_volume(&mut self) {
        *self = Self::default();
    }

    /// A frame was made of pages that are so far.
    pub fn handle_progress(&mut self, progress: PageProgress) {
        self.untold = Some(progress).filter(|progress| self.told != Some(*progress));
    }

    /// The next message. Only the newest progress remains.
    pub fn poll_message(&mut self) -> Option<ServerMessage> {
        let progress = self.untold.take()?;
        self.told = Some(progress);
        Some(ServerMessage::Pages(progress))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::pair::Pair;

    #[test]
    fn the_newest_progress_arrives_on_a_lossy_link_once() {
        let mut pair = Pair::new(100_000, 0.2, 7);
        pair.run(1_000_000);
        assert_eq!(pair.client.pages.progress(), None);
        let progress = |num_resident| PageProgress { num_wanted: 9, num_resident, ..PageProgress::default() };
        for i in 0..9 {
            pair.server().pages.handle_progress(progress(i));
        }
        pair.run(1_000_000);
        let found = pair.client.pages.progress();
        assert!(found == Some(progress(8)) && found.is_some_and(|p| p.is_loading()), "{found:?}");
        pair.server().pages.handle_progress(progress(8));
        assert!(pair.server().pages.poll_message().is_none());
        pair.server().pages.handle_progress(progress(9));
        pair.run(1_000_000);
        assert!(pair.client.pages.progress().is_some_and(|p| p.is_exact()));
    }
}
