//! A viewer's screenshots: one at a time, made between everyone's frames.

use std::sync::Arc;

use isinglass_core::camera::Camera;
use isinglass_core::look::Look;
use isinglass_core::picture::linear_from_srgb;
use isinglass_core::session::admission::ViewerId;
use isinglass_core::volume::Lighting;
use isinglass_core::wire::ScreenshotRequest;
use isinglass_formats::png;
use isinglass_net::server::{Control, FrameSender};
use tokio::task::JoinHandle;
use tracing::Instrument;

use crate::generator::Generator;
use crate::selection::Present;

/// One viewer's screenshots. A new request or the viewer's leaving cancels the one in progress.
pub(crate) struct Screenshots {
    viewer: ViewerId,
    generator: Generator,
    frames: FrameSender,
    control: Control,
    running: Option<JoinHandle<()>>,
}

impl Screenshots {
    pub(crate) fn new(viewer: ViewerId, generator: Generator, frames: FrameSender, control: Control) -> Self {
        Self { viewer, generator, frames, control, running: None }
    }

    /// Cancels the picture in progress and makes the requested one, if any.
    pub(crate) fn set(&mut self, shot: Option<ScreenshotRequest>, look: &Look, present: &Arc<Present>) {
        self.give_up();
        let Some(shot) = shot else { return };
        let (generator, look, present) = (self.generator.clone(), look.clone(), present.clone());
        let (frames, control) = (self.frames.clone(), self.control.clone());
        let (id, viewer) = (shot.id, self.viewer);
        let work = async move {
            match make(viewer, &generator, &shot, &look, &present).await {
                // If the viewer has left, nobody waits for it.
                Ok(png) => drop(frames.send_screenshot(id, &png).await),
                Err(why) => {
                    tracing::warn!("no picture: {why}");
                    control.talk().screenshot.handle_failed(id, &why);
                }
            }
        };
        self.running = Some(tokio::spawn(work.instrument(tracing::debug_span!("picture", id = id.0))));
    }

    fn give_up(&mut self) {
        if let Some(running) = self.running.take() {
            running.abort();
        }
    }
}

impl Drop for Screenshots {
    fn drop(&mut self) {
        self.give_up();
    }
}

/// The picture as a PNG file, or one line that says why there is none.
async fn make(
    viewer: ViewerId,
    generator: &Generator,
    shot: &ScreenshotRequest,
    look: &Look,
    present: &Present,
) -> Result<Vec<u8>, String> {
    let view = shot.view().map_err(|e| e.to_string())?;
    let camera = Camera::new(view.pose, view.intrinsics, &present.bounds);
    let linear = |rgb: [u8; 3]| rgb.map(|c| linear_from_srgb(f32::from(c) / 255.0));
    let background = shot.background.map(linear);
    // Light for a look of its own would push out the light that other viewers share.
    let own = shot.look.as_deref().map(|look| Look { lighting: Lighting::default(), ..look.clone() });
    let look = own.as_ref().unwrap_or(look);
    // Small pictures of other looks show the coarsest level.
    let pages = present.pager.as_ref().filter(|_| own.is_none()).and_then(|pager| pager.shown(viewer));
    let of = (&present.lights, pages);
    let made = generator.picture(viewer, present.scene, look, of, camera, background).await;
    let rgb = made.ok_or("the server has stopped rendering")?.map_err(|e| e.to_string())?;
    let [width, height] = [view.intrinsics.width, view.intrinsics.height];
    let encoded = tokio::task::spawn_blocking(move || png::encode(width, height, &rgb));
    encoded.await.map_err(|e| e.to_string())?.map_err(|e| e.to_string())
}
