//! A viewer that leads or follows.

use std::sync::Arc;

use isinglass_core::ids::PoseId;
use isinglass_core::layer::FrameHeader;
use isinglass_core::session::admission::ViewerId;
use isinglass_core::session::frames::Asked;
use isinglass_core::wire::PoseRequest;
use tokio::time::Instant;

use super::Viewer;
use crate::audience::{Following, LedFrame, PATIENCE};
use crate::frame_memory::bytes_of;
use crate::generator::{Generated, Wish};

/// Whom a viewer follows, and what it has from there.
#[derive(Debug)]
pub(super) struct Led {
    following: Following,
    newest: Option<Arc<LedFrame>>,
    /// The pose and size of the newest frame, numbered here.
    pub(super) request: Option<PoseRequest>,
    num_frames: u32,
    /// When to look whether the leader is gone for good.
    check_at: Instant,
}

impl Viewer {
    /// Follows another viewer, or nobody.
    pub(super) fn follow(&mut self, leader: Option<ViewerId>) {
        let now = Instant::now();
        match self.common.audience.follow(self.session.viewer, leader) {
            Ok(following) => {
                self.led = following.map(|following| Led {
                    following,
                    newest: None,
                    request: None,
                    num_frames: 0,
                    check_at: now + PATIENCE,
                });
                self.frames.handle_unanswered();
                self.pipeline.give_up_generating();
            }
            Err(e) => {
                self.session.talk().link.notice(&e.to_string());
                self.tell_viewers();
            }
        }
    }

    pub(super) fn tell_viewers(&self) {
        let list = self.common.audience.list(self.session.viewer);
        self.session.talk().viewers.handle_list(list);
    }

    /// When to look after the leader again. A viewer whose leader is gone has its own frames again.
    pub(super) fn look_after_leader(&mut self) -> Option<Instant> {
        let led = self.led.as_mut()?;
        if Instant::now() >= led.check_at {
            led.check_at = Instant::now() + PATIENCE / 4;
            if self.common.audience.is_gone(led.following.leader) {
                self.session.talk().link.notice("the viewer that this one followed has left");
                self.follow(None);
                return None;
            }
        }
        self.led.as_ref().map(|led| led.check_at)
    }

    /// Takes a frame of the leader: its pose is answered next, under its look.
    pub(super) fn take_led(&mut self, frame: Arc<LedFrame>) {
        let (Some(led), Some(own)) = (&mut self.led, self.session.talk().pose.newest()) else { return };
        if frame.scene != self.present.scene {
            return;
        }
        led.num_frames = led.num_frames.wrapping_add(1);
        let PoseRequest { pose, intrinsics, .. } = frame.request;
        let request = PoseRequest { id: PoseId(led.num_frames), pose, intrinsics, ..own };
        (led.request, led.newest) = (Some(request), Some(frame.clone()));
        let now = self.now_micros();
        {
            let mut talk = self.session.talk();
            if **talk.look.look() != frame.look || talk.look.is_draft() != frame.is_draft {
                talk.look.begin(now, frame.look.clone(), !frame.is_draft);
            }
        }
        self.note_pose(&request);
    }

    /// A frame of the leader as one of this viewer: it answers none of its poses.
    pub(super) fn led_frame(&self, asked: &mut Asked) -> Option<(Generated, Wish)> {
        let newest = self.led.as_ref()?.newest.as_ref()?;
        let camera = newest.frame.header().camera;
        asked.header.camera = camera;
        let bytes = bytes_of(newest.frame.num_segments(), newest.frame.num_lists());
        let held = self.common.memory.hold(bytes, 0);
        if held.bytes() < bytes {
            tracing::debug!("no memory for a frame of the leader");
            return None;
        }
        let mut frame = newest.frame.clone();
        let FrameHeader { frame: number, look, .. } = asked.header;
        let header = frame.header_mut();
        *header = FrameHeader { frame: number, look, pose: PoseId(0), ..*header };
        let generated = Generated {
            frame,
            _held: held,
            generate_micros: 0,
            is_draft: newest.is_draft,
            occlusion: None,
            pages: None,
        };
        Some((generated, Wish::default()))
    }

    /// Shows a frame to those that follow this viewer.
    pub(super) fn lead(&self, asked: &Asked, generated: &Generated) {
        let frame = &generated.frame;
        let bytes = bytes_of(frame.num_segments(), frame.num_lists());
        let held = self.common.memory.hold(bytes, 0);
        let is_of_look = asked.header.look == self.session.talk().look.version();
        if held.bytes() < bytes || !is_of_look {
            return;
        }
        let look = (**self.session.talk().look.look()).clone();
        self.presence.publish(LedFrame {
            request: asked.request,
            look,
            scene: self.present.scene,
            frame: frame.clone(),
            is_draft: generated.is_draft,
            _held: held,
        });
    }

    /// Shows the resting frame to a viewer that has begun to follow.
    pub(super) fn lead_at_rest(&self) {
        if let Some(sent) = &self.resting {
            self.lead(&sent.ticket.sending.asked, &sent.generated);
        }
    }
}

/// The leader's next frame; never without one.
pub(super) async fn next_led(led: &mut Option<Led>) -> Arc<LedFrame> {
    match led {
        Some(led) => led.following.next().await,
        None => std::future::pending().await,
    }
}
