//! Views by choice in the whole window: fit, the cube, the way back, another axis up, and views with a name.

use glam::Vec3;
use isinglass_formats::UpAxis;

use super::*;

const ALT: Modifiers = Modifiers::ALT;

fn click_at(w: &mut Harness<'_, ViewerApp<HereSource>>, at: egui::Pos2) {
    w.event(Event::PointerMoved(at));
    w.step();
    for pressed in [true, false] {
        let button = PointerButton::Primary;
        w.event(Event::PointerButton { pos: at, button, pressed, modifiers: Modifiers::NONE });
        w.step();
    }
    rest(w);
}

#[test]
fn one_step_back_is_one_gesture_and_one_forward_returns() {
    let mut w = window([640.0, 480.0]);
    let first = pose(&w);
    press(&mut w, ALT, Key::ArrowLeft);
    assert_eq!(pose(&w), first, "nothing has happened yet");
    drag(&mut w, egui::pos2(300.0, 300.0), vec2(77.0, -41.0), Modifiers::NONE);
    let dragged = pose(&w);
    press(&mut w, Modifiers::NONE, Key::Num7);
    let top = pose(&w);
    for (key, wanted) in [
        (Key::ArrowLeft, dragged),
        (Key::ArrowLeft, first),
        (Key::ArrowLeft, first),
        (Key::ArrowRight, dragged),
        (Key::ArrowRight, top),
    ] {
        press(&mut w, ALT, key);
        assert_eq!(pose(&w), wanted, "{key:?}");
    }
    assert!(first != dragged && dragged != top);
}

#[test]
fn a_chosen_view_is_reached_in_steps_and_a_drag_takes_over() {
    let mut w = window([640.0, 480.0]);
    let first = pose(&w);
    w.key_press(Key::Num3);
    w.run_steps(6);
    let on_the_way = pose(&w);
    let (from, _) = Orientation::of(None).standard_view(crate::input::bindings::Side::Right, false);
    let is_there = |pose: &Pose| (pose.forward() + from).length() < 1e-5;
    assert!(on_the_way != first && !is_there(&on_the_way));
    rest(&mut w);
    assert!(is_there(&pose(&w)));
    press(&mut w, Modifiers::NONE, Key::R);
    w.key_press(Key::Num3);
    w.run_steps(6);
    drag(&mut w, egui::pos2(300.0, 300.0), vec2(1.0, 0.0), Modifiers::NONE);
    assert!(!is_there(&pose(&w)), "the hand has it");
}

#[test]
fn fit_and_isometric_show_the_whole_volume() {
    let mut w = window([640.0, 480.0]);
    drag(&mut w, egui::pos2(300.0, 300.0), vec2(120.0, 60.0), Modifiers::SHIFT);
    for _ in 0..8 {
        w.key_press(Key::Plus);
        w.step();
    }
    rest(&mut w);
    let corners_inside = |w: &Harness<'_, ViewerApp<HereSource>>| {
        let view = w.state().clip_view.unwrap();
        let basis = view.camera.basis();
        let is_inside = |p: Vec3| {
            let [at, _] = crate::paint::view_aids::projected(&basis, view.rect, p, p)?;
            view.rect.contains(at).then_some(())
        };
        view.bounds.corners().into_iter().filter(|p| is_inside(*p).is_some()).count()
    };
    assert!(corners_inside(&w) < 8, "control: it is too near");
    w.get_by_label("fit the volume").click();
    rest(&mut w);
    assert_eq!(corners_inside(&w), 8);
    press(&mut w, Modifiers::NONE, Key::Num5);
    press(&mut w, Modifiers::NONE, Key::F);
    assert_eq!(corners_inside(&w), 8, "parallel rays too");
    press(&mut w, Modifiers::NONE, Key::Num0);
    let forward = pose(&w).forward();
    assert!((forward.abs() - Vec3::splat(3f32.sqrt().recip())).length() < 1e-5, "{forward}");
}

#[test]
fn a_click_on_the_cube_turns_to_what_is_clicked() {
    let mut w = window([640.0, 480.0]);
    press(&mut w, Modifiers::NONE, Key::Num1);
    let cube = w.get_by_label_contains("axes: ").rect();
    // From the front the upper edge of the cube is that of y and z.
    w.event(Event::PointerMoved(cube.center() - vec2(0.0, 21.0)));
    rest(&mut w);
    click_at(&mut w, cube.center() - vec2(0.0, 21.0));
    let forward = pose(&w).forward();
    assert!((forward + Vec3::new(0.0, 1.0, 1.0).normalize()).length() < 1e-5, "{forward}");
    let edge = pose(&w);
    click_at(&mut w, cube.min + vec2(2.0, 2.0));
    assert_eq!(pose(&w), edge, "control: beside the cube");
    // By keyboard it turns to the side that is seen best.
    press(&mut w, Modifiers::NONE, Key::R);
    w.get_by_label_contains("axes: ").focus();
    w.run_steps(4);
    press(&mut w, Modifiers::NONE, Key::Enter);
    assert!((pose(&w).forward() - Vec3::NEG_Z).length() < 1e-5, "{}", pose(&w).forward());
}

#[test]
fn the_way_back_from_a_named_view_restores_the_projection() {
    use crate::panels::toolbar::NamedViewWish;
    let mut w = window([640.0, 480.0]);
    let show = |w: &mut Harness<'_, ViewerApp<HereSource>>, wish| {
        let now = w.state().last_refresh;
        w.state_mut().do_named_view(now, wish);
        rest(w);
    };
    press(&mut w, Modifiers::NONE, Key::Num5);
    show(&mut w, NamedViewWish::Remember("parallel".into()));
    press(&mut w, Modifiers::NONE, Key::Num5);
    drag(&mut w, egui::pos2(300.0, 300.0), vec2(77.0, -41.0), Modifiers::NONE);
    let before = pose(&w);
    show(&mut w, NamedViewWish::Show(0));
    assert!(w.state().is_orthographic && pose(&w) != before, "control");
    press(&mut w, ALT, Key::ArrowLeft);
    assert!(!w.state().is_orthographic && pose(&w) == before);
    press(&mut w, ALT, Key::ArrowRight);
    assert!(w.state().is_orthographic);
}

#[test]
fn another_axis_can_be_up_and_the_state_keeps_it() {
    let mut w = window([900.0, 700.0]);
    w.get_by_label("Views").click();
    rest(&mut w);
    w.get_by_label_contains("Up").click();
    rest(&mut w);
    w.get_by_label("z").click();
    rest(&mut w);
    assert_eq!(w.state().up_axis, UpAxis::Z);
    let up = pose(&w).world_from_view * Vec3::Y;
    assert!(up.z > 0.5, "z points up in the picture: {up}");
    press(&mut w, Modifiers::NONE, Key::Num1);
    assert!((pose(&w).forward() - Vec3::Y).length() < 1e-5, "the front is where -y points");
    let state = w.state().saved_state(&w.ctx, w.state().window.unwrap()).unwrap();
    let mut other = window([900.0, 700.0]);
    other.state_mut().options.state = Some(state.clone());
    rest(&mut other);
    assert_eq!((other.state().up_axis, pose(&other)), (UpAxis::Z, pose(&w)));
    press(&mut other, Modifiers::NONE, Key::R);
    assert!((pose(&other).world_from_view * Vec3::Y).z > 0.5, "the first view, too");
}

#[test]
fn views_have_names_and_return_and_go() {
    let mut w = window([900.0, 700.0]);
    drag(&mut w, egui::pos2(300.0, 300.0), vec2(77.0, -41.0), Modifiers::NONE);
    let wanted = pose(&w);
    w.get_by_label("Views").click();
    rest(&mut w);
    w.get_by_label("name of the present view").focus();
    rest(&mut w);
    w.event(Event::Text("left nerve".into()));
    rest(&mut w);
    w.get_by_label("Remember").click();
    rest(&mut w);
    assert_eq!(w.state().named_views.len(), 1);
    press(&mut w, Modifiers::NONE, Key::R);
    assert_ne!(pose(&w), wanted);
    let state = w.state().saved_state(&w.ctx, w.state().window.unwrap()).unwrap();
    let mut other = window([900.0, 700.0]);
    assert!(other.state().named_views.is_empty());
    other.state_mut().options.state = Some(state);
    rest(&mut other);
    for w in [&mut w, &mut other] {
        w.get_by_label("Views").click();
        rest(w);
        w.get_by_label("left nerve").click();
        rest(w);
        assert_eq!(pose(w), wanted);
    }
    w.get_by_label("Views").click();
    rest(&mut w);
    w.get_by_label("remove the view left nerve").click();
    rest(&mut w);
    assert!(w.state().named_views.is_empty());
}

/// The window has the camera of the person that it follows: turned, moved to the side and rolled.
#[test]
fn who_follows_has_the_camera_of_the_leader_and_can_still_turn() {
    use isinglass_core::wire::{ServerMessage, ViewerEntry};
    for is_parallel in [false, true] {
        let mut w = window([900.0, 700.0]);
        let (start, bounds) = (pose(&w), w.state().clip_view.unwrap().bounds);
        let turn = glam::Quat::from_euler(glam::EulerRot::YXZ, 1.9, -0.4, 0.6);
        let (aside, depth) = (Vec3::new(0.3, -0.2, 0.0), 3.1);
        let led = Pose::around(bounds.center(), turn, aside + depth * Vec3::Z);
        let intrinsics = Intrinsics::perspective(48, 36, w.state().options.fov_y);
        let camera = Camera::new(led, intrinsics, &bounds);
        let camera = if is_parallel { camera.to_orthographic(depth, &bounds) } else { camera };
        w.state().viewing.source().here().leader = Some(camera);
        let viewer = |number, name: &str| ViewerEntry {
            number,
            name: name.into(),
            is_own: number == 0,
            follows: None,
        };
        let people = ServerMessage::Viewers(vec![viewer(0, "me"), viewer(1, "anna")]);
        w.state().viewing.source().talk().viewers.handle_message(&people);
        rest(&mut w);
        assert_eq!(pose(&w), start, "control: nobody is followed");
        w.get_by_label("2 people").click();
        rest(&mut w);
        w.get_by_label("Follow anna").click();
        rest(&mut w);
        assert_eq!(w.state().is_orthographic, is_parallel);
        let seen = w.state().clip_view.unwrap().camera;
        // Equal cameras have a point of the volume at the same share of the picture's height.
        let share = |camera: &Camera, p: Vec3| {
            let (h, i) = (camera.basis().pixel_from_point(p), camera.intrinsics);
            (glam::vec2(h.x, h.y) / h.z - glam::vec2(i.width as f32, i.height as f32) * 0.5) / i.height as f32
        };
        let apart = |a: &Camera, b: &Camera| {
            bounds.corners().into_iter().map(|p| (share(a, p) - share(b, p)).length()).fold(0.0, f32::max)
        };
        assert!(apart(&seen, &camera) < 1e-4, "{is_parallel}: {}", apart(&seen, &camera));
        // Negative control: the same numbers in the world's axes are another camera.
        let turned = Pose { eye: bounds.center() + aside + depth * Vec3::Z, ..led };
        assert!(apart(&seen, &Camera::new(turned, intrinsics, &bounds)) > 0.1);
        // Later frames of the leader leave the camera to the hand.
        let there = pose(&w);
        drag(&mut w, egui::pos2(300.0, 300.0), vec2(60.0, 40.0), Modifiers::NONE);
        let mine = pose(&w);
        assert_ne!(mine, there);
        w.state().viewing.source().here().render();
        rest(&mut w);
        assert_eq!(pose(&w), mine);
    }
}
