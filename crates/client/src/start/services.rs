//! What whoever opens the start window has to provide.

use std::path::PathBuf;
use std::sync::Arc;

use isinglass_formats::LoadRequest;
use isinglass_net::Link;

use crate::view::BoxedSource;
use crate::view::local_servers::LocalServers;
use crate::view::remote_servers::RemoteServers;

/// What the start window needs.
#[derive(Clone)]
pub struct Services {
    /// Starts servers.
    pub servers: Arc<dyn LocalServers>,
    /// Starts servers on other machines, if it can.
    pub remote: Option<Arc<dyn RemoteServers>>,
    /// The file of the recent list; none: the list is not stored.
    pub recent_file: Option<PathBuf>,
    /// Whether files are chosen by the system's dialog, where it has one.
    pub has_system_dialog: bool,
    /// Seconds since 1970.
    pub calendar: fn() -> u64,
}

/// What the window shows at first.
pub enum First {
    /// The page on which the person chooses a server or a volume.
    StartPage,
    /// A server that has let this viewer in.
    Connected {
        /// Its frames.
        source: BoxedSource,
        /// Its link.
        link: Link,
        /// The volume on another machine for which it was started, as the person named it.
        remote: Option<String>,
    },
    /// A volume of this machine.
    Volume(LoadRequest),
}
