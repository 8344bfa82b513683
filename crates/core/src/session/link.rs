//! The connection itself: the greeting, notices, and how both sides fare.
//!
//! | message | content |
//! |---|---|
//! | [`ClientMessage::Hello`], [`ServerMessage::Welcome`], [`ServerMessage::Refused`] | the request to join, and its answer |
//! | [`ClientMessage::Stats`] | how the client fares, at most once a second |
//! | [`ServerMessage::Stats`] | the cost of the newest frame |
//! | [`ServerMessage::Notice`] | one line for the user |
//! | [`ClientMessage::Bye`] | the client leaves |

use std::collections::VecDeque;
use std::sync::Arc;

use super::bucket::Bucket;
use super::pace::Pace;
use crate::wire::control::one_line;
use crate::wire::{ClientMessage, ClientStats, ServerMessage, ServerStats, VolumeChange, Welcome};

/// The client's half.
#[derive(Debug)]
pub struct LinkClient {
    connection: u32,
    description: Option<Arc<Welcome>>,
    server_stats: ServerStats,
    notice: Option<String>,
    report: Pace<ClientStats>,
}

impl Default for LinkClient {
    fn default() -> Self {
        Self {
            connection: 0,
            description: None,
            server_stats: ServerStats::default(),
            notice: None,
            report: Pace::new(REPORT_MICROS),
        }
    }
}

impl LinkClient {
    /// Number of the newest connection, from 1; 0 before the first.
    pub fn connection(&self) -> u32 {
        self.connection
    }

    /// The last welcome, with the volume that is shown now.
    pub fn description(&self) -> Option<Arc<Welcome>> {
        self.description.clone()
    }

    /// The last known cost of a frame at the server.
    pub fn server_stats(&self) -> ServerStats {
        self.server_stats
    }

    /// Takes the last line that the server wants to show.
    pub fn take_notice(&mut self) -> Option<String> {
        self.notice.take()
    }

    /// Reports how this client fares.
    pub fn report(&mut self, stats: ClientStats) {
        self.report.offer(Some(stats));
    }

    /// A connection is up. Returns whether the server now has another file.
    pub fn handle_welcome(&mut self, welcome: Welcome) -> bool {
        self.connection = self.connection.wrapping_add(1);
        let before = self.description.replace(Arc::new(welcome));
        let names = before.zip(self.description.as_ref());
        names.is_some_and(|(before, now)| before.volume.name != now.volume.name)
    }

    /// A message has arrived. A new notice replaces the previous one.
    pub fn handle_message(&mut self, message: &ServerMessage) {
        match message {
            ServerMessage::Stats(stats) => self.server_stats = *stats,
            ServerMessage::Notice(text) => self.notice = Some(text.clone()),
            ServerMessage::VolumeChanged(change) => {
                if let Some(welcome) = &mut self.description {
                    let VolumeChange { volume, look_version, look } = (**change).clone();
                    *welcome = Arc::new(Welcome { volume, look_version, look, ..(**welcome).clone() });
                }
            }
            _ => {}
        }
    }

    /// The next message.
    pub fn poll_message(&mut self, now_micros: u64) -> Option<ClientMessage> {
        self.report.poll(now_micros).map(ClientMessage::Stats)
    }

    /// When to poll again, µs.
    pub fn due(&self) -> Option<u64> {
        self.report.due()
    }
}

/// Wait before connection attempt `attempt`, which counts from 1, µs. It is 0.25 s, doubled each time up to 5 s.
/// `random`, 0 to 1, shortens it by up to a quarter, so that many clients do not come at once.
pub fn retry_wait_micros(attempt: u32, random: f64) -> u64 {
    let whole = (FIRST_RETRY_MICROS << attempt.saturating_sub(1).min(8)).min(LONGEST_RETRY_MICROS);
    (whole as f64 * (1.0 - 0.25 * random)) as u64
}

/// The server's half.
#[derive(Debug)]
pub struct LinkServer {
    messages: Bucket,
    notices: VecDeque<String>,
    stats: Option<ServerStats>,
}

impl LinkServer {
    /// Starts for a viewer that was admitted now.
    pub fn new(now_micros: u64) -> Self {
        let messages = Bucket::new(MAX_MESSAGES_PER_SECOND, now_micros);
        Self { messages, notices: VecDeque::new(), stats: None }
    }

    /// Whether one more message may be handled now. Otherwise it and those behind it wait. After a network stall many
    /// arrive at once, so this is no error.
    pub fn takes_message(&mut self, now_micros: u64) -> bool {
        self.messages.take(now_micros)
    }

    /// One line for the user at the viewer.
    pub fn notice(&mut self, text: &str) {
        if self.notices.len() == MAX_NOTICES {
            self.notices.pop_front();
        }
        self.notices.push_back(one_line(text));
    }

    /// The cost of the newest frame.
    pub fn report(&mut self, stats: ServerStats) {
        self.stats = Some(stats);
    }

    /// The next message.
    pub fn poll_message(&mut self) -> Option<ServerMessage> {
        let notice = self.notices.pop_front().map(ServerMessage::Notice);
        notice.or_else(|| self.stats.take().map(ServerMessage::Stats))
    }
}

/// Control messages handled per second.
pub const MAX_MESSAGES_PER_SECOND: u32 = 100;
/// Wait until one more message may be handled, µs.
pub const MESSAGE_WAIT_MICROS: u64 = 1_000_000 / MAX_MESSAGES_PER_SECOND as u64;
const FIRST_RETRY_MICROS: u64 = 250_000;
const LONGEST_RETRY_MICROS: u64 = 5_000_000;
/// Reports go out at most once a second.
const REPORT_MICROS: u64 = 1_000_000;
/// Lines that wait for the network; the oldest is dropped first.
const MAX_NOTICES: usize = 32;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::pair::{Pair, welcome};

    #[test]
    fn a_server_with_another_file_is_told_from_one_with_the_same() {
        let mut client = LinkClient::default();
        let is_other = ["a", "a", "b", "b"].map(|name| client.handle_welcome(welcome(name)));
        assert_eq!((is_other, client.connection()), ([false, false, true, false], 4));
    }

    #[test]
    fn the_newest_of_many_lines_and_figures_arrives() {
        let mut pair = Pair::new(50_000, 0.2, 5);
        pair.run(1_000_000);
        for n in 0..1000 {
            pair.server().link.notice(&format!("{n}\n"));
            pair.server().link.report(ServerStats { bytes: n, ..ServerStats::default() });
        }
        pair.run(1_000_000);
        assert_eq!(pair.client.link.take_notice().as_deref(), Some("999 "));
        assert_eq!((pair.client.link.take_notice(), pair.client.link.server_stats().bytes), (None, 999));
    }

    #[test]
    fn waits_double_to_their_limit_and_are_up_to_a_quarter_shorter() {
        for (attempt, ms) in [(1, 250), (2, 500), (3, 1000), (5, 4000), (6, 5000), (1000, 5000)] {
            assert_eq!(retry_wait_micros(attempt, 0.0), ms * 1000);
            assert_eq!(retry_wait_micros(attempt, 1.0), ms * 750);
        }
    }

    #[test]
    fn a_flood_of_messages_waits() {
        let mut server = LinkServer::new(0);
        assert_eq!((0..1000).filter(|_| server.takes_message(0)).count(), 100);
        assert!(server.takes_message(MESSAGE_WAIT_MICROS) && !server.takes_message(MESSAGE_WAIT_MICROS));
    }
}
