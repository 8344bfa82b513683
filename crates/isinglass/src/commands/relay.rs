//! `relay`: joins standard input and output with a server on this machine. A viewer runs it through ssh where no packet
//! reaches the server directly.

use std::io::{self, Read, Write};
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpStream};
use std::thread;

use anyhow::{Context, Result};
use clap::Args;

#[derive(Args)]
pub(crate) struct RelayArgs {
    /// The server's TCP port, on loopback or with its address
    #[arg(value_name = "[ADDRESS:]PORT", value_parser = parse_server)]
    server: SocketAddr,
}

/// Returns when the server closes its side.
pub(crate) fn run(args: &RelayArgs) -> Result<()> {
    let stream = TcpStream::connect(args.server).with_context(|| format!("no server at {}", args.server))?;
    stream.set_nodelay(true).context("the connection to the server")?;
    let to_server = stream.try_clone().context("the connection to the server")?;
    thread::spawn(move || {
        // At the end of the input the server learns that no more comes, and may still answer.
        let _ = pass_on(io::stdin().lock(), &to_server);
        let _ = to_server.shutdown(Shutdown::Write);
    });
    match pass_on(&stream, io::stdout().lock()) {
        Err(e) if e.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        done => done.context("the connection to the server"),
    }
}

/// Copies at once whatever comes, until the end.
fn pass_on(mut from: impl Read, mut to: impl Write) -> io::Result<()> {
    let mut buffer = vec![0; CHUNK];
    loop {
        match from.read(&mut buffer) {
            Ok(0) => return Ok(()),
            Ok(num) => {
                to.write_all(&buffer[..num])?;
                to.flush()?;
            }
            Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
            Err(e) => return Err(e),
        }
    }
}

fn parse_server(text: &str) -> Result<SocketAddr, String> {
    let on_loopback = || text.parse().ok().map(|port: u16| (Ipv4Addr::LOCALHOST, port).into());
    let found = text.parse().ok().or_else(on_loopback).filter(|server: &SocketAddr| server.port() != 0);
    found.ok_or_else(|| "expected a port, or an address with one, such as 4433 or [::1]:4433".into())
}

/// Bytes that are copied at once.
const CHUNK: usize = 64 << 10;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_port_is_on_loopback() {
        assert_eq!(parse_server("4433"), Ok(([127, 0, 0, 1], 4433).into()));
        assert_eq!(parse_server("[::1]:1"), Ok((std::net::Ipv6Addr::LOCALHOST, 1).into()));
        for bad in ["", "0", "65536", "host:1", "-1", "1.2.3.4", "1.2.3.4:0"] {
            assert!(parse_server(bad).is_err(), "{bad}");
        }
    }
}
