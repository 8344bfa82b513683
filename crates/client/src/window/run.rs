//! The viewer on a server's link.

use isinglass_net::{Client, ClientOptions, Clock, Link, LinkModel};

use super::{ViewerError, run_window};
use crate::app::options::WindowOptions;

/// What the viewer needs.
pub struct ViewerOptions {
    /// As the server printed it.
    pub link: Link,
    /// Properties of a simulated link under the connection.
    pub conditioner: Option<LinkModel>,
    /// The window. An empty server name is replaced by that of the link.
    pub window: WindowOptions,
}

/// Opens the viewer on a server and returns when its window closes. Must be called on the main thread. The window
/// shows a server that does not answer or refuses; that is no error of this function.
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
