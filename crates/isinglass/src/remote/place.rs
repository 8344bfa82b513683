//! A volume on another machine, as a person writes it: `ssh://user@host:port/path`, `user@host:path` or `host:path`.

use std::fmt;

/// A volume on a machine that ssh reaches.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct RemoteVolume {
    /// Name of the user there; `None` leaves it to ssh.
    pub(super) user: Option<String>,
    /// Name or address as ssh knows it; an IPv6 address without brackets.
    pub(super) host: String,
    /// Port of ssh; `None` leaves it to ssh.
    pub(super) port: Option<u16>,
    /// The volume there: a path, from the home folder unless it begins with `/`, or a built-in volume.
    pub(super) path: String,
}

impl RemoteVolume {
    /// Reads a text; `None` if it does not name a volume on another machine.
    ///
    /// # Errors
    /// What is wrong with such a name.
    pub(crate) fn parse(text: &str) -> Option<Result<Self, String>> {
        let text = text.trim();
        if let Some(rest) = text.strip_prefix("ssh://") {
            return Some(Self::of_url(rest));
        }
        if text.contains("://") || text.starts_with("builtin:") {
            return None;
        }
        let end = match text.find('[').filter(|at| !text[..*at].contains([':', '/'])) {
            Some(bracket) => bracket + text[bracket..].find("]:")? + 1,
            None => text.find(':')?,
        };
        let (authority, path) = (&text[..end], &text[end + 1..]);
        // A drive of Windows, and a colon in the middle of a path.
        let is_drive = cfg!(windows) && authority.len() == 1;
        if authority.is_empty() || authority.contains('/') || is_drive {
            return None;
        }
        Some(Self::new(authority, None, path.to_owned()))
    }

    fn of_url(rest: &str) -> Result<Self, String> {
        let (authority, path) = rest.split_once('/').ok_or(EXPECTED)?;
        let (user, place) = authority.rsplit_once('@').map_or(("", authority), |(user, place)| (user, place));
        let (host, port) = match place.rsplit_once(':') {
            Some((host, port)) if !port.contains(']') => {
                let port = port.parse().ok().filter(|port| *port != 0u16);
                (host, Some(port.ok_or("expected a port from 1 to 65535 behind the host")?))
            }
            _ => (place, None),
        };
        let path = without_percents(path)?;
        let path =
            if path.starts_with("~/") || path.starts_with("builtin:") { path } else { format!("/{path}") };
        let at = if user.is_empty() { String::new() } else { format!("{user}@") };
        Self::new(&format!("{at}{host}"), port, path)
    }

    fn new(authority: &str, port: Option<u16>, path: String) -> Result<Self, String> {
        let (user, host) = match authority.rsplit_once('@') {
            Some((user, host)) => (Some(user), host),
            None => (None, authority),
        };
        let is_bracketed = host.starts_with('[') && host.ends_with(']') && host.len() > 2;
        let host = if is_bracketed { &host[1..host.len() - 1] } else { host };
        // ssh reads a name with a dash as an option, and its configuration may put names into commands.
        let is_good = |name: &str, others: &str| {
            let is_char = |c: char| c.is_alphanumeric() || others.contains(c);
            !name.is_empty() && !name.starts_with('-') && !name.ends_with('\\') && name.chars().all(is_char)
        };
        if !is_good(host, if is_bracketed { "._-:%" } else { "._-" }) {
            return Err("expected the name or address of a host before the path".into());
        }
        if !user.is_none_or(|user| is_good(user, "._-+@\\")) {
            return Err("expected the name of a user before the @".into());
        }
        if path.is_empty() || path == "/" || path == "~/" || path.contains('\0') {
            return Err(EXPECTED.into());
        }
        Ok(Self { user: user.map(str::to_owned), host: host.to_owned(), port, path })
    }

    /// The user and the host for ssh.
    pub(super) fn destination(&self) -> String {
        match &self.user {
            Some(user) => format!("{user}@{}", self.host),
            None => self.host.clone(),
        }
    }
}

/// The host, and the volume there.
impl fmt::Display for RemoteVolume {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.host, self.path)
    }
}

/// The path of a URL, in which `%20` stands for a blank.
fn without_percents(path: &str) -> Result<String, String> {
    let mut bytes = Vec::with_capacity(path.len());
    let mut rest = path.as_bytes();
    while let [first, after @ ..] = rest {
        let digit = |at: usize| (*after.get(at)? as char).to_digit(16);
        match (first, digit(0), digit(1)) {
            (b'%', Some(high), Some(low)) => {
                bytes.push((high << 4 | low) as u8);
                rest = &after[2..];
            }
            (b'%', ..) => return Err("expected two hexadecimal digits behind each %, and %25 for a %".into()),
            _ => {
                bytes.push(*first);
                rest = after;
            }
        }
    }
    String::from_utf8(bytes).map_err(|_| "expected a path in UTF-8".into())
}

const EXPECTED: &str =
    "expected a volume on another machine, such as ssh://user@host/data/scan.nrrd or host:/data/scan.nrrd";

#[cfg(test)]
mod tests {
    use super::*;

    fn place(user: Option<&str>, host: &str, port: Option<u16>, path: &str) -> RemoteVolume {
        RemoteVolume { user: user.map(str::to_owned), host: host.into(), port, path: path.into() }
    }

    #[test]
    fn both_forms_are_read() {
        for (text, expected) in [
            ("ssh://gpu/data/a.nrrd", place(None, "gpu", None, "/data/a.nrrd")),
            (
                "ssh://me@gpu.example.org:2222/~/a b.nrrd",
                place(Some("me"), "gpu.example.org", Some(2222), "~/a b.nrrd"),
            ),
            ("ssh://me@lab@gpu/a%20b%25", place(Some("me@lab"), "gpu", None, "/a b%")),
            ("ssh://[fe80::1%25]:22/x", place(None, "fe80::1%25", Some(22), "/x")),
            ("ssh://gpu/builtin:cloud@32", place(None, "gpu", None, "builtin:cloud@32")),
            ("gpu:/data/a.nrrd", place(None, "gpu", None, "/data/a.nrrd")),
            ("DOM\\me@gpu:scans/a:b.nrrd", place(Some("DOM\\me"), "gpu", None, "scans/a:b.nrrd")),
            ("me@[::1]:-x", place(Some("me"), "::1", None, "-x")),
            (" gpu:builtin:cloud ", place(None, "gpu", None, "builtin:cloud")),
        ] {
            assert_eq!(RemoteVolume::parse(text), Some(Ok(expected)), "{text}");
        }
    }

    #[test]
    fn what_is_a_file_or_a_link_is_left_alone_and_nonsense_is_refused() {
        for text in [
            "",
            "a.nrrd",
            "/a:b",
            "./a:b",
            "builtin:cloud",
            "isinglass://h:1/#x",
            "http://a/b",
            ":a",
            "[::1]",
        ] {
            assert_eq!(RemoteVolume::parse(text), None, "{text}");
        }
        for text in [
            "ssh://",
            "ssh://gpu",
            "ssh://gpu/",
            "ssh:///a",
            "ssh://-oProxyCommand=x/a",
            "ssh://gpu:0/a",
            "ssh://gpu:x/a",
            "ssh://a b/c",
            "ssh://-l@gpu/a",
            "ssh://gpu/%2",
            "ssh://gpu/%ff",
            "ssh://gpu/a%00b",
            "gpu:",
            "-x:/a",
            "a b:/c",
            "@gpu:/a",
            "$(x)@gpu:/a",
            "me\\@gpu:/a",
        ] {
            assert!(matches!(RemoteVolume::parse(text), Some(Err(_))), "{text}");
        }
    }
}
