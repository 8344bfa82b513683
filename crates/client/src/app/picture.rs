//! The picture and what is drawn over it.

use std::sync::Arc;
use std::time::Duration;

use egui::PointerButton;
use isinglass_core::camera::Intrinsics;
use isinglass_core::wire::Welcome;
use isinglass_net::ReceivedFrame;

use super::{ViewerApp, is_free};
use crate::paint::clip_editor;
use crate::paint::legend::Legend;
use crate::paint::novel_view::Shown;
use crate::paint::picture::PicturePaint;
use crate::paint::stereo::Stereo;
use crate::paint::view_aids::{self, ViewAids, pixel_at};
use crate::panels::style;
use crate::panels::text::format_in;
use crate::view::frame_source::FrameSource;
use crate::view::pick::visible_point;
use crate::view::viewing::{Refresh, Standing};

impl<S: FrameSource> ViewerApp<S> {
    /// Paints the ray cast, or the newest picture of another method.
    pub(super) fn paint(
        &mut self,
        ui: &egui::Ui,
        rect: egui::Rect,
        refresh: &Refresh,
        frame: Arc<ReceivedFrame>,
    ) {
        let (camera, bounds, clip) = (refresh.camera, refresh.bounds, refresh.clip);
        let is_parallel =
            [&camera, &frame.frame.header.camera].map(|c| c.intrinsics.projection.is_orthographic());
        let other = match is_parallel {
            [false, false] => {
                self.novel_views.show(ui.ctx(), &frame, &bounds, &camera, self.aids.linear_background())
            }
            _ if self.novel_views.selected == 0 => None,
            _ => Some(Shown::Problem("this method goes between perspective views only".into())),
        };
        match other {
            Some(Shown::Picture(texture)) => {
                let whole = egui::Rect::from_min_max(egui::Pos2::ZERO, egui::pos2(1.0, 1.0));
                ui.painter().image(texture, rect, whole, egui::Color32::WHITE);
                self.method_problem = None;
                return;
            }
            Some(Shown::Problem(problem)) => self.method_problem = Some(problem),
            None if self.novel_views.selected == 0 => self.method_problem = None,
            None => {}
        }
        let stereo = self.stereo();
        let quality = self.quality.quality(refresh.standing == Standing::Moving);
        // The server's own picture lacks nothing, even if the eye is inside and sees nothing nearer than the near
        // plane.
        let keeps = quality.keeps && refresh.standing != Standing::Exact;
        let kept = if keeps { refresh.kept.clone() } else { Vec::new() };
        let background = self.aids.linear_background();
        ui.painter().add(
            PicturePaint { rect, frame, kept, camera, bounds, clip, stereo, quality, background }.shape(),
        );
    }

    /// Stereo of the picture; only the ray cast has two eyes.
    pub(super) fn stereo(&self) -> Stereo {
        if self.novel_views.selected == 0 { self.stereo } else { Stereo::default() }
    }

    /// A double click makes the visible point under it the centre of rotation.
    pub(super) fn choose_center(
        &mut self,
        ctx: &egui::Context,
        now: Duration,
        rect: egui::Rect,
        refresh: &Refresh,
    ) {
        let is_double = ctx.input(|i| i.pointer.button_double_clicked(PointerButton::Primary));
        let at = ctx.pointer_interact_pos().filter(|at| is_double && is_free(ctx, rect, *at));
        let (Some(at), Some(frame)) = (at, &refresh.frame) else { return };
        let is_cube = self.aids.shows_axes && self.cube_rect().contains(at);
        if !self.stereo().is_mono() || self.clip_editor.is_busy() || is_cube || self.is_measuring() {
            return;
        }
        let region = refresh.clip.region(&refresh.bounds);
        let pixel = pixel_at(rect, &refresh.camera, at);
        if let Some(point) = visible_point(&frame.frame, &region, &refresh.camera, pixel)
            && let Some((_, controls)) = &mut self.controls
            && match self.is_orthographic {
                true => controls.set_center_of_parallel(point),
                false => controls.set_center(point),
            }
        {
            self.slices.point = point;
            self.center_chosen_at = Some(now);
        }
    }

    pub(super) fn paint_aids(
        &mut self,
        ui: &egui::Ui,
        now: Duration,
        rect: egui::Rect,
        refresh: &Refresh,
        picture: &Intrinsics,
    ) {
        let (Some((_, controls)), Some(description)) = (&self.controls, self.viewing.source().description())
        else {
            return;
        };
        // Lines over the picture are drawn for one eye only.
        if !self.stereo().is_mono() {
            return;
        }
        let orientation = self.orientation();
        let mut scene = view_aids::AidsScene {
            rect,
            camera: &refresh.camera,
            bounds: &refresh.bounds,
            orientation: &orientation,
            unit: description.volume.unit.as_deref(),
            center: controls.center(),
            shows_center: self.marks_center(now),
            lift: self.parts_bar.height_over(view_aids::CORNER.x),
            marked: None,
        };
        self.paint_planes(ui, rect, refresh);
        scene.marked = self.marked_part(ui.ctx(), &scene);
        self.aids.paint(ui.painter(), &scene);
        let view = clip_editor::ClipView { rect, camera: refresh.camera, bounds: refresh.bounds };
        self.clip_editor.paint(&self.aids.pen(ui.painter()), &view, &refresh.clip);
        if self.aids.shows_axes {
            let words = ViewAids::axes_in_words(&scene);
            let part = self.cube_control(ui, &scene, &words, scene.marked);
            if let Some(part) = part {
                self.turn_to_part(now, picture, part);
                ui.ctx().request_repaint();
            }
        }
        if self.aids.shows_legend {
            self.paint_legend(ui, rect, &description);
        }
    }

    fn paint_legend(&self, ui: &egui::Ui, rect: egui::Rect, description: &Welcome) {
        let (Some(look), Some(bar)) = (self.viewing.look(), Legend::rect(rect)) else { return };
        let Some(scale) = self.value_scale() else { return };
        let domain = scale.domain(&look.chosen_transfer().domain);
        let legend = Legend {
            transfer: look.chosen_transfer(),
            domain,
            unit: description.volume.value_unit.as_deref(),
            mode: look.mode,
            format: &|value| format_in(value, domain.1 - domain.0),
        };
        legend.paint(&self.aids.pen(ui.painter()), bar);
        style::image(ui, bar, "legend", &legend.in_words());
    }

    pub(super) fn marks_center(&self, now: Duration) -> bool {
        self.center_chosen_at.is_some_and(|at| now < at + CENTER_TIME)
    }
}

/// Makes the picture a control that Tab reaches, with a name, and a frame while it has the keyboard.
pub(super) fn picture_widget(ui: &egui::Ui, rect: egui::Rect, name: &str) -> egui::Response {
    let response = ui.interact(rect, picture_id(), egui::Sense::click());
    response.widget_info(|| egui::WidgetInfo::labeled(egui::Role::Image, true, name));
    if response.has_focus() {
        // Arrows move the camera and do not leave the picture.
        let filter =
            egui::EventFilter { horizontal_arrows: true, vertical_arrows: true, ..Default::default() };
        ui.memory_mut(|m| m.set_focus_lock_filter(response.id, filter));
        let stroke = egui::Stroke::new(2.0, ui.visuals().selection.stroke.color);
        ui.painter().rect_stroke(rect, 0.0, stroke, egui::StrokeKind::Inside);
    }
    response
}

pub(super) fn picture_id() -> egui::Id {
    egui::Id::unique("picture")
}

/// A chosen centre of rotation is marked for this long.
pub(super) const CENTER_TIME: Duration = Duration::from_millis(1500);
