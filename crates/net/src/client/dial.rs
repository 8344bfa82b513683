//! Makes a connection: over UDP, or where that does not come through over TCP or a tunnel.

use std::net::{Ipv4Addr, SocketAddr};
use std::process::Stdio;
use std::sync::Arc;
use std::time::Duration;

use isinglass_core::text::printable;
use isinglass_core::wire::control::hello;
use isinglass_core::wire::{PROTOCOL_VERSION, Refusal, ServerMessage, Token, version_in_notice};
use quinn::{
    AsyncUdpSocket, Connection, ConnectionError, Endpoint, EndpointConfig, RecvStream, Runtime, SendStream,
    TokioRuntime, TransportErrorCode,
};
use rand::SeedableRng;
use rand::rngs::Xoshiro256PlusPlus;
use rustls::pki_types::ServerName;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio::time::timeout;
use tokio_rustls::TlsConnector;

use super::connection::say_goodbye;
use super::{ClientOptions, ConnectError, Shared, State, Tunnel};
use crate::carrier::{Carrier, CarrierSocket, stream_address};
use crate::conditioner::{ConditionedSocket, LinkModel, SharedCounters};
use crate::control_stream::{self, ReceiveError};
use crate::identity::{IdentityError, Mismatch, SERVER_NAME, pinned_tls, quic_client, random_token};
use crate::link::Link;
use crate::transport::{self, AUTH_DEADLINE};

/// The server's address and the content of the hello.
pub(super) struct Dialer {
    link: Link,
    name: String,
    conditioner: Option<LinkModel>,
    /// Makes the sockets, in place of the system.
    pub(super) sockets: Option<SocketSource>,
    tunnel: Option<Tunnel>,
    config: quinn::ClientConfig,
    tls: Arc<rustls::ClientConfig>,
    /// What came through last.
    carrier: Carrier,
    mismatch: Arc<Mismatch>,
    /// The link's token first, later the newest ticket.
    token: Token,
    instance: Token,
    pub(super) random: Xoshiro256PlusPlus,
}

/// Makes a socket for each attempt to connect.
pub(super) type SocketSource = Box<dyn Fn() -> (Arc<dyn AsyncUdpSocket>, EndpointConfig) + Send + Sync>;

/// A connection that was welcomed.
pub(super) struct Dialed {
    pub(super) endpoint: Endpoint,
    pub(super) connection: Connection,
    pub(super) send: SendStream,
    pub(super) recv: RecvStream,
}

impl Dialer {
    pub(super) fn new(link: Link, options: &ClientOptions) -> Result<Self, IdentityError> {
        let (tls, mismatch) = pinned_tls(link.fingerprint)?;
        let mut config = quic_client(tls.clone())?;
        config.transport_config(Arc::new(transport::client()));
        let token = link.token.clone();
        Ok(Self {
            name: options.name.clone(),
            conditioner: options.conditioner.clone(),
            sockets: None,
            tunnel: options.tunnel.clone(),
            config,
            tls,
            carrier: Carrier::Udp,
            mismatch,
            token,
            instance: random_token()?,
            random: Xoshiro256PlusPlus::seed_from_u64(
                options.clock.now_micros() ^ u64::from(std::process::id()) << 32,
            ),
            link,
        })
    }

    pub(super) async fn dial(&mut self, shared: &Arc<Shared>) -> Result<Dialed, ConnectError> {
        let Connected { endpoint, connection, carrier } = self.shake_hands(shared).await?;
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
                self.carrier = carrier;
                shared.update(|s| {
                    (s.welcome, s.state, s.stats.carrier) = (description, State::Connected, carrier);
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

    /// Makes another connection while the present one is `silent`. If the present one is heard first, the attempt
    /// ends.
    pub(super) async fn dial_beside(
        &mut self,
        shared: &Arc<Shared>,
        mut silent: watch::Receiver<bool>,
    ) -> Dialed {
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

    /// Tries UDP at all addresses of the host, each a quarter of a second after the previous one, and the other ways
    /// later; the first answer counts.
    async fn shake_hands(&self, shared: &Arc<Shared>) -> Result<Connected, ConnectError> {
        let port = self.link.port;
        let (addresses, mut problem) = match self.addresses().await {
            Ok(addresses) => (addresses, self.no_answer()),
            // Only the other end of the tunnel may know the name.
            Err(problem) if self.tunnel.is_some() => (Vec::new(), problem),
            Err(problem) => return Err(problem),
        };
        let mut attempts = JoinSet::new();
        let attempt = || Attempt {
            config: self.config.clone(),
            tls: self.tls.clone(),
            conditioner: self.conditioner.clone(),
            counters: shared.counters.clone(),
        };
        for (i, address) in addresses.iter().copied().enumerate() {
            let wait = HEAD_START * i as u32;
            let endpoint = self.sockets.as_ref().map(|source| source());
            attempts.spawn(attempt().udp(wait, address, endpoint));
            if self.sockets.is_none() {
                attempts.spawn(attempt().tcp(wait + self.wait_of(Carrier::Tcp), address));
            }
        }
        if let Some(tunnel) = &self.tunnel {
            let wait = if addresses.is_empty() { Duration::ZERO } else { self.wait_of(Carrier::Tunnel) };
            attempts.spawn(attempt().tunnel(wait, tunnel.clone(), port));
        }
        while let Some(attempt) = attempts.join_next().await {
            match attempt {
                Ok(Ok(connected)) => {
                    self.mismatch.forget();
                    return Ok(connected);
                }
                Ok(Err(Failure::Quic(e))) => problem = self.explain(&e),
                Ok(Err(Failure::Tls(e))) => problem = self.explain_tls(&e).unwrap_or(problem),
                // An answer from one address says more than silence or a missing route at another.
                Ok(Err(Failure::Socket(e))) if problem == self.no_answer() => {
                    problem = ConnectError::Socket(e.to_string());
                }
                Ok(Err(_)) | Err(_) => {}
            }
        }
        Err(problem)
    }

    /// The first addresses of the host.
    async fn addresses(&self) -> Result<Vec<SocketAddr>, ConnectError> {
        let Link { host, port, .. } = &self.link;
        let resolve = |problem: String| ConnectError::Resolve { host: host.clone(), problem };
        let found = timeout(AUTH_DEADLINE, tokio::net::lookup_host((host.as_str(), *port)));
        let found = found.await.map_err(|_| resolve("no answer from the name service".into()))?;
        let addresses: Vec<_> = found.map_err(|e| resolve(e.to_string()))?.take(MAX_ADDRESSES).collect();
        if addresses.is_empty() { Err(resolve("it has no address".into())) } else { Ok(addresses) }
    }

    /// How long UDP alone is tried before this. What came through last is tried at once.
    fn wait_of(&self, carrier: Carrier) -> Duration {
        match carrier {
            _ if carrier == self.carrier => Duration::ZERO,
            Carrier::Udp => Duration::ZERO,
            Carrier::Tcp => BEFORE_TCP,
            Carrier::Tunnel => BEFORE_TUNNEL,
        }
    }

    fn no_answer(&self) -> ConnectError {
        ConnectError::NoAnswer { host: self.link.host.clone(), port: self.link.port }
    }

    /// The meaning of a connection's end.
    pub(super) fn explain(&self, error: &ConnectionError) -> ConnectError {
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
            // Nothing else ends a connection so: its socket has failed.
            ConnectionError::TransportError(e) if e.code == TransportErrorCode::INTERNAL_ERROR => {
                ConnectError::Lost(format!("the {} stream broke", self.carrier))
            }
            other => ConnectError::Lost(other.to_string()),
        }
    }

    /// What a failed handshake of TLS over a stream means; `None` if it says no more than that there is no answer.
    fn explain_tls(&self, error: &std::io::Error) -> Option<ConnectError> {
        let Link { host, port, fingerprint: expected, .. } = &self.link;
        if let Some(found) = self.mismatch.found() {
            let host = host.clone();
            return Some(ConnectError::Certificate { host, port: *port, expected: *expected, found });
        }
        let tls = error.get_ref()?.downcast_ref::<rustls::Error>()?;
        let no_version = rustls::Error::AlertReceived(rustls::AlertDescription::NoApplicationProtocol);
        (*tls == no_version).then_some(ConnectError::Version)
    }
}

/// A connection whose handshake is done.
struct Connected {
    endpoint: Endpoint,
    connection: Connection,
    carrier: Carrier,
}

enum Failure {
    Socket(std::io::Error),
    Quic(ConnectionError),
    Tls(std::io::Error),
    Silence,
}

/// What every attempt to connect needs.
struct Attempt {
    config: quinn::ClientConfig,
    tls: Arc<rustls::ClientConfig>,
    conditioner: Option<LinkModel>,
    counters: Arc<SharedCounters>,
}

impl Attempt {
    /// Over UDP, after a wait, with the given socket or one of the system.
    async fn udp(
        self,
        wait: Duration,
        address: SocketAddr,
        given: Option<(Arc<dyn AsyncUdpSocket>, EndpointConfig)>,
    ) -> Result<Connected, Failure> {
        tokio::time::sleep(wait).await;
        let runtime = Arc::new(TokioRuntime);
        let endpoint = match given {
            Some((socket, config)) => Endpoint::new_with_abstract_socket(config, None, socket, runtime),
            None => {
                let any: SocketAddr = match address {
                    SocketAddr::V4(_) => ([0, 0, 0, 0], 0).into(),
                    SocketAddr::V6(_) => ([0u16; 8], 0).into(),
                };
                let socket = std::net::UdpSocket::bind(any).map_err(Failure::Socket)?;
                self.endpoint(runtime.wrap_udp_socket(socket).map_err(Failure::Socket)?)
            }
        };
        self.shake_hands(endpoint.map_err(Failure::Socket)?, address, Carrier::Udp).await
    }

    /// Over TCP with TLS, after a wait.
    async fn tcp(self, wait: Duration, address: SocketAddr) -> Result<Connected, Failure> {
        tokio::time::sleep(wait).await;
        let connecting = timeout(AUTH_DEADLINE, TcpStream::connect(address));
        // Without TCP, the answer over UDP counts.
        let stream = connecting.await.map_err(|_| Failure::Silence)?.map_err(|_| Failure::Silence)?;
        let _ = stream.set_nodelay(true);
        self.stream(stream, address, Carrier::Tcp).await
    }

    /// The same through a tunnel.
    async fn tunnel(self, wait: Duration, tunnel: Tunnel, port: u16) -> Result<Connected, Failure> {
        tokio::time::sleep(wait).await;
        let mut command = tokio::process::Command::from(tunnel());
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        // Once its ends are closed, the command ends, and the runtime collects it.
        let mut child = command.spawn().map_err(Failure::Socket)?;
        let (Some(output), Some(input)) = (child.stdout.take(), child.stdin.take()) else {
            return Err(Failure::Silence);
        };
        let here = SocketAddr::from((Ipv4Addr::LOCALHOST, port));
        self.stream(tokio::io::join(output, input), here, Carrier::Tunnel).await
    }

    async fn stream(
        self,
        stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
        address: SocketAddr,
        carrier: Carrier,
    ) -> Result<Connected, Failure> {
        let name = ServerName::try_from(SERVER_NAME).map_err(|_| Failure::Silence)?;
        let encrypting = TlsConnector::from(self.tls.clone()).connect(name, stream);
        let stream = timeout(AUTH_DEADLINE, encrypting).await.map_err(|_| Failure::Silence)?;
        let address = stream_address(address);
        let socket = CarrierSocket::of_stream(stream.map_err(Failure::Tls)?, address);
        let endpoint = self.endpoint(socket).map_err(Failure::Socket)?;
        self.shake_hands(endpoint, address, carrier).await
    }

    fn endpoint(&self, plain: Arc<dyn AsyncUdpSocket>) -> std::io::Result<Endpoint> {
        let socket: Arc<dyn AsyncUdpSocket> = match &self.conditioner {
            Some(model) => ConditionedSocket::new(plain, model, self.counters.clone()),
            None => plain,
        };
        let runtime = Arc::new(TokioRuntime);
        Endpoint::new_with_abstract_socket(EndpointConfig::default(), None, socket, runtime)
    }

    async fn shake_hands(
        self,
        endpoint: Endpoint,
        address: SocketAddr,
        carrier: Carrier,
    ) -> Result<Connected, Failure> {
        let connecting = endpoint
            .connect_with(self.config, address, SERVER_NAME)
            .map_err(|e| Failure::Socket(std::io::Error::other(e)))?;
        let connected = timeout(AUTH_DEADLINE, connecting).await.map_err(|_| Failure::Silence)?;
        Ok(Connected { endpoint, connection: connected.map_err(Failure::Quic)?, carrier })
    }
}

/// The TLS alert `no_application_protocol`, which QUIC carries in a crypto error (RFC 9001, section 4.8).
const NO_COMMON_ALPN: u8 = 120;
/// Pause between attempts beside a silent connection.
const BETWEEN_OTHERS: Duration = Duration::from_millis(250);
/// Longest close reason that is shown, in characters.
const MAX_REASON_CHARS: usize = 500;
/// Delay between attempts at the addresses of a host.
const HEAD_START: Duration = Duration::from_millis(250);
/// Most addresses of a host that are tried.
const MAX_ADDRESSES: usize = 4;
/// An answer over UDP takes two round trips, and a few hundred milliseconds more if a packet is lost.
const BEFORE_TCP: Duration = Duration::from_millis(1500);
/// TCP takes three round trips more.
const BEFORE_TUNNEL: Duration = Duration::from_millis(3000);
