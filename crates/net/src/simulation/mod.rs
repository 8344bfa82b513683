//! Whole sessions in virtual time: this crate's server and client over real QUIC, with a simulated network and a
//! model of a renderer. The clock is tokio's, paused: it jumps to the next event. The same seed gives the same run.

mod bad_links;
mod crowd;
mod laws;
mod long_use;
mod model;
mod network;

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU16, Ordering};
use std::time::Duration;

use quinn::congestion::ControllerFactory;
use quinn::{Endpoint, EndpointConfig, TokioRuntime};
use tokio::time::Instant;

use crate::client::model::ModelClient;
use crate::clock::Clock;
use crate::conditioner::LinkModel;
use crate::identity::{Identity, quic_server};
use crate::link::Link;
use crate::server::{OtherCongestion, Server, ServerOptions};
use model::{Renderer, Shown};
use network::{Network, Traffic};

/// A server on a network.
struct World {
    network: Network,
    server: Option<Server>,
    clock: Clock,
    num_viewers: u16,
    seed: u64,
}

fn server_address() -> SocketAddr {
    ([10, 0, 0, 1], 4433).into()
}

impl World {
    fn new(model: &LinkModel, congestion: Option<Arc<dyn ControllerFactory + Send + Sync>>) -> Self {
        let network = Network::new(model, server_address());
        let epoch = Instant::now();
        let clock = Clock::new(move || epoch.elapsed().as_micros() as u64);
        let identity = Identity::generate().expect("random numbers");
        let config = quic_server(identity.tls().expect("TLS")).expect("TLS");
        let socket = network.socket(server_address());
        let runtime = Arc::new(TokioRuntime);
        let endpoint =
            Endpoint::new_with_abstract_socket(seeded(model.seed), Some(config.clone()), socket, runtime);
        let options = ServerOptions { clock: clock.clone(), max_viewers: 64 };
        let server = Server::over(
            endpoint.expect("a simulated socket"),
            config,
            identity.fingerprint(),
            options,
            model::greeting().into(),
            congestion.map(OtherCongestion),
            None,
        );
        Self { network, server: Some(server), clock, num_viewers: 0, seed: model.seed }
    }

    /// Makes links for viewers, and then serves them.
    fn serve(&mut self, num_viewers: usize, renderer: Renderer) -> Vec<Link> {
        self.serve_each(vec![renderer; num_viewers])
    }

    /// The same with a renderer for each viewer, in the order of their arrival.
    fn serve_each(&mut self, renderers: Vec<Renderer>) -> Vec<Link> {
        let mut server = self.server.take().expect("served once");
        let mint = |_: &Renderer| server.mint_link("10.0.0.1").expect("a place");
        let links = renderers.iter().map(mint).collect();
        tokio::spawn(async move {
            let mut renderers = renderers.into_iter().cycle();
            while let Some((session, renderer)) = server.accept().await.zip(renderers.next()) {
                tokio::spawn(model::serve(session, renderer));
            }
        });
        links
    }

    /// A viewer that connects now.
    fn viewer(&mut self, link: &Link) -> ModelClient {
        self.num_viewers += 1;
        let address = viewer_address(self.num_viewers);
        let (network, seed) = (self.network.clone(), self.seed + u64::from(self.num_viewers));
        // Each attempt to connect has a port of its own.
        let attempts = AtomicU16::new(0);
        ModelClient::connect(link, self.clock.clone(), seeded(seed), move || {
            let attempt = attempts.fetch_add(1, Ordering::Relaxed);
            network.socket(SocketAddr::new(address.ip(), address.port() + 100 * attempt))
        })
    }
}

fn viewer_address(number: u16) -> SocketAddr {
    ([10, 0, 1, 1], 5000 + number).into()
}

fn seeded(seed: u64) -> EndpointConfig {
    let mut config = EndpointConfig::default();
    let mut bytes = [0; 32];
    bytes[..8].copy_from_slice(&seed.to_le_bytes());
    config.rng_seed(Some(bytes));
    config
}

/// Runs a scenario in virtual time.
fn in_virtual_time<T>(scenario: impl Future<Output = T>) -> T {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().start_paused(true).build();
    runtime.expect("a runtime").block_on(scenario)
}

fn link_model(mbit: f64, rtt_ms: u64, loss: f64) -> LinkModel {
    LinkModel {
        rtt: Duration::from_millis(rtt_ms),
        bandwidth_mbit: Some(mbit),
        loss,
        seed: 7,
        ..LinkModel::default()
    }
}

/// One viewer turns its camera and rests then.
fn one_viewer(
    model: LinkModel,
    congestion: Option<Arc<dyn ControllerFactory + Send + Sync>>,
    moving: Duration,
    resting: Duration,
) -> (Shown, Traffic) {
    in_virtual_time(async move {
        let mut world = World::new(&model, congestion);
        let links = world.serve(1, Renderer::default());
        let client = world.viewer(&links[0]);
        let shown = model::view(client, moving, resting).await;
        (shown, world.network.traffic())
    })
}
