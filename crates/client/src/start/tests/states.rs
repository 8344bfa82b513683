//! States that are opened where their volume is not shown yet.

use isinglass_core::camera::{Intrinsics, Pose};
use isinglass_core::look::Look;
use isinglass_formats::{SavedCamera, SavedState, SavedVolume, preset};

use super::*;

/// A view of its own of the volume at `source`, which is not what a window begins with.
fn state(source: Option<&str>) -> SavedState {
    let pose = Pose::orbit(glam::Vec3::ZERO, 0.7, -0.4, 9.0);
    let eye_from_center = pose.world_from_view.inverse() * pose.eye;
    let camera = SavedCamera::of(
        glam::Vec3::ZERO,
        (pose.world_from_view, eye_from_center),
        Intrinsics::perspective(640, 480, 0.6),
    );
    let volume = SavedVolume {
        name: "film.nrrd".into(),
        source: source.map(str::to_owned),
        time: Some(2),
        dims: [6, 5, 4],
        spacing: [1.0; 3],
        range: [7.0, 7.0],
        ..SavedVolume::default()
    };
    SavedState {
        volume: Some(volume),
        camera: Some(camera),
        look: Some(Look { k: 5, ..Look::new(preset("cubus").unwrap()) }),
        ..SavedState::default()
    }
}

impl Stage {
    fn drop_file(&mut self, path: PathBuf) {
        self.window.input_mut().dropped_files.push(Arc::new(DroppedFile(path)));
        self.window.run_steps(2);
    }

    fn data(&self, name: &str) -> PathBuf {
        self.folder.path().join("data").join(name)
    }

    fn write(&self, name: &str, state: &SavedState) -> PathBuf {
        let path = self.data(name);
        std::fs::write(&path, state.to_toml()).unwrap();
        path
    }

    /// Waits for the question whether another machine may be called, and presses a button.
    fn answer(&mut self, button: &str) {
        until(&mut self.window, button, |w| w.query_by_label(button).is_some());
        assert!(self.has("Whoever wrote the state chose it") && self.window.state().opening.is_none());
        self.window.get_by_label(button).click();
        self.window.run_steps(3);
        assert!(!self.has("Whoever wrote the state chose it"));
    }

    /// Whether the picture is as the state says.
    fn is_seen_as(&self, state: &SavedState) -> bool {
        let seen = self.window.state().app.seen();
        let wanted = (state.look.clone().unwrap(), state.camera.unwrap().pose());
        is_shown(&self.window) && seen == Some(wanted)
    }
}

#[test]
fn a_dropped_state_opens_the_volume_that_it_names_and_shows_it_as_it_says() {
    // Where it is, and moved together with the state.
    for moved in [false, true] {
        let mut stage = Stage::new(Servers::default(), |_| Recent::default());
        let source = if moved { "/not/there/any/more/film.nrrd".into() } else { stage.data("film.nrrd") };
        let state = state(source.to_str());
        let path = stage.write("seen.toml", &state);
        // The control: opened by itself, the volume is seen otherwise.
        stage.drop_file(stage.data("film.nrrd"));
        until(&mut stage.window, "the volume", is_shown);
        assert!(!stage.is_seen_as(&state));
        stage.window.key_press_modifiers(Modifiers::COMMAND, Key::N);
        stage.window.run_steps(3);
        stage.drop_file(path);
        until(&mut stage.window, "the state", |w| is_shown(w) && w.state().opening.is_none());
        assert!(stage.is_seen_as(&state), "moved: {moved}");
        let started = stage.servers.started.lock().unwrap().clone();
        assert_eq!(started[1].0, Selection { time: Some(2), ..Selection::default() });
    }
}

#[test]
fn a_state_over_another_volume_opens_its_own() {
    let mut stage = Stage::new(Servers::default(), |_| Recent::default());
    stage.drop_file(stage.data("inner/small.nrrd"));
    until(&mut stage.window, "the volume", is_shown);
    let state = state(stage.data("film.nrrd").to_str());
    let path = stage.write("seen.toml", &state);
    stage.drop_file(path.clone());
    until(&mut stage.window, "the other volume", |w| {
        w.state().services.servers.max_bytes() > 0 && is_shown(w) && {
            w.state().app.seen().is_some_and(|(look, _)| look.k == 5)
        }
    });
    assert!(stage.is_seen_as(&state));
    assert_eq!(stage.servers.started.lock().unwrap().len(), 2);
    // Once more, and one whose volume is nowhere on this machine: it is there already, and opened no second time.
    stage.drop_file(path);
    until(&mut stage.window, "the state", |w| !w.state().dropped.is_busy() && w.state().opening.is_none());
    let mut elsewhere = state.clone();
    elsewhere.volume.as_mut().unwrap().source = Some("/nowhere/none.nrrd".into());
    let path = stage.write("elsewhere.toml", &elsewhere);
    stage.drop_file(path);
    until(&mut stage.window, "the state", |w| !w.state().dropped.is_busy() && w.state().opening.is_none());
    stage.window.run_steps(20);
    assert_eq!(stage.servers.started.lock().unwrap().len(), 2);
}

#[test]
fn a_state_is_chosen_in_the_list_of_files() {
    let mut stage = Stage::new(Servers::default(), |folder| {
        let state = state(folder.join("data/film.nrrd").to_str());
        std::fs::write(folder.join("data/seen.toml"), state.to_toml()).unwrap();
        Recent::default()
    });
    stage.browse();
    stage.window.get_by_label("files").focus();
    stage.window.run_steps(2);
    stage.window.event(Event::Text("see".into()));
    stage.window.run_steps(2);
    assert!(stage.has("a saved state, with the volume that it names"));
    press(&mut stage.window, Key::Enter);
    until(&mut stage.window, "the volume", is_shown);
    assert!(stage.is_seen_as(&state(stage.data("film.nrrd").to_str())));
}

#[test]
fn a_state_whose_volume_is_a_link_connects_to_it() {
    let (_runtime, links) = porter(&Builtin::Shells.volume(16));
    let mut stage = Stage::new(Servers::default(), |_| Recent::default());
    let state = state(Some(&links[0].to_string()));
    let path = stage.write("seen.toml", &state);
    stage.drop_file(path);
    stage.answer(&format!("Call {}", links[0].place()));
    until(&mut stage.window, "the server", is_shown);
    stage.window.run_steps(3);
    // What the server shows is another volume, which is said; where a camera may be there is for the controls to say.
    assert_eq!(stage.window.state().app.seen().map(|(look, _)| look.k), Some(5));
    let notice = stage.window.state().app.notice();
    assert!(notice.contains("the state was made of") && notice.contains("16×16×16"), "{notice}");
    assert!(stage.servers.started.lock().unwrap().is_empty());
}

#[test]
fn a_state_calls_no_stranger_before_the_person_says_so() {
    use std::io::ErrorKind;
    let token = format!("token={}&cert=sha256:{}", "1".repeat(32), "2".repeat(64));
    let udp = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let tcp = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    udp.set_nonblocking(true).unwrap();
    tcp.set_nonblocking(true).unwrap();
    let [server, web] = [udp.local_addr().unwrap(), tcp.local_addr().unwrap()];
    let is_called = || {
        let is_silent = |e: std::io::Error| assert_eq!(e.kind(), ErrorKind::WouldBlock);
        udp.recv(&mut [0; 2000]).map_err(is_silent).is_ok() || tcp.accept().map_err(is_silent).is_ok()
    };
    let sources = [
        (format!("isinglass://{server}/#{token}"), None, server),
        ("film.nrrd".into(), Some(format!("http://{web}/labels.zarr")), web),
        (format!("http://{web}/a.zarr"), None, web),
    ];
    for (source, labels, host) in sources {
        let mut stage = Stage::new(Servers::default(), |_| Recent::default());
        let (file, has_labels) = (stage.data("film.nrrd"), labels.is_some());
        let mut state = state(if labels.is_some() { file.to_str() } else { Some(&source) });
        state.volume.as_mut().unwrap().labels = labels;
        let path = stage.write("seen.toml", &state);
        // A request that is tried again would be taken for one of the next source.
        let answers = ["Cancel".to_owned(), format!("Call {host}")];
        for button in answers.iter().take(if has_labels { 1 } else { 2 }) {
            assert!(!is_called(), "{source}");
            stage.drop_file(path.clone());
            stage.answer(button);
            assert_eq!(stage.window.state().opening.is_some(), button != "Cancel", "{source}");
            if button == "Cancel" {
                // Long enough for a packet on loopback.
                std::thread::sleep(Duration::from_millis(200));
                stage.window.run_steps(3);
            }
        }
        // The control: it is called then.
        if !has_labels {
            until(&mut stage.window, "a call", |_| is_called());
        }
        drop(stage);
        std::thread::sleep(Duration::from_millis(300));
        while is_called() {}
    }
}

#[test]
fn what_a_state_needs_and_is_not_there_is_named_and_the_page_stays() {
    let mut stage = Stage::new(Servers::default(), |_| Recent::default());
    let cases = [
        (Some("/nowhere/none.nrrd"), None, "/nowhere/none.nrrd"),
        (None, None, "may lie anywhere"),
        (None, Some("render-01:4433"), "was shown by the server render-01:4433"),
        (Some("isinglass://h:1/#cert=sha256:00"), None, "The link of the state's volume"),
    ];
    for (source, server, words) in cases {
        let mut state = state(source);
        state.volume.as_mut().unwrap().server = server.map(str::to_owned);
        let path = stage.write("seen.toml", &state);
        stage.drop_file(path);
        until(&mut stage.window, "a message", |w| w.query_all_by_label_contains(words).next().is_some());
        assert!(stage.has("Connect to a server") && stage.window.state().opening.is_none(), "{words}");
        assert!(!stage.window.state().has_session);
    }
    // A damaged one.
    std::fs::write(stage.data("seen.toml"), "isinglass_state = 1\nvolume = 3\n").unwrap();
    stage.drop_file(stage.data("seen.toml"));
    until(&mut stage.window, "a message", |w| {
        w.query_all_by_label_contains("seen.toml: line 2").next().is_some()
    });
}

#[test]
fn a_link_that_is_pasted_over_the_picture_connects_and_keeps_camera_and_look() {
    let (_first, links) = porter(&Builtin::Shells.volume(16));
    let (_second, others) = porter(&Builtin::Shells.volume(16));
    let mut stage = Stage::new(Servers::default(), |_| Recent::default());
    stage.paste(&links[0].to_string());
    press(&mut stage.window, Key::Enter);
    until(&mut stage.window, "the server", is_shown);
    let first_view = stage.window.state().app.seen().unwrap();
    press(&mut stage.window, Key::ArrowLeft);
    press(&mut stage.window, Key::M);
    let seen = stage.window.state().app.seen().unwrap();
    assert!(seen.0 != first_view.0 && seen.1 != first_view.1, "control: it is another view");
    stage.window.event(Event::Paste(others[0].to_string()));
    stage.window.run_steps(2);
    let place = others[0].place();
    until(&mut stage.window, "the other server", |w| w.state().opening.is_none());
    until(&mut stage.window, "its list", |_| {
        std::fs::read_to_string(stage.folder.path().join("recent.toml"))
            .is_ok_and(|list| list.contains(&place))
    });
    assert_eq!(stage.window.state().app.seen().unwrap(), seen);
    // A link to the server that is shown connects to nothing.
    stage.window.event(Event::Paste(others[1].to_string()));
    stage.window.run_steps(2);
    assert!(stage.window.state().opening.is_none());
    assert!(stage.window.state().app.notice().contains("connected to that server already"));
}
