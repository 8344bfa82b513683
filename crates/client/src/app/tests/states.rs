//! Does a state bring back the very same picture, whichever way it takes?

use std::path::{Path, PathBuf};

use isinglass_core::ids::LoadId;
use isinglass_core::wire::{Choices, LoadState, LoadStatus, Part};
use isinglass_formats::{SavedState, VolumeSource, read_state};

use super::*;
use crate::panels::state_files::StateWish;

/// A file of this test alone.
fn path(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("isinglass-{}-{name}.state.toml", std::process::id()));
    let _ = std::fs::remove_file(&path);
    path
}

/// A window in which nothing is as it was at first.
fn changed() -> Harness<'static, ViewerApp<HereSource>> {
    let mut w = window([640.0, 480.0]);
    drag(&mut w, egui::pos2(300.0, 300.0), vec2(77.0, -41.0), Modifiers::NONE);
    drag(&mut w, egui::pos2(300.0, 300.0), vec2(-13.0, 9.0), Modifiers::SHIFT);
    drag(&mut w, egui::pos2(300.0, 200.0), vec2(30.0, 50.0), Modifiers::COMMAND);
    for key in [Key::B, Key::A, Key::O, Key::K] {
        press(&mut w, Modifiers::NONE, key);
    }
    let transfer = isinglass_formats::preset("cubus").unwrap();
    let look = Look { shaded: false, k: 5, ..Look::new(transfer) };
    let app = w.state_mut();
    app.viewing.set_look(Duration::ZERO, look);
    app.aids.background = [1, 200, 3];
    app.stereo.eye_angle_degrees = 3.3;
    let (bounds, controls) = app.controls.as_mut().unwrap();
    assert!(controls.set_center(bounds.max * 0.3));
    rest(&mut w);
    w
}

/// Waits for the thread that reads or writes.
fn wait(w: &mut Harness<'_, ViewerApp<HereSource>>, until: impl Fn(&ViewerApp<HereSource>) -> bool) {
    for _ in 0..2000 {
        w.step();
        if until(w.state()) {
            return rest(w);
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    panic!("the file was never read or written");
}

fn state(w: &Harness<'_, ViewerApp<HereSource>>) -> SavedState {
    let app = w.state();
    app.saved_state(&w.ctx, app.window.unwrap()).unwrap()
}

fn save(w: &mut Harness<'_, ViewerApp<HereSource>>, path: &Path) {
    w.state_mut().state_files.set_path(path);
    press(w, Modifiers::COMMAND, Key::S);
    wait(w, |_| path.exists());
    wait(w, |app| app.notice.as_ref().is_some_and(|(text, _)| text.contains("saved as")));
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

fn drop_file(w: &mut Harness<'_, ViewerApp<HereSource>>, path: &Path) {
    w.input_mut().dropped_files.push(Arc::new(Dropped(path.to_owned())));
    w.step();
}

#[test]
fn a_state_gives_the_very_same_picture_in_another_window() {
    let mut w = changed();
    let (wanted, shown, wanted_pose) = (state(&w), picture(&w), pose(&w));
    let path = path("same");
    save(&mut w, &path);
    assert_eq!(read_state(&path).unwrap().state, wanted);

    for way in ["file", "drop", "link", "start"] {
        let mut other = window([640.0, 480.0]);
        assert!(pose(&other) != wanted_pose && picture(&other) != shown, "control: without it they differ");
        match way {
            "file" => {
                other.state_mut().state_files.set_path(&path);
                let ctx = other.ctx.clone();
                other.state_mut().do_state(&ctx, Duration::ZERO, StateWish::Open);
            }
            "drop" => drop_file(&mut other, &path),
            "link" => {
                let text = isinglass_formats::state_to_link(&wanted);
                let link = format!("isinglass://h:1/#cert=sha256:{}&state={text}", "ab".repeat(32));
                other.event(Event::Paste(link));
                other.step();
            }
            _ => other.state_mut().options.state = Some(wanted.clone()),
        }
        wait(&mut other, |app| app.viewing.look().is_some_and(|look| look.k == 5));
        assert_eq!(pose(&other), wanted_pose, "{way}");
        assert_eq!(state(&other), wanted, "{way}");
        assert!(picture(&other) == shown, "{way}: the picture is the same to the byte");
    }
    std::fs::remove_file(path).unwrap();
}

#[test]
fn ctrl_o_opens_states_and_presets_from_a_list_of_files() {
    let folder = tempfile::TempDir::new().unwrap();
    let mut first = changed();
    let wanted = state(&first);
    save(&mut first, &folder.path().join("a.state.toml"));
    let transfer = isinglass_formats::preset("cubus").unwrap();
    let text = isinglass_formats::transfer_to_toml(&transfer);
    std::fs::write(folder.path().join("b.toml"), text).unwrap();
    std::fs::write(folder.path().join("c.nrrd"), "NRRD0004\ntype: uchar\n").unwrap();

    let mut w = window([640.0, 480.0]);
    w.state_mut().open_dialog.begin_at(folder.path());
    let sees = |w: &mut Harness<'_, ViewerApp<HereSource>>, text: &str| {
        for _ in 0..2000 {
            w.step();
            if w.query_by_label_contains(text).is_some() {
                return;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        panic!("{text} is never shown");
    };
    let choose = |w: &mut Harness<'_, ViewerApp<HereSource>>, letter: &str, says: &str| {
        press(w, Modifiers::COMMAND, Key::O);
        sees(w, "b.toml");
        w.event(Event::Text(letter.into()));
        sees(w, says);
        press(w, Modifiers::NONE, Key::Enter);
    };
    choose(&mut w, "a", "a saved state");
    wait(&mut w, |app| app.viewing.look().is_some_and(|look| look.k == 5));
    assert_eq!(state(&w), wanted);
    assert!(!w.state().open_dialog.is_open() && !w.state().is_look_open);
    let mut w = window([640.0, 480.0]);
    w.state_mut().open_dialog.begin_at(folder.path());
    choose(&mut w, "b", "as colours and opacities");
    wait(&mut w, |app| app.viewing.look().is_some_and(|look| look.transfer == transfer));
    assert!(w.state().is_look_open);
    // Nobody opens volumes in this window.
    choose(&mut w, "c", "c.nrrd is not supported: NRRD");
    assert!(w.state().open_dialog.is_open());
    press(&mut w, Modifiers::NONE, Key::Escape);
    assert!(!w.state().open_dialog.is_open() && w.state().wish.is_none());
}

#[test]
fn a_file_that_is_there_is_replaced_when_it_is_asked_for_twice() {
    let mut w = window([640.0, 480.0]);
    let path = path("twice");
    std::fs::write(&path, "mine").unwrap();
    w.state_mut().state_files.set_path(&path);
    press(&mut w, Modifiers::COMMAND, Key::S);
    wait(&mut w, |app| app.notice.as_ref().is_some_and(|(text, _)| text.contains("save again")));
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "mine");
    press(&mut w, Modifiers::COMMAND, Key::S);
    wait(&mut w, |app| app.notice.as_ref().is_some_and(|(text, _)| text.contains("saved as")));
    assert!(read_state(&path).is_ok());
    std::fs::remove_file(path).unwrap();
}

#[test]
fn what_is_no_state_or_of_another_volume_is_told() {
    let mut w = window([640.0, 480.0]);
    let mut other = state(&w);
    other.volume.as_mut().unwrap().dims = [1, 2, 3];
    let path = path("other");
    std::fs::write(&path, other.to_toml()).unwrap();
    drop_file(&mut w, &path);
    wait(&mut w, |app| app.notice.is_some());
    let notice = w.state().notice.clone().unwrap().0;
    assert!(notice.contains("1×2×3") && notice.contains("24×24×24"), "{notice}");
    for (text, word) in [("isinglass_state = 7", "isinglass_state"), ("isinglass_state = 1\nk = x", "line 2")]
    {
        w.state_mut().notice = None;
        std::fs::write(&path, text).unwrap();
        drop_file(&mut w, &path);
        wait(&mut w, |app| app.notice.is_some());
        let notice = w.state().notice.clone().unwrap().0;
        assert!(notice.contains(word) && !notice.contains('\n'), "{notice}");
    }
    w.state_mut().notice = None;
    w.event(Event::Paste("isinglass://h:1/#state=AAAA".into()));
    rest(&mut w);
    assert!(w.state().notice.clone().unwrap().0.contains("the link's state"));
    std::fs::remove_file(path).unwrap();
}

#[test]
fn a_copied_link_names_the_server_and_holds_no_token() {
    let mut w = changed();
    press(&mut w, Modifiers::COMMAND, Key::L);
    assert!(w.state().notice.clone().unwrap().0.contains("no server"));
    let token = "00112233445566778899aabbccddeeff";
    let link = format!("isinglass://far:4433/#token={token}&cert=sha256:{}", "ab".repeat(32));
    w.state_mut().options.link = Some(link.parse().unwrap());
    press(&mut w, Modifiers::COMMAND, Key::L);
    assert!(w.state().notice.clone().unwrap().0.contains("clipboard"));
    let copied = w.state().link_to(state(&w)).unwrap();
    assert!(copied.starts_with("isinglass://far:4433/#cert=sha256:") && !copied.contains(token), "{copied}");
    let text = isinglass_net::state_of_link(&copied).unwrap();
    let seen = isinglass_formats::state_from_link(&text).unwrap().state;
    assert_eq!((seen.camera, seen.look.clone()), (state(&w).camera, state(&w).look));
    assert_eq!(seen.volume.unwrap().source, None, "where it lies is not for others");
    // A server in this window ends with it, so the link names the file, for this computer.
    w.state_mut().options.volume_source = Some(VolumeSource::new("/here/head.nrrd"));
    let copied = w.state().link_to(state(&w)).unwrap();
    let text = isinglass_net::state_of_link(&copied).unwrap();
    let seen = isinglass_formats::state_from_link(&text).unwrap().state;
    assert_eq!(seen.volume.unwrap().source.as_deref(), Some("/here/head.nrrd"));
    assert!(!copied.contains(token));
}

/// A file of two levels of which the first is shown, and a state of the other with another look.
fn with_level_to_come() -> (Harness<'static, ViewerApp<HereSource>>, Choices) {
    let mut w = window([640.0, 480.0]);
    let now = Part { channel: Some(0), time: Some(0), level: Some(0), series: Some(0), ..Part::default() };
    let parts = Choices {
        shown: now,
        whole_dims: [24; 3],
        num_channels: 1,
        num_times: 1,
        num_series: 1,
        levels: vec![[24; 3], [12; 3]],
        ..Choices::default()
    };
    w.state().viewing.source().talk().selection.handle_choices(parts.clone());
    rest(&mut w);
    let mut wanted = state(&w);
    let volume = wanted.volume.as_mut().unwrap();
    (volume.level, volume.dims) = (Some(1), [12; 3]);
    wanted.look.as_mut().unwrap().k = 5;
    let text = isinglass_formats::state_to_link(&wanted);
    w.event(Event::Paste(format!("isinglass://h:1/#state={text}")));
    rest(&mut w);
    assert!(w.state().coming.is_some() && w.state().notice().is_empty());
    (w, parts)
}

#[test]
fn reading_a_part_may_be_slow_but_not_stand_still() {
    let (mut w, parts) = with_level_to_come();
    let skipped = Arc::new(AtomicU64::new(0));
    let (clock, more) = (w.state().clock.clone(), skipped.clone());
    w.state_mut().clock = Clock::new(move || clock.now_micros() + more.load(Ordering::Relaxed));
    let part = Part { level: Some(1), ..parts.shown };
    // A percent in five minutes; what the server told last stays there.
    let wait = |w: &mut Harness<'_, ViewerApp<HereSource>>| {
        skipped.fetch_add(300_000_000, Ordering::Relaxed);
        rest(w);
    };
    for percent in 0..4 {
        let state = LoadState::Reading { permille: percent * 10 };
        let load = LoadStatus { load: LoadId(1), is_own: true, part, bytes_needed: 1, state };
        w.state().viewing.source().talk().selection.handle_load(load);
        rest(&mut w);
        wait(&mut w);
        assert!(w.state().coming.is_some() && w.state().notice().is_empty(), "{}", w.state().notice());
    }
    wait(&mut w);
    assert!(w.state().coming.is_none());
    assert!(w.state().notice().contains("tells no more"), "{}", w.state().notice());
    assert_ne!(w.state().seen().unwrap().0.k, 5);
}

#[test]
fn a_state_of_the_file_that_is_shown_read_otherwise_is_of_another_volume() {
    let raw = |offset| isinglass_formats::RawShape {
        dims: [24; 3],
        dtype: isinglass_formats::Dtype::Uint8,
        spacing: glam::Vec3::ONE,
        endian: Default::default(),
        offset,
    };
    let spacing = |z: f32| Some(glam::vec3(1.0, 1.0, z));
    // Files that are there: others nobody could open.
    let folder = tempfile::TempDir::new().unwrap();
    let file = |name: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, "").unwrap();
        VolumeSource::new(path.to_string_lossy())
    };
    let plain = file("scan");
    let spaced = |z| VolumeSource { spacing: spacing(z), ..plain.clone() };
    let shaped = |offset| VolumeSource { raw: Some(raw(offset)), ..plain.clone() };
    let elsewhere = file("other");
    // What is shown, what a state is of, and whether that is another.
    let cases = [
        (plain.clone(), plain.clone(), false),
        (plain.clone(), elsewhere, true),
        (plain.clone(), spaced(2.0), true),
        (spaced(2.0), plain.clone(), true),
        (spaced(2.0), spaced(3.0), true),
        (spaced(2.0), spaced(2.0), false),
        (shaped(4), shaped(4), false),
        (shaped(4), shaped(5), true),
        (plain.clone(), shaped(4), true),
        // Nobody could read it without a shape.
        (shaped(4), plain, false),
    ];
    let mut w = window([640.0, 480.0]);
    let path = folder.path().join("seen.state.toml");
    let first = state(&w);
    for (i, (present, wanted, is_other)) in (0..).zip(cases) {
        for opens_volumes in [true, false] {
            let mut seen = first.clone();
            seen.volume = seen.volume.map(|volume| volume.opened_from(&wanted));
            // By this it is seen which states are shown.
            let k = 10 + 2 * i + u8::from(opens_volumes);
            seen.look.as_mut().unwrap().k = k;
            std::fs::write(&path, seen.to_toml()).unwrap();
            let app = w.state_mut();
            (app.options.volume_source, app.opens_volumes) = (Some(present.clone()), opens_volumes);
            drop_file(&mut w, &path);
            let is_shown = |app: &ViewerApp<HereSource>| app.seen().unwrap().0.k == k;
            wait(&mut w, |app| app.wish.is_some() || is_shown(app));
            let is_wished = w.state_mut().take_wish().is_some();
            let is_right = (is_wished, is_shown(w.state()))
                == match is_other && opens_volumes {
                    true => (true, false),
                    false => (false, true),
                };
            assert!(is_right, "{present:?} {wanted:?}, where volumes are opened: {opens_volumes}");
        }
    }
}

#[test]
fn a_state_whose_part_was_read_and_is_another_volume_is_shown_with_a_line_and_not_waited_for() {
    let (mut w, parts) = with_level_to_come();
    // The server reads the level, and then shows one of another size.
    let part = Part { level: Some(1), ..parts.shown };
    let load = LoadStatus { load: LoadId(1), is_own: true, part, bytes_needed: 1, state: LoadState::Done };
    {
        let mut talk = w.state().viewing.source().talk();
        talk.selection.handle_load(load);
        talk.selection.handle_choices(Choices { shown: part, whole_dims: [24; 3], ..parts });
    }
    rest(&mut w);
    assert!(w.state().coming.is_some(), "its description may be on the way");
    for _ in 0..12 {
        w.run_steps(60);
    }
    assert!(w.state().coming.is_none());
    assert!(w.state().notice().contains("the state was made of"), "{}", w.state().notice());
    assert_eq!(w.state().seen().unwrap().0.k, 5);
}

#[test]
fn a_whole_state_replaces_measures_and_views_and_a_part_of_one_leaves_them() {
    let other = state(&changed());
    let part = SavedState { camera: None, ..other.clone() };
    for (opened, stays) in [(part, true), (other, false)] {
        let mut w = window([640.0, 480.0]);
        let points = vec![[0.0; 3], [1.0; 3]];
        let distance =
            isinglass_formats::SavedMeasure { kind: isinglass_formats::MeasureKind::Distance, points };
        w.state_mut().measures.set(vec![distance]);
        let (center, rotation) = ([0.0; 3], [0.0, 0.0, 0.0, 1.0]);
        let name = "front".into();
        let view =
            NamedView { name, center, rotation, eye_from_center: [0.0, 0.0, 5.0], orthographic: false };
        w.state_mut().named_views = vec![view];
        w.state_mut().options.state = Some(opened);
        wait(&mut w, |app| app.viewing.look().is_some_and(|look| look.k == 5));
        let left = (w.state().measures.measures().is_empty(), w.state().named_views.is_empty());
        assert_eq!(left, (!stays, !stays));
    }
}
