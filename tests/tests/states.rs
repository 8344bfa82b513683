//! Does a state bring the server back to the channel that it was made of, and give the very same picture?
//!
//! The whole window, without a display: its real widgets on a real connection to a server with a file of three channels.
//! The judge is the renderer's twin, which knows the state and the voxels and nothing of viewer, wire or server. Tolerance:
//! 1/255, as a frame at its own pose is the server's picture but for the rounding of its segments.

#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use egui::{Event, Key, Modifiers, vec2};
use egui_kittest::Harness;
use egui_kittest::kittest::Queryable;
use isinglass_client::{FrameSize, Refresh, ScriptStep, WindowContents, WindowOptions};
use isinglass_core::kernels::march::{Scene, render};
use isinglass_core::volume::Volume;
use isinglass_core::volume::procedural::Builtin;
use isinglass_core::wire::{Choices, Part};
use isinglass_formats::{SavedState, load_transfer, read_state, state_to_link};
use isinglass_net::{Client, ClientOptions, Clock};
use isinglass_server::{Loaded, Loader, Survey};
use isinglass_tests::host::Host;
use isinglass_tests::twins::Difference;

/// A file with three channels, of which the one in the middle cannot be read.
struct Cells;

fn volume(channel: u32) -> Volume {
    [Builtin::Shells, Builtin::Cubus, Builtin::Cloud][channel as usize].volume(24)
}

fn parts(channel: u32) -> Choices {
    Choices {
        shown: Part {
            channel: Some(channel),
            time: Some(0),
            level: Some(0),
            series: Some(0),
            ..Part::default()
        },
        whole_dims: [24; 3],
        num_channels: 3,
        channels: ["DAPI", "GFP", "actin"].map(str::to_owned).into(),
        num_times: 1,
        num_series: 1,
        ..Choices::default()
    }
}

impl Loader for Cells {
    fn survey(&self, part: &Part, _held: u64) -> Result<Survey, String> {
        match part.channel {
            Some(channel @ (0 | 2)) => Ok(Survey { parts: parts(channel), bytes_needed: 0 }),
            _ => Err("cells: that channel cannot be read".into()),
        }
    }

    fn load(
        &self,
        part: &Part,
        _: u64,
        _progress: &dyn Fn(f32),
        _cancel: &AtomicBool,
    ) -> Result<Loaded, String> {
        let channel = part.channel.unwrap();
        let transfer = load_transfer(["shells", "cubus", "cloud"][channel as usize]).unwrap();
        Ok(Loaded { volume: volume(channel), transfer, channels: Default::default() })
    }
}

struct Stage {
    host: Host,
    /// Somebody else, who turns the server back to its first channel.
    other: Client,
}

impl Stage {
    fn new() -> Self {
        let host = Host::new(volume(0), "shells", parts(0), Arc::new(Cells));
        let other = host.viewer();
        Self { host, other }
    }

    /// The first channel is shown again.
    fn turn_back(&self) {
        self.other.talk().selection.open(Some(parts(0).shown));
        let patience = Instant::now() + Duration::from_secs(120);
        while self.other.talk().selection.choices().is_none_or(|parts| parts.shown.channel != Some(0)) {
            assert!(Instant::now() < patience);
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    fn window(&self, state: Option<SavedState>) -> Window {
        let link = self.host.link();
        let clock = Clock::start();
        let options = ClientOptions { clock: clock.clone(), ..ClientOptions::default() };
        let client = Client::connect(&link, options).unwrap();
        let refresh = Rc::new(RefCell::new(None));
        let seen = refresh.clone();
        let options = WindowOptions {
            frame_size: FrameSize { max_width: 96, max_height: 96, ..FrameSize::default() },
            state,
            script: Some(Box::new(move |probe| {
                *seen.borrow_mut() = probe.refresh.clone();
                ScriptStep::Continue
            })),
            ..WindowOptions::default()
        };
        let contents = WindowContents::new(options, client, clock);
        let show = |ui: &mut egui::Ui, contents: &mut WindowContents<Client>| contents.show(ui);
        let harness = Harness::builder().with_size(vec2(640.0, 480.0)).build_ui_state(show, contents);
        Window { harness, refresh }
    }

    fn end(self) {
        drop(self.other);
        self.host.end();
    }
}

struct Window {
    harness: Harness<'static, WindowContents<Client>>,
    refresh: Rc<RefCell<Option<Refresh>>>,
}

impl Window {
    /// Refreshes until there is something to find.
    fn until<T>(&mut self, what: &str, mut find: impl FnMut(&Self) -> Option<T>) -> T {
        let patience = Instant::now() + Duration::from_secs(120);
        loop {
            self.harness.step();
            if let Some(found) = find(self) {
                return found;
            }
            let shown = || {
                let refresh = self.refresh.borrow();
                refresh.as_ref().map(|r| (r.standing, r.frame.as_ref().map(|f| f.frame.header)))
            };
            assert!(Instant::now() < patience, "waited in vain: {what}; {:?}", shown());
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    fn until_label(&mut self, label: &str) {
        self.until(label, |w| w.harness.query_all_by_label_contains(label).next().map(drop));
    }

    /// How far the picture that is shown is from the twin's of a channel as a state says, once it is at rest at the state's
    /// pose.
    fn difference(&mut self, state: &SavedState, channel: u32) -> Difference {
        let wanted = state.camera.unwrap().pose();
        let frame = self.until("the picture at rest", |w| {
            let refresh = w.refresh.borrow().clone()?;
            let frame = refresh.frame.filter(|f| f.is_exact)?;
            let is_settled = refresh.standing == isinglass_client::Standing::Settled;
            (is_settled && frame.frame.header.camera.pose == wanted).then_some(frame)
        });
        let look = state.look.as_ref().unwrap();
        let scene = Scene::new(Arc::new(volume(channel)), &look.transfer, look.march_settings());
        Difference::of(&frame.frame.flatten(), &render(&scene, &frame.frame.header.camera))
    }
}

#[derive(Debug)]
struct Dropped(PathBuf);

impl egui::DroppedFile for Dropped {
    fn path(&self) -> &Path {
        &self.0
    }

    fn bytes(&self) -> Result<Vec<u8>, String> {
        std::fs::read(&self.0).map_err(|e| e.to_string())
    }
}

fn drop_file(window: &mut Window, path: &Path) {
    window.harness.input_mut().dropped_files.push(Arc::new(Dropped(path.to_owned())));
    window.harness.step();
}

/// A state that a window with the third channel has saved, seen from another side.
fn saved(stage: &Stage, folder: &Path) -> SavedState {
    let mut window = stage.window(None);
    window.until("the first picture", |w| w.refresh.borrow().as_ref()?.frame.clone());
    window.until_label("channel");
    window.harness.get_by_role_and_label(egui::Role::ComboBox, "channel").click();
    window.until_label("2: actin");
    window.harness.get_by_role_and_label(egui::Role::Button, "2: actin").click();
    for _ in 0..5 {
        window.harness.key_press(Key::ArrowLeft);
        window.harness.key_press(Key::ArrowUp);
    }
    window.until("the channel", |w| {
        let name = "2: actin";
        w.harness
            .query_by_role_and_label(egui::Role::ComboBox, "channel")
            .filter(|c| c.value().as_deref() == Some(name))?;
        stage.other.talk().selection.choices().filter(|p| p.shown.channel == Some(2))
    });
    // Its description is on the way to this window too.
    window.until("the look of the channel", |w| {
        let refresh = w.refresh.borrow().clone()?;
        (refresh.standing == isinglass_client::Standing::Settled).then_some(())
    });
    window.harness.key_press_modifiers(Modifiers::COMMAND, Key::S);
    window.until_label("saved as");
    let files = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let file = files.into_iter().find(|path| path.to_string_lossy().ends_with(".state.toml")).unwrap();
    let state = read_state(&file).unwrap().state;
    let volume = state.volume.as_ref().unwrap();
    assert_eq!((volume.channel, volume.time, volume.dims), (Some(2), Some(0), [24; 3]));
    assert!(window.difference(&state, 2).max <= 1);
    state
}

#[test]
fn a_state_of_another_channel_gives_the_very_same_picture_by_every_way() {
    let folder = tempfile::TempDir::new().unwrap();
    // Where states are saved that nobody has named.
    std::env::set_current_dir(folder.path()).unwrap();
    let stage = Stage::new();
    let mut state = saved(&stage, folder.path());
    let look = state.look.as_mut().unwrap();
    (look.k, look.shaded) = (6, !look.shaded);
    let path = folder.path().join("seen.toml");
    std::fs::write(&path, state.to_toml()).unwrap();
    for way in ["start", "drop", "paste"] {
        stage.turn_back();
        let mut window = stage.window((way == "start").then(|| state.clone()));
        if way != "start" {
            window.until("the first picture", |w| w.refresh.borrow().as_ref()?.frame.clone());
        }
        match way {
            "drop" => drop_file(&mut window, &path),
            "paste" => {
                let text = state_to_link(&state);
                let link = format!("isinglass://h:1/#cert=sha256:{}&state={text}", "ab".repeat(32));
                window.harness.event(Event::Paste(link));
            }
            _ => {}
        }
        window.until(way, |_| stage.other.talk().selection.choices().filter(|p| p.shown.channel == Some(2)));
        let difference = window.difference(&state, 2);
        assert!(difference.max <= 1, "{way}: {difference:?}");
        // The controls: the same state's picture of another channel, and of another look.
        assert!(window.difference(&state, 0).max > 30, "{way}: another channel was not noticed");
        let mut other = state.clone();
        let look = other.look.as_mut().unwrap();
        look.shaded = !look.shaded;
        assert!(window.difference(&other, 2).max > 1, "{way}: another look was not noticed");
    }

    // A state that names no channel shows the one that is there.
    stage.turn_back();
    let mut unnamed = state.clone();
    unnamed.volume.as_mut().unwrap().channel = None;
    let mut window = stage.window(Some(unnamed));
    let difference = window.difference(&state, 0);
    assert!(difference.max <= 1, "{difference:?}");
    assert_eq!(stage.other.talk().selection.choices().unwrap().shown.channel, Some(0));

    // What is not there is named, in one line over the picture.
    for (channel, dims, line) in [
        (Some(7), [24; 3], "this file has channel 0 to 2"),
        (Some(1), [24; 3], "the state is not shown: cells: that channel cannot be read"),
        (Some(2), [9; 3], "of 9×9×9 voxels"),
    ] {
        let mut other = state.clone();
        let volume = other.volume.as_mut().unwrap();
        (volume.channel, volume.dims) = (channel, dims);
        std::fs::write(&path, other.to_toml()).unwrap();
        drop_file(&mut window, &path);
        window.until_label(line);
        assert_eq!(stage.other.talk().selection.choices().unwrap().shown.channel, Some(0), "{line}");
    }
    drop(window);
    stage.end();
}
