//! Measuring in the window: events of points, the bar, and the values along a line.

use std::sync::Arc;
use std::time::Duration;

use egui::Panel;
use isinglass_core::clip::Region;
use isinglass_formats::MAX_MEASURES;
use isinglass_net::ReceivedFrame;

use super::{ViewerApp, is_free};
use crate::input::bindings::Action;
use crate::paint::clip_editor::ClipView;
use crate::paint::measure::Ground;
use crate::paint::view_aids::pixel_at;
use crate::panels::slices::PaneView;
use crate::panels::style::bar;
use crate::panels::{measure, slices};
use crate::view::frame_source::FrameSource;
use crate::view::pick::visible_point;
use crate::view::viewing::Refresh;
use crate::view::waker_of;

/// What the refresh before showed, which the person points at.
pub(crate) struct SeenPicture {
    view: ClipView,
    region: Region,
    frame: Arc<ReceivedFrame>,
}

impl SeenPicture {
    pub(super) fn of(rect: egui::Rect, refresh: &Refresh) -> Option<Self> {
        Some(Self {
            view: ClipView { rect, camera: refresh.camera, bounds: refresh.bounds },
            region: refresh.clip.region(&refresh.bounds),
            frame: refresh.frame.clone()?,
        })
    }
}

impl<S: FrameSource> ViewerApp<S> {
    /// Gives points of measurements their events before the camera gets the rest.
    pub(super) fn drag_measures(
        &mut self,
        ctx: &egui::Context,
        now: Duration,
        events: &mut Vec<egui::Event>,
    ) {
        let Some(SeenPicture { view, region, frame }) = &self.seen_picture else { return };
        let cube = (self.aids.shows_axes).then(|| self.cube_rect());
        let room = self.room;
        let pick = |at| {
            let pixel = pixel_at(view.rect, &view.camera, at);
            visible_point(&frame.frame, region, &view.camera, pixel)
        };
        let free = move |at| is_free(ctx, room, at) && cube.is_none_or(|cube| !cube.contains(at));
        let panes: Vec<PaneView> = self.slices.views().collect();
        let mut grounds = vec![Ground { canvas: view, pick: Box::new(pick), is_free: Box::new(free) }];
        grounds.extend(panes.iter().map(|pane| Ground {
            canvas: pane,
            pick: Box::new(|at| pane.pick(at)),
            is_free: Box::new(|at| pane.is_free(at) && is_free(ctx, pane.rect, at)),
        }));
        let is_changed = self.measures.take_events(events, &grounds);
        drop(grounds);
        if is_changed {
            ctx.request_repaint();
        }
        if self.measures.take_refusal() {
            self.tell(now, format!("At most {MAX_MEASURES} measurements"));
        }
        if self.measures.is_busy() {
            ctx.set_cursor_icon(egui::CursorIcon::Grab);
        }
    }

    /// Draws the measurements, and asks for the values along the shown line.
    pub(super) fn show_measures(&mut self, ui: &egui::Ui, rect: egui::Rect, refresh: &Refresh) {
        if !self.measures.is_on || !self.stereo().is_mono() {
            return;
        }
        let Some(description) = self.viewing.source().description() else { return };
        let view = ClipView { rect, camera: refresh.camera, bounds: refresh.bounds };
        let pen = self.aids.pen(ui.painter());
        let scale = measure::scale(&description.volume);
        self.measures.paint(&pen, &view, &scale);
        for pane in self.slices.views() {
            // A part of the picture's painter would end at the picture.
            let mut painter = ui.painter().clone();
            painter.set_clip_rect(pane.rect);
            self.measures.paint(&slices::pen(&painter), &pane, &scale);
        }
        let answer = self.viewing.source().talk().profile.answer().cloned();
        self.measure_bar.note_answer(answer.as_ref());
        if let Some(wanted) = self.measure_bar.wanted(self.measures.measures(), &description) {
            let id = self.viewing.source().talk().profile.ask(wanted.ends(), wanted.num_points);
            self.measure_bar.note_asked(&wanted, id);
        }
    }

    /// Shows the bar of the measurements at the bottom of `ui`.
    pub(super) fn show_measure_bar(&mut self, ui: &mut egui::Ui) {
        let description = self.viewing.source().description();
        let Some(description) = description.filter(|_| self.measures.is_on && self.stereo().is_mono()) else {
            return;
        };
        let ctx = ui.ctx().clone();
        let bar = Panel::bottom("measure bar").frame(bar(&ctx)).exact_size(self.measure_bar.height());
        let (bindings, wake) = (&self.options.bindings, waker_of(&ctx));
        let is_closed = bar.show(ui, |ui| {
            self.measure_bar.show(ui, &mut self.measures, &description.volume, bindings, &wake)
        });
        if is_closed.inner {
            self.chosen_actions.push(Action::Measure);
        }
    }

    /// A click in the picture means a point, not the centre of rotation.
    pub(super) fn is_measuring(&self) -> bool {
        self.measures.is_on
    }

    #[cfg(test)]
    pub(super) fn told(&self) -> Vec<String> {
        let Some(description) = self.viewing.source().description() else { return Vec::new() };
        let scale = measure::scale(&description.volume);
        self.measures.measures().iter().map(|m| scale.told(m)).collect()
    }

    /// Switches measuring on or off.
    pub(super) fn toggle_measures(&mut self, now: Duration) {
        self.measures.toggle();
        if self.measures.is_on && !self.stereo().is_mono() {
            self.tell(now, "Measuring needs a picture for one eye: switch stereo off");
        }
    }
}
