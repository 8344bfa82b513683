//! Servers on other machines, for volumes that are named in the window.

use isinglass_net::{Link, Tunnel};

/// Starts servers on other machines.
pub trait RemoteServers: Send + Sync {
    /// Whether a text names a volume on another machine.
    fn is_place(&self, text: &str) -> bool;

    /// Starts a server for the volume that `place` names. Takes seconds, or minutes where the volume is large. It asks
    /// the person nothing.
    ///
    /// # Errors
    /// One line for the user.
    fn start(&self, place: &str) -> Result<RemoteServer, String>;
}

/// A server on another machine, which ends by itself some time after its last viewer.
pub struct RemoteServer {
    /// Admits one viewer.
    pub link: Link,
    /// The way through ssh.
    pub tunnel: Tunnel,
}
