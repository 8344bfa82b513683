//! The client: keeps a connection up and the newest frame at hand, and never makes its caller wait.
//!
//! One thread drives the network, another decodes; what the caller reads is swapped in whole, and what it wishes is swapped out
//! by a third, so that no call of a display loop takes a lock that those threads hold. A lost connection changes the state and nothing else: the last frame stays, and the client comes back by itself.

mod chunks;
mod connection;
mod decode;
mod error;
mod shot;
mod status;
mod wishes;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, mpsc};
use std::time::Duration;

use arc_swap::ArcSwapOption;
use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::ids::{FrameId, LookVersion, PoseId, ProbeId, ShotId};
use isinglass_core::layer::LayeredFrame;
use isinglass_core::look::{Look, LookError};
use isinglass_core::session::client;
use isinglass_core::session::ledger::Life;
use isinglass_core::wire::{
    ClientStats, LoadStatus, Part, Parts, PoseRequest, ProbeRequest, Probed, ServerStats, ShotRequest,
    Welcome,
};
use tokio::sync::watch;

use crate::clock::Clock;
use crate::conditioner::{LinkCounters, LinkModel, LinkModelError, SharedCounters};

use crate::link::Link;
use crate::work::AfterWork;

pub use error::ConnectError;
pub use shot::ReceivedShot;
use status::{Status, StatusBoard};
use wishes::Wishes;

/// How to connect.
#[derive(Clone)]
pub struct ClientOptions {
    /// Name of this client, for the server's log.
    pub name: String,
    /// A link with these properties is put under the connection.
    pub conditioner: Option<LinkModel>,
    /// What all stamps are read from.
    pub clock: Clock,
    /// What follows the decoding of chunks.
    pub after_work: AfterWork,
    /// Called, on a thread of the client, when there is a new frame or state. Must return at once.
    pub wake: Arc<dyn Fn() + Send + Sync>,
}

impl Default for ClientOptions {
    fn default() -> Self {
        let name = concat!("isinglass ", env!("CARGO_PKG_VERSION")).into();
        Self {
            name,
            conditioner: None,
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
            .finish_non_exhaustive()
    }
}

/// Why no client could be started.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// The link model cannot be used.
    #[error("link conditioner: {0}")]
    Conditioner(#[from] LinkModelError),
    /// The system gives no random numbers, or TLS cannot be set up.
    #[error(transparent)]
    Identity(#[from] crate::identity::IdentityError),
    /// The system gives no thread or timer.
    #[error("cannot start the network thread: {0}")]
    Thread(#[from] std::io::Error),
}

/// Where the connection stands.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum State {
    /// The first connection is being made.
    Connecting {
        /// Counts from 1.
        attempt: u32,
        /// Why the attempt before failed.
        problem: Option<ConnectError>,
    },
    /// Frames flow.
    Connected,
    /// The connection was lost; the last frame stays.
    Reconnecting {
        /// When it was lost, on the client's clock.
        since_micros: u64,
        /// Counts from 1.
        attempt: u32,
        /// Why it was lost, or why the attempt before failed.
        problem: ConnectError,
    },
    /// There is no use in trying again.
    Refused(ConnectError),
}

/// A decoded frame.
#[derive(Clone, Debug)]
pub struct ReceivedFrame {
    /// The frame.
    pub frame: LayeredFrame,
    /// Whether its refinements are there too. The same frame comes once more when they are.
    pub is_complete: bool,
    /// Whether all lists and depths are the server's own.
    pub is_exact: bool,
    /// Stamps of its life so far.
    pub times: Life,
}

/// What the overlay shows. Times are on the client's clock.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LinkStats {
    /// Round-trip time, smoothed, µs.
    pub rtt_micros: u64,
    /// Bytes received in the last second or so.
    pub bytes_per_second: f64,
    /// Frames decoded in the last second.
    pub frames_per_second: u32,
    /// Chunks that could not be used.
    pub broken_chunks: u64,
    /// Since a packet came, µs.
    pub silence_micros: u64,
    /// Packets that this side sent and lost.
    pub lost_packets: u64,
    /// What the newest frame cost the server.
    pub server: ServerStats,
}

/// A handle on the connection. Dropping it says goodbye, which takes up to a quarter of a second.
pub struct Client {
    shared: Arc<Shared>,
    done: mpsc::Receiver<()>,
}

impl Client {
    /// Starts to connect, and returns at once.
    ///
    /// # Errors
    /// If this machine cannot do it at all. What goes wrong with the connection is told by [`Client::state`].
    pub fn connect(link: &Link, options: ClientOptions) -> Result<Self, ClientError> {
        if let Some(model) = &options.conditioner {
            model.validate()?;
        }
        let dialer = connection::Dialer::new(link.clone(), &options)?;
        let (shown, shown_in) = mpsc::sync_channel(MAX_SHOWN);
        let shared = Arc::new(Shared {
            clock: options.clock,
            after_work: options.after_work,
            wake: options.wake,
            session: Mutex::default(),
            decode_wanted: Condvar::new(),
            is_stopping: AtomicBool::new(false),
            frame: ArcSwapOption::empty(),
            status: StatusBoard::new(),
            wishes: Wishes::default(),
            shown,
            shown_in: Mutex::new(shown_in),
            pose: watch::Sender::new(None),
            look: watch::Sender::new(None),
            part: watch::Sender::new(None),
            report: watch::Sender::new(None),
            probe: watch::Sender::new(None),
            shot: watch::Sender::new(None),
            stop: watch::Sender::new(false),
            counters: Arc::default(),
        });
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let (done_in, done) = mpsc::sync_channel(1);
        let for_network = shared.clone();
        std::thread::Builder::new().name("isinglass-net".into()).spawn(move || {
            runtime.block_on(connection::run(for_network, dialer));
            // A name that is being resolved may take minutes.
            runtime.shutdown_background();
            let _ = done_in.send(());
        })?;
        let for_decoding = shared.clone();
        std::thread::Builder::new()
            .name("isinglass-decode".into())
            .spawn(move || decode::run(&for_decoding))
            .inspect_err(|_| shared.stop())?;
        let for_wishes = shared.clone();
        let messenger = std::thread::Builder::new()
            .name("isinglass-wishes".into())
            .spawn(move || wishes::carry(&for_wishes))
            .inspect_err(|_| shared.stop())?;
        // Before anybody can wish for anything.
        let _ = shared.wishes.messenger.set(messenger.thread().clone());
        Ok(Self { shared, done })
    }

    /// Asks for frames from this pose. The newest wins; an unusable pose is ignored. Returns the pose's number.
    pub fn set_pose(&self, pose: Pose, intrinsics: Intrinsics) -> PoseId {
        self.shared.wishes.pose(self.shared.clock.now_micros(), pose, intrinsics)
    }

    /// What the datagrams from now on say of [`PoseRequest::shown_turn_deg`], degrees: the server makes frames to be seen so,
    /// with the bytes there are. It takes what the first datagram of a pose says.
    pub fn note_turn(&self, degrees: Option<f32>) {
        self.shared.wishes.note_turn(degrees);
    }

    /// Asks for another look. The newest wins; it is asked for again after a lost connection.
    ///
    /// # Errors
    /// If the look cannot be used.
    pub fn set_look(&self, look: Look) -> Result<(), LookError> {
        look.validate()?;
        self.shared.wishes.look(look);
        Ok(())
    }

    /// Asks for another part of the server's file, for all its viewers; none: the one that is being read is not wanted any
    /// more. The newest wish wins. One that cannot be sent for lack of a connection is forgotten.
    pub fn open_part(&self, part: Option<Part>) {
        self.shared.wishes.part(part);
    }

    /// Tells the server how this client fares, once a second at most.
    pub fn report(&self, stats: ClientStats) {
        self.shared.wishes.report(stats);
    }

    /// Whether frames of that look show a draft of it, with a final one to follow.
    pub fn is_draft(&self) -> bool {
        self.shared.status.read().is_draft
    }

    /// Asks for the value at a point of world space; the newest question wins, and one is answered.
    pub fn probe(&self, point: [f32; 3]) -> ProbeId {
        self.shared.wishes.probe(point)
    }

    /// The newest answer.
    pub fn probed(&self) -> Option<Probed> {
        self.shared.status.read().probed
    }

    /// Asks for a picture to keep, under the look that was asked for last. It takes the place of one that has not come.
    pub fn shoot(&self, pose: Pose, intrinsics: Intrinsics, background: [u8; 3]) -> ShotId {
        self.shared.wishes.shot(pose, intrinsics, background)
    }

    /// The picture that was asked for last is no longer wanted.
    pub fn cancel_shot(&self) {
        self.shared.wishes.cancel_shot();
    }

    /// What has become of the picture that was asked for last; taken when it is asked for.
    pub fn take_shot(&self) -> Option<Arc<ReceivedShot>> {
        self.shared.status.take_shot()
    }

    /// The newest frame that can be shown, if there has been one.
    pub fn latest_frame(&self) -> Option<Arc<ReceivedFrame>> {
        self.shared.frame.load_full()
    }

    /// A frame of the present connection was on the screen: closes its ledger.
    pub fn note_shown(&self, frame: FrameId) {
        // Without a connection nobody fetches these, and no ledger is open.
        let _ = self.shared.shown.try_send((frame, self.shared.clock.now_micros()));
    }

    /// The lives of the last frames, oldest first.
    pub fn ledger(&self) -> Vec<Life> {
        self.shared.note_shown();
        self.shared.session().ledger().iter().copied().collect()
    }

    /// Number of the newest connection, from 1; 0 before the first.
    pub fn connection(&self) -> u32 {
        self.shared.status.read().connection
    }

    /// Where the connection stands.
    pub fn state(&self) -> State {
        self.shared.status.read().state.clone()
    }

    /// What the server said when it let this client in, last time; of the volume that is shown now.
    pub fn description(&self) -> Option<Arc<Welcome>> {
        self.shared.status.read().welcome.clone()
    }

    /// The look that the server has said is in force, and its number.
    pub fn look(&self) -> Option<(LookVersion, Arc<Look>)> {
        self.shared.status.read().look.clone()
    }

    /// Whether a frame is of the volume that [`Client::description`] describes, and not of the one before.
    pub fn is_of_volume(&self, frame: &ReceivedFrame) -> bool {
        let status = self.shared.status.read();
        let since = status.welcome.as_ref().map_or(LookVersion(0), |w| w.look_version);
        frame.times.connection == status.connection && frame.frame.header.look >= since
    }

    /// What the server's file holds beside what is shown, once it said so.
    pub fn parts(&self) -> Option<Arc<Parts>> {
        self.shared.status.read().parts.clone()
    }

    /// How the reading of another part stands, as last heard.
    pub fn load(&self) -> Option<LoadStatus> {
        self.shared.status.read().load.clone()
    }

    /// The last line that the server wanted shown; taken when it is asked for.
    pub fn take_notice(&self) -> Option<String> {
        self.shared.status.take_notice()
    }

    /// What went wrong last with a chunk or message.
    pub fn last_problem(&self) -> Option<String> {
        self.shared.status.read().last_problem.clone()
    }

    /// What the overlay shows.
    pub fn stats(&self) -> LinkStats {
        self.shared.status.read().stats
    }

    /// What has become of the packets, if there is a conditioner.
    pub fn link_counters(&self) -> LinkCounters {
        self.shared.counters.read()
    }

    /// The clock of all stamps.
    pub fn clock(&self) -> &Clock {
        &self.shared.clock
    }

    /// Waits until the server has let this client in, for callers without a display loop.
    ///
    /// # Errors
    /// Why the first attempt failed, or that nothing was decided in time.
    pub fn wait_connected(&self, timeout: Duration) -> Result<Arc<Welcome>, ConnectError> {
        self.shared.status.wait_connected(timeout)
    }
}

impl Drop for Client {
    fn drop(&mut self) {
        self.shared.stop();
        // The goodbye is sent at once; a thread that is stuck in the system is left behind.
        let _ = self.done.recv_timeout(Duration::from_millis(250));
    }
}

impl std::fmt::Debug for Client {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Client").field("state", &self.state()).finish_non_exhaustive()
    }
}

/// What the caller, the network thread and the decoding thread share. No lock is held while waiting for anything
/// but the lock's own condition; `session` is for the two threads alone.
struct Shared {
    clock: Clock,
    after_work: AfterWork,
    wake: Arc<dyn Fn() + Send + Sync>,
    session: Mutex<client::Session>,
    decode_wanted: Condvar,
    is_stopping: AtomicBool,
    frame: ArcSwapOption<ReceivedFrame>,
    status: StatusBoard,
    wishes: Wishes,
    /// Frames that were on the screen, and when, on their way to the ledger.
    shown: mpsc::SyncSender<(FrameId, u64)>,
    shown_in: Mutex<mpsc::Receiver<(FrameId, u64)>>,
    pose: watch::Sender<Option<PoseRequest>>,
    look: watch::Sender<Option<Look>>,
    /// The newest wish for another part; its inside is none where it is one for no other.
    part: watch::Sender<Option<Option<Part>>>,
    report: watch::Sender<Option<ClientStats>>,
    probe: watch::Sender<Option<ProbeRequest>>,
    /// The picture that has not been answered.
    shot: watch::Sender<Option<ShotRequest>>,
    stop: watch::Sender<bool>,
    counters: Arc<SharedCounters>,
}

impl Shared {
    fn session(&self) -> MutexGuard<'_, client::Session> {
        lock(&self.session)
    }

    /// Changes the status and tells everyone.
    fn update(&self, change: impl FnOnce(&mut Status)) {
        self.status.update(change);
        (self.wake)();
    }

    /// Enters what was shown into the ledger.
    fn note_shown(&self) {
        let shown = lock(&self.shown_in);
        let mut session = self.session();
        for (frame, at_micros) in shown.try_iter() {
            session.handle_shown(at_micros, frame);
        }
    }

    /// Something of the server's could not be used.
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
        self.wishes.knock();
        // Taken and given back, so that the decoding thread is either before its check or in its wait.
        drop(self.session());
        self.decode_wanted.notify_all();
    }

    fn is_stopping(&self) -> bool {
        self.is_stopping.load(Ordering::Acquire)
    }
}

/// A panic on another thread leaves state that is still in order: every change is one step.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Frames shown that wait to be entered into the ledger: those of several seconds.
const MAX_SHOWN: usize = 256;
