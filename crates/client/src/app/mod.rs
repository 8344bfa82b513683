//! One viewer in a window. At each refresh the input moves the camera, the camera sets the request, and the newest
//! frame is drawn.

mod actions;
mod bars;
mod choices;
mod icon_strip;
mod measure;
pub(crate) mod open_dialog;
pub(crate) mod options;
mod path;
mod picture;
mod refresh;
pub(crate) mod script;
mod sections;
mod shown_volume;
pub(crate) mod side_panel;
mod slices;
mod state;
mod state_part;
mod views;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use isinglass_core::camera::Intrinsics;
use isinglass_core::mode::Mode;
use isinglass_core::space::Aabb;
use isinglass_formats::{LoadRequest, NamedView, ReadState, UpAxis, VolumeSource};
use isinglass_net::{Clock, Link};

use self::choices::ChoiceKeeper;
use self::measure::SeenPicture;
use self::open_dialog::OpenDialog;
use self::options::{USUAL_HZ, WindowOptions};
use self::path::Recording;
use self::shown_volume::ShownVolume;
use self::state::ComingState;
pub(crate) use self::state::theme_preference;
use crate::input::bindings::{Action, Focus};
use crate::input::camera_controls::CameraControls;
use crate::input::camera_moves::CameraMoves;
use crate::input::orientation::Orientation;
use crate::input::pointer::Pointer;
use crate::paint::clip_editor::{self, ClipEditor};
use crate::paint::measure::MeasureEditor;
use crate::paint::novel_view::NovelViews;
use crate::paint::picture::PictureStatus;
use crate::paint::stereo::Stereo;
use crate::paint::view_aids::ViewAids;
use crate::panels::gallery::Gallery;
use crate::panels::hints::Hints;
use crate::panels::measure::MeasureBar;
use crate::panels::parts_bar::PartsBar;
use crate::panels::probe::ValueProbe;
use crate::panels::screenshots::Screenshots;
use crate::panels::slices::SlicePanes;
use crate::panels::state_files::StateFiles;
use crate::panels::transfer::TransferEditor;
use crate::view::frame_source::FrameSource;
use crate::view::local_servers::LocalServers;
use crate::view::quality_control::QualityControl;
use crate::view::refresh_meter::RefreshMeter;
use crate::view::viewing::{Standing, Viewing};
use crate::view::waker_of;

/// What is known of a source of frames.
#[derive(Default)]
pub(crate) struct Origin {
    /// The name of the server for the person at the viewer.
    pub(crate) server_name: String,
    /// The server's link, from which links to the view are made.
    pub(crate) link: Option<Link>,
    /// What the server opened, if known; a saved state names it.
    pub(crate) volume_source: Option<VolumeSource>,
    /// Shown instead of the first view.
    pub(crate) state: Option<ReadState>,
}

/// What the viewer leaves to the window around it.
pub(crate) enum AppWish {
    /// Show the start page.
    StartPage,
    /// Let the person choose a file.
    ChooseFile,
    /// Open a volume.
    Volume(LoadRequest),
    /// Open the volume of a state.
    State(Box<ReadState>),
    /// Connect to another server, and show it as the state says if the link has no state of its own.
    Server(Box<(Link, Option<ReadState>)>),
}

pub(crate) struct ViewerApp<S> {
    options: WindowOptions,
    viewing: Viewing<S>,
    shown_volume: Option<ShownVolume>,
    controls: Option<(Aabb, CameraControls)>,
    moves: CameraMoves,
    /// Whether the camera goes to that of the person to follow, once a frame shows it.
    joins_leader: bool,
    /// Whether the camera is on its way to a chosen view.
    is_turning: bool,
    up_axis: UpAxis,
    named_views: Vec<NamedView>,
    clock: Clock,
    opened_at: Duration,
    last_refresh: Duration,
    was_active: bool,
    last_standing: Option<Standing>,
    /// Whether the refresh before had older frames to cast.
    had_kept: bool,
    refreshes: RefreshMeter,
    quality: QualityControl,
    picture_status: Arc<PictureStatus>,
    novel_views: NovelViews,
    method_problem: Option<String>,
    stereo: Stereo,
    /// How often the person asked for the next mode since the last refresh.
    next_modes: usize,
    /// Whether the picture has bars and panels around it.
    shows_bars: bool,
    shows_numbers: bool,
    /// What is left for the picture, points.
    room: egui::Rect,
    /// Actions of buttons and menus, to be done with those of keys.
    chosen_actions: Vec<Action>,
    /// The mode that was chosen since the last refresh.
    chosen_mode: Option<Mode>,
    aids: ViewAids,
    is_orthographic: bool,
    clip_editor: ClipEditor,
    /// Where the clip handles were drawn.
    clip_view: Option<clip_editor::ClipView>,
    /// The volume that the clip was last checked for.
    clip_bounds: Option<Aabb>,
    center_chosen_at: Option<Duration>,
    editor: TransferEditor,
    state_files: StateFiles,
    open_dialog: OpenDialog,
    coming: Option<ComingState>,
    /// Whether other volumes can be opened in this window.
    opens_volumes: bool,
    window: Option<Intrinsics>,
    shows_help: bool,
    help_search: String,
    pub(crate) hints: Hints,
    is_look_open: bool,
    pointer: Pointer,
    probe: ValueProbe,
    measures: MeasureEditor,
    measure_bar: MeasureBar,
    seen_picture: Option<SeenPicture>,
    screenshots: Screenshots,
    recording: Option<Recording>,
    gallery: Gallery,
    slices: SlicePanes,
    wants_picture: bool,
    title: String,
    notice: Option<(String, Duration)>,
    reported_at: Duration,
    parts_bar: PartsBar,
    wish: Option<AppWish>,
    keeper: ChoiceKeeper,
}

impl<S: FrameSource> ViewerApp<S> {
    /// `picture_status` receives reports from painting. `clock` is the clock of the source's stamps.
    pub(crate) fn new(
        options: WindowOptions,
        novel_views: NovelViews,
        source: S,
        clock: Clock,
        picture_status: Arc<PictureStatus>,
    ) -> Self {
        let opened_at = Duration::from_micros(clock.now_micros());
        let viewing = Viewing::new(source, options.frame_size, options.foresight);
        let shows_panel = options.shows_panel;
        let (file, chosen) = (options.choices_file.clone(), options.choices.clone());
        let keeper = ChoiceKeeper::new(file, chosen, options.has_light);
        let quality = QualityControl::new(options.refresh_hz.unwrap_or(USUAL_HZ));
        Self {
            stereo: options.stereo,
            shows_bars: options.shows_bars,
            shows_numbers: false,
            room: egui::Rect::ZERO,
            chosen_actions: Vec::new(),
            chosen_mode: None,
            aids: ViewAids { shows_axes: options.shows_bars, ..ViewAids::default() },
            is_orthographic: options.is_orthographic,
            clip_editor: ClipEditor::default(),
            clip_view: None,
            clip_bounds: None,
            options,
            viewing,
            shown_volume: None,
            controls: None,
            moves: CameraMoves::default(),
            joins_leader: false,
            is_turning: false,
            up_axis: UpAxis::default(),
            named_views: Vec::new(),
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
            window: None,
            shows_help: false,
            help_search: String::new(),
            hints: Hints::default(),
            is_look_open: shows_panel,
            pointer: Pointer::default(),
            probe: ValueProbe::default(),
            measures: MeasureEditor::default(),
            measure_bar: MeasureBar::default(),
            seen_picture: None,
            screenshots: Screenshots::default(),
            recording: None,
            gallery: Gallery::default(),
            slices: SlicePanes::default(),
            wants_picture: false,
            title: String::new(),
            notice: None,
            reported_at: Duration::ZERO,
            parts_bar: PartsBar::default(),
            wish: None,
            keeper,
        }
    }

    /// Shows another source, from its first view or its state on. Returns the source before.
    pub(crate) fn turn_to(&mut self, source: S, origin: Origin) -> S {
        let Origin { server_name, link, volume_source, state } = origin;
        self.options.server_name = server_name;
        (self.options.link, self.options.volume_source) = (link, volume_source);
        if state.is_some() {
            (self.options.state, self.options.state_sets_size) = (None, false);
        }
        let viewing = Viewing::new(source, self.viewing.frame_size, self.options.foresight);
        (self.controls, self.center_chosen_at) = (None, None);
        (self.up_axis, self.named_views) = (UpAxis::default(), Vec::new());
        self.moves.clear();
        (self.was_active, self.last_standing, self.had_kept) = (false, None, false);
        (self.editor, self.parts_bar) = (TransferEditor::default(), PartsBar::default());
        self.gallery = Gallery::default();
        self.slices.forget();
        self.shown_volume = None;
        self.measures.set(Vec::new());
        (self.measure_bar, self.seen_picture) = (MeasureBar::default(), None);
        self.recording = None;
        self.keeper.turn();
        (self.coming, self.wish) = (state.map(ComingState::new), None);
        let now = Duration::from_micros(self.clock.now_micros());
        (self.notice, self.method_problem) = (self.screenshots.forget().map(|told| (told, now)), None);
        self.title.clear();
        std::mem::replace(&mut self.viewing, viewing).into_source()
    }

    /// States of other volumes are left to the start window from now on.
    pub(crate) fn leave_volumes_to_others(&mut self) {
        self.opens_volumes = true;
    }

    /// What the person asked for since the last call.
    pub(crate) fn take_wish(&mut self) -> Option<AppWish> {
        self.wish.take()
    }

    /// Lets the file dialog offer volumes. `servers` open them; `held` is the size of the volume shown, bytes. The
    /// list starts in `folder`.
    pub(crate) fn offer_volumes(&mut self, servers: Arc<dyn LocalServers>, held: u64, folder: &Path) {
        self.open_dialog.offer_volumes(servers, held, folder);
    }

    /// The actions of keys where nothing is shown.
    pub(crate) fn take_page_actions(&self, ctx: &egui::Context) -> Vec<Action> {
        ctx.input_mut(|i| self.options.bindings.take_actions(&mut i.events, Focus::Text))
    }

    /// Opens the list of files over the picture.
    pub(crate) fn open_file_dialog(&mut self, ctx: &egui::Context) {
        self.open_dialog.open(ctx);
    }

    /// Opens that list at a volume, with its size and parts. `is_folder` if the files in it are the volume together.
    pub(crate) fn open_file_dialog_at(&mut self, ctx: &egui::Context, volume: PathBuf, is_folder: bool) {
        self.open_dialog.open_at(ctx, volume, is_folder);
    }

    /// Opens a file of a state, or of colours and opacities.
    pub(crate) fn open_any(&mut self, path: PathBuf, ctx: &egui::Context) {
        self.state_files.open_any(path, &waker_of(ctx));
    }

    /// Colour behind the volume, linear.
    pub(crate) fn background(&self) -> [f32; 3] {
        self.aids.linear_background()
    }

    pub(crate) fn warm_up(&self) {
        self.picture_status.submit_warm_up();
    }

    /// The camera controls for the source's volume. A volume of another size is seen from the same side.
    fn controls(&mut self, picture: &Intrinsics) -> Option<&mut (Aabb, CameraControls)> {
        let bounds = self.viewing.source().description()?.volume.bounds();
        match &mut self.controls {
            Some((of, controls)) if *of != bounds => {
                controls.turn_to(&bounds);
                *of = bounds;
                self.moves.clear();
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
            .with_up(self.up_axis)
    }

    /// Whether a dialog lies over the picture.
    fn has_dialog(&self) -> bool {
        self.shows_help || self.screenshots.is_dialog_open() || self.open_dialog.is_open()
    }

    fn tell(&mut self, now: Duration, text: impl Into<String>) {
        self.notice = Some((text.into(), now));
    }

    pub(crate) fn source(&self) -> &S {
        self.viewing.source()
    }
}

impl<S: FrameSource> eframe::App for ViewerApp<S> {
    fn ui(&mut self, ui: &mut egui::Ui, _frame: &mut eframe::Frame) {
        self.show(ui);
    }

    fn on_exit(&mut self) {
        self.finish_choices();
    }
}

/// Whether no panel covers a point of the picture.
fn is_free(ctx: &egui::Context, room: egui::Rect, at: egui::Pos2) -> bool {
    room.contains(at) && ctx.layer_id_at(at).is_none_or(|layer| layer.order == egui::Order::Background)
}

#[cfg(test)]
pub(crate) mod tests;
