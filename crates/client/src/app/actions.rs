//! What keys do to the window, and what dragged clip handles do.

use std::time::Duration;

use isinglass_core::camera::Intrinsics;
use isinglass_core::clip::Clip;
use isinglass_core::look::Look;

use super::picture::picture_id;
use super::{AppWish, ViewerApp, is_free};
use crate::input::bindings::{Action, Focus, Step};
use crate::input::camera_controls::{ControlInput, ZOOM_PER_NOTCH};
use crate::paint::stereo;
use crate::panels::state_files::StateWish;
use crate::view::frame_source::FrameSource;

impl<S: FrameSource> ViewerApp<S> {
    /// Does what keys and buttons say, and returns their movement of the camera.
    pub(super) fn keys(&mut self, ctx: &egui::Context, now: Duration, picture: &Intrinsics) -> ControlInput {
        let focus = match ctx.memory(|m| m.focused()) {
            _ if ctx.text_edit_focused() => Focus::Text,
            // Letters find files in its list.
            Some(_) if self.open_dialog.is_open() => Focus::Text,
            Some(id) if id != picture_id() => Focus::Widget,
            _ => Focus::Picture,
        };
        let mut actions = std::mem::take(&mut self.chosen_actions);
        actions.extend(ctx.input_mut(|i| self.options.bindings.take_actions(&mut i.events, focus)));
        let mut input = ControlInput::default();
        for action in actions {
            match action {
                Action::FirstView => self.turn_camera(now, picture, |controls| controls.reset(picture)),
                Action::Fit => self.fit(now, picture),
                Action::PreviousView => self.step_view(now, picture, true),
                Action::NextView => self.step_view(now, picture, false),
                Action::Step(step) => add_step(&mut input, step, picture),
                Action::StandardView(side, opposite) => {
                    let (from, up) = self.orientation().standard_view(side, opposite);
                    self.turn_camera(now, picture, |controls| controls.look_from(from, up));
                }
                Action::Isometric => {
                    let (from, up) = self.orientation().isometric_view();
                    self.turn_camera(now, picture, |controls| controls.look_from(from, up));
                }
                Action::Numbers => self.shows_numbers = !self.shows_numbers,
                Action::FullScreen => {
                    self.shows_bars = !self.shows_bars;
                    ctx.send_viewport_cmd(egui::ViewportCommand::Fullscreen(!self.shows_bars));
                    ctx.request_repaint();
                }
                Action::LookPanel => {
                    self.is_look_open = !self.is_look_open;
                    self.gallery.retry();
                }
                Action::Legend => self.aids.shows_legend = !self.aids.shows_legend,
                Action::Box => self.aids.shows_box = !self.aids.shows_box,
                Action::Clip => self.toggle_clip(now),
                Action::Slices => self.set_slices_on(!self.slices.is_on()),
                Action::Projection => self.is_orthographic = !self.is_orthographic,
                Action::Axes => self.aids.shows_axes = !self.aids.shows_axes,
                Action::Stereo => self.stereo.mode = stereo::next(self.stereo.mode),
                Action::Probe => self.probe.toggle(),
                Action::Measure => self.toggle_measures(now),
                Action::Picture => self.wants_picture = true,
                Action::PictureDialog => self.screenshots.toggle_dialog(),
                Action::RecordPath => self.toggle_recording(now),
                Action::Mode => self.next_modes += 1,
                Action::Undo | Action::Redo => {
                    let Some(scale) = self.value_scale() else { continue };
                    match action {
                        Action::Undo => self.editor.undo(&scale),
                        _ => self.editor.redo(&scale),
                    }
                }
                Action::Start => self.wish = Some(AppWish::StartPage),
                Action::StepTime(by) => {
                    let (parts, load) = self.parts_and_load();
                    let wish = parts.and_then(|parts| self.parts_bar.step(&parts, load.as_ref(), by));
                    self.do_part(now, wish);
                }
                Action::Play => self.toggle_play(now),
                Action::SaveState => self.do_state(ctx, now, StateWish::Save),
                Action::OpenFile if self.opens_volumes => self.wish = Some(AppWish::ChooseFile),
                Action::OpenFile => self.open_dialog.open(ctx),
                Action::CopyLink => self.do_state(ctx, now, StateWish::CopyLink),
                Action::Help => self.shows_help = !self.shows_help,
                Action::CloseHelp => {
                    self.shows_help = false;
                    self.measures.give_up();
                    if !egui::Popup::is_any_open(ctx) {
                        self.screenshots.close_dialog();
                    }
                }
                Action::Quit => ctx.send_viewport_cmd(egui::ViewportCommand::Close),
            }
        }
        input
    }

    pub(super) fn drop_empty_clip(&mut self, now: Duration) {
        let (Some(look), Some((bounds, _))) = (self.viewing.look(), &self.controls) else { return };
        if self.clip_bounds.replace(*bounds) != Some(*bounds) && look.clip.region(bounds).is_empty() {
            self.set_clip(now, Clip::default());
        }
    }

    fn toggle_clip(&mut self, now: Duration) {
        let (Some(look), Some((bounds, _))) = (self.viewing.look(), &self.controls) else { return };
        let mut clip = look.clip;
        self.clip_editor.toggle(&mut clip, bounds);
        self.set_clip(now, clip);
    }

    fn set_clip(&mut self, now: Duration, clip: Clip) {
        if let Some(look) = self.viewing.look().filter(|look| look.clip != clip) {
            self.viewing.set_look(now, Look { clip, ..(*look).clone() });
        }
    }

    /// Gives the clip handles their events before the camera gets the rest.
    pub(super) fn drag_clip(&mut self, ctx: &egui::Context, now: Duration, events: &mut Vec<egui::Event>) {
        let (Some(view), Some(look)) = (self.clip_view, self.viewing.look()) else { return };
        if let Some(clip) =
            self.clip_editor.take_events(events, &view, &look.clip, |at| is_free(ctx, self.room, at))
        {
            self.set_clip(now, clip);
            ctx.request_repaint();
        }
        if self.clip_editor.is_busy() {
            ctx.set_cursor_icon(egui::CursorIcon::Grab);
        }
    }
}

/// A key moves the camera as a short drag would.
fn add_step(input: &mut ControlInput, step: Step, picture: &Intrinsics) {
    let side = picture.width.min(picture.height) as f32;
    let pixels = |parts: i8| f32::from(parts) * side * KEY_STEP;
    match step {
        Step::Turn(x, y) => input.orbit = [input.orbit[0] + pixels(x), input.orbit[1] + pixels(y)],
        Step::Pan(x, y) => input.pan = [input.pan[0] + pixels(x), input.pan[1] + pixels(y)],
        Step::Roll(parts) => input.roll += f32::from(parts) * KEY_STEP * std::f32::consts::PI,
        Step::Zoom(parts) => input.zoom += f32::from(parts) * ZOOM_PER_NOTCH,
    }
}

/// A key's step, as a share of the picture's shorter side: a turn by five degrees.
const KEY_STEP: f32 = 5.0 / 180.0;
