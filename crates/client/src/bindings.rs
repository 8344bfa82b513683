//! What keys and mouse do: the one table that the window acts by and the help shows.

use egui::{Event, Key, Modifiers};

/// What a key does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// Back to the first view.
    FirstView,
    /// A standard view, from the front, the right or the top, or from the opposite side.
    StandardView(Side, Opposite),
    /// Numbers on or off.
    Numbers,
    /// The look panel open or folded.
    LookPanel,
    /// The volume's box on or off.
    Box,
    /// Handles of the clip box, and a clip box if there is none, on or off.
    Clip,
    /// Perspective or parallel rays.
    Projection,
    /// Axes and scale bar on or off.
    Axes,
    /// The next kind of stereo.
    Stereo,
    /// One edit of the transfer function back.
    Undo,
    /// One edit of the transfer function forward.
    Redo,
    /// So many times on in the server's file, or back.
    StepTime(i32),
    /// The state of the view as a file.
    SaveState,
    /// The field for the file of a state.
    OpenState,
    /// A link to what is seen, in the clipboard.
    CopyLink,
    /// The help on or off.
    Help,
    /// The help off.
    CloseHelp,
    /// The end.
    Quit,
}

/// Where a standard view looks from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// A patient's anterior side, or +z.
    Front,
    /// What is on the right hand in the view from the front: a patient's left side, or +x.
    Right,
    /// A patient's head, or +y.
    Top,
}

/// Whether a standard view is taken from the other side.
pub type Opposite = bool;

/// A line of the table.
#[derive(Clone, Copy, Debug)]
pub struct Binding {
    /// Keys or movements, as people read them.
    pub keys: &'static str,
    /// What they do.
    pub text: &'static str,
    /// Each key with what it does; nothing for the mouse.
    chords: &'static [(Modifiers, Key, Action)],
}

/// Every line.
pub const BINDINGS: &[Binding] = &[
    mouse("left drag", "orbit"),
    mouse("middle or shift+left drag", "pan"),
    mouse("ctrl+left drag", "roll"),
    mouse("wheel, pinch", "zoom at the pointer"),
    mouse("right drag", "zoom"),
    mouse("double click", "turn about what is visible there"),
    keys("r", "first view", &[(NONE, Key::R, Action::FirstView)]),
    keys(
        "1, 3, 7",
        "from the front, the right, the top; Shift: from the opposite side",
        &[
            (NONE, Key::Num1, Action::StandardView(Side::Front, false)),
            (NONE, Key::Num3, Action::StandardView(Side::Right, false)),
            (NONE, Key::Num7, Action::StandardView(Side::Top, false)),
            (SHIFT, Key::Num1, Action::StandardView(Side::Front, true)),
            (SHIFT, Key::Num3, Action::StandardView(Side::Right, true)),
            (SHIFT, Key::Num7, Action::StandardView(Side::Top, true)),
        ],
    ),
    keys("5", "perspective or orthographic", &[(NONE, Key::Num5, Action::Projection)]),
    keys("c", "clip: handles to drag on or off", &[(NONE, Key::C, Action::Clip)]),
    keys("l", "look panel open or folded", &[(NONE, Key::L, Action::LookPanel)]),
    keys("o", "numbers on or off", &[(NONE, Key::O, Action::Numbers)]),
    keys("b", "the volume's box on or off", &[(NONE, Key::B, Action::Box)]),
    keys("a", "axes and scale bar on or off", &[(NONE, Key::A, Action::Axes)]),
    keys("s", "stereo: side by side, red-cyan, off", &[(NONE, Key::S, Action::Stereo)]),
    keys(
        "Ctrl+z, Ctrl+Shift+z",
        "undo and redo edits of the transfer function",
        &[(CTRL_SHIFT, Key::Z, Action::Redo), (CTRL, Key::Z, Action::Undo)],
    ),
    keys(
        "[, ]",
        "the time before, the next time",
        &[(NONE, Key::OpenBracket, Action::StepTime(-1)), (NONE, Key::CloseBracket, Action::StepTime(1))],
    ),
    mouse("in the curve: click, drag", "add a point, move one"),
    mouse("in the curve: middle click, Del", "remove a point"),
    mouse("in the curve: left, right; up, down", "choose a point; change its opacity"),
    mouse("in the curve: Shift+left, Shift+right", "move a point along the values"),
    mouse("in the curve: right or ctrl+left drag", "level and window"),
    keys(
        "Ctrl+s, Ctrl+o",
        "save the state of the view as a file; open one",
        &[(CTRL, Key::S, Action::SaveState), (CTRL, Key::O, Action::OpenState)],
    ),
    keys(
        "Ctrl+l",
        "copy a link to what is seen; Ctrl+v shows what such a link says",
        &[(CTRL, Key::L, Action::CopyLink)],
    ),
    keys("h, F1", "this help", &[(NONE, Key::H, Action::Help), (NONE, Key::F1, Action::Help)]),
    keys("Esc", "close help", &[(NONE, Key::Escape, Action::CloseHelp)]),
    keys("Ctrl+q", "close the window", &[(CTRL, Key::Q, Action::Quit)]),
];

const fn mouse(keys: &'static str, text: &'static str) -> Binding {
    Binding { keys, text, chords: &[] }
}

const fn keys(
    keys: &'static str,
    text: &'static str,
    chords: &'static [(Modifiers, Key, Action)],
) -> Binding {
    Binding { keys, text, chords }
}

const NONE: Modifiers = Modifiers::NONE;
const SHIFT: Modifiers = Modifiers::SHIFT;
const CTRL: Modifiers = Modifiers::COMMAND;
const CTRL_SHIFT: Modifiers = Modifiers::COMMAND.plus(Modifiers::SHIFT);

/// Takes the keys of the table out of a refresh's events, and says what they do. While a person `types`, keys without
/// Ctrl are letters, and undo is the text's.
pub(crate) fn take_actions(events: &mut Vec<Event>, types: bool) -> Vec<Action> {
    let mut actions = Vec::new();
    events.retain(|event| {
        let Event::Key { key, physical_key, pressed: true, repeat, modifiers } = event else { return true };
        let Some(action) = action_of(*key, *physical_key, *modifiers) else { return true };
        let is_text = types && !matches!(action, Action::Quit | Action::CloseHelp);
        // A key that is held down asks once for what switches.
        if !is_text && (!repeat || matches!(action, Action::Undo | Action::Redo)) {
            actions.push(action);
        }
        // Whoever else listens for it may close, too: a list, a chosen point.
        is_text || action == Action::CloseHelp
    });
    actions
}

/// Digits are found by their place on the keyboard: with shift, or in some countries without, they are other signs.
fn action_of(key: Key, physical_key: Option<Key>, modifiers: Modifiers) -> Option<Action> {
    let is_digit = |k: &Key| matches!(k, Key::Num1 | Key::Num3 | Key::Num5 | Key::Num7);
    let key = physical_key.filter(is_digit).unwrap_or(key);
    let chords = BINDINGS.iter().flat_map(|b| b.chords);
    let mut fitting = chords.filter(|(m, k, _)| *k == key && modifiers.matches_exact(*m));
    fitting.next().map(|(_, _, action)| *action)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn press(key: Key, physical_key: Option<Key>, modifiers: Modifiers, repeat: bool) -> Event {
        Event::Key { key, physical_key, pressed: true, repeat, modifiers }
    }

    #[test]
    fn every_key_of_the_table_does_what_its_line_says_and_no_chord_is_there_twice() {
        let mut seen = Vec::new();
        for (modifiers, key, action) in BINDINGS.iter().flat_map(|b| b.chords) {
            let mut events = vec![press(*key, None, *modifiers, false)];
            let left = usize::from(*action == Action::CloseHelp);
            assert_eq!((take_actions(&mut events, false), events.len()), (vec![*action], left));
            assert!(!seen.contains(&(*modifiers, *key)), "{key:?} twice");
            seen.push((*modifiers, *key));
        }
        let mut other = vec![press(Key::X, None, NONE, false), press(Key::R, None, Modifiers::ALT, false)];
        assert_eq!((take_actions(&mut other, false), other.len()), (vec![], 2));
    }

    #[test]
    fn digits_are_where_they_are_on_the_keyboard() {
        let opposite = Action::StandardView(Side::Front, true);
        assert_eq!(action_of(Key::Exclamationmark, Some(Key::Num1), SHIFT), Some(opposite));
        assert_eq!(
            action_of(Key::A, Some(Key::Q), NONE),
            Some(Action::Axes),
            "letters are where they are written"
        );
    }

    #[test]
    fn a_person_who_types_is_left_alone() {
        let mut events = vec![press(Key::R, None, NONE, false), press(Key::Z, None, CTRL, false)];
        assert_eq!((take_actions(&mut events, true), events.len()), (vec![], 2));
        let mut events = vec![press(Key::Q, None, CTRL, false)];
        assert_eq!(take_actions(&mut events, true), [Action::Quit]);
    }

    #[test]
    fn a_held_key_switches_once_and_undoes_on() {
        let held =
            |key, m| vec![press(key, None, m, false), press(key, None, m, true), press(key, None, m, true)];
        assert_eq!(take_actions(&mut held(Key::O, NONE), false), [Action::Numbers]);
        assert_eq!(take_actions(&mut held(Key::Z, CTRL), false), [Action::Undo; 3]);
    }
}
