//! The version of the protocol, and what peers of different versions tell each other.

/// Version of the protocol on a connection.
pub const PROTOCOL_VERSION: u32 = 20;
/// Protocol name in the TLS handshake: peers that share it speak the same version.
pub const ALPN: &[u8] = b"isinglass/20";
/// Protocol name of peers that share no version. The server then only tells its own version, by
/// [`version_notice`], and closes. This name and the notice stay the same in all versions.
pub const ALPN_ANY: &[u8] = b"isinglass/any";

/// The bytes by which a server tells its version.
pub fn version_notice() -> &'static [u8] {
    ALPN
}

/// The version in a notice; `None` if the bytes are none.
pub fn version_in_notice(bytes: &[u8]) -> Option<u32> {
    let digits = std::str::from_utf8(bytes.strip_prefix(b"isinglass/")?).ok()?;
    digits.bytes().all(|b| b.is_ascii_digit()).then(|| digits.parse().ok()).flatten()
}

/// The side with the lower version, in words for the person at the viewer.
pub(super) fn older_side(server: u32, client: u32) -> &'static str {
    if server < client { "the server's isinglass" } else { "the viewer's isinglass" }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_notice_tells_the_version_and_nothing_else_does() {
        assert_eq!(version_in_notice(version_notice()), Some(PROTOCOL_VERSION));
        for other in
            [&b""[..], b"isinglass/", ALPN_ANY, b"isinglass/+1", b"isinglass/99999999999", b"14", b"\xff"]
        {
            assert_eq!(version_in_notice(other), None, "{other:?}");
        }
    }
}
