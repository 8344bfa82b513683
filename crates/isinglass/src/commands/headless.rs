//! `view --headless`: the viewer without a window, measured.

use std::io::{self, BufRead};
use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use clap::Args;
use isinglass_bench::visit::{self, VisitOptions};
use isinglass_core::camera::Intrinsics;
use isinglass_core::orbit::Orbit;
use isinglass_net::{Client, ClientOptions, Link, Tunnel};

use super::demo::parse_speed;
use super::view::connect;
use crate::args::{PathArgs, usage_error};
use crate::report::{print, print_json};

/// What the viewer does without a window.
#[derive(Args)]
pub(super) struct HeadlessArgs {
    /// Play a camera path without a window, cast every picture, and measure what a window would show
    #[arg(long)]
    headless: bool,
    #[command(flatten)]
    path: PathArgs,
    /// Speed of the headless camera without --path, degrees a second
    #[arg(long, value_name = "DEG", default_value_t = 30.0, value_parser = parse_speed)]
    speed: f32,
    /// Folder for the figures and pictures without a window [default: isinglass-view]
    #[arg(long, value_name = "DIR", requires = "headless")]
    out: Option<PathBuf>,
    /// Also write the picture of every Nth refresh
    #[arg(long, value_name = "N", requires = "headless", value_parser = clap::value_parser!(u32).range(1..))]
    every: Option<u32>,
    /// Load the server with N viewers, and cast pictures for the first: standard input gives a link for each
    #[arg(long, value_name = "N", requires = "headless", value_parser = clap::value_parser!(u32).range(1..=100))]
    copies: Option<u32>,
    /// Print the figures as JSON
    #[arg(long, requires = "headless")]
    json: bool,
}

/// The picture, the same with a window and without.
pub(super) struct View {
    pub(super) orbit: Orbit,
    pub(super) intrinsics: Intrinsics,
    pub(super) is_orthographic: bool,
    pub(super) foresight: isinglass_client::Foresight,
    pub(super) refresh_hz: Option<f32>,
    pub(super) backend: isinglass_render::BackendChoice,
}

impl HeadlessArgs {
    pub(super) fn is_on(&self) -> bool {
        self.headless
    }

    /// The number of links on standard input.
    pub(super) fn num_copies(&self) -> u32 {
        self.copies.unwrap_or(1)
    }

    pub(super) fn check(&self) -> Result<()> {
        if self.path.path.is_some() && !self.headless {
            return Err(usage_error("--path plays a camera path without a window, expected --headless too"));
        }
        Ok(())
    }

    /// Lets all viewers play, and reports. The first may have a tunnel.
    pub(super) fn run(self, links: &[Link], tunnel: Option<Tunnel>, view: View) -> Result<()> {
        let out = self.out.unwrap_or_else(|| PathBuf::from(DEFAULT_OUT));
        if out.exists() && !out.is_dir() {
            bail!("{}: found a file, expected a folder for the figures", out.display());
        }
        // A link admits one viewer, and must not be used up by a path that cannot be read.
        let path = self.path.read()?;
        let Some(first) = links.first() else { bail!("found no link, expected one") };
        let options = VisitOptions {
            server: first.place(),
            path,
            orbit: view.orbit,
            degrees_per_second: self.speed,
            intrinsics: view.intrinsics,
            is_orthographic: view.is_orthographic,
            foresight: view.foresight,
            refresh_hz: view.refresh_hz.unwrap_or(USUAL_HZ),
            backend: view.backend,
            every: self.every,
        };
        let tunnels = std::iter::once(tunnel).chain(std::iter::repeat_with(|| None));
        let clients: Vec<Client> = links
            .iter()
            .zip(tunnels)
            .map(|(link, tunnel)| connect(link, ClientOptions { tunnel, ..ClientOptions::default() }))
            .collect::<Result<_>>()?;
        let report = visit::run(clients, &options, &out)?;
        if self.json { print_json(&report) } else { print(&report.text(&out)) }
    }
}

/// Reads `num` links, one a line, and no more, because `serve` holds its output open.
pub(super) fn read_links(text: impl BufRead, num: u32) -> Result<Vec<Link>> {
    let mut text = text.take(LONGEST_LINK * u64::from(num));
    let mut read = || {
        let mut line = String::new();
        text.read_line(&mut line).context("standard input")?;
        if line.is_empty() {
            return Err(io::Error::from(io::ErrorKind::UnexpectedEof))
                .context("standard input has too few links");
        }
        line.trim().parse().context("standard input")
    };
    (0..num).map(|_| read()).collect()
}

/// Most bytes of one link on standard input; a state inside has a limit of its own.
const LONGEST_LINK: u64 = 1 << 20;
const DEFAULT_OUT: &str = "isinglass-view";
const USUAL_HZ: f32 = 60.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn as_many_links_are_read_as_there_are_viewers() {
        let link =
            |n: u32| format!("isinglass://a:{n}/#token={}&cert=sha256:{}\n", "0".repeat(32), "0".repeat(64));
        let text = link(1) + &link(2);
        let ports =
            |num| read_links(text.as_bytes(), num).map(|l| l.iter().map(|l| l.port).collect::<Vec<_>>());
        assert_eq!(ports(1).unwrap(), [1]);
        assert_eq!(ports(2).unwrap(), [1, 2]);
        assert!(ports(3).is_err());
    }
}
