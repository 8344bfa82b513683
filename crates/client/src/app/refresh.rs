//! One refresh: from the input to the picture, the panels and the time of the next refresh.

use std::sync::PoisonError;
use std::time::Duration;

use isinglass_core::camera::Intrinsics;
use isinglass_core::prediction::STILL;
use isinglass_core::wire::{ClientStats, VolumeDescription};
use isinglass_net::State;

use super::measure::SeenPicture;
use super::picture::{CENTER_TIME, picture_widget};
use super::script::{Probe, ScriptStep, Shot};
use super::{ViewerApp, is_free};
use crate::input::bindings::Action;
use crate::input::camera_controls::ControlInput;
use crate::paint::clip_editor;
use crate::panels::hints::Hint;
use crate::panels::status::{OverlayModel, ViewTime};
use crate::panels::{banner, first_page, help, status, style};
use crate::view::frame_source::FrameSource;
use crate::view::viewing::{Refresh, Standing};

impl<S: FrameSource> ViewerApp<S> {
    pub(crate) fn show(&mut self, ui: &mut egui::Ui) {
        self.warm_up();
        let ctx = ui.ctx().clone();
        let now = Duration::from_micros(self.clock.now_micros());
        let elapsed = now.saturating_sub(self.last_refresh);
        self.last_refresh = now;
        style::install(&ctx);
        self.follow_volume(now);
        self.show_bars(ui, now);
        self.set_modes(now);
        let rect = self.room;
        let ui = &mut ui.new_child(egui::UiBuilder::new().max_rect(rect));
        ui.set_clip_rect(rect);
        self.take_states(&ctx, now, picture_intrinsics(rect, ctx.pixels_per_point(), self.options.fov_y));
        let window = picture_intrinsics(rect, ctx.pixels_per_point(), self.options.fov_y);
        self.window = Some(window);
        let picture = self.stereo().eye_intrinsics(window);
        let eye_rect = self.stereo().rect_at(rect, ctx.pointer_latest_pos());
        let by_keys = self.keys(&ctx, now, &picture);
        let mut events = ctx.input(|i| i.events.clone());
        let is_button = |event: &egui::Event| matches!(event, egui::Event::PointerButton { .. });
        if !ctx.input(|i| i.pointer.any_down()) && !events.iter().any(is_button) {
            // The button was released while another page was shown.
            self.pointer.end_drag();
            self.clip_editor.end_drag();
            self.measures.end_drag();
            self.slices.end_drag();
        }
        self.drop_empty_clip(now);
        self.drag_clip(&ctx, now, &mut events);
        self.drag_measures(&ctx, now, &mut events);
        let free = |at| is_free(&ctx, rect, at);
        let mut input =
            self.pointer.control_input(&self.options.bindings, &events, rect, ctx.pixels_per_point(), free);
        if input.orbit != [0.0; 2] {
            self.hints.note(Hint::Turn);
        }
        if input.zoom != 0.0 {
            self.hints.note(Hint::Zoom);
        }
        // Zooming keeps a point of the eye's own picture in place.
        input.zoom_at[0] += (rect.center() - eye_rect.center()).x * ctx.pixels_per_point();
        input.add(&by_keys);
        self.turn_light(now, &picture);
        let is_by_hand = !input.is_idle();
        let auto_orbit = self.options.auto_orbit_degrees_per_second;
        let turn_pixels =
            auto_orbit / 180.0 * picture.width.min(picture.height) as f32 * elapsed.as_secs_f32();
        // The near side moves to the left as the eye moves towards +x.
        input.orbit[0] -= turn_pixels;

        let is_held = ctx.input(|i| i.pointer.any_down());
        let refresh = self.refresh(now, &input, picture, (is_by_hand, is_held));
        // Clip handles are drawn for one eye only.
        self.clip_view = refresh
            .as_ref()
            .filter(|_| self.stereo().is_mono())
            .map(|r| clip_editor::ClipView { rect, camera: r.camera, bounds: r.bounds });
        let is_mono = self.stereo().is_mono();
        self.seen_picture = refresh.as_ref().filter(|_| is_mono).and_then(|r| SeenPicture::of(rect, r));
        let state = self.viewing.source().state();
        let notice = self.viewing.source().talk().quietly().link.take_notice();
        if let Some(notice) = notice {
            self.notice = Some((notice, now));
        }
        let is_active = !input.is_idle() || refresh.as_ref().is_some_and(|r| r.changed);
        if is_active {
            self.refreshes.record(now, self.was_active);
        }
        // If the refresh before moved too, drawing it took until now.
        if is_active && self.was_active && self.last_standing == Some(Standing::Moving) {
            let mut drawn = self.quality.quality(true);
            drawn.keeps &= self.had_kept;
            self.quality.handle_cast(now, drawn, elapsed);
        }
        self.had_kept = refresh.as_ref().is_some_and(|r| !r.kept.is_empty());
        self.last_standing = refresh.as_ref().map(|r| r.standing);
        self.was_active = is_active;

        let seconds = now.saturating_sub(self.opened_at).as_secs_f64();
        match refresh.as_ref().and_then(|r| Some((r, r.frame.clone()?))) {
            Some((r, frame)) => {
                self.choose_center(&ctx, now, rect, r);
                self.paint(ui, rect, r, frame.clone());
                let shown = picture_widget(ui, rect, &format!("{}, {}", self.title, r.standing.word()));
                let mut chosen = None;
                if shown.context_menu(|ui| chosen = self.toolbar().show_menu(ui)).is_some() {
                    self.hints.note(Hint::Menu);
                }
                self.choose(now, chosen);
                self.paint_aids(ui, now, rect, r, &picture);
                self.show_probe(&ctx, rect, r);
                self.show_measures(ui, rect, r);
                if r.older_look_since.is_some_and(|since| now >= since + OLDER_LOOK_DELAY) {
                    let is_of_volume = self.viewing.source().is_of_volume(&frame);
                    banner::older_look(&ctx, is_of_volume, &state, self.room_at_top());
                }
                let model = self.overlay_model(r, is_active);
                let volume_name = self.viewing.source().description().map(|d| d.volume.name.clone());
                let volume_name = volume_name.unwrap_or_default();
                if self.shows_bars && status::show(&ctx, rect, &volume_name, &model, self.shows_numbers) {
                    self.chosen_actions.push(Action::Numbers);
                }
                self.report(now, &model);
                match self.banner(now, &model) {
                    Some((text, true)) => {
                        let takes_link = self.opens_volumes && model.banner().is_some();
                        let room = self.room_at_bottom();
                        banner::trouble(&ctx, &text, model.details().as_deref(), takes_link, room);
                    }
                    Some((text, false)) => banner::news(&ctx, &text, self.room_at_bottom()),
                    // Beside slices there is no room for them.
                    None if self.shows_bars && !self.slices.is_on() => {
                        self.hints.show(&ctx, self.room_at_bottom());
                    }
                    None => {}
                }
            }
            None => {
                let help = self.options.bindings.hint(Action::Help);
                first_page::show(ui, &self.options.server_name, &state, seconds, &help);
            }
        }
        let has_frame = refresh.as_ref().is_some_and(|r| r.frame.is_some());
        self.keep_choices(&ctx, now, has_frame);
        self.show_parts(&ctx, now, refresh.as_ref());
        self.show_screenshots(&ctx, now, refresh.as_ref());
        self.show_recording(&ctx, now);
        self.show_open_dialog(&ctx);
        help::show(&ctx, &self.options.bindings, &mut self.shows_help, &mut self.help_search);
        self.set_title(&ctx);
        self.run_script(&ctx, now, refresh.as_ref());

        // A moving picture is refreshed without a rest, so that the time between refreshes is the time of a cast.
        if auto_orbit != 0.0 || self.is_turning || self.last_standing == Some(Standing::Moving) {
            ctx.request_repaint();
        } else if let Some(wait) = self.rest(refresh.as_ref(), &state) {
            ctx.request_repaint_after(wait);
        }
        if self.marks_center(now) {
            ctx.request_repaint_after(CENTER_TIME);
        }
        if let Some((_, at)) = self.notice.as_ref().filter(|(_, at)| now < *at + NOTICE_TIME) {
            ctx.request_repaint_after((*at + NOTICE_TIME).saturating_sub(now));
        }
    }

    fn refresh(
        &mut self,
        now: Duration,
        input: &ControlInput,
        picture: Intrinsics,
        (is_by_hand, is_held): (bool, bool),
    ) -> Option<Refresh> {
        let is_orthographic = self.is_orthographic;
        self.controls(&picture)?;
        let (bounds, controls) = self.controls.as_mut()?;
        controls.apply(input, &picture);
        self.is_turning = self.moves.follow(now, (controls, is_orthographic), is_by_hand, is_held);
        let (bounds, pose) = (*bounds, controls.pose());
        let camera = match is_orthographic {
            true => controls.parallel_camera(picture, &bounds),
            false => controls.camera(picture, &bounds),
        };
        if let Some(recorder) = &self.options.recorder {
            let at = now.saturating_sub(self.opened_at);
            recorder.lock().unwrap_or_else(PoisonError::into_inner).record(at, &pose, &bounds);
        }
        self.record(now, &pose, &bounds);
        let mut refresh = self.viewing.refresh(now, camera.pose, camera.intrinsics, &bounds);
        self.join_leader(now, refresh.frame.as_deref());
        let is_of_other_method = self.novel_views.selected != 0;
        if (!self.stereo().is_mono() || is_of_other_method) && refresh.standing == Standing::Exact {
            // Each eye sees a novel view of the middle's frame, and other methods make other pictures.
            refresh.standing = Standing::Settled;
        }
        if !is_of_other_method && self.picture_status.is_blank() {
            refresh.standing = Standing::Waiting;
        }
        // A line per refresh lets a test compare pictures of the window with the poses that they show.
        tracing::trace!(
            camera = ?pose,
            frame = ?refresh.frame.as_ref().map(|frame| frame.frame.header.camera.pose),
            standing = ?refresh.standing,
            "refresh"
        );
        Some(refresh)
    }

    /// How long the window may sleep if nothing happens; none: until something does. Frames, pointer and keys wake
    /// it.
    fn rest(&self, refresh: Option<&Refresh>, state: &State) -> Option<Duration> {
        let is_settled = refresh.is_some_and(|r| {
            use Standing::{Exact, Following, Offline, Settled};
            matches!(r.standing, Exact | Settled | Following | Offline)
        });
        let is_dead = matches!(state, State::Refused(_));
        if refresh.is_some_and(|r| r.is_ahead) && !is_dead {
            return Some(STILL);
        }
        match (is_settled, self.shows_bars) {
            // Age, rates and badge change.
            (false, _) if !is_dead => Some(OVERLAY_PERIOD),
            // Only the rate of bytes still falls, or the age grows without a connection.
            (true, true) => Some(SETTLED_PERIOD),
            // A server that falls silent wakes nobody.
            (true, false) if *state == State::Connected => Some(SETTLED_PERIOD),
            _ => None,
        }
    }

    /// News first, then trouble of the connection, then of the device; and whether it is trouble.
    fn banner(&self, now: Duration, model: &OverlayModel) -> Option<(String, bool)> {
        let problem = || {
            let problem = self.method_problem.clone().or_else(|| self.picture_status.problem())?;
            Some(format!("The newest frame cannot be shown: {problem}"))
        };
        let notice = self.notice.as_ref().filter(|(_, at)| now < *at + NOTICE_TIME);
        match notice {
            Some((text, _)) => Some((text.clone(), false)),
            None => Some((model.banner().or_else(problem)?, true)),
        }
    }

    fn report(&mut self, now: Duration, model: &OverlayModel) {
        if now < self.reported_at + REPORT_PERIOD {
            return;
        }
        self.reported_at = now;
        let as_micros = |d: Duration| d.as_micros() as u64;
        let stats = ClientStats {
            frames_per_second: model.refreshes_per_second.unwrap_or(0.0) as f32,
            age_micros: model.frame_age.map_or(0, as_micros),
            novel_view_micros: match model.view_time {
                ViewTime::Gpu(d) => as_micros(d),
                ViewTime::FrameInterval(_) | ViewTime::Unknown => 0,
            },
        };
        self.viewing.source().talk().link.report(stats);
    }

    fn set_title(&mut self, ctx: &egui::Context) {
        let Some(description) = self.viewing.source().description() else { return };
        let volume = &description.volume;
        let title = title_of(volume);
        let window = format!("{} – isinglass", volume.name);
        style::name_window(ctx, &window);
        if title != self.title {
            self.title = title;
            ctx.send_viewport_cmd(egui::ViewportCommand::Title(window));
        }
    }

    fn overlay_model(&self, refresh: &Refresh, is_active: bool) -> OverlayModel {
        let source = self.viewing.source();
        let stats = source.stats();
        let interval = self.refreshes.interval().filter(|_| is_active);
        let state = source.state();
        // Without a connection the round trip is unknown, and nothing arrives.
        let is_silent = source.is_silent();
        let is_connected = state == State::Connected && !is_silent;
        let round_trip = is_connected.then(|| micros(stats.rtt_micros)).flatten();
        OverlayModel {
            state,
            carrier: stats.carrier,
            standing: refresh.standing,
            pages: source.talk().pages.progress(),
            silence: is_silent.then(|| Duration::from_micros(stats.silence_micros)),
            round_trip,
            frame_age: refresh.frame_age,
            turned_degrees: refresh.turned_degrees,
            view_time: if self.picture_status.has_timer {
                self.picture_status.time.get().map_or(ViewTime::Unknown, ViewTime::Gpu)
            } else {
                interval.map_or(ViewTime::Unknown, ViewTime::FrameInterval)
            },
            generate: micros(stats.server.generate_micros),
            bytes_per_second: if is_connected { stats.bytes_per_second } else { 0.0 },
            new_frames_per_second: if is_connected { stats.frames_per_second } else { 0 },
            refreshes_per_second: interval.filter(|i| !i.is_zero()).map(|i| i.as_secs_f64().recip()),
        }
    }

    fn run_script(&mut self, ctx: &egui::Context, now: Duration, refresh: Option<&Refresh>) {
        let Some(script) = &mut self.options.script else { return };
        match script(&Probe { now: now.saturating_sub(self.opened_at), refresh: refresh.cloned() }) {
            ScriptStep::Continue => {}
            ScriptStep::Capture(then) => ctx.request_screenshot(move |image| {
                let rgb = image.pixels.iter().flat_map(|p| [p.r(), p.g(), p.b()]).collect();
                then(Shot { width: image.width(), height: image.height(), rgb });
            }),
            ScriptStep::Close => ctx.send_viewport_cmd(egui::ViewportCommand::Close),
        }
        // No input wakes the window for a script.
        ctx.request_repaint_after(SCRIPT_REFRESH);
    }
}

fn title_of(volume: &VolumeDescription) -> String {
    let [x, y, z] = volume.dims;
    format!("{}  {x}×{y}×{z}", volume.name)
}

/// A time in microseconds, where 0 means unknown.
fn micros(micros: u64) -> Option<Duration> {
    (micros > 0).then(|| Duration::from_micros(micros))
}

/// The intrinsics of a picture that fills `rect`, one pixel for each pixel of the screen.
fn picture_intrinsics(rect: egui::Rect, pixels_per_point: f32, fov_y: f32) -> Intrinsics {
    let pixels = |points: f32| (points * pixels_per_point).round().clamp(1.0, MAX_PICTURE_SIDE) as u32;
    Intrinsics::perspective(pixels(rect.width()), pixels(rect.height()), fov_y)
}

/// Period of refreshes of the numbers while nothing moves.
const OVERLAY_PERIOD: Duration = Duration::from_millis(100);
/// The same when the picture is the server's own, or no better one can come.
const SETTLED_PERIOD: Duration = Duration::from_millis(500);
const REPORT_PERIOD: Duration = Duration::from_secs(1);
const NOTICE_TIME: Duration = Duration::from_secs(8);
/// The delay before a picture of the look before is labelled; a fast server needs less.
const OLDER_LOOK_DELAY: Duration = Duration::from_millis(250);
const SCRIPT_REFRESH: Duration = Duration::from_millis(30);
/// The largest texture, and so window, of egui's device.
const MAX_PICTURE_SIDE: f32 = 8192.0;
