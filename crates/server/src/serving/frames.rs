//! Drives the frames of one viewer through the stations, as `isinglass_core::session::frames` decides.

use std::time::Duration;

use isinglass_core::codec::CodecError;
use isinglass_core::session::frames::{Asked, FramesServer, bounded};
use isinglass_core::session::look::GeneratedLook;
use isinglass_core::wire::PoseRequest;
use isinglass_net::SessionClosed;
use tokio::time::Instant;

use super::Viewer;
use crate::generator::{GenerateError, Generated, Wanted, Wish};
use crate::pipeline::{Coded, Event, Sent, Ticket};

impl Viewer {
    /// Hands frames on, and begins the next one if it is time. Returns when to look again, if that is known.
    pub(super) fn advance(&mut self) -> Option<Instant> {
        self.pipeline.send();
        if let Some((asked, generated)) = self.pipeline.take_made() {
            self.code(asked, generated);
        }
        let now = self.now_micros();
        let talk = self.session.control.talk();
        let request = talk.pose.newest()?;
        if self.frames.is_answered(request.id, talk.look.version()) {
            let due = self.frames.finer_due(&talk.look).filter(|_| self.pipeline.is_idle())?;
            return Some(Instant::now() + Duration::from_micros(due.saturating_sub(now)));
        }
        let wait = self.pipeline.begins_in(bounded(request.intrinsics, talk.look.look().k).num_pixels())?;
        if wait > Duration::ZERO {
            return Some(Instant::now() + wait);
        }
        let asked = self.frames.begin(now, &request, &talk.look, &self.present.bounds);
        let (generator, scene) = (self.common.generator.clone(), self.present.scene);
        let (look, wish) = ((**talk.look.look()).clone(), Wish::default());
        let near = self.occlusion.clone();
        let wanted = Wanted { look, near, header: asked.header, wish: wish.clone() };
        let making = async move { generator.generate(scene, wanted).await };
        self.pipeline.generate(asked, wish, making);
        None
    }

    /// A newer pose has come: what is only for the one before is given up.
    pub(super) fn note_pose(&mut self, newest: &PoseRequest) {
        self.pipeline.handle_decoding(newest.decode_nanos_per_list);
        self.give_up_outdated(newest);
        let now = self.now_micros();
        let generating = self.pipeline.generating();
        if self.frames.handle_pose(now, newest, generating.map(|(asked, _)| asked)) {
            self.pipeline.give_up_generating();
        }
    }

    /// Another look has come: what is only for the one before is given up.
    pub(super) fn note_look(&mut self) {
        let newest = self.session.talk().pose.newest();
        if let Some(newest) = newest {
            self.give_up_outdated(&newest);
        }
        let now = self.now_micros();
        let generating = self.pipeline.generating();
        if self.frames.handle_look(now, generating.map(|(asked, _)| asked)) {
            self.pipeline.give_up_generating();
        }
    }

    fn give_up_outdated(&mut self, newest: &PoseRequest) {
        let version = self.session.talk().look.version();
        self.pipeline.give_up(|sending| FramesServer::is_outdated(sending, newest, version));
        self.pipeline.give_up_coding(|asked| FramesServer::is_overtaken(asked, newest, version));
    }

    /// Takes what a station has done; false when the viewer has left.
    pub(super) fn handle(&mut self, event: Event) -> bool {
        match event {
            Event::Generated(asked, generated) => self.note_generated(asked, generated),
            Event::Coded(coded) => self.note_coded(coded),
            Event::Sent(sent) => self.note_sent(sent),
        }
    }

    fn note_generated(
        &mut self,
        asked: Option<Asked>,
        generated: Option<Result<Generated, GenerateError>>,
    ) -> bool {
        let (Some(asked), Some(generated)) = (asked, generated) else { return false };
        let frame = asked.header.frame;
        match generated {
            Ok(generated) => {
                self.frames.handle_generated(generated.generate_micros);
                // Without light there is none, and a light that is switched on again begins with the former.
                if let Some(occlusion) = &generated.occlusion {
                    self.occlusion = Some(occlusion.clone());
                }
                let (now, version) = (self.now_micros(), asked.header.look);
                let look = self.session.talk().look.handle_generated(now, version, generated.is_draft);
                match look {
                    GeneratedLook::Usable => self.pipeline.put_made(asked, generated),
                    GeneratedLook::Draft => {
                        self.frames.handle_unanswered();
                        self.pipeline.drop_made(frame);
                    }
                }
            }
            Err(GenerateError::GivenUp) => {
                tracing::trace!("frame {frame} given up: the camera or the look moves on");
                self.frames.handle_given_up();
            }
            // The change is about to be told, and the pose answered with it.
            Err(GenerateError::OtherVolume) => {}
            Err(e) => {
                tracing::warn!("frame {frame}: {e}");
                self.frames.handle_failed(e.is_lost());
                self.session.talk().link.notice(&format!("the server cannot render: {e}"));
            }
        }
        true
    }

    /// Decides how a frame is coded, and has it coded.
    fn code(&mut self, asked: Asked, generated: Generated) {
        let reference = self.sent.next(self.session.talk().chunks.reported()).cloned();
        let link = self.session.frames.link_state();
        let mode = generated.frame.header.mode;
        let sending = self.frames.choose_coding(link, asked, mode, reference.is_some());
        self.pipeline.code(generated, Ticket { sending, reference, wish: Wish::default() });
    }

    fn note_coded(&mut self, coded: Option<Result<Coded, CodecError>>) -> bool {
        match coded {
            Some(Ok(coded)) => {
                if let Some(reference) = &coded.reference {
                    self.sent.insert(reference.clone());
                }
                let Ticket { sending, reference, .. } = &coded.ticket;
                let (bytes, micros) = (coded.num_bytes(), coded.encode_micros);
                self.frames.handle_encoded(sending, reference.is_some(), bytes, micros);
                self.pipeline.put_coded(coded);
            }
            Some(Err(CodecError::Abandoned)) => {}
            Some(Err(e)) => {
                tracing::warn!("{e}");
                self.session.talk().link.notice(&format!("the server cannot encode a frame: {e}"));
            }
            None => {
                tracing::error!("encoding ended early");
                return false;
            }
        }
        true
    }

    fn note_sent(&mut self, sent: Result<Sent, SessionClosed>) -> bool {
        self.resting = sent.ok();
        if let Some(sent) = &self.resting {
            self.frames.handle_sent(sent.ticket.sending.clone());
        }
        self.resting.is_some()
    }

    /// Sends the frame of a resting camera again, finer, if it is time.
    pub(super) fn send_finer(&mut self) {
        if !self.pipeline.is_idle() {
            return;
        }
        let now = self.now_micros();
        let sending = self.frames.poll_finer(now, &self.session.control.talk().look);
        let Some(sending) = sending else { return };
        let Some(sent) = self.resting.take() else { return };
        let mut generated = sent.generated;
        generated.frame.header.frame = sending.asked.header.frame;
        // It may be too many frames ago by now.
        let reference = sent.ticket.reference.clone().filter(|r| self.sent.get(r.frame()).is_some());
        self.pipeline.code(generated, Ticket { sending, reference, ..sent.ticket });
    }
}
