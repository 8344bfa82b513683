//! One viewer's connection.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use isinglass_core::ids::{LookVersion, ShotId};
use isinglass_core::look::Look;
use isinglass_core::session::admission::ViewerId;
use isinglass_core::session::server::{self, MESSAGE_WAIT_MICROS, Request, violation};
use isinglass_core::wire::control::one_line;
use isinglass_core::wire::{
    LoadState, LoadStatus, Parts, PoseRequest, ProbeRequest, Probed, Refusal, ServerMessage, ServerStats,
    VolumeChange,
};
use quinn::{Connection, RecvStream, SendStream};
use tokio::sync::{mpsc, watch};
use tracing::Instrument;

use super::frames::{FrameSender, Pace};
use super::{Admitted, Greeting, refuse};
use crate::clock::Clock;
use crate::control_stream::{self, ReceiveError};
use crate::journal::Journal;
use crate::transport;

/// One viewer's connection, in parts that can go to different tasks. The connection closes when `frames` and
/// `control` (and their clones) are dropped.
#[derive(Debug)]
pub struct Session {
    /// Counts the sessions of the server.
    pub id: u64,
    /// The viewer, the same over its connections.
    pub viewer: ViewerId,
    /// What the viewer calls itself.
    pub name: String,
    /// Where it is.
    pub remote: SocketAddr,
    /// What it was told when it was let in.
    pub greeting: Arc<Greeting>,
    /// The newest pose: there is no queue. Its sender is dropped when the connection is over.
    pub poses: watch::Receiver<Option<PoseRequest>>,
    /// The newest question for the value at a point; earlier ones are not answered.
    pub probes: watch::Receiver<Option<ProbeRequest>>,
    /// What else the viewer asks for. The control stream is not read on while this is full.
    pub requests: mpsc::Receiver<Request>,
    /// Frames go here.
    pub frames: FrameSender,
    /// Messages go here.
    pub control: ControlSender,
    /// The lives of the frames.
    pub journal: Journal,
}

/// The connection is over.
#[derive(Clone, Copy, Debug, thiserror::Error, PartialEq, Eq)]
#[error("the viewer's connection is over")]
pub struct SessionClosed;

/// Sends messages to the viewer.
#[derive(Clone, Debug)]
pub struct ControlSender {
    messages: mpsc::Sender<ServerMessage>,
    close: Arc<CloseOnDrop>,
}

impl ControlSender {
    /// Frames from now on have this look, or a draft of it.
    ///
    /// # Errors
    /// If the connection is over.
    pub async fn look_changed(
        &self,
        version: LookVersion,
        look: Look,
        is_draft: bool,
    ) -> Result<(), SessionClosed> {
        self.send(ServerMessage::LookChanged { version, look, is_draft }).await
    }

    /// What is at a point. Dropped if messages already wait: the viewer asks again.
    pub fn probed(&self, probed: Probed) {
        let _ = self.messages.try_send(ServerMessage::Probed(probed));
    }

    /// A picture that was asked for will not come.
    ///
    /// # Errors
    /// If the connection is over.
    pub async fn shot_failed(&self, id: ShotId, why: &str) -> Result<(), SessionClosed> {
        self.send(ServerMessage::ShotFailed { id, why: one_line(why) }).await
    }

    /// One line for the person at the viewer.
    ///
    /// # Errors
    /// If the connection is over.
    pub async fn notice(&self, text: &str) -> Result<(), SessionClosed> {
        self.send(ServerMessage::Notice(one_line(text))).await
    }

    /// Frames from now on show another volume.
    ///
    /// # Errors
    /// If the connection is over.
    pub async fn volume_changed(&self, change: VolumeChange) -> Result<(), SessionClosed> {
        self.send(ServerMessage::VolumeChanged(Box::new(change))).await
    }

    /// What else the file holds.
    ///
    /// # Errors
    /// If the connection is over.
    pub async fn parts(&self, parts: Parts) -> Result<(), SessionClosed> {
        self.send(ServerMessage::Parts(Box::new(parts))).await
    }

    /// How the reading of another part stands. While it goes on, one is dropped if messages already wait.
    ///
    /// # Errors
    /// If the connection is over.
    pub async fn load(&self, status: LoadStatus) -> Result<(), SessionClosed> {
        if matches!(status.state, LoadState::Reading { .. }) {
            let _ = self.messages.try_send(ServerMessage::Load(status));
            return Ok(());
        }
        self.send(ServerMessage::Load(status)).await
    }

    /// What the newest frame cost. Dropped if messages already wait: there will be newer ones.
    pub fn stats(&self, stats: ServerStats) {
        let _ = self.messages.try_send(ServerMessage::Stats(stats));
    }

    /// Ends this session; the viewer may come back.
    pub fn close(&self, reason: &str) {
        self.close.0.close(transport::CLOSE_SESSION, one_line(reason).as_bytes());
    }

    async fn send(&self, message: ServerMessage) -> Result<(), SessionClosed> {
        self.messages.send(message).await.map_err(|_| SessionClosed)
    }
}

/// The connection and the state that decides about it; closes when the last user is gone.
#[derive(Debug)]
pub(super) struct Link {
    pub(super) connection: Connection,
    state: Mutex<server::Session>,
    pace: Mutex<Pace>,
    pub(super) journal: Journal,
    /// Sent on whenever a chunk may have been superseded.
    pub(super) progress: watch::Sender<()>,
    /// Frames that are being written: pictures to keep wait for them.
    pub(super) num_writing: watch::Sender<usize>,
}

impl Link {
    pub(super) fn state(&self) -> MutexGuard<'_, server::Session> {
        // Its methods change single numbers.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn pace(&self) -> MutexGuard<'_, Pace> {
        self.pace.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Owned by what the application holds, not by the tasks here.
#[derive(Debug)]
pub(super) struct CloseOnDrop(Connection);

impl Drop for CloseOnDrop {
    fn drop(&mut self) {
        self.0.close(transport::CLOSE_SESSION, b"the server has ended the session");
    }
}

/// Serves one connection until it is over.
pub(super) async fn run(admitted: Admitted, sessions: mpsc::Sender<Session>) {
    let Admitted { connection, mut send, recv, place, name, greeting } = admitted;
    let (id, viewer) = (place.session, place.viewer);
    let span = tracing::info_span!("session", id, viewer = viewer.0);
    let clock = place.shared.options.clock.clone();
    let journal = Journal::new(clock.clone());
    let link = Arc::new(Link {
        connection: connection.clone(),
        state: Mutex::new(server::Session::new(clock.now_micros())),
        pace: Mutex::default(),
        journal: journal.clone(),
        progress: watch::Sender::new(()),
        num_writing: watch::Sender::new(0),
    });
    let close = Arc::new(CloseOnDrop(connection.clone()));
    let max_viewers = place.shared.options.max_viewers;
    let (poses_in, poses) = watch::channel(None);
    let (probes_in, probes) = watch::channel(None);
    let (requests_in, requests) = mpsc::channel(MAX_REQUESTS);
    let (messages, messages_out) = mpsc::channel(MAX_MESSAGES);
    let remote = connection.remote_address();
    tracing::info!(parent: &span, %remote, name, "viewer connected");
    let session = Session {
        id,
        viewer,
        name,
        remote,
        greeting,
        poses,
        probes,
        requests,
        frames: FrameSender::new(link.clone(), close.clone()),
        control: ControlSender { messages, close },
        journal,
    };
    // An unsent session is kept for the moment: dropping it closes the connection.
    if let Err(_unsent) = sessions.try_send(session) {
        return refuse(&connection, &mut send, Refusal::Full(max_viewers)).await;
    }
    let serving = async {
        let violated = tokio::select! {
            () = read_poses(&link, &clock, &poses_in) => None,
            violated = read_requests(&link, &clock, recv, &requests_in, &probes_in) => violated,
            () = write_messages(&mut send, messages_out) => None,
        };
        if let Some(refusal) = violated {
            refuse(&connection, &mut send, refusal).await;
        }
        // Whatever ended, the rest ends with it; a connection that is closed stays closed for its own reason.
        connection.close(transport::CLOSE_PROTOCOL, b"the control stream ended");
        let reason = connection.closed().await;
        tracing::info!("viewer gone: {reason}");
    };
    serving.instrument(span).await;
}

async fn read_poses(link: &Link, clock: &Clock, poses: &watch::Sender<Option<PoseRequest>>) {
    while let Ok(bytes) = link.connection.read_datagram().await {
        let result = link.state().handle_datagram(clock.now_micros(), &bytes);
        link.progress.send_replace(());
        match result {
            Ok(Some(request)) => {
                tracing::trace!(pose = request.id.0, "pose");
                poses.send_replace(Some(request));
            }
            Ok(None) => {}
            Err(e) => tracing::debug!("ignored: {e}"),
        }
    }
}

/// Ends with what the client has done wrong, or with nothing when the connection is over.
async fn read_requests(
    link: &Link,
    clock: &Clock,
    mut stream: RecvStream,
    requests: &mpsc::Sender<Request>,
    probes: &watch::Sender<Option<ProbeRequest>>,
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
        while !link.state().takes_message(clock.now_micros()) {
            tokio::time::sleep(Duration::from_micros(MESSAGE_WAIT_MICROS)).await;
        }
        let handled = link.state().handle_message(&body);
        match handled {
            Ok(Request::Bye) => {
                link.connection.close(transport::CLOSE_BYE, b"");
                return None;
            }
            // Newest wins; a frame in the making does not hold it up.
            Ok(Request::Probe(probe)) => drop(probes.send_replace(Some(probe))),
            // An application that no longer listens does not end the session: frames may still be wanted.
            Ok(request) => drop(requests.send(request).await),
            Err(refusal) => return Some(refusal),
        }
    }
}

async fn write_messages(stream: &mut SendStream, mut messages: mpsc::Receiver<ServerMessage>) {
    while let Some(message) = messages.recv().await {
        match control_stream::send(stream, &message).await {
            Ok(()) => {}
            Err(control_stream::SendError::Control(e)) => tracing::error!("not sent: {e}"),
            Err(control_stream::SendError::Ended(_)) => return,
        }
    }
    // All senders are gone, which may happen long before the frames end.
    std::future::pending::<()>().await;
}

/// Requests that wait for the application.
const MAX_REQUESTS: usize = 32;
/// Messages that wait for the network.
const MAX_MESSAGES: usize = 32;
