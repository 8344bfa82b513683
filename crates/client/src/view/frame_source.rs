//! The viewer's door to the frames: what it asks of whoever brings them. The network client is one; tests have others.

use std::sync::Arc;
use std::time::Duration;

use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::ids::FrameId;
use isinglass_core::session::ClientSession;
use isinglass_core::wire::Welcome;
use isinglass_net::{Client, LinkStats, ReceivedFrame, State, Talking};

/// Brings layered frames. No call waits for anything but a lock that is held for moments: the viewer polls it at every
/// refresh.
pub trait FrameSource {
    /// The conversation with the server: all that the viewer may ask for, and what it has heard.
    fn talk(&self) -> Talking<'_, ClientSession>;

    /// The newest frame that can be shown. The same `Arc` as long as nothing has changed.
    fn latest_frame(&self) -> Option<Arc<ReceivedFrame>>;

    /// A frame was on the screen, for the ledger.
    fn note_shown(&mut self, frame: FrameId);

    /// Where the connection stands.
    fn state(&self) -> State;

    /// What the connection costs.
    fn stats(&self) -> LinkStats;

    /// Asks for a frame from `pose`, set at `now`; the newest wins, and an unusable pose is ignored.
    fn set_pose(&mut self, now: Duration, pose: Pose, intrinsics: Intrinsics) {
        if let Err(e) = self.talk().pose.set(now.as_micros() as u64, pose, intrinsics) {
            tracing::warn!("pose ignored: {e}");
        }
    }

    /// What the server said of the volume, once it did.
    fn description(&self) -> Option<Arc<Welcome>> {
        self.talk().link.description()
    }

    /// Whether a frame is of the volume that is described, and not of the one before.
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
