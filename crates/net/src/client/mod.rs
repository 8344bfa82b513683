//! The client: it keeps a connection up and the newest frame ready, and never blocks its caller.
//!
//! One thread drives the network, another decodes. They share the session behind one lock that is only held for
//! moments. A lost connection changes the state and nothing else: the last frame stays, and the client reconnects by
//! itself.

mod chunks;
mod connection;
mod decode;
mod dial;
mod error;
#[cfg(test)]
pub(crate) mod model;
mod parities;
mod status;
mod whole;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, mpsc};
use std::time::Duration;

use arc_swap::ArcSwapOption;
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::ids::{FrameId, PoseId};
use isinglass_core::layer::LayeredFrame;
use isinglass_core::look::{Look, LookError};
use isinglass_core::session::ClientSession;
use isinglass_core::session::chunks::ChunksClient;
use isinglass_core::session::ledger::Life;
use isinglass_core::wire::{ServerStats, Welcome};
use tokio::sync::{Semaphore, watch};

use crate::carrier::Carrier;
use crate::clock::Clock;
use crate::conditioner::{LinkCounters, LinkModel, LinkModelError, SharedCounters};
use crate::link::Link;
use crate::talk::{Talk, Talking};
use crate::work::AfterWork;

pub use error::ConnectError;
use status::{Status, StatusBoard};

/// Options of a client.
#[derive(Clone)]
pub struct ClientOptions {
    /// Name of this client, for the server's log and its other viewers: that of the user.
    pub name: String,
    /// Simulates a link with these properties.
    pub conditioner: Option<LinkModel>,
    /// A way to the server where neither UDP nor TCP comes through.
    pub tunnel: Option<Tunnel>,
    /// Clock of all stamps.
    pub clock: Clock,
    /// Hook after decoding.
    pub after_work: AfterWork,
    /// Called on a thread of the client for each new frame or state. Must return at once.
    pub wake: Arc<dyn Fn() + Send + Sync>,
}

/// Makes a command whose standard input and output are a TCP connection to the server's port on its own machine.
pub type Tunnel = Arc<dyn Fn() -> std::process::Command + Send + Sync>;

impl Default for ClientOptions {
    fn default() -> Self {
        let mut users = ["USER", "USERNAME"].into_iter().filter_map(|key| std::env::var(key).ok());
        let name = users.find(|name| !name.is_empty());
        let name = name.unwrap_or_else(|| concat!("isinglass ", env!("CARGO_PKG_VERSION")).into());
        Self {
            name,
            conditioner: None,
            tunnel: None,
            clock: Clock::start(),
            after_work: AfterWork::default(),
            wake: Arc::new(|| {}),
        }
    }
}

impl std::fmt::Debug for ClientOptions {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ClientOptions")
            .field("name", &self.name)
            .field("conditioner", &self.conditioner)
            .field("has_tunnel", &self.tunnel.is_some())
            .finish_non_exhaustive()
    }
}

/// Why no client could start.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// The link model is invalid.
    #[error("link conditioner: {0}")]
    Conditioner(#[from] LinkModelError),
    /// The system provides no random numbers, or TLS cannot be set up.
    #[error(transparent)]
    Identity(#[from] crate::identity::IdentityError),
    /// The system provides no thread or timer.
    #[error("cannot start the network thread: {0}")]
    Thread(#[from] std::io::Error),
}

/// The state of the connection.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum State {
    /// The first connection is being made.
    Connecting {
        /// Number of the attempt, from 1.
        attempt: u32,
        /// Why the previous attempt failed.
        problem: Option<ConnectError>,
    },
    /// Frames arrive.
    Connected,
    /// The connection was lost; the last frame stays.
    Reconnecting {
        /// Time of the loss on the client's clock, µs.
        since_micros: u64,
        /// Number of the attempt, from 1.
        attempt: u32,
        /// Why it was lost, or why the previous attempt failed.
        problem: ConnectError,
    },
    /// A retry is useless.
    Refused(ConnectError),
}

/// A decoded frame.
#[derive(Clone, Debug)]
pub struct ReceivedFrame {
    /// The frame.
    pub frame: LayeredFrame,
    /// Whether all lists and depths equal the server's.
    pub is_exact: bool,
    /// Its life so far.
    pub times: Life,
}

impl ReceivedFrame {
    /// Whether it shows the volume that the session describes, and not the previous one.
    pub fn is_of(&self, session: &ClientSession) -> bool {
        session.is_of_volume(self.times.connection, self.frame.header.look)
    }
}

/// Statistics for the overlay, on the client's clock.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LinkStats {
    /// What carries the packets.
    pub carrier: Carrier,
    /// Round-trip time, smoothed, µs.
    pub rtt_micros: u64,
    /// Rate of received bytes over about the last second, bytes per second.
    pub bytes_per_second: f64,
    /// Frames decoded in the last second.
    pub frames_per_second: u32,
    /// Number of unusable frames and datagrams.
    pub broken_chunks: u64,
    /// Time since the last packet, µs.
    pub silence_micros: u64,
    /// Number of packets that this side sent and lost.
    pub lost_packets: u64,
    /// The newest frame's cost at the server.
    pub server: ServerStats,
}

impl LinkStats {
    /// Whether the server of a connection has not answered for more than two keep-alives.
    pub fn is_silent(&self) -> bool {
        self.silence_micros > SILENT_MICROS + self.rtt_micros
    }
}

/// Most slices that are unpacked at a time.
const MAX_UNPACKING: usize = 2;
/// Silence that a person should know of, beyond a round trip, µs.
const SILENT_MICROS: u64 = 1_200_000;

/// A handle on the connection. Dropping it says goodbye within a quarter of a second.
pub struct Client {
    shared: Arc<Shared>,
    done: mpsc::Receiver<()>,
}

impl Client {
    /// Starts to connect, and returns at once.
    ///
    /// # Errors
    /// If this machine cannot do it at all. Problems of the connection appear in [`Client::state`].
    pub fn connect(link: &Link, options: ClientOptions) -> Result<Self, ClientError> {
        if let Some(model) = &options.conditioner {
            model.validate()?;
        }
        let dialer = dial::Dialer::new(link.clone(), &options)?;
        let shared = Arc::new(Shared::new(options));
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let (done_in, done) = mpsc::sync_channel(1);
        let for_network = shared.clone();
        std::thread::Builder::new().name("isinglass-net".into()).spawn(move || {
            runtime.block_on(connection::run(for_network, dialer));
            // Resolving a name may take minutes, so nobody waits for it.
            runtime.shutdown_background();
            let _ = done_in.send(());
        })?;
        let for_decoding = shared.clone();
        std::thread::Builder::new()
            .name("isinglass-decode".into())
            .spawn(move || decode::run(&for_decoding))
            .inspect_err(|_| shared.stop())?;
        Ok(Self { shared, done })
    }

    /// The conversation with the server: everything that this viewer can say, and what it has heard.
    pub fn talk(&self) -> Talking<'_, ClientSession> {
        self.shared.talk.lock()
    }

    /// Requests frames from this pose. The newest wins; an unusable pose is ignored. Returns the newest pose's
    /// number.
    pub fn set_pose(&self, pose: Pose, intrinsics: Intrinsics) -> PoseId {
        let mut talk = self.talk();
        if let Err(e) = talk.pose.set(self.shared.clock.now_micros(), pose, intrinsics) {
            tracing::warn!("pose ignored: {e}");
        }
        talk.pose.newest().map_or(PoseId(0), |newest| newest.id)
    }

    /// Requests another look.
    ///
    /// # Errors
    /// If the look is invalid.
    pub fn set_look(&self, look: Look) -> Result<(), LookError> {
        self.talk().look.set(self.shared.clock.now_micros(), look)
    }

    /// The newest displayable frame, if any.
    pub fn latest_frame(&self) -> Option<Arc<ReceivedFrame>> {
        self.shared.frame.load_full()
    }

    /// A frame of the present connection has appeared on the screen.
    pub fn note_shown(&self, frame: FrameId) {
        self.shared.chunks().handle_shown(self.shared.clock.now_micros(), frame);
    }

    /// The recent lives of frames, oldest first.
    pub fn ledger(&self) -> Vec<Life> {
        self.shared.chunks().ledger().iter().copied().collect()
    }

    /// The state of the connection.
    pub fn state(&self) -> State {
        self.shared.status.read().state.clone()
    }

    /// The last problem with a chunk or message.
    pub fn last_problem(&self) -> Option<String> {
        self.shared.status.read().last_problem.clone()
    }

    /// Statistics for the overlay.
    pub fn stats(&self) -> LinkStats {
        let server = self.talk().link.server_stats();
        LinkStats { server, ..self.shared.status.read().stats }
    }

    /// Packet counters of the conditioner; zero without one.
    pub fn link_counters(&self) -> LinkCounters {
        self.shared.counters.read()
    }

    /// The clock of all stamps.
    pub fn clock(&self) -> &Clock {
        &self.shared.clock
    }

    /// Blocks until the server admits this client, for callers without a display loop.
    ///
    /// # Errors
    /// Why the first attempt failed, or that there was no result in time.
    pub fn wait_connected(&self, timeout: Duration) -> Result<Arc<Welcome>, ConnectError> {
        self.shared.status.wait_connected(timeout)
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        self.shared.stop();
        // The goodbye goes out at once; a thread that is stuck in the system is left behind.
        let _ = self.done.recv_timeout(Duration::from_millis(250));
    }
}

impl std::fmt::Debug for Client {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Client").field("state", &self.state()).finish_non_exhaustive()
    }
}

/// What the caller, the network thread and the decoding thread share. No lock is held across a wait, except for its
/// own condition, or while another is taken.
struct Shared {
    clock: Clock,
    after_work: AfterWork,
    wake: Arc<dyn Fn() + Send + Sync>,
    talk: Talk<ClientSession>,
    chunks: Mutex<ChunksClient>,
    decode_wanted: Condvar,
    /// One for each slice that may be unpacked at a time.
    unpacking: Semaphore,
    is_stopping: AtomicBool,
    frame: ArcSwapOption<ReceivedFrame>,
    status: StatusBoard,
    stop: watch::Sender<bool>,
    counters: Arc<SharedCounters>,
}

impl Shared {
    fn new(options: ClientOptions) -> Self {
        Self {
            clock: options.clock,
            after_work: options.after_work,
            wake: options.wake,
            talk: Talk::new(ClientSession::default()),
            chunks: Mutex::default(),
            decode_wanted: Condvar::new(),
            unpacking: Semaphore::new(MAX_UNPACKING),
            is_stopping: AtomicBool::new(false),
            frame: ArcSwapOption::empty(),
            status: StatusBoard::new(),
            stop: watch::Sender::new(false),
            counters: Arc::default(),
        }
    }

    fn chunks(&self) -> MutexGuard<'_, ChunksClient> {
        lock(&self.chunks)
    }

    /// Changes the status and notifies everyone.
    fn update(&self, change: impl FnOnce(&mut Status)) {
        self.status.update(change);
        (self.wake)();
    }

    /// Something from the server is unusable.
    fn note_broken_chunk(&self, problem: String) {
        tracing::warn!("{problem}");
        self.status.update(|status| {
            status.stats.broken_chunks += 1;
            status.last_problem = Some(problem);
        });
    }

    fn stop(&self) {
        self.stop.send_replace(true);
        self.is_stopping.store(true, Ordering::Release);
        // This lock makes sure that the decoding thread is before its check or in its wait.
        drop(self.chunks());
        self.decode_wanted.notify_all();
    }

    fn is_stopping(&self) -> bool {
        self.is_stopping.load(Ordering::Acquire)
    }
}

/// Every change is one step, so a panic on another thread leaves the state in order.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
