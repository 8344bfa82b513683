//! Chooses the frame to show: the source of frames, the requests to the server, and how a displayed frame relates to
//! the camera. Nothing here draws.

use std::sync::Arc;

pub(crate) mod foresight;
pub(crate) mod frame_source;
pub(crate) mod headless;
pub(crate) mod kept;
pub(crate) mod local_servers;
pub(crate) mod pick;
pub(crate) mod planes;
pub(crate) mod quality_control;
pub(crate) mod refresh_meter;
pub(crate) mod remote_servers;
pub(crate) mod viewing;

/// The frames of a window that can switch between sources.
pub type BoxedSource = Box<dyn frame_source::FrameSource + Send>;

/// Wakes the window from any thread: something to show has arrived.
pub type Waker = Arc<dyn Fn() + Send + Sync>;

pub(crate) fn waker_of(ctx: &egui::Context) -> Waker {
    let ctx = ctx.clone();
    Arc::new(move || ctx.request_repaint())
}
