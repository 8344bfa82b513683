use super::*;

fn press(key: Key, physical_key: Option<Key>, modifiers: Modifiers, repeat: bool) -> Event {
    Event::Key { key, physical_key, pressed: true, repeat, modifiers }
}

fn taken(events: &mut Vec<Event>, focus: Focus) -> Vec<Action> {
    Bindings::default().take_actions(events, focus)
}

const NONE: Modifiers = Modifiers::NONE;
const CTRL: Modifiers = Modifiers::COMMAND;

fn set(name: &str, chords: &[&str]) -> Result<Bindings, BindingError> {
    let mut bindings = Bindings::default();
    bindings.set(name, &chords.iter().map(|c| (*c).to_owned()).collect::<Vec<_>>())?;
    bindings.check().map(|()| bindings)
}

#[test]
fn every_key_of_the_table_does_what_its_line_says_and_no_chord_is_there_twice() {
    let bindings = Bindings::default();
    bindings.check().unwrap();
    for ((name, deed, _), chords) in entries().zip(&bindings.chords) {
        for chord in chords {
            assert_eq!(chord.to_string().parse(), Ok(*chord), "{name}: {chord} is read as it is written");
            match (deed, chord) {
                (Deed::Act(action), Chord::Key(modifiers, key)) => {
                    let mut events = vec![press(*key, None, *modifiers, false)];
                    let left = usize::from(action == Action::CloseHelp);
                    assert_eq!((taken(&mut events, Focus::Picture), events.len()), (vec![action], left));
                }
                (Deed::Drag(gesture), Chord::Drag(modifiers, button)) => {
                    assert_eq!(bindings.gesture(*button, *modifiers), Some(gesture));
                }
                _ => panic!("{name} is bound to {chord}"),
            }
        }
    }
    let mut names: Vec<_> = Bindings::names().collect();
    names.sort_unstable();
    names.dedup();
    assert_eq!(names.len(), Bindings::names().count(), "every name is there once");
    let mut other = vec![press(Key::J, None, NONE, false), press(Key::R, None, Modifiers::ALT, false)];
    assert_eq!((taken(&mut other, Focus::Picture), other.len()), (vec![], 2));
}

#[test]
fn digits_are_where_they_are_on_the_keyboard() {
    let opposite = Action::StandardView(Side::Front, true);
    let bindings = Bindings::default();
    assert_eq!(bindings.action_of(Key::Exclamationmark, Some(Key::Num1), Modifiers::SHIFT), Some(opposite));
    // A sign that means something does so wherever it lies: in France - and, with AltGr, [ are on the digits' keys.
    let zoom_out = bindings.action_of(Key::Minus, None, NONE);
    assert!(zoom_out.is_some());
    assert_eq!(bindings.action_of(Key::Minus, Some(Key::Num6), NONE), zoom_out);
    let before = bindings.action_of(Key::OpenBracket, Some(Key::Num5), NONE);
    assert_eq!(before, Some(Action::StepTime(-1)));
    let written = bindings.action_of(Key::A, Some(Key::Q), NONE);
    assert_eq!(written, Some(Action::Axes), "letters are where they are written");
}

#[test]
fn a_person_who_types_is_left_alone_and_a_control_has_its_arrows() {
    let mut events = vec![press(Key::R, None, NONE, false), press(Key::Z, None, CTRL, false)];
    assert_eq!((taken(&mut events, Focus::Text), events.len()), (vec![], 2));
    let mut events = vec![press(Key::Q, None, CTRL, false)];
    assert_eq!(taken(&mut events, Focus::Text), [Action::Quit]);
    let chords = [
        (Key::S, CTRL, Action::SaveState),
        (Key::S, CTRL | Modifiers::SHIFT, Action::PictureDialog),
        (Key::O, CTRL, Action::OpenFile),
        (Key::L, CTRL, Action::CopyLink),
        (Key::N, CTRL, Action::Start),
        (Key::F12, NONE, Action::Picture),
        (Key::F1, NONE, Action::Help),
    ];
    for (key, modifiers, action) in chords {
        let mut events = vec![press(key, None, modifiers, false)];
        assert_eq!((taken(&mut events, Focus::Text), events.len()), (vec![action], 0), "writes nothing");
    }
    let of_text = [
        (Key::Z, CTRL | Modifiers::SHIFT),
        (Key::ArrowLeft, CTRL),
        (Key::Num1, Modifiers::SHIFT),
        (Key::F, NONE),
        (Key::Plus, NONE),
        (Key::OpenBracket, NONE),
    ];
    for (key, modifiers) in of_text {
        let mut events = vec![press(key, None, modifiers, false)];
        assert_eq!((taken(&mut events, Focus::Text), events.len()), (vec![], 1), "{key:?}");
    }
    // On some keyboards a letter.
    let bindings = set("numbers", &["ctrl+alt+q"]).unwrap();
    let mut events = vec![press(Key::Q, None, CTRL | Modifiers::ALT, false)];
    assert_eq!(bindings.take_actions(&mut events, Focus::Text), []);
    let mut events = vec![press(Key::ArrowLeft, None, NONE, false), press(Key::O, None, NONE, false)];
    assert_eq!((taken(&mut events, Focus::Widget), events.len()), (vec![Action::Numbers], 1));
    assert_eq!(taken(&mut events, Focus::Picture), [Action::Step(Step::Turn(-1, 0))]);
    // The space bar presses the control that has the focus, and writes in a text.
    let mut events = vec![press(Key::Space, None, NONE, false)];
    for focus in [Focus::Widget, Focus::Text] {
        assert_eq!((taken(&mut events, focus), events.len()), (vec![], 1), "{focus:?}");
    }
    assert_eq!((taken(&mut events, Focus::Picture), events.len()), (vec![Action::Play], 0));
}

#[test]
fn a_held_key_switches_once_and_undoes_and_turns_on() {
    let held =
        |key, m| vec![press(key, None, m, false), press(key, None, m, true), press(key, None, m, true)];
    assert_eq!(taken(&mut held(Key::O, NONE), Focus::Picture), [Action::Numbers]);
    assert_eq!(taken(&mut held(Key::Z, CTRL), Focus::Picture), [Action::Undo; 3]);
    assert_eq!(taken(&mut held(Key::Minus, NONE), Focus::Picture), [Action::Step(Step::Zoom(-1)); 3]);
}

#[test]
fn what_is_set_holds_and_the_help_says_so() {
    let bindings = set("numbers", &["n", "Ctrl+Alt+Space"]).unwrap();
    for (key, modifiers, action) in [
        (Key::N, NONE, Some(Action::Numbers)),
        (Key::Space, CTRL | Modifiers::ALT, Some(Action::Numbers)),
        (Key::O, NONE, None),
    ] {
        assert_eq!(bindings.action_of(key, None, modifiers), action);
    }
    let line = |b: &Bindings, text| b.lines().into_iter().find(|(_, t)| *t == text).map(|(keys, _)| keys);
    let text = "numbers on or off";
    assert_eq!(line(&Bindings::default(), text).unwrap(), "O");
    assert_eq!(line(&bindings, text).unwrap(), format!("N, {}", "ctrl+alt+space".parse::<Chord>().unwrap()));
    assert_eq!(bindings.hint(Action::Numbers), "N");
    let nothing = set("numbers", &[]).unwrap();
    assert_eq!((line(&nothing, text), nothing.action_of(Key::O, None, NONE)), (None, None));

    let mut drags = Bindings::default();
    drags.set("orbit", &["right drag".into()]).unwrap();
    drags.set("zoom", &["left drag".into()]).unwrap();
    drags.set(REVERSE_WHEEL, &["true".into()]).unwrap();
    drags.check().unwrap();
    assert_eq!(drags.gesture(PointerButton::Secondary, NONE), Some(Gesture::Orbit));
    assert_eq!(drags.gesture(PointerButton::Primary, NONE), Some(Gesture::Zoom));
    assert_eq!(drags.gesture(PointerButton::Primary, Modifiers::SHIFT), Some(Gesture::Pan), "more is named");
    assert!(drags.reverses_wheel && drags.chords("orbit") == ["right drag"]);
    assert_eq!(drags.gesture(PointerButton::Extra1, NONE), None);
}

#[test]
fn mistakes_are_named_in_one_line() {
    for (name, chords, words) in [
        ("jump", &["j"][..], &["unknown action \"jump\"", "first-view", "reverse-wheel"][..]),
        ("numbers", &["hyper+o"], &["found \"hyper+o\"", "ctrl, shift or alt"]),
        ("numbers", &["oo"], &["found \"oo\"", "a key"]),
        ("numbers", &[""], &["found \"\"", "a key"]),
        ("numbers", &["left drag"], &["found \"left drag\"", "a key"]),
        ("orbit", &["o"], &["found \"o\"", "a drag"]),
        ("orbit", &["up drag"], &["found \"up drag\"", "a drag"]),
        ("numbers", &["l"], &["l is bound to numbers and to look", "[]"]),
        ("zoom", &["Left drag"], &["left drag is bound to orbit and to zoom"]),
        ("numbers", &["n", "n"], &["bound to numbers and to numbers"]),
        ("reverse-wheel", &["yes"], &["expected true or false"]),
    ] {
        let problem = set(name, chords).unwrap_err().to_string();
        let has_all = |words: &[&str]| words.iter().all(|word| problem.contains(word));
        // The table's order decides which of two is named first.
        let (a, b) = ("l is bound to look and to numbers", words);
        assert!(has_all(b) || problem.contains(a), "{problem}");
        assert!(!problem.contains('\n'));
    }
}

#[test]
fn what_a_mistake_quotes_is_cut() {
    let long = vec!["f{a=".repeat(2000)];
    for name in Bindings::names().map(str::to_owned).chain(long.clone()) {
        let message = Bindings::default().set(&name, &long).unwrap_err().to_string();
        assert!(message.len() < 1500, "{name:.40}: {} bytes", message.len());
    }
}
