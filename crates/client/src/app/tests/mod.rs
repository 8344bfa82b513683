//! The whole window's widgets and keys on a volume that is rendered here.

use std::cell::{RefCell, RefMut};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use egui::{Event, Key, Modifiers, PointerButton, vec2};
use egui_kittest::Harness;
use egui_kittest::kittest::Queryable;
use isinglass_core::camera::{Camera, Pose};
use isinglass_core::cancel::ALWAYS;
use isinglass_core::ids::{FrameId, LookVersion, PoseId};
use isinglass_core::kernels::layering::generate;
use isinglass_core::kernels::march::{MarchSettings, Scene, render};
use isinglass_core::layer::FrameHeader;
use isinglass_core::look::Look;
use isinglass_core::mode::Mode;
use isinglass_core::session::ClientSession;
use isinglass_core::session::ledger::Life;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Placement, Slice};
use isinglass_core::wire::{ClientMessage, Part, ScreenshotRequest, Token, VolumeDescription, Welcome};
use isinglass_net::{LinkStats, ReceivedFrame, State, Talking};

use super::*;
use crate::input::bindings::Bindings;
use crate::input::camera_controls::InitialOrbit;
use crate::paint::novel_view::LAYERS;
use crate::view::viewing::FrameSize;

mod bars;
mod keeping;
pub(crate) mod window_walk;

/// A server in a moment: frames of 48 pixels, made when they are asked for. While it `sleeps`, looks wait.
pub(crate) struct HereSource {
    session: Mutex<ClientSession>,
    here: RefCell<Here>,
    micros: Arc<AtomicU64>,
}

struct Here {
    scene: Scene,
    described: Option<Arc<Welcome>>,
    look: (LookVersion, Arc<Look>),
    wanted: Option<Look>,
    asked: Option<(Pose, Intrinsics)>,
    /// The camera of another person, whose frames come while the window follows.
    leader: Option<Camera>,
    is_following: bool,
    frame: Option<Arc<ReceivedFrame>>,
    num_frames: u32,
    num_looks: usize,
    sleeps: bool,
    orientation: Option<String>,
    placement: Option<Placement>,
    num_probes: usize,
    num_shots: u32,
    num_cancelled: usize,
    /// Parts that were requested.
    selected: Vec<Part>,
    num_slice_lists: usize,
    /// Slices of the newest list.
    num_wanted_slices: usize,
    state: State,
    stats: LinkStats,
}

impl HereSource {
    pub(crate) fn new() -> Self {
        let transfer = isinglass_formats::preset("shells").unwrap();
        let scene = Scene::new(Arc::new(Builtin::Shells.volume(24)), &transfer, MarchSettings::default());
        let look = Look::new(transfer);
        let here = Here {
            scene,
            described: None,
            look: (LookVersion(1), Arc::new(look)),
            wanted: None,
            asked: None,
            leader: None,
            is_following: false,
            frame: None,
            num_frames: 0,
            num_looks: 0,
            sleeps: false,
            orientation: None,
            placement: None,
            num_probes: 0,
            num_shots: 0,
            num_cancelled: 0,
            selected: Vec::new(),
            num_slice_lists: 0,
            num_wanted_slices: 0,
            state: State::Connected,
            stats: LinkStats::default(),
        };
        let mut session = ClientSession::default();
        session.handle_welcome(0, here.welcome());
        Self { session: Mutex::new(session), here: RefCell::new(here), micros: Arc::default() }
    }

    fn here(&self) -> RefMut<'_, Here> {
        self.here.borrow_mut()
    }

    /// Answers what was asked since the last time.
    fn serve(&self) {
        let (mut session, now) = (self.session.lock().unwrap(), self.micros.load(Ordering::Relaxed));
        let here = &mut *self.here();
        while let Some(message) = session.poll_message(now) {
            match message {
                ClientMessage::SetLook(look) => {
                    here.num_looks += 1;
                    here.wanted = Some(look);
                }
                ClientMessage::Probe(question) => {
                    here.num_probes += 1;
                    session.probe.handle_answer(question.answer(&mut &*here.scene.volume));
                }
                ClientMessage::Profile(question) => {
                    session.profile.handle_answer(question.answer(&mut &*here.scene.volume));
                }
                ClientMessage::TakeScreenshot(shot) => {
                    here.num_shots += 1;
                    if !here.sleeps {
                        session.screenshot.handle_png(shot.id, here.png(&shot));
                    }
                }
                ClientMessage::Select(part) => here.selected.push(part),
                ClientMessage::CancelScreenshot => here.num_cancelled += 1,
                ClientMessage::Follow(leader) => {
                    here.is_following = leader.is_some();
                    here.render();
                }
                ClientMessage::WantSlices(list) => {
                    here.num_slice_lists += 1;
                    here.num_wanted_slices = list.slices.len();
                    for wanted in list.slices.iter().filter(|_| !here.sleeps) {
                        let slice = Slice::of(&here.scene.volume, &wanted.spec, ALWAYS).unwrap();
                        session.slices.handle_slice(wanted.id, slice, false);
                    }
                }
                _ => {}
            }
        }
        if let Some(look) = here.wanted.take_if(|_| !here.sleeps) {
            let volume = here.scene.volume.clone();
            here.scene = Scene::new(volume, &look.transfer, look.march_settings());
            here.look = (here.look.0.next(), Arc::new(look.clone()));
            session.look.handle_changed(now, here.look.0, look, false);
            here.render();
        }
    }
}

impl Here {
    fn welcome(&self) -> Welcome {
        let mut volume = VolumeDescription::of(&self.scene.volume, &self.scene.histogram);
        volume.orientation.clone_from(&self.orientation);
        volume.placement = self.placement;
        Welcome {
            ticket: Token::new([0; 16]),
            volume,
            look_version: self.look.0,
            look: (*self.look.1).clone(),
            max_side: 4096,
            max_poses_per_second: 100,
        }
    }

    fn png(&self, shot: &ScreenshotRequest) -> Vec<u8> {
        let view = shot.view().unwrap();
        let camera = Camera::new(view.pose, view.intrinsics, &self.scene.volume.bounds());
        let scene = match shot.look.as_deref() {
            Some(look) => Scene::new(self.scene.volume.clone(), &look.transfer, look.march_settings()),
            None => self.scene.clone(),
        };
        let picture = render(&scene, &camera);
        let bytes = match shot.background {
            Some(background) => {
                picture.to_srgb8(ViewAids { background, ..ViewAids::default() }.linear_background())
            }
            None => picture.to_srgba8(),
        };
        isinglass_formats::png::encode(view.intrinsics.width, view.intrinsics.height, &bytes).unwrap()
    }

    fn render(&mut self) {
        let Some((pose, intrinsics)) = self.asked.filter(|_| !self.sleeps) else { return };
        self.num_frames += 1;
        let own = Camera::new(pose, intrinsics, &self.scene.volume.bounds());
        let led = self.leader.filter(|_| self.is_following);
        let header = FrameHeader {
            frame: FrameId(self.num_frames),
            // A leader's frame answers no pose of this window.
            pose: if led.is_some() { PoseId(0) } else { PoseId(self.num_frames) },
            look: self.look.0,
            camera: led.unwrap_or(own),
            k: self.look.1.k,
            mode: Default::default(),
            fineness: Default::default(),
        };
        let frame = generate(&self.scene, header);
        let times = Life::default();
        self.frame = Some(Arc::new(ReceivedFrame { frame, is_exact: true, times }));
    }
}

impl FrameSource for HereSource {
    fn talk(&self) -> Talking<'_, ClientSession> {
        self.serve();
        Talking::alone(&self.session)
    }

    fn latest_frame(&self) -> Option<Arc<ReceivedFrame>> {
        self.here().frame.clone()
    }

    fn note_shown(&mut self, _frame: FrameId) {}

    fn state(&self) -> State {
        self.here().state.clone()
    }

    fn stats(&self) -> LinkStats {
        self.here().stats
    }

    fn set_pose(&mut self, _now: Duration, pose: Pose, intrinsics: Intrinsics) {
        let here = self.here.get_mut();
        here.asked = Some((pose, intrinsics));
        here.render();
    }

    fn description(&self) -> Option<Arc<Welcome>> {
        let here = &mut *self.here();
        let welcome = here.welcome();
        // As in a session, the description stays until there is another volume.
        if here.described.as_ref().is_none_or(|described| described.volume != welcome.volume) {
            here.described = Some(Arc::new(welcome));
        }
        here.described.clone()
    }

    fn is_of_volume(&self, _frame: &ReceivedFrame) -> bool {
        true
    }
}

/// At rest: the first picture is there.
fn window(size: [f32; 2]) -> Harness<'static, ViewerApp<HereSource>> {
    window_of(size, 1.0)
}

/// The same on a screen of so many pixels a point.
fn window_of(size: [f32; 2], pixels_per_point: f32) -> Harness<'static, ViewerApp<HereSource>> {
    window_on(HereSource::new(), InitialOrbit::default(), size, pixels_per_point)
}

fn window_on(
    source: HereSource,
    initial_orbit: InitialOrbit,
    size: [f32; 2],
    pixels_per_point: f32,
) -> Harness<'static, ViewerApp<HereSource>> {
    let options = WindowOptions { frame_size: SMALL, initial_orbit, ..WindowOptions::default() };
    window_with(options, source, size, pixels_per_point)
}

const SMALL: FrameSize = FrameSize { max_width: 48, max_height: 48, scale: 1.0, moving_budget: None };

fn window_with(
    options: WindowOptions,
    source: HereSource,
    size: [f32; 2],
    pixels_per_point: f32,
) -> Harness<'static, ViewerApp<HereSource>> {
    let micros = source.micros.clone();
    let clock = {
        let micros = micros.clone();
        Clock::new(move || micros.load(Ordering::Relaxed))
    };
    let views = NovelViews::new(Vec::new(), LAYERS, Arc::new(|| {}));
    let app = ViewerApp::new(options, views, source, clock, Arc::default());
    // A display at 60 Hz.
    let show = move |ui: &mut egui::Ui, app: &mut ViewerApp<HereSource>| {
        micros.fetch_add(16_667, Ordering::Relaxed);
        app.show(ui);
    };
    let mut window = Harness::builder()
        .with_size(vec2(size[0], size[1]))
        .with_pixels_per_point(pixels_per_point)
        .with_step_dt(1.0 / 60.0)
        .build_ui_state(show, app);
    rest(&mut window);
    window
}

fn rest(w: &mut Harness<'_, ViewerApp<HereSource>>) {
    w.run_steps(40);
}

fn press(w: &mut Harness<'_, ViewerApp<HereSource>>, modifiers: Modifiers, key: Key) {
    w.key_press_modifiers(modifiers, key);
    rest(w);
}

/// The server's picture that is on the screen.
fn picture(w: &Harness<'_, ViewerApp<HereSource>>) -> Vec<u8> {
    let app = w.state();
    let frame = app.viewing.source().latest_frame().unwrap();
    frame.frame.flatten().to_srgb8(app.aids.linear_background())
}

fn pose(w: &Harness<'_, ViewerApp<HereSource>>) -> Pose {
    w.state().controls.as_ref().unwrap().1.pose()
}

fn open_panel(w: &mut Harness<'_, ViewerApp<HereSource>>) {
    press(w, Modifiers::NONE, Key::L);
    assert!(w.query_by_label("opacity over values").is_some(), "l opens the panel");
}

fn drag(w: &mut Harness<'_, ViewerApp<HereSource>>, from: egui::Pos2, by: egui::Vec2, modifiers: Modifiers) {
    let button =
        |pos, pressed| Event::PointerButton { pos, button: PointerButton::Primary, pressed, modifiers };
    w.event(Event::PointerMoved(from));
    w.event(button(from, true));
    for i in 1..=6 {
        w.event(Event::PointerMoved(from + by * (i as f32 / 6.0)));
    }
    w.event(button(from + by, false));
    rest(w);
}

#[test]
fn editing_a_point_changes_the_picture_and_undo_brings_it_back_to_the_byte() {
    let mut w = window([1280.0, 720.0]);
    open_panel(&mut w);
    let before = picture(&w);
    // A point of the outermost shell: matter there becomes nearly clear.
    let point = w.get_by_label_contains("point 3 of ").rect().center();
    drag(&mut w, point, vec2(0.0, 60.0), Modifiers::NONE);
    let edited = picture(&w);
    let most = before.iter().zip(&edited).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
    assert!(most > 10, "by no more than {most} of 255");
    press(&mut w, Modifiers::COMMAND, Key::Z);
    assert_eq!(picture(&w), before);
    press(&mut w, Modifiers::COMMAND.plus(Modifiers::SHIFT), Key::Z);
    assert_eq!(picture(&w), edited);
    assert!(w.state().editor.has_selection());
    press(&mut w, Modifiers::NONE, Key::Escape);
    assert!(!w.state().editor.has_selection(), "the curve gets the key, too");
    // What the picture on the screen stands for is said all the time.
    let version = w.state().viewing.source().latest_frame().unwrap().frame.header.look;
    assert_eq!(version, w.state().viewing.source().here().look.0);
}

#[test]
fn edits_are_paced_and_a_picture_of_the_look_before_is_called_so() {
    let mut w = window([1280.0, 720.0]);
    open_panel(&mut w);
    let point = w.get_by_label_contains("point 2 of ").rect().center();
    assert!(w.query_by_label_contains("shown with the look before").is_none());
    w.state().viewing.source().here().sleeps = true;
    let looks = w.state().viewing.source().here().num_looks;
    let button = |pos, pressed| Event::PointerButton {
        pos,
        button: PointerButton::Primary,
        pressed,
        modifiers: Modifiers::NONE,
    };
    w.event(Event::PointerMoved(point));
    w.event(button(point, true));
    // One second of dragging at 60 refreshes a second.
    for i in 1..=60 {
        w.event(Event::PointerMoved(point + vec2(0.0, -(i as f32) * 0.5)));
    }
    w.step();
    let sent = w.state().viewing.source().here().num_looks - looks;
    assert!((20..=31).contains(&sent), "{sent} looks in a second");
    w.event(button(point, false));
    rest(&mut w);
    assert!(w.query_by_label_contains("shown with the look before").is_some());
    let last = w.state().viewing.source().here().wanted.clone().unwrap();
    assert_eq!(w.state().viewing.look().as_deref(), Some(&last), "the newest has arrived");
    w.state().viewing.source().here().sleeps = false;
    rest(&mut w);
    assert!(w.query_by_label_contains("shown with the look before").is_none());
}

#[test]
fn every_preset_in_the_panel_is_what_its_label_says() {
    for (name, title) in [("shells", "Shells"), ("smooth", "Smooth")] {
        let mut w = window([1280.0, 720.0]);
        open_panel(&mut w);
        w.get_by_role_and_label(egui::Role::ComboBox, "preset").click();
        w.run_steps(4);
        let foreign = w.query_by_role_and_label(egui::Role::Button, "CT bone");
        assert!(foreign.is_none(), "not of this volume");
        w.get_by_role_and_label(egui::Role::Button, title).click();
        rest(&mut w);
        let transfer = w.state().viewing.source().here().look.1.transfer.clone();
        assert_eq!(Some(transfer), isinglass_formats::preset(name));
    }
}

#[test]
fn a_body_is_seen_upright_at_first() {
    let first = |letters: Option<&str>| {
        let orbit = InitialOrbit { elevation_degrees: 0.0, azimuth_degrees: 0.0, ..Default::default() };
        let source = HereSource::new();
        source.here().orientation = letters.map(Into::into);
        pose(&window_on(source, orbit, [640.0, 480.0], 1.0))
    };
    for letters in [None, Some("RAS"), Some("LPS")] {
        let (from, up) = Orientation::of(letters).standard_view(crate::input::bindings::Side::Front, false);
        let pose = first(letters);
        assert!((pose.forward() + from).length() < 1e-5, "{letters:?}");
        assert!((pose.world_from_view * glam::Vec3::Y - up).length() < 1e-5, "{letters:?}");
    }
    assert_ne!(first(None), first(Some("RAS")), "negative control");
}

#[test]
fn standard_views_look_from_where_the_key_says() {
    let mut w = window([640.0, 480.0]);
    let first = pose(&w);
    for letters in [None, Some("RAS".to_owned())] {
        w.state().viewing.source().here().orientation.clone_from(&letters);
        let orientation = Orientation::of(letters.as_deref());
        for (key, side) in [
            (Key::Num1, crate::input::bindings::Side::Front),
            (Key::Num3, crate::input::bindings::Side::Right),
            (Key::Num7, crate::input::bindings::Side::Top),
        ] {
            for (modifiers, opposite) in [(Modifiers::NONE, false), (Modifiers::SHIFT, true)] {
                press(&mut w, modifiers, key);
                let (from, up) = orientation.standard_view(side, opposite);
                let pose = pose(&w);
                assert!((pose.forward() + from).length() < 1e-5, "{key:?} {opposite}");
                assert!((pose.world_from_view * glam::Vec3::Y - up).length() < 1e-5);
            }
        }
    }
    press(&mut w, Modifiers::NONE, Key::R);
    assert_eq!(pose(&w), first);
}

#[test]
fn keys_switch_what_they_say() {
    let mut w = window([900.0, 700.0]);
    let shown =
        |w: &Harness<'_, ViewerApp<HereSource>>, label: &str| w.query_by_label_contains(label).is_some();
    for is_shown in [false, true, false] {
        assert_eq!(shown(&w, "server frame"), is_shown);
        press(&mut w, Modifiers::NONE, Key::O);
    }
    press(&mut w, Modifiers::NONE, Key::H);
    for (keys, text) in Bindings::default().lines() {
        assert!(w.query_all_by_label(text).next().is_some(), "{keys} is in the help");
    }
    press(&mut w, Modifiers::NONE, Key::Escape);
    assert!(!shown(&w, "make the point there"));
    for (key, of) in [
        (Key::B, (|aids: &ViewAids| aids.shows_box) as fn(&ViewAids) -> bool),
        (Key::A, |aids: &ViewAids| aids.shows_axes),
        (Key::K, |aids: &ViewAids| aids.shows_legend),
    ] {
        let before = of(&w.state().aids);
        press(&mut w, Modifiers::NONE, key);
        assert_ne!(of(&w.state().aids), before, "{key:?}");
    }
    press(&mut w, Modifiers::NONE, Key::S);
    assert!(!w.state().stereo.is_mono());
    let before = pose(&w);
    drag(&mut w, egui::pos2(300.0, 300.0), vec2(60.0, 40.0), Modifiers::NONE);
    assert_ne!(pose(&w), before, "a drag over the picture turns it");
}

#[test]
fn the_key_m_goes_through_the_modes_and_surfaces_have_their_values_in_the_panel() {
    let mut w = window([900.0, 700.0]);
    let first = picture(&w);
    let mut seen = vec![first.clone()];
    for mode in Mode::ALL.into_iter().cycle().skip(1).take(4) {
        press(&mut w, Modifiers::NONE, Key::M);
        assert_eq!(w.state().viewing.look().unwrap().mode, mode);
        let now = picture(&w);
        assert!(!seen.contains(&now), "{mode} looks like another mode");
        seen.push(now);
    }
    // The last one is that of surfaces, which has a value where nobody has chosen any.
    let isos = |w: &Harness<'_, ViewerApp<HereSource>>| w.state().viewing.look().unwrap().isos;
    let (lo, hi) = w.state().value_scale().unwrap().range;
    let value = isos(&w).as_slice()[0].value;
    assert!(isos(&w).as_slice().len() == 1 && lo < value && value < hi, "{value}");
    open_panel(&mut w);
    assert!(w.query_by_label("value of surface 1").is_some());
    let only = isos(&w).as_slice()[0];
    w.get_by_label("add a surface").click();
    rest(&mut w);
    assert!(isos(&w).as_slice().len() == 2 && isos(&w).as_slice()[0] == only, "the first stays as it was");
    assert_ne!(&picture(&w), seen.last().unwrap());
    w.get_by_label("remove surface 1").click();
    rest(&mut w);
    assert_eq!(isos(&w).as_slice().len(), 1);
    press(&mut w, Modifiers::NONE, Key::L);
    press(&mut w, Modifiers::NONE, Key::M);
    assert_eq!(picture(&w), first);
}

#[test]
fn a_double_click_makes_what_is_seen_the_centre_of_rotation() {
    let mut w = window([640.0, 480.0]);
    let at = egui::pos2(340.0, 225.0);
    let before = pose(&w);
    w.event(Event::PointerMoved(at));
    for pressed in [true, false, true, false] {
        let button = PointerButton::Primary;
        w.event(Event::PointerButton { pos: at, button, pressed, modifiers: Modifiers::NONE });
    }
    rest(&mut w);
    let center = w.state().controls.as_ref().unwrap().1.center();
    assert!(center.length() > 0.1, "no longer the volume's middle: {center}");
    let moved = pose(&w).eye - before.eye;
    assert!(moved.length() < 1e-4, "the view stays: {moved}");
    drag(&mut w, egui::pos2(100.0, 400.0), vec2(50.0, -30.0), Modifiers::NONE);
    let app = w.state();
    let (bounds, controls) = app.controls.as_ref().unwrap();
    let (picture, at) = (app.window.unwrap(), at - app.room.min.to_vec2());
    let basis = controls.camera(picture, bounds).basis();
    let h = basis.pixel_from_point(center);
    // A step of the search along the ray, seen from the side, is less than half a pixel.
    assert!((h.x / h.z - at.x).abs() < 0.5 && (h.y / h.z - at.y).abs() < 0.5, "{} {}", h.x / h.z, h.y / h.z);
}

#[test]
fn the_background_is_what_was_chosen() {
    let mut w = window([1280.0, 720.0]);
    open_panel(&mut w);
    let before = picture(&w);
    w.get_by_label("View").scroll_to_me();
    rest(&mut w);
    w.get_by_label("View").click();
    rest(&mut w);
    w.get_by_label("white").scroll_to_me();
    rest(&mut w);
    w.get_by_label("white").click();
    rest(&mut w);
    assert_eq!(w.state().aids.background, [255; 3]);
    assert_eq!(picture(&w)[..3], [255; 3], "the corner of the picture is empty");
    assert_eq!(before[..3], [0; 3]);
}

#[test]
fn every_control_has_a_name_in_both_themes_and_at_small_sizes() {
    for (size, theme) in [([1280.0, 720.0], egui::Theme::Dark), ([700.0, 420.0], egui::Theme::Light)] {
        let mut w = window(size);
        w.ctx.set_theme(theme);
        open_panel(&mut w);
        for section in ["Light", "Clip", "View", "Advanced"] {
            w.get_by_label(section).scroll_to_me();
            w.run_steps(4);
            w.get_by_label(section).click();
            w.run_steps(4);
        }
        assert_eq!(w.unnamed_widgets(), Vec::<String>::new());
    }
}

mod access;
mod choices;
mod clip;
mod measures;
mod narrow;
mod offline;
mod slices;
mod states;
mod times;
mod views;
