//! Does a viewer get its frames where UDP does not come through?
#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod common;

use std::net::SocketAddr;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use common::*;
use isinglass_core::codec;
use isinglass_net::identity::pinned_tls;
use isinglass_net::{Carrier, Client, ClientOptions, ConnectError, Identity, Link, LinkModel, Server, State};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream, UdpSocket};
use tokio::sync::watch;

/// A place in front of a server through which TCP comes, and UDP only if it is let.
struct Firewall {
    port: u16,
    broken: watch::Sender<u32>,
    lets_tcp: Arc<AtomicBool>,
    lets_udp: Arc<AtomicBool>,
}

impl Firewall {
    async fn before(server: u16) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let port = listener.local_addr().unwrap().port();
        let udp = UdpSocket::bind(("127.0.0.1", port)).await.unwrap();
        let lets_udp = Arc::<AtomicBool>::default();
        tokio::spawn(relay_udp(udp, server, lets_udp.clone()));
        let broken = watch::Sender::new(0);
        let lets_tcp = Arc::new(AtomicBool::new(true));
        let (breaking, is_open) = (broken.clone(), lets_tcp.clone());
        tokio::spawn(async move {
            while let Ok((mut near, _)) = listener.accept().await {
                let mut breaking = breaking.subscribe();
                if !is_open.load(Ordering::Relaxed) {
                    continue;
                }
                tokio::spawn(async move {
                    let mut far = TcpStream::connect(("127.0.0.1", server)).await.unwrap();
                    tokio::select! {
                        _ = tokio::io::copy_bidirectional(&mut near, &mut far) => {}
                        _ = breaking.changed() => {}
                    }
                });
            }
        });
        Self { port, broken, lets_tcp, lets_udp }
    }

    /// Breaks all streams.
    fn break_streams(&self) {
        self.broken.send_modify(|times| *times += 1);
    }
}

/// Relays the packets of one viewer both ways while they are let.
async fn relay_udp(near: UdpSocket, server: u16, lets: Arc<AtomicBool>) {
    let far = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let (mut up, mut down, mut viewer) = ([0; 2048], [0; 2048], None);
    loop {
        tokio::select! {
            Ok((length, from)) = near.recv_from(&mut up) => {
                viewer = Some(from);
                if lets.load(Ordering::Relaxed) {
                    let _ = far.send_to(&up[..length], ("127.0.0.1", server)).await;
                }
            }
            Ok((length, _)) = far.recv_from(&mut down) => {
                if let Some(viewer) = viewer.filter(|_| lets.load(Ordering::Relaxed)) {
                    let _ = near.send_to(&down[..length], viewer).await;
                }
            }
        }
    }
}

async fn assert_frames(client: &Client, numbers: std::ops::Range<u32>, carrier: Carrier) {
    for n in numbers {
        let id = client.set_pose(pose(n), INTRINSICS);
        let received = until_answered(client, id).await;
        let expected = encoded(received.frame.header.frame, id, pose(n), INTRINSICS);
        let bytes = expected.chunks.into_iter().map(|chunk| chunk.bytes).collect::<Vec<_>>();
        assert_eq!(received.frame, codec::decode(&bytes).unwrap());
    }
    assert_eq!(client.stats().carrier, carrier);
}

#[tokio::test(flavor = "multi_thread")]
async fn where_udp_does_not_come_through_the_session_runs_over_tcp() {
    let server = server();
    let [link, direct] = [(); 2].map(|()| server.mint_link("127.0.0.1").unwrap());
    serve(server);
    let firewall = Firewall::before(link.port).await;
    let client = connect(&Link { port: firewall.port, ..link });
    assert_frames(&client, 1..20, Carrier::Tcp).await;
    // The stream breaks: the viewer comes back over the same way, as the same viewer.
    firewall.break_streams();
    let lost = until("the loss", || match client.state() {
        State::Reconnecting { problem, .. } => Some(problem.to_string()),
        _ => None,
    });
    assert!(lost.await.contains("the TCP stream broke"));
    assert_frames(&client, 20..30, Carrier::Tcp).await;
    // The control: where UDP comes through, it carries the session.
    let client = connect(&direct);
    assert_frames(&client, 1..5, Carrier::Udp).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn where_udp_comes_through_no_longer_tcp_takes_its_place() {
    let server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    serve(server);
    let firewall = Firewall::before(link.port).await;
    firewall.lets_udp.store(true, Ordering::Relaxed);
    let client = connect(&Link { port: firewall.port, ..link });
    assert_frames(&client, 1..10, Carrier::Udp).await;
    // From now on its packets vanish without a word.
    firewall.lets_udp.store(false, Ordering::Relaxed);
    assert_frames(&client, 10..20, Carrier::Tcp).await;
    assert_eq!(client.state(), State::Connected);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_slow_link_over_tcp_shows_new_frames() {
    let server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    serve(server);
    let firewall = Firewall::before(link.port).await;
    let model = LinkModel {
        rtt: Duration::from_millis(60),
        bandwidth_mbit: Some(5.0),
        loss: 0.01,
        seed: 3,
        ..LinkModel::default()
    };
    let options = ClientOptions { conditioner: Some(model), ..ClientOptions::default() };
    let client = Client::connect(&Link { port: firewall.port, ..link }, options).unwrap();
    assert_frames(&client, 1..20, Carrier::Tcp).await;
}

/// A command that joins its input and output with a port of this machine.
fn joined_with(port: u16) -> Command {
    let mut command = Command::new("bash");
    command.arg("-c").arg(format!("exec 3<>/dev/tcp/127.0.0.1/{port}; cat <&3 & cat >&3"));
    command
}

#[cfg(unix)]
#[tokio::test(flavor = "multi_thread")]
async fn where_tcp_does_not_come_through_either_a_tunnel_carries_the_session() {
    let server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    serve(server);
    let firewall = Firewall::before(link.port).await;
    firewall.lets_tcp.store(false, Ordering::Relaxed);
    let port = link.port;
    let options =
        ClientOptions { tunnel: Some(Arc::new(move || joined_with(port))), ..ClientOptions::default() };
    let client = Client::connect(&Link { port: firewall.port, ..link }, options).unwrap();
    assert_frames(&client, 1..20, Carrier::Tunnel).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn another_certificate_is_refused_over_tcp_too() {
    let server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    serve(server);
    let firewall = Firewall::before(link.port).await;
    let expected = Identity::generate().unwrap().fingerprint();
    let client = connect(&Link { port: firewall.port, fingerprint: expected, ..link });
    let refused = until("a refusal", || match client.state() {
        State::Refused(problem) => Some(problem),
        _ => None,
    });
    let ConnectError::Certificate { found, .. } = refused.await else { panic!("{:?}", client.state()) };
    assert_eq!(found, link.fingerprint);
}

/// A stranger's stream to the server, encrypted.
async fn stranger(link: &Link) -> tokio_rustls::client::TlsStream<TcpStream> {
    let (tls, _) = pinned_tls(link.fingerprint).unwrap();
    let tcp = TcpStream::connect(("127.0.0.1", link.port)).await.unwrap();
    let name = "isinglass".try_into().unwrap();
    tokio_rustls::TlsConnector::from(tls).connect(name, tcp).await.unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn strangers_on_streams_keep_nobody_out() {
    let server = server();
    let [good, other] = [(); 2].map(|()| server.mint_link("127.0.0.1").unwrap());
    let refusals = server.refusals();
    serve(server);
    let address = SocketAddr::from(([127, 0, 0, 1], good.port));
    // Some say nothing, some are not TLS, and some send packets that are garbage, empty, or longer than any.
    let mut strangers = vec![];
    for _ in 0..20 {
        strangers.push(TcpStream::connect(address).await.unwrap());
        let mut noise = TcpStream::connect(address).await.unwrap();
        noise.write_all(b"GET / HTTP/1.1\r\n\r\n").await.unwrap();
        strangers.push(noise);
    }
    let mut encrypted = vec![];
    for n in 0..4u8 {
        let mut stream = stranger(&good).await;
        let bytes: Vec<u8> = match n {
            0 => [0; 4096].into(),
            1 => [255; 200_000].into(),
            2 => (0..50_000u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect(),
            _ => vec![],
        };
        let _ = stream.write_all(&bytes).await;
        let _ = stream.flush().await;
        encrypted.push(stream);
    }
    assert_frames(&connect(&good), 1..10, Carrier::Udp).await;
    let firewall = Firewall::before(other.port).await;
    assert_frames(&connect(&Link { port: firewall.port, ..other }), 1..10, Carrier::Tcp).await;
    // A stream without a viewer is ended in time, and the server says so.
    let mut rest = vec![];
    let ended = encrypted.last_mut().unwrap().read_to_end(&mut rest);
    assert!(tokio::time::timeout(Duration::from_secs(30), ended).await.is_ok());
    assert!(refusals.load(Ordering::Relaxed) >= 20);
}

/// Both kinds of port are free or the server says which one is not.
#[tokio::test(flavor = "multi_thread")]
async fn a_taken_port_is_named() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let identity = Identity::generate().unwrap();
    let bind = || Server::bind(address, &identity, Default::default(), greeting());
    assert!(bind().unwrap_err().to_string().contains(&address.port().to_string()));
    drop(listener);
    assert!(bind().is_ok(), "the negative control");
}
