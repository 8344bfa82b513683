//! The task of the server, and one task for each viewer.

use std::sync::Arc;
use std::time::{Duration, Instant};

use isinglass_core::camera::{Camera, Intrinsics};
use isinglass_core::codec::Coding;
use isinglass_core::codec::blocks::{Reference, References};
use isinglass_core::ids::{FrameId, LookVersion, PoseId};
use isinglass_core::layer::{FrameHeader, max_lists};
use isinglass_core::look::Look;
use isinglass_core::session::server::Request;
use isinglass_core::space::Aabb;
use isinglass_core::wire::{PoseRequest, ServerStats};
use isinglass_net::{Server, Session, SessionClosed};
use tokio::sync::mpsc;
use tokio::task::{JoinHandle, JoinSet};
use tracing::Instrument;

use crate::Command;
use crate::generator::{Generated, Generator};

/// Lets viewers in until told to close.
pub(crate) async fn serve(
    mut server: Server,
    generator: Generator,
    bounds: Aabb,
    look: Look,
    codec: Coding,
    mut commands: mpsc::Receiver<Command>,
) {
    let mut viewers = JoinSet::new();
    loop {
        tokio::select! {
            session = server.accept() => {
                let Some(session) = session else { break };
                let span = tracing::info_span!("session", id = session.id, viewer = session.name, remote = %session.remote);
                let viewer = Viewer::new(session, generator.clone(), bounds, look.clone(), codec);
                viewers.spawn(viewer.run().instrument(span));
            }
            Some(_) = viewers.join_next() => {}
            command = commands.recv() => match command {
                Some(Command::MintLink { host, reply }) => {
                    let _ = reply.send(server.mint_link(&host));
                }
                Some(Command::Close) | None => break,
            },
        }
    }
    server.close().await;
}

/// One viewer: turns its newest pose into frames until the connection is over.
struct Viewer {
    session: Session,
    generator: Generator,
    bounds: Aabb,
    look: Arc<Look>,
    version: LookVersion,
    codec: Coding,
    frame: FrameId,
    /// What the newest frame was made for.
    answered: Option<(PoseId, LookVersion)>,
    /// Encoding and handing over of the frame before: runs while the next one is generated.
    sending: Option<JoinHandle<Result<Option<Arc<Reference>>, SessionClosed>>>,
    /// Frames that later ones may be predicted from.
    sent: References,
}

impl Viewer {
    fn new(session: Session, generator: Generator, bounds: Aabb, look: Look, codec: Coding) -> Self {
        Self {
            session,
            generator,
            bounds,
            look: Arc::new(look),
            version: LookVersion(1),
            codec,
            frame: FrameId(0),
            answered: None,
            sending: None,
            sent: References::default(),
        }
    }

    async fn run(mut self) {
        tracing::info!("viewer connected");
        while self.wait_for_work().await {
            let Some(request) = *self.session.poses.borrow_and_update() else { continue };
            if self.answered == Some((request.id, self.version)) {
                continue;
            }
            if !self.answer(&request).await {
                break;
            }
        }
        tracing::info!(frames = self.frame.0, "viewer gone");
    }

    /// Waits for a pose or a request; false when the viewer has left.
    async fn wait_for_work(&mut self) -> bool {
        tokio::select! {
            changed = self.session.poses.changed() => changed.is_ok(),
            request = self.session.requests.recv() => match request {
                Some(request) => self.take(request).await,
                None => false,
            },
        }
    }

    /// Takes all that has come by now. Of several looks the newest wins: none is rendered that is out of date.
    async fn take(&mut self, first: Request) -> bool {
        let mut newest_look = None;
        let mut next = Some(first);
        while let Some(request) = next {
            match request {
                Request::SetLook(look) => newest_look = Some(look),
                Request::Stats(stats) => tracing::debug!(?stats, "viewer"),
                Request::Bye => return false,
            }
            next = self.session.requests.try_recv().ok();
        }
        let Some(look) = newest_look else { return true };
        tracing::info!(transfer = look.transfer.name, layering = %look.layering, k = look.k, "new look");
        self.version = self.version.next();
        self.look = Arc::new(look);
        // The newest pose shall be answered again.
        self.session.poses.mark_changed();
        self.session.control.look_changed(self.version, (*self.look).clone()).await.is_ok()
    }

    /// Generates the frame for a pose, and hands it over to be encoded and sent; false when the viewer has left.
    async fn answer(&mut self, request: &PoseRequest) -> bool {
        self.frame = self.frame.next();
        self.answered = Some((request.id, self.version));
        let header = FrameHeader {
            frame: self.frame,
            pose: request.id,
            look: self.version,
            camera: Camera::new(request.pose, bounded(request.intrinsics, self.look.k), &self.bounds),
            k: self.look.k,
        };
        let Some(result) = self.generator.generate((*self.look).clone(), header).await else { return false };
        let generated = match result {
            Ok(generated) => generated,
            Err(e) => {
                tracing::warn!("frame {}: {e}", self.frame);
                return self.session.control.notice(&format!("the server cannot render: {e}")).await.is_ok();
            }
        };
        if let Some(sending) = self.sending.take() {
            let waiting = Instant::now();
            let Ok(Ok(reference)) = sending.await else { return false };
            if let Some(reference) = reference {
                self.sent.insert(reference);
            }
            // Where the network is slower than the renderer, a frame for the newest pose is made sooner than this one
            // has waited. It finds the network free, so no frame is passed over twice in a row.
            let is_outdated = self.session.poses.borrow().is_some_and(|newest| newest.id != request.id);
            if is_outdated && waiting.elapsed() > Duration::from_micros(generated.generate_micros) {
                tracing::trace!("frame {} waited too long", self.frame);
                self.answered = None;
                self.session.poses.mark_changed();
                return true;
            }
        }
        let span = tracing::debug_span!("frame", id = self.frame.0);
        let reference = self.sent.next(self.session.frames.newest_decoded()).cloned();
        let (frames, control) = (self.session.frames.clone(), self.session.control.clone());
        let send = send(frames, control, generated, *request, self.codec, reference);
        self.sending = Some(tokio::spawn(send.instrument(span)));
        true
    }
}

/// Encodes a frame on a thread for blocking work, and returns when the network has taken its base: what later frames
/// may be predicted from.
async fn send(
    frames: isinglass_net::server::FrameSender,
    control: isinglass_net::server::ControlSender,
    generated: Generated,
    request: PoseRequest,
    codec: Coding,
    reference: Option<Arc<Reference>>,
) -> Result<Option<Arc<Reference>>, SessionClosed> {
    let header = generated.frame.header;
    let segments = generated.frame.num_segments() as u64;
    let started = Instant::now();
    let encoded =
        tokio::task::spawn_blocking(move || codec.encode(&generated.frame, reference.as_deref())).await;
    let encode_micros = started.elapsed().as_micros() as u64;
    let (encoded, reference) = match encoded {
        Ok(Ok(encoded)) => encoded,
        Ok(Err(e)) => {
            tracing::warn!("{e}");
            return control.notice(&format!("the server cannot encode a frame: {e}")).await.map(|()| None);
        }
        Err(e) => {
            tracing::error!("encoding ended early: {e}");
            return Err(SessionClosed);
        }
    };
    control.stats(ServerStats {
        frame: header.frame,
        pose: header.pose,
        pose_stamp_micros: request.stamp_micros,
        generate_micros: generated.generate_micros,
        encode_micros,
        bytes: encoded.num_bytes() as u64,
        segments,
    });
    frames.send(header.frame, header.pose, encoded.chunks).await?;
    Ok(reference)
}

/// The picture size that is rendered for a wish: the same shape, at most [`max_lists`] pixels.
fn bounded(wish: Intrinsics, k: u8) -> Intrinsics {
    let excess = wish.num_pixels() as f32 / max_lists(k) as f32;
    if excess <= 1.0 {
        return wish;
    }
    let shrink = |side: u32| ((side as f32 / excess.sqrt()) as u32).max(1);
    Intrinsics { width: shrink(wish.width), height: shrink(wish.height), ..wish }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wishes_are_bounded_and_keep_their_shape() {
        for k in [1, 8, 15, 32] {
            let wish = |width, height| bounded(Intrinsics { width, height, fov_y: 1.0 }, k);
            assert_eq!(wish(1920, 1200), Intrinsics { width: 1920, height: 1200, fov_y: 1.0 });
            let (big, most) = (wish(8192, 4096), max_lists(k));
            assert!(big.num_pixels() <= most && big.num_pixels() > most * 9 / 10);
            assert!((big.width as f32 / big.height as f32 - 2.0).abs() < 0.01);
            assert!(wish(8192, 1).num_pixels() >= 1);
        }
    }
}
