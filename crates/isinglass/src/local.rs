//! Servers in this process for volumes that are opened in the viewer's window, and the folder of the window's list.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{SystemTime, UNIX_EPOCH};

use isinglass_client::{LocalServer, LocalServers, Services};
use isinglass_core::look::Look;
use isinglass_core::session::rate::CodingPlan;
use isinglass_core::volume::{Lighting, Volume};
use isinglass_formats::{LoadRequest, Outline};
use isinglass_render::{Backend, BackendChoice};
use isinglass_server::{RunningServer, ServeOptions, Timing};
use tokio::runtime::Runtime;

use crate::args::{ListArgs, LookArgs};
use crate::library::FileLoader;
use crate::memory;
use crate::remote::RemoteArgs;
use crate::state_args::Seen;

pub(crate) struct Locals {
    backend: BackendChoice,
    /// The backend, opened with the first volume and kept, because opening takes a while.
    opened: Mutex<Option<Backend>>,
    max_memory: u64,
    /// Whether headers may name files outside their folders.
    foreign_files: bool,
    first: Mutex<Option<FirstLook>>,
}

/// The look of a command's volume when it first opens. Other volumes in its window get one that suits them.
pub(crate) struct FirstLook {
    pub(crate) source: String,
    pub(crate) seen: Seen,
    pub(crate) look: LookArgs,
    pub(crate) lighting: Lighting,
    pub(crate) lists: ListArgs,
}

impl Locals {
    fn backend(&self) -> Result<Backend, String> {
        let mut opened = self.opened.lock().unwrap_or_else(PoisonError::into_inner);
        if opened.as_ref().is_none_or(Backend::is_lost) {
            *opened = Some(Backend::open(self.backend).map_err(|e| e.to_string())?);
        }
        opened.clone().ok_or_else(|| "no backend".into())
    }
}

impl LocalServers for Locals {
    fn max_bytes(&self) -> u64 {
        self.max_memory
    }

    fn allows_foreign_files(&self) -> bool {
        self.foreign_files
    }

    fn index_folder(&self) -> Option<PathBuf> {
        index_folder().map(Path::to_owned)
    }

    fn check(&self, outline: &Outline, held: u64) -> Result<(), String> {
        memory::check(&outline.name, outline.bytes_needed(), held, self.max_memory)
    }

    fn start(&self, volume: Volume, outline: &Outline, request: &LoadRequest) -> Result<LocalServer, String> {
        let one_line = |e: anyhow::Error| format!("{e:#}");
        let mut first = self.first.lock().unwrap_or_else(PoisonError::into_inner);
        let named = first.as_ref().filter(|first| first.source == request.source);
        let transfer = named.and_then(|first| first.look.tf.as_deref());
        let loader = FileLoader::new(request, transfer).map_err(one_line)?;
        let opened = loader.opened(Arc::new(volume), outline).map_err(one_line)?;
        let look = match named {
            Some(FirstLook { seen, look, lighting, lists, .. }) => {
                seen.look_at(&opened, look, *lighting, lists).map_err(one_line)?
            }
            None => Look { channels: opened.channels, ..Look::new(opened.transfer) },
        };
        let bytes = memory::of_volume(&opened.volume);
        let options = ServeOptions {
            volume: opened.volume,
            look,
            devices: self.backend()?.into(),
            listen: ([127, 0, 0, 1], 0).into(),
            plan: CodingPlan::default(),
            max_viewers: 1,
            frame_memory: memory::of_frames(self.max_memory, bytes),
            library: Some(opened.library),
            timing: Timing::default(),
        };
        let runtime = Runtime::new().map_err(|e| format!("no threads for the server: {e}"))?;
        let started = runtime.block_on(async {
            let server = isinglass_server::start(options).map_err(|e| e.to_string())?;
            let link = server.mint_link(None).await.map_err(|e| e.to_string())?;
            Ok::<_, String>((server, link))
        });
        let (server, link) = started?;
        // This applies only once: opened again, it gets a look that suits it.
        first.take_if(|first| first.source == request.source);
        Ok(LocalServer { link, server: Box::new(Running(Some((runtime, server)))) })
    }
}

/// A server and the threads that drive it; both end with it.
struct Running(Option<(Runtime, RunningServer)>);

impl Drop for Running {
    fn drop(&mut self) {
        if let Some((runtime, server)) = self.0.take() {
            runtime.block_on(server.close());
            runtime.shutdown_background();
        }
    }
}

/// The services of a window with a start page, or of one that begins with the volume of `first`.
pub(crate) fn services(
    backend: BackendChoice,
    max_memory: u64,
    foreign_files: bool,
    first: Option<FirstLook>,
    remote: RemoteArgs,
) -> Services {
    let (opened, first) = (Mutex::new(None), Mutex::new(first));
    Services {
        servers: Arc::new(Locals { backend, opened, max_memory, foreign_files, first }),
        remote: Some(Arc::new(remote)),
        recent_file: state_folder().map(|folder| folder.join("recent.toml")),
        has_system_dialog: true,
        calendar: || SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs()),
    }
}

/// The file of the window's choices.
pub(crate) fn choices_file() -> Option<PathBuf> {
    state_folder().map(|folder| folder.join("choices.toml"))
}

/// The folder of what is known of the values of large files, which can be made anew.
pub(crate) fn index_folder() -> Option<&'static Path> {
    static FOLDER: OnceLock<Option<PathBuf>> = OnceLock::new();
    let find = || {
        let variable =
            |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
        let folder = if cfg!(windows) {
            variable("LOCALAPPDATA")
        } else if cfg!(target_os = "macos") {
            std::env::home_dir().map(|home| home.join("Library/Caches"))
        } else {
            variable("XDG_CACHE_HOME").or_else(|| std::env::home_dir().map(|home| home.join(".cache")))
        };
        Some(folder?.join("isinglass").join("pages"))
    };
    FOLDER.get_or_init(find).as_deref()
}

/// The folder where this user's programs keep their state.
fn state_folder() -> Option<PathBuf> {
    let variable = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let folder = if cfg!(windows) {
        variable("LOCALAPPDATA")
    } else if cfg!(target_os = "macos") {
        std::env::home_dir().map(|home| home.join("Library/Application Support"))
    } else {
        variable("XDG_STATE_HOME").or_else(|| std::env::home_dir().map(|home| home.join(".local/state")))
    };
    Some(folder?.join("isinglass"))
}
