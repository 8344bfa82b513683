//! Measuring in the whole window: points on surfaces, their pane, the state and the CSV file.

use glam::Vec3;
use isinglass_formats::MeasureKind;

use super::*;
use crate::paint::view_aids::projected;

fn click_at(w: &mut Harness<'_, ViewerApp<HereSource>>, at: egui::Pos2) {
    w.event(Event::PointerMoved(at));
    for pressed in [true, false] {
        let button = PointerButton::Primary;
        w.event(Event::PointerButton { pos: at, button, pressed, modifiers: Modifiers::NONE });
    }
    rest(w);
}

fn points(w: &Harness<'_, ViewerApp<HereSource>>, number: usize) -> Vec<Vec3> {
    w.state().measures.measures()[number].points.iter().map(|p| Vec3::from_array(*p)).collect()
}

fn on_screen(w: &Harness<'_, ViewerApp<HereSource>>, point: Vec3) -> egui::Pos2 {
    let view = w.state().clip_view.unwrap();
    projected(&view.camera.basis(), view.rect, point, point).unwrap()[0]
}

/// Two places where the shells are seen.
const PLACES: [egui::Pos2; 2] = [egui::pos2(420.0, 320.0), egui::pos2(480.0, 380.0)];

fn measured() -> Harness<'static, ViewerApp<HereSource>> {
    let mut w = window([900.0, 700.0]);
    press(&mut w, Modifiers::NONE, Key::D);
    PLACES.iter().for_each(|at| click_at(&mut w, *at));
    w
}

#[test]
fn two_clicks_tell_the_distance_of_what_is_seen_there() {
    let mut w = window([900.0, 700.0]);
    PLACES.iter().for_each(|at| click_at(&mut w, *at));
    assert!(w.state().measures.measures().is_empty(), "control: it is off");
    let mut w = measured();
    let [a, b] = points(&w, 0)[..] else { panic!("a distance has two points") };
    for (point, at) in [a, b].into_iter().zip(PLACES) {
        assert!(on_screen(&w, point).distance(at) < 0.5, "the point is under the pointer");
        let bounds = w.state().clip_view.unwrap().bounds;
        assert!(point.cmpge(bounds.min).all() && point.cmple(bounds.max).all());
    }
    let expected = format!("{:.2}", a.distance(b));
    let told = w.state().told().remove(0);
    assert!(told.starts_with(&expected[..3]), "{told} {expected}");
    assert!(w.query_by_label_contains(&format!("1: Distance {told}")).is_some(), "the bar says so");
    assert_eq!(w.unnamed_widgets(), Vec::<String>::new());
    // The camera has not moved, and a drag beside the points still turns it.
    let before = pose(&w);
    drag(&mut w, egui::pos2(200.0, 560.0), vec2(60.0, 10.0), Modifiers::NONE);
    assert!(pose(&w) != before && w.state().measures.measures().len() == 1);
    assert_eq!(points(&w, 0), [a, b], "points stay in the volume");
}

#[test]
fn a_point_is_dragged_over_the_surface_and_the_camera_stays() {
    let mut w = measured();
    let before = (pose(&w), points(&w, 0));
    let from = on_screen(&w, before.1[1]);
    drag(&mut w, from, vec2(-20.0, -90.0), Modifiers::NONE);
    let after = points(&w, 0);
    assert_eq!((pose(&w), after[0]), (before.0, before.1[0]));
    assert!(on_screen(&w, after[1]).distance(from + vec2(-20.0, -90.0)) < 0.5);
    w.get_by_label("list of measurements").click();
    rest(&mut w);
    w.get_by_label("remove measurement 1").click();
    rest(&mut w);
    assert!(w.state().measures.measures().is_empty());
}

#[test]
fn the_values_along_a_line_are_the_server_s_and_go_to_a_csv_file() {
    let mut w = window([900.0, 700.0]);
    press(&mut w, Modifiers::NONE, Key::D);
    w.get_by_label("Profile").click();
    rest(&mut w);
    PLACES.iter().for_each(|at| click_at(&mut w, *at));
    assert_eq!(w.state().measures.measures()[0].kind, MeasureKind::Profile);
    let answer = w.state().viewing.source().talk().profile.answer().cloned().unwrap();
    let ends = points(&w, 0);
    let question = isinglass_core::wire::ProfileRequest {
        id: answer.id,
        ends: [ends[0].to_array(), ends[1].to_array()],
        num_points: answer.values.len() as u16,
    };
    let volume = w.state().viewing.source().here().scene.volume.clone();
    assert_eq!(answer, question.answer(&mut &*volume));
    assert!(w.query_by_label_contains("values along").is_some());

    let folder = tempfile::TempDir::new().unwrap();
    let path = folder.path().join("a.csv");
    w.state_mut().measure_bar.set_path(&path);
    w.get_by_label("Save as CSV").click();
    for _ in 0..2000 {
        w.step();
        if path.exists() && w.query_by_label_contains("saved as").is_some() {
            break;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    let text = std::fs::read_to_string(&path).unwrap();
    assert_eq!(text.lines().count(), 1 + answer.values.len());
    assert!(text.lines().nth(1).unwrap().starts_with("1,profile,1,"), "{text}");
    // Another file of that name stays until the person says so again.
    std::fs::write(&path, "mine").unwrap();
    w.get_by_label("Save as CSV").click();
    for _ in 0..200 {
        w.step();
        std::thread::sleep(Duration::from_millis(2));
    }
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "mine");
}

#[test]
fn measurements_stay_in_place_in_another_part_of_the_file_or_go() {
    let placement =
        |x: f64| Some(Placement { center: [x, 0.0, 0.0], axes: [[1., 0., 0.], [0., 1., 0.], [0., 0., 1.]] });
    let show = |w: &mut Harness<'_, ViewerApp<HereSource>>, placement: Option<Placement>| {
        w.state().viewing.source().here().placement = placement;
        rest(w);
    };
    let source = HereSource::new();
    source.here().placement = placement(1.0);
    let mut w = window_on(source, InitialOrbit::default(), [900.0, 700.0], 1.0);
    press(&mut w, Modifiers::NONE, Key::D);
    PLACES.iter().for_each(|at| click_at(&mut w, *at));
    let before = points(&w, 0);
    show(&mut w, placement(1.25));
    let moved: Vec<Vec3> = before.iter().map(|p| *p - Vec3::X * 0.25).collect();
    assert_eq!(points(&w, 0), moved);
    assert_eq!(w.state().slices.point, Vec3::NEG_X * 0.25);
    assert!(w.query_by_label_contains("were of another volume").is_none(), "control");
    show(&mut w, None);
    assert!(w.state().measures.measures().is_empty());
    assert_eq!(w.state().slices.point, Vec3::ZERO);
    assert!(w.query_by_label_contains("were of another volume").is_some());
}

#[test]
fn two_clicks_on_a_slice_tell_the_distance_in_its_plane() {
    let mut w = window([1000.0, 800.0]);
    for key in [Key::X, Key::D] {
        press(&mut w, Modifiers::NONE, key);
    }
    let rect = w.get_by_label_contains("across z, slice ").rect();
    let app = w.state();
    let stack = app.stacks(&app.viewing.source().description().unwrap().volume)[1];
    let points_per_unit =
        (rect.size() - vec2(40.0, 40.0)).min_elem() / (2.0 * stack.half_size().max_element());
    let (point, large, before) = (app.slices.point, app.slices.large(), pose(&w));
    let [a, b] = [vec2(-40.0, 30.0), vec2(50.0, -20.0)];
    [a, b].iter().for_each(|by| click_at(&mut w, rect.center() + *by));
    let found = points(&w, 0);
    let middle = stack.moved(point, stack.index_of(point));
    for (found, by) in found.iter().zip([a, b]) {
        let in_plane = (stack.right * by.x + stack.down * by.y) / points_per_unit;
        let expected = in_plane + stack.towards * stack.towards.dot(middle);
        assert!((*found - expected).length() < 1e-4, "{found} {expected}");
    }
    assert!((found[0].distance(found[1]) - (b - a).length() / points_per_unit).abs() < 1e-4);
    // It is drawn in the pane, too.
    for by in [a, b] {
        let is_point = |shape: &egui::epaint::ClippedShape| match &shape.shape {
            egui::Shape::Circle(c) => {
                shape.clip_rect.contains(c.center) && c.center.distance(rect.center() + by) < 1.0
            }
            _ => false,
        };
        assert!(w.output().shapes.iter().any(is_point), "{by}");
    }
    let state = w.state();
    assert_eq!((state.slices.point, state.slices.large(), pose(&w)), (point, large, before), "nothing moves");
    // A point is dragged in the plane, and the common point stays.
    drag(&mut w, rect.center() + b, vec2(10.0, 25.0), Modifiers::NONE);
    let moved = points(&w, 0);
    let by = (moved[1] - found[1]) * points_per_unit;
    assert!((by.dot(stack.right) - 10.0).abs() < 1e-2 && (by.dot(stack.down) - 25.0).abs() < 1e-2, "{by}");
    assert_eq!((moved[0], w.state().slices.point), (found[0], point));
    // A drag beside the points moves the common point.
    let beside = rect.center() + vec2(-20.0, -30.0);
    let button = |pos, pressed| {
        let button = PointerButton::Primary;
        Event::PointerButton { pos, button, pressed, modifiers: Modifiers::NONE }
    };
    let to = beside + vec2(-30.0, 0.0);
    for event in
        [Event::PointerMoved(beside), button(beside, true), Event::PointerMoved(to), button(to, false)]
    {
        w.event(event);
        w.step();
    }
    rest(&mut w);
    assert!(w.state().slices.point.distance(point) > 0.01 && points(&w, 0) == moved);
    w.state_mut().slices.point = point;
    // In another slice the points are faint, and cannot be grasped.
    let view = w.state().slices.views().nth(1).unwrap();
    assert!(crate::paint::measure::Canvas::holds(&view, moved[0]));
    w.state_mut().slices.page(1, &stack, 3);
    rest(&mut w);
    let view = w.state().slices.views().nth(1).unwrap();
    assert!(!crate::paint::measure::Canvas::holds(&view, moved[0]));
    // Without measuring, a click moves the common point as ever.
    press(&mut w, Modifiers::NONE, Key::D);
    click_at(&mut w, rect.center() + a);
    assert!(w.state().slices.point.distance(point) > 0.01 && points(&w, 0) == moved);
}

#[test]
fn a_state_keeps_what_was_measured() {
    let w = measured();
    let state = w.state().saved_state(&w.ctx, w.state().window.unwrap()).unwrap();
    assert_eq!(state.measures.as_deref(), Some(w.state().measures.measures()));
    let mut other = window([900.0, 700.0]);
    other.state_mut().options.state = Some(state);
    rest(&mut other);
    assert_eq!(points(&other, 0), points(&w, 0));
    assert!(other.state().measures.is_on, "it is seen at once");
}

/// The bar leaves room for the picture and the slices, and opens only when the person says so.
#[test]
fn the_bar_leaves_the_picture_and_the_slices_free() {
    use crate::app::tests::window_walk::{assert_all_named, assert_tab_reaches_all, cut_off, outside};
    for size in [[1280.0, 800.0], [700.0, 500.0]] {
        let mut w = window(size);
        let screen = egui::Rect::from_min_size(egui::Pos2::ZERO, size.into());
        press(&mut w, Modifiers::NONE, Key::X);
        let before = w.state().room;
        press(&mut w, Modifiers::NONE, Key::D);
        for is_open in [false, true] {
            let room = w.state().room;
            let least = if is_open { 0.5 } else { 0.9 };
            assert!(room.height() > least * before.height(), "{size:?}, {room:?} of {before:?}");
            let is_bare = |at: egui::Pos2| w.ctx.layer_id_at(at).unwrap().order == egui::Order::Background;
            assert!(is_bare(room.center()) && is_bare(room.right_top() + vec2(-4.0, 4.0)), "{size:?}");
            assert_eq!(outside(&w, screen), Vec::<String>::new(), "{size:?}");
            assert_eq!(cut_off(&w), Vec::<String>::new(), "{size:?}");
            w.get_by_label("list of measurements").click();
            rest(&mut w);
        }
        for (kind, y) in [("Distance", -15.0), ("Profile", 15.0)] {
            w.get_by_label(kind).click();
            rest(&mut w);
            let middle = w.get_by_label_contains("across z, slice ").rect().center();
            [-30.0, 20.0].into_iter().for_each(|x| click_at(&mut w, middle + vec2(x, y)));
        }
        // Values along a line are seen at once.
        assert!(
            w.query_by_label("plot of the values").is_some() && w.query_by_label("Save as CSV").is_some()
        );
        assert_eq!((outside(&w, screen), cut_off(&w)), Default::default(), "{size:?}");
        assert_all_named(&w);
        assert_tab_reaches_all(&mut w);
        w.get_by_label("stop measuring").click();
        rest(&mut w);
        assert_eq!(w.state().room, before);
    }
}
