//! Do the bars do what keys do, and do pictures of presets and modes show them?

use super::*;
use crate::panels::gallery::GalleryEntry;

#[test]
fn a_button_does_what_its_key_does() {
    let mut w = window([1280.0, 720.0]);
    for (name, key) in [("box", Key::B), ("axes and scale", Key::A), ("look", Key::L)] {
        let state = |w: &Harness<'_, ViewerApp<HereSource>>| {
            let app = w.state();
            [app.aids.shows_box, app.aids.shows_axes, app.is_look_open]
        };
        let before = state(&w);
        w.get_by_role_and_label(egui::Role::CheckBox, name).click();
        rest(&mut w);
        assert_ne!(state(&w), before, "{name}");
        press(&mut w, Modifiers::NONE, key);
        assert_eq!(state(&w), before, "{name}");
    }
    w.get_by_label("Mode").click();
    rest(&mut w);
    w.get_by_label("MIP: greatest value").click();
    rest(&mut w);
    assert_eq!(w.state().viewing.look().unwrap().mode, Mode::Mip);
}

#[test]
fn a_key_leaves_the_picture_alone_and_brings_the_bars_back() {
    let mut w = window([1280.0, 720.0]);
    let room = w.state().room;
    press(&mut w, Modifiers::NONE, Key::F11);
    assert!(w.query_by_label("Open").is_none() && w.state().room.area() > room.area());
    press(&mut w, Modifiers::NONE, Key::F11);
    assert!(w.query_by_label("Open").is_some() && w.state().room == room);
}

#[test]
fn presets_and_modes_are_shown_by_pictures_of_this_volume() {
    let mut w = window([1280.0, 720.0]);
    assert_eq!(w.state().viewing.source().here().num_shots, 0, "nobody looks at them");
    w.key_press(Key::L);
    w.run_steps(10);
    assert_eq!(w.state().viewing.source().here().num_shots, 0, "the volume may change at once");
    rest(&mut w);
    rest(&mut w);
    let wanted = [GalleryEntry::Preset("shells"), GalleryEntry::Preset("smooth")].into_iter();
    let wanted = wanted.chain(Mode::ALL.into_iter().map(GalleryEntry::Mode));
    let missing: Vec<_> = wanted.filter(|entry| !w.state().gallery.has(*entry)).collect();
    assert!(missing.is_empty(), "{missing:?}");
    assert!(!w.state().gallery.has(GalleryEntry::Preset("ct-bone")), "not in Hounsfield units");
    let num = w.state().viewing.source().here().num_shots;
    rest(&mut w);
    assert_eq!(w.state().viewing.source().here().num_shots, num, "each once");
    w.get_by_role_and_label(egui::Role::RadioButton, "mode isosurface").click();
    rest(&mut w);
    // The surface is in one of the pictures.
    assert_eq!(w.state().viewing.source().here().num_shots, num + 1);
    assert!(w.state().gallery.has(GalleryEntry::Mode(Mode::Iso)));
    let look = w.state().viewing.look().unwrap();
    assert!(look.mode == Mode::Iso && look.isos.as_slice().len() == 1);
    w.get_by_role_and_label(egui::Role::RadioButton, "preset smooth").click();
    rest(&mut w);
    assert_eq!(w.state().viewing.look().unwrap().transfer.name, "smooth");
    press(&mut w, Modifiers::COMMAND, Key::Z);
    assert_eq!(w.state().viewing.look().unwrap().transfer.name, "shells", "undone");
}

/// A picture that is taken while the bars are hidden takes the place of the one that the panel asked for.
#[test]
fn pictures_of_presets_go_on_after_a_picture_of_the_view() {
    let folder = tempfile::tempdir().unwrap();
    let mut w = window([1280.0, 720.0]);
    w.state_mut().screenshots.folder = folder.path().display().to_string();
    w.state().viewing.source().here().sleeps = true;
    open_panel(&mut w);
    press(&mut w, Modifiers::NONE, Key::F11);
    w.state().viewing.source().here().sleeps = false;
    press(&mut w, Modifiers::NONE, Key::F12);
    while w.state().screenshots.is_busy() {
        rest(&mut w);
    }
    assert!(!w.state().gallery.has(GalleryEntry::Mode(Mode::Iso)), "the bars are hidden");
    press(&mut w, Modifiers::NONE, Key::F11);
    assert!(w.state().gallery.has(GalleryEntry::Mode(Mode::Iso)));
}

#[test]
fn pictures_of_modes_follow_the_curve_and_all_follow_the_clip() {
    let mut w = window([1280.0, 720.0]);
    open_panel(&mut w);
    rest(&mut w);
    let shots = |w: &Harness<'_, ViewerApp<HereSource>>| w.state().viewing.source().here().num_shots;
    let first = shots(&w);
    let point = w.get_by_label_contains("point 3 of ").rect().center();
    drag(&mut w, point, vec2(0.0, 60.0), Modifiers::NONE);
    rest(&mut w);
    assert_eq!(shots(&w) - first, Mode::ALL.len() as u32);
    let edited = shots(&w);
    // The box of the handles lies around everything, so nothing looks different.
    press(&mut w, Modifiers::NONE, Key::C);
    rest(&mut w);
    assert!(w.state().viewing.look().unwrap().clip.bounds.is_some());
    assert_eq!(shots(&w), edited);
    let bounds = w.state().clip_view.unwrap().bounds;
    let half = Aabb { max: bounds.center().with_x(bounds.max.x).with_y(bounds.max.y), ..bounds };
    let look = (*w.state().viewing.look().unwrap()).clone();
    let clip = isinglass_core::clip::Clip { bounds: Some(half), ..look.clip };
    w.state_mut().viewing.set_look(Duration::from_secs(9), Look { clip, ..look });
    rest(&mut w);
    rest(&mut w);
    assert_eq!(shots(&w) - edited, first);
}

/// While the pipelines of the first picture are made, nothing is drawn, whatever the frame is.
#[test]
fn the_badge_waits_until_something_is_drawn() {
    let mut w = window([1280.0, 720.0]);
    let words = |w: &Harness<'_, ViewerApp<HereSource>>| {
        ["waiting", "settled"].map(|word| w.query_by_label(word).is_some())
    };
    for (is_blank, expected) in [(true, [true, false]), (false, [false, true])] {
        w.state().picture_status.set_blank(is_blank);
        rest(&mut w);
        assert_eq!(words(&w), expected, "{is_blank}");
    }
}
