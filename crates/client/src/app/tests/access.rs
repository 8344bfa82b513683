//! Can everything be named, reached and used without a mouse?

use isinglass_core::ids::LoadId;
use isinglass_core::wire::{Choices, LoadState, LoadStatus, Part};

use super::*;
use crate::app::tests::window_walk::{
    assert_all_named, assert_tab_reaches_all, cut_off, focusable, outside, overlapping,
};

/// A film of two channels, two levels and three series, of which another time is being read.
fn give_parts(w: &mut Harness<'_, ViewerApp<HereSource>>) {
    let shown = Part { channel: Some(0), time: Some(1), level: Some(0), series: Some(0), ..Part::default() };
    let mut talk = w.state().viewing.source().talk();
    talk.selection.handle_choices(Choices {
        shown,
        whole_dims: [24; 3],
        num_channels: 2,
        channels: vec!["GFP".into(), "a channel with a name that takes more room than there is".into()],
        num_times: 9,
        levels: vec![[24; 3], [12; 3]],
        num_series: 3,
        ..Choices::default()
    });
    let state = LoadState::Reading { permille: 250 };
    let part = Part { time: Some(2), ..shown };
    talk.selection.handle_load(LoadStatus {
        load: LoadId(1),
        is_own: true,
        part,
        bytes_needed: 1 << 30,
        state,
    });
}

/// Every panel and section is open, the volume is clipped and its file has parts.
fn everything(size: [f32; 2], pixels_per_point: f32) -> Harness<'static, ViewerApp<HereSource>> {
    let mut w = window_of(size, pixels_per_point);
    give_parts(&mut w);
    press(&mut w, Modifiers::NONE, Key::C);
    open_panel(&mut w);
    for section in ["Light", "Clip", "View", "Advanced", "State"] {
        w.get_by_label(section).scroll_to_me();
        w.run_steps(4);
        w.get_by_label(section).click();
        rest(&mut w);
    }
    w.get_by_label("clip plane").scroll_to_me();
    w.run_steps(4);
    w.get_by_label("clip plane").click();
    rest(&mut w);
    w
}

#[test]
fn every_control_has_a_name_and_a_role() {
    let mut w = everything([1280.0, 1400.0], 1.0);
    // A point is chosen, so that its row is there too.
    w.get_by_label("opacity over values").focus();
    press(&mut w, Modifiers::NONE, Key::ArrowRight);
    for shows_help in [false, true] {
        w.state_mut().shows_help = shows_help;
        rest(&mut w);
        assert!(assert_all_named(&w) > 40, "{:?}", focusable(&w));
    }
    for painted in ["axes: ", "low end at ", "high end at ", "point 1 of "] {
        assert!(w.query_all_by_label_contains(painted).next().is_some(), "{painted} is told");
    }
    for control in ["z from", "plane at", "flip", "channel", "the next time", "level", "series", "cancel"] {
        let is_there = focusable(&w).iter().any(|(_, name)| name.starts_with(control));
        assert!(is_there, "{control} is a control: {:?}", focusable(&w));
    }
}

#[test]
fn tab_reaches_every_control() {
    assert_tab_reaches_all(&mut everything([1280.0, 1400.0], 1.0));
}

/// A small screen, and one of twice as many pixels an inch.
const SCREENS: [([f32; 2], f32); 2] = [([1280.0, 720.0], 1.0), ([1920.0, 1080.0], 2.0)];

#[test]
fn nothing_lies_outside_a_small_screen_or_a_fine_one() {
    for (size, pixels_per_point) in SCREENS {
        let mut w = everything(size, pixels_per_point);
        let screen = egui::Rect::from_min_size(egui::Pos2::ZERO, size.into());
        w.state_mut().notice = Some(("a line of the server's".into(), Duration::from_secs(1000)));
        rest(&mut w);
        assert_eq!(outside(&w, screen), Vec::<String>::new(), "{size:?}");
        let panes = ["overlay", "parts", "banner"];
        assert_eq!(overlapping(&w, &panes), Vec::<String>::new(), "{size:?}");
        assert_eq!(cut_off(&w), Vec::<String>::new(), "{size:?}");
        // One pixel of the picture is one of the screen.
        let picture = w.state().window.unwrap();
        let pixels = (w.state().room.size() * pixels_per_point).round();
        assert_eq!([picture.width as f32, picture.height as f32], [pixels.x, pixels.y]);
        // A click beside the middle of a point of the curve chooses it, whatever the number of pixels.
        let point = w.get_by_label_contains("point 2 of ").rect();
        assert!(point.width() >= 8.0 && point.height() >= 8.0, "{point:?}");
        press(&mut w, Modifiers::COMMAND.plus(Modifiers::SHIFT), Key::S);
        assert!(w.query_by_label("Picture of the view").is_some());
        assert_eq!(outside(&w, screen), Vec::<String>::new(), "{size:?}, with the dialog");
    }
}

#[test]
fn panes_keep_clear_of_each_other_and_of_axes_and_scale() {
    let long =
        "Reconnecting; the last picture stays usable. Connection lost: the server says nothing any more.";
    for (size, has_panel, has_parts) in [
        ([1100.0, 760.0], true, true),
        ([1100.0, 760.0], true, false),
        ([1100.0, 760.0], false, true),
        ([600.0, 400.0], true, false),
        ([600.0, 400.0], false, false),
    ] {
        let mut w = window(size);
        if has_parts {
            give_parts(&mut w);
        }
        if has_panel {
            open_panel(&mut w);
        }
        w.state().viewing.source().here().sleeps = true;
        press(&mut w, Modifiers::NONE, Key::M);
        w.state_mut().notice = Some((long.into(), Duration::from_secs(1000)));
        rest(&mut w);
        let case = format!("{size:?}, {has_panel}, {has_parts}");
        let screen = egui::Rect::from_min_size(egui::Pos2::ZERO, size.into());
        assert_eq!(outside(&w, screen), Vec::<String>::new(), "{case}");
        let panes = ["overlay", "older look", "parts", "banner"];
        assert_eq!(overlapping(&w, &panes), Vec::<String>::new(), "{case}");
        let pane = |name| w.ctx.memory(|m| m.area_rect(egui::Id::unique(name)));
        let room = w.state().room;
        for name in ["overlay", "older look", "banner", "parts"] {
            assert!(pane(name).is_none_or(|pane| room.contains_rect(pane)), "{name}, {case}");
        }
        // The harness leaves eight points around the picture.
        let corner = w.get_by_label_contains("axes: ").rect();
        let scale = egui::Rect::from_min_size(corner.right_bottom() - vec2(0.0, 64.0), vec2(180.0, 48.0));
        for name in ["banner", "parts"] {
            let is_clear = |rect: egui::Rect| !rect.intersects(corner) && !rect.intersects(scale);
            assert!(pane(name).is_none_or(is_clear), "{name}, {case}");
        }
    }
}

#[test]
fn all_keys_are_on_a_small_screen_at_once() {
    for (size, pixels_per_point) in SCREENS {
        let mut w = window_of(size, pixels_per_point);
        w.key_press(Key::H);
        // Where a refresh takes long, what is seen first is seen for long.
        w.run_steps(1);
        assert_eq!(cut_off(&w), Vec::<String>::new(), "{size:?}");
        rest(&mut w);
        let screen = egui::Rect::from_min_size(egui::Pos2::ZERO, size.into());
        assert_eq!(outside(&w, screen), Vec::<String>::new(), "{size:?}");
        let pane = w.ctx.memory(|m| m.area_rect(egui::Id::unique("help"))).unwrap();
        for (keys, text) in Bindings::default().lines() {
            for label in [&keys[..], text] {
                let lines = w.query_all_by_label(label).map(|n| n.rect());
                let lines: Vec<_> = lines.filter(|line| pane.contains_rect(*line)).collect();
                assert!(!lines.is_empty(), "{label} is not on the pane at {pane:?} of {size:?}");
            }
        }
    }
}

#[test]
fn in_a_window_that_is_too_small_the_keys_are_broken_and_scrolled() {
    for size in [[600.0, 400.0], [400.0, 300.0]] {
        let mut w = window(size);
        press(&mut w, Modifiers::NONE, Key::O);
        press(&mut w, Modifiers::NONE, Key::H);
        let screen = egui::Rect::from_min_size(egui::Pos2::ZERO, size.into());
        assert_eq!(outside(&w, screen), Vec::<String>::new(), "{size:?}");
        assert_eq!(cut_off(&w), Vec::<String>::new(), "{size:?}");
        let pane = w.ctx.memory(|m| m.area_rect(egui::Id::unique("help"))).unwrap();
        let texts = Bindings::default().lines().into_iter().map(|(_, text)| text);
        let right = texts
            .flat_map(|text| w.query_all_by_label(text).map(|n| n.rect().right()).max_by(f32::total_cmp));
        let bar = w.ctx.global_style().spacing.scroll.bar_width;
        assert!(right.fold(0.0, f32::max) <= pane.right() - bar, "the bar has its own place");
    }
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
