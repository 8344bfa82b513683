//! Files in the list, dropped files, and samples.

use super::*;

#[test]
fn files_that_are_dropped_are_told_apart_by_what_they_hold() {
    let mut stage = Stage::new(Servers::default(), |_| Recent::default());
    let drop_file = |stage: &mut Stage, name: &str| {
        let path = stage.folder.path().join("data").join(name);
        stage.window.input_mut().dropped_files.push(Arc::new(DroppedFile(path)));
        stage.window.run_steps(2);
    };
    drop_file(&mut stage, "notes.txt");
    until(&mut stage.window, "a message", |w| w.state().problem.is_some());
    assert!(stage.has("notes.txt is not supported: another kind of text. isinglass opens volumes"));
    drop_file(&mut stage, "film.nrrd");
    until(&mut stage.window, "the volume", is_shown);
    assert!(stage.window.state().problem.is_none());
    // Over a picture, what is no volume is the viewer's: a text that holds no preset is said so in its panel, which
    // opens.
    drop_file(&mut stage, "notes.txt");
    until(&mut stage.window, "the viewer's message", |w| {
        !w.state().dropped.is_busy() && w.state().opening.is_none()
    });
    until(&mut stage.window, "the viewer's message", |w| w.query_by_label_contains("notes.txt").is_some());
    // A volume without room is refused, and what is shown stays.
    drop_file(&mut stage, "large.nrrd");
    until(&mut stage.window, "a refusal", |w| w.state().problem.is_some());
    assert!(is_shown(&stage.window) && stage.has("large.nrrd: needs"));
    stage.window.get_by_label("OK").click();
    stage.window.run_steps(3);
    assert!(!stage.has("large.nrrd: needs"));
    // A folder is tried as one volume.
    drop_file(&mut stage, "inner");
    until(&mut stage.window, "a refusal", |w| w.state().problem.is_some());
}

#[test]
fn ctrl_o_opens_volumes_from_the_list_beside_the_picture() {
    let mut stage = Stage::new(Servers::default(), |_| Recent::default());
    let source = stage.folder.path().join("data/inner/small.nrrd").to_string_lossy().into_owned();
    stage
        .window
        .state_mut()
        .open(Act::Open, LoadRequest { max_bytes: MAX_BYTES, ..LoadRequest::new(source) });
    until(&mut stage.window, "the volume", is_shown);
    stage.window.key_press_modifiers(Modifiers::COMMAND, Key::O);
    stage.window.run_steps(3);
    assert!(is_shown(&stage.window) && stage.has("Open a file"));
    wait_for_kinds(&mut stage.window);
    assert_all_named(&stage.window);
    // Letters are names of files here, and not keys of the viewer.
    stage.window.event(Event::Text("fi".into()));
    press(&mut stage.window, Key::B);
    until(&mut stage.window, "a header", |w| w.query_by_label_contains("6×5×4 uint8").is_some());
    press(&mut stage.window, Key::Enter);
    until(&mut stage.window, "the other volume", |w| {
        stage.servers.started.lock().unwrap().len() == 2 && w.state().opening.is_none()
    });
    assert!(is_shown(&stage.window) && !stage.has("Open a file"));
    assert_eq!(stage.servers.started.lock().unwrap()[1].1, [6, 5, 4]);
    // A path can be written as well, and one that was copied goes into the list.
    stage.window.key_press_modifiers(Modifiers::COMMAND, Key::O);
    stage.window.run_steps(3);
    let path = stage.folder.path().join("data/noise.bin").to_string_lossy().into_owned();
    stage.window.event(Event::Paste(path));
    stage.window.run_steps(3);
    until(&mut stage.window, "what it is", |w| {
        w.query_by_label_contains("noise.bin is not supported: no header that is known").is_some()
    });
    press(&mut stage.window, Key::Enter);
    assert!(stage.has("Open a file") && stage.window.state().opening.is_none());
    press(&mut stage.window, Key::Escape);
    assert!(!stage.has("Open a file") && is_shown(&stage.window));
}

/// A volume that was chosen by the system's dialog comes to the same page as one that was chosen in the list.
#[test]
fn a_chosen_file_tells_its_size_before_it_is_read() {
    let mut stage = Stage::new(Servers::default(), |folder| {
        std::fs::copy(folder.join("data/film.nrrd"), folder.join("data/.hidden.nrrd")).unwrap();
        Recent::default()
    });
    let num_started = |stage: &Stage| stage.servers.started.lock().unwrap().len();
    // On the page, and then beside the picture; a name with a dot is not in the list.
    for (number, name) in ["film.nrrd", "inner/small.nrrd", ".hidden.nrrd"].into_iter().enumerate() {
        let path = stage.folder.path().join("data").join(name);
        stage.window.state_mut().look_at(Act::Open, vec![path]);
        stage.window.run_steps(2);
        until(&mut stage.window, "its size", |w| w.query_by_label_contains("of memory").is_some());
        wait_for_kinds(&mut stage.window);
        assert!(stage.has("Open a file") && stage.has("of memory") && num_started(&stage) == number);
        press(&mut stage.window, Key::Enter);
        until(&mut stage.window, "the volume", |w| is_shown(w) && w.state().opening.is_none());
        assert_eq!(num_started(&stage), number + 1, "{name}");
        assert!(!stage.has("Open a file"));
    }
    // Another entry of the list takes its place. A folder says what is wrong with it as one volume.
    let data = stage.folder.path().join("data");
    stage.window.state_mut().look_at(Act::Open, vec![data.join(".hidden.nrrd")]);
    until(&mut stage.window, "its size", |w| w.query_by_label_contains("of memory").is_some());
    wait_for_kinds(&mut stage.window);
    stage.window.get_by_label("noise.bin").click();
    stage.window.run_steps(3);
    assert!(!stage.has("of memory"));
    stage.window.state_mut().look_at(Act::Open, vec![data.join("inner")]);
    until(&mut stage.window, "the folder", |w| w.query_by_label("small.nrrd").is_some());
    assert_eq!(num_started(&stage), 3);
}

#[test]
fn a_written_folder_is_shown_and_files_that_come_later_are_listed() {
    let mut stage = Stage::new(Servers::default(), |_| Recent::default());
    let data = stage.folder.path().join("data");
    stage.browse();
    for (text, folder) in [("inner", data.join("inner")), ("../film.nrrd", data.clone())] {
        stage.window.get_by_label("path").focus();
        stage.window.run_steps(2);
        stage.window.key_press_modifiers(Modifiers::COMMAND, Key::A);
        stage.window.event(Event::Text(text.into()));
        stage.window.run_steps(2);
        press(&mut stage.window, Key::Enter);
        until(&mut stage.window, text, |w| {
            let shown = w.state().page.browser.folder();
            shown.canonicalize().ok() == folder.canonicalize().ok()
        });
        wait_for_kinds(&mut stage.window);
    }
    // A file's own folder is shown, and the file is selected.
    until(&mut stage.window, "a header", |w| w.query_by_label_contains("6×5×4 uint8").is_some());
    press(&mut stage.window, Key::Escape);
    std::fs::write(data.join("seen.state.toml"), "isinglass_state = 1\n").unwrap();
    assert!(!stage.has("seen.state.toml"));
    stage.browse();
    until(&mut stage.window, "the new file", |w| w.query_by_label("seen.state.toml").is_some());
}

#[test]
fn files_over_the_window_are_announced() {
    let mut stage = Stage::new(Servers::default(), |_| Recent::default());
    let hover = |stage: &mut Stage, name: &str| {
        let path = stage.folder.path().join("data").join(name);
        let file = egui::HoveredFile { path: Some(path), ..Default::default() };
        stage.window.input_mut().hovered_files = vec![file];
    };
    for (name, told) in [
        ("film.nrrd", "Open film.nrrd, "),
        ("noise.bin", "noise.bin is not supported: no header that is known"),
    ] {
        hover(&mut stage, name);
        until(&mut stage.window, told, |w| w.query_by_label_contains(told).is_some());
    }
    stage.window.input_mut().hovered_files.clear();
    stage.window.run_steps(3);
    assert!(!stage.has("noise.bin") && stage.window.state().opening.is_none(), "nothing was dropped");
}

#[test]
fn the_refusal_of_a_sample_is_in_its_card() {
    let mut stage = Stage::new(Servers::default(), |_| Recent::default());
    stage.window.get_by_label("Shells").click();
    stage.window.run_steps(2);
    until(&mut stage.window, "a refusal", |w| w.state().problem.is_some());
    // It is said in the card of the samples, below its buttons.
    let (said, button) = (stage.window.get_by_label_contains("needs "), stage.window.get_by_label("Shells"));
    assert!(said.rect().top() > button.rect().top() && said.rect().left() < button.rect().right() + 60.0);
    assert!(said.rect().left() > stage.window.get_by_label("Connect").rect().left());
}
