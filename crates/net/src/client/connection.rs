//! Makes a connection, drives it, and reconnects after a loss.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use isinglass_core::session::client;
use isinglass_core::session::link::retry_wait_micros;
use isinglass_core::session::pose::ReceiverReport;
use isinglass_core::text::printable;
use isinglass_core::wire::control::hello;
use isinglass_core::wire::{
    ClientMessage, PROTOCOL_VERSION, Refusal, ServerMessage, Token, version_in_notice,
};
use quinn::{
    AsyncUdpSocket, Connection, ConnectionError, Endpoint, EndpointConfig, RecvStream, Runtime,
    SendDatagramError, SendStream, TokioRuntime, TransportErrorCode,
};
use rand::rngs::Xoshiro256PlusPlus;
use rand::{RngExt, SeedableRng};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior, timeout};
use tracing::Instrument;

use super::{ClientOptions, ConnectError, Shared, State, chunks};
use crate::conditioner::{ConditionedSocket, LinkModel};
use crate::control_stream::{self, ReceiveError};
use crate::identity::{IdentityError, Mismatch, SERVER_NAME, pinned_tls, random_token};
use crate::link::Link;
use crate::talk::until_due;
use crate::transport::{self, AUTH_DEADLINE};

/// The server's address and the content of the hello.
pub(super) struct Dialer {
    link: Link,
    name: String,
    conditioner: Option<LinkModel>,
    /// Makes the sockets, in place of the system.
    pub(super) sockets: Option<SocketSource>,
    config: quinn::ClientConfig,
    mismatch: Arc<Mismatch>,
    /// The link's token first, later the newest ticket.
    token: Token,
    instance: Token,
    random: Xoshiro256PlusPlus,
}

/// Makes a socket for each attempt to connect.
pub(super) type SocketSource = Box<dyn Fn() -> (Arc<dyn AsyncUdpSocket>, EndpointConfig) + Send + Sync>;

/// A connection that was welcomed.
struct Dialed {
    endpoint: Endpoint,
    connection: Connection,
    send: SendStream,
    recv: RecvStream,
}

impl Dialer {
    pub(super) fn new(link: Link, options: &ClientOptions) -> Result<Self, IdentityError> {
        let (tls, mismatch) = pinned_tls(link.fingerprint)?;
        let mut config = quinn::ClientConfig::new(Arc::new(tls));
        config.transport_config(Arc::new(transport::client()));
        let token = link.token.clone();
        Ok(Self {
            name: options.name.clone(),
            conditioner: options.conditioner.clone(),
            sockets: None,
            config,
            mismatch,
            token,
            instance: random_token()?,
            random: Xoshiro256PlusPlus::seed_from_u64(
                options.clock.now_micros() ^ u64::from(std::process::id()) << 32,
            ),
            link,
        })
    }

    async fn dial(&mut self, shared: &Arc<Shared>) -> Result<Dialed, ConnectError> {
        let (endpoint, connection) = self.shake_hands(shared).await?;
        if transport::has_no_common_version(&connection) {
            let told = timeout(AUTH_DEADLINE, connection.closed()).await;
            return Err(told.map_or(ConnectError::Version, |reason| self.explain(&reason)));
        }
        let hello = hello(self.token.clone(), self.instance.clone(), &self.name);
        let greeting = async {
            let (mut send, mut recv) = connection.open_bi().await.map_err(|e| self.explain(&e))?;
            let sent = control_stream::send(&mut send, &hello).await;
            let answer = control_stream::receive::<ServerMessage>(&mut recv).await;
            match (sent, answer) {
                (_, Ok(message)) => Ok((send, recv, message)),
                (_, Err(ReceiveError::Control(e))) => Err(ConnectError::Protocol(e.to_string())),
                (_, Err(ReceiveError::Ended(e))) => {
                    Err(connection.close_reason().map_or(ConnectError::Lost(e), |r| self.explain(&r)))
                }
            }
        };
        let (send, recv, message) =
            timeout(AUTH_DEADLINE, greeting).await.map_err(|_| self.no_answer())??;
        match message {
            ServerMessage::Welcome(welcome) => {
                self.token = welcome.ticket.clone();
                shared.chunks().handle_connected();
                let now = shared.clock.now_micros();
                let description = {
                    let mut talk = shared.talk.lock();
                    talk.handle_welcome(now, *welcome);
                    talk.link.description()
                };
                shared.update(|s| (s.welcome, s.state) = (description, State::Connected));
                Ok(Dialed { endpoint, connection, send, recv })
            }
            ServerMessage::Refused(refusal) => {
                connection.close(transport::CLOSE_BYE, b"");
                say_goodbye(&endpoint).await;
                Err(ConnectError::Refused(refusal))
            }
            _ => Err(ConnectError::Protocol("the first message is not a welcome".into())),
        }
    }

    /// Makes another connection while the present one is `silent`. If the present one is heard first, the attempt
    /// ends.
    async fn dial_beside(&mut self, shared: &Arc<Shared>, mut silent: watch::Receiver<bool>) -> Dialed {
        let mut attempt = 0;
        loop {
            if silent.wait_for(|is_silent| *is_silent).await.is_err() {
                // The present connection has ended.
                return std::future::pending().await;
            }
            let since_micros = shared.clock.now_micros();
            let dialed = tokio::select! {
                dialed = self.dial(shared) => Some(dialed),
                Ok(_) = silent.wait_for(|is_silent| !is_silent) => None,
            };
            match dialed {
                Some(Ok(dialed)) => return dialed,
                Some(Err(problem)) => {
                    tracing::warn!("{problem}");
                    attempt += 1;
                    shared.update(|s| s.state = State::Reconnecting { since_micros, attempt, problem });
                    tokio::time::sleep(BETWEEN_OTHERS).await;
                }
                None => {
                    attempt = 0;
                    shared.update(|s| s.state = State::Connected);
                }
            }
        }
    }

    /// Tries all addresses of the host, each a quarter of a second after the previous one; the first answer counts.
    async fn shake_hands(&self, shared: &Arc<Shared>) -> Result<(Endpoint, Connection), ConnectError> {
        let Link { host, port, .. } = &self.link;
        let resolve = |problem: String| ConnectError::Resolve { host: host.clone(), problem };
        let found = timeout(AUTH_DEADLINE, tokio::net::lookup_host((host.as_str(), *port)));
        let found = found.await.map_err(|_| resolve("no answer from the name service".into()))?;
        let addresses: Vec<_> = found.map_err(|e| resolve(e.to_string()))?.take(MAX_ADDRESSES).collect();
        if addresses.is_empty() {
            return Err(resolve("it has no address".into()));
        }
        let mut attempts = JoinSet::new();
        for (i, address) in addresses.into_iter().enumerate() {
            let endpoint = self.endpoint(address, shared);
            let config = self.config.clone();
            attempts.spawn(async move {
                tokio::time::sleep(HEAD_START * i as u32).await;
                let endpoint = endpoint.map_err(Failure::Socket)?;
                let connecting = endpoint
                    .connect_with(config, address, SERVER_NAME)
                    .map_err(|e| Failure::Socket(std::io::Error::other(e)))?;
                let connected = timeout(AUTH_DEADLINE, connecting).await.map_err(|_| Failure::Silence)?;
                Ok((endpoint, connected.map_err(Failure::Quic)?))
            });
        }
        let mut problem = self.no_answer();
        while let Some(attempt) = attempts.join_next().await {
            match attempt {
                Ok(Ok(connected)) => {
                    self.mismatch.forget();
                    return Ok(connected);
                }
                Ok(Err(Failure::Quic(e))) => problem = self.explain(&e),
                // An answer from one address says more than silence or a missing route at another.
                Ok(Err(Failure::Socket(e))) if problem == self.no_answer() => {
                    problem = ConnectError::Socket(e.to_string());
                }
                Ok(Err(_)) | Err(_) => {}
            }
        }
        Err(problem)
    }

    fn endpoint(&self, peer: SocketAddr, shared: &Shared) -> std::io::Result<Endpoint> {
        let any: SocketAddr = match peer {
            SocketAddr::V4(_) => ([0, 0, 0, 0], 0).into(),
            SocketAddr::V6(_) => ([0u16; 8], 0).into(),
        };
        let runtime = Arc::new(TokioRuntime);
        if let Some(source) = &self.sockets {
            let (socket, config) = source();
            return Endpoint::new_with_abstract_socket(config, None, socket, runtime);
        }
        let plain = runtime.wrap_udp_socket(std::net::UdpSocket::bind(any)?)?;
        let socket: Arc<dyn AsyncUdpSocket> = match &self.conditioner {
            Some(model) => ConditionedSocket::new(plain, model, shared.counters.clone()),
            None => plain,
        };
        Endpoint::new_with_abstract_socket(EndpointConfig::default(), None, socket, runtime)
    }

    fn no_answer(&self) -> ConnectError {
        ConnectError::NoAnswer { host: self.link.host.clone(), port: self.link.port }
    }

    /// The meaning of a connection's end.
    fn explain(&self, error: &ConnectionError) -> ConnectError {
        let Link { host, port, fingerprint, .. } = &self.link;
        if let Some(found) = self.mismatch.found() {
            return ConnectError::Certificate {
                host: host.clone(),
                port: *port,
                expected: *fingerprint,
                found,
            };
        }
        match error {
            ConnectionError::TimedOut => self.no_answer(),
            ConnectionError::VersionMismatch => ConnectError::Version,
            ConnectionError::ConnectionClosed(close)
                if close.error_code == TransportErrorCode::crypto(NO_COMMON_ALPN) =>
            {
                ConnectError::Version
            }
            ConnectionError::ConnectionClosed(close)
                if close.error_code == TransportErrorCode::CONNECTION_REFUSED =>
            {
                ConnectError::Busy
            }
            ConnectionError::ApplicationClosed(close) => {
                let reason = printable(&String::from_utf8_lossy(&close.reason), MAX_REASON_CHARS);
                match close.error_code {
                    transport::CLOSE_REPLACED => ConnectError::Replaced,
                    transport::CLOSE_REFUSED => ConnectError::Refused(Refusal::Protocol(reason)),
                    transport::CLOSE_VERSION => match version_in_notice(&close.reason) {
                        Some(server) => {
                            ConnectError::Refused(Refusal::Version { server, client: PROTOCOL_VERSION })
                        }
                        None => ConnectError::Version,
                    },
                    _ if reason.is_empty() => ConnectError::Lost("the server has closed it".into()),
                    _ => ConnectError::Lost(reason),
                }
            }
            ConnectionError::LocallyClosed => ConnectError::Lost("it was closed here".into()),
            other => ConnectError::Lost(other.to_string()),
        }
    }
}

enum Failure {
    Socket(std::io::Error),
    Quic(ConnectionError),
    Silence,
}

/// The whole life of the network thread.
pub(super) async fn run(shared: Arc<Shared>, mut dialer: Dialer) {
    let mut stop = shared.stop.subscribe();
    let stopped = async move { stop.wait_for(|s| *s).await.map(drop).unwrap_or_default() };
    tokio::pin!(stopped);
    let mut lost_at = None;
    let mut attempt = 1;
    loop {
        let dialed = tokio::select! {
            () = &mut stopped => return,
            dialed = dialer.dial(&shared) => dialed,
        };
        let problem = match dialed {
            Ok(dialed) => {
                let span = tracing::info_span!("session", server = %dialed.connection.remote_address());
                let (mut dialed, since) = (dialed, Instant::now());
                let ended = loop {
                    let (silent_in, silent) = watch::channel(false);
                    let old = dialed.connection.clone();
                    let ended = tokio::select! {
                        biased;
                        () = &mut stopped => break None,
                        other = dialer.dial_beside(&shared, silent.clone()) => Err(other),
                        ended = drive(&shared, &mut dialed, &silent_in).instrument(span.clone()) => Ok(ended),
                    };
                    let other = match ended {
                        Err(other) => Some(other),
                        // The server may close the old connection before its welcome over the other arrives.
                        Ok(_) if is_replaced(&old) && *silent.borrow() => {
                            timeout(AUTH_DEADLINE, dialer.dial(&shared)).await.ok().and_then(Result::ok)
                        }
                        Ok(ended) => break Some(ended),
                    };
                    let Some(other) = other else { break Some(Ended::Connection) };
                    old.close(transport::CLOSE_SILENT, b"");
                    dialed = other;
                };
                let Some(ended) = ended else {
                    let _ = control_stream::send(&mut dialed.send, &ClientMessage::Bye).await;
                    dialed.connection.close(transport::CLOSE_BYE, b"");
                    return say_goodbye(&dialed.endpoint).await;
                };
                if since.elapsed() >= USEFUL {
                    attempt = 0;
                }
                shared.talk.lock().handle_lost();
                lost_at = Some(shared.clock.now_micros());
                match ended {
                    Ended::Connection => {
                        let closed = timeout(REASON_WAIT, dialed.connection.closed()).await;
                        let reason = match closed {
                            Ok(reason) => reason,
                            Err(_) => {
                                // Only the stream has ended.
                                dialed
                                    .connection
                                    .close(transport::CLOSE_PROTOCOL, b"the control stream ended");
                                dialed.connection.closed().await
                            }
                        };
                        match dialer.explain(&reason) {
                            ConnectError::NoAnswer { .. } => {
                                ConnectError::Lost("no packet has come for long".into())
                            }
                            problem => problem,
                        }
                    }
                    Ended::Problem(problem) => {
                        dialed.connection.close(transport::CLOSE_PROTOCOL, b"");
                        problem
                    }
                }
            }
            Err(problem) => problem,
        };
        tracing::warn!("{problem}");
        if !problem.is_temporary() {
            shared.update(|s| s.state = State::Refused(problem));
            return;
        }
        attempt += 1;
        shared.update(|s| {
            s.stats.frames_per_second = 0;
            s.state = match lost_at {
                Some(since_micros) => State::Reconnecting { since_micros, attempt, problem },
                None => State::Connecting { attempt, problem: Some(problem) },
            };
        });
        let wait = retry_wait_micros(attempt, dialer.random.random());
        tokio::select! {
            () = &mut stopped => return,
            () = tokio::time::sleep(Duration::from_micros(wait)) => {}
        }
    }
}

/// Why a connection is no longer driven.
enum Ended {
    Connection,
    Problem(ConnectError),
}

async fn drive(shared: &Arc<Shared>, dialed: &mut Dialed, silent: &watch::Sender<bool>) -> Ended {
    let Dialed { connection, send, recv, .. } = dialed;
    let number = shared.chunks().connection();
    tokio::select! {
        () = chunks::read_all(shared, connection, number) => Ended::Connection,
        ended = read_messages(shared, recv) => ended,
        () = write_messages(shared, send) => Ended::Connection,
        () = send_poses(shared, connection) => Ended::Connection,
        () = watch_link(shared, connection, silent) => Ended::Connection,
    }
}

async fn read_messages(shared: &Shared, stream: &mut RecvStream) -> Ended {
    loop {
        let message = match control_stream::receive::<ServerMessage>(stream).await {
            Ok(message) => message,
            Err(ReceiveError::Control(e)) => return Ended::Problem(ConnectError::Protocol(e.to_string())),
            Err(ReceiveError::Ended(_)) => return Ended::Connection,
        };
        // The overlay shows these with the next frame.
        let is_quiet = matches!(message, ServerMessage::Stats(_));
        let handled = shared.talk.lock().handle_message(shared.clock.now_micros(), message);
        match handled {
            Ok(()) if is_quiet => {}
            Ok(()) => (shared.wake)(),
            Err(client::Ended::Refused(refusal)) => {
                return Ended::Problem(ConnectError::Refused(refusal));
            }
            Err(client::Ended::Broken(how)) => return Ended::Problem(ConnectError::Protocol(how.into())),
        }
    }
}

async fn write_messages(shared: &Shared, stream: &mut SendStream) {
    let mut changed = shared.talk.subscribe();
    loop {
        let (message, due) = {
            let mut talk = shared.talk.lock_quietly();
            (talk.poll_message(shared.clock.now_micros()), talk.due())
        };
        let Some(message) = message else {
            until_due(&mut changed, &shared.clock, due).await;
            continue;
        };
        match control_stream::send(stream, &message).await {
            Ok(()) => {}
            Err(control_stream::SendError::Control(e)) => tracing::error!("not sent: {e}"),
            Err(control_stream::SendError::Ended(_)) => return,
        }
    }
}

async fn send_poses(shared: &Shared, connection: &Connection) {
    let mut changed = shared.talk.subscribe();
    loop {
        let report = {
            let chunks = shared.chunks();
            let decode_nanos_per_list = chunks.decode_nanos_per_list();
            ReceiverReport { newest_complete: chunks.newest_complete(), decode_nanos_per_list }
        };
        let (request, due) = {
            let mut talk = shared.talk.lock_quietly();
            (talk.pose.poll_datagram(shared.clock.now_micros(), report), talk.pose.due())
        };
        let Some(request) = request else {
            until_due(&mut changed, &shared.clock, due).await;
            continue;
        };
        shared.chunks().handle_pose(request.stamp_micros, request.id);
        match connection.send_datagram(request.encode().to_vec().into()) {
            Ok(()) => {}
            Err(SendDatagramError::ConnectionLost(_)) => return,
            Err(e) => tracing::error!("no pose can be sent: {e}"),
        }
    }
}

/// Reads the connection's statistics, and tells whether the server is silent.
async fn watch_link(shared: &Shared, connection: &Connection, silent: &watch::Sender<bool>) {
    let mut tick = tokio::time::interval(STATS_INTERVAL);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let (mut heard_at, mut before) = (Instant::now(), connection.stats());
    let mut before_at = heard_at;
    loop {
        let now = tick.tick().await.max(before_at);
        let stats = connection.stats();
        if stats.udp_rx.datagrams != before.udp_rx.datagrams {
            heard_at = now;
        }
        let seconds = (now - before_at).as_secs_f64();
        let frames_per_second = shared.chunks().frames_per_second(shared.clock.now_micros());
        let mut has_changed = false;
        shared.status.update(|status| {
            let link = &mut status.stats;
            let was_silent = link.is_silent();
            if seconds > 0.0 {
                let rate = (stats.udp_rx.bytes - before.udp_rx.bytes) as f64 / seconds;
                // A mean over about a second.
                let weight = (seconds / 1.0).min(1.0);
                link.bytes_per_second += (rate - link.bytes_per_second) * weight;
            }
            link.frames_per_second = frames_per_second;
            link.rtt_micros = stats.path.rtt.as_micros() as u64;
            link.lost_packets = stats.path.lost_packets;
            link.silence_micros = (now - heard_at).as_micros() as u64;
            has_changed = link.is_silent() != was_silent;
        });
        if has_changed {
            (shared.wake)();
        }
        silent.send_if_modified(|is_silent| {
            let was = std::mem::replace(is_silent, now - heard_at > SILENCE_BEFORE_OTHER);
            was != *is_silent
        });
        (before, before_at) = (stats, now);
    }
}

fn is_replaced(connection: &Connection) -> bool {
    matches!(
        connection.close_reason(),
        Some(ConnectionError::ApplicationClosed(close)) if close.error_code == transport::CLOSE_REPLACED
    )
}

/// Waits for the last packet to leave.
async fn say_goodbye(endpoint: &Endpoint) {
    let _ = timeout(Duration::from_millis(100), endpoint.wait_idle()).await;
}

/// The TLS alert `no_application_protocol`, which QUIC carries in a crypto error (RFC 9001, section 4.8).
const NO_COMMON_ALPN: u8 = 120;
const STATS_INTERVAL: Duration = Duration::from_millis(200);
/// Silence after which another connection is tried. Keep-alives are answered twice a second.
const SILENCE_BEFORE_OTHER: Duration = Duration::from_secs(2);
/// Pause between such attempts.
const BETWEEN_OTHERS: Duration = Duration::from_millis(250);
/// Time for a connection's close reason to arrive after the end of its streams.
const REASON_WAIT: Duration = Duration::from_secs(1);
/// Longest close reason that is shown, in characters.
const MAX_REASON_CHARS: usize = 500;
/// A connection that lasted this long was of use. Attempts after one that ended sooner wait ever longer.
const USEFUL: Duration = Duration::from_secs(5);
/// Delay between attempts at the addresses of a host.
const HEAD_START: Duration = Duration::from_millis(250);
/// Most addresses of a host that are tried.
const MAX_ADDRESSES: usize = 4;
