//! The list of what was opened lately, and what it takes to open it again.

use glam::Vec3;
use isinglass_formats::{Dtype, Endian, RawShape, SavedState, SavedVolume};
use isinglass_net::{Client, ClientOptions};

use super::*;

fn entry(place: RecentPlace, shows: &str) -> RecentEntry {
    RecentEntry { place, shows: shows.into(), used_at: 996_400 }
}

/// What `isinglass view LINK` does: the window notes its server before the list was read.
#[test]
fn a_window_that_begins_connected_keeps_what_was_opened_before() {
    let (_runtime, links) = porter(&Builtin::Shells.volume(16));
    let client = Client::connect(&links[0], ClientOptions::default()).unwrap();
    client.wait_connected(Duration::from_secs(60)).unwrap();
    let first = First::Connected { source: Box::new(client), link: links[0].clone(), remote: None };
    let earlier = vec![
        entry(RecentPlace::Server { host: "::1".into(), port: 4433 }, "head.nrrd"),
        entry(RecentPlace::Volume(VolumeSource::new("/data/b.nrrd")), "b.nrrd"),
    ];
    let before = earlier.clone();
    let mut stage = Stage::begun_with(first, |_| Recent { folder: None, entries: before });
    let port = links[0].port;
    let file = stage.folder.path().join("recent.toml");
    let read = || Recent::read(&file).unwrap();
    until(&mut stage.window, "the list's file", |_| read().entries.len() != earlier.len());
    let places: Vec<_> = read().entries.into_iter().map(|e| e.place).collect();
    let server = RecentPlace::Server { host: "127.0.0.1".into(), port };
    assert_eq!(places, [server, earlier[0].place.clone(), earlier[1].place.clone()]);
    assert_eq!(read().folder, Some(stage.folder.path().join("data")));
    // An address with colons is written as in a link.
    stage.window.key_press_modifiers(Modifiers::COMMAND, Key::N);
    stage.window.run_steps(3);
    assert!(stage.window.query_by_role_and_label(egui::Role::Button, "[::1]:4433").is_some());
}

fn raw() -> RawShape {
    RawShape { dims: [6, 5, 2], dtype: Dtype::Uint16, spacing: Vec3::ONE, endian: Endian::Big, offset: 4 }
}

#[test]
fn a_raw_volume_is_opened_again_as_it_was_from_the_list_and_by_a_state() {
    let mut stage = Stage::new(Servers::default(), |folder| {
        std::fs::write(folder.join("data/scan.raw"), [7; 124]).unwrap();
        Recent::default()
    });
    let source = stage.folder.path().join("data/scan.raw").to_string_lossy().into_owned();
    let spacing = Some(Vec3::new(1.0, 1.0, 2.5));
    let volume = VolumeSource { raw: Some(raw()), spacing, ..VolumeSource::new(source.clone()) };
    stage.window.state_mut().open(Act::Open, volume.clone().request(MAX_BYTES));
    until(&mut stage.window, "the volume", is_shown);
    let file = stage.folder.path().join("recent.toml");
    until(&mut stage.window, "the list's file", |_| !Recent::read(&file).unwrap().entries.is_empty());
    let list = Recent::read(&file).unwrap();
    assert_eq!(list.entries[0].place, RecentPlace::Volume(volume.clone()));

    stage.window.key_press_modifiers(Modifiers::COMMAND, Key::N);
    stage.window.run_steps(3);
    stage.window.get_by_label("Close it").click();
    stage.window.run_steps(3);
    let shows = &list.entries[0].shows;
    stage.window.get_by_role_and_label(egui::Role::Button, shows).click();
    stage.window.run_steps(2);
    until(&mut stage.window, "the volume", is_shown);

    // A state of it brings its shape along; without one the file says nothing of itself.
    stage.window.state_mut().close();
    for (saved, is_opened) in [(VolumeSource::new(source), false), (volume, true)] {
        let saved = SavedVolume { name: "scan.raw".into(), dims: [6, 5, 2], ..SavedVolume::default() }
            .opened_from(&saved);
        let state = SavedState { volume: Some(saved), ..SavedState::default() };
        let path = stage.folder.path().join("data/seen.toml");
        std::fs::write(&path, state.to_toml()).unwrap();
        stage.window.state_mut().problem = None;
        stage.window.input_mut().dropped_files.push(Arc::new(DroppedFile(path)));
        stage.window.run_steps(2);
        until(&mut stage.window, "an end", |w| is_shown(w) || w.state().problem.is_some());
        assert_eq!(is_shown(&stage.window), is_opened);
    }
    assert_eq!(*stage.servers.started.lock().unwrap(), [(Selection::default(), [6, 5, 2]); 3]);
}

#[test]
fn a_name_that_is_not_in_the_folder_is_said_to_be_missing() {
    let mut stage = Stage::new(Servers::default(), |_| Recent::default());
    stage.browse();
    let go_to = |stage: &mut Stage, name: &str| {
        let path = stage.folder.path().join("data").join(name).to_string_lossy().into_owned();
        stage.window.get_by_label("path").focus();
        stage.window.run_steps(2);
        stage.window.key_press_modifiers(Modifiers::COMMAND, Key::A);
        stage.window.event(Event::Paste(path));
        stage.window.run_steps(2);
        press(&mut stage.window, Key::Enter);
        until(&mut stage.window, "the folder", |w| w.query_by_label_contains("nothing in this").is_none());
    };
    go_to(&mut stage, "none.nrrd");
    until(&mut stage.window, "a line", |w| {
        w.query_by_label_contains("none.nrrd: not in this folder").is_some()
    });
    go_to(&mut stage, "film.nrrd");
    until(&mut stage.window, "a header", |w| w.query_by_label_contains("6×5×4 uint8").is_some());
    assert!(!stage.has("not in this folder"));
}

/// What takes time to end does so elsewhere, also what nobody has taken yet.
#[test]
fn a_server_that_started_and_was_not_taken_ends_on_another_thread() {
    let mut stage = Stage::new(Servers::default(), |_| Recent::default());
    let source = stage.folder.path().join("data/film.nrrd").to_string_lossy().into_owned();
    stage.window.state_mut().open(Act::Open, VolumeSource::new(source).request(MAX_BYTES));
    let servers = stage.servers.clone();
    let num_running = || servers.num_running.load(Ordering::SeqCst);
    let patience = Instant::now() + Duration::from_secs(60);
    // No refresh: the window is to find it there, and is told to cancel first.
    while num_running() == 0 {
        assert!(Instant::now() < patience, "it never started");
        let opening = stage.window.state_mut().opening.as_mut().unwrap();
        if opening.progress().0 != "preparing the picture…" {
            assert!(opening.poll().is_none());
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    std::thread::sleep(Duration::from_millis(20));
    stage.window.state_mut().opening = None;
    while num_running() > 0 {
        assert!(Instant::now() < patience, "it runs on");
        std::thread::sleep(Duration::from_millis(2));
    }
    let ended_on = servers.ended_on.lock().unwrap().clone();
    assert!(ended_on.len() == 1 && ended_on[0] != std::thread::current().id());
}

#[test]
fn a_source_that_is_forgotten_leaves_no_picture() {
    let link: Link =
        format!("isinglass://far:4433/#token={}&cert=sha256:{}", "0".repeat(32), "ab".repeat(32))
            .parse()
            .unwrap();
    let place = RecentPlace::Server { host: "far".into(), port: 4433 };
    for is_forgotten in [false, true] {
        let first =
            First::Connected { source: Box::new(HereSource::new()), link: link.clone(), remote: None };
        let mut stage = Stage::begun_with(first, |_| Recent::default());
        let pictures = stage.folder.path().join("pictures");
        // Another window's.
        std::fs::create_dir_all(&pictures).unwrap();
        std::fs::write(pictures.join("0123456789abcdef.png"), "its own").unwrap();
        let num_files = || std::fs::read_dir(&pictures).unwrap().count();
        until(&mut stage.window, "a frame", |w| w.state().app.source().latest_frame().is_some());
        stage.window.key_press_modifiers(Modifiers::COMMAND, Key::N);
        until(&mut stage.window, "its picture", |w| w.state().pictures.of(&place).is_some());
        assert_eq!(num_files(), 2);
        if is_forgotten {
            stage.window.get_by_label("forget far:4433").click();
            until(&mut stage.window, "no picture", |_| num_files() == 1);
            press(&mut stage.window, Key::Escape);
            stage.window.key_press_modifiers(Modifiers::COMMAND, Key::N);
            stage.window.run_steps(3);
            assert!(stage.window.state().pictures.of(&place).is_none());
        }
        stage.window.state_mut().finish();
        assert_eq!(num_files(), if is_forgotten { 1 } else { 2 });
        assert_eq!(stage.list().contains("far"), !is_forgotten);
    }
}

#[test]
fn pictures_that_no_entry_has_any_more_are_deleted_at_the_start() {
    let place = RecentPlace::Server { host: "far".into(), port: 4433 };
    let kept = entry(place.clone(), "kept");
    let before = Recent { folder: None, entries: vec![kept] };
    let names = ["0123456789abcdef.png", "fedcba9876543210.png", "0123456789abcdef.txt", "x.png"];
    for (list, is_swept) in [(before.to_toml(), true), ("no list".to_owned(), false)] {
        let folder = TempDir::new().unwrap();
        let pictures = folder.path().join("pictures");
        std::fs::create_dir_all(&pictures).unwrap();
        let recent = folder.path().join("recent.toml");
        std::fs::write(&recent, list).unwrap();
        let own = pictures::name_of(&place);
        for name in names.iter().copied().chain([&own[..]]) {
            let file = std::fs::File::create(pictures.join(name)).unwrap();
            // The second is of a window that has yet to write its entry.
            if name != names[1] {
                file.set_modified(std::time::SystemTime::now() - Duration::from_secs(7200)).unwrap();
            }
        }
        let ctx = egui::Context::default();
        let mut pictures_of_window = Pictures::new(Some(&recent));
        pictures_of_window.sweep(&[]);
        pictures_of_window.go_on(&ctx);
        pictures_of_window.finish();
        let left = |name: &str| pictures.join(name).exists();
        assert_eq!(left(names[0]), !is_swept);
        assert!(names[1..].iter().all(|name| left(name)) && left(&own));
    }
    // The window does so when its list is read.
    let mut stage = Stage::new(Servers::default(), |folder| {
        std::fs::create_dir_all(folder.join("pictures")).unwrap();
        let file = std::fs::File::create(folder.join("pictures").join(names[0])).unwrap();
        file.set_modified(std::time::SystemTime::now() - Duration::from_secs(7200)).unwrap();
        before
    });
    let old = stage.folder.path().join("pictures").join(names[0]);
    until(&mut stage.window, "no picture", |_| !old.exists());
}

#[test]
fn what_goes_wrong_is_told_where_it_was_begun() {
    let (check, gate) = sync_channel(1);
    let servers = Servers { check_gate: Some(Mutex::new(gate)), ..Servers::default() };
    let mut stage = Stage::new(servers, |_| Recent::default());
    let large = VolumeSource::new(stage.folder.path().join("data/large.nrrd").to_string_lossy());
    stage.window.state_mut().open(Act::Recent, large.request(MAX_BYTES));
    let notes = stage.folder.path().join("data/notes.txt");
    stage.window.input_mut().dropped_files.push(Arc::new(DroppedFile(notes)));
    let is_of = |w: &Window, act| w.state().problem.as_ref().is_some_and(|(of, _)| *of == act);
    until(&mut stage.window, "the text is refused", |w| is_of(w, Act::Drop));
    check.send(()).unwrap();
    until(&mut stage.window, "there is no room", |w| is_of(w, Act::Recent));
}
