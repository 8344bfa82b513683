//! Can everything be named, reached and used without a mouse?

use egui::accesskit;
use egui_kittest::kittest::NodeT;

use super::*;

/// Roles and names of all that the keyboard can go to.
fn focusable(w: &Harness<'_, ViewerApp<HereSource>>) -> Vec<(egui::Role, String)> {
    let nodes = w.root().children_recursive();
    let can_focus = nodes.filter(|n| {
        let node = n.accesskit_node();
        node.data().supports_action(accesskit::Action::Focus) && !node.is_disabled()
    });
    can_focus.map(|n| (n.accesskit_node().role(), n.accesskit_node().label().unwrap_or_default())).collect()
}

fn focused(w: &Harness<'_, ViewerApp<HereSource>>) -> Option<(egui::Role, String)> {
    let mut nodes = w.root().children_recursive().filter(|n| n.accesskit_node().is_focused());
    nodes.next().map(|n| (n.accesskit_node().role(), n.accesskit_node().label().unwrap_or_default()))
}

/// Every panel and section is open.
fn everything() -> Harness<'static, ViewerApp<HereSource>> {
    let mut w = window([1280.0, 1400.0]);
    open_panel(&mut w);
    for section in ["Light", "Frames", "View", "State"] {
        w.get_by_label(section).scroll_to_me();
        w.run_steps(4);
        w.get_by_label(section).click();
        rest(&mut w);
    }
    w
}

#[test]
fn every_control_has_a_name_and_a_role() {
    let mut w = everything();
    // A point is chosen, so that its row is there too.
    w.get_by_label("opacity over values").focus();
    press(&mut w, Modifiers::NONE, Key::ArrowRight);
    for shows_help in [false, true] {
        w.state_mut().shows_help = shows_help;
        rest(&mut w);
        assert_eq!(w.unnamed_widgets(), Vec::<String>::new());
        let all = focusable(&w);
        assert!(all.len() > 20, "{all:?}");
        for (role, name) in &all {
            assert!(!name.trim().is_empty(), "a {role:?} without a name among {all:?}");
        }
    }
    for painted in ["axes: ", "low end at ", "high end at ", "point 1 of "] {
        assert!(w.query_all_by_label_contains(painted).next().is_some(), "{painted} is told");
    }
}

#[test]
fn what_has_no_name_would_be_found() {
    let builder = Harness::builder().with_accessibility_check(false);
    let mut w = builder.build_ui(|ui| {
        let _ = ui.button("");
    });
    w.run_steps(2);
    assert_eq!(w.unnamed_widgets().len(), 1);
}

/// Tab goes around through everything that can be used now.
#[test]
fn tab_reaches_every_control() {
    let mut w = everything();
    let mut wanted: Vec<String> = focusable(&w).into_iter().map(|(_, name)| name).collect();
    let mut reached = Vec::new();
    for _ in 0..wanted.len() + 2 {
        w.key_press(Key::Tab);
        w.run_steps(4);
        reached.extend(focused(&w).map(|(_, name)| name));
    }
    wanted.retain(|name| !reached.contains(name));
    assert_eq!(wanted, Vec::<String>::new(), "not reached; reached were {reached:?}");
}

#[test]
fn the_camera_turns_moves_and_zooms_by_keys_until_a_control_has_them() {
    let mut w = window([640.0, 480.0]);
    let first = pose(&w);
    for (there, back) in [
        ((Modifiers::NONE, Key::ArrowLeft), (Modifiers::NONE, Key::ArrowRight)),
        ((Modifiers::SHIFT, Key::ArrowUp), (Modifiers::SHIFT, Key::ArrowDown)),
        ((Modifiers::COMMAND, Key::ArrowLeft), (Modifiers::COMMAND, Key::ArrowRight)),
        ((Modifiers::NONE, Key::Plus), (Modifiers::NONE, Key::Minus)),
    ] {
        press(&mut w, there.0, there.1);
        let moved = pose(&w);
        let off = |a: Pose, b: Pose| {
            (a.eye - b.eye).length() + (1.0 - a.world_from_view.dot(b.world_from_view).abs())
        };
        // A step and its opposite leave a few roundings of a distance of about five.
        assert!(off(moved, first) > 5e-4, "{there:?} moves");
        press(&mut w, back.0, back.1);
        assert!(off(pose(&w), first) < 1e-4, "{back:?} moves back: {}", off(pose(&w), first));
    }
    press(&mut w, Modifiers::NONE, Key::ArrowLeft);
    let turned = pose(&w).eye.x;
    assert!(turned > first.eye.x, "the near side goes to the left, the eye to the right");
    open_panel(&mut w);
    w.get_by_label("window and level").focus();
    rest(&mut w);
    let (before, level) = (pose(&w), w.state().viewing.look().unwrap().transfer.domain);
    press(&mut w, Modifiers::NONE, Key::ArrowLeft);
    assert_eq!(pose(&w), before, "the strip has the arrows");
    assert_ne!(w.state().viewing.look().unwrap().transfer.domain, level);
}

#[test]
fn points_are_added_chosen_moved_and_removed_by_keys() {
    let mut w = window([1280.0, 720.0]);
    open_panel(&mut w);
    let points =
        |w: &Harness<'_, ViewerApp<HereSource>>| w.state().viewing.look().unwrap().transfer.points.clone();
    let first = points(&w);
    w.get_by_label("opacity over values").focus();
    for key in [Key::ArrowRight, Key::Enter] {
        press(&mut w, Modifiers::NONE, key);
    }
    let added = points(&w);
    assert_eq!(added.len(), first.len() + 1);
    assert!((added[1].x - 0.5 * (first[0].x + first[1].x)).abs() < 1e-5, "half-way");
    press(&mut w, Modifiers::NONE, Key::ArrowUp);
    assert!(points(&w)[1].opacity > added[1].opacity);
    press(&mut w, Modifiers::SHIFT, Key::ArrowRight);
    assert!(points(&w)[1].x > added[1].x);
    press(&mut w, Modifiers::NONE, Key::Delete);
    assert_eq!(points(&w).len(), first.len());
    press(&mut w, Modifiers::NONE, Key::Escape);
    assert!(!w.state().editor.has_selection());
    press(&mut w, Modifiers::COMMAND, Key::Z);
    assert_ne!(points(&w).len(), first.len(), "undo brings the point back");
}
