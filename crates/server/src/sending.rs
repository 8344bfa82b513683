//! Encoding a frame and handing it to the network, beside the task of its viewer.

use std::sync::Arc;

use isinglass_core::codec::blocks::Reference;
use isinglass_core::codec::{CodecError, Coding};
use isinglass_core::ids::LookVersion;
use isinglass_core::session::ledger::Stage;
use isinglass_core::wire::{PoseRequest, ServerStats};
use isinglass_net::{AfterWork, Journal, SessionClosed, Work};
use isinglass_net::server::{ControlSender, FrameSender};
use tokio::task::JoinHandle;
use tokio::time::Instant;

use crate::generator::{Generated, Wish};

/// A frame on its way to the network.
pub(crate) struct Sending {
    pub(crate) task: JoinHandle<Result<Option<Sent>, SessionClosed>>,
    pub(crate) ticket: Ticket,
}

/// What a frame is sent as.
#[derive(Clone)]
pub(crate) struct Ticket {
    pub(crate) request: PoseRequest,
    pub(crate) version: LookVersion,
    /// When the request was taken up.
    pub(crate) asked_at: Instant,
    pub(crate) coding: Coding,
    pub(crate) reference: Option<Arc<Reference>>,
    /// Whether the same frame was sent before, less fine.
    pub(crate) is_finer: bool,
    /// Whether the viewer has the exact picture of it already, with another margin.
    pub(crate) is_margin: bool,
    pub(crate) wish: Wish,
}

/// A frame that the network has taken.
pub(crate) struct Sent {
    pub(crate) ticket: Ticket,
    pub(crate) generated: Generated,
    /// What later frames may be predicted from.
    pub(crate) reference: Option<Arc<Reference>>,
    pub(crate) bytes: usize,
    pub(crate) encode_micros: u64,
}

/// Returns when the frame is with the network; at once if there is none. Nothing is lost if this is dropped.
pub(crate) async fn finished(sending: &mut Option<Sending>) -> Result<Option<Sent>, SessionClosed> {
    let Some(running) = sending else { return Ok(None) };
    let ended = (&mut running.task).await;
    *sending = None;
    ended.unwrap_or(Err(SessionClosed))
}

/// Encodes a frame on a thread for blocking work, and returns when the network has taken its base. None if it was given up
/// or cannot be encoded.
pub(crate) async fn send(
    frames: FrameSender,
    control: ControlSender,
    journal: Journal,
    after_work: AfterWork,
    generated: Generated,
    ticket: Ticket,
) -> Result<Option<Sent>, SessionClosed> {
    let header = generated.frame.header;
    let segments = generated.frame.num_segments() as u64;
    let started = Instant::now();
    let Ticket { coding, reference, wish, .. } = ticket.clone();
    journal.stamp(header.frame, Stage::CodingBegun);
    let encoded = tokio::task::spawn_blocking(move || {
        let wanted = || wish.holds();
        let work = || coding.encode_while(&generated.frame, reference.as_deref(), &wanted);
        let encoded = after_work.run(Work::Encode, work);
        (encoded, generated)
    });
    let encoded = encoded.await;
    let encode_micros = started.elapsed().as_micros() as u64;
    let (encoded, reference, generated) = match encoded {
        Ok((Ok((encoded, reference)), generated)) => (encoded, reference, generated),
        Ok((Err(CodecError::Abandoned), _)) => {
            journal.give_up(header.frame);
            return Ok(None);
        }
        Ok((Err(e), _)) => {
            tracing::warn!("{e}");
            return control.notice(&format!("the server cannot encode a frame: {e}")).await.map(|()| None);
        }
        Err(e) => {
            tracing::error!("encoding ended early: {e}");
            return Err(SessionClosed);
        }
    };
    journal.stamp(header.frame, Stage::Coded);
    if !ticket.wish.holds() {
        journal.give_up(header.frame);
        return Ok(None);
    }
    let bytes = encoded.num_bytes();
    journal.add_bytes(header.frame, bytes as u64);
    if ticket.is_finer {
        frames.send_finer(header.frame, header.pose, encoded.chunks).await?;
    } else {
        control.stats(ServerStats {
            frame: header.frame,
            pose: header.pose,
            pose_stamp_micros: ticket.request.stamp_micros,
            generate_micros: generated.generate_micros,
            encode_micros,
            bytes: bytes as u64,
            segments,
        });
        frames.send(header.frame, header.pose, encoded.chunks).await?;
    }
    Ok(Some(Sent { ticket, generated, reference, bytes, encode_micros }))
}
