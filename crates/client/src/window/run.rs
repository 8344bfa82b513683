//! The viewer on a server's link.

use isinglass_net::{Client, ClientOptions, Clock, Link, LinkModel};

use super::{ViewerError, run_window};
use crate::app::options::WindowOptions;

/// What the viewer needs to know.
pub struct ViewerOptions {
    /// As printed by the server.
    pub link: Link,
    /// A link with these properties is put under the connection.
    pub conditioner: Option<LinkModel>,
    /// The window. Its server's name is taken from the link if it is empty.
    pub window: WindowOptions,
}

/// Opens the viewer on a server and returns when its window is closed. Must be called on the main thread. A server that
/// does not answer or refuses is shown in the window; it is not an error of this function.
///
/// # Errors
/// If there is no window, or this machine cannot connect to anything at all.
pub fn run(options: ViewerOptions) -> Result<(), ViewerError> {
    let ViewerOptions { link, conditioner, mut window } = options;
    if window.server_name.is_empty() {
        window.server_name = link.place();
    }
    let clock = Clock::start();
    let client_clock = clock.clone();
    run_window(window, clock, move |wake| {
        let options = ClientOptions { conditioner, clock: client_clock, wake, ..Default::default() };
        Client::connect(&link, options).map_err(|e| e.to_string())
    })
}
