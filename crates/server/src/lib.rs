//! The server: owns one volume, renders layered frames of it and serves any number of viewers, each with its own
//! pose and look. Another part of the volume's file may take its place, for all of them.
//!
//! One thread owns the renderer and makes frames in the order they are asked for; every viewer has at most one frame
//! waiting, so all get the same share. A viewer's frame is made for the newest pose that has arrived. It is begun so that the
//! coder and the network are free when it is done. None is made for a pose that has been answered. At rest the same frame is
//! sent again finer, and at last exactly. This crate opens no files and no window.

mod generator;
mod lights;
mod pipeline;
mod screenshots;
mod selection;
mod serving;

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;

use isinglass_core::kernels::march::Scene;
use isinglass_core::look::Look;
use isinglass_core::session::rate::CodingPlan;
use isinglass_core::volume::Volume;
use isinglass_core::wire::Choices;
use isinglass_gpu::GpuError;
use isinglass_net::{AfterWork, BindError, Clock, Identity, Journal, Link, Server};
use isinglass_render::Backend;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinHandle;

use generator::Generator;
use selection::{Present, SceneNumber, SelectionReader};

pub use selection::{Loaded, Loader, Survey};

/// What to serve, and how.
pub struct ServeOptions {
    /// The volume.
    pub volume: Arc<Volume>,
    /// The look that viewers begin with; must be valid.
    pub look: Look,
    /// Where kernels run.
    pub backend: Backend,
    /// Address to listen on; port 0 takes a free one.
    pub listen: SocketAddr,
    /// How frames are coded.
    pub plan: CodingPlan,
    /// Viewers at the same time.
    pub max_viewers: u32,
    /// What else there is in the volume's file, for viewers to choose; none: they cannot choose another part.
    pub library: Option<Library>,
    /// Time, as the server sees it.
    pub timing: Timing,
}

/// Where times come from.
#[derive(Clone, Debug, Default)]
pub struct Timing {
    /// What all stamps are read from.
    pub clock: Clock,
    /// What follows the generating and coding of frames.
    pub after_work: AfterWork,
}

/// The file that a volume comes from.
#[derive(Clone)]
pub struct Library {
    /// What there is to choose, and what is shown at first.
    pub parts: Choices,
    /// Opens it.
    pub loader: Arc<dyn Loader>,
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
    /// The thread of the renderer could not be started.
    #[error("cannot start the rendering thread: {0}")]
    Thread(std::io::Error),
    /// Nor those that help it.
    #[error("cannot start the rendering threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
}

/// A server at work. It stops when this is dropped; [`RunningServer::close`] also tells the viewers.
pub struct RunningServer {
    address: SocketAddr,
    commands: mpsc::Sender<Command>,
    attendance: watch::Receiver<Attendance>,
    newest: watch::Receiver<Option<Journal>>,
    serving: JoinHandle<()>,
}

/// Who is at a server.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Attendance {
    /// Viewers that are here now.
    pub connected: usize,
    /// Links that a viewer has used.
    pub used_links: usize,
}

/// What the owner of a server asks of its task.
enum Command {
    MintLink { host: String, reply: oneshot::Sender<Result<Link, BindError>> },
    Close,
}

/// Starts to serve. Must be called within a tokio runtime with more than one thread, which then drives the server.
///
/// # Errors
/// If the address is taken or the volume does not fit the backend.
pub fn start(options: ServeOptions) -> Result<RunningServer, ServeError> {
    let ServeOptions { volume, look, backend, listen, plan, max_viewers, library, timing } = options;
    let Timing { clock, after_work } = timing;
    let scene = Scene::new(volume, &look.transfer, look.march_settings());
    let (parts, loader) = library.map(|l| (l.parts, l.loader)).unzip();
    let present = Arc::new(Present::new(&scene, SceneNumber::default(), look.clone(), parts));
    let identity = Identity::generate()?;
    let options = isinglass_net::ServerOptions { max_viewers, clock };
    let server = Server::bind(listen, &identity, options, present.greeting.clone())?;
    let address = server.local_addr().map_err(|source| BindError::Io { address: listen, source })?;
    let generator = Generator::start(&backend, scene, look, present.lights.clone(), after_work.clone())?;
    let (commands, receiver) = mpsc::channel(1);
    let (present_in, present) = watch::channel(present);
    let (load_in, load) = watch::channel(None);
    let (orders, orders_out) = mpsc::channel(MAX_ORDERS);
    // The first frame neither waits for the tables nor takes long because of them, which would be held against its coding.
    tokio::task::spawn_blocking(isinglass_core::codec::prepare);
    tracing::info!(%address, backend = backend.description(), "serving");
    let reader = SelectionReader {
        loader,
        backend,
        generator: generator.clone(),
        orders: orders_out,
        present: present_in,
        load: load_in,
    };
    let coders = pipeline::coders()?;
    let common = serving::Common { generator, present, load, orders, plan, after_work, coders };
    let (attendance_in, attendance) = watch::channel(Attendance::default());
    let (newest_in, newest) = watch::channel(None);
    let serving = tokio::spawn(serving::serve(server, reader, common, receiver, attendance_in, newest_in));
    Ok(RunningServer { address, commands, attendance, newest, serving })
}

/// Orders of parts that wait: the newest counts, and each is taken at once.
const MAX_ORDERS: usize = 16;

impl RunningServer {
    /// The address that is listened on, with its real port.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Who is here, and what changes of it.
    pub fn attendance(&self) -> watch::Receiver<Attendance> {
        self.attendance.clone()
    }

    /// The lives of the frames of the viewer that came last.
    pub fn newest_journal(&self) -> Option<Journal> {
        self.newest.borrow().clone()
    }

    /// A new link that lets in one viewer, who reaches this server as `host`, or at its own address.
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

    /// Ends all sessions and waits, for a short time, until the viewers know.
    pub async fn close(self) {
        let _ = self.commands.send(Command::Close).await;
        let _ = self.serving.await;
    }
}
