//! `serve`: serves a volume to viewers.

use std::net::{Ipv6Addr, SocketAddr, ToSocketAddrs};
use std::path::PathBuf;
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result};
use clap::Args;
use isinglass_bench::progress::note;
use isinglass_core::look::Look;
use isinglass_core::volume::Volume;
use isinglass_net::{Identity, Link};
use isinglass_render::Devices;
use isinglass_server::{Attendance, Library, Pager, ServeOptions, Timing};
use serde_json::json;
use tokio::time::Instant;

use crate::args::{BackendArgs, GpusArgs, ListArgs, LookArgs, PlanArgs, VolumeArgs, parse_mbit};
use crate::detach;
use crate::distributed::{DistributedArgs, Together};
use crate::ending;
use crate::given::Given;
use crate::identity_file;
use crate::light_args::LightArgs;
use crate::memory::MemoryArgs;
use crate::metrics::{self, parse_loopback};
use crate::report::print;
use crate::state_args::{Seen, StateArgs};

#[derive(Args)]
pub(crate) struct ServeArgs {
    #[command(flatten)]
    state: StateArgs,
    /// Address and port to listen on, over UDP and TCP; port 0 takes a free one
    #[arg(long, value_name = "ADDRESS:PORT", value_parser = parse_address, default_value = "127.0.0.1:4433")]
    listen: SocketAddr,
    /// Name or address of this machine for viewers, for the link [default: the one listened on]
    #[arg(long, value_name = "HOST", value_parser = parse_host)]
    host: Option<String>,
    /// Most viewers at the same time; one link is printed for each, and another when one has left
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=100))]
    viewers: u32,
    #[command(flatten)]
    lists: ListArgs,
    /// Send each viewer at most so many megabits a second, in frames as good as that allows [default: what its link
    /// carries]
    #[arg(long, value_name = "MBIT", value_parser = parse_mbit)]
    rate: Option<f64>,
    #[command(flatten)]
    backend: BackendArgs,
    #[command(flatten)]
    gpus: GpusArgs,
    #[command(flatten)]
    memory: MemoryArgs,
    #[command(flatten)]
    distributed: DistributedArgs,
    /// Show only this part: viewers cannot choose another channel, time, level or series
    #[arg(long)]
    fixed: bool,
    /// Keep this server's certificate and key in a file, so that its fingerprint stays [default: new ones at each start]
    #[arg(long, value_name = "FILE")]
    identity: Option<PathBuf>,
    /// Answer GET /metrics with numbers for Prometheus at this address, on loopback only
    #[arg(long, value_name = "ADDRESS:PORT", value_parser = parse_loopback)]
    metrics: Option<SocketAddr>,
    /// End when no viewer has been connected for so long, such as 60s or 10min [default: never]
    #[arg(long, value_name = "TIME", value_parser = parse_patience)]
    end_after_last: Option<Duration>,
    /// Go on in the background when the links are printed, even when the terminal or the ssh connection closes
    #[arg(long, conflicts_with = "distributed")]
    detach: bool,
    /// This process is the one in the background
    #[arg(long, hide = true, conflicts_with = "detach")]
    detached: bool,
    /// Print the links as JSON, one object per line
    #[arg(long)]
    json: bool,
    // These come last because clap would list later arguments under their headings.
    #[command(flatten)]
    look: LookArgs,
    #[command(flatten)]
    light: LightArgs,
    #[command(flatten)]
    plan: PlanArgs,
    #[command(flatten)]
    volume: VolumeArgs,
}

pub(crate) fn run(args: ServeArgs, given: Given) -> Result<()> {
    if args.detach {
        return detach::run_again();
    }
    if args.detached {
        detach::leave_terminal()?;
    }
    match args.distributed.join()? {
        Some(together) => together.conclude(serve_together(&args, given, &together)),
        None => serve_alone(&args, given),
    }
}

/// Serves a volume that this process holds.
fn serve_alone(args: &ServeArgs, given: Given) -> Result<()> {
    let seen = args.state.read(given)?;
    let (opened, look) =
        seen.open_to_serve(&args.volume, &args.look, args.light.lighting(), &args.lists, &args.memory)?;
    let library = (!args.fixed).then_some(opened.library);
    let pager = Pager::of(&opened.volume)?;
    serve(args, &seen, (opened.volume, look), args.gpus.open(&args.backend)?, library, pager)
}

/// Serves a volume whose parts several processes hold. Viewers cannot choose another part of the file.
fn serve_together(args: &ServeArgs, given: Given, together: &Together) -> Result<()> {
    let seen = args.state.read(given)?;
    let light = (args.light.lighting(), &args.lists, &args.backend);
    together.serve(&seen, (&args.volume, &args.memory), &args.look, light, |volume, look, backend, pager| {
        serve(args, &seen, (volume, look), backend.into(), None, pager)
    })
}

fn serve(
    args: &ServeArgs,
    seen: &Seen,
    (volume, look): (Arc<Volume>, Look),
    devices: Devices,
    library: Option<Library>,
    pager: Option<Pager>,
) -> Result<()> {
    let source = seen.volume(&args.volume)?.source()?.to_owned();
    // A viewer that follows the link opens the state at once.
    let state = seen.for_link(&look);
    let description = devices.description();
    let frame_memory = args.memory.frame_bytes(&volume);
    let options = ServeOptions {
        volume,
        look,
        devices,
        listen: args.listen,
        plan: args.plan.plan(args.rate),
        max_viewers: args.viewers,
        frame_memory,
        library,
        timing: Timing::default(),
    };
    let identity =
        args.identity.as_deref().map_or_else(|| Ok(Identity::generate()?), identity_file::read_or_make)?;
    let runtime = tokio::runtime::Runtime::new().context("no threads for the server")?;
    let served = runtime.block_on(async {
        let server = isinglass_server::start_as(&identity, options, pager)?;
        let address = server.address();
        let end = if args.detached { format!("`kill {}`", std::process::id()) } else { "Ctrl-C".into() };
        note(&format!("serving {source} at {address} on {description}; each link lets in one viewer; {end} ends it"));
        if args.host.is_none() && address.ip().is_unspecified() {
            note("the links are for viewers on this computer; others need --host, the name or address they reach it by");
        }
        if let Some(wanted) = args.metrics {
            let listener = tokio::net::TcpListener::bind(wanted).await;
            let listener = listener.with_context(|| format!("cannot listen on {wanted} for --metrics"))?;
            note(&format!("numbers for Prometheus are at http://{}/metrics", listener.local_addr()?));
            let (attendance, counters) = (server.attendance(), server.counters());
            tokio::spawn(metrics::answer_all(listener, move || metrics::text(*attendance.borrow(), &counters)));
        }
        let most = args.viewers as usize;
        let mut num_links = 0;
        let mut attendance = server.attendance();
        let mut end = pin!(told_to_end());
        let mut alone_since = Some(Instant::now());
        loop {
            // One link per free place. A viewer that lost the network reconnects without one.
            let Attendance { connected, used_links } = *attendance.borrow_and_update();
            alone_since = (connected == 0).then(|| alone_since.unwrap_or_else(Instant::now));
            let unused = num_links - used_links.min(num_links);
            let mut links = Vec::new();
            let mut minted = Ok(());
            for _ in 0..most.saturating_sub(connected + unused) {
                match server.mint_link(args.host.as_deref()).await {
                    Ok(link) => links.push(Link { state: state.clone(), ..link }.to_string()),
                    Err(e) => minted = Err(e.into()),
                }
            }
            if num_links > 0 && !links.is_empty() {
                note("a viewer has left; for the next one:");
            }
            let told = match (links.is_empty(), args.json) {
                (true, _) => Ok(()),
                // Each link is on a line of its own, as there may be more.
                (_, true) => print(&format!("{}\n", json!({ "address": address.to_string(), "links": links }))),
                (_, false) => print(&(links.join("\n") + "\n")),
            };
            match minted.and(told) {
                // Present viewers stay.
                Err(e) if num_links > 0 => note(&format!("no other viewer can come: {e:#}")),
                all => all?,
            }
            if args.detached && num_links == 0 {
                detach::let_go()?;
            }
            num_links += links.len();
            let end_at = alone_since.zip(args.end_after_last).map(|(since, patience)| since + patience);
            tokio::select! {
                told = &mut end => break told?,
                Ok(()) = attendance.changed() => {}
                () = tokio::time::sleep_until(end_at.unwrap_or_else(Instant::now)), if end_at.is_some() => {
                    note("no viewer is left");
                    break;
                }
            }
        }
        note("closing");
        server.close().await;
        Ok(())
    });
    // Nobody waits for unfinished reading or computing.
    runtime.shutdown_background();
    served
}

/// Returns on Ctrl-C, or on SIGTERM, which service managers send.
async fn told_to_end() -> Result<()> {
    ending::leave_to_command(true);
    let ctrl_c = async { tokio::signal::ctrl_c().await.context("cannot wait for Ctrl-C") };
    #[cfg(unix)]
    {
        use tokio::signal::unix::{SignalKind, signal};
        let mut terminate = signal(SignalKind::terminate()).context("cannot wait for SIGTERM")?;
        tokio::select! {
            told = ctrl_c => told,
            _ = terminate.recv() => Ok(()),
        }
    }
    #[cfg(not(unix))]
    ctrl_c.await
}

/// `60s`, `10min`, `2h`, or a number of seconds.
fn parse_patience(text: &str) -> Result<Duration, String> {
    let split = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    let (number, unit) = text.split_at(split);
    let seconds_per_unit = match unit.trim() {
        "" | "s" => 1,
        "min" => 60,
        "h" => 3600,
        _ => 0,
    };
    let seconds = number.parse::<u64>().ok().and_then(|n| n.checked_mul(seconds_per_unit));
    let seconds = seconds.filter(|s| (1..=30 * 86_400).contains(s));
    seconds.map(Duration::from_secs).ok_or_else(|| "expected a time such as 60s, 10min or 2h".into())
}

fn parse_host(text: &str) -> Result<String, String> {
    let bracketed = if text.contains(':') { format!("[{text}]") } else { text.to_owned() };
    let nobody =
        format!("isinglass://{bracketed}:1/#token={}&cert=sha256:{}", "0".repeat(32), "0".repeat(64));
    let is_address =
        !text.contains(':') || text.split('%').next().is_some_and(|t| t.parse::<Ipv6Addr>().is_ok());
    match nobody.parse::<Link>() {
        Ok(link) if link.host == text && is_address => Ok(link.host),
        _ => Err("expected a name or an address without a port, such as render-01.example.org".into()),
    }
}

fn parse_address(text: &str) -> Result<SocketAddr, String> {
    let mut found =
        text.to_socket_addrs().map_err(|e| format!("{e}; expected an address such as 127.0.0.1:4433"))?;
    found.next().ok_or_else(|| "no such address".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_patience_has_a_unit() {
        for (text, seconds) in [("60s", 60), ("10min", 600), ("2 h", 7200), ("5", 5)] {
            assert_eq!(parse_patience(text), Ok(Duration::from_secs(seconds)), "{text}");
        }
        for bad in ["", "0s", "s", "5m", "-1s", "1.5h", "99999999999999999999h", "9999h"] {
            assert!(parse_patience(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn a_host_is_a_name_or_an_address_without_a_port() {
        for host in ["render-01.example.org", "10.0.0.7", "::1", "fe80::1%eth0", "localhost"] {
            assert_eq!(parse_host(host).as_deref(), Ok(host));
        }
        for host in
            ["", "a:1", "10.0.0.7:4433", "[::1]", "[::1]:9", "a b", "a/b", "a#b", "isinglass://a", "a@b"]
        {
            assert!(parse_host(host).is_err(), "{host}");
        }
    }
}
