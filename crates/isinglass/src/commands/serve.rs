//! `serve`: a volume for viewers.

use std::net::{SocketAddr, ToSocketAddrs};

use anyhow::{Context, Result};
use clap::Args;
use isinglass_bench::progress::note;
use isinglass_net::Link;
use isinglass_server::ServeOptions;
use serde_json::json;

use crate::args::{BackendArgs, LayeringArgs, LookArgs, PlanArgs, VolumeArgs, parse_mbit};
use crate::given::Given;
use crate::light_args::LightArgs;
use crate::memory::MemoryArgs;
use crate::report::{print, print_json};
use crate::state_args::StateArgs;

#[derive(Args)]
pub(crate) struct ServeArgs {
    #[command(flatten)]
    volume: VolumeArgs,
    #[command(flatten)]
    state: StateArgs,
    /// Address and UDP port to listen on; port 0 takes a free one
    #[arg(long, value_name = "ADDRESS:PORT", value_parser = parse_address, default_value = "127.0.0.1:4433")]
    listen: SocketAddr,
    /// Name or address that viewers reach this machine by, for the link [default: the one listened on]
    #[arg(long, value_name = "HOST")]
    host: Option<String>,
    /// Viewers at the same time; one link is printed for each
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=100))]
    viewers: u32,
    #[command(flatten)]
    look: LookArgs,
    #[command(flatten)]
    light: LightArgs,
    #[command(flatten)]
    layering: LayeringArgs,
    #[command(flatten)]
    plan: PlanArgs,
    /// Send each viewer no more than so many megabits a second, in frames as good as that allows [default: what its link
    /// carries]
    #[arg(long, value_name = "MBIT", value_parser = parse_mbit)]
    rate: Option<f64>,
    #[command(flatten)]
    backend: BackendArgs,
    #[command(flatten)]
    memory: MemoryArgs,
    /// Show what is named here only: viewers cannot choose another channel, time, level or series
    #[arg(long)]
    fixed: bool,
    /// Print the links as JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(args: ServeArgs, given: Given) -> Result<()> {
    let seen = args.state.read(given)?;
    let source = seen.volume(&args.volume)?.source()?.to_owned();
    let (opened, look) =
        seen.open_to_serve(&args.volume, &args.look, args.light.lighting(), &args.layering, &args.memory)?;
    // Who follows the link sees the state at once.
    let state = seen.for_link(&look);
    let backend = args.backend.open()?;
    let description = backend.description();
    let options = ServeOptions {
        volume: opened.volume,
        look,
        backend,
        listen: args.listen,
        plan: args.plan.plan(args.rate),
        max_viewers: args.viewers,
        library: (!args.fixed).then_some(opened.library),
    };
    let runtime = tokio::runtime::Runtime::new().context("no threads for the server")?;
    runtime.block_on(async {
        let server = isinglass_server::start(options)?;
        let mut links = Vec::new();
        for _ in 0..args.viewers {
            let link = server.mint_link(args.host.as_deref()).await?;
            links.push(Link { state: state.clone(), ..link }.to_string());
        }
        note(&format!(
            "serving {} at {} on {description}; each link lets in one viewer; Ctrl-C ends it",
            source,
            server.address()
        ));
        if args.json {
            print_json(&json!({ "address": server.address().to_string(), "links": links }))?;
        } else {
            print(&(links.join("\n") + "\n"))?;
        }
        tokio::signal::ctrl_c().await.context("cannot wait for Ctrl-C")?;
        note("closing");
        server.close().await;
        Ok(())
    })
}

fn parse_address(text: &str) -> Result<SocketAddr, String> {
    let mut found =
        text.to_socket_addrs().map_err(|e| format!("{e}; expected an address such as 127.0.0.1:4433"))?;
    found.next().ok_or_else(|| "no such address".into())
}
