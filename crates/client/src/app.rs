//! The window's application: at each refresh input to camera, camera to wish, newest frame to picture.

use std::sync::{Arc, PoisonError};
use std::time::Duration;

use egui::{Key, Modifiers};
use isinglass_core::camera::Intrinsics;
use isinglass_core::prediction::STILL;
use isinglass_core::space::Aabb;
use isinglass_core::wire::ClientStats;
use isinglass_net::{Clock, ReceivedFrame, State};

use crate::camera_controls::{CameraControls, ControlInput};
use crate::frame_source::FrameSource;
use crate::meters::RefreshMeter;
use crate::novel_view::{NovelViews, Shown};
use crate::overlay::{OverlayModel, ViewTime};
use crate::panels;
use crate::picture::{PicturePaint, PictureStatus};
use crate::pointer::Pointer;
use crate::quality_control::QualityControl;
use crate::stereo::Stereo;
use crate::viewing::{FrameSize, Refresh, Standing, Viewing};
use crate::window::{Probe, ScriptStep, Shot, WindowOptions};

/// See the module.
pub(crate) struct ViewerApp<S> {
    options: WindowOptions,
    viewing: Viewing<S>,
    controls: Option<(Aabb, CameraControls)>,
    clock: Clock,
    opened_at: Duration,
    last_refresh: Duration,
    was_active: bool,
    last_standing: Option<Standing>,
    /// Whether there were older frames to cast at the refresh before.
    had_kept: bool,
    refreshes: RefreshMeter,
    quality: QualityControl,
    picture_status: Arc<PictureStatus>,
    novel_views: NovelViews,
    method_problem: Option<String>,
    stereo: Stereo,
    shows_overlay: bool,
    shows_help: bool,
    shows_look: bool,
    pointer: Pointer,
    title: String,
    notice: Option<(String, Duration)>,
    reported_at: Duration,
}

impl<S: FrameSource> ViewerApp<S> {
    /// `picture_status` is what the painting reports to; `clock` is that of the source's stamps.
    pub(crate) fn new(
        options: WindowOptions,
        novel_views: NovelViews,
        source: S,
        clock: Clock,
        picture_status: Arc<PictureStatus>,
    ) -> Self {
        let opened_at = Duration::from_micros(clock.now_micros());
        let viewing = Viewing::new(source, options.frame_size, options.foresight);
        Self {
            stereo: options.stereo,
            shows_overlay: options.shows_overlay,
            options,
            viewing,
            controls: None,
            clock,
            opened_at,
            last_refresh: opened_at,
            was_active: false,
            last_standing: None,
            had_kept: false,
            refreshes: RefreshMeter::default(),
            quality: QualityControl::new(TARGET_RATE),
            picture_status,
            novel_views,
            method_problem: None,
            shows_help: false,
            shows_look: true,
            pointer: Pointer::default(),
            title: String::new(),
            notice: None,
            reported_at: Duration::ZERO,
        }
    }

    /// The camera controls for the volume that the source has now; a volume of another size starts over.
    fn controls(&mut self, picture: &Intrinsics) -> Option<&mut (Aabb, CameraControls)> {
        let bounds = self.viewing.source().description()?.volume.bounds();
        if self.controls.as_ref().is_none_or(|(b, _)| *b != bounds) {
            let controls = CameraControls::new(self.options.initial_orbit, &bounds, picture);
            self.controls = Some((bounds, controls));
        }
        self.controls.as_mut()
    }

    fn keys(&mut self, ctx: &egui::Context) {
        let pressed = |key| ctx.input_mut(|i| i.consume_key(Modifiers::NONE, key));
        if pressed(Key::O) {
            self.shows_overlay = !self.shows_overlay;
        }
        if pressed(Key::L) {
            self.shows_look = !self.shows_look;
        }
        if pressed(Key::S) {
            self.stereo.mode = self.stereo.mode.next();
        }
        if pressed(Key::H) | pressed(Key::F1) {
            self.shows_help = !self.shows_help;
        }
        if pressed(Key::Escape) {
            self.shows_help = false;
        }
        if ctx.input_mut(|i| i.consume_key(Modifiers::COMMAND, Key::Q)) {
            ctx.send_viewport_cmd(egui::ViewportCommand::Close);
        }
    }

    fn overlay_model(&self, refresh: &Refresh, is_active: bool) -> OverlayModel {
        let source = self.viewing.source();
        let stats = source.stats();
        let interval = self.refreshes.interval().filter(|_| is_active);
        OverlayModel {
            state: source.state(),
            standing: refresh.standing,
            round_trip: micros(stats.rtt_micros),
            frame_age: refresh.frame_age,
            turned_degrees: refresh.turned_degrees,
            view_time: if self.picture_status.has_timer {
                self.picture_status.time.get().map_or(ViewTime::Unknown, ViewTime::Gpu)
            } else {
                interval.map_or(ViewTime::Unknown, ViewTime::FrameInterval)
            },
            generate: micros(stats.server.generate_micros),
            bytes_per_second: stats.bytes_per_second,
            new_frames_per_second: stats.frames_per_second,
            refreshes_per_second: interval.filter(|i| !i.is_zero()).map(|i| i.as_secs_f64().recip()),
        }
    }

    fn show_look_panel(&mut self, ctx: &egui::Context, now: Duration) {
        let Some(look) = self.viewing.look(now).filter(|_| self.shows_look) else { return };
        let methods = (&self.novel_views.names[..], self.novel_views.selected);
        let choice = panels::look_panel(ctx, &look, &self.viewing.frame_size, methods, self.stereo);
        if let Some(selected) = choice.method {
            self.novel_views.selected = selected;
        }
        if let Some(look) = choice.look {
            self.viewing.set_look(now, look);
        }
        if let Some(scale) = choice.scale {
            self.viewing.frame_size = FrameSize { scale, ..self.viewing.frame_size };
        }
        if let Some(stereo) = choice.stereo {
            self.stereo = stereo;
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
        // A script has no hand to wake the window.
        ctx.request_repaint_after(SCRIPT_REFRESH);
    }
}

impl<S: FrameSource> eframe::App for ViewerApp<S> {
    /// Tab would move egui's keyboard focus before any widget is asked.
    fn raw_input_hook(&mut self, _ctx: &egui::Context, raw_input: &mut egui::RawInput) {
        raw_input.events.retain(|event| match event {
            egui::Event::Key { key: Key::Tab, pressed, repeat, modifiers, .. } if modifiers.is_none() => {
                self.shows_overlay ^= *pressed && !*repeat;
                false
            }
            _ => true,
        });
    }

    fn ui(&mut self, ui: &mut egui::Ui, _frame: &mut eframe::Frame) {
        let ctx = ui.ctx().clone();
        let now = Duration::from_micros(self.clock.now_micros());
        let elapsed = now.saturating_sub(self.last_refresh);
        self.last_refresh = now;
        let keys_are_free = !ctx.egui_wants_keyboard_input();
        if keys_are_free {
            self.keys(&ctx);
        }

        let rect = ui.max_rect();
        let window = picture_intrinsics(rect, ctx.pixels_per_point(), self.options.fov_y);
        let picture = self.stereo().eye_intrinsics(window);
        let eye_rect = self.stereo().rect_at(rect, ctx.pointer_latest_pos());
        let is_free = |at| ctx.layer_id_at(at).is_none_or(|layer| layer.order == egui::Order::Background);
        let events = ctx.input(|i| i.events.clone());
        let mut input = self.pointer.control_input(&events, rect, ctx.pixels_per_point(), is_free);
        // Zooming is about a point of the eye's own picture.
        input.zoom_at[0] += (rect.center() - eye_rect.center()).x * ctx.pixels_per_point();
        input.reset = keys_are_free && ctx.input_mut(|i| i.consume_key(Modifiers::NONE, Key::R));
        let auto_orbit = self.options.auto_orbit_degrees_per_second;
        let turn_pixels =
            auto_orbit / 180.0 * picture.width.min(picture.height) as f32 * elapsed.as_secs_f32();
        // The near side moves to the left, as the eye moves towards +x.
        input.orbit[0] -= turn_pixels;

        let refresh = self.refresh(now, &input, picture);
        let state = self.viewing.source().state();
        if let Some(notice) = self.viewing.source_mut().take_notice() {
            self.notice = Some((notice, now));
        }
        let is_active = !input.is_idle() || refresh.as_ref().is_some_and(|r| r.changed);
        if is_active {
            self.refreshes.record(now, self.was_active);
        }
        // What was drawn at the refresh before took until now, if that one moved too.
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
                self.paint(ui, rect, r, frame);
                let model = self.overlay_model(r, is_active);
                if self.shows_overlay {
                    panels::overlay(&ctx, &self.title, &model);
                }
                self.report(now, &model);
                if let Some(text) = self.banner(now, &model) {
                    panels::banner(&ctx, &text);
                }
            }
            None => panels::first_page(ui, &self.options.server_name, &state, seconds),
        }
        self.show_look_panel(&ctx, now);
        panels::help(&ctx, &mut self.shows_help);
        self.set_title(&ctx);
        self.run_script(&ctx, now, refresh.as_ref());

        // A moving picture is drawn without a rest, so that the time between two refreshes tells what one costs.
        if auto_orbit != 0.0 || self.last_standing == Some(Standing::Moving) {
            ctx.request_repaint();
        } else if let Some(wait) = self.rest(refresh.as_ref(), &state) {
            ctx.request_repaint_after(wait);
        }
    }
}

impl<S: FrameSource> ViewerApp<S> {
    /// The ray cast, or the newest picture of another method.
    fn paint(&mut self, ui: &egui::Ui, rect: egui::Rect, refresh: &Refresh, frame: Arc<ReceivedFrame>) {
        let (camera, bounds) = (refresh.camera, refresh.bounds);
        match self.novel_views.show(ui.ctx(), &frame, &bounds, &camera) {
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
        let kept = if quality.keeps { refresh.kept.clone() } else { Vec::new() };
        ui.painter().add(PicturePaint { frame, kept, camera, bounds, stereo, quality }.shape(rect));
    }

    /// Only the ray cast has two eyes.
    fn stereo(&self) -> Stereo {
        if self.novel_views.selected == 0 { self.stereo } else { Stereo::default() }
    }

    fn refresh(&mut self, now: Duration, input: &ControlInput, picture: Intrinsics) -> Option<Refresh> {
        let (bounds, controls) = self.controls(&picture)?;
        controls.apply(input, &picture);
        let (bounds, pose) = (*bounds, controls.pose());
        if let Some(recorder) = &self.options.recorder {
            let at = now.saturating_sub(self.opened_at);
            recorder.lock().unwrap_or_else(PoisonError::into_inner).record(at, &pose, &bounds);
        }
        let mut refresh = self.viewing.refresh(now, pose, picture, &bounds);
        if !self.stereo().is_mono() && refresh.standing == Standing::Exact {
            // The frame is the middle's between the eyes; each of them sees a novel view.
            refresh.standing = Standing::Settled;
        }
        Some(refresh)
    }

    /// How long the window may sleep if nothing happens; none: until something does. Frames, pointer and keys wake it.
    fn rest(&self, refresh: Option<&Refresh>, state: &State) -> Option<Duration> {
        let is_settled = refresh.is_some_and(|r| matches!(r.standing, Standing::Exact | Standing::Settled));
        let is_dead = matches!(state, State::Refused(_));
        if refresh.is_some_and(|r| r.is_ahead) && !is_dead {
            return Some(STILL);
        }
        match (is_settled, self.shows_overlay) {
            // Numbers that change: age, rates, the badge.
            (false, _) if !is_dead => Some(OVERLAY_PERIOD),
            // Only the rate of bytes still falls.
            (true, true) => Some(SETTLED_PERIOD),
            _ => None,
        }
    }

    /// The connection's trouble before the device's before what the server says.
    fn banner(&self, now: Duration, model: &OverlayModel) -> Option<String> {
        let problem = || {
            let problem = self.method_problem.clone().or_else(|| self.picture_status.problem())?;
            Some(format!("The newest frame cannot be shown: {problem}"))
        };
        let notice =
            || self.notice.as_ref().filter(|(_, at)| now < *at + NOTICE_TIME).map(|(n, _)| n.clone());
        model.banner().or_else(problem).or_else(notice)
    }

    fn report(&mut self, now: Duration, model: &OverlayModel) {
        if now < self.reported_at + REPORT_PERIOD {
            return;
        }
        self.reported_at = now;
        let as_micros = |d: Duration| d.as_micros() as u64;
        self.viewing.source_mut().report(ClientStats {
            frames_per_second: model.refreshes_per_second.unwrap_or(0.0) as f32,
            age_micros: model.frame_age.map_or(0, as_micros),
            novel_view_micros: match model.view_time {
                ViewTime::Gpu(d) => as_micros(d),
                ViewTime::FrameInterval(_) | ViewTime::Unknown => 0,
            },
        });
    }

    fn set_title(&mut self, ctx: &egui::Context) {
        let Some(description) = self.viewing.source().description() else { return };
        let volume = &description.volume;
        let title = panels::title_of(volume);
        if title != self.title {
            self.title = title;
            let window = format!("{} – isinglass", volume.name);
            ctx.send_viewport_cmd(egui::ViewportCommand::Title(window));
        }
    }
}

/// A time of which 0 means that it is not known yet.
fn micros(micros: u64) -> Option<Duration> {
    (micros > 0).then(|| Duration::from_micros(micros))
}

/// The picture fills `rect`: one pixel of it is one of the screen.
fn picture_intrinsics(rect: egui::Rect, pixels_per_point: f32, fov_y: f32) -> Intrinsics {
    let pixels = |points: f32| (points * pixels_per_point).round().clamp(1.0, MAX_PICTURE_SIDE) as u32;
    Intrinsics { width: pixels(rect.width()), height: pixels(rect.height()), fov_y }
}

/// Refreshes of the numbers while nothing moves.
const OVERLAY_PERIOD: Duration = Duration::from_millis(100);
/// The same when the picture is the server's own.
const SETTLED_PERIOD: Duration = Duration::from_millis(500);
/// The server is told how the viewer fares.
const REPORT_PERIOD: Duration = Duration::from_secs(1);
/// A line of the server's stays so long.
const NOTICE_TIME: Duration = Duration::from_secs(8);
/// A script is asked so often.
const SCRIPT_REFRESH: Duration = Duration::from_millis(30);
/// The largest texture, and so window, that egui's device allows.
const MAX_PICTURE_SIDE: f32 = 8192.0;
/// While the camera moves, the picture is cast as finely as this many refreshes a second allow.
const TARGET_RATE: f32 = 30.0;
