//! Slices beside the picture, in the whole window.

use egui_kittest::kittest::NodeT;
use isinglass_core::volume::SlabMode;

use super::*;
use crate::app::tests::window_walk::{assert_all_named, assert_tab_reaches_all, cut_off, outside};
use crate::panels::slices::Rooms;

fn slices_on(size: [f32; 2]) -> Harness<'static, ViewerApp<HereSource>> {
    let mut w = window(size);
    press(&mut w, Modifiers::NONE, Key::X);
    assert!(w.state().slices.is_on());
    w
}

/// The panes, by their names.
fn pane(w: &Harness<'_, ViewerApp<HereSource>>, name: &str) -> egui::Rect {
    let name = format!("{name}, slice ");
    w.get_by_label_contains(&name).rect()
}

/// The number that a pane tells.
fn number(w: &Harness<'_, ViewerApp<HereSource>>, name: &str) -> usize {
    let name = format!("{name}, slice ");
    let node = w.get_by_label_contains(&name);
    let label = node.accesskit_node().label().unwrap_or_default();
    label.split_whitespace().rev().nth(2).and_then(|n| n.parse().ok()).expect("slice N of M")
}

fn turn_wheel(w: &mut Harness<'_, ViewerApp<HereSource>>, at: egui::Pos2, notches: f32) {
    w.event(Event::PointerMoved(at));
    w.event(Event::MouseWheel {
        unit: egui::MouseWheelUnit::Line,
        delta: vec2(0.0, notches),
        phase: egui::TouchPhase::Move,
        source: egui::MouseWheelSource::Unknown,
        modifiers: Modifiers::NONE,
    });
    rest(w);
}

fn drag_with(
    w: &mut Harness<'_, ViewerApp<HereSource>>,
    button: PointerButton,
    from: egui::Pos2,
    by: egui::Vec2,
) {
    let event = |pos, pressed| Event::PointerButton { pos, button, pressed, modifiers: Modifiers::NONE };
    w.event(Event::PointerMoved(from));
    w.step();
    w.event(event(from, true));
    w.step();
    for i in 1..=4 {
        w.event(Event::PointerMoved(from + by * (i as f32 / 4.0)));
        w.step();
    }
    w.event(event(from + by, false));
    rest(w);
}

#[test]
fn the_picture_keeps_its_middle_beside_three_panes() {
    let mut w = window([1000.0, 800.0]);
    let whole = w.state().room;
    press(&mut w, Modifiers::NONE, Key::X);
    let room = w.state().room;
    assert!(room.width() < whole.width() * 0.55 && room.height() < whole.height() * 0.55);
    let view = w.state().clip_view.unwrap();
    assert_eq!(view.rect, room, "the volume is centred in its own part");
    for name in ["across x", "across y", "across z"] {
        assert!(!pane(&w, name).intersects(room.shrink(1.0)), "{name}");
        assert_eq!(number(&w, name), 13, "the middle of 24");
    }
    assert_eq!(outside(&w, w.ctx.content_rect()), Vec::<String>::new());
    assert_eq!(cut_off(&w), Vec::<String>::new());
    press(&mut w, Modifiers::NONE, Key::X);
    assert_eq!(w.state().room, whole);
}

#[test]
fn what_a_pane_shows_is_the_server_s_voxels() {
    let mut w = slices_on([1000.0, 800.0]);
    rest(&mut w);
    let app = w.state();
    let description = app.viewing.source().description().unwrap();
    for stack in app.stacks(&description.volume) {
        let spec = stack.spec(12, app.slices.slab).unwrap();
        let kept = app.viewing.source().talk().slices.get(&spec).expect("the slice has come");
        let volume = app.viewing.source().here().scene.volume.clone();
        assert_eq!(*kept, Slice::of(&volume, &spec, ALWAYS).unwrap());
        // The neighbours have come, too.
        for by in [-1, 1] {
            let next = stack.spec(12 + by, app.slices.slab).unwrap();
            assert!(app.viewing.source().talk().slices.get(&next).is_some());
        }
    }
}

#[test]
fn wheel_and_keys_page_and_a_click_moves_the_point_of_all_panes() {
    let mut w = slices_on([1000.0, 800.0]);
    let at = pane(&w, "across z").center();
    turn_wheel(&mut w, at, 3.0);
    assert_eq!(["across z", "across x", "across y"].map(|p| number(&w, p)), [16, 13, 13]);
    turn_wheel(&mut w, at, -1.0);
    assert_eq!(number(&w, "across z"), 15);
    press(&mut w, Modifiers::NONE, Key::PageDown);
    assert_eq!(number(&w, "across z"), 14, "the pane under the pointer has the key");
    let before = pose(&w);
    w.get_by_label_contains("across x, slice ").focus();
    for key in [Key::ArrowUp, Key::ArrowRight, Key::PageUp, Key::ArrowDown] {
        press(&mut w, Modifiers::NONE, key);
    }
    assert_eq!(["across z", "across x"].map(|p| number(&w, p)), [14, 15]);
    assert_eq!(pose(&w), before, "the camera rests");
    // A click right of and above the middle: +x and +y there.
    let rect = pane(&w, "across z");
    let half = w.state().stacks(&w.state().viewing.source().description().unwrap().volume)[1].half_size();
    let scale = (rect.size() - vec2(40.0, 40.0)).min_elem() / (2.0 * half.max_element());
    let spacing = w.state().viewing.source().description().unwrap().volume.spacing;
    let to = rect.center() + vec2(5.2 * spacing[0], -3.2 * spacing[1]) * scale;
    w.event(Event::PointerMoved(to));
    w.step();
    for pressed in [true, false] {
        let button = PointerButton::Primary;
        w.event(Event::PointerButton { pos: to, button, pressed, modifiers: Modifiers::NONE });
        w.step();
    }
    rest(&mut w);
    // Voxels 5.2 and 3.2 from the middle of 24, counted from 1.
    assert_eq!(["across x", "across y", "across z"].map(|p| number(&w, p)), [18, 16, 14]);
    assert_eq!(pose(&w), before, "no click in a pane turns the volume");
}

#[test]
fn a_drag_with_the_right_button_sets_window_and_level_without_the_server() {
    let mut w = slices_on([1000.0, 800.0]);
    rest(&mut w);
    let scale = w.state().value_scale().unwrap();
    let first = w.state().slices.window_of(&scale);
    let looks = w.state().viewing.source().here().num_looks;
    let lists = w.state().viewing.source().here().num_slice_lists;
    let at = pane(&w, "across y").center();
    drag_with(&mut w, PointerButton::Secondary, at, vec2(60.0, 0.0));
    let wider = w.state().slices.window_of(&scale);
    let width = |(lo, hi): (f32, f32)| hi - lo;
    assert!(width(wider) > width(first) * 1.2, "{first:?} {wider:?}");
    assert!(((wider.0 + wider.1) - (first.0 + first.1)).abs() < 1e-3 * width(first), "the level stays");
    drag_with(&mut w, PointerButton::Secondary, at, vec2(0.0, 40.0));
    let darker = w.state().slices.window_of(&scale);
    assert!((width(darker) - width(wider)).abs() < 1e-3 * width(wider), "the width stays");
    assert!(darker.0 > wider.0 && darker.1 > wider.1);
    assert_eq!(w.state().viewing.source().here().num_looks, looks);
    assert_eq!(w.state().viewing.source().here().num_slice_lists, lists, "nothing is said to the server");
    w.get_by_label("auto").click();
    rest(&mut w);
    assert_eq!(w.state().slices.window_of(&scale), first);
}

#[test]
fn a_double_click_enlarges_a_pane_and_the_menu_turns_it_across_the_view() {
    let mut w = slices_on([1000.0, 800.0]);
    let before = pane(&w, "across y");
    let at = before.center();
    for _ in 0..2 {
        for pressed in [true, false] {
            let button = PointerButton::Primary;
            w.event(Event::PointerMoved(at));
            w.event(Event::PointerButton { pos: at, button, pressed, modifiers: Modifiers::NONE });
        }
    }
    rest(&mut w);
    assert!(pane(&w, "across y").area() > before.area() * 2.0);
    w.get_by_label("plane: across z").click();
    rest(&mut w);
    w.get_by_label("oblique: across the view").click();
    rest(&mut w);
    let app = w.state();
    let stacks = app.stacks(&app.viewing.source().description().unwrap().volume);
    let oblique = stacks.iter().find(|s| (s.towards + pose(&w).forward()).length() < 1e-5);
    let spec = oblique.unwrap().spec(0, app.slices.slab).unwrap();
    assert!(app.viewing.source().talk().slices.get(&spec).is_some());
    assert!(w.query_by_label_contains("oblique, slice ").is_some());
}

#[test]
fn a_slab_is_requested_and_nothing_is_while_no_slice_is_shown() {
    let mut w = slices_on([1000.0, 800.0]);
    let volume = w.state().viewing.source().description().unwrap().volume.clone();
    w.state_mut().slices.slab.thickness = volume.spacing[2] * 4.0;
    rest(&mut w);
    w.get_by_label("MIP").click();
    rest(&mut w);
    assert_eq!(w.state().slices.slab.mode, SlabMode::Max);
    let app = w.state();
    let spec = app.stacks(&volume)[0].spec(12, app.slices.slab).unwrap();
    assert!(spec.thickness > 0.0 && app.viewing.source().talk().slices.get(&spec).is_some());
    // The server is slow, so the slices of another slab stay on the list.
    w.state().viewing.source().here().sleeps = true;
    let wanted = |w: &Harness<'_, ViewerApp<HereSource>>| w.state().viewing.source().here().num_wanted_slices;
    let saved = w.state().saved_slices();
    w.state_mut().slices.slab.thickness = volume.spacing[2] * 6.0;
    rest(&mut w);
    assert!(wanted(&w) > 0, "control");
    w.get_by_label("close the slices").click();
    rest(&mut w);
    assert!(!w.state().slices.is_on() && wanted(&w) == 0);
    assert!(w.query_by_label_contains(", slice ").is_none());
    // A state closes them in the same way.
    press(&mut w, Modifiers::NONE, Key::X);
    assert!(wanted(&w) > 0, "control");
    w.state_mut().restore_slices(&isinglass_formats::SavedSlices { shown: false, ..saved });
    rest(&mut w);
    assert!(!w.state().slices.is_on() && wanted(&w) == 0);
}

#[test]
fn a_drag_of_the_window_ends_though_its_release_is_never_reported() {
    let mut w = slices_on([1000.0, 800.0]);
    let at = pane(&w, "across y").center();
    let press_right = |w: &mut Harness<'_, ViewerApp<HereSource>>, pressed| {
        let (button, modifiers) = (PointerButton::Secondary, Modifiers::NONE);
        w.event(Event::PointerMoved(at));
        w.event(Event::PointerButton { pos: at, button, pressed, modifiers });
        w.step();
    };
    let scale = w.state().value_scale().unwrap();
    press_right(&mut w, true);
    let first = w.state().slices.window_of(&scale);
    w.event(Event::PointerMoved(at + vec2(30.0, 0.0)));
    w.step();
    let dragged = w.state().slices.window_of(&scale);
    assert_ne!(dragged, first, "control");
    // The panes are closed during the drag, and the release comes while they are closed.
    press(&mut w, Modifiers::NONE, Key::X);
    press_right(&mut w, false);
    press(&mut w, Modifiers::NONE, Key::X);
    w.event(Event::PointerMoved(at + vec2(90.0, 0.0)));
    rest(&mut w);
    assert_eq!(w.state().slices.window_of(&scale), dragged);
}

#[test]
fn keys_with_modifiers_and_keys_of_a_dialog_page_no_slice() {
    let mut w = slices_on([1000.0, 800.0]);
    w.get_by_label_contains("across x, slice ").focus();
    for (modifiers, key) in [(Modifiers::ALT, Key::ArrowLeft), (Modifiers::COMMAND, Key::PageUp)] {
        press(&mut w, modifiers, key);
        assert_eq!(number(&w, "across x"), 13, "{key:?}");
    }
    press(&mut w, Modifiers::NONE, Key::ArrowLeft);
    assert_eq!(number(&w, "across x"), 12, "control");
    press(&mut w, Modifiers::NONE, Key::F1);
    press(&mut w, Modifiers::NONE, Key::PageUp);
    assert_eq!(number(&w, "across x"), 12);
}

#[test]
fn a_reversed_wheel_pages_the_other_way() {
    let mut w = slices_on([1000.0, 800.0]);
    let at = pane(&w, "across z").center();
    turn_wheel(&mut w, at, 1.0);
    assert_eq!(number(&w, "across z"), 14, "control");
    w.state_mut().options.bindings.reverses_wheel = true;
    turn_wheel(&mut w, at, 1.0);
    assert_eq!(number(&w, "across z"), 13);
}

#[test]
fn rooms_are_disjoint_and_fill_the_window() {
    let mut w = slices_on([700.0, 500.0]);
    for large in [None, Some(0), Some(1), Some(2)] {
        w.state_mut().slices.set_large(large);
        let room = egui::Rect::from_min_size(egui::pos2(3.0, 5.0), vec2(601.0, 402.0));
        let Rooms { picture, panes } = w.state().slices.rooms(room);
        let all: Vec<_> = panes.into_iter().chain([picture]).collect();
        let area: f32 = all.iter().map(egui::Rect::area).sum();
        assert!(area > room.area() * 0.98 && area <= room.area() * 1.001, "{large:?}");
        for (i, a) in all.iter().enumerate() {
            assert!(room.expand(0.6).contains_rect(*a) && a.is_positive());
            assert!(all[..i].iter().all(|b| !a.shrink(0.5).intersects(b.shrink(0.5))), "{large:?}");
        }
    }
}

#[test]
fn panes_and_strip_have_names_and_tab_reaches_them() {
    let mut w = slices_on([1000.0, 800.0]);
    assert!(assert_all_named(&w) > 15);
    assert_tab_reaches_all(&mut w);
}
