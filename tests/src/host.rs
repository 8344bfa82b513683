//! A server on loopback whose file is one of the test's own.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use isinglass_core::look::Look;
use isinglass_core::session::rate::CodingPlan;
use isinglass_core::volume::Volume;
use isinglass_core::wire::Choices;
use isinglass_formats::load_transfer;
use isinglass_net::{Client, ClientOptions, Link};
use isinglass_render::Backend;
use isinglass_server::{Library, Loader, RunningServer, ServeOptions, Timing, start};

/// See the module. It renders on the CPU and sends exact frames to at most four viewers.
pub struct Host {
    runtime: tokio::runtime::Runtime,
    server: RunningServer,
}

impl Host {
    /// Shows a part of the file that `loader` reads, at first as the preset says.
    pub fn new(volume: Volume, preset: &str, parts: Choices, loader: Arc<dyn Loader>) -> Self {
        Self::within(volume, preset, parts, loader, [1 << 30; 2])
    }

    /// The same within so many bytes for all frames, and for all volumes.
    pub fn within(
        volume: Volume,
        preset: &str,
        parts: Choices,
        loader: Arc<dyn Loader>,
        [frame_memory, volume_memory]: [u64; 2],
    ) -> Self {
        let mut threads = tokio::runtime::Builder::new_multi_thread();
        let runtime = threads.worker_threads(2).enable_all().build().expect("threads for the server");
        let options = ServeOptions {
            volume: Arc::new(volume),
            look: Look::new(load_transfer(preset).expect("a preset")),
            devices: Backend::Cpu.into(),
            listen: SocketAddr::from(([127, 0, 0, 1], 0)),
            plan: CodingPlan::EXACT,
            max_viewers: 4,
            frame_memory,
            library: Some(Library { parts, loader, volume_memory }),
            timing: Timing::default(),
        };
        let server = runtime.block_on(async { start(options) }).expect("a port of loopback");
        Self { runtime, server }
    }

    /// Lets one viewer in.
    pub fn link(&self) -> Link {
        self.runtime.block_on(self.server.mint_link(None)).expect("room for another viewer")
    }

    /// A viewer that was let in.
    pub fn viewer(&self) -> Client {
        let client = Client::connect(&self.link(), ClientOptions::default()).expect("a client");
        client.wait_connected(Duration::from_secs(60)).expect("the server lets it in");
        client
    }

    /// Ends the server.
    pub fn end(self) {
        self.runtime.block_on(self.server.close());
    }
}
