//! Clipping by hand and the projection, in the whole window.

use isinglass_core::clip::Clip;
use isinglass_core::kernels::raycast::{CastOptions, Raycaster};

use super::*;
use crate::paint::view_aids::{self, pixel_at};

/// The picture as the window casts it now: the newest frame from the present camera, cut by the present clip.
fn cast(w: &Harness<'_, ViewerApp<HereSource>>) -> Vec<u8> {
    let app = w.state();
    let view = app.clip_view.unwrap();
    let intrinsics = Intrinsics { width: 78, height: 58, ..view.camera.intrinsics };
    let camera = Camera { intrinsics, ..view.camera };
    let frame = app.viewing.source().latest_frame().unwrap();
    let options = CastOptions { clip: app.viewing.look().unwrap().clip, ..CastOptions::default() };
    Raycaster::new(&frame.frame, &view.bounds).picture(&camera, &options).to_srgb8([0.0; 3])
}

/// Where a handle of the clip is on the screen.
fn handle(w: &Harness<'_, ViewerApp<HereSource>>, axis: usize, is_high: bool) -> egui::Pos2 {
    let app = w.state();
    let view = app.clip_view.unwrap();
    let bounds = app.viewing.look().unwrap().clip.bounds.unwrap();
    let mut middle = bounds.center();
    middle[axis] = if is_high { bounds.max[axis] } else { bounds.min[axis] };
    view_aids::projected(&view.camera.basis(), view.rect, middle, middle).unwrap()[0]
}

fn most_apart(a: &[u8], b: &[u8]) -> u8 {
    a.iter().zip(b).map(|(a, b)| a.abs_diff(*b)).max().unwrap()
}

#[test]
fn dragging_a_face_cuts_the_picture_at_once_and_the_server_s_frame_makes_it_exact() {
    let mut w = window([640.0, 480.0]);
    press(&mut w, Modifiers::NONE, Key::C);
    rest(&mut w);
    assert!(w.state().clip_editor.is_shown);
    assert_eq!(w.state().last_standing, Some(Standing::Settled), "a box around all of it cuts nothing");
    let (before, pose_before) = (cast(&w), pose(&w));
    w.state().viewing.source().here().sleeps = true;
    let old = w.state().viewing.source().latest_frame().unwrap();
    // The nearest face is drawn inwards.
    let from = handle(&w, 2, true);
    let to = from + (handle(&w, 2, false) - from) * 0.6;
    let button = |pos, pressed| Event::PointerButton {
        pos,
        button: PointerButton::Primary,
        pressed,
        modifiers: Modifiers::NONE,
    };
    w.event(Event::PointerMoved(from));
    w.event(button(from, true));
    w.event(Event::PointerMoved(to));
    w.step();
    let at_once = cast(&w);
    assert!(most_apart(&before, &at_once) > 30, "in the refresh of the movement");
    assert!(Arc::ptr_eq(&old, &w.state().viewing.source().latest_frame().unwrap()), "before any new frame");
    assert_eq!(pose(&w), pose_before, "the camera rests");
    w.event(button(to, false));
    rest(&mut w);
    // Cut here, the old frame shows what is asked for, but is not the server's picture of it.
    assert!(w.query_by_label_contains("shown with the look before").is_none());
    assert_eq!(w.state().last_standing, Some(Standing::Refining));
    w.state().viewing.source().here().sleeps = false;
    rest(&mut w);
    assert_eq!(w.state().last_standing, Some(Standing::Settled));
    let exact = cast(&w);
    assert!(
        most_apart(&exact, &before) > 30
            && !Arc::ptr_eq(&old, &w.state().viewing.source().latest_frame().unwrap())
    );
    // Drawn out again there is nothing to be seen of what the newest frame does not hold, and that is said.
    w.state().viewing.source().here().sleeps = true;
    let from = handle(&w, 2, true);
    let outwards = (from - handle(&w, 2, false)) * 0.8;
    drag(&mut w, from, outwards, Modifiers::NONE);
    assert!(w.query_by_label_contains("shown with the look before").is_some());
    w.state().viewing.source().here().sleeps = false;
    rest(&mut w);
    assert!(w.query_by_label_contains("shown with the look before").is_none());
    assert!(most_apart(&cast(&w), &exact) > 20, "the server has what was cut away");
    // Negative control: beside the handles a drag turns the camera.
    drag(&mut w, egui::pos2(60.0, 420.0), vec2(40.0, -30.0), Modifiers::NONE);
    assert_ne!(pose(&w), pose_before);
}

#[test]
fn the_projection_changes_by_key_and_in_the_panel_and_keeps_size_and_centre() {
    let mut w = window([1280.0, 720.0]);
    let camera = |w: &Harness<'_, ViewerApp<HereSource>>| w.state().clip_view.unwrap().camera;
    let is_parallel =
        |w: &Harness<'_, ViewerApp<HereSource>>| camera(w).intrinsics.projection.is_orthographic();
    let before = camera(&w);
    press(&mut w, Modifiers::NONE, Key::Num5);
    assert!(is_parallel(&w));
    let asked = w.state().viewing.source().here().asked.unwrap();
    assert_eq!(asked.0, camera(&w).pose);
    assert!(asked.1.projection.is_orthographic(), "and the server is asked for such frames");
    assert_eq!(w.state().last_standing, Some(Standing::Settled));
    // What lies at the centre's depth stays where it is.
    let right = before.pose.world_from_view * glam::Vec3::X;
    for p in [glam::Vec3::ZERO, right * 0.4] {
        let [a, b] = [before, camera(&w)].map(|c| {
            let h = c.basis().pixel_from_point(p);
            h.truncate() / h.z
        });
        assert!((a - b).length() < 0.05, "{a} {b}");
    }
    // Zooming at the pointer shows less of the world, and keeps what is there.
    let height = camera(&w).intrinsics.half_size_at(1.0).1;
    let at = egui::pos2(740.0, 300.0);
    let under = |w: &Harness<'_, ViewerApp<HereSource>>| {
        let view = w.state().clip_view.unwrap();
        let [x, y] = pixel_at(view.rect, &view.camera, at);
        view.camera.ray(x, y).0
    };
    let ray = under(&w);
    w.event(Event::PointerMoved(at));
    w.event(Event::Zoom(1.5));
    rest(&mut w);
    assert!((camera(&w).intrinsics.half_size_at(1.0).1 * 1.5 - height).abs() < 1e-3 * height);
    assert!(
        (ray.origin - under(&w).origin).cross(ray.dir).length() < 1e-3,
        "the ray under the pointer stays"
    );
    // A double click keeps the view, and another key press brings the perspective back.
    let zoomed = camera(&w);
    for pressed in [true, false, true, false] {
        let button = PointerButton::Primary;
        w.event(Event::PointerButton { pos: at, button, pressed, modifiers: Modifiers::NONE });
    }
    rest(&mut w);
    assert!(w.state().controls.as_ref().unwrap().1.center().length() > 0.05);
    assert!(
        (camera(&w).pose.eye - zoomed.pose.eye).length() < 1e-4 && camera(&w).intrinsics == zoomed.intrinsics
    );
    press(&mut w, Modifiers::NONE, Key::Num3);
    assert!(is_parallel(&w));
    press(&mut w, Modifiers::NONE, Key::Num5);
    assert!(!is_parallel(&w));
    open_panel(&mut w);
    w.get_by_label("View").scroll_to_me();
    rest(&mut w);
    w.get_by_label("View").click();
    rest(&mut w);
    w.get_by_label("Parallel").scroll_to_me();
    rest(&mut w);
    w.get_by_label("Parallel").click();
    rest(&mut w);
    assert!(is_parallel(&w));
}

#[test]
fn a_clip_that_leaves_nothing_of_another_volume_is_given_up() {
    let mut w = window([640.0, 480.0]);
    let bounds = w.state().clip_view.unwrap().bounds;
    let corner = Clip { bounds: Some(Aabb { min: bounds.max * 0.8, max: bounds.max }), plane: None };
    let look = (*w.state().viewing.look().unwrap()).clone();
    w.state_mut().viewing.set_look(Duration::from_secs(9), Look { clip: corner, ..look });
    rest(&mut w);
    assert_eq!(w.state().viewing.look().unwrap().clip, corner, "something of this one is left");
    let half = Builtin::Shells.volume(24);
    let volume = isinglass_core::volume::Volume::new(
        half.dims(),
        half.spacing() * 0.5,
        half.voxels().clone(),
        (1.0, 0.0),
        Default::default(),
    );
    {
        let here = &mut *w.state().viewing.source().here();
        here.scene = Scene::new(Arc::new(volume.unwrap()), &here.look.1.transfer, here.scene.settings);
        here.render();
    }
    rest(&mut w);
    assert_eq!(w.state().viewing.look().unwrap().clip, Clip::default());
}
