//! The window's application: at each refresh input to camera, camera to wish, newest frame to picture.

mod actions;
mod sections;
mod state;

use std::path::Path;
use std::sync::{Arc, PoisonError};
use std::time::Duration;

use egui::PointerButton;
use isinglass_core::camera::Intrinsics;
use isinglass_core::prediction::STILL;
use isinglass_core::space::Aabb;
use isinglass_core::wire::ClientStats;
use isinglass_formats::{LoadRequest, ReadState, VolumeSource};
use isinglass_net::{Clock, Link, ReceivedFrame, State};

use self::state::ComingState;
pub(crate) use self::state::theme_preference;
use crate::bindings::{Action, Bindings, Focus};
use crate::camera_controls::{CameraControls, ControlInput};
use crate::clip_editor::{self, ClipEditor};
use crate::frame_source::FrameSource;
use crate::meters::RefreshMeter;
use crate::novel_view::{NovelViews, Shown};
use crate::open_dialog::OpenDialog;
use crate::orientation::Orientation;
use crate::overlay::{OverlayModel, ViewTime};
use crate::panels;
use crate::parts_bar::PartsBar;
use crate::pick::visible_point;
use crate::picture::{PicturePaint, PictureStatus};
use crate::pointer::Pointer;
use crate::probe::ValueProbe;
use crate::quality_control::QualityControl;
use crate::shots::Shots;
use crate::start::LocalServers;
use crate::state_files::StateFiles;
use crate::stereo::Stereo;
use crate::transfer_editor::{TransferEditor, ValueScale};
use crate::view_aids::{self, ViewAids, pixel_at};
use crate::viewing::{Refresh, Standing, Viewing};
use crate::window::{Probe, ScriptStep, Shot, USUAL_HZ, WindowOptions};

/// Where the frames of a source come from.
#[derive(Default)]
pub(crate) struct Origin {
    /// Who renders, as the person at the viewer knows it.
    pub(crate) server_name: String,
    /// The server's link, for links to what is seen.
    pub(crate) link: Option<Link>,
    /// What the server was given to open, where that is known, for states that are saved.
    pub(crate) volume_source: Option<VolumeSource>,
    /// What is shown at first in place of the first view.
    pub(crate) state: Option<ReadState>,
}

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
    /// How often the next mode was asked for since the last refresh.
    next_modes: usize,
    shows_overlay: bool,
    aids: ViewAids,
    is_orthographic: bool,
    clip_editor: ClipEditor,
    /// Where the handles of the clip were drawn.
    clip_view: Option<clip_editor::View>,
    /// The volume that the clip was last looked at for.
    clip_bounds: Option<Aabb>,
    /// When the centre of rotation was chosen.
    center_chosen_at: Option<Duration>,
    editor: TransferEditor,
    state_files: StateFiles,
    open_dialog: OpenDialog,
    /// A volume that was chosen there.
    wanted_volume: Option<LoadRequest>,
    coming: Option<ComingState>,
    /// Whether somebody opens other volumes for this window.
    opens_volumes: bool,
    /// A state of another one.
    wanted_state: Option<Box<ReadState>>,
    /// The whole window's picture at the last refresh.
    window: Option<Intrinsics>,
    shows_help: bool,
    is_look_open: bool,
    pointer: Pointer,
    probe: ValueProbe,
    shots: Shots,
    wants_picture: bool,
    title: String,
    notice: Option<(String, Duration)>,
    reported_at: Duration,
    parts_bar: PartsBar,
    /// Whether the page was asked for on which another volume or server is chosen.
    wants_start: bool,
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
        let quality = QualityControl::new(options.refresh_hz.unwrap_or(USUAL_HZ));
        Self {
            stereo: options.stereo,
            shows_overlay: options.shows_overlay,
            aids: ViewAids { shows_axes: options.shows_overlay, ..ViewAids::default() },
            is_orthographic: options.is_orthographic,
            clip_editor: ClipEditor::default(),
            clip_view: None,
            clip_bounds: None,
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
            quality,
            picture_status,
            novel_views,
            method_problem: None,
            next_modes: 0,
            center_chosen_at: None,
            editor: TransferEditor::default(),
            state_files: StateFiles::default(),
            open_dialog: OpenDialog::default(),
            coming: None,
            opens_volumes: false,
            wanted_state: None,
            wanted_volume: None,
            window: None,
            shows_help: false,
            is_look_open: false,
            pointer: Pointer::default(),
            probe: ValueProbe::default(),
            shots: Shots::default(),
            wants_picture: false,
            title: String::new(),
            notice: None,
            reported_at: Duration::ZERO,
            parts_bar: PartsBar::default(),
            wants_start: false,
        }
    }

    /// Shows what another source brings, from its first view or its state on. Gives back the source before.
    pub(crate) fn turn_to(&mut self, source: S, origin: Origin) -> S {
        let Origin { server_name, link, volume_source, state } = origin;
        self.options.server_name = server_name;
        (self.options.link, self.options.volume_source) = (link, volume_source);
        if state.is_some() {
            (self.options.state, self.options.state_sets_size) = (None, false);
        }
        let viewing = Viewing::new(source, self.viewing.frame_size, self.options.foresight);
        (self.controls, self.center_chosen_at) = (None, None);
        (self.was_active, self.last_standing, self.had_kept) = (false, None, false);
        (self.editor, self.parts_bar) = (TransferEditor::default(), PartsBar::default());
        (self.coming, self.wanted_state) = (state.map(ComingState::new), None);
        let now = Duration::from_micros(self.clock.now_micros());
        (self.notice, self.method_problem) = (self.shots.forget().map(|told| (told, now)), None);
        self.title.clear();
        std::mem::replace(&mut self.viewing, viewing).into_source()
    }

    /// From now on states of other volumes are left to whoever opens those.
    pub(crate) fn leave_volumes_to_others(&mut self) {
        self.opens_volumes = true;
    }

    /// Whether the page was asked for on which another volume or server is chosen; once.
    pub(crate) fn take_start_wish(&mut self) -> bool {
        std::mem::take(&mut self.wants_start)
    }

    /// The dialog that opens files offers volumes too, which `servers` open beside the bytes `held`; its list begins with `folder`.
    pub(crate) fn offer_volumes(&mut self, servers: Arc<dyn LocalServers>, held: u64, folder: &Path) {
        self.open_dialog.offer_volumes(servers, held, folder);
    }

    /// A volume that was chosen there; once.
    pub(crate) fn take_volume_wish(&mut self) -> Option<LoadRequest> {
        self.wanted_volume.take()
    }

    /// Whether a key says that the window shall be closed. Where nothing is shown, it is the only one that says anything.
    pub(crate) fn take_quit(&self, ctx: &egui::Context) -> bool {
        let take = |i: &mut egui::InputState| self.options.bindings.take_actions(&mut i.events, Focus::Text);
        ctx.input_mut(take).contains(&Action::Quit)
    }

    /// Goes on with the draws before the first picture.
    pub(crate) fn warm_up(&self) {
        self.picture_status.submit_warm_up();
    }

    /// What keys and mouse do.
    pub(crate) fn bindings(&self) -> &Bindings {
        &self.options.bindings
    }

    /// The camera controls for the volume that the source has now; one of another size is seen from the same side.
    fn controls(&mut self, picture: &Intrinsics) -> Option<&mut (Aabb, CameraControls)> {
        let bounds = self.viewing.source().description()?.volume.bounds();
        match &mut self.controls {
            Some((of, controls)) if *of != bounds => {
                controls.turn_to(&bounds);
                *of = bounds;
                self.clip_view = None;
            }
            Some(_) => {}
            None => {
                let upright = self.orientation().world_from_upright();
                let controls = CameraControls::new(self.options.initial_orbit, upright, &bounds, picture);
                self.controls = Some((bounds, controls));
            }
        }
        self.controls.as_mut()
    }

    fn orientation(&self) -> Orientation {
        let description = self.viewing.source().description();
        Orientation::of(description.as_ref().and_then(|d| d.volume.orientation.as_deref()))
    }

    fn value_scale(&self) -> Option<ValueScale> {
        Some(ValueScale::of(&self.viewing.source().description()?.volume))
    }

    /// A double click makes what is visible there the centre of rotation.
    fn choose_center(&mut self, ctx: &egui::Context, now: Duration, rect: egui::Rect, refresh: &Refresh) {
        let is_double = ctx.input(|i| i.pointer.button_double_clicked(PointerButton::Primary));
        let at = ctx.pointer_interact_pos().filter(|at| is_double && rect.contains(*at) && is_free(ctx, *at));
        let (Some(at), Some(frame)) = (at, &refresh.frame) else { return };
        if !self.stereo().is_mono() || self.clip_editor.is_busy() {
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
            self.center_chosen_at = Some(now);
        }
    }

    fn paint_aids(&self, ui: &egui::Ui, now: Duration, rect: egui::Rect, refresh: &Refresh) {
        let (Some((_, controls)), Some(description)) = (&self.controls, self.viewing.source().description())
        else {
            return;
        };
        // Two eyes would each need their own.
        if !self.stereo().is_mono() {
            return;
        }
        let scene = view_aids::Scene {
            rect,
            camera: &refresh.camera,
            bounds: &refresh.bounds,
            orientation: &self.orientation(),
            unit: description.volume.unit.as_deref(),
            center: controls.center(),
            shows_center: self.marks_center(now),
            lift: self.parts_bar.height_over(view_aids::CORNER.x),
        };
        self.aids.paint(ui.painter(), &scene);
        let view = clip_editor::View { rect, camera: refresh.camera, bounds: refresh.bounds };
        self.clip_editor.paint(&self.aids.pen(ui.painter()), &view, &refresh.clip);
        if self.aids.shows_axes {
            panels::image(ui, ViewAids::axes_rect(&scene), "axes", &ViewAids::axes_in_words(&scene));
        }
    }

    fn marks_center(&self, now: Duration) -> bool {
        self.center_chosen_at.is_some_and(|at| now < at + CENTER_TIME)
    }

    fn overlay_model(&self, refresh: &Refresh, is_active: bool) -> OverlayModel {
        let source = self.viewing.source();
        let stats = source.stats();
        let interval = self.refreshes.interval().filter(|_| is_active);
        let state = source.state();
        // Nothing is known of a way that is cut, and nothing comes by it.
        let is_connected = state == State::Connected;
        let round_trip = is_connected.then(|| micros(stats.rtt_micros)).flatten();
        OverlayModel {
            state,
            standing: refresh.standing,
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
        // A script has no hand to wake the window.
        ctx.request_repaint_after(SCRIPT_REFRESH);
    }
}

impl<S: FrameSource> eframe::App for ViewerApp<S> {
    fn ui(&mut self, ui: &mut egui::Ui, _frame: &mut eframe::Frame) {
        self.show(ui);
    }
}

impl<S: FrameSource> ViewerApp<S> {
    /// Whoever brings the frames.
    pub(crate) fn source(&self) -> &S {
        self.viewing.source()
    }

    /// A refresh of the whole window.
    pub(crate) fn show(&mut self, ui: &mut egui::Ui) {
        self.warm_up();
        let ctx = ui.ctx().clone();
        let now = Duration::from_micros(self.clock.now_micros());
        let elapsed = now.saturating_sub(self.last_refresh);
        self.last_refresh = now;
        let rect = ui.max_rect();
        self.take_states(&ctx, now, picture_intrinsics(rect, ctx.pixels_per_point(), self.options.fov_y));
        let window = picture_intrinsics(rect, ctx.pixels_per_point(), self.options.fov_y);
        self.window = Some(window);
        let picture = self.stereo().eye_intrinsics(window);
        let eye_rect = self.stereo().rect_at(rect, ctx.pointer_latest_pos());
        let by_keys = self.keys(&ctx, now, &picture);
        let mut events = ctx.input(|i| i.events.clone());
        let is_button = |event: &egui::Event| matches!(event, egui::Event::PointerButton { .. });
        if !ctx.input(|i| i.pointer.any_down()) && !events.iter().any(is_button) {
            // Another page was shown when it was released.
            self.pointer.end_drag();
            self.clip_editor.end_drag();
        }
        self.drop_empty_clip(now);
        self.drag_clip(&ctx, now, &mut events);
        let free = |at| is_free(&ctx, at);
        let mut input =
            self.pointer.control_input(&self.options.bindings, &events, rect, ctx.pixels_per_point(), free);
        // Zooming is about a point of the eye's own picture.
        input.zoom_at[0] += (rect.center() - eye_rect.center()).x * ctx.pixels_per_point();
        input.add(&by_keys);
        self.turn_light(now, &picture);
        let auto_orbit = self.options.auto_orbit_degrees_per_second;
        let turn_pixels =
            auto_orbit / 180.0 * picture.width.min(picture.height) as f32 * elapsed.as_secs_f32();
        // The near side moves to the left, as the eye moves towards +x.
        input.orbit[0] -= turn_pixels;

        let refresh = self.refresh(now, &input, picture);
        // Two eyes would each need their own handles.
        self.clip_view = refresh.as_ref().filter(|_| self.stereo().is_mono()).map(|r| clip_editor::View {
            rect,
            camera: r.camera,
            bounds: r.bounds,
        });
        let state = self.viewing.source().state();
        let notice = self.viewing.source().talk().quietly().link.take_notice();
        if let Some(notice) = notice {
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
                self.choose_center(&ctx, now, rect, r);
                self.paint(ui, rect, r, frame.clone());
                panels::picture(ui, rect, &format!("{}, {}", self.title, r.standing.word()));
                self.paint_aids(ui, now, rect, r);
                self.show_probe(&ctx, rect, r);
                if r.older_look_since.is_some_and(|since| now >= since + OLDER_LOOK_DELAY) {
                    let (is_of_volume, taken) =
                        (self.viewing.source().is_of_volume(&frame), self.taken_at_top(&ctx));
                    panels::older_look(&ctx, is_of_volume, &state, taken);
                }
                let model = self.overlay_model(r, is_active);
                if self.shows_overlay {
                    panels::overlay(&ctx, &self.title, &model, self.right_width_at_top());
                }
                self.report(now, &model);
                if let Some(text) = self.banner(now, &model) {
                    panels::banner(&ctx, &text, self.taken_at_bottom(&ctx));
                }
            }
            None => {
                let help = self.options.bindings.hint(Action::Help);
                panels::first_page(ui, &self.options.server_name, &state, seconds, &help);
            }
        }
        self.show_look_panel(&ctx, now);
        self.show_parts(&ctx, now);
        self.show_shots(&ctx, now, refresh.as_ref());
        self.show_open_dialog(&ctx);
        panels::help(&ctx, &self.options.bindings, &mut self.shows_help);
        self.set_title(&ctx);
        self.run_script(&ctx, now, refresh.as_ref());

        // A moving picture is drawn without a rest, so that the time between two refreshes tells what one costs.
        if auto_orbit != 0.0 || self.last_standing == Some(Standing::Moving) {
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

    /// The ray cast, or the newest picture of another method.
    fn paint(&mut self, ui: &egui::Ui, rect: egui::Rect, refresh: &Refresh, frame: Arc<ReceivedFrame>) {
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
        // The server's own picture lacks nothing, also where the eye is inside and sees nothing nearer than the near plane.
        let keeps = quality.keeps && refresh.standing != Standing::Exact;
        let kept = if keeps { refresh.kept.clone() } else { Vec::new() };
        let background = self.aids.linear_background();
        ui.painter().add(
            PicturePaint { rect, frame, kept, camera, bounds, clip, stereo, quality, background }.shape(),
        );
    }

    /// Only the ray cast has two eyes.
    fn stereo(&self) -> Stereo {
        if self.novel_views.selected == 0 { self.stereo } else { Stereo::default() }
    }

    fn refresh(&mut self, now: Duration, input: &ControlInput, picture: Intrinsics) -> Option<Refresh> {
        let is_orthographic = self.is_orthographic;
        let (bounds, controls) = self.controls(&picture)?;
        controls.apply(input, &picture);
        let (bounds, pose) = (*bounds, controls.pose());
        let camera = match is_orthographic {
            true => controls.parallel_camera(picture, &bounds),
            false => controls.camera(picture, &bounds),
        };
        if let Some(recorder) = &self.options.recorder {
            let at = now.saturating_sub(self.opened_at);
            recorder.lock().unwrap_or_else(PoisonError::into_inner).record(at, &pose, &bounds);
        }
        let mut refresh = self.viewing.refresh(now, camera.pose, camera.intrinsics, &bounds);
        let is_of_other_method = self.novel_views.selected != 0;
        if (!self.stereo().is_mono() || is_of_other_method) && refresh.standing == Standing::Exact {
            // The frame is the middle's between the eyes; each of them sees a novel view. And other methods make others.
            refresh.standing = Standing::Settled;
        }
        Some(refresh)
    }

    /// How long the window may sleep if nothing happens; none: until something does. Frames, pointer and keys wake it.
    fn rest(&self, refresh: Option<&Refresh>, state: &State) -> Option<Duration> {
        let is_settled = refresh
            .is_some_and(|r| matches!(r.standing, Standing::Exact | Standing::Settled | Standing::Offline));
        let is_dead = matches!(state, State::Refused(_));
        if refresh.is_some_and(|r| r.is_ahead) && !is_dead {
            return Some(STILL);
        }
        match (is_settled, self.shows_overlay) {
            // Numbers that change: age, rates, the badge.
            (false, _) if !is_dead => Some(OVERLAY_PERIOD),
            // Only the rate of bytes still falls, and without a connection the age grows.
            (true, true) => Some(SETTLED_PERIOD),
            _ => None,
        }
    }

    /// What was just asked for or said before the connection's trouble before the device's.
    fn banner(&self, now: Duration, model: &OverlayModel) -> Option<String> {
        let problem = || {
            let problem = self.method_problem.clone().or_else(|| self.picture_status.problem())?;
            Some(format!("The newest frame cannot be shown: {problem}"))
        };
        let notice =
            || self.notice.as_ref().filter(|(_, at)| now < *at + NOTICE_TIME).map(|(n, _)| n.clone());
        notice().or_else(|| model.banner()).or_else(problem)
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
        let title = panels::title_of(volume);
        let window = format!("{} – isinglass", volume.name);
        panels::name_window(ctx, &window);
        if title != self.title {
            self.title = title;
            ctx.send_viewport_cmd(egui::ViewportCommand::Title(window));
        }
    }
}

/// Whether no panel lies at a point of the picture.
fn is_free(ctx: &egui::Context, at: egui::Pos2) -> bool {
    ctx.layer_id_at(at).is_none_or(|layer| layer.order == egui::Order::Background)
}

/// A time of which 0 means that it is not known yet.
fn micros(micros: u64) -> Option<Duration> {
    (micros > 0).then(|| Duration::from_micros(micros))
}

/// The picture fills `rect`: one pixel of it is one of the screen.
fn picture_intrinsics(rect: egui::Rect, pixels_per_point: f32, fov_y: f32) -> Intrinsics {
    let pixels = |points: f32| (points * pixels_per_point).round().clamp(1.0, MAX_PICTURE_SIDE) as u32;
    Intrinsics::perspective(pixels(rect.width()), pixels(rect.height()), fov_y)
}

/// Refreshes of the numbers while nothing moves.
const OVERLAY_PERIOD: Duration = Duration::from_millis(100);
/// The same when the picture is the server's own, or none can come.
const SETTLED_PERIOD: Duration = Duration::from_millis(500);
/// The server is told how the viewer fares.
const REPORT_PERIOD: Duration = Duration::from_secs(1);
/// A line of the server's stays so long.
const NOTICE_TIME: Duration = Duration::from_secs(8);
/// A chosen centre of rotation is marked so long.
const CENTER_TIME: Duration = Duration::from_millis(1500);
/// A picture of the look before is called so only then: a fast server is faster.
const OLDER_LOOK_DELAY: Duration = Duration::from_millis(250);
/// A script is asked so often.
const SCRIPT_REFRESH: Duration = Duration::from_millis(30);
/// The largest texture, and so window, that egui's device allows.
const MAX_PICTURE_SIDE: f32 = 8192.0;

#[cfg(test)]
mod tests;
