//! Views by choice: sides, fit, the cube in the corner, views with a name, and the way back.

use std::time::Duration;

use isinglass_core::camera::{Camera, Intrinsics, Projection};
use isinglass_core::ids::PoseId;
use isinglass_formats::{MAX_VIEWS, NamedView, UpAxis};
use isinglass_net::ReceivedFrame;

use super::{ViewerApp, is_free};
use crate::input::camera_controls::CameraControls;
use crate::input::camera_moves::Viewpoint;
use crate::paint::view_aids::{self, AidsScene};
use crate::paint::view_cube::{self, CubePart, direction_of};
use crate::panels::style::named;
use crate::panels::toolbar::NamedViewWish;
use crate::view::frame_source::FrameSource;

impl<S: FrameSource> ViewerApp<S> {
    /// Turns the camera to where `change` takes it.
    pub(super) fn turn_camera(
        &mut self,
        now: Duration,
        picture: &Intrinsics,
        change: impl FnOnce(&mut CameraControls),
    ) {
        let Some((_, mut controls)) = self.controls(picture).cloned() else { return };
        let from = Viewpoint::of(&controls, self.is_orthographic);
        change(&mut controls);
        self.moves.turn(now, from, Viewpoint::of(&controls, self.is_orthographic));
    }

    /// Turns back to the view before the newest gesture, or on to the one after.
    pub(super) fn step_view(&mut self, now: Duration, picture: &Intrinsics, is_back: bool) {
        let is_orthographic = self.is_orthographic;
        let Some((_, controls)) = self.controls(picture) else { return };
        let from = Viewpoint::of(controls, is_orthographic);
        if let Some(to) = self.moves.step(now, from, is_back) {
            self.is_orthographic = to.is_orthographic;
        }
    }

    /// Brings all of the volume, or of what a clip box leaves, into the picture.
    pub(super) fn fit(&mut self, now: Duration, picture: &Intrinsics) {
        let Some((bounds, _)) = &self.controls else { return };
        let clip = self.viewing.look().and_then(|look| look.clip.bounds);
        let bounds = clip.unwrap_or(*bounds);
        let is_parallel = self.is_orthographic;
        self.turn_camera(now, picture, |controls| controls.fit(&bounds, picture, is_parallel));
    }

    /// Turns another axis upwards, and the camera with it.
    pub(super) fn turn_up(&mut self, now: Duration, axis: UpAxis) {
        self.set_up_axis(axis);
        let orientation = self.orientation();
        let Some(window) = self.window else { return };
        self.turn_camera(now, &window, |controls| {
            let from = -controls.pose().forward();
            controls.roll_upright(orientation.up_from(from));
        });
    }

    pub(super) fn set_up_axis(&mut self, axis: UpAxis) {
        self.up_axis = axis;
        let upright = self.orientation().world_from_upright();
        if let Some((_, controls)) = &mut self.controls {
            controls.set_upright(upright);
        }
    }

    pub(super) fn do_named_view(&mut self, now: Duration, wish: NamedViewWish) {
        match wish {
            NamedViewWish::Remember(name) => {
                let Some((_, controls)) = &self.controls else { return };
                let (rotation, eye) = controls.placement();
                let view = NamedView {
                    name,
                    center: controls.center().to_array(),
                    rotation: rotation.to_array(),
                    eye_from_center: eye.to_array(),
                    orthographic: self.is_orthographic,
                };
                // A name stands for one view.
                self.named_views.retain(|other| other.name != view.name);
                if self.named_views.len() < MAX_VIEWS {
                    self.tell(now, format!("The view {} is in the menu Views", view.name));
                    self.named_views.push(view);
                }
            }
            NamedViewWish::Remove(number) if number < self.named_views.len() => {
                self.named_views.remove(number);
            }
            NamedViewWish::Show(number) => {
                let Some(view) = self.named_views.get(number).cloned() else { return };
                let Some((_, controls)) = &self.controls else { return };
                let from = Viewpoint::of(controls, self.is_orthographic);
                let (center, world_from_view, eye_from_center) = view.viewpoint();
                let is_orthographic = view.orthographic;
                let to = Viewpoint { center, world_from_view, eye_from_center, is_orthographic };
                if to.place(&mut controls.clone()) {
                    self.is_orthographic = is_orthographic;
                    self.moves.turn(now, from, to);
                } else {
                    self.tell(now, "That view is too near to this volume or too far away");
                }
            }
            NamedViewWish::Remove(_) => {}
        }
    }

    /// Goes to the camera of the person to follow, once a frame shows it.
    pub(super) fn join_leader(&mut self, now: Duration, frame: Option<&ReceivedFrame>) {
        // A frame of a leader answers no pose of this viewer.
        let Some(frame) = frame.filter(|f| self.joins_leader && f.frame.header.pose == PoseId(0)) else {
            return;
        };
        let (Some((_, controls)), Some(window)) = (&self.controls, self.window) else { return };
        self.joins_leader = false;
        let Camera { pose, intrinsics, .. } = frame.frame.header.camera;
        let center = controls.center();
        let is_orthographic = intrinsics.projection.is_orthographic();
        let from = Viewpoint::of(controls, self.is_orthographic);
        let world_from_view = pose.world_from_view;
        let mut eye_from_center = world_from_view.inverse() * (pose.eye - center);
        if let Projection::Orthographic { height } = intrinsics.projection {
            // Such an eye lies before the volume. Its height is what perspective shows at the centre's depth.
            eye_from_center.z = 0.5 * height / window.half_size_at(1.0).1;
        }
        let to = Viewpoint { center, world_from_view, eye_from_center, is_orthographic };
        if to.place(&mut controls.clone()) {
            self.is_orthographic = is_orthographic;
            self.moves.turn(now, from, to);
        }
    }

    /// The part of the cube under the pointer.
    pub(super) fn marked_part(&self, ctx: &egui::Context, scene: &AidsScene<'_>) -> Option<CubePart> {
        let at = ctx.pointer_latest_pos().filter(|at| is_free(ctx, self.room, *at))?;
        let is_dragging = ctx.input(|i| i.pointer.is_decidedly_dragging());
        if is_dragging { None } else { self.aids.cube(scene).part_at(at) }
    }

    /// Makes the cube a control. Enter turns to the nearest side.
    pub(super) fn cube_control(
        &self,
        ui: &egui::Ui,
        scene: &AidsScene<'_>,
        words: &str,
        marked: Option<CubePart>,
    ) -> Option<CubePart> {
        let cube = self.aids.cube(scene);
        let response = ui.interact(cube.rect(), egui::Id::unique("axes"), egui::Sense::click());
        named(&response, egui::Role::Button, words);
        if response.has_focus() {
            let stroke = egui::Stroke::new(2.0, ui.visuals().selection.stroke.color);
            ui.painter().rect_stroke(cube.rect(), 4.0, stroke, egui::StrokeKind::Inside);
        }
        let is_by_pointer = ui.input(|i| i.pointer.any_released());
        let part = if is_by_pointer { marked } else { Some(cube.nearest_side()) };
        let chosen = if response.clicked() { part } else { None };
        if let Some(part) = marked {
            response.on_hover_text(format!("view from {}", cube.name(part)));
        }
        chosen
    }

    /// Where the cube is.
    pub(super) fn cube_rect(&self) -> egui::Rect {
        let lift = self.parts_bar.height_over(view_aids::CORNER.x);
        let size = egui::Vec2::splat(2.0 * view_cube::RADIUS);
        egui::Rect::from_center_size(view_aids::cube_center(self.room, lift), size)
    }

    /// Turns to a part of the cube.
    pub(super) fn turn_to_part(&mut self, now: Duration, picture: &Intrinsics, part: CubePart) {
        let from = direction_of(part);
        let up = self.orientation().up_from(from);
        self.turn_camera(now, picture, |controls| controls.look_from(from, up));
    }
}
