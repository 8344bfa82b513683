//! `bench pipeline`: the time of each stage of a frame.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Result;
use clap::Args;
use isinglass_bench::demo::{DEFAULT_SOURCE, DemoOptions};
use isinglass_bench::pipeline::{self, PipelineOptions};
use isinglass_core::camera::Intrinsics;
use isinglass_core::orbit::Orbit;

use super::demo::parse_speed;
use crate::args::{
    BackendArgs, ForesightArgs, LinkArgs, ListArgs, LookArgs, PartArgs, PlanArgs, RawArgs, any_text,
    not_an_input, parse_duration, parse_fov, parse_output, parse_rate, parse_size,
};
use crate::light_args::LightArgs;
use crate::memory::MemoryArgs;
use crate::report::{print, print_json};

#[derive(Args)]
pub(super) struct PipelineArgs {
    /// A volume, as for `serve`
    #[arg(value_name = "VOLUME", default_value = DEFAULT_SOURCE, value_parser = any_text())]
    volume: String,
    /// Round-trip time between server and viewer [default: the link's, or 20ms]
    #[arg(long, value_name = "TIME", value_parser = parse_duration)]
    rtt: Option<Duration>,
    /// Duration of the measurement, seconds
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=3600))]
    seconds: u32,
    /// Columns and rows of the picture
    #[arg(long, value_name = "WxH", value_parser = parse_size, default_value = "640x360")]
    size: [u32; 2],
    /// Vertical field of view, degrees
    #[arg(long, value_name = "DEG", value_parser = parse_fov, default_value_t = isinglass_client::DEFAULT_FOV_Y_DEGREES)]
    fov: f32,
    /// Where the camera begins, see `render`
    #[arg(long, value_name = "AZ,EL[,DIST]", default_value = "30,20", allow_hyphen_values = true)]
    orbit: Orbit,
    /// Speed of the camera, degrees per second
    #[arg(long, value_name = "DEG", default_value_t = 30.0, value_parser = parse_speed)]
    speed: f32,
    /// Refreshes of the display per second
    #[arg(long, value_name = "HZ", default_value_t = 60.0, value_parser = parse_rate)]
    refresh: f32,
    #[command(flatten)]
    lists: ListArgs,
    #[command(flatten)]
    backend: BackendArgs,
    #[command(flatten)]
    memory: MemoryArgs,
    /// As JSON
    #[arg(long)]
    json: bool,
    /// Also write the lives of frames to a file, as Chrome trace events
    #[arg(long, value_name = "FILE", value_parser = parse_output)]
    trace: Option<PathBuf>,
    // These come last because clap would list later arguments under their headings.
    #[command(flatten)]
    look: LookArgs,
    #[command(flatten)]
    light: LightArgs,
    #[command(flatten)]
    plan: PlanArgs,
    #[command(flatten)]
    link: LinkArgs,
    #[command(flatten)]
    foresight: ForesightArgs,
    #[command(flatten)]
    raw: RawArgs,
    #[command(flatten)]
    part: PartArgs,
}

pub(super) fn run(args: PipelineArgs) -> Result<()> {
    if let Some(trace) = &args.trace {
        not_an_input(trace, [Some(args.volume.as_str()), args.look.transfer_file()])?;
    }
    let (mode, isos) = args.look.mode()?;
    let [width, height] = args.size;
    let demo = DemoOptions {
        source: args.volume,
        raw: args.raw.shape(),
        selection: args.part.selection(),
        spacing: args.part.spacing,
        foreign_files: args.part.has_foreign_files(),
        reading: args.part.reading(),
        max_bytes: args.memory.bytes(),
        transfer: args.look.tf.clone(),
        shaded: args.look.is_shaded(),
        clip: args.look.clip.clip(),
        lighting: args.light.lighting(),
        mode,
        isos,
        k: args.lists.k,
        orbit: args.orbit,
        foresight: args.foresight.foresight(),
        intrinsics: Intrinsics::perspective(width, height, args.fov.to_radians()),
        backend: args.backend.backend,
        link: args.link.model(args.rtt, Duration::from_millis(20))?,
        plan: args.plan.plan(None),
        degrees_per_second: args.speed,
        refresh_hz: args.refresh,
        ..DemoOptions::default()
    };
    let options = PipelineOptions { demo, duration: Duration::from_secs(args.seconds.into()) };
    let report = pipeline::run(&options, args.trace.as_deref())?;
    if args.json { print_json(&report) } else { print(&pipeline::table(&report)) }
}
