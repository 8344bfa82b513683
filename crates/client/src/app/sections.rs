//! Places the panels that ask for something: look, parts of the file, screenshots and the probe.

use std::sync::Arc;
use std::time::Duration;

use isinglass_core::camera::{Camera, Intrinsics};
use isinglass_core::look::Look;
use isinglass_core::wire::{Choices, LoadStatus, Part, VolumeDescription};
use isinglass_net::State;

use super::side_panel::{self, LookSettings};
use super::{AppWish, ViewerApp, is_free};
use crate::paint::view_aids::pixel_at;
use crate::panels::browser::Chosen;
use crate::panels::parts_bar::PartsWish;
use crate::panels::screenshots::{LegendSubject, Subject};
use crate::panels::text::mode_name;
use crate::panels::value_scale::ValueScale;
use crate::panels::{light, probe};
use crate::view::frame_source::FrameSource;
use crate::view::pick::visible_point;
use crate::view::viewing::Refresh;
use crate::view::waker_of;

impl<S: FrameSource> ViewerApp<S> {
    /// What a screenshot shows: the present view.
    fn subject(&self, camera: &Camera) -> Option<Subject> {
        let (bounds, controls) = self.controls.as_ref()?;
        // In stereo with half a window for each eye, a screenshot shows the view of one eye in the whole window.
        let camera = match self.window.filter(|_| !self.stereo().is_mono()) {
            Some(window) if self.is_orthographic => controls.parallel_camera(window, bounds),
            Some(window) => controls.camera(window, bounds),
            None => *camera,
        };
        let description = self.viewing.source().description()?;
        let volume = &description.volume;
        let legend = self.viewing.look().zip(self.value_scale()).map(|(look, scale)| LegendSubject {
            range: scale.domain(&look.chosen_transfer().domain),
            unit: volume.value_unit.clone(),
            look,
        });
        Some(Subject {
            name: volume.name.clone(),
            pose: camera.pose,
            intrinsics: camera.intrinsics,
            background: self.aids.background,
            bounds: *bounds,
            center: controls.center(),
            up: self.orientation().up(),
            unit: volume.unit.clone(),
            legend,
        })
    }

    pub(super) fn show_screenshots(&mut self, ctx: &egui::Context, now: Duration, refresh: Option<&Refresh>) {
        let is_needed = self.wants_picture || self.screenshots.is_dialog_open();
        let subject = refresh.filter(|_| is_needed).and_then(|refresh| self.subject(&refresh.camera));
        let is_connected = self.viewing.source().state() == State::Connected;
        if std::mem::take(&mut self.wants_picture)
            && let Some(subject) = subject.clone()
        {
            match is_connected {
                true => self.screenshots.take(ctx, subject),
                false => {
                    self.tell(now, NO_SERVER_FOR_PICTURE);
                    ctx.request_repaint();
                }
            }
        }
        let room = self.room_at_top();
        let source = self.viewing.source_mut();
        let done = match source.state() {
            // No picture can come any more.
            State::Refused(_) => self.screenshots.end(source, ctx),
            _ => self.screenshots.poll(source, ctx),
        };
        if let Some(notice) = self.screenshots.show(ctx, subject, source, room).or(done) {
            self.tell(now, notice);
            ctx.request_repaint();
        }
    }

    /// Requests the value under the pointer, and shows what is known of it.
    pub(super) fn show_probe(&mut self, ctx: &egui::Context, rect: egui::Rect, refresh: &Refresh) {
        // The probe must not cover a dialog.
        if !self.probe.is_on() || !self.stereo().is_mono() || self.has_dialog() {
            return;
        }
        let at = ctx.pointer_latest_pos().filter(|at| is_free(ctx, rect, *at));
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
        let answer = source.talk().probe.answer().copied();
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
        self.keeper.note_light(now, lighting);
        self.viewing.set_look(now, Look { lighting, ..(*look).clone() });
    }

    fn shown_settings(&self) -> impl PartialEq + use<S> {
        (self.novel_views.selected, self.viewing.frame_size, self.stereo, self.aids, self.is_orthographic)
    }

    pub(super) fn show_look_panel(&mut self, ui: &mut egui::Ui, now: Duration) {
        let ctx = &ui.ctx().clone();
        let (Some(look), Some(scale)) = (self.viewing.look(), self.value_scale()) else { return };
        self.editor.follow(look.chosen_transfer(), &scale);
        let Some((bounds, forward)) = self.controls.as_ref().map(|(b, c)| (*b, c.pose().forward())) else {
            return;
        };
        let world_from_view = self.world_from_view();
        let Some(description) = self.viewing.source().description() else { return };
        let unit = description.volume.unit.clone();
        self.poll_gallery(ctx, now, &look, &scale, &description.volume);
        let before = self.shown_settings();
        let mut resets_choices = false;
        let mut settings = LookSettings {
            look: (*look).clone(),
            gallery: &self.gallery,
            volume: &description.volume,
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
            resets_choices: &mut resets_choices,
        };
        let files = &mut self.state_files;
        let frame = Self::panel_frame(ctx);
        let wish = side_panel::show(
            ui,
            frame,
            &mut self.is_look_open,
            &mut self.editor,
            &scale,
            &mut settings,
            files,
        );
        let mut wanted = settings.look;
        if self.shown_settings() != before {
            // The picture beneath is drawn already.
            ctx.request_repaint();
        }
        let edit = self.editor.take_edit(ctx);
        if let Some(transfer) = edit.transfer {
            *wanted.transfer_of_mut(look.channels.chosen) = transfer;
        }
        wanted.shaded = edit.shaded.unwrap_or(wanted.shaded);
        if wanted.lighting != look.lighting {
            self.keeper.note_light(now, wanted.lighting);
        }
        if wanted != *look {
            self.viewing.set_look(now, wanted);
            // The picture has to be labelled as older.
            ctx.request_repaint();
        }
        if resets_choices {
            self.reset_choices(ctx, now);
        }
        if let Some(wish) = wish {
            self.do_state(ctx, now, wish);
        }
    }

    /// Has the pictures of presets and modes made while nothing moves.
    fn poll_gallery(
        &mut self,
        ctx: &egui::Context,
        now: Duration,
        look: &Look,
        scale: &ValueScale,
        volume: &VolumeDescription,
    ) {
        self.gallery.follow(now, volume, look);
        if !self.is_look_open {
            return;
        }
        let is_dragging = ctx.input(|i| i.pointer.any_down());
        let is_still = !self.was_active && !is_dragging && !self.parts_bar.is_playing();
        let is_free = is_still && !self.screenshots.is_busy();
        if let Some((_, controls)) = self.controls.as_ref().filter(|_| is_free)
            && self.viewing.source().state() == State::Connected
        {
            let camera = (controls.pose(), self.options.fov_y);
            self.gallery.poll(ctx, now, self.viewing.source(), scale, camera);
        }
    }

    /// Sets the mode that was chosen by the key or in the menu.
    pub(super) fn set_modes(&mut self, now: Duration) {
        let by_key = std::mem::take(&mut self.next_modes);
        let (Some(look), Some(scale)) = (self.viewing.look(), self.value_scale()) else { return };
        let chosen = self.chosen_mode.take().unwrap_or(look.mode);
        let next = (0..by_key).fold(chosen, |mode, _| mode.next());
        if next != look.mode {
            let mut wanted = (*look).clone();
            scale.set_mode(&mut wanted, next);
            self.viewing.set_look(now, wanted);
            self.tell(now, mode_name(next));
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

    pub(super) fn toggle_play(&mut self, now: Duration) {
        let (parts, load) = self.parts_and_load();
        if self.viewing.source().state() != State::Connected {
            self.tell(now, NO_SERVER_FOR_PART);
        } else if !parts.is_some_and(|parts| self.parts_bar.toggle_play(now, &parts, load.as_ref())) {
            self.tell(now, "There is nothing to play: the file has one point in time");
        }
    }

    pub(super) fn parts_and_load(&self) -> (Option<Arc<Choices>>, Option<LoadStatus>) {
        let talk = self.viewing.source().talk();
        (talk.selection.choices(), talk.selection.load())
    }

    /// Shows the bar of parts, and plays their times. `refresh` is what is on the screen.
    pub(super) fn show_parts(&mut self, ctx: &egui::Context, now: Duration, refresh: Option<&Refresh>) {
        let (parts, load) = self.parts_and_load();
        let (room, bindings) = (self.room, &self.options.bindings);
        let wish = self.parts_bar.show(ctx, now, room, bindings, parts.as_deref(), load.as_ref());
        self.do_part(now, wish);
        if self.viewing.source().state() != State::Connected {
            self.parts_bar.forget();
        }
        if let Some(parts) = parts.filter(|_| self.parts_bar.is_playing()) {
            let frame = refresh.and_then(|refresh| refresh.frame.as_ref());
            let is_shown = frame.is_some_and(|frame| self.viewing.source().is_of_volume(frame));
            let wish = self.parts_bar.play(now, &parts, load.as_ref(), is_shown);
            self.do_part(now, wish);
            if let Some(wait) = self.parts_bar.wait(now) {
                ctx.request_repaint_after(wait);
            }
        }
    }

    /// Requests the volume mirrored along some of its axes.
    pub(super) fn mirror(&mut self, now: Duration, flip: [bool; 3]) {
        let (parts, load) = self.parts_and_load();
        let Some(parts) = parts else { return };
        let shown = parts.shown;
        // A region is counted along the axes as they are shown.
        let region = shown.region.map(|region| {
            std::array::from_fn(|axis| {
                let ([from, to], whole) = (region[axis], parts.whole_dims[axis] as u32);
                let is_turned = flip[axis] != shown.flip[axis];
                if is_turned { [whole - to.min(whole), whole.saturating_sub(from)] } else { region[axis] }
            })
        });
        let wish = self.parts_bar.open(Part { flip, region, ..shown }, load.as_ref());
        self.do_part(now, Some(wish));
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

const NO_SERVER_FOR_PART: &str = "Nothing else can be opened: there is no connection to the server";
const NO_SERVER_FOR_PICTURE: &str = "No picture: the server renders it, and there is no connection to it";
