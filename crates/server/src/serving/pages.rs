//! What one viewer's frames show of a volume that is read by pages.

use isinglass_core::layer::Fineness;
use isinglass_core::wire::PoseRequest;

use super::Viewer;
use crate::generator::Generated;

/// What is known of the pages of a viewer's newest frame. The pages themselves may be needed by nobody.
#[derive(Clone, Debug)]
pub(super) struct ShownPages {
    is_draft: bool,
    /// Changes with the pages in memory.
    version: u64,
    /// When it was made, µs.
    at: u64,
    /// How long that took, µs.
    took: u64,
}

impl Viewer {
    /// A frame was made of these pages.
    pub(super) fn note_pages(&mut self, now: u64, generated: &mut Generated) {
        // A frame on its way keeps no page in memory.
        let Some(pages) = generated.pages.take() else { return };
        let is_draft = pages.fineness() == Fineness::Draft;
        self.session.talk().pages.handle_progress(pages.part.progress);
        let (version, took) = (pages.part.version, generated.generate_micros);
        self.shown_pages = Some(ShownPages { is_draft, version, at: now, took });
    }

    /// When the present pose needs a frame of more pages, µs; `None` if nothing is new.
    pub(super) fn pages_due(&self, now: u64, request: &PoseRequest) -> Option<u64> {
        let ShownPages { version, at, took, .. } =
            self.shown_pages.as_ref().filter(|shown| shown.is_draft)?;
        if self.resting_pose != Some(request.id) {
            return Some(at + REST_MICROS);
        }
        let is_new = *self.page_changes.as_ref()?.borrow() != *version;
        // The last pages are shown at once.
        let viewer = self.session.viewer;
        let is_complete = || self.present.pager.as_ref().is_some_and(|pager| !pager.is_loading(viewer));
        // Frames leave time to reading.
        let period = PERIOD_MICROS.max(FRAME_TIMES * took);
        is_new.then(|| if is_complete() { now } else { at + period })
    }
}

/// A camera rests when no other pose has come for this time, µs.
const REST_MICROS: u64 = 150_000;
/// Least time between frames while pages come, µs.
const PERIOD_MICROS: u64 = 400_000;
/// The same in times that a frame takes.
const FRAME_TIMES: u64 = 4;
