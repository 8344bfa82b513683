//! OME-Zarr at an address of the web, from a server of files on this machine.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

use std::collections::VecDeque;
use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use isinglass_core::volume::{PageError, PageId, Volume};
use isinglass_formats::{
    FormatError, OpenOptions, Selection, ValuesOf, facts_at_once, open, open_paged, outline, source_exists,
};
use tempfile::TempDir;

/// A server of the files in a folder, over HTTP/1.1 with kept connections and ranges.
struct FileServer {
    address: String,
    requests: Arc<Mutex<Vec<String>>>,
    most_at_once: Arc<AtomicUsize>,
    /// What the next requests get in place of a file.
    faults: Arc<Mutex<VecDeque<Fault>>>,
}

/// How a request fails.
#[derive(Clone, Copy)]
enum Fault {
    /// Such a status, and that the client should come back at once.
    Status(u16),
    /// The connection ends in the middle of the file.
    Cut,
    /// Nothing is answered until there is another fault.
    Silence,
}

impl FileServer {
    fn start(folder: &Path) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = format!("http://{}", listener.local_addr().unwrap());
        let (requests, most_at_once) = (Arc::new(Mutex::new(Vec::new())), Arc::new(AtomicUsize::new(0)));
        let (folder, theirs, most) = (folder.to_owned(), Arc::clone(&requests), Arc::clone(&most_at_once));
        let faults = Arc::new(Mutex::new(VecDeque::new()));
        let faults_of_thread = Arc::clone(&faults);
        let now = Arc::new(AtomicUsize::new(0));
        thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                let (folder, requests, most, now) =
                    (folder.clone(), theirs.clone(), most.clone(), now.clone());
                let faults = faults_of_thread.clone();
                thread::spawn(move || {
                    let mut reader = BufReader::new(stream.try_clone().unwrap());
                    while serve(&mut reader, &stream, &folder, &requests, (&now, &most), &faults).is_some() {}
                });
            }
        });
        Self { address, requests, most_at_once, faults }
    }

    fn requests(&self) -> Vec<String> {
        std::mem::take(&mut self.requests.lock().unwrap())
    }
}

/// Answers one request; `None` at the end of the connection.
fn serve(
    reader: &mut BufReader<TcpStream>,
    mut stream: &TcpStream,
    folder: &Path,
    requests: &Mutex<Vec<String>>,
    (now, most): (&AtomicUsize, &AtomicUsize),
    faults: &Mutex<VecDeque<Fault>>,
) -> Option<()> {
    let mut first = String::new();
    reader.read_line(&mut first).ok().filter(|n| *n > 0)?;
    let (mut range, mut line) = (None, String::new());
    while reader.read_line(&mut line).ok()? > 2 {
        if let Some((name, value)) = line.split_once(':')
            && name.eq_ignore_ascii_case("range")
        {
            range = value
                .trim()
                .strip_prefix("bytes=")
                .and_then(|r| r.split_once('-'))
                .map(|(a, b)| (a.parse::<usize>().ok(), b.parse::<usize>().ok()));
        }
        line.clear();
    }
    most.fetch_max(now.fetch_add(1, Ordering::SeqCst) + 1, Ordering::SeqCst);
    // Long enough for others to arrive.
    thread::sleep(Duration::from_millis(3));
    let name = first.split(' ').nth(1)?.trim_start_matches('/').replace("%20", " ");
    requests.lock().unwrap().push(name.clone());
    let name = name.split('?').next()?;
    let fault = faults.lock().unwrap().pop_front();
    match fault {
        Some(Fault::Status(status)) => {
            now.fetch_sub(1, Ordering::SeqCst);
            let head = format!("HTTP/1.1 {status} Busy\r\nRetry-After: 0\r\nContent-Length: 0\r\n\r\n");
            return stream.write_all(head.as_bytes()).ok();
        }
        Some(Fault::Silence) => {
            while faults.lock().unwrap().is_empty() {
                thread::sleep(Duration::from_millis(5));
            }
        }
        Some(Fault::Cut) | None => {}
    }
    let answer = match fs::read(folder.join(name)) {
        Err(_) => b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n".to_vec(),
        Ok(bytes) => {
            let n = bytes.len();
            let (from, to) = match range {
                None => (0, n),
                Some((None, Some(last))) => (n.saturating_sub(last), n),
                Some((from, last)) => (from.unwrap_or(0), last.map_or(n, |last| (last + 1).min(n))),
            };
            let status = if range.is_some() { "206 Partial Content" } else { "200 OK" };
            let length = to - from;
            let head = format!(
                "HTTP/1.1 {status}\r\nContent-Length: {length}\r\nContent-Range: bytes {from}-{}/{n}\r\n\r\n",
                to.saturating_sub(1)
            );
            [head.as_bytes(), &bytes[from..to]].concat()
        }
    };
    now.fetch_sub(1, Ordering::SeqCst);
    if let Some(Fault::Cut) = fault {
        let _ = stream.write_all(&answer[..answer.len() - answer.len() / 4]);
        let _ = stream.shutdown(std::net::Shutdown::Both);
        return None;
    }
    stream.write_all(&answer).ok()
}

/// An image of plain bytes with two levels. Its voxels count up, in chunks of four along each side.
fn image(folder: &Path) -> PathBuf {
    let path = folder.join("an image.zarr");
    let write = |name: &str, bytes: &[u8]| {
        fs::create_dir_all(path.join(name).parent().unwrap()).unwrap();
        fs::write(path.join(name), bytes).unwrap();
    };
    write(
        ".zattrs",
        br#"{"multiscales": [{"version": "0.4", "axes": ["z", "y", "x"], "datasets": [{"path": "0"}, {"path": "1"}]}]}"#,
    );
    for (level, side) in [("0", 8u64), ("1", 4)] {
        let array = format!(
            r#"{{"zarr_format": 2, "shape": [{side}, {side}, {side}], "chunks": [4, 4, 4], "dtype": "|u1",
                 "compressor": null, "filters": null, "order": "C", "fill_value": 9, "dimension_separator": "/"}}"#
        );
        write(&format!("{level}/.zarray"), array.as_bytes());
        let chunks = side / 4;
        for n in 0..chunks.pow(3) {
            let at = [n / chunks / chunks, n / chunks % chunks, n % chunks];
            let number = |i: u64| {
                let inner = [i / 16, i / 4 % 4, i % 4];
                let [z, y, x] = [0, 1, 2].map(|k| at[k] * 4 + inner[k]);
                (x + side * (y + side * z)) as u8
            };
            let bytes: Vec<u8> = (0..64).map(number).collect();
            write(&format!("{level}/{}/{}/{}", at[0], at[1], at[2]), &bytes);
        }
    }
    path
}

fn opened(source: &str, selection: Selection) -> Result<Volume, FormatError> {
    open(source, &OpenOptions { selection, ..OpenOptions::default() })
}

fn numbers(volume: &Volume) -> Vec<f32> {
    (0..volume.voxels().len()).map(|i| volume.voxels().get(i)).collect()
}

#[test]
fn an_image_at_an_address_is_the_one_in_its_folder() {
    let folder = TempDir::new().unwrap();
    let path = image(folder.path());
    let server = FileServer::start(folder.path());
    let source = format!("{}/an%20image.zarr/", server.address);
    assert!(source_exists(&source) && server.requests().is_empty());
    let before = outline(&source, &OpenOptions::default()).unwrap();
    assert_eq!((before.dims, before.levels.len(), &before.name[..]), ([8; 3], 2, "an%20image.zarr"));
    assert!(server.requests().iter().all(|name| name.contains("/.z") || name.ends_with("zarr.json")));
    let all = Selection::default();
    let [here, there] = [path.to_str().unwrap(), &source].map(|source| opened(source, all).unwrap());
    assert_eq!(numbers(&there), numbers(&here));
    assert!(server.most_at_once.load(Ordering::SeqCst) > 1, "requests are on their way together");
    server.requests();
    // A region asks for its own chunks only.
    let region = Some("0:4,4:8,:".parse().unwrap());
    let part = opened(&source, Selection { region, ..all }).unwrap();
    assert_eq!((part.dims(), numbers(&part)[0]), ([4, 4, 8], 32.0));
    let is_chunk = |name: &&String| name.contains("/0/") && !name.contains("/.z") && !name.ends_with("json");
    assert_eq!(server.requests().iter().filter(is_chunk).count(), 2);
    // Absent chunks have the fill value.
    fs::remove_file(path.join("0/0/0/1")).unwrap();
    let volume = opened(&source, all).unwrap();
    assert_eq!(numbers(&volume)[..8], [0.0, 1.0, 2.0, 3.0, 9.0, 9.0, 9.0, 9.0]);
    assert!(volume.info.warnings.iter().any(|w| w.starts_with("chunks not found: 1 of 8")));
    // A chunk that is longer than it can be.
    fs::write(path.join("0/0/0/1"), vec![0; 200_000]).unwrap();
    let message = opened(&source, all).unwrap_err().to_string();
    assert!(message.contains("0/0/1") && message.contains("expected at most"), "{message}");
}

#[test]
fn facts_of_an_address_ask_for_the_coarsest_level_only() {
    let folder = TempDir::new().unwrap();
    image(folder.path());
    let server = FileServer::start(folder.path());
    let source = format!("{}/an%20image.zarr", server.address);
    let found = facts_at_once(&source, &OpenOptions::default()).unwrap().unwrap();
    assert_eq!((found.values_of, found.dims, found.range), (ValuesOf::Level(1), [8; 3], Some([0.0, 63.0])));
    let chunks = |level: &str, names: &[String]| {
        let is_chunk =
            |name: &&String| name.contains(level) && !name.contains("/.z") && !name.ends_with("json");
        names.iter().filter(is_chunk).count()
    };
    let asked = server.requests();
    assert_eq!((chunks("zarr/0/", &asked), chunks("zarr/1/", &asked)), (0, 1), "{asked:?}");
    // The control: all voxels take all chunks.
    opened(&source, Selection::default()).unwrap();
    assert_eq!(chunks("zarr/0/", &server.requests()), 8);
}

#[test]
fn pages_at_an_address_are_those_of_the_folder_and_ask_for_each_chunk_once() {
    let folder = TempDir::new().unwrap();
    let path = image(folder.path());
    let server = FileServer::start(folder.path());
    let source = format!("{}/an%20image.zarr", server.address);
    let [here, there] =
        [path.to_str().unwrap(), &source].map(|source| open_paged(source, &OpenOptions::default()).unwrap());
    let is_fine =
        |name: &&String| name.contains(".zarr/0/") && !name.contains("/.z") && !name.ends_with("json");
    assert_eq!(server.requests().iter().filter(is_fine).count(), 0, "only the coarse level was read");
    assert!(there.index.is_none() && here.index.is_some());
    for level in 0..2 {
        let page = PageId { level, at: [0; 3] };
        assert_eq!(there.source.read(0, page), here.source.read(0, page));
        there.source.read(0, page).unwrap();
    }
    assert_eq!(server.requests().iter().filter(is_fine).count(), 8);
}

/// A server of a folder that answers 503 to requests of `busy` names.
fn busy_server(folder: &Path, busy: &'static str) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("http://{}", listener.local_addr().unwrap());
    let folder = folder.to_owned();
    thread::spawn(move || {
        for mut stream in listener.incoming().flatten() {
            let mut line = String::new();
            let mut reader = BufReader::new(stream.try_clone().unwrap());
            let _ = reader.read_line(&mut line);
            while reader.read_line(&mut String::new()).is_ok_and(|n| n > 2) {}
            let name = line.split(' ').nth(1).unwrap_or_default().trim_start_matches('/').replace("%20", " ");
            let answer = match fs::read(folder.join(&name)) {
                _ if name.contains(busy) => {
                    b"HTTP/1.1 503 Busy\r\nContent-Length: 0\r\nConnection: close\r\n\r\n".to_vec()
                }
                Ok(bytes) => {
                    let head = format!(
                        "HTTP/1.1 200 OK\r\nContent-Length: {}\r\nConnection: close\r\n\r\n",
                        bytes.len()
                    );
                    [head.into_bytes(), bytes].concat()
                }
                Err(_) => b"HTTP/1.1 404 No\r\nContent-Length: 0\r\nConnection: close\r\n\r\n".to_vec(),
            };
            let _ = stream.write_all(&answer);
        }
    });
    address
}

#[test]
fn a_page_of_a_busy_server_is_unreachable_and_one_of_a_damaged_chunk_is_damaged() {
    let folder = TempDir::new().unwrap();
    let path = image(folder.path());
    let read = |busy| {
        let source = format!("{}/an%20image.zarr", busy_server(folder.path(), busy));
        let paged = open_paged(&source, &OpenOptions::default()).unwrap_or_else(|e| panic!("{e}"));
        paged.source.read(0, PageId { level: 0, at: [0; 3] })
    };
    let busy = read("/0/1/1/1").unwrap_err();
    assert!(matches!(&busy, PageError::Unreachable(text) if text.contains("answers 503")), "{busy}");
    fs::write(path.join("0/1/1/1"), [1, 2, 3]).unwrap();
    let damaged = read("nothing").unwrap_err();
    assert!(
        matches!(&damaged, PageError::Damaged(text) if text.contains("3 bytes, expected 64")),
        "{damaged}"
    );
}

#[test]
fn shards_are_read_in_parts() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("s.zarr");
    fs::create_dir_all(path.join("c/0/0")).unwrap();
    let text = r#"{"zarr_format": 3, "node_type": "array", "shape": [2, 2, 4], "data_type": "uint8", "fill_value": 5,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [2, 2, 4]}},
        "chunk_key_encoding": {"name": "default"}, "codecs": [{"name": "sharding_indexed", "configuration":
        {"chunk_shape": [2, 2, 2], "codecs": [{"name": "bytes"}], "index_codecs": [{"name": "bytes"}]}}]}"#;
    fs::write(path.join("zarr.json"), text).unwrap();
    let mut bytes: Vec<u8> = (10..18).collect();
    // The second of its chunks is not there.
    bytes.extend([0u64, 8, u64::MAX, u64::MAX].iter().flat_map(|n| n.to_le_bytes()));
    fs::write(path.join("c/0/0/0"), bytes).unwrap();
    let server = FileServer::start(folder.path());
    let volume = opened(&format!("{}/s.zarr", server.address), Selection::default()).unwrap();
    let expected = [10, 11, 5, 5, 12, 13, 5, 5, 14, 15, 5, 5, 16, 17, 5, 5].map(|n| n as f32);
    assert_eq!(numbers(&volume), expected);
    assert_eq!(
        server.requests().iter().filter(|name| name.ends_with("c/0/0/0")).count(),
        2,
        "index and chunk"
    );
}

#[test]
fn what_is_no_image_is_refused_in_one_line() {
    let folder = TempDir::new().unwrap();
    fs::write(folder.path().join("a.nii"), [0; 400]).unwrap();
    let server = FileServer::start(folder.path());
    // Nobody listens at the address of a listener that is gone.
    let gone = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    for (source, words) in [
        (format!("{}/nothing.zarr", server.address), "found no image at this address, expected multiscales"),
        (format!("{}/a.nii", server.address), "found no image at this address, expected multiscales"),
        (format!("http://{gone}/a.zarr"), "a.zarr"),
        ("ftp://example.org/a.zarr".to_owned(), "found an address, expected a path on the machine"),
    ] {
        let message = opened(&source, Selection::default()).unwrap_err().to_string();
        assert!(message.contains(words) && message.lines().count() == 1, "{message}");
    }
}

#[test]
fn a_query_follows_every_address_and_is_told_to_nobody() {
    let folder = TempDir::new().unwrap();
    image(folder.path());
    let server = FileServer::start(folder.path());
    let source = format!("{}/an%20image.zarr?token=secret/1&v=2", server.address);
    let volume = opened(&source, Selection::default()).unwrap();
    assert_eq!((volume.dims(), &volume.info.name[..]), ([8; 3], "an%20image.zarr"));
    let requests = server.requests();
    assert!(requests.len() > 8 && requests.iter().all(|name| name.ends_with("?token=secret/1&v=2")));
    let message = opened(&source.replace("image", "omage"), Selection::default()).unwrap_err().to_string();
    assert!(!message.contains("secret"), "{message}");
    // The control: without a query there is none.
    server.requests();
    opened(source.split('?').next().unwrap(), Selection::default()).unwrap();
    assert!(server.requests().iter().all(|name| !name.contains('?')));
}

#[test]
fn what_fails_for_a_moment_is_asked_for_again_and_the_rest_is_an_error() {
    let folder = TempDir::new().unwrap();
    image(folder.path());
    let server = FileServer::start(folder.path());
    let source = format!("{}/an%20image.zarr", server.address);
    let right = numbers(&opened(&source, Selection::default()).unwrap());
    for faults in
        [vec![Fault::Status(503), Fault::Status(429), Fault::Cut, Fault::Status(503)], vec![Fault::Cut; 4]]
    {
        server.requests();
        server.faults.lock().unwrap().extend(faults);
        assert_eq!(numbers(&opened(&source, Selection::default()).unwrap()), right);
        assert!(server.faults.lock().unwrap().is_empty());
    }
    // It gives up after five times.
    for (status, words) in [(503, "the server answers 503"), (429, "the server answers 429")] {
        server.requests();
        server.faults.lock().unwrap().extend([Fault::Status(status); 40]);
        let message = opened(&source, Selection::default()).unwrap_err().to_string();
        assert!(message.contains(words) && message.lines().count() == 1, "{message}");
        assert_eq!((server.requests().len(), server.faults.lock().unwrap().len()), (5, 35));
        server.faults.lock().unwrap().clear();
    }
    // The control: what a server refuses for good is asked for once.
    server.faults.lock().unwrap().push_back(Fault::Status(401));
    let message = opened(&source, Selection::default()).unwrap_err().to_string();
    assert!(message.contains("the server answers 401"), "{message}");
    assert_eq!(server.requests().len(), 1);
}

#[test]
fn the_survey_of_a_silent_server_ends_when_it_is_cancelled() {
    let folder = TempDir::new().unwrap();
    image(folder.path());
    let server = FileServer::start(folder.path());
    server.faults.lock().unwrap().push_back(Fault::Silence);
    let source = format!("{}/an%20image.zarr", server.address);
    let cancel = AtomicBool::new(false);
    let found = thread::scope(|scope| {
        let opening = scope.spawn(|| {
            let options = OpenOptions { cancel: Some(&cancel), ..OpenOptions::default() };
            open(&source, &options).map(|volume| volume.dims())
        });
        while server.requests().is_empty() {
            thread::yield_now();
        }
        cancel.store(true, Ordering::Relaxed);
        opening.join().unwrap()
    });
    // The server still says nothing.
    assert!(matches!(found, Err(FormatError::Cancelled { .. })), "{found:?}");
    server.faults.lock().unwrap().push_back(Fault::Status(503));
}
