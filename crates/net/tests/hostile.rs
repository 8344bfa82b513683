//! Does a server survive its clients, and a client its server? Each peer here speaks raw QUIC.
#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod common;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use common::*;
use isinglass_core::ids::{FrameId, PoseId};
use isinglass_core::wire::control::{self, hello};
use isinglass_core::wire::{ALPN, ClientMessage, PROTOCOL_VERSION, Refusal, ServerMessage, Token};
use isinglass_net::identity::{pinned_tls, quic_client};
use isinglass_net::{
    BindError, ConnectError, Fingerprint, Identity, Link, Server, ServerOptions, State, random_token,
};
use quinn::{Connection, ConnectionError, Endpoint, RecvStream, SendStream};

type Mutation<'a> = &'a dyn Fn(&mut Vec<u8>);

/// A client that can say anything.
struct Raw {
    _endpoint: Endpoint,
    connection: Connection,
    send: SendStream,
    recv: RecvStream,
}

async fn raw(link: &Link) -> Raw {
    let (tls, _) = pinned_tls(link.fingerprint).unwrap();
    let endpoint = Endpoint::client(([127, 0, 0, 1], 0).into()).unwrap();
    let address: SocketAddr = ([127, 0, 0, 1], link.port).into();
    let config = quic_client(tls).unwrap();
    let connection = endpoint.connect_with(config, address, "isinglass").unwrap().await.unwrap();
    let (send, recv) = connection.open_bi().await.unwrap();
    Raw { _endpoint: endpoint, connection, send, recv }
}

impl Raw {
    async fn answer(&mut self) -> ServerMessage {
        let mut prefix = [0; 4];
        self.recv.read_exact(&mut prefix).await.unwrap();
        let mut body = vec![0; control::body_length(prefix).unwrap()];
        self.recv.read_exact(&mut body).await.unwrap();
        control::decode(&body).unwrap()
    }

    async fn is_refused(&mut self) -> Refusal {
        match self.answer().await {
            ServerMessage::Refused(refusal) => refusal,
            other => panic!("expected a refusal, found {other:?}"),
        }
    }

    async fn close_reason(&self) -> String {
        match self.connection.closed().await {
            ConnectionError::ApplicationClosed(close) => String::from_utf8(close.reason.to_vec()).unwrap(),
            other => panic!("expected a reason, found {other}"),
        }
    }
}

fn t() -> Token {
    random_token().unwrap()
}

/// The server still serves: a viewer gets a frame.
async fn assert_serves(link: &Link) {
    let client = connect(link);
    let id = client.set_pose(pose(1), INTRINSICS);
    until_answered(&client, id).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn whatever_a_client_says_first_others_are_served() {
    let server = server();
    let bad_links = [0, 1, 2, 3].map(|_| server.mint_link("127.0.0.1").unwrap());
    let links = [0, 1, 2, 3, 4, 5].map(|_| server.mint_link("127.0.0.1").unwrap());
    serve(server);

    // A wrong token, from a real client.
    let wrong = Link { token: t(), ..links[0].clone() };
    let refused = connect(&wrong).wait_connected(Duration::from_secs(20)).unwrap_err();
    assert_eq!(refused, ConnectError::Refused(Refusal::UnknownToken));
    assert_serves(&links[0]).await;

    // Another version behind the same ALPN.
    let mut peer = raw(&bad_links[0]).await;
    let other = ClientMessage::Hello { protocol: 99, token: t(), instance: t(), name: String::new() };
    peer.send.write_all(&control::encode(&other).unwrap()).await.unwrap();
    assert_eq!(peer.is_refused().await, Refusal::Version { server: PROTOCOL_VERSION, client: 99 });
    assert!(peer.close_reason().await.contains(&format!("protocol version {PROTOCOL_VERSION}")));

    // Garbage: of a good length, of a huge length, of length zero.
    let garbage = [[&8u32.to_le_bytes()[..], &[0xee; 8]].concat(), vec![0xff; 64], vec![0; 4]];
    for (bytes, link) in garbage.iter().zip(&links[1..]) {
        let mut peer = raw(&bad_links[1]).await;
        peer.send.write_all(bytes).await.unwrap();
        let refusal = peer.is_refused().await;
        assert!(matches!(&refusal, Refusal::Protocol(line) if !line.contains('\n')), "{refusal:?}");
        assert_eq!(peer.close_reason().await, refusal.to_string());
        assert_serves(link).await;
    }

    // A message that is not a hello.
    let mut peer = raw(&bad_links[2]).await;
    peer.send.write_all(&control::encode(&ClientMessage::Bye).unwrap()).await.unwrap();
    assert!(matches!(peer.is_refused().await, Refusal::Protocol(_)));

    // Half a message, and gone.
    let mut peer = raw(&bad_links[3]).await;
    peer.send.write_all(&[40, 0, 0, 0, 1, 2, 3]).await.unwrap();
    peer.connection.close(0u32.into(), b"");
    assert_serves(&links[4]).await;
    // None of the bad ones has used up its token, and none of the good ones is left unused.
    assert_serves(&bad_links[1]).await;
}

/// Tokens cannot be guessed, so wrong ones keep nobody out: a person behind the same address has a valid link.
#[tokio::test(flavor = "multi_thread")]
async fn wrong_tokens_keep_no_valid_link_of_their_address_out() {
    let server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    let refusals = server.refusals();
    serve(server);
    // The same address over UDP, many at a time, for as long as the viewer comes in.
    let guessing: Vec<_> = (0..8)
        .map(|_| {
            let link = link.clone();
            tokio::spawn(async move {
                for _ in 0..25 {
                    let mut peer = raw(&link).await;
                    let wrong = control::encode(&hello(t(), t(), "x")).unwrap();
                    peer.send.write_all(&wrong).await.unwrap();
                    assert_eq!(peer.is_refused().await, Refusal::UnknownToken);
                }
            })
        })
        .collect();
    until("many guesses", || (refusals.load(std::sync::atomic::Ordering::Relaxed) >= 120).then_some(()))
        .await;
    // A lock of any length would last longer than these guesses do.
    let early = connect(&link);
    assert_eq!(early.wait_connected(Duration::from_secs(20)), Ok(()));
    for guesses in guessing {
        guesses.await.unwrap();
    }
    let id = early.set_pose(pose(1), INTRINSICS);
    until_answered(&early, id).await;
    // The control: a wrong token after all of these is still refused.
    let refused = connect(&Link { token: t(), ..link }).wait_connected(Duration::from_secs(20)).unwrap_err();
    assert_eq!(refused, ConnectError::Refused(Refusal::UnknownToken));
}

/// Also where nobody has accepted them yet: who makes links must know.
#[tokio::test(flavor = "multi_thread")]
async fn a_viewer_that_is_gone_at_once_has_used_its_link_and_left() {
    let server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    let left = server.left();
    let mut peer = raw(&link).await;
    peer.send.write_all(&control::encode(&hello(link.token.clone(), t(), "x")).unwrap()).await.unwrap();
    assert!(matches!(peer.answer().await, ServerMessage::Welcome(_)));
    assert_eq!((server.num_used_links(), server.num_viewers()), (1, 1));
    peer.connection.close(0u32.into(), b"");
    tokio::time::timeout(Duration::from_secs(20), left.notified()).await.unwrap();
    assert_eq!((server.num_used_links(), server.num_viewers()), (1, 0));
}

#[tokio::test(flavor = "multi_thread")]
async fn garbage_after_the_welcome_hurts_only_its_sender() {
    let server = server();
    let links = [0, 1, 2].map(|_| server.mint_link("127.0.0.1").unwrap());
    serve(server);
    let good = connect(&links[0]);
    let id = good.set_pose(pose(1), INTRINSICS);
    until_answered(&good, id).await;

    let mut peer = raw(&links[1]).await;
    let hello = hello(links[1].token.clone(), t(), "x");
    peer.send.write_all(&control::encode(&hello).unwrap()).await.unwrap();
    assert!(matches!(peer.answer().await, ServerMessage::Welcome(_)));
    // Garbage datagrams are ignored: the session goes on.
    for length in [1, 55, 56, 57, 1000] {
        peer.connection.send_datagram(vec![0xa5; length].into()).unwrap();
    }
    // Streams that the server never asked for are not granted.
    assert!(tokio::time::timeout(Duration::from_millis(100), peer.connection.open_uni()).await.is_err());
    assert!(peer.connection.close_reason().is_none());
    // A second hello is not ignored.
    peer.send.write_all(&control::encode(&hello).unwrap()).await.unwrap();
    let refusal = peer.is_refused().await;
    assert_eq!(refusal, Refusal::Protocol("a second hello".into()));

    let id = good.set_pose(pose(2), INTRINSICS);
    until_answered(&good, id).await;
    assert_serves(&links[2]).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn another_certificate_is_never_trusted() {
    let server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    serve(server);
    let other: Fingerprint = Identity::generate().unwrap().fingerprint();
    let forged = Link { fingerprint: other, ..link.clone() };
    let client = connect(&forged);
    let error = client.wait_connected(Duration::from_secs(20)).unwrap_err();
    match &error {
        ConnectError::Certificate { expected, found, .. } => {
            assert_eq!((*expected, *found), (other, link.fingerprint));
        }
        e => panic!("{e}"),
    }
    assert_eq!(client.state(), State::Refused(error));
    // The token was not given away.
    assert_serves(&link).await;
}

/// A killed server says no goodbye.
#[test]
fn a_dead_server_is_noticed_before_the_connection_is_given_up() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let server = runtime.block_on(async { server() });
    let link = server.mint_link("127.0.0.1").unwrap();
    runtime.block_on(async { serve(server) });
    let client = connect(&link);
    client.wait_connected(Duration::from_secs(20)).unwrap();
    // Keep-alives are answered.
    for _ in 0..20 {
        assert!(!client.stats().is_silent());
        std::thread::sleep(Duration::from_millis(100));
    }
    runtime.shutdown_background();
    while !client.stats().is_silent() {
        assert_eq!(client.state(), State::Connected);
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_port_in_use_is_named() {
    let first = server();
    let address = first.local_addr().unwrap();
    let identity = Identity::generate().unwrap();
    let second = Server::bind(address, &identity, ServerOptions::default(), greeting());
    let error = second.unwrap_err();
    assert!(matches!(error, BindError::InUse(a) if a == address));
    assert!(error.to_string().contains(&address.port().to_string()));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_that_is_not_there_is_named_in_bounded_time() {
    // Bound but silent: nothing is sent back, as behind a firewall.
    let silent = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let port = silent.local_addr().unwrap().port();
    let fingerprint = Identity::generate().unwrap().fingerprint();
    let link = Link { host: "127.0.0.1".into(), port, token: t(), fingerprint, state: None };
    let client = connect(&link);
    let error = client.wait_connected(Duration::from_secs(60)).unwrap_err();
    assert_eq!(error, ConnectError::NoAnswer { host: "127.0.0.1".into(), port });
    assert!(matches!(client.state(), State::Connecting { attempt: 2, problem: Some(_) }));

    let nowhere = Link { host: "no-such-host.invalid".into(), ..link };
    let error = connect(&nowhere).wait_connected(Duration::from_secs(60)).unwrap_err();
    assert!(
        matches!(&error, ConnectError::Resolve { host, .. } if host == "no-such-host.invalid"),
        "{error}"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn mutated_chunks_cost_their_frame_and_nothing_else() {
    let mut server = server();
    let link = server.mint_link("127.0.0.1").unwrap();
    let client = connect(&link);
    let session = server.accept().await.unwrap();
    client.set_pose(pose(1), INTRINSICS);
    let mut id = FrameId(0);
    // A flip at the start, in the header, in the payload and at the end; a cut; an extension; nothing at all.
    let mutations: [Mutation<'_>; 7] = [
        &|b| b[0] ^= 0x10,
        &|b| b[5] ^= 0xff,
        &|b| {
            let middle = b.len() / 2;
            b[middle] ^= 0x55;
        },
        &|b| *b.last_mut().unwrap() ^= 0x80,
        &|b| b.truncate(b.len() / 2),
        &|b| b.push(0),
        &Vec::clear,
    ];
    for mutate in mutations {
        id = id.next();
        let mut chunks = encoded(id, PoseId(1), pose(1), INTRINSICS).chunks;
        mutate(&mut chunks[0].bytes);
        session.frames.send(id, PoseId(1), chunks).await.unwrap();
        // A whole frame after each bad one arrives.
        id = id.next();
        session.frames.send(id, PoseId(1), encoded(id, PoseId(1), pose(1), INTRINSICS).chunks).await.unwrap();
        until("the good frame", || client.latest_frame().filter(|f| f.frame.header.frame == id)).await;
    }
    assert_eq!(client.state(), State::Connected);
    assert!(client.stats().broken_chunks > 0);
    assert!(!client.last_problem().unwrap().contains('\n'));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_silent_viewer_gives_its_place_up() {
    let server = server();
    let links = [0, 1].map(|_| server.mint_link("127.0.0.1").unwrap());
    let mut peer = raw(&links[0]).await;
    peer.send.write_all(&control::encode(&hello(links[0].token.clone(), t(), "x")).unwrap()).await.unwrap();
    assert!(matches!(peer.answer().await, ServerMessage::Welcome(_)));
    // The control rests, too, but keeps its connection alive.
    let resting = connect(&links[1]);
    resting.wait_connected(Duration::from_secs(20)).unwrap();
    assert_eq!(server.num_viewers(), 2);
    // The server says so long before QUIC's own timeout, which says nothing.
    assert!(peer.close_reason().await.contains("no packet has come"));
    until("its place", || (server.num_viewers() == 1).then_some(())).await;
    assert_eq!(resting.state(), State::Connected);
    // Its token still lets it come back.
    assert_eq!(server.num_used_links(), 2);
}

/// Each welcome is followed by garbage.
#[tokio::test(flavor = "multi_thread")]
async fn a_server_that_breaks_the_protocol_after_each_welcome_is_not_flooded() {
    let greeting = greeting();
    let welcome = ServerMessage::Welcome(Box::new(isinglass_core::wire::Welcome {
        ticket: t(),
        volume: greeting.volume,
        look_version: greeting.look_version,
        look: greeting.look,
        max_side: 8192,
        max_poses_per_second: 240,
    }));
    let bytes = [control::encode(&welcome).unwrap(), vec![0xff; 4]].concat();
    let (link, num) = forged_server(bytes);
    let _client = connect(&link);
    tokio::time::sleep(Duration::from_secs(5)).await;
    // After waits of 1/4, 1/2, 1 and 2 s, each up to a quarter shorter, the fifth is not yet over. It does try again.
    let num = num.load(std::sync::atomic::Ordering::Relaxed);
    assert!((2..=5).contains(&num), "{num} connections");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_server_that_speaks_garbage_is_given_up() {
    let (link, _) = forged_server(vec![0xff; 4]);
    let client = connect(&link);
    let error = client.wait_connected(Duration::from_secs(20)).unwrap_err();
    assert!(matches!(&error, ConnectError::Protocol(line) if line.contains("4294967295")), "{error}");
}

/// A server with the right certificate that says these bytes on the control stream, and the number of its connections.
fn forged_server(bytes: Vec<u8>) -> (Link, Arc<std::sync::atomic::AtomicU32>) {
    let num = Arc::new(std::sync::atomic::AtomicU32::new(0));
    let (endpoint, fingerprint) = forged_endpoint(&[ALPN]);
    let port = endpoint.local_addr().unwrap().port();
    let counter = num.clone();
    tokio::spawn(async move {
        while let Some(incoming) = endpoint.accept().await {
            counter.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
            let Ok(connection) = incoming.await else { continue };
            let Ok((mut send, _recv)) = connection.accept_bi().await else { continue };
            let _ = send.write_all(&bytes).await;
            connection.closed().await;
        }
    });
    (Link { host: "127.0.0.1".into(), port, token: t(), fingerprint, state: None }, num)
}
