//! Does a web server lead requests to places that the user did not name? Two servers of this machine answer: the one that
//! was named, and one that only this machine reaches.

#![expect(clippy::unwrap_used, reason = "a test stops where the ground it stands on is missing")]

#[expect(dead_code, reason = "each test file uses its own part of the module")]
#[path = "support/zarr.rs"]
mod zarr;

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::net::TcpListener;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::thread;

use isinglass_formats::{OpenOptions, open};
use tempfile::TempDir;
use zarr::{ArrayText, Packing};

/// A server of the files in a folder. Requests for chunks are sent on to `location`, if there is one.
struct Server {
    port: u16,
    num_requests: Arc<AtomicUsize>,
    location: Arc<Mutex<Option<String>>>,
}

impl Server {
    fn start(folder: &Path) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let (num_requests, location) =
            (Arc::<AtomicUsize>::default(), Arc::<Mutex<Option<String>>>::default());
        let (folder, num, sent_to) = (folder.to_owned(), num_requests.clone(), location.clone());
        thread::spawn(move || {
            for mut stream in listener.incoming().flatten() {
                num.fetch_add(1, Ordering::SeqCst);
                let mut line = String::new();
                let mut reader = BufReader::new(stream.try_clone().unwrap());
                let _ = reader.read_line(&mut line);
                while reader.read_line(&mut String::new()).is_ok_and(|n| n > 2) {}
                let name = line.split(' ').nth(1).unwrap_or_default().trim_start_matches('/');
                let to = sent_to.lock().unwrap().clone().filter(|_| name.ends_with("/0"));
                let head = match (to, fs::read(folder.join(name))) {
                    (Some(to), _) => format!("HTTP/1.1 302 Found\r\nLocation: {to}\r\nContent-Length: 0\r\n"),
                    (None, Ok(bytes)) => format!("HTTP/1.1 200 OK\r\nContent-Length: {}\r\n", bytes.len()),
                    (None, Err(_)) => "HTTP/1.1 404 No\r\nContent-Length: 0\r\n".into(),
                };
                let body = match head.contains("200 OK") {
                    true => fs::read(folder.join(name)).unwrap(),
                    false => Vec::new(),
                };
                let _ = stream.write_all(&[head.as_bytes(), b"Connection: close\r\n\r\n", &body].concat());
            }
        });
        Self { port, num_requests, location }
    }

    fn send_on(&self, location: &str) {
        *self.location.lock().unwrap() = Some(location.to_owned());
    }

    fn num_requests(&self) -> usize {
        self.num_requests.swap(0, Ordering::SeqCst)
    }
}

/// An array of one chunk, of one value.
fn array(folder: &Path, value: u8) {
    let text = ArrayText { shape: &[2, 2, 2], chunk: &[2, 2, 2], dtype: "|u1", packing: Packing::Raw };
    text.write(folder, |_| vec![value]);
    fs::create_dir_all(folder.join("kept")).unwrap();
    fs::copy(folder.join("0/0/0"), folder.join("kept/chunk")).unwrap();
}

fn first_voxel(source: &str) -> Result<f32, String> {
    open(source, &OpenOptions::default()).map(|volume| volume.voxels().get(0)).map_err(|e| e.to_string())
}

#[test]
fn a_server_sends_requests_on_within_itself_alone() {
    let [theirs, secret] = [TempDir::new().unwrap(), TempDir::new().unwrap()];
    array(&theirs.path().join("a.zarr"), 7);
    array(&secret.path().join("a.zarr"), 99);
    let [server, local] = [theirs.path(), secret.path()].map(Server::start);
    let source = format!("http://127.0.0.1:{}/a.zarr", server.port);
    assert_eq!(first_voxel(&source), Ok(7.0));
    // The control: its own places are followed, and the other server is there for whoever names it.
    for own in ["/a.zarr/kept/chunk".into(), format!("http://127.0.0.1:{}/a.zarr/kept/chunk", server.port)] {
        server.send_on(&own);
        assert_eq!(first_voxel(&source), Ok(7.0), "{own}");
    }
    assert_eq!(first_voxel(&format!("http://127.0.0.1:{}/a.zarr", local.port)), Ok(99.0));
    local.num_requests();
    for host in ["127.0.0.1", "localhost", "[::1]", "0x7f.1", "[::ffff:127.0.0.1]", "x@127.0.0.1"] {
        server.send_on(&format!("http://{host}:{}/a.zarr/0/0/0", local.port));
        let line = first_voxel(&source).unwrap_err();
        assert!(line.contains("the server sends on to") && !line.contains('\n'), "{line}");
        assert_eq!(local.num_requests(), 0, "{host} was asked");
    }
    // A circle ends.
    server.send_on("/a.zarr/0/0/0");
    assert!(first_voxel(&source).unwrap_err().contains("more than 5 times"));
}

/// The system reads `0x7f.0.0.1` as a name for loopback, as a name server could make any name of the web.
#[test]
fn a_name_of_the_web_does_not_lead_to_this_machine() {
    let folder = TempDir::new().unwrap();
    array(&folder.path().join("a.zarr"), 7);
    let server = Server::start(folder.path());
    let source = |host: &str| format!("http://{host}:{}/a.zarr", server.port);
    for own in ["127.0.0.1", "localhost"] {
        assert_eq!(first_voxel(&source(own)), Ok(7.0), "{own}");
    }
    server.num_requests();
    let line = first_voxel(&source("0x7f.0.0.1")).unwrap_err();
    if line.contains("lookup") || line.contains("host not found") {
        eprintln!("skipped: this system does not know the name ({line})");
        return;
    }
    let hint = format!("a loopback address; open http://127.0.0.1:{}/", server.port);
    assert!(line.contains(&hint) && !line.contains('\n'), "{line}");
    assert_eq!(server.num_requests(), 0);
}
