//! Who else looks at this volume, and whom to follow.

use egui::{RichText, Role, Ui, vec2};
use isinglass_core::wire::ViewerEntry;
use lucide_icons::Icon;

use super::style::{icon, named};

/// Shows a menu of the people at this server, if there are others. Returns the number of the one to follow, or `None`
/// inside for nobody.
pub(crate) fn show(
    ui: &mut Ui,
    list: &[ViewerEntry],
    following: Option<&ViewerEntry>,
) -> Option<Option<u32>> {
    if list.len() < 2 {
        return None;
    }
    let text = match following {
        Some(leader) => format!("following {}", name_of(leader, list)),
        None => format!("{} people", list.len()),
    };
    let mut chosen = None;
    // It is as low as the line that it stands in.
    ui.spacing_mut().interact_size.y = 0.0;
    ui.spacing_mut().button_padding = vec2(5.0, 1.0);
    let shown = ui.menu_button((icon(Icon::Users).size(SIZE), RichText::new(&text).size(SIZE)), |ui| {
        if ui.radio(following.is_none(), "On my own").clicked() && following.is_some() {
            chosen = Some(None);
        }
        for viewer in list.iter().filter(|viewer| !viewer.is_own) {
            let is_followed = following.is_some_and(|leader| leader.number == viewer.number);
            let item = ui.radio(is_followed, format!("Follow {}", name_of(viewer, list)));
            let item = item.on_hover_text("See what this person sees. You can still turn your own view.");
            if item.clicked() && !is_followed {
                chosen = Some(Some(viewer.number));
            }
        }
    });
    named(&shown.response, Role::Button, &text);
    chosen
}

/// The name, with a number where another one has the same.
fn name_of(viewer: &ViewerEntry, list: &[ViewerEntry]) -> String {
    let num_same = list.iter().filter(|other| other.name == viewer.name).count();
    match viewer.name.is_empty() || num_same > 1 {
        true => format!("{} {}", viewer.name, viewer.number + 1).trim().to_owned(),
        false => viewer.name.clone(),
    }
}

/// Size of the text, points.
const SIZE: f32 = 12.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn people_of_one_name_have_numbers() {
        let viewer =
            |number, name: &str| ViewerEntry { number, name: name.into(), is_own: false, follows: None };
        let list = [viewer(0, "anna"), viewer(1, "ben"), viewer(2, "anna"), viewer(3, "")];
        let names: Vec<String> = list.iter().map(|viewer| name_of(viewer, &list)).collect();
        assert_eq!(names, ["anna 1", "ben", "anna 3", "4"]);
    }
}
