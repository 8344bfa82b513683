//! A key or a button with modifiers, as people write them.

use std::fmt;
use std::str::FromStr;

use egui::{Key, Modifiers, PointerButton};

use super::BindingError;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Chord {
    /// A key with exactly these modifiers.
    Key(Modifiers, Key),
    /// A drag with a button and at least these modifiers.
    Drag(Modifiers, PointerButton),
}

impl FromStr for Chord {
    type Err = BindingError;

    /// Reads `a`, `ctrl+shift+z`, `F1`, `shift+left drag`, in upper or lower case.
    fn from_str(text: &str) -> Result<Self, BindingError> {
        let bad = |expected| BindingError::Chord(text.chars().take(60).collect(), expected);
        let words = text.trim().to_lowercase();
        let (rest, is_drag) = match words.strip_suffix(" drag") {
            Some(rest) => (rest.trim_end(), true),
            None => (&words[..], false),
        };
        let mut modifiers = Modifiers::NONE;
        // A plus at the end is a key.
        let (names, last) = match rest.strip_suffix('+') {
            Some(names) => (names.strip_suffix('+').unwrap_or(names), "+"),
            None => rest.rsplit_once('+').unwrap_or(("", rest)),
        };
        for name in names.split('+').map(str::trim).filter(|name| !name.is_empty()) {
            modifiers |= match name {
                "ctrl" | "cmd" | "command" => Modifiers::COMMAND,
                "shift" => Modifiers::SHIFT,
                "alt" | "option" => Modifiers::ALT,
                _ => return Err(bad(EXPECTED_MODIFIER)),
            };
        }
        let last = last.trim();
        if is_drag {
            let button = BUTTONS.iter().find(|(name, _)| *name == last);
            return button.map(|(_, b)| Self::Drag(modifiers, *b)).ok_or_else(|| bad(EXPECTED_DRAG));
        }
        let named = Key::ALL.iter().find(|key| key.name().to_lowercase() == last);
        let short = SHORT.iter().find(|(name, _)| name.to_lowercase() == last).map(|(_, key)| *key);
        let key = short.or(named.copied());
        key.map(|key| Self::Key(modifiers, key)).ok_or_else(|| bad(EXPECTED_KEY))
    }
}

impl fmt::Display for Chord {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (Self::Key(modifiers, _) | Self::Drag(modifiers, _)) = self;
        for (is_held, name) in [
            (modifiers.command, CTRL_NAME),
            (modifiers.shift, "Shift"),
            (modifiers.alt, if cfg!(target_os = "macos") { "Option" } else { "Alt" }),
        ] {
            if is_held {
                write!(f, "{name}+")?;
            }
        }
        match self {
            Self::Key(_, key) if SHORT.iter().any(|(_, k)| k == key) => {
                f.write_str(SHORT.iter().find(|(_, k)| k == key).map_or("", |(name, _)| name))
            }
            Self::Key(_, key) if key.name().len() == 1 => f.write_str(&key.name().to_lowercase()),
            Self::Key(_, key) => f.write_str(key.name()),
            Self::Drag(_, button) => {
                let name = BUTTONS.iter().find(|(_, b)| b == button).map_or("", |(name, _)| name);
                write!(f, "{name} drag")
            }
        }
    }
}

impl Chord {
    /// As on keyboards: with a large letter, because a small l looks like a 1.
    pub(super) fn on_keyboard(&self) -> String {
        let mut text = self.to_string();
        if let Self::Key(_, key) = self
            && key.name().len() == 1
            && let Some(last) = text.pop()
        {
            text.push(last.to_ascii_uppercase());
        }
        text
    }
}

pub(super) fn is_digit(key: Key) -> bool {
    key.name().len() == 1 && key.name().starts_with(|c: char| c.is_ascii_digit())
}

/// Whether a text field has no use of its own for a key.
pub(super) fn means_nothing_in_text(key: Key, modifiers: Modifiers) -> bool {
    let is_function = key.name().strip_prefix('F').is_some_and(|number| number.parse::<u8>().is_ok());
    // Alt and Ctrl together write letters on some keyboards.
    is_function || modifiers.command && !modifiers.alt && !OF_TEXT.split(' ').any(|name| name == key.name())
}

/// How many modifiers a chord names.
pub(super) fn num_held(modifiers: Modifiers) -> u8 {
    u8::from(modifiers.command) + u8::from(modifiers.shift) + u8::from(modifiers.alt)
}

const BUTTONS: [(&str, PointerButton); 5] = [
    ("left", PointerButton::Primary),
    ("middle", PointerButton::Middle),
    ("right", PointerButton::Secondary),
    ("back", PointerButton::Extra1),
    ("forward", PointerButton::Extra2),
];
/// Keys with a shorter name than egui's.
const SHORT: [(&str, Key); 12] = [
    ("Esc", Key::Escape),
    ("Del", Key::Delete),
    ("+", Key::Plus),
    ("-", Key::Minus),
    ("=", Key::Equals),
    ("[", Key::OpenBracket),
    ("]", Key::CloseBracket),
    (",", Key::Comma),
    (".", Key::Period),
    ("/", Key::Slash),
    (";", Key::Semicolon),
    ("'", Key::Quote),
];
/// Keys that edit text together with Ctrl.
const OF_TEXT: &str = "A C V X Z Y H K U W Left Right Up Down Home End Backspace Delete Insert Enter";
const CTRL_NAME: &str = if cfg!(target_os = "macos") { "Cmd" } else { "Ctrl" };
pub(super) const EXPECTED_KEY: &str =
    "a key with or without ctrl, shift and alt, such as \"ctrl+z\", \"F1\" or \"Space\"";
pub(super) const EXPECTED_DRAG: &str =
    "a drag with left, middle, right, back or forward, such as \"shift+left drag\"";
const EXPECTED_MODIFIER: &str = "ctrl, shift or alt before the last +";
