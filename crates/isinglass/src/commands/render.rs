//! `render`: the reference picture of a volume.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Result;
use clap::Args;
use isinglass_bench::view::Orbit;
use serde_json::json;

use crate::args::{
    BackendArgs, LayeringArgs, LookArgs, ViewArgs, VolumeArgs, parse_background, parse_output,
};
use crate::given::Given;
use crate::lens_args::LensArgs;
use crate::report::print_json;
use crate::state_args::StateArgs;

#[derive(Args)]
pub(crate) struct RenderArgs {
    #[command(flatten)]
    volume: VolumeArgs,
    #[command(flatten)]
    state: StateArgs,
    /// Azimuth and elevation in degrees, and distance in radii of the volume's bounding sphere
    #[arg(long, value_name = "AZ,EL[,DIST]", default_value = "30,20", allow_hyphen_values = true)]
    orbit: Orbit,
    /// PNG file to write
    #[arg(short, long, value_name = "FILE", value_parser = parse_output)]
    output: PathBuf,
    #[command(flatten)]
    view: ViewArgs,
    #[command(flatten)]
    look: LookArgs,
    /// Colour behind the volume
    #[arg(long, value_name = "#RRGGBB", value_parser = parse_background, default_value = "#000000")]
    background: [u8; 3],
    #[command(flatten)]
    backend: BackendArgs,
    /// Tell what was done as JSON
    #[arg(long)]
    json: bool,
    // Last: what follows would be listed under its heading.
    #[command(flatten)]
    lens: LensArgs,
}

pub(crate) fn run(args: &RenderArgs, given: Given) -> Result<()> {
    let seen = args.state.read(given)?;
    let (opened, _) = seen.open(&args.volume, &args.look, &LayeringArgs::default())?;
    let backend = args.backend.open()?;
    let bounds = opened.scene.volume.bounds();
    let camera = seen.camera(&args.orbit, &args.view, &bounds);
    let plan = args.lens.plan(&camera, &bounds)?;
    let mut renderer = backend.renderer(opened.scene)?;
    let start = Instant::now();
    let pictures = plan.draw(|views| renderer.render_mean(views))?;
    let render_ms = start.elapsed().as_secs_f64() * 1e3;
    let picture = plan.compose(&pictures, seen.background(args.background));
    picture.write(&args.output)?;
    if args.json {
        print_json(&json!({
            "output": args.output.display().to_string(),
            "size": [picture.width, picture.height],
            "lens": plan.json,
            "backend": backend.description(),
            "tf": opened.transfer.name,
            "render_ms": render_ms,
        }))?;
    }
    Ok(())
}
