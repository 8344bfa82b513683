//! The frames of one viewer: which pose is answered next, and how each frame is coded.

use std::time::Duration;

use isinglass_core::camera::{Camera, Intrinsics};
use isinglass_core::codec::{CodecError, Coding, Settings};
use isinglass_core::layer::{FrameHeader, max_lists};
use isinglass_core::session::rate::Mode;
use isinglass_core::wire::PoseRequest;
use isinglass_net::SessionClosed;
use tokio::time::Instant;

use super::Viewer;
use crate::generator::{GenerateError, Generated, Wish};
use crate::pipeline::{Asked, Coded, Event, Sent, Ticket};

impl Viewer {
    /// Hands frames on, and begins the next one if it is time; when to look again, if that is known.
    pub(super) fn advance(&mut self) -> Option<Instant> {
        self.pipeline.send();
        if let Some((asked, generated)) = self.pipeline.take_made() {
            self.code(asked, generated);
        }
        let request = (*self.session.poses.borrow())?;
        if self.answered == Some((request.id, self.version)) {
            return self.finer_at();
        }
        let intrinsics = bounded(request.intrinsics, self.look.k);
        let wait = self.pipeline.begins_in(intrinsics.num_pixels())?;
        if wait > Duration::ZERO {
            return Some(Instant::now() + wait);
        }
        self.begin(&request, intrinsics);
        None
    }

    /// Begins the frame for a pose.
    fn begin(&mut self, request: &PoseRequest, intrinsics: Intrinsics) {
        self.frame = self.frame.next();
        // The look is another, or its shade: what was said of the camera's movement then has been taken.
        let is_again = self.answered.is_some_and(|(pose, _)| pose == request.id);
        self.answered = Some((request.id, self.version));
        let header = FrameHeader {
            frame: self.frame,
            pose: request.id,
            look: self.version,
            camera: Camera::new(request.pose, intrinsics, &self.present.bounds),
            k: self.look.k,
            mode: Default::default(),
        };
        self.note_interval();
        self.rests = true;
        let wish = Wish::default();
        let (generator, scene, look) =
            (self.house.generator.clone(), self.present.scene, (*self.look).clone());
        let asked =
            Asked { request: *request, header, asked_at: Instant::now(), is_again, wish: wish.clone() };
        self.pipeline.generate(asked, async move { generator.generate(scene, look, header, wish).await });
    }

    /// Learns how often frames are begun while the camera moves.
    fn note_interval(&mut self) {
        let now = Instant::now();
        let since = self.begun_at.replace(now).map(|at| now - at);
        if let Some(interval) = since.filter(|interval| *interval < LONG_REST) {
            self.pilot.handle_interval(interval.as_micros() as u64);
        }
    }

    /// A newer pose has come: what is only for the one before is given up.
    pub(super) fn note_pose(&mut self) {
        let Some(newest) = *self.session.poses.borrow_and_update() else { return };
        self.pipeline.handle_decoding(newest.decode_nanos_per_list);
        // Whoever moves does not wait for what only makes a rest finer.
        let version = self.version;
        let is_wanted =
            |r: &PoseRequest| r.pose == newest.pose && is_same_picture(&r.intrinsics, &newest.intrinsics);
        let is_extra = |t: &Ticket| t.is_finer || t.is_margin;
        self.pipeline.give_up(|t| is_extra(t) && (!is_wanted(&t.request) || t.version != version));
        // A frame for a camera that has rested is larger than those of a moving one, and none of them can be made before it is
        // done. Never twice in a row: a viewer that is slow to ask would get no frame at all.
        let rested = std::mem::take(&mut self.rests) && !self.has_given_up;
        if let Some(asked) = self.pipeline.generating().filter(|_| rested) {
            // Smaller frames are asked for while something changes, if only the look.
            let is_smaller = newest.intrinsics.num_pixels() < asked.request.intrinsics.num_pixels();
            let is_outdated = newest.pose != asked.request.pose || is_smaller;
            if is_outdated && asked.asked_at.elapsed() >= LONG_REST {
                asked.wish.give_up();
            }
        }
    }

    /// Takes what a station has done; false when the viewer has left.
    pub(super) async fn handle(&mut self, event: Event) -> bool {
        match event {
            Event::Generated(asked, generated) => self.note_generated(asked, generated).await,
            Event::Coded(coded) => self.note_coded(coded).await,
            Event::Sent(sent) => self.note_sent(sent),
        }
    }

    async fn note_generated(
        &mut self,
        asked: Option<Asked>,
        generated: Option<Result<Generated, GenerateError>>,
    ) -> bool {
        let Some(asked) = asked else { return false };
        let generated = match generated {
            Some(Ok(generated)) => generated,
            None => return false,
            Some(Err(GenerateError::GivenUp)) => {
                tracing::trace!("frame {} given up: the camera moves on", asked.header.frame);
                (self.has_given_up, self.answered) = (true, None);
                return true;
            }
            // The change is about to be told, and the pose answered with it.
            Some(Err(GenerateError::OtherVolume)) => return true,
            Some(Err(e)) => {
                tracing::warn!("frame {}: {e}", asked.header.frame);
                // Another renderer has taken the place of a lost one: once more.
                if e.is_lost() && !std::mem::replace(&mut self.has_failed, true) {
                    self.answered = None;
                }
                return self.session.control.notice(&format!("the server cannot render: {e}")).await.is_ok();
            }
        };
        (self.has_given_up, self.has_failed) = (false, false);
        let is_newest = asked.header.look == self.version;
        if is_newest && generated.is_draft && !self.is_draft {
            // Other viewers' looks have taken the place of its shade.
            self.answered = None;
            self.pipeline.drop_made(asked.header.frame);
            return self.begin_version(true).await;
        }
        if is_newest && self.is_draft && !generated.is_draft {
            // Nothing of the shade had changed.
            self.stop_refining();
            if !self.tell_version(false).await {
                return false;
            }
        }
        self.pilot.handle_generated(generated.generate_micros);
        self.pipeline.put_made(asked, generated);
        true
    }

    /// Decides how a frame is coded, and has it coded.
    fn code(&mut self, asked: Asked, generated: Generated) {
        let header = asked.header;
        self.pilot.handle_link(self.since.elapsed().as_micros() as u64, self.session.frames.link_state());
        self.pilot.handle_turned(asked.request.shown_turn_deg.filter(|_| !asked.is_again));
        let reference = self.sent.next(self.session.frames.newest_decoded()).cloned();
        let num_lists = header.camera.intrinsics.num_pixels();
        let is_margin = self.shows_exactly(&header.camera);
        let coding = if is_margin {
            Coding::Exact(Settings { num_groups: 1, ..Settings::default() })
        } else {
            self.pilot.next(num_lists, reference.is_some())
        };
        let coding = coding.for_mode(generated.frame.header.mode);
        let ticket = Ticket {
            request: asked.request,
            version: header.look,
            asked_at: asked.asked_at,
            coding,
            reference,
            is_finer: false,
            is_margin,
            wish: Wish::default(),
        };
        self.pipeline.code(generated, ticket);
    }

    async fn note_coded(&mut self, coded: Option<Result<Coded, CodecError>>) -> bool {
        let coded = match coded {
            Some(Ok(coded)) => coded,
            Some(Err(CodecError::Abandoned)) => return true,
            None => {
                tracing::error!("encoding ended early");
                return false;
            }
            Some(Err(e)) => {
                tracing::warn!("{e}");
                return self
                    .session
                    .control
                    .notice(&format!("the server cannot encode a frame: {e}"))
                    .await
                    .is_ok();
            }
        };
        if let Some(reference) = &coded.reference {
            self.sent.insert(reference.clone());
        }
        let Ticket { coding, reference, is_finer, .. } = &coded.ticket;
        // What a frame takes that is predicted from itself says nothing of others.
        if !is_finer || matches!(coding, Coding::Exact(_)) {
            let num_lists = coded.generated.frame.header.camera.intrinsics.num_pixels();
            let (bytes, micros) = (coded.num_bytes(), coded.encode_micros);
            self.pilot.handle_encoded(coding, reference.is_some(), num_lists, bytes, micros);
        }
        self.pipeline.put_coded(coded);
        true
    }

    /// False when the viewer has left.
    fn note_sent(&mut self, sent: Result<Sent, SessionClosed>) -> bool {
        self.resting = sent.ok();
        self.resting.is_some()
    }

    /// When the frame of a resting camera is sent again, finer.
    fn finer_at(&self) -> Option<Instant> {
        let sent = self.resting.as_ref().filter(|_| self.pipeline.is_idle())?;
        self.finer(sent).map(|_| sent.ticket.asked_at + REST)
    }

    /// Sends it, if it is time.
    pub(super) fn send_finer(&mut self) {
        if self.finer_at().is_none_or(|at| Instant::now() < at) {
            return;
        }
        let Some((coding, sent)) = self.resting.as_ref().and_then(|s| self.finer(s)).zip(self.resting.take())
        else {
            return;
        };
        self.frame = self.frame.next();
        let mut generated = sent.generated;
        generated.frame.header.frame = self.frame;
        // It may be too many frames ago by now.
        let reference = sent.ticket.reference.clone().filter(|r| self.sent.get(r.frame()).is_some());
        self.pipeline.code(generated, Ticket { coding, reference, is_finer: true, ..sent.ticket });
    }

    /// How a frame that was sent shall be sent again if the camera rests where it is.
    fn finer(&self, sent: &Sent) -> Option<Coding> {
        let header = &sent.generated.frame.header;
        // Nor is a draft: it is about to be made anew.
        let is_newest = !self.is_draft
            && self.answered == Some((header.pose, self.version))
            && header.look == self.version;
        let num_lists = header.camera.intrinsics.num_pixels();
        is_newest.then(|| self.pilot.finer(num_lists, &sent.ticket.coding)).flatten()
    }

    /// Whether the viewer has, or will have, the exact picture that this camera sees: a frame for it has another margin
    /// only.
    fn shows_exactly(&self, camera: &Camera) -> bool {
        let sent = self.resting.as_ref();
        let is_exact = sent.is_some_and(|sent| {
            let header = &sent.generated.frame.header;
            matches!(sent.ticket.coding, Coding::Exact(_))
                && header.camera.pose == camera.pose
                && is_same_picture(&header.camera.intrinsics, &camera.intrinsics)
                && header.look == self.version
        });
        self.mode == Mode::Auto && is_exact
    }
}

/// Whether frames of two sizes hold the same lists, but for a margin around them.
fn is_same_picture(a: &Intrinsics, b: &Intrinsics) -> bool {
    a.margin_around(b).is_some() || b.margin_around(a).is_some()
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

/// A camera that no newer pose has come of for so long rests: three refreshes at 30 Hz.
const REST: Duration = Duration::from_millis(100);
/// And one that none has come of for so long does even where the viewer refreshes four times a second only: what it waits
/// for is given up when it moves.
const LONG_REST: Duration = Duration::from_millis(250);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wishes_are_bounded_and_keep_their_shape() {
        for k in [1, 8, 15, 32] {
            let wish = |width, height| bounded(Intrinsics::perspective(width, height, 1.0), k);
            assert_eq!(wish(1920, 1200), Intrinsics::perspective(1920, 1200, 1.0));
            let (big, most) = (wish(8192, 4096), max_lists(k));
            assert!(big.num_pixels() <= most && big.num_pixels() > most * 9 / 10);
            assert!((big.width as f32 / big.height as f32 - 2.0).abs() < 0.01);
            assert!(wish(8192, 1).num_pixels() >= 1);
        }
    }
}
