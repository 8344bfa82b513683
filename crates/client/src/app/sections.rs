//! Places the panels that ask for something: look, parts of the file, screenshots and the probe.

use std::time::Duration;

use egui::Vec2;
use isinglass_core::camera::{Camera, Intrinsics};
use isinglass_core::look::Look;
use isinglass_net::State;

use super::side_panel::{self, LookSettings};
use super::{AppWish, ViewerApp, is_free};
use crate::paint::view_aids::{self, pixel_at};
use crate::panels::browser::Chosen;
use crate::panels::parts_bar::PartsWish;
use crate::panels::screenshots::Subject;
use crate::panels::style::Taken;
use crate::panels::{light, mode, probe, status};
use crate::view::frame_source::FrameSource;
use crate::view::pick::visible_point;
use crate::view::viewing::Refresh;
use crate::view::waker_of;

impl<S: FrameSource> ViewerApp<S> {
    /// What the side panel takes of the window's right, points.
    pub(crate) fn right_width(&self) -> f32 {
        if self.is_look_open { side_panel::OPEN_WIDTH } else { 0.0 }
    }

    /// The same with the buttons beside it.
    pub(crate) fn right_width_at_top(&self) -> f32 {
        self.right_width().max(side_panel::FOLDED_WIDTH) + OPEN_BUTTON_WIDTH
    }

    /// The room taken at the top. Panes lie between the numbers and the buttons, or below these if there is too
    /// little room.
    pub(crate) fn taken_at_top(&self, ctx: &egui::Context) -> Taken {
        let right = self.right_width_at_top();
        let left = if self.shows_overlay { status::width_taken(ctx, right) } else { 0.0 };
        let between = Taken { left, right, edge: 0.0 };
        if between.width(ctx) >= LEAST_ROOM_AT_TOP {
            return between;
        }
        // The badge alone is no higher than the buttons.
        let left = if status::has_room_for_numbers(ctx, right) { left } else { 0.0 };
        Taken { left, right: self.right_width(), edge: BUTTONS_HEIGHT }
    }

    /// The room taken at the bottom. Panes lie beside axes and scale bar, or above them if there is too little room.
    pub(crate) fn taken_at_bottom(&self, ctx: &egui::Context) -> Taken {
        let corner = if self.aids.shows_axes { view_aids::CORNER } else { Vec2::ZERO };
        let (right, edge) = (self.right_width(), self.parts_bar.height());
        let beside = Taken { left: corner.x, right, edge };
        let lift = self.parts_bar.height_over(corner.x);
        match beside.width(ctx) >= LEAST_ROOM {
            true => beside,
            false => Taken { left: 0.0, right, edge: edge.max(lift + corner.y) },
        }
    }

    /// What a screenshot shows: the present view.
    fn subject(&self, camera: &Camera) -> Option<Subject> {
        let (bounds, controls) = self.controls.as_ref()?;
        // In stereo with half a window for each eye, a screenshot shows the view of one eye in the whole window.
        let camera = match self.window.filter(|_| !self.stereo().is_mono()) {
            Some(window) if self.is_orthographic => controls.parallel_camera(window, bounds),
            Some(window) => controls.camera(window, bounds),
            None => *camera,
        };
        Some(Subject {
            name: self.viewing.source().description()?.volume.name.clone(),
            pose: camera.pose,
            intrinsics: camera.intrinsics,
            background: self.aids.background,
            bounds: *bounds,
            center: controls.center(),
            up: self.orientation().up(),
        })
    }

    pub(super) fn show_screenshots(&mut self, ctx: &egui::Context, now: Duration, refresh: Option<&Refresh>) {
        let subject = refresh.and_then(|refresh| self.subject(&refresh.camera));
        let is_connected = self.viewing.source().state() == State::Connected;
        if std::mem::take(&mut self.wants_picture)
            && let Some(subject) = subject.clone()
        {
            match is_connected {
                true => self.screenshots.take(subject),
                false => {
                    self.tell(now, NO_SERVER_FOR_PICTURE);
                    ctx.request_repaint();
                }
            }
        }
        let taken = self.taken_at_top(ctx);
        let source = self.viewing.source_mut();
        let done = match source.state() {
            // No picture can come any more.
            State::Refused(_) => self.screenshots.end(source, ctx),
            _ => self.screenshots.poll(source, ctx),
        };
        if let Some(notice) = self.screenshots.show(ctx, subject, source, taken).or(done) {
            self.tell(now, notice);
            ctx.request_repaint();
        }
    }

    /// Requests the value under the pointer, and shows what is known of it.
    pub(super) fn show_probe(&mut self, ctx: &egui::Context, rect: egui::Rect, refresh: &Refresh) {
        // The probe must not cover a dialog.
        let has_dialog = self.shows_help || self.screenshots.is_dialog_open() || self.open_dialog.is_open();
        if !self.probe.is_on() || !self.stereo().is_mono() || has_dialog {
            return;
        }
        let at = ctx.pointer_latest_pos().filter(|at| rect.contains(*at) && is_free(ctx, *at));
        let point = at.zip(refresh.frame.as_ref()).and_then(|(at, frame)| {
            let pixel = pixel_at(rect, &refresh.camera, at);
            let region = refresh.clip.region(&refresh.bounds);
            visible_point(&frame.frame, &region, &refresh.camera, pixel)
        });
        self.probe.ask_of(self.viewing.source().description().as_ref());
        let source = self.viewing.source();
        if let Some(point) = self.probe.point_at(point) {
            source.talk().probe.ask(point.to_array());
        }
        let answer = source.talk().probe.answer();
        if let (Some(at), Some(point), Some(description)) = (at, point, source.description()) {
            probe::show(ctx, at, &probe::lines(point, answer.as_ref(), &description.volume));
        }
    }

    fn world_from_view(&self) -> glam::Quat {
        self.controls.as_ref().map_or(glam::Quat::IDENTITY, |(_, controls)| controls.pose().world_from_view)
    }

    pub(super) fn turn_light(&mut self, now: Duration, picture: &Intrinsics) {
        let (Some(drag), Some(look)) = (self.pointer.take_light_drag(), self.viewing.look()) else { return };
        let lighting = light::turned(look.lighting, drag, picture.height as f32, self.world_from_view());
        self.viewing.set_look(now, Look { lighting, ..(*look).clone() });
    }

    fn shown_settings(&self) -> impl PartialEq + use<S> {
        (self.novel_views.selected, self.viewing.frame_size, self.stereo, self.aids, self.is_orthographic)
    }

    pub(super) fn show_look_panel(&mut self, ctx: &egui::Context, now: Duration) {
        let (Some(look), Some(scale)) = (self.viewing.look(), self.value_scale()) else { return };
        self.editor.follow(&look.transfer, &scale);
        let Some((bounds, forward)) = self.controls.as_ref().map(|(b, c)| (*b, c.pose().forward())) else {
            return;
        };
        let world_from_view = self.world_from_view();
        let unit = self.viewing.source().description().and_then(|d| d.volume.unit.clone());
        let before = self.shown_settings();
        let mut settings = LookSettings {
            look: (*look).clone(),
            frame_size: &mut self.viewing.frame_size,
            methods: &self.novel_views.names,
            method: &mut self.novel_views.selected,
            stereo: &mut self.stereo,
            aids: &mut self.aids,
            is_orthographic: &mut self.is_orthographic,
            clip_editor: &mut self.clip_editor,
            bounds,
            unit: unit.as_deref(),
            forward,
            bindings: &self.options.bindings,
            world_from_view,
        };
        let files = &mut self.state_files;
        let wish =
            side_panel::show(ctx, &mut self.is_look_open, &mut self.editor, &scale, &mut settings, files);
        let mut wanted = settings.look;
        if self.shown_settings() != before {
            // The picture beneath is drawn already.
            ctx.request_repaint();
        }
        let edit = self.editor.take_edit(ctx);
        if let Some(transfer) = edit.transfer {
            wanted.transfer = transfer;
        }
        wanted.shaded = edit.shaded.unwrap_or(wanted.shaded);
        for _ in 0..std::mem::take(&mut self.next_modes) {
            let next = wanted.mode.next();
            mode::set_mode(&mut wanted, next, &scale);
            self.tell(now, mode::text(next));
        }
        if wanted != *look {
            self.viewing.set_look(now, wanted);
            // The picture has to be labelled as older.
            ctx.request_repaint();
        }
        if let Some(wish) = wish {
            self.do_state(ctx, now, wish);
        }
    }

    pub(super) fn show_open_dialog(&mut self, ctx: &egui::Context) {
        match self.open_dialog.show(ctx) {
            Some(Chosen::Volume(request)) => self.wish = Some(AppWish::Volume(request)),
            Some(Chosen::Text(path)) => self.state_files.open_any(path, &waker_of(ctx)),
            None => return,
        }
        ctx.request_repaint();
    }

    pub(super) fn show_parts(&mut self, ctx: &egui::Context, now: Duration) {
        let source = self.viewing.source();
        let (parts, load) = {
            let talk = source.talk();
            (talk.selection.choices(), talk.selection.load())
        };
        let (right, bindings) = (self.right_width(), &self.options.bindings);
        let wish = self.parts_bar.show(ctx, now, right, bindings, parts.as_deref(), load.as_ref());
        self.do_part(now, wish);
        if self.viewing.source().state() != State::Connected {
            self.parts_bar.forget();
        }
    }

    pub(super) fn do_part(&mut self, now: Duration, wish: Option<PartsWish>) {
        let Some(wish) = wish else { return };
        if self.viewing.source().state() != State::Connected {
            self.tell(now, NO_SERVER_FOR_PART);
            return;
        }
        self.viewing.source().talk().selection.open(match wish {
            PartsWish::Open(part) => Some(part),
            PartsWish::Cancel => None,
        });
    }
}

/// Width of the button that leads to the start page, with a gap, points.
const OPEN_BUTTON_WIDTH: f32 = 64.0;
/// Height of the buttons from the window's upper edge, with a gap below, less that of a pane, points.
const BUTTONS_HEIGHT: f32 = 42.0;
/// Least width of a pane at the top, points.
const LEAST_ROOM_AT_TOP: f32 = 180.0;
/// Least width of a pane at the bottom, points.
const LEAST_ROOM: f32 = 280.0;
const NO_SERVER_FOR_PART: &str = "Nothing else can be opened: there is no connection to the server";
const NO_SERVER_FOR_PICTURE: &str = "No picture: the server renders it, and there is no connection to it";
