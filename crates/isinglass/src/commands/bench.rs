//! `bench`: tables of speed, latency, the pipeline and viewers.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Result, bail};
use clap::{Args, Subcommand};
use isinglass_bench::demo::DemoOptions;
use isinglass_bench::latency::Contender;
use isinglass_bench::progress::note;
use isinglass_bench::scenes::distinct;
use isinglass_bench::subject::Subject;
use isinglass_bench::{latency, scenes, speed};
use isinglass_core::camera::Intrinsics;
use isinglass_core::look::DEFAULT_K;
use isinglass_core::orbit::Orbit;
use isinglass_formats::{VolumeSource, check_writable, write_whole};
use isinglass_render::{Backend, BackendChoice};
use serde::Serialize;

use super::demo::parse_speed;
use super::pipeline::{self, PipelineArgs};
use super::viewers::{self, ViewersArgs};
use crate::args::{
    BackendArgs, ForesightArgs, LinkArgs, ListArgs, LookArgs, PartArgs, PathArgs, PlanArgs, RawArgs, Switch,
    not_an_input, parse_duration, parse_fov, parse_k, parse_output, parse_size,
};
use crate::report::{print, print_json};

#[derive(Args)]
pub(crate) struct BenchArgs {
    #[command(subcommand)]
    table: Table,
}

#[derive(Subcommand)]
enum Table {
    /// How long rendering, layers, coding and novel views take
    Speed(SpeedArgs),
    /// Quality under latency: the headless demo over a table of round-trip times
    Latency(LatencyArgs),
    /// The time of a frame from request to screen: server and viewer over a slowed-down link
    Pipeline(Box<PipelineArgs>),
    /// What viewers of one server cost it: memory and time a frame
    Viewers(ViewersArgs),
}

/// Arguments of all tables.
#[derive(Args)]
struct CommonArgs {
    /// Scenes: cloud, cubus, shells, bonsai, engine, avm, t1_head, heptane, mouse_brain, a file or folder, or a
    /// built-in volume [default: all]. Scanned volumes come from the folder that ISINGLASS_DATA names, or from
    /// shared/data
    #[arg(value_name = "SCENE", help_heading = None::<&'static str>)]
    scenes: Vec<String>,
    /// Columns and rows of pictures, and by default of frames
    #[arg(long, value_name = "WxH", value_parser = parse_size, default_value = "256x256")]
    size: [u32; 2],
    /// Vertical field of view, degrees
    #[arg(long, value_name = "DEG", value_parser = parse_fov, default_value_t = isinglass_client::DEFAULT_FOV_Y_DEGREES)]
    fov: f32,
    /// Generating camera: azimuth and elevation in degrees, distance in radii, as for render
    #[arg(long, value_name = "AZ,EL[,DIST]", default_value = "30,20", allow_hyphen_values = true)]
    orbit: Orbit,
    /// As JSON
    #[arg(long)]
    json: bool,
    /// Also write the JSON to a file, whole or not at all
    #[arg(short, long, value_name = "FILE", value_parser = parse_output)]
    output: Option<PathBuf>,
    // These come last because clap would list later arguments under their headings.
    #[command(flatten)]
    look: LookArgs,
    #[command(flatten)]
    part: PartArgs,
    #[command(flatten)]
    raw: RawArgs,
}

impl CommonArgs {
    fn intrinsics(&self) -> Intrinsics {
        let [width, height] = self.size;
        Intrinsics::perspective(width, height, self.fov.to_radians())
    }

    fn select(&self) -> Result<Vec<scenes::SceneSource>> {
        let selection = scenes::select(&self.scenes, scenes::data_folder().as_deref())?;
        for skipped in &selection.skipped {
            note(&format!("skipped {skipped}"));
        }
        let mut scenes = selection.scenes;
        for scene in &mut scenes {
            let (raw, selection, spacing) = (self.raw.shape(), self.part.selection(), self.part.spacing);
            scene.volume = VolumeSource {
                raw,
                selection,
                spacing,
                foreign_files: self.part.has_foreign_files(),
                reading: self.part.reading(),
                ..scene.volume.clone()
            };
            // A source that cannot be opened is rejected before hours of measuring.
            scene.check()?;
        }
        Ok(scenes)
    }

    fn subject(&self, ks: Vec<u8>, angles_degrees: Vec<f32>) -> Result<Subject> {
        let (mode, isos) = self.look.mode()?;
        Ok(Subject {
            scenes: self.select()?,
            transfer: self.look.tf.clone(),
            ks: distinct(ks),
            angles_degrees: distinct(angles_degrees),
            orbit: self.orbit,
            intrinsics: self.intrinsics(),
            shaded: self.look.is_shaded(),
            mode,
            isos,
            clip: self.look.clip.clip(),
        })
    }

    /// Rejects a file that cannot be written.
    fn check_output(&self) -> Result<()> {
        if let Some(output) = &self.output {
            let transfer = std::iter::once(self.look.transfer_file());
            not_an_input(output, self.scenes.iter().map(|scene| Some(scene.as_str())).chain(transfer))?;
        }
        self.output.iter().try_for_each(|path| Ok(check_writable(path)?))
    }

    /// Prints before it writes, so that an unwritable file loses no results. Failed scenes are reported last.
    fn publish(&self, report: &impl Serialize, table: &str, failed: &[String]) -> Result<()> {
        let printed = if self.json { print_json(report) } else { print(table) };
        if let Some(path) = &self.output {
            write_whole(path, (serde_json::to_string_pretty(report)? + "\n").as_bytes())?;
        }
        printed?;
        if failed.is_empty() { Ok(()) } else { bail!("not measured to the end: {}", failed.join("; ")) }
    }
}

#[derive(Args)]
struct SpeedArgs {
    /// Mean lengths of lists, between commas
    #[arg(long, value_name = "K", value_parser = parse_k, value_delimiter = ',', default_values_t = [DEFAULT_K])]
    k: Vec<u8>,
    /// Turns of the novel view, degrees, between commas
    #[arg(long, alias = "angle", value_name = "DEG", value_parser = parse_angle, value_delimiter = ',', default_value = "5,30")]
    angles: Vec<f32>,
    /// Columns and rows of lists, between commas [default: those of the pictures]
    #[arg(long, value_name = "WxH", value_parser = parse_size, value_delimiter = ',')]
    frame_size: Vec<[u32; 2]>,
    /// Rounds of which the least time counts
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=1000))]
    repeats: u32,
    /// Backends, between commas [default: cpu, and gpu if there is one]
    #[arg(long, value_name = "BACKEND", value_delimiter = ',')]
    backend: Vec<BackendChoice>,
    // These come last because clap would list later arguments under their headings.
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Args)]
struct LatencyArgs {
    #[command(flatten)]
    lists: ListArgs,
    /// Whether frames are requested for the predicted pose, between commas: on, off
    #[arg(long, value_enum, value_name = "SWITCH", value_delimiter = ',', default_values_t = [Switch::On])]
    prediction: Vec<Switch>,
    /// Round-trip times, between commas [default: the link's, or 0ms,100ms,300ms]
    #[arg(long, alias = "rtts", value_name = "TIME", value_parser = parse_duration, value_delimiter = ',')]
    rtt: Vec<Duration>,
    /// Speeds of the camera, degrees a second, between commas
    #[arg(long, value_name = "DEG", default_value = "30", value_parser = parse_speed, value_delimiter = ',')]
    speed: Vec<f32>,
    /// Most pictures of each run that are compared with the truth
    #[arg(long, value_name = "N", default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    compared: u32,
    /// Keep the pictures and reports of each run in a folder of its own in DIR
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    backend: BackendArgs,
    #[command(flatten)]
    path: PathArgs,
    // These come last because clap would list later arguments under their headings.
    #[command(flatten)]
    common: CommonArgs,
    #[command(flatten)]
    plan: PlanArgs,
    #[command(flatten)]
    link: LinkArgs,
    #[command(flatten)]
    foresight: ForesightArgs,
}

pub(crate) fn run(args: BenchArgs) -> Result<()> {
    match args.table {
        Table::Speed(args) => run_speed(args),
        Table::Latency(args) => run_latency(args),
        Table::Pipeline(args) => pipeline::run(*args),
        Table::Viewers(args) => viewers::run(args),
    }
}

fn run_speed(args: SpeedArgs) -> Result<()> {
    let common = args.common;
    // This comes first, so that bad usage opens no device.
    common.check_output()?;
    let subject = common.subject(args.k, args.angles)?;
    let mut backends = distinct(args.backend);
    if backends.is_empty() {
        backends.push(BackendChoice::Cpu);
        if let Ok(Backend::Gpu(_)) = Backend::open(BackendChoice::Gpu) {
            backends.push(BackendChoice::Gpu);
        }
    }
    let frame_sizes = if args.frame_size.is_empty() { vec![common.size] } else { args.frame_size };
    let report = speed::run(&speed::SpeedOptions {
        subject,
        backends,
        frame_sizes: distinct(frame_sizes),
        repeats: args.repeats,
    })?;
    common.publish(&report, &speed::table(&report), &report.conditions.subject.failed)
}

fn run_latency(args: LatencyArgs) -> Result<()> {
    let common = args.common;
    common.check_output()?;
    let path = args.path.read()?;
    let mut speeds = distinct(args.speed);
    if path.is_some() && speeds.len() > 1 {
        note("a path is played as it was recorded, at its own speed");
        speeds.truncate(1);
    }
    let (mode, isos) = common.look.mode()?;
    let link = args.link.model(None, Duration::ZERO)?;
    let rtts = match distinct(args.rtt) {
        given if !given.is_empty() => given,
        _ if args.link.is_named() => vec![link.rtt],
        _ => [0, 100, 300].map(Duration::from_millis).into(),
    };
    let report = latency::run(&latency::LatencyOptions {
        scenes: common.select()?,
        contenders: distinct(args.prediction)
            .into_iter()
            .map(|switch| Contender { rival: None, never_predicts: switch == Switch::Off })
            .collect(),
        degrees_per_second: speeds,
        rtts,
        out: args.out,
        demo: DemoOptions {
            transfer: common.look.tf.clone(),
            shaded: common.look.is_shaded(),
            mode,
            isos,
            clip: common.look.clip.clip(),
            k: args.lists.k,
            orbit: common.orbit,
            path,
            foresight: args.foresight.foresight(),
            intrinsics: common.intrinsics(),
            backend: args.backend.backend,
            link,
            plan: args.plan.plan(None),
            max_evaluated: args.compared as usize,
            ..DemoOptions::default()
        },
    })?;
    common.publish(&report, &latency::table(&report), &report.conditions.subject.failed)
}

/// Degrees, finite.
fn parse_angle(text: &str) -> Result<f32, String> {
    let degrees = text.parse::<f32>().ok().filter(|d| d.abs() <= 360.0);
    degrees.ok_or_else(|| "expected degrees, -360 to 360".into())
}
