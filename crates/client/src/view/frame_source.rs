//! The source of frames for the viewer. The network client is one; tests have others.

use std::sync::Arc;
use std::time::Duration;

use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::ids::FrameId;
use isinglass_core::session::ClientSession;
use isinglass_core::wire::Welcome;
use isinglass_net::{Client, LinkStats, ReceivedFrame, State, Talking};

/// Brings layered frames. The viewer polls it at every refresh, so calls wait only for locks that are held for
/// moments.
pub trait FrameSource {
    /// The conversation with the server: everything that the viewer can say, and what it has heard.
    fn talk(&self) -> Talking<'_, ClientSession>;

    /// The newest displayable frame. It is the same `Arc` until something changes.
    fn latest_frame(&self) -> Option<Arc<ReceivedFrame>>;

    /// Notes for the ledger that a frame was on the screen.
    fn note_shown(&mut self, frame: FrameId);

    /// The state of the connection.
    fn state(&self) -> State;

    /// Statistics of the connection.
    fn stats(&self) -> LinkStats;

    /// Whether the server does not answer, although the connection is not lost.
    fn is_silent(&self) -> bool {
        self.state() == State::Connected && self.stats().is_silent()
    }

    /// Requests a frame from `pose`, set at `now`. The newest wins, and an unusable pose is ignored.
    fn set_pose(&mut self, now: Duration, pose: Pose, intrinsics: Intrinsics) {
        if let Err(e) = self.talk().pose.set(now.as_micros() as u64, pose, intrinsics) {
            tracing::warn!("pose ignored: {e}");
        }
    }

    /// The server's description of the volume, once known.
    fn description(&self) -> Option<Arc<Welcome>> {
        self.talk().link.description()
    }

    /// Whether a frame shows the described volume, and not the previous one.
    fn is_of_volume(&self, frame: &ReceivedFrame) -> bool {
        frame.is_of(&self.talk())
    }
}

impl<S: FrameSource + ?Sized> FrameSource for Box<S> {
    fn talk(&self) -> Talking<'_, ClientSession> {
        (**self).talk()
    }

    fn latest_frame(&self) -> Option<Arc<ReceivedFrame>> {
        (**self).latest_frame()
    }

    fn note_shown(&mut self, frame: FrameId) {
        (**self).note_shown(frame);
    }

    fn state(&self) -> State {
        (**self).state()
    }

    fn stats(&self) -> LinkStats {
        (**self).stats()
    }

    fn set_pose(&mut self, now: Duration, pose: Pose, intrinsics: Intrinsics) {
        (**self).set_pose(now, pose, intrinsics);
    }

    fn description(&self) -> Option<Arc<Welcome>> {
        (**self).description()
    }

    fn is_of_volume(&self, frame: &ReceivedFrame) -> bool {
        (**self).is_of_volume(frame)
    }
}

impl FrameSource for Client {
    fn talk(&self) -> Talking<'_, ClientSession> {
        Client::talk(self)
    }

    fn latest_frame(&self) -> Option<Arc<ReceivedFrame>> {
        Client::latest_frame(self)
    }

    fn note_shown(&mut self, frame: FrameId) {
        Client::note_shown(self, frame);
    }

    fn state(&self) -> State {
        Client::state(self)
    }

    fn stats(&self) -> LinkStats {
        Client::stats(self)
    }
}
