//! What tests ask of any window, whatever it shows: that all in it can be named, reached by keyboard, and lies on the
//! screen.

use egui::{Rect, Shape, accesskit};
use egui_kittest::Harness;
use egui_kittest::kittest::{NodeT, Queryable};

/// Roles and names of all that the keyboard can go to.
pub(crate) fn focusable<S>(w: &Harness<'_, S>) -> Vec<(egui::Role, String)> {
    let nodes = w.root().children_recursive();
    let can_focus = nodes.filter(|n| {
        let node = n.accesskit_node();
        node.data().supports_action(accesskit::Action::Focus) && !node.is_disabled()
    });
    can_focus.map(|n| (n.accesskit_node().role(), n.accesskit_node().label().unwrap_or_default())).collect()
}

fn focused<S>(w: &Harness<'_, S>) -> Option<String> {
    let mut nodes = w.root().children_recursive().filter(|n| n.accesskit_node().is_focused());
    nodes.next().map(|n| n.accesskit_node().label().unwrap_or_default())
}

/// Every control has a name; how many there are.
pub(crate) fn assert_all_named<S>(w: &Harness<'_, S>) -> usize {
    assert_eq!(w.unnamed_widgets(), Vec::<String>::new());
    let all = focusable(w);
    for (role, name) in &all {
        assert!(!name.trim().is_empty(), "a {role:?} without a name among {all:?}");
    }
    all.len()
}

/// Tab goes around through everything that can be used now.
pub(crate) fn assert_tab_reaches_all<S>(w: &mut Harness<'_, S>) {
    let mut wanted: Vec<String> = focusable(w).into_iter().map(|(_, name)| name).collect();
    let mut reached = Vec::new();
    for _ in 0..wanted.len() + 2 {
        w.key_press(egui::Key::Tab);
        w.run_steps(4);
        reached.extend(focused(w));
    }
    wanted.retain(|name| !reached.contains(name));
    assert_eq!(wanted, Vec::<String>::new(), "not reached; reached were {reached:?}");
}

/// What lies outside `screen`, points: panes, and texts by what they say. What a pane cuts off can be scrolled to;
/// the pane itself is to be on the screen.
pub(crate) fn outside<S>(w: &Harness<'_, S>, screen: Rect) -> Vec<String> {
    // A line, or the shade around a letter, may reach over the edge it lies on.
    let room = screen.expand(2.0);
    // What lies outside altogether is not drawn, but its pane is known.
    let panes = w.ctx.memory(|m| {
        let layers = m.areas().visible_layer_ids().into_iter();
        let panes = layers.filter(|layer| layer.order != egui::Order::Background);
        panes.filter_map(|layer| m.area_rect(layer.id)).collect::<Vec<_>>()
    });
    let far = panes.into_iter().filter(|pane| !room.contains_rect(*pane));
    let mut found: Vec<String> = far.map(|pane| format!("a pane at {pane:?}")).collect();
    for clipped in &w.output().shapes {
        let bounds = clipped.shape.visual_bounding_rect();
        let is_cut_by_a_pane = !clipped.clip_rect.contains_rect(screen);
        let seen = if is_cut_by_a_pane { clipped.clip_rect.intersect(bounds) } else { bounds };
        if bounds.is_positive() && seen.is_positive() && !room.contains_rect(seen) {
            found.push(match &clipped.shape {
                Shape::Text(text) => format!("{:?} at {seen:?}", text.galley.text()),
                _ => format!("a shape at {seen:?}"),
            });
        }
    }
    found
}

/// Texts that a pane cuts off at a side.
pub(crate) fn cut_off<S>(w: &Harness<'_, S>) -> Vec<String> {
    let texts = w.output().shapes.iter().filter_map(|clipped| match &clipped.shape {
        Shape::Text(text) => Some((text, clipped.clip_rect.x_range(), text.visual_bounding_rect().x_range())),
        _ => None,
    });
    let is_cut =
        |room: egui::Rangef, text: egui::Rangef| text.min < room.min - 1.0 || text.max > room.max + 1.0;
    texts.filter(|(_, room, text)| is_cut(*room, *text)).map(|(text, ..)| text.galley.text().into()).collect()
}

/// Panes that lie over each other, by the names of their areas.
pub(crate) fn overlapping<S>(w: &Harness<'_, S>, areas: &[&str]) -> Vec<String> {
    let rects = |m: &egui::Memory| -> Vec<(String, Rect)> {
        let visible = |id| m.areas().visible_layer_ids().iter().any(|layer| layer.id == id);
        let placed = |name: &&str| {
            let id = egui::Id::unique(*name);
            Some((name.to_string(), m.area_rect(id)?)).filter(|_| visible(id))
        };
        areas.iter().filter_map(placed).collect()
    };
    let rects = w.ctx.memory(rects);
    let mut found = Vec::new();
    for (i, (name, rect)) in rects.iter().enumerate() {
        let under = rects[..i].iter().filter(|(_, other)| other.shrink(1.0).intersects(*rect));
        found.extend(under.map(|(other, _)| format!("{other} and {name}")));
    }
    found
}

#[test]
fn what_is_wrong_would_be_found() {
    let builder = Harness::builder().with_accessibility_check(false).with_size([300.0, 200.0]);
    let mut w = builder.build_ui(|ui| {
        let _ = ui.button("");
        for (name, x) in [("one", 10.0), ("two", 40.0), ("three", 250.0)] {
            let area = egui::Area::new(egui::Id::unique(name)).fixed_pos([x, 50.0]).constrain(false);
            area.show(ui.ctx(), |ui| ui.label("a label that is as wide as this"));
        }
        egui::ScrollArea::vertical().max_height(40.0).show(ui, |ui| {
            for i in 0..40 {
                ui.label(format!("line {i}"));
            }
        });
        let narrow = ui.max_rect().with_max_x(30.0);
        ui.painter().with_clip_rect(narrow).text(
            egui::pos2(10.0, 150.0),
            egui::Align2::LEFT_CENTER,
            "a text without room",
            egui::FontId::default(),
            egui::Color32::WHITE,
        );
    });
    w.run_steps(3);
    assert_eq!(w.unnamed_widgets().len(), 1);
    assert!(std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| assert_all_named(&w))).is_err());
    let screen = Rect::from_min_size(egui::Pos2::ZERO, egui::vec2(300.0, 200.0));
    let found = outside(&w, screen);
    assert!(found.len() == 2 && found[0].contains("a pane"), "{found:?}");
    assert!(found[1].contains("as wide as this"), "{found:?}");
    assert_eq!(cut_off(&w), ["a text without room", "a label that is as wide as this"]);
    assert_eq!(overlapping(&w, &["one", "two", "three"]), ["one and two"]);
    assert!(w.query_by_label("line 39").is_some() || w.query_by_label("line 1").is_some());
}
