//! The server: it admits viewers and hands out one [`Session`] for each connection.

mod frames;
mod known_paths;
mod pending_hellos;
mod session;
mod stranger_log;
mod streams;

use std::collections::HashMap;
use std::io;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use isinglass_core::camera::MAX_SIDE;
use isinglass_core::ids::LookVersion;
use isinglass_core::look::Look;
use isinglass_core::session::admission::{Admission, ViewerId};
use isinglass_core::session::chunks::CONTROL_PRIORITY;
use isinglass_core::session::pose::MAX_POSES_PER_SECOND;
use isinglass_core::session::server::violation;
use isinglass_core::wire::{
    ClientMessage, PROTOCOL_VERSION, Refusal, ServerMessage, Token, VolumeDescription, Welcome,
    version_notice,
};
use quinn::congestion::ControllerFactory;
use quinn::{Connection, Endpoint, EndpointConfig, Incoming, RecvStream, Runtime, SendStream, TokioRuntime};
use tokio::sync::{Notify, Semaphore, mpsc};
use tokio::task::AbortHandle;
use tokio::time::Instant;
use tracing::Instrument;

use crate::carrier::{CarrierSocket, StreamDoor, is_stream_address, peer_address};
use crate::clock::Clock;
use crate::congestion::{DelayConfig, LinkGauge};
use crate::control_stream::{self, ReceiveError};
use crate::identity::{Fingerprint, Identity, IdentityError, quic_server, random_token};
use crate::link::Link;
use crate::transport;

use known_paths::KnownPaths;
use pending_hellos::{MAX_PENDING, PendingHellos};
use stranger_log::StrangerLog;

pub use frames::{FrameSender, SentSlice};
pub use session::{Control, Session, SessionClosed};

/// A bound endpoint that admits viewers.
#[derive(Debug)]
pub struct Server {
    endpoint: Endpoint,
    /// Accepts byte streams.
    listening: Option<AbortHandle>,
    shared: Arc<ServerShared>,
    sessions: mpsc::Receiver<Session>,
    fingerprint: Fingerprint,
}

/// Limits of a server.
#[derive(Clone, Debug)]
pub struct ServerOptions {
    /// Most viewers at the same time.
    pub max_viewers: u32,
    /// Clock of all stamps.
    pub clock: Clock,
}

impl Default for ServerOptions {
    fn default() -> Self {
        Self { max_viewers: 8, clock: Clock::start() }
    }
}

/// A congestion control for comparison with [`crate::congestion`].
pub(crate) struct OtherCongestion(pub(crate) Arc<dyn ControllerFactory + Send + Sync>);

impl std::fmt::Debug for OtherCongestion {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("OtherCongestion")
    }
}

/// What every viewer is told in its welcome.
#[derive(Clone, Debug)]
pub struct Greeting {
    /// The volume.
    pub volume: VolumeDescription,
    /// Version of the look.
    pub look_version: LookVersion,
    /// The look that a session begins with.
    pub look: Look,
}

/// Why there is no server.
#[derive(Debug, thiserror::Error)]
pub enum BindError {
    /// Another program has the port.
    #[error("port {} of {} is in use; choose another with --listen", .0.port(), .0.ip())]
    InUse(SocketAddr),
    /// The server cannot listen on the address.
    #[error("cannot listen on {address}: {source}")]
    Io {
        /// The address.
        address: SocketAddr,
        /// The system's message.
        source: io::Error,
    },
    /// There is no certificate, or no random numbers.
    #[error(transparent)]
    Identity(#[from] IdentityError),
    /// All places of the server are used.
    #[error("no more links can be made by this server; restart it")]
    NoPlaces,
}

#[derive(Debug)]
struct ServerShared {
    options: ServerOptions,
    config: quinn::ServerConfig,
    other_congestion: Option<OtherCongestion>,
    /// Where the byte streams of viewers come in.
    door: Option<StreamDoor>,
    greeting: Mutex<Arc<Greeting>>,
    doors: Mutex<Doors>,
    pending: Arc<PendingHellos>,
    /// Bounds the connections that are refused and still have to hear why.
    farewells: Semaphore,
    known_paths: KnownPaths,
    strangers: StrangerLog,
    /// Connections that came to nothing.
    refusals: Arc<AtomicU64>,
    /// Notified when a place is given back.
    left: Arc<Notify>,
}

/// Who may join, and who has joined.
#[derive(Debug, Default)]
struct Doors {
    admission: Admission,
    live: HashMap<ViewerId, (u64, Connection)>,
    next_session: u64,
}

impl Server {
    /// Listens on an address. Must be called within a tokio runtime, which then drives the server. Nobody is admitted
    /// before [`Server::mint_token`] or [`Server::mint_link`].
    ///
    /// # Errors
    /// If the address is taken or cannot be used.
    pub fn bind(
        address: SocketAddr,
        identity: &Identity,
        options: ServerOptions,
        greeting: impl Into<Arc<Greeting>>,
    ) -> Result<Self, BindError> {
        let io_error = |source: io::Error| match source.kind() {
            io::ErrorKind::AddrInUse => BindError::InUse(address),
            _ => BindError::Io { address, source },
        };
        let (udp, listener) = streams::bind_both(address).map_err(io_error)?;
        let udp = TokioRuntime.wrap_udp_socket(udp).map_err(io_error)?;
        let (socket, door) = CarrierSocket::with_streams(udp);
        let tls = identity.tls()?;
        let mut config = quic_server(tls.clone())?;
        config.max_incoming(MAX_PENDING).incoming_buffer_size(64 << 10).incoming_buffer_size_total(4 << 20);
        let endpoint = Endpoint::new_with_abstract_socket(
            EndpointConfig::default(),
            Some(config.clone()),
            socket,
            Arc::new(TokioRuntime),
        );
        let endpoint = endpoint.map_err(io_error)?;
        let fingerprint = identity.fingerprint();
        let mut server =
            Self::over(endpoint, config, fingerprint, options, greeting.into(), None, Some(door.clone()));
        let accepting = streams::accept_all(listener, tls, door, server.shared.clone());
        server.listening = Some(tokio::spawn(accepting).abort_handle());
        Ok(server)
    }

    /// The same over an endpoint with this configuration.
    pub(crate) fn over(
        endpoint: Endpoint,
        config: quinn::ServerConfig,
        fingerprint: Fingerprint,
        options: ServerOptions,
        greeting: Arc<Greeting>,
        other_congestion: Option<OtherCongestion>,
        door: Option<StreamDoor>,
    ) -> Self {
        let shared = Arc::new(ServerShared {
            options,
            config,
            other_congestion,
            door,
            greeting: Mutex::new(greeting),
            doors: Mutex::default(),
            pending: Arc::default(),
            farewells: Semaphore::new(MAX_FAREWELLS),
            known_paths: KnownPaths::default(),
            strangers: StrangerLog::default(),
            refusals: Arc::default(),
            left: Arc::default(),
        });
        let (sender, sessions) = mpsc::channel(MAX_UNACCEPTED);
        tokio::spawn(accept_all(endpoint.clone(), shared.clone(), sender));
        Self { endpoint, listening: None, shared, sessions, fingerprint }
    }

    /// The bound address with its real port.
    ///
    /// # Errors
    /// If the socket is gone.
    pub fn local_addr(&self) -> io::Result<SocketAddr> {
        self.endpoint.local_addr()
    }

    /// A new token that admits one viewer.
    ///
    /// # Errors
    /// If there are no random numbers or no places.
    pub fn mint_token(&self) -> Result<Token, BindError> {
        let token = random_token()?;
        self.shared.doors().admission.add(token.clone()).ok_or(BindError::NoPlaces)?;
        Ok(token)
    }

    /// A new link that admits one viewer, which reaches this server as `host`.
    ///
    /// # Errors
    /// If there are no random numbers or no places.
    pub fn mint_link(&self, host: &str) -> Result<Link, BindError> {
        let address = self.local_addr();
        let port =
            address.map_err(|source| BindError::Io { address: ([0, 0, 0, 0], 0).into(), source })?.port();
        let token = self.mint_token()?;
        Ok(Link { host: host.to_owned(), port, token, fingerprint: self.fingerprint, state: None })
    }

    /// Number of links that a viewer has used.
    pub fn num_used_links(&self) -> usize {
        self.shared.doors().admission.num_used()
    }

    /// The number of connections that came to nothing before their viewer was let in.
    pub fn refusals(&self) -> Arc<AtomicU64> {
        self.shared.refusals.clone()
    }

    /// Notified when a viewer gives its place back, even one that left before it was accepted.
    pub fn left(&self) -> Arc<Notify> {
        self.shared.left.clone()
    }

    /// Sets the greeting of later viewers.
    pub fn set_greeting(&self, greeting: Arc<Greeting>) {
        *self.shared.greeting.lock().unwrap_or_else(PoisonError::into_inner) = greeting;
    }

    /// Number of connected viewers.
    pub fn num_viewers(&self) -> usize {
        self.shared.doors().live.len()
    }

    /// The next admitted viewer. `None` after [`Server::close`].
    pub async fn accept(&mut self) -> Option<Session> {
        self.sessions.recv().await
    }

    /// Ends all sessions and waits briefly until the viewers know.
    pub async fn close(&self) {
        self.stop_listening();
        self.endpoint.close(transport::CLOSE_SESSION, b"the server was stopped");
        let _ = tokio::time::timeout(Duration::from_millis(500), self.endpoint.wait_idle()).await;
    }
}

impl Server {
    fn stop_listening(&self) {
        self.listening.iter().for_each(AbortHandle::abort);
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.stop_listening();
        self.endpoint.close(transport::CLOSE_SESSION, b"the server was stopped");
    }
}

impl ServerShared {
    /// The configuration of one connection.
    fn config_with(&self, gauge: Arc<LinkGauge>, remote: SocketAddr) -> Arc<quinn::ServerConfig> {
        let congestion = match &self.other_congestion {
            Some(OtherCongestion(other)) => other.clone(),
            None => {
                let first_window_bytes = self.known_paths.first_window_bytes(remote.ip(), Instant::now());
                Arc::new(DelayConfig { gauge, first_window_bytes })
            }
        };
        let mut config = self.config.clone();
        config.transport_config(Arc::new(transport::server(congestion)));
        Arc::new(config)
    }

    fn doors(&self) -> MutexGuard<'_, Doors> {
        // Every change is one step, so a panic leaves the doors in order.
        self.doors.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

async fn accept_all(endpoint: Endpoint, shared: Arc<ServerShared>, sessions: mpsc::Sender<Session>) {
    while let Some(incoming) = endpoint.accept().await {
        let remote = incoming.remote_address();
        let shared = shared.clone();
        let sessions = sessions.clone();
        if is_stream_address(remote) {
            tokio::spawn(serve_stream(incoming, shared, sessions).instrument(connection_span(remote)));
            continue;
        }
        // One more round trip proves the address; on this machine nobody can forge it.
        if !remote.ip().is_loopback() && !incoming.remote_address_validated() && incoming.may_retry() {
            let _ = incoming.retry();
            continue;
        }
        let serving = async move {
            let Some(mut seat) = shared.pending.enter(remote.ip(), Instant::now()) else {
                shared.tell(remote, &CROWDED);
                return incoming.refuse();
            };
            let admitted = tokio::select! {
                admitted = admit(&shared, incoming) => admitted,
                why = seat.is_given_up() => Err(Rejection::Ended(why)),
            };
            // Nobody waits for the seat of one that is refused and only has to hear it.
            drop(seat);
            match admitted {
                Ok(admitted) => session::run(admitted, sessions).await,
                Err(failure) => shared.tell(remote, &failure.conclude(&shared).await),
            }
        };
        tokio::spawn(serving.instrument(connection_span(remote)));
    }
}

/// Serves the one connection over a byte stream. The stream has the seat.
async fn serve_stream(incoming: Incoming, shared: Arc<ServerShared>, sessions: mpsc::Sender<Session>) {
    let remote = incoming.remote_address();
    let Some(door) = shared.door.clone().filter(|door| door.begin(remote)) else { return incoming.refuse() };
    match admit(&shared, incoming).await {
        Ok(admitted) => {
            door.admit(remote);
            session::run(admitted, sessions).await;
        }
        Err(failure) => {
            // This gives the seat back.
            door.refuse(remote);
            shared.tell(remote, &failure.conclude(&shared).await);
        }
    }
    door.close(remote);
}

fn connection_span(remote: SocketAddr) -> tracing::Span {
    tracing::info_span!("connection", remote = %peer_address(remote))
}

/// A connection whose hello was accepted and answered.
struct Admitted {
    connection: Connection,
    gauge: Arc<LinkGauge>,
    send: SendStream,
    recv: RecvStream,
    place: Place,
    name: String,
    greeting: Arc<Greeting>,
}

/// A viewer's place among the connected ones, given back however its task ends.
struct Place {
    shared: Arc<ServerShared>,
    viewer: ViewerId,
    session: u64,
}

impl Drop for Place {
    fn drop(&mut self) {
        self.shared.leave(self.viewer, self.session);
        self.shared.left.notify_one();
    }
}

/// Why there is no viewer.
enum Rejection {
    /// The connection has ended.
    Ended(String),
    /// Its client still has to hear why.
    Refused(Connection, SendStream, Refusal),
}

impl From<String> for Rejection {
    fn from(why: String) -> Self {
        Self::Ended(why)
    }
}

impl Rejection {
    /// Ends the connection. Returns the reason.
    async fn conclude(self, shared: &ServerShared) -> String {
        match self {
            Self::Ended(why) => why,
            Self::Refused(connection, mut send, refusal) => {
                refuse(shared, &connection, &mut send, refusal).await
            }
        }
    }
}

/// From the first packet to the welcome, or why there is no viewer.
async fn admit(shared: &Arc<ServerShared>, incoming: Incoming) -> Result<Admitted, Rejection> {
    let remote = incoming.remote_address();
    let gauge = Arc::<LinkGauge>::default();
    let greeted = async {
        let connecting = incoming.accept_with(shared.config_with(gauge.clone(), remote));
        let connection = connecting.map_err(|e| e.to_string())?.await.map_err(|e| e.to_string())?;
        let guard = CloseUnlessKept(Some(connection.clone()));
        if transport::has_no_common_version(&connection) {
            connection.close(transport::CLOSE_VERSION, version_notice());
            return Err(format!("a viewer of another protocol version than {PROTOCOL_VERSION}"));
        }
        let (send, mut recv) = connection.accept_bi().await.map_err(|e| e.to_string())?;
        let _ = send.set_priority(CONTROL_PRIORITY);
        let hello = control_stream::receive::<ClientMessage>(&mut recv).await;
        Ok::<_, String>((connection, guard, send, recv, hello))
    };
    let (connection, mut guard, mut send, recv, hello) =
        match tokio::time::timeout(transport::AUTH_DEADLINE, greeted).await {
            Ok(Ok(greeted)) => greeted,
            Ok(Err(e)) => return Err(e.into()),
            Err(_) => return Err(format!("no hello within {:?}", transport::AUTH_DEADLINE).into()),
        };
    let decision = match hello {
        Ok(ClientMessage::Hello { protocol, token, instance, name }) => {
            welcome(shared, &connection, protocol, &token, &instance).map(|w| (w, name))
        }
        Ok(_) => Err(Refusal::Protocol("the first message is not a hello".into())),
        Err(ReceiveError::Control(e)) => Err(violation(&e)),
        Err(e @ ReceiveError::Ended(_)) => return Err(e.to_string().into()),
    };
    let ((viewer, session, welcome, greeting), name) = match decision {
        Ok(decision) => decision,
        Err(refusal) => {
            guard.0 = None;
            return Err(Rejection::Refused(connection, send, refusal));
        }
    };
    let place = Place { shared: shared.clone(), viewer, session };
    let welcome = ServerMessage::Welcome(welcome);
    control_stream::send(&mut send, &welcome).await.map_err(|e| e.to_string())?;
    guard.0 = None;
    Ok(Admitted { connection, gauge, send, recv, place, name, greeting })
}

/// Decides on a hello and takes the place.
fn welcome(
    shared: &ServerShared,
    connection: &Connection,
    protocol: u32,
    token: &Token,
    instance: &Token,
) -> Result<(ViewerId, u64, Box<Welcome>, Arc<Greeting>), Refusal> {
    let ticket = random_token().map_err(|e| Refusal::Protocol(e.to_string()))?;
    let mut doors = shared.doors();
    let Doors { admission, live, .. } = &mut *doors;
    let is_full = |viewer| {
        let others = live.keys().filter(|v| **v != viewer).count();
        let max_viewers = shared.options.max_viewers;
        (others >= max_viewers as usize).then_some(Refusal::Full(max_viewers))
    };
    let viewer = admission.admit(protocol, token, instance, &ticket, is_full)?;
    doors.next_session += 1;
    let session = doors.next_session;
    if let Some((_, old)) = doors.live.insert(viewer, (session, connection.clone())) {
        old.close(transport::CLOSE_REPLACED, b"the viewer has connected again");
    }
    drop(doors);
    let greeting = shared.greeting.lock().unwrap_or_else(PoisonError::into_inner).clone();
    let welcome = Welcome {
        ticket,
        volume: greeting.volume.clone(),
        look_version: greeting.look_version,
        look: greeting.look.clone(),
        max_side: MAX_SIDE,
        max_poses_per_second: MAX_POSES_PER_SECOND,
    };
    Ok((viewer, session, Box::new(welcome), greeting))
}

impl ServerShared {
    /// Logs that a connection came to nothing.
    fn tell(&self, remote: SocketAddr, why: &dyn std::fmt::Display) {
        self.refusals.fetch_add(1, Ordering::Relaxed);
        self.strangers.tell(peer_address(remote), Instant::now(), why);
    }

    /// The session is over; a newer one of the same viewer stays.
    fn leave(&self, viewer: ViewerId, session: u64) {
        let mut doors = self.doors();
        if doors.live.get(&viewer).is_some_and(|(s, _)| *s == session) {
            doors.live.remove(&viewer);
        }
    }
}

/// Tells a client why, and closes when it has heard or after a short time. If many have to hear it, the close alone tells.
/// Returns the reason.
async fn refuse(
    shared: &ServerShared,
    connection: &Connection,
    send: &mut SendStream,
    refusal: Refusal,
) -> String {
    let (reason, is_temporary) = (refusal.to_string(), refusal.is_temporary());
    let told = async {
        if control_stream::send(send, &ServerMessage::Refused(refusal)).await.is_ok() {
            let _ = send.finish();
            connection.closed().await;
        }
    };
    match shared.farewells.try_acquire() {
        Ok(_held) => {
            // A client without room to receive never hears why.
            let _ = tokio::time::timeout(REFUSAL_LINGER, told).await;
            connection.close(transport::CLOSE_REFUSED, reason.as_bytes());
        }
        // Whoever may come back must not take this for the last word.
        Err(_) if is_temporary => connection.close(transport::CLOSE_SESSION, reason.as_bytes()),
        Err(_) => connection.close(transport::CLOSE_REFUSED, reason.as_bytes()),
    }
    format!("refused: {reason}")
}

const CROWDED: &str = "too many connections at once";

/// Closes a connection unless somebody takes it over.
struct CloseUnlessKept(Option<Connection>);

impl Drop for CloseUnlessKept {
    fn drop(&mut self) {
        if let Some(connection) = self.0.take() {
            connection.close(transport::CLOSE_PROTOCOL, b"no hello in time");
        }
    }
}

/// Most sessions that wait for [`Server::accept`].
const MAX_UNACCEPTED: usize = 16;
/// Most refused clients at a time that have it.
const MAX_FAREWELLS: usize = 64;
/// Time for a refused client to read why.
const REFUSAL_LINGER: Duration = Duration::from_secs(1);
