//! One viewer's connection.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use isinglass_core::session::ServerSession;
use isinglass_core::session::admission::ViewerId;
use isinglass_core::session::link::MESSAGE_WAIT_MICROS;
use isinglass_core::session::server::{Heard, violation};
use isinglass_core::wire::Refusal;
use isinglass_core::wire::control::one_line;
use quinn::{Connection, RecvStream, SendStream};
use tokio::sync::{mpsc, watch};
use tokio::time::Instant;
use tracing::Instrument;

use super::frames::{FrameSender, Pace};
use super::{Admitted, Greeting, refuse};
use crate::carrier::{Carrier, is_stream_address, peer_address};
use crate::clock::Clock;
use crate::congestion::LinkGauge;
use crate::control_stream::{self, ReceiveError};
use crate::journal::Journal;
use crate::talk::{Talk, Talking, until_due};
use crate::transport::{self, SILENCE_LIMIT};

/// One viewer's connection, in parts that can go to different tasks. The connection closes when `frames` and
/// `control` (and their clones) are dropped.
#[derive(Debug)]
pub struct Session {
    /// Number of the session at this server.
    pub id: u64,
    /// The viewer, the same for all its connections.
    pub viewer: ViewerId,
    /// The viewer's name for itself.
    pub name: String,
    /// The viewer's address.
    pub remote: SocketAddr,
    /// The greeting in its welcome.
    pub greeting: Arc<Greeting>,
    /// Sends frames.
    pub frames: FrameSender,
    /// The conversation.
    pub control: Control,
    /// The lives of the frames.
    pub journal: Journal,
    heard: watch::Receiver<()>,
}

impl Session {
    /// The conversation with the viewer: its requests and what it is told.
    pub fn talk(&self) -> Talking<'_, ServerSession> {
        self.control.talk()
    }

    /// Returns when the viewer has said something; false when the connection is over. Cancellation loses nothing.
    pub async fn hear(&mut self) -> bool {
        self.heard.changed().await.is_ok()
    }
}

/// The connection is over.
#[derive(Clone, Copy, Debug, thiserror::Error, PartialEq, Eq)]
#[error("the viewer's connection is over")]
pub struct SessionClosed;

/// A handle on the conversation with the viewer.
#[derive(Clone, Debug)]
pub struct Control {
    link: Arc<ViewerLink>,
    close: Arc<CloseOnDrop>,
}

impl Control {
    /// The conversation.
    pub fn talk(&self) -> Talking<'_, ServerSession> {
        self.link.talk.lock()
    }

    /// Ends this session; the viewer may reconnect.
    pub fn close(&self, reason: &str) {
        self.close.0.close(transport::CLOSE_SESSION, one_line(reason).as_bytes());
    }
}

/// The connection and its session; it closes when the last user is gone.
#[derive(Debug)]
pub(super) struct ViewerLink {
    pub(super) connection: Connection,
    pub(super) gauge: Arc<LinkGauge>,
    pub(super) talk: Talk<ServerSession>,
    pace: Mutex<Pace>,
    /// What lossy links have room for.
    room: Mutex<Pace>,
    pub(super) journal: Journal,
    /// Notified whenever a chunk may have been superseded.
    pub(super) progress: watch::Sender<()>,
    /// Number of frames being written; screenshots wait for them.
    pub(super) num_writing: watch::Sender<usize>,
}

impl ViewerLink {
    pub(super) fn room(&self) -> MutexGuard<'_, Pace> {
        self.room.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn pace(&self) -> MutexGuard<'_, Pace> {
        self.pace.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Owned by the application's handles, not by the tasks here.
#[derive(Debug)]
pub(super) struct CloseOnDrop(Connection);

impl Drop for CloseOnDrop {
    fn drop(&mut self) {
        self.0.close(transport::CLOSE_SESSION, b"the server has ended the session");
    }
}

/// Serves one connection until it is over.
pub(super) async fn run(admitted: Admitted, sessions: mpsc::Sender<Session>) {
    let Admitted { connection, gauge, mut send, recv, place, name, greeting } = admitted;
    let (id, viewer) = (place.session, place.viewer);
    let span = tracing::info_span!("session", id, viewer = viewer.0);
    let clock = place.shared.options.clock.clone();
    let journal = Journal::new(clock.clone());
    let (version, look) = (greeting.look_version, greeting.look.clone());
    let link = Arc::new(ViewerLink {
        connection: connection.clone(),
        gauge,
        talk: Talk::new(ServerSession::new(clock.now_micros(), viewer, version, look)),
        pace: Mutex::default(),
        room: Mutex::default(),
        journal: journal.clone(),
        progress: watch::Sender::new(()),
        num_writing: watch::Sender::new(0),
    });
    let close = Arc::new(CloseOnDrop(connection.clone()));
    let max_viewers = place.shared.options.max_viewers;
    let (heard_in, heard) = watch::channel(());
    let remote = peer_address(connection.remote_address());
    let carrier = if is_stream_address(connection.remote_address()) { Carrier::Tcp } else { Carrier::Udp };
    tracing::info!(parent: &span, %remote, %carrier, name, "viewer connected");
    let session = Session {
        id,
        viewer,
        name,
        remote,
        greeting,
        frames: FrameSender::new(link.clone(), close.clone()),
        control: Control { link: link.clone(), close },
        journal,
        heard,
    };
    // An unsent session must live on: dropping it would close the connection.
    if let Err(_unsent) = sessions.try_send(session) {
        let why = refuse(&place.shared, &connection, &mut send, Refusal::Full(max_viewers)).await;
        return place.shared.tell(remote, &why);
    }
    let serving = async {
        let violated = tokio::select! {
            () = read_poses(&link, &clock, &heard_in) => None,
            violated = read_messages(&link, &clock, recv, &heard_in) => violated,
            () = write_messages(&link, &clock, &mut send) => None,
            () = watch_silence(&connection) => None,
        };
        if let Some(refusal) = violated {
            let why = refuse(&place.shared, &connection, &mut send, refusal).await;
            tracing::warn!("{why}");
        }
        // When any of these ends, the rest ends with it. A closed connection keeps its own reason.
        connection.close(transport::CLOSE_PROTOCOL, b"the control stream ended");
        let reason = connection.closed().await;
        place.shared.known_paths.note(remote.ip(), Instant::now(), &link.gauge);
        tracing::info!("viewer gone: {reason}");
    };
    serving.instrument(span).await;
}

/// Closes a connection from which no packet has come for long: its viewer gives its place up, and may come back. A
/// viewer keeps its connection alive twice a second.
async fn watch_silence(connection: &Connection) {
    let mut tick = tokio::time::interval(SILENCE_CHECK);
    let mut heard = (tick.tick().await, connection.stats().udp_rx.datagrams);
    loop {
        let now = tick.tick().await;
        let datagrams = connection.stats().udp_rx.datagrams;
        if datagrams != heard.1 {
            heard = (now, datagrams);
        } else if now - heard.0 >= SILENCE_LIMIT {
            return connection.close(transport::CLOSE_SILENT, b"no packet has come for long");
        }
    }
}

async fn read_poses(link: &ViewerLink, clock: &Clock, heard: &watch::Sender<()>) {
    let mut heard_at = Instant::now();
    while let Ok(bytes) = link.connection.read_datagram().await {
        if heard_at.elapsed() > OUTAGE {
            link.gauge.handle_heard_again();
        }
        heard_at = Instant::now();
        let handled = link.talk.lock_quietly().handle_datagram(clock.now_micros(), &bytes);
        match handled {
            Ok(true) => heard.send_replace(()),
            Ok(false) => {}
            Err(e) => tracing::debug!("ignored: {e}"),
        }
        link.progress.send_replace(());
    }
}

/// Ends with what the client did wrong, or with nothing when the connection is over.
async fn read_messages(
    link: &ViewerLink,
    clock: &Clock,
    mut stream: RecvStream,
    heard: &watch::Sender<()>,
) -> Option<Refusal> {
    loop {
        let body = match control_stream::receive_body(&mut stream).await {
            Ok(body) => body,
            Err(ReceiveError::Control(e)) => return Some(violation(&e)),
            Err(ReceiveError::Ended(_)) => {
                link.connection.close(transport::CLOSE_BYE, b"");
                return None;
            }
        };
        while !link.talk.lock_quietly().link.takes_message(clock.now_micros()) {
            tokio::time::sleep(Duration::from_micros(MESSAGE_WAIT_MICROS)).await;
        }
        let handled = link.talk.lock_quietly().handle_message(&body);
        match handled {
            Ok(Heard::Taken) => heard.send_replace(()),
            Ok(Heard::Stats(stats)) => tracing::debug!(?stats, "viewer"),
            Ok(Heard::Bye) => {
                link.connection.close(transport::CLOSE_BYE, b"");
                return None;
            }
            Err(refusal) => return Some(refusal),
        }
    }
}

async fn write_messages(link: &ViewerLink, clock: &Clock, stream: &mut SendStream) {
    let mut changed = link.talk.subscribe();
    loop {
        let (message, due) = {
            let mut talk = link.talk.lock_quietly();
            (talk.poll_message(clock.now_micros()), talk.due())
        };
        let Some(message) = message else {
            until_due(&mut changed, clock, due).await;
            continue;
        };
        match control_stream::send(stream, &message).await {
            Ok(()) => {}
            Err(control_stream::SendError::Control(e)) => tracing::error!("not sent: {e}"),
            Err(control_stream::SendError::Ended(_)) => return,
        }
    }
}

/// Time between two looks at whether packets come.
const SILENCE_CHECK: Duration = Duration::from_secs(1);
/// A pause between poses after which the link may have been dead. A viewer repeats its pose more often.
const OUTAGE: Duration = Duration::from_millis(300);
