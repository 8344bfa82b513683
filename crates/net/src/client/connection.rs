//! Making a connection, driving it, and coming back after it was lost.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use isinglass_core::ids::ShotId;
use isinglass_core::wire::control::hello;
use isinglass_core::wire::{
    ClientMessage, Part, Refusal, ServerMessage, ShotRequest, Token, VolumeChange, Welcome,
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

use super::{ClientOptions, ConnectError, Shared, State, chunks, shot};
use crate::conditioner::{ConditionedSocket, LinkModel};
use crate::control_stream::{self, ReceiveError};
use crate::identity::{IdentityError, Mismatch, SERVER_NAME, pinned_tls, random_token};
use crate::link::Link;
use crate::transport::{self, AUTH_DEADLINE, SILENCE_LIMIT};

/// Whom to call, and what to say.
pub(super) struct Dialer {
    link: Link,
    name: String,
    conditioner: Option<LinkModel>,
    config: quinn::ClientConfig,
    mismatch: Arc<Mismatch>,
    /// The link's token first, then the last ticket.
    token: Token,
    instance: Token,
    backoff: Backoff,
}

/// A connection that has said hello and was welcomed.
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
            config,
            mismatch,
            token,
            instance: random_token()?,
            backoff: Backoff::new(options.clock.now_micros() ^ u64::from(std::process::id()) << 32),
            link,
        })
    }

    async fn dial(&mut self, shared: &Arc<Shared>) -> Result<Dialed, ConnectError> {
        let (endpoint, connection) = self.shake_hands(shared).await?;
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
                let number = {
                    let mut session = shared.session();
                    session.handle_connected();
                    session.connection()
                };
                if number > 1 {
                    // Wished for while nobody was there, perhaps minutes ago: it would change what all others see.
                    shared.part.send_if_modified(|wish| wish.take().is_some());
                }
                let is_other = |known: &Arc<Welcome>| known.volume.name != welcome.volume.name;
                if shared.status.read().welcome.as_ref().is_some_and(is_other) {
                    // The look that was asked for was one of another file. Of another part of a file it stays.
                    shared.look.send_if_modified(|wish| wish.take().is_some());
                }
                shared.update(|s| {
                    s.connection = number;
                    s.look = Some((welcome.look_version, Arc::new(welcome.look.clone())));
                    s.is_draft = false;
                    s.welcome = Some(Arc::new(*welcome));
                    // Both are said again, if there are any.
                    (s.parts, s.load) = (None, None);
                    s.state = State::Connected;
                });
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

    /// Tries all addresses of the host, each a quarter of a second after the one before; the first to answer counts.
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

    /// What the end of a connection means.
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
                let reason: String =
                    String::from_utf8_lossy(&close.reason).chars().filter(|c| !c.is_control()).collect();
                match close.error_code {
                    transport::CLOSE_REPLACED => ConnectError::Replaced,
                    transport::CLOSE_REFUSED => ConnectError::Refused(Refusal::Protocol(reason)),
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

/// The network thread's whole life.
pub(super) async fn run(shared: Arc<Shared>, mut dialer: Dialer) {
    let mut stop = shared.stop.subscribe();
    let stopped = async move { stop.wait_for(|s| *s).await.map(drop).unwrap_or_default() };
    tokio::pin!(stopped);
    // Kept over connections: a wish made between a welcome and the first message after it is not lost, and one that was
    // sent is not sent again.
    let mut parts = shared.part.subscribe();
    parts.mark_changed();
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
                attempt = 0;
                let mut dialed = dialed;
                let ended = tokio::select! {
                    () = &mut stopped => None,
                    ended = drive(&shared, &mut dialed, &mut parts).instrument(span) => Some(ended),
                };
                let Some(ended) = ended else {
                    let _ = control_stream::send(&mut dialed.send, &ClientMessage::Bye).await;
                    dialed.connection.close(transport::CLOSE_BYE, b"");
                    return say_goodbye(&dialed.endpoint).await;
                };
                lost_at = Some(shared.clock.now_micros());
                match ended {
                    Ended::Connection => {
                        let closed = timeout(REASON_WAIT, dialed.connection.closed()).await;
                        let reason = match closed {
                            Ok(reason) => reason,
                            Err(_) => {
                                // The stream alone has ended.
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
                    Ended::Silence => {
                        dialed.connection.close(transport::CLOSE_SILENT, b"");
                        ConnectError::Lost(format!(
                            "no packet from the server for {} s",
                            SILENCE_LIMIT.as_secs()
                        ))
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
        tokio::select! {
            () = &mut stopped => return,
            () = tokio::time::sleep(dialer.backoff.after(attempt)) => {}
        }
    }
}

/// The newest wish for another part of the file; its inside is none where it is one for no other.
type PartWishes = watch::Receiver<Option<Option<Part>>>;

/// Why a connection is not driven any more.
enum Ended {
    Connection,
    Problem(ConnectError),
    Silence,
}

async fn drive(shared: &Arc<Shared>, dialed: &mut Dialed, parts: &mut PartWishes) -> Ended {
    let Dialed { connection, send, recv, .. } = dialed;
    let number = shared.session().connection();
    tokio::select! {
        () = chunks::read_all(shared, connection, number) => Ended::Connection,
        ended = read_messages(shared, recv) => ended,
        () = write_messages(shared, send, parts) => Ended::Connection,
        () = send_poses(shared, connection) => Ended::Connection,
        () = watch_link(shared, connection) => Ended::Silence,
    }
}

async fn read_messages(shared: &Shared, stream: &mut RecvStream) -> Ended {
    loop {
        match control_stream::receive::<ServerMessage>(stream).await {
            Ok(ServerMessage::LookChanged { version, look, is_draft }) => {
                shared.update(|s| (s.look, s.is_draft) = (Some((version, Arc::new(look))), is_draft));
            }
            Ok(ServerMessage::VolumeChanged(change)) => change_volume(shared, *change),
            Ok(ServerMessage::Parts(parts)) => shared.update(|s| s.parts = Some(Arc::new(*parts))),
            Ok(ServerMessage::Load(load)) => shared.update(|s| s.load = Some(load)),
            Ok(ServerMessage::Probed(probed)) => shared.update(|s| s.probed = Some(probed)),
            Ok(ServerMessage::ShotFailed { id, why }) => shot::settle(shared, id, Err(why)),
            Ok(ServerMessage::Notice(text)) => {
                shared.status.put_notice(text);
                (shared.wake)();
            }
            Ok(ServerMessage::Stats(stats)) => shared.status.update(|s| s.stats.server = stats),
            Ok(ServerMessage::Refused(refusal)) => return Ended::Problem(ConnectError::Refused(refusal)),
            Ok(ServerMessage::Welcome(_)) => {
                return Ended::Problem(ConnectError::Protocol("a second welcome".into()));
            }
            Err(ReceiveError::Control(e)) => return Ended::Problem(ConnectError::Protocol(e.to_string())),
            Err(ReceiveError::Ended(_)) => return Ended::Connection,
        }
    }
}

/// Another volume is shown from now on. Its look may be another too, which is not to be undone by asking again for the one
/// before: over the next connection that of the new volume is asked for.
fn change_volume(shared: &Shared, change: VolumeChange) {
    let VolumeChange { volume, look_version, look } = change;
    let before = shared.status.read().look.clone();
    shared.look.send_if_modified(|wanted| {
        if wanted.is_some() && wanted.as_ref() == before.as_ref().map(|(_, look)| &**look) {
            *wanted = Some(look.clone());
        }
        false
    });
    shared.update(|s| {
        if let Some(welcome) = &s.welcome {
            s.welcome =
                Some(Arc::new(Welcome { volume, look_version, look: look.clone(), ..(**welcome).clone() }));
        }
        s.look = Some((look_version, Arc::new(look)));
        (s.is_draft, s.probed) = (false, None);
    });
}

/// Looks, parts and reports, the newest of each.
async fn write_messages(shared: &Shared, stream: &mut SendStream, parts: &mut PartWishes) {
    let mut looks = shared.look.subscribe();
    let mut reports = shared.report.subscribe();
    let mut probes = shared.probe.subscribe();
    // Nor is a question forgotten that was asked without a connection.
    probes.mark_changed();
    let mut shots = shared.shot.subscribe();
    // A look that was asked for over a connection that is gone is asked for again.
    looks.mark_changed();
    // Once one was asked for over this connection, what is in force is on its way to that one.
    let in_force = || shared.status.read().look.as_ref().map(|(_, look)| look.as_ref().clone());
    let since = || shared.status.read().welcome.as_ref().map(|w| w.look_version);
    let (mut asked, mut asked_since) = (in_force(), since());
    let mut next_report = Instant::now() + REPORT_INTERVAL;
    // After the look: a picture that is still waited for is asked for again, too.
    shots.mark_changed();
    let (mut shoots_at, mut probes_at) = (Instant::now(), Instant::now());
    let mut asked_shot = None;
    loop {
        let message = tokio::select! {
            biased;
            changed = looks.changed() => {
                let wanted = looks.borrow_and_update().clone();
                if changed.is_err() {
                    return;
                }
                // Another volume may have come with another look.
                if std::mem::replace(&mut asked_since, since()) != asked_since {
                    asked = in_force();
                }
                let wanted = wanted.filter(|w| asked.as_ref() != Some(w));
                asked = wanted.clone().or(asked);
                wanted.map(ClientMessage::SetLook)
            }
            changed = parts.changed() => {
                if changed.is_err() {
                    return;
                }
                let wish = *parts.borrow_and_update();
                wish.map(|part| part.map_or(ClientMessage::CancelPart, ClientMessage::OpenPart))
            }
            changed = changed_after(shoots_at, &mut shots) => {
                if changed.is_err() {
                    return;
                }
                shoots_at = Instant::now() + SHOT_INTERVAL;
                let waiting = shots.borrow_and_update().clone();
                shot_message(waiting, &mut asked_shot)
            }
            changed = changed_after(probes_at, &mut probes) => {
                if changed.is_err() {
                    return;
                }
                probes_at = Instant::now() + PROBE_INTERVAL;
                probes.borrow_and_update().map(ClientMessage::Probe)
            }
            () = tokio::time::sleep_until(next_report) => {
                next_report += REPORT_INTERVAL;
                let report = if reports.has_changed().unwrap_or(false) { *reports.borrow_and_update() } else { None };
                report.map(ClientMessage::Stats)
            }
        };
        let Some(message) = message else { continue };
        match control_stream::send(stream, &message).await {
            Ok(()) => {}
            Err(control_stream::SendError::Control(e)) => tracing::error!("not sent: {e}"),
            Err(control_stream::SendError::Ended(_)) => return,
        }
    }
}

/// Waits for a moment, and then for a change: who asks too often is sent away.
async fn changed_after<T>(
    at: Instant,
    value: &mut watch::Receiver<T>,
) -> Result<(), watch::error::RecvError> {
    tokio::time::sleep_until(at).await;
    value.changed().await
}

/// What to say of the picture that is wanted; `asked` is the one that the server knows of.
fn shot_message(waiting: Option<ShotRequest>, asked: &mut Option<ShotId>) -> Option<ClientMessage> {
    let before = std::mem::replace(asked, waiting.as_ref().map(|w| w.id));
    match waiting {
        Some(shot) => (before != Some(shot.id)).then_some(ClientMessage::Shoot(shot)),
        None => before.map(|_| ClientMessage::CancelShot),
    }
}

/// A datagram for every new pose, at most 120 a second, and ten a second at rest: a lost one heals by itself, the
/// newest complete frame is acknowledged, and no timer on the way grows sleepy.
async fn send_poses(shared: &Shared, connection: &Connection) {
    let mut poses = shared.pose.subscribe();
    poses.mark_changed();
    let mut noted = None;
    loop {
        let _ = timeout(POSE_REPEAT, poses.changed()).await;
        let newest = *poses.borrow_and_update();
        if let Some(mut request) = newest {
            if noted.replace(request.id) != Some(request.id) {
                shared.session().handle_pose(request.stamp_micros, request.id);
            }
            {
                let session = shared.session();
                request.newest_complete = session.newest_complete();
                request.decode_nanos_per_list = session.decode_nanos_per_list();
            }
            request.shown_turn_deg = shared.wishes.shown_turn_deg();
            match connection.send_datagram(request.encode().to_vec().into()) {
                Ok(()) => {}
                Err(SendDatagramError::ConnectionLost(_)) => return,
                Err(e) => tracing::error!("no pose can be sent: {e}"),
            }
        }
        tokio::time::sleep(POSE_INTERVAL).await;
    }
}

/// Reads the connection's numbers; returns when nothing has come for too long.
async fn watch_link(shared: &Shared, connection: &Connection) {
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
        let frames_per_second = shared.session().frames_per_second(shared.clock.now_micros());
        shared.note_shown();
        shared.status.update(|status| {
            let link = &mut status.stats;
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
        });
        if now - heard_at > SILENCE_LIMIT {
            return;
        }
        (before, before_at) = (stats, now);
    }
}

/// Lets the last packet leave.
async fn say_goodbye(endpoint: &Endpoint) {
    let _ = timeout(Duration::from_millis(100), endpoint.wait_idle()).await;
}

/// How long to wait before the next attempt.
struct Backoff(Xoshiro256PlusPlus);

impl Backoff {
    fn new(seed: u64) -> Self {
        Self(Xoshiro256PlusPlus::seed_from_u64(seed))
    }

    /// 0.25 s, doubled each time up to 5 s, then up to a quarter less, so that many clients do not come at once.
    fn after(&mut self, attempt: u32) -> Duration {
        let whole = (FIRST_BACKOFF * (1 << attempt.saturating_sub(1).min(8))).min(LONGEST_BACKOFF);
        whole.mul_f64(1.0 - 0.25 * self.0.random::<f64>())
    }
}

/// The TLS alert `no_application_protocol`, which QUIC carries in a crypto error (RFC 9001, section 4.8).
const NO_COMMON_ALPN: u8 = 120;
const POSE_INTERVAL: Duration = Duration::from_micros(8_300);
const POSE_REPEAT: Duration = Duration::from_millis(100);
/// Questions go out at most 30 times a second.
const PROBE_INTERVAL: Duration = Duration::from_micros(33_334);
/// And pictures are asked for.
const SHOT_INTERVAL: Duration = PROBE_INTERVAL;
const REPORT_INTERVAL: Duration = Duration::from_secs(1);
const STATS_INTERVAL: Duration = Duration::from_millis(200);
/// Why a connection is closed comes with the end of its streams, or soon after.
const REASON_WAIT: Duration = Duration::from_secs(1);
const FIRST_BACKOFF: Duration = Duration::from_millis(250);
const LONGEST_BACKOFF: Duration = Duration::from_secs(5);
/// Between the addresses of a host.
const HEAD_START: Duration = Duration::from_millis(250);
/// Addresses of a host that are tried.
const MAX_ADDRESSES: usize = 4;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn backoff_doubles_to_its_limit_with_jitter() {
        let mut backoff = Backoff::new(3);
        for (attempt, whole) in [(1, 250), (2, 500), (3, 1000), (5, 4000), (6, 5000), (1000, 5000)] {
            let d = backoff.after(attempt).as_millis();
            assert!((whole * 3 / 4..=whole).contains(&d), "{attempt}: {d}");
        }
        let several: Vec<_> = (0..4).map(|_| backoff.after(1)).collect();
        assert!(several.windows(2).any(|w| w[0] != w[1]));
    }
}
