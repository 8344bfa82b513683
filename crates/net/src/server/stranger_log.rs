//! What the log says of connections before their token: a few lines in a while, each with the peer's address, and then
//! how many more there were.

use std::fmt::Display;
use std::net::SocketAddr;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use isinglass_core::text::one_line;
use tokio::time::Instant;

#[derive(Debug, Default)]
pub(super) struct StrangerLog(Mutex<Lines>);

#[derive(Debug, Default)]
struct Lines {
    /// The start of the present period, and the lines in it.
    since: Option<Instant>,
    num_lines: u32,
    /// Connections since then without a line, and the address of the last one.
    num_left_out: u64,
    last: Option<SocketAddr>,
}

impl StrangerLog {
    /// Logs why a connection from `remote` came to nothing, if there is room for it.
    pub(super) fn tell(&self, remote: SocketAddr, now: Instant, why: &dyn Display) {
        let mut lines = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        for line in lines.add(remote, now, why) {
            tracing::warn!("{line}");
        }
    }
}

impl Lines {
    /// The lines to log for one more connection.
    fn add(&mut self, remote: SocketAddr, now: Instant, why: &dyn Display) -> Vec<String> {
        let mut lines = Vec::new();
        if self.since.is_none_or(|since| now.duration_since(since) >= PERIOD) {
            if let Some(last) = self.last.filter(|_| self.num_left_out > 0) {
                lines.push(format!(
                    "{} more connections came to nothing, the last from {last}",
                    self.num_left_out
                ));
            }
            *self = Self { since: Some(now), ..Self::default() };
        }
        if self.num_lines < MAX_LINES {
            self.num_lines += 1;
            // The reason may be a text of the peer.
            lines.push(format!("no viewer from {remote}: {}", one_line(&why.to_string(), MAX_CHARS)));
        } else {
            (self.num_left_out, self.last) = (self.num_left_out + 1, Some(remote));
        }
        lines
    }
}

/// Most lines in a period, beside the number of what was left out.
const MAX_LINES: u32 = 10;
const PERIOD: Duration = Duration::from_secs(10);
/// Longest reason, in characters.
const MAX_CHARS: usize = 200;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_makes_few_lines_and_is_counted() {
        let (mut log, start) = (Lines::default(), Instant::now());
        let remote = |n: u16| SocketAddr::from(([203, 0, 113, 7], n));
        let long = format!("token\n\u{202e}{}", "x".repeat(5000));
        // A thousand in three periods.
        let lines: Vec<String> = (0..1000u16)
            .flat_map(|n| log.add(remote(n), start + PERIOD * u32::from(n) / 334, &long))
            .collect();
        assert_eq!(lines.len(), 3 * MAX_LINES as usize + 2, "{lines:?}");
        assert!(lines.iter().map(String::len).sum::<usize>() < 10_000);
        assert!(lines[0].contains("203.0.113.7:0") && !lines[0].contains(['\n', '\u{202e}']), "{}", lines[0]);
        assert!(lines[10].contains("324 more") && lines[10].contains("203.0.113.7:333"), "{}", lines[10]);
        // The control: a few strangers are all named.
        let mut log = Lines::default();
        let lines: Vec<String> = (0..5).flat_map(|n| log.add(remote(n), start, &"silence")).collect();
        assert!(lines.len() == 5 && lines[4].ends_with("from 203.0.113.7:4: silence"), "{lines:?}");
    }
}
