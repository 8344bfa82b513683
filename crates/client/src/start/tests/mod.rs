//! The real page, list, browser and loading page, without a window; servers on loopback.

use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::ThreadId;
use std::time::{Duration, Instant};

use egui::{Event, Key, Modifiers};
use egui_kittest::Harness;
use egui_kittest::kittest::Queryable;
use isinglass_core::ids::LookVersion;
use isinglass_core::look::Look;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::volume::{Histogram, Volume};
use isinglass_core::wire::VolumeDescription;
use isinglass_formats::{Outline, Recent, Selection, VolumeSource};
use isinglass_net::{Greeting, Identity, Link, Server, ServerOptions};
use tempfile::TempDir;

mod files;
mod layout;
mod recents;
mod remote;
mod states;

use super::*;
use crate::app::options::WindowOptions;
use crate::app::tests::HereSource;
use crate::app::tests::window_walk::assert_all_named;
use crate::paint::novel_view::{LAYERS, NovelViews};
use crate::view::local_servers::{LocalServer, LocalServers};

/// A server that lets in and says what it has, and renders nothing; it ends with the runtime.
fn porter(volume: &Volume) -> (tokio::runtime::Runtime, Vec<Link>) {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
    let greeting = Greeting {
        volume: VolumeDescription::of(volume, &Histogram::of(volume)),
        look_version: LookVersion(1),
        look: Look::new(isinglass_formats::preset("shells").unwrap()),
    };
    let identity = Identity::generate().unwrap();
    let bind = async {
        Server::bind(([127, 0, 0, 1], 0).into(), &identity, ServerOptions::default(), greeting).unwrap()
    };
    let mut server = runtime.block_on(bind);
    let links = (0..3).map(|_| server.mint_link("127.0.0.1").unwrap()).collect();
    runtime.spawn(async move {
        let mut sessions = Vec::new();
        while let Some(session) = server.accept().await {
            sessions.push(session);
        }
    });
    (runtime, links)
}

/// Begins servers when the test lets it.
#[derive(Default)]
struct Servers {
    /// Headers wait for this.
    check_gate: Option<Mutex<Receiver<()>>>,
    /// And servers for this.
    start_gate: Option<Mutex<Receiver<()>>>,
    started: Mutex<Vec<(Selection, [u32; 3])>>,
    num_running: Arc<AtomicUsize>,
    ended_on: Arc<Mutex<Vec<ThreadId>>>,
}

struct Running {
    num_running: Arc<AtomicUsize>,
    ended_on: Arc<Mutex<Vec<ThreadId>>>,
    runtime: Option<tokio::runtime::Runtime>,
}

impl Drop for Running {
    fn drop(&mut self) {
        self.ended_on.lock().unwrap().push(std::thread::current().id());
        self.num_running.fetch_sub(1, Ordering::SeqCst);
        self.runtime.take().unwrap().shutdown_background();
    }
}

const MAX_BYTES: u64 = 1000;

impl LocalServers for Servers {
    fn max_bytes(&self) -> u64 {
        MAX_BYTES
    }

    fn check(&self, outline: &Outline, held: u64) -> Result<(), String> {
        if let Some(gate) = &self.check_gate {
            let _ = gate.lock().unwrap().recv();
        }
        let needed = outline.bytes_needed() + held;
        if needed > MAX_BYTES {
            Err(format!("{}: needs {needed} of {MAX_BYTES}", outline.name))
        } else {
            Ok(())
        }
    }

    fn start(&self, volume: Volume, _: &Outline, request: &LoadRequest) -> Result<LocalServer, String> {
        if let Some(gate) = &self.start_gate {
            let _ = gate.lock().unwrap().recv();
        }
        self.started.lock().unwrap().push((request.selection, volume.dims()));
        self.num_running.fetch_add(1, Ordering::SeqCst);
        let (runtime, mut links) = porter(&volume);
        let (num_running, ended_on) = (self.num_running.clone(), self.ended_on.clone());
        let server = Running { num_running, ended_on, runtime: Some(runtime) };
        Ok(LocalServer { link: links.remove(0), server: Box::new(server) })
    }
}

type Window = Harness<'static, StartWindow>;

/// The page, with a list and a folder of its own.
struct Stage {
    window: Window,
    folder: TempDir,
    servers: Arc<Servers>,
}

impl Stage {
    fn new(servers: Servers, list: impl FnOnce(&Path) -> Recent) -> Self {
        Self::of_size(servers, [1280.0, 720.0], list)
    }

    fn of_size(servers: Servers, size: [f32; 2], list: impl FnOnce(&Path) -> Recent) -> Self {
        Self::on_screen(servers, size, 1.0, list)
    }

    fn begun_with(first: First, list: impl FnOnce(&Path) -> Recent) -> Self {
        Self::begin(Servers::default(), first, [1280.0, 720.0], 1.0, list)
    }

    fn on_screen(
        servers: Servers,
        size: [f32; 2],
        pixels_per_point: f32,
        list: impl FnOnce(&Path) -> Recent,
    ) -> Self {
        Self::begin(servers, First::StartPage, size, pixels_per_point, list)
    }

    fn begin(
        servers: Servers,
        first: First,
        size: [f32; 2],
        pixels_per_point: f32,
        list: impl FnOnce(&Path) -> Recent,
    ) -> Self {
        let folder = TempDir::new().unwrap();
        write_volumes(folder.path());
        let mut recent = list(folder.path());
        recent.folder.get_or_insert_with(|| folder.path().join("data"));
        std::fs::write(folder.path().join("recent.toml"), recent.to_toml()).unwrap();
        let servers = Arc::new(servers);
        let services = Services {
            servers: servers.clone(),
            remote: Some(Arc::new(remote::Machines)),
            recent_file: Some(folder.path().join("recent.toml")),
            has_system_dialog: false,
            calendar: || 1_000_000,
        };
        let micros = Arc::new(AtomicU64::new(0));
        let clock = {
            let micros = micros.clone();
            Clock::new(move || micros.load(Ordering::Relaxed))
        };
        let make = move |ctx: &egui::Context| {
            let views = NovelViews::new(Vec::new(), LAYERS, Arc::new(|| {}));
            let source: BoxedSource = Box::<Nothing>::default();
            let app = ViewerApp::new(WindowOptions::default(), views, source, clock.clone(), Arc::default());
            let wake: Waker = Arc::new(|| {});
            StartWindow::new(app, services, first, ctx, clock, wake)
        };
        let show = move |ui: &mut egui::Ui, state: &mut StartWindow| {
            micros.fetch_add(16_667, Ordering::Relaxed);
            state.show(ui);
        };
        let state = make(&egui::Context::default());
        let builder = Harness::builder().with_size(size).with_pixels_per_point(pixels_per_point);
        let mut window = builder.with_step_dt(1.0 / 60.0).build_ui_state(show, state);
        until(&mut window, "the list", |w| {
            !w.state().recent.entries().is_empty() || recent.entries.is_empty()
        });
        let data = folder.path().join("data");
        until(&mut window, "the folder", |w| w.state().page.browser.folder() == data);
        Self { window, folder, servers }
    }

    fn paste(&mut self, text: &str) {
        self.window.get_by_label("link").focus();
        self.window.run_steps(2);
        self.window.key_press_modifiers(Modifiers::COMMAND, Key::A);
        self.window.event(Event::Paste(text.into()));
        self.window.run_steps(2);
    }

    /// Opens the list of files.
    fn browse(&mut self) {
        self.window.key_press_modifiers(Modifiers::COMMAND, Key::O);
        self.window.run_steps(3);
        wait_for_kinds(&mut self.window);
    }

    fn has(&self, label: &str) -> bool {
        self.window.query_all_by_label_contains(label).next().is_some()
    }

    fn list(&self) -> String {
        std::fs::read_to_string(self.folder.path().join("recent.toml")).unwrap()
    }
}

/// A film of three times, a text, noise, and a folder with a volume of six slices.
fn write_volumes(folder: &Path) {
    let data = folder.join("data");
    std::fs::create_dir_all(data.join("inner")).unwrap();
    let header = "NRRD0004\ntype: uchar\ndimension: 4\nsizes: 6 5 4 3\nspacings: 1 1 1 nan\n\
                  kinds: domain domain domain time\nencoding: raw\n\n";
    std::fs::write(data.join("film.nrrd"), [header.as_bytes(), &[7; 360]].concat()).unwrap();
    std::fs::write(data.join("notes.txt"), "a text").unwrap();
    std::fs::write(data.join("noise.bin"), [0xff; 50]).unwrap();
    let header = "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 6 5 6\nencoding: raw\n\n";
    std::fs::write(data.join("inner/small.nrrd"), [header.as_bytes(), &[7; 180]].concat()).unwrap();
    let header = "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 20 20 20\nencoding: raw\n\n";
    std::fs::write(data.join("large.nrrd"), [header.as_bytes(), &[7; 8000]].concat()).unwrap();
}

/// Refreshes until it is so; how many.
fn until(window: &mut Window, what: &str, is_so: impl Fn(&Window) -> bool) -> usize {
    let patience = Instant::now() + Duration::from_secs(60);
    let mut refreshes = 0;
    while !is_so(window) {
        assert!(Instant::now() < patience, "waited in vain: {what}; {:?}", window.state().problem);
        window.step();
        refreshes += 1;
        std::thread::sleep(Duration::from_millis(1));
    }
    window.run_steps(3);
    refreshes
}

fn is_shown(window: &Window) -> bool {
    !window.state().is_page_shown && window.state().has_session
}

fn press(window: &mut Window, key: Key) {
    window.key_press(key);
    window.run_steps(3);
}

/// Waits until the folder's files are told apart.
fn wait_for_kinds(window: &mut Window) {
    until(window, "what files are", |w| {
        let names = ["film.nrrd", "small.nrrd"];
        names.iter().any(|n| w.query_all_by_label(n).next().is_some())
    });
    // What they hold comes after their names.
    for _ in 0..200 {
        window.step();
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn a_pasted_link_connects_and_the_list_keeps_no_secret() {
    let (_runtime, links) = porter(&Builtin::Shells.volume(16));
    let mut stage = Stage::new(Servers::default(), |_| Recent::default());
    let (link, other) = (links[0].to_string(), &links[1]);
    stage.paste(&format!("isinglass view '{link}'\n"));
    press(&mut stage.window, Key::Enter);
    until(&mut stage.window, "the server", is_shown);
    let place = format!("127.0.0.1:{}", links[0].port);
    until(&mut stage.window, "the list's file", |_| {
        std::fs::read_to_string(stage.folder.path().join("recent.toml")).unwrap().contains(&place)
    });
    let list = stage.list();
    assert!(!list.contains(&links[0].token.reveal()) && !list.contains("sha256"), "{list}");

    // Back to the page and to another server, without a window between.
    stage.window.key_press_modifiers(Modifiers::COMMAND, Key::N);
    stage.window.run_steps(3);
    assert!(stage.has("Connect to a server") && stage.has("Back to the picture"));
    press(&mut stage.window, Key::Escape);
    assert!(is_shown(&stage.window));
    stage.window.get_by_label("Open").click();
    stage.window.run_steps(3);
    stage.paste(&other.to_string());
    stage.window.get_by_label("Connect").click();
    stage.window.run_steps(2);
    until(&mut stage.window, "the other server", is_shown);
    stage.window.key_press_modifiers(Modifiers::COMMAND, Key::N);
    stage.window.run_steps(3);
    stage.window.get_by_label("Close it").click();
    stage.window.run_steps(3);
    assert!(stage.window.state().is_page_shown && !stage.window.state().has_session);
    assert!(!stage.has("Back to the picture"));
}

#[test]
fn what_is_wrong_with_a_link_is_said_on_the_page_and_another_can_be_tried() {
    let (_runtime, links) = porter(&Builtin::Shells.volume(16));
    let mut stage = Stage::new(Servers::default(), |_| Recent::default());
    for (text, message) in [
        ("hello", "Not an isinglass link"),
        ("isinglass://127.0.0.1:4433/", "Link without 'token='"),
        ("isinglass://127.0.0.1/", "Link without a host and port"),
    ] {
        stage.paste(text);
        press(&mut stage.window, Key::Enter);
        assert!(stage.has(message), "{text}");
        assert!(stage.window.state().opening.is_none());
    }
    // A token that nobody was given.
    let token = links[0].token.reveal();
    let wrong = links[0].to_string().replace(&token, &"0".repeat(token.len()));
    stage.paste(&wrong);
    press(&mut stage.window, Key::Enter);
    until(&mut stage.window, "a refusal", |w| w.state().problem.is_some());
    assert!(stage.has("does not know the token") && stage.has("Connect to a server"));
    assert!(!stage.list().contains("127.0.0.1"), "what did not open is not remembered");
    // The link is still there to be mended.
    stage.paste(&links[0].to_string());
    press(&mut stage.window, Key::Enter);
    until(&mut stage.window, "the server", is_shown);
    assert!(stage.window.state().problem.is_none());
}

#[test]
fn the_list_opens_volumes_asks_for_links_and_forgets() {
    let entry = |place, shows: &str| RecentEntry { place, shows: shows.into(), used_at: 996_400 };
    let mut stage = Stage::new(Servers::default(), |folder| Recent {
        folder: None,
        entries: vec![
            entry(RecentPlace::Server { host: "render-01".into(), port: 4433 }, "head.nrrd"),
            entry(
                RecentPlace::Volume(VolumeSource {
                    selection: Selection { time: Some(2), ..Selection::default() },
                    ..VolumeSource::new(folder.join("data/film.nrrd").to_string_lossy())
                }),
                "film.nrrd",
            ),
        ],
    });
    stage.window.get_by_role_and_label(egui::Role::Button, "render-01:4433").click();
    stage.window.run_steps(3);
    assert!(stage.has("paste the new one that 'isinglass serve' printed on render-01"));
    assert!(stage.window.get_by_label("link").is_focused() && stage.window.state().opening.is_none());

    stage.window.get_by_role_and_label(egui::Role::Button, "forget render-01:4433").click();
    stage.window.run_steps(3);
    assert!(stage.window.query_by_role_and_label(egui::Role::Button, "render-01:4433").is_none());
    until(&mut stage.window, "the list's file", |_| {
        !std::fs::read_to_string(stage.folder.path().join("recent.toml")).unwrap().contains("render-01")
    });

    stage.window.get_by_role_and_label(egui::Role::Button, "film.nrrd").click();
    stage.window.run_steps(2);
    until(&mut stage.window, "the volume", is_shown);
    let selection = Selection { time: Some(2), ..Selection::default() };
    assert_eq!(*stage.servers.started.lock().unwrap(), [(selection, [6, 5, 4])]);
}

#[test]
fn files_are_found_chosen_and_opened_by_keyboard() {
    let mut stage = Stage::new(Servers::default(), |_| Recent::default());
    stage.browse();
    stage.window.get_by_label("files").focus();
    stage.window.run_steps(2);
    // Folders first, then by name: inner, film, large, noise, notes.
    for _ in 0..4 {
        press(&mut stage.window, Key::ArrowDown);
    }
    assert!(stage.has("noise.bin is not supported: no header that is known"));
    press(&mut stage.window, Key::Enter);
    assert!(stage.window.state().opening.is_none());
    press(&mut stage.window, Key::ArrowUp);
    until(&mut stage.window, "a header", |w| w.query_by_label_contains("large.nrrd: needs").is_some());
    press(&mut stage.window, Key::Enter);
    assert!(stage.window.state().opening.is_none(), "there is no room for it");
    // Into the folder and back.
    press(&mut stage.window, Key::Home);
    press(&mut stage.window, Key::Enter);
    assert!(stage.window.state().page.browser.folder().ends_with("inner"));
    wait_for_kinds(&mut stage.window);
    press(&mut stage.window, Key::Backspace);
    assert!(stage.window.state().page.browser.folder().ends_with("data"));
    wait_for_kinds(&mut stage.window);
    // By the first letters of its name.
    stage.window.get_by_label("files").focus();
    stage.window.run_steps(2);
    stage.window.event(Event::Text("fi".into()));
    stage.window.run_steps(2);
    until(&mut stage.window, "a header", |w| w.query_by_label_contains("6×5×4 uint8").is_some());
    assert!(stage.has("of 0 to 2") && stage.has("needs 240 bytes of memory"));
    // Only a part of it: the estimate follows.
    stage.window.get_by_label("only a region").click();
    stage.window.run_steps(3);
    let end = stage.window.get_by_label("end of x");
    end.focus();
    stage.window.run_steps(2);
    stage.window.event(Event::Text("5".into()));
    stage.window.run_steps(2);
    press(&mut stage.window, Key::Enter);
    until(&mut stage.window, "a smaller estimate", |w| {
        w.query_by_label_contains("needs 200 bytes").is_some()
    });
    stage.window.get_by_label("files").focus();
    stage.window.run_steps(2);
    press(&mut stage.window, Key::Enter);
    until(&mut stage.window, "the volume", is_shown);
    assert_eq!(stage.servers.started.lock().unwrap()[0].1, [5, 5, 4]);
    // Both are remembered: the volume with its region, and the folder.
    until(&mut stage.window, "the list's file", |_| {
        std::fs::read_to_string(stage.folder.path().join("recent.toml"))
            .unwrap()
            .contains("region = \"0:5,0:5,0:4\"")
    });
    assert!(stage.list().contains("data\"\n"), "{}", stage.list());
}

/// Whether anything waits is counted in refreshes: while a gate is closed, the window goes on.
#[test]
fn a_slow_opening_holds_up_no_refresh_and_can_be_cancelled() {
    let gate = || -> (SyncSender<()>, Option<Mutex<Receiver<()>>>) {
        let (open, gate) = sync_channel(8);
        (open, Some(Mutex::new(gate)))
    };
    let ((check, check_gate), (start, start_gate)) = (gate(), gate());
    let servers = Servers { check_gate, start_gate, ..Servers::default() };
    let mut stage = Stage::new(servers, |_| Recent::default());
    let open = |stage: &mut Stage| {
        let source = stage.folder.path().join("data/film.nrrd").to_string_lossy().into_owned();
        stage
            .window
            .state_mut()
            .open(Act::Open, LoadRequest { max_bytes: MAX_BYTES, ..LoadRequest::new(source) });
    };
    open(&mut stage);
    stage.window.run_steps(50);
    assert!(stage.has("reading the header") && !stage.has("Connect to a server"));
    stage.window.get_by_label("Cancel").click();
    stage.window.run_steps(3);
    assert!(stage.has("Connect to a server") && stage.window.state().opening.is_none());
    check.send(()).unwrap();
    open(&mut stage);
    check.send(()).unwrap();
    until(&mut stage.window, "the last step", |w| w.query_by_label_contains("preparing").is_some());
    stage.window.run_steps(50);
    assert!(stage.has("6×5×4 uint8, 240 bytes of memory"));
    press(&mut stage.window, Key::Escape);
    assert!(stage.window.state().opening.is_none());
    start.send(()).unwrap();
    let started = || stage.servers.started.lock().unwrap().len();
    let patience = Instant::now() + Duration::from_secs(60);
    while started() == 0 || stage.servers.num_running.load(Ordering::SeqCst) > 0 {
        assert!(Instant::now() < patience, "a server that nobody waits for runs on");
        std::thread::sleep(Duration::from_millis(2));
    }
    assert!(!stage.window.state().has_session);
    // The control: not cancelled, it is shown.
    open(&mut stage);
    check.send(()).unwrap();
    start.send(()).unwrap();
    until(&mut stage.window, "the volume", is_shown);

    // A second one beside it: the first is shown until the second is there.
    open(&mut stage);
    stage.window.run_steps(50);
    assert!(is_shown(&stage.window) && stage.has("reading the header"));
    assert_eq!(stage.servers.num_running.load(Ordering::SeqCst), 1);
    check.send(()).unwrap();
    start.send(()).unwrap();
    until(&mut stage.window, "the second", |w| w.state().opening.is_none());
    assert!(is_shown(&stage.window));
    let patience = Instant::now() + Duration::from_secs(60);
    while stage.servers.num_running.load(Ordering::SeqCst) != 1 {
        assert!(Instant::now() < patience, "the first server runs on");
        std::thread::sleep(Duration::from_millis(2));
    }
    assert_eq!(stage.servers.started.lock().unwrap().len(), 3);
}

#[derive(Debug)]
struct DroppedFile(PathBuf);

impl egui::DroppedFile for DroppedFile {
    fn path(&self) -> &Path {
        &self.0
    }

    fn bytes(&self) -> Result<Vec<u8>, String> {
        Err("nobody reads it this way".into())
    }
}
