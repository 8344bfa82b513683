//! Files at addresses of the web, by HTTP. Buckets of S3 that everybody may read are addressed by HTTP too. No request
//! waits for ever, and no answer takes more memory than the caller allows.

use std::io;
use std::path::Path;
use std::thread;
use std::time::Duration;

use ureq::http::{Response, StatusCode};
use ureq::unversioned::transport::DefaultConnector;
use ureq::{Agent, Body};

use crate::error::{FormatError, one_line, shown};
use crate::web_reach::{GuardedResolver, next_address};

/// A client for the files below one address.
pub(crate) struct WebFolder {
    agent: Agent,
    /// The address as the user wrote it, without its query.
    shown: String,
    /// The address for requests, without a slash at its end.
    base: String,
    /// What follows each address, such as `?token=…`; empty if nothing does.
    query: String,
    /// Whether it is a bucket, which the storage may keep on another of its servers.
    is_bucket: bool,
}

/// What to get of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum FilePart {
    Whole,
    /// So many bytes from an offset.
    At(u64, u64),
    /// So many bytes at the end.
    End(u64),
}

/// Whether `source` is an address of the web, at which an OME-Zarr image may be.
pub fn is_address(source: &str) -> bool {
    ["http://", "https://", "s3://"]
        .iter()
        .any(|scheme| source.get(..scheme.len()).is_some_and(|start| start.eq_ignore_ascii_case(scheme)))
}

/// An address as it is shown: without its query, which may be secret.
pub(crate) fn shown_address(address: &str) -> &str {
    parts(address).0
}

/// Whom a request to an address calls, for a question to the user: the host and its port, or the bucket.
pub(crate) fn host_of_address(address: &str) -> String {
    let shown = shown_address(address);
    let rest = shown.split_once("://").map_or(shown, |(_, rest)| rest);
    let authority = rest.split(['/', '\\']).next().unwrap_or_default();
    // What stands before an @ is a user's name, which could look like a host.
    let host = authority.rsplit('@').next().unwrap_or_default();
    let host = if is_bucket(shown) { format!("s3://{host}") } else { host.to_owned() };
    one_line(&host)
}

/// An address without a slash at its end, and its query for every file below it.
fn parts(address: &str) -> (&str, String) {
    let address = address.split('#').next().unwrap_or_default();
    let (place, query) = address.split_once('?').unwrap_or((address, ""));
    let query = if query.is_empty() { String::new() } else { format!("?{query}") };
    (place.trim_end_matches('/'), query)
}

impl WebFolder {
    /// The folder at `address`. Nothing is requested yet.
    pub(crate) fn new(address: &str) -> Self {
        Self::with_timeouts(address, CONNECT_TIME, ANSWER_TIME)
    }

    fn with_timeouts(address: &str, connect: Duration, answer: Duration) -> Self {
        let config = Agent::config_builder()
            .timeout_connect(Some(connect))
            .timeout_recv_response(Some(answer))
            .timeout_global(Some(answer * 3))
            .max_redirects(0)
            .http_status_as_error(false)
            .user_agent("isinglass")
            .build();
        let (place, query) = parts(address);
        let shown = place.to_owned();
        let agent = Agent::with_parts(config, DefaultConnector::default(), GuardedResolver::default());
        Self { agent, base: http_address(&shown), is_bucket: is_bucket(&shown), shown, query }
    }

    /// The address as the user wrote it, without its query, which may be secret.
    pub(crate) fn address(&self) -> &str {
        &self.shown
    }

    /// Gets a part of the file at `path`, which begins with [`WebFolder::address`]. Returns its bytes and the length of
    /// the file, or `None` if there is no such file.
    ///
    /// # Errors
    /// The server does not answer in time, refuses, or sends more or less than was asked for.
    pub(crate) fn read(
        &self,
        path: &Path,
        part: FilePart,
        most: u64,
    ) -> Result<Option<(Vec<u8>, u64)>, FormatError> {
        let mut wait = FIRST_WAIT;
        for _ in 0..MAX_AGAIN {
            match self.read_once(path, part, most) {
                Err(Failure::Passing(after, _)) => thread::sleep(after.unwrap_or(wait).min(LONGEST_WAIT)),
                Err(Failure::Lasting(e)) => return Err(e),
                Ok(found) => return Ok(found),
            }
            wait *= 2;
        }
        self.read_once(path, part, most).map_err(|failure| match failure {
            Failure::Passing(_, e) | Failure::Lasting(e) => e,
        })
    }

    fn read_once(&self, path: &Path, part: FilePart, most: u64) -> Result<Option<(Vec<u8>, u64)>, Failure> {
        let bad = |problem: String| Failure::Lasting(FormatError::Data { path: shown(path), problem });
        let mut answer = self.request(path, part)?;
        let status = answer.status();
        match status.as_u16() {
            200 | 206 => {}
            // Buckets without a public list refuse access to what is not there.
            403 | 404 | 410 => return Ok(None),
            // The server is busy, or something before it is.
            429 | 500 | 502..=504 => {
                let cause = io::Error::other(unexpected(status));
                return Err(Failure::Passing(wait_of(&answer), FormatError::Io { path: shown(path), cause }));
            }
            // It may answer otherwise later, but not soon.
            501 | 505..=599 => {
                let cause = io::Error::other(unexpected(status));
                return Err(Failure::Lasting(FormatError::Io { path: shown(path), cause }));
            }
            _ => return Err(bad(unexpected(status))),
        }
        let wanted = match part {
            FilePart::Whole => None,
            FilePart::At(_, size) | FilePart::End(size) => Some(size),
        };
        if wanted.is_some_and(|size| size > most) {
            return Err(bad(format!("{} bytes, expected at most {most}", wanted.unwrap_or(0))));
        }
        if part != FilePart::Whole && status != StatusCode::PARTIAL_CONTENT {
            return Err(bad("the server sends no parts of files, expected one that does".into()));
        }
        let whole = length_of(&answer);
        let limit = wanted.unwrap_or(most);
        let long = || bad(format!("the server sends more bytes, expected at most {limit}"));
        let body = answer.body_mut().with_config().limit(limit.saturating_add(1)).read_to_vec();
        let bytes = body.map_err(|e| match e {
            ureq::Error::BodyExceedsLimit(_) => long(),
            e => self.failure(path, &e),
        })?;
        let found = bytes.len() as u64;
        if found > limit {
            return Err(long());
        }
        if let Some(size) = wanted.filter(|size| *size != found) {
            return Err(bad(format!("the server sends {found} bytes, expected {size}")));
        }
        Ok(Some((bytes, whole.unwrap_or(found))))
    }

    /// Asks for a part of a file. Where the server sends on to another place of its own, that is asked.
    fn request(&self, path: &Path, part: FilePart) -> Result<Response<Body>, Failure> {
        let inner = path.strip_prefix(&self.shown).unwrap_or(path);
        let names = inner.iter().map(|name| escaped(&name.to_string_lossy()));
        let address = std::iter::once(self.base.clone()).chain(names).collect::<Vec<_>>().join("/");
        let mut address = address + &self.query;
        let refused = |line: String| {
            let cause = io::Error::new(io::ErrorKind::PermissionDenied, one_line(&line));
            Failure::Lasting(FormatError::Io { path: shown(path), cause })
        };
        for _ in 0..=MAX_REDIRECTS {
            let answer = self.ask(&address, part).map_err(|e| self.failure(path, &e))?;
            if !matches!(answer.status().as_u16(), 301..=303 | 307 | 308) {
                return Ok(answer);
            }
            let location = answer.headers().get("location").and_then(|text| text.to_str().ok());
            let Some(location) = location else { return Ok(answer) };
            address = next_address(&address, location, self.is_bucket).map_err(refused)?;
        }
        Err(refused(format!("the server sends on more than {MAX_REDIRECTS} times")))
    }

    fn ask(&self, address: &str, part: FilePart) -> Result<Response<Body>, ureq::Error> {
        let request = self.agent.get(address);
        match part {
            FilePart::Whole => request,
            FilePart::At(at, size) => {
                request.header("Range", format!("bytes={at}-{}", at.saturating_add(size).saturating_sub(1)))
            }
            FilePart::End(size) => request.header("Range", format!("bytes=-{size}")),
        }
        .call()
    }

    /// A connection that was dropped may be made again. One that is only slow would be slow again.
    fn failure(&self, path: &Path, e: &ureq::Error) -> Failure {
        let path = shown(path);
        match e {
            ureq::Error::Timeout(_) => {
                let cause = io::Error::new(io::ErrorKind::TimedOut, "the server does not answer in time");
                Failure::Lasting(FormatError::Io { path, cause })
            }
            // No other try leads elsewhere.
            ureq::Error::Io(e) if e.kind() == io::ErrorKind::PermissionDenied => {
                let cause = io::Error::new(e.kind(), one_line(&e.to_string()));
                Failure::Lasting(FormatError::Io { path, cause })
            }
            e => {
                let cause = io::Error::other(one_line(&e.to_string()));
                Failure::Passing(None, FormatError::Io { path, cause })
            }
        }
    }
}

/// Why a file was not read.
enum Failure {
    /// It may be there later, after the time that the server names.
    Passing(Option<Duration>, FormatError),
    Lasting(FormatError),
}

fn unexpected(status: StatusCode) -> String {
    format!("the server answers {status}, expected the file")
}

/// The seconds after which a busy server wants to be asked again.
fn wait_of(answer: &Response<Body>) -> Option<Duration> {
    let seconds: u32 = answer.headers().get("retry-after")?.to_str().ok()?.trim().parse().ok()?;
    Some(Duration::from_secs(seconds.into()))
}

/// The length of the whole file, from the headers of an answer.
fn length_of(answer: &Response<Body>) -> Option<u64> {
    let header = |name: &str| answer.headers().get(name)?.to_str().ok();
    match header("content-range") {
        // Such as `bytes 0-99/1234`.
        Some(range) => range.rsplit_once('/')?.1.parse().ok(),
        None => header("content-length")?.parse().ok(),
    }
}

fn is_bucket(address: &str) -> bool {
    address.get(..5).is_some_and(|start| start.eq_ignore_ascii_case("s3://"))
}

/// The address of a bucket by HTTP. One with a dot in its name has no certificate of its own.
fn http_address(address: &str) -> String {
    let Some(place) = address.get(5..).filter(|_| is_bucket(address)) else { return address.to_owned() };
    let (bucket, key) = place.split_once('/').unwrap_or((place, ""));
    let key = key.split('/').map(escaped).collect::<Vec<_>>().join("/");
    let address = match bucket.contains('.') {
        true => format!("https://s3.amazonaws.com/{bucket}/{key}"),
        false => format!("https://{bucket}.s3.amazonaws.com/{key}"),
    };
    address.trim_end_matches('/').to_owned()
}

/// The name of a file in an address.
fn escaped(name: &str) -> String {
    let is_plain = |b: u8| b.is_ascii_alphanumeric() || b"-._~!$&'()*+,;=:@".contains(&b);
    name.bytes().map(|b| if is_plain(b) { char::from(b).to_string() } else { format!("%{b:02X}") }).collect()
}

const CONNECT_TIME: Duration = Duration::from_secs(15);
/// Until an answer begins. All of it may take three times as long.
const ANSWER_TIME: Duration = Duration::from_secs(30);
const MAX_REDIRECTS: u32 = 5;
/// How often a file is asked for again.
const MAX_AGAIN: u32 = 4;
/// Until it is asked for again; twice as long each time.
const FIRST_WAIT: Duration = Duration::from_millis(100);
const LONGEST_WAIT: Duration = Duration::from_secs(2);

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};
    use std::net::TcpListener;
    use std::thread;

    use super::*;

    /// A server that says `answer` to each request and keeps the connection for a second. Returns its address.
    fn server(answer: &'static [u8]) -> String {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = format!("http://{}", listener.local_addr().unwrap());
        thread::spawn(move || {
            for stream in listener.incoming() {
                let mut stream = stream.unwrap();
                thread::spawn(move || {
                    let _ = stream.read(&mut [0; 4096]);
                    let _ = stream.write_all(answer);
                    thread::sleep(Duration::from_secs(1));
                });
            }
        });
        address
    }

    fn got(answer: &'static [u8], part: FilePart, most: u64) -> Result<Option<(Vec<u8>, u64)>, String> {
        let address = server(answer);
        let folder = WebFolder::with_timeouts(&address, Duration::from_secs(5), Duration::from_millis(200));
        folder.read(&Path::new(&address).join("a b"), part, most).map_err(|e| e.to_string())
    }

    #[test]
    fn answers_are_bounded_in_time_and_size() {
        let whole = |answer, most| got(answer, FilePart::Whole, most);
        let good = b"HTTP/1.1 200 OK\r\nContent-Length: 5\r\n\r\nhello";
        assert_eq!(whole(good, 5), Ok(Some((b"hello".to_vec(), 5))));
        let fails = |found: Result<_, String>, words: &str| {
            let message = found.unwrap_err();
            assert!(message.contains(words) && message.lines().count() == 1, "{message}");
        };
        fails(whole(good, 4), "expected at most 4");
        // Without a length, and with a wrong one.
        fails(whole(b"HTTP/1.1 200 OK\r\nContent-Length: 999999999999\r\n\r\nhello", 1000), "a b");
        fails(whole(b"HTTP/1.1 200 OK\r\nContent-Length: 9\r\n\r\nhello", 1000), "a b");
        // It never answers, or stops in the middle.
        fails(whole(b"", 1000), "does not answer in time");
        fails(whole(b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n5\r\nhello\r\n", 1000), "in time");
        fails(whole(b"nonsense\r\n\r\n", 1000), "a b");
        fails(
            whole(b"HTTP/1.1 500 Oh\r\nConnection: close\r\nContent-Length: 0\r\n\r\n", 1000),
            "the server answers 500",
        );
        assert_eq!(whole(b"HTTP/1.1 404 No\r\nContent-Length: 0\r\n\r\n", 9), Ok(None));
        assert_eq!(whole(b"HTTP/1.1 403 No\r\nContent-Length: 0\r\n\r\n", 9), Ok(None));
    }

    #[test]
    fn parts_are_those_that_were_asked_for() {
        let part = b"HTTP/1.1 206 Part\r\nContent-Length: 3\r\nContent-Range: bytes 2-4/17\r\n\r\nllo";
        assert_eq!(got(part, FilePart::At(2, 3), 9), Ok(Some((b"llo".to_vec(), 17))));
        assert!(got(part, FilePart::At(2, 4), 9).unwrap_err().contains("3 bytes, expected 4"));
        assert!(got(part, FilePart::End(10), 9).unwrap_err().contains("expected at most 9"));
        let whole = b"HTTP/1.1 200 OK\r\nContent-Length: 5\r\n\r\nhello";
        assert!(got(whole, FilePart::At(2, 3), 9).unwrap_err().contains("sends no parts of files"));
    }

    #[test]
    fn a_query_follows_each_address_and_is_not_shown() {
        for (address, place, query) in [
            ("https://a/b.zarr?token=x/y#z", "https://a/b.zarr", "?token=x/y"),
            ("https://a/b.zarr/?", "https://a/b.zarr", ""),
            ("s3://a/b/", "s3://a/b", ""),
        ] {
            assert_eq!((shown_address(address), parts(address).1.as_str()), (place, query));
        }
    }

    #[test]
    fn whom_an_address_calls_is_told() {
        for (address, host) in [
            ("https://data.example.org/a.zarr?t=1", "data.example.org"),
            ("http://data.example.org:8000", "data.example.org:8000"),
            ("http://data.example.org@evil.com/a", "evil.com"),
            ("http://evil.com\\@data.example.org/a", "evil.com"),
            ("http://[::1]:80/a", "[::1]:80"),
            ("s3://bucket/a", "s3://bucket"),
        ] {
            assert_eq!(host_of_address(address), host, "{address}");
        }
    }

    #[test]
    fn buckets_have_addresses() {
        for (address, expected) in [
            ("s3://janelia-cosem/a b/c.zarr", "https://janelia-cosem.s3.amazonaws.com/a%20b/c.zarr"),
            ("S3://my.bucket/c.zarr", "https://s3.amazonaws.com/my.bucket/c.zarr"),
            ("https://example.org/c%20d.zarr", "https://example.org/c%20d.zarr"),
        ] {
            assert!(is_address(address));
            assert_eq!(http_address(address), expected);
        }
        for other in ["ftp://a/b", "isinglass://a", "http:/a", "/data/http://a", "s3:/a", "µ"] {
            assert!(!is_address(other), "{other}");
        }
    }
}
