//! Byte streams of viewers to which UDP does not come through. They come to the TCP port of the same number.

use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use tokio::net::{TcpListener, TcpStream};
use tokio::time::{Instant, timeout};
use tokio_rustls::TlsAcceptor;

use super::{CROWDED, REFUSAL_LINGER, ServerShared};
use crate::carrier::{StreamDoor, carry, stream_address};
use crate::transport::AUTH_DEADLINE;

/// Binds UDP and TCP at one address. Without a port, the system chooses one that both have free.
pub(super) fn bind_both(address: SocketAddr) -> io::Result<(UdpSocket, TcpListener)> {
    let mut attempt = 1;
    loop {
        let udp = UdpSocket::bind(address)?;
        let tcp = std::net::TcpListener::bind(udp.local_addr()?);
        match tcp {
            Err(e) if e.kind() == io::ErrorKind::AddrInUse && address.port() == 0 && attempt < MAX_PORTS => {
                attempt += 1;
            }
            tcp => {
                let tcp = tcp?;
                tcp.set_nonblocking(true)?;
                return Ok((udp, TcpListener::from_std(tcp)?));
            }
        }
    }
}

/// Accepts streams for ever.
pub(super) async fn accept_all(
    listener: TcpListener,
    tls: Arc<rustls::ServerConfig>,
    door: StreamDoor,
    shared: Arc<ServerShared>,
) {
    let tls = TlsAcceptor::from(tls);
    loop {
        match listener.accept().await {
            Ok((stream, peer)) => {
                tokio::spawn(serve(stream, peer, tls.clone(), door.clone(), shared.clone()));
            }
            Err(e) => {
                tracing::debug!("no stream is accepted: {e}");
                tokio::time::sleep(PAUSE).await;
            }
        }
    }
}

/// Encrypts a stream and carries its packets. Until its viewer is let in, it needs a seat.
async fn serve(
    stream: TcpStream,
    peer: SocketAddr,
    tls: TlsAcceptor,
    door: StreamDoor,
    shared: Arc<ServerShared>,
) {
    let Some(mut seat) = shared.pending.enter(peer.ip(), Instant::now()) else {
        return shared.tell(peer, &CROWDED);
    };
    let _ = stream.set_nodelay(true);
    let address = stream_address(peer);
    let stream = tokio::select! {
        encrypted = timeout(AUTH_DEADLINE, tls.accept(stream)) => match encrypted {
            Ok(Ok(stream)) => stream,
            Ok(Err(e)) => return shared.tell(peer, &e),
            Err(_) => return shared.tell(peer, &"no TLS in time"),
        },
        why = seat.is_given_up() => return shared.tell(peer, &why),
    };
    let end = door.add(address);
    let decided = end.decided();
    let mut carrying = pin!(carry(stream, end));
    let is_viewer = tokio::select! {
        _ = &mut carrying => return,
        why = seat.is_given_up() => return shared.tell(peer, &why),
        is_viewer = decided => is_viewer,
    };
    drop(seat);
    if !is_viewer {
        // Whoever does not read the refusal keeps no stream open.
        let _ = timeout(2 * REFUSAL_LINGER, carrying).await;
        return;
    }
    if let Err(e) = carrying.await {
        tracing::debug!(%peer, "a stream broke: {e}");
    }
}

/// Ports of the system's choice that are tried.
const MAX_PORTS: u32 = 16;
/// Pause after a failure, such as too many open files.
const PAUSE: Duration = Duration::from_millis(100);
