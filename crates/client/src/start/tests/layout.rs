//! Does all of the page have a name, and room?

use super::*;
use crate::app::tests::window_walk::{assert_tab_reaches_all, cut_off, focusable, outside};

/// A server and a volume in the list, and a film selected of which only a region is wanted.
fn everything(size: [f32; 2], pixels_per_point: f32) -> Stage {
    let entry = |place, shows: &str| RecentEntry { place, shows: shows.into(), used_at: 996_400 };
    let server = RecentPlace::Server { host: "render-01".into(), port: 4433 };
    let list = |folder: &Path| {
        let source = folder.join("data/film.nrrd").to_string_lossy().into_owned();
        let volume = RecentPlace::Volume(VolumeSource::new(source));
        Recent { folder: None, entries: vec![entry(server, "head.nrrd"), entry(volume, "a film")] }
    };
    let mut stage = Stage::on_screen(Servers::default(), size, pixels_per_point, list);
    stage.browse();
    stage.window.get_by_label("files").focus();
    stage.window.run_steps(2);
    stage.window.event(Event::Text("fi".into()));
    stage.window.run_steps(2);
    until(&mut stage.window, "a header", |w| w.query_by_label_contains("6×5×4 uint8").is_some());
    stage.window.get_by_label("only a region").click();
    stage.window.run_steps(3);
    stage
}

#[test]
fn everything_on_the_page_has_a_name_and_is_reached_by_tab() {
    let mut stage = everything([1280.0, 720.0], 1.0);
    // As it is once there is something to come back to.
    stage.window.state_mut().has_session = true;
    stage.window.run_steps(3);
    assert!(assert_all_named(&stage.window) > 15, "{:?}", focusable(&stage.window));
    for control in [
        "link",
        "render-01:4433",
        "forget render-01:4433",
        "up",
        "path",
        "files",
        "film.nrrd",
        "a film",
        "time",
        "end of z",
    ] {
        let is_there = focusable(&stage.window).iter().any(|(_, name)| name == control);
        assert!(is_there, "{control} is a control: {:?}", focusable(&stage.window));
    }
    assert_tab_reaches_all(&mut stage.window);
    // While something is opened there is one way out, and with a picture another.
    let (_open, gate) = sync_channel(1);
    let servers = Servers { check_gate: Some(Mutex::new(gate)), ..Servers::default() };
    let mut stage = Stage::new(servers, |_| Recent::default());
    let source = stage.folder.path().join("data/film.nrrd").to_string_lossy().into_owned();
    stage
        .window
        .state_mut()
        .open(Act::Open, LoadRequest { max_bytes: MAX_BYTES, ..LoadRequest::new(source) });
    stage.window.state_mut().has_session = true;
    stage.window.run_steps(3);
    assert_eq!(assert_all_named(&stage.window), 2);
    assert_tab_reaches_all(&mut stage.window);
}

#[test]
fn nothing_of_the_page_lies_outside_a_small_screen_or_a_fine_one() {
    for (size, pixels_per_point) in [([1280.0, 720.0], 1.0), ([1920.0, 1080.0], 2.0)] {
        let stage = everything(size, pixels_per_point);
        let screen = egui::Rect::from_min_size(egui::Pos2::ZERO, size.into());
        assert_eq!(outside(&stage.window, screen), Vec::<String>::new(), "{size:?}");
        assert_eq!(cut_off(&stage.window), Vec::<String>::new(), "{size:?}");
        let open = stage.window.get_by_label_contains("needs 240 bytes").rect();
        assert!(screen.contains_rect(open), "{open:?} in {size:?}");
    }
}

#[test]
fn the_page_fits_small_windows_in_both_themes() {
    for (size, theme) in [([1280.0, 720.0], egui::Theme::Light), ([520.0, 420.0], egui::Theme::Dark)] {
        let mut stage = Stage::of_size(Servers::default(), size, |_| Recent::default());
        stage.window.ctx.set_theme(theme);
        stage.window.run_steps(4);
        let screen = egui::Rect::from_min_size(egui::Pos2::ZERO, size.into());
        for label in ["link", "Connect"] {
            assert!(screen.contains_rect(stage.window.get_by_label(label).rect()), "{label} in {size:?}");
        }
        // The system's dialog opens files or folders; our own list opens both.
        assert!(!stage.has("Choose a folder…"));
        stage.window.state_mut().system_dialog = SystemDialog::new(true);
        stage.window.run_steps(4);
        let [file, folder] =
            ["Choose a file…", "Choose a folder…"].map(|label| stage.window.get_by_label(label).rect());
        assert!(screen.contains_rect(folder) && !file.intersects(folder), "{file:?} {folder:?}");
        assert_eq!(cut_off(&stage.window), Vec::<String>::new(), "{size:?}");
    }
}
