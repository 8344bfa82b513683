//! Scripts that watch every refresh of a window, for tests and pictures of the window.

use std::time::Duration;

use crate::view::viewing::Refresh;

/// Is called after every refresh and says what to do next.
pub type Script = Box<dyn FnMut(&Probe) -> ScriptStep>;

/// What a script sees of a refresh.
#[derive(Clone)]
pub struct Probe {
    /// Time since the window opened.
    pub now: Duration,
    /// What is drawn; none before the volume is known.
    pub refresh: Option<Refresh>,
}

/// What a script asks for.
pub enum ScriptStep {
    /// Nothing.
    Continue,
    /// Capture the window as this refresh draws it.
    Capture(Box<dyn FnOnce(Shot) + Send>),
    /// Close the window.
    Close,
}

/// A picture of the window, 8-bit sRGB, three bytes a pixel, row by row from the top.
#[derive(Clone, Debug)]
pub struct Shot {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// The pixels.
    pub rgb: Vec<u8>,
}
