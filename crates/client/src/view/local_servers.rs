//! What the start window needs of whoever opens it: servers in this process, a place for its list, a calendar.

use std::path::PathBuf;
use std::sync::Arc;

use isinglass_core::volume::Volume;
use isinglass_formats::{LoadRequest, Outline};
use isinglass_net::Link;

/// Starts servers in this process, for volumes that are opened in the window. The viewer renders none itself.
///
/// Functions that may take time are called on threads where they may.
pub trait LocalServers: Send + Sync {
    /// Most bytes of memory that volumes may take.
    fn max_bytes(&self) -> u64;

    /// Whether there is room for a volume beside the bytes `held`.
    ///
    /// # Errors
    /// One line for a person if there is none.
    fn check(&self, outline: &Outline, held: u64) -> Result<(), String>;

    /// Serves a volume that was read as `request` says, with this outline. May take a moment.
    ///
    /// # Errors
    /// One line for a person.
    fn start(&self, volume: Volume, outline: &Outline, request: &LoadRequest) -> Result<LocalServer, String>;
}

/// A server in this process.
pub struct LocalServer {
    /// Lets the window in.
    pub link: Link,
    /// Ends the server when it is dropped, which may take a moment.
    pub server: Box<dyn Send>,
}

/// What is injected.
#[derive(Clone)]
pub struct Services {
    /// Starts servers.
    pub servers: Arc<dyn LocalServers>,
    /// Where the list of what was opened lately is kept; none: nowhere.
    pub recent_file: Option<PathBuf>,
    /// Seconds since 1970.
    pub calendar: fn() -> u64,
}

/// What the window begins with.
pub enum First {
    /// The page on which a server or a volume is chosen.
    StartPage,
    /// A server that has let this viewer in.
    Connected {
        /// Its frames.
        source: crate::BoxedSource,
        /// Where it is.
        link: Link,
    },
    /// A volume of this machine.
    Volume(LoadRequest),
}
