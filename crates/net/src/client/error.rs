//! Why there is no connection.

use std::time::Duration;

use isinglass_core::wire::{PROTOCOL_VERSION, Refusal};

use crate::identity::Fingerprint;
use crate::link::place_of;

/// Why there is no connection. The user at the viewer reads the text.
#[derive(Clone, Debug, thiserror::Error, PartialEq, Eq)]
pub enum ConnectError {
    /// The name does not resolve.
    #[error("cannot find '{host}': {problem}")]
    Resolve {
        /// The name.
        host: String,
        /// The system's message.
        problem: String,
    },
    /// Nothing came back.
    #[error(
        "no answer from {host} on port {port}: is the server running, and does a firewall block UDP and TCP there?"
    )]
    NoAnswer {
        /// Name or address.
        host: String,
        /// UDP and TCP port.
        port: u16,
    },
    /// The certificate is not that of the link.
    #[error(
        "the certificate at {} is not the link's: the server was started again and printed a new link, or \
         someone is in between",
        place_of(host, *port)
    )]
    Certificate {
        /// Name or address.
        host: String,
        /// UDP and TCP port.
        port: u16,
        /// Fingerprint in the link.
        expected: Fingerprint,
        /// Fingerprint of the server.
        found: Fingerprint,
    },
    /// The server speaks another version and does not say which, so it is from before servers did.
    #[error(
        "the server speaks an older protocol version than this viewer ({PROTOCOL_VERSION}): update the server's isinglass"
    )]
    Version,
    /// The server refuses.
    #[error("{0}")]
    Refused(Refusal),
    /// The server has too many pending connections.
    #[error("the server is too busy to take connections")]
    Busy,
    /// The same viewer has connected from elsewhere.
    #[error("this viewer has connected again from elsewhere")]
    Replaced,
    /// The server sent something unreadable.
    #[error("the server broke the protocol: {0}")]
    Protocol(String),
    /// The connection ended.
    #[error("connection lost: {0}")]
    Lost(String),
    /// This machine cannot send.
    #[error("cannot open a socket: {0}")]
    Socket(String),
    /// There was no result in the given time.
    #[error("not connected within {0:?}")]
    Undecided(Duration),
}

impl ConnectError {
    /// What only an expert compares: the fingerprints of certificates.
    pub fn details(&self) -> Option<String> {
        match self {
            Self::Certificate { expected, found, .. } => {
                Some(format!("expected the certificate {expected}, found {found}"))
            }
            _ => None,
        }
    }

    /// Whether a retry without changes on this side may succeed.
    pub fn is_temporary(&self) -> bool {
        match self {
            Self::Certificate { .. } | Self::Version | Self::Replaced => false,
            Self::Refused(refusal) => refusal.is_temporary(),
            _ => true,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_may_pass_is_tried_again() {
        let fingerprint = crate::identity::Identity::generate().unwrap().fingerprint();
        let host = String::from("h");
        let certificate = ConnectError::Certificate {
            host: host.clone(),
            port: 1,
            expected: fingerprint,
            found: fingerprint,
        };
        for permanent in [certificate, ConnectError::Version, ConnectError::Refused(Refusal::UnknownToken)] {
            assert!(!permanent.is_temporary());
        }
        let no_answer = ConnectError::NoAnswer { host, port: 1 };
        for passing in [no_answer, ConnectError::Busy, ConnectError::Refused(Refusal::Full(1))] {
            assert!(passing.is_temporary());
        }
    }
}
