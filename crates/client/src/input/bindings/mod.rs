//! What keys and mouse do. The window acts by this one table, the help shows it, and settings change it.
//!
//! A line of the table names what can be bound, each with its chords: `Ctrl+z` for a key, `shift+left drag` for a
//! button. A new action needs a line here; everything else follows.

mod chord;
#[cfg(test)]
mod tests;

use std::fmt::Write;

use egui::{Event, Key, Modifiers, PointerButton};

use chord::Chord;

/// What a key does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action {
    /// Return to the first view.
    FirstView,
    /// Show a standard view, from the front, the right or the top, or from the opposite side.
    StandardView(Side, Opposite),
    /// Show three sides alike.
    Isometric,
    /// Bring all of the volume into the picture.
    Fit,
    /// Return to the view before the newest movement.
    PreviousView,
    /// Return from there.
    NextView,
    /// Move the camera by a step.
    Step(Step),
    /// Switch the numbers on or off.
    Numbers,
    /// Open or fold the side panel.
    LookPanel,
    /// Switch the volume's box on or off.
    Box,
    /// Switch the clip handles on or off, with a clip box if there is no clip.
    Clip,
    /// Switch the slices beside the picture on or off.
    Slices,
    /// Switch between perspective and parallel rays.
    Projection,
    /// Switch axes and scale bar on or off.
    Axes,
    /// Switch the legend of the colours on or off.
    Legend,
    /// Choose the next kind of stereo.
    Stereo,
    /// Switch the probe on or off.
    Probe,
    /// Switch measuring on or off.
    Measure,
    /// Save a picture of the view.
    Picture,
    /// Open the dialog for a picture of another size, or for a turntable.
    PictureDialog,
    /// Begin to record the way of the camera, or end it.
    RecordPath,
    /// Choose the next mode.
    Mode,
    /// Undo an edit of the transfer function.
    Undo,
    /// Redo an edit of the transfer function.
    Redo,
    /// Move by so many times in the server's file.
    StepTime(i32),
    /// Play the times in the server's file, or stop.
    Play,
    /// Show the start page.
    Start,
    /// Save the state of the view as a file.
    SaveState,
    /// Open the file dialog.
    OpenFile,
    /// Copy a link to the view.
    CopyLink,
    /// Switch the help on or off.
    Help,
    /// Close the help.
    CloseHelp,
    /// Show the picture and its slices on the whole screen without bars, or return to the window.
    FullScreen,
    /// Close the window.
    Quit,
}

impl Action {
    /// Whether the key repeats while it is held down.
    fn repeats(self) -> bool {
        matches!(self, Self::Undo | Self::Redo | Self::PreviousView | Self::NextView | Self::Step(_))
    }
}

/// Where a standard view looks from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// A patient's anterior side, or +z.
    Front,
    /// A patient's right side, or +x.
    Right,
    /// A patient's head, or +y.
    Top,
}

/// Whether a standard view is seen from the opposite side.
pub type Opposite = bool;

/// A movement of the camera by keys, in the direction of a drag.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// Around the centre: steps to the right and down.
    Turn(i8, i8),
    /// In the picture's plane: steps to the right and down.
    Pan(i8, i8),
    /// In the picture's plane: steps clockwise.
    Roll(i8),
    /// Steps nearer.
    Zoom(i8),
}

/// What a drag over the picture does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Gesture {
    /// Turn about the centre.
    Orbit,
    /// Move in the picture's plane.
    Pan,
    /// Turn in the picture's plane.
    Roll,
    /// Move nearer or away by dragging up and down.
    Zoom,
    /// Move the light.
    Light,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Deed {
    Act(Action),
    Drag(Gesture),
}

struct Line {
    text: &'static str,
    /// Names, what they do, and their default chords.
    entries: &'static [(&'static str, Deed, &'static [&'static str])],
    /// Keys or movements that cannot be changed.
    fixed: &'static str,
}

impl Line {
    fn is_title(&self) -> bool {
        self.entries.is_empty() && self.fixed.is_empty()
    }
}

/// Why a setting is refused.
#[derive(Clone, Debug, thiserror::Error, PartialEq, Eq)]
pub enum BindingError {
    /// There is no action of that name.
    #[error("unknown action {0:?}, expected one of {1}")]
    Action(String, String),
    /// A chord is unreadable.
    #[error("found {0:?}, expected {1}")]
    Chord(String, &'static str),
    /// One chord has two meanings.
    #[error("{0} is bound to {1} and to {2}; bind one of them to something else, or to [] for nothing")]
    Conflict(String, &'static str, &'static str),
    /// The direction of the wheel is not a boolean.
    #[error("found {0:?}, expected true or false")]
    Switch(String),
}

/// What keys and mouse do in a window.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Bindings {
    /// The chords of every entry of the table, in its order.
    chords: Vec<Vec<Chord>>,
    /// Whether the wheel zooms the other way.
    pub(crate) reverses_wheel: bool,
}

impl Default for Bindings {
    fn default() -> Self {
        let parsed = |texts: &[&str]| texts.iter().map(|t| t.parse().expect("a test parses all")).collect();
        Self { chords: entries().map(|(_, _, texts)| parsed(texts)).collect(), reverses_wheel: false }
    }
}

impl Bindings {
    /// Binds the action `name` to `chords` and to nothing else.
    ///
    /// # Errors
    /// If there is no such action, or a chord cannot be read, or is none of the action's kind.
    pub fn set(&mut self, name: &str, chords: &[String]) -> Result<(), BindingError> {
        if name == REVERSE_WHEEL {
            self.reverses_wheel = match chords {
                [text] if text == "true" => true,
                [text] if text == "false" => false,
                other => return Err(BindingError::Switch(other.join(", ").chars().take(60).collect())),
            };
            return Ok(());
        }
        let Some(index) = entries().position(|(known, _, _)| known == name) else {
            let known: Vec<_> = Self::names().collect();
            return Err(BindingError::Action(name.chars().take(60).collect(), known.join(", ")));
        };
        let (_, deed, _) = entries().nth(index).expect("it was found");
        let mut parsed = Vec::new();
        for text in chords {
            let chord: Chord = text.parse()?;
            let expected = match deed {
                Deed::Act(_) if !matches!(chord, Chord::Key(..)) => chord::EXPECTED_KEY,
                Deed::Drag(_) if !matches!(chord, Chord::Drag(..)) => chord::EXPECTED_DRAG,
                _ => {
                    parsed.push(chord);
                    continue;
                }
            };
            return Err(BindingError::Chord(text.chars().take(60).collect(), expected));
        }
        self.chords[index] = parsed;
        Ok(())
    }

    /// Checks that every chord has one meaning.
    ///
    /// # Errors
    /// The first chord with two.
    pub fn check(&self) -> Result<(), BindingError> {
        let all = || {
            entries().zip(&self.chords).flat_map(|((name, ..), chords)| chords.iter().map(move |c| (name, c)))
        };
        for (i, (name, chord)) in all().enumerate() {
            if let Some((other, _)) = all().take(i).find(|(_, c)| *c == chord) {
                return Err(BindingError::Conflict(chord.to_string(), other, name));
            }
        }
        Ok(())
    }

    /// The names that can be bound.
    pub fn names() -> impl Iterator<Item = &'static str> {
        entries().map(|(name, ..)| name).chain([REVERSE_WHEEL])
    }

    /// The chords of a name, as text.
    pub fn chords(&self, name: &str) -> Vec<String> {
        if name == REVERSE_WHEEL {
            return vec![self.reverses_wheel.to_string()];
        }
        let index = entries().position(|(known, ..)| known == name);
        index.map_or_else(Vec::new, |i| self.chords[i].iter().map(Chord::to_string).collect())
    }

    /// Every line of the help: keys or movements, and what they do.
    pub(crate) fn lines(&self) -> Vec<(String, &'static str)> {
        let mut index = 0;
        let mut lines = Vec::with_capacity(TABLE.len());
        for line in TABLE {
            let mut keys = String::from(line.fixed);
            for _ in line.entries {
                for chord in &self.chords[index] {
                    let comma = if keys.is_empty() { "" } else { ", " };
                    let _ = write!(keys, "{comma}{}", chord.on_keyboard());
                }
                index += 1;
            }
            if !keys.is_empty() {
                lines.push((keys, line.text));
            }
        }
        lines
    }

    /// The lines of the help, by task.
    pub(crate) fn tasks(&self) -> Vec<(&'static str, Vec<(String, &'static str)>)> {
        let mut lines = self.lines().into_iter().peekable();
        let mut tasks: Vec<(_, Vec<_>)> = Vec::new();
        for line in TABLE {
            if line.is_title() {
                tasks.push((line.text, Vec::new()));
            } else if let Some(shown) = lines.next_if(|(_, text)| *text == line.text)
                && let Some((_, of_task)) = tasks.last_mut()
            {
                of_task.push(shown);
            }
        }
        tasks
    }

    /// The first chord of an action, for hints; empty if there is none.
    pub(crate) fn hint(&self, action: Action) -> String {
        let mut bound = entries().zip(&self.chords).filter(|((_, deed, _), _)| *deed == Deed::Act(action));
        bound.next().and_then(|(_, chords)| chords.first()).map(Chord::on_keyboard).unwrap_or_default()
    }

    /// A text with its key in brackets, if it has one.
    pub(crate) fn with_key(&self, text: &str, action: Action) -> String {
        let key = self.hint(action);
        if key.is_empty() { text.to_owned() } else { format!("{text} ({key})") }
    }

    /// The gesture that begins with this button. Of several, the one with the most modifiers that are held.
    pub(crate) fn gesture(&self, button: PointerButton, held: Modifiers) -> Option<Gesture> {
        let bound = entries().zip(&self.chords).filter_map(|((_, deed, _), chords)| match deed {
            Deed::Drag(gesture) => Some((gesture, chords)),
            Deed::Act(_) => None,
        });
        let fitting = bound.flat_map(|(gesture, chords)| chords.iter().map(move |chord| (gesture, chord)));
        let named = fitting.filter_map(|(gesture, chord)| match chord {
            Chord::Drag(modifiers, b) if *b == button && held.contains(*modifiers) => {
                Some((chord::num_held(*modifiers), gesture))
            }
            _ => None,
        });
        named.max_by_key(|(count, _)| *count).map(|(_, gesture)| gesture)
    }

    /// Takes the keys of the table out of a refresh's events. Returns their actions.
    pub(crate) fn take_actions(&self, events: &mut Vec<Event>, focus: Focus) -> Vec<Action> {
        let mut actions = Vec::new();
        events.retain(|event| {
            let Event::Key { key, physical_key, pressed: true, repeat, modifiers } = event else {
                return true;
            };
            let Some(action) = self.action_of(*key, *physical_key, *modifiers) else { return true };
            let is_left = match focus {
                // A text field needs letters, and has its own undo.
                Focus::Text => {
                    let is_other = chord::means_nothing_in_text(*key, *modifiers);
                    !is_other && !matches!(action, Action::Quit | Action::CloseHelp)
                }
                // A control uses arrows itself, and the space bar presses it.
                Focus::Widget => {
                    matches!(action, Action::Step(_)) || (*key == Key::Space && modifiers.is_none())
                }
                Focus::Picture => false,
            };
            // A switch acts once while its key is held down.
            if !is_left && (!repeat || action.repeats()) {
                actions.push(action);
            }
            // Lists and chosen points close by this key, too.
            is_left || action == Action::CloseHelp
        });
        actions
    }

    /// Keys are found by their character. Digits are also found by their place on the keyboard: with shift, and on
    /// some keyboards without it, they type other characters.
    fn action_of(&self, key: Key, physical_key: Option<Key>, modifiers: Modifiers) -> Option<Action> {
        let of = |key: Key| {
            let fits = |c: &Chord| matches!(c, Chord::Key(m, k) if *k == key && modifiers.matches_exact(*m));
            entries().zip(&self.chords).find_map(|((_, deed, _), chords)| match deed {
                Deed::Act(action) if chords.iter().any(fits) => Some(action),
                _ => None,
            })
        };
        of(key).or_else(|| physical_key.filter(|k| chord::is_digit(*k)).and_then(of))
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Focus {
    /// The picture, or nothing.
    Picture,
    /// A control.
    Widget,
    /// A text field.
    Text,
}

fn entries() -> impl Iterator<Item = (&'static str, Deed, &'static [&'static str])> {
    TABLE.iter().flat_map(|line| line.entries.iter().copied())
}

const fn keys(text: &'static str, entries: &'static [(&'static str, Deed, &'static [&'static str])]) -> Line {
    Line { text, entries, fixed: "" }
}

/// A title: the lines below it are for this task.
const fn task(title: &'static str) -> Line {
    Line { text: title, entries: &[], fixed: "" }
}

/// A line that settings cannot change.
const fn fixed(keys: &'static str, text: &'static str) -> Line {
    Line { text, entries: &[], fixed: keys }
}

const fn view(side: Side, opposite: Opposite) -> Deed {
    Deed::Act(Action::StandardView(side, opposite))
}

const fn step(step: Step) -> Deed {
    Deed::Act(Action::Step(step))
}

/// The name of the setting for the wheel, which is no chord.
pub const REVERSE_WHEEL: &str = "reverse-wheel";

const TABLE: &[Line] = &[
    task("Turn, move and zoom"),
    keys("orbit", &[("orbit", Deed::Drag(Gesture::Orbit), &["left drag"])]),
    keys("pan", &[("pan", Deed::Drag(Gesture::Pan), &["middle drag", "shift+left drag"])]),
    keys("roll", &[("roll", Deed::Drag(Gesture::Roll), &["ctrl+left drag"])]),
    fixed("wheel, pinch", "zoom at the pointer"),
    keys("zoom", &[("zoom", Deed::Drag(Gesture::Zoom), &["right drag"])]),
    fixed("double click", "make the point there the centre of rotation"),
    keys("first view", &[("first-view", Deed::Act(Action::FirstView), &["r"])]),
    keys(
        "from the front, back, right, left, top, below",
        &[
            ("front", view(Side::Front, false), &["1"]),
            ("back", view(Side::Front, true), &["shift+1"]),
            ("right", view(Side::Right, false), &["3"]),
            ("left", view(Side::Right, true), &["shift+3"]),
            ("top", view(Side::Top, false), &["7"]),
            ("bottom", view(Side::Top, true), &["shift+7"]),
        ],
    ),
    keys("isometric view", &[("isometric", Deed::Act(Action::Isometric), &["0"])]),
    keys("fit the volume into the picture", &[("fit", Deed::Act(Action::Fit), &["f"])]),
    keys(
        "previous view, next view",
        &[
            ("previous-view", Deed::Act(Action::PreviousView), &["alt+left"]),
            ("next-view", Deed::Act(Action::NextView), &["alt+right"]),
        ],
    ),
    keys(
        "turn the volume by a step",
        &[
            ("turn-left", step(Step::Turn(-1, 0)), &["left"]),
            ("turn-right", step(Step::Turn(1, 0)), &["right"]),
            ("turn-up", step(Step::Turn(0, -1)), &["up"]),
            ("turn-down", step(Step::Turn(0, 1)), &["down"]),
        ],
    ),
    keys(
        "move the volume by a step",
        &[
            ("pan-left", step(Step::Pan(-1, 0)), &["shift+left"]),
            ("pan-right", step(Step::Pan(1, 0)), &["shift+right"]),
            ("pan-up", step(Step::Pan(0, -1)), &["shift+up"]),
            ("pan-down", step(Step::Pan(0, 1)), &["shift+down"]),
        ],
    ),
    keys(
        "roll and zoom by a step",
        &[
            ("roll-left", step(Step::Roll(-1)), &["ctrl+left"]),
            ("roll-right", step(Step::Roll(1)), &["ctrl+right"]),
            ("zoom-in", step(Step::Zoom(1)), &["+", "=", "ctrl+up"]),
            ("zoom-out", step(Step::Zoom(-1)), &["-", "ctrl+down"]),
        ],
    ),
    keys("perspective or parallel", &[("projection", Deed::Act(Action::Projection), &["5"])]),
    task("Colours and light"),
    keys("look panel open or folded", &[("look", Deed::Act(Action::LookPanel), &["l"])]),
    keys("mode: composite, MIP, MinIP, average, isosurface", &[("mode", Deed::Act(Action::Mode), &["m"])]),
    keys("move the light", &[("light", Deed::Drag(Gesture::Light), &["ctrl+right drag"])]),
    keys(
        "undo and redo edits of the transfer function",
        &[
            ("undo", Deed::Act(Action::Undo), &["ctrl+z"]),
            ("redo", Deed::Act(Action::Redo), &["ctrl+shift+z"]),
        ],
    ),
    fixed("in the curve: click, drag", "add a point, move one"),
    fixed("in the curve: middle click, Del", "remove a point"),
    fixed("in the curve: Insert, Enter", "add a point after the chosen one"),
    fixed("in the curve: left, right; up, down", "choose a point; change its opacity"),
    fixed("in the curve: Shift+left, Shift+right", "move a point along the values"),
    fixed("in the curve: right or Ctrl+left drag", "level and window"),
    fixed("in the strip: arrows", "level; window"),
    fixed("in the stops: as in the curve", "choose, move, add and remove colours"),
    task("Measure, cut, watch"),
    keys("place and value under the pointer", &[("probe", Deed::Act(Action::Probe), &["p"])]),
    keys("measure distances, angles, paths and values", &[("measure", Deed::Act(Action::Measure), &["d"])]),
    keys("clip: handles to drag on or off", &[("clip", Deed::Act(Action::Clip), &["c"])]),
    keys("slices beside the picture on or off", &[("slices", Deed::Act(Action::Slices), &["x"])]),
    fixed("on a slice: click, drag", "move the common point"),
    fixed("on a slice: wheel, PageUp, PageDown", "next slice, previous slice"),
    fixed("on a slice: right or Shift+left drag", "window and level"),
    fixed("on a slice: double click", "enlarge the slice, and back"),
    keys("the volume's box on or off", &[("box", Deed::Act(Action::Box), &["b"])]),
    keys("axes and scale bar on or off", &[("axes", Deed::Act(Action::Axes), &["a"])]),
    keys("legend of the colours on or off", &[("legend", Deed::Act(Action::Legend), &["k"])]),
    keys(
        "previous time, next time",
        &[
            ("previous-time", Deed::Act(Action::StepTime(-1)), &["["]),
            ("next-time", Deed::Act(Action::StepTime(1)), &["]"]),
        ],
    ),
    keys("play the times, stop", &[("play", Deed::Act(Action::Play), &["space"])]),
    keys("stereo: side by side, red-cyan, off", &[("stereo", Deed::Act(Action::Stereo), &["s"])]),
    keys("full screen", &[("full-screen", Deed::Act(Action::FullScreen), &["F11"])]),
    keys("numbers on or off", &[("numbers", Deed::Act(Action::Numbers), &["o"])]),
    task("Files, pictures, window"),
    keys("open a state, a preset or a volume", &[("open-file", Deed::Act(Action::OpenFile), &["ctrl+o"])]),
    keys("start page: other volumes, servers, samples", &[("start", Deed::Act(Action::Start), &["ctrl+n"])]),
    keys(
        "save the state of the view as a file",
        &[("save-state", Deed::Act(Action::SaveState), &["ctrl+s"])],
    ),
    keys(
        "copy a link to this view (Ctrl+V opens a copied one)",
        &[("copy-link", Deed::Act(Action::CopyLink), &["ctrl+l"])],
    ),
    keys("save a picture of the view", &[("picture", Deed::Act(Action::Picture), &["F12"])]),
    keys(
        "picture of another size, turntable",
        &[("picture-dialog", Deed::Act(Action::PictureDialog), &["ctrl+shift+s"])],
    ),
    keys("record the camera for a movie", &[("record-path", Deed::Act(Action::RecordPath), &["ctrl+r"])]),
    fixed("Tab, Shift+Tab", "next control, previous control"),
    fixed("Ctrl++, Ctrl+-, Ctrl+0", "larger, smaller, usual texts"),
    keys("this help", &[("help", Deed::Act(Action::Help), &["h", "F1"])]),
    keys("close a dialog, give up a measurement", &[("close-help", Deed::Act(Action::CloseHelp), &["Esc"])]),
    keys("close the window", &[("quit", Deed::Act(Action::Quit), &["ctrl+q"])]),
];
