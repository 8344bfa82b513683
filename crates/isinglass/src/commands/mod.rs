//! One file per command.

mod bench;
mod compare;
mod convert;
mod demo;
mod doctor;
mod headless;
mod index;
mod info;
mod layers;
mod pipeline;
mod relay;
mod render;
mod reproject;
mod serve;
mod view;
mod viewers;

use anyhow::Result;
use clap::Subcommand;

use crate::given::Given;

/// What to do.
#[derive(Subcommand)]
pub(crate) enum Command {
    /// Server and viewer in one process, with as much latency as you like
    Demo(demo::DemoArgs),
    /// Serve a volume, and print the link for a viewer
    Serve(serve::ServeArgs),
    /// Open the viewer: a page to choose from, a server's link, or a volume of this or another machine
    View(view::ViewerArgs),
    /// Render a volume: the reference picture
    Render(render::RenderArgs),
    /// Make a layered frame of a volume and store it
    Layers(layers::LayersArgs),
    /// Show a stored layered frame from another side
    Reproject(reproject::ReprojectArgs),
    /// Compare two pictures: DSSIM, SSIM, PSNR
    Compare(compare::CompareArgs),
    /// Show what is in a volume or in a stored layered frame
    Info(info::InfoArgs),
    /// Read all voxels of a large volume once, so that it is shown faster and in its true colours by pages
    Index(index::IndexArgs),
    /// Make a pyramid in OME-Zarr of a volume, in bounded memory
    Convert(convert::ConvertArgs),
    /// Measure speed, latency or the stages of a frame
    Bench(bench::BenchArgs),
    /// Join standard input and output with a server of this machine
    #[command(hide = true)]
    Relay(relay::RelayArgs),
    /// Report what this machine lacks, and what to install
    Doctor(doctor::DoctorArgs),
}

impl Command {
    /// The default log level. Only a server has problems that appear nowhere else.
    pub(crate) fn log_level(&self) -> &'static str {
        if matches!(self, Self::Serve(_)) { "warn" } else { "error" }
    }

    pub(crate) fn run(self, given: Given) -> Result<()> {
        match self {
            Self::Demo(args) => demo::run(args, given),
            Self::Serve(args) => serve::run(args, given),
            Self::View(args) => view::run(args, given),
            Self::Render(args) => render::run(&args, given),
            Self::Layers(args) => layers::run(&args, given),
            Self::Reproject(args) => reproject::run(&args),
            Self::Compare(args) => compare::run(&args),
            Self::Info(args) => info::run(&args),
            Self::Index(args) => index::run(&args),
            Self::Convert(args) => convert::run(&args),
            Self::Bench(args) => bench::run(args),
            Self::Relay(args) => relay::run(&args),
            Self::Doctor(args) => doctor::run(&args),
        }
    }
}

/// The commands in which a state may name the volume in place of VOLUME.
pub(crate) const WITH_STATE: [&str; 3] = ["serve", "render", "layers"];
