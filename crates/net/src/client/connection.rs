//! Drives a connection, and reconnects after a loss.

use std::sync::Arc;
use std::time::Duration;

use isinglass_core::session::client;
use isinglass_core::session::link::retry_wait_micros;
use isinglass_core::session::pose::ReceiverReport;
use isinglass_core::wire::{ClientMessage, ServerMessage};
use quinn::{Connection, ConnectionError, Endpoint, RecvStream, SendDatagramError, SendStream};
use rand::RngExt;
use tokio::sync::watch;
use tokio::time::{Instant, MissedTickBehavior, timeout};
use tracing::Instrument;

use super::dial::{Dialed, Dialer};
use super::{ConnectError, Shared, State, chunks};
use crate::control_stream::{self, ReceiveError};
use crate::talk::until_due;
use crate::transport::{self, AUTH_DEADLINE};

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
pub(super) async fn say_goodbye(endpoint: &Endpoint) {
    let _ = timeout(Duration::from_millis(100), endpoint.wait_idle()).await;
}

const STATS_INTERVAL: Duration = Duration::from_millis(200);
/// Silence after which another connection is tried. Keep-alives are answered twice a second.
const SILENCE_BEFORE_OTHER: Duration = Duration::from_secs(2);
/// Time for a connection's close reason to arrive after the end of its streams.
const REASON_WAIT: Duration = Duration::from_secs(1);
/// A connection that lasted this long was of use. Attempts after one that ended sooner wait ever longer.
const USEFUL: Duration = Duration::from_secs(5);
