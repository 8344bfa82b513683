//! Is all of the panel there in a narrow window, and do hints go once they are followed?

use super::*;
use crate::app::tests::window_walk::{assert_all_named, assert_tab_reaches_all, cut_off, outside};
use crate::panels::hints::{Hint, Hints};

#[test]
fn in_a_narrow_window_icons_open_the_sections_over_the_picture() {
    for pixels_per_point in [1.0, 2.0] {
        let size = [700.0, 500.0];
        let mut w = window_of(size, pixels_per_point);
        let room = w.state().room;
        open_panel(&mut w);
        let strip = room.width() - w.state().room.width();
        assert!((30.0..60.0).contains(&strip), "the picture keeps its room: {strip}");
        let screen = egui::Rect::from_min_size(egui::Pos2::ZERO, size.into());
        assert!(w.query_by_label("opacity over values").is_some(), "the first section");
        for (section, own) in [
            ("Light", "light direction"),
            ("Clip", "clip box"),
            ("View", "Reset settings"),
            ("Advanced", "server resolution"),
            ("State", "save state"),
            ("Presets", "mode isosurface"),
        ] {
            w.get_by_role_and_label(egui::Role::CheckBox, section).click();
            rest(&mut w);
            assert!(w.query_by_label("opacity over values").is_none(), "{section} takes its place");
            assert!(w.query_all_by_label(own).next().is_some(), "{section} is there");
            assert_all_named(&w);
            assert_eq!(outside(&w, screen), Vec::<String>::new(), "{section}");
            assert_eq!(cut_off(&w), Vec::<String>::new(), "{section}");
        }
        w.get_by_role_and_label(egui::Role::CheckBox, "Presets").click();
        rest(&mut w);
        assert!(w.query_by_role_and_label(egui::Role::RadioButton, "mode isosurface").is_none(), "closed");
        w.get_by_role_and_label(egui::Role::CheckBox, "Light").click();
        rest(&mut w);
        assert_tab_reaches_all(&mut w);
    }
    // The control: a wide window docks all of them.
    let mut w = window([900.0, 700.0]);
    open_panel(&mut w);
    assert!(w.query_by_role_and_label(egui::Role::CheckBox, "Light").is_none());
}

#[test]
fn a_window_that_becomes_narrow_shows_its_picture() {
    let has_curve =
        |w: &Harness<'_, ViewerApp<HereSource>>| w.query_by_label("opacity over values").is_some();
    let mut w = window([900.0, 700.0]);
    open_panel(&mut w);
    w.set_size(vec2(700.0, 500.0));
    rest(&mut w);
    assert!(!has_curve(&w) && w.query_by_role_and_label(egui::Role::CheckBox, "Light").is_some());
    w.get_by_role_and_label(egui::Role::CheckBox, "Transfer function").click();
    rest(&mut w);
    assert!(has_curve(&w), "by choice");
    // Negative control: who opens the panel of a narrow window wants to see it.
    press(&mut w, Modifiers::NONE, Key::L);
    open_panel(&mut w);
}

#[test]
fn a_hint_goes_once_its_act_was_done() {
    let mut w = window([900.0, 700.0]);
    let hints = |w: &Harness<'_, ViewerApp<HereSource>>| {
        let texts = ["drag to turn", "wheel to zoom", "right button for the menu"];
        texts.map(|text| w.query_by_label(text).is_some())
    };
    assert_eq!(hints(&w), [false; 3], "nobody asked for hints");
    w.state_mut().hints = Hints::of(Hint::ALL.to_vec());
    rest(&mut w);
    assert_eq!(hints(&w), [true; 3]);
    let at = egui::pos2(300.0, 300.0);
    drag(&mut w, at, vec2(60.0, 40.0), Modifiers::NONE);
    assert_eq!(hints(&w), [false, true, true]);
    press(&mut w, Modifiers::NONE, Key::B);
    assert_eq!(hints(&w), [false, true, true], "another act");
    for pressed in [true, false] {
        let button = PointerButton::Secondary;
        w.event(Event::PointerButton { pos: at, button, pressed, modifiers: Modifiers::NONE });
    }
    rest(&mut w);
    assert_eq!(hints(&w), [false, true, false]);
}

#[test]
fn the_help_finds_what_is_written() {
    for size in [[1280.0, 800.0], [760.0, 500.0]] {
        let mut w = window(size);
        press(&mut w, Modifiers::NONE, Key::H);
        let screen = egui::Rect::from_min_size(egui::Pos2::ZERO, size.into());
        assert_eq!(outside(&w, screen), Vec::<String>::new(), "{size:?}");
        assert_eq!(cut_off(&w), Vec::<String>::new(), "{size:?}");
        let shows =
            |w: &Harness<'_, ViewerApp<HereSource>>, text: &str| w.query_by_label_contains(text).is_some();
        assert!(shows(&w, "Turn, move and zoom"));
        w.get_by_label("find in the help").focus();
        w.run_steps(2);
        w.event(Event::Text("probe".into()));
        rest(&mut w);
        assert!(!shows(&w, "Turn, move and zoom") && shows(&w, "No match for \"probe\""), "{size:?}");
        press(&mut w, Modifiers::COMMAND, Key::A);
        w.event(Event::Text("pointer".into()));
        rest(&mut w);
        assert!(shows(&w, "place and value under the pointer") && !shows(&w, "save a picture"), "{size:?}");
        press(&mut w, Modifiers::NONE, Key::Escape);
        assert!(!shows(&w, "place and value under the pointer"));
    }
}
