//! The server: owns one volume, renders layered frames of it and serves any number of viewers, each with its own pose
//! and look. Another part of the volume's file may take its place, for all of them.
//!
//! One thread owns the renderer of each device and makes frames in pieces; the next piece is for whoever has used least
//! of its time, so all get the same share. A viewer's frame is made for the newest pose that has arrived. It is begun so
//! that the coder and the network are free when it is done. None is made for a pose that has been answered. At rest
//! the same frame is sent again finer, and at last exactly. This crate opens no files and no window.

mod ahead;
mod audience;
mod company;
mod counters;
mod dispatch;
mod frame_memory;
mod generator;
mod give_up;
mod lights;
mod paging;
mod pipeline;
mod placement;
mod render_thread;
mod screenshots;
mod selection;
mod serving;
mod slices;
mod turns;

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;

use isinglass_core::kernels::march::Scene;
use isinglass_core::look::Look;
use isinglass_core::session::rate::CodingPlan;
use isinglass_core::volume::Volume;
use isinglass_core::wire::Choices;
use isinglass_gpu::GpuError;
use isinglass_net::{AfterWork, BindError, Clock, Identity, Journal, Link, Server};
use isinglass_render::{Backend, Devices};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinHandle;

use ahead::ReadAhead;
use audience::Audience;
use dispatch::{Dispatch, ShownScene};
use frame_memory::FrameMemory;
use generator::Generator;
use selection::{Present, SceneNumber, SelectionReader};

pub use counters::Counters;
pub use dispatch::DeviceUse;
pub use paging::{FramePages, Pager};
pub use selection::{Loaded, Loader, Survey};

/// Options of a server.
pub struct ServeOptions {
    /// The volume.
    pub volume: Arc<Volume>,
    /// The first look of viewers; must be valid.
    pub look: Look,
    /// Where kernels run. With several devices, a viewer's frames are made by the one with the least load.
    pub devices: Devices,
    /// Address to listen on; port 0 takes a free one.
    pub listen: SocketAddr,
    /// The coding of frames.
    pub plan: CodingPlan,
    /// Most viewers at the same time.
    pub max_viewers: u32,
    /// Most memory of all viewers' frames together, bytes. Frames that would exceed it are made smaller. Up to a
    /// quarter of it is for times that are read ahead, if the memory for volumes has no room for them.
    pub frame_memory: u64,
    /// The volume's file, for viewers to choose parts of; `None` if they cannot.
    pub library: Option<Library>,
    /// Clock and hooks of the server.
    pub timing: Timing,
}

/// Clock and hooks.
#[derive(Clone, Debug, Default)]
pub struct Timing {
    /// Clock of all stamps.
    pub clock: Clock,
    /// Hook after generating and coding frames.
    pub after_work: AfterWork,
}

/// The file that a volume comes from.
#[derive(Clone)]
pub struct Library {
    /// The choices, and the part that is shown first.
    pub parts: Choices,
    /// Opens parts of it.
    pub loader: Arc<dyn Loader>,
    /// Most memory of all volumes, bytes: the shown one, one that is read, and those that are read ahead.
    pub volume_memory: u64,
}

/// Why there is no server.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The renderer could not be made.
    #[error("cannot render this volume: {0}")]
    Renderer(#[from] GpuError),
    /// The address cannot be used.
    #[error(transparent)]
    Bind(#[from] BindError),
    /// There is no certificate.
    #[error(transparent)]
    Identity(#[from] isinglass_net::identity::IdentityError),
    /// The pages and their coarsest level do not belong together.
    #[error("cannot read this volume by pages: {0}")]
    Pages(#[from] isinglass_core::volume::VolumeError),
    /// The thread of the renderer could not be started.
    #[error("cannot start the rendering thread: {0}")]
    Thread(std::io::Error),
    /// Its worker threads could not be started.
    #[error("cannot start the rendering threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
}

/// A running server. It stops when this is dropped; [`RunningServer::close`] also tells the viewers.
pub struct RunningServer {
    address: SocketAddr,
    commands: mpsc::Sender<Command>,
    attendance: watch::Receiver<Attendance>,
    counters: Counters,
    dispatch: Dispatch,
    newest: watch::Receiver<Option<Journal>>,
    serving: JoinHandle<()>,
}

/// The viewers of a server.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Attendance {
    /// Number of connected viewers.
    pub connected: usize,
    /// Number of links that a viewer has used.
    pub used_links: usize,
}

/// Commands of a server's owner to its task.
enum Command {
    MintLink { host: String, reply: oneshot::Sender<Result<Link, BindError>> },
    Close,
}

/// Starts to serve. Must be called within a tokio runtime with more than one thread, which then drives the server.
///
/// # Errors
/// If the address is taken or the volume does not fit the backend.
pub fn start(options: ServeOptions) -> Result<RunningServer, ServeError> {
    let pager = Pager::of(&options.volume)?;
    start_as(&Identity::generate()?, options, pager)
}

/// The same with an identity that outlives the server, and with what reads the pages of the volume, if it has any.
///
/// # Errors
/// If the address is taken or the volume does not fit the backend.
pub fn start_as(
    identity: &Identity,
    options: ServeOptions,
    pager: Option<Pager>,
) -> Result<RunningServer, ServeError> {
    let ServeOptions { volume, look, devices, listen, plan, max_viewers, frame_memory, library, timing } =
        options;
    let Timing { clock, after_work } = timing;
    let scene = Scene::of_look(volume, &look);
    let memory = FrameMemory::new(frame_memory);
    let ahead = ReadAhead::new(library.as_ref().map_or(0, |l| l.volume_memory), &memory);
    let (parts, loader) = library.map(|l| (l.parts, l.loader)).unzip();
    let present = Arc::new(Present::new(&scene, SceneNumber::default(), look.clone(), parts, pager));
    let options = isinglass_net::ServerOptions { max_viewers, clock };
    let server = Server::bind(listen, identity, options, present.greeting.clone())?;
    let address = server.local_addr().map_err(|source| BindError::Io { address: listen, source })?;
    let counters = Counters::new(server.refusals());
    let lights = present.lights.clone();
    let (number, pager) = (present.scene, present.pager.clone());
    let shown = ShownScene { scene, look, number, lights, pager };
    let generator = Generator::start(&devices, shown, after_work.clone(), counters.clone())?;
    let (commands, receiver) = mpsc::channel(1);
    let (present_in, present) = watch::channel(present);
    let (load_in, load) = watch::channel(None);
    let (orders, orders_out) = mpsc::channel(MAX_ORDERS);
    // Building the tables now keeps the first frame's coding time representative.
    tokio::task::spawn_blocking(isinglass_core::codec::prepare);
    tracing::info!(%address, devices = devices.description(), "serving");
    let reader = SelectionReader {
        loader,
        generator: generator.clone(),
        orders: orders_out,
        present: present_in,
        load: load_in,
        ahead,
        reading: None,
    };
    let dispatch = generator.dispatch.clone();
    let coders = pipeline::coders()?;
    let workers = devices.each().iter().find_map(Backend::workers).cloned();
    let slice_makers = Arc::new(slices::SliceMakers::new(workers.clone())?);
    let common = serving::Common {
        generator,
        present,
        load,
        orders,
        plan,
        after_work,
        coders,
        slice_makers,
        workers,
        memory,
        counters: counters.clone(),
        audience: Audience::default(),
    };
    let (attendance_in, attendance) = watch::channel(Attendance::default());
    let (newest_in, newest) = watch::channel(None);
    let serving = tokio::spawn(serving::serve(server, reader, common, receiver, attendance_in, newest_in));
    Ok(RunningServer { address, commands, attendance, counters, dispatch, newest, serving })
}

/// Most orders that wait: the newest counts, and each is taken at once.
const MAX_ORDERS: usize = 16;

impl RunningServer {
    /// The bound address with its real port.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The present viewers, with notification of changes.
    pub fn attendance(&self) -> watch::Receiver<Attendance> {
        self.attendance.clone()
    }

    /// What the server has done so far.
    pub fn counters(&self) -> Counters {
        self.counters.clone()
    }

    /// What each of its devices does now.
    pub fn devices(&self) -> Vec<DeviceUse> {
        self.dispatch.uses()
    }

    /// The frames' lives of the newest viewer.
    pub fn newest_journal(&self) -> Option<Journal> {
        self.newest.borrow().clone()
    }

    /// A new link that admits one viewer, which reaches this server as `host`, or at its own address.
    ///
    /// # Errors
    /// If there are no random numbers or no places.
    pub async fn mint_link(&self, host: Option<&str>) -> Result<Link, BindError> {
        let own = match self.address.ip() {
            ip if ip.is_unspecified() => IpAddr::V4(Ipv4Addr::LOCALHOST),
            ip => ip,
        };
        let (reply, answer) = oneshot::channel();
        let host = host.map_or_else(|| own.to_string(), str::to_owned);
        let _ = self.commands.send(Command::MintLink { host, reply }).await;
        answer.await.unwrap_or(Err(BindError::NoPlaces))
    }

    /// Ends all sessions and waits briefly until the viewers know.
    pub async fn close(self) {
        let _ = self.commands.send(Command::Close).await;
        let _ = self.serving.await;
    }
}
