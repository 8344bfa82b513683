//! What the start window needs of whoever opens it.

use std::path::PathBuf;
use std::sync::Arc;

use isinglass_formats::LoadRequest;
use isinglass_net::Link;

use crate::view::BoxedSource;
use crate::view::local_servers::LocalServers;

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
        source: BoxedSource,
        /// Where it is.
        link: Link,
    },
    /// A volume of this machine.
    Volume(LoadRequest),
}
