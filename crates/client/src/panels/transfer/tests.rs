//! The editor's own widgets under a pointer and a keyboard.

use egui::{Event, Key, Modifiers, PointerButton, Pos2, vec2};
use egui_kittest::Harness;
use egui_kittest::kittest::{NodeT, Queryable};
use isinglass_formats::preset;

use super::*;

struct Bench {
    editor: TransferEditor,
    /// What a server would have.
    given: TransferFunction,
    scale: ValueScale,
    edits: usize,
    shaded: Option<bool>,
    /// In the mode of surfaces.
    isos: Option<Isos>,
}

fn harness(name: &str) -> Harness<'static, Bench> {
    let scale = ValueScale::of(&isinglass_core::wire::VolumeDescription {
        name: "test".into(),
        dims: [4, 4, 4],
        spacing: [1.0; 3],
        unit: None,
        orientation: None,
        placement: None,
        value_unit: None,
        value_range: (-1000.0, 3000.0),
        histogram_range: (-1000.0, 3000.0),
        histogram: (0..256).map(|i| 10_000 / (1 + i)).collect(),
        channels: vec![],
    });
    let given = preset(name).unwrap();
    let bench = Bench { editor: TransferEditor::default(), given, scale, edits: 0, shaded: None, isos: None };
    let show = |ui: &mut Ui, bench: &mut Bench| {
        bench.editor.follow(&bench.given, &bench.scale);
        let presets: Vec<_> = isinglass_formats::preset_names().collect();
        bench.editor.show(ui, &bench.scale, &presets, bench.isos.as_mut());
        let edit = bench.editor.take_edit(ui.ctx());
        bench.shaded = edit.shaded.or(bench.shaded);
        if let Some(transfer) = edit.transfer {
            transfer.validate().unwrap();
            bench.given = transfer;
            bench.edits += 1;
        }
    };
    Harness::builder().with_size(vec2(340.0, 460.0)).build_ui_state(show, bench)
}

fn point(h: &Harness<'_, Bench>, number: usize) -> Pos2 {
    h.get_by_label_contains(&format!("point {number} of ")).rect().center()
}

fn marks_of(h: &Harness<'_, Bench>) -> Marks {
    h.state().editor.curve.marks.clone()
}

fn stop(h: &Harness<'_, Bench>, number: usize) -> Pos2 {
    h.get_by_label_contains(&format!("stop {number} of ")).rect().center()
}

fn button(h: &Harness<'_, Bench>, pos: Pos2, button: PointerButton, pressed: bool, modifiers: Modifiers) {
    h.event(Event::PointerButton { pos, button, pressed, modifiers });
}

/// Every event is a refresh of its own.
fn drag_with(
    h: &mut Harness<'_, Bench>,
    with: PointerButton,
    modifiers: Modifiers,
    from: Pos2,
    by: egui::Vec2,
) {
    h.event(Event::PointerMoved(from));
    button(h, from, with, true, modifiers);
    for i in 1..=4 {
        h.event(Event::PointerMoved(from + by * (i as f32 / 4.0)));
    }
    button(h, from + by, with, false, modifiers);
    h.run();
}

fn drag(h: &mut Harness<'_, Bench>, from: Pos2, by: egui::Vec2) {
    drag_with(h, PointerButton::Primary, Modifiers::NONE, from, by);
}

fn press(h: &mut Harness<'_, Bench>, modifiers: Modifiers, key: Key) {
    h.key_press_modifiers(modifiers, key);
    h.run();
}

fn click(h: &mut Harness<'_, Bench>, label: &str) {
    h.get_by_label(label).click();
    h.run();
}

fn choose(h: &mut Harness<'_, Bench>, combo: &str, item: &str) {
    h.get_by_role_and_label(egui::Role::ComboBox, combo).click();
    h.run();
    h.get_by_label(item).click();
    h.run();
}

#[test]
fn a_point_follows_the_pointer_and_undo_brings_it_back() {
    let mut h = harness("ct");
    let before = h.state().given.clone();
    let marks = marks_of(&h);
    let at = point(&h, 4);
    drag(&mut h, at, vec2(6.0, -40.0));
    let moved = h.state().given.clone();
    for (i, (a, b)) in marks.points.iter().zip(&marks_of(&h).points).enumerate() {
        if i == 3 {
            assert!(b.is[0] > 2.0 * a.is[0] && b.x > a.x, "{a:?} {b:?}");
        } else {
            assert_eq!(a, b, "no other point moves");
        }
    }
    assert_eq!(marks_of(&h).stops, marks.stops, "and no colour");
    assert!(point(&h, 4).distance(at + vec2(6.0, -40.0)) < 1.0, "it lies under the pointer");
    assert!(h.state().edits >= 4, "each refresh of the movement is an edit");
    click(&mut h, "undo");
    assert_eq!(h.state().given, before, "one movement, one step");
    click(&mut h, "redo");
    assert_eq!(h.state().given, moved);
    click(&mut h, "reset");
    assert_eq!(h.state().given, before);
    click(&mut h, "undo");
    assert_eq!(h.state().given, moved, "a reset can be undone");
}

#[test]
fn a_click_adds_a_point_and_a_middle_click_or_delete_removes_it() {
    let mut h = harness("mri");
    let before = marks_of(&h);
    let free = point(&h, 1) + vec2(30.0, -70.0);
    drag(&mut h, free, vec2(0.0, 0.0));
    assert_eq!(marks_of(&h).points.len(), before.points.len() + 1);
    assert_eq!(marks_of(&h).stops, before.stops, "it has no colour of its own");
    assert!(point(&h, 2).distance(free) < 1.0);
    drag_with(&mut h, PointerButton::Middle, Modifiers::NONE, free, vec2(0.0, 0.0));
    assert_eq!(marks_of(&h), before);
    drag(&mut h, free, vec2(9.0, 5.0));
    assert!(point(&h, 2).distance(free + vec2(9.0, 5.0)) < 1.0, "a new point can be dragged on at once");
    press(&mut h, Modifiers::NONE, Key::Delete);
    assert_eq!(marks_of(&h), before);
    // A press beside all points with the middle button is for nobody.
    drag_with(&mut h, PointerButton::Middle, Modifiers::NONE, free, vec2(0.0, 0.0));
    assert_eq!(marks_of(&h), before);
}

#[test]
fn arrows_choose_points_and_move_them() {
    let mut h = harness("ct");
    let at = point(&h, 2);
    drag(&mut h, at, vec2(0.0, 0.0));
    let (given, before) = (h.state().given.clone(), marks_of(&h));
    assert_eq!(h.state().editor.selected, Some(Selected::Point(1)));
    press(&mut h, Modifiers::NONE, Key::ArrowRight);
    assert_eq!(
        (h.state().editor.selected_point(), &h.state().given),
        (Some(2), &given),
        "choosing is no edit"
    );
    press(&mut h, Modifiers::NONE, Key::ArrowUp);
    press(&mut h, Modifiers::SHIFT, Key::ArrowRight);
    let (a, b) = (before.points[2], marks_of(&h).points[2]);
    assert!(b.is[0] > a.is[0] && b.x > a.x, "{a:?} {b:?}");
    press(&mut h, Modifiers::SHIFT, Key::ArrowLeft);
    press(&mut h, Modifiers::NONE, Key::ArrowDown);
    let c = marks_of(&h).points[2];
    // There and back on the axes of the plot, in single precision.
    assert!((a.x - c.x).abs() < 1e-5 && (a.is[0] - c.is[0]).abs() < 1e-5, "{a:?} {c:?}");
    press(&mut h, Modifiers::NONE, Key::ArrowLeft);
    press(&mut h, Modifiers::NONE, Key::Backspace);
    assert_eq!(marks_of(&h).points.len(), before.points.len() - 1);
    press(&mut h, Modifiers::NONE, Key::Escape);
    assert_eq!(h.state().editor.selected, None);
}

#[test]
fn window_and_level_are_dragged_on_the_strip_and_with_the_right_button() {
    let mut h = harness("ct");
    let before = h.state().editor.curve.clone();
    let strip = h.get_by_label("window and level").rect();
    drag(&mut h, strip.center(), vec2(20.0, 0.0));
    let moved = h.state().editor.curve.clone();
    let (level, window) = before.level_and_window();
    let (new_level, new_window) = moved.level_and_window();
    assert!(
        new_level > level + 50.0 && (new_window - window).abs() < 1.0,
        "{level} {new_level} {new_window}"
    );
    assert_eq!(moved.transfer.points, before.transfer.points, "the whole curve goes with it");
    drag(&mut h, strip.center(), vec2(0.0, -40.0));
    assert!(h.state().editor.curve.level_and_window().1 < 0.8 * new_window, "up is narrower");
    click(&mut h, "undo");
    click(&mut h, "undo");
    assert_eq!(h.state().editor.curve, before);
    for (with, modifiers) in
        [(PointerButton::Secondary, Modifiers::NONE), (PointerButton::Primary, Modifiers::COMMAND)]
    {
        let free = point(&h, 1) + vec2(40.0, -100.0);
        drag_with(&mut h, with, modifiers, free, vec2(-15.0, 0.0));
        assert!(h.state().editor.curve.level_and_window().0 < level - 50.0);
        assert_eq!(h.state().given.points, before.transfer.points, "and no point is added");
        click(&mut h, "undo");
    }
    // An end alone.
    let axis = strip.width() - 14.0;
    let high_end = strip.left()
        + 7.0
        + axis * {
            let (lo, hi) = h.state_mut().editor.view.unwrap();
            (before.domain.1 - lo) / (hi - lo)
        };
    drag(&mut h, Pos2::new(high_end, strip.center().y), vec2(-30.0, 0.0));
    let (lo, hi) = h.state().editor.curve.domain;
    assert!(lo == before.domain.0 && hi < before.domain.1 - 50.0, "{lo} {hi}");
}

#[test]
fn buttons_set_the_range_and_the_slider_shifts_all_of_it() {
    let mut h = harness("ct");
    let points = h.state().given.points.clone();
    for (label, domain) in [
        ("full", Domain::Full),
        ("0.1–99.9 %", Domain::Percentiles(0.1, 99.9)),
        ("1–99 %", Domain::Percentiles(1.0, 99.0)),
    ] {
        click(&mut h, label);
        assert_eq!((h.state().given.domain, &h.state().given.points), (domain, &points));
    }
    click(&mut h, "reset");
    // A range changes neither opacity nor brightness of the whole.
    h.get_by_label("opacity of the whole curve").set_value_accesskit(2.0);
    h.run();
    let (tone, marks, thick) = (h.state().editor.curve.tone, marks_of(&h), h.state().given.points.clone());
    assert!(tone != Tone::default() && h.state().editor.is_edited());
    click(&mut h, "full");
    assert_eq!((h.state().editor.curve.tone, &h.state().given.points), (tone, &thick));
    assert_eq!((marks_of(&h), &h.state().given.domain), (marks, &Domain::Full));
    h.get_by_label("opacity of the whole curve").set_value_accesskit(1.0);
    h.run();
    assert_eq!(h.state().given.points, points);
    assert!(h.state().editor.is_edited(), "another domain");
    click(&mut h, "reset");
    assert!(!h.state().editor.is_edited());
    let (level, window) = h.state().editor.curve.level_and_window();
    h.get_by_label("shift of the whole curve").set_value_accesskit(250.0);
    h.run();
    let (shifted, same) = h.state().editor.curve.level_and_window();
    assert!((shifted - level - 250.0).abs() < 0.01 && (same - window).abs() < 0.01, "{level} {shifted}");
    let edits = h.state().edits;
    click(&mut h, "log");
    click(&mut h, "fit");
    assert_eq!(h.state().edits, edits, "how the histogram is drawn is no edit");
    assert!(!h.state().editor.is_log);
}

#[test]
fn presets_and_colour_maps_are_one_step_each() {
    let mut h = harness("ct");
    choose(&mut h, "preset", "Fluorescence");
    assert_eq!(h.state().given, preset("fluorescence").unwrap());
    choose(&mut h, "colour map", "viridis");
    let (mapped, plain) = (h.state().given.clone(), preset("fluorescence").unwrap());
    let points = Marks::of(&plain.points).points;
    assert_eq!(marks_of(&h).points, points, "a colour map replaces stops and no point");
    let map = ColorMap::named("viridis").unwrap();
    for x in (0..=50).map(|i| i as f32 / 50.0) {
        let (color, opacity) = h.state().editor.curve.at(h.state().editor.curve.value_at(x));
        assert!((0..3).all(|n| (color[n] - map.at(x)[n]).abs() < 0.03), "{x}: {color:?}");
        assert!((opacity - plain.at(x).1).abs() < 1e-5 && (mapped.at(x).1 - opacity).abs() < 1e-5);
    }
    click(&mut h, "undo");
    assert_eq!(h.state().given, preset("fluorescence").unwrap());
    click(&mut h, "undo");
    assert_eq!(h.state().given, preset("ct").unwrap());
    assert!(!h.state().editor.history.has().0);
    // What reset and the shift refer to goes back and forth with it.
    let can_reset = |h: &Harness<'_, Bench>| !h.get_by_label("reset").accesskit_node().is_disabled();
    assert_eq!((&h.state().editor.preset, can_reset(&h)), (&preset("ct").unwrap(), false));
    click(&mut h, "redo");
    assert_eq!((&h.state().editor.preset, can_reset(&h)), (&preset("fluorescence").unwrap(), false));
}

#[test]
fn a_point_has_numbers_and_a_stop_has_a_colour() {
    let mut h = harness("ct");
    let below = h.get_by_role_and_label(egui::Role::SpinButton, "level").rect();
    assert!(h.query_by_label("colour of the stop").is_none());
    let at = point(&h, 5);
    drag(&mut h, at, vec2(0.0, 0.0));
    assert!(h.query_by_label("colour of the stop").is_none(), "a point has no colour");
    let before = marks_of(&h);
    h.get_by_role_and_label(egui::Role::SpinButton, "opacity").set_value_accesskit(0.5);
    h.run();
    let after = marks_of(&h);
    assert_eq!(
        (after.points[4].is, after.points[4].x, &after.stops),
        ([0.5], before.points[4].x, &before.stops)
    );
    assert_eq!(
        h.get_by_role_and_label(egui::Role::SpinButton, "level").rect(),
        below,
        "no row moves under the pointer"
    );
    click(&mut h, "remove");
    assert_eq!(marks_of(&h).points.len(), before.points.len() - 1);
    // A stop.
    let at = stop(&h, 3);
    drag(&mut h, at, vec2(5.0, 0.0));
    let moved = marks_of(&h);
    assert!(moved.stops[2].x > before.stops[2].x && moved.stops[2].is == before.stops[2].is);
    assert_eq!(moved.points.len(), before.points.len() - 1, "no point moves or comes");
    assert!(h.query_by_label("colour of the stop").is_some());
    assert_eq!(h.get_by_role_and_label(egui::Role::SpinButton, "level").rect(), below);
    let free = stop(&h, 8) + vec2(22.0, 0.0);
    drag(&mut h, free, vec2(0.0, 0.0));
    assert_eq!(marks_of(&h).stops.len(), before.stops.len() + 1);
    press(&mut h, Modifiers::SHIFT, Key::ArrowLeft);
    press(&mut h, Modifiers::NONE, Key::Delete);
    assert_eq!((marks_of(&h).stops, marks_of(&h).points), (moved.stops, moved.points));
    press(&mut h, Modifiers::NONE, Key::ArrowRight);
    assert_eq!(h.state().editor.selected, Some(Selected::Stop(0)));
    let first = stop(&h, 1);
    drag_with(&mut h, PointerButton::Middle, Modifiers::NONE, first, vec2(0.0, 0.0));
    assert_eq!(marks_of(&h).stops.len(), before.stops.len() - 1);
}

#[test]
fn opacity_and_brightness_of_the_whole_curve_are_sliders() {
    let mut h = harness("ct");
    let (before, marks) = (h.state().given.clone(), marks_of(&h));
    h.get_by_label("opacity of the whole curve").set_value_accesskit(2.0);
    h.run();
    h.get_by_label("brightness of the whole curve").set_value_accesskit(0.5);
    h.run();
    assert_eq!(marks_of(&h), marks);
    for x in [0.2, 0.4, 0.7, 1.0] {
        assert!(h.state().given.at(x).1 > before.at(x).1 && h.state().given.at(x).0[0] < before.at(x).0[0]);
    }
    click(&mut h, "undo");
    click(&mut h, "undo");
    assert_eq!((&h.state().given, h.state().editor.curve.tone), (&before, Tone::default()));
}

#[test]
fn surfaces_are_lines_in_the_histogram() {
    let mut h = harness("ct");
    h.run();
    assert!(h.query_by_label_contains("line of surface").is_none());
    assert!(h.query_by_label("add a surface").is_none(), "the list is of one mode only");
    // Where nobody has chosen a surface, the list and the line show the server's, and looking at it chooses nothing.
    h.state_mut().isos = Some(Isos::default());
    h.run();
    assert!(h.query_by_label("value of surface 1").is_some());
    assert!(h.query_by_label_contains("line of surface 1 at").is_some());
    assert_eq!(h.state().isos, Some(Isos::default()));
    click(&mut h, "add a surface");
    assert_eq!(h.state().isos.unwrap().as_slice().len(), 2);
    h.state_mut().isos = Some("300, 1200:0.5".parse().unwrap());
    h.run();
    // The list stands below the curve, and above what is of the curve alone.
    let y = |name: &str| h.get_by_label(name).rect().center().y;
    let order =
        ["opacity over values", "value of surface 1", "value of surface 2", "add a surface", "undo"].map(y);
    assert!(order.is_sorted(), "{order:?}");
    let x = |h: &Harness<'_, Bench>, name: &str| h.get_by_label_contains(name).rect().center().x;
    assert!(x(&h, "line of surface 1 at 300") < x(&h, "line of surface 2 at"));
}

/// Steps until the thread has read or written.
fn wait(h: &mut Harness<'_, Bench>) {
    for _ in 0..2000 {
        h.step();
        if !h.state().editor.files.is_busy() {
            h.run();
            return;
        }
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    panic!("the file was never read or written");
}

#[test]
fn files_are_saved_asked_about_before_they_are_replaced_and_opened_again() {
    let folder = std::env::temp_dir().join(format!("isinglass editor {}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let file = folder.join("mine.toml");
    let mut h = harness("ct");
    let at = point(&h, 3);
    drag(&mut h, at, vec2(3.0, -20.0));
    let mine = h.state().given.clone();
    h.state_mut().editor.files.set_path(&file);
    h.run();
    click(&mut h, "save");
    wait(&mut h);
    choose(&mut h, "preset", "MR");
    click(&mut h, "save");
    wait(&mut h);
    assert!(h.query_by_label_contains("press again to replace").is_some());
    click(&mut h, "open");
    wait(&mut h);
    assert_eq!(h.state().given, mine, "what was there is there still");
    choose(&mut h, "preset", "MR");
    h.state_mut().editor.files.forget_that_it_exists();
    h.run();
    click(&mut h, "save");
    wait(&mut h);
    click(&mut h, "replace");
    wait(&mut h);
    choose(&mut h, "preset", "CT");
    click(&mut h, "open");
    wait(&mut h);
    assert_eq!(h.state().given, preset("mri").unwrap());

    let slicer = r#"<P><VolumeProperty name="one" shade="0" scalarOpacity="4 0 0 100 1" colorTransfer="4 0 1 0 0"/>
        <VolumeProperty name="two" shade="1" scalarOpacity="4 5 0 50 1" colorTransfer="4 0 0 1 0"/></P>"#;
    std::fs::write(folder.join("presets.xml"), slicer).unwrap();
    let wake = waker_of(&h.ctx);
    h.state_mut().editor.open(folder.join("presets.xml"), &wake);
    wait(&mut h);
    assert_eq!((h.state().given.name.as_str(), h.state().shaded), ("one", Some(false)));
    choose(&mut h, "presets in the file", "two");
    assert_eq!((h.state().given.domain, h.state().shaded), (Domain::Values(0.0, 50.0), Some(true)));

    h.state_mut().editor.open(folder.join("nothing.toml"), &wake);
    wait(&mut h);
    assert!(h.query_by_label_contains("nothing.toml").is_some(), "what went wrong is said");
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn a_function_from_elsewhere_is_shown_and_does_not_end_a_movement() {
    let mut h = harness("ct");
    h.state_mut().given = preset("angio").unwrap();
    h.run();
    assert_eq!(h.state().editor.curve.transfer, preset("angio").unwrap());
    let at = point(&h, 2);
    h.event(Event::PointerMoved(at));
    button(&h, at, PointerButton::Primary, true, Modifiers::NONE);
    h.event(Event::PointerMoved(at + vec2(0.0, -10.0)));
    h.run();
    h.state_mut().given = preset("mri").unwrap();
    h.event(Event::PointerMoved(at + vec2(0.0, -20.0)));
    h.run();
    assert_eq!(h.state().given.name, "angio", "the hand has the last word");
}

#[test]
fn of_a_function_wider_than_the_volume_the_part_is_shown_that_the_volume_has() {
    let mut h = harness("ct");
    let mut wide = preset("ct").unwrap();
    wide.domain = Domain::Values(-3024.0, 2000.0);
    h.state_mut().given = wide.clone();
    h.run();
    assert_eq!(h.state().editor.view, Some((-1000.0, 2000.0 + 0.06 * 5024.0)));
    wide.domain = Domain::Values(5000.0, 6000.0);
    h.state_mut().given = wide;
    h.run();
    assert_eq!(h.state().editor.view, Some((-1000.0, 6000.0)), "nothing of it: all there is");
}

#[test]
fn who_goes_through_the_numbers_changes_none() {
    let mut h = harness("ct");
    h.state_mut().given.domain = Domain::Values(-123.456_78, 1_234.567_8);
    h.run();
    let at = point(&h, 2);
    drag(&mut h, at, vec2(0.0, 0.0));
    let before = h.state().given.clone();
    for number in 0..5 {
        for end in [Key::Tab, Key::Escape, Key::Enter] {
            h.query_all_by_role(egui::Role::SpinButton).nth(number).unwrap().focus();
            h.run();
            press(&mut h, Modifiers::NONE, end);
            assert_eq!((&h.state().given, h.state().edits), (&before, 0), "{number}, {end:?}");
            h.get_by_label("window and level").focus();
            h.run();
        }
    }
}

#[test]
fn another_volume_is_shown_from_end_to_end_and_a_zoom_stays_with_its_own() {
    let mut h = harness("ct");
    let mut narrow = preset("ct").unwrap();
    narrow.domain = Domain::Values(0.0, 100.0);
    h.state_mut().given = narrow;
    h.state_mut().editor.view = Some((40.0, 50.0));
    h.run();
    h.state_mut().editor.view = Some((40.0, 50.0));
    h.run();
    assert_eq!(h.state().editor.view, Some((40.0, 50.0)));
    h.state_mut().scale.range = (20.0, 9000.0);
    h.run();
    assert_eq!(h.state().editor.view, Some((0.0, 9000.0)), "the function and the volume");
}

/// The curve becomes narrower, by undo say, than what is looked at of it.
#[test]
fn a_view_of_nothing_is_not_zoomed_but_left() {
    let mut h = harness("ct");
    h.run();
    let at = point(&h, 2);
    for view in [(2900.0, 9000.0), (4000.0, 9000.0)] {
        h.state_mut().editor.view = Some(view);
        h.event(Event::PointerMoved(at));
        h.run();
        for _ in 0..3 {
            h.event(Event::MouseWheel {
                unit: egui::MouseWheelUnit::Line,
                delta: vec2(0.0, 1.0),
                phase: egui::TouchPhase::Move,
                source: egui::MouseWheelSource::Unknown,
                modifiers: Modifiers::NONE,
            });
            h.run();
        }
        let (lo, hi) = h.state().editor.view.unwrap();
        assert!(lo < hi && hi <= 3000.0, "{lo} {hi}");
        drag(&mut h, at, vec2(20.0, 20.0));
    }
}
