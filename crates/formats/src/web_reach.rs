//! Where requests may go. A web server may be anybody's, and so may a name: neither may lead a request to a machine or a
//! port that the user did not name, such as a service that only this computer reaches.

use std::io;
use std::net::{IpAddr, Ipv6Addr, SocketAddr};

use ureq::config::Config;
use ureq::http::Uri;
use ureq::unversioned::resolver::{DefaultResolver, ResolvedSocketAddrs, Resolver};
use ureq::unversioned::transport::NextTimeout;

use crate::error::quoted;

/// The address to which an answer at `from` sends a request on, by its header `Location`. It must be on the same host and
/// port, and never falls from https to http. With `is_storage`, another server of the same object storage will do.
///
/// # Errors
/// One line that names the other place.
pub(crate) fn next_address(from: &str, location: &str, is_storage: bool) -> Result<String, String> {
    let location = location.split('#').next().unwrap_or_default();
    let refusal = |why: &str| format!("the server sends on to {}, {why}", quoted(without_query(location)));
    let bad = || refusal("expected an address");
    let next = joined(from, location).ok_or_else(bad)?;
    let parsed = |address: &str| origin(&address.parse().ok()?);
    let (old, new) = (parsed(from).ok_or_else(bad)?, parsed(&next).ok_or_else(bad)?);
    if old.is_secure && !new.is_secure {
        return Err(refusal("which is not encrypted as its own address is"));
    }
    let is_same_host = old.host == new.host;
    // The same server, with encryption.
    let is_upgrade = !old.is_secure && new.is_secure && (old.port, new.port) == (80, 443);
    if is_same_host && (old.port == new.port && old.is_secure == new.is_secure || is_upgrade) {
        return Ok(next);
    }
    if is_storage && new.is_secure && new.port == 443 && new.host.ends_with(STORAGE) {
        return Ok(next);
    }
    Err(refusal("expected an answer of its own; open that address if you trust it"))
}

struct WebOrigin {
    is_secure: bool,
    host: String,
    port: u16,
}

fn origin(uri: &Uri) -> Option<WebOrigin> {
    let is_secure = match uri.scheme_str()? {
        scheme if scheme.eq_ignore_ascii_case("https") => true,
        scheme if scheme.eq_ignore_ascii_case("http") => false,
        _ => return None,
    };
    // A name before an @ is a user's, and hides the host from a quick look.
    let authority = uri.authority().filter(|authority| !authority.as_str().contains('@'))?;
    let port = authority.port_u16().unwrap_or(if is_secure { 443 } else { 80 });
    Some(WebOrigin { is_secure, host: authority.host().to_ascii_lowercase(), port })
}

/// The absolute address of `location` beside `from`.
fn joined(from: &str, location: &str) -> Option<String> {
    let (scheme, rest) = from.split_once("://")?;
    let end = rest.find(['/', '?', '#']).unwrap_or(rest.len());
    let (authority, path) = rest.split_at(end);
    let path = path.split(['?', '#']).next().unwrap_or_default();
    let is_absolute =
        location.split_once(':').is_some_and(|(s, _)| s.chars().all(|c| c.is_ascii_alphanumeric()));
    Some(match location {
        "" => return None,
        _ if is_absolute => location.to_owned(),
        _ if location.starts_with("//") => format!("{scheme}:{location}"),
        _ if location.starts_with('/') => format!("{scheme}://{authority}{location}"),
        _ if location.starts_with('?') => format!("{scheme}://{authority}{path}{location}"),
        _ => format!(
            "{scheme}://{authority}{}/{location}",
            path.rsplit_once('/').map_or("", |(folder, _)| folder)
        ),
    })
}

fn without_query(address: &str) -> &str {
    address.split('?').next().unwrap_or_default()
}

/// Resolves names as the system does, and leaves out addresses that a name must not lead to.
#[derive(Debug, Default)]
pub(crate) struct GuardedResolver(DefaultResolver);

impl Resolver for GuardedResolver {
    fn resolve(
        &self,
        uri: &Uri,
        config: &Config,
        timeout: NextTimeout,
    ) -> Result<ResolvedSocketAddrs, ureq::Error> {
        let found = self.0.resolve(uri, config, timeout)?;
        let host = uri.host().unwrap_or_default();
        // Whoever set the proxy means it, and the proxy decides where it goes.
        let is_proxy = config.proxy().is_some_and(|proxy| proxy.host() == host);
        if is_proxy || uri.scheme_str() == Some("https") || is_local_name(host) {
            return Ok(found);
        }
        let mut reached = self.empty();
        found.iter().filter(|at| local_kind(at.ip()).is_none()).for_each(|at| reached.push(*at));
        match found.iter().find(|_| reached.is_empty()) {
            None => Ok(reached),
            Some(at) => {
                Err(ureq::Error::Io(io::Error::new(io::ErrorKind::PermissionDenied, refusal(host, *at))))
            }
        }
    }
}

fn refusal(host: &str, at: SocketAddr) -> String {
    let kind = local_kind(at.ip()).unwrap_or("public");
    format!(
        "{} leads to {}, a {kind} address; open http://{at}/ if you mean that machine",
        quoted(host),
        at.ip()
    )
}

/// Whether a host names a machine of one's own network by itself: a literal address, a name without a dot, or one of the
/// endings that no public name has (RFC 6761, RFC 6762, RFC 8375 and ICANN's list of 2024). Other names belong to whoever
/// bought them, who may let them lead anywhere. By https this does not matter, as the certificate proves that the machine
/// is meant.
fn is_local_name(host: &str) -> bool {
    let name = host.trim_start_matches('[').trim_end_matches(']').trim_end_matches('.').to_ascii_lowercase();
    let is_literal = name.parse::<IpAddr>().is_ok();
    is_literal || !name.contains('.') || LOCAL_ENDINGS.iter().any(|ending| name.ends_with(ending))
}

/// What kind of address it is, if it is not a public one.
fn local_kind(at: IpAddr) -> Option<&'static str> {
    let six = match at {
        IpAddr::V4(four) => {
            let [a, b, ..] = four.octets();
            return match (a, b) {
                _ if four.is_loopback() || a == 0 => Some("loopback"),
                _ if four.is_link_local() => Some("link-local"),
                _ if four.is_private() => Some("private"),
                // Shared by the customers of a provider (RFC 6598); tests and documents (RFC 2544, RFC 5737).
                (100, 64..128) | (198, 18 | 19) => Some("private"),
                _ if four.is_multicast() || a >= 240 => Some("special"),
                _ => None,
            };
        }
        IpAddr::V6(six) => six,
    };
    if six.is_loopback() || six.is_unspecified() {
        return Some("loopback");
    }
    if let Some(four) = four_within(six) {
        return local_kind(four);
    }
    match six.segments()[0] {
        0xfe80..=0xfebf => Some("link-local"),
        // Unique local (RFC 4193), and the site-local ones before them.
        0xfc00..=0xfdff | 0xfec0..=0xfeff => Some("private"),
        0xff00..=0xffff => Some("special"),
        _ => None,
    }
}

/// The IPv4 address that an IPv6 one stands for: mapped, compatible, by NAT64 (RFC 6052) or by 6to4 (RFC 3056).
fn four_within(six: Ipv6Addr) -> Option<IpAddr> {
    let last = u32::try_from(six.to_bits() & u128::from(u32::MAX)).unwrap_or_default();
    let four = match six.segments() {
        [0, 0, 0, 0, 0, 0 | 0xffff, ..] | [0x64, 0xff9b, 0, 0, 0, 0, ..] => last,
        [0x2002, high, low, ..] => u32::from(high) << 16 | u32::from(low),
        _ => return None,
    };
    Some(IpAddr::from(four.to_be_bytes()))
}

/// What the names of this object storage end with.
const STORAGE: &str = ".amazonaws.com";
const LOCAL_ENDINGS: [&str; 6] = [".localhost", ".local", ".lan", ".home.arpa", ".internal", ".localdomain"];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn redirects_stay_on_the_host_and_encrypted() {
        let at = "http://data.example.org:8000/a/b.zarr/0?t=1";
        for (location, next) in [
            ("/c", "http://data.example.org:8000/c"),
            ("c?x#y", "http://data.example.org:8000/a/b.zarr/c?x"),
            ("?t=2", "http://data.example.org:8000/a/b.zarr/0?t=2"),
            ("//DATA.example.org:8000/c", "http://DATA.example.org:8000/c"),
            ("http://data.example.org:8000/a:b", "http://data.example.org:8000/a:b"),
        ] {
            assert_eq!(next_address(at, location, false).as_deref(), Ok(next), "{location}");
        }
        for location in [
            "http://127.0.0.1:8000/",
            "http://data.example.org:22/",
            "https://data.example.org/",
            "http://data.example.org.evil.com:8000/",
            "http://data.example.org:8000@evil.com/",
            "http://x@data.example.org:8000/",
            "//evil.com/",
            "file:///etc/passwd",
            "ftp://data.example.org:8000/",
            "http://[::1]:8000/",
            "http:///",
            "",
        ] {
            let line = next_address(at, location, true).unwrap_err();
            assert!(line.starts_with("the server sends on to") && !line.contains('\n'), "{line}");
        }
        let secure = "https://data.example.org/a";
        assert!(next_address("http://data.example.org/a", secure, false).is_ok());
        assert!(next_address(secure, "http://data.example.org/a", false).unwrap_err().contains("encrypted"));
        let bucket = ("https://b.s3.amazonaws.com/x", "https://b.s3.eu-west-1.amazonaws.com/x");
        assert!(
            next_address(bucket.0, bucket.1, true).is_ok()
                && next_address(bucket.0, bucket.1, false).is_err()
        );
    }

    #[test]
    fn addresses_that_only_this_network_has_are_known() {
        for (text, kind) in [
            ("127.0.0.1", "loopback"),
            ("127.8.9.1", "loopback"),
            ("0.0.0.0", "loopback"),
            ("::1", "loopback"),
            ("::", "loopback"),
            ("::ffff:127.0.0.1", "loopback"),
            ("::127.0.0.1", "loopback"),
            ("64:ff9b::7f00:1", "loopback"),
            ("2002:7f00:1::", "loopback"),
            ("169.254.169.254", "link-local"),
            ("fe80::1", "link-local"),
            ("10.1.2.3", "private"),
            ("172.31.0.1", "private"),
            ("192.168.0.1", "private"),
            ("100.64.0.1", "private"),
            ("::ffff:10.0.0.1", "private"),
            ("fd00::1", "private"),
            ("fec0::1", "private"),
            ("224.0.0.1", "special"),
            ("255.255.255.255", "special"),
            ("ff02::1", "special"),
        ] {
            assert_eq!(local_kind(text.parse().unwrap()), Some(kind), "{text}");
        }
        for public in ["8.8.8.8", "172.32.0.1", "100.128.0.1", "2001:4860:4860::8888", "::ffff:8.8.8.8"] {
            assert_eq!(local_kind(public.parse().unwrap()), None, "{public}");
        }
        for local in ["127.0.0.1", "[::1]", "localhost", "LOCALHOST.", "nas", "nas.local", "a.b.internal"] {
            assert!(is_local_name(local), "{local}");
        }
        for public in
            ["example.org", "127.0.0.1.example.org", "local.example.org", "0x7f.0.0.1", "x.notlocal"]
        {
            assert!(!is_local_name(public), "{public}");
        }
    }
}
