//! The viewer's door to the frames: what it asks of whoever brings them. The network client is one; tests have others.

use std::sync::Arc;

use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::ids::{FrameId, LookVersion};
use isinglass_core::look::Look;
use isinglass_core::wire::{ClientStats, Welcome};
use isinglass_net::{Client, LinkStats, ReceivedFrame, State};

/// Brings layered frames. No call waits for anything: the viewer polls it at every refresh.
pub trait FrameSource {
    /// Asks for a frame from `pose`; the newest wish wins.
    fn set_pose(&mut self, pose: Pose, intrinsics: Intrinsics);

    /// The newest frame that can be shown. The same `Arc` as long as nothing has changed.
    fn latest_frame(&self) -> Option<Arc<ReceivedFrame>>;

    /// Where the connection stands.
    fn state(&self) -> State;

    /// What the connection costs.
    fn stats(&self) -> LinkStats;

    /// What the server said of the volume, once it did.
    fn description(&self) -> Option<Arc<Welcome>>;

    /// The look that the server renders with now, once known.
    fn look(&self) -> Option<(LookVersion, Arc<Look>)>;

    /// Asks for another look. One that cannot be used is ignored.
    fn set_look(&mut self, look: Look);

    /// A line that the server wants shown; taken when it is asked for.
    fn take_notice(&mut self) -> Option<String>;

    /// A frame was on the screen, for the ledger.
    fn note_shown(&mut self, frame: FrameId);

    /// How the viewer fares, for the server.
    fn report(&mut self, stats: ClientStats);
}

impl FrameSource for Client {
    fn set_pose(&mut self, pose: Pose, intrinsics: Intrinsics) {
        Client::set_pose(self, pose, intrinsics);
    }

    fn latest_frame(&self) -> Option<Arc<ReceivedFrame>> {
        Client::latest_frame(self)
    }

    fn state(&self) -> State {
        Client::state(self)
    }

    fn stats(&self) -> LinkStats {
        Client::stats(self)
    }

    fn description(&self) -> Option<Arc<Welcome>> {
        Client::description(self)
    }

    fn look(&self) -> Option<(LookVersion, Arc<Look>)> {
        Client::look(self)
    }

    fn set_look(&mut self, look: Look) {
        if let Err(e) = Client::set_look(self, look) {
            tracing::warn!("look not sent: {e}");
        }
    }

    fn take_notice(&mut self) -> Option<String> {
        Client::take_notice(self)
    }

    fn note_shown(&mut self, frame: FrameId) {
        Client::note_shown(self, frame);
    }

    fn report(&mut self, stats: ClientStats) {
        Client::report(self, stats);
    }
}
