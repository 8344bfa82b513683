//! Recording the way of the camera in the window, for a movie of it.

use std::sync::Arc;
use std::time::Duration;

use egui::{Align2, RichText};
use isinglass_core::camera::Pose;
use isinglass_core::space::Aabb;
use lucide_icons::Icon;

use super::ViewerApp;
use crate::input::bindings::Action;
use crate::input::camera_path::CameraPath;
use crate::panels::screenshots::LONGEST_PATH;
use crate::panels::style::{accent, icon, pane_at};
use crate::view::frame_source::FrameSource;

/// A recording in progress.
pub(super) struct Recording {
    path: CameraPath,
    begun_at: Duration,
}

impl<S: FrameSource> ViewerApp<S> {
    /// Begins to record, or ends it and asks for the movie.
    pub(super) fn toggle_recording(&mut self, now: Duration) {
        let Some(recording) = self.recording.take() else {
            self.recording = Some(Recording { path: CameraPath::default(), begun_at: now });
            return;
        };
        match recording.path.without_rests() {
            Some(path) => self.screenshots.offer_path(Arc::new(path)),
            None => self.tell(now, "Nothing was recorded: the camera did not move"),
        }
    }

    /// Notes where the camera is. The longest path ends by itself.
    pub(super) fn record(&mut self, now: Duration, pose: &Pose, bounds: &Aabb) {
        let Some(recording) = &mut self.recording else { return };
        recording.path.record(now, pose, bounds);
        if now >= recording.begun_at + LONGEST_PATH {
            self.toggle_recording(now);
        }
    }

    /// Says that the way is recorded, with a button to end it.
    pub(super) fn show_recording(&mut self, ctx: &egui::Context, now: Duration) {
        let Some(recording) = &self.recording else { return };
        let seconds = now.saturating_sub(recording.begun_at).as_secs();
        let place = (Align2::CENTER_TOP, [0.0, RECORDING_TOP]);
        let is_ended = pane_at(ctx, "recording", self.room_at_top(), place, |ui| {
            let row = |ui: &mut egui::Ui| {
                ui.label(icon(Icon::Video).color(accent(ctx)));
                ui.label(RichText::new(format!("recording, {seconds} s")));
                let end = self.options.bindings.with_key("end the recording", Action::RecordPath);
                ui.button("Stop").on_hover_text(end).clicked()
            };
            ui.horizontal(row).inner
        });
        if is_ended.inner {
            self.chosen_actions.push(Action::RecordPath);
            ctx.request_repaint();
        }
        ctx.request_repaint_after(CLOCK_PERIOD);
    }
}

/// Below other panes at the top, points.
const RECORDING_TOP: f32 = 90.0;
const CLOCK_PERIOD: Duration = Duration::from_millis(250);
