//! The link that a server prints for a viewer: `isinglass://host:port/#token=<32 hex digits>&cert=sha256:<64 hex
//! digits>`, optionally with `&state=<what to show>`.
//!
//! Secrets stand behind the `#`, which browsers and proxies do not pass on. `Debug` hides the token.
//!
//! A link that a viewer copies for others has a state but no token ([`Link::of_state`]): its own token is used up,
//! and the server decides who gets in. [`state_of_link`] finds the state in either kind.

use std::fmt;
use std::str::FromStr;

use isinglass_core::text::printable;
use isinglass_core::wire::Token;

use crate::identity::Fingerprint;

/// The address of a server, its identity, and the view to open.
#[derive(Clone, Debug)]
pub struct Link {
    /// Name or address; an IPv6 address without brackets.
    pub host: String,
    /// UDP and TCP port.
    pub port: u16,
    /// Admits one viewer.
    pub token: Token,
    /// Fingerprint of the server's certificate.
    pub fingerprint: Fingerprint,
    /// The first view in base64url characters, which this crate does not interpret.
    pub state: Option<String>,
}

impl Link {
    /// The server's address as `host:port`.
    pub fn place(&self) -> String {
        place_of(&self.host, self.port)
    }

    /// A link to the same server that shows `state` and admits nobody.
    pub fn of_state(&self, state: &str) -> String {
        format!("{SCHEME}{}/#cert={}&state={state}", self.place(), self.fingerprint)
    }
}

/// Joins host and port; an IPv6 address gets brackets.
pub fn place_of(host: &str, port: u16) -> String {
    if host.contains(':') { format!("[{host}]:{port}") } else { format!("{host}:{port}") }
}

/// What is wrong with a link.
#[derive(Clone, Debug, thiserror::Error, PartialEq, Eq)]
pub enum LinkError {
    /// It does not begin like a link.
    #[error("not an isinglass link: expected 'isinglass://host:port/#token=…&cert=sha256:…', found '{0}'")]
    Scheme(String),
    /// The host or port cannot be read.
    #[error("link without a host and port: expected 'host:port' after 'isinglass://', found '{0}'")]
    Authority(String),
    /// A part behind the `#` is missing.
    #[error("link without '{0}='; it may have been cut when it was copied (a shell needs quotes around it)")]
    Missing(&'static str),
    /// The token cannot be read.
    #[error("link with a damaged token: {0}")]
    Token(String),
    /// The fingerprint cannot be read.
    #[error("link with a damaged certificate fingerprint: {0}")]
    Fingerprint(String),
    /// The link shows a state but admits nobody.
    #[error(
        "a link without a token shows a view to those who have a link of their own: open that one with --state and this link, \
         or paste this one into the viewer's window"
    )]
    StateOnly,
    /// The state is too long or contains invalid characters.
    #[error(
        "link with a damaged state; it may have been cut or changed when it was copied (a shell needs quotes around it)"
    )]
    State,
    /// A part behind the `#` is unknown.
    #[error("link with an unknown part '{0}', expected 'token', 'cert' and 'state'")]
    Unknown(String),
}

impl FromStr for Link {
    type Err = LinkError;

    fn from_str(s: &str) -> Result<Self, LinkError> {
        let Parts { host, port, token, fingerprint, state } = Parts::of(s)?;
        let no_token = if state.is_some() { LinkError::StateOnly } else { LinkError::Missing("token") };
        Ok(Self {
            host,
            port,
            token: token.ok_or(no_token)?,
            fingerprint: fingerprint.ok_or(LinkError::Missing("cert"))?,
            state,
        })
    }
}

/// The state in a link, with or without a token.
///
/// # Errors
/// If it is no link, or has no state.
pub fn state_of_link(s: &str) -> Result<String, LinkError> {
    Parts::of(s)?.state.ok_or(LinkError::Missing("state"))
}

struct Parts {
    host: String,
    port: u16,
    token: Option<Token>,
    fingerprint: Option<Fingerprint>,
    state: Option<String>,
}

impl Parts {
    fn of(s: &str) -> Result<Self, LinkError> {
        let s = s.trim();
        let shown = |s: &str| printable(s, 40);
        let rest = s.strip_prefix(SCHEME).ok_or_else(|| {
            // The message omits everything behind the '#', which may be secret.
            LinkError::Scheme(shown(s.split('#').next().unwrap_or_default()))
        })?;
        let (authority, fragment) = rest.split_once('#').unwrap_or((rest, ""));
        let authority = authority.strip_suffix('/').unwrap_or(authority);
        let bad_authority = || LinkError::Authority(shown(authority));
        let (host, port) = authority.rsplit_once(':').ok_or_else(bad_authority)?;
        let is_bracketed = host.starts_with('[') && host.ends_with(']');
        let host = if is_bracketed { &host[1..host.len() - 1] } else { host };
        let is_good =
            |c: char| c.is_ascii_alphanumeric() || ".-_".contains(c) || is_bracketed && ":%".contains(c);
        if host.is_empty() || host.len() > 255 || !host.chars().all(is_good) {
            return Err(bad_authority());
        }
        let port = port.parse().ok().filter(|&p: &u16| p != 0).ok_or_else(bad_authority)?;
        let mut parts = Self { host: host.to_owned(), port, token: None, fingerprint: None, state: None };
        for part in fragment.split('&').filter(|p| !p.is_empty()) {
            match part.split_once('=') {
                Some(("token", v)) => {
                    parts.token = Some(v.parse().map_err(|e| LinkError::Token(format!("{e}")))?);
                }
                Some(("cert", v)) => parts.fingerprint = Some(v.parse().map_err(LinkError::Fingerprint)?),
                Some(("state", v)) => {
                    let is_good = |c: char| c.is_ascii_alphanumeric() || "-_".contains(c);
                    if v.is_empty() || v.len() > MAX_STATE_CHARS || !v.chars().all(is_good) {
                        return Err(LinkError::State);
                    }
                    parts.state = Some(v.to_owned());
                }
                _ => return Err(LinkError::Unknown(shown(part.split('=').next().unwrap_or_default()))),
            }
        }
        Ok(parts)
    }
}

/// The whole link, with its secret.
impl fmt::Display for Link {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { token, fingerprint, state, .. } = self;
        write!(f, "{SCHEME}{}/#token={}&cert={fingerprint}", self.place(), token.reveal())?;
        state.as_ref().map_or(Ok(()), |state| write!(f, "&state={state}"))
    }
}

const SCHEME: &str = "isinglass://";
/// Longest state in a link, characters.
const MAX_STATE_CHARS: usize = 64 << 10;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::identity::{Identity, random_token};

    #[test]
    fn a_link_survives_its_text() {
        for host in ["127.0.0.1", "::1", "render-01.example.org"] {
            let fingerprint = Identity::generate().unwrap().fingerprint();
            let token = random_token().unwrap();
            let link = Link { host: host.into(), port: 4433, token, fingerprint, state: None };
            let again: Link = format!(" {link}\n").parse().unwrap();
            assert_eq!((&again.host, again.port, again.fingerprint), (&link.host, 4433, fingerprint));
            assert!(again.token.matches(&link.token));
            assert!(!format!("{link:?}").contains(&link.token.reveal()));
            assert_eq!(state_of_link(&link.to_string()), Err(LinkError::Missing("state")));
            let seen = Link { state: Some("aB-_9".into()), ..link.clone() };
            let again: Link = seen.to_string().parse().unwrap();
            assert_eq!((again.state.as_deref(), again.port), (Some("aB-_9"), 4433));
            let shared = link.of_state("aB-_9");
            assert!(!shared.contains("token") && !shared.contains(&link.token.reveal()), "{shared}");
            for text in [&shared, &seen.to_string()] {
                assert_eq!(state_of_link(text).as_deref(), Ok("aB-_9"));
            }
            assert_eq!(shared.parse::<Link>().unwrap_err(), LinkError::StateOnly);
        }
    }

    #[test]
    fn what_is_wrong_is_named() {
        let token = "00112233445566778899aabbccddeeff";
        let cert = format!("sha256:{}", "ab".repeat(32));
        let error = |s: &str| s.parse::<Link>().unwrap_err();
        assert!(format!("isinglass://h:1/#token={token}&cert={cert}").parse::<Link>().is_ok());
        assert!(matches!(error(""), LinkError::Scheme(_)));
        assert_eq!(error(&format!("http://h:1/#token={token}")), LinkError::Scheme("http://h:1/".into()));
        for authority in ["", "h", "h:", "h:0", "h:99999", ":1", "a b:1", "::1:1", "[::1]"] {
            let s = format!("isinglass://{authority}/#token={token}&cert={cert}");
            assert!(matches!(error(&s), LinkError::Authority(_)), "{s}");
        }
        assert_eq!(error("isinglass://h:1"), LinkError::Missing("token"));
        assert_eq!(error(&format!("isinglass://h:1/#token={token}")), LinkError::Missing("cert"));
        assert!(matches!(error(&format!("isinglass://h:1/#token=12&cert={cert}")), LinkError::Token(_)));
        assert!(matches!(error("isinglass://h:1/#cert=sha256:12"), LinkError::Fingerprint(_)));
        for bad in ["", "a+b", "é", &"a".repeat(MAX_STATE_CHARS + 1)] {
            assert_eq!(
                error(&format!("isinglass://h:1/#token={token}&cert={cert}&state={bad}")),
                LinkError::State
            );
        }
        assert_eq!(error("isinglass://h:1/#tocken=1"), LinkError::Unknown("tocken".into()));
        assert!(!error(&format!("isinglass://h:1/#token={token}0")).to_string().contains(token));
    }
}
