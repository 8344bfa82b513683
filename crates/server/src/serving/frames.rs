//! Drives the frames of one viewer through the stations, as `isinglass_core::session::frames` decides.

use std::time::Duration;

use isinglass_core::codec::CodecError;
use isinglass_core::codec::blocks::References;
use isinglass_core::layer::FrameHeader;
use isinglass_core::session::frames::{Asked, FramesServer, bounded};
use isinglass_core::session::look::GeneratedLook;
use isinglass_core::wire::PoseRequest;
use isinglass_net::SessionClosed;
use tokio::time::Instant;

use super::Viewer;
use crate::frame_memory::{LEAST_BYTES, bytes_of_making};
use crate::generator::{FrameOrder, GenerateError, Generated, Wish};
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
        let request = match &self.led {
            Some(led) => led.request?,
            None => talk.pose.newest()?,
        };
        let larger_due = self.frames.larger_due();
        if larger_due.is_some_and(|due| due <= now) && self.pipeline.is_idle() {
            self.frames.handle_unanswered();
        }
        let is_answered = self.frames.is_answered(request.id, talk.look.version());
        if let Some(due) = self.pages_due(now, &request).filter(|_| is_answered) {
            if due > now || !self.pipeline.is_idle() {
                let due = Some(due).filter(|_| self.pipeline.is_idle())?;
                return Some(Instant::now() + Duration::from_micros(due.saturating_sub(now)));
            }
            self.resting_pose = Some(request.id);
            self.frames.handle_unanswered();
        }
        if self.frames.is_answered(request.id, talk.look.version()) {
            if larger_due.is_some() {
                let due = larger_due.filter(|_| self.pipeline.is_idle())?;
                return Some(Instant::now() + Duration::from_micros(due.saturating_sub(now)));
            }
            let due = self.frames.finer_due(&talk.look).filter(|_| self.pipeline.is_idle())?;
            return Some(Instant::now() + Duration::from_micros(due.saturating_sub(now)));
        }
        if self.led.is_some() {
            drop(talk);
            return self.begin_led(now, &request);
        }
        let look = (**talk.look.look()).clone();
        let mut num_lists = bounded(request.intrinsics, look.k).num_pixels();
        let (viewer, moment) = (self.session.viewer, std::time::Instant::now());
        let others = self.common.generator.dispatch.has_others(viewer, moment);
        let shared = self.sizes.lists_beside_others(moment).filter(|most| others && *most < num_lists);
        self.frames.bound(shared.unwrap_or(usize::MAX), shared.is_some());
        num_lists = self.frames.size_of(&request, look.k).num_pixels();
        let wait = self.pipeline.begins_in(num_lists)?;
        if wait > Duration::ZERO {
            return Some(Instant::now() + wait);
        }
        let wanted = |lists| bytes_of_making(self.sizes.expected_segments(&look, lists), lists);
        let memory = &self.common.memory;
        let mut held = memory.hold(wanted(num_lists), LEAST_BYTES);
        if held.bytes() < wanted(num_lists) {
            // What was sent already is worth less than what comes.
            drop(held);
            self.resting = None;
            self.sent.keep_newest();
            self.held.set(self.sent.num_bytes() as u64);
            held = memory.hold(wanted(num_lists), LEAST_BYTES);
            let share = held.bytes() as f64 / wanted(num_lists) as f64;
            if share < 1.0 {
                num_lists = (num_lists as f64 * share) as usize;
                self.frames.bound(num_lists, shared.is_some());
            }
        }
        let asked = self.frames.begin(now, &request, &talk.look, &self.present.bounds);
        let (generator, scene) = (self.common.generator.clone(), self.present.scene);
        let wish = Wish::default();
        let (near, header) = (self.occlusion.clone(), asked.header);
        let rests = self.resting_pose == Some(request.id);
        let order = FrameOrder { viewer, scene, look, near, header, rests, wish: wish.clone(), held };
        let making = async move { generator.generate(order).await };
        self.pipeline.generate(asked, wish, making);
        None
    }

    /// Begins a frame that the leader's viewer has already, if it is time.
    fn begin_led(&mut self, now: u64, request: &PoseRequest) -> Option<Instant> {
        let wait = self.pipeline.begins_in(request.intrinsics.num_pixels())?;
        if wait > Duration::ZERO {
            return Some(Instant::now() + wait);
        }
        self.frames.bound(usize::MAX, false);
        let mut asked =
            self.frames.begin(now, request, &self.session.control.talk().look, &self.present.bounds);
        let (generated, wish) = self.led_frame(&mut asked)?;
        self.pipeline.generate(asked, wish, std::future::ready(Some(Ok(generated))));
        None
    }

    /// A newer pose has come: what is only for the one before is given up.
    pub(super) fn note_pose(&mut self, newest: &PoseRequest) {
        self.sizes.note_pose(newest, std::time::Instant::now());
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
        let (Some(mut asked), Some(generated)) = (asked, generated) else { return false };
        let frame = asked.header.frame;
        match generated {
            Ok(mut generated) => {
                self.frames.handle_generated(generated.generate_micros);
                // To keep to its memory, it may be smaller.
                let FrameHeader { camera, fineness, .. } = *generated.frame.header();
                (asked.header.camera, asked.header.fineness) = (camera, fineness);
                // Without light there is none, and a light that is switched on again begins with the former.
                if let Some(occlusion) = &generated.occlusion {
                    self.occlusion = Some(occlusion.clone());
                }
                let (now, version) = (self.now_micros(), asked.header.look);
                self.note_pages(now, &mut generated);
                if version == self.session.control.talk().quietly().look.version() {
                    let look = self.session.control.talk().quietly().look.look().clone();
                    self.sizes.note_frame(&look, &generated);
                }
                let look = self.session.talk().look.handle_generated(now, version, generated.is_draft);
                match look {
                    GeneratedLook::Usable => {
                        if self.presence.has_followers() {
                            self.lead(&asked, &generated);
                        }
                        self.pipeline.put_made(asked, generated);
                    }
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
        let mode = generated.frame.header().mode;
        let sending = self.frames.choose_coding(link, asked, mode, reference.is_some());
        self.pipeline.code(generated, Ticket { sending, reference, wish: Wish::default() });
    }

    fn note_coded(&mut self, coded: Option<Result<Coded, CodecError>>) -> bool {
        match coded {
            Some(Ok(coded)) => {
                if let Some(reference) = &coded.reference {
                    self.sent.insert(reference.clone());
                    self.held.set(self.sent.num_bytes() as u64);
                    if self.common.memory.room() == 0 {
                        self.sent.keep_newest();
                        self.held.set(self.sent.num_bytes() as u64);
                    }
                }
                let Ticket { sending, reference, .. } = &coded.ticket;
                let (bytes, micros) = (coded.num_bytes(), coded.encode_micros);
                self.common.counters.note_bytes(bytes);
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
            self.common.counters.note_frame();
            self.frames.handle_sent(sent.ticket.sending.clone());
        }
        self.resting.is_some()
    }

    /// Forgets what was sent.
    pub(super) fn forget_sent(&mut self) {
        (self.resting, self.sent) = (None, References::default());
        self.held.set(0);
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
        generated.frame.header_mut().frame = sending.asked.header.frame;
        // It may be too many frames ago by now.
        let reference = sent.ticket.reference.clone().filter(|r| self.sent.get(r.frame()).is_some());
        self.pipeline.code(generated, Ticket { sending, reference, ..sent.ticket });
    }
}
