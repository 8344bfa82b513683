//! `bench`: tables of quality, speed and latency.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Result;
use clap::{Args, Subcommand};
use isinglass_bench::demo::DemoOptions;
use isinglass_bench::output::write_whole;
use isinglass_bench::progress::note;
use isinglass_bench::rivals::Method;
use isinglass_bench::view::Orbit;
use isinglass_bench::{latency, quality, scenes, speed};
use isinglass_core::camera::Intrinsics;
use isinglass_core::codec;
use isinglass_core::kernels::layering::Layering;
use isinglass_gpu::{Backend, BackendChoice};
use serde::Serialize;

use super::demo::parse_speed;
use crate::args::{
    BackendArgs, DEFAULT_K, ForesightArgs, LayeringArgs, LinkArgs, LookArgs, MethodArgs, PathArgs,
    parse_duration, parse_fov, parse_k, parse_output, parse_size,
};
use crate::report::{print, print_json};

#[derive(Args)]
pub(crate) struct BenchArgs {
    #[command(subcommand)]
    table: Table,
}

#[derive(Subcommand)]
enum Table {
    /// How near novel views come to full renderings
    Quality(QualityArgs),
    /// How long rendering, layers, coding and novel views take
    Speed(SpeedArgs),
    /// What is shown under latency: the headless demo over a table of round-trip times
    Latency(LatencyArgs),
}

/// What all tables have in common.
#[derive(Args)]
struct CommonArgs {
    /// Scenes: cloud, cubus, shells, bonsai, engine, avm, t1_head, heptane, mouse_brain, a volume or a built-in volume
    /// [default: all]. Scanned volumes come from the folder that ISINGLASS_DATA names, or from shared/data
    #[arg(value_name = "SCENE")]
    scenes: Vec<String>,
    /// Columns and rows of pictures and frames
    #[arg(long, value_name = "WxH", value_parser = parse_size, default_value = "256x256")]
    size: [u32; 2],
    /// Vertical field of view, degrees
    #[arg(long, value_name = "DEG", value_parser = parse_fov, default_value_t = isinglass_client::DEFAULT_FOV_Y_DEGREES)]
    fov: f32,
    /// Generating camera: azimuth and elevation in degrees, distance in radii
    #[arg(long, value_name = "AZ,EL[,DIST]", default_value = "30,20", allow_hyphen_values = true)]
    orbit: Orbit,
    #[command(flatten)]
    look: LookArgs,
    /// As JSON
    #[arg(long)]
    json: bool,
    /// Also write the JSON to a file, whole or not at all
    #[arg(short, long, value_name = "FILE", value_parser = parse_output)]
    output: Option<PathBuf>,
}

impl CommonArgs {
    fn intrinsics(&self) -> Intrinsics {
        let [width, height] = self.size;
        Intrinsics { width, height, fov_y: self.fov.to_radians() }
    }

    fn select(&self) -> Result<Vec<scenes::SceneSource>> {
        let selection = scenes::select(&self.scenes, scenes::data_folder().as_deref())?;
        for skipped in &selection.skipped {
            note(&format!("skipped {skipped}"));
        }
        Ok(selection.scenes)
    }

    fn publish(&self, report: &impl Serialize, table: &str) -> Result<()> {
        if let Some(path) = &self.output {
            write_whole(path, (serde_json::to_string_pretty(report)? + "\n").as_bytes())?;
        }
        if self.json { print_json(report) } else { print(table) }
    }
}

#[derive(Args)]
struct QualityArgs {
    #[command(flatten)]
    common: CommonArgs,
    /// Rules, between commas [default: all]
    #[arg(long, value_name = "RULE", value_delimiter = ',')]
    layering: Vec<Layering>,
    /// How frames become pictures: layers, point-warp, slabs-planar, slabs-mesh, between commas
    #[arg(long, value_name = "METHOD", value_delimiter = ',', default_values_t = [Method::default()])]
    method: Vec<Method>,
    /// Most segments a pixel, between commas
    #[arg(long, value_name = "K", value_parser = parse_k, value_delimiter = ',', default_values_t = [DEFAULT_K])]
    k: Vec<u8>,
    /// Turns of azimuth to either side, degrees, between commas; 0 is the generating camera
    #[arg(long, value_name = "DEG", value_parser = parse_angle, value_delimiter = ',', default_value = "0,5,10,30")]
    angles: Vec<f32>,
    #[command(flatten)]
    backend: BackendArgs,
}

#[derive(Args)]
struct SpeedArgs {
    #[command(flatten)]
    common: CommonArgs,
    #[command(flatten)]
    layering: LayeringArgs,
    #[command(flatten)]
    method: MethodArgs,
    /// Turn of the novel view, degrees
    #[arg(long, value_name = "DEG", value_parser = parse_angle, default_value = "10")]
    angle: f32,
    /// Runs of which the median counts
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=1000))]
    repeats: u32,
    /// Backends, between commas [default: cpu, and gpu if there is one]
    #[arg(long, value_name = "BACKEND", value_delimiter = ',')]
    backend: Vec<BackendChoice>,
}

#[derive(Args)]
struct LatencyArgs {
    #[command(flatten)]
    common: CommonArgs,
    #[command(flatten)]
    layering: LayeringArgs,
    #[command(flatten)]
    method: MethodArgs,
    /// Round-trip times, between commas
    #[arg(long, value_name = "TIME", value_parser = parse_duration, value_delimiter = ',', default_value = "0ms,100ms,300ms")]
    rtts: Vec<Duration>,
    #[command(flatten)]
    link: LinkArgs,
    /// Speed of the camera, degrees a second
    #[arg(long, value_name = "DEG", default_value_t = 30.0, value_parser = parse_speed)]
    speed: f32,
    #[command(flatten)]
    path: PathArgs,
    #[command(flatten)]
    foresight: ForesightArgs,
    /// Keep the pictures and reports of each run in a folder of its own in DIR
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    backend: BackendArgs,
}

pub(crate) fn run(args: BenchArgs) -> Result<()> {
    match args.table {
        Table::Quality(args) => run_quality(args),
        Table::Speed(args) => run_speed(args),
        Table::Latency(args) => run_latency(args),
    }
}

fn run_quality(args: QualityArgs) -> Result<()> {
    let common = args.common;
    let report = quality::run(&quality::QualityOptions {
        scenes: common.select()?,
        transfer: common.look.tf.clone(),
        layerings: if args.layering.is_empty() { Layering::ALL.to_vec() } else { args.layering },
        methods: args.method,
        ks: args.k,
        angles_degrees: args.angles,
        orbit: common.orbit,
        intrinsics: common.intrinsics(),
        shaded: common.look.is_shaded(),
        backend: args.backend.backend,
        codec: codec::Settings::default(),
    })?;
    common.publish(&report, &quality::table(&report))
}

fn run_speed(args: SpeedArgs) -> Result<()> {
    let common = args.common;
    let mut backends = args.backend;
    if backends.is_empty() {
        backends.push(BackendChoice::Cpu);
        if let Ok(Backend::Gpu(_)) = Backend::open(BackendChoice::Gpu) {
            backends.push(BackendChoice::Gpu);
        }
    }
    let report = speed::run(&speed::SpeedOptions {
        scenes: common.select()?,
        transfer: common.look.tf.clone(),
        backends,
        layering: args.layering.layering,
        method: args.method.method,
        k: args.layering.k,
        orbit: common.orbit,
        turn_degrees: args.angle,
        intrinsics: common.intrinsics(),
        shaded: common.look.is_shaded(),
        repeats: args.repeats,
    })?;
    common.publish(&report, &speed::table(&report))
}

fn run_latency(args: LatencyArgs) -> Result<()> {
    let common = args.common;
    let report = latency::run(&latency::LatencyOptions {
        scenes: common.select()?,
        rtts: args.rtts,
        out: args.out,
        demo: DemoOptions {
            transfer: common.look.tf.clone(),
            shaded: common.look.is_shaded(),
            layering: args.layering.layering,
            method: args.method.method,
            k: args.layering.k,
            orbit: common.orbit,
            path: args.path.read()?,
            foresight: args.foresight.foresight(),
            degrees_per_second: args.speed,
            intrinsics: common.intrinsics(),
            backend: args.backend.backend,
            link: args.link.model(Duration::ZERO)?,
            ..DemoOptions::default()
        },
    })?;
    common.publish(&report, &latency::table(&report))
}

/// Degrees, finite.
fn parse_angle(text: &str) -> Result<f32, String> {
    let degrees = text.parse::<f32>().ok().filter(|d| d.abs() <= 360.0);
    degrees.ok_or_else(|| "expected degrees, -360 to 360".into())
}
