//! The X server from outside: a mouse, a keyboard, a clipboard, and pictures of a window.

use std::io::IoSlice;
use std::time::{Duration, Instant};

use x11rb::connection::{Connection, RequestConnection};
use x11rb::protocol::Event;
use x11rb::protocol::xproto::{
    AtomEnum, BUTTON_PRESS_EVENT, BUTTON_RELEASE_EVENT, ConnectionExt as _, EventMask, ImageFormat,
    InputFocus, KEY_PRESS_EVENT, KEY_RELEASE_EVENT, MOTION_NOTIFY_EVENT, MapState, PropMode,
    SELECTION_NOTIFY_EVENT, SelectionNotifyEvent, Window, WindowClass,
};
use x11rb::rust_connection::RustConnection;

/// A connection to the server that `DISPLAY` names.
pub(crate) struct Screen {
    connection: RustConnection,
    root: Window,
}

/// A picture, 8-bit RGB, row by row.
pub(crate) struct Shot {
    pub(crate) size: [u32; 2],
    pub(crate) rgb: Vec<u8>,
}

impl Screen {
    pub(crate) fn open() -> Self {
        let (connection, number) = x11rb::connect(None).unwrap();
        let root = connection.setup().roots[number].root;
        Self { connection, root }
    }

    /// The visible window of this size, if there is one.
    pub(crate) fn window(&self, size: [u16; 2]) -> Option<Window> {
        let windows = self.connection.query_tree(self.root).unwrap().reply().unwrap().children;
        // A window may go away while it is looked at.
        windows.into_iter().find(|window| {
            let is_visible = || {
                let attributes = self.connection.get_window_attributes(*window).unwrap().reply().ok()?;
                let shape = self.connection.get_geometry(*window).unwrap().reply().ok()?;
                Some(attributes.map_state == MapState::VIEWABLE && [shape.width, shape.height] == size)
            };
            is_visible() == Some(true)
        })
    }

    /// Moves the pointer to a point of a window.
    pub(crate) fn point_at(&self, window: Window, x: i16, y: i16) {
        let at = self.connection.translate_coordinates(window, self.root, x, y).unwrap().reply().unwrap();
        self.input(MOTION_NOTIFY_EVENT, 0, [at.dst_x, at.dst_y]);
    }

    /// Presses or releases the left button.
    pub(crate) fn press(&self, is_pressed: bool) {
        let event = if is_pressed { BUTTON_PRESS_EVENT } else { BUTTON_RELEASE_EVENT };
        self.input(event, 1, [0; 2]);
    }

    /// Presses and releases the left button at a point of a window.
    pub(crate) fn click(&self, window: Window, x: i16, y: i16) {
        self.point_at(window, x, y);
        // A window learns what is under the pointer before the button.
        for is_pressed in [true, false] {
            std::thread::sleep(Duration::from_millis(150));
            self.press(is_pressed);
        }
        std::thread::sleep(Duration::from_millis(150));
    }

    /// Presses and releases a key, such as `ctrl+v`. A window without a window manager gets the focus first.
    pub(crate) fn key(&self, window: Window, chord: &str) {
        let focus = self.connection.set_input_focus(InputFocus::PARENT, window, x11rb::CURRENT_TIME);
        focus.unwrap().check().unwrap();
        let codes: Vec<u8> = chord.split('+').map(|name| self.code_of(name)).collect();
        for code in &codes {
            self.input(KEY_PRESS_EVENT, *code, [0; 2]);
        }
        for code in codes.iter().rev() {
            self.input(KEY_RELEASE_EVENT, *code, [0; 2]);
        }
    }

    fn code_of(&self, name: &str) -> u8 {
        let symbol = match name {
            "ctrl" => 0xffe3,
            "shift" => 0xffe1,
            "Enter" => 0xff0d,
            "F12" => 0xffc9,
            letter => u32::from(letter.as_bytes()[0]),
        };
        let setup = self.connection.setup();
        let (first, num) = (setup.min_keycode, setup.max_keycode - setup.min_keycode + 1);
        let mapping = self.connection.get_keyboard_mapping(first, num).unwrap().reply().unwrap();
        let per_code = usize::from(mapping.keysyms_per_keycode);
        let index = mapping.keysyms.iter().position(|s| *s == symbol).expect("the keyboard has the key");
        first + (index / per_code) as u8
    }

    /// Puts a text in the clipboard and does `paste`, until a program has taken the text.
    pub(crate) fn hand_over(&self, text: &str, paste: impl Fn()) {
        let c = &self.connection;
        let atom = |name: &str| c.intern_atom(false, name.as_bytes()).unwrap().reply().unwrap().atom;
        let (clipboard, utf8, targets) = (atom("CLIPBOARD"), atom("UTF8_STRING"), atom("TARGETS"));
        let owner = c.generate_id().unwrap();
        let class = WindowClass::INPUT_ONLY;
        c.create_window(0, owner, self.root, 0, 0, 1, 1, 0, class, 0, &Default::default()).unwrap();
        c.set_selection_owner(owner, clipboard, x11rb::CURRENT_TIME).unwrap().check().unwrap();
        paste();
        let patience = Instant::now() + Duration::from_secs(60);
        loop {
            assert!(Instant::now() < patience, "nobody takes the clipboard");
            let Some(Event::SelectionRequest(asked)) = c.poll_for_event().unwrap() else {
                std::thread::sleep(Duration::from_millis(5));
                continue;
            };
            let is_text = asked.target == utf8;
            let mut property = asked.property;
            if is_text {
                let bytes = text.as_bytes();
                c.change_property(
                    PropMode::REPLACE,
                    asked.requestor,
                    property,
                    utf8,
                    8,
                    bytes.len() as u32,
                    bytes,
                )
                .unwrap();
            } else if asked.target == targets {
                let known: Vec<u8> = [targets, utf8].iter().flat_map(|a| a.to_ne_bytes()).collect();
                let kind = AtomEnum::ATOM;
                c.change_property(PropMode::REPLACE, asked.requestor, property, kind, 32, 2, &known).unwrap();
            } else {
                property = x11rb::NONE;
            }
            let answer = SelectionNotifyEvent {
                response_type: SELECTION_NOTIFY_EVENT,
                sequence: 0,
                time: asked.time,
                requestor: asked.requestor,
                selection: asked.selection,
                target: asked.target,
                property,
            };
            c.send_event(false, asked.requestor, EventMask::NO_EVENT, answer).unwrap().check().unwrap();
            if is_text {
                return;
            }
        }
    }

    /// Returns when the server has passed the input on.
    fn input(&self, event: u8, detail: u8, [x, y]: [i16; 2]) {
        let xtest =
            self.connection.extension_information("XTEST").unwrap().expect("the server takes fake input");
        // By hand: the crate's feature for it would have the window's crates built once more for this test.
        let mut request = [0; 36];
        request[..2].copy_from_slice(&[xtest.major_opcode, FAKE_INPUT]);
        request[2..4].copy_from_slice(&9u16.to_ne_bytes());
        request[4..6].copy_from_slice(&[event, detail]);
        request[12..16].copy_from_slice(&self.root.to_ne_bytes());
        request[24..26].copy_from_slice(&x.to_ne_bytes());
        request[26..28].copy_from_slice(&y.to_ne_bytes());
        let sent = self.connection.send_request_without_reply(&[IoSlice::new(&request)], Vec::new());
        sent.unwrap().check().unwrap();
        self.connection.get_input_focus().unwrap().reply().unwrap();
    }

    /// What a window shows now.
    pub(crate) fn shot(&self, window: Window, size: [u16; 2]) -> Shot {
        let [width, height] = size;
        let image = self.connection.get_image(ImageFormat::Z_PIXMAP, window, 0, 0, width, height, u32::MAX);
        let image = image.unwrap().reply().unwrap();
        assert_eq!(image.data.len(), 4 * usize::from(width) * usize::from(height), "four bytes a pixel");
        let rgb = image.data.chunks(4).flat_map(|bgrx| [bgrx[2], bgrx[1], bgrx[0]]).collect();
        Shot { size: size.map(u32::from), rgb }
    }
}

/// The request of the extension XTEST.
const FAKE_INPUT: u8 = 2;
