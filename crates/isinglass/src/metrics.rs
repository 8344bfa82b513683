//! Numbers about a server for monitoring, as Prometheus reads them, over HTTP on loopback.

use std::fmt::Write;
use std::io;
use std::net::SocketAddr;
use std::time::Duration;

use isinglass_server::{Attendance, Counters};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

/// The numbers in the text format of Prometheus.
pub(crate) fn text(attendance: Attendance, counters: &Counters) -> String {
    let mut text = String::new();
    let mut add = |name: &str, kind: &str, help: &str, value: f64| {
        let _ = write!(
            text,
            "# HELP isinglass_{name} {help}\n# TYPE isinglass_{name} {kind}\nisinglass_{name} {value}\n"
        );
    };
    add("viewers", "gauge", "Connected viewers.", attendance.connected as f64);
    add("frames_total", "counter", "Frames that the network has taken.", counters.frames() as f64);
    add("frame_bytes_total", "counter", "Bytes of coded frames.", counters.frame_bytes() as f64);
    add("refusals_total", "counter", "Connections that came to nothing.", counters.refusals() as f64);
    let seconds = counters.rendering().as_secs_f64();
    add("rendering_seconds_total", "counter", "Time in which the rendering threads have worked.", seconds);
    text
}

/// Answers requests for ever, one after the other. `text` gives the present numbers.
pub(crate) async fn answer_all(listener: TcpListener, text: impl Fn() -> String) {
    loop {
        match listener.accept().await {
            // Who is slow or says nonsense keeps others waiting only for a moment.
            Ok((stream, _)) => drop(tokio::time::timeout(PATIENCE, answer(stream, &text)).await),
            Err(_) => tokio::time::sleep(PATIENCE).await,
        }
    }
}

async fn answer(mut stream: TcpStream, text: &impl Fn() -> String) -> io::Result<()> {
    let mut request = [0; MAX_REQUEST_BYTES];
    let mut num = 0;
    while !request[..num].windows(4).any(|end| end == b"\r\n\r\n") {
        match stream.read(&mut request[num..]).await? {
            0 => return Ok(()),
            more => num += more,
        }
    }
    let (status, body) = match request.starts_with(b"GET /metrics ") {
        true => ("200 OK", text()),
        false => ("404 Not Found", "expected GET /metrics\n".into()),
    };
    let head = format!(
        "HTTP/1.1 {status}\r\nContent-Type: text/plain; version=0.0.4\r\nContent-Length: {}\r\nConnection: close\r\n\r\n",
        body.len()
    );
    stream.write_all((head + &body).as_bytes()).await?;
    stream.shutdown().await
}

/// Parses an address for the numbers: on loopback, so that no stranger reads them.
pub(crate) fn parse_loopback(text: &str) -> Result<SocketAddr, String> {
    let expected = || "expected an address on loopback, such as 127.0.0.1:9464".to_owned();
    let address: SocketAddr = text.parse().map_err(|_| expected())?;
    if address.ip().is_loopback() { Ok(address) } else { Err(expected()) }
}

/// Time for a request and its answer.
const PATIENCE: Duration = Duration::from_secs(2);
/// Longest request.
const MAX_REQUEST_BYTES: usize = 2048;

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn numbers_are_answered_and_nonsense_ends() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let seen = Attendance { connected: 3, used_links: 0 };
        tokio::spawn(answer_all(listener, move || text(seen, &Counters::default())));
        let ask = async |request: &[u8]| {
            let mut stream = TcpStream::connect(address).await.unwrap();
            let mut answer = String::new();
            // A request that is too long is cut off.
            let _ = stream.write_all(request).await;
            let _ = stream.read_to_string(&mut answer).await;
            answer
        };
        for _ in 0..2 {
            let answer = ask(b"GET /metrics HTTP/1.1\r\nHost: x\r\n\r\n").await;
            assert!(answer.starts_with("HTTP/1.1 200 OK\r\n"), "{answer}");
            assert!(
                answer.contains("\nisinglass_viewers 3\n") && answer.contains("isinglass_frames_total 0\n")
            );
            assert!(ask(b"GET / HTTP/1.1\r\n\r\n").await.starts_with("HTTP/1.1 404"));
            assert_eq!(ask(&[b'x'; 10_000]).await, "");
        }
    }

    #[test]
    fn only_loopback_is_an_address_for_numbers() {
        assert!(parse_loopback("127.0.0.1:9464").is_ok() && parse_loopback("[::1]:0").is_ok());
        for bad in ["0.0.0.0:9464", "192.0.2.1:80", "localhost", "9464", ""] {
            assert!(parse_loopback(bad).unwrap_err().contains("loopback"), "{bad}");
        }
    }
}
