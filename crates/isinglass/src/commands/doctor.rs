//! `doctor`: what this machine lacks, and what to install.

use std::net::UdpSocket;
use std::path::Path;
use std::time::Duration;

use anyhow::Result;
use clap::Args;
use isinglass_gpu::Gpu;
use serde::Serialize;

use crate::report::{print, print_json};

#[derive(Args)]
pub(crate) struct DoctorArgs {
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// The result of one check.
#[derive(Serialize)]
struct Check {
    name: &'static str,
    ok: bool,
    found: String,
    /// What to do about it, if anything.
    advice: Option<&'static str>,
}

pub(crate) fn run(args: &DoctorArgs) -> Result<()> {
    let checks = [processors(), gpu(), vulkan_loader(), display(), udp_loopback()];
    if args.json {
        return print_json(&serde_json::json!({ "checks": checks }));
    }
    let mut text = format!("isinglass {} on {}\n", env!("CARGO_PKG_VERSION"), std::env::consts::OS);
    for check in &checks {
        let mark = if check.ok { "ok" } else { "--" };
        text += &format!("  {mark}  {:<14} {}\n", check.name, check.found);
        if let Some(advice) = check.advice {
            text += &format!("      {:<14} {advice}\n", "");
        }
    }
    text += "Without a GPU everything runs on the CPU (--backend cpu); without a display `isinglass demo` runs headless.\n";
    print(&text)
}

fn processors() -> Check {
    let num = std::thread::available_parallelism().map_or(1, usize::from);
    Check { name: "processors", ok: true, found: num.to_string(), advice: None }
}

fn gpu() -> Check {
    let name = "GPU";
    match Gpu::open() {
        Ok(gpu) if !gpu.info().is_software => {
            Check { name, ok: true, found: gpu.info().to_string(), advice: None }
        }
        Ok(gpu) => {
            let found = format!("{}: a program on the CPU, not used by --backend auto", gpu.info());
            Check { name, ok: false, found, advice: Some(GPU_ADVICE) }
        }
        Err(e) => {
            let found = e.to_string().split(';').next().unwrap_or_default().to_owned();
            Check { name, ok: false, found, advice: Some(GPU_ADVICE) }
        }
    }
}

/// The library that finds Vulkan drivers; systems with Metal or DirectX 12 need none.
fn vulkan_loader() -> Check {
    let name = "Vulkan loader";
    if !cfg!(all(unix, not(target_os = "macos"))) {
        return Check { name, ok: true, found: "not needed here".into(), advice: None };
    }
    let named = std::env::var("LD_LIBRARY_PATH").unwrap_or_default();
    let folders = named.split(':').filter(|f| !f.is_empty()).chain(LIBRARY_FOLDERS);
    match folders.map(|folder| Path::new(folder).join(VULKAN_LOADER)).find(|path| path.exists()) {
        Some(path) => Check { name, ok: true, found: path.display().to_string(), advice: None },
        None => {
            let found = format!("no {VULKAN_LOADER} in the usual folders");
            Check {
                name,
                ok: false,
                found,
                advice: Some("Debian, Ubuntu: libvulkan1; Fedora: vulkan-loader; Arch: vulkan-icd-loader"),
            }
        }
    }
}

fn display() -> Check {
    let ok = isinglass_client::display_available();
    let found = if ok { "a window can be opened" } else { "none answers: no DISPLAY, or nothing behind it" };
    let advice = (!ok).then_some("start a desktop session, use ssh -X, or run `demo --headless --out DIR`");
    Check { name: "display", ok, found: found.into(), advice }
}

/// Server and viewer talk over UDP; some containers and firewalls forbid even the loopback.
fn udp_loopback() -> Check {
    let name = "UDP loopback";
    let attempt = || -> std::io::Result<()> {
        let (a, b) = (UdpSocket::bind("127.0.0.1:0")?, UdpSocket::bind("127.0.0.1:0")?);
        b.set_read_timeout(Some(Duration::from_secs(1)))?;
        a.send_to(b"isinglass", b.local_addr()?)?;
        b.recv_from(&mut [0; 16]).map(|_| ())
    };
    match attempt() {
        Ok(()) => Check { name, ok: true, found: "packets arrive".into(), advice: None },
        Err(e) => {
            let advice = Some("allow UDP on 127.0.0.1 in the firewall or the sandbox");
            Check { name, ok: false, found: format!("a packet to this machine itself is lost: {e}"), advice }
        }
    }
}

#[cfg(target_os = "macos")]
const GPU_ADVICE: &str = "every Mac of the last ten years has Metal: run outside of a virtual machine";
#[cfg(windows)]
const GPU_ADVICE: &str = "install the graphics vendor's driver (DirectX 12 or Vulkan)";
#[cfg(not(any(target_os = "macos", windows)))]
const GPU_ADVICE: &str =
    "Intel, AMD: mesa-vulkan-drivers (Arch: vulkan-intel, vulkan-radeon); NVIDIA: the vendor's driver";
const VULKAN_LOADER: &str = "libvulkan.so.1";
const LIBRARY_FOLDERS: [&str; 8] = [
    "/usr/lib",
    "/usr/lib64",
    "/usr/local/lib",
    "/lib",
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/run/opengl-driver/lib",
    "/usr/lib/wsl/lib",
];
