//! What the display loop of the test has behind it: a server with a file of two times, which ends and comes again.

use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};

use isinglass_client::Waker;
use isinglass_core::look::Look;
use isinglass_core::session::rate::CodingPlan;
use isinglass_core::wire::{Choices, Part};
use isinglass_formats::{OpenOptions, Selection, open};
use isinglass_net::{Client, ClientOptions, Clock};
use isinglass_render::Backend;
use isinglass_server::{Library, Loaded, Loader, RunningServer, ServeOptions, Survey, Timing, start};

/// Voxels along each side of a time: two megabytes.
const SIDE: usize = 128;

/// A film of two times, four megabytes: balls around other points.
fn write_film(path: &Path) {
    let header = format!(
        "NRRD0004\ntype: uchar\ndimension: 4\nsizes: {SIDE} {SIDE} {SIDE} 2\nspacings: 1 1 1 nan\n\
         kinds: domain domain domain time\nencoding: raw\n\n"
    );
    let mut bytes = header.into_bytes();
    for time in 0..2 {
        let middle = [0.4, 0.6][time] * SIDE as f32;
        for i in 0..SIDE.pow(3) {
            let at = [i % SIDE, i / SIDE % SIDE, i / SIDE / SIDE];
            let square: f32 = at.iter().map(|x| (*x as f32 - middle).powi(2)).sum();
            bytes.push((255.0 - 5.0 * square.sqrt()).max(0.0) as u8);
        }
    }
    std::fs::write(path, bytes).unwrap();
}

struct Film {
    source: String,
}

fn selection(part: &Part) -> Selection {
    Selection { time: part.time, ..Selection::default() }
}

fn parts(time: u32) -> Choices {
    Choices {
        shown: Part {
            channel: Some(0),
            time: Some(time),
            level: Some(0),
            series: Some(0),
            ..Part::default()
        },
        whole_dims: [SIDE as u64; 3],
        num_channels: 1,
        num_times: 2,
        num_series: 1,
        ..Choices::default()
    }
}

pub(crate) fn look() -> Look {
    Look::new(isinglass_formats::preset("shells").unwrap())
}

impl Loader for Film {
    fn survey(&self, part: &Part, _held: u64) -> Result<Survey, String> {
        Ok(Survey { parts: parts(part.time.unwrap_or(0)), bytes_needed: 0 })
    }

    fn load(
        &self,
        part: &Part,
        _: u64,
        progress: &dyn Fn(f32),
        cancel: &AtomicBool,
    ) -> Result<Loaded, String> {
        let options = OpenOptions {
            selection: selection(part),
            progress: Some(progress),
            cancel: Some(cancel),
            ..OpenOptions::default()
        };
        let volume = open(&self.source, &options).map_err(|e| e.to_string())?;
        Ok(Loaded { volume, transfer: look().transfer, channels: Default::default() })
    }
}

/// What the display loop asks for. It never waits for the answer.
enum Order {
    /// The server ends.
    EndServer,
    /// Another one, on another port; its client comes.
    StartServer,
}

/// See the module.
pub(crate) struct Backstage {
    orders: SyncSender<Order>,
    clients: Receiver<Client>,
}

impl Backstage {
    /// Writes the file and prepares everything, but starts no server.
    pub(crate) fn new(clock: Clock, wake: Waker) -> Self {
        let (orders, orders_out) = sync_channel(4);
        let (clients_in, clients) = sync_channel(1);
        std::thread::spawn(move || run(&orders_out, &clients_in, &clock, &wake));
        Self { orders, clients }
    }

    pub(crate) fn start_server(&self) {
        self.orders.try_send(Order::StartServer).unwrap();
    }

    pub(crate) fn end_server(&self) {
        self.orders.try_send(Order::EndServer).unwrap();
    }

    /// The client of the server that was started last, once.
    pub(crate) fn client(&self) -> Option<Client> {
        match self.clients.try_recv() {
            Ok(client) => Some(client),
            Err(TryRecvError::Empty) => None,
            Err(TryRecvError::Disconnected) => panic!("the servers ended early"),
        }
    }
}

fn run(orders: &Receiver<Order>, clients: &SyncSender<Client>, clock: &Clock, wake: &Waker) {
    let folder = tempfile::TempDir::new().unwrap();
    let path = folder.path().join("film.nrrd");
    write_film(&path);
    let source = path.to_str().unwrap().to_owned();
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    let mut server: Option<RunningServer> = None;
    while let Ok(order) = orders.recv() {
        match order {
            Order::EndServer => runtime.block_on(server.take().unwrap().close()),
            Order::StartServer => {
                let part = Part { time: Some(0), ..Part::default() };
                let film = Film { source: source.clone() };
                let loaded = film.load(&part, &|_| (), &AtomicBool::new(false)).unwrap();
                let options = ServeOptions {
                    volume: Arc::new(loaded.volume),
                    look: look(),
                    devices: Backend::Cpu.into(),
                    listen: SocketAddr::from(([127, 0, 0, 1], 0)),
                    plan: CodingPlan::default(),
                    max_viewers: 1,
                    frame_memory: 1 << 30,
                    library: Some(Library {
                        parts: parts(0),
                        loader: Arc::new(film),
                        volume_memory: 1 << 30,
                    }),
                    timing: Timing::default(),
                };
                let (started, link) = runtime.block_on(async {
                    let server = start(options).unwrap();
                    let link = server.mint_link(None).await.unwrap();
                    (server, link)
                });
                server = Some(started);
                let options =
                    ClientOptions { clock: clock.clone(), wake: wake.clone(), ..ClientOptions::default() };
                clients.send(Client::connect(&link, options).unwrap()).unwrap();
                wake();
            }
        }
    }
    if let Some(server) = server {
        runtime.block_on(server.close());
    }
}
