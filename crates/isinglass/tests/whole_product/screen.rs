//! The X server from outside: a mouse, and pictures of a window.

use std::io::IoSlice;

use x11rb::connection::{Connection, RequestConnection};
use x11rb::protocol::xproto::{
    BUTTON_PRESS_EVENT, BUTTON_RELEASE_EVENT, ConnectionExt as _, ImageFormat, MOTION_NOTIFY_EVENT, MapState,
    Window,
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

    /// Returns when the server has passed the input on.
    fn input(&self, event: u8, button: u8, [x, y]: [i16; 2]) {
        let xtest =
            self.connection.extension_information("XTEST").unwrap().expect("the server takes fake input");
        // By hand: the crate's feature for it would have the window's crates built once more for this test.
        let mut request = [0; 36];
        request[..2].copy_from_slice(&[xtest.major_opcode, FAKE_INPUT]);
        request[2..4].copy_from_slice(&9u16.to_ne_bytes());
        request[4..6].copy_from_slice(&[event, button]);
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
