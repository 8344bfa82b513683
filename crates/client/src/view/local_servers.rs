//! Servers in this process, for volumes that are opened in the window.

use std::path::PathBuf;

use isinglass_core::volume::Volume;
use isinglass_formats::{FormatError, LoadRequest, OpenOptions, Outline, outline};
use isinglass_net::Link;

/// Starts servers in this process for volumes that are opened in the window. The viewer itself renders no volume.
///
/// Slow functions are called on threads that may block.
pub trait LocalServers: Send + Sync {
    /// Memory limit for volumes, bytes.
    fn max_bytes(&self) -> u64;

    /// Whether a header may name files outside its own folder.
    fn allows_foreign_files(&self) -> bool {
        false
    }

    /// The folder with indices of volumes that were read before; `None` keeps none.
    fn index_folder(&self) -> Option<PathBuf> {
        None
    }

    /// Checks that a volume fits beside `held` bytes.
    ///
    /// # Errors
    /// One line for a person if it does not.
    fn check(&self, outline: &Outline, held: u64) -> Result<(), String>;

    /// Serves a volume that was read for `request`. May take a moment.
    ///
    /// # Errors
    /// One line for the user.
    fn start(&self, volume: Volume, outline: &Outline, request: &LoadRequest) -> Result<LocalServer, String>;
}

/// A server in this process.
pub struct LocalServer {
    /// Admits the window.
    pub link: Link,
    /// Ends the server when it is dropped, which may take a moment.
    pub server: Box<dyn Send>,
}

/// Reads the header of a volume, and checks that memory suffices.
pub(crate) fn survey(
    request: &LoadRequest,
    held: u64,
    servers: &dyn LocalServers,
) -> Result<Outline, String> {
    let mut options = request.options();
    options.foreign_files |= servers.allows_foreign_files();
    let found = match outline(&request.source, &options) {
        // The check explains the needs.
        Err(FormatError::TooLarge { .. }) => {
            outline(&request.source, &OpenOptions { max_bytes: u64::MAX, ..options })
        }
        found => found,
    };
    let found = found.map_err(|e| e.to_string())?;
    servers.check(&found, held)?;
    Ok(found)
}
